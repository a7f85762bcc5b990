// A stand-in for the boot ROM: its tables, with functions that are carried out here. Each is a
// breakpoint and a return; the breakpoint's number says which.
const FLASH = 0x10000000, SIZE = 2 * 1024 * 1024;
/** Bytes of the smallest erasure and of a page. */
export const SECTOR = 4096, PAGE = 256;
// Typical times of the W25Q16JV in ticks: 45 ms for a sector, 0.4 ms for a page.
const ERASE_TICKS = 5_625_000, PROGRAM_TICKS = 50_000;
const RUN_FROM_FLASH = 1;

/** Power went before operation `operation` of the flash, or in the middle of it. */
export class PowerCut extends Error {}

const copy = (m, to, from, count) => {
  for (let i = 0; i < count; i++) m.mcu.writeUint8(to + i, m.mcu.readUint8(from + i));
  return 20 + count;
};
const fill = (m, to, value, count) => {
  for (let i = 0; i < count; i++) m.mcu.writeUint8(to + i, value & 0xff);
  return 20 + (count >> 1);
};

/** One erasure of a sector or programming of a page, cut where the machine's `cut` says. */
function flash(m, kind, offset, bytes) {
  if (m.executing(FLASH, FLASH + SIZE)) throw new Error('flash operation called from flash');
  if (!m.flashOut) throw new Error('flash operation without flash_exit_xip');
  if (offset < 0 || offset + bytes.length > SIZE) throw new Error(`flash offset ${offset}`);
  m.operations.push([kind, offset]);
  const cut = m.cut && m.operations.length - 1 === m.cut.operation ? m.cut.part : 1;
  const count = Math.floor(bytes.length * cut);
  for (let i = 0; i < count; i++) {
    const at = offset + i;
    // Programming clears bits, it never sets one.
    m.mcu.flash[at] = kind === 'erase' ? 0xff : m.mcu.flash[at] & bytes[i];
  }
  if (cut < 1) throw new PowerCut(`${kind} ${offset}`);
}

const functions = [
  ['P3', (m, a) => { let n = 0; for (let v = a; v; v &= v - 1) n++; m.result(n); return 10; }],
  ['R3', (m, a) => { let r = 0; for (let i = 0; i < 32; i++) r = (r << 1) | ((a >>> i) & 1); m.result(r); return 10; }],
  ['L3', (m, a) => { m.result(Math.clz32(a)); return 10; }],
  ['T3', (m, a) => { m.result(a ? 31 - Math.clz32(a & -a) : 32); return 10; }],
  ['MS', (m, to, value, count) => fill(m, to, value, count)],
  ['S4', (m, to, value, count) => fill(m, to, value, count)],
  ['MC', (m, to, from, count) => copy(m, to, from, count)],
  ['C4', (m, to, from, count) => copy(m, to, from, count)],
  ['IF', (m) => { m.flashConnected = true; return 100; }],
  ['EX', (m) => { m.flashOut = true; return 100; }],
  ['RE', (m, offset, count, block) => {
    if (offset % SECTOR || count % SECTOR) throw new Error(`erase of ${count} bytes at ${offset}`);
    for (let at = offset; at < offset + count; at += SECTOR) flash(m, 'erase', at, new Uint8Array(SECTOR));
    return ERASE_TICKS * (count / SECTOR);
  }],
  ['RP', (m, offset, data, count) => {
    if (offset % PAGE || count % PAGE) throw new Error(`programming of ${count} bytes at ${offset}`);
    for (let at = 0; at < count; at += PAGE) {
      const page = Uint8Array.from({ length: PAGE }, (_, i) => m.mcu.readUint8(data + at + i));
      flash(m, 'program', offset + at, page);
    }
    return PROGRAM_TICKS * (count / PAGE);
  }],
  ['FC', () => 100],
  ['CX', (m) => { m.flashOut = false; return 100; }],
];
const LOOKUP = 0xff, TABLE = 0x40, CODE = 0x200;

/** The image of the ROM. */
export function image() {
  const view = new DataView(new ArrayBuffer(16384));
  const half = (at, value) => view.setUint16(at, value, true);
  const stub = (at, number) => { half(at, 0xbe00 | number); half(at + 2, 0x4770); };
  view.setUint32(0, 0x20041000, true);
  view.setUint32(4, CODE + 0x100 + 1, true);
  half(0x10, 0x754d); // "Mu"
  half(0x12, 0x0201);
  half(0x14, TABLE);
  half(0x16, TABLE + 4 * functions.length);
  half(0x18, CODE + 4 * functions.length + 1);
  functions.forEach(([name], i) => {
    half(TABLE + 4 * i, name.charCodeAt(0) | (name.charCodeAt(1) << 8));
    half(TABLE + 4 * i + 2, CODE + 4 * i + 1);
    stub(CODE + 4 * i, i);
  });
  stub(CODE + 4 * functions.length, LOOKUP);
  return new Uint8Array(view.buffer);
}

/** Carries out the function of breakpoint `number`; returns the ticks that it takes. */
export function call(m, number) {
  const [a, b, c, d] = m.mcu.core.registers;
  if (number === LOOKUP) {
    const index = functions.findIndex(([name]) => (name.charCodeAt(0) | (name.charCodeAt(1) << 8)) === (b & 0xffff));
    m.result(a === TABLE && index >= 0 ? CODE + 4 * index + 1 : 0);
    return 20 + 6 * Math.max(index, 0);
  }
  const entry = functions[number];
  if (!entry) throw new Error(`breakpoint ${number} at ${m.mcu.core.PC.toString(16)}`);
  return entry[1](m, a, b, c, d);
}
