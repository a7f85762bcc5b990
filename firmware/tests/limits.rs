//! What comes out of the controller itself keeps every limit: accepted programs with waits, gates, policies, homing
//! and moves, under inputs, limit switches, stops and silences at random.

mod common;

use common::*;
use daic_firmware::{Board, Homing};
use daic_protocol::channels::INTERLOCK;
use daic_protocol::message::*;
use daic_protocol::program::{Condition, Instruction, Policy, Reaction, Timeout, encode};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use std::cell::RefCell;
use std::collections::BTreeMap;

const F: u64 = 125_000_000;
/// Ticks by which a step makes way for other words.
const WAY: u64 = 6;

fn board() -> Board {
    let mut board = small_board();
    board.capabilities |= Capabilities::INTERLOCK;
    board.axes[0].home = Some(Homing { high_end: false, rate: 60_000, travel: 200, position: -40 });
    board
}

fn extra() -> impl Strategy<Value = Vec<Instruction>> {
    let condition = prop_oneof![
        Just(Condition::Rising),
        Just(Condition::Falling),
        Just(Condition::High),
        Just(Condition::Low)
    ];
    let on_timeout =
        prop_oneof![1 => Just(Timeout::Fault), 2 => Just(Timeout::Continue), 1 => Just(Timeout::Stop)];
    let timeout = prop_oneof![1 => Just(0u32), 4 => 20u32..4000];
    let wait = (0u8..2, condition, 0u32..2, 20u32..60, timeout, on_timeout).prop_map(
        |(input, condition, skip, delay, timeout, on_timeout)| {
            let level = matches!(condition, Condition::High | Condition::Low);
            let skip = if level { 0 } else { skip };
            vec![Instruction::Wait { input, condition, skip, delay, timeout, on_timeout }]
        },
    );
    let gate = (0u8..2, any::<bool>())
        .prop_map(|(input, open_high)| vec![Instruction::Gate { input, open_high }, Instruction::NoGate]);
    let reaction = || prop_oneof![Just(Reaction::Safe), Just(Reaction::FinishMove)];
    let policy = (0u32..3, reaction(), reaction()).prop_map(|(host_timeout_ms, host_loss, interlock)| {
        vec![Instruction::Policy(Policy { host_timeout_ms, host_loss, interlock, underrun: Reaction::Safe })]
    });
    let home = Just(vec![Instruction::Home { axis: 0 }]);
    prop_oneof![5 => wait, 1 => gate, 1 => policy, 2 => home]
}

/// Homes first, so that moves are allowed; then parts with and without inputs.
fn program() -> impl Strategy<Value = Vec<Instruction>> {
    let part = prop_oneof![3 => random::program(true), 2 => extra()];
    vec(part, 1..5).prop_map(|parts| [vec![Instruction::Home { axis: 0 }], parts.concat()].concat())
}

/// What happens from outside, so many ticks after the last thing.
#[derive(Debug, Clone, Copy)]
enum Outside {
    Inputs(u32),
    Switches(u32),
    Interlock,
    Stop,
    Abort,
}

fn outside() -> impl Strategy<Value = Vec<(u64, Outside)>> {
    let what = prop_oneof![
        20 => (0u32..4).prop_map(Outside::Inputs),
        2 => (0u32..4).prop_map(|ends| Outside::Switches(ends << 12)),
        1 => Just(Outside::Interlock),
        1 => Just(Outside::Stop),
        1 => Just(Outside::Abort),
    ];
    vec((prop_oneof![1u64..300, 300u64..40_000], what), 0..30)
}

/// Follows one LED.
#[derive(Default)]
struct Lamp {
    lit: Option<u64>,
    level: u16,
    set: Option<u64>,
    owed: (u64, u64),
}

/// Every limit on what came out; the first that is broken.
fn broken(board: &Board, out: &Recorder, safe: bool) -> Option<String> {
    let mut last: Option<u64> = None;
    let mut before = 0u32;
    for &(tick, word) in &out.words {
        if last.is_some_and(|last| tick < last + 4) {
            return Some(format!("words {last:?} and {tick}"));
        }
        last = Some(tick);
        if word & 0xf000_0000 != 0 || word & !0x000f_1103 & 0xffff != 0 {
            return Some(format!("word {word:#x}"));
        }
        before = word;
    }
    if safe && before != 0 {
        return Some(format!("left at {before:#x}"));
    }
    // Steps: never faster than the axis, never beyond its soft limits once it has been homed.
    for (axis, limits) in (0u32..).zip(&board.axes) {
        let (line, mut before, mut last) = (1u32 << (16 + 2 * axis), 0, None::<u64>);
        for &(tick, word) in &out.words {
            if word & line != 0 && before & line == 0 {
                let least = F / u64::from(limits.max_rate) - 2 - WAY;
                if last.is_some_and(|last| tick - last < least) {
                    return Some(format!("axis {axis}: steps at {last:?} and {tick}"));
                }
                last = Some(tick);
            }
            before = word;
        }
    }
    // Light: longest pulse, rest owed, levels that have settled.
    for (i, limits) in board.leds.iter().enumerate() {
        let mut lamp = Lamp::default();
        let mut changes: Vec<(u64, Option<u16>, bool)> =
            out.words.iter().map(|&(tick, word)| (tick, None, word >> i & 1 == 1)).collect();
        let levels = out.levels.iter().filter(|(_, led, _)| usize::from(*led) == i);
        changes.extend(levels.map(|&(tick, _, level)| (tick, Some(level), false)));
        // A level at the tick of a word comes behind it.
        changes.sort_by_key(|&(tick, level, _)| (tick, level.is_some()));
        for (tick, level, on) in changes {
            if let Some(level) = level {
                if lamp.lit.is_some() {
                    return Some(format!("LED {i}: level set at {tick} while it shines"));
                }
                // Darkness is no level to wait for.
                (lamp.level, lamp.set) = (level, (level > 0).then_some(tick));
                continue;
            }
            let rows = limits.overdrive.iter().filter(|row| lamp.level > row.above);
            let (mut most, mut cycle) = (u64::from(limits.max_pulse), 1);
            for row in rows {
                (most, cycle) = (most.min(u64::from(row.max_pulse)), cycle.max(u64::from(row.cycle)));
            }
            match (lamp.lit, on) {
                (None, true) => {
                    if lamp.set.is_some_and(|set| tick - set < u64::from(limits.settle)) {
                        return Some(format!("LED {i}: lit at {tick}, level set at {:?}", lamp.set));
                    }
                    let (owed, at) = lamp.owed;
                    lamp.owed = (owed.saturating_sub(tick - at), tick);
                    lamp.lit = Some(tick);
                }
                (Some(since), false) => {
                    // The word that ends it in a fault may have to wait for the one before.
                    if tick - since > most + 4 {
                        return Some(format!("LED {i}: lit from {since} to {tick}, at most {most}"));
                    }
                    let owed = lamp.owed.0 + (tick - since) * (cycle - 1);
                    if owed > u64::from(limits.window) + 4 * (cycle - 1) {
                        return Some(format!("LED {i}: owes {owed} at {tick}"));
                    }
                    (lamp.owed, lamp.lit) = ((owed, tick), None);
                }
                _ => {}
            }
        }
    }
    None
}

#[test]
fn what_comes_out_keeps_every_limit() {
    let board = board();
    let ends = RefCell::new(BTreeMap::<String, u32>::new());
    let mut runner = TestRunner::new(random::config(20_000));
    runner
        .run(&(program(), outside(), -300i64..0), |(p, world, switch)| {
            let Ok(bytes) = encode(&p) else { return Ok(()) };
            let mut rig = Rig::new(board.clone());
            rig.input(1, INTERLOCK);
            if rig.load_bytes(&bytes) != (Reply::Done { state: State::Loaded }) {
                *ends.borrow_mut().entry("refused".into()).or_default() += 1;
                return Ok(());
            }
            rig.start_again(&bytes);
            let (mut levels, mut ends_pressed) = (0, 0);
            let mut real = 0i64;
            let mut seen = 0;
            let mut world = world.into_iter().peekable();
            let mut next = world.next().map(|(gap, what)| (rig.now + gap, what));
            // The low switch of axis 0 is pressed where the stage really stands.
            for _ in 0..4000 {
                if rig.controller.state() != State::Running {
                    break;
                }
                let due = rig.controller.next_due();
                let outside = next.filter(|(tick, _)| due.is_none_or(|due| *tick < due));
                let Some(tick) = outside.map(|o| o.0).or(due) else {
                    prop_assert_eq!(rig.done(Request::Stop), State::Running);
                    continue;
                };
                rig.play_to(tick);
                for at in seen.max(1)..rig.out.words.len() {
                    let (was, is) = (rig.out.words[at - 1].1, rig.out.words[at].1);
                    if is & !was & 0x1_0000 != 0 {
                        real += if is & 0x2_0000 != 0 { 1 } else { -1 };
                    }
                }
                seen = rig.out.words.len();
                let mut open = false;
                if outside.is_some() {
                    next = world.next().map(|(gap, what)| (tick + gap, what));
                }
                match outside.map(|o| o.1) {
                    Some(Outside::Inputs(word)) => levels = word,
                    Some(Outside::Switches(word)) => ends_pressed = word,
                    Some(Outside::Interlock) => open = true,
                    Some(Outside::Stop) => drop(rig.ask(Request::Stop)),
                    Some(Outside::Abort) => drop(rig.ask(Request::Abort)),
                    None => {}
                }
                let home = if real <= switch { 0x1000 } else { 0 };
                let closed = if open { 0 } else { INTERLOCK };
                rig.input(tick, closed | levels | (ends_pressed & !0x1000) | home);
            }
            let state = rig.controller.state();
            prop_assert_ne!(state, State::Running, "still playing: {:?}", p);
            let (faults, position) = (rig.controller.fault(), rig.controller.position());
            let kind = faults.map_or("done".into(), |f| {
                let text = format!("{:?}", f.cause);
                text.split(' ').next().unwrap_or_default().to_owned()
            });
            prop_assert!(kind != "Internal" && kind != "LedLimit", "{kind}: {:?}", p);
            *ends.borrow_mut().entry(kind).or_default() += 1;
            prop_assert_eq!(broken(&board, &rig.out, true), None, "{:?}", p);
            prop_assert_eq!(rig.controller.levels(), [0; 8]);
            if faults.is_none() {
                prop_assert!(position[..2].iter().all(|p| (-40..=40).contains(p)), "{position:?}");
            }
            Ok(())
        })
        .unwrap();
    let ends = ends.into_inner();
    eprintln!("{ends:?}");
    // Every way in which a run ends must have been there, or nothing was tested.
    for kind in ["done", "Aborted", "Interlock", "LimitSwitch", "TriggerTimeout", "HostLost", "HomingFailed"]
    {
        assert!(ends.get(kind).is_some_and(|n| *n >= 10), "{kind}: {ends:?}");
    }
}

/// The check can fail.
#[test]
fn the_check_notices() {
    let board = board();
    let check = |words: &[(u64, u32)], levels: &[(u64, u8, u16)]| {
        broken(&board, &Recorder { words: words.to_vec(), levels: levels.to_vec() }, true).unwrap_or_default()
    };
    assert_eq!(check(&[(100, 1), (160, 0)], &[]), "");
    assert!(check(&[(100, 1), (103, 0)], &[]).contains("words"));
    assert!(check(&[(100, 1), (165, 0)], &[]).contains("at most 60"));
    assert!(check(&[(100, 1)], &[]).contains("left"));
    assert!(check(&[(100, 1), (160, 0)], &[(90, 0, 9)]).contains("level set"));
    assert!(check(&[(100, 2), (150, 0)], &[(10, 1, 40_000)]).contains("at most 40"));
    let pulses: Vec<_> = (0..9).flat_map(|k| [(100 + 50 * k, 2), (130 + 50 * k, 0)]).collect();
    assert!(check(&pulses, &[(10, 1, 40_000)]).contains("owes"));
    assert!(check(&[(100, 0x1_0000), (110, 0), (400, 0x1_0000), (410, 0)], &[]).contains("steps"));
}
