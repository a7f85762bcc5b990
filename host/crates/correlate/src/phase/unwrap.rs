//! Phase unwrapping in two dimensions.

use std::f64::consts::TAU;

/// An unwrapped phase map.
#[derive(Debug, Clone, PartialEq)]
pub struct Unwrapped {
    /// Phase in radians, row by row; NaN where the pixel is not valid. Every component has its own
    /// unknown multiple of 2π.
    pub phase: Vec<f64>,
    /// Component of each pixel: 0 for none, 1 for the largest, then by decreasing size.
    pub label: Vec<u32>,
    /// Number of components.
    pub components: usize,
    /// Squares of 2 × 2 valid pixels around which the phase does not close. Where there is one, the
    /// phase depends on the path.
    pub residues: usize,
}

/// What is left of a phase difference without whole turns, −π…π.
pub(super) fn wrap(d: f64) -> f64 {
    d - TAU * (d / TAU).round()
}

/// Unwraps `wrapped` (radians, `width` per row) over the pixels that are `valid`.
///
/// Pixels that share an edge are connected; what is not connected gets its own label. Where every
/// difference between neighbours is consistent the result does not depend on the path and is found
/// by a flood; else the most reliable edges are joined first (Herráez et al., Appl. Opt. 41 (2002)
/// 7437: reliability by second differences). Deterministic.
pub fn unwrap(width: usize, wrapped: &[f32], valid: &[bool]) -> Unwrapped {
    let (mut phase, label, components) = flood(width, wrapped, valid);
    let residues = residues(width, wrapped, valid);
    let consistent =
        edges(width, valid).all(|(a, b)| (phase[a] - phase[b]).abs() <= std::f64::consts::PI + 1e-6);
    if !consistent {
        join_by_reliability(width, wrapped, valid, &mut phase);
    }
    Unwrapped { phase, label, components, residues }
}

/// Pairs of valid neighbours.
fn edges(width: usize, valid: &[bool]) -> impl Iterator<Item = (usize, usize)> + '_ {
    (0..valid.len()).filter(|&k| valid[k]).flat_map(move |k| {
        let right = (!(k + 1).is_multiple_of(width) && valid[k + 1]).then_some((k, k + 1));
        let below = (k + width < valid.len() && valid[k + width]).then_some((k, k + width));
        right.into_iter().chain(below)
    })
}

fn flood(width: usize, wrapped: &[f32], valid: &[bool]) -> (Vec<f64>, Vec<u32>, usize) {
    let n = valid.len();
    let mut phase = vec![f64::NAN; n];
    let mut label = vec![0u32; n];
    let mut sizes: Vec<(usize, u32)> = Vec::new();
    let mut stack = Vec::new();
    for start in 0..n {
        if !valid[start] || label[start] != 0 {
            continue;
        }
        let id = sizes.len() as u32 + 1;
        let mut size = 0;
        label[start] = id;
        phase[start] = f64::from(wrapped[start]);
        stack.push(start as u32);
        while let Some(k) = stack.pop() {
            let k = k as usize;
            size += 1;
            let mut visit = |m: usize| {
                if valid[m] && label[m] == 0 {
                    label[m] = id;
                    phase[m] = phase[k] + wrap(f64::from(wrapped[m]) - f64::from(wrapped[k]));
                    stack.push(m as u32);
                }
            };
            if !k.is_multiple_of(width) {
                visit(k - 1);
            }
            if !(k + 1).is_multiple_of(width) {
                visit(k + 1);
            }
            if k >= width {
                visit(k - width);
            }
            if k + width < n {
                visit(k + width);
            }
        }
        sizes.push((size, id));
    }
    sizes.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut rank = vec![0u32; sizes.len() + 1];
    for (r, (_, id)) in sizes.iter().enumerate() {
        rank[*id as usize] = r as u32 + 1;
    }
    label.iter_mut().for_each(|l| *l = rank[*l as usize]);
    (phase, label, sizes.len())
}

fn residues(width: usize, wrapped: &[f32], valid: &[bool]) -> usize {
    let rows = valid.len() / width;
    let mut count = 0;
    for y in 1..rows {
        for x in 1..width {
            let k = y * width + x;
            let loop_ = [k - width - 1, k - width, k, k - 1];
            if !loop_.iter().all(|&m| valid[m]) {
                continue;
            }
            let step = |a: usize, b: usize| wrap(f64::from(wrapped[b]) - f64::from(wrapped[a]));
            let sum: f64 = (0..4).map(|i| step(loop_[i], loop_[(i + 1) % 4])).sum();
            count += usize::from(sum.abs() > 1.0);
        }
    }
    count
}

/// Groups of pixels with their whole turns relative to a root.
struct Groups {
    parent: Vec<u32>,
    turns: Vec<i32>,
    size: Vec<u32>,
}

impl Groups {
    /// Root of k and the turns of k relative to it; shortens the path.
    fn find(&mut self, k: u32) -> (u32, i32) {
        let (mut root, mut total) = (k, 0);
        while self.parent[root as usize] != root {
            total += self.turns[root as usize];
            root = self.parent[root as usize];
        }
        let (mut at, mut rest) = (k, total);
        while self.parent[at as usize] != at {
            let (next, own) = (self.parent[at as usize], self.turns[at as usize]);
            self.parent[at as usize] = root;
            self.turns[at as usize] = rest;
            rest -= own;
            at = next;
        }
        (root, total)
    }
}

fn join_by_reliability(width: usize, wrapped: &[f32], valid: &[bool], phase: &mut [f64]) {
    let n = valid.len();
    let at = |k: usize| f64::from(wrapped[k]);
    // second differences over the four lines through a pixel; a pixel at an edge trusts nobody
    let roughness = |k: usize| -> f32 {
        let x = k % width;
        if x == 0 || x + 1 == width || k < width || k + width >= n {
            return f32::MAX / 8.0;
        }
        let mut sum = 0.0;
        for step in [1, width, width + 1, width - 1] {
            if !valid[k - step] || !valid[k + step] {
                return f32::MAX / 8.0;
            }
            let d = wrap(at(k - step) - at(k)) - wrap(at(k) - at(k + step));
            sum += d * d;
        }
        sum.sqrt() as f32
    };
    let rough: Vec<f32> = (0..n).map(|k| if valid[k] { roughness(k) } else { 0.0 }).collect();
    // positive floats order as their bits; equal ones by position
    let mut order: Vec<(u32, u32, u32)> =
        edges(width, valid).map(|(a, b)| ((rough[a] + rough[b]).to_bits(), a as u32, b as u32)).collect();
    order.sort_unstable();
    let mut groups = Groups { parent: (0..n as u32).collect(), turns: vec![0; n], size: vec![1; n] };
    for (_, a, b) in order {
        let ((ra, ta), (rb, tb)) = (groups.find(a), groups.find(b));
        if ra == rb {
            continue;
        }
        // turns that b's group needs to continue a's
        let jump = (at(b as usize) - at(a as usize)) / TAU;
        let need = -jump.round() as i32 + ta - tb;
        if groups.size[ra as usize] >= groups.size[rb as usize] {
            groups.parent[rb as usize] = ra;
            groups.turns[rb as usize] = need;
            groups.size[ra as usize] += groups.size[rb as usize];
        } else {
            groups.parent[ra as usize] = rb;
            groups.turns[ra as usize] = -need;
            groups.size[rb as usize] += groups.size[ra as usize];
        }
    }
    for k in 0..n {
        if valid[k] {
            phase[k] = at(k) + TAU * f64::from(groups.find(k as u32).1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wrapped(width: usize, height: usize, f: impl Fn(f64, f64) -> f64) -> Vec<f32> {
        (0..width * height).map(|k| wrap(f((k % width) as f64, (k / width) as f64)) as f32).collect()
    }

    /// Difference to a truth is one whole number of turns per label.
    fn agrees(u: &Unwrapped, width: usize, f: impl Fn(f64, f64) -> f64) {
        let mut offsets = vec![f64::NAN; u.components + 1];
        for (k, p) in u.phase.iter().enumerate() {
            let l = u.label[k] as usize;
            if l == 0 {
                assert!(p.is_nan());
                continue;
            }
            let d = (p - f((k % width) as f64, (k / width) as f64)) / TAU;
            assert!((d - d.round()).abs() < 1e-5);
            if offsets[l].is_nan() {
                offsets[l] = d.round();
            }
            assert_eq!(offsets[l], d.round(), "pixel {k}");
        }
    }

    #[test]
    fn steep_surface_with_a_hole_and_an_island() {
        let f = |x: f64, y: f64| 0.9 * x - 0.4 * y + 0.01 * (x - 30.0) * (y - 20.0);
        let (w, h) = (64, 48);
        let map = wrapped(w, h, f);
        // a ring-shaped gap around an island, and a hole
        let valid: Vec<bool> = (0..w * h)
            .map(|k| {
                let r = ((k % w) as f64 - 40.0).hypot((k / w) as f64 - 24.0);
                let hole = (k % w) / 8 == 1 && (k / w) / 8 == 2;
                !(9.0..12.0).contains(&r) && !hole
            })
            .collect();
        let u = unwrap(w, &map, &valid);
        assert_eq!((u.components, u.residues), (2, 0));
        agrees(&u, w, f);
        let big = u.label.iter().filter(|&&l| l == 1).count();
        assert!(big > u.label.iter().filter(|&&l| l == 2).count());
    }

    #[test]
    fn reliable_pixels_are_joined_before_a_noisy_patch() {
        let f = |x: f64, y: f64| 0.3 * x + 0.2 * y;
        let (w, h) = (60, 50);
        let mut map = wrapped(w, h, f);
        // scrambled patch: its phases are meaningless, everything around must stay right
        let inside = |k: usize| (20..32).contains(&(k % w)) && (15..30).contains(&(k / w));
        let mut state = 12345u32;
        for k in (0..w * h).filter(|&k| inside(k)) {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            map[k] = (f64::from(state >> 8) / f64::from(1u32 << 24) * TAU - std::f64::consts::PI) as f32;
        }
        let u = unwrap(w, &map, &vec![true; w * h]);
        assert!(u.residues > 10, "{}", u.residues);
        assert_eq!(u.components, 1);
        let turns = |k: usize| ((u.phase[k] - f((k % w) as f64, (k / w) as f64)) / TAU).round();
        let wrong = (0..w * h).filter(|&k| !inside(k) && turns(k) != turns(0)).count();
        assert_eq!(wrong, 0);
    }
}
