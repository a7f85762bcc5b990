//! Hashing of integers into uniform numbers: the source of everything random in the simulated rig.
//!
//! Counter-based, so that any pixel or cell can be drawn by itself, in any order, on any thread.

/// The finaliser of SplitMix64: a bijection of 64-bit words whose outputs pass for independent.
#[inline]
pub fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Uniform in (0, 1), never 0 and never 1.
#[inline]
pub fn unit(word: u64) -> f64 {
    ((word >> 11) as f64 + 0.5) * (1.0 / 9_007_199_254_740_992.0)
}
