//! The lenslet lattice of a real camera, from a white image, and frames brought onto it.
//!
//! Images are `[y][x]`; pixel (0, 0) has its centre at (0, 0), x right, y down. Positions and vectors are
//! [x, y] in pixels.

mod find;
mod rectify;

pub use find::find;
pub use rectify::{Rectified, Rectifier, cell_gains};

use crate::optics::Packing;
use serde::{Deserialize, Serialize};

/// A value with its standard uncertainty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Value.
    pub value: f64,
    /// Standard uncertainty.
    pub sigma: f64,
}

/// The lattice of lenslet centres in an image: `origin` + i `along_x` + j `along_y`, and for hexagonal packing
/// also `origin` + (i + ½) `along_x` + (j + ½) `along_y`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lattice {
    /// Width and height of the images it belongs to.
    pub size_px: [usize; 2],
    /// Packing.
    pub packing: Packing,
    /// The lenslet centre nearest to the middle of the image.
    pub origin_px: [f64; 2],
    /// Standard uncertainty of each coordinate of the origin.
    pub origin_sigma_px: [f64; 2],
    /// Side of the cell that is nearer to the x axis.
    pub along_x_px: [f64; 2],
    /// The other side.
    pub along_y_px: [f64; 2],
    /// Standard uncertainties of both sides' coordinates.
    pub sides_sigma_px: [[f64; 2]; 2],
    /// Lengths of both sides.
    pub pitch_px: [Measured; 2],
    /// Angle of `along_x` with the x axis, towards y.
    pub rotation_rad: Measured,
    /// Angle between the sides minus 90°.
    pub skew_rad: Measured,
    /// RMS distance of the measured centres from the lattice.
    pub rms_px: f64,
    /// Centres used.
    pub used: usize,
    /// Centres that did not fit.
    pub rejected: usize,
}

impl Lattice {
    /// Position of cell coordinates (along x, along y); lenslet centres are at integers.
    pub fn at(&self, u: f64, v: f64) -> [f64; 2] {
        [0, 1].map(|k| self.origin_px[k] + u * self.along_x_px[k] + v * self.along_y_px[k])
    }

    /// Area of a cell, pixels.
    pub fn cell_area(&self) -> f64 {
        let (a, b) = (self.along_x_px, self.along_y_px);
        (a[0] * b[1] - a[1] * b[0]).abs()
    }

    /// Cell coordinates of a position.
    pub fn cell_of(&self, p: [f64; 2]) -> [f64; 2] {
        let (a, b) = (self.along_x_px, self.along_y_px);
        let d = [p[0] - self.origin_px[0], p[1] - self.origin_px[1]];
        let det = a[0] * b[1] - a[1] * b[0];
        [(d[0] * b[1] - d[1] * b[0]) / det, (a[0] * d[1] - a[1] * d[0]) / det]
    }

    /// Ranges (first, last) of whole cells along both sides such that the rectangle of cells lies in the image.
    pub fn whole_cells(&self) -> [[isize; 2]; 2] {
        let [w, h] = self.size_px.map(|n| n as f64 - 1.0);
        let inside = |u: f64, v: f64| {
            let p = self.at(u, v);
            p[0] >= 0.0 && p[0] <= w && p[1] >= 0.0 && p[1] <= h
        };
        let mut range = [[0isize; 2]; 2];
        let fits = |r: &[[isize; 2]; 2]| {
            let edge = |r: [isize; 2]| [r[0] as f64 - 0.5, r[1] as f64 + 0.5];
            let (u, v) = (edge(r[0]), edge(r[1]));
            u.iter().all(|&u| v.iter().all(|&v| inside(u, v)))
        };
        // the sides grow in turn until none can
        loop {
            let mut grown = false;
            for (axis, end, step) in [(0, 0, -1), (1, 0, -1), (0, 1, 1), (1, 1, 1)] {
                let mut next = range;
                next[axis][end] += step;
                if fits(&next) {
                    range = next;
                    grown = true;
                }
            }
            if !grown {
                return range;
            }
        }
    }
}
