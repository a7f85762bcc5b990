//! Inputs: triggers, exposures, limit switches, and a host that says nothing.

use super::*;
use daic_firmware::pico::{INPUT_LATENCY, INPUTS};
use daic_protocol::program::{Condition, Policy, Reaction, Timeout};

/// GPIO of a bit of the input word.
fn gpio(bit: u8) -> u8 {
    INPUTS.iter().find(|input| input.0 == bit).map_or(0, |input| input.1)
}

fn wait(timeout: u32, on_timeout: Timeout) -> Instruction {
    let (input, condition, skip, delay) = (0, Condition::Rising, 0, INPUT_LATENCY);
    Instruction::Wait { input, condition, skip, delay, timeout, on_timeout }
}

/// From a trigger at the pin to the edge that answers it.
pub(super) fn trigger(host: &mut Host, long: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot(NO_BENCH));
    }
    let count: u32 = if long { 200 } else { 24 };
    let program = repeat(
        count,
        &[
            wait(0, Timeout::Fault),
            set(shutter(), 0),
            clear(shutter(), 31),
            set(lamp(1), 4),
            clear(lamp(1), 9),
        ],
    );
    let from = host.status()?.next_event;
    host.start(&program)?;
    host.target.pass(1_400_000);
    let mut triggers = Vec::new();
    for n in 0..count {
        host.target.pass(u64::from(INPUT_LATENCY) + 20_000 + u64::from(n * 7919 % 1000));
        let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
        bench.input(gpio(0), true);
        triggers.push(bench.now());
        // As short as a pulse may be.
        host.target.pass(8 + u64::from(n % 5));
        if let Some(bench) = host.target.bench() {
            bench.input(gpio(0), false);
        }
    }
    let ran = host.finish(from, 125_000, 10_000_000)?;
    done(&ran)?;
    let rises: Vec<u64> = ran.edges.iter().filter(|e| e.1 == shutter()).map(|e| e.0).collect();
    check(rises.len() == triggers.len(), || {
        format!("{} answers to {} triggers", rises.len(), triggers.len())
    })?;
    let late: Vec<u64> = rises.iter().zip(&triggers).map(|(r, t)| r - t).collect();
    let (least, most) = (late.iter().min().copied().unwrap_or(0), late.iter().max().copied().unwrap_or(0));
    check(most - least <= 1, || format!("answers after {late:?}"))?;
    check(least.abs_diff(u64::from(INPUT_LATENCY)) <= 8, || format!("answers after {late:?}"))?;
    // The words of one answer are apart as programmed.
    for (index, rise) in rises.iter().enumerate() {
        let words: Vec<u64> = ran.edges[4 * index..4 * index + 4].iter().map(|e| e.0 - rise).collect();
        check(words == [0, 31, 35, 44], || format!("answer {index}: {words:?}"))?;
    }
    let stamps: Vec<u64> =
        ran.events.iter().filter(|e| matches!(e.kind, EventKind::Triggered { .. })).map(|e| e.tick).collect();
    let apart: Vec<u64> = stamps.iter().zip(&triggers).map(|(s, t)| s.wrapping_sub(*t)).collect();
    let spread = apart.iter().map(|a| a.wrapping_sub(apart[0]) as i64);
    let spread = spread.clone().max().unwrap_or(0) - spread.min().unwrap_or(0);
    check(spread <= 1, || format!("stamps spread by {spread} ticks"))?;
    Ok(Outcome::Passed(vec![
        ("triggers", f64::from(count), ""),
        ("latency, least", least as f64, "ticks"),
        ("jitter", (most - least) as f64, "ticks"),
        ("spread of the stamps", spread as f64, "ticks"),
    ]))
}

/// Without a trigger the program goes on where it says, or ends safe.
pub(super) fn timeouts(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let limit = 3000 * US;
    let pulse = [set(shutter(), 100), clear(shutter(), 50)];
    let program = [&pulse[..], &[wait(limit, Timeout::Continue)], &pulse[..]].concat();
    let ran = host.play(&program)?;
    done(&ran)?;
    let told = ran.events.iter().find(|e| matches!(e.kind, EventKind::TimedOut { .. })).map(|e| e.tick);
    check(told == Some(ran.start + 150 + u64::from(limit)), || format!("{told:?}"))?;
    if host.watched() {
        let at: Vec<u64> = ran.edges.iter().map(|e| e.0 - ran.edges[0].0).collect();
        let second = 50 + u64::from(limit + INPUT_LATENCY) + 100;
        check(at == [0, 50, second, second + 50], || format!("{at:?}"))?;
    }
    let program = [&pulse[..], &[wait(limit, Timeout::Fault)], &pulse[..]].concat();
    let ran = host.play(&program)?;
    check(ran.fault.is_some_and(|f| f.cause == FaultCause::TriggerTimeout { input: 0 }), || {
        format!("{:?}", ran.fault)
    })?;
    check(!host.watched() || ran.edges.len() == 2, || format!("{:?}", ran.edges))?;
    host.done(&Request::ClearFault)?;
    Ok(Outcome::Passed(vec![]))
}

/// The camera's trigger line wired to its exposure-active input.
pub(super) fn exposure(host: &mut Host, _: bool) -> Result<Outcome, String> {
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
    bench.wire(6, gpio(8));
    let widths: Vec<u32> = (0..12).map(|n| 20 * US + 37 * n).collect();
    let mut program: Vec<Instruction> =
        widths.iter().flat_map(|&width| [set(shutter(), 200 * US), clear(shutter(), width)]).collect();
    // The end of the last exposure is seen a little after the line.
    program.push(Instruction::Delay { ticks: 100 * US });
    let ran = host.play(&program)?;
    done(&ran)?;
    let after: Vec<u32> = ran
        .events
        .iter()
        .filter_map(|e| if let EventKind::ExposureBegan { after, .. } = e.kind { Some(after) } else { None })
        .collect();
    let length: Vec<u32> = ran
        .events
        .iter()
        .filter_map(
            |e| if let EventKind::ExposureEnded { length, .. } = e.kind { Some(length) } else { None },
        )
        .collect();
    check(after.len() == widths.len() && length.len() == widths.len(), || format!("{after:?} {length:?}"))?;
    check(after.iter().all(|a| *a <= 3), || format!("begun after {after:?} ticks"))?;
    check(length.iter().zip(&widths).all(|(l, w)| l.abs_diff(*w) <= 2), || format!("{length:?}"))?;
    let worst = after.iter().max().copied().unwrap_or(0);
    Ok(Outcome::Passed(vec![
        ("exposures", widths.len() as f64, ""),
        ("wire told as delay of, at most", f64::from(worst), "ticks"),
    ]))
}

/// A switch at the low end of axis 0 stops a move there, and the count is that of the steps that came out.
pub(super) fn limit(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot(NO_BENCH));
    }
    let program = [go(0, -2000)];
    let from = host.status()?.next_event;
    host.start(&program)?;
    host.target.pass(3_500_000);
    let Some(bench) = host.target.bench() else { return Ok(Outcome::Cannot(NO_BENCH)) };
    bench.input(gpio(12), true);
    let pressed = bench.now();
    let ran = host.finish(from, 125_000, 20_000_000)?;
    check(ran.fault.is_some_and(|f| f.cause == FaultCause::LimitSwitch { axis: 0 }), || {
        format!("{:?}", ran.fault)
    })?;
    let safe = ran.edges.last().copied().unwrap_or((0, 1));
    check(safe.1 == SAFE_WORD, || format!("left at {safe:?}"))?;
    let (step, mut before) = (1 << 16, 0);
    let steps = ran.edges.iter().filter(|e| std::mem::replace(&mut before, e.1) & step < e.1 & step).count();
    let position = host.status()?.position[0];
    check(position == -(steps as i32), || format!("{steps} steps came out, the count is {position}"))?;
    let late = safe.0.saturating_sub(pressed);
    // A turn of the main loop and the answer; the moment decides how much of it.
    let most = u64::from(1000 * US);
    check(late < most, || format!("safe {late} ticks after the switch"))?;
    Ok(Outcome::Passed(vec![("pressed to safe, less than", most as f64, "ticks")]))
}

/// The policy for a host that says nothing: an exact beginning of the program, then safe.
pub(super) fn silence(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot("silence takes time that only the host passes"));
    }
    let policy = Policy { host_timeout_ms: 15, host_loss: Reaction::Safe, ..Policy::DEFAULT };
    let mut program = vec![Instruction::Policy(policy)];
    program.extend(repeat(500, &[set(lamp(1), 300 * US), clear(lamp(1), 200 * US)]));
    let from = host.status()?.next_event;
    host.start(&program)?;
    let heard = host.target.bench().map_or(0, |bench| bench.now());
    host.target.pass(9_000_000);
    let ran = host.finish(from, 125_000, 10_000_000)?;
    check(ran.fault.is_some_and(|f| f.cause == FaultCause::HostLost), || format!("{:?}", ran.fault))?;
    let edges = ran.edges.clone();
    let origin = edges.first().map_or(0, |e| e.0) as i64 - i64::from(300 * US);
    prefix(&program, &edges, origin)?;
    let late = edges.last().map_or(0, |e| e.0).saturating_sub(heard);
    // 15 ms, and what the player has been given: 20 ms and a block.
    let most = u64::from(40_000 * US);
    check(late < most, || format!("safe {late} ticks after the last request"))?;
    let told = ran.fault.map_or(0, |f| f.tick) as i64 - ran.start as i64;
    let safe = edges.last().map_or(0, |e| e.0) as i64 - origin;
    check(told >= safe && told - safe <= i64::from(500 * US), || format!("safe at {safe}, told {told}"))?;
    Ok(Outcome::Passed(vec![("last request to safe, less than", most as f64, "ticks")]))
}
