// What rp2040js 1.4.1 lacks for this image. Each patch has a test of its own in test.mjs.
import { RPPIO, StateMachine, FIFO, RPUART, RPPPB, RPDMA } from './rp2040.mjs';

const machine = StateMachine.prototype, pio = RPPIO.prototype;

// --- PIO: one step per tick of the system clock --------------------------------------------------
// Stock: stepped from setTimeout, disabled machines too; delays, dividers, FIFO joining ignored.
pio.run = function () {};
machine.clkDivRestart = function () { this.fraction = 0; };
const stockWriteFifo = machine.writeFIFO, stockCheckWait = machine.checkWait;
// What waits is released in the machine's own cycle, not in that of the bus.
machine.writeFIFO = function (value) {
  this.held = true;
  stockWriteFifo.call(this, value);
  this.held = false;
};
machine.checkWait = function () { if (!this.held) stockCheckWait.call(this); };
const stockWrite = machine.writeUint32;
machine.writeUint32 = function (offset, value) {
  const before = this.shiftCtrl;
  if (offset === 0x10 && this.waiting) this.waiting = false; // an executed instruction ends a wait
  stockWrite.call(this, offset, value);
  if (offset === 8 && (before ^ this.shiftCtrl) >>> 30) { // FJOIN: sizes change, FIFOs are emptied
    const join = this.shiftCtrl >>> 30;
    this.txFIFO = new FIFO(join & 1 ? 8 : join & 2 ? 1 : 4);
    this.rxFIFO = new FIFO(join & 2 ? 8 : join & 1 ? 1 : 4);
    this.updateDMARx();
    this.updateDMATx();
  }
};
// Autopull refills in the background, not only at the next OUT.
machine.refill = function () {
  if (this.shiftCtrl & (1 << 17) && !this.waiting && this.outputShiftCount >= this.pullThreshold && !this.txFIFO.empty) {
    this.outputShiftReg = this.txFIFO.pull();
    this.outputShiftCount = 0;
    this.updateDMATx();
    this.pio.checkInterrupts();
  }
};
machine.tick = function () {
  const divider = (this.clockDivInt || 65536) * 256 + (this.clockDivInt ? this.clockDivFrac : 0);
  if (divider !== 256) {
    this.fraction = (this.fraction || 0) + 256;
    if (this.fraction < divider) return;
    this.fraction -= divider;
  }
  if (this.delayLeft > 0) { this.delayLeft--; this.refill(); return; }
  const before = this.cycles;
  if (this.waiting) { // the cycle in which a wait is released is used up
    stockCheckWait.call(this);
    if (!this.waiting) this.delayLeft = this.cycles - before;
    return;
  }
  this.updatePC = true;
  this.executeInstruction(this.pio.instructions[this.pc]);
  if (this.updatePC) this.nextPC();
  this.refill();
  const delay = this.cycles - before - 1;
  this.delayLeft = delay > 0 ? delay : 0;
};
pio.tick = function () {
  const m = this.machines;
  for (let i = 0; i < 4; i++) if (m[i].enabled) m[i].tick();
  if (this.pinValues !== this.oldPinValues || this.pinDirections !== this.oldPinDirections) this.checkChangedPins();
};

// --- PIO inputs: two flip-flops between pad and machine -------------------------------------------
// `rp2040.synchronised` is kept by the machine in machine.mjs.
Object.defineProperty(machine, 'inPins', {
  get() {
    const pins = this.rp2040.synchronised, base = this.inBase;
    return base ? ((pins << (32 - base)) | (pins >>> base)) >>> 0 : pins;
  },
});
const stockJump = machine.jmpCondition;
machine.jmpCondition = function (condition) {
  return condition === 6 ? !!((this.rp2040.synchronised >>> this.jmpPin) & 1) : stockJump.call(this, condition);
};
const PIN = 1;
const checkOther = stockCheckWait;
const checkWait = function () {
  if (this.waiting && this.waitType === PIN) {
    if (!!((this.rp2040.synchronised >>> this.waitIndex) & 1) !== this.waitPolarity) return;
    this.waiting = false;
    this.nextPC();
    this.cycles += this.waitDelay;
    this.execCtrl &= ~(1 << 31);
    return;
  }
  checkOther.call(this);
};
machine.checkWait = function () { if (!this.held) checkWait.call(this); };
const tick = machine.tick;
machine.tick = function () {
  if (this.waiting && this.waitType === PIN && !(this.delayLeft > 0)) {
    const before = this.cycles;
    checkWait.call(this);
    if (!this.waiting) this.delayLeft = this.cycles - before;
    return;
  }
  tick.call(this);
};

// --- UART: bytes leave at the speed of the line ---------------------------------------------------
// Stock: sent at once, never full. The machine calls `send` once per byte time.
const uart = RPUART.prototype, stockUartWrite = uart.writeUint32;
const flags = Object.getOwnPropertyDescriptor(uart, 'flags').get;
const FULL = 1 << 5, EMPTY = 1 << 7;
uart.writeUint32 = function (offset, value) {
  if (offset === 0) {
    this.sending ??= [];
    if (this.sending.length < 32) this.sending.push(value & 0xff);
  } else {
    stockUartWrite.call(this, offset, value);
  }
};
Object.defineProperty(uart, 'flags', {
  get() {
    const count = this.sending ? this.sending.length : 0;
    return (flags.call(this) & ~(FULL | EMPTY)) | (count >= 32 ? FULL : 0) | (count === 0 ? EMPTY : 0);
  },
});
uart.send = function () {
  if (this.sending && this.sending.length) this.onByte?.(this.sending.shift());
};

// --- The core's timer: 2²⁴ ticks from wrap to wrap -------------------------------------------------
// Stock: one tick less, because it is set to the reload value in the tick in which it reaches zero.
const stockPpbRead = RPPPB.prototype.readUint32;
RPPPB.prototype.readUint32 = function (offset) {
  if (offset === 0x18) return (0xffffff - (this.rp2040.ticks() & 0xffffff)) >>> 0;
  return stockPpbRead.call(this, offset);
};

// --- DMA: the abort register reads as zero once the channels have stopped --------------------------
// Stock: not readable. Aborting takes no time here.
const stockDmaRead = RPDMA.prototype.readUint32;
RPDMA.prototype.readUint32 = function (offset) { return offset === 0x444 ? 0 : stockDmaRead.call(this, offset); };

// --- PIO: machines that only count while their pin stands still are not stepped ------------------------
// Such a machine is in `jmp x-- next; jmp pin elsewhere` and back. What it would have done is made good
// (`wake`) before a pin changes and before anybody looks; test.mjs holds it against stepping.
const X_MINUS = 0x0040, ON_PIN = 0x00c0, KIND = 0xffe0;
machine.counts = function () {
  if (this.delayLeft > 0 || this.waiting) return false;
  const code = this.pio.instructions, first = (code[this.pc] & KIND) === X_MINUS ? this.pc : this.pc - 1;
  if (first < 0 || (code[first] & KIND) !== X_MINUS || (code[first] & 31) !== first + 1) return false;
  if ((code[first + 1] & KIND) !== ON_PIN) return false;
  const high = (this.rp2040.synchronised >>> this.jmpPin) & 1;
  if (high) return (code[first + 1] & 31) === first;
  return this.wrapTop === first + 1 && this.wrapBottom === first;
};
/** Puts the block to sleep if nothing but counting goes on. */
pio.doze = function () {
  if (this.asleep === undefined) {
    this.asleep = 0;
    for (const name of ['readUint32', 'writeUint32', 'writeUint32Atomic']) {
      const stock = this[name];
      if (stock) this[name] = function (...args) { this.wake(); return stock.apply(this, args); };
    }
  }
  this.sleeping = this.machines.every((m) => !m.enabled || m.counts());
};
pio.wake = function () {
  if (!this.sleeping) return;
  this.sleeping = false;
  const half = this.asleep >>> 1, odd = this.asleep & 1;
  this.asleep = 0;
  for (const m of this.machines) if (m.enabled) m.x = (m.x - half) >>> 0;
  if (odd) this.tick();
};
