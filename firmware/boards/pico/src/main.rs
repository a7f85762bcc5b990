//! The daic trigger box on a Raspberry Pi Pico.
//!
//! The controller of `daic-firmware` on real pins. One loop serves links, look-ahead and levels;
//! all timing is in PIO and DMA ([`player`]), so how long a turn takes decides nothing but how far
//! ahead the player is filled.
#![no_std]
#![no_main]

mod clock;
mod flash;
mod inputs;
mod player;
mod reg;
mod reset;
mod serial;
mod stack;

use core::mem::MaybeUninit;
use daic_firmware::links::FrameGate;
use daic_firmware::pico::{INTERLOCK, SLOTS};
use daic_firmware::slots::{self, Slots};
use daic_firmware::{Board, Controller, Sink};
use daic_protocol::channels;
use daic_protocol::limits::MAX_SLOTS;
use daic_protocol::message::{Autostart, FaultCause, Health, ResetCause, SlotError, SlotInfo, State};
use daic_protocol::program::ProgramBytes;
use embedded_hal::pwm::SetDutyCycle;
use flash::Chip;
use hal::Clock;
use hal::fugit::{MicrosDurationU32, RateExtU32};
use hal::pac::{self, interrupt};
use inputs::{Change, Inputs};
use player::Player;
use rp2040_hal as hal;
use serial::{Link, Outgoing};
use usb_device::bus::UsbBusAllocator;

/// The second stage of the boot: sets up the flash chip.
#[unsafe(link_section = ".boot2")]
#[used]
static BOOT2_FIRMWARE: [u8; 256] = rp2040_boot2::BOOT_LOADER_W25Q080;

/// A turn of the main loop that takes longer than this resets the board. The longest is a verification; while
/// a program is played the player itself does not wait so long.
const WATCHDOG: MicrosDurationU32 = MicrosDurationU32::secs(4);

/// What the controller reaches directly: levels at their time; words are the player's.
struct Direct<'a> {
    levels: [&'a mut dyn SetDutyCycle<Error = core::convert::Infallible>; 4],
    /// Tick at which the run under way ends safe by itself.
    ended: Option<u64>,
    slots: Slots<Chip>,
    /// What the slots hold.
    list: heapless::Vec<SlotInfo, MAX_SLOTS>,
}

impl Direct<'_> {
    /// The first slot whose program starts like this.
    fn listed(&self, like: impl Fn(Autostart) -> bool) -> Option<u8> {
        self.list.iter().find(|held| like(held.autostart)).map(|held| held.slot)
    }
}

/// Starts the program that belongs to a trigger input that rose, if nothing else is played.
fn autostart(risen: u32, controller: &mut Controller, direct: &mut Direct<'_>, now: u64) {
    if risen == 0 || !matches!(controller.state(), State::Empty | State::Loaded) {
        return;
    }
    let slot = direct.listed(|start| match start {
        Autostart::Input { input } => channels::trigger_input(input).is_some_and(|bit| risen & bit != 0),
        _ => false,
    });
    if let Some(slot) = slot {
        // Refused: as if there were none.
        let _ = controller.autostart(now, slot, direct);
    }
}

impl Sink for Direct<'_> {
    fn word(&mut self, _: u64, _: u32) {}
    fn level(&mut self, _: u64, led: u8, level: u16) {
        if let Some(channel) = self.levels.get_mut(usize::from(led)) {
            let _ = channel.set_duty_cycle(level);
        }
    }
    fn halt(&mut self, tick: u64) -> u64 {
        if self.ended.is_some_and(|ended| ended <= tick) { tick } else { player::halt().max(tick) }
    }
    fn store(&mut self, slot: u8, program: &[u8], autostart: Autostart) -> Result<(), SlotError> {
        let stored = self.slots.store(slot, program, slots::tag(autostart));
        self.list = self.slots.list();
        stored.map(|_| ())
    }
    fn fetch(&mut self, slot: u8, program: &mut ProgramBytes) -> Result<(), SlotError> {
        self.slots.load(slot, program).map(|_| ())
    }
    fn erase(&mut self, slot: u8) -> Result<(), SlotError> {
        let erased = self.slots.stored(slot).and_then(|_| self.slots.erase(slot));
        self.list = self.slots.list();
        erased
    }
    fn slots(&mut self) -> heapless::Vec<SlotInfo, MAX_SLOTS> {
        self.list.clone()
    }
}

/// The controller, made where it stays: it is too large to be passed about.
#[inline(never)]
fn controller(boot_id: u32) -> &'static mut Controller {
    static mut PLACE: MaybeUninit<Controller> = MaybeUninit::uninit();
    // SAFETY: called once, by `main`, which never ends.
    let place = unsafe { &mut *(&raw mut PLACE) };
    place.write(Controller::new(Board::pico(), boot_id))
}

#[hal::entry]
fn main() -> ! {
    stack::paint();
    let (cause, boots) = reset::cause();
    // Every peripheral is taken here and nowhere else.
    let (Some(mut p), Some(mut core)) = (pac::Peripherals::take(), pac::CorePeripherals::take()) else {
        unreachable!()
    };
    let mut watchdog = hal::watchdog::Watchdog::new(p.WATCHDOG);
    let Ok(clocks) = hal::clocks::init_clocks_and_plls(
        12_000_000,
        p.XOSC,
        p.CLOCKS,
        p.PLL_SYS,
        p.PLL_USB,
        &mut p.RESETS,
        &mut watchdog,
    ) else {
        unreachable!()
    };
    watchdog.start(WATCHDOG);
    let sio = hal::Sio::new(p.SIO);
    let pins = hal::gpio::Pins::new(p.IO_BANK0, p.PADS_BANK0, sio.gpio_bank0, &mut p.RESETS);
    p.RESETS.reset().modify(|_, w| w.dma().clear_bit().pio0().clear_bit().pio1().clear_bit());
    while {
        let done = p.RESETS.reset_done().read();
        done.dma().bit_is_clear() || done.pio0().bit_is_clear() || done.pio1().bit_is_clear()
    } {}
    let mut player = Player::new();
    clock::start(&mut core.SYST);
    let mut inputs = Inputs::new();

    let slices = hal::pwm::Slices::new(p.PWM, &mut p.RESETS);
    let (mut pwm0, mut pwm1) = (slices.pwm0, slices.pwm1);
    // With this top every 16-bit level is a duty cycle, 65 535 fully on.
    pwm0.set_top(0xfffe);
    pwm1.set_top(0xfffe);
    pwm0.channel_a.output_to(pins.gpio16);
    pwm0.channel_b.output_to(pins.gpio17);
    pwm1.channel_a.output_to(pins.gpio18);
    pwm1.channel_b.output_to(pins.gpio19);
    pwm0.enable();
    pwm1.enable();
    let slots = Slots::new(Chip, SLOTS);
    let mut direct = Direct {
        levels: [&mut pwm0.channel_a, &mut pwm0.channel_b, &mut pwm1.channel_a, &mut pwm1.channel_b],
        ended: None,
        list: slots.list(),
        slots,
    };
    for channel in &mut direct.levels {
        let _ = channel.set_duty_cycle(0);
    }
    let uart_pins = (
        pins.gpio0.into_function::<hal::gpio::FunctionUart>(),
        pins.gpio1.into_function::<hal::gpio::FunctionUart>(),
    );
    let config = hal::uart::UartConfig::new(
        serial::BAUD.Hz(),
        hal::uart::DataBits::Eight,
        None,
        hal::uart::StopBits::One,
    );
    let uart = hal::uart::UartPeripheral::new(p.UART0, uart_pins, &mut p.RESETS);
    let Ok(mut uart) = uart.enable(config, clocks.peripheral_clock.freq()) else { unreachable!() };
    uart.enable_rx_interrupt();
    serial::start_uart();
    let bus = hal::usb::UsbBus::new(p.USBCTRL_REGS, p.USBCTRL_DPRAM, clocks.usb_clock, true, &mut p.RESETS);
    if let Some(allocator) =
        cortex_m::singleton!(: UsbBusAllocator<hal::usb::UsbBus> = UsbBusAllocator::new(bus))
    {
        serial::start_usb(allocator);
    }
    // The interlock: only its falling edge matters here, and only for the tick reported.
    let shift = 4 * (u32::from(INTERLOCK) % 8);
    let bank = 4 * (u32::from(INTERLOCK) / 8);
    reg::write(reg::IO_BANK0 + 0xf0 + bank, 0xf << shift);
    reg::write(reg::IO_BANK0 + 0x100 + bank + reg::SET, 4 << shift);
    // SAFETY: the handler below shares nothing but atomics.
    unsafe { pac::NVIC::unmask(pac::Interrupt::IO_IRQ_BANK0) };

    let noise =
        (0..32).fold(0u32, |bits, _| (bits << 1) | u32::from(p.ROSC.randombit().read().randombit().bit()));
    // Another one at every boot: noise of the ring oscillator, and the count since power came.
    let boot_id = noise.wrapping_add(boots.wrapping_mul(0x9e37_79b9));
    let controller = controller(boot_id);
    let mut links = [
        (Link::Uart, FrameGate::new(), Outgoing::new(Link::Uart)),
        (Link::Usb, FrameGate::new(), Outgoing::new(Link::Usb)),
    ];
    let mut watch = stack::Watch::new();
    let mut health = Health { reset: cause, stack_size: stack::Watch::size(), ..Health::default() };
    let mut last = clock::now();
    let (changes, _) = inputs.poll();
    let mut before = 0;
    for Change { tick, word } in changes {
        controller.inputs(tick, word, &mut direct);
        before = word;
    }
    if cause == ResetCause::Power
        && let Some(slot) = direct.listed(|start| start == Autostart::PowerUp)
    {
        // Refused: as if there were none.
        let _ = controller.autostart(clock::now(), slot, &mut direct);
    }
    loop {
        let now = clock::now();
        health.turn = health.turn.max(u32::try_from(now.wrapping_sub(last)).unwrap_or(u32::MAX));
        last = now;
        watchdog.feed();
        player.feed(now);
        direct.ended = player.ended();
        let (changes, known) = inputs.poll();
        for Change { tick, word } in changes {
            if before & !word & channels::INTERLOCK != 0 {
                // The player went safe by itself.
                let opened = player::opened_at().unwrap_or(tick);
                controller.trip(FaultCause::Interlock, opened, &mut direct);
            }
            controller.inputs(tick, word, &mut direct);
            player.inputs(tick, word, controller);
            autostart(word & !before, controller, &mut direct, now);
            before = word;
        }
        controller.play_ahead(now, known, &mut direct);
        player.service(controller, &mut direct);
        watch.look();
        let restarted = serial::restarted();
        for (link, gate, outgoing) in &mut links {
            if restarted && *link == Link::Usb {
                gate.restart();
            }
            // One frame a turn, so that none delays the player by more than itself.
            while let Some((byte, stamp)) = serial::receive(*link) {
                let Some(frame) = gate.feed(byte) else { continue };
                health.received_lost = serial::lost().wrapping_add(Inputs::lost());
                health.stack_peak = watch.peak;
                health.lead = player.lead;
                health.replies_lost = outgoing.lost;
                controller.set_health(health);
                let at = stamp.unwrap_or(now);
                controller.receive(at, frame, &mut direct, &mut |reply| outgoing.send(reply));
                if controller.state() == State::Running {
                    player.service(controller, &mut direct);
                }
                break;
            }
            outgoing.pump();
        }
    }
}

#[interrupt]
fn IO_IRQ_BANK0() {
    player::opened();
    let shift = 4 * (u32::from(INTERLOCK) % 8);
    let bank = 4 * (u32::from(INTERLOCK) / 8);
    reg::write(reg::IO_BANK0 + 0xf0 + bank, 4 << shift);
}
