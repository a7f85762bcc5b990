//! The page of chapter 4 and its figures.

use super::summary::summary;
use super::{Boxed, Condition, Convergence, FAR_UM, ITERATIONS, Models, RADII, Results, SEVEN, Widths};
use crate::reproduce::ReproduceError;
use crate::reproduce::document::{Part, row_of, table};
use crate::reproduce::pictures::chart;
use daic_lightfield::DiffractionModel;
use daic_report::{ColourScale, GridAxes, Heatmap, Markup, SeriesStyle};
use std::fmt::Write as _;

const HEAD: &str = "
## Chapter 4: light field

`cargo xtask reproduce lightfield`, by wave optics. 20×, NA 0.5, 450 nm, lenslets of 150 µm and 3000 µm focal length, 15 × 15 pixels each, 35 × 35 of them; box z = 0…40 µm with z = 0 in focus; beads of
12 µm. `virtual`: the thesis' virtual point (4.8); `pupil`: the exact phase over the pupil, the grating's efficiency taken as 1 at all angles. Richardson–Lucy from a uniform volume with both first orders.
";

const CONVERGENCE: &str = "The thesis does not say what its g is. Against the truth nothing near 0.675 % is reached, not even with the inverse crime: the bead has an edge and a flat top that the lenslets do not carry, and after the
first iterations Richardson–Lucy sharpens slowly. Numbers of that size are what the change by one iteration comes to after some tens of iterations, and, with the inverse crime only, the distance of the images.

";

/// What was made smaller, and what it means.
const LEFT_OUT: &str = "### What the simulation simplifies

- Images are simulated on finer voxels, planes and fields than reconstructions use: five voxels a lenslet (1.5 µm), planes 2 µm apart and five field samples a pixel (2 µm at the lenslets) against three voxels
  (2.5 µm), planes 2.5 µm apart and four samples (2.5 µm). Voxels are points (the thesis smears them over three, (4.7)). What finer fields would change is in the table of point spread functions.
- Images have planes only within 7 µm of a bead's centre; elsewhere there is nothing to see.
- Point spread functions end at a radius in lenslets. VIRTUAL With `pupil` no radius does at 30° and 45°: at NA 0.5 and 30° the pupil takes emission angles from 0° to 90°, and
  what leaves at grazing angles lands tens of lenslets away. The images' radius is larger than the reconstruction's, so that the reconstruction meets light that it does not know; what lies beyond
  the images' radius is missing in both. The row with a reconstruction of larger radius shows what the smaller one costs.
- Beads emit alike in all directions and scatter nothing; the grating has no zero order and no second order in the views. Noise is added where the text says so.
";

pub(super) fn um(v: f64) -> String {
    if v.is_finite() { format!("{v:.1}") } else { "open".into() }
}

fn cells(w: &Widths) -> Vec<String> {
    w.fwhm_um.iter().chain([&w.peak_um]).map(|v| um(*v)).collect()
}

fn model(m: Option<DiffractionModel>) -> String {
    m.map_or("–".to_owned(), |m| format!("`{}`", format!("{m:?}").to_lowercase()))
}

/// What the radii of the virtual point's spread functions hold.
fn held_by_virtual(results: &Results) -> String {
    let short: Vec<String> = results
        .psfs
        .iter()
        .filter(|(what, energy, _)| what.contains(", virtual,") && *energy < 0.99)
        .map(|(what, energy, _)| format!("{what} ({:.0} %)", 100.0 * energy))
        .collect();
    if short.is_empty() {
        return "With `virtual` the radii hold 99 % and more of every plane's light.".into();
    }
    let short = short.join("; ");
    format!(
        "With `virtual` the radii hold 99 % and more of every plane's light, but for: {short}, whose deepest planes lack light (next table)."
    )
}

/// Share of its peak that the first plane, the focal one, holds of a condition's bead: `virtual`, `pupil`.
pub(super) fn left_in_focus(c: &Condition) -> [f64; 2] {
    [&c.virtual_point, &c.pupil].map(|w| axial(w, 0.0).first().map_or(f64::NAN, |p| p.1))
}

/// Profile along z, its largest value 1, moved by `origin`.
fn axial(w: &Widths, origin: f64) -> Vec<(f64, f64)> {
    let top = w.axial.iter().map(|p| p.1).fold(f64::MIN_POSITIVE, f64::max);
    w.axial.iter().map(|p| (p.0 - origin, p.1 / top)).collect()
}

/// Mean of what is finite, and how many are not.
pub(super) fn mean(values: impl Iterator<Item = f64>) -> (f64, usize) {
    let all: Vec<f64> = values.collect();
    let good: Vec<f64> = all.iter().copied().filter(|v| v.is_finite()).collect();
    (good.iter().sum::<f64>() / good.len() as f64, all.len() - good.len())
}

/// The page's part.
///
/// # Errors
/// A figure that cannot be drawn.
pub fn part(results: &Results) -> Result<Part, ReproduceError> {
    let mut text = HEAD.to_owned();
    writeln!(
        text,
        "{ITERATIONS} iterations if nothing else is said. Widths are full widths at half maximum of profiles through the voxel nearest to the bead's centre, in µm; *open*: the profile does not fall to half within the\nbox. A sphere of 12 µm has 12 µm; held in the reconstruction's voxels it has {} × {} × {} µm. Widths below that are not resolution: Richardson–Lucy makes a peak of the flat-topped bead.\n",
        um(results.truth.fwhm_um[0]), um(results.truth.fwhm_um[1]), um(results.truth.fwhm_um[2])
    )
    .ok();
    let mut figures = Vec::new();
    summary(results, &mut text);
    angles(results, &mut text, &mut figures)?;
    seven(results, &mut text, &mut figures)?;
    conditions(results, &mut text, &mut figures)?;
    convergence(results, &mut text, &mut figures)?;
    real(results, &mut text, &mut figures)?;
    if !results.light.is_empty() {
        text.push_str(&LEFT_OUT.replace("VIRTUAL", &held_by_virtual(results)));
        text.push('\n');
    }
    light(results, &mut text);
    psfs(results, &mut text);
    Ok(Part { name: "lightfield", text, figures })
}

type Figures = Vec<(String, Markup)>;

fn angles(results: &Results, text: &mut String, figures: &mut Figures) -> Result<(), ReproduceError> {
    text.push_str("### Figures 16 and 17: a bead at z = 20 µm, by diffraction angle\n\n");
    let rows: Vec<Vec<String>> = results
        .angles
        .iter()
        .map(|a| {
            let Models { data, reconstruction } = a.models;
            let angle = if a.degrees == 0.0 { "no grating".into() } else { format!("{}°", a.degrees) };
            let radius = a.radius.to_string();
            [vec![angle, model(data), model(reconstruction), radius], cells(&a.widths)].concat()
        })
        .collect();
    let head = ["angle", "images", "reconstruction", "its radius", "x", "y", "z", "peak at z"];
    text.push_str(&table(&head, &rows));
    let own = |m: DiffractionModel, of: &dyn Fn(&Widths) -> Vec<(f64, f64)>| {
        let mut curves: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
        for a in &results.angles {
            let name = if a.degrees == 0.0 { "no grating".into() } else { format!("{}°", a.degrees) };
            let shown = a.degrees == 0.0 || a.models == both(m);
            // of one angle the first reconstruction
            if shown && curves.iter().all(|c| c.0 != name) {
                curves.push((name, of(&a.widths)));
            }
        }
        curves
    };
    let mut shown = Vec::new();
    for m in [DiffractionModel::Virtual, DiffractionModel::Pupil] {
        let name = format!("{m:?}").to_lowercase();
        if m == DiffractionModel::Pupil && results.angles.iter().all(|a| a.models != both(m)) {
            continue;
        }
        for (axis, of) in [("z", &along_z as &dyn Fn(&Widths) -> _), ("x", &along_x)] {
            let curves = own(m, of);
            let series = curves.iter().map(|(n, c)| (n.as_str(), SeriesStyle::Line, c.clone())).collect();
            let title = format!("Bead at 20 µm, profiles along {axis}, {name}");
            let file = if axis == "z" {
                format!("light-angles-{name}")
            } else {
                format!("light-angles-{name}-{axis}")
            };
            let label = format!("{axis}, µm");
            figures.push((file.clone(), chart(&title, &label, "g, relative", series, None)?));
            shown.push((file, title));
        }
    }
    for pair in shown.chunks(2) {
        let pair: Vec<(&str, &str)> = pair.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
        text.push_str(&row_of(&pair));
    }
    Ok(())
}

pub(super) fn both(m: DiffractionModel) -> Models {
    Models { data: Some(m), reconstruction: Some(m) }
}

fn along_z(w: &Widths) -> Vec<(f64, f64)> {
    axial(w, 0.0)
}

fn along_x(w: &Widths) -> Vec<(f64, f64)> {
    let top = w.lateral.iter().map(|p| p.1).fold(f64::MIN_POSITIVE, f64::max);
    w.lateral.iter().map(|p| (p.0, p.1 / top)).collect()
}

/// Maximum-intensity projection of a box.
fn projection(b: &Boxed, along_z: bool) -> Result<Markup, ReproduceError> {
    let [nz, ny, nx] = b.shape;
    let [dz, dx] = b.voxel_um;
    let (height, dy, y0) = if along_z { (ny, dx, 0.0) } else { (nz, dz, b.first_um) };
    let mut values = vec![0f64; height * nx];
    for (i, v) in b.volume.iter().enumerate() {
        let row = if along_z { i / nx % ny } else { i / (nx * ny) };
        let out = &mut values[row * nx + i % nx];
        *out = out.max(f64::from(*v));
    }
    let top = values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    values.iter_mut().for_each(|v| *v /= top);
    let scale = ColourScale::values(&values);
    let axes =
        GridAxes { x0: 0.0, dx, y0, dy, unit: "µm".into(), names: ["x", if along_z { "y" } else { "z" }] };
    let title = format!("Seven beads, {}: {}", b.name, if along_z { "x and y" } else { "x and depth" });
    let map =
        Heatmap { title, width: nx, height, values, axes, quantity: "g".into(), unit: String::new(), scale };
    Ok(map.render_svg()?)
}

fn seven(results: &Results, text: &mut String, figures: &mut Figures) -> Result<(), ReproduceError> {
    if results.seven.is_empty() {
        return Ok(());
    }
    text.push_str("### Figure 16: seven beads in 256 × 256 × 40 µm, 30°\n\n");
    let mut rows = Vec::new();
    for b in &results.seven {
        let (lateral, _) = mean(b.widths.iter().flat_map(|w| [w.fwhm_um[0], w.fwhm_um[1]]));
        let (axial, open) = mean(b.widths.iter().map(|w| w.fwhm_um[2]));
        let away = b.widths.iter().zip(SEVEN).map(|(w, c)| (w.peak_um - c[2]).abs());
        let (away, _) = mean(away);
        let open = format!("{open} of {}", b.widths.len());
        // a flat top has no peak
        let away = if b.name == "true" { "–".to_owned() } else { um(away) };
        rows.push(vec![b.name.to_owned(), um(lateral), um(axial), open, away]);
    }
    let head = [
        "reconstruction",
        "lateral FWHM, mean",
        "axial FWHM, mean",
        "axial, open",
        "peak from the true depth, mean",
    ];
    text.push_str(&table(&head, &rows));
    text.push_str("\n`plain`: without the grating. `pupil as virtual`: images by the exact phase, reconstructed with the virtual point. Projections show the largest value along the third axis, relative to the largest of all; depth runs downwards from the focus.\nThe virtual point fails with the depth: of `pupil as virtual` the beads at 29 and 31 µm are smeared into crosses, which the widths through their centres show in part only.\n");
    let side = results.views.first().map_or(0, |v| v.len().isqrt());
    let mut shown = Vec::new();
    for (image, name) in results.views.iter().zip(["plus", "minus"]) {
        let values: Vec<f64> = image.iter().map(|v| f64::from(*v)).collect();
        let scale = ColourScale::values(&values);
        let title = format!("Seven beads, view {name}, exact phase");
        let axes = GridAxes { x0: 0.0, dx: 1.0, y0: 0.0, dy: 1.0, unit: "px".into(), names: ["x", "y"] };
        let (quantity, unit) = ("light".into(), String::new());
        let map =
            Heatmap { title: title.clone(), width: side, height: side, values, axes, quantity, unit, scale };
        let file = format!("light-seven-view-{name}");
        figures.push((file.clone(), map.render_svg()?));
        shown.push((file, title));
    }
    for (along_z, suffix) in [(true, "xy"), (false, "xz")] {
        for b in &results.seven {
            let file = format!("light-seven-{}-{suffix}", b.name.replace(' ', "-"));
            figures.push((file.clone(), projection(b, along_z)?));
            shown.push((file, format!("{}, {suffix}", b.name)));
        }
    }
    let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
    let (views, maps) = shown.split_at(results.views.len());
    text.push_str(&row_of(views));
    let (xy, xz) = maps.split_at(results.seven.len());
    text.push_str(&row_of(xy).replace("19%", "32%"));
    text.push_str(&row_of(xz).replace("19%", "49%"));
    Ok(())
}

fn conditions(results: &Results, text: &mut String, figures: &mut Figures) -> Result<(), ReproduceError> {
    if results.conditions.is_empty() {
        return Ok(());
    }
    text.push_str("### Figures 18, 19 and 21: depth, bits, noise (30°)\n\n");
    let rows: Vec<Vec<String>> = results
        .conditions
        .iter()
        .map(|c| {
            [vec![format!("{}: {}", c.figure, c.name)], cells(&c.virtual_point), cells(&c.pupil)].concat()
        })
        .collect();
    let head = ["figure", "`virtual`: x", "y", "z", "peak at z", "`pupil`: x", "y", "z", "peak at z"];
    text.push_str(&table(&head, &rows));
    let mut shown = Vec::new();
    for (figure, title) in [(18, "Depth of the bead"), (19, "Bits of the camera"), (21, "White noise")] {
        let list: Vec<_> = results.conditions.iter().filter(|c| c.figure == figure).collect();
        let series =
            list.iter().map(|c| (c.name, SeriesStyle::Line, axial(&c.virtual_point, c.z_um))).collect();
        let file = format!("light-fig{figure}");
        figures.push((file.clone(), chart(title, "z from the bead, µm", "g, relative", series, None)?));
        shown.push((file, title));
    }
    let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), *b)).collect();
    text.push_str(&row_of(&shown));
    let first = results.conditions.iter().find(|c| c.figure == 18);
    let [left, _] = first.map_or([f64::NAN; 2], left_in_focus);
    writeln!(
        text,
        "Of the bead at 7.5 µm {:.0} % of the peak are left in the focal plane, where the lenslets hold no depth; its half width does not show that. Planes are 2.5 µm apart: some tenths of a micrometre mean nothing.",
        100.0 * left
    )
    .ok();
    text.push_str("Curves: `virtual`. SNR: largest value of the images over the noise's σ, which is the same on every pixel; negative pixels are cut to 0.\n\n");
    let rows: Vec<Vec<String>> = results
        .conditions
        .iter()
        .filter_map(|c| {
            let percent = |v: f64| format!("{:.1}", 100.0 * v);
            let cells = c.disturbance?.map(|d| [percent(d.distance), percent(d.outside)]).concat();
            Some([vec![format!("{}: {}", c.figure, c.name)], cells].concat())
        })
        .collect();
    let head = ["figure", "`virtual`: distance, %", "outside, %", "`pupil`: distance, %", "outside, %"];
    text.push_str(&table(&head, &rows));
    writeln!(
        text,
        "\nWhat bits and noise do to the volume. *Distance*: ‖g − g₀‖/‖g₀‖ to the volume g₀ of 16 bits without noise. *Outside*: largest voxel farther than {FAR_UM:.0} µm from the bead's centre, of the peak.\n"
    )
    .ok();
    Ok(())
}

fn convergence(results: &Results, text: &mut String, figures: &mut Figures) -> Result<(), ReproduceError> {
    let curve = |value: &dyn Fn(&Convergence) -> f64| -> Vec<(f64, f64)> {
        let points = results.convergence.iter().map(|c| (c.iterations as f64, 100.0 * value(c)));
        // an iterate's distance to itself is no news
        points.filter(|p| p.1 > 0.0).collect()
    };
    let end = results.convergence.last().map_or(0, |c| c.iterations);
    let name = format!("of iterate {end}");
    let curves = [
        ("of the truth", curve(&|c| c.truth)),
        ("of the truth, images by the same projector", curve(&|c| c.crime[0])),
        (name.as_str(), curve(&|c| c.last)),
        ("change by one iteration", curve(&|c| c.change)),
        ("of the images", curve(&|c| c.residual)),
    ];
    text.push_str("### Figure 20: convergence\n\n‖gⁿ − g‖/‖g‖ in % of a bead at 20 µm, 30°, `virtual`, by what g may be. *Change*: ‖gⁿ − gⁿ⁻¹‖/‖gⁿ‖. *Images*: ‖Hgⁿ⁻¹ − f‖/‖f‖. *Own projector*: images made by the projector of the reconstruction, the inverse crime.\n\n");
    let percent = |v: f64| if v == 0.0 { "–".to_owned() } else { format!("{:.2}", 100.0 * v) };
    let rows: Vec<Vec<String>> = results
        .convergence
        .iter()
        .map(|c| {
            let values = [c.truth, c.last, c.change, c.residual, c.crime[0], c.crime[1]];
            [vec![c.iterations.to_string()], values.map(percent).to_vec()].concat()
        })
        .collect();
    let head =
        ["n", "truth", &format!("iterate {end}"), "change", "images", "own projector: truth", "images"];
    text.push_str(&table(&head, &rows));
    text.push('\n');
    let series = curves.map(|(name, curve)| (name, SeriesStyle::Line, curve)).to_vec();
    figures.push((
        "light-fig20".into(),
        chart("Convergence", "iteration", "‖gⁿ − g‖/‖g‖, %", series, Some((0.0, 100.0)))?,
    ));
    text.push_str(&row_of(&[("light-fig20", "Convergence")]).replace("98%", "60%"));
    text.push_str(CONVERGENCE);
    Ok(())
}

fn real(results: &Results, text: &mut String, figures: &mut Figures) -> Result<(), ReproduceError> {
    if results.real.is_empty() {
        return Ok(());
    }
    text.push_str("### Figure 15: the real set-up of §4.3 (grating 2 µm: 13°; lenslets 125 µm / 2500 µm; 8 bits, SNR 50)\n\n");
    let rows: Vec<Vec<String>> = results
        .real
        .iter()
        .map(|(z, name, w)| [vec![um(*z), (*name).to_owned()], cells(w)].concat())
        .collect();
    text.push_str(&table(&["bead at z", "reconstruction", "x", "y", "z", "peak at z"], &rows));
    let mut shown = Vec::new();
    for z in [7.5, 20.0] {
        let list: Vec<_> = results.real.iter().filter(|r| r.0 == z).collect();
        let series = list.iter().map(|(z, name, w)| (*name, SeriesStyle::Line, axial(w, *z))).collect();
        let place = if z < 10.0 { "near" } else { "deep" };
        let (file, title) = (format!("light-fig15-{place}"), format!("Set-up of §4.3, bead at {z} µm"));
        figures.push((file.clone(), chart(&title, "z from the bead, µm", "g, relative", series, None)?));
        shown.push((file, title));
    }
    let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
    text.push_str(&row_of(&shown));
    text.push_str("Where the grating does not make it worse here, the small angle, which the thesis suspects, is not enough to explain its result. What the simulation leaves out of §4.3 is what a real grating and its mounting add: zero order and higher orders in the views, tilt, aberrations of a substrate, unequal efficiency over the pupil.\n\n");
    Ok(())
}

fn light(results: &Results, text: &mut String) {
    if results.light.is_empty() {
        return;
    }
    text.push_str("### Light by radius\n\nShare of the light of a point on the axis that reaches the lenslets within so many of its own, per side.\n\n");
    let rows: Vec<Vec<String>> = results
        .light
        .iter()
        .map(|l| {
            let head = vec![format!("{}°", l.degrees), um(l.z_um), model(Some(l.model))];
            [head, l.held.iter().map(|h| format!("{h:.3}")).collect()].concat()
        })
        .collect();
    let radii = RADII.map(|r| r.to_string());
    let head: Vec<&str> =
        ["angle", "z, µm", "model"].into_iter().chain(radii.iter().map(String::as_str)).collect();
    text.push_str(&table(&head, &rows));
    text.push('\n');
}

fn psfs(results: &Results, text: &mut String) {
    text.push_str("### Point spread functions used\n\nLeast share of a plane's light that the radius (in lenslets) holds; change of the point spread function when the field is sampled 1.8 times as finely.\n\n");
    let rows: Vec<Vec<String>> = results
        .psfs
        .iter()
        .map(|(what, energy, error)| vec![what.clone(), format!("{energy:.4}"), format!("{error:.1e}")])
        .collect();
    text.push_str(&table(&["what", "light", "sampling"], &rows));
    text.push('\n');
}
