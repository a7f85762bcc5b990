//! Momentum, total variation, smoothing near the native plane.

use crate::operator::Layout;
use rayon::prelude::*;

/// Factor of the extrapolation: ⟨step, earlier⟩/⟨earlier, earlier⟩, from 0 to 1.
pub(super) fn acceleration(step: &[f32], earlier: &[f32]) -> f32 {
    let sums = |a: &[f32], b: &[f32]| -> f64 {
        let parts: Vec<f64> = a
            .par_chunks(4096)
            .zip(b.par_chunks(4096))
            .map(|(a, b)| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum())
            .collect();
        parts.iter().sum()
    };
    let square = sums(earlier, earlier);
    if square > 0.0 { (sums(step, earlier) / square).clamp(0.0, 1.0) as f32 } else { 0.0 }
}

/// Extrapolation: factor (x − previous).
pub(super) fn ahead(x: &[f32], previous: &[f32], factor: f32) -> Vec<f32> {
    x.iter().zip(previous).map(|(x, q)| factor * (x - q)).collect()
}

/// point ← max(0, x + ahead).
pub(super) fn go_ahead(point: &mut [f32], x: &[f32], ahead: &[f32]) {
    for ((p, x), a) in point.iter_mut().zip(x).zip(ahead) {
        *p = (x + a).max(0.0);
    }
}

/// 1/(1 − λ div(∇g/|∇g|)) for each voxel, packed as the volume.
///
/// Forward differences over the voxel size, their adjoint as divergence; lengths relative to the lateral voxel.
pub(super) fn variation(layout: &Layout, packed: &[f32], weight: f32, voxel_um: [f64; 3]) -> Vec<f32> {
    let g = layout.unpack(packed);
    let [ny, nx] = [0, 1].map(|a| layout.cells[a] * layout.cell.n[a]);
    let nz = layout.cell.inner;
    let h = voxel_um.map(|v| (voxel_um[2] / v) as f32);
    let mean = g.iter().map(|v| f64::from(*v)).sum::<f64>() / g.len() as f64;
    let floor = (1e-3 * mean).max(1e-20) as f32;
    let at = |z: usize, y: usize, x: usize| g[(z * ny + y) * nx + x];
    // unit gradients along z, y, x
    let unit = |z: usize, y: usize, x: usize| -> [f32; 3] {
        let v = at(z, y, x);
        let d = [
            if z + 1 < nz { (at(z + 1, y, x) - v) * h[0] } else { 0.0 },
            if y + 1 < ny { (at(z, y + 1, x) - v) * h[1] } else { 0.0 },
            if x + 1 < nx { (at(z, y, x + 1) - v) * h[2] } else { 0.0 },
        ];
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + floor * floor).sqrt();
        d.map(|d| d / length)
    };
    let units: Vec<[f32; 3]> =
        (0..nz * ny * nx).into_par_iter().map(|i| unit(i / (ny * nx), i / nx % ny, i % nx)).collect();
    let factors: Vec<f32> = (0..units.len())
        .into_par_iter()
        .map(|i| {
            let [a, b, c] = units[i];
            let (z, y, x) = (i / (ny * nx), i / nx % ny, i % nx);
            let mut divergence = a * h[0] + b * h[1] + c * h[2];
            if z > 0 {
                divergence -= units[i - ny * nx][0] * h[0];
            }
            if y > 0 {
                divergence -= units[i - nx][1] * h[1];
            }
            if x > 0 {
                divergence -= units[i - 1][2] * h[2];
            }
            1.0 / (1.0 - weight * divergence).max(0.1)
        })
        .collect();
    layout.pack(&factors)
}

/// Smooths every plane with a Gaussian whose full width at half maximum is `factor` (w − 1) voxels, w the
/// plane's sampling distance; the total of a plane away from the border is kept.
pub(super) fn smooth_planes(layout: &Layout, packed: &mut [f32], widths: &[f64], factor: f64) {
    let mut g = layout.unpack(packed);
    let [ny, nx] = [0, 1].map(|a| layout.cells[a] * layout.cell.n[a]);
    g.par_chunks_mut(ny * nx).zip(widths).for_each(|(plane, width)| {
        let sigma = factor * (width - 1.0).max(0.0) / 2.354_820_045;
        if sigma < 0.05 {
            return;
        }
        let reach = (3.0 * sigma).ceil() as isize;
        let kernel: Vec<f64> = (-reach..=reach).map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp()).collect();
        let line = |from: &[f32]| -> Vec<f32> {
            let n = from.len() as isize;
            (0..n)
                .map(|i| {
                    let (mut sum, mut norm) = (0.0, 0.0);
                    for (k, w) in kernel.iter().enumerate() {
                        let j = i + k as isize - reach;
                        if j >= 0 && j < n {
                            sum += w * f64::from(from[j as usize]);
                            norm += w;
                        }
                    }
                    (sum / norm) as f32
                })
                .collect()
        };
        for row in plane.chunks_exact_mut(nx) {
            let new = line(row);
            row.copy_from_slice(&new);
        }
        for x in 0..nx {
            let column: Vec<f32> = (0..ny).map(|y| plane[y * nx + x]).collect();
            for (y, v) in line(&column).into_iter().enumerate() {
                plane[y * nx + x] = v;
            }
        }
    });
    packed.copy_from_slice(&layout.pack(&g));
}
