//! The deformed image sampled along one row of pixels at a displacement field that changes slowly.

use crate::plane::Plane;
use crate::sampler::{V, convolve, sample_lanes, shifted, weights};
use crate::subset::LANES;
use fearless_simd::{prelude::*, u8x32};
use fearless_simd_macros::simd;

/// How eight pixels in a row lie between the nodes, by the phase of the first one.
pub(crate) struct Spread {
    step: usize,
    lead: usize,
    /// Node of each pixel counted from the first one's, as byte indices into a vector; and the pixel's
    /// distance from its node.
    lanes: Vec<([u8; 4 * LANES], [f32; LANES])>,
}

impl Spread {
    /// Nodes every `step` pixels, the first `lead` pixels before the row.
    pub(crate) fn new(step: usize, lead: usize) -> Self {
        let lanes = (0..step)
            .map(|t| {
                let index = std::array::from_fn(|b| ((t + b / 4) / step * 4 + b % 4) as u8);
                (index, std::array::from_fn(|l| ((t + l) % step) as f32))
            })
            .collect();
        Self { step, lead, lanes }
    }
}

/// A displacement field along a row: values at the nodes and slopes per pixel from there to the next.
pub(crate) struct RowField<'a> {
    pub(crate) u: &'a [f32],
    pub(crate) su: &'a [f32],
    pub(crate) v: &'a [f32],
    pub(crate) sv: &'a [f32],
    pub(crate) spread: &'a Spread,
}

/// Interpolates the pixels (x + k, y), displaced by the field, into `out`, whose length is a multiple
/// of eight. Loads are contiguous wherever the integer part of the displacement takes at most two
/// values over eight pixels; elsewhere each pixel is read by itself. What lies outside the padded
/// plane is arbitrary but finite.
#[simd]
pub(crate) fn warp_row<S: Simd, const N: usize, const N1: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    field: &RowField<'_>,
    out: &mut [f32],
) {
    let zero = V::splat(s, 0.0);
    let one = V::splat(s, 1.0);
    let centre = V::splat(s, 0.5);
    let half = (N / 2 - 1) as i32;
    let Spread { step, lead, lanes } = field.spread;
    let mut x = x;
    let (mut node, mut phase) = (lead / step, lead % step);
    for o in out.chunks_exact_mut(LANES) {
        let (index, distance) = &lanes[phase];
        let index = u8x32::from_slice(s, index);
        let distance = V::from_slice(s, distance);
        macro_rules! at {
            ($values:expr) => {
                V::from_slice(s, &$values[node..node + LANES]).swizzle_dyn(index)
            };
        }
        let du = at!(field.su).mul_add(distance, at!(field.u));
        let dv = at!(field.sv).mul_add(distance, at!(field.v));
        phase += LANES;
        while phase >= *step {
            phase -= step;
            node += 1;
        }
        let (fx, fy) = (du.floor(), dv.floor());
        let (ku, kv) = (fx.reduce_min(), fy.reduce_min());
        let (tx, ty) = (du - V::splat(s, ku), dv - V::splat(s, kv));
        let inside = (one - tx).min(one - ty).simd_ge(zero);
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
