//! From the `[processing]` section to what the crates want.

use crate::measure;
use daic_dataset::Lattice;
use daic_rig::experiment::{self, Experiment};

/// The pixels of a channel of a mosaic sensor; without one all.
pub fn lattice(bayer: Option<experiment::Bayer>) -> Lattice {
    bayer.map_or(Lattice::ALL, |b| Lattice::bayer(b.origin()))
}

/// Measurement settings of an experiment.
pub fn measure_settings(experiment: &Experiment) -> measure::Settings {
    let processing = &experiment.processing;
    measure::Settings {
        lattice: lattice(experiment.rig.camera.bayer),
        dic: daic_correlate::Settings {
            subset: processing.subset as usize,
            shape: match processing.shape {
                experiment::Shape::Translation => daic_correlate::Shape::Translation,
                experiment::Shape::Affine => daic_correlate::Shape::Affine,
                experiment::Shape::Quadratic => daic_correlate::Shape::Quadratic,
            },
            interpolation: match processing.interpolation {
                experiment::Interpolation::Cubic => daic_correlate::Interpolation::Cubic,
                experiment::Interpolation::Quintic => daic_correlate::Interpolation::Quintic,
                experiment::Interpolation::Septic => daic_correlate::Interpolation::Septic,
            },
            criterion: match processing.criterion {
                experiment::Criterion::Znssd => daic_correlate::Criterion::Znssd,
                experiment::Criterion::Zssd => daic_correlate::Criterion::Zssd,
            },
            solver: match processing.solver {
                experiment::Solver::Auto => daic_correlate::SolverChoice::Auto,
                experiment::Solver::Exact => daic_correlate::SolverChoice::Exact,
                experiment::Solver::Dense => daic_correlate::SolverChoice::Dense,
            },
            tolerance: processing.convergence,
            max_iterations: processing.max_iterations,
            min_zncc: processing.min_zncc,
            noise: processing.noise,
            ..daic_correlate::Settings::default()
        },
        step: processing.step as usize,
        roi: processing.roi.map(|[left, right, top, bottom]| measure::Rectangle {
            x: left as usize,
            y: top as usize,
            width: (right.saturating_sub(left) + 1) as usize,
            height: (bottom.saturating_sub(top) + 1) as usize,
        }),
        ..measure::Settings::default()
    }
}

/// The decoder of that name.
pub fn decoder(decoder: experiment::Decoder) -> daic_optics::Decoder {
    match decoder {
        experiment::Decoder::Ray => daic_optics::Decoder::Ray,
        experiment::Decoder::Closed => daic_optics::Decoder::Closed,
        experiment::Decoder::Linear => daic_optics::Decoder::Linear,
    }
}
