//! Grey images seen by the detectors, and the small models fitted to patches of them.

pub(crate) mod blob;
pub(crate) mod ellipse;
pub(crate) mod fit;
pub(crate) mod gaussian;
pub(crate) mod saddle;
pub(crate) mod smooth;

/// A grey image: row-major, `data[y * width + x]`, pixel (0, 0) centred at (0, 0), x right, y down.
#[derive(Clone, Copy, Debug)]
pub struct GreyView<'a> {
    data: &'a [f32],
    width: usize,
    height: usize,
    mask: Option<&'a [bool]>,
}

/// An image that no detector can work on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GreyError {
    /// Pixels and size do not belong together.
    #[error("{values} {what} do not make an image of {width} × {height} pixels")]
    Shape {
        /// What was counted: grey values or mask entries.
        what: &'static str,
        /// How many there are.
        values: usize,
        /// Of the image.
        width: usize,
        /// Of the image.
        height: usize,
    },
    /// Less than 16 pixels on one side.
    #[error("an image of {width} × {height} pixels is too small: at least {limit} are needed on each side")]
    TooSmall {
        /// Of the image.
        width: usize,
        /// Of the image.
        height: usize,
        /// Least side.
        limit: usize,
    },
}

/// Least side of an image.
const LEAST_SIDE: usize = 16;

impl<'a> GreyView<'a> {
    /// An image of `width × height` grey values. Pixels that are not finite are not used.
    ///
    /// # Errors
    /// [`GreyError`] if the size does not fit the data or a side is shorter than 16 pixels.
    pub fn new(data: &'a [f32], width: usize, height: usize) -> Result<Self, GreyError> {
        if width.checked_mul(height) != Some(data.len()) {
            return Err(GreyError::Shape { what: "grey values", values: data.len(), width, height });
        }
        if width.min(height) < LEAST_SIDE {
            return Err(GreyError::TooSmall { width, height, limit: LEAST_SIDE });
        }
        Ok(Self { data, width, height, mask: None })
    }

    /// The same image of which only the pixels are used that are `true` in `mask` (row-major).
    ///
    /// # Errors
    /// [`GreyError::Shape`] if the mask has another size.
    pub fn with_mask(self, mask: &'a [bool]) -> Result<Self, GreyError> {
        if mask.len() != self.data.len() {
            return Err(GreyError::Shape {
                what: "mask entries",
                values: mask.len(),
                width: self.width,
                height: self.height,
            });
        }
        Ok(Self { mask: Some(mask), ..self })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Grey value of a pixel in use.
    pub(crate) fn at(&self, index: usize) -> Option<f64> {
        let used = self.mask.is_none_or(|m| m[index]);
        let value = self.data[index];
        (used && value.is_finite()).then(|| f64::from(value))
    }

    /// The pixels in use inside the circle about `centre`, at positions relative to it, as far as
    /// `keep` wants them; none if more than `missing` of them (a fraction) are outside the image or
    /// the mask.
    pub(crate) fn patch(
        &self,
        centre: [f64; 2],
        radius: f64,
        missing: f64,
        keep: impl Fn([f64; 2]) -> bool,
    ) -> Option<Vec<fit::Pixel>> {
        // Written so that a NaN is refused as well.
        if !(radius < 1e4 && centre.iter().all(|c| c.abs() < 1e7)) {
            return None;
        }
        let (mut pixels, mut absent) = (Vec::new(), 0);
        let range = |c: f64| (c - radius).ceil() as i64..=(c + radius).floor() as i64;
        for y in range(centre[1]) {
            for x in range(centre[0]) {
                let at = [x as f64 - centre[0], y as f64 - centre[1]];
                if at[0] * at[0] + at[1] * at[1] > radius * radius || !keep(at) {
                    continue;
                }
                let inside = x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height;
                match inside.then(|| self.at(y as usize * self.width + x as usize)).flatten() {
                    Some(grey) => pixels.push(fit::Pixel { at, grey }),
                    None => absent += 1,
                }
            }
        }
        (absent as f64 <= missing * (pixels.len() + absent) as f64).then_some(pixels)
    }
}
