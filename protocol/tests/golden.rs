//! The bytes of every message, pinned.
//!
//! Postcard: an enum is its variant number, unsigned numbers are varints (7 bits a byte, low end
//! first), signed ones zigzag varints (0, −1, 1, −2 … are 0, 1, 2, 3 …), `u8` is itself, an option is 0 or 1
//! and the value, a list its length and its items, a struct its fields. A line here never changes;
//! a new variant adds one at the end of its list.

use daic_protocol::frame::{Decoder, Fed, MAX_FRAME, crc32, encode_reply, encode_request};
use daic_protocol::limits::*;
use daic_protocol::message::*;
use daic_protocol::program::{
    self, Condition, Instruction, MAX_INSTRUCTION_BYTES, Policy, Reaction, Timeout, TriggerEdge,
};
use serde::{Serialize, de::DeserializeOwned};
use std::fmt::Debug;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ")
}

fn bytes(hex: &str) -> Vec<u8> {
    hex.split_whitespace().map(|b| u8::from_str_radix(b, 16).unwrap()).collect()
}

/// Checks a list of all variants of `T`, `prefix` bytes before the variant number; returns all bytes.
fn check<T: Serialize + DeserializeOwned + PartialEq + Debug>(list: &[(T, &str)], prefix: &[u8]) -> Vec<u8> {
    let mut all = Vec::new();
    let mut seen = Vec::new();
    for (value, pinned) in list {
        let mut buffer = [0; MAX_BODY];
        let encoded = postcard::to_slice(value, &mut buffer).unwrap();
        assert_eq!(hex(encoded), pinned.split_whitespace().collect::<Vec<_>>().join(" "), "{value:?}");
        let (decoded, rest) =
            postcard::take_from_bytes::<T>(&bytes(pinned)).map(|(v, r)| (v, r.len())).unwrap();
        assert_eq!((&decoded, rest), (value, 0));
        // No part of it is a whole.
        for n in 0..encoded.len() {
            assert!(postcard::take_from_bytes::<T>(&encoded[..n]).is_err(), "{value:?} cut to {n} bytes");
        }
        seen.push(encoded[prefix.len()]);
        all.extend_from_slice(encoded);
    }
    seen.dedup();
    assert!(seen.iter().copied().eq(0..seen.len() as u8), "variants out of order or missing: {seen:?}");
    let mut next = prefix.to_vec();
    next.push(seen.len() as u8);
    next.extend([0; 64]);
    assert!(postcard::take_from_bytes::<T>(&next).is_err(), "a variant is not pinned here");
    all
}

fn requests() -> Vec<(Request, &'static str)> {
    let data: heapless::Vec<u8, CHUNK_LEN> = [0, 1, 0xff].into_iter().collect();
    let stream = data.clone();
    vec![
        (Request::Hello, "00"),
        (Request::Status, "01"),
        (Request::LoadBegin { length: 481 }, "02 e1 03"),
        (Request::LoadChunk { index: 300, data }, "03 ac 02 03 00 01 ff"),
        (Request::LoadCommit { length: 481, hash: 0xdead_beef }, "04 e1 03 ef fd b6 f5 0d"),
        (Request::LoadAbort, "05"),
        (Request::Arm { hash: 0xdead_beef }, "06 ef fd b6 f5 0d"),
        (Request::Start, "07"),
        (Request::Stop, "08"),
        (Request::Abort, "09"),
        (Request::ClearFault, "0a"),
        (Request::ReadEvents { from: 256 }, "0b 80 02"),
        (Request::Clock, "0c"),
        (Request::StreamBegin, "0d"),
        (Request::StreamWrite { offset: 300, data: stream }, "0e ac 02 03 00 01 ff"),
        (Request::StreamEnd { length: 481, hash: 0xdead_beef }, "0f e1 03 ef fd b6 f5 0d"),
        (Request::StreamStatus, "10"),
        (Request::Inputs, "11"),
        (Request::SlotStore { slot: 2, autostart: Autostart::Input { input: 1 } }, "12 02 02 01"),
        (Request::SlotLoad { slot: 2 }, "13 02"),
        (Request::SlotErase { slot: 2 }, "14 02"),
        (Request::Slots, "15"),
        (Request::SelfTest, "16"),
        (Request::Health, "17"),
    ]
}

fn hello() -> Hello {
    Hello {
        magic: Hello::MAGIC,
        protocol: 1,
        schema: 0x1234_5678,
        firmware: "0.1.0".try_into().unwrap(),
        board: "reference".try_into().unwrap(),
        boot_id: 7,
        tick_hz: 125_000_000,
        capabilities: 1,
        leds: 4,
        cameras: 2,
        axes: 3,
        inputs: 0,
        max_program_bytes: 16_384,
        max_instructions: 1024,
        event_ring: 256,
        min_step_ticks: 4,
    }
}

fn status() -> Status {
    Status {
        state: State::Faulted,
        tick: 1 << 40,
        boot_id: 7,
        program: Some(128),
        position: [0, -1, 1, -64, 64, i32::MIN],
        next_event: 9,
        run: 2,
        instruction: 200,
        fault: Some(Fault { cause: FaultCause::Underrun, tick: 300, instruction: 200 }),
        rejected: Rejected { oversized: 1, cobs: 2, length: 3, crc: 4, header: 5, body: 6 },
    }
}

fn replies() -> Vec<(Reply, &'static str)> {
    let event = Event { seq: 5, tick: 1000, kind: EventKind::Mark { id: 3 } };
    let events = Events { oldest: 5, next: 6, dropped: 2, events: [event].into_iter().collect() };
    let stream = StreamState {
        received: 481,
        consumed: 128,
        limit: 16_512,
        lead: 300,
        min_lead: u64::MAX,
        instruction: 7,
        ended: true,
    };
    let mut inputs = Inputs { word: 0x0100_0001, homed: 5, ..Inputs::default() };
    (inputs.rising[0], inputs.missed[1]) = (1, 128);
    let slot = SlotInfo { slot: 2, length: 481, hash: 0xdead_beef, autostart: Autostart::PowerUp };
    let nothing = Status { state: State::Empty, program: None, fault: None, position: [0; 6], ..status() };
    vec![
        (
            Reply::Hello(hello()),
            "00 e3 d2 85 a3 06 01 f8 ac d1 91 01 05 30 2e 31 2e 30 09 72 65 66 65 72 65 6e 63 65 07 \
             c0 b2 cd 3b 01 04 02 03 00 80 80 01 80 08 80 02 04",
        ),
        (
            Reply::Status(status()),
            "01 04 80 80 80 80 80 20 07 01 80 01 00 01 02 7f 80 01 ff ff ff ff 0f 09 02 c8 01 \
             01 01 ac 02 c8 01 01 02 03 04 05 06",
        ),
        (
            Reply::Status(nothing),
            "01 00 80 80 80 80 80 20 07 00 00 00 00 00 00 00 09 02 c8 01 00 01 02 03 04 05 06",
        ),
        (Reply::Done { state: State::Running }, "02 03"),
        (Reply::Refused(Refusal::IdReused), "03 09"),
        (Reply::Events(events), "04 05 06 02 01 05 e8 07 03 03"),
        (Reply::Clock { tick: u64::MAX }, "05 ff ff ff ff ff ff ff ff ff 01"),
        (Reply::Stream(stream), "06 e1 03 80 01 80 81 01 ac 02 ff ff ff ff ff ff ff ff ff 01 07 01"),
        (Reply::Inputs(inputs), "07 81 80 80 08 01 00 00 00 00 00 00 00 00 80 01 00 00 00 00 00 00 05"),
        (Reply::Slots([slot].into_iter().collect()), "08 01 02 e1 03 ef fd b6 f5 0d 01"),
        (Reply::SelfTest(SelfTest { made: 0x1_003f, failed: 2 }), "09 bf 80 04 02"),
        (
            Reply::Health(Health {
                reset: ResetCause::Watchdog,
                stack_size: 200_000,
                stack_peak: 9000,
                received_lost: 1,
                replies_lost: 2,
                lead: 1_250_000,
                turn: 128,
            }),
            "0a 01 c0 9a 0c a8 46 01 02 d0 a5 4c 80 01",
        ),
    ]
}

fn states() -> Vec<(State, &'static str)> {
    use State::*;
    vec![(Empty, "00"), (Loaded, "01"), (Armed, "02"), (Running, "03"), (Faulted, "04")]
}

fn refusals() -> Vec<(Refusal, &'static str)> {
    let violation = Violation { instruction: 3, rule: Rule::PulseTooLong, value: 61, limit: 60 };
    vec![
        (Refusal::WrongState { state: State::Running }, "00 03"),
        (Refusal::ProgramTooLong { length: 16_385, max: 16_384 }, "01 81 80 01 80 80 01"),
        (Refusal::BadChunk { index: 1, length: 2, expected: 240 }, "02 01 02 f0 01"),
        (Refusal::ChunkChanged { index: 4 }, "03 04"),
        (Refusal::ChunkMissing { index: 5 }, "04 05"),
        (Refusal::NotStaging, "05"),
        (Refusal::LengthDiffers { begun: 1, committed: 2 }, "06 01 02"),
        (Refusal::HashDiffers { computed: 1, given: 2 }, "07 01 02"),
        (Refusal::Invalid(violation), "08 03 13 7a 78"),
        (Refusal::IdReused, "09"),
        (Refusal::NotStreaming, "0a"),
        (Refusal::StreamGap { expected: 1, given: 2 }, "0b 01 02"),
        (Refusal::StreamFull { limit: 1, end: 2 }, "0c 01 02"),
        (Refusal::StreamEnded { length: 3 }, "0d 03"),
        (Refusal::InterlockOpen, "0e"),
        (Refusal::NotHomed { axis: 2 }, "0f 02"),
        (Refusal::Cooling { led: 1, ticks: 300 }, "10 01 ac 02"),
        (Refusal::Slot { slot: 2, error: SlotError::Damaged }, "11 02 03"),
    ]
}

fn rules() -> Vec<(Violation, &'static str)> {
    let at = |rule, pinned| (Violation { instruction: 0, rule, value: -1, limit: 1 }, pinned);
    vec![
        at(Rule::Undecodable, "00 00 01 02"),
        at(Rule::TooManyInstructions, "00 01 01 02"),
        at(Rule::EmptyProgram, "00 02 01 02"),
        at(Rule::ForbiddenBits, "00 03 01 02"),
        at(Rule::ValueOutsideMask, "00 04 01 02"),
        at(Rule::StepTooShort, "00 05 01 02"),
        at(Rule::ZeroLoop, "00 06 01 02"),
        at(Rule::UnmatchedLoopEnd, "00 07 01 02"),
        at(Rule::UnclosedLoop, "00 08 01 02"),
        at(Rule::LoopTooDeep, "00 09 01 02"),
        at(Rule::EmptyLoop, "00 0a 01 02"),
        at(Rule::NoSuchAxis, "00 0b 01 02"),
        at(Rule::NoSuchLed, "00 0c 01 02"),
        at(Rule::NoSuchInput, "00 0d 01 02"),
        at(Rule::TargetOutOfRange, "00 0e 01 02"),
        at(Rule::RateOutOfRange, "00 0f 01 02"),
        at(Rule::AccelerationOutOfRange, "00 10 01 02"),
        at(Rule::Unsupported, "00 11 01 02"),
        at(Rule::LevelNotSettled, "00 12 01 02"),
        at(Rule::PulseTooLong, "00 13 01 02"),
        at(Rule::TooLong, "00 14 01 02"),
        at(Rule::LeftOn, "00 15 01 02"),
        at(Rule::CannotProve, "00 16 01 02"),
        at(Rule::DutyExceeded, "00 17 01 02"),
        at(Rule::DelayTooShort, "00 18 01 02"),
        at(Rule::SkipOfLevel, "00 19 01 02"),
        at(Rule::MoveNotEnded, "00 1a 01 02"),
        at(Rule::NothingToReach, "00 1b 01 02"),
        at(Rule::BadJoin, "00 1c 01 02"),
        at(Rule::JerkOutOfRange, "00 1d 01 02"),
        at(Rule::NoHomeSwitch, "00 1e 01 02"),
        at(Rule::BadPolicy, "00 1f 01 02"),
        at(Rule::LoopInStream, "00 20 01 02"),
    ]
}

fn causes() -> Vec<(FaultCause, &'static str)> {
    vec![
        (FaultCause::Aborted, "00"),
        (FaultCause::Underrun, "01"),
        (FaultCause::Internal, "02"),
        (FaultCause::HostLost, "03"),
        (FaultCause::Interlock, "04"),
        (FaultCause::LimitSwitch { axis: 1 }, "05 01"),
        (FaultCause::TriggerTimeout { input: 2 }, "06 02"),
        (FaultCause::HomingFailed { axis: 3 }, "07 03"),
        (FaultCause::LedLimit { led: 4 }, "08 04"),
        (FaultCause::Heartbeat, "09"),
    ]
}

fn resets() -> Vec<(ResetCause, &'static str)> {
    vec![
        (ResetCause::Power, "00"),
        (ResetCause::Watchdog, "01"),
        (ResetCause::Panic, "02"),
        (ResetCause::HardFault, "03"),
    ]
}

fn autostarts() -> Vec<(Autostart, &'static str)> {
    vec![(Autostart::Off, "00"), (Autostart::PowerUp, "01"), (Autostart::Input { input: 1 }, "02 01")]
}

fn slot_errors() -> Vec<(SlotError, &'static str)> {
    use SlotError::*;
    vec![(NoMemory, "00"), (NoSuchSlot, "01"), (Empty, "02"), (Damaged, "03"), (WriteFailed, "04")]
}

fn conditions() -> Vec<(Condition, &'static str)> {
    use Condition::*;
    vec![(Rising, "00"), (Falling, "01"), (High, "02"), (Low, "03")]
}

fn timeouts() -> Vec<(Timeout, &'static str)> {
    vec![(Timeout::Fault, "00"), (Timeout::Continue, "01"), (Timeout::Stop, "02")]
}

fn reactions() -> Vec<(Reaction, &'static str)> {
    vec![(Reaction::Safe, "00"), (Reaction::FinishMove, "01"), (Reaction::Continue, "02")]
}

fn events() -> Vec<(Event, &'static str)> {
    let at = |kind, pinned| (Event { seq: 1, tick: 2, kind }, pinned);
    vec![
        at(EventKind::RunStarted { run: 3, program: 128 }, "01 02 00 03 80 01"),
        at(EventKind::Edge { changed: 0x101, word: 0x100 }, "01 02 01 81 02 80 02"),
        at(EventKind::Level { led: 200, level: 65_535 }, "01 02 02 c8 ff ff 03"),
        at(EventKind::Mark { id: 4 }, "01 02 03 04"),
        at(EventKind::MoveStarted { axis: 2, target: -320_000 }, "01 02 04 02 ff 87 27"),
        at(EventKind::MoveDone { axis: 2, position: 320_000 }, "01 02 05 02 80 88 27"),
        at(EventKind::Settled, "01 02 06"),
        at(EventKind::RunDone { run: 3, words: 4, events: 5 }, "01 02 07 03 04 05"),
        at(EventKind::Faulted { cause: FaultCause::Aborted, instruction: 6 }, "01 02 08 00 06"),
        at(EventKind::Triggered { input: 1, missed: 2 }, "01 02 09 01 02"),
        at(EventKind::TimedOut { input: 1 }, "01 02 0a 01"),
        at(EventKind::ExposureBegan { camera: 1, after: 300 }, "01 02 0b 01 ac 02"),
        at(EventKind::ExposureEnded { camera: 1, length: 300 }, "01 02 0c 01 ac 02"),
        at(EventKind::ExposureMissing { camera: 1, after: 300 }, "01 02 0d 01 ac 02"),
        at(EventKind::Homed { axis: 2, correction: -3 }, "01 02 0e 02 05"),
        at(EventKind::StreamLead { ticks: 300 }, "01 02 0f ac 02"),
    ]
}

fn instructions() -> Vec<(Instruction, &'static str)> {
    use Instruction::{
        Capture, Delay, Edge, Gate, Go, Home, Join, Level, LoopBegin, LoopEnd, Mark, Move, NoGate, Reach,
        Settle, Stop, Wait, WaitTrigger,
    };
    vec![
        (Edge { mask: 0x103, value: 0x101, after: 125_000 }, "00 83 02 81 02 c8 d0 07"),
        (Delay { ticks: 127 }, "01 7f"),
        (LoopBegin { count: u32::MAX }, "02 ff ff ff ff 0f"),
        (LoopEnd, "03"),
        (WaitTrigger { input: 1, edge: TriggerEdge::Rising, skip: 2, timeout: 3 }, "04 01 00 02 03"),
        (WaitTrigger { input: 1, edge: TriggerEdge::Falling, skip: 2, timeout: 3 }, "04 01 01 02 03"),
        (
            Move { axis: 1, target: -192, max_rate: 64_000, acceleration: 2_000_000, jerk: 0 },
            "05 01 ff 02 80 f4 03 80 89 7a 00",
        ),
        (Settle { ticks: 128 }, "06 80 01"),
        (Level { led: 3, level: 40_000 }, "07 03 c0 b8 02"),
        (Mark { id: 258 }, "08 82 02"),
        (Stop, "09"),
        (
            Wait {
                input: 1,
                condition: Condition::Falling,
                skip: 2,
                delay: 128,
                timeout: 3,
                on_timeout: Timeout::Stop,
            },
            "0a 01 01 02 80 01 03 02",
        ),
        (Gate { input: 1, open_high: true }, "0b 01 01"),
        (NoGate, "0c"),
        (Join { axis: 1, target: -192 }, "0d 01 ff 02"),
        (
            Go { axis: 1, target: -192, max_rate: 64_000, acceleration: 2_000_000, jerk: 5 },
            "0e 01 ff 02 80 f4 03 80 89 7a 05",
        ),
        (Reach, "0f"),
        (Home { axis: 2 }, "10 02"),
        (
            Capture {
                axis: 1,
                target: -192,
                max_rate: 64_000,
                acceleration: 2_000_000,
                jerk: 0,
                settle: 128,
                cameras: 0x100,
                leds: 1,
                lead: 5,
                pulse: 127,
                hold: 6,
            },
            "11 01 ff 02 80 f4 03 80 89 7a 00 80 01 80 02 01 05 7f 06",
        ),
        (
            Instruction::Policy(Policy {
                host_timeout_ms: 1000,
                host_loss: Reaction::Safe,
                interlock: Reaction::FinishMove,
                underrun: Reaction::Safe,
            }),
            "12 e8 07 00 01 00",
        ),
    ]
}

#[test]
fn every_message_has_its_bytes() {
    let lists = [
        check(&requests(), &[]),
        check(&replies(), &[]),
        check(&states(), &[]),
        check(&refusals(), &[]),
        check(&rules(), &[0]),
        check(&causes(), &[]),
        check(&events(), &[1, 2]),
        check(&instructions(), &[]),
        check(&autostarts(), &[]),
        check(&slot_errors(), &[]),
        check(&conditions(), &[]),
        check(&timeouts(), &[]),
        check(&reactions(), &[]),
        check(&resets(), &[]),
    ];
    let hash = crc32(&lists.concat());
    assert_eq!(hash, SCHEMA_HASH, "the messages have changed: the schema hash is now {hash:#010x}");
}

/// Whole frames, as printed in `docs/protocol.md`.
#[test]
fn frames_have_their_bytes() {
    let request = |id, r| hex(&encode_request(id, &r).unwrap());
    let frames = [
        (request(1, Request::Hello), "04 01 01 01 02 01 01 01 01 05 77 22 cf a6 00"),
        (
            request(0x0102_0304, Request::Arm { hash: 0xdead_beef }),
            "04 01 01 06 0f 04 03 02 01 06 ef fd b6 f5 0d 2c e2 53 74 00",
        ),
        (
            hex(&encode_reply(0x0102_0304, &Reply::Done { state: State::Armed }).unwrap()),
            "04 01 02 02 0b 04 03 02 01 02 02 67 b5 59 cb 00",
        ),
        (request(5, Request::Start), "04 01 01 01 02 05 01 01 06 07 14 11 2b cd 00"),
    ];
    for (frame, pinned) in frames {
        assert_eq!(frame, pinned);
        assert!(DOCUMENT.contains(pinned), "not in docs/protocol.md: {pinned}");
    }
}

const DOCUMENT: &str = include_str!("../../docs/protocol.md");

/// The document names every message with the example pinned here, and the schema.
#[test]
fn the_document_is_up_to_date() {
    assert!(DOCUMENT.contains(&format!("{SCHEMA_HASH:#010x}")));
    for (request, pinned) in requests() {
        assert!(DOCUMENT.contains(&format!("`{pinned}` |")), "{request:?}");
    }
    for (instruction, pinned) in instructions() {
        let other_edge = matches!(instruction, Instruction::WaitTrigger { edge: TriggerEdge::Falling, .. });
        assert!(other_edge || DOCUMENT.contains(&format!("`{pinned}` |")), "{instruction:?}");
    }
}

/// A frame taken apart by hand, with a CRC computed bit by bit.
#[test]
fn a_frame_by_hand() {
    let mut crc = u32::MAX;
    let payload = [1u8, 1, 6, 0, 4, 3, 2, 1, 0x06, 0xef, 0xfd, 0xb6, 0xf5, 0x0d];
    for byte in payload {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        }
    }
    let crc = (!crc).to_le_bytes();
    assert!(!crc.contains(&0));
    // One zero, the fourth byte: a block of three, then one of the rest.
    let mut frame = vec![4, 1, 1, 6, 15];
    frame.extend_from_slice(&payload[4..]);
    frame.extend_from_slice(&crc);
    frame.push(0);
    assert_eq!(encode_request(0x0102_0304, &Request::Arm { hash: 0xdead_beef }).unwrap()[..], frame[..]);
}

#[test]
fn longest_messages_fit() {
    let data = std::iter::repeat_n(0xff, CHUNK_LEN).collect();
    let frame = encode_request(u32::MAX, &Request::LoadChunk { index: u16::MAX, data }).unwrap();
    assert!(frame.len() <= MAX_FRAME);
    let longest = EventKind::RunDone { run: u32::MAX, words: u32::MAX, events: u32::MAX };
    let event = Event { seq: u32::MAX, tick: u64::MAX, kind: longest };
    let events = |n| {
        let events = std::iter::repeat_n(event, n).collect();
        encode_reply(
            u32::MAX,
            &Reply::Events(Events { oldest: u32::MAX, next: u32::MAX, dropped: u32::MAX, events }),
        )
    };
    assert!(events(EVENTS_PER_REPLY).is_err(), "513 bytes of body: the box then sends one event fewer");
    let frame = events(EVENTS_PER_REPLY - 1).unwrap();
    let mut d = Decoder::new();
    assert!(matches!(frame.iter().map(|&b| d.feed_reply(b)).last(), Some(Fed::Message { .. })));
}

#[test]
fn programs_are_streams_of_instructions() {
    let list: Vec<_> = instructions().into_iter().map(|(i, _)| i).collect();
    let encoded = program::encode(&list).unwrap();
    assert_eq!(hex(&encoded), instructions().iter().map(|(_, h)| *h).collect::<Vec<_>>().join(" "));
    let mut offset = 0;
    for ((at, decoded), expected) in program::decode(&encoded).zip(&list) {
        assert_eq!((at, decoded), (offset, Ok(*expected)));
        offset += program::encode_instruction(expected).len();
    }
    assert_eq!(program::decode(&encoded).count(), list.len());
    assert_eq!(program::hash(b"123456789"), 0xcbf4_3926);

    // The first error ends it, with its place.
    let mut broken = program::encode(&[Instruction::Delay { ticks: 300 }]).unwrap();
    broken.extend_from_slice(&[200, 1, 2]).unwrap();
    let got: Vec<_> = program::decode(&broken).collect();
    assert_eq!(got, [(0, Ok(Instruction::Delay { ticks: 300 })), (3, Err(program::Undecodable))]);

    let longest = Instruction::Capture {
        axis: u8::MAX,
        target: i32::MIN,
        max_rate: u32::MAX,
        acceleration: u32::MAX,
        jerk: u32::MAX,
        settle: u32::MAX,
        cameras: u32::MAX,
        leds: u32::MAX,
        lead: u32::MAX,
        pulse: u32::MAX,
        hold: u32::MAX,
    };
    assert_eq!(program::encode_instruction(&longest).len(), MAX_INSTRUCTION_BYTES);
    let fits = MAX_PROGRAM_BYTES / MAX_INSTRUCTION_BYTES;
    assert!(program::encode(&vec![longest; fits]).is_ok());
    assert!(program::encode(&vec![longest; fits + 1]).is_err());
}
