//! Ways in which limits, states or times once went wrong, each by an example.

mod common;

use common::*;
use daic_firmware::{Board, Controller, Homing, Sink};
use daic_protocol::message::*;
use daic_protocol::program::{self, Condition, Instruction, Policy, Reaction, Timeout};

/// Lines other than those of axes that are high after `tick`.
fn lit_after(rig: &Rig, tick: u64) -> bool {
    rig.out.words.iter().any(|&(t, word)| t > tick && word & 0xffff != 0)
}

#[test]
fn a_stop_beside_a_move_goes_dark_at_once_and_finishes_the_move() {
    let program = [
        Instruction::Go { axis: 0, target: 6400, max_rate: 8000, acceleration: 400_000, jerk: 0 },
        edge(0x1101, 0x1101, 1000),
        delay(2000),
        edge(0x1101, 0, 9),
        Instruction::Reach,
    ];
    let mut board = Board::reference();
    board.leds[0].max_pulse = u32::MAX;
    let mut rig = Rig::new(board);
    let start = rig.start(&program);
    rig.play_to(start + 1500);
    rig.done(Request::Stop);
    rig.finish();
    assert!(!lit_after(&rig, start + 3000), "{:?}", &rig.out.words[..6]);
    assert_eq!((rig.controller.state(), rig.controller.position()[0]), (State::Loaded, 6400));
    // The same by a time-out, which needs no host.
    let wait = Instruction::Wait {
        input: 0,
        condition: Condition::Rising,
        skip: 0,
        delay: 6250,
        timeout: 1000,
        on_timeout: Timeout::Stop,
    };
    let program = [program[0], program[1], wait, program[3], program[4]];
    let mut rig =
        Rig::new(Board { leds: rig.controller.board().leds.clone(), ..Board::reference().simulated() });
    let start = rig.start(&program);
    rig.finish();
    assert!(!lit_after(&rig, start + 1000 + 1000 + 6250), "{:?}", &rig.out.words[..6]);
    assert_eq!((rig.controller.state(), rig.controller.position()[0]), (State::Loaded, 6400));
}

#[test]
fn a_limit_switch_counts_for_steps_that_come_with_words_of_the_program() {
    let go = Instruction::Go { axis: 0, target: 3, max_rate: 1000, acceleration: 1_000_000, jerk: 0 };
    let mut whole = Rig::new(small_board());
    let start = whole.start(&[go, Instruction::Reach]);
    whole.finish();
    let ticks: Vec<u64> = whole.out.words.iter().map(|w| w.0 - start).collect();
    assert_eq!(whole.controller.position()[0], 3);
    // A word of the program at the tick of every word of the move.
    let mut program = vec![go];
    let mut now = 0;
    for (k, tick) in ticks.iter().take(7).enumerate() {
        program.push(edge(0x1000, if k % 2 == 0 { 0x1000 } else { 0 }, (tick - now) as u32));
        now = *tick;
    }
    program.extend([edge(0x1000, 0, 100), Instruction::Reach]);
    let mut rig = Rig::new(small_board());
    rig.input(1, 0x2000);
    rig.start(&program);
    rig.finish();
    assert_eq!(rig.controller.fault().map(|f| f.cause), Some(FaultCause::LimitSwitch { axis: 0 }));
    assert_eq!((rig.controller.position()[0], rig.controller.word()), (0, 0));
}

#[test]
fn homing_behind_a_move_keeps_the_smallest_step() {
    let mut board = small_board();
    board.axes[0].home = Some(Homing { high_end: false, rate: 8000, travel: 200, position: 0 });
    let go = Instruction::Go { axis: 0, target: 4, max_rate: 64_000, acceleration: 2_000_000, jerk: 0 };
    // A word shortly before the last step's end, which has to wait for it.
    for before in 1..4u32 {
        let word = edge(0x1000, 0, 4 + 625 + 353_553 + 250 - before);
        let program =
            [Instruction::Home { axis: 0 }, go, word, Instruction::Reach, Instruction::Home { axis: 0 }];
        let mut rig = Rig::new(board.clone());
        rig.start(&program);
        let mut seen = 0;
        let mut real = 0i32;
        while rig.controller.state() == State::Running {
            let due = rig.controller.next_due().unwrap();
            rig.play_to(due);
            for at in seen.max(1)..rig.out.words.len() {
                let (was, is) = (rig.out.words[at - 1].1, rig.out.words[at].1);
                if is & !was & 0x1_0000 != 0 {
                    real += if is & 0x2_0000 != 0 { 1 } else { -1 };
                }
            }
            seen = rig.out.words.len();
            rig.input(due, if real <= -1 { 0x1000 } else { 0 });
        }
        assert_eq!(rig.controller.fault(), None);
        let close = rig.out.words.windows(2).find(|w| w[1].0 < w[0].0 + 4);
        assert_eq!(close, None, "{before}");
    }
}

#[test]
fn a_policy_does_not_reach_into_the_past() {
    let policy = Policy { host_timeout_ms: 1, host_loss: Reaction::Safe, ..Policy::DEFAULT };
    let program = [
        edge(0x1000, 0x1000, 9),
        delay(1_000_000_000),
        Instruction::Policy(policy),
        delay(1000),
        edge(0x1000, 0, 9),
    ];
    let whole = |step: u64| {
        let mut rig = Rig::new(small_board());
        let start = rig.start(&program);
        let mut tick = start;
        while rig.controller.state() == State::Running {
            tick += step;
            rig.play_to(tick);
        }
        (rig.controller.fault().map(|f| (f.cause, f.tick - start)), rig.out.words)
    };
    let (fault, words) = whole(1 << 33);
    assert_eq!(fault, Some((FaultCause::HostLost, 1_000_000_009)));
    assert_eq!(whole(250_007), (fault, words), "it does not matter how often it is asked to play");
}

/// Slots that hold what they are given.
#[derive(Default)]
struct Slots {
    out: Recorder,
    held: [Vec<u8>; 4],
}

impl Sink for Slots {
    fn word(&mut self, tick: u64, word: u32) {
        self.out.word(tick, word);
    }
    fn level(&mut self, tick: u64, led: u8, level: u16) {
        self.out.level(tick, led, level);
    }
    fn store(&mut self, slot: u8, program: &[u8], _: Autostart) -> Result<(), SlotError> {
        let place = self.held.get_mut(usize::from(slot)).ok_or(SlotError::NoSuchSlot)?;
        *place = program.to_vec();
        Ok(())
    }
    fn fetch(&mut self, slot: u8, program: &mut program::ProgramBytes) -> Result<(), SlotError> {
        let held = self.held.get(usize::from(slot)).filter(|h| !h.is_empty()).ok_or(SlotError::Empty)?;
        program.clear();
        program.extend_from_slice(held).map_err(|_| SlotError::Damaged)
    }
}

#[test]
fn an_autostart_that_is_refused_does_not_spoil_the_next() {
    let mut board = small_board();
    board.leds[0].window = 10_000_000;
    board.leds[0]
        .overdrive
        .push(daic_firmware::Overdrive { above: 0, max_pulse: 60, cycle: 100_000 })
        .unwrap();
    let mut controller = Controller::new(board, 1);
    let mut sink = Slots::default();
    let lit = [level(0, 1000), delay(20), edge(1, 1, 9), edge(1, 0, 50)];
    sink.held[1] = program::encode(&lit).unwrap().to_vec();
    assert_eq!(controller.autostart(1000, 1, &mut sink), Ok(()));
    controller.play(1_000_000, &mut sink);
    assert_eq!(controller.state(), State::Loaded);
    let cooling = controller.autostart(2_000_000, 1, &mut sink);
    assert!(matches!(cooling, Err(Refusal::Cooling { led: 0, .. })), "{cooling:?}");
    assert_eq!(controller.state(), State::Loaded);
    assert_eq!(controller.autostart(20_000_000, 1, &mut sink), Ok(()));
    assert_eq!(controller.state(), State::Running);
}

#[test]
fn what_is_refused_has_had_no_effect() {
    let mut rig =
        Rig::new(Board { capabilities: Capabilities::STREAMING | Capabilities::FLASH, ..small_board() });
    assert!(matches!(rig.ask(Request::StreamBegin), Reply::Stream(_)));
    let too_long = rig.refused(Request::LoadBegin { length: 20_000 });
    assert!(matches!(too_long, Refusal::ProgramTooLong { .. }));
    assert_eq!(rig.status().state, State::Armed, "the stream still waits to be started");
    assert_eq!(rig.done(Request::Stop), State::Empty);
    // A load that has begun outlasts a slot that is asked for meanwhile.
    let bytes = program::encode(&[delay(100)]).unwrap();
    rig.done(Request::LoadBegin { length: bytes.len() as u32 });
    rig.done(Request::LoadChunk { index: 0, data: bytes.iter().copied().collect() });
    rig.refused(Request::SlotLoad { slot: 3 });
    let committed = rig.ask(Request::LoadCommit { length: bytes.len() as u32, hash: program::hash(&bytes) });
    assert_eq!(committed, Reply::Done { state: State::Loaded });
    let start = Autostart::Input { input: 200 };
    let Refusal::Invalid(found) = rig.refused(Request::SlotStore { slot: 0, autostart: start }) else {
        panic!()
    };
    assert_eq!((found.rule, found.value, found.limit), (Rule::NoSuchInput, 200, 2));
}

#[test]
fn behind_a_wait_without_end_no_loop_is_called_empty() {
    let program = [
        Instruction::Wait {
            input: 0,
            condition: Condition::Rising,
            skip: 0,
            delay: 20,
            timeout: 0,
            on_timeout: Timeout::Fault,
        },
        begin(2),
        delay(5),
        END,
        level(1, 100),
        delay(20),
        edge(2, 2, 9),
        edge(2, 0, 50),
        level(1, 60_000),
        delay(20),
        edge(2, 2, 200),
        edge(2, 0, 30),
    ];
    let mut rig = Rig::new(small_board());
    match rig.load_bytes(&program::encode(&program).unwrap()) {
        Reply::Refused(Refusal::Invalid(v)) => assert_eq!(v.rule, Rule::CannotProve, "{v:?}"),
        other => assert_eq!(other, Reply::Done { state: State::Loaded }),
    }
}

#[test]
fn a_stream_that_has_ended_can_still_be_asked_about() {
    let mut rig = Rig::new(small_board());
    rig.ask(Request::StreamBegin);
    let bytes: Vec<u8> =
        [edge(0x1000, 0x1000, 9), edge(0x1000, 0, 9)].iter().flat_map(program::encode_instruction).collect();
    let data = bytes.iter().copied().collect();
    assert!(matches!(rig.ask(Request::StreamWrite { offset: 0, data }), Reply::Stream(_)));
    rig.done(Request::Start);
    rig.finish();
    assert_eq!(rig.controller.fault().map(|f| f.cause), Some(FaultCause::Underrun));
    let Reply::Stream(state) = rig.ask(Request::StreamStatus) else { panic!() };
    assert_eq!((state.instruction, state.ended), (2, false));
}
