//! The phase and the aperture of the lenslets.

use crate::optics::{Aperture, Lenslets, Packing};
use rustfft::num_complex::Complex64;

/// Transmission on a grid of one cell, `[y][x]`, sample (i, j) at ((i + ½)/n − ½) of the cell from its
/// centre, where a lenslet has its centre: exp(−i k₀ |X − c|²/(2 f)) about the nearest lenslet centre c,
/// zero outside its aperture. k₀ is that of air (the thesis' κ of the immersion medium is a misprint).
pub(crate) fn transmission(lenslets: &Lenslets, wavelength_um: f64, samples: [usize; 2]) -> Vec<Complex64> {
    let k0 = std::f64::consts::TAU / wavelength_um;
    let cell = lenslets.cell_um();
    let centres: &[[f64; 2]] = match lenslets.packing {
        Packing::Square => &[[0.0, 0.0]],
        Packing::Hexagonal => &[[0.0, 0.0], [-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]],
    };
    let at = |i: usize, axis: usize| ((i as f64 + 0.5) / samples[axis] as f64 - 0.5) * cell[axis];
    let mut out = Vec::with_capacity(samples[0] * samples[1]);
    for i in 0..samples[0] {
        for j in 0..samples[1] {
            let (y, x) = (at(i, 0), at(j, 1));
            let square = centres
                .iter()
                .map(|c| (y - c[0] * cell[0]).powi(2) + (x - c[1] * cell[1]).powi(2))
                .fold(f64::INFINITY, f64::min);
            let open = match lenslets.aperture {
                Aperture::Full => true,
                Aperture::Round { diameter_um } => square <= 0.25 * diameter_um * diameter_um,
            };
            out.push(if open {
                Complex64::from_polar(1.0, -0.5 * k0 * square / lenslets.focal_um)
            } else {
                Complex64::new(0.0, 0.0)
            });
        }
    }
    out
}
