//! Program and plan, played by the real controller and compared.

use daic_firmware::{Board, Controller, Sink, verifier};
use daic_protocol::channels;
use daic_protocol::frame::{Decoder, Fed, crc32, encode_request};
use daic_protocol::limits::CHUNK_LEN;
use daic_protocol::message::{Event, EventKind, Hello, Reply, Request};
use daic_protocol::program::Instruction;
use daic_rig::acquire::triggers_of;
use daic_rig::compile::{CompileError, Compiled, compile};
use daic_rig::experiment::{Experiment, Role, template};
use std::path::Path;

fn parse(text: &str) -> Experiment {
    Experiment::parse(text, Path::new("experiment.toml")).unwrap_or_else(|e| panic!("{e}"))
}

/// The template's rig and optics with another sequence.
fn with_sequence(sequence: &str) -> Experiment {
    let head = template().split("# --- what is played").next().expect("head");
    parse(&format!("{head}{sequence}"))
}

struct Nothing;
impl Sink for Nothing {
    fn word(&mut self, _: u64, _: u32) {}
    fn level(&mut self, _: u64, _: u8, _: u16) {}
}

/// The real controller without a link in between.
struct Bench {
    controller: Controller,
    id: u32,
    now: u64,
}

impl Bench {
    fn new() -> Self {
        Self { controller: Controller::new(Board::reference(), 1), id: 0, now: 1000 }
    }

    fn ask(&mut self, request: &Request) -> Reply {
        self.id += 1;
        let bytes = encode_request(self.id, request).expect("request");
        let mut decoder = Decoder::new();
        let mut answer = None;
        self.controller.receive(self.now, &bytes, &mut Nothing, &mut |reply| {
            for &byte in reply {
                if let Fed::Message { message, .. } = decoder.feed_reply(byte) {
                    answer = Some(message);
                }
            }
        });
        answer.expect("reply")
    }

    fn done(&mut self, request: &Request) {
        let reply = self.ask(request);
        assert!(matches!(reply, Reply::Done { .. }), "{reply:?}");
    }

    fn hello(&mut self) -> Hello {
        match self.ask(&Request::Hello) {
            Reply::Hello(hello) => hello,
            other => panic!("{other:?}"),
        }
    }

    /// Plays a program to its end, reading events often enough to lose none.
    fn play(&mut self, program: &[u8]) -> Vec<Event> {
        let (length, hash) = (program.len() as u32, crc32(program));
        self.done(&Request::LoadBegin { length });
        for (index, chunk) in (0..).zip(program.chunks(CHUNK_LEN)) {
            self.done(&Request::LoadChunk { index, data: chunk.iter().copied().collect() });
        }
        self.done(&Request::LoadCommit { length, hash });
        self.done(&Request::Arm { hash });
        self.done(&Request::Start);
        let mut events: Vec<Event> = Vec::new();
        loop {
            let due = self.controller.next_due();
            if let Some(due) = due {
                self.now = self.now.max(due);
                self.controller.play(self.now, &mut Nothing);
            }
            loop {
                let from = events.last().map_or(0, |e| e.seq + 1);
                let Reply::Events(reply) = self.ask(&Request::ReadEvents { from }) else {
                    panic!("no events")
                };
                assert!(reply.oldest <= from, "events lost");
                if reply.events.is_empty() {
                    break;
                }
                events.extend(reply.events);
            }
            if due.is_none() {
                return events;
            }
        }
    }
}

/// What the plan says must be what the controller plays: triggers, strobes, offsets, positions.
fn compare(compiled: &Compiled, events: &[Event]) {
    let begin = events
        .iter()
        .find_map(|e| matches!(e.kind, EventKind::RunStarted { .. }).then_some(e.tick))
        .expect("run started");
    let triggers = triggers_of(events, compiled.plan.camera_mask);
    assert_eq!(triggers.len(), compiled.plan.frames.len());
    for (trigger, frame) in triggers.iter().zip(&compiled.plan.frames) {
        if let Some(offset) = frame.trigger_offset {
            assert_eq!(trigger.tick - begin, offset, "{}", frame.name);
        }
        let pulse = trigger.strobe.unwrap_or_else(|| panic!("{}: no strobe", frame.name));
        assert_eq!(pulse.led, frame.strobe.led);
        assert_eq!(pulse.on - trigger.tick, frame.strobe.delay_ticks);
        assert_eq!(pulse.off - pulse.on, frame.strobe.width_ticks);
        let before = |kind: fn(&EventKind) -> Option<(u8, i64)>, index: u8| {
            events
                .iter()
                .take_while(|e| e.tick <= trigger.tick)
                .filter_map(|e| kind(&e.kind))
                .filter(|k| k.0 == index)
                .last()
                .map_or(0, |k| k.1)
        };
        for axis in 0..3u8 {
            let position = before(
                |k| {
                    if let EventKind::MoveDone { axis, position } = k {
                        Some((*axis, i64::from(*position)))
                    } else {
                        None
                    }
                },
                axis,
            );
            assert_eq!(
                position,
                i64::from(frame.position_steps[usize::from(axis)]),
                "{} axis {axis}",
                frame.name
            );
        }
        let level = before(
            |k| if let EventKind::Level { led, level } = k { Some((*led, i64::from(*level))) } else { None },
            frame.strobe.led,
        );
        assert_eq!(level, i64::from(frame.strobe.level), "{}", frame.name);
    }
}

fn compile_and_play(experiment: &Experiment) -> Compiled {
    let mut bench = Bench::new();
    let hello = bench.hello();
    let compiled = compile(experiment, &hello, [0; 6]).unwrap_or_else(|e| panic!("{e}"));
    verifier::verify(&compiled.program, &Board::reference())
        .unwrap_or_else(|v| panic!("{v:?}\n{:?}", compiled.instructions));
    compare(&compiled, &bench.play(&compiled.program));
    compiled
}

#[test]
fn the_template_plays_as_planned() {
    let compiled = compile_and_play(&parse(template()));
    let frames = &compiled.plan.frames;
    assert_eq!(frames.len(), 7);
    let per_mm = 6400.0;
    for frame in frames {
        for axis in 0..3 {
            assert_eq!(frame.position_mm[axis], f64::from(frame.position_steps[axis]) / per_mm);
            // Half a step at most.
            assert!((frame.position_mm[axis] - frame.asked_mm[axis]).abs() <= 0.5 / per_mm);
        }
    }
    assert_eq!(frames[6].asked_mm, [0.05, -0.03, 0.2]);
    assert_eq!(frames[6].position_steps, [320, -192, 1280]);
    assert_eq!(frames[5].role, Role::Reference);
    // 2 ms for the level to settle, then the least step.
    assert_eq!(frames[0].trigger_offset, Some(250_000 + 4));
    assert!(frames[1..].iter().all(|f| f.trigger_offset.is_none()));
    assert_eq!(frames[0].strobe.delay_ticks, 125_000);
    assert_eq!(frames[0].strobe.width_ticks, 25_000);
}

#[test]
fn repeats_levels_and_other_leds_play_as_planned() {
    let compiled = compile_and_play(&with_sequence(
        r#"
        [[sequence]]
        level = { led = 1, level = 0.5 }
        [[sequence]]
        repeat = { times = 3, steps = [
            { settle = "1 ms" },
            { repeat = { times = 4, steps = [
                { frame = { name = "a", role = "series" } },
                { frame = { name = "b", role = "series", strobe = { led = 1, delay = "2 ms", width = "50 us", level = 0.25 } } },
            ] } },
            { repeat = { times = 1000, steps = [{ settle = "1 us" }] } },
        ] }
        [[sequence]]
        frame = { name = "last", role = "deformed", strobe = { led = 1, delay = "0 ms", width = "10 us" } }
        [[sequence]]
        repeat = { times = 2, steps = [
            { move = { x = "1 mm" } },
            { frame = { name = "there", role = "series" } },
            { move = { x = "0.12345 mm", z = "-1 mm" } },
            { frame = { name = "back", role = "series" } },
        ] }
        "#,
    ));
    let frames = &compiled.plan.frames;
    assert_eq!(frames.len(), 3 * 4 * 2 + 1 + 4);
    assert_eq!((frames[0].name.as_str(), frames[23].name.as_str()), ("a_0000", "b_0011"));
    assert_eq!(frames[24].name, "last");
    // Everything up to the first move is known beforehand, also behind the loops.
    assert!(frames[..25].iter().all(|f| f.trigger_offset.is_some()));
    assert!(frames[25..].iter().all(|f| f.trigger_offset.is_none()));
    assert_eq!(frames[1].strobe.level, 16_384);
    // Half a step of 1/6400 mm either way.
    assert_eq!(frames[26].position_steps, [790, 0, -6400]);
    assert_eq!(frames[26].asked_mm[0], 0.12345);
}

#[test]
fn an_axis_that_stands_elsewhere_is_planned_from_there() {
    let experiment = with_sequence("[[sequence]]\nframe = { name = \"here\", role = \"reference\" }\n");
    let hello = Bench::new().hello();
    let plan = compile(&experiment, &hello, [640, 0, -64, 7, 7, 7]).expect("compile").plan;
    assert_eq!(plan.frames[0].position_steps, [640, 0, -64]);
    assert_eq!(plan.frames[0].position_mm, [0.1, 0.0, -0.01]);
    assert_eq!(plan.camera_mask, channels::camera(0).expect("camera"));
}

#[test]
fn what_the_box_cannot_do_is_refused_before_anything_is_sent() {
    let hello = Bench::new().hello();
    let frame = "[[sequence]]\nframe = { name = \"f\", role = \"series\" }\n";
    let error =
        |experiment: &Experiment, hello: &Hello| compile(experiment, hello, [0; 6]).expect_err("refused");

    let one = with_sequence(frame);
    assert_eq!(error(&one, &Hello { leds: 0, ..hello.clone() }), CompileError::NoSuchLed { led: 0, leds: 0 });
    assert_eq!(
        error(&one, &Hello { cameras: 0, ..hello.clone() }),
        CompileError::NoSuchCamera { line: 0, cameras: 0 }
    );
    let moved = with_sequence(&format!("[[sequence]]\nmove = {{ z = \"1 mm\" }}\n{frame}"));
    assert_eq!(
        error(&moved, &Hello { axes: 2, ..hello.clone() }),
        CompileError::NoSuchAxis { axis: 2, axes: 2 }
    );
    let count = compile(&one, &hello, [0; 6]).expect("fits").instructions.len();
    let tight = Hello { max_instructions: count as u16 - 1, ..hello.clone() };
    assert_eq!(error(&one, &tight), CompileError::TooManyInstructions { count, max: count - 1 });
    let tight = Hello { max_program_bytes: 3, ..hello.clone() };
    assert!(matches!(error(&one, &tight), CompileError::ProgramTooLong { max: 3, .. }));
    // 16 ns is 2 ticks, the player needs 4.
    let short = parse(&template().replace("width = \"200 us\"", "width = \"16 ns\""));
    assert!(matches!(error(&short, &hello), CompileError::EdgesTooClose { ticks: 2, min: 4, .. }));
    let short = parse(&template().replace("width = \"200 us\"", "width = \"1 ns\""));
    assert!(matches!(error(&short, &hello), CompileError::EdgesTooClose { ticks: 0, min: 4, .. }));
    let many = Experiment {
        sequence: vec![daic_rig::experiment::Step::Repeat(daic_rig::experiment::RepeatStep {
            times: u32::MAX,
            steps: one.sequence.clone(),
        })],
        ..one
    };
    assert!(matches!(error(&many, &hello), CompileError::TooManyFrames { .. }));
}

#[test]
fn waits_beyond_one_instruction_are_split() {
    let experiment = with_sequence(
        "[[sequence]]\nsettle = \"2 min\"\n[[sequence]]\nframe = { name = \"f\", role = \"series\" }\n",
    );
    let compiled = compile_and_play(&experiment);
    let settled: u64 = compiled
        .instructions
        .iter()
        .map(|i| if let Instruction::Settle { ticks } = i { u64::from(*ticks) } else { 0 })
        .sum();
    assert_eq!(settled, 120 * 125_000_000 + 250_000);
    assert_eq!(compiled.plan.frames[0].trigger_offset, Some(settled + 4));
}

/// Where a carriage stands that a drive with this much play pulls along.
fn carriage(instructions: &[Instruction], play: i32, begin: i32) -> Vec<i32> {
    let (mut carriage, mut seen) = (begin, Vec::new());
    let mut loops: Vec<(usize, u32)> = Vec::new();
    let mut at = 0;
    while let Some(instruction) = instructions.get(at) {
        match *instruction {
            Instruction::Move { axis: 0, target, .. } => {
                carriage = carriage.clamp(target - play, target);
            }
            Instruction::Edge { mask, value, .. } if mask & value & channels::CAMERA_MASK != 0 => {
                seen.push(carriage);
            }
            Instruction::LoopBegin { count } => loops.push((at, count)),
            Instruction::LoopEnd => {
                let (begin, left) = loops.last_mut().expect("open");
                *left -= 1;
                if *left > 0 {
                    at = *begin;
                } else {
                    loops.pop();
                }
            }
            _ => {}
        }
        at += 1;
    }
    seen
}

#[test]
fn play_of_the_drive_is_always_taken_up_in_the_same_direction() {
    let sequence = "
[[sequence]]
move = { x = \"0.01 mm\" }
[[sequence]]
frame = { name = \"a\", role = \"series\" }
[[sequence]]
move = { x = \"-0.5 mm\" }
[[sequence]]
frame = { name = \"b\", role = \"series\" }
[[sequence]]
repeat = { times = 3, steps = [
    { move = { x = \"0.1 mm\" } },
    { frame = { name = \"c\", role = \"series\" } },
    { move = { x = \"0.2 mm\" } },
    { frame = { name = \"d\", role = \"series\" } },
] }
[[sequence]]
move = { x = \"0.3 mm\" }
[[sequence]]
frame = { name = \"e\", role = \"series\" }
";
    for (approach, taken) in [("positive", 1), ("negative", 0)] {
        let head = template().split("# --- what is played").next().expect("head").to_owned();
        let text = head.replacen(
            "acceleration = \"50 mm/s^2\"",
            &format!(
                "acceleration = \"50 mm/s^2\"\nbacklash = \"20 um\"\napproach = \"{approach}\"\njerk = \"500 mm/s^3\""
            ),
            1,
        );
        let compiled = compile_and_play(&parse(&format!("{text}{sequence}")));
        let wanted: Vec<i32> = compiled.plan.frames.iter().map(|f| f.position_steps[0]).collect();
        assert_eq!(wanted, [64, -3200, 640, 1280, 640, 1280, 640, 1280, 1920]);
        // 20 µm are 128 steps; the carriage may have been left anywhere within its play
        for begin in [-128, -64, 0] {
            let seen = carriage(&compiled.instructions, 128, begin);
            let behind: Vec<i32> = wanted.iter().zip(&seen).map(|(w, s)| (w - s) / 128).collect();
            assert_eq!((behind, seen.len()), (vec![taken; 9], 9), "{approach} from {begin}: {seen:?}");
        }
        let jerks =
            compiled.instructions.iter().filter(|i| matches!(i, Instruction::Move { jerk: 3_200_000, .. }));
        assert!(jerks.count() > 6);
    }
    let head = template().split("# --- what is played").next().expect("head").to_owned();
    let tight =
        head.replacen("max = \"5 mm\"", "max = \"5 mm\"\nbacklash = \"20 um\"\napproach = \"negative\"", 1);
    let sequence = "[[sequence]]\nmove = { x = \"4.99 mm\" }\n[[sequence]]\nframe = { name = \"f\", role = \"series\" }\n";
    let experiment = parse(&format!("{tight}{sequence}"));
    let hello = Bench::new().hello();
    let found = compile(&experiment, &hello, [0; 6]);
    assert_eq!(found.err(), Some(CompileError::NoRoomToApproach { axis: 0, mm: 4.99, by_way_mm: 5.03 }));
}
