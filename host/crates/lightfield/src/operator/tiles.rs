//! The same operator, tile by tile of the lenslet grid.

use super::basis::Cell;
use super::{Geometry, Layout, Whole};

/// A volume cut into tiles, each with the sensor that its light reaches; images of tiles add up.
pub(crate) struct Tiles {
    whole: Whole,
    tile: Geometry,
    geometry: Geometry,
}

impl Tiles {
    /// `whole`: operator of one tile, whose sensor is larger by the radius on every side.
    pub(crate) fn new(whole: Whole, tile: Geometry, geometry: &Geometry) -> Self {
        Self { whole, tile, geometry: geometry.clone() }
    }

    /// The operator of one tile.
    pub(crate) fn whole(&self) -> &Whole {
        &self.whole
    }

    pub(crate) fn through(&self, input: &[f32], forward: bool) -> Vec<f32> {
        let g = &self.geometry;
        let s = &g.shape;
        let voxels = |cells| Layout::new(Cell { n: s.voxels, inner: s.planes }, cells);
        let pixels = |cells| Layout::new(Cell { n: s.pixels, inner: 1 }, cells);
        let (volume, sensor) = (voxels(g.cells), pixels(g.sensor));
        let (tile_volume, tile_sensor) = (voxels(self.tile.cells), pixels(self.tile.sensor));
        let mut out = vec![0f32; if forward { sensor.len() } else { volume.len() }];
        for ty in (0..g.cells[0]).step_by(self.tile.cells[0]) {
            for tx in (0..g.cells[1]).step_by(self.tile.cells[1]) {
                // first cell of the tile in the volume, and of its sensor in the sensor
                let at = [ty as isize, tx as isize];
                let seen = at.map(|a| a + g.margin - self.tile.margin);
                if forward {
                    let part = cut(&volume, input, at, &tile_volume);
                    let image = self.whole.through(&[&part], true).pop().unwrap_or_default();
                    add(&sensor, &mut out, seen, &tile_sensor, &image);
                } else {
                    let part = cut(&sensor, input, seen, &tile_sensor);
                    let back = self.whole.through(&[&part], false).pop().unwrap_or_default();
                    add(&volume, &mut out, at, &tile_volume, &back);
                }
            }
        }
        out
    }
}

/// Cells of `whole` from `at` on, zero outside.
fn cut(whole: &Layout, values: &[f32], at: [isize; 2], part: &Layout) -> Vec<f32> {
    let mut out = vec![0f32; part.len()];
    overlap(whole, at, part, |w, p| out[p..p + part.padded].copy_from_slice(&values[w..w + whole.padded]));
    out
}

/// Adds cells to those of `whole` from `at` on.
fn add(whole: &Layout, values: &mut [f32], at: [isize; 2], part: &Layout, of: &[f32]) {
    overlap(whole, at, part, |w, p| {
        for (v, o) in values[w..w + whole.padded].iter_mut().zip(&of[p..p + part.padded]) {
            *v += o;
        }
    });
}

fn overlap(whole: &Layout, at: [isize; 2], part: &Layout, mut work: impl FnMut(usize, usize)) {
    for y in 0..part.cells[0] {
        for x in 0..part.cells[1] {
            let (wy, wx) = (at[0] + y as isize, at[1] + x as isize);
            if wy < 0 || wx < 0 || wy >= whole.cells[0] as isize || wx >= whole.cells[1] as isize {
                continue;
            }
            let cell = wy as usize * whole.cells[1] + wx as usize;
            work(cell * whole.padded, (y * part.cells[1] + x) * part.padded);
        }
    }
}
