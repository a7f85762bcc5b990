//! Trigger inputs, gates, interlock, limit switches, homing, exposures, policies.

mod common;

use common::*;
use daic_firmware::{Board, Homing};
use daic_protocol::channels::INTERLOCK;
use daic_protocol::message::*;
use daic_protocol::program::{Condition, Instruction, Policy, Reaction, Timeout, TriggerEdge};
use proptest::prelude::*;

fn wait(condition: Condition, skip: u32, delay: u32, timeout: u32, on_timeout: Timeout) -> Instruction {
    Instruction::Wait { input: 0, condition, skip, delay, timeout, on_timeout }
}

const BLINK: [Instruction; 2] = [
    Instruction::Edge { mask: 0x100, value: 0x100, after: 0 },
    Instruction::Edge { mask: 0x100, value: 0, after: 9 },
];

/// Runs a program with input words at ticks after its begin; returns begin and rig.
fn run(board: Board, program: &[Instruction], inputs: &[(u64, u32)]) -> (u64, Rig) {
    let mut rig = Rig::new(board);
    let start = rig.start(program);
    for &(tick, word) in inputs {
        rig.input(start + tick, word);
    }
    rig.finish();
    (start, rig)
}

#[test]
fn an_edge_is_answered_after_exactly_the_delay() {
    let program = [&[wait(Condition::Rising, 0, 20, 0, Timeout::Fault)], &BLINK[..]].concat();
    let (start, mut rig) = run(small_board(), &program, &[(1000, 1), (1100, 0)]);
    assert_eq!(rig.out.words, [(start + 1020, 0x100), (start + 1029, 0)]);
    let kinds: Vec<_> = rig.events().iter().map(|e| (e.tick, e.kind)).collect();
    assert_eq!(kinds[1], (start + 1000, EventKind::Triggered { input: 0, missed: 0 }));
    assert_eq!(rig.controller.state(), State::Loaded);
}

#[test]
fn edges_are_skipped_and_missed_ones_are_counted() {
    let mut program = vec![wait(Condition::Rising, 2, 20, 0, Timeout::Fault)];
    program.extend([delay(1000)]);
    program.extend(BLINK);
    let pulses: Vec<_> = (0..8).flat_map(|i| [(100 * i + 50, 1), (100 * i + 90, 0)]).collect();
    let (start, mut rig) = run(small_board(), &program, &pulses);
    // The third edge counts; five came while nothing waited.
    assert_eq!(rig.out.words[0], (start + 250 + 20 + 1000, 0x100));
    let Reply::Inputs(inputs) = rig.ask(Request::Inputs) else { panic!() };
    assert_eq!((inputs.rising[0], inputs.missed[0], inputs.word), (8, 5, 0));
}

#[test]
fn levels_count_at_once() {
    for (condition, before, after) in [(Condition::High, 0, 1), (Condition::Low, 1, 0)] {
        let program = [&[delay(500), wait(condition, 0, 20, 0, Timeout::Fault)], &BLINK[..]].concat();
        let (start, rig) = run(small_board(), &program, &[(10, before), (20, after)]);
        assert_eq!(rig.out.words[0].0, start + 520, "{condition:?} was there already");
        let (start, rig) = run(small_board(), &program, &[(10, before), (600, after)]);
        assert_eq!(rig.out.words[0].0, start + 620, "{condition:?} came later");
    }
}

#[test]
fn a_gate_lets_triggers_through() {
    let gate = Instruction::Gate { input: 1, open_high: true };
    let one = [&[wait(Condition::Rising, 0, 20, 0, Timeout::Fault)], &BLINK[..]].concat();
    let program = [&[gate], &one[..], &[Instruction::NoGate], &one[..]].concat();
    let pulses = [(100, 1), (150, 0), (200, 2), (250, 3), (300, 0), (400, 1)];
    let (start, mut rig) = run(small_board(), &program, &pulses);
    assert_eq!(rig.out.words[0].0, start + 270, "the first edge met a closed gate");
    assert_eq!(rig.out.words[2].0, start + 420);
    let Reply::Inputs(inputs) = rig.ask(Request::Inputs) else { panic!() };
    // The gate itself rose while nothing waited for it.
    assert_eq!(inputs.missed[..2], [1, 1]);
}

#[test]
fn time_runs_out() {
    let ends = |on_timeout| {
        let program = [&[wait(Condition::Rising, 0, 20, 300, on_timeout)], &BLINK[..]].concat();
        run(small_board(), &program, &[(5, 0)])
    };
    let (start, rig) = ends(Timeout::Continue);
    assert_eq!(rig.out.words[0].0, start + 320);
    let (_, rig) = ends(Timeout::Stop);
    assert_eq!((rig.out.words.len(), rig.controller.state()), (0, State::Loaded));
    let (start, mut rig) = ends(Timeout::Fault);
    let fault = Fault { cause: FaultCause::TriggerTimeout { input: 0 }, tick: start + 300, instruction: 0 };
    assert_eq!(rig.controller.fault(), Some(fault));
    assert!(rig.events().iter().any(|e| e.kind == EventKind::TimedOut { input: 0 }));
    // The last tick still counts.
    let program = [&[wait(Condition::Rising, 0, 20, 300, Timeout::Fault)], &BLINK[..]].concat();
    let (start, rig) = run(small_board(), &program, &[(300, 1)]);
    assert_eq!(rig.out.words[0].0, start + 320);
}

#[test]
fn stop_ends_a_wait() {
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[wait(Condition::Rising, 0, 20, 0, Timeout::Fault)]);
    rig.play_to(start + 1_000_000);
    assert_eq!(rig.controller.next_due(), None, "nothing happens by itself");
    rig.done(Request::Stop);
    rig.play_to(rig.now);
    assert_eq!(rig.controller.state(), State::Loaded);
}

fn interlocked() -> Board {
    let mut board = small_board();
    board.capabilities |= Capabilities::INTERLOCK;
    board
}

#[test]
fn an_open_interlock_stops_and_latches() {
    let mut rig = Rig::new(interlocked());
    let bytes = daic_protocol::program::encode(&[edge(1, 1, 100), edge(1, 0, 50)]).unwrap();
    rig.load_bytes(&bytes);
    let hash = daic_protocol::program::hash(&bytes);
    rig.done(Request::Arm { hash });
    assert_eq!(rig.refused(Request::Start), Refusal::InterlockOpen);
    rig.input(rig.now, INTERLOCK);
    let start = rig.start_again(&bytes);
    rig.input(start + 120, 0);
    assert_eq!(rig.out.words, [(start + 100, 1), (start + 120, 0)]);
    let fault = Fault { cause: FaultCause::Interlock, tick: start + 120, instruction: 1 };
    assert_eq!(rig.controller.fault(), Some(fault));
    assert_eq!(rig.refused(Request::ClearFault), Refusal::InterlockOpen);
    rig.input(rig.now, INTERLOCK);
    assert_eq!(rig.controller.state(), State::Faulted, "it stays until it is cleared");
    assert_eq!(rig.done(Request::ClearFault), State::Loaded);
    // Opening while armed is no less a fault.
    rig.done(Request::Arm { hash });
    rig.input(rig.now + 5, 0);
    assert_eq!(rig.controller.fault().unwrap().cause, FaultCause::Interlock);
}

#[test]
fn a_policy_may_finish_the_move() {
    let policy = Policy { interlock: Reaction::FinishMove, ..Policy::DEFAULT };
    let mut rig = Rig::new(interlocked());
    rig.input(rig.now, INTERLOCK);
    let start =
        rig.start(&[Instruction::Policy(policy), edge(0x100, 0x100, 0), go(0, 40), edge(0x100, 0, 9)]);
    rig.play_to(start + 800_000);
    let before = rig.controller.position()[0];
    assert!((1..39).contains(&before), "{before}");
    rig.input(start + 800_001, 0);
    assert_eq!(rig.controller.word() & 0x100, 0, "what is not a move is off at once");
    assert_eq!(rig.controller.state(), State::Running);
    rig.finish();
    assert_eq!(rig.controller.position()[0], 40);
    assert_eq!(rig.controller.fault().unwrap().cause, FaultCause::Interlock);
    assert_eq!(rig.controller.word(), 0);
}

#[test]
fn a_lost_host_is_noticed_to_the_tick() {
    let policy = Policy { host_timeout_ms: 10, host_loss: Reaction::Safe, ..Policy::DEFAULT };
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[
        Instruction::Policy(policy),
        edge(0x100, 0x100, 0),
        delay(10_000_000),
        edge(0x100, 0, 9),
    ]);
    let heard = rig.now;
    rig.play_to(start + 500_000);
    // Any request is a sign of life.
    let _ = rig.status();
    let heard_again = rig.now;
    assert!(heard_again > heard);
    rig.play_to(start + 10_000_000);
    let fault = rig.controller.fault().unwrap();
    assert_eq!((fault.cause, fault.tick), (FaultCause::HostLost, heard_again + 1_250_000));
    assert_eq!(fault.instruction, 2);
    assert_eq!(rig.out.words.last(), Some(&(heard_again + 1_250_000, 0)));
    // Without a policy nobody is needed.
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[edge(0x100, 0x100, 0), delay(10_000_000), edge(0x100, 0, 9)]);
    rig.play_to(start + 20_000_000);
    assert_eq!(rig.controller.state(), State::Loaded);
}

fn homing_board() -> Board {
    let mut board = small_board();
    board.axes[0].home = Some(Homing { high_end: false, rate: 8000, travel: 200, position: -40 });
    board
}

/// Plays with a switch that is pressed at and below `at` steps from where the axis stood at first.
fn home_with_switch(rig: &mut Rig, at: i32) -> i32 {
    let mut real = 0;
    let mut seen = rig.out.words.len();
    let mut before = 0;
    while let Some(due) = rig.controller.next_due() {
        rig.play_to(due);
        for &(_, word) in &rig.out.words[seen..] {
            if word & !before & 0x1_0000 != 0 {
                real += if word & 0x2_0000 != 0 { 1 } else { -1 };
            }
            before = word;
        }
        seen = rig.out.words.len();
        rig.input(due, if real <= at { 0x1000 } else { 0 });
    }
    real
}

#[test]
fn homing_finds_the_switch() {
    let mut rig = Rig::new(homing_board());
    let bytes = daic_protocol::program::encode(&[go(0, 5)]).unwrap();
    rig.load_bytes(&bytes);
    rig.done(Request::Arm { hash: daic_protocol::program::hash(&bytes) });
    assert_eq!(rig.refused(Request::Start), Refusal::NotHomed { axis: 0 });
    rig.done(Request::Stop);
    rig.start(&[Instruction::Home { axis: 0 }]);
    let real = home_with_switch(&mut rig, -73);
    assert_eq!(real, -72, "one step off the switch");
    assert_eq!(rig.controller.position()[0], -40);
    assert!(rig.events().iter().any(|e| e.kind == EventKind::Homed { axis: 0, correction: 32 }));
    assert_eq!(rig.controller.state(), State::Loaded);
    // Now it may move.
    rig.input(rig.now, 0);
    rig.start(&[go(0, 5)]);
    rig.finish();
    assert_eq!(rig.controller.position()[0], 5);
}

#[test]
fn a_switch_that_is_not_there_is_a_fault() {
    let mut rig = Rig::new(homing_board());
    rig.start(&[Instruction::Home { axis: 0 }]);
    let real = home_with_switch(&mut rig, -1000);
    assert_eq!(real, -200);
    assert_eq!(rig.controller.fault().unwrap().cause, FaultCause::HomingFailed { axis: 0 });
    // One that never lets go.
    let mut rig = Rig::new(homing_board());
    rig.start(&[Instruction::Home { axis: 0 }]);
    let real = home_with_switch(&mut rig, 1000);
    assert_eq!(real, 200);
    assert_eq!(rig.controller.fault().unwrap().cause, FaultCause::HomingFailed { axis: 0 });
}

#[test]
fn a_limit_switch_ends_a_move_into_it() {
    let mut rig = Rig::new(small_board());
    let start = rig.start(&[go(0, 40)]);
    rig.play_to(start + 100_000);
    // The other end is no obstacle.
    rig.input(start + 100_000, 0x1000);
    assert_eq!(rig.controller.state(), State::Running);
    rig.input(start + 100_010, 0x3000);
    let fault = rig.controller.fault().unwrap();
    assert_eq!(fault.cause, FaultCause::LimitSwitch { axis: 0 });
    assert!((start + 100_010..=start + 100_014).contains(&fault.tick));
    assert_eq!(rig.controller.word(), 0);
    // Away from it is allowed, into it is not.
    rig.done(Request::ClearFault);
    rig.start(&[go(0, -40)]);
    rig.input(rig.now + 1, 0x2000);
    rig.finish();
    assert_eq!(rig.controller.position()[0], -40);
    rig.start(&[go(0, 40)]);
    rig.finish();
    assert_eq!(rig.controller.fault().unwrap().cause, FaultCause::LimitSwitch { axis: 0 });
    assert_eq!(rig.controller.position()[0], -40);
}

#[test]
fn exposures_are_stamped_and_compared_with_their_triggers() {
    let mut board = small_board();
    board.capabilities |= Capabilities::EXPOSURE_ACTIVE;
    let frame = [edge(0x100, 0x100, 1000), edge(0x100, 0, 100)];
    let mut rig = Rig::new(board);
    let start = rig.start(&[&[begin(3)], &frame[..], &[END, delay(1_000_000)]].concat());
    for (tick, word) in [(1007, 0x100), (1507, 0), (3208, 0x100), (3608, 0), (5000, 0x100)] {
        rig.input(start + tick, word);
    }
    rig.finish();
    let kinds: Vec<_> = rig.events().iter().map(|e| (e.tick - start, e.kind)).collect();
    let of =
        |wanted: fn(&EventKind) -> bool| kinds.iter().filter(|k| wanted(&k.1)).copied().collect::<Vec<_>>();
    assert_eq!(
        of(|k| matches!(k, EventKind::ExposureBegan { .. })),
        [
            (1007, EventKind::ExposureBegan { camera: 0, after: 7 }),
            (3208, EventKind::ExposureBegan { camera: 0, after: 8 }),
            (5000, EventKind::ExposureBegan { camera: 0, after: u32::MAX }),
        ]
    );
    assert_eq!(
        of(|k| matches!(k, EventKind::ExposureEnded { .. })),
        [
            (1507, EventKind::ExposureEnded { camera: 0, length: 500 }),
            (3608, EventKind::ExposureEnded { camera: 0, length: 400 }),
        ]
    );
    assert_eq!(
        of(|k| matches!(k, EventKind::ExposureMissing { .. })),
        [(3208, EventKind::ExposureMissing { camera: 0, after: 3208 - 2100 })]
    );
}

#[test]
fn an_led_that_owes_rest_must_cool_before_the_next_run() {
    let mut rig = Rig::new(small_board());
    let program = [level(1, 40_000), delay(20), edge(2, 2, 4), edge(2, 0, 40)];
    rig.start(&program);
    rig.finish();
    // 40 ticks at a fifth: 160 ticks owed, all paid in the lead of the next start.
    rig.start(&program);
    rig.finish();
    assert_eq!(rig.controller.state(), State::Loaded);
    // A window that the lead of a start does not pay back.
    let mut board = small_board();
    board.leds[1].window = 10_000_000;
    board.leds[1].overdrive[0].max_pulse = 1_000_000;
    board.leds[1].max_pulse = 1_000_000;
    let mut rig = Rig::new(board);
    let program = [level(1, 40_000), delay(20), edge(2, 2, 4), edge(2, 0, 1_000_000)];
    rig.start(&program);
    rig.finish();
    let bytes = daic_protocol::program::encode(&program).unwrap();
    rig.done(Request::Arm { hash: daic_protocol::program::hash(&bytes) });
    let Refusal::Cooling { led: 1, ticks } = rig.refused(Request::Start) else { panic!() };
    assert_eq!(ticks, 4_000_000 - daic_firmware::START_LEAD);
    rig.play_to(rig.now + ticks);
    assert_eq!(rig.done(Request::Start), State::Running);
}

#[test]
fn self_test_passes_and_touches_nothing() {
    let mut rig = Rig::new(small_board());
    let Reply::SelfTest(found) = rig.ask(Request::SelfTest) else { panic!() };
    assert_eq!((found.made, found.failed), (0x3f, 0));
    assert!(rig.out.words.is_empty());
    rig.start(&[delay(1000)]);
    assert_eq!(rig.refused(Request::SelfTest), Refusal::WrongState { state: State::Running });
}

#[test]
fn without_permanent_memory_slots_are_refused() {
    let mut rig = Rig::new(small_board());
    rig.load_bytes(&daic_protocol::program::encode(&BLINK).unwrap());
    let slot = Refusal::Slot { slot: 1, error: SlotError::NoMemory };
    assert_eq!(rig.refused(Request::SlotStore { slot: 1, autostart: Autostart::Off }), slot);
    assert_eq!(rig.refused(Request::SlotLoad { slot: 1 }), slot);
    assert_eq!(rig.refused(Request::SlotErase { slot: 1 }), slot);
    assert_eq!(rig.ask(Request::Slots), Reply::Slots(Default::default()));
}

#[test]
fn bad_waits_are_refused() {
    let refused = |i: Instruction, rule| {
        let bytes = daic_protocol::program::encode(&[i]).unwrap();
        let found = daic_firmware::verifier::verify(&bytes, &small_board()).unwrap_err();
        assert_eq!(found.rule, rule, "{i:?}");
    };
    refused(wait(Condition::Rising, 0, 19, 0, Timeout::Fault), Rule::DelayTooShort);
    refused(wait(Condition::High, 1, 20, 0, Timeout::Fault), Rule::SkipOfLevel);
    let skip = Instruction::WaitTrigger { input: 2, edge: TriggerEdge::Rising, skip: 0, timeout: 0 };
    refused(skip, Rule::NoSuchInput);
    refused(Instruction::Gate { input: 9, open_high: false }, Rule::NoSuchInput);
    refused(Instruction::Home { axis: 0 }, Rule::NoHomeSwitch);
    refused(Instruction::Policy(Policy { underrun: Reaction::Continue, ..Policy::DEFAULT }), Rule::BadPolicy);
    refused(Instruction::Join { axis: 0, target: 0 }, Rule::BadJoin);
    refused(Instruction::Reach, Rule::NothingToReach);
    refused(
        Instruction::Go { axis: 0, target: 1, max_rate: 1, acceleration: 1, jerk: 0 },
        Rule::MoveNotEnded,
    );
}

/// An LED must not shine across a wait that has no end.
#[test]
fn light_across_a_wait() {
    let program =
        |timeout| [edge(1, 1, 4), wait(Condition::Rising, 0, 20, timeout, Timeout::Fault), edge(1, 0, 4)];
    let verdict = |timeout| {
        let bytes = daic_protocol::program::encode(&program(timeout)).unwrap();
        daic_firmware::verifier::verify(&bytes, &small_board())
    };
    let v = verdict(0).unwrap_err();
    assert_eq!((v.instruction, v.rule, v.value), (2, Rule::PulseTooLong, i64::MAX));
    let v = verdict(37).unwrap_err();
    assert_eq!((v.instruction, v.rule, v.value, v.limit), (2, Rule::PulseTooLong, 61, 60));
    assert_eq!(verdict(36), Ok(()));
}

proptest! {
    #![proptest_config(random::config(200))]

    /// Waits for edges against the second player, however playing is cut up.
    #[test]
    fn waits_are_played_as_written(
        waits in proptest::collection::vec((0u8..2, any::<bool>(), 0u32..3, prop_oneof![Just(0u32), 50u32..400]), 1..5),
        gaps in proptest::collection::vec((1u64..80, 0u32..4), 0..60),
        cut in 1u64..50,
    ) {
        let mut program = Vec::new();
        for (input, rising, skip, timeout) in waits {
            let edge = if rising { TriggerEdge::Rising } else { TriggerEdge::Falling };
            program.push(Instruction::WaitTrigger { input, edge, skip, timeout });
            program.extend(BLINK);
            program.push(Instruction::Delay { ticks: 7 });
        }
        let mut rig = Rig::new(small_board());
        let start = rig.start(&program);
        let mut tick = start;
        let inputs: Vec<(u64, u32)> = gaps.iter().map(|&(gap, word)| { tick += gap; (tick, word) }).collect();
        for &(tick, word) in &inputs {
            while rig.now + cut < tick && rig.now >= start {
                rig.play_to(rig.now + cut);
            }
            rig.input(tick, word);
        }
        rig.play_to(rig.now + 100_000);
        let bytes = daic_protocol::program::encode(&program).unwrap();
        let hash = daic_protocol::program::hash(&bytes);
        let expected = naive::play_with(&program, &small_board(), start, [0; 6], 1, hash, &inputs);
        // A wait that never ends is still under way.
        let last = rig.now;
        let words: Vec<_> = expected.words.iter().copied().filter(|w| w.0 <= last).collect();
        prop_assert_eq!(&rig.out.words, &words);
        prop_assert_eq!(rig.controller.fault().map(|f| f.tick), expected.faulted.filter(|t| *t <= last));
    }
}
