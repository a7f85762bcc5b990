//! Connected regions of pixels and their moments.

use super::ellipse::Form;

/// A connected region.
#[derive(Clone, Debug)]
pub(crate) struct Blob {
    pub(crate) centre: [f64; 2],
    /// Pixels.
    pub(crate) area: usize,
    /// Second central moments xx, xy, yy.
    pub(crate) moments: Form,
    /// Whether it reaches the border of the image or a pixel that is not used.
    pub(crate) cut: bool,
}

impl Blob {
    /// Area divided by that of the ellipse of equal moments: 1 for a filled ellipse.
    pub(crate) fn fullness(&self) -> f64 {
        let det = self.moments[0] * self.moments[2] - self.moments[1] * self.moments[1];
        self.area as f64 / (4.0 * std::f64::consts::PI * det.max(1e-12).sqrt())
    }

    /// The form A of the ellipse dᵀ A d = 1 of equal moments (of a filled ellipse they are A⁻¹/4).
    pub(crate) fn form(&self) -> Form {
        let [xx, xy, yy] = self.moments;
        let det = 4.0 * (xx * yy - xy * xy).max(1e-12);
        [yy / det, -xy / det, xx / det]
    }
}

/// What a pixel is to the search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Background,
    Foreground,
    Unused,
}

/// Regions of foreground pixels joined by their sides, in the order of their first pixel.
pub(crate) fn regions(kinds: &mut [Kind], width: usize, height: usize) -> Vec<Blob> {
    let mut blobs = Vec::new();
    let mut stack = Vec::new();
    for first in 0..kinds.len() {
        if kinds[first] != Kind::Foreground {
            continue;
        }
        kinds[first] = Kind::Background;
        stack.push(first);
        let (mut area, mut cut) = (0_usize, false);
        let (x0, y0) = ((first % width) as f64, (first / width) as f64);
        let mut sums = [0.0_f64; 5];
        while let Some(k) = stack.pop() {
            let (x, y) = (k % width, k / width);
            area += 1;
            let (dx, dy) = (x as f64 - x0, y as f64 - y0);
            for (s, v) in sums.iter_mut().zip([dx, dy, dx * dx, dx * dy, dy * dy]) {
                *s += v;
            }
            cut |= x == 0 || y == 0 || x + 1 == width || y + 1 == height;
            let mut visit = |n: usize| match kinds[n] {
                Kind::Foreground => {
                    kinds[n] = Kind::Background;
                    stack.push(n);
                }
                Kind::Unused => cut = true,
                Kind::Background => {}
            };
            if x > 0 {
                visit(k - 1);
            }
            if x + 1 < width {
                visit(k + 1);
            }
            if y > 0 {
                visit(k - width);
            }
            if y + 1 < height {
                visit(k + width);
            }
        }
        let n = area as f64;
        let (mx, my) = (sums[0] / n, sums[1] / n);
        // 1/12: a pixel is a square, not a point.
        let moments =
            [sums[2] / n - mx * mx + 1.0 / 12.0, sums[3] / n - mx * my, sums[4] / n - my * my + 1.0 / 12.0];
        blobs.push(Blob { centre: [x0 + mx, y0 + my], area, moments, cut });
    }
    blobs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_an_ellipse() {
        let (w, h) = (60, 50);
        let inside = |k: usize| {
            let (x, y) = ((k % w) as f64 - 30.2, (k / w) as f64 - 22.7);
            (x / 14.0).powi(2) + (y / 9.0).powi(2) < 1.0
        };
        let mut kinds: Vec<Kind> =
            (0..w * h).map(|k| if inside(k) { Kind::Foreground } else { Kind::Background }).collect();
        let blobs = regions(&mut kinds, w, h);
        assert_eq!(blobs.len(), 1);
        let b = &blobs[0];
        // Pixels are in or out: 396 pixels on the area 396.
        assert!((b.centre[0] - 30.2).abs() < 0.1 && (b.centre[1] - 22.7).abs() < 0.1, "{b:?}");
        assert!((b.fullness() - 1.0).abs() < 0.01, "{}", b.fullness());
        let form = b.form();
        assert!((form[0] * 196.0 - 1.0).abs() < 0.03 && (form[2] * 81.0 - 1.0).abs() < 0.03, "{form:?}");
        assert!(!b.cut);
    }
}
