//! Rendering of one specimen position: reflectance seen by every pixel.

use rayon::prelude::*;

use crate::scene::Scene;
use crate::scene::surface::Line;

impl Scene {
    /// Mean reflectance over each pixel, the spectrum and the cone of rays with the stage at `stage_mm`, row by
    /// row; 0 outside the specimen.
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
        let pixel_mm = self.instrument.pixel_mm();
        for (x, pixel) in row.iter_mut().enumerate() {
            let view = self.view_of_column(x);
            let (x, y) = (x as f64, y as f64);
            let middle = self.line(view, x, y, self.mean_wavelength_mm, shift);
            // Where a field stop cuts the pixel, its middle may see nothing and its rim something.
            let near = |line: Line| self.surface.may_hit(&line, self.reach_mm);
            if !middle.map_or(self.instrument.has_stop(), near) {
                continue;
            }
            let mut sum = 0.0;
            for &(wavelength, weight) in &self.spectrum {
                for &(dy, wy) in &self.nodes {
                    for &(dx, wx) in &self.nodes {
                        let seen = self
                            .line(view, x + dx, y + dy, wavelength, shift)
                            .map_or(0.0, |line| self.reflectance(&line, shift, pixel_mm));
                        sum += weight * wx * wy * seen;
                    }
                }
            }
            *pixel = sum as f32;
        }
    }

    /// Mean reflectance that the cone about a chief ray meets; 0 beyond the specimen.
    #[inline]
    fn reflectance(&self, chief: &Line, shift: [f64; 3], pixel_mm: f64) -> f64 {
        let at = |line: &Line| {
            self.surface.first_hit(line).map_or(0.0, |[x, y, _]| self.texture.reflectance(x, y))
        };
        let Some(cone) = &self.cone else { return at(chief) };
        let focus = cone.focus_mm - shift[2];
        // So near the sharp plane that the cone is narrower than a twentieth of a pixel, its chief ray does.
        if let Some([x, y, h]) = self.surface.first_hit(chief)
            && (h - focus).abs() * cone.widest < 0.05 * pixel_mm
        {
            return self.texture.reflectance(x, y);
        }
        let [x, y] = chief.at_height(focus);
        let fall = -chief.direction[2];
        let lean = [chief.direction[0] / fall, chief.direction[1] / fall];
        cone.rays
            .iter()
            .map(|&([a, b], weight)| {
                let direction = [lean[0] + a, lean[1] + b, -1.0];
                // Lines begin in front of the specimen.
                let origin = [x - direction[0], y - direction[1], focus + 1.0];
                weight * at(&Line { origin, direction })
            })
            .sum()
    }
}
