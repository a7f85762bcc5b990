//! The two links: UART 0 and USB CDC. Bytes come in by interrupt and go out as they are taken.

use crate::{clock, reg};
use core::cell::RefCell;
use critical_section::Mutex;
use daic_protocol::frame::MAX_FRAME;
use heapless::Deque;
use rp2040_hal as hal;
use rp2040_hal::pac::{self, interrupt};
use usb_device::class_prelude::*;
use usb_device::prelude::*;
use usbd_serial::SerialPort;

/// UART speed in bits per second.
pub const BAUD: u32 = 1_000_000;
const RECEIVE: usize = 2048;
const SEND: usize = 4 * MAX_FRAME;

/// Which link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// UART 0.
    Uart,
    /// USB CDC.
    Usb,
}

/// Bytes received on a link, and when the delimiters came.
struct Received {
    bytes: Deque<u8, RECEIVE>,
    stamps: Deque<u64, 64>,
    lost: u32,
}

impl Received {
    const fn new() -> Self {
        Self { bytes: Deque::new(), stamps: Deque::new(), lost: 0 }
    }

    fn push(&mut self, byte: u8) {
        let room = !self.bytes.is_full() && (byte != 0 || !self.stamps.is_full());
        if !room {
            self.lost = self.lost.wrapping_add(1);
            return;
        }
        let _ = self.bytes.push_back(byte);
        if byte == 0 {
            let _ = self.stamps.push_back(clock::now());
        }
    }
}

type Bus = hal::usb::UsbBus;
struct Usb {
    device: UsbDevice<'static, Bus>,
    port: SerialPort<'static, Bus>,
    configured: bool,
    restarted: bool,
}

static FROM_UART: Mutex<RefCell<Received>> = Mutex::new(RefCell::new(Received::new()));
static FROM_USB: Mutex<RefCell<Received>> = Mutex::new(RefCell::new(Received::new()));
static USB: Mutex<RefCell<Option<Usb>>> = Mutex::new(RefCell::new(None));

/// A byte received, and for a delimiter when.
pub fn receive(link: Link) -> Option<(u8, Option<u64>)> {
    let queue = match link {
        Link::Uart => &FROM_UART,
        Link::Usb => &FROM_USB,
    };
    critical_section::with(|cs| {
        let mut queue = queue.borrow_ref_mut(cs);
        let byte = queue.bytes.pop_front()?;
        let stamp = if byte == 0 { queue.stamps.pop_front() } else { None };
        Some((byte, stamp))
    })
}

/// Bytes lost for want of room, on both links.
pub fn lost() -> u32 {
    critical_section::with(|cs| FROM_UART.borrow_ref(cs).lost.wrapping_add(FROM_USB.borrow_ref(cs).lost))
}

/// The USB host has opened the port anew.
pub fn restarted() -> bool {
    critical_section::with(|cs| {
        USB.borrow_ref_mut(cs).as_mut().is_some_and(|usb| core::mem::take(&mut usb.restarted))
    })
}

/// Bytes to be sent on a link.
pub struct Outgoing {
    link: Link,
    bytes: Deque<u8, SEND>,
    /// Replies dropped for want of room.
    pub lost: u32,
}

impl Outgoing {
    /// Nothing to be sent.
    pub const fn new(link: Link) -> Self {
        Self { link, bytes: Deque::new(), lost: 0 }
    }

    /// Sends a frame, whole or not at all.
    pub fn send(&mut self, frame: &[u8]) {
        if SEND.saturating_sub(self.bytes.len()) < frame.len() {
            self.lost = self.lost.wrapping_add(1);
            return;
        }
        for &byte in frame {
            let _ = self.bytes.push_back(byte);
        }
    }

    /// Hands over as much as the link takes now.
    pub fn pump(&mut self) {
        if self.bytes.is_empty() {
            return;
        }
        match self.link {
            Link::Uart => {
                // Transmit FIFO not full.
                while reg::read(reg::UART0 + 0x18) & (1 << 5) == 0 {
                    let Some(byte) = self.bytes.pop_front() else { return };
                    reg::write(reg::UART0, u32::from(byte));
                }
            }
            Link::Usb => critical_section::with(|cs| {
                let mut usb = USB.borrow_ref_mut(cs);
                let Some(usb) = usb.as_mut() else { return };
                if usb.device.state() != UsbDeviceState::Configured {
                    self.bytes.clear();
                    return;
                }
                let (front, _) = self.bytes.as_slices();
                let part = front.get(..front.len().min(64)).unwrap_or(front);
                if let Ok(count) = usb.port.write(part) {
                    for _ in 0..count {
                        self.bytes.pop_front();
                    }
                }
                let _ = usb.port.flush();
            }),
        }
    }
}

/// Starts USB.
pub fn start_usb(allocator: &'static UsbBusAllocator<Bus>) {
    let port = SerialPort::new(allocator);
    let strings = StringDescriptors::default().manufacturer("daic").product("trigger box");
    // 1209:0001 is the test id of pid.codes.
    let builder = UsbDeviceBuilder::new(allocator, UsbVidPid(0x1209, 0x0001)).device_class(2);
    let Ok(builder) = builder.strings(&[strings]) else { return };
    let Ok(builder) = builder.max_packet_size_0(64) else { return };
    let usb = Usb { device: builder.build(), port, configured: false, restarted: false };
    critical_section::with(|cs| USB.borrow_ref_mut(cs).replace(usb));
    // SAFETY: the handler below is ready, and what it shares is behind critical sections.
    unsafe { pac::NVIC::unmask(pac::Interrupt::USBCTRL_IRQ) };
}

/// Lets bytes of the UART come in.
pub fn start_uart() {
    // SAFETY: as above.
    unsafe { pac::NVIC::unmask(pac::Interrupt::UART0_IRQ) };
}

#[interrupt]
fn UART0_IRQ() {
    critical_section::with(|cs| {
        let mut queue = FROM_UART.borrow_ref_mut(cs);
        // Receive FIFO not empty.
        while reg::read(reg::UART0 + 0x18) & (1 << 4) == 0 {
            queue.push(reg::read(reg::UART0) as u8);
        }
    });
}

#[interrupt]
fn USBCTRL_IRQ() {
    critical_section::with(|cs| {
        let mut usb = USB.borrow_ref_mut(cs);
        let Some(usb) = usb.as_mut() else { return };
        let ready = usb.device.poll(&mut [&mut usb.port]);
        let configured = usb.device.state() == UsbDeviceState::Configured;
        usb.restarted |= configured && !usb.configured;
        usb.configured = configured;
        if !ready {
            return;
        }
        let mut bytes = [0; 64];
        if let Ok(count) = usb.port.read(&mut bytes) {
            let mut queue = FROM_USB.borrow_ref_mut(cs);
            bytes.iter().take(count).for_each(|&byte| queue.push(byte));
        }
    });
}
