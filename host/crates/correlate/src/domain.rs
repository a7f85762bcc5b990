//! Pixels that subsets may use where that is not the whole image, and the subsets that they cut.

use crate::image::{Mask, MaskSums};

/// Pixels of a cut subset that are used, row by row; empty for a whole subset.
pub(crate) type Cut = Vec<bool>;

/// How much of a subset may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Coverage {
    /// All of it.
    Whole,
    /// Part of it, and enough.
    Cut,
    /// Too little, or not its centre.
    Outside,
}

/// The pixels that subsets may use, and how many of its pixels a subset must keep.
#[derive(Debug)]
pub(crate) struct Domain {
    mask: Mask,
    sums: MaskSums,
    min_inside: f64,
}

impl Domain {
    pub(crate) fn new(mask: Mask, min_inside: f64) -> Self {
        let sums = MaskSums::new(&mask);
        Self { mask, sums, min_inside }
    }

    pub(crate) fn size(&self) -> (usize, usize) {
        (self.mask.width(), self.mask.height())
    }

    fn contains(&self, x: i32, y: i32) -> bool {
        x >= 0 && y >= 0 && self.mask.contains(x as usize, y as usize)
    }

    /// Coverage of the subset of radius r around (x, y).
    pub(crate) fn coverage(&self, x: i32, y: i32, r: i32) -> Coverage {
        if !self.contains(x, y) {
            return Coverage::Outside;
        }
        let clamp = |c: i32, size: usize| i64::from(c).clamp(0, size as i64) as usize;
        let (w, h) = self.size();
        let inside =
            self.sums.count(clamp(x - r, w), clamp(y - r, h), clamp(x + r + 1, w), clamp(y + r + 1, h));
        let all = f64::from(2 * r + 1).powi(2);
        match f64::from(inside) {
            n if n == all => Coverage::Whole,
            n if n >= self.min_inside * all => Coverage::Cut,
            _ => Coverage::Outside,
        }
    }

    /// Pixels used of the subset of radius r around (x, y).
    pub(crate) fn cut(&self, x: i32, y: i32, r: i32, out: &mut Cut) {
        out.clear();
        for b in y - r..=y + r {
            out.extend((x - r..=x + r).map(|a| self.contains(a, b)));
        }
    }
}

/// Bounding box of the used pixels about the centre: smallest and largest ξ, smallest and largest η.
pub(crate) fn extent(cut: &[bool], radius: usize) -> [f64; 4] {
    let (r, width) = (radius as f64, 2 * radius + 1);
    let mut e = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
    for k in (0..cut.len()).filter(|&k| cut[k]) {
        let (xi, eta) = ((k % width) as f64 - r, (k / width) as f64 - r);
        e = [e[0].min(xi), e[1].max(xi), e[2].min(eta), e[3].max(eta)];
    }
    if e[0] > e[1] { [0.0; 4] } else { e }
}
