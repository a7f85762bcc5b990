//! Interpolation of a coefficient plane at eight points at once, without gathers.

use crate::plane::{PAD, Plane, transpose8};
use fearless_simd::{f32x8, mask32x8, prelude::*};

pub(crate) type V<S> = f32x8<S>;
const LANES: usize = 8;

/// B-spline weights of the N taps (8 septic, 6 quintic, 4 cubic) along both axes, for fractions t of the
/// pixel given as t − ½. In this variable tap k and tap N−1−k share their even part and differ in
/// the sign of the odd one. Both axes go side by side so that they share the constants.
#[inline(always)]
pub(crate) fn weights<S: Simd, const N: usize>(s: S, x: V<S>, y: V<S>) -> ([V<S>; 9], [V<S>; 9]) {
    let k = |a: f32| V::splat(s, a);
    let (q, p) = (x * x, y * y);
    let mut w = [k(0.0); 9];
    let mut z = [k(0.0); 9];
    macro_rules! pair {
        ($a:expr, $b:expr; $e0:expr, $($e:expr),+; $o0:expr, $($o:expr),+) => {{
            let mut e = (k($e0), k($e0));
            $( let c = k($e); e = (e.0.mul_add(q, c), e.1.mul_add(p, c)); )+
            let mut o = (k($o0), k($o0));
            $( let c = k($o); o = (o.0.mul_add(q, c), o.1.mul_add(p, c)); )+
            let o = (o.0 * x, o.1 * y);
            w[$a] = e.0 - o.0;
            w[$b] = e.0 + o.0;
            z[$a] = e.1 - o.1;
            z[$b] = e.1 + o.1;
        }};
    }
    if N == 8 {
        pair!(0, 7; 1. / 1440., 1. / 1152., 1. / 7680., 1. / 645_120.;
            1. / 5040., 1. / 960., 1. / 2304., 1. / 46_080.);
        pair!(1, 6; -1. / 288., 19. / 1152., 47. / 1536., 2179. / 645_120.;
            -1. / 720., 1. / 960., 73. / 2304., 721. / 46_080.);
        pair!(2, 5; 1. / 160., -7. / 128., 403. / 2560., 20_219. / 215_040.;
            1. / 240., -19. / 960., 5. / 2304., 9821. / 46_080.);
        pair!(3, 4; -1. / 288., 43. / 1152., -289. / 1536., 259_723. / 645_120.;
            -1. / 144., 3. / 64., -43. / 256., 289. / 1024.);
    } else if N == 6 {
        pair!(0, 5; 1. / 48., 1. / 96., 1. / 3840.; 1. / 120., 1. / 48., 1. / 384.);
        pair!(1, 4; -1. / 16., 7. / 32., 79. / 1280.; -1. / 24., 1. / 16., 25. / 128.);
        pair!(2, 3; 1. / 24., -11. / 48., 841. / 1920.; 1. / 12., -7. / 24., 77. / 192.);
    } else {
        pair!(0, 3; 1. / 4., 1. / 48.; 1. / 6., 1. / 8.);
        pair!(1, 2; -1. / 4., 23. / 48.; -1. / 2., 5. / 8.);
    }
    (w, z)
}

/// Lanes whose integer part is one larger use the same taps, shifted by one.
#[inline(always)]
pub(crate) fn shifted<S: Simd, const N: usize>(s: S, w: [V<S>; 9], m: mask32x8<S>) -> [V<S>; 9] {
    let zero = V::splat(s, 0.0);
    let mut o = [zero; 9];
    o[0] = m.select(zero, w[0]);
    for i in 1..N {
        o[i] = m.select(w[i - 1], w[i]);
    }
    o[N] = m.select(w[N - 1], zero);
    o
}

/// Weighted sum over NX × NY taps; lane l reads from `origin + l`. Nothing where the taps are not
/// all in the plane.
#[inline(always)]
pub(crate) fn convolve<S: Simd, const NX: usize, const NY: usize>(
    s: S,
    plane: &Plane,
    origin: usize,
    wx: &[V<S>; 9],
    wy: &[V<S>; 9],
) -> Option<V<S>> {
    let stride = plane.stride;
    let mut rest = plane.data.get(origin..)?;
    let mut g = V::splat(s, 0.0);
    for j in 0..NY {
        // one comparison per row is all that bounds checking costs this way
        let row = if j + 1 < NY {
            let (row, below) = rest.split_at_checked(stride)?;
            rest = below;
            row
        } else {
            rest
        };
        let row = row.first_chunk::<{ 2 * LANES }>()?;
        let mut h = wx[0] * V::from_slice(s, &row[..LANES]);
        for i in 1..NX {
            h = wx[i].mul_add(V::from_slice(s, &row[i..i + LANES]), h);
        }
        g = wy[j].mul_add(h, g);
    }
    Some(g)
}

/// The nearest position from which all taps (and unused lanes) stay inside the padded plane. Warped
/// subsets that really need it are reported as outside the image.
#[inline(always)]
fn clamped(plane: &Plane, x: i32, y: i32) -> usize {
    let x = x.clamp(-(PAD as i32), plane.stride as i32 - PAD as i32 - 16);
    let y = y.clamp(-(PAD as i32), plane.rows as i32 - PAD as i32 - 8);
    plane.index(x, y)
}

/// Largest displacement gradient along a row for [`sample_row`]: over eight pixels the integer part
/// of a displacement then takes at most two values.
pub(crate) const GENTLE: f64 = 0.12;

/// 2³²: displacements along a row are advanced in 32.32 fixed point, so that integer parts need no
/// vector operation and nothing drifts.
const ONE: f64 = 4_294_967_296.0;

/// Interpolates a row of groups of eight pixels from pixel (x, y) on, displaced by the polynomials
/// `u` and `v` (pixels; constant, linear and quadratic coefficient in the distance from the first
/// pixel), into `out`. Loads are contiguous: all eight lanes use one window of taps, lanes whose
/// integer part is one larger have their weights shifted by one tap. At the seams between spline
/// pieces a lane may be treated as either side's: the pieces join smoothly.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(crate) fn sample_row<S: Simd, const N: usize, const N1: usize, const O: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    u: [f64; 3],
    v: [f64; 3],
    out: &mut [f32],
) {
    let sp = |a: f32| V::splat(s, a);
    let lanes = V::from_fn(s, |l| l as f32);
    let half = (N / 2 - 1) as i32;
    let fixed = |a: f64| (a * ONE) as i64;
    // value at the group's first pixel, its increment over a group, the increment's increment
    let (mut au, mut av) = (fixed(u[0]), fixed(v[0]));
    let (mut bu, mut bv) = (fixed(8.0 * u[1] + 64.0 * u[2]), fixed(8.0 * v[1] + 64.0 * v[2]));
    let (cu, cv) = (fixed(128.0 * u[2]), fixed(128.0 * v[2]));
    let (mut gu, mut gv) = (sp(u[1] as f32), sp(v[1] as f32));
    let (ku, kv) = (sp(u[2] as f32), sp(v[2] as f32));
    let (hu, hv) = (sp(16.0 * u[2] as f32), sp(16.0 * v[2] as f32));
    let mut x = x - half;
    let y = y - half;
    for o in out.chunks_exact_mut(LANES) {
        let (nu, nv) = (au.wrapping_add(bu), av.wrapping_add(bv));
        let (iu, iv) = ((au.min(nu) >> 32) as i32, (av.min(nv) >> 32) as i32);
        let (ju, jv) = ((au.max(nu) >> 32) as i32, (av.max(nv) >> 32) as i32);
        let rest = |a: i64, i: i32| (a - (i64::from(i) << 32)) as f32 * (1.0 / ONE as f32) - 0.5;
        let (tu, tv) = (sp(rest(au, iu)), sp(rest(av, iv)));
        let (mut tx, mut ty);
        if O == 2 {
            tx = ku.mul_add(lanes, gu).mul_add(lanes, tu);
            ty = kv.mul_add(lanes, gv).mul_add(lanes, tv);
            gu += hu;
            gv += hv;
            bu = bu.wrapping_add(cu);
            bv = bv.wrapping_add(cv);
        } else {
            tx = gu.mul_add(lanes, tu);
            ty = gv.mul_add(lanes, tv);
        }
        (au, av) = (nu, nv);
        let origin = (y.wrapping_add(iv).wrapping_add(PAD as i32) as isize)
            .wrapping_mul(plane.stride as isize)
            .wrapping_add(x.wrapping_add(iu).wrapping_add(PAD as i32) as isize) as usize;
        x += LANES as i32;
        let (carry_x, carry_y) = (ju != iu, jv != iv);
        let (limit, one) = (sp(0.5), sp(1.0));
        let value = if !carry_x && !carry_y {
            let (wx, wy) = weights::<S, N>(s, tx, ty);
            convolve::<S, N, N>(s, plane, origin, &wx, &wy)
        } else {
            let (mx, my) = (tx.simd_ge(limit), ty.simd_ge(limit));
            tx = mx.select(tx - one, tx);
            ty = my.select(ty - one, ty);
            let (wx, wy) = weights::<S, N>(s, tx, ty);
            if !carry_y {
                convolve::<S, N1, N>(s, plane, origin, &shifted::<S, N>(s, wx, mx), &wy)
            } else if !carry_x {
                convolve::<S, N, N1>(s, plane, origin, &wx, &shifted::<S, N>(s, wy, my))
            } else {
                convolve::<S, N1, N1>(
                    s,
                    plane,
                    origin,
                    &shifted::<S, N>(s, wx, mx),
                    &shifted::<S, N>(s, wy, my),
                )
            }
        };
        // a subset this far outside is never reported as converged
        value.unwrap_or(sp(0.0)).store_slice(o);
    }
}

/// Value at (x + step_x·lane + du, y + step_y·lane + dv), each lane by itself: its taps are loaded
/// row by row, weighted down the rows, transposed and weighted across.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(crate) fn sample_lanes<S: Simd, const N: usize>(
    s: S,
    plane: &Plane,
    x: i32,
    y: i32,
    step_x: i32,
    step_y: i32,
    du: V<S>,
    dv: V<S>,
) -> V<S> {
    let (fx, fy) = (du.floor(), dv.floor());
    let centre = V::splat(s, 0.5);
    let (wx, wy) = weights::<S, N>(s, du - fx - centre, dv - fy - centre);
    let half = (N / 2 - 1) as i32;
    let zero = V::splat(s, 0.0);
    let mut taps = [[0.0f32; LANES]; N];
    for j in 0..N {
        wy[j].store_slice(&mut taps[j]);
    }
    let (mut ix, mut iy) = ([0.0f32; LANES], [0.0f32; LANES]);
    fx.store_slice(&mut ix);
    fy.store_slice(&mut iy);
    let stride = plane.stride;
    let mut m = [zero; 8];
    for l in 0..LANES {
        let li = l as i32;
        let o = clamped(plane, x + step_x * li + ix[l] as i32 - half, y + step_y * li + iy[l] as i32 - half);
        let Some(window) = plane.data.get(o..o + (N - 1) * stride + LANES) else {
            return zero;
        };
        let mut a = V::splat(s, taps[0][l]) * V::from_slice(s, &window[..LANES]);
        for j in 1..N {
            let row = &window[j * stride..][..LANES];
            a = V::splat(s, taps[j][l]).mul_add(V::from_slice(s, row), a);
        }
        m[l] = a;
    }
    let m = transpose8(m);
    let mut g = wx[0] * m[0];
    for i in 1..N {
        g = wx[i].mul_add(m[i], g);
    }
    g
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::spline;
    use crate::scalar::basis;
    use crate::simd::dispatch;
    use fearless_simd::Level;

    fn check<S: Simd, const N: usize>(s: S) {
        let half = N as f64 / 2.0 - 1.0;
        for k in 0..64u8 {
            let (x, y) = (f32::from(k) / 64.0, 1.0 - f32::from(k) / 64.0);
            let (w, z) = weights::<S, N>(s, V::splat(s, x - 0.5), V::splat(s, y - 0.5));
            for (t, w) in [(x, w), (y, z)] {
                for (tap, w) in w.iter().enumerate() {
                    let distance = f64::from(t) + half - tap as f64;
                    let expected = spline(N as u32 - 1, distance);
                    // rounding of single precision
                    assert!((f64::from(w[0]) - expected).abs() < 1e-7, "{N} taps, tap {tap} at {t}");
                    assert!((basis(N, distance) - expected).abs() < 1e-14, "{N} taps, tap {tap} at {t}");
                }
            }
        }
    }

    #[test]
    fn weights_are_those_of_the_recursion() {
        dispatch!(Level::new(), s => {
            check::<_, 4>(s);
            check::<_, 6>(s);
            check::<_, 8>(s);
        });
    }
}
