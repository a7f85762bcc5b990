//! The two projections of an iteration, with the work on pixels and voxels done in passing.

use super::Model;
use crate::operator::{Form, Layout, Normal, Spectra};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Work on a row of voxels: (frame, row, what came back, the volume's row); returns two sums.
pub(super) type VoxelWork<'a> = dyn Fn(usize, usize, &mut [f32], &mut [f32]) -> (f64, f64) + Sync + 'a;

/// Spectra, or in tiles plain images, of all frames and orders.
pub(super) struct Passes<'a> {
    model: &'a Model,
    orders: usize,
    spectra: Vec<Spectra>,
    images: Vec<Vec<f32>>,
    /// The spectra hold the rows of the volumes.
    prepared: bool,
}

/// Numbers that rows leave behind, whatever the order in which they are done.
struct Sums(Vec<AtomicU64>);

impl Sums {
    fn new(n: usize) -> Self {
        Self((0..n).map(|_| AtomicU64::new(0)).collect())
    }

    fn set(&self, i: usize, value: f64) {
        self.0[i].store(value.to_bits(), Ordering::Relaxed);
    }

    fn take(self) -> Vec<f64> {
        self.0.into_iter().map(|v| f64::from_bits(v.into_inner())).collect()
    }
}

impl<'a> Passes<'a> {
    pub(super) fn new(model: &'a Model, frames: usize) -> Self {
        let count = frames * model.orders;
        let spectra = (0..count).map(|_| Spectra::default()).collect();
        Self { model, orders: model.orders, spectra, images: vec![Vec::new(); count], prepared: false }
    }

    /// Hᵀ of images that `pixel(image, row, values)` fills, summed over the orders.
    pub(super) fn back_project(
        &mut self,
        volume: &Layout,
        pixel: &(dyn Fn(usize, usize, &mut [f32]) + Sync),
    ) -> Vec<Vec<f32>> {
        let [_, sensor] = self.model.operator.layouts();
        match &self.model.operator.form {
            Form::Whole(whole) => {
                for (image, s) in self.spectra.iter_mut().enumerate() {
                    let side = &whole.sensor.side;
                    whole
                        .engine
                        .turn(side, s, false, true, &mut [], &|row, values, _| pixel(image, row, values));
                }
            }
            Form::Tiled(_) => {
                for (image, values) in self.images.iter_mut().enumerate() {
                    values.resize(sensor.len(), 0.0);
                    let rows = values.par_chunks_mut(sensor.row()).enumerate();
                    rows.for_each(|(row, values)| pixel(image, row, values));
                }
            }
        }
        let mut out = vec![vec![0f32; volume.len()]; self.spectra.len() / self.orders];
        self.update(None, &mut out, false, &|_, _, values, x| {
            x.copy_from_slice(values);
            (0.0, 0.0)
        });
        out
    }

    /// Estimates of the images of `xs`, handed to `pixel`, whose numbers come back for every image and row.
    pub(super) fn forward(
        &mut self,
        xs: &[Vec<f32>],
        pixel: &(dyn Fn(usize, usize, &mut [f32]) -> f64 + Sync),
    ) -> Vec<Vec<f64>> {
        let [volume, sensor] = self.model.operator.layouts();
        let orders = self.orders;
        let mut out = Vec::new();
        match &self.model.operator.form {
            Form::Whole(whole) => {
                if !self.prepared {
                    for (image, s) in self.spectra.iter_mut().enumerate() {
                        let x = &xs[image / orders];
                        whole.engine.turn(&whole.volume.side, s, false, true, &mut [], &|row, values, _| {
                            own_row(&volume, x, row, image % orders, values);
                        });
                    }
                }
                whole.forward(&mut self.spectra);
                for (image, s) in self.spectra.iter_mut().enumerate() {
                    let sums = Sums::new(sensor.cells[0]);
                    whole.engine.turn(&whole.sensor.side, s, true, true, &mut [], &|row, values, _| {
                        sums.set(row, pixel(image, row, values));
                    });
                    out.push(sums.take());
                }
            }
            Form::Tiled(tiles) => {
                for (image, values) in self.images.iter_mut().enumerate() {
                    let mut x = xs[image / orders].clone();
                    if image % orders == 1 {
                        for (row, to) in x.chunks_exact_mut(volume.row()).enumerate() {
                            own_row(&volume, &xs[image / orders], row, 1, to);
                        }
                    }
                    *values = tiles.through(&x, true);
                    let rows = values.par_chunks_mut(sensor.row()).enumerate();
                    out.push(rows.map(|(row, values)| pixel(image, row, values)).collect());
                }
            }
        }
        self.prepared = false;
        out
    }

    /// Back-projects what `forward` left (or multiplies by the normal matrix) and hands it with the volume to
    /// `voxel(frame, row, values, x)`. `go_on`: the new volume is wanted by `forward` next.
    pub(super) fn update(
        &mut self,
        normal: Option<&Normal>,
        xs: &mut [Vec<f32>],
        go_on: bool,
        voxel: &VoxelWork<'_>,
    ) -> Vec<Vec<(f64, f64)>> {
        let [volume, _] = self.model.operator.layouts();
        let orders = self.orders;
        let count = volume.cells[0];
        let mut out = Vec::new();
        if let Some(normal) = normal {
            let frames = &mut self.spectra[..xs.len()];
            if !self.prepared {
                for (s, x) in frames.iter_mut().zip(xs.iter()) {
                    normal.engine.turn(&normal.volume.side, s, false, true, &mut [], &|row, values, _| {
                        own_row(&volume, x, row, 0, values);
                    });
                }
            }
            normal.apply(frames);
            for (frame, (s, x)) in frames.iter_mut().zip(xs).enumerate() {
                let sums = [Sums::new(count), Sums::new(count)];
                normal.engine.turn(&normal.volume.side, s, true, go_on, x, &|row, values, x| {
                    let (a, b) = voxel(frame, row, values, x);
                    sums[0].set(row, a);
                    sums[1].set(row, b);
                    values.copy_from_slice(x);
                });
                let [a, b] = sums.map(Sums::take);
                out.push(a.into_iter().zip(b).collect());
            }
            self.prepared = go_on;
            return out;
        }
        match &self.model.operator.form {
            Form::Whole(whole) => {
                whole.backward(&mut self.spectra);
                let (engine, side) = (&whole.engine, &whole.volume.side);
                for (frame, (s, x)) in self.spectra.chunks_mut(orders).zip(xs).enumerate() {
                    let (first, second) = s.split_at_mut(1);
                    let mut mirrored = Vec::new();
                    if let [second] = second {
                        mirrored.resize(volume.len(), 0.0);
                        engine.turn(side, second, true, false, &mut mirrored, &|_, values, out| {
                            volume.mirror_row(values, out);
                        });
                    }
                    let sums = [Sums::new(count), Sums::new(count)];
                    engine.turn(side, &mut first[0], true, go_on, x, &|row, values, x| {
                        if let Some(other) = mirrored.get(row * volume.row()..(row + 1) * volume.row()) {
                            for (v, o) in values.iter_mut().zip(other) {
                                *v += o;
                            }
                        }
                        let (a, b) = voxel(frame, row, values, x);
                        sums[0].set(row, a);
                        sums[1].set(row, b);
                        values.copy_from_slice(x);
                    });
                    let [a, b] = sums.map(Sums::take);
                    out.push(a.into_iter().zip(b).collect());
                    if let ([second], true) = (second, go_on) {
                        let x = &*x;
                        engine.turn(side, second, false, true, &mut [], &|row, values, _| {
                            own_row(&volume, x, row, 1, values);
                        });
                    }
                }
                self.prepared = go_on;
            }
            Form::Tiled(tiles) => {
                for (frame, (images, x)) in self.images.chunks(orders).zip(xs).enumerate() {
                    let mut back = tiles.through(&images[0], false);
                    if let Some(second) = images.get(1) {
                        let other = tiles.through(second, false);
                        let mut row = vec![0f32; volume.row()];
                        for (to, from) in
                            back.chunks_exact_mut(volume.row()).zip(other.chunks_exact(volume.row()))
                        {
                            volume.mirror_row(from, &mut row);
                            for (v, o) in to.iter_mut().zip(&row) {
                                *v += o;
                            }
                        }
                    }
                    let rows = back.par_chunks_mut(volume.row()).zip(x.par_chunks_mut(volume.row()));
                    let rows = rows.enumerate().map(|(row, (values, x))| voxel(frame, row, values, x));
                    out.push(rows.collect());
                }
            }
        }
        out
    }
}

/// A row of a volume as an order sees it.
fn own_row(volume: &Layout, x: &[f32], row: usize, order: usize, values: &mut [f32]) {
    let from = &x[row * volume.row()..(row + 1) * volume.row()];
    if order == 0 {
        values.copy_from_slice(from);
    } else {
        volume.mirror_row(from, values);
    }
}
