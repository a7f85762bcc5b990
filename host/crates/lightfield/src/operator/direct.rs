//! The projection lenslet by lenslet: slow and plain, to test the others by and for small problems.

use super::Geometry;
use crate::error::OperatorError;
use crate::psf::Psf;

/// Projections as sums over the offsets of lenslets, in double precision.
pub struct Direct<'a> {
    psf: &'a Psf,
    geometry: Geometry,
}

impl<'a> Direct<'a> {
    /// For a volume of `cells` (y, x) cells and a sensor that is larger by `margin` cells on every side.
    ///
    /// # Errors
    /// [`OperatorError`] for a grid that cannot be.
    pub fn new(psf: &'a Psf, cells: [usize; 2], margin: isize) -> Result<Self, OperatorError> {
        Ok(Self { psf, geometry: Geometry::new(psf.shape(), cells, margin)? })
    }

    /// Runs `work(image pixel, voxel, value)` for every non-zero element of the matrix.
    fn each(&self, mut work: impl FnMut(usize, usize, f64)) {
        let g = &self.geometry;
        let s = &g.shape;
        let (d, [ny, nx], [vy, vx]) = (s.side() as isize, s.pixels, s.voxels);
        let r = s.radius as isize;
        let [_, height, width] = g.volume();
        let columns = g.image()[1];
        for z in 0..s.planes {
            for y in 0..height {
                for x in 0..width {
                    let voxel = (z * height + y) * width + x;
                    let (ly, lx) = ((y / vy) as isize, (x / vx) as isize);
                    let at = ((z * vy + y % vy) * vx + x % vx) * s.voxel();
                    for dy in 0..d {
                        for dx in 0..d {
                            let (cy, cx) = (ly + dy - r + g.margin, lx + dx - r + g.margin);
                            let inside = |c: isize, n: usize| c >= 0 && c < n as isize;
                            if !inside(cy, g.sensor[0]) || !inside(cx, g.sensor[1]) {
                                continue;
                            }
                            let (cy, cx) = (cy as usize, cx as usize);
                            let part = &self.psf.values[at + (dy * d + dx) as usize * ny * nx..][..ny * nx];
                            for (n, v) in part.iter().enumerate() {
                                let pixel = (cy * ny + n / nx) * columns + cx * nx + n % nx;
                                work(pixel, voxel, f64::from(*v));
                            }
                        }
                    }
                }
            }
        }
    }

    /// H g: volume `[z][y][x]` to image `[y][x]`.
    ///
    /// # Errors
    /// [`OperatorError::Length`].
    pub fn project(&self, volume: &[f32]) -> Result<Vec<f64>, OperatorError> {
        self.geometry.check_volume(volume.len())?;
        let [h, w] = self.geometry.image();
        let mut image = vec![0.0; h * w];
        self.each(|pixel, voxel, v| image[pixel] += v * f64::from(volume[voxel]));
        Ok(image)
    }

    /// Hᵀ f: image to volume.
    ///
    /// # Errors
    /// [`OperatorError::Length`].
    pub fn back_project(&self, image: &[f32]) -> Result<Vec<f64>, OperatorError> {
        self.geometry.check_image(image.len())?;
        let [d, h, w] = self.geometry.volume();
        let mut volume = vec![0.0; d * h * w];
        self.each(|pixel, voxel, v| volume[voxel] += v * f64::from(image[pixel]));
        Ok(volume)
    }
}
