//! Each figure of chapter 4: what the thesis says, and what is found.

use super::page::{both, left_in_focus, mean, um};
use super::{ITERATIONS, Models, Results};
use crate::reproduce::document::table;
use daic_lightfield::DiffractionModel;
use std::fmt::Write as _;

/// Relative change of a lateral width that counts as none.
const LATERAL: f64 = 0.15;
/// Relative growth of an axial width that noise may cause.
const AXIAL_GROWTH: f64 = 0.15;
/// Difference of axial widths that planes 2.5 µm apart do not tell, µm.
const AXIAL_UM: f64 = 0.5;
/// Relative distance below which 0.675 % counts as reached.
const REACHED: f64 = 0.01;

/// "comes out", or not.
fn verdict(yes: bool) -> &'static str {
    if yes { "**comes out**" } else { "**does not come out**" }
}

/// Widths (x, y, z) of the bead at 20 µm under an angle: the first reconstruction of its kind.
fn at_angle(results: &Results, degrees: f64, models: Models) -> [f64; 3] {
    let found = results.angles.iter().find(|a| a.degrees == degrees && a.models == models);
    found.map_or([f64::NAN; 3], |a| a.widths.fwhm_um)
}

/// Each figure: what the thesis says, what is found.
pub(super) fn summary(results: &Results, text: &mut String) {
    if results.real.is_empty() {
        return;
    }
    let (v, p) = (DiffractionModel::Virtual, DiffractionModel::Pupil);
    let none = Models { data: None, reconstruction: None };
    let as_virtual = Models { data: Some(p), reconstruction: Some(v) };
    let plain = at_angle(results, 0.0, none);
    let line = |models: Models, k: usize| [15.0, 30.0, 45.0].map(|d| at_angle(results, d, models)[k]);
    let list = |w: &[f64]| w.iter().map(|v| um(*v)).collect::<Vec<_>>().join(", ");
    // a profile that stays open is wider than any that closes
    let wide = |v: f64| if v.is_finite() { v } else { f64::INFINITY };
    let ordered =
        |w: [f64; 3]| wide(plain[2]) > wide(w[0]) && wide(w[0]) > wide(w[1]) && wide(w[1]) > wide(w[2]);
    // the smallest of the three steps, where it is less than the planes can tell
    let step = |w: [f64; 3]| {
        let least = (plain[2] - w[0]).min(w[0] - w[1]).min(w[1] - w[2]);
        if ordered(w) && least < AXIAL_UM {
            format!(" (least step {} µm)", um(least))
        } else {
            String::new()
        }
    };
    let mut rows = Vec::new();
    let mut row = |figure: &str, thesis: &str, here: String| {
        rows.push(vec![figure.to_owned(), thesis.to_owned(), here]);
    };

    let mut here = Vec::new();
    for z in [7.5, 20.0] {
        let of = |name: &str| {
            results.real.iter().find(|r| r.0 == z && r.1 == name).map_or(f64::NAN, |r| r.2.fwhm_um[2])
        };
        let (plain, with, exact) = (of("no grating"), of("pupil as virtual"), of("pupil"));
        let found = if plain.is_finite() || with.is_finite() {
            verdict(wide(with) > wide(plain))
        } else {
            "no width to compare"
        };
        here.push(format!(
            "bead at {z} µm: z {} without, {} with ({} if reconstructed as `pupil`): {found}",
            um(plain),
            um(with),
            um(exact)
        ));
    }
    row(
        "15",
        "set-up of §4.3, 13°: with the grating worse than without",
        format!("`pupil` images reconstructed as `virtual`, as the thesis does<br>{}", here.join("<br>")),
    );

    let means = |name: &str| {
        let found = results.seven.iter().find(|b| b.name == name);
        found.map_or(([f64::NAN; 2], 0), |b| {
            let (lateral, _) = mean(b.widths.iter().flat_map(|w| [w.fwhm_um[0], w.fwhm_um[1]]));
            let (axial, open) = mean(b.widths.iter().map(|w| w.fwhm_um[2]));
            ([lateral, axial], open)
        })
    };
    let (straight, open) = means("plain");
    let here: Vec<String> = ["virtual", "pupil", "pupil as virtual"]
        .into_iter()
        .map(|name| {
            let (with, opened) = means(name);
            let better = opened <= open && with[1] < 0.75 * straight[1];
            let equal = (with[0] - straight[0]).abs() < LATERAL * straight[0];
            let [lateral, axial] = with.map(um);
            format!("`{name}`: {lateral} lateral, {axial} axial, {opened} open: {}", verdict(better && equal))
        })
        .collect();
    row(
        "16",
        "seven beads, 30°: axial much better, lateral as without",
        format!(
            "without: {} lateral, {} axial, {open} of 7 open<br>{}",
            um(straight[0]),
            um(straight[1]),
            here.join("<br>")
        ),
    );

    let here: Vec<String> =
        [("`virtual`", both(v)), ("`pupil`", both(p)), ("`pupil` images as `virtual`", as_virtual)]
            .into_iter()
            .map(|(name, models)| {
                let [x, y, z] = [0, 1, 2].map(|k| line(models, k));
                // a width that stays open is not unchanged
                let changes = x.map(|x| wide(x) / plain[0] - 1.0).into_iter();
                let changes: Vec<f64> = changes.chain(y.map(|y| wide(y) / plain[1] - 1.0)).collect();
                let most = changes.into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs()));
                let most = most.unwrap_or(f64::NAN);
                format!(
                    "{name}: z {} without, {} at 15, 30, 45°: {}{}; lateral changes by up to {:+.0} %: {}",
                    um(plain[2]),
                    list(&z),
                    verdict(ordered(z)),
                    step(z),
                    100.0 * most,
                    verdict(most.abs() < LATERAL)
                )
            })
            .collect();
    row("17", "axial better from 15 to 30 to 45°, lateral largely unchanged", here.join("<br>"));

    let of = |name: &str| results.conditions.iter().find(|c| c.name == name);
    let pair =
        |name: &str| of(name).map_or([f64::NAN; 2], |c| [c.virtual_point.fwhm_um[2], c.pupil.fwhm_um[2]]);
    let depths = ["z = 7.5 µm", "z = 20 µm", "z = 30 µm"].map(pair);
    let here: Vec<String> = ["virtual", "pupil"]
        .into_iter()
        .enumerate()
        .map(|(k, name)| {
            let w = depths.map(|d| wide(d[k]));
            let shown = depths.map(|d| d[k]);
            let found = verdict(w[1] < w[0] && w[1] < w[2]);
            let apart = w.iter().copied().fold(0.0, f64::max) - w.iter().copied().fold(f64::INFINITY, f64::min);
            let left = of("z = 7.5 µm").map_or(f64::NAN, |c| left_in_focus(c)[k]);
            format!(
                "`{name}`: z {} at 7.5, 20, 30 µm: {found}; they differ by {} µm at most, the bead at 7.5 µm leaves {:.0} % of its peak in the focal plane",
                list(&shown),
                um(apart),
                100.0 * left
            )
        })
        .collect();
    row(
        "18",
        "of beads at 7.5, 20, 30 µm the one at 20 µm is best in z",
        format!(
            "{}<br>The differences are far below the 2.5 µm between planes, and half widths do not show what is left in the focal plane: widths cannot tell which depth is best.",
            here.join("<br>")
        ),
    );

    let bits = ["8 bits", "16 bits"].map(pair);
    let same = (0..2).all(|k| (bits[0][k] - bits[1][k]).abs() < AXIAL_UM);
    row(
        "19",
        "8 bits as good as 16",
        format!(
            "z {} with 8, {} with 16 bits (`virtual`, `pupil`): {}",
            list(&bits[0]),
            list(&bits[1]),
            verdict(same)
        ),
    );

    let at = |n: usize| results.convergence.iter().find(|c| c.iterations == n);
    if let (Some(eight), Some(end)) = (at(ITERATIONS), results.convergence.last()) {
        let values = [eight.truth, eight.last, eight.change, eight.residual, eight.crime[0], eight.crime[1]];
        let below = results.convergence.iter().find(|c| c.truth.min(c.crime[0]) < REACHED);
        row(
            "20",
            "‖gⁿ − g‖/‖g‖ falls fast over 8 iterations and ends at 0.675 %",
            format!(
                "`virtual` only<br>after {ITERATIONS}: {:.0} % of the truth ({:.0} % with images by the same projector), {:.1} % of iterate {}, changing by {:.1} % an iteration<br>after {}: {:.0} % of the truth ({:.0} %), changing by {:.2} %<br>fast at first: {}; 0.675 % of the truth: {}",
                100.0 * values[0],
                100.0 * values[4],
                100.0 * values[1],
                end.iterations,
                100.0 * values[2],
                end.iterations,
                100.0 * end.truth,
                100.0 * end.crime[0],
                100.0 * end.change,
                verdict(at(1).is_some_and(|one| one.truth - eight.truth > 2.0 * (eight.truth - end.truth))),
                verdict(below.is_some())
            ),
        );
    }

    let noise = ["SNR 1000", "SNR 100", "SNR 20"].map(pair);
    let stays = (0..2).all(|k| wide(noise[2][k]) < (1.0 + AXIAL_GROWTH) * noise[0][k]);
    let disturbed = of("SNR 20").and_then(|c| c.disturbance);
    let disturbed = disturbed.map_or([[f64::NAN; 2]; 2], |d| d.map(|d| [d.distance, d.outside]));
    let percent = |k: usize| disturbed.map(|d| format!("{:.0}", 100.0 * d[k])).join(", ");
    row(
        "21",
        "good convergence down to SNR 20",
        format!(
            "z {} (`virtual`), {} (`pupil`) at SNR 1000, 100, 20: {}, judged by width alone<br>the volume of SNR 20 is {} % (`virtual`, `pupil`) away from that without noise; its largest voxel outside of the bead has {} % of the peak",
            list(&noise.map(|n| n[0])),
            list(&noise.map(|n| n[1])),
            verdict(stays),
            percent(0),
            percent(1)
        ),
    );
    writeln!(
        text,
        "### What comes out\n\n\"Better\", \"worse\" and \"best\" (figures 15, 17, 18) are taken as any difference of the axial width, open being the widest; \"much better\" (16) as a mean more than a quarter shorter, no more beads open. Lateral \"as without\" (16: mean of x and y)\nand \"unchanged\" (17: x and y at every angle) is within {:.0} %; \"as good as\" (19) an axial width within {AXIAL_UM} µm; \"fast\" (20) a distance that falls from iteration 1 to {ITERATIONS} more than twice as much as from there on; 0.675 % counts as\nreached below {:.0} %, after any number of iterations, by either kind of images; \"good convergence\" (21) an axial width that grows by less than {:.0} % from SNR 1000 to 20. Planes are 2.5 µm apart: steps below {AXIAL_UM} µm are named, because they mean little.\n",
        100.0 * LATERAL, 100.0 * REACHED, 100.0 * AXIAL_GROWTH
    )
    .ok();
    text.push_str(&table(&["figure", "thesis", "here; widths in µm"], &rows).replace("--:", "---"));
    let cost = line(as_virtual, 2);
    writeln!(
        text,
        "\nWhat the virtual point costs: light that behaves as the exact phase says, reconstructed with (4.8), gives axial widths of {} µm at 15, 30, 45° against {} with the exact phase throughout. The cos³ of (4.8)\nholds along the grating vector; across it the virtual point lies at V₃/cos θ, and no single point stands for a pupil that takes emission angles from 0° to 90°.\n",
        list(&cost), list(&line(both(p), 2))
    )
    .ok();
}
