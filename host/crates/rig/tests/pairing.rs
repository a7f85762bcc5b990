//! Frames and triggers found again after drops, copies, swaps and foreign frames.

use daic_rig::pairing::{
    Arrival, Counts, Pairing, PairingOptions, Stamp, StrobePulse, Trigger, Verdict, pair,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const TICK_HZ: u32 = 125_000_000;

struct World {
    triggers: Vec<Trigger>,
    trigger_ns: Vec<f64>,
    stamps: Vec<Stamp>,
    /// The trigger that caused each stamp; `None` for a foreign frame.
    truth: Vec<Option<usize>>,
    /// Host time of each exposure.
    exposed: Vec<f64>,
    /// Whether anything happened to it or beside it.
    disturbed: Vec<bool>,
}

#[derive(Clone, Copy)]
struct Rates {
    drop: f64,
    duplicate: f64,
    swap: f64,
    foreign: f64,
    miss: f64,
}

const ROUGH: Rates = Rates { drop: 0.01, duplicate: 0.005, swap: 0.02, foreign: 0.002, miss: 0.002 };

fn world(count: usize, uneven: f64, rates: Rates, seed: u64) -> World {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let period_ns = rng.random_range(2e6..20e6);
    let drift = rng.random_range(-200e-6..200e-6);
    let offset = rng.random_range(0.0..1e15);
    let mut tick = rng.random_range(0..1u64 << 40);
    let mut w = World {
        triggers: vec![],
        trigger_ns: vec![],
        stamps: vec![],
        truth: vec![],
        exposed: vec![],
        disturbed: vec![],
    };
    let mut id = rng.random_range(0..1000u64);
    let mut host = 0.0;
    for index in 0..count {
        let interval = period_ns * (1.0 + uneven * rng.random_range(-1.0..1.0));
        let ticks = (interval / 8.0) as u64;
        tick += ticks;
        host += ticks as f64 * 8.0;
        let led = (index % 3) as u8;
        w.triggers.push(Trigger { tick, strobe: Some(StrobePulse { led, on: tick + 10, off: tick + 20 }) });
        w.trigger_ns.push(host);
        let camera = |after: f64, jitter: f64| (offset + (host + after) * (1.0 + drift) + jitter) as u64;
        let arrive = |ms: f64| Some((host + ms * 1e6) as i64);
        // The camera was not ready: no exposure, no number.
        if rng.random_bool(rates.miss) {
            continue;
        }
        let stamp = Stamp {
            id,
            camera_ns: Some(camera(0.0, rng.random_range(-20e3..20e3))),
            host_ns: arrive(rng.random_range(0.6..1.0) + if rng.random_bool(0.05) { 30.0 } else { 0.0 }),
        };
        id += 1;
        // Lost on its way.
        if !rng.random_bool(rates.drop) {
            w.stamps.push(stamp);
            w.truth.push(Some(index));
            w.exposed.push(host);
            w.disturbed.push(false);
            if rng.random_bool(rates.duplicate) {
                w.stamps.push(stamp);
                w.truth.push(Some(index));
                w.exposed.push(host);
                w.disturbed.push(true);
            }
        }
        if rng.random_bool(rates.foreign) {
            let after = rng.random_range(0.0..period_ns);
            let camera_ns = Some(camera(after, 0.0));
            w.stamps.push(Stamp { id, camera_ns, host_ns: Some((host + after + 7e5) as i64) });
            id += 1;
            w.truth.push(None);
            w.exposed.push(host + after);
            w.disturbed.push(true);
        }
    }
    for i in 1..w.stamps.len() {
        if rng.random_bool(rates.swap) {
            w.stamps.swap(i - 1, i);
            w.truth.swap(i - 1, i);
            w.exposed.swap(i - 1, i);
            w.disturbed.swap(i - 1, i);
        }
    }
    w
}

impl World {
    fn arrival(&self) -> Arrival {
        Arrival {
            trigger_ns: self.trigger_ns.clone(),
            bound_ns: 1e4,
            min_latency_ns: 5e5,
            quickest_ns: 1e6,
            max_latency_ns: 4e7,
        }
    }

    /// Wrong pairs, and undisturbed frames that were not paired.
    fn judge(&self, p: &Pairing) -> (usize, usize, usize) {
        let (mut wrong, mut undisturbed, mut unpaired) = (0, 0, 0);
        for ((verdict, truth), disturbed) in p.frames.iter().zip(&self.truth).zip(&self.disturbed) {
            if let Verdict::Paired { trigger, strobe } = verdict {
                wrong += usize::from(*truth != Some(*trigger) || *strobe != self.triggers[*trigger].strobe);
            }
            if !disturbed {
                undisturbed += 1;
                unpaired += usize::from(!matches!(verdict, Verdict::Paired { .. }));
            }
        }
        let Counts { paired, missing, extra, ambiguous } = p.counts;
        assert_eq!(paired + extra + ambiguous, self.stamps.len());
        assert_eq!(paired + missing, self.triggers.len());
        assert_eq!(paired, p.triggers.iter().flatten().count());
        (wrong, undisturbed, unpaired)
    }
}

#[test]
fn uneven_trains_are_paired_by_their_pattern() {
    let (mut frames, mut lost) = (0, 0);
    for seed in 0..40 {
        let count = if seed == 0 { 100_000 } else { 2_000 };
        let w = world(count, 0.2, ROUGH, seed);
        let p = pair(&w.triggers, &w.stamps, &PairingOptions::new(TICK_HZ), None);
        let (wrong, undisturbed, unpaired) = w.judge(&p);
        assert_eq!(wrong, 0, "seed {seed}: {:?}", p.counts);
        frames += undisturbed;
        lost += unpaired;
    }
    println!("uneven: {lost} of {frames} undisturbed frames not paired, 0 wrong pairs");
    assert!(lost as f64 <= 0.001 * frames as f64, "{lost} of {frames}");
}

#[test]
fn periodic_trains_are_paired_by_arrival() {
    let (mut frames, mut lost) = (0, 0);
    for seed in 100..140 {
        let count = if seed == 100 { 50_000 } else { 2_000 };
        let w = world(count, 0.0, ROUGH, seed);
        let p = pair(&w.triggers, &w.stamps, &PairingOptions::new(TICK_HZ), Some(&w.arrival()));
        let (wrong, undisturbed, unpaired) = w.judge(&p);
        assert_eq!(wrong, 0, "seed {seed}: {:?}", p.counts);
        frames += undisturbed;
        lost += unpaired;
    }
    println!("periodic with arrival: {lost} of {frames} undisturbed frames not paired, 0 wrong pairs");
    assert!(lost as f64 <= 0.001 * frames as f64, "{lost} of {frames}");
}

#[test]
fn periodic_trains_without_arrival_are_paired_or_ambiguous_but_never_wrong() {
    let mut decided = 0;
    for seed in 200..300 {
        let w = world(300, 0.0, ROUGH, seed);
        let p = pair(&w.triggers, &w.stamps, &PairingOptions::new(TICK_HZ), None);
        let (wrong, ..) = w.judge(&p);
        assert_eq!(wrong, 0, "seed {seed}: {:?}", p.counts);
        decided += usize::from(p.counts.paired > 0);
    }
    println!("periodic without arrival: {decided} of 100 runs decided, 0 wrong pairs");
    // A frame lost at either end makes a run ambiguous: 2 · (1 % + 0.2 %) of the runs.
    assert!(decided >= 90, "{decided}");
}

#[test]
fn short_runs_are_never_wrong() {
    for seed in 1000..3000 {
        let rates = Rates { drop: 0.15, duplicate: 0.1, swap: 0.2, foreign: 0.0, miss: 0.1 };
        let w = world(1 + (seed as usize % 9), 0.3, rates, seed);
        let p = pair(&w.triggers, &w.stamps, &PairingOptions::new(TICK_HZ), None);
        assert_eq!(w.judge(&p).0, 0, "seed {seed}: {:?} {:?}", w.stamps, p);
    }
}

#[test]
fn a_frame_lost_at_the_end_of_a_periodic_train_is_ambiguous() {
    let triggers: Vec<Trigger> = (0..10).map(|i| Trigger { tick: i * 1_250_000, strobe: None }).collect();
    let stamp = |i: u64| Stamp { id: i, camera_ns: Some(5_000_000_000 + i * 10_000_000), host_ns: None };
    let options = PairingOptions::new(TICK_HZ);
    let all: Vec<Stamp> = (0..10).map(stamp).collect();
    assert_eq!(pair(&triggers, &all, &options, None).counts, Counts { paired: 10, ..Counts::default() });
    let middle: Vec<Stamp> = (0..10).filter(|&i| i != 4).map(stamp).collect();
    let p = pair(&triggers, &middle, &options, None);
    assert_eq!(p.counts, Counts { paired: 9, missing: 1, ..Counts::default() });
    assert_eq!(p.triggers[4], None);
    let p = pair(&triggers, &all[..9], &options, None);
    assert_eq!(p.counts, Counts { ambiguous: 9, missing: 10, ..Counts::default() });
}

#[test]
fn nothing_comes_of_nothing() {
    let options = PairingOptions::new(TICK_HZ);
    let trigger = Trigger { tick: 7, strobe: None };
    let stamp = Stamp { id: 0, camera_ns: Some(1), host_ns: None };
    assert_eq!(pair(&[], &[], &options, None).counts, Counts::default());
    assert_eq!(pair(&[trigger], &[], &options, None).counts, Counts { missing: 1, ..Counts::default() });
    assert_eq!(pair(&[], &[stamp], &options, None).counts, Counts { extra: 1, ..Counts::default() });
    let clockless = Stamp { camera_ns: None, ..stamp };
    let p = pair(&[trigger], &[clockless], &options, None);
    assert_eq!(p.counts, Counts { missing: 1, ambiguous: 1, ..Counts::default() });
}

#[test]
fn a_camera_without_a_clock_is_paired_by_arrival_alone() {
    let triggers: Vec<Trigger> = (0..50).map(|i| Trigger { tick: i * 12_500_000, strobe: None }).collect();
    let arrival = Arrival {
        trigger_ns: (0..50).map(|i| i as f64 * 1e8).collect(),
        bound_ns: 1e5,
        min_latency_ns: 5e6,
        quickest_ns: 3e7,
        max_latency_ns: 9e7,
    };
    let frames: Vec<Stamp> = (0..50u64)
        .filter(|i| i % 7 != 3)
        .map(|i| Stamp { id: i, camera_ns: None, host_ns: Some(i as i64 * 100_000_000 + 20_000_000) })
        .collect();
    let p = pair(&triggers, &frames, &PairingOptions::new(TICK_HZ), Some(&arrival));
    assert_eq!(p.counts, Counts { paired: 43, missing: 7, ..Counts::default() });
    assert!(p.triggers.iter().enumerate().all(|(t, f)| f.is_none_or(|f| frames[f].id == t as u64)));
}

/// A foreign frame is taken for a lost one only where its time cannot tell them
/// apart: at the time of a lost one, or where one or two frames are all there is to judge by.
#[test]
fn short_runs_among_foreign_frames_are_wrong_only_where_nobody_could_know() {
    let (mut pairs, mut alike, mut lone, mut wrong) = (0, 0, 0, 0);
    for seed in 10_000..30_000 {
        let rates = Rates { drop: 0.15, duplicate: 0.1, swap: 0.2, foreign: 0.1, miss: 0.1 };
        let w = world(1 + (seed as usize % 9), 0.3, rates, seed);
        let p = pair(&w.triggers, &w.stamps, &PairingOptions::new(TICK_HZ), None);
        for (index, verdict) in p.frames.iter().enumerate() {
            let Verdict::Paired { trigger, .. } = *verdict else { continue };
            pairs += 1;
            if w.truth[index] == Some(trigger) {
                continue;
            }
            // Four times the jitter of 20 us: its own, the other pairs', and the slack for both.
            if (w.exposed[index] - w.trigger_ns[trigger]).abs() <= 80e3 {
                alike += 1;
            } else if p.counts.paired < 3 && p.counts.paired == p.frames.len() {
                lone += 1;
            } else {
                wrong += 1;
                println!("seed {seed}: {:?} {p:?}", w.stamps);
            }
        }
    }
    println!(
        "short, 10 % foreign: {pairs} pairs, {alike} at the time of a lost frame, {lone} in runs of one or two frames that all fit, {wrong} wrong otherwise"
    );
    assert_eq!(wrong, 0);
}
