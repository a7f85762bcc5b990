//! Images made ready for correlation; kept and reused over a series.

use crate::image::{Image, ImageError};
use crate::plane::{self, Plane, Work};
use crate::settings::Interpolation;
use fearless_simd::Level;
use std::sync::atomic::{AtomicU64, Ordering};

/// The reference image with its gradients (derivatives of the interpolating quintic B-spline).
#[derive(Clone)]
pub struct Reference {
    pub(crate) image: Image,
    pub(crate) gx: Plane,
    pub(crate) gy: Plane,
    /// Mean grey level.
    pub(crate) mean: f32,
    /// Differs between any two contents of any two references.
    pub(crate) id: u64,
    work: Work,
}

/// Identities given out so far.
static IDENTITIES: AtomicU64 = AtomicU64::new(0);

/// The deformed image with the coefficients of its interpolating B-spline.
#[derive(Clone)]
pub struct Target {
    pub(crate) image: Image,
    pub(crate) coefficients: Plane,
    /// Subtracted before the coefficients were made, so that single precision is not spent on it.
    pub(crate) offset: f32,
    pub(crate) interpolation: Interpolation,
    work: Work,
}

impl Reference {
    /// Prepares a reference image.
    pub fn new(image: Image) -> Self {
        let mut new = Self {
            image,
            gx: Plane::default(),
            gy: Plane::default(),
            mean: 0.0,
            id: 0,
            work: Work::default(),
        };
        new.prepare();
        new
    }

    /// Replaces the image; memory is used again where the size allows.
    pub fn update(&mut self, image: Image) {
        self.image = image;
        self.prepare();
    }

    /// Replaces the image by a window of a larger one, as [`Image::assign`]: no memory is taken where
    /// the size stays the same.
    ///
    /// # Errors
    /// As [`Image::assign`].
    pub fn assign<T: Copy + Into<f32>>(
        &mut self,
        width: usize,
        height: usize,
        stride: usize,
        grey: &[T],
    ) -> Result<(), ImageError> {
        self.image.assign(width, height, stride, grey)?;
        self.prepare();
        Ok(())
    }

    fn prepare(&mut self) {
        self.id = IDENTITIES.fetch_add(1, Ordering::Relaxed);
        self.mean = self.image.mean();
        let (level, mean) = (Level::new(), self.mean);
        let Self { image, gx, gy, work, .. } = self;
        plane::gradients(level, image, mean, work, [gx, gy]);
    }

    /// Exchanges the image for another, which gets the old one; no memory is allocated.
    pub(crate) fn exchange(&mut self, image: &mut Image) {
        std::mem::swap(&mut self.image, image);
        self.prepare();
    }

    /// The image.
    pub fn image(&self) -> &Image {
        &self.image
    }
}

impl Target {
    /// Prepares a deformed image for the given interpolation.
    pub fn new(image: Image, interpolation: Interpolation) -> Self {
        let mut target =
            Self { offset: 0.0, coefficients: Plane::default(), interpolation, image, work: Work::default() };
        target.prepare();
        target
    }

    /// Replaces the image; memory is used again where the size allows.
    pub fn update(&mut self, image: Image) {
        self.image = image;
        self.prepare();
    }

    /// Replaces the image by a window of a larger one, as [`Image::assign`]: no memory is taken where
    /// the size stays the same.
    ///
    /// # Errors
    /// As [`Image::assign`].
    pub fn assign<T: Copy + Into<f32>>(
        &mut self,
        width: usize,
        height: usize,
        stride: usize,
        grey: &[T],
    ) -> Result<(), ImageError> {
        self.image.assign(width, height, stride, grey)?;
        self.prepare();
        Ok(())
    }

    fn prepare(&mut self) {
        self.offset = self.image.mean();
        let Self { image, offset, coefficients, interpolation, work } = self;
        plane::coefficients(Level::new(), image, *offset, *interpolation, work, coefficients);
    }

    /// The image.
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// Interpolation for which it was prepared.
    pub fn interpolation(&self) -> Interpolation {
        self.interpolation
    }
}
