//! The deformed image sampled along one row of pixels at a displacement field that changes slowly.

use crate::plane::Plane;
use crate::sampler::{V, convolve, sample_lanes, shifted, weights};
use crate::subset::LANES;
use fearless_simd::prelude::*;

/// Interpolates the pixels (x + k, y), displaced by (u[k], v[k]), into `out`, whose length is a
/// multiple of eight. Loads are contiguous wherever the integer part of the displacement takes at
/// most two values over eight pixels; elsewhere each pixel is read by itself. What lies outside the
/// padded plane is arbitrary but finite.
#[inline(always)]
pub(crate) fn warp_row<S: Simd, const N: usize, const N1: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    u: &[f32],
    v: &[f32],
    out: &mut [f32],
) {
    let zero = V::splat(s, 0.0);
    let one = V::splat(s, 1.0);
    let centre = V::splat(s, 0.5);
    let half = (N / 2 - 1) as i32;
    let groups = out.chunks_exact_mut(LANES).zip(u.chunks_exact(LANES)).zip(v.chunks_exact(LANES));
    let mut x = x;
    for ((o, u), v) in groups {
        let (du, dv) = (V::from_slice(s, u), V::from_slice(s, v));
        let (ku, kv) = (u[0].floor(), v[0].floor());
        let (tx, ty) = (du - V::splat(s, ku), dv - V::splat(s, kv));
        let inside = (tx * (one - tx)).min(ty * (one - ty)).simd_ge(zero);
        let g = if inside.all_true() {
            let origin = plane.signed_index(x + ku as i32 - half, y + kv as i32 - half);
            let (wx, wy) = weights::<S, N>(s, tx - centre, ty - centre);
            convolve::<S, N, N>(s, plane, origin, &wx, &wy).unwrap_or(zero)
        } else {
            carried::<S, N, N1>(s, plane, x, y, du, dv)
        };
        g.store_slice(o);
        x += LANES as i32;
    }
}

/// As [`warp_row`] where the integer part changes within the eight pixels.
#[inline(always)]
fn carried<S: Simd, const N: usize, const N1: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    du: V<S>,
    dv: V<S>,
) -> V<S> {
    let (fx, fy) = (du.floor(), dv.floor());
    let (kx, ky) = (fx.reduce_min(), fy.reduce_min());
    let (ex, ey) = (fx - V::splat(s, kx), fy - V::splat(s, ky));
    let one = V::splat(s, 1.0);
    let gentle = ex.max(ey).simd_le(one).all_true();
    if !gentle {
        return sample_lanes::<S, N>(s, plane, x, y, 1, 0, du, dv);
    }
    let half = (N / 2 - 1) as i32;
    let centre = V::splat(s, 0.5);
    let (wx, wy) = weights::<S, N>(s, du - fx - centre, dv - fy - centre);
    let (wx, wy) = (shifted::<S, N>(s, wx, ex.simd_ge(one)), shifted::<S, N>(s, wy, ey.simd_ge(one)));
    let origin = plane.signed_index(x + kx as i32 - half, y + ky as i32 - half);
    convolve::<S, N1, N1>(s, plane, origin, &wx, &wy).unwrap_or(V::splat(s, 0.0))
}
