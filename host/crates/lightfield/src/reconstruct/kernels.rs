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
            let (parts, rest) = self.0.as_chunks_mut::<LANES>();
            for part in parts {
                for j in 0..LANES {
                    part[j] = part[j].max(0.0);
                    squares[j] += f64::from(part[j]) * f64::from(part[j]);
                    largest[j] = largest[j].max(part[j]);
                }
            }
            for (j, v) in rest.iter_mut().enumerate() {
                *v = v.max(0.0);
                squares[j] += f64::from(*v) * f64::from(*v);
                largest[j] = largest[j].max(*v);
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
    [f, b, w]: [Option<&[f32]>; 3],
) -> f64 {
    let rl = settings.method == Method::Rl;
    let f = f.unwrap_or_default();
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
