// Tests of the patches, the boot ROM and the machine: node --test test.mjs
import test from 'node:test';
import assert from 'node:assert/strict';
import { Machine, BYTE_TICKS } from './machine.mjs';
import { PowerCut } from './bootrom.mjs';

const PIO = 0x50200000, DMA = 0x50000000, RAM = 0x20000000;
const sm = (machine, register) => PIO + 0xc8 + 0x18 * machine + register;
const [CLKDIV, EXECCTRL, SHIFTCTRL, INSTR, PINCTRL] = [0, 4, 8, 0x10, 0x14];

/** A machine whose core does nothing. */
function bench() {
  const m = new Machine(null, { usb: false });
  m.stall = [0, Infinity];
  for (let gpio = 2; gpio < 8; gpio++) m.mcu.gpio[gpio].ctrl = 6; // PIO 0
  m.mcu.pio[0].pinDirections = 0xfc;
  m.mcu.pio[0].checkChangedPins();
  m.edges = [];
  return m;
}
const write = (m, address, value) => m.mcu.writeUint32(address, value >>> 0);
const load = (m, program, at = 0) => program.forEach((word, i) => write(m, PIO + 0x48 + 4 * (at + i), word));
/** Cycles between level changes of a pin. */
const gaps = (m, gpio) => {
  const at = m.edges.filter(([, g]) => g === gpio).map(([cycle]) => cycle);
  return at.slice(1).map((cycle, i) => cycle - at[i]);
};
/** set pins 1 [a] / set pins 0 [b], on GPIO 2. */
function blink(m, a, b, divider = 1 << 16) {
  load(m, [0xe001 | (a << 8), 0xe000 | (b << 8)]);
  write(m, sm(0, CLKDIV), divider);
  write(m, sm(0, EXECCTRL), 1 << 12);
  write(m, sm(0, PINCTRL), (1 << 26) | (2 << 5));
  write(m, PIO, 1);
}

test('a machine runs once a tick, delays included', () => {
  const m = bench();
  blink(m, 0, 4);
  m.run(60);
  assert.deepEqual(gaps(m, 2).slice(0, 6), [1, 5, 1, 5, 1, 5]);
});

test('a disabled machine stands still', () => {
  const m = bench();
  blink(m, 0, 0);
  write(m, PIO, 0);
  m.edges = [];
  m.run(50);
  assert.deepEqual(m.edges, []);
});

test('the clock divider divides, its fraction too', () => {
  const whole = bench();
  blink(whole, 0, 0, 3 << 16);
  whole.run(60);
  assert.deepEqual(gaps(whole, 2).slice(0, 4), [3, 3, 3, 3]);
  const half = bench();
  blink(half, 0, 0, (2 << 16) | (128 << 8));
  half.run(60);
  const got = gaps(half, 2).slice(0, 8);
  assert.equal(got.reduce((a, b) => a + b), 20, '2.5 on the average');
});

test('joined FIFOs hold eight words', () => {
  const m = bench();
  write(m, sm(0, SHIFTCTRL), (1 << 30) | (3 << 18));
  for (let i = 0; i < 10; i++) write(m, PIO + 0x10, i);
  assert.equal(m.mcu.readUint32(PIO + 0xc) & 0xf, 8);
  write(m, sm(0, SHIFTCTRL), 3 << 18);
  assert.equal(m.mcu.readUint32(PIO + 0xc) & 0xf, 0, 'changing the join empties them');
});

test('autopull refills in the background', () => {
  const m = bench();
  // out x, 32 / 1: jmp x-- 1: with a word in the OSR already, no cycle is lost at the next OUT
  load(m, [0x6020, 0x0041, 0xe001, 0x6020, 0xe000]);
  write(m, sm(0, EXECCTRL), 4 << 12);
  write(m, sm(0, SHIFTCTRL), (1 << 30) | (3 << 18) | (1 << 17));
  write(m, sm(0, PINCTRL), (1 << 26) | (2 << 5));
  write(m, PIO, 0xf0);
  for (const word of [2, 0, 2, 0]) write(m, PIO + 0x10, word);
  write(m, PIO, 1);
  m.run(60);
  // set 1; out; set 0: two cycles.
  assert.equal(gaps(m, 2)[0], 2);
});

test('an input reaches a machine two ticks after the pad', () => {
  for (const level of [0, 1]) {
    const m = bench();
    m.mcu.gpio[20].padValue = 0x46;
    m.setInput(20, 1 - level);
    m.run(10);
    // wait <level> gpio 20 / set pins 1 / jmp 2
    load(m, [0x2000 | (level << 7) | 20, 0xe001, 0x0002]);
    write(m, sm(0, PINCTRL), (1 << 26) | (2 << 5));
    write(m, PIO, 1);
    m.run(30);
    m.edges = [];
    m.setInput(20, level);
    const at = m.cycle;
    m.run(60);
    // Two in the synchroniser, of which the second is that of the wait; then the set.
    assert.deepEqual(m.edges.map(([cycle, gpio]) => [cycle - at, gpio]), [[3, 2]]);
  }
});

test('jmp pin sees the synchronised level', () => {
  const m = bench();
  // 0: jmp pin 2 / 1: jmp 0 / 2: set pins 1 / 3: jmp 3
  load(m, [0x00c2, 0x0000, 0xe001, 0x0003]);
  write(m, sm(0, EXECCTRL), (20 << 24) | (31 << 12));
  write(m, sm(0, PINCTRL), (1 << 26) | (2 << 5));
  write(m, PIO, 1);
  m.run(20);
  m.setInput(20, 1);
  const at = m.cycle;
  m.run(40);
  const [[cycle]] = m.edges;
  assert.ok(cycle - at >= 3 && cycle - at <= 4, `${cycle - at}`);
});

test('of machines that write the same pin in one tick the highest wins', () => {
  const m = bench();
  load(m, [0xe001, 0xe000]);
  for (const machine of [0, 1]) {
    write(m, sm(machine, EXECCTRL), machine << 12 | machine << 7);
    write(m, sm(machine, PINCTRL), (1 << 26) | (2 << 5));
  }
  write(m, sm(1, INSTR), 1);
  write(m, PIO, 3);
  m.run(20);
  assert.deepEqual(m.edges.filter(([, , level]) => level === 1), []);
});

test('DMA with a chain of pointers stops at a null pointer', () => {
  const m = bench();
  write(m, sm(0, SHIFTCTRL), (1 << 30) | (3 << 18));
  [RAM + 0x100, RAM + 0x108, 0].forEach((pointer, i) => write(m, RAM + 4 * i, pointer));
  [11, 12, 13, 14].forEach((word, i) => write(m, RAM + 0x100 + 4 * i, word));
  const common = 1 | (2 << 2) | (1 << 4) | (1 << 21);
  write(m, DMA + 0x34, PIO + 0x10);
  write(m, DMA + 0x38, 2);
  write(m, DMA + 0x10, common | (1 << 11));
  write(m, DMA + 0x54, RAM);
  write(m, DMA + 0x74, DMA + 0x3c);
  write(m, DMA + 0x78, 1);
  write(m, DMA + 0x50, common | (1 << 11) | (0x3f << 15));
  write(m, DMA + 0x430, 2);
  m.run(50);
  assert.deepEqual(m.mcu.pio[0].machines[0].txFIFO.items, [11, 12, 13, 14]);
  assert.equal(m.mcu.readUint32(DMA + 0x54), RAM + 12, 'the null pointer was read, nothing after it');
});

test('DMA that is aborted stops, and says so', () => {
  const m = bench();
  write(m, sm(0, SHIFTCTRL), (1 << 30) | (3 << 18));
  write(m, DMA, RAM);
  write(m, DMA + 4, PIO + 0x10);
  write(m, DMA + 8, 100);
  write(m, DMA + 0xc, 1 | (2 << 2) | (1 << 4)); // paced by machine 0, which takes nothing
  m.run(20);
  assert.equal(m.mcu.pio[0].machines[0].txFIFO.itemCount, 8);
  write(m, DMA + 0x444, 1);
  assert.equal(m.mcu.readUint32(DMA + 0x444), 0);
  assert.equal(m.mcu.readUint32(DMA + 0xc) & (1 << 24), 0, 'not busy');
});

test('the UART sends a byte in its time and says when it is full', () => {
  const m = bench(), uart = 0x40034000;
  for (let i = 0; i < 32; i++) write(m, uart, i);
  assert.ok(m.mcu.readUint32(uart + 0x18) & (1 << 5), 'full');
  const before = m.cycle;
  m.run(before + 32 * BYTE_TICKS - 10);
  assert.equal(m.sent.uart.length, 32 - (m.cycle < m.sendAt ? 0 : 1));
  m.run(before + 33 * BYTE_TICKS);
  assert.deepEqual(m.sent.uart, Array.from({ length: 32 }, (_, i) => i));
  assert.ok(m.mcu.readUint32(uart + 0x18) & (1 << 7), 'empty');
});

test("the core's timer wraps after 2^24 ticks", () => {
  const m = bench();
  const read = () => m.mcu.readUint32(0xe000e018);
  const first = read();
  m.cycle += 2 ** 24;
  assert.equal(read(), first);
  m.cycle += 5;
  assert.equal(read(), (first - 5) & 0xffffff);
});

/** Calls a function of the boot ROM as a program in RAM would. */
function rom(m, name, ...values) {
  const { core } = m.mcu;
  const call = (address, parameters) => {
    parameters.forEach((value, i) => { core.registers[i] = value; });
    core.registers[14] = RAM + 0x1001;
    core.PC = address & ~1;
    for (let i = 0; i < 2; i++) core.executeInstruction();
    return core.registers[0] >>> 0;
  };
  const table = m.mcu.readUint16(0x14), lookup = m.mcu.readUint16(0x18);
  const address = call(lookup, [table, name.charCodeAt(0) | (name.charCodeAt(1) << 8)]);
  assert.notEqual(address, 0, name);
  return call(address, values);
}

test('the boot ROM finds its functions, and not others', () => {
  const m = bench();
  assert.equal(rom(m, 'L3', 1), 31);
  assert.equal(rom(m, 'T3', 8), 3);
  assert.equal(rom(m, 'P3', 0xf0f0), 8);
  assert.equal(rom(m, 'R3', 1), 0x80000000);
  assert.throws(() => rom(m, 'ZZ'));
});

test('memory functions of the boot ROM', () => {
  const m = bench();
  rom(m, 'MS', RAM + 16, 0xab, 5);
  rom(m, 'MC', RAM + 32, RAM + 15, 7);
  assert.deepEqual([...m.mcu.sram.subarray(32, 40)], [0, 0xab, 0xab, 0xab, 0xab, 0xab, 0, 0]);
});

test('flash: erasing sets, programming only clears, both only in whole units', () => {
  const m = bench();
  assert.throws(() => rom(m, 'RE', 0x100000, 4096, 65536, 0xd8), /exit_xip/);
  rom(m, 'IF');
  rom(m, 'EX');
  rom(m, 'RE', 0x100000, 4096, 65536, 0xd8);
  for (let i = 0; i < 256; i++) m.mcu.sram[0x2000 + i] = i;
  rom(m, 'RP', 0x100100, RAM + 0x2000, 256);
  m.mcu.sram.fill(0xf0, 0x2000, 0x2100);
  rom(m, 'RP', 0x100100, RAM + 0x2000, 256);
  assert.deepEqual([...m.mcu.flash.subarray(0x100100, 0x100104)], [0, 0, 0, 0]);
  assert.equal(m.mcu.flash[0x1001ff], 0xf0);
  assert.equal(m.mcu.flash[0x1000ff], 0xff);
  assert.throws(() => rom(m, 'RP', 0x100101, RAM, 256));
  assert.throws(() => rom(m, 'RE', 0x100000, 256, 0, 0));
  assert.deepEqual(m.operations, [['erase', 0x100000], ['program', 0x100100], ['program', 0x100100]]);
});

test('flash: power goes in the middle of an operation', () => {
  const m = bench();
  m.mcu.flash.fill(0x55, 0x100000, 0x101000);
  rom(m, 'EX');
  m.cut = { operation: 0, part: 0.25 };
  assert.throws(() => rom(m, 'RE', 0x100000, 4096, 65536, 0xd8), PowerCut);
  assert.equal(m.mcu.flash[0x1003ff], 0xff);
  assert.equal(m.mcu.flash[0x100400], 0x55);
  m.powerCycle();
  assert.equal(m.mcu.flash[0x100400], 0x55, 'flash stays');
  assert.equal(m.mcu.sram[0x2000], 0, 'RAM does not');
});

test('flash: routines called from flash are an error', () => {
  const m = bench();
  rom(m, 'EX');
  const { core } = m.mcu;
  core.registers[14] = 0x10000101;
  const stub = 0x200 + 4 * 10; // RE
  [0x100000, 4096].forEach((value, i) => { core.registers[i] = value; });
  core.PC = stub;
  assert.throws(() => core.executeInstruction(), /from flash/);
});

test('the watchdog resets once, RAM and scratch registers stay', () => {
  const m = bench(), watchdog = 0x40058000;
  write(m, watchdog + 0x0c, 0xda1c);
  m.mcu.sram[100] = 7;
  write(m, watchdog + 4, 200); // counts down twice a microsecond
  write(m, watchdog, 1 << 30);
  m.run(100_000);
  assert.equal(m.boots, 2);
  assert.equal(m.mcu.readUint32(watchdog + 0x0c), 0xda1c);
  assert.equal(m.mcu.readUint32(watchdog + 8) & 1, 1, 'reason');
  assert.equal(m.mcu.sram[100], 7);
});

test('the noise of the ring oscillator is another at every boot', () => {
  const noise = (m) => Array.from({ length: 32 }, () => m.mcu.readUint32(0x4006001c)).join('');
  const m = bench(), first = noise(m);
  m.reset();
  assert.notEqual(noise(m), first);
  assert.equal(noise(bench()), first, 'and the same in every run');
});

test('a reset lets go of every output at once', () => {
  const m = bench();
  blink(m, 20, 20);
  m.run(15);
  m.reset();
  assert.deepEqual(m.edges.at(-1), [m.cycle, 7, 4]);
  assert.equal(m.edges.filter(([cycle, gpio]) => gpio === 2 && cycle === m.cycle).length, 1);
});

test('the same stimuli give the same edges', () => {
  const edges = () => {
    const m = bench();
    blink(m, 3, 5);
    m.wire(2, 20);
    m.run(5000);
    return JSON.stringify(m.edges);
  };
  assert.equal(edges(), edges());
});

test('machines that only count are not stepped, and nobody can tell', () => {
  const PIO1 = 0x50300000;
  const program = [0x41, 0xc2, 0xa0c1, 0x44, 0x8000, 0x46, 0x47, 0xc6, 0xa0c1, 0x4a, 0x8000, 0x40, 0];
  const counts = (doze) => {
    const m = bench();
    m.doze = doze;
    program.forEach((word, i) => write(m, PIO1 + 0x48 + 4 * i, word));
    for (const [machine, gpio] of [[0, 21], [1, 26]]) {
      const at = PIO1 + 0xc8 + 0x18 * machine;
      write(m, at + EXECCTRL, (gpio << 24) | (1 << 12));
      write(m, at + SHIFTCTRL, (1 << 31) | (3 << 18));
      write(m, at + CLKDIV, 1 << 16);
      write(m, at + INSTR, 0xa02b); // mov x, ~null
      write(m, at + INSTR, 0);
    }
    write(m, PIO1, 3);
    const seen = [];
    let state = 12345;
    for (let n = 0; n < 200; n++) {
      state = (Math.imul(state, 1103515245) + 12345) >>> 0;
      m.run(m.cycle + 1 + (state >>> 8) % 977);
      m.setInput(state & 1 ? 21 : 26, (state >>> 4) & 1);
      for (const machine of [0, 1])
        while (!(m.mcu.readUint32(PIO1 + 4) & (1 << (8 + machine)))) seen.push([machine, m.mcu.readUint32(PIO1 + 0x20 + 4 * machine)]);
    }
    seen.push(m.mcu.pio[1].machines.slice(0, 2).map((machine) => (m.mcu.pio[1].wake?.(), machine.x)));
    return JSON.stringify(seen);
  };
  const stepped = counts(false);
  assert.ok(stepped.length > 1000);
  assert.equal(counts(true), stepped);
});
