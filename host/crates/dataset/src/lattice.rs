//! The pixels of one colour of a mosaic sensor.

use crate::image_file::GreyImage;

/// Every `pitch`-th pixel of an image from `origin` on: one channel of a mosaic sensor, taken as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lattice {
    /// Column and row of the first pixel, below `pitch`.
    pub origin: [u32; 2],
    /// Distance of the pixels in both directions, at least 1.
    pub pitch: u32,
}

impl Default for Lattice {
    fn default() -> Self {
        Self::ALL
    }
}

impl Lattice {
    /// Every pixel.
    pub const ALL: Self = Self { origin: [0, 0], pitch: 1 };

    /// A channel of a Bayer mosaic whose first pixel is `origin`.
    pub const fn bayer(origin: [u32; 2]) -> Self {
        Self { origin, pitch: 2 }
    }

    /// The pixels of the lattice as an image, without any interpolation; columns and rows that are not full are
    /// those of the lattice's pixels that the image has.
    pub fn of(&self, image: &GreyImage) -> GreyImage {
        let [x0, y0] = self.origin;
        let pitch = self.pitch.max(1);
        let along = |from: u32, to: u32| to.saturating_sub(from).div_ceil(pitch);
        let (width, height) = (along(x0, image.width), along(y0, image.height));
        let mut data = Vec::with_capacity(width as usize * height as usize);
        for row in
            image.data.chunks_exact(image.width.max(1) as usize).skip(y0 as usize).step_by(pitch as usize)
        {
            data.extend(row.iter().skip(x0 as usize).step_by(pitch as usize));
        }
        GreyImage { width, height, data, ..*image }
    }

    /// Position in the sensor's pixels of a position in the lattice's.
    pub fn to_sensor(&self, position: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|i| f64::from(self.pitch) * position[i] + f64::from(self.origin[i]))
    }

    /// Position in the lattice's pixels of a position in the sensor's.
    pub fn from_sensor(&self, position: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|i| (position[i] - f64::from(self.origin[i])) / f64::from(self.pitch))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every pixel of the lattice holds the pixel of the sensor at the position it says, for odd and even sizes.
    #[test]
    fn takes_the_pixels_where_it_says() {
        for (width, height) in [(8, 6), (9, 7), (2, 2)] {
            let data: Vec<u16> = (0..width * height).map(|k| k as u16).collect();
            let image = GreyImage { width, height, container_bits: 16, significant_bits: 12, data };
            for origin in [[0, 0], [1, 0], [0, 1], [1, 1]] {
                let lattice = Lattice::bayer(origin);
                let found = lattice.of(&image);
                assert_eq!(found.significant_bits, 12);
                assert_eq!(found.data.len(), (found.width * found.height) as usize);
                for j in 0..found.height {
                    for i in 0..found.width {
                        let [x, y] = lattice.to_sensor([f64::from(i), f64::from(j)]);
                        assert_eq!(lattice.from_sensor([x, y]), [f64::from(i), f64::from(j)]);
                        let value = found.data[(j * found.width + i) as usize];
                        assert_eq!(f64::from(value), y * f64::from(width) + x);
                    }
                }
                let count = |from: u32, to: u32| (from..to).step_by(2).count() as u32;
                assert_eq!((found.width, found.height), (count(origin[0], width), count(origin[1], height)));
            }
            assert_eq!(Lattice::ALL.of(&image), image);
        }
    }
}
