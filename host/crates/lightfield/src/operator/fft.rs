//! Fourier transforms over the lenslet grid, vectorised over the channels of a cell.
//!
//! Stockham's autosort form with radices 2, 3, 4, 5 and 8; no bit reversal, two buffers. The first stage reads
//! its numbers where they lie.

use crate::simd::{LANES, V};
use fearless_simd::prelude::*;
use prefetch_index::prefetch_index;

/// Length and twiddle factors of a transform.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) n: usize,
    stages: Vec<Stage>,
}

#[derive(Debug, Clone)]
struct Stage {
    radix: usize,
    /// Butterflies of the stage.
    m: usize,
    /// Distance of what belongs together.
    stride: usize,
    /// (cos, sin) of −2π p k/(radix m) for p = 0…m−1, k = 1…radix−1.
    twiddles: Vec<[f32; 2]>,
}

/// The smallest length ≥ n that is made of the radices.
pub(crate) fn good_length(n: usize) -> usize {
    let smooth = |mut k: usize| {
        for f in [2, 3, 5] {
            while k.is_multiple_of(f) {
                k /= f;
            }
        }
        k == 1
    };
    (n.max(1)..).find(|&k| smooth(k)).unwrap_or(n)
}

#[derive(Clone, Copy)]
pub(crate) struct C<S: Simd> {
    pub(crate) re: V<S>,
    pub(crate) im: V<S>,
}

impl<S: Simd> C<S> {
    #[inline(always)]
    pub(crate) fn zero(s: S) -> Self {
        Self { re: V::splat(s, 0.0), im: V::splat(s, 0.0) }
    }

    #[inline(always)]
    fn plus(self, o: Self) -> Self {
        Self { re: self.re + o.re, im: self.im + o.im }
    }

    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        Self { re: self.re - o.re, im: self.im - o.im }
    }

    /// Times −i, or +i for the inverse.
    #[inline(always)]
    fn turn<const INVERSE: bool>(self) -> Self {
        if INVERSE { Self { re: -self.im, im: self.re } } else { Self { re: self.im, im: -self.re } }
    }

    #[inline(always)]
    fn scaled(self, f: V<S>) -> Self {
        Self { re: self.re * f, im: self.im * f }
    }

    /// self + f·o.
    #[inline(always)]
    fn plus_scaled(self, f: V<S>, o: Self) -> Self {
        Self { re: f.mul_add(o.re, self.re), im: f.mul_add(o.im, self.im) }
    }

    #[inline(always)]
    fn times<const INVERSE: bool>(self, s: S, w: [f32; 2]) -> Self {
        let (c, d) = (V::splat(s, w[0]), V::splat(s, if INVERSE { -w[1] } else { w[1] }));
        Self { re: self.re * c - self.im * d, im: self.re * d + self.im * c }
    }
}

#[inline(always)]
fn dft2<S: Simd>(x: [C<S>; 2]) -> [C<S>; 2] {
    [x[0].plus(x[1]), x[0].minus(x[1])]
}

#[inline(always)]
fn dft3<S: Simd, const INVERSE: bool>(s: S, x: [C<S>; 3]) -> [C<S>; 3] {
    let sum = x[1].plus(x[2]);
    let difference = x[1].minus(x[2]).scaled(V::splat(s, 0.866_025_4)).turn::<INVERSE>();
    let middle = x[0].plus_scaled(V::splat(s, -0.5), sum);
    [x[0].plus(sum), middle.plus(difference), middle.minus(difference)]
}

#[inline(always)]
fn dft4<S: Simd, const INVERSE: bool>(x: [C<S>; 4]) -> [C<S>; 4] {
    let (a, b) = (x[0].plus(x[2]), x[0].minus(x[2]));
    let (c, d) = (x[1].plus(x[3]), x[1].minus(x[3]).turn::<INVERSE>());
    [a.plus(c), b.plus(d), a.minus(c), b.minus(d)]
}

#[inline(always)]
fn dft5<S: Simd, const INVERSE: bool>(s: S, x: [C<S>; 5]) -> [C<S>; 5] {
    let (c1, c2) = (V::splat(s, 0.309_017), V::splat(s, -0.809_017));
    let (s1, s2) = (V::splat(s, 0.951_056_5), V::splat(s, 0.587_785_25));
    let (a, b) = (x[1].plus(x[4]), x[2].plus(x[3]));
    let (d, e) = (x[1].minus(x[4]), x[2].minus(x[3]));
    let p = x[0].plus_scaled(c1, a).plus_scaled(c2, b);
    let q = x[0].plus_scaled(c2, a).plus_scaled(c1, b);
    let u = d.scaled(s1).plus_scaled(s2, e).turn::<INVERSE>();
    let v = d.scaled(s2).plus_scaled(-s1, e).turn::<INVERSE>();
    [x[0].plus(a).plus(b), p.plus(u), q.plus(v), q.minus(v), p.minus(u)]
}

/// An offset that stands for zero.
pub(crate) const NOTHING: usize = usize::MAX;

/// Where the complex numbers of a transform lie.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Source<'a> {
    pub(crate) values: &'a [f32],
    /// Of the real part of each number, or [`NOTHING`].
    pub(crate) offsets: &'a [usize],
    /// From the real to the imaginary part.
    pub(crate) imaginary: usize,
}

impl Source<'_> {
    #[inline(always)]
    fn get<S: Simd>(&self, s: S, i: usize, channel: usize) -> C<S> {
        let at = self.offsets[i];
        if at == NOTHING {
            return C::zero(s);
        }
        let at = at + channel;
        // the next line of the cache, for the groups of lanes to come
        prefetch_index(self.values, at + 2 * LANES);
        prefetch_index(self.values, at + self.imaginary + 2 * LANES);
        let re = V::from_slice(s, &self.values[at..at + LANES]);
        let at = at + self.imaginary;
        C { re, im: V::from_slice(s, &self.values[at..at + LANES]) }
    }
}

#[inline(always)]
fn dft8<S: Simd, const INVERSE: bool>(s: S, x: [C<S>; 8]) -> [C<S>; 8] {
    let even = dft4::<S, INVERSE>([x[0], x[2], x[4], x[6]]);
    let odd = dft4::<S, INVERSE>([x[1], x[3], x[5], x[7]]);
    let half = V::splat(s, std::f32::consts::FRAC_1_SQRT_2);
    // odd[1] (1 − i)/√2, odd[2] (−i), odd[3] (−1 − i)/√2, conjugated for the inverse
    let (a, b) = (odd[1].turn::<INVERSE>(), odd[3].turn::<INVERSE>());
    let odd = [odd[0], odd[1].plus(a).scaled(half), odd[2].turn::<INVERSE>(), b.minus(odd[3]).scaled(half)];
    [
        even[0].plus(odd[0]),
        even[1].plus(odd[1]),
        even[2].plus(odd[2]),
        even[3].plus(odd[3]),
        even[0].minus(odd[0]),
        even[1].minus(odd[1]),
        even[2].minus(odd[2]),
        even[3].minus(odd[3]),
    ]
}

/// Complex numbers of one group of lanes.
pub(crate) const PART: usize = 2 * LANES;

#[inline(always)]
fn get<S: Simd>(s: S, part: &[f32; PART]) -> C<S> {
    C { re: V::from_slice(s, &part[..LANES]), im: V::from_slice(s, &part[LANES..]) }
}

#[inline(always)]
fn put<S: Simd>(part: &mut [f32; PART], c: C<S>) {
    c.re.store_slice(&mut part[..LANES]);
    c.im.store_slice(&mut part[LANES..]);
}

/// Radices of a length, in the order of the stages.
fn radices(mut n: usize) -> Vec<usize> {
    let mut out = Vec::new();
    for f in [5, 3] {
        while n.is_multiple_of(f) {
            out.push(f);
            n /= f;
        }
    }
    while n > 1 {
        let r = match n {
            8 | 32.. => 8,
            4.. => 4,
            _ => 2,
        };
        out.push(r);
        n /= r;
    }
    out
}

impl Plan {
    /// `n` must be a [`good_length`].
    pub(crate) fn new(n: usize) -> Self {
        let (mut rest, mut stride, mut stages) = (n, 1, Vec::new());
        for radix in radices(n) {
            let m = rest / radix;
            let twiddles = (0..m)
                .flat_map(|p| (1..radix).map(move |k| (p * k) as f64 / (radix * m) as f64))
                .map(|turn| {
                    let (sin, cos) = (-std::f64::consts::TAU * turn).sin_cos();
                    [cos as f32, sin as f32]
                })
                .collect();
            stages.push(Stage { radix, m, stride, twiddles });
            rest = m;
            stride *= radix;
        }
        Self { n, stages }
    }

    /// Numbers of the two buffers together.
    pub(crate) fn scratch(&self) -> usize {
        2 * self.n * PART
    }

    /// Transforms the lanes of `source` from `channel` on; the result lies in the first half of `scratch`,
    /// complex number by complex number ([`result`]). No scaling.
    ///
    /// A function of its own, as every caller's copy would take long to compile.
    #[inline(never)]
    pub(crate) fn run<S: Simd, const INVERSE: bool>(
        &self,
        s: S,
        scratch: &mut [f32],
        source: Source<'_>,
        channel: usize,
    ) {
        s.vectorize(
            #[inline(always)]
            || {
                let parts = scratch.as_chunks_mut::<PART>().0;
                let (result, other) = parts[..2 * self.n].split_at_mut(self.n);
                let Some((first, rest)) = self.stages.split_first() else {
                    put(&mut result[0], source.get(s, 0, channel));
                    return;
                };
                // the last stage writes into `result`
                let (mut from, mut to) =
                    if rest.len().is_multiple_of(2) { (other, result) } else { (result, other) };
                first.run::<S, INVERSE>(
                    s,
                    #[inline(always)]
                    |i| source.get(s, i, channel),
                    to,
                );
                for stage in rest {
                    (from, to) = (to, from);
                    stage.run::<S, INVERSE>(
                        s,
                        #[inline(always)]
                        |i| get(s, &from[i]),
                        to,
                    );
                }
            },
        );
    }
}

/// Complex number `i` of a result of [`Plan::run`].
#[inline(always)]
pub(crate) fn result<S: Simd>(s: S, scratch: &[f32], i: usize) -> C<S> {
    get(s, &scratch.as_chunks::<PART>().0[i])
}

impl Stage {
    #[inline(always)]
    fn run<S: Simd, const INVERSE: bool>(&self, s: S, from: impl Fn(usize) -> C<S>, to: &mut [[f32; PART]]) {
        match self.radix {
            2 => self.pass::<S, 2, INVERSE>(
                s,
                from,
                to,
                #[inline(always)]
                |x| dft2(x),
            ),
            3 => self.pass::<S, 3, INVERSE>(
                s,
                from,
                to,
                #[inline(always)]
                |x| dft3::<S, INVERSE>(s, x),
            ),
            4 => self.pass::<S, 4, INVERSE>(
                s,
                from,
                to,
                #[inline(always)]
                |x| dft4::<S, INVERSE>(x),
            ),
            5 => self.pass::<S, 5, INVERSE>(
                s,
                from,
                to,
                #[inline(always)]
                |x| dft5::<S, INVERSE>(s, x),
            ),
            _ => self.pass::<S, 8, INVERSE>(
                s,
                from,
                to,
                #[inline(always)]
                |x| dft8::<S, INVERSE>(s, x),
            ),
        }
    }

    #[inline(always)]
    fn pass<S: Simd, const R: usize, const INVERSE: bool>(
        &self,
        s: S,
        from: impl Fn(usize) -> C<S>,
        to: &mut [[f32; PART]],
        dft: impl Fn([C<S>; R]) -> [C<S>; R],
    ) {
        for p in 0..self.m {
            for q in 0..self.stride {
                let mut x = [C::zero(s); R];
                for k in 0..R {
                    x[k] = from(q + self.stride * (p + self.m * k));
                }
                let y = dft(x);
                put(&mut to[q + self.stride * R * p], y[0]);
                for k in 1..R {
                    let value = if p == 0 {
                        y[k]
                    } else {
                        y[k].times::<INVERSE>(s, self.twiddles[p * (R - 1) + k - 1])
                    };
                    put(&mut to[q + self.stride * (R * p + k)], value);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Kernel, levels, run};

    struct Transform<'a> {
        plan: &'a Plan,
        source: Source<'a>,
        inverse: bool,
    }

    impl Kernel for Transform<'_> {
        type Output = Vec<[[f32; LANES]; 2]>;

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Self::Output {
            let mut scratch = vec![0f32; self.plan.scratch()];
            if self.inverse {
                self.plan.run::<S, true>(s, &mut scratch, self.source, LANES);
            } else {
                self.plan.run::<S, false>(s, &mut scratch, self.source, LANES);
            }
            (0..self.plan.n)
                .map(|i| {
                    let mut out = [[0f32; LANES]; 2];
                    let c = result(s, &scratch, i);
                    c.re.store_slice(&mut out[0]);
                    c.im.store_slice(&mut out[1]);
                    out
                })
                .collect()
        }
    }

    /// Every length up to 200, some numbers missing, against the sum itself in double precision.
    #[test]
    fn transforms_are_the_sums() {
        let mut worst = 0.0f64;
        for n in (1..=200).filter(|&n| good_length(n) == n) {
            // two groups of lanes a number, of which the second is transformed
            let values: Vec<f32> = (0..n * 4 * LANES).map(|i| (i as f32 * 1.7).sin()).collect();
            let mut offsets: Vec<usize> = (0..n).map(|i| i * 4 * LANES).collect();
            for i in (3..n).step_by(7) {
                offsets[i] = NOTHING;
            }
            let source = Source { values: &values, offsets: &offsets, imaginary: 2 * LANES };
            for (inverse, level) in
                [false, true].into_iter().flat_map(|i| levels().into_iter().map(move |l| (i, l)))
            {
                let found = run(level, Transform { plan: &Plan::new(n), source, inverse });
                for (k, found) in found.iter().enumerate() {
                    for lane in 0..LANES {
                        let (mut re, mut im) = (0.0, 0.0);
                        for (i, at) in offsets.iter().enumerate().filter(|(_, at)| **at != NOTHING) {
                            let turn = (i * k % n) as f64 / n as f64 * std::f64::consts::TAU;
                            let (sin, cos) = if inverse { turn } else { -turn }.sin_cos();
                            let a = f64::from(values[at + LANES + lane]);
                            let b = f64::from(values[at + 3 * LANES + lane]);
                            re += a * cos - b * sin;
                            im += a * sin + b * cos;
                        }
                        let off = (f64::from(found[0][lane]) - re).hypot(f64::from(found[1][lane]) - im);
                        let off = off / (n as f64).sqrt();
                        // 1.4e-6 (AVX2) is the worst of 49 000 numbers
                        assert!(off < 1.6e-6, "{off:e} at {k} of {n}, {level:?}");
                        worst = worst.max(off);
                    }
                }
            }
        }
        println!("largest error over the root of the length {worst:.1e}");
    }
}
