//! The cases.

mod inputs;
mod slots;
mod streaming;

use super::{Case, Host, Outcome, expected};
use daic_firmware::pico::INTERLOCK;
use daic_protocol::channels::{SAFE_WORD, camera, led};
use daic_protocol::message::*;
use daic_protocol::program::Instruction;

/// Ticks of a microsecond.
const US: u32 = 125;

const NOT_WATCHED: &str = "nobody watches the outputs";
const NO_BENCH: &str = "no instruments around the board";

/// Every case, in order.
pub const ALL: &[Case] = &[
    Case { name: "identity", run: identity },
    Case { name: "strobe and camera", run: strobe },
    Case { name: "shortest steps", run: shortest },
    Case { name: "sustained rate", run: sustained },
    Case { name: "moves and strobes", run: moves },
    Case { name: "jerk-limited moves, two axes, strobes beside them", run: jerk },
    Case { name: "moves at full speed", run: full_speed },
    Case { name: "10 000 edges", run: many_edges },
    Case { name: "10 000 edges streamed, all events read", run: streaming::edges },
    Case { name: "a stream that ends too soon", run: streaming::dry },
    Case { name: "trigger to edge", run: inputs::trigger },
    Case { name: "time-outs of triggers", run: inputs::timeouts },
    Case { name: "exposure-active", run: inputs::exposure },
    Case { name: "a limit switch", run: inputs::limit },
    Case { name: "a silent host", run: inputs::silence },
    Case { name: "slots and autostart", run: slots::autostart },
    Case { name: "power cut while a slot is written", run: slots::cut },
    Case { name: "one tick wrong is found", run: one_tick },
    Case { name: "the player misses a clock", run: slipped },
    Case { name: "stop ends with an instruction", run: stop },
    Case { name: "abort is safe and latched", run: abort },
    Case { name: "refused programs change nothing", run: refused },
    Case { name: "a repeated start starts once", run: repeated },
    Case { name: "interlock", run: interlock },
    Case { name: "core halted", run: halted },
    Case { name: "core halted in a long pulse", run: halted_in_pulse },
    Case { name: "a short stall is no fault", run: stalled },
    Case { name: "reset in mid-run", run: reset },
    Case { name: "both links", run: links },
    Case { name: "levels", run: levels },
    Case { name: "starts are alike", run: starts },
    Case { name: "health", run: health },
    Case { name: "the longest verification", run: verification },
];

fn set(mask: u32, after: u32) -> Instruction {
    Instruction::Edge { mask, value: mask, after }
}
fn clear(mask: u32, after: u32) -> Instruction {
    Instruction::Edge { mask, value: 0, after }
}
fn go(axis: u8, target: i32) -> Instruction {
    Instruction::Move { axis, target, max_rate: 16_000, acceleration: 1_000_000, jerk: 0 }
}
fn lamp(index: u8) -> u32 {
    led(index).unwrap_or(0)
}
fn shutter() -> u32 {
    camera(0).unwrap_or(0)
}
fn repeat(count: u32, body: &[Instruction]) -> Vec<Instruction> {
    let mut program = vec![Instruction::LoopBegin { count }];
    program.extend_from_slice(body);
    program.push(Instruction::LoopEnd);
    program
}

/// Camera trigger, strobe of odd lengths, for each of `count` frames.
fn strobes(count: u32) -> Vec<Instruction> {
    let mut program =
        vec![Instruction::Level { led: 0, level: 40_000 }, Instruction::Settle { ticks: 2500 * US }];
    program.extend(repeat(
        count,
        &[
            set(shutter(), 1009),
            set(lamp(0), 37 * US + 3),
            clear(lamp(0), 10 * US + 1),
            set(lamp(1) | lamp(2), 4),
            clear(lamp(1), 5),
            clear(lamp(2), 7),
            clear(shutter(), 100 * US),
        ],
    ));
    program
}

fn check(holds: bool, message: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(message()) }
}

/// Events tell the same edges as the recorder, tick by tick.
fn same_by_events(program: &[Instruction], events: &[Event], start: u64) -> Result<(), String> {
    let axes = daic_protocol::channels::AXIS_MASK;
    let mut before = 0;
    let mut wanted = expected(program);
    wanted.retain(|&(_, word)| (std::mem::replace(&mut before, word) ^ word) & !axes != 0);
    let told: Vec<(u64, u32)> = events
        .iter()
        .filter_map(|e| match e.kind {
            EventKind::Edge { word, .. } => Some((e.tick - start, word)),
            _ => None,
        })
        .collect();
    check(told == wanted, || format!("events tell {told:?}, expected {wanted:?}"))
}

fn done(ran: &super::host::Ran) -> Result<(), String> {
    let last = ran.events.last().map(|e| e.kind);
    check(matches!(last, Some(EventKind::RunDone { .. })), || {
        format!("the run ended in {last:?}, {:?}", ran.fault)
    })
}

/// The edges of `ran` are the first of the program's, and then the outputs are safe: returns the
/// index of the first edge that is not the program's and its tick on the program's timeline.
fn prefix(
    program: &[Instruction],
    edges: &[(u64, u32)],
    origin: i64,
) -> Result<(usize, Option<i64>), String> {
    let wanted = expected(program);
    let got: Vec<(i64, u32)> = edges.iter().map(|&(t, w)| (t as i64 - origin, w)).collect();
    let same = got.iter().zip(&wanted).take_while(|(g, w)| g.0 == w.0 as i64 && g.1 == w.1).count();
    match &got[same..] {
        [] => {
            check(got.last().is_none_or(|e| e.1 == SAFE_WORD), || format!("left at {:?}", got.last()))?;
            Ok((same, None))
        }
        [(tick, SAFE_WORD)] => Ok((same, Some(*tick))),
        rest => Err(format!("after {same} edges of the program: {:?}", &rest[..rest.len().min(4)])),
    }
}

/// Ticks of the recorder between the program's beginning and the first edge of the recording that is
/// sure to be there.
fn origin(host: &mut Host, program: &[Instruction]) -> Result<i64, String> {
    let wanted = expected(program)[0].0 as i64;
    let first = host.recorded().first().copied().ok_or("no edge at all")?;
    Ok(first.0 as i64 - wanted)
}

fn identity(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let hello = host.hello()?;
    check(hello.magic == Hello::MAGIC, || format!("{hello:?}"))?;
    check(hello.schema == SCHEMA_HASH && hello.tick_hz == 125_000_000, || format!("{hello:?}"))?;
    let status = host.status()?;
    check(status.boot_id == hello.boot_id, || format!("{status:?}"))?;
    check(status.rejected == Rejected::default(), || format!("{status:?}"))?;
    Ok(Outcome::Passed(vec![]))
}

fn exact(host: &mut Host, program: &[Instruction]) -> Result<Outcome, String> {
    let ran = host.play(program)?;
    done(&ran)?;
    if !host.watched() {
        same_by_events(program, &ran.events, ran.start)?;
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    host.compare(program, &ran)?;
    Ok(Outcome::Passed(vec![("edges", ran.edges.len() as f64, ""), ("edge error", 0.0, "ticks")]))
}

fn strobe(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = strobes(12);
    let ran = host.play(&program)?;
    done(&ran)?;
    same_by_events(&program, &ran.events, ran.start)?;
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    host.compare(&program, &ran)?;
    Ok(Outcome::Passed(vec![("edges", ran.edges.len() as f64, ""), ("edge error", 0.0, "ticks")]))
}

fn shortest(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let aux = 1 << 12;
    let mut program = vec![];
    for _ in 0..3 {
        program.extend(repeat(
            10,
            &[set(aux, 4), clear(aux, 4), set(aux | lamp(1), 5), clear(aux | lamp(1), 6)],
        ));
        // The processor expands the next ones meanwhile.
        program.push(Instruction::Delay { ticks: 1500 * US });
    }
    exact(host, &program)
}

/// The highest rate of edges that goes on for longer than anything is buffered.
fn sustained(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot("nothing is expanded ahead of time"));
    }
    let aux = 1 << 12;
    for step in [10, 12, 16, 20, 24, 32, 40, 50, 100].map(|us: u32| us * US) {
        host.restart();
        let program = repeat(1500, &[set(aux, step), clear(aux, step)]);
        let ran = host.play(&program)?;
        match ran.fault.map(|fault| fault.cause) {
            None => {
                host.compare(&program, &ran)?;
                return Ok(Outcome::Passed(vec![("edges per second", f64::from(125_000_000 / step), "")]));
            }
            Some(FaultCause::Underrun) => {
                // Too fast: what came out is the beginning of the program, and the outputs are safe
                // from the planned end of its last record on.
                let edges = host.recorded().to_vec();
                let (_, early) = prefix(&program, &edges, origin(host, &program)?)?;
                check(early.is_none(), || format!("safe at {early:?}, between two edges"))?;
            }
            Some(other) => return Err(format!("{other:?} at steps of {step} ticks")),
        }
    }
    Err("no rate can be sustained".into())
}

fn moves(host: &mut Host, long: bool) -> Result<Outcome, String> {
    let steps = if long { 400 } else { 40 };
    let mut body = vec![];
    for (axis, target) in [(0, steps), (1, -steps), (0, -3), (1, 2)] {
        body.push(go(axis, target));
        body.push(Instruction::Settle { ticks: 50 * US });
        body.extend([set(shutter(), 4), set(lamp(0), 11), clear(lamp(0), 20 * US), clear(shutter(), 9)]);
    }
    let mut program = repeat(2, &body);
    program.extend([go(0, 0), go(1, 0)]);
    let outcome = exact(host, &program)?;
    let status = host.status()?;
    check(status.position[..2] == [0, 0], || format!("{:?}", status.position))?;
    Ok(outcome)
}

/// Two axes in step along an S-curve, blocking and beside strobes, and `Capture`.
fn jerk(host: &mut Host, long: bool) -> Result<Outcome, String> {
    let steps = if long { 3000 } else { 150 };
    let (max_rate, acceleration, jerk) = (16_000, 1_000_000, 500_000_000);
    let join = |target| Instruction::Join { axis: 1, target };
    let mut program = vec![
        join(-steps / 3),
        Instruction::Move { axis: 0, target: steps, max_rate, acceleration, jerk },
        join(7),
        Instruction::Go { axis: 0, target: 0, max_rate, acceleration, jerk },
    ];
    for n in 0..40 {
        program.extend([set(lamp(n % 4), 97 * US + u32::from(n)), clear(lamp(n % 4), 4 + 3 * u32::from(n))]);
    }
    program.extend([
        Instruction::Reach,
        Instruction::Capture {
            axis: 1,
            target: 0,
            max_rate,
            acceleration,
            jerk,
            settle: 20 * US,
            cameras: shutter(),
            leds: lamp(2),
            lead: 11,
            pulse: 50 * US,
            hold: 13,
        },
    ]);
    exact(host, &program)
}

/// Longer than anything is expanded ahead, at the highest rate that the verifier lets through.
fn full_speed(host: &mut Host, long: bool) -> Result<Outcome, String> {
    let limits = daic_firmware::Board::pico().axes[0];
    // The simulated stage stands less than the Pico's step lines.
    let (max_rate, acceleration, jerk) = (limits.max_rate, 1_000_000, 500_000_000);
    let target = if long { 40_000 } else { 2_500 };
    let program = [
        Instruction::Move { axis: 0, target, max_rate, acceleration, jerk: 0 },
        Instruction::Join { axis: 1, target: target - 1 },
        Instruction::Move { axis: 0, target: 0, max_rate, acceleration, jerk },
    ];
    let outcome = exact(host, &program)?;
    if let Outcome::Passed(mut numbers) = outcome {
        numbers.push(("steps per second", f64::from(max_rate), ""));
        return Ok(Outcome::Passed(numbers));
    }
    Ok(outcome)
}

/// Edges at 15 … 30 kHz in nested loops: about 8000 instructions' worth from a dozen.
fn many_edges(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let aux = 1 << 13;
    let inner = repeat(
        24,
        &[set(aux, 34 * US + 1), clear(aux, 46 * US), set(shutter(), 62 * US), clear(shutter(), 38 * US + 2)],
    );
    let mut body = inner;
    body.extend([set(lamp(0), 29 * US), clear(lamp(0), 7 * US), set(lamp(3), 4), clear(lamp(3), 40 * US)]);
    let program = repeat(100, &body);
    exact(host, &program)
}

/// The comparison itself: a recording with one edge moved by one tick must not pass.
fn one_tick(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = strobes(4);
    let mut ran = host.play(&program)?;
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    host.compare(&program, &ran)?;
    for index in 1..ran.edges.len() {
        for by in [1, -1] {
            let kept = ran.edges[index].0;
            ran.edges[index].0 = kept.wrapping_add_signed(by);
            check(host.compare(&program, &ran).is_err(), || {
                format!("edge {index} moved by {by}: not found")
            })?;
            ran.edges[index].0 = kept;
        }
    }
    Ok(Outcome::Passed(vec![("faults found", 2.0 * (ran.edges.len() - 1) as f64, "")]))
}

/// A real fault of one tick: the player does not get one of its clocks.
fn slipped(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = strobes(12);
    let from = host.status()?.next_event;
    host.start(&program)?;
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
    // After the settling (2.5 ms), before the last strobe (4.3 ms), wherever in the lead the reply came.
    let at = bench.now() + u64::from(3400 * US);
    bench.slip(at);
    let ran = host.finish(from, 125_000, 10_000_000)?;
    match host.compare(&program, &ran) {
        Err(_) => Ok(Outcome::Passed(vec![])),
        Ok(_) => Err("a clock was withheld and the edges are still right".into()),
    }
}

fn stop(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = repeat(
        200,
        &[set(shutter(), 400 * US), set(lamp(0), 100 * US), clear(shutter() | lamp(0), 300 * US)],
    );
    let from = host.status()?.next_event;
    host.start(&program)?;
    host.target.pass(u64::from(15_000 * US));
    let state = match host.request(&Request::Stop)? {
        Reply::Done { state } => state,
        // Where time is that of the host alone the run may be over by now.
        Reply::Refused(Refusal::WrongState { .. }) => {
            return Ok(Outcome::Cannot("the run is over before the host can stop it"));
        }
        other => return Err(format!("{other:?}")),
    };
    let ran = host.finish(from, 125_000, 20_000_000)?;
    done(&ran)?;
    check(host.status()?.state == State::Loaded, || format!("{state:?}"))?;
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    let first = ran.edges.first().map_or(0, |e| e.0) as i64 - i64::from(400 * US);
    let origin = if host.target.edges_on_board_clock() { ran.start as i64 } else { first };
    let (same, safe) = prefix(&program, &ran.edges, origin)?;
    check(same > 10 && same < 599, || format!("{same} edges"))?;
    // `RunDone` comes where the outputs went safe.
    let end = ran.events.last().map_or(0, |e| e.tick) as i64 - ran.start as i64;
    if let Some(safe) = safe {
        check(safe == end, || format!("safe at {safe}, said {end}"))?;
    }
    Ok(Outcome::Passed(vec![("edges before the end", same as f64, "")]))
}

fn abort(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = repeat(500, &[set(shutter() | lamp(1), 200 * US), clear(shutter() | lamp(1), 300 * US)]);
    let from = host.status()?.next_event;
    host.start(&program)?;
    host.target.pass(u64::from(13_000 * US));
    host.done(&Request::Abort)?;
    let ran = host.finish(from, 125_000, 2_000_000)?;
    let last = ran.events.last().map(|e| e.kind);
    if !matches!(last, Some(EventKind::Faulted { cause: FaultCause::Aborted, .. })) {
        return Ok(Outcome::Cannot("the run is over before the host can abort it"));
    }
    check(matches!(host.request(&Request::Start)?, Reply::Refused(_)), || "started while faulted".into())?;
    host.target.pass(1_000_000);
    let quiet = host.recorded().len();
    host.target.pass(1_000_000);
    check(host.recorded().len() == quiet, || "edges after the abort".into())?;
    let mut numbers = vec![];
    if host.watched() {
        let origin = if host.target.edges_on_board_clock() {
            ran.start as i64
        } else {
            ran.edges.first().map_or(0, |e| e.0) as i64 - i64::from(200 * US)
        };
        let (same, safe) = prefix(&program, &ran.edges, origin)?;
        let told = ran.fault.map_or(0, |f| f.tick) as i64 - ran.start as i64;
        numbers.push(("edges before", same as f64, ""));
        if let Some(safe) = safe {
            // The processor reads the clock after it has made the outputs safe.
            let late = told - safe;
            check((0..=200).contains(&late), || format!("safe at {safe}, said {told}"))?;
            numbers.push(("told late by", late as f64, "ticks"));
        }
    }
    host.done(&Request::ClearFault)?;
    // Latched until re-armed; then everything is as new.
    let again = strobes(2);
    let ran = host.play(&again)?;
    done(&ran)?;
    if host.watched() {
        host.compare(&again, &ran)?;
    }
    Ok(Outcome::Passed(numbers))
}

fn refused(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let good = strobes(2);
    let hash = host.load(&good)?;
    let bad = [
        vec![set(lamp(0), 4), clear(lamp(0), u32::MAX)],
        vec![set(lamp(0), 4)],
        vec![set(shutter(), 4), clear(shutter(), 3)],
        vec![set(1 << 30, 4)],
        vec![go(0, 1_000_000)],
        vec![go(7, 0)],
        vec![Instruction::LoopBegin { count: u32::MAX }],
        vec![],
    ];
    for program in bad {
        check(host.load(&program).is_err(), || format!("accepted: {program:?}"))?;
        let status = host.status()?;
        check(status.program == Some(hash) && status.state == State::Loaded, || format!("{status:?}"))?;
    }
    let recorded = host.recorded().len();
    check(recorded == 0, || format!("{recorded} edges from loading"))?;
    Ok(Outcome::Passed(vec![("refused", 8.0, "")]))
}

fn repeated(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = strobes(2);
    let hash = host.load(&program)?;
    host.done(&Request::Arm { hash })?;
    let from = host.status()?.next_event;
    host.recorded();
    let (id, frame) = host.frame(&Request::Start);
    let first = host.exchange(id, &frame)?;
    let ran = host.finish(from, 125_000, 20_000_000)?;
    done(&ran)?;
    // Also long after the run has ended.
    let second = host.exchange(id, &frame)?;
    check(first == second, || format!("{first:?}, then {second:?}"))?;
    host.target.pass(2_000_000);
    let status = host.status()?;
    check(status.run == 1 || !host.watched(), || format!("{status:?}"))?;
    check(status.state == State::Loaded, || format!("{status:?}"))?;
    Ok(Outcome::Passed(vec![]))
}

/// Something that keeps all kinds of lines busy, for the cases that cut it.
fn busy() -> Vec<Instruction> {
    let mut body = vec![];
    body.extend(repeat(
        10,
        &[set(shutter() | lamp(0), 13 * US), clear(lamp(0), 7 * US), clear(shutter(), 4)],
    ));
    body.push(go(0, 6));
    body.extend([set(lamp(1), 50 * US), clear(lamp(1), 400 * US)]);
    body.push(go(0, 0));
    let mut program = vec![set(1 << 15, 20 * US)];
    program.extend(repeat(100, &body));
    program.push(clear(1 << 15, 4));
    program
}

/// Ticks from the pad to the pins: two flip-flops, the wait, the write.
const INTERLOCK_TICKS: i64 = 4;

fn interlock(host: &mut Host, long: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot(NO_BENCH));
    }
    let program = busy();
    let instants: u64 = if long { 100 } else { 12 };
    let mut worst = 0;
    for n in 0..instants {
        // A move that was cut leaves the axis where it is; the program begins at the origin.
        host.restart();
        let from = host.status()?.next_event;
        host.start(&program)?;
        host.target.pass(u64::from(1200 * US) + n * 7919);
        let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
        bench.input(INTERLOCK, false);
        let opened = bench.now() as i64;
        // A short opening is enough.
        host.target.pass(20 + n % 3);
        if let Some(bench) = host.target.bench() {
            bench.input(INTERLOCK, true);
        }
        let ran = host.finish(from, 25_000, 5_000_000)?;
        let cause = ran.fault.map(|f| f.cause);
        check(cause == Some(FaultCause::Interlock), || format!("{n}: {:?}", ran.events.last()))?;
        host.target.pass(3_000_000);
        let origin = origin(host, &program)?;
        let edges = host.recorded().to_vec();
        let (_, safe) = prefix(&program, &edges, origin).map_err(|e| format!("instant {n}: {e}"))?;
        let at = safe.ok_or("no safe word")? + origin;
        worst = worst.max(at - opened);
        check((1..=INTERLOCK_TICKS).contains(&(at - opened)), || {
            format!("{n}: safe {} ticks later", at - opened)
        })?;
        // An open interlock permits nothing.
        host.done(&Request::ClearFault)?;
    }
    if let Some(bench) = host.target.bench() {
        bench.input(INTERLOCK, false);
    }
    host.target.pass(100_000);
    let hash = host.load(&program)?;
    host.done(&Request::Arm { hash })?;
    let before = host.recorded().len();
    let refused = host.request(&Request::Start)?;
    check(refused == Reply::Refused(Refusal::InterlockOpen), || format!("{refused:?}"))?;
    host.target.pass(3_000_000);
    let edges = host.recorded().len() - before;
    check(edges == 0, || format!("{edges} edges with the interlock open"))?;
    Ok(Outcome::Passed(vec![("instants", instants as f64, ""), ("open to safe", worst as f64, "ticks")]))
}

/// Longest time from the halt of the processor to safe outputs: what is expanded ahead (20 ms and up
/// to one block of 4 ms), or the watching machine's 5 ms, whichever is shorter.
const HALT_TICKS: i64 = 3 * 208_000 + 6 + 30_000;

fn halted_at(host: &mut Host, program: &[Instruction], after: u64) -> Result<(usize, i64), String> {
    host.restart();
    host.start(program)?;
    let Some(bench) = host.target.bench() else { return Err(NO_BENCH.into()) };
    let at = bench.now() + after;
    bench.halt_core(at);
    host.target.pass(after + HALT_TICKS as u64 + 100_000);
    let origin = origin(host, program)?;
    let edges = host.recorded().to_vec();
    let (same, safe) = prefix(program, &edges, origin)?;
    // The watchdog (0.5 s) has not acted yet: it was the player alone.
    let last = edges.last().map_or(0, |e| e.0) as i64;
    let late = safe.map_or(last, |s| s + origin) - at as i64;
    check(late <= HALT_TICKS, || format!("safe {late} ticks after the halt"))?;
    host.target.pass(200_000);
    check(host.recorded().len() == edges.len(), || "not latched".into())?;
    Ok((same, late))
}

fn halted(host: &mut Host, long: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot(NO_BENCH));
    }
    let program = busy();
    let instants: u64 = if long { 100 } else { 10 };
    let mut worst = 0;
    for n in 0..instants {
        let after = u64::from(1100 * US) + n * 104_729 % 1_500_000;
        let (_, late) =
            halted_at(host, &program, after).map_err(|e| format!("halt {after} ticks after start: {e}"))?;
        worst = worst.max(late);
    }
    Ok(Outcome::Passed(vec![
        ("instants", instants as f64, ""),
        ("halt to safe, worst", worst as f64, "ticks"),
    ]))
}

fn halted_in_pulse(host: &mut Host, long: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot(NO_BENCH));
    }
    // Longer than anything that looks after it.
    let program = [set(1 << 12 | lamp(1), 50 * US), clear(lamp(1), 9900 * US), clear(1 << 12, 100_000 * US)];
    let mut worst = 0;
    let instants: u64 = if long { 20 } else { 3 };
    for n in 0..instants {
        // The pulse ends before the watching machine would act later.
        let after = u64::from(2000 * US) + n * 15_013;
        let (same, late) = halted_at(host, &program, after)?;
        check(same == 1, || format!("{same} edges"))?;
        worst = worst.max(late);
    }
    Ok(Outcome::Passed(vec![
        ("instants", instants as f64, ""),
        ("halt to safe, worst", worst as f64, "ticks"),
    ]))
}

/// What is expanded ahead bridges a processor that is busy elsewhere.
fn stalled(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = busy();
    let from = host.status()?.next_event;
    host.start(&program)?;
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
    let now = bench.now();
    // 4 ms, twice.
    bench.stall_core(now + 1_000_000, now + 1_500_000);
    host.target.pass(1_600_000);
    if let Some(bench) = host.target.bench() {
        bench.stall_core(now + 2_500_000, now + 3_000_000);
    }
    host.target.pass(2_000_000);
    host.done(&Request::Abort)?;
    let ran = host.finish(from, 125_000, 2_000_000)?;
    let cause = ran.fault.map(|f| f.cause);
    check(cause == Some(FaultCause::Aborted), || format!("{cause:?}"))?;
    let origin = origin(host, &program)?;
    let (same, _) = prefix(&program, &ran.edges, origin)?;
    Ok(Outcome::Passed(vec![
        ("edges before the end", same as f64, ""),
        ("stalls bridged", 500_000.0, "ticks"),
    ]))
}

fn reset(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let program = busy();
    let boot = host.hello()?.boot_id;
    host.start(&program)?;
    host.target.pass(u64::from(3000 * US) + 77);
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
    bench.reset();
    let at = bench.now();
    host.target.pass(500_000);
    let origin = origin(host, &program)?;
    let edges = host.recorded().to_vec();
    let (_, safe) = prefix(&program, &edges, origin)?;
    check(safe == Some(at as i64 - origin), || format!("safe at {safe:?}, reset at {at}"))?;
    let hello = host.hello()?;
    check(hello.boot_id != boot, || format!("boot id {boot} again"))?;
    let status = host.status()?;
    check(status.state == State::Empty && status.run == 0, || format!("{status:?}"))?;
    Ok(Outcome::Passed(vec![("reset to safe", 0.0, "ticks")]))
}

fn links(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot("one link only")) };
    bench.link(true);
    host.restart();
    let program = strobes(3);
    let ran = host.play(&program);
    let verdict = ran.and_then(|ran| {
        done(&ran)?;
        host.compare(&program, &ran)
    });
    if let Some(bench) = host.target.bench() {
        bench.link(false);
    }
    verdict?;
    Ok(Outcome::Passed(vec![]))
}

fn levels(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let wanted = [65_535u16, 1, 0, 32_768];
    let mut program: Vec<Instruction> =
        (0u8..).zip(wanted).map(|(led, level)| Instruction::Level { led, level }).collect();
    program.push(Instruction::Delay { ticks: 4000 * US });
    let from = host.status()?.next_event;
    host.start(&program)?;
    host.target.pass(u64::from(3000 * US));
    let Some(bench) = host.target.bench() else {
        return Ok(Outcome::Cannot("levels are not seen from outside"));
    };
    let duty = bench.duty();
    for (index, (got, level)) in duty.iter().zip(wanted).enumerate() {
        let expected = f64::from(level) / 65_535.0;
        check((got - expected).abs() < 1e-9, || format!("LED {index}: {got}, expected {expected}"))?;
    }
    done(&host.finish(from, 125_000, 5_000_000)?)?;
    let duty = host.target.bench().map_or([1.0; 4], |bench| bench.duty());
    check(duty == [0.0; 4], || format!("after the run: {duty:?}"))?;
    Ok(Outcome::Passed(vec![]))
}

/// The first tick on the board's clock and the first edge are apart by the same time in every run.
fn starts(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if !host.watched() {
        return Ok(Outcome::Cannot(NOT_WATCHED));
    }
    let program = [set(shutter(), 10 * US), clear(shutter(), 10 * US)];
    let mut apart = std::collections::BTreeSet::new();
    for n in 0..8u64 {
        host.target.pass(997 * n);
        let ran = host.play(&program)?;
        done(&ran)?;
        let origin = host.compare(&program, &ran)?;
        apart.insert(origin - ran.start as i64);
    }
    check(apart.len() == 1, || format!("first edges at {apart:?} ticks after the tick told"))?;
    Ok(Outcome::Passed(vec![("jitter of the start", 0.0, "ticks")]))
}

fn health(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let mut body = vec![];
    let aux = 1 << 14;
    body.extend([go(0, 600), go(1, 500), set(aux, 10), clear(aux, 100 * US)]);
    body.extend([go(0, 0), go(1, 0)]);
    let from = host.status()?.next_event;
    host.start(&repeat(1, &body))?;
    done(&host.finish(from, 125_000, 200_000_000)?)?;
    host.target.pass(8_000_000);
    let health = host.health()?;
    if health.stack_size == 0 {
        return Ok(Outcome::Cannot("the board does not measure itself"));
    }
    check(health.reset == ResetCause::Power, || format!("{health:?}"))?;
    check(health.stack_peak > 0 && health.stack_peak < health.stack_size / 2, || format!("{health:?}"))?;
    check(health.received_lost == 0 && health.replies_lost == 0, || format!("{health:?}"))?;
    check(health.lead > 0, || format!("{health:?}"))?;
    Ok(Outcome::Passed(vec![
        ("stack peak", f64::from(health.stack_peak), "bytes"),
        ("stack size", f64::from(health.stack_size), "bytes"),
        ("least lead", f64::from(health.lead), "ticks"),
        ("longest turn", f64::from(health.turn), "ticks"),
    ]))
}

/// A program whose end, where it breaks a rule, the verifier does not reach: six times 20 000 instructions.
fn verification(host: &mut Host, _: bool) -> Result<Outcome, String> {
    use daic_protocol::program::{Condition, Timeout};
    let wait = |timeout| Instruction::Wait {
        input: 0,
        condition: Condition::Rising,
        skip: 0,
        delay: daic_firmware::pico::INPUT_LATENCY,
        timeout,
        on_timeout: Timeout::Continue,
    };
    let aux = 1 << 13;
    let mut program = repeat(1_000_000, &[wait(2000 * US), set(aux, 50), clear(aux, 60)]);
    program.extend([set(lamp(0), 100), wait(0), clear(lamp(0), 100)]);
    let refused = host.load(&program).err().unwrap_or_default();
    check(refused.contains("CannotProve"), || format!("answered {refused:?}"))?;
    // The stack is looked through a little in every turn.
    host.target.pass(16_000_000);
    let health = host.health()?;
    if health.stack_size == 0 {
        return Ok(Outcome::Cannot("the board does not measure itself"));
    }
    // The watchdog has not acted.
    check(health.reset == ResetCause::Power, || format!("{health:?}"))?;
    check(health.stack_peak < health.stack_size / 2, || format!("{health:?}"))?;
    Ok(Outcome::Passed(vec![
        ("stack peak", f64::from(health.stack_peak), "bytes"),
        ("longest turn", f64::from(health.turn), "ticks"),
    ]))
}
