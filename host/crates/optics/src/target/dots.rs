//! Dot grids: candidates, seeds and centres.

use super::lattice::{self, Cells, Node, Seed, difference};
use super::local::LocalMap;
use super::{Found, Polarity, Refined};
use crate::patch::blob::{Blob, Kind, regions};
use crate::patch::ellipse::{self, Ellipse, Form, quadratic};
use crate::patch::{GreyView, smooth::Plane};

/// Least pixels of a dot.
const LEAST_AREA: usize = 12;
/// Widths of the threshold's window, as fractions of the shorter side.
const WINDOWS: [f64; 3] = [0.5, 0.2, 0.08];

/// Dots in the image by thresholding at the local mid-level.
fn candidates(plane: &Plane, mid: &[f32], std: &[f32], polarity: Polarity) -> Vec<Blob> {
    let sign = match polarity {
        Polarity::Dark => -1.0,
        Polarity::Light => 1.0,
    };
    let mut kinds: Vec<Kind> = (0..plane.data.len())
        .map(|k| {
            let over = sign * (plane.data[k] - mid[k]);
            match plane.is_used(k) {
                false => Kind::Unused,
                true if over > 0.0 && std[k] > 0.0 => Kind::Foreground,
                true => Kind::Background,
            }
        })
        .collect();
    let most = plane.data.len() / 20;
    regions(&mut kinds, plane.width, plane.height)
        .into_iter()
        .filter(|b| {
            let [long, short] = Ellipse::semi_axes(b.form());
            !b.cut
                && (LEAST_AREA..=most).contains(&b.area)
                && (0.85..1.15).contains(&b.fullness())
                && short > 0.2 * long
        })
        .collect()
}

/// Seeds from the shapes: seen through its own ellipse a square lattice of circles is square.
fn seeds(nodes: &[Node], forms: &[Form], cells: &Cells, limit: f64) -> Vec<Seed> {
    let mut found = Vec::new();
    for (k, node) in nodes.iter().enumerate() {
        let form = forms[k];
        let mut near: Vec<(f64, [f64; 2])> = cells
            .about(nodes, node.at, 13, limit)
            .into_iter()
            .filter(|&n| n != k)
            .map(|n| {
                let d = difference(nodes[n].at, node.at);
                (quadratic(form, d).sqrt(), d)
            })
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1[0].total_cmp(&b.1[0])));
        let Some(&(r, a)) = near.first() else { continue };
        let product = |d: [f64; 2]| {
            form[0] * a[0] * d[0] + form[1] * (a[0] * d[1] + a[1] * d[0]) + form[2] * a[1] * d[1]
        };
        let has = |d: [f64; 2]| near.iter().any(|n| quadratic(form, difference(n.1, d)).sqrt() < 0.3 * r);
        let across = near.iter().find(|n| (product(n.1) / (r * n.0)).abs() < 0.3 && n.0 < 1.4 * r);
        let Some(&(_, b)) = across else { continue };
        if has([-a[0], -a[1]]) && has([-b[0], -b[1]]) {
            found.push(Seed { node: k, a, b });
        }
    }
    found
}

/// The largest lattice over polarities and window sizes.
pub(crate) fn search(plane: &Plane, wanted: Option<Polarity>) -> Found {
    let smoothed = plane.smoothed(0.8);
    let side = plane.width.min(plane.height);
    let mut best = Found::default();
    for share in WINDOWS {
        let half = ((share * side as f64) as usize).max(8);
        let (mid, std) = smoothed.mid_levels(half);
        for polarity in [Polarity::Dark, Polarity::Light] {
            if wanted.is_some_and(|w| w != polarity) {
                continue;
            }
            let blobs = candidates(&smoothed, &mid, &std, polarity);
            let nodes: Vec<Node> =
                blobs.iter().map(|b| Node { at: b.centre, bright: None, area: b.area as f64 }).collect();
            let forms: Vec<Form> = blobs.iter().map(Blob::form).collect();
            let cells = Cells::new(&nodes, plane.width, plane.height);
            let seeds = seeds(&nodes, &forms, &cells, side as f64);
            let lattice = lattice::largest(&nodes, &cells, &seeds);
            if lattice.len() > best.lattice.len()
                || (best.lattice.is_empty() && nodes.len() > best.nodes.len())
            {
                best = Found { nodes, lattice, forms, polarity: Some(polarity), scale: 1.0 };
            }
        }
    }
    best
}

/// Centres of the dots of a lattice, without the correction for perspective.
pub(crate) fn refine(view: &GreyView<'_>, found: &Found) -> Vec<Refined> {
    let at = |index| found.lattice.get(&index).map(|&k| found.nodes[k].at);
    found
        .lattice
        .iter()
        .filter_map(|(&index, &k)| {
            let (centre, form) = (found.nodes[k].at, found.forms[k]);
            // Half-way to the nearest neighbour, in units of the ellipse.
            let neighbours = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]];
            let nearest = neighbours
                .iter()
                .filter_map(|[i, j]| at([index[0] + i, index[1] + j]))
                .map(|n| quadratic(form, difference(n, centre)).sqrt())
                .fold(f64::INFINITY, f64::min);
            let reach = (0.5 * nearest).clamp(1.25, 2.2);
            let [long, _] = Ellipse::semi_axes(form);
            let inside = |d: [f64; 2]| quadratic(form, d) <= reach * reach;
            let pixels = view.patch(centre, reach * long, 0.1, inside)?;
            let mean = |keep: &dyn Fn(f64) -> bool| {
                let (sum, n) = pixels
                    .iter()
                    .filter(|p| keep(quadratic(form, p.at).sqrt()))
                    .fold((0.0, 0.0_f64), |(s, n), p| (s + p.grey, n + 1.0));
                (n > 0.0).then_some(sum / n)
            };
            let levels = [mean(&|r| r > 1.2)?, mean(&|r| r < 0.6)?];
            let fit = ellipse::fit(&pixels, centre, form, levels)?;
            let right = match found.polarity {
                Some(Polarity::Dark) => fit.contrast < 0.0,
                _ => fit.contrast > 0.0,
            };
            // A dot that does not stand out of its own residuals is no dot.
            let clear = fit.contrast.abs() > 2.0 * fit.noise && fit.sigma.iter().all(|s| *s < 0.5);
            let [long, short] = Ellipse::semi_axes(fit.form);
            (right && clear).then_some(Refined {
                index,
                centre: fit.centre,
                sigma: fit.sigma,
                contrast: fit.contrast,
                noise: fit.noise,
                area: std::f64::consts::PI * long * short,
            })
        })
        .collect()
}

/// Radius of the dots in lattice steps, one for each point (none where the map is not known).
pub(crate) fn radii(points: &[Refined], maps: &[Option<LocalMap>]) -> Vec<Option<f64>> {
    points
        .iter()
        .zip(maps)
        .map(|(p, m)| m.map(|m| (p.area / (std::f64::consts::PI * m.determinant().abs())).sqrt()))
        .collect()
}
