// A Pico with the image in its flash: deterministic, counted in ticks of the system clock (8 ns).
import './patches.mjs';
import { RP2040, USBCDC, ConsoleLogger, LogLevel } from './rp2040.mjs';
import * as bootrom from './bootrom.mjs';

const TICK_NS = 8, TOP_OF_RAM = 0x20041000, FLASH = 0x10000000;
const WATCHDOG = 0x40058, ROSC = 0x40060, RANDOM_BIT = 0x1c;
/** Ticks of a byte on the UART at 1 Mbaud. */
export const BYTE_TICKS = 1250;

/** Puts the loadable parts of an ELF file into the flash. */
function load(elf, flash) {
  const view = Buffer.from(elf.buffer, elf.byteOffset, elf.byteLength);
  const table = view.readUInt32LE(28), count = view.readUInt16LE(44);
  for (let i = 0; i < count; i++) {
    const at = table + 32 * i;
    const [type, from, , physical, size] = [0, 4, 8, 12, 16].map((o) => view.readUInt32LE(at + o));
    if (type === 1 && size && physical >= FLASH && physical < FLASH + flash.length)
      flash.set(view.subarray(from, from + size), physical - FLASH);
  }
}

export class Machine {
  constructor(elf, { usb = true } = {}) {
    this.elf = elf;
    this.usb = usb;
    this.cycle = 0;
    /** [cycle, gpio, level] of every change of an output; level 2 and more: not driven. */
    this.edges = [];
    this.sent = { uart: [], usb: [] };
    this.queue = { uart: [], usb: [] };
    this.inputs = 0;
    /** [cycle, GPIO levels] on their way through the synchroniser. */
    this.arriving = [];
    /** Outputs wired to inputs. */
    this.wires = new Map();
    /** The core does nothing between these cycles. */
    this.stall = [Infinity, Infinity];
    /** The player misses the clock in this cycle. */
    this.slip = -1;
    this.boots = 0;
    /** Machines that only count are not stepped. */
    this.doze = true;
    this.cut = null;
    this.build(null);
  }

  build(before, power = false) {
    const mcu = (this.mcu = new RP2040());
    mcu.logger = new ConsoleLogger(LogLevel.Error, true);
    mcu.ticks = () => this.cycle - this.zero;
    mcu.synchronised = this.inputs >>> 0;
    if (before) mcu.flash.set(before.flash);
    else if (this.elf) load(this.elf, mcu.flash);
    if (before && !power) { // a reset keeps RAM and the watchdog's scratch registers
      mcu.sram.set(before.sram);
      const [to, from] = [mcu.peripherals[WATCHDOG], before.peripherals[WATCHDOG]];
      to.scratchData.set(from.scratchData);
      to.reason = from.reason;
    }
    this.zero = this.cycle;
    new Uint8Array(mcu.bootrom.buffer).set(bootrom.image());
    mcu.core.SP = TOP_OF_RAM;
    mcu.core.LR = 0;
    mcu.core.PC = FLASH; // at the second stage of the boot, as the ROM would
    this.flashOut = false;
    this.operations = [];
    this.extra = 0;
    mcu.onBreak = (number) => { this.extra += bootrom.call(this, number); };
    const watchdog = mcu.peripherals[WATCHDOG];
    watchdog.onWatchdogTrigger = () => {
      // Stock would fire again for ever inside one step of the clock.
      watchdog.alarm.enable = false;
      watchdog.timer.enable = false;
      this.resetting = true;
    };
    // Noise that is another at every boot, and the same in every run.
    let noise = (this.boots + 1) * 0x9e3779b1;
    const rosc = mcu.peripherals[ROSC], stockRosc = rosc.readUint32.bind(rosc);
    rosc.readUint32 = (offset) => {
      if (offset !== RANDOM_BIT) return stockRosc(offset);
      noise = (Math.imul(noise, 1664525) + 1013904223) >>> 0;
      return noise >>> 31;
    };
    mcu.uart[0].onByte = (byte) => this.sent.uart.push(byte);
    mcu.gpio.forEach((pin, gpio) => {
      pin.rawInputValue = !!((this.inputs >>> gpio) & 1);
      pin.addListener((level) => this.changed(gpio, level));
    });
    this.armed = new Map();
    this.configured = false;
    if (this.usb) {
      const cdc = (this.cdc = new USBCDC(mcu.usbCtrl));
      cdc.onDeviceConnected = () => { this.configured = true; };
      cdc.onSerialData = (bytes) => this.sent.usb.push(...bytes);
      // Stock forgets a buffer armed before SET_CONFIGURATION and answers an idle one with nothing.
      mcu.usbCtrl.onEndpointRead = (endpoint, size) => this.armed.set(endpoint, size);
    }
    this.byteAt = this.cycle;
    this.sendAt = this.cycle;
    this.boots++;
  }

  changed(gpio, level) {
    this.edges.push([this.cycle, gpio, level]);
    const to = this.wires.get(gpio);
    if (to !== undefined && level < 2) this.setInput(to, level);
  }

  executing(from, to) {
    // The routine returns to whoever called it.
    const caller = this.mcu.core.LR >>> 0;
    return caller >= from && caller < to;
  }

  result(value) { this.mcu.core.registers[0] = value >>> 0; }

  setInput(gpio, level) {
    const bit = 2 ** gpio;
    const before = this.inputs;
    this.inputs = level ? (before | bit) >>> 0 : (before & ~bit) >>> 0;
    if (this.inputs === before) return;
    this.mcu.gpio[gpio].setInputValue(!!level);
    this.arriving.push([this.cycle + 2, this.inputs]);
  }

  wire(from, to) { this.wires.set(from, to); }

  /** Power off and on: RAM is gone, flash stays. */
  powerCycle() { this.cut = null; this.build(this.mcu, true); }

  /** The reset pin. */
  reset() {
    // All pins are inputs from now on.
    this.release();
    const before = this.mcu;
    before.peripherals[WATCHDOG].reason = 0;
    before.peripherals[WATCHDOG].scratchData.fill(0);
    this.build(before);
  }

  release() {
    this.mcu.gpio.forEach((pin, gpio) => { if (pin.value < 2) this.changed(gpio, 4); });
  }

  /** Runs up to `end`, or until `done` says so, looked at every `every` cycles. */
  run(end, done = null, every = 1000) {
    let look = this.cycle + every;
    const { queue } = this;
    while (this.cycle < end) {
      if (this.cycle >= look) {
        if (done && done()) return true;
        look = this.cycle + every;
      }
      const { mcu } = this;
      if (this.cycle >= this.byteAt && queue.uart.length && mcu.uart[0].enabled && !mcu.uart[0].rxFIFO.full) {
        mcu.uart[0].feedByte(queue.uart.shift());
        this.byteAt = this.cycle + BYTE_TICKS;
      }
      if (this.cycle >= this.sendAt) {
        mcu.uart[0].send();
        this.sendAt = this.cycle + BYTE_TICKS;
      }
      if (queue.usb.length && this.configured && this.armed.has(this.cdc.outEndpoint)) {
        const endpoint = this.cdc.outEndpoint;
        const bytes = queue.usb.splice(0, this.armed.get(endpoint));
        this.armed.delete(endpoint);
        mcu.usbCtrl.endpointReadDone(endpoint, Uint8Array.from(bytes));
      }
      const stalled = this.cycle >= this.stall[0] && this.cycle < this.stall[1];
      let n = stalled || mcu.core.waiting ? 1 : mcu.core.executeInstruction();
      n += this.extra;
      this.extra = 0;
      const { clock } = mcu, [p0, p1] = mcu.pio;
      // While the flash is busy nothing else goes on: a byte time at once.
      while (n > 2 * BYTE_TICKS && (p1.stopped || p1.sleeping) && !p0.machines.some((m) => m.enabled)) {
        n -= BYTE_TICKS;
        this.cycle += BYTE_TICKS;
        clock.tick(TICK_NS * BYTE_TICKS);
        if (p1.sleeping) p1.asleep += BYTE_TICKS;
        if (this.resetting) break;
      }
      for (; n > 0; n--) {
        this.cycle++;
        clock.tick(TICK_NS);
        if (this.arriving.length && this.arriving[0][0] <= this.cycle) {
          p1.wake();
          mcu.synchronised = this.arriving.shift()[1] >>> 0;
        }
        if (!p0.stopped && this.cycle !== this.slip) p0.tick();
        if (p1.sleeping) p1.asleep++;
        else if (!p1.stopped) {
          p1.tick();
          if ((this.cycle & 63) === 0 && this.doze) p1.doze();
        }
      }
      if (this.resetting) {
        this.resetting = false;
        this.release();
        this.build(mcu);
      }
    }
    return !!done && done();
  }

  /** Duty cycle of PWM slice and channel as a fraction. */
  duty(slice, channel) {
    const { cc, top, csr } = this.mcu.pwm.channels[slice];
    return csr & 1 ? (channel ? cc >>> 16 : cc & 0xffff) / (top + 1) : 0;
  }
}
