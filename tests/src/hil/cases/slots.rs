//! Programs in flash.

use super::*;

fn blink(width: u32) -> Vec<Instruction> {
    repeat(3, &[set(lamp(1) | shutter(), 100 * US), clear(lamp(1), width), clear(shutter(), 55)])
}

fn stored(host: &mut Host) -> Result<Vec<SlotInfo>, String> {
    match host.request(&Request::Slots)? {
        Reply::Slots(slots) => Ok(slots.to_vec()),
        other => Err(format!("{other:?}")),
    }
}

/// What is played by itself after the power has come back.
fn after_power(host: &mut Host) -> Result<Vec<(u64, u32)>, String> {
    let Some(bench) = host.target.bench() else { return Err(NO_BENCH.into()) };
    bench.power_cycle();
    host.forget();
    host.target.pass(3_000_000);
    Ok(crate::expansion::changes_only(host.recorded()))
}

fn is(program: &[Instruction], edges: &[(u64, u32)]) -> bool {
    let wanted = expected(program);
    let zero = |edges: &[(u64, u32)]| -> Vec<(u64, u32)> {
        edges.iter().map(|e| (e.0 - edges.first().map_or(0, |f| f.0), e.1)).collect()
    };
    zero(edges) == zero(&wanted)
}

pub(super) fn autostart(host: &mut Host, _: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot("its power stays on"));
    }
    let (first, second) = (blink(20 * US), blink(33 * US + 1));
    host.load(&first)?;
    host.done(&Request::SlotStore { slot: 2, autostart: Autostart::PowerUp })?;
    host.load(&second)?;
    host.done(&Request::SlotStore { slot: 0, autostart: Autostart::Input { input: 1 } })?;
    let kept = stored(host)?;
    check(kept.len() == 2 && kept[0].slot == 0 && kept[1].autostart == Autostart::PowerUp, || {
        format!("{kept:?}")
    })?;
    let edges = after_power(host)?;
    check(is(&first, &edges), || format!("at power-up: {edges:?}"))?;
    check(stored(host)? == kept, || "another list after power-up".into())?;
    // And the other one at its input.
    for _ in 0..2 {
        host.forget();
        for level in [true, false] {
            if let Some(bench) = host.target.bench() {
                bench.input(22, level);
            }
            host.target.pass(1000);
        }
        host.target.pass(3_000_000);
        let edges = crate::expansion::changes_only(host.recorded());
        check(is(&second, &edges), || format!("at the input: {edges:?}"))?;
    }
    host.done(&Request::SlotErase { slot: 2 })?;
    let edges = after_power(host)?;
    check(edges.is_empty(), || format!("erased, and still {edges:?}"))?;
    host.done(&Request::SlotLoad { slot: 0 })?;
    let refused = host.request(&Request::SlotLoad { slot: 2 })?;
    let empty = Refusal::Slot { slot: 2, error: SlotError::Empty };
    check(refused == Reply::Refused(empty), || format!("{refused:?}"))?;
    Ok(Outcome::Passed(vec![]))
}

/// Power goes at every operation of the flash, before it, in it, after it.
pub(super) fn cut(host: &mut Host, long: bool) -> Result<Outcome, String> {
    if host.target.bench().is_none() {
        return Ok(Outcome::Cannot("its power stays on"));
    }
    let (old, new) = (blink(20 * US), blink(33 * US + 1));
    let store = Request::SlotStore { slot: 1, autostart: Autostart::PowerUp };
    host.load(&old)?;
    host.done(&store)?;
    let count = host.target.bench().map_or(0, |bench| bench.flash_operations().len());
    check(count == 7, || format!("{count} operations for a short program"))?;
    let parts: &[f64] = if long { &[0.0, 0.02, 0.5, 0.99] } else { &[0.0, 0.6] };
    let (mut kept, mut replaced) = (0, 0);
    for operation in 0..count {
        for &part in parts {
            // Old everywhere first: what follows the last cut may have become the new one.
            let edges = after_power(host)?;
            if !is(&old, &edges) {
                host.load(&old)?;
                host.done(&store)?;
                after_power(host)?;
            }
            host.load(&new)?;
            let Some(bench) = host.target.bench() else { return Err(NO_BENCH.into()) };
            bench.cut_power(operation, part);
            let (id, frame) = host.frame(&store);
            let _ = host.exchange(id, &frame);
            check(host.target.bench().is_some_and(|bench| bench.is_dead()), || {
                format!("operation {operation} never came")
            })?;
            let edges = after_power(host)?;
            if is(&new, &edges) {
                replaced += 1;
            } else {
                check(is(&old, &edges), || format!("cut {operation} at {part}: {edges:?}"))?;
                kept += 1;
            }
        }
    }
    Ok(Outcome::Passed(vec![
        ("old program kept", f64::from(kept), ""),
        ("new program there", f64::from(replaced), ""),
    ]))
}
