//! The work on pixels and voxels, with the best instructions of the machine.

use super::{FLOOR, Method, Settings};
use crate::simd::{Kernel, LANES, run};
use fearless_simd::{Level, Simd};

/// Whether any number passes a test.
pub(super) fn any(values: &[f32], test: impl Fn(f32) -> bool) -> bool {
    // without a way out inside a part the test is done on many numbers at once
    values.chunks(1024).any(|part| part.iter().fold(false, |any, v| any | test(*v)))
}

/// Negative numbers become zero; returns the sum of squares and the largest.
pub(super) fn clip(image: &mut [f32]) -> (f64, f32) {
    struct Clip<'a>(&'a mut [f32]);
    impl Kernel for Clip<'_> {
        type Output = (f64, f32);

        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> Self::Output {
            let (mut squares, mut largest) = ([0f64; LANES], [0f32; LANES]);
            // packed images are made of whole lanes
            for part in self.0.as_chunks_mut::<LANES>().0 {
                for j in 0..LANES {
                    part[j] = part[j].max(0.0);
                    squares[j] += f64::from(part[j]) * f64::from(part[j]);
                    largest[j] = largest[j].max(part[j]);
                }
            }
            (squares.iter().sum(), largest.iter().copied().fold(0.0, f32::max))
        }
    }
    run(Level::new(), Clip(image))
}

/// What becomes of a row of estimates `values`, given the image f, the background b and the weights w;
/// returns Σ w (f − Hg − b)².
pub(super) fn pixels(
    settings: &Settings,
    floor: f32,
    values: &mut [f32],
    f: &[f32],
    b: Option<&[f32]>,
    w: Option<&[f32]>,
) -> f64 {
    let rl = settings.method == Method::Rl;
    run(Level::new(), Pixels { rl, variance: settings.read_variance, floor, values, f, b, w })
}

struct Pixels<'a> {
    rl: bool,
    variance: f32,
    floor: f32,
    values: &'a mut [f32],
    f: &'a [f32],
    b: Option<&'a [f32]>,
    w: Option<&'a [f32]>,
}

impl Kernel for Pixels<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> f64 {
        match (self.rl, self.b.is_none() && self.w.is_none()) {
            (true, true) => self.all::<true, true>(),
            (true, false) => self.all::<true, false>(),
            (false, true) => self.all::<false, true>(),
            (false, false) => self.all::<false, false>(),
        }
    }
}

impl Pixels<'_> {
    /// `PLAIN`: no background, no weights.
    #[inline(always)]
    fn all<const RL: bool, const PLAIN: bool>(self) -> f64 {
        let Self { variance: v, floor, values, f, b, w, .. } = self;
        let mut sum = [0f32; LANES];
        let mut total = 0.0;
        let parts = values.as_chunks_mut::<LANES>().0.iter_mut().zip(f.as_chunks::<LANES>().0);
        for (i, (values, f)) in parts.enumerate() {
            let (mut back, mut weight) = ([0f32; LANES], [1f32; LANES]);
            if !PLAIN {
                let of = |list: Option<&[f32]>, other| {
                    list.and_then(|l| l[i * LANES..].first_chunk()).copied().unwrap_or(other)
                };
                (back, weight) = (of(b, back), of(w, weight));
            }
            for j in 0..LANES {
                let d = f[j] - values[j] - back[j];
                sum[j] += weight[j] * d * d;
            }
            for j in 0..LANES {
                values[j] = if RL {
                    weight[j] * (f[j] + v) / (values[j] + back[j] + v).max(floor)
                } else {
                    weight[j] * values[j]
                };
            }
            if i % 64 == 63 {
                total += sum.iter().map(|s| f64::from(*s)).sum::<f64>();
                sum = [0.0; LANES];
            }
        }
        total + sum.iter().map(|s| f64::from(*s)).sum::<f64>()
    }
}

/// Updates a row of the volume; returns the squares of the change and of the new values.
pub(super) fn voxels(
    method: Method,
    values: &[f32],
    factors: &[f32],
    variation: Option<&[f32]>,
    x: &mut [f32],
) -> (f64, f64) {
    run(Level::new(), Voxels { rl: method == Method::Rl, values, factors, variation, x })
}

struct Voxels<'a> {
    rl: bool,
    values: &'a [f32],
    factors: &'a [f32],
    variation: Option<&'a [f32]>,
    x: &'a mut [f32],
}

impl Kernel for Voxels<'_> {
    type Output = (f64, f64);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> (f64, f64) {
        match (self.rl, self.variation.is_some()) {
            (true, false) => self.all::<true, false>(),
            (true, true) => self.all::<true, true>(),
            (false, false) => self.all::<false, false>(),
            (false, true) => self.all::<false, true>(),
        }
    }
}

impl Voxels<'_> {
    /// `TV`: with total variation.
    #[inline(always)]
    fn all<const RL: bool, const TV: bool>(self) -> (f64, f64) {
        let Self { values, factors, variation, x, .. } = self;
        let (mut change, mut size) = ([0f32; LANES], [0f32; LANES]);
        let (mut total, mut norm) = (0.0, 0.0);
        let parts = values.as_chunks::<LANES>().0.iter().zip(factors.as_chunks::<LANES>().0);
        for (i, ((values, factors), x)) in parts.zip(x.as_chunks_mut::<LANES>().0).enumerate() {
            let mut new = [0f32; LANES];
            for j in 0..LANES {
                new[j] = if RL {
                    x[j] * values[j].max(0.0) * factors[j]
                } else {
                    x[j] * factors[j] / values[j].max(FLOOR)
                };
            }
            if TV && let Some(variation) = variation.and_then(|v| v[i * LANES..].first_chunk::<LANES>()) {
                for j in 0..LANES {
                    new[j] *= variation[j];
                }
            }
            for j in 0..LANES {
                let d = new[j] - x[j];
                change[j] += d * d;
                size[j] += new[j] * new[j];
            }
            *x = new;
            if i % 64 == 63 {
                total += change.iter().map(|s| f64::from(*s)).sum::<f64>();
                norm += size.iter().map(|s| f64::from(*s)).sum::<f64>();
                (change, size) = ([0.0; LANES], [0.0; LANES]);
            }
        }
        let rest = |v: [f32; LANES]| v.iter().map(|s| f64::from(*s)).sum::<f64>();
        (total + rest(change), norm + rest(size))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(seed: f32) -> Vec<f32> {
        // more than 64 groups of lanes: the sums in single precision are emptied on the way
        (0..70 * LANES).map(|i| (i as f32 * seed).sin().abs() + 0.1).collect()
    }

    fn near(a: f64, b: f64) {
        assert!((a - b).abs() <= 2e-6 * b.abs(), "{a} {b}");
    }

    #[test]
    fn pixels_obey_their_formula() {
        let (f, b, w, before) = (numbers(0.7), numbers(1.3), numbers(2.1), numbers(0.3));
        for method in [Method::Rl, Method::Isra] {
            for (b, w) in [(None, None), (Some(&b), None), (None, Some(&w)), (Some(&b), Some(&w))] {
                let settings = Settings { read_variance: 0.5, ..Settings::new(method, 1) };
                let mut values = before.clone();
                let found = pixels(&settings, 0.9, &mut values, &f, b.map(|b| &b[..]), w.map(|w| &w[..]));
                let mut sum = 0.0;
                for i in 0..f.len() {
                    let (b, w) = (b.map_or(0.0, |b| b[i]), w.map_or(1.0, |w| w[i]));
                    sum += f64::from(w * (f[i] - before[i] - b).powi(2));
                    let expected = match method {
                        Method::Rl => w * (f[i] + 0.5) / (before[i] + b + 0.5).max(0.9),
                        Method::Isra => w * before[i],
                    };
                    near(values[i].into(), expected.into());
                }
                near(found, sum);
            }
        }
    }

    #[test]
    fn voxels_obey_their_formula() {
        let (back, factors, tv, before) = (numbers(0.9), numbers(1.1), numbers(1.7), numbers(0.4));
        for method in [Method::Rl, Method::Isra] {
            for tv in [None, Some(&tv)] {
                let mut x = before.clone();
                let found = voxels(method, &back, &factors, tv.map(|t| &t[..]), &mut x);
                let mut sums = (0.0, 0.0);
                for i in 0..x.len() {
                    let step = match method {
                        Method::Rl => back[i] * factors[i],
                        Method::Isra => factors[i] / back[i],
                    };
                    let expected = f64::from(before[i] * step) * f64::from(tv.map_or(1.0, |t| t[i]));
                    near(x[i].into(), expected);
                    sums.0 += f64::from(x[i] - before[i]).powi(2);
                    sums.1 += f64::from(x[i]).powi(2);
                }
                near(found.0, sums.0);
                near(found.1, sums.1);
            }
        }
    }

    #[test]
    fn images_are_clipped() {
        let mut image: Vec<f32> = numbers(0.7).iter().map(|v| v - 0.6).collect();
        let expected: Vec<f32> = image.iter().map(|v| v.max(0.0)).collect();
        let (squares, largest) = clip(&mut image);
        assert_eq!(image, expected);
        assert_eq!(largest, expected.iter().copied().fold(0.0, f32::max));
        near(squares, expected.iter().map(|v| f64::from(*v).powi(2)).sum());
    }

    #[test]
    fn one_number_is_found() {
        for at in [0, 1023, 1024, 2999] {
            let mut values = vec![1f32; 3000];
            assert!(!any(&values, |v| v < 0.0));
            values[at] = -1.0;
            assert!(any(&values, |v| v < 0.0));
        }
    }
}
