//! Rays from the pinhole through a grating, and the set-up prepared for tracing them.

use nalgebra::Vector3;

use crate::camera::{CameraModel, UndistortError};
use crate::grating::{Axes, DiffractError, SubstrateSide};
use crate::maps::DistortionMaps;
use crate::parameter::{GratingParameter, Parameter};
use crate::real::{Dual, Real, along, dot};
use crate::setup::{Optics, OpticsError, View};

/// Why a pixel or a point could not be followed through the optics.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum TraceError {
    /// The lens distortion cannot be undone at a pixel.
    #[error(transparent)]
    Undistort(#[from] UndistortError),
    /// The pixel lies outside the distortion map of its view or of the sensor, or the map folds
    /// over there.
    #[error(
        "pixel ({:.2}, {:.2}) of the {view:?} view lies outside the distortion map, which was never measured there",
        pixel_px[0], pixel_px[1]
    )]
    OutsideMap {
        /// The view.
        view: View,
        /// The pixel.
        pixel_px: [f64; 2],
    },
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
    camera: CameraModel<T>,
    maps: DistortionMaps,
    /// Pinhole to grating.
    s: T,
    /// Grating to reference plane.
    d: T,
    gratings: [PlacedGrating<T>; 2],
    /// Axes of the reference plane and its origin, if it is not simply square to the optical axis.
    reference: Option<(Axes<T>, [T; 2])>,
    pub(crate) paraxial: Paraxial<T>,
}

/// What the virtual-object models know of the gratings: the means over both.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Paraxial<T> {
    pub(crate) s: T,
    pub(crate) d: T,
    /// sin θ = λ/p.
    pub(crate) sin_theta: T,
}

#[derive(Clone, Debug)]
struct PlacedGrating<T> {
    axes: Axes<T>,
    /// mλ/p with the order m of this view.
    shift: T,
    order: f64,
    /// Pinhole to this grating's pivot.
    distance: T,
    plate: Option<Plate<T>>,
    side: SubstrateSide,
    thickness_mm: f64,
}

#[derive(Clone, Copy, Debug)]
struct Plate<T> {
    thickness: T,
    index: T,
}

/// A line of sight in world coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WorldRay<T> {
    pub(crate) origin: [T; 3],
    pub(crate) direction: [T; 3],
}

impl<T: Real> Setup<T> {
    /// The set-up with every parameter constant.
    pub(crate) fn new(o: &Optics, maps: &DistortionMaps) -> Self {
        Self::with(o, maps, |_, value| T::constant(value))
    }

    /// The set-up with the scalars that `scalar` makes of each parameter's value, for instance
    /// variables to differentiate by.
    pub(crate) fn with(o: &Optics, maps: &DistortionMaps, scalar: impl Fn(Parameter, f64) -> T) -> Self {
        use GratingParameter as G;
        use Parameter as P;
        let of = |p: Parameter| scalar(p, p.get(o));
        let nothing = |c: &T| c.value() == 0.0 && c.is_constant();
        let (s, d, wavelength) = (of(P::PinholeToGrating), of(P::GratingToReference), of(P::Wavelength));
        let offsets = View::BOTH.map(|view| of(P::Grating(view, G::Offset)));
        let gratings = View::BOTH.map(|view| {
            let own = |g: G| of(P::Grating(view, g));
            let order = view.traced_order();
            let thickness = own(G::Thickness);
            let substrate = &o.grating(view).substrate;
            PlacedGrating {
                axes: Axes::new([own(G::TiltX), own(G::TiltY), own(G::TiltZ)]),
                shift: T::constant(order) * wavelength / own(G::Pitch),
                order,
                distance: s + offsets[view.index()],
                plate: (!nothing(&thickness)).then(|| Plate { thickness, index: own(G::Index) }),
                side: substrate.side,
                thickness_mm: substrate.thickness_mm,
            }
        });
        let tilt = [of(P::ReferenceTiltX), of(P::ReferenceTiltY), of(P::ReferenceTiltZ)];
        let origin = [of(P::ReferenceOriginX), of(P::ReferenceOriginY)];
        let square = tilt.iter().chain(&origin).all(nothing);
        let half = T::constant(0.5);
        let offset = (offsets[0] + offsets[1]) * half;
        Self {
            camera: CameraModel::of(
                of(P::FocalPx),
                [of(P::PrincipalPointX), of(P::PrincipalPointY)],
                [of(P::BrownK1), of(P::BrownK2), of(P::BrownK3), of(P::BrownP1), of(P::BrownP2)],
            ),
            maps: maps.clone(),
            s,
            d,
            reference: (!square).then(|| (Axes::new(tilt), origin)),
            paraxial: Paraxial {
                s: s + offset,
                d: d - offset,
                sin_theta: (gratings[0].shift - gratings[1].shift) * half,
            },
            gratings,
        }
    }

    /// Ideal normalised coordinates of a pixel.
    #[inline]
    pub(crate) fn direction(&self, view: View, pixel: [T; 2]) -> Result<[T; 2], TraceError> {
        let outside = || TraceError::OutsideMap { view, pixel_px: pixel.map(T::value) };
        let pixel = self.maps.remove(view, pixel).ok_or_else(outside)?;
        Ok(self.camera.direction(pixel)?)
    }

    /// Pixel of the direction with ideal normalised coordinates `q`; nothing where the lens model
    /// is not one to one.
    #[inline]
    pub(crate) fn pixel(&self, view: View, q: [T; 2]) -> Option<Result<[T; 2], TraceError>> {
        if !self.camera.is_invertible(q.map(T::value)) {
            return None;
        }
        let pixel = self.camera.pixel(q);
        let outside = || TraceError::OutsideMap { view, pixel_px: pixel.map(T::value) };
        Some(self.maps.add(view, pixel).ok_or_else(outside))
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
        let to_plane = g.distance * g.axes.normal[2] / cosines.before[2];
        let mut origin = [k[0] * to_plane, k[1] * to_plane, k[2] * to_plane];
        if let Some(plate) = &g.plate {
            origin = g.axes.past_plate(origin, &cosines, g.side, plate.thickness, plate.index);
        }
        Ok(WorldRay { origin, direction: g.axes.to_world(cosines.after) })
    }

    /// Distance of a world point behind the last surface of the view's grating, along its normal.
    pub(crate) fn behind(&self, view: View, p: [T; 3]) -> f64 {
        let g = &self.gratings[view.index()];
        let [nx, ny, nz] = g.axes.normal.map(T::value);
        let beyond = nx * p[0].value() + ny * p[1].value() + nz * (p[2] - g.distance).value();
        match g.side {
            SubstrateSide::Camera => beyond,
            SubstrateSide::Object => beyond - g.thickness_mm,
        }
    }

    /// World coordinates of the object point (x, y, h).
    #[inline]
    pub(crate) fn world(&self, p: [T; 3]) -> [T; 3] {
        let z = self.s + self.d;
        match &self.reference {
            None => [p[0], p[1], z - p[2]],
            Some((axes, [x, y])) => {
                let w = axes.to_world([p[0], p[1], -p[2]]);
                [w[0] + *x, w[1] + *y, w[2] + z]
            }
        }
    }

    /// Object coordinates (x, y, h) of the world point.
    #[inline]
    pub(crate) fn object(&self, p: [T; 3]) -> [T; 3] {
        let z = self.s + self.d;
        match &self.reference {
            None => [p[0], p[1], z - p[2]],
            Some((axes, [x, y])) => {
                let w = [p[0] - *x, p[1] - *y, p[2] - z];
                [dot(axes.across, w), dot(axes.along, w), -dot(axes.normal, w)]
            }
        }
    }

    /// A world direction in object coordinates.
    #[inline]
    pub(crate) fn object_direction(&self, v: [T; 3]) -> [T; 3] {
        match &self.reference {
            None => [v[0], v[1], -v[2]],
            Some((axes, _)) => [dot(axes.across, v), dot(axes.along, v), -dot(axes.normal, v)],
        }
    }
}

/// A validated set-up, prepared for many pixels or points.
#[derive(Clone, Debug)]
pub struct OpticalModel {
    optics: Optics,
    maps: DistortionMaps,
    pub(crate) plain: Setup<f64>,
    /// Derivatives with respect to two coordinates of one pixel or direction.
    pub(crate) by_direction: Setup<Dual<2>>,
    /// Derivatives with respect to the three coordinates of a point.
    pub(crate) by_point: Setup<Dual<3>>,
    /// Derivatives with respect to the four coordinates of a pixel pair.
    pub(crate) by_pair: Setup<Dual<4>>,
    /// Derivatives with respect to [`Parameter::ALL`].
    pub(crate) by_parameters: Setup<Dual<{ Parameter::COUNT }>>,
}

impl OpticalModel {
    /// Validates and prepares `optics`.
    ///
    /// # Errors
    /// As [`Optics::validate`].
    pub fn new(optics: &Optics) -> Result<Self, OpticsError> {
        Self::with_maps(optics, DistortionMaps::NONE)
    }

    /// As [`OpticalModel::new`], with dense distortion maps on top of the camera's Brown terms.
    ///
    /// # Errors
    /// As [`Optics::validate`].
    pub fn with_maps(optics: &Optics, maps: DistortionMaps) -> Result<Self, OpticsError> {
        optics.validate()?;
        Ok(Self {
            optics: *optics,
            plain: Setup::new(optics, &maps),
            by_direction: Setup::new(optics, &maps),
            by_point: Setup::new(optics, &maps),
            by_pair: Setup::new(optics, &maps),
            by_parameters: Setup::with(optics, &maps, |p, value| Dual::variable(value, p.index())),
            maps,
        })
    }

    /// The parameters it was made from.
    pub fn optics(&self) -> &Optics {
        &self.optics
    }

    /// The distortion maps it was made with.
    pub fn maps(&self) -> &DistortionMaps {
        &self.maps
    }

    /// Line of sight of a pixel behind the grating, in object coordinates.
    ///
    /// # Errors
    /// If the distortion cannot be undone or the order does not propagate.
    pub fn ray(&self, view: View, pixel_px: [f64; 2]) -> Result<Ray, TraceError> {
        let q = self.plain.direction(view, pixel_px)?;
        let r = self.plain.trace(view, q)?;
        let (origin, direction) = (self.plain.object(r.origin), self.plain.object_direction(r.direction));
        Ok(Ray { origin_mm: origin.into(), direction: direction.into() })
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
        let q = self.plain.direction(view, pixel_px)?;
        let r = self.plain.trace(view, q)?;
        let (origin, direction) = (self.plain.object(r.origin), self.plain.object_direction(r.direction));
        let t = (height_mm - origin[2]) / direction[2];
        let p = along(origin, direction, t);
        let distance_mm = self.plain.behind(view, self.plain.world(p));
        if !t.is_finite() {
            return Err(TraceError::NoIntersection);
        }
        if !(distance_mm > 0.0 && t > 0.0) {
            return Err(TraceError::BeforeGrating { distance_mm });
        }
        Ok(Vector3::new(p[0], p[1], height_mm))
    }
}
