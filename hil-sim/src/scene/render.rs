//! Rendering of one specimen position: reflectance seen by every pixel.

use rayon::prelude::*;

use crate::scene::Scene;

/// Nodes and weights of Gauss–Legendre quadrature over one pixel, [−½, ½], weights summing to 1.
fn quadrature(points: usize) -> &'static [(f64, f64)] {
    const ONE: [(f64, f64); 1] = [(0.0, 1.0)];
    const TWO: [(f64, f64); 2] = [(-0.288_675_134_594_812_9, 0.5), (0.288_675_134_594_812_9, 0.5)];
    const THREE: [(f64, f64); 3] =
        [(-0.387_298_334_620_741_7, 5.0 / 18.0), (0.0, 8.0 / 18.0), (0.387_298_334_620_741_7, 5.0 / 18.0)];
    const FOUR: [(f64, f64); 4] = [
        (-0.430_568_155_797_026_3, 0.173_927_422_568_727),
        (-0.169_990_521_792_428_1, 0.326_072_577_431_273),
        (0.169_990_521_792_428_1, 0.326_072_577_431_273),
        (0.430_568_155_797_026_3, 0.173_927_422_568_727),
    ];
    match points {
        0 | 1 => &ONE,
        2 => &TWO,
        3 => &THREE,
        _ => &FOUR,
    }
}

impl Scene {
    /// Mean reflectance over each pixel with the stage at `stage_mm`, row by row; 0 outside the specimen.
    ///
    /// Times the light's photo-electrons per second at reflectance 1 this is the expected rate per
    /// pixel. Rows are rendered in parallel; the result does not depend on the number of threads.
    pub fn render(&self, stage_mm: [f64; 3]) -> Vec<f32> {
        let shift = self.shift(stage_mm);
        let mut image = vec![0.0f32; self.width * self.height];
        image.par_chunks_mut(self.width).enumerate().for_each(|(y, row)| self.render_row(y, shift, row));
        image
    }

    fn render_row(&self, y: usize, shift: [f64; 3], row: &mut [f32]) {
        let nodes = quadrature(self.samples);
        // A pixel whose centre passes the specimen's box by this much has no part inside; the −1
        // and +1 stretch of a pixel stays below 2 within any usable order.
        let margin = 4.0 * self.tracer.pixel_mm();
        for (x, pixel) in row.iter_mut().enumerate() {
            let view = self.view_of_column(x);
            let (x, y) = (x as f64, y as f64);
            let near = self.line(view, x, y, shift).is_some_and(|line| self.surface.may_hit(&line, margin));
            if !near {
                continue;
            }
            let mut sum = 0.0;
            for &(dy, wy) in nodes {
                for &(dx, wx) in nodes {
                    let hit =
                        self.line(view, x + dx, y + dy, shift).and_then(|line| self.surface.first_hit(&line));
                    if let Some([px, py, _]) = hit {
                        sum += wx * wy * self.texture.reflectance(px, py);
                    }
                }
            }
            *pixel = sum as f32;
        }
    }
}
