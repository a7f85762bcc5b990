//! Sizes that both sides agree on.

/// Version of the wire format; a box and a host of different versions refuse each other.
pub const PROTOCOL_VERSION: u16 = 1;

/// Largest message body in bytes (postcard, before header, CRC and COBS).
pub const MAX_BODY: usize = 512;

/// Bytes of program carried by one load chunk; every chunk but the last is exactly this long.
pub const CHUNK_LEN: usize = 240;

/// Largest encoded program in bytes.
pub const MAX_PROGRAM_BYTES: usize = 16 * 1024;

/// Largest number of instructions of a stored program.
pub const MAX_INSTRUCTIONS: usize = 1024;

/// Deepest nesting of counted loops.
pub const MAX_LOOP_DEPTH: usize = 8;

/// Events the box keeps for re-reading.
pub const EVENT_RING: usize = 256;

/// Events returned by one `ReadEvents` reply at most.
pub const EVENTS_PER_REPLY: usize = 16;

/// Replies the box keeps, so that a repeated request is answered and not executed again.
pub const REPLY_CACHE: usize = 8;

/// Ticks per second of the player (8 ns, the system clock of the Pico).
pub const TICK_HZ: u32 = 125_000_000;

/// Smallest distance in ticks between two successive words of the player (32 ns).
pub const MIN_STEP_TICKS: u32 = 4;

/// Bytes of a stream that the box holds: what is not yet played, at most.
pub const STREAM_BYTES: usize = MAX_PROGRAM_BYTES;

/// Program slots that a box with permanent memory has at most.
pub const MAX_SLOTS: usize = 8;
