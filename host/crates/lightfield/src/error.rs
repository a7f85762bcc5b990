//! Errors, each with the place and the limit.

use thiserror::Error;

/// Why there is no point spread function.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PsfError {
    /// A quantity that must be positive and finite.
    #[error("{what} must be positive and finite, not {value}")]
    NotPositive {
        /// The quantity.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// A numerical aperture that the medium does not have.
    #[error("the numerical aperture {na} must be below the refractive index {index}")]
    Aperture {
        /// NA.
        na: f64,
        /// n.
        index: f64,
    },
    /// A grating whose first order does not propagate.
    #[error(
        "the first order of a grating of pitch {pitch_um} µm is evanescent: sin θ = λ/(n p) = {sine:.4}, it must be below 1"
    )]
    Evanescent {
        /// Pitch.
        pitch_um: f64,
        /// Sine of the angle.
        sine: f64,
    },
    /// A number of things that cannot be.
    #[error("{what} must be from {least} to {most}, not {value}")]
    Count {
        /// What.
        what: &'static str,
        /// The number.
        value: usize,
        /// Smallest.
        least: usize,
        /// Largest.
        most: usize,
    },
    /// Depths that are not finite.
    #[error("plane {plane} has the depth {value}, which is not a finite number")]
    Plane {
        /// Index.
        plane: usize,
        /// Depth.
        value: f64,
    },
    /// A share of energy that cannot be reached.
    #[error("the energy share must be above 0 and below 1, not {share}")]
    Share {
        /// Share.
        share: f64,
    },
    /// Too few cells for the light.
    #[error(
        "plane z = {z_um} µm: {max} cells hold {found:.4} of the light, {wanted} is asked for; allow a larger radius or a smaller share"
    )]
    Spread {
        /// Depth.
        z_um: f64,
        /// Largest radius allowed.
        max: usize,
        /// Share found.
        found: f64,
        /// Share asked for.
        wanted: f64,
    },
    /// A field that is sampled too coarsely.
    #[error(
        "the field is under-sampled: with {samples} samples a pixel (dx = {dx_um:.3} µm) the point spread function changes by {error:.3} when sampled more finely, the tolerance is {tolerance}; dx ≤ {advice_um:.3} µm is a good start"
    )]
    UnderSampled {
        /// Samples per pixel.
        samples: usize,
        /// Sample distance.
        dx_um: f64,
        /// Change found.
        error: f64,
        /// Largest allowed.
        tolerance: f64,
        /// λ f/(5 p).
        advice_um: f64,
    },
    /// The integral did not converge.
    #[error("the Debye integral does not converge: {error:.1e} remains with {nodes} nodes, 1e-11 is needed")]
    Quadrature {
        /// What remains.
        error: f64,
        /// Nodes.
        nodes: usize,
    },
    /// More memory than is allowed.
    #[error("{what} needs {needed_mib} MiB, {limit_mib} MiB are allowed")]
    Memory {
        /// What.
        what: &'static str,
        /// Needed.
        needed_mib: u64,
        /// Allowed.
        limit_mib: u64,
    },
    /// Values that do not fit the parameters.
    #[error("the stored values do not fit their parameters: {found} numbers, {expected} expected")]
    Shape {
        /// Values.
        found: usize,
        /// By the parameters.
        expected: usize,
    },
}

/// Why an operator cannot be built or applied.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum OperatorError {
    /// No lenslets.
    #[error("the lenslet grid must have from 1 to {most} cells a side, not {found}")]
    Lenslets {
        /// Cells.
        found: usize,
        /// Largest.
        most: usize,
    },
    /// A margin that leaves no sensor.
    #[error("a sensor margin of {margin} leaves nothing of {cells} cells")]
    Margin {
        /// Margin.
        margin: isize,
        /// Cells of the volume.
        cells: usize,
    },
    /// An array of the wrong size.
    #[error("{what} has {found} numbers, {expected} are needed")]
    Length {
        /// Which array.
        what: &'static str,
        /// Numbers in it.
        found: usize,
        /// Numbers needed.
        expected: usize,
    },
    /// More memory than is allowed, even in tiles.
    #[error(
        "the operator needs {needed_mib} MiB even in the smallest tiles, {limit_mib} MiB are allowed; take f16 storage, fewer planes or a smaller radius"
    )]
    Memory {
        /// Needed.
        needed_mib: u64,
        /// Allowed.
        limit_mib: u64,
    },
    /// Nothing to work on.
    #[error("no frame was given")]
    NoFrame,
}

/// Why a reconstruction cannot run.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ReconstructError {
    /// The operator.
    #[error(transparent)]
    Operator(#[from] OperatorError),
    /// A pixel that is not a number.
    #[error("pixel ({x}, {y}) of image {image} is {value}; mask it or repair the image")]
    Pixel {
        /// Image.
        image: usize,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// Value.
        value: f32,
    },
    /// Negative pixels.
    #[error(
        "{count} pixels of image {image} are negative after the background was taken off (the first at ({x}, {y}): {value}); clip them or mask them"
    )]
    Negative {
        /// Image.
        image: usize,
        /// How many.
        count: usize,
        /// Column of the first.
        x: usize,
        /// Row of the first.
        y: usize,
        /// Value of the first.
        value: f32,
    },
    /// Saturated pixels.
    #[error("{count} pixels of image {image} are saturated (≥ {level}; the first at ({x}, {y})); mask them")]
    Saturated {
        /// Image.
        image: usize,
        /// How many.
        count: usize,
        /// Saturation level.
        level: f32,
        /// Column of the first.
        x: usize,
        /// Row of the first.
        y: usize,
    },
    /// Nothing to see.
    #[error("image {image} holds no light at all")]
    Dark {
        /// Image.
        image: usize,
    },
    /// A setting.
    #[error("{what} must be {range}, not {value}")]
    Setting {
        /// Which.
        what: &'static str,
        /// What is possible.
        range: &'static str,
        /// The value.
        value: f64,
    },
}

/// Why no lattice was found in a white image.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum LatticeError {
    /// An image that is too small.
    #[error("the white image has {width} × {height} pixels; at least {least} a side are needed")]
    Small {
        /// Width.
        width: usize,
        /// Height.
        height: usize,
        /// Least.
        least: usize,
    },
    /// An array of the wrong size.
    #[error("{what} has {found_width} × {found_height} pixels, {width} × {height} are expected")]
    Size {
        /// Which image.
        what: &'static str,
        /// Found.
        found_width: usize,
        /// Found.
        found_height: usize,
        /// Expected.
        width: usize,
        /// Expected.
        height: usize,
    },
    /// No periodic pattern.
    #[error(
        "no lenslet lattice was found in the white image: the strongest period stands out by {contrast:.1} from its surroundings, {needed} is needed; is it a white image, in focus on the lenslets?"
    )]
    NoPattern {
        /// Found.
        contrast: f64,
        /// Needed.
        needed: f64,
    },
    /// The lenslets' centres do not lie on a lattice.
    #[error("only {found} of {expected} lenslets lie on a lattice; at least half must")]
    NoLattice {
        /// Lenslets that fit.
        found: usize,
        /// Lenslets expected.
        expected: usize,
    },
    /// Saturated white image.
    #[error("{share:.3} of the white image is saturated (≥ {level}); expose it shorter")]
    Saturated {
        /// Share.
        share: f64,
        /// Level.
        level: f32,
    },
    /// Nothing but dark.
    #[error("the white image is no brighter than the dark image")]
    Dark,
}
