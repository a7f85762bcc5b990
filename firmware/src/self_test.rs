//! What the box can test by itself, without touching an output.

use crate::board::{AxisLimits, Board, LedLimits};
use crate::motion::{Profile, Steps};
use crate::verifier::verify;
use daic_protocol::channels::SAFE_WORD;
use daic_protocol::frame::{Decoder, Fed, crc32, encode_request};
use daic_protocol::message::{Request, SelfTest, SelfTests};
use daic_protocol::program::{Instruction, MAX_INSTRUCTION_BYTES, encode_instruction};

/// Whether a known move has its known step times.
fn motion() -> bool {
    let steps = Steps::new(Profile::new(4, 64_000, 2_000_000, 0));
    steps.eq([125_000u64, 176_776, 228_553, 353_553])
}

fn verifier() -> bool {
    let axis = AxisLimits { min: 0, max: 1, max_rate: 1, max_acceleration: 1, max_jerk: 0, home: None };
    let board = Board {
        name: "",
        capabilities: 0,
        axes: heapless::Vec::from_array([axis]),
        leds: heapless::Vec::from_array([LedLimits::new(10, 0)]),
        cameras: 0,
        inputs: 0,
        input_latency: 0,
        start_lead: 0,
    };
    // A program of full capacity is too large for the stack.
    let pulse = |length: u32| -> heapless::Vec<u8, { 2 * MAX_INSTRUCTION_BYTES }> {
        let on = encode_instruction(&Instruction::Edge { mask: 1, value: 1, after: 4 });
        let off = encode_instruction(&Instruction::Edge { mask: 1, value: 0, after: length });
        on.into_iter().chain(off).collect()
    };
    verify(&pulse(10), &board).is_ok() && verify(&pulse(11), &board).is_err()
}

fn framing() -> bool {
    let request = Request::ReadEvents { from: 0xdead_beef };
    let Ok(frame) = encode_request(7, &request) else { return false };
    let mut decoder = Decoder::new();
    let last = frame.iter().map(|&byte| decoder.feed_request(byte)).last();
    matches!(last, Some(Fed::Message { id: 7, message, .. }) if message == request)
}

/// Makes every test; `program` is the committed program and its hash.
#[inline(never)]
pub(crate) fn run(program: &[u8], hash: Option<u32>, word: u32) -> SelfTest {
    let tests = [
        (SelfTests::CRC, crc32(b"123456789") == 0xcbf4_3926),
        (SelfTests::PROGRAM, hash.is_none_or(|hash| crc32(program) == hash)),
        (SelfTests::MOTION, motion()),
        (SelfTests::VERIFIER, verifier()),
        (SelfTests::FRAMING, framing()),
        (SelfTests::OUTPUTS, word == SAFE_WORD),
    ];
    tests.iter().fold(SelfTest::default(), |found, (bit, passed)| SelfTest {
        made: found.made | bit,
        failed: found.failed | if *passed { 0 } else { *bit },
    })
}
