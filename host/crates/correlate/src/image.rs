//! Grey images and pixel masks.

use thiserror::Error;

/// Why an image or a mask could not be made from the given pixels.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ImageError {
    /// Width or height is zero.
    #[error("an image of {width}×{height} pixels has no content")]
    Empty {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// One side exceeds [`Image::MAX_SIDE`].
    #[error("an image of {width}×{height} pixels is larger than {limit} pixels on a side")]
    TooLarge {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Largest side accepted.
        limit: usize,
    },
    /// The number of values is not width × height.
    #[error("{width}×{height} pixels need {} values, {found} were given", width * height)]
    Length {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Values given.
        found: usize,
    },
    /// A grey level is NaN or infinite.
    #[error("the grey level at pixel ({x}, {y}) is not a finite number")]
    NotFinite {
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
}

fn check(width: usize, height: usize, found: usize) -> Result<(), ImageError> {
    if width == 0 || height == 0 {
        return Err(ImageError::Empty { width, height });
    }
    if width > Image::MAX_SIDE || height > Image::MAX_SIDE {
        return Err(ImageError::TooLarge { width, height, limit: Image::MAX_SIDE });
    }
    if width * height != found {
        return Err(ImageError::Length { width, height, found });
    }
    Ok(())
}

/// Grey levels, row by row from the top left; pixel (0, 0) has its centre at (0, 0), x runs to the
/// right and y down.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    width: usize,
    height: usize,
    data: Vec<f32>,
}

impl Image {
    /// Largest width or height accepted: pixel positions stay exact in single precision.
    pub const MAX_SIDE: usize = 1 << 16;

    /// Image of 8-bit grey levels (`width * height` of them).
    ///
    /// # Errors
    /// [`ImageError`] where the size is zero, too large or does not match the number of values.
    pub fn from_u8(width: usize, height: usize, grey: &[u8]) -> Result<Self, ImageError> {
        check(width, height, grey.len())?;
        let data = grey.iter().map(|&g| f32::from(g)).collect();
        Ok(Self { width, height, data })
    }

    /// Image of 16-bit grey levels (`width * height` of them).
    ///
    /// # Errors
    /// As [`Image::from_u8`].
    pub fn from_u16(width: usize, height: usize, grey: &[u16]) -> Result<Self, ImageError> {
        check(width, height, grey.len())?;
        let data = grey.iter().map(|&g| f32::from(g)).collect();
        Ok(Self { width, height, data })
    }

    /// Image of single-precision grey levels (`width * height` of them).
    ///
    /// # Errors
    /// As [`Image::from_u8`], and [`ImageError::NotFinite`] for NaN or infinity.
    pub fn from_f32(width: usize, height: usize, grey: Vec<f32>) -> Result<Self, ImageError> {
        check(width, height, grey.len())?;
        if let Some(k) = grey.iter().position(|g| !g.is_finite()) {
            return Err(ImageError::NotFinite { x: k % width, y: k / width });
        }
        Ok(Self { width, height, data: grey })
    }

    /// Replaces the image by a window of a larger one, using the memory again: `width` × `height`
    /// pixels, rows `stride` values apart, the first at `grey[0]`.
    ///
    /// # Errors
    /// As [`Image::from_u8`]; [`ImageError::Length`] also where the rows do not fit into `grey`. The
    /// image is unchanged then.
    pub fn assign<T: Copy + Into<f32>>(
        &mut self,
        width: usize,
        height: usize,
        stride: usize,
        grey: &[T],
    ) -> Result<(), ImageError> {
        check(width, height, width.saturating_mul(height))?;
        let needed = stride.saturating_mul(height - 1).saturating_add(width);
        if stride < width || grey.len() < needed {
            return Err(ImageError::Length { width, height, found: grey.len() });
        }
        (self.width, self.height) = (width, height);
        self.data.resize(width * height, 0.0);
        for (out, row) in self.data.chunks_exact_mut(width).zip(grey.chunks(stride)) {
            for (o, g) in out.iter_mut().zip(row) {
                *o = (*g).into();
            }
        }
        Ok(())
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Grey levels, row by row.
    pub fn grey(&self) -> &[f32] {
        &self.data
    }

    /// Grey levels of row `y`, or nothing below the image.
    pub fn row(&self, y: usize) -> &[f32] {
        self.data.get(y * self.width..(y + 1) * self.width).unwrap_or(&[])
    }

    /// Mean grey level.
    pub fn mean(&self) -> f32 {
        // sixteen sums side by side: one alone would wait for every addition
        let mut sums = [0.0f64; 16];
        let (blocks, rest) = self.data.as_chunks::<16>();
        for b in blocks {
            for (s, &g) in sums.iter_mut().zip(b) {
                *s += f64::from(g);
            }
        }
        let sum: f64 = sums.iter().sum::<f64>() + rest.iter().map(|&g| f64::from(g)).sum::<f64>();
        (sum / self.data.len() as f64) as f32
    }
}

/// Which pixels may be used, row by row as in [`Image`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    width: usize,
    height: usize,
    inside: Vec<bool>,
}

impl Mask {
    /// Mask of `width * height` pixels.
    ///
    /// # Errors
    /// As [`Image::from_u8`].
    pub fn new(width: usize, height: usize, inside: Vec<bool>) -> Result<Self, ImageError> {
        check(width, height, inside.len())?;
        Ok(Self { width, height, inside })
    }

    /// For pixels whose number is known to fit.
    pub(crate) fn from_parts(width: usize, height: usize, inside: Vec<bool>) -> Self {
        Self { width, height, inside }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Pixels, row by row.
    pub fn pixels(&self) -> &[bool] {
        &self.inside
    }

    /// Whether pixel (x, y) is inside; outside the image nothing is.
    pub fn contains(&self, x: usize, y: usize) -> bool {
        x < self.width && y < self.height && self.inside[y * self.width + x]
    }

    /// Number of pixels inside.
    pub fn count(&self) -> usize {
        self.inside.iter().filter(|&&m| m).count()
    }
}

/// Sums of a mask over any rectangle in constant time.
#[derive(Debug)]
pub(crate) struct MaskSums {
    stride: usize,
    sums: Vec<u32>,
}

impl MaskSums {
    pub(crate) fn new(mask: &Mask) -> Self {
        let stride = mask.width + 1;
        let mut sums = vec![0u32; stride * (mask.height + 1)];
        for y in 0..mask.height {
            let mut row = 0;
            for x in 0..mask.width {
                row += u32::from(mask.inside[y * mask.width + x]);
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        Self { stride, sums }
    }

    /// Pixels inside among columns `x0..x1` and rows `y0..y1`, which lie in the image.
    pub(crate) fn count(&self, x0: usize, y0: usize, x1: usize, y1: usize) -> u32 {
        let at = |x: usize, y: usize| self.sums[y * self.stride + x];
        at(x1, y1) + at(x0, y0) - at(x1, y0) - at(x0, y1)
    }
}
