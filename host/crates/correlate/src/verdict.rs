//! What makes a converged subset a result: it lies in the images, matches better than chance, and is not
//! stretched beyond belief.

use crate::domain::{Cut, extent};
use crate::icgn::Solver;
use crate::point::Status;
use crate::shape::Warp;

/// How far a converged subset may overhang: half a pixel, so that noise does not decide on
/// subsets which touch the border.
pub(crate) const BORDER: f64 = 0.5;

/// What is known of a subset that is accepted by itself.
pub(crate) struct Accepted {
    /// Independent speckles.
    pub(crate) independent: f64,
    /// Standard uncertainties of u and v.
    pub(crate) sigma: [f32; 2],
    /// Share of noise in the energy of the gradients, the larger one of x and y.
    pub(crate) excess: f64,
}

/// What a verdict on a subset rests on.
pub(crate) struct Numbers {
    /// Pixels used, and their bounding box: smallest and largest ξ and η.
    pub(crate) count: f64,
    pub(crate) extent: [f64; 4],
    /// Σ (f − mean)².
    pub(crate) sff: f64,
    /// Σ fx², Σ fy².
    pub(crate) energy: [f64; 2],
    /// Variances of u and v per unit of residual variance.
    pub(crate) variance: [f64; 2],
    pub(crate) zncc: f64,
    /// From deformed to reference grey levels.
    pub(crate) gain: f64,
    /// Σ of the squared residuals.
    pub(crate) left: f64,
}

impl Solver<'_> {
    /// Whether the subset around (x, y), displaced by `warp`, clearly leaves the deformed image.
    pub(crate) fn leaves(&self, x: i32, y: i32, warp: &Warp) -> bool {
        let r = self.layout.radius as f64;
        let mut cut = Cut::new();
        self.cut(x, y, &mut cut);
        let used = if cut.is_empty() { [-r, r, -r, r] } else { extent(&cut, self.layout.radius) };
        !self.inside(x, y, used, warp, 2.0)
    }

    /// Whether the warped subset, of which the box `[ξ0, ξ1, η0, η1]` is used, stays within `margin`
    /// pixels of the deformed image.
    pub(crate) fn inside(
        &self,
        x: i32,
        y: i32,
        [x0, x1, y0, y1]: [f64; 4],
        warp: &Warp,
        margin: f64,
    ) -> bool {
        let w = self.target.image.width() as f64 - 1.0 + margin;
        let h = self.target.image.height() as f64 - 1.0 + margin;
        let r = self.layout.radius as f64;
        // most subsets are far from every edge
        let reach = |c: &[f64; 6]| {
            let [_, a, b, d, e, f] = c.map(f64::abs);
            r * (1.0 + a + b + r * (d + e + f))
        };
        let place = |p: i32, d: f64, reach: f64, size: f64| {
            let p = f64::from(p) + d;
            p - reach >= -margin && p + reach <= size
        };
        let [u, v] = &warp.0;
        if place(x, u[0], reach(u), w) && place(y, v[0], reach(v), h) {
            return true;
        }
        [y0, 0.5 * (y0 + y1), y1].iter().all(|&eta| {
            [x0, 0.5 * (x0 + x1), x1].iter().all(|&xi| {
                let d = warp.at(xi, eta);
                let (px, py) = (f64::from(x) + xi + d[0], f64::from(y) + eta + d[1]);
                px >= -margin && py >= -margin && px <= w && py <= h
            })
        })
    }

    /// ZNCC that unrelated speckles of the subset's size reach only with the chosen significance.
    fn threshold(&self, independent: f64) -> f64 {
        // small subsets would need more than noise leaves them: their neighbours judge them
        significant(self.settings.significance, independent).min(0.9).max(self.settings.min_zncc)
    }

    /// Whether a ZNCC reaches [`Solver::threshold`].
    #[inline(always)]
    pub(crate) fn clears(&self, zncc: f64, independent: f64) -> bool {
        // tanh x < x saves nearly all points the function
        let above = zncc >= self.settings.min_zncc;
        let x2 = self.settings.significance.powi(2) / (independent - 3.0).max(1.0);
        (above && zncc > 0.0 && zncc * zncc >= x2) || zncc >= self.threshold(independent)
    }

    /// Judges a converged subset by itself: independent speckles and standard uncertainties where it
    /// is accepted.
    #[inline(always)]
    pub(crate) fn verdict(
        &self,
        (x, y): (i32, i32),
        warp: &Warp,
        numbers: &Numbers,
    ) -> Result<Accepted, Status> {
        let independent = self.independent(numbers);
        if !self.inside(x, y, numbers.extent, warp, BORDER) {
            Err(Status::OutOfImage)
        } else if !self.clears(numbers.zncc, independent) {
            Err(Status::LowCorrelation)
        } else if !warp.stretches_less(self.settings.max_log_stretch) {
            Err(Status::Distorted)
        } else {
            let (sigma, excess) = self.sigma(warp, numbers);
            Ok(Accepted { independent, sigma, excess })
        }
    }

    /// Number of independent speckles in the subset: two unrelated fields of correlation lengths s
    /// (autocorrelation exp(−d²/2s²) each, s² = Σf²/Σf_x²) have a ZNCC of variance π s_x s_y / n
    /// over n pixels.
    fn independent(&self, numbers: &Numbers) -> f64 {
        let n = numbers.count;
        let [gxx, gyy] = numbers.energy.map(|e| e.max(f64::MIN_POSITIVE));
        n * (gxx * gyy).sqrt() / (std::f64::consts::PI * numbers.sff)
    }
}

/// ZNCC that lies `sigmas` standard deviations above chance (Fisher's z).
pub(crate) fn significant(sigmas: f64, independent: f64) -> f64 {
    (sigmas / (independent - 3.0).max(1.0).sqrt()).tanh()
}
