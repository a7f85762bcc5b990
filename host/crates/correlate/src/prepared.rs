//! Images made ready for correlation; kept and reused over a series.

use crate::image::Image;
use crate::plane::{self, Plane};
use crate::settings::Interpolation;
use fearless_simd::Level;

/// The reference image with its gradients (derivatives of the interpolating quintic B-spline).
#[derive(Clone)]
pub struct Reference {
    pub(crate) image: Image,
    pub(crate) gx: Plane,
    pub(crate) gy: Plane,
}

/// The deformed image with the coefficients of its interpolating B-spline.
#[derive(Clone)]
pub struct Target {
    pub(crate) image: Image,
    pub(crate) coefficients: Plane,
    /// Subtracted before the coefficients were made, so that single precision is not spent on it.
    pub(crate) offset: f32,
    pub(crate) interpolation: Interpolation,
}

impl Reference {
    /// Prepares a reference image.
    pub fn new(image: Image) -> Self {
        let (mut gx, mut gy) = (Plane::default(), Plane::default());
        gradients(&image, &mut gx, &mut gy);
        Self { image, gx, gy }
    }

    /// Replaces the image; memory is used again where the size allows.
    pub fn update(&mut self, image: Image) {
        self.image = image;
        gradients(&self.image, &mut self.gx, &mut self.gy);
    }

    /// The image.
    pub fn image(&self) -> &Image {
        &self.image
    }
}

fn gradients(image: &Image, gx: &mut Plane, gy: &mut Plane) {
    let (level, mean) = (Level::new(), image.mean());
    rayon::join(
        || {
            gx.load(image, mean);
            plane::gradient_x(level, gx);
        },
        || {
            gy.load(image, mean);
            plane::gradient_y(level, gy);
        },
    );
}

impl Target {
    /// Prepares a deformed image for the given interpolation.
    pub fn new(image: Image, interpolation: Interpolation) -> Self {
        let mut target = Self { offset: 0.0, coefficients: Plane::default(), interpolation, image };
        target.prepare();
        target
    }

    /// Replaces the image; memory is used again where the size allows.
    pub fn update(&mut self, image: Image) {
        self.image = image;
        self.prepare();
    }

    fn prepare(&mut self) {
        self.offset = self.image.mean();
        self.coefficients.load(&self.image, self.offset);
        plane::coefficients(Level::new(), &mut self.coefficients, self.interpolation);
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
