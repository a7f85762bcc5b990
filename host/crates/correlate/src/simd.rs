//! Which vector instructions the kernels are compiled for.

/// Runs `op` with the SIMD token of the machine. On x86 every kernel exists twice: for AVX2 with FMA,
/// and for what every x86-64 has. AVX-512 machines use the former: eight lanes fit the width of usual
/// subsets, and the sums are the same on all of them.
macro_rules! dispatch {
    ($level:expr, $simd:ident => $op:expr) => {{
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        {
            let level: fearless_simd::Level = $level;
            if let Some($simd) = level.as_avx2() {
                $op
            } else if let Some($simd) = level.as_sse2() {
                $op
            } else {
                unreachable!("every x86 level that the library knows includes SSE2")
            }
        }
        #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
        {
            fearless_simd::dispatch!($level, $simd => $op)
        }
    }};
}
pub(crate) use dispatch;
