//! Rays from the pinhole through a grating, and the set-up prepared for tracing them.

use nalgebra::Vector3;

use crate::camera::{CameraModel, UndistortError};
use crate::grating::{Axes, DiffractError, Substrate, SubstrateSide};
use crate::real::{Dual, Real, along};
use crate::setup::{Optics, OpticsError, Parameter, View};

/// Why a pixel or a point could not be followed through the optics.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum TraceError {
    /// The lens distortion cannot be undone at a pixel.
    #[error(transparent)]
    Undistort(#[from] UndistortError),
    /// No diffracted ray.
    #[error("{view:?} view: {source}")]
    Diffract {
        /// The view.
        view: View,
        /// Why.
        source: DiffractError,
    },
    /// The two lines of sight do not meet: they are parallel or part from each other.
    #[error("the two lines of sight do not meet behind the grating: parallel or diverging")]
    NoIntersection,
    /// The point lies in front of the grating; pixels of swapped views do this.
    #[error(
        "the lines of sight meet {distance_mm:.3} mm from the grating, on the camera's side or in the substrate: are the −1 and +1 views swapped?"
    )]
    BeforeGrating {
        /// Signed distance along the grating's normal in millimetres.
        distance_mm: f64,
    },
    /// No pixel of the view sees the point: Newton's iteration did not converge, or the point
    /// lies outside the region where the lens model is one to one.
    #[error(
        "no pixel of the {view:?} view sees the point ({:.3}, {:.3}, {:.3}) mm",
        point_mm[0], point_mm[1], point_mm[2]
    )]
    NotSeen {
        /// The view.
        view: View,
        /// The point (x, y, h).
        point_mm: [f64; 3],
    },
    /// An input is NaN or infinite.
    #[error("an input is not a finite number")]
    NotFinite,
}

/// A line of sight behind the grating, in object coordinates (x, y, h), millimetres.
///
/// Behind a substrate on the object's side, `origin_mm` is where the line in air, prolonged
/// backwards, meets the plane of the grooves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// A point of the line.
    pub origin_mm: Vector3<f64>,
    /// Unit direction, away from the camera (negative h).
    pub direction: Vector3<f64>,
}

/// The set-up for any scalar. World coordinates.
#[derive(Clone, Debug)]
pub(crate) struct Setup<T> {
    pub(crate) camera: CameraModel<T>,
    /// Pinhole to grating.
    pub(crate) s: T,
    /// Grating to reference plane.
    pub(crate) d: T,
    gratings: [PlacedGrating<T>; 2],
    /// sin θ of the virtual-object models: mean of λ/p over the two gratings.
    pub(crate) mean_sin_theta: T,
}

#[derive(Clone, Debug)]
struct PlacedGrating<T> {
    axes: Axes<T>,
    /// mλ/p with the order m of this view.
    shift: T,
    order: f64,
    substrate: Substrate,
}

/// A line of sight in world coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WorldRay<T> {
    pub(crate) origin: [T; 3],
    pub(crate) direction: [T; 3],
}

impl<T: Real> Setup<T> {
    pub(crate) fn new(o: &Optics) -> Self {
        let k = T::constant;
        let gratings = View::BOTH.map(|view| {
            let g = o.grating(view);
            let order = view.traced_order();
            PlacedGrating {
                axes: Axes::new(g.tilt_rad_xyz.map(k)),
                shift: k(order * o.wavelength_mm / g.pitch_mm),
                order,
                substrate: g.substrate,
            }
        });
        Self {
            camera: CameraModel::new(&o.camera),
            s: k(o.pinhole_to_grating_mm),
            d: k(o.grating_to_reference_mm),
            mean_sin_theta: (gratings[0].shift - gratings[1].shift) * k(0.5),
            gratings,
        }
    }

    /// Replaces a parameter, for instance by a variable to differentiate by.
    pub(crate) fn set(&mut self, parameter: Parameter, value: T) {
        match parameter {
            Parameter::FocalPx => self.camera.focal = value,
            Parameter::PinholeToGrating => self.s = value,
            Parameter::GratingToReference => self.d = value,
        }
    }

    /// Line of sight behind the grating for the ideal normalised coordinates `q`.
    #[inline]
    pub(crate) fn trace(&self, view: View, q: [T; 2]) -> Result<WorldRay<T>, TraceError> {
        let g = &self.gratings[view.index()];
        let one = T::constant(1.0);
        let norm = (q[0] * q[0] + q[1] * q[1] + one).sqrt();
        let k = [q[0] / norm, q[1] / norm, one / norm];
        let cosines = g
            .axes
            .diffract(k, g.shift)
            .map_err(|e| TraceError::Diffract { view, source: e.of_order(g.order) })?;
        let to_plane = self.s * g.axes.normal[2] / cosines.before[2];
        let mut origin = [k[0] * to_plane, k[1] * to_plane, k[2] * to_plane];
        if g.substrate.thickness_mm > 0.0 {
            // Snell's law keeps the tangential cosines; the plate is passed at a steeper angle
            // and shifts the ray along the grating. One shift serves both sides: before the
            // grooves it moves where they are hit, behind them where the ray seems to come from.
            let c = match g.substrate.side {
                SubstrateSide::Camera => cosines.before,
                SubstrateSide::Object => cosines.after,
            };
            let n = T::constant(g.substrate.index);
            let inside = (n * n - c[0] * c[0] - c[1] * c[1]).sqrt();
            let t = T::constant(g.substrate.thickness_mm) * (one / inside - one / c[2]);
            origin = along(origin, g.axes.across, c[0] * t);
            origin = along(origin, g.axes.along, c[1] * t);
        }
        Ok(WorldRay { origin, direction: g.axes.to_world(cosines.after) })
    }

    /// Distance of a world point behind the last surface of the view's grating, along its normal.
    pub(crate) fn behind(&self, view: View, p: [T; 3]) -> f64 {
        let g = &self.gratings[view.index()];
        let [nx, ny, nz] = g.axes.normal.map(T::value);
        let beyond = nx * p[0].value() + ny * p[1].value() + nz * (p[2] - self.s).value();
        match g.substrate.side {
            SubstrateSide::Camera => beyond,
            SubstrateSide::Object => beyond - g.substrate.thickness_mm,
        }
    }

    /// World coordinates of the object point (x, y, h).
    #[inline]
    pub(crate) fn world(&self, p: [T; 3]) -> [T; 3] {
        [p[0], p[1], self.s + self.d - p[2]]
    }

    /// Object coordinates (x, y, h) of the world point.
    #[inline]
    pub(crate) fn object(&self, p: [T; 3]) -> [T; 3] {
        [p[0], p[1], self.s + self.d - p[2]]
    }
}

/// A validated set-up, prepared for many pixels or points.
#[derive(Clone, Debug)]
pub struct OpticalModel {
    pub(crate) optics: Optics,
    pub(crate) plain: Setup<f64>,
    /// Derivatives with respect to two coordinates of one pixel or direction.
    pub(crate) by_direction: Setup<Dual<2>>,
    /// Derivatives with respect to the three coordinates of a point.
    pub(crate) by_point: Setup<Dual<3>>,
    /// Derivatives with respect to the four coordinates of a pixel pair.
    pub(crate) by_pair: Setup<Dual<4>>,
    /// Derivatives with respect to [`Parameter::ALL`].
    pub(crate) by_parameters: Setup<Dual<3>>,
}

impl OpticalModel {
    /// Validates and prepares `optics`.
    ///
    /// # Errors
    /// As [`Optics::validate`].
    pub fn new(optics: &Optics) -> Result<Self, OpticsError> {
        optics.validate()?;
        let mut by_parameters = Setup::new(optics);
        for (i, p) in Parameter::ALL.into_iter().enumerate() {
            by_parameters.set(p, Dual::variable(p.get(optics), i));
        }
        Ok(Self {
            optics: *optics,
            plain: Setup::new(optics),
            by_direction: Setup::new(optics),
            by_point: Setup::new(optics),
            by_pair: Setup::new(optics),
            by_parameters,
        })
    }

    /// The parameters it was made from.
    pub fn optics(&self) -> &Optics {
        &self.optics
    }

    /// Line of sight of a pixel behind the grating, in object coordinates.
    ///
    /// # Errors
    /// If the distortion cannot be undone or the order does not propagate.
    pub fn ray(&self, view: View, pixel_px: [f64; 2]) -> Result<Ray, TraceError> {
        let q = self.plain.camera.direction(pixel_px)?;
        let r = self.plain.trace(view, q)?;
        let [x, y, z] = r.direction;
        Ok(Ray { origin_mm: self.plain.object(r.origin).into(), direction: Vector3::new(x, y, -z) })
    }

    /// Point (x, y, h) where the line of sight of a pixel meets the plane of height `height_mm`.
    ///
    /// # Errors
    /// As [`OpticalModel::ray`]; also if the plane is not behind the grating along that line.
    pub fn point_at_height(
        &self,
        view: View,
        pixel_px: [f64; 2],
        height_mm: f64,
    ) -> Result<Vector3<f64>, TraceError> {
        let q = self.plain.camera.direction(pixel_px)?;
        let r = self.plain.trace(view, q)?;
        let z = self.plain.s + self.plain.d - height_mm;
        let t = (z - r.origin[2]) / r.direction[2];
        let p = along(r.origin, r.direction, t);
        let distance_mm = self.plain.behind(view, p);
        if !t.is_finite() {
            return Err(TraceError::NoIntersection);
        }
        if !(distance_mm > 0.0 && t > 0.0) {
            return Err(TraceError::BeforeGrating { distance_mm });
        }
        Ok(Vector3::new(p[0], p[1], height_mm))
    }
}
