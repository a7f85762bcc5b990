//! The quantities of a set-up that can be estimated or carry an uncertainty.

use nalgebra::{DMatrix, SMatrix, SVector, SymmetricEigen};
use serde::{Deserialize, Serialize};

use crate::setup::{Optics, View};

/// A quantity of one grating, see [`Parameter::Grating`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum GratingParameter {
    /// [`crate::Grating::pitch_mm`]; only λ/p enters, so it stands for the ratio where λ is given.
    Pitch,
    /// Rotation about x, radians.
    TiltX,
    /// Rotation about y, radians.
    TiltY,
    /// Rotation about z, radians.
    TiltZ,
    /// [`crate::Grating::offset_mm`].
    Offset,
    /// Thickness of the substrate, mm.
    Thickness,
    /// Refractive index of the substrate.
    Index,
}

impl GratingParameter {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Pitch, Self::TiltX, Self::TiltY, Self::TiltZ, Self::Offset, Self::Thickness, Self::Index];
}

/// A quantity of the set-up that can be estimated or carry an uncertainty.
///
/// Its text form, in files and messages, is the name of the field it stands for
/// ([`Parameter::name`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
#[non_exhaustive]
pub enum Parameter {
    /// [`crate::Camera::focal_px`].
    FocalPx,
    /// [`crate::Camera::principal_point_px`], x.
    PrincipalPointX,
    /// [`crate::Camera::principal_point_px`], y.
    PrincipalPointY,
    /// [`crate::Brown::k1`].
    BrownK1,
    /// [`crate::Brown::k2`].
    BrownK2,
    /// [`crate::Brown::k3`].
    BrownK3,
    /// [`crate::Brown::p1`].
    BrownP1,
    /// [`crate::Brown::p2`].
    BrownP2,
    /// [`Optics::wavelength_mm`].
    Wavelength,
    /// [`Optics::pinhole_to_grating_mm`].
    PinholeToGrating,
    /// [`Optics::grating_to_reference_mm`].
    GratingToReference,
    /// Rotation of the reference plane about x, see [`crate::ReferenceFrame`].
    ReferenceTiltX,
    /// Rotation of the reference plane about y.
    ReferenceTiltY,
    /// Rotation of the reference plane about z.
    ReferenceTiltZ,
    /// Origin of the reference plane, x.
    ReferenceOriginX,
    /// Origin of the reference plane, y.
    ReferenceOriginY,
    /// A quantity of the grating in one view's path.
    Grating(View, GratingParameter),
}

/// A name that no parameter has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "there is no parameter {0:?}; parameters are named as the fields of the optics, such as camera.focal_px or minus.pitch_mm"
)]
pub struct UnknownParameter(pub String);

const SHARED: usize = 16;
const OWN: usize = GratingParameter::ALL.len();
/// Parameters that one view depends on.
pub(crate) const OF_ONE_VIEW: usize = SHARED + OWN;

impl Parameter {
    /// How many there are.
    pub const COUNT: usize = SHARED + 2 * OWN;

    /// Every parameter, in the order used for vectors and matrices over all of them.
    pub const ALL: [Self; Self::COUNT] = {
        const fn of(view: View) -> [Parameter; OWN] {
            let mut all = [Parameter::FocalPx; OWN];
            let mut i = 0;
            while i < OWN {
                all[i] = Parameter::Grating(view, GratingParameter::ALL[i]);
                i += 1;
            }
            all
        }
        let [a0, a1, a2, a3, a4, a5, a6] = of(View::Minus);
        let [b0, b1, b2, b3, b4, b5, b6] = of(View::Plus);
        [
            Self::FocalPx,
            Self::PrincipalPointX,
            Self::PrincipalPointY,
            Self::BrownK1,
            Self::BrownK2,
            Self::BrownK3,
            Self::BrownP1,
            Self::BrownP2,
            Self::Wavelength,
            Self::PinholeToGrating,
            Self::GratingToReference,
            Self::ReferenceTiltX,
            Self::ReferenceTiltY,
            Self::ReferenceTiltZ,
            Self::ReferenceOriginX,
            Self::ReferenceOriginY,
            a0,
            a1,
            a2,
            a3,
            a4,
            a5,
            a6,
            b0,
            b1,
            b2,
            b3,
            b4,
            b5,
            b6,
        ]
    };

    /// Its place in [`Parameter::ALL`].
    pub const fn index(self) -> usize {
        match self {
            Self::FocalPx => 0,
            Self::PrincipalPointX => 1,
            Self::PrincipalPointY => 2,
            Self::BrownK1 => 3,
            Self::BrownK2 => 4,
            Self::BrownK3 => 5,
            Self::BrownP1 => 6,
            Self::BrownP2 => 7,
            Self::Wavelength => 8,
            Self::PinholeToGrating => 9,
            Self::GratingToReference => 10,
            Self::ReferenceTiltX => 11,
            Self::ReferenceTiltY => 12,
            Self::ReferenceTiltZ => 13,
            Self::ReferenceOriginX => 14,
            Self::ReferenceOriginY => 15,
            Self::Grating(view, own) => SHARED + view.index() * OWN + own as usize,
        }
    }

    /// Its place among the parameters that `view` depends on, if it does.
    pub(crate) const fn index_in(self, view: View) -> Option<usize> {
        match self {
            Self::Grating(of, own) if of.index() == view.index() => Some(SHARED + own as usize),
            Self::Grating(..) => None,
            shared => Some(shared.index()),
        }
    }

    /// Name of the field it stands for.
    pub const fn name(self) -> &'static str {
        use GratingParameter as G;
        match self {
            Self::FocalPx => "camera.focal_px",
            Self::PrincipalPointX => "camera.principal_point_px[0]",
            Self::PrincipalPointY => "camera.principal_point_px[1]",
            Self::BrownK1 => "camera.brown.k1",
            Self::BrownK2 => "camera.brown.k2",
            Self::BrownK3 => "camera.brown.k3",
            Self::BrownP1 => "camera.brown.p1",
            Self::BrownP2 => "camera.brown.p2",
            Self::Wavelength => "wavelength_mm",
            Self::PinholeToGrating => "pinhole_to_grating_mm",
            Self::GratingToReference => "grating_to_reference_mm",
            Self::ReferenceTiltX => "reference.tilt_rad_xyz[0]",
            Self::ReferenceTiltY => "reference.tilt_rad_xyz[1]",
            Self::ReferenceTiltZ => "reference.tilt_rad_xyz[2]",
            Self::ReferenceOriginX => "reference.origin_mm[0]",
            Self::ReferenceOriginY => "reference.origin_mm[1]",
            Self::Grating(View::Minus, own) => match own {
                G::Pitch => "minus.pitch_mm",
                G::TiltX => "minus.tilt_rad_xyz[0]",
                G::TiltY => "minus.tilt_rad_xyz[1]",
                G::TiltZ => "minus.tilt_rad_xyz[2]",
                G::Offset => "minus.offset_mm",
                G::Thickness => "minus.substrate.thickness_mm",
                G::Index => "minus.substrate.index",
            },
            Self::Grating(View::Plus, own) => match own {
                G::Pitch => "plus.pitch_mm",
                G::TiltX => "plus.tilt_rad_xyz[0]",
                G::TiltY => "plus.tilt_rad_xyz[1]",
                G::TiltZ => "plus.tilt_rad_xyz[2]",
                G::Offset => "plus.offset_mm",
                G::Thickness => "plus.substrate.thickness_mm",
                G::Index => "plus.substrate.index",
            },
        }
    }

    /// Unit of its value: `px`, `mm`, `rad` or none.
    pub const fn unit(self) -> &'static str {
        use GratingParameter as G;
        match self {
            Self::FocalPx | Self::PrincipalPointX | Self::PrincipalPointY => "px",
            Self::BrownK1 | Self::BrownK2 | Self::BrownK3 | Self::BrownP1 | Self::BrownP2 => "",
            Self::ReferenceTiltX | Self::ReferenceTiltY | Self::ReferenceTiltZ => "rad",
            Self::Grating(_, G::TiltX | G::TiltY | G::TiltZ) => "rad",
            Self::Grating(_, G::Index) => "",
            _ => "mm",
        }
    }

    /// The parameter of this name.
    ///
    /// # Errors
    /// If there is none.
    pub fn from_name(name: &str) -> Result<Self, UnknownParameter> {
        Self::ALL.into_iter().find(|p| p.name() == name).ok_or_else(|| UnknownParameter(name.to_owned()))
    }

    /// Its value in `optics`.
    pub fn get(self, optics: &Optics) -> f64 {
        let mut copy = *optics;
        *self.field(&mut copy)
    }

    /// Sets it in `optics`, unchecked.
    pub fn set(self, optics: &mut Optics, value: f64) {
        *self.field(optics) = value;
    }

    fn field(self, o: &mut Optics) -> &mut f64 {
        use GratingParameter as G;
        match self {
            Self::FocalPx => &mut o.camera.focal_px,
            Self::PrincipalPointX => &mut o.camera.principal_point_px[0],
            Self::PrincipalPointY => &mut o.camera.principal_point_px[1],
            Self::BrownK1 => &mut o.camera.brown.k1,
            Self::BrownK2 => &mut o.camera.brown.k2,
            Self::BrownK3 => &mut o.camera.brown.k3,
            Self::BrownP1 => &mut o.camera.brown.p1,
            Self::BrownP2 => &mut o.camera.brown.p2,
            Self::Wavelength => &mut o.wavelength_mm,
            Self::PinholeToGrating => &mut o.pinhole_to_grating_mm,
            Self::GratingToReference => &mut o.grating_to_reference_mm,
            Self::ReferenceTiltX => &mut o.reference.tilt_rad_xyz[0],
            Self::ReferenceTiltY => &mut o.reference.tilt_rad_xyz[1],
            Self::ReferenceTiltZ => &mut o.reference.tilt_rad_xyz[2],
            Self::ReferenceOriginX => &mut o.reference.origin_mm[0],
            Self::ReferenceOriginY => &mut o.reference.origin_mm[1],
            Self::Grating(view, own) => {
                let g = match view {
                    View::Minus => &mut o.minus,
                    View::Plus => &mut o.plus,
                };
                match own {
                    G::Pitch => &mut g.pitch_mm,
                    G::TiltX => &mut g.tilt_rad_xyz[0],
                    G::TiltY => &mut g.tilt_rad_xyz[1],
                    G::TiltZ => &mut g.tilt_rad_xyz[2],
                    G::Offset => &mut g.offset_mm,
                    G::Thickness => &mut g.substrate.thickness_mm,
                    G::Index => &mut g.substrate.index,
                }
            }
        }
    }
}

impl From<Parameter> for String {
    fn from(parameter: Parameter) -> Self {
        parameter.name().to_owned()
    }
}

impl TryFrom<String> for Parameter {
    type Error = UnknownParameter;
    fn try_from(name: String) -> Result<Self, UnknownParameter> {
        Self::from_name(&name)
    }
}

/// Derivatives of `R` coordinates with respect to every parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterJacobian<const R: usize>(pub SMatrix<f64, R, { Parameter::COUNT }>);

impl<const R: usize> ParameterJacobian<R> {
    /// Derivatives with respect to one parameter, per unit of its field.
    pub fn by(&self, parameter: Parameter) -> SVector<f64, R> {
        self.0.column(parameter.index()).into_owned()
    }
}

/// For what the difference of two points does: their displacement, for instance.
impl<const R: usize> std::ops::Sub for ParameterJacobian<R> {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

/// Covariance of a set of parameters, such as a calibration leaves it.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterCovariance {
    parameters: Vec<Parameter>,
    matrix: DMatrix<f64>,
}

/// A matrix that is no covariance of the parameters named.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CovarianceError {
    /// Not as many rows and columns as parameters.
    #[error("covariance of {parameters} parameters has {rows} rows and {columns} columns")]
    Size {
        /// Parameters named.
        parameters: usize,
        /// Rows.
        rows: usize,
        /// Columns.
        columns: usize,
    },
    /// A parameter is named twice.
    #[error("covariance names {} twice", .0.name())]
    Repeated(Parameter),
    /// An entry is not finite, the matrix is not symmetric or a variance is negative.
    #[error("covariance of {} and {} is {value}: it must be finite, symmetric, with no |correlation| above 1", row.name(), column.name())]
    Entry {
        /// Parameter of the row.
        row: Parameter,
        /// Parameter of the column.
        column: Parameter,
        /// The value.
        value: f64,
    },
    /// Every pair fits, all together do not: some combination of the parameters would have a negative variance.
    #[error(
        "the covariance is of no possible errors: the smallest eigenvalue of its correlations is {eigenvalue}, it must not be below 0"
    )]
    Negative {
        /// Smallest eigenvalue of the matrix of correlations.
        eigenvalue: f64,
    },
}

/// Smallest eigenvalue of the correlations of a symmetric matrix with a diagonal that is not below 0; 0 for a matrix
/// without entries. A covariance has none below 0 but for rounding ([`LEAST_EIGENVALUE`]).
pub fn least_correlation_eigenvalue(covariance: &DMatrix<f64>) -> f64 {
    let n = covariance.nrows();
    let correlation = DMatrix::from_fn(n, n, |i, j| {
        let unit = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
        if i == j {
            1.0
        } else if unit > 0.0 {
            covariance[(i, j)] / unit
        } else {
            0.0
        }
    });
    if n == 0 { 0.0 } else { SymmetricEigen::new(correlation).eigenvalues.min() }
}

/// As far below 0 as rounding may bring the smallest eigenvalue of correlations written with 17 digits.
pub const LEAST_EIGENVALUE: f64 = -1e-9;

impl ParameterCovariance {
    /// Nothing uncertain.
    pub fn none() -> Self {
        Self { parameters: Vec::new(), matrix: DMatrix::zeros(0, 0) }
    }

    /// `matrix` over `parameters`, in units of their fields.
    ///
    /// # Errors
    /// See [`CovarianceError`].
    pub fn new(parameters: Vec<Parameter>, matrix: DMatrix<f64>) -> Result<Self, CovarianceError> {
        let n = parameters.len();
        if matrix.shape() != (n, n) {
            let (rows, columns) = matrix.shape();
            return Err(CovarianceError::Size { parameters: n, rows, columns });
        }
        for i in 0..n {
            if parameters[..i].contains(&parameters[i]) {
                return Err(CovarianceError::Repeated(parameters[i]));
            }
            for j in 0..=i {
                let value = matrix[(i, j)];
                let unit = (matrix[(i, i)] * matrix[(j, j)]).sqrt();
                // 1e-9: rounding of the inverse of a badly scaled matrix.
                let fits =
                    value.abs() <= unit * (1.0 + 1e-9) && (value - matrix[(j, i)]).abs() <= 1e-9 * unit;
                if !(value.is_finite() && fits && matrix[(i, i)] >= 0.0) {
                    return Err(CovarianceError::Entry { row: parameters[i], column: parameters[j], value });
                }
            }
        }
        let eigenvalue = least_correlation_eigenvalue(&matrix);
        if eigenvalue < LEAST_EIGENVALUE {
            return Err(CovarianceError::Negative { eigenvalue });
        }
        Ok(Self { parameters, matrix })
    }

    /// From independent standard deviations.
    ///
    /// # Errors
    /// See [`CovarianceError`].
    pub fn independent(sigmas: &[(Parameter, f64)]) -> Result<Self, CovarianceError> {
        let n = sigmas.len();
        let matrix = DMatrix::from_fn(n, n, |i, j| if i == j { sigmas[i].1 * sigmas[i].1 } else { 0.0 });
        Self::new(sigmas.iter().map(|(p, _)| *p).collect(), matrix)
    }

    /// The parameters, in the order of the matrix.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// The matrix.
    pub fn matrix(&self) -> &DMatrix<f64> {
        &self.matrix
    }

    /// Standard deviation of a parameter; zero if it is not among those that are uncertain.
    pub fn sigma(&self, parameter: Parameter) -> f64 {
        self.parameters.iter().position(|p| *p == parameter).map_or(0.0, |i| self.matrix[(i, i)].sqrt())
    }

    /// Covariance that it causes between two quantities with these derivatives, two points (mm²) for
    /// instance; the covariance of one where both are the same.
    pub fn between<const R: usize>(
        &self,
        a: &ParameterJacobian<R>,
        b: &ParameterJacobian<R>,
    ) -> SMatrix<f64, R, R> {
        let by = |j: &ParameterJacobian<R>| -> Vec<SVector<f64, R>> {
            self.parameters.iter().map(|p| j.by(*p)).collect()
        };
        let (a, b) = (by(a), by(b));
        let mut sum = SMatrix::zeros();
        for (i, a) in a.iter().enumerate() {
            let mut row = SVector::zeros();
            for (j, b) in b.iter().enumerate() {
                row += b * self.matrix[(i, j)];
            }
            sum += a * row.transpose();
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_names_and_fields_agree() {
        let mut o = crate::setup::tests_support::any();
        for (i, p) in Parameter::ALL.into_iter().enumerate() {
            assert_eq!(p.index(), i);
            assert_eq!(Parameter::from_name(p.name()), Ok(p));
            p.set(&mut o, 0.25 + i as f64);
        }
        for (i, p) in Parameter::ALL.into_iter().enumerate() {
            assert_eq!(p.get(&o), 0.25 + i as f64, "{}", p.name());
        }
        for view in View::BOTH {
            let mut seen: Vec<_> = Parameter::ALL.into_iter().filter_map(|p| p.index_in(view)).collect();
            seen.sort_unstable();
            assert_eq!(seen, (0..OF_ONE_VIEW).collect::<Vec<_>>());
        }
        assert!(Parameter::from_name("camera.focal").is_err());
    }

    #[test]
    fn what_is_no_covariance_is_refused() {
        let p = vec![Parameter::FocalPx, Parameter::PinholeToGrating];
        let m = |v: [f64; 4]| DMatrix::from_row_slice(2, 2, &v);
        assert!(ParameterCovariance::new(p.clone(), m([4.0, 1.0, 1.0, 1.0])).is_ok());
        for bad in
            [[4.0, 3.0, 3.0, 1.0], [4.0, 1.0, 0.0, 1.0], [4.0, 0.0, 0.0, -1.0], [f64::NAN, 0.0, 0.0, 1.0]]
        {
            assert!(matches!(
                ParameterCovariance::new(p.clone(), m(bad)),
                Err(CovarianceError::Entry { .. })
            ));
        }
        assert!(matches!(
            ParameterCovariance::new(vec![p[0]], m([1.0; 4])),
            Err(CovarianceError::Size { .. })
        ));
        assert!(matches!(
            ParameterCovariance::new(vec![p[0], p[0]], m([1.0, 0.0, 0.0, 1.0])),
            Err(CovarianceError::Repeated(_))
        ));
    }
}
