//! True errors against the bounds, on simulated links whose delays and clocks are known.

use daic_rig::clock::{ClockError, ClockModel, ClockOptions, ClockSample, sample_period_ms};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const TICK_HZ: u32 = 125_000_000;

/// A box whose clock runs at `1 + drift` of nominal, and wanders.
struct Truth {
    zero_ns: f64,
    drift: f64,
    wander: f64,
}

impl Truth {
    /// Tick at host time `ns`: the rate is 1 + drift + wander·sin(2πt/100 s).
    fn tick(&self, ns: f64) -> u64 {
        let t = ns - self.zero_ns;
        let omega = 2.0 * std::f64::consts::PI / 100e9;
        let device = t * (1.0 + self.drift) + self.wander * (1.0 - (omega * t).cos()) / omega;
        (device * 0.125) as u64
    }
}

struct Trial {
    asked: usize,
    refused: usize,
    beyond: usize,
    worst: f64,
    widest_ns: f64,
}

/// Samples over a jittery, asymmetric link; then compares host times within the samples and up to
/// 20 s behind the last one.
fn trial(seed: u64, samples: u64, total: &mut Trial) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let truth = Truth {
        zero_ns: rng.random_range(-1e12..0.0),
        drift: rng.random_range(-200e-6..200e-6),
        wander: rng.random_range(0.0..0.2e-6),
    };
    let options = ClockOptions::new(TICK_HZ);
    let mut model = ClockModel::new(options);
    let mut now = 0.0;
    // Some links are slow one way only.
    let (there, back) = (rng.random_range(2e4..2e5), rng.random_range(2e4..2e5));
    for index in 0..samples {
        now += sample_period_ms(index) as f64 * 1e6;
        let slow = |rng: &mut ChaCha8Rng| if rng.random_bool(0.2) { rng.random_range(0.0..5e6) } else { 0.0 };
        let sent = now;
        let arrived = sent + there * rng.random_range(1.0..1.5) + slow(&mut rng);
        let received = arrived + back * rng.random_range(1.0..1.5) + slow(&mut rng);
        now = received;
        model
            .add(ClockSample {
                sent_ns: sent.floor() as i64,
                received_ns: received.ceil() as i64,
                tick: truth.tick(arrived),
            })
            .unwrap_or_else(|e| panic!("seed {seed}: {e}"));
    }
    for _ in 0..200 {
        let at = rng.random_range(0.0..now + 20e9);
        total.asked += 1;
        match model.host_time(truth.tick(at)) {
            Ok(time) => {
                assert!(time.bound_ns <= options.limit_ns);
                let share = (time.ns - at).abs() / time.bound_ns;
                total.beyond += usize::from(share > 1.0);
                total.worst = total.worst.max(share);
                total.widest_ns = total.widest_ns.max(time.bound_ns);
            }
            Err(ClockError::BeyondLimit { bound_ns, .. }) => {
                assert!(bound_ns > options.limit_ns);
                total.refused += 1;
            }
            Err(other) => panic!("seed {seed}: {other}"),
        }
    }
}

#[test]
fn no_host_time_is_wrong_by_more_than_its_bound() {
    for samples in [1, 2, 8, 40, 200] {
        let mut total = Trial { asked: 0, refused: 0, beyond: 0, worst: 0.0, widest_ns: 0.0 };
        for seed in 0..200 {
            trial(seed * 1000 + samples, samples, &mut total);
        }
        println!(
            "{samples} samples (seeds {samples} + 1000 n): {} asked, {} refused, {} beyond the bound, worst error {:.2} of the bound",
            total.asked, total.refused, total.beyond, total.worst
        );
        assert_eq!(total.beyond, 0);
        // A bound that is never approached would be no use; one-way slowness comes within a factor 2.
        assert!(total.worst > 0.5, "{}", total.worst);
        // With a minute of samples nearly everything up to 20 s later can be stamped.
        if samples >= 40 {
            assert!(total.refused * 100 < total.asked, "{} refused", total.refused);
        }
    }
}

#[test]
fn the_bound_is_of_the_size_of_the_round_trip_among_the_samples() {
    let mut model = ClockModel::new(ClockOptions::new(TICK_HZ));
    for i in 0..64i64 {
        let sent_ns = i * 1_000_000_000;
        let tick = (sent_ns as u64 + 50_000) / 8;
        model.add(ClockSample { sent_ns, received_ns: sent_ns + 100_000, tick }).expect("sample");
    }
    // 50 µs of half round trip; the weights of a line over 64 points add up to 1 in the middle, and
    // 0.5 ppm of wander over a mean distance of 16 s is 8 µs.
    let middle = model.host_time(32_000_000_000 / 8).expect("middle");
    assert!((50_000.0..60_000.0).contains(&middle.bound_ns), "{}", middle.bound_ns);
    assert!((middle.ns - 32e9).abs() < 10.0, "{}", middle.ns);
    assert_eq!(model.min_round_trip_ns(), Some(100_000.0));
}

#[test]
fn what_cannot_be_known_is_refused() {
    let options = ClockOptions::new(TICK_HZ);
    let mut model = ClockModel::new(options);
    assert_eq!(model.host_time(0), Err(ClockError::NoSample));
    let sample = |s: i64, tick: u64| ClockSample { sent_ns: s, received_ns: s + 100_000, tick };
    model.add(sample(0, 6_250)).expect("first");
    // 200 ppm over 10 s is 2 ms.
    let far = model.host_time(10 * u64::from(TICK_HZ)).expect_err("far");
    assert!(
        matches!(far, ClockError::BeyondLimit { bound_ns, limit_ns, .. } if bound_ns > 2e6 && limit_ns == 1e6),
        "{far}"
    );
    model.host_time(u64::from(TICK_HZ)).expect("near");
    // The box was reset: its ticks begin again.
    assert!(matches!(
        model.add(sample(1_000_000_000, 100)),
        Err(ClockError::Backwards { tick: 100, previous: 6_250 })
    ));
    // Ten times too fast, as a simulated clock may be.
    let fast = model.add(sample(1_000_000_000, 10 * u64::from(TICK_HZ)));
    assert!(matches!(fast, Err(ClockError::Inconsistent { .. })), "{fast:?}");
    assert_eq!(model.len(), 1);
    model.add(sample(1_000_000_000, u64::from(TICK_HZ) + 6_250)).expect("as it should be");
}

#[test]
fn sampling_periods_are_uneven() {
    let later: Vec<u64> = (8..40).map(sample_period_ms).collect();
    assert!(later.iter().all(|p| (700..1300).contains(p)));
    assert!(later.windows(2).all(|w| w[0] != w[1]), "{later:?}");
    assert!((0..8).all(|i| sample_period_ms(i) < 12));
}
