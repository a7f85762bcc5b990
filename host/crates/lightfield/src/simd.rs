//! Which vector instructions the kernels are compiled for.

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
use fearless_simd::Avx2;
use fearless_simd::{Level, Simd, SimdBase};

/// Lanes of the vectors used: 8 numbers of 32 bits.
pub(crate) const LANES: usize = 8;
/// The vector.
pub(crate) type V<S> = fearless_simd::f32x8<S>;

/// Work that is compiled for several instruction sets.
pub(crate) trait Kernel {
    /// What it gives.
    type Output;
    /// Does it; must be `#[inline(always)]`.
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

/// Runs a kernel with the best instructions of the machine. On x86 there are two forms, AVX2 with FMA and
/// SSE2; machines with AVX-512 use the former, so that results are the same on all of them.
#[inline]
pub(crate) fn run<K: Kernel>(level: Level, kernel: K) -> K::Output {
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    {
        if let Some(s) = level.as_avx2() {
            s.vectorize(
                #[inline(always)]
                || kernel.run(s),
            )
        } else if let Some(s) = level.as_sse2() {
            s.vectorize(
                #[inline(always)]
                || kernel.run(s),
            )
        } else {
            unreachable!("every x86 level that the library knows includes SSE2")
        }
    }
    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    {
        fearless_simd::dispatch!(level, s => kernel.run(s))
    }
}

/// The lanes in reverse order.
#[inline(always)]
pub(crate) fn reversed<S: Simd>(s: S, v: V<S>) -> V<S> {
    // known when a kernel is compiled
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    if let Some(avx2) = s.level().as_avx2() {
        let lanes: [f32; LANES] = v.into();
        let lanes: [f32; LANES] = permuted(avx2, V::from_slice(avx2, &lanes)).into();
        return V::from_slice(s, &lanes);
    }
    s.reverse_f32x8(v)
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
fearless_simd::kernel! {
    fn permuted(s: Avx2, v: V<Avx2>) -> V<Avx2> {
        use fearless_simd::SimdFrom;
        #[cfg(target_arch = "x86")]
        use std::arch::x86::{_mm256_permutevar8x32_ps, _mm256_setr_epi32};
        #[cfg(target_arch = "x86_64")]
        use std::arch::x86_64::{_mm256_permutevar8x32_ps, _mm256_setr_epi32};
        V::simd_from(s, _mm256_permutevar8x32_ps(v.into(), _mm256_setr_epi32(7, 6, 5, 4, 3, 2, 1, 0)))
    }
}

/// Rows of eight vectors as columns.
#[inline(always)]
pub(crate) fn transposed<S: Simd>(s: S, mut rows: [V<S>; LANES]) -> [V<S>; LANES] {
    // three perfect shuffles exchange the three bits of the vector's number with those of the lane's
    for _ in 0..3 {
        let from = rows;
        for i in 0..LANES / 2 {
            (rows[2 * i], rows[2 * i + 1]) = s.interleave_f32x8(from[i], from[i + LANES / 2]);
        }
    }
    rows
}

/// Eight numbers of half precision. Numbers below the smallest normal one must have been made zero.
#[inline(always)]
pub(crate) fn widen<S: Simd>(s: S, halves: [u16; LANES]) -> V<S> {
    // known when a kernel is compiled
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    if let Some(avx2) = s.level().as_avx2() {
        let wide: [f32; LANES] = f16c(avx2, &halves).into();
        return V::from_slice(s, &wide);
    }
    // exponents are re-biased by the multiplication: 2^(127−15)
    let rebias = f32::from_bits((127 + 112) << 23);
    let wide = halves.map(|h| {
        let bits = u32::from(h);
        let magnitude = f32::from_bits((bits & 0x7fff) << 13) * rebias;
        f32::from_bits(magnitude.to_bits() | ((bits & 0x8000) << 16))
    });
    V::from_slice(s, &wide)
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
fearless_simd::kernel! {
    fn f16c(s: Avx2, halves: &[u16; LANES]) -> V<Avx2> {
        use fearless_simd::{SimdBase, SimdFrom, u16x8};
        #[cfg(target_arch = "x86")]
        use std::arch::x86::{__m128i, _mm256_cvtph_ps};
        #[cfg(target_arch = "x86_64")]
        use std::arch::x86_64::{__m128i, _mm256_cvtph_ps};
        let packed: __m128i = u16x8::from_slice(s, halves).into();
        V::simd_from(s, _mm256_cvtph_ps(packed))
    }
}

/// The instruction sets that tests run with: the machine's best, and what every machine of its kind has.
#[cfg(test)]
pub(crate) fn levels() -> Vec<Level> {
    let best = Level::new();
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    let least = best.as_sse2().map(Level::Sse2);
    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    let least = None;
    [Some(best), least].into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Everything here with one instruction set.
    struct All;

    impl Kernel for All {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            let lanes: [f32; LANES] = std::array::from_fn(|i| i as f32);
            let mut back = [0f32; LANES];
            reversed(s, V::from_slice(s, &lanes)).store_slice(&mut back);
            assert_eq!(back, [7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0, 0.0]);

            let rows = std::array::from_fn(|r| {
                let row: [f32; LANES] = std::array::from_fn(|c| (10 * r + c) as f32);
                V::from_slice(s, &row)
            });
            for (c, column) in transposed(s, rows).iter().enumerate() {
                column.store_slice(&mut back);
                assert_eq!(back, std::array::from_fn(|r| (10 * r + c) as f32));
            }

            for first in (0..=u16::MAX).step_by(LANES) {
                let halves: [u16; LANES] = std::array::from_fn(|i| first + i as u16);
                widen(s, halves).store_slice(&mut back);
                for (h, found) in halves.iter().zip(back) {
                    let number = half::f16::from_bits(*h);
                    // what is stored is zero, or normal and finite
                    if number.is_normal() || h & 0x7fff == 0 {
                        assert_eq!(found.to_bits(), number.to_f32().to_bits(), "{h:#06x}");
                    }
                }
            }
        }
    }

    #[test]
    fn lanes_are_where_they_belong() {
        levels().into_iter().for_each(|level| run(level, All));
    }
}
