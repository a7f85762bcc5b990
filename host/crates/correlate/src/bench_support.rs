//! The kernels by themselves, for `benches/kernels.rs`: thin wrappers, no part of the library's
//! interface. Each kernel has its scalar reference beside it where there is one.

use crate::fft::{Search, Window};
use crate::icgn::{Scratch, Solver};
use crate::kernel::{Sampling, Sums, sweep};
use crate::plane::{self, Plane, Work};
use crate::scalar;
use crate::simd::dispatch;
use crate::subset::{Layout, Subset};
use crate::{Image, Interpolation, Reference, Settings, Target};
use fearless_simd::Level;

/// A prepared pair and one subset of it, ready for any kernel.
pub struct Bench {
    level: Level,
    reference: Reference,
    target: Target,
    settings: Settings,
    layout: Layout,
    plane: Plane,
    gradients: [Plane; 2],
    work: Work,
    subset: Subset,
    warped: Vec<f32>,
    scratch: Scratch,
    at: Sampling,
    centre: (i32, i32),
}

impl Bench {
    /// Subsets of `settings` in the middle of the images; the deformed one is sampled under a
    /// gentle gradient.
    pub fn new(reference: Image, deformed: Image, settings: Settings) -> Self {
        let level = Level::new();
        let layout = Layout::new(settings.radius());
        let centre = (reference.width() as i32 / 2, reference.height() as i32 / 2);
        let reference = Reference::new(reference);
        let target = Target::new(deformed, settings.interpolation);
        let mut subset = Subset::default();
        scalar::load(&mut subset, &layout, &reference, centre.0, centre.1, 2, &[]);
        let at = Sampling {
            x: centre.0 + 1,
            y: centre.1 - 1,
            u: [0.3, 0.01, 0.002, 1e-5, 0.0, 0.0],
            v: [0.6, 0.002, -0.003, 0.0, 1e-5, 0.0],
            mean: (subset.mean - f64::from(target.offset)) as f32,
        };
        Self {
            level,
            reference,
            target,
            settings,
            layout,
            plane: Plane::default(),
            gradients: Default::default(),
            work: Work::default(),
            subset,
            warped: Vec::new(),
            scratch: Scratch::default(),
            at,
            centre,
        }
    }

    /// Loads and prefilters the deformed image.
    pub fn prefilter(&mut self, kind: Interpolation) {
        let (image, minus) = (&self.target.image, self.target.offset);
        plane::coefficients(self.level, image, minus, kind, &mut self.work, &mut self.plane);
    }

    /// Loads the deformed image and differentiates along x and y.
    pub fn gradients(&mut self) {
        let (image, minus) = (&self.target.image, self.target.offset);
        plane::gradients(self.level, image, minus, &mut self.work, self.gradients.each_mut());
    }

    /// Packs a subset and sums its moments for a shape function of order 1.
    pub fn subset_affine(&mut self) -> f64 {
        let (level, (x, y)) = (self.level, self.centre);
        let (subset, layout, reference) = (&mut self.subset, &self.layout, &self.reference);
        dispatch!(level, s => subset.load::<_, 1>(s, layout, reference, x, y, &[]));
        self.subset.sff
    }

    /// The same for order 2.
    pub fn subset_quadratic(&mut self) -> f64 {
        let (level, (x, y)) = (self.level, self.centre);
        let (subset, layout, reference) = (&mut self.subset, &self.layout, &self.reference);
        dispatch!(level, s => subset.load::<_, 2>(s, layout, reference, x, y, &[]));
        self.subset.sff
    }

    /// Scalar reference of [`Bench::subset_affine`] (1) and [`Bench::subset_quadratic`] (2).
    pub fn subset_scalar(&mut self, order: usize) -> f64 {
        let (x, y) = self.centre;
        scalar::load(&mut self.subset, &self.layout, &self.reference, x, y, order, &[]);
        self.subset.sff
    }

    /// One sweep of the exact form, quintic, order 1.
    pub fn sweep_affine(&mut self) -> f64 {
        let (subset, layout, plane) = (&self.subset, &self.layout, &self.target.coefficients);
        let (at, warped) = (&self.at, &mut self.warped);
        sum(&dispatch!(self.level, s => sweep::<_, 6, 7, 1>(s, layout, subset, plane, at, warped)))
    }

    /// One sweep of the exact form, quintic, order 2.
    pub fn sweep_quadratic(&mut self) -> f64 {
        let (subset, layout, plane) = (&self.subset, &self.layout, &self.target.coefficients);
        let (at, warped) = (&self.at, &mut self.warped);
        sum(&dispatch!(self.level, s => sweep::<_, 6, 7, 2>(s, layout, subset, plane, at, warped)))
    }

    /// Scalar reference of the sweeps.
    pub fn sweep_scalar(&mut self, order: usize) -> f64 {
        let plane = &self.target.coefficients;
        sum(&scalar::sweep(&self.layout, &self.subset, plane, &self.at, 6, order, &mut self.warped))
    }

    /// Search of one subset over ± `reach` whole pixels by FFT, its plans made.
    pub fn search(&mut self, reach: i32) -> impl FnMut() -> Option<f64> + '_ {
        let solver = Solver::new(&self.reference, &self.target, &self.settings, self.level);
        let window = Window::around(0.0, 0.0, reach);
        let search = Search::new(&solver.layout, &window);
        let (scratch, centre) = (&mut self.scratch, self.centre);
        move || search.best(&solver, scratch, centre, &window).map(|b| b.2)
    }
}

fn sum(s: &Sums) -> f64 {
    s.qq + s.slopes[0][0]
}
