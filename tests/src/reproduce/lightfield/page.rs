//! The page of chapter 4 and its figures.

use super::{Boxed, Convergence, ITERATIONS, Models, Results, Widths};
use crate::reproduce::ReproduceError;
use crate::reproduce::document::{Part, row_of, table};
use crate::reproduce::pictures::chart;
use daic_lightfield::DiffractionModel;
use daic_report::{ColourScale, GridAxes, Heatmap, Markup, SeriesStyle};
use std::fmt::Write as _;

const HEAD: &str = "
## Chapter 4: light field

`cargo xtask reproduce lightfield`. 20×, NA 0.5, 450 nm, lenslets of 150 µm and 3000 µm focal length, 15 pixels each, 35 × 35 of them; box z = 0…40 µm with z = 0 in focus; beads
of 12 µm. Images are simulated with five voxels a lenslet, planes 2 µm apart and six field samples a pixel, and reconstructed with three, 2.5 µm and five: no inverse crime.
";

fn um(v: f64) -> String {
    if v.is_finite() { format!("{v:.1}") } else { "open".into() }
}

fn cells(w: &Widths) -> Vec<String> {
    w.fwhm_um.iter().chain([&w.peak_um]).map(|v| um(*v)).collect()
}

fn model(m: Option<DiffractionModel>) -> String {
    m.map_or("–".to_owned(), |m| format!("`{}`", format!("{m:?}").to_lowercase()))
}

/// Profile along z, its largest value 1, moved by `origin`.
fn axial(w: &Widths, origin: f64) -> Vec<(f64, f64)> {
    let top = w.axial.iter().map(|p| p.1).fold(f64::MIN_POSITIVE, f64::max);
    w.axial.iter().map(|p| (p.0 - origin, p.1 / top)).collect()
}

/// Mean of what is finite, and how many are not.
fn mean(values: impl Iterator<Item = f64>) -> (f64, usize) {
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
        "Richardson–Lucy, {ITERATIONS} iterations from a uniform volume, both first orders. `virtual`: the thesis' virtual point (4.8); `pupil`: the exact phase over the pupil. Widths are full widths at half\nmaximum of profiles through the voxel nearest to the bead's centre, in µm; *open*: the profile does not fall to half within the box. A sphere of 12 µm has 12 µm; held in the\nreconstruction's voxels it has {} × {} × {}.\n",
        um(results.truth.fwhm_um[0]), um(results.truth.fwhm_um[1]), um(results.truth.fwhm_um[2])
    )
    .ok();
    let mut figures = Vec::new();
    angles(results, &mut text, &mut figures)?;
    seven(results, &mut text, &mut figures)?;
    conditions(results, &mut text, &mut figures)?;
    convergence(results, &mut text, &mut figures)?;
    real(results, &mut text, &mut figures)?;
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
            [vec![angle, model(data), model(reconstruction)], cells(&a.widths)].concat()
        })
        .collect();
    text.push_str(&table(&["angle", "images", "reconstruction", "x", "y", "z", "peak at z"], &rows));
    let own = |m: DiffractionModel| {
        let curves = results
            .angles
            .iter()
            .filter(|a| a.degrees == 0.0 || (a.models.data == Some(m) && a.models.reconstruction == Some(m)));
        curves.map(|a| (format!("{}°", a.degrees), axial(&a.widths, 0.0))).collect::<Vec<_>>()
    };
    let mut shown = Vec::new();
    for m in [DiffractionModel::Virtual, DiffractionModel::Pupil] {
        let name = format!("{m:?}").to_lowercase();
        let curves = own(m);
        let series = curves.iter().map(|(n, c)| (n.as_str(), SeriesStyle::Line, c.clone())).collect();
        let title = format!("Bead at 20 µm, profiles along z, {name}");
        let file = format!("light-angles-{name}");
        figures.push((file.clone(), chart(&title, "z, µm", "g, relative", series, None)?));
        shown.push((file, title));
    }
    let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
    text.push_str(&row_of(&shown));
    let axial_of = |degrees: f64, data, reconstruction| {
        results
            .angles
            .iter()
            .find(|a| a.degrees == degrees && a.models == Models { data, reconstruction })
            .map_or(f64::NAN, |a| a.widths.fwhm_um[2])
    };
    let (v, p) = (Some(DiffractionModel::Virtual), Some(DiffractionModel::Pupil));
    let plain = axial_of(0.0, None, None);
    let line = |m| [15.0, 30.0, 45.0].map(|d| axial_of(d, m, m));
    let ordered = |w: [f64; 3]| w[0] > w[1] && w[1] > w[2];
    let run = |m| results.angles.iter().filter(|a| a.models.data == m && a.degrees > 0.0).count() >= 3;
    if !run(v) || !run(p) {
        return Ok(());
    }
    for (name, widths) in [("virtual", line(v)), ("pupil", line(p))] {
        let [a, b, c] = widths.map(um);
        writeln!(
            text,
            "`{name}` throughout: axial width {} without the grating, {a}, {b}, {c} µm at 15, 30, 45°: the thesis' \"better with the angle\" {}.",
            um(plain),
            if ordered(widths) { "comes out" } else { "does not come out in this order" }
        )
        .ok();
    }
    let [a, b, c] = [15.0, 30.0, 45.0].map(|d| um(axial_of(d, p, v)));
    writeln!(
        text,
        "What (4.8) costs: light that behaves as the exact phase says, reconstructed with the virtual point, gives {a}, {b}, {c} µm. The cos³ of (4.8) holds along the grating vector; across it the virtual point lies at V₃/cos θ, and the pupil of NA 0.5 sees emission angles from 0° to 90° at 30°.\n"
    )
    .ok();
    Ok(())
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
    let scale = ColourScale::values(&values);
    let axes = GridAxes { x0: 0.0, dx, y0, dy, unit: "µm".into() };
    let title = format!("Seven beads, {}, maximum along {}", b.name, if along_z { "z" } else { "y" });
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
    let mut axial_means = Vec::new();
    for b in &results.seven {
        let (lateral, _) = mean(b.widths.iter().flat_map(|w| [w.fwhm_um[0], w.fwhm_um[1]]));
        let (axial, open) = mean(b.widths.iter().map(|w| w.fwhm_um[2]));
        axial_means.push(axial);
        rows.push(vec![b.name.to_owned(), um(lateral), um(axial), format!("{open} of {}", b.widths.len())]);
    }
    text.push_str(&table(
        &["reconstruction", "lateral FWHM, mean", "axial FWHM, mean", "axial, open"],
        &rows,
    ));
    text.push_str("\n`pupil as virtual`: images by the exact phase, reconstructed with the virtual point.\n");
    for (along_z, suffix) in [(true, "xy"), (false, "xz")] {
        let mut shown = Vec::new();
        for b in &results.seven {
            let file = format!("light-seven-{}-{suffix}", b.name.replace(' ', "-"));
            figures.push((file.clone(), projection(b, along_z)?));
            shown.push((file, format!("{}, {suffix}", b.name)));
        }
        let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
        text.push_str(&row_of(&shown));
    }
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
    let depths: Vec<(f64, f64)> = results
        .conditions
        .iter()
        .filter(|c| c.figure == 18)
        .map(|c| (c.z_um, c.virtual_point.fwhm_um[2]))
        .collect();
    let best = depths.iter().copied().filter(|d| d.1.is_finite()).min_by(|a, b| a.1.total_cmp(&b.1));
    if let Some((z, width)) = best {
        writeln!(
            text,
            "Figure 18: the thesis finds z = 20 µm the best of the three; here {z} µm is ({width:.1} µm axial, `virtual`)."
        )
        .ok();
    }
    let of = |name: &str| {
        results.conditions.iter().find(|c| c.name == name).map_or(f64::NAN, |c| c.virtual_point.fwhm_um[2])
    };
    writeln!(
        text,
        "Figure 19: 8 and 16 bits differ by {:.2} µm in axial width (thesis: alike). Figure 21: axial width {}, {}, {} µm at SNR 1000, 100, 20 (largest value over the noise's σ, on every pixel of the frame).\n",
        (of("8 bits") - of("16 bits")).abs(),
        um(of("SNR 1000")), um(of("SNR 100")), um(of("SNR 20"))
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
    figures.push(("light-fig20".into(), chart("Convergence", "iteration", "‖gⁿ − g‖/‖g‖, %", series, None)?));
    text.push_str(&row_of(&[("light-fig20", "Convergence")]).replace("98%", "49%"));
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
        let (file, title) = (format!("light-fig15-{z:.0}"), format!("Set-up of §4.3, bead at {z} µm"));
        figures.push((file.clone(), chart(&title, "z from the bead, µm", "g, relative", series, None)?));
        shown.push((file, title));
    }
    let shown: Vec<(&str, &str)> = shown.iter().map(|(a, b)| (a.as_str(), b.as_str())).collect();
    text.push_str(&row_of(&shown));
    let of = |z: f64, name: &str| {
        results.real.iter().find(|r| r.0 == z && r.1 == name).map_or(f64::NAN, |r| r.2.fwhm_um[2])
    };
    for z in [7.5, 20.0] {
        let (plain, with) = (of(z, "no grating"), of(z, "pupil as virtual"));
        // an open profile is worse than any width
        let worse = !with.is_finite() || (plain.is_finite() && with > plain);
        writeln!(
            text,
            "Bead at {z} µm: axial {} µm without and {} µm with the grating, reconstructed as the thesis does: that the grating made it worse {}.",
            um(plain),
            um(with),
            if worse { "comes out" } else { "does not come out" }
        )
        .ok();
    }
    text.push_str("What simulations leave out of §4.3 is what a real grating and its mounting add: zero order and higher orders in the views, tilt, aberrations of a substrate, unequal efficiency over the pupil.\n\n");
    Ok(())
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
