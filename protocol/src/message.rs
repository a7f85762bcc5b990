//! Requests, replies and events.
//!
//! Append-only enums: a variant never changes its place or its fields; `tests/golden.rs` pins the
//! bytes of each.

use crate::channels::INPUTS;
use crate::limits::{CHUNK_LEN, EVENTS_PER_REPLY, MAX_SLOTS};
use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

/// Hash (CRC-32/ISO-HDLC) over the golden bytes of all messages, in the order of `tests/golden.rs`,
/// which computes it anew. A change means that the messages have changed.
pub const SCHEMA_HASH: u32 = 0x6bab_7c13;

/// From host to box. The frame header carries the request id.
// Nothing here can be boxed: there is no allocator.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Request {
    /// Who are you? Frozen for ever.
    Hello,
    /// State, position, program, counters.
    Status,
    /// Start staging a program of `length` bytes; drops an earlier unfinished staging.
    LoadBegin {
        /// Encoded length in bytes.
        length: u32,
    },
    /// The bytes at `index * CHUNK_LEN`; chunks may come in any order, each exactly once or repeated identically.
    LoadChunk {
        /// Chunk number from 0.
        index: u16,
        /// [`CHUNK_LEN`] bytes, fewer only in the last chunk.
        data: Vec<u8, CHUNK_LEN>,
    },
    /// Validate what was staged; only a valid program replaces the old one.
    LoadCommit {
        /// Must equal that of `LoadBegin`.
        length: u32,
        /// CRC-32 (ISO-HDLC) over the encoded program.
        hash: u32,
    },
    /// Forget what was staged.
    LoadAbort,
    /// Make the committed program ready.
    Arm {
        /// Must be the hash of the committed program.
        hash: u32,
    },
    /// Play the armed program from its first instruction.
    Start,
    /// End after the current instruction, outputs safe, position known.
    Stop,
    /// Outputs safe now. Position stays known (steps made are counted).
    Abort,
    /// Leave the faulted state.
    ClearFault,
    /// Events from `from` on.
    ReadEvents {
        /// Sequence number of the first event wanted.
        from: u32,
    },
    /// One clock sample; the reply carries the tick at which the request was received.
    Clock,
    /// Begin a program that comes while it is played; the box is armed for it. The committed program
    /// stays where it is.
    StreamBegin,
    /// The bytes of the stream at `offset`. What has been received before is ignored, so a repeat
    /// does no harm; a gap is refused.
    StreamWrite {
        /// Absolute: counted from the beginning of the stream.
        offset: u32,
        /// Bytes of instructions, cut anywhere.
        data: Vec<u8, CHUNK_LEN>,
    },
    /// The stream is complete.
    StreamEnd {
        /// Bytes of the whole stream.
        length: u32,
        /// CRC-32 (ISO-HDLC) over the whole stream.
        hash: u32,
    },
    /// How far the stream is.
    StreamStatus,
    /// The input word and what was counted on it.
    Inputs,
    /// Keep the committed program in a slot of permanent memory.
    SlotStore {
        /// Slot number.
        slot: u8,
        /// When to start it without a host.
        autostart: Autostart,
    },
    /// Commit the program of a slot; it is verified as if it had been loaded.
    SlotLoad {
        /// Slot number.
        slot: u8,
    },
    /// Forget the program of a slot.
    SlotErase {
        /// Slot number.
        slot: u8,
    },
    /// What the slots hold.
    Slots,
    /// Test the box itself; outputs do not change.
    SelfTest,
    /// How the board itself is doing.
    Health,
}

/// When a stored program starts without a host. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Autostart {
    /// Never.
    Off,
    /// At power-up.
    PowerUp,
    /// At every rising edge of a trigger input, while nothing else is played.
    Input {
        /// Trigger input.
        input: u8,
    },
}

/// From box to host. The frame header carries the id of the request answered.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reply {
    /// Answer to `Hello`.
    Hello(Hello),
    /// Answer to `Status`.
    Status(Status),
    /// The request has been carried out (or, for `Start`, accepted).
    Done {
        /// State after the request.
        state: State,
    },
    /// The request was refused and had no effect.
    Refused(Refusal),
    /// Answer to `ReadEvents`.
    Events(Events),
    /// Answer to `Clock`.
    Clock {
        /// Tick at which the request's last byte was received.
        tick: u64,
    },
    /// Answer to `StreamBegin`, `StreamWrite`, `StreamEnd` and `StreamStatus`.
    Stream(StreamState),
    /// Answer to `Inputs`.
    Inputs(Inputs),
    /// Answer to `Slots`.
    Slots(Vec<SlotInfo, MAX_SLOTS>),
    /// Answer to `SelfTest`.
    SelfTest(SelfTest),
    /// Answer to `Health`.
    Health(Health),
}

/// How the board itself is doing; all zero from a board that does not measure itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Health {
    /// Why the board last started.
    pub reset: ResetCause,
    /// Bytes of memory between variables and the top of the stack.
    pub stack_size: u32,
    /// Most bytes of stack ever in use since the start.
    pub stack_peak: u32,
    /// Bytes received while there was no room for them.
    pub received_lost: u32,
    /// Replies dropped because nobody took the ones before.
    pub replies_lost: u32,
    /// Least ticks by which words were ready before their time in the last run.
    pub lead: u32,
    /// Longest turn of the main loop since the start, in ticks.
    pub turn: u32,
}

/// Why a board last started. Append-only.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum ResetCause {
    /// Not known, or power was switched on.
    #[default]
    Power,
    /// The watchdog: the program hung.
    Watchdog,
    /// The program found an impossible state, made the outputs safe and started anew.
    Panic,
    /// The processor refused an instruction or an access.
    HardFault,
}

/// How far a stream is. All byte counts are absolute: counted from the beginning of the stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamState {
    /// Bytes received.
    pub received: u32,
    /// Bytes of instructions that have begun.
    pub consumed: u32,
    /// Credit: no byte at or beyond this offset may be sent yet.
    pub limit: u32,
    /// Ticks of program still to be played (waits at their shortest).
    pub lead: u64,
    /// Smallest lead since the start, taken whenever bytes came in; `u64::MAX` before.
    pub min_lead: u64,
    /// Instructions begun.
    pub instruction: u32,
    /// Whether the stream is complete.
    pub ended: bool,
}

/// The inputs and what was counted on them since boot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Inputs {
    /// The input word, see [`channels`](crate::channels).
    pub word: u32,
    /// Rising edges of each trigger input.
    pub rising: [u32; INPUTS as usize],
    /// Triggers that nothing waited for while a program was played.
    pub missed: [u32; INPUTS as usize],
    /// Axes that know where they are, one bit each.
    pub homed: u8,
}

/// What a slot holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SlotInfo {
    /// Slot number.
    pub slot: u8,
    /// Bytes of the program.
    pub length: u32,
    /// Its hash.
    pub hash: u32,
    /// When it starts.
    pub autostart: Autostart,
}

/// What the self-test found; bits of [`SelfTests`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SelfTest {
    /// Tests made.
    pub made: u32,
    /// Tests failed.
    pub failed: u32,
}

/// Bits of [`SelfTest`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SelfTests;
impl SelfTests {
    /// CRC-32 of the check string.
    pub const CRC: u32 = 1;
    /// The committed program still has its hash.
    pub const PROGRAM: u32 = 2;
    /// Step times of a known move.
    pub const MOTION: u32 = 4;
    /// The verifier refuses a program that is known to be wrong, and accepts one that is right.
    pub const VERIFIER: u32 = 8;
    /// A frame encoded is the frame decoded.
    pub const FRAMING: u32 = 16;
    /// Outputs are safe.
    pub const OUTPUTS: u32 = 32;
    /// From this bit on: tests of the board itself.
    pub const BOARD: u32 = 1 << 16;
}

/// Why permanent memory refused. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SlotError {
    /// The box has no permanent memory.
    NoMemory,
    /// No such slot.
    NoSuchSlot,
    /// Nothing is stored there.
    Empty,
    /// What is stored there is damaged.
    Damaged,
    /// It could not be written.
    WriteFailed,
}

/// What the box is and can do. **Frozen for ever**: a host of any version can read it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// Always [`Hello::MAGIC`]: tells the box from any other thing on a serial port.
    pub magic: u32,
    /// [`PROTOCOL_VERSION`](crate::limits::PROTOCOL_VERSION) of the box.
    pub protocol: u16,
    /// Hash over the golden bytes of all messages; differs when the messages differ.
    pub schema: u32,
    /// Firmware version, "major.minor.patch".
    pub firmware: String<16>,
    /// Board name.
    pub board: String<16>,
    /// Drawn anew at every boot: a change means the box was reset.
    pub boot_id: u32,
    /// Ticks per second.
    pub tick_hz: u32,
    /// Bits of [`Capabilities`].
    pub capabilities: u32,
    /// Number of LEDs, cameras, axes, trigger inputs.
    pub leds: u8,
    /// Number of camera trigger lines.
    pub cameras: u8,
    /// Number of stage axes.
    pub axes: u8,
    /// Number of trigger inputs.
    pub inputs: u8,
    /// Largest encoded program in bytes.
    pub max_program_bytes: u32,
    /// Largest number of instructions.
    pub max_instructions: u16,
    /// Events kept for re-reading.
    pub event_ring: u16,
    /// Smallest distance between two words in ticks.
    pub min_step_ticks: u32,
}

impl Hello {
    /// "daic" in ASCII, big end first.
    pub const MAGIC: u32 = 0x6461_6963;
}

/// Bits of [`Hello::capabilities`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capabilities;
impl Capabilities {
    /// The box is a simulation.
    pub const SIMULATED: u32 = 1;
    /// `WaitTrigger` is played.
    pub const TRIGGER_INPUTS: u32 = 2;
    /// Moves may be limited in jerk.
    pub const JERK: u32 = 4;
    /// Programs longer than memory can be streamed.
    pub const STREAMING: u32 = 8;
    /// Programs can be stored in flash.
    pub const FLASH: u32 = 16;
    /// There is an interlock input.
    pub const INTERLOCK: u32 = 32;
    /// Exposure-active lines of the cameras are stamped.
    pub const EXPOSURE_ACTIVE: u32 = 64;
}

/// State of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum State {
    /// No program committed.
    Empty,
    /// A valid program is committed.
    Loaded,
    /// Ready to start.
    Armed,
    /// Playing.
    Running,
    /// Ended in a fault, outputs safe; only `ClearFault` leaves this state.
    Faulted,
}

/// Answer to `Status`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// State now.
    pub state: State,
    /// Tick now.
    pub tick: u64,
    /// Boot id, as in `Hello`.
    pub boot_id: u32,
    /// Hash of the committed program, if any.
    pub program: Option<u32>,
    /// Position of each axis in steps.
    pub position: [i32; 6],
    /// Sequence number the next event will get.
    pub next_event: u32,
    /// Number of the run since boot (0 = none yet).
    pub run: u32,
    /// Index of the instruction being played.
    pub instruction: u16,
    /// Fault, if the state is `Faulted`.
    pub fault: Option<Fault>,
    /// Frames rejected since boot, by cause.
    pub rejected: Rejected,
}

/// Frames that were received and rejected, by cause.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejected {
    /// Longer than the longest frame.
    pub oversized: u32,
    /// Not COBS.
    pub cobs: u32,
    /// Length differs from that in the header.
    pub length: u32,
    /// CRC wrong.
    pub crc: u32,
    /// CRC right, but of another version or not a request.
    pub header: u32,
    /// CRC right, but the body does not decode or leaves bytes over.
    pub body: u32,
}

/// Why a request was refused. The request had no effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Refusal {
    /// Not possible in this state.
    WrongState {
        /// State of the box.
        state: State,
    },
    /// Longer than the box can hold.
    ProgramTooLong {
        /// Bytes announced.
        length: u32,
        /// Bytes that fit.
        max: u32,
    },
    /// Chunk number or chunk length does not fit the announced length.
    BadChunk {
        /// Chunk number.
        index: u16,
        /// Bytes received.
        length: u16,
        /// Bytes expected (0: no such chunk).
        expected: u16,
    },
    /// A chunk was repeated with other content.
    ChunkChanged {
        /// Chunk number.
        index: u16,
    },
    /// Commit before all chunks were there.
    ChunkMissing {
        /// First missing chunk.
        index: u16,
    },
    /// Nothing is being staged.
    NotStaging,
    /// Length of commit differs from that of begin.
    LengthDiffers {
        /// Of begin.
        begun: u32,
        /// Of commit.
        committed: u32,
    },
    /// Hash of what was received (or committed) differs from that of the request.
    HashDiffers {
        /// Computed by the box.
        computed: u32,
        /// In the request.
        given: u32,
    },
    /// The program is not valid.
    Invalid(Violation),
    /// A request id was used again for another request.
    IdReused,
    /// No stream has begun.
    NotStreaming,
    /// Bytes of the stream are missing before these.
    StreamGap {
        /// Offset of the first byte missing.
        expected: u32,
        /// Offset given.
        given: u32,
    },
    /// Beyond the credit.
    StreamFull {
        /// No byte at or beyond this offset yet.
        limit: u32,
        /// End of the bytes given.
        end: u32,
    },
    /// The stream was declared complete, or ends in mid-instruction.
    StreamEnded {
        /// Bytes of whole instructions received.
        length: u32,
    },
    /// The interlock is open.
    InterlockOpen,
    /// An axis that has a home switch must be homed before it moves.
    NotHomed {
        /// Axis.
        axis: u8,
    },
    /// An LED has to cool down.
    Cooling {
        /// LED.
        led: u8,
        /// Ticks to wait.
        ticks: u64,
    },
    /// Permanent memory refused.
    Slot {
        /// Slot.
        slot: u8,
        /// Why.
        error: SlotError,
    },
}

/// Which rule a program breaks, where, and by how much.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Violation {
    /// Index of the instruction.
    pub instruction: u16,
    /// The rule.
    pub rule: Rule,
    /// Offending value.
    pub value: i64,
    /// Limit it breaks.
    pub limit: i64,
}

/// Rules of the verifier. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Rule {
    /// The bytes do not decode to an instruction (`value` = byte offset).
    Undecodable,
    /// More instructions than fit.
    TooManyInstructions,
    /// Program without instructions.
    EmptyProgram,
    /// Edge drives bits that it may not (`value` = mask).
    ForbiddenBits,
    /// Edge sets bits outside its mask (`value` = value).
    ValueOutsideMask,
    /// Two words closer than the player can do (`value` = ticks).
    StepTooShort,
    /// Loop count is zero.
    ZeroLoop,
    /// Loop end without begin.
    UnmatchedLoopEnd,
    /// Loop begin without end.
    UnclosedLoop,
    /// Loops nested too deep.
    LoopTooDeep,
    /// Loop whose body takes no time.
    EmptyLoop,
    /// No such axis.
    NoSuchAxis,
    /// No such LED.
    NoSuchLed,
    /// No such trigger input.
    NoSuchInput,
    /// Target beyond the soft limits.
    TargetOutOfRange,
    /// Step rate zero or beyond the axis.
    RateOutOfRange,
    /// Acceleration zero or beyond the axis.
    AccelerationOutOfRange,
    /// Not played by this firmware (see [`Capabilities`]).
    Unsupported,
    /// LED switched on before its level has settled (`value` = ticks since the level was set).
    LevelNotSettled,
    /// LED on longer than its longest pulse (`value` = ticks).
    PulseTooLong,
    /// Program longer than the tick counter allows.
    TooLong,
    /// An output is left on when the program ends (`value` = word); only a safe end is allowed.
    LeftOn,
    /// Whether another rule holds can be neither proven nor refuted within the bounds of the box
    /// (`value` = number of that rule, `limit` = instructions that were played to find out).
    CannotProve,
    /// An LED owes more rest than its window allows (`value` = ticks owed).
    DutyExceeded,
    /// Delay of a wait below the latency of the box (`value` = ticks).
    DelayTooShort,
    /// Skipping edges makes no sense for a level (`value` = skip).
    SkipOfLevel,
    /// A move must end before another begins, before a loop ends, and before the program does.
    MoveNotEnded,
    /// `Reach` without a move under way.
    NothingToReach,
    /// `Join` without a move after it, or an axis joined twice (`value` = axis).
    BadJoin,
    /// Jerk beyond the axis.
    JerkOutOfRange,
    /// The axis has no home switch (`value` = axis).
    NoHomeSwitch,
    /// A policy that does not end safe (`value` = reaction).
    BadPolicy,
    /// Loops cannot be streamed.
    LoopInStream,
}

/// Why the box stopped by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fault {
    /// Cause.
    pub cause: FaultCause,
    /// Tick at which outputs went safe.
    pub tick: u64,
    /// Instruction being played.
    pub instruction: u16,
}

/// Cause of a fault. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FaultCause {
    /// The host asked (`Abort`).
    Aborted,
    /// The player ran dry.
    Underrun,
    /// A committed program broke a rule at run time.
    Internal,
    /// The host has said nothing for the time that the program's policy allows.
    HostLost,
    /// The interlock opened.
    Interlock,
    /// A limit switch was met.
    LimitSwitch {
        /// Axis.
        axis: u8,
    },
    /// No trigger came in time.
    TriggerTimeout {
        /// Trigger input.
        input: u8,
    },
    /// The home switch was not found, or did not let go.
    HomingFailed {
        /// Axis.
        axis: u8,
    },
    /// An LED was about to exceed a limit.
    LedLimit {
        /// LED.
        led: u8,
    },
    /// The processor did not report in time.
    Heartbeat,
}

/// Answer to `ReadEvents`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Events {
    /// Sequence number of the oldest event still kept; larger than asked means events were lost.
    pub oldest: u32,
    /// Sequence number the next event will get.
    pub next: u32,
    /// Events overwritten since boot before anyone read them.
    pub dropped: u32,
    /// Events in order, from the one asked (or the oldest) on.
    pub events: Vec<Event, EVENTS_PER_REPLY>,
}

/// Something that happened on the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// Counts up by one, from 0 at boot.
    pub seq: u32,
    /// When, in ticks since boot.
    pub tick: u64,
    /// What.
    pub kind: EventKind,
}

/// What happened. Append-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum EventKind {
    /// A run began; its ticks count from here.
    RunStarted {
        /// Number of the run since boot.
        run: u32,
        /// Hash of the program.
        program: u32,
    },
    /// Outputs other than step and direction changed.
    Edge {
        /// Bits that changed.
        changed: u32,
        /// The word after the change.
        word: u32,
    },
    /// An LED level was set.
    Level {
        /// LED index.
        led: u8,
        /// Level.
        level: u16,
    },
    /// A mark was passed.
    Mark {
        /// Its id.
        id: u16,
    },
    /// A move began.
    MoveStarted {
        /// Axis.
        axis: u8,
        /// Target in steps.
        target: i32,
    },
    /// A move ended.
    MoveDone {
        /// Axis.
        axis: u8,
        /// Position in steps.
        position: i32,
    },
    /// A settling time ended.
    Settled,
    /// A run ended as programmed (or by `Stop`).
    RunDone {
        /// Number of the run.
        run: u32,
        /// Words put out in this run.
        words: u32,
        /// Events of this run, this one included.
        events: u32,
    },
    /// The box stopped by itself or by `Abort`.
    Faulted {
        /// Cause.
        cause: FaultCause,
        /// Instruction being played.
        instruction: u16,
    },
    /// A trigger that was waited for; the event's tick is the trigger's.
    Triggered {
        /// Trigger input.
        input: u8,
        /// Triggers missed on this input since boot.
        missed: u32,
    },
    /// No trigger came in time.
    TimedOut {
        /// Trigger input.
        input: u8,
    },
    /// A camera began to expose.
    ExposureBegan {
        /// Camera.
        camera: u8,
        /// Ticks since its trigger; `u32::MAX` if there was none.
        after: u32,
    },
    /// A camera ended its exposure.
    ExposureEnded {
        /// Camera.
        camera: u8,
        /// Ticks that it took.
        length: u32,
    },
    /// A camera was triggered and did not expose.
    ExposureMissing {
        /// Camera.
        camera: u8,
        /// Ticks from that trigger to this event.
        after: u32,
    },
    /// An axis knows where it is.
    Homed {
        /// Axis.
        axis: u8,
        /// Steps by which the count was wrong.
        correction: i32,
    },
    /// A streamed run ended with this smallest lead.
    StreamLead {
        /// Ticks.
        ticks: u64,
    },
}
