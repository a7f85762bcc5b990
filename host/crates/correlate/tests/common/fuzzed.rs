//! A correlation made of arbitrary bytes: sizes, pixels, settings, region, mask, guess and solver.
//! The fuzz target and the property test run the same function.
#![allow(dead_code)] // each user takes its own part

use daic_correlate::*;

/// Bytes as a source of choices; zeros when they have run out.
struct Bytes<'a>(std::slice::Iter<'a, u8>);

impl Bytes<'_> {
    fn byte(&mut self) -> u8 {
        self.0.next().copied().unwrap_or(0)
    }

    fn below(&mut self, n: usize) -> usize {
        let two = usize::from(self.byte()) | usize::from(self.byte()) << 8;
        two % n
    }

    fn chance(&mut self, one_in: u8) -> bool {
        self.byte() % one_in == one_in - 1
    }

    /// Mostly within ± `reach`, sometimes no number that can be used.
    fn real(&mut self, reach: f64) -> f64 {
        let fraction = f64::from(i16::from_le_bytes([self.byte(), self.byte()])) / 32768.0;
        match self.byte() {
            255 => f64::NAN,
            254 => f64::INFINITY,
            253 => -1e300,
            252 => fraction * 1e6,
            _ => fraction * reach,
        }
    }
}

/// Grey level at a pixel of a texture that needs no table.
fn texture(kind: usize, seed: f64, x: f64, y: f64) -> f64 {
    match kind {
        // fine, no symmetry
        0..=3 => {
            let s = 0.02 * seed;
            let waves =
                ((0.61 + s) * x + 0.2 * y).sin() + (0.47 * y - 0.33 * x).cos() + (0.9 * x + 0.7 * y).sin();
            120.0 + 35.0 * waves + 10.0 * (0.004 * x * y + 0.3 * x).sin()
        }
        // varies along x only
        4 => 100.0 + 50.0 * (0.7 * x).sin(),
        // periodic
        5 => 128.0 + 60.0 * (0.78 * x).sin() * (0.78 * y).sin(),
        // an edge
        6 => {
            if x > 20.0 + 0.3 * y {
                230.0
            } else {
                10.0
            }
        }
        _ => 90.0,
    }
}

fn grey(
    b: &mut Bytes<'_>,
    width: usize,
    height: usize,
    (u, v): (f64, f64),
    kind: usize,
    seed: f64,
) -> Vec<f32> {
    let scale = match b.byte() {
        255 => 1e36,
        254 => 1e18,
        253 => 1e-30,
        252 => 1e4,
        _ => 1.0,
    };
    let offset = if b.chance(16) { 1e7 } else { 0.0 };
    let mut grey: Vec<f32> = (0..width * height)
        .map(|k| {
            let (x, y) = ((k % width) as f64 - u, (k / width) as f64 - v);
            ((texture(kind, seed, x, y) + offset) * scale) as f32
        })
        .collect();
    // what the bytes themselves say goes on top: a line of them, a blot
    if b.chance(4) {
        let at = b.below(grey.len());
        for g in grey.iter_mut().skip(at).take(64) {
            *g = f32::from(b.byte());
        }
    }
    if b.chance(8) {
        let (x0, y0, w) = (b.below(width), b.below(height), b.below(40));
        let level = f32::from(b.byte());
        for y in y0..(y0 + w).min(height) {
            for x in x0..(x0 + w).min(width) {
                grey[y * width + x] = level;
            }
        }
    }
    if b.chance(64) {
        let at = b.below(grey.len());
        grey[at] = if b.chance(2) { f32::NAN } else { f32::MAX };
    }
    grey
}

fn settings(b: &mut Bytes<'_>) -> Settings {
    let mut s = Settings {
        subset: [5, 7, 9, 11, 13, 17, 21, 25, 33, 41][b.below(10)],
        shape: [Shape::Translation, Shape::Affine, Shape::Quadratic][b.below(3)],
        interpolation: [Interpolation::Quintic, Interpolation::Cubic, Interpolation::Septic][b.below(3)],
        criterion: [Criterion::Znssd, Criterion::Zssd][b.below(2)],
        solver: [SolverChoice::Auto, SolverChoice::Dense, SolverChoice::Exact][b.below(3)],
        ..Settings::default()
    };
    if b.chance(16) {
        s.subset = b.below(1100);
    }
    if b.chance(4) {
        s.tolerance = b.real(1.0).abs();
        s.max_iterations = b.below(200) as u32;
    }
    if b.chance(4) {
        s.min_zncc = b.real(1.2);
        s.significance = b.real(20.0);
    }
    if b.chance(4) {
        s.max_log_stretch = b.real(2.1);
        s.consistency = b.real(10.0);
    }
    if b.chance(4) {
        s.noise = Some(b.real(20.0));
    }
    s
}

/// Runs one case. What is wrong in the input must come back as an error or a status.
///
/// # Panics
/// Where a point claims to be measured but is not a usable number, or the answer does not have the
/// shape that was asked for.
pub fn drive(bytes: &[u8]) -> Option<(usize, usize)> {
    let mut b = Bytes(bytes.iter());
    let (width, height) = (1 + b.below(110), 1 + b.below(110));
    let (kind, seed) = (b.below(8), f64::from(b.byte()));
    let settings = settings(&mut b);
    let shift = (b.real(6.0).clamp(-1e3, 1e3), b.real(6.0).clamp(-1e3, 1e3));
    let shift = if shift.0.is_nan() || shift.1.is_nan() { (0.3, -0.7) } else { shift };
    let other = if b.chance(8) { 7 - kind } else { kind };
    let first = grey(&mut b, width, height, (0.0, 0.0), kind, seed);
    let second = grey(&mut b, width, height, shift, other, seed);
    let a = Image::from_f32(width, height, first).ok()?;
    // sometimes of another size
    let odd = b.chance(32);
    let (w2, h2) = if odd { (height, width) } else { (width, height) };
    let second = Image::from_f32(w2, h2, second).ok()?;
    let mask = b.chance(3).then(|| {
        let (kind, cx, cy) = (b.below(4), b.below(width), b.below(height));
        let reach = 10 + b.below(60);
        let inside = (0..width * height)
            .map(|k| {
                let (dx, dy) = ((k % width).abs_diff(cx), (k / width).abs_diff(cy));
                match kind {
                    0 => dx * dx + dy * dy <= reach * reach,
                    1 => dx * dx + dy * dy >= (reach / 8) * (reach / 8),
                    2 => dx > 1,
                    _ => false,
                }
            })
            .collect();
        Mask::new(width, height, inside)
    });
    let mask = match mask {
        Some(m) => Some(m.ok()?),
        None => None,
    };
    let rectangle = b.chance(3).then(|| Rectangle {
        x: b.below(width + 4),
        y: b.below(height + 4),
        width: b.below(width + 4),
        height: if b.chance(32) { usize::MAX } else { b.below(height + 4) },
    });
    let points = if b.chance(4) {
        let n = b.below(60);
        Points::scattered((0..n).map(|_| [b.real(130.0), b.real(130.0)]).collect())
    } else {
        let step = b.below(12);
        let roi = Roi { rectangle, mask: mask.as_ref() };
        // a subset of every setting is asked of the grid, valid or not
        Points::grid(width, height, settings.subset, step, &roi)
    };
    let points = points.ok()?;
    let list: Vec<Option<[f64; 2]>>;
    let guess = match b.below(4) {
        0 | 1 => Guess::Fft,
        2 => {
            let (u, v) = (b.real(30.0), b.real(30.0));
            // a search over more shifts than this only takes longer
            let wide =
                |a: f64| (a, a + f64::from(a.abs() < 1e3) * 20.0 - f64::from(settings.noise.is_some()));
            Guess::Search { u: wide(u), v: wide(v) }
        }
        _ => {
            let missing = usize::from(b.chance(16));
            list = (0..points.len().saturating_sub(missing))
                .map(|_| (!b.chance(8)).then(|| [b.real(8.0), b.real(8.0)]))
                .collect();
            Guess::Given(&list)
        }
    };
    let (reference, target) = (Reference::new(a), Target::new(second, settings.interpolation));
    let c = correlate(&reference, &target, &points, &guess, &settings, &()).ok()?;
    assert_eq!(c.points.len(), points.len(), "one answer per point");
    for p in c.points.iter().filter(|p| p.status.is_ok()) {
        assert!(p.u.is_finite() && p.v.is_finite(), "{p:?}");
        assert!(p.sigma_u.is_finite() && p.sigma_v.is_finite(), "{p:?}");
        assert!(p.sigma_u >= 0.0 && p.sigma_v >= 0.0, "{p:?}");
        assert!(p.zncc.is_finite() && p.zncc.abs() <= 1.0 + 1e-4, "{p:?}");
        assert!(p.shape.u.iter().chain(&p.shape.v).all(|s| s.is_finite()), "{p:?}");
        // the subset lies in both images, up to its overhang and deformation
        let (w, h) = (width as f64, height as f64);
        assert!((-1.0..=w).contains(&(p.x + p.u)) && (-1.0..=h).contains(&(p.y + p.v)), "{p:?}");
    }
    Some((c.points.len(), c.converged()))
}
