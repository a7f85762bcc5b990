//! Which vector instructions the kernels are compiled for.

use fearless_simd::{Level, Simd};

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
