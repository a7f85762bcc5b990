// The parts of rp2040js that are patched or used; the package itself is installed from the registry
// into the directory that DAIC_EMULATOR_MODULES names.
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const root = process.env.DAIC_EMULATOR_MODULES ?? path.join(import.meta.dirname, 'node_modules');
const from = (file) => import(pathToFileURL(path.join(root, 'rp2040js/dist/esm', file)).href);

export const { RP2040, USBCDC, ConsoleLogger, LogLevel } = await from('index.js');
export const { RPPIO, StateMachine } = await from('peripherals/pio.js');
export const { RPDMA } = await from('peripherals/dma.js');
export const { RPUART } = await from('peripherals/uart.js');
export const { RPPPB } = await from('peripherals/ppb.js');
export const { FIFO } = await from('utils/fifo.js');
