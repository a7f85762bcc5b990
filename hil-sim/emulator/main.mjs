// The emulated Pico as a program.
//
//   node main.mjs IMAGE.elf                                  lockstep: one JSON command a line on stdin,
//                                                            one JSON answer a line on stdout
//   node main.mjs IMAGE.elf --uart PORT --usb PORT           free running, both links on TCP
//        [--script FILE] [--edges FILE] [--ticks N]          stimuli, edges as [tick, gpio, level], end
import fs from 'node:fs';
import net from 'node:net';
import readline from 'node:readline';
import { Machine } from './machine.mjs';
import { PowerCut } from './bootrom.mjs';

const [image, ...rest] = process.argv.slice(2);
const option = (name) => { const at = rest.indexOf(`--${name}`); return at < 0 ? undefined : rest[at + 1]; };
if (!image) {
  console.error('main.mjs IMAGE.elf [--uart PORT] [--usb PORT] [--script FILE] [--edges FILE] [--ticks N]');
  process.exit(2);
}
const elf = fs.readFileSync(image);
const hex = (bytes) => Buffer.from(bytes).toString('hex');

/** What has happened since the last answer. */
function answer(m, extra = {}) {
  const edges = m.edges.filter(([, gpio]) => gpio < 16 || gpio > 19);
  const reply = { cycle: m.cycle, uart: hex(m.sent.uart), usb: hex(m.sent.usb), edges, boots: m.boots, ...extra };
  m.edges = [];
  m.sent = { uart: [], usb: [] };
  return reply;
}

const commands = {
  boot: (m, { usb = false }) => (state.m = new Machine(elf, { usb })),
  send: (m, { link, hex: bytes }) => m.queue[link].push(...Buffer.from(bytes, 'hex')),
  /** `until`: also ends once a frame has come on this link, or all is sent. */
  run: (m, { ticks, until = null }) => {
    const done = until && (() => m.sent[until].at(-1) === 0 && !(m.mcu.uart[0].sending?.length));
    try {
      m.run(m.cycle + ticks, done);
    } catch (error) {
      if (!(error instanceof PowerCut)) throw error;
      return { cut: error.message };
    }
  },
  input: (m, { gpio, level }) => m.setInput(gpio, level),
  wire: (m, { from, to }) => m.wire(from, to),
  stall: (m, { from, to }) => (m.stall = [from ?? m.cycle, to ?? Infinity]),
  slip: (m, { at }) => (m.slip = at),
  reset: (m) => m.reset(),
  power: (m) => m.powerCycle(),
  cut: (m, { operation, part }) => (m.cut = { operation, part }),
  operations: (m) => ({ operations: m.operations }),
  duty: (m) => ({ duty: [0, 1, 2, 3].map((i) => m.duty(i >> 1, i & 1)) }),
  flash: (m, { offset, length }) => ({ flash: hex(m.mcu.flash.subarray(offset, offset + length)) }),
};
const state = { m: new Machine(elf, { usb: option('usb') !== undefined }) };

function lockstep() {
  const lines = readline.createInterface({ input: process.stdin, terminal: false });
  lines.on('line', (line) => {
    const { op, ...parameters } = JSON.parse(line);
    const command = commands[op];
    if (!command) throw new Error(`no command ${op}`);
    const result = command(state.m, parameters);
    const extra = result && Object.getPrototypeOf(result) === Object.prototype && op !== 'boot' ? result : {};
    process.stdout.write(JSON.stringify(answer(state.m, extra)) + '\n');
  });
  lines.on('close', () => process.exit(0));
}

/** Bytes of a link over TCP; time follows the emulation. */
function serve(link, port, sockets) {
  net.createServer((socket) => {
    socket.setNoDelay(true);
    sockets[link] = socket;
    socket.on('data', (bytes) => state.m.queue[link].push(...bytes));
    socket.on('error', () => {});
    socket.on('close', () => { if (sockets[link] === socket) sockets[link] = null; });
  }).listen(Number(port), '127.0.0.1', function () {
    console.error(`${link} on tcp://127.0.0.1:${this.address().port}`);
  });
}

function free() {
  const sockets = {}, { m } = state;
  for (const link of ['uart', 'usb']) if (option(link) !== undefined) serve(link, option(link), sockets);
  // [tick, "input", gpio, level] | [tick, "stall", ticks] | [tick, "reset"] | [tick, "uart" | "usb", hex]
  const script = option('script') ? JSON.parse(fs.readFileSync(option('script'), 'utf8')) : [];
  script.sort((a, b) => a[0] - b[0]);
  const end = Number(option('ticks') ?? Infinity), edges = [];
  m.setInput(20, 1); // the interlock permits unless the script says otherwise
  const turn = () => {
    const until = Math.min(m.cycle + 125_000, end);
    while (script.length && script[0][0] <= until) {
      const [tick, what, a, b] = script.shift();
      m.run(tick);
      if (what === 'input') m.setInput(a, b);
      else if (what === 'stall') m.stall = [m.cycle, m.cycle + a];
      else if (what === 'reset') m.reset();
      else m.queue[what].push(...Buffer.from(a, 'hex'));
    }
    m.run(until);
    for (const link of ['uart', 'usb'])
      if (m.sent[link].length && sockets[link]) sockets[link].write(Buffer.from(m.sent[link].splice(0)));
    edges.push(...m.edges.splice(0));
    if (m.cycle < end) return setImmediate(turn);
    if (option('edges')) fs.writeFileSync(option('edges'), edges.map((e) => JSON.stringify(e)).join('\n') + '\n');
    process.exit(0);
  };
  turn();
}

if (['uart', 'usb', 'script', 'edges', 'ticks'].some((name) => option(name) !== undefined)) free();
else lockstep();
