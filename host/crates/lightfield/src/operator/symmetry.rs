//! Which symmetries a point spread function really has.

use crate::psf::PsfShape;

/// Symmetries found in the values of a point spread function, not assumed from its parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Symmetries {
    /// Unchanged by y → −y.
    pub mirror_y: bool,
    /// Unchanged by x → −x.
    pub mirror_x: bool,
    /// Unchanged by the exchange of y and x.
    pub exchange: bool,
    /// Unchanged by a turn of 180°.
    pub turn: bool,
}

/// Largest deviation that counts as rounding, relative to the largest value.
pub(crate) const ROUNDING: f32 = 3e-7;

impl Symmetries {
    /// Compares every value with its images.
    pub fn of(shape: &PsfShape, values: &[f32]) -> Self {
        let largest = values.iter().fold(0.0f32, |a, v| a.max(v.abs()));
        let limit = ROUNDING * largest;
        let test = |image: &dyn Fn([[usize; 3]; 2]) -> [[usize; 3]; 2]| holds(shape, values, limit, image);
        let n = [0, 1].map(|a| [shape.voxels[a], shape.side(), shape.pixels[a]]);
        let flip = |axis: usize, v: [usize; 3]| {
            let n = n[axis];
            [n[0] - 1 - v[0], n[1] - 1 - v[1], n[2] - 1 - v[2]]
        };
        let square = shape.voxels[0] == shape.voxels[1] && shape.pixels[0] == shape.pixels[1];
        let mirror_y = test(&|[y, x]| [flip(0, y), x]);
        let mirror_x = test(&|[y, x]| [y, flip(1, x)]);
        Self {
            mirror_y,
            mirror_x,
            exchange: square && test(&|[y, x]| [x, y]),
            turn: mirror_x && mirror_y || test(&|[y, x]| [flip(0, y), flip(1, x)]),
        }
    }
}

/// Whether no value differs from its image. Positions are [voxel, cell, pixel] along y and x.
fn holds(
    shape: &PsfShape,
    values: &[f32],
    limit: f32,
    image: &dyn Fn([[usize; 3]; 2]) -> [[usize; 3]; 2],
) -> bool {
    let [vy, vx] = shape.voxels;
    let [py, px] = shape.pixels;
    let d = shape.side();
    let place = |z: usize, [y, x]: [[usize; 3]; 2]| {
        (((((z * vy + y[0]) * vx + x[0]) * d + y[1]) * d + x[1]) * py + y[2]) * px + x[2]
    };
    for z in 0..shape.planes {
        for sy in 0..vy {
            for sx in 0..vx {
                for dy in 0..d {
                    for dx in 0..d {
                        for ny in 0..py {
                            for nx in 0..px {
                                let at = [[sy, dy, ny], [sx, dx, nx]];
                                if (values[place(z, at)] - values[place(z, image(at))]).abs() > limit {
                                    return false;
                                }
                            }
                        }
                    }
                }
            }
        }
    }
    true
}
