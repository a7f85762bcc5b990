//! The measures of error by themselves, on fields whose errors are made by hand.

#[path = "common/score.rs"]
mod score;

/// Points every 5 px in an image of 1024 × 1024 pixels, displaced by the truth times `gain` plus an
/// offset.
fn points(field: &str, gain: impl Fn(f64) -> f64, offset: f64) -> Vec<([f64; 4], bool)> {
    let mut out = Vec::new();
    for y in (40..984).step_by(5) {
        for x in (40..984).step_by(5) {
            let (x, y) = (f64::from(x), f64::from(y));
            let t = score::truth(field, 1024, x, y).unwrap();
            out.push(([x, y, t.0 * gain(x) + offset, t.1 * gain(x) - offset], true));
        }
    }
    out
}

#[test]
fn bias_and_outliers() {
    let mut p = points("aff1", |_| 1.0, 0.01);
    p[7].0[2] += 2.0;
    p[9].0[3] = f64::NAN;
    p[11].1 = false;
    let s = score::score("aff1", 1024, &p).unwrap();
    assert_eq!((s.points, s.ok, s.outliers), (35721, 35719, 1));
    assert!((s.bias[0] - 0.01).abs() < 1e-12 && (s.bias[1] + 0.01).abs() < 1e-12);
    assert!(s.scatter[0] < 1e-12);
    // half of the points off by ± 0.02
    for (k, q) in p.iter_mut().enumerate() {
        q.0[2] += if k % 2 == 0 { 0.02 } else { -0.02 };
    }
    let s = score::score("aff1", 1024, &p).unwrap();
    assert!((s.scatter[0] - 0.02).abs() < 1e-6);
    assert!(score::score("unknown", 1024, &p).is_none());
}

#[test]
fn the_star_is_attenuated_where_it_is_made_so() {
    // amplitude 0.8 left of x = 400, where the period is 10 + 140 · 400 / 1023 = 64.7 px; the mean
    // over seven points falls below 0.9 within three points (2 px of period) of it
    let p = points("star", |x| if x < 400.0 { 0.8 } else { 1.0 }, 0.0);
    let period = score::star_period_at_tenth(1024, &p);
    assert!((period - 64.7).abs() < 2.1, "{period}");
    // nowhere attenuated: the shortest period looked at
    let period = score::star_period_at_tenth(1024, &points("star", |_| 1.0, 0.0));
    assert!((period - 20.3).abs() < 0.1, "{period}");
    assert!(score::star_period_at_tenth(1024, &[]).is_nan());
}
