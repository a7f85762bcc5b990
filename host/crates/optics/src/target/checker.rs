//! Checkerboards: corners, seeds and their positions.

use super::lattice::{self, Cells, Node, Seed, difference, distance, dot};
use super::{Found, Refined};
use crate::patch::saddle;
use crate::patch::{GreyView, smooth::Plane};

/// Standard deviation of the smoothing before saddles are looked for, pixels.
const SMOOTHING: f64 = 1.5;
/// Radius of the ring on which a corner must look like one, pixels.
const RING: f64 = 4.5;
/// Saddles weaker than this share of the strongest are left out (contrast enters squared).
const WEAKEST: f64 = 0.01;
/// Most saddles that are looked at.
const MOST: usize = 20_000;

/// A saddle of the smoothed image.
struct Saddle {
    at: [f64; 2],
    strength: f64,
    bright: [f64; 2],
    edges: [[f64; 2]; 2],
}

fn saddles(s: &Plane) -> Vec<Saddle> {
    let (w, h) = (s.width, s.height);
    let v = |k: usize| f64::from(s.data[k]);
    let hessian = |k: usize| {
        let xx = v(k + 1) - 2.0 * v(k) + v(k - 1);
        let yy = v(k + w) - 2.0 * v(k) + v(k - w);
        let xy = 0.25 * (v(k + w + 1) - v(k + w - 1) - v(k - w + 1) + v(k - w - 1));
        [xx, xy, yy]
    };
    let mut strength = vec![0.0_f32; w * h];
    let mut most = 0.0_f32;
    for y in 1..h - 1 {
        for x in 1..w - 1 {
            let k = y * w + x;
            let [xx, xy, yy] = hessian(k);
            strength[k] = (xy * xy - xx * yy).max(0.0) as f32;
            most = most.max(strength[k]);
        }
    }
    let least = WEAKEST as f32 * most;
    let mut found = Vec::new();
    for y in 3..h.saturating_sub(3) {
        for x in 3..w.saturating_sub(3) {
            let k = y * w + x;
            let own = strength[k];
            if !(own > least) || !s.is_used(k) {
                continue;
            }
            let peak = (0..25).all(|n| {
                let other = k + (n / 5) * w + n % 5 - 2 * w - 2;
                // of equal ones the first
                strength[other] < own || (strength[other] == own && other >= k)
            });
            if !peak {
                continue;
            }
            let [xx, xy, yy] = hessian(k);
            let (gx, gy) = (0.5 * (v(k + 1) - v(k - 1)), 0.5 * (v(k + w) - v(k - w)));
            let det = xx * yy - xy * xy;
            let step = [-(yy * gx - xy * gy) / det, -(xx * gy - xy * gx) / det];
            if !(step[0].hypot(step[1]) < 2.0) {
                continue;
            }
            let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
            let mean = 0.5 * (xx + yy);
            let half = (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
            // Along `angle` the curvature is mean + half > 0: bright.
            let open = ((mean + half) / (half - mean)).sqrt().atan();
            let unit = |a: f64| [a.cos(), a.sin()];
            found.push(Saddle {
                at: [x as f64 + step[0], y as f64 + step[1]],
                strength: f64::from(own),
                bright: unit(angle),
                edges: [unit(angle + open), unit(angle - open)],
            });
        }
    }
    found.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    found.truncate(MOST);
    found
}

/// Whether the brightness on a ring goes up and down twice.
fn is_corner(s: &Plane, at: [f64; 2]) -> bool {
    const N: usize = 16;
    let mut values = [0.0; N];
    for (k, value) in values.iter_mut().enumerate() {
        let a = std::f64::consts::TAU * k as f64 / N as f64;
        let Some(v) = s.sample(at[0] + RING * a.cos(), at[1] + RING * a.sin()) else { return false };
        *value = v;
    }
    let mean = values.iter().sum::<f64>() / N as f64;
    let power: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    let (mut re, mut im) = (0.0, 0.0);
    for (k, v) in values.iter().enumerate() {
        let a = 2.0 * std::f64::consts::TAU * k as f64 / N as f64;
        re += (v - mean) * a.cos();
        im += (v - mean) * a.sin();
    }
    (re * re + im * im) * 2.0 / N as f64 > 0.6 * power
}

fn seeds(nodes: &[Node], edges: &[[[f64; 2]; 2]], cells: &Cells, limit: f64) -> Vec<Seed> {
    let mut found = Vec::new();
    for (k, node) in nodes.iter().enumerate() {
        let Some(bright) = node.bright else { continue };
        let near = cells.about(nodes, node.at, 21, limit);
        let along = |e: [f64; 2]| {
            near.iter()
                .filter(|&&n| n != k)
                .map(|&n| (difference(nodes[n].at, node.at), nodes[n].bright))
                .filter(|(d, other)| {
                    let turned = other.is_some_and(|o| dot(o, bright).abs() < 0.6);
                    // cos 20°
                    turned && dot(*d, e) > 0.94 * d[0].hypot(d[1])
                })
                .map(|(d, _)| d)
                .min_by(|a, b| dot(*a, *a).total_cmp(&dot(*b, *b)))
        };
        let opposite = |e: [f64; 2]| {
            let (ahead, behind) = (along(e)?, along([-e[0], -e[1]])?);
            let gap = [ahead[0] + behind[0], ahead[1] + behind[1]];
            (gap[0].hypot(gap[1]) < 0.4 * ahead[0].hypot(ahead[1])).then_some(ahead)
        };
        if let (Some(a), Some(b)) = (opposite(edges[k][0]), opposite(edges[k][1])) {
            found.push(Seed { node: k, a, b });
        }
    }
    found
}

/// The largest lattice over three sizes of the image.
pub(crate) fn search(plane: &Plane) -> Found {
    let mut best = Found::default();
    let mut level = plane.clone();
    let mut scale = 1.0;
    for _ in 0..4 {
        if level.width.min(level.height) < 40 {
            break;
        }
        let smoothed = level.smoothed(SMOOTHING);
        let corners: Vec<Saddle> =
            saddles(&smoothed).into_iter().filter(|c| is_corner(&smoothed, c.at)).collect();
        let nodes: Vec<Node> =
            corners.iter().map(|c| Node { at: c.at, bright: Some(c.bright), area: 1.0 }).collect();
        let edges: Vec<[[f64; 2]; 2]> = corners.iter().map(|c| c.edges).collect();
        let cells = Cells::new(&nodes, level.width, level.height);
        let seeds = seeds(&nodes, &edges, &cells, level.width.min(level.height) as f64);
        let lattice = lattice::largest(&nodes, &cells, &seeds);
        if lattice.len() > best.lattice.len() || (best.lattice.is_empty() && nodes.len() > best.nodes.len()) {
            // Pixel i of a reduced image has its centre at scale·(i + ½) − ½ of the full one.
            let back = |c: f64| scale * (c + 0.5) - 0.5;
            let nodes = nodes.into_iter().map(|n| Node { at: n.at.map(back), ..n }).collect();
            best = Found { nodes, lattice, scale, ..Found::default() };
        }
        level = level.halved();
        scale *= 2.0;
    }
    best
}

/// Positions of the corners of a lattice.
pub(crate) fn refine(view: &GreyView<'_>, plane: &Plane, found: &Found) -> Vec<Refined> {
    let at = |index| found.lattice.get(&index).map(|&k| found.nodes[k].at);
    found
        .lattice
        .iter()
        .filter_map(|(&index, &k)| {
            let centre = found.nodes[k].at;
            let direction = |axis: usize| {
                let mut ends = [index, index];
                ends[0][axis] += 1;
                ends[1][axis] -= 1;
                match (at(ends[0]), at(ends[1])) {
                    (Some(p), Some(q)) => Some(difference(p, q).map(|v| 0.5 * v)),
                    (Some(p), None) => Some(difference(p, centre)),
                    (None, Some(q)) => Some(difference(centre, q)),
                    (None, None) => None,
                }
            };
            let (a, b) = (direction(0)?, direction(1)?);
            let cross = (a[0] * b[1] - a[1] * b[0]).abs();
            // Short of the next parallel edge, but never so short that nothing is left to fit.
            let reach = (0.6 * cross / a[0].hypot(a[1]).max(b[0].hypot(b[1]))).clamp(3.5, 14.0);
            let pixels = view.patch(centre, reach, 0.1, |_| true)?;
            let level = |s: f64| {
                plane.sample(centre[0] + 0.3 * (a[0] + s * b[0]), centre[1] + 0.3 * (a[1] + s * b[1]))
            };
            let (one, other) = (level(1.0)?, level(-1.0)?);
            let unit = |v: [f64; 2]| v.map(|c| c / v[0].hypot(v[1]));
            let levels = [0.5 * (one + other), 0.5 * (one - other)];
            let corner = saddle::fit(&pixels, centre, [unit(a), unit(b)], found.scale, levels, 0.5 * reach)?;
            let clear = corner.half.abs() > corner.noise && corner.sigma.iter().all(|s| *s < 0.5);
            (clear && distance(corner.centre, centre) < 0.5 * reach).then_some(Refined {
                index,
                centre: corner.centre,
                sigma: corner.sigma,
                contrast: 2.0 * corner.half.abs(),
                noise: corner.noise,
                area: 0.0,
            })
        })
        .collect()
}
