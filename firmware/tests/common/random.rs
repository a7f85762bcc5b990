//! Random programs for `small_board`: well formed, near the limits, not always within.

use daic_protocol::program::Instruction;
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// Configuration of a property test with so many cases. The seed is fixed and printed, so that two
/// runs test the same; `DAIC_SEED` sets another, `DAIC_CASES` another number of cases.
pub fn config(cases: u32) -> ProptestConfig {
    let from_env = |name| std::env::var(name).ok().and_then(|v| v.parse::<u64>().ok());
    let seed = from_env("DAIC_SEED").unwrap_or(1);
    let cases = from_env("DAIC_CASES").map_or(cases, |n| n as u32);
    eprintln!("seed {seed}, {cases} cases");
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(seed),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

fn ticks() -> impl Strategy<Value = u32> {
    prop_oneof![4 => 4u32..30, 2 => 0u32..4, 2 => 30u32..80]
}

/// The other axis, if it comes along.
fn joined(axis: u8, target: Option<i32>) -> Vec<Instruction> {
    target.map(|target| Instruction::Join { axis: 1 - axis, target }).into_iter().collect()
}

fn leaf(moves: bool) -> impl Strategy<Value = Vec<Instruction>> {
    let lines = prop_oneof![Just(1u32), Just(2), Just(0x100), Just(0x1000), Just(0x103), Just(0)];
    let edge = (lines, any::<u32>(), ticks())
        .prop_map(|(mask, value, after)| vec![Instruction::Edge { mask, value: value & mask, after }]);
    // Without pulses that go off again hardly any random program would end safe.
    let pulse = (0u32..3, ticks(), 4u32..62).prop_map(|(line, before, length)| {
        let mask = [1, 2, 0x100][line as usize];
        vec![
            Instruction::Edge { mask, value: mask, after: before },
            Instruction::Edge { mask, value: 0, after: length },
        ]
    });
    let pace = || {
        (1000u32..=250_000, 1_000_000u32..=1_000_000_000, prop_oneof![Just(0u32), 1_000_000_000..=u32::MAX])
    };
    let join = || prop_oneof![3 => Just(None), 1 => (-40i32..=40).prop_map(Some)];
    let go = (0u8..2, -40i32..=40, pace(), join()).prop_map(|(axis, target, pace, join)| {
        let (max_rate, acceleration, jerk) = pace;
        let mut all = joined(axis, join);
        all.push(Instruction::Move { axis, target, max_rate, acceleration, jerk });
        all
    });
    let beside = (0u8..2, -40i32..=40, pace(), join(), vec((0u32..3, ticks(), 4u32..62), 1..6)).prop_map(
        |(axis, target, pace, join, pulses)| {
            let (max_rate, acceleration, jerk) = pace;
            let mut all = joined(axis, join);
            all.push(Instruction::Go { axis, target, max_rate, acceleration, jerk });
            for (line, before, length) in pulses {
                let mask = [1, 2, 0x100][line as usize];
                all.push(Instruction::Edge { mask, value: mask, after: before + 200 });
                all.push(Instruction::Edge { mask, value: 0, after: length });
            }
            all.push(Instruction::Reach);
            all
        },
    );
    let capture = (0u8..2, -40i32..=40, pace(), ticks(), 0u32..20, 4u32..62, 0u32..20).prop_map(
        |(axis, target, pace, settle, lead, pulse, hold)| {
            let (max_rate, acceleration, jerk) = pace;
            vec![Instruction::Capture {
                axis,
                target,
                max_rate,
                acceleration,
                jerk,
                settle,
                cameras: 0x100,
                leds: 1,
                lead,
                pulse,
                hold,
            }]
        },
    );
    let level = (0u8..2, prop_oneof![Just(0u16), Just(20_000), Just(40_000)])
        .prop_map(|(led, level)| vec![Instruction::Level { led, level }]);
    prop_oneof![
        3 => edge,
        6 => pulse,
        2 => ticks().prop_map(|ticks| vec![Instruction::Delay { ticks }]),
        1 => ticks().prop_map(|ticks| vec![Instruction::Settle { ticks }]),
        2 => level,
        1 => any::<u16>().prop_map(|id| vec![Instruction::Mark { id }]),
        if moves { 3 } else { 0 } => go,
        if moves { 2 } else { 0 } => beside,
        if moves { 1 } else { 0 } => capture,
    ]
}

/// A program, with or without moves; one in eight holds a `Stop` somewhere.
pub fn program(moves: bool) -> impl Strategy<Value = Vec<Instruction>> {
    let tree = leaf(moves).prop_recursive(3, 10, 4, |inner| {
        (1u32..4, vec(inner, 1..4)).prop_map(|(count, body)| {
            let mut all = vec![Instruction::LoopBegin { count }];
            all.extend(body.concat());
            all.push(Instruction::LoopEnd);
            all
        })
    });
    (vec(tree, 1..5), any::<prop::sample::Index>(), 0u8..8).prop_map(|(parts, at, stop)| {
        let mut all = parts.concat();
        if stop == 0 {
            all.insert(at.index(all.len() + 1), Instruction::Stop);
        }
        all
    })
}
