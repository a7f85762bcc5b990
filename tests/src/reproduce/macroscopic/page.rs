//! Tables and figures of chapter 2.

use super::super::document::{Part, row_of, table};
use super::super::pictures::{Field, chart};
use super::super::{ReproduceError, SUBSET};
use super::rig::{PIXEL_MM, SEED};
use super::specimens::{CONFINED_PX, TIP_PX};
use super::{Bench, Case, Decoded, Decoding, Results};
use daic_correlate::Shape;
use daic_optics::{Parameter, View};
use daic_report::{Markup, Overlay, SeriesStyle};

/// Limits of the error maps and sections, µm.
const ERROR_UM: f64 = 10.0;

fn um(value: f64) -> String {
    format!("{value:.2}")
}

/// Files of the specimens in their order.
fn files(bench: &Bench) -> Vec<&'static str> {
    bench.cases.iter().filter(|c| c.shape == Shape::Quadratic).map(|c| c.file).collect()
}

fn both<'a>(bench: &'a Bench, file: &str) -> Option<(&'a Case, &'a Case)> {
    Some((bench.case(file, Shape::Affine)?, bench.case(file, Shape::Quadratic)?))
}

fn main_table(bench: &Bench) -> String {
    let rows: Vec<Vec<String>> = files(bench)
        .into_iter()
        .filter_map(|file| both(bench, file))
        .map(|(a, q)| {
            vec![
                q.name.to_owned(),
                if q.file == "face" { "–".to_owned() } else { "10".to_owned() },
                um(a.um(Decoding::Calibrated)),
                format!("**{}**", um(q.um(Decoding::Calibrated))),
                um(a.measured_um[4][1]),
                um(q.measured_um[4][1]),
                format!("{:.4}", a.correlation_px),
                format!("{:.4}", q.correlation_px),
                format!("{} of {}", q.points[1], q.points[0]),
            ]
        })
        .collect();
    let head = [
        "RMS error of h, µm",
        "thesis",
        "affine",
        "quadratic",
        "affine, not registered",
        "quadratic, not registered",
        "error of u, affine, px",
        "quadratic, px",
        "points accepted",
    ];
    table(&head, &rows)
}

fn contributions(bench: &Bench) -> String {
    let names = [
        "`linear` (the thesis), no map",
        "`linear`, map through the grating",
        "`ray`, no map",
        "`ray`, map through the grating",
        "`ray`, calibrated",
    ];
    let files = files(bench);
    let mut head = vec!["RMS error of h, µm, registered".to_owned()];
    for file in &files {
        let name = bench.case(file, Shape::Quadratic).map_or("", |c| c.name);
        head.extend([format!("{name}: exact pairs"), "affine".to_owned(), "quadratic".to_owned()]);
    }
    let rows: Vec<Vec<String>> = names
        .into_iter()
        .zip(Decoding::ALL)
        .map(|(name, decoding)| {
            let mut row = vec![name.to_owned()];
            for (a, q) in files.iter().filter_map(|file| both(bench, file)) {
                row.extend([um(q.exact(decoding)), um(a.um(decoding)), um(q.um(decoding))]);
            }
            row
        })
        .collect();
    table(&head.iter().map(String::as_str).collect::<Vec<_>>(), &rows)
}

fn edges(bench: &Bench) -> String {
    let rows: Vec<Vec<String>> = ["cone", "step", "step-y"]
        .into_iter()
        .filter_map(|file| both(bench, file))
        .map(|(a, q)| {
            let name = q.name.to_owned();
            vec![name, format!("{:.1}", a.spread_px), format!("{:.1}", q.spread_px)]
        })
        .collect();
    table(
        &["farthest point that is off by more than 10 µm, px from the discontinuity", "affine", "quadratic"],
        &rows,
    )
}

fn calibration(bench: &Bench) -> String {
    let c = &bench.calibration;
    let wanted = [
        (Parameter::FocalPx, "F, px", bench.truth.camera.focal_px, 1),
        (Parameter::PinholeToGrating, "s, mm", bench.truth.pinhole_to_grating_mm, 3),
        (Parameter::GratingToReference, "d, mm", bench.truth.grating_to_reference_mm, 3),
        (Parameter::BrownK1, "k1", bench.truth.camera.brown.k1, 5),
        (Parameter::PrincipalPointX, "principal point x, px", bench.truth.camera.principal_point_px[0], 1),
    ];
    let rows: Vec<Vec<String>> = wanted
        .into_iter()
        .filter_map(|(parameter, name, truth, digits)| {
            let e = c.estimate(parameter)?;
            Some(vec![
                name.to_owned(),
                format!("{:.digits$}", e.start),
                format!("{:.digits$}", e.value),
                format!("{:.digits$}", e.sigma),
                format!("{truth:.digits$}"),
            ])
        })
        .collect();
    let residuals: Vec<String> = View::BOTH
        .into_iter()
        .map(|view| {
            let of = c.residuals.iter().filter(|r| r.view == view).map(|r| r.rms_px[0]);
            format!("{:.4}", super::super::statistics::largest(of))
        })
        .collect();
    table(&["", "start", "calibrated", "σ", "truth"], &rows)
        + &format!(
            "\nRMS residual {:.4} px; largest RMS of x in one pose {} px (−1 view) and {} px (+1 view).\n",
            c.rms_px, residuals[0], residuals[1]
        )
}

fn surface_figures(case: &Case, step: usize, out: &mut Vec<(String, Markup)>) -> Result<(), ReproduceError> {
    let [linear, mapped, ours] = &case.surfaces;
    let field = |points: &[Decoded],
                 title: &'static str,
                 quantity,
                 unit,
                 value: &dyn Fn(&Decoded) -> f64,
                 symmetric| {
        let points = points.iter().map(|p| [p.point_mm[0], p.point_mm[1], value(p)]).collect();
        Field { title, quantity, unit, length: "mm", points, pitch: 1.5 * step as f64 * PIXEL_MM, symmetric }
    };
    let file = |name: &str| format!("macro-{}-{name}", case.file);
    let h = |p: &Decoded| p.point_mm[2];
    let e = |p: &Decoded| 1e3 * p.registered_mm;
    let truth = |p: &Decoded| p.point_mm[2] - p.error_mm;
    out.push((file("h"), field(ours, case.name, "h", "mm", &h, None).map()?));
    let first = field(linear, "linear, no map (as Fig. 5)", "Δh", "µm", &e, Some(50.0)).map()?;
    out.push((file("error-linear"), first));
    out.push((file("error"), field(ours, "ray, calibrated", "Δh", "µm", &e, Some(ERROR_UM)).map()?));
    // across the wall of the step, along x elsewhere
    let across = usize::from(case.file != "step");
    let axis = if across == 1 { "x / mm" } else { "y / mm" };
    let section = |points: &[Decoded], value: &dyn Fn(&Decoded) -> f64| {
        field(points, "", "", "", value, None).section(across, 0.0)
    };
    let series = vec![
        ("measured", SeriesStyle::Points, section(ours, &h)),
        ("true", SeriesStyle::Dashed, section(ours, &truth)),
    ];
    out.push((file("section"), chart(case.name, axis, "h / mm", series, None)?));
    let series = vec![
        ("linear", SeriesStyle::Line, section(linear, &e)),
        ("linear, map", SeriesStyle::Line, section(mapped, &e)),
        ("ray, calibrated", SeriesStyle::Line, section(ours, &e)),
    ];
    let errors = chart("errors along the section", axis, "Δh / µm", series, Some((-80.0, 80.0)))?;
    out.push((file("section-error"), errors));
    Ok(())
}

fn map_figures(bench: &Bench, out: &mut Vec<(String, Markup)>) -> Result<(), ReproduceError> {
    let names = [
        ("macro-map-x", "e_x of the −1 view"),
        ("macro-map-y", "e_y of the −1 view"),
        ("macro-map", "|e| of the −1 view"),
    ];
    for (i, (file, title)) in names.into_iter().enumerate() {
        let value = |e: &[f64; 4]| if i < 2 { e[2 + i] } else { e[2].hypot(e[3]) };
        let points = bench.map.iter().map(|e| [e[0], e[1], value(e)]).collect();
        let field =
            Field { title, quantity: "e", unit: "px", length: "px", points, pitch: 12.0, symmetric: None };
        out.push((file.to_owned(), field.map()?));
    }
    Ok(())
}

/// The part of the page and its figures.
///
/// # Errors
/// A figure without points.
pub fn part(results: &Results) -> Result<Part, ReproduceError> {
    let bench = &results.ideal;
    let mut figures = Vec::new();
    if let Some((size, grey)) = &results.face {
        let overlay = Overlay {
            title: "Frame of the last specimen: −1 view (left), +1 view (right)".to_owned(),
            width: size[0],
            height: size[1],
            grey: grey.clone(),
            display: None,
            marks: Vec::new(),
            most_pixels: 800,
        };
        figures.push(("macro-views".to_owned(), overlay.render_svg()?));
    }
    map_figures(bench, &mut figures)?;
    for case in bench.cases.iter().filter(|c| c.shape == Shape::Quadratic) {
        surface_figures(case, bench.step, &mut figures)?;
    }
    let mut text = format!(
        "
## Chapter 2: profiles of machined surfaces

`cargo xtask reproduce macro`, seed {SEED}. 2592 × 1944 pixels of 2.2 µm, 8 bit, full well of 6000 e⁻ with photon noise, 5 e⁻ of read noise; F = 17 347 px, s = 307 mm,
d = 109 mm, 300 lines/mm, 632–634 nm (every wavelength of the filter's band traced by itself: 2.9 px of smear in either view); speckles of 125 µm on 20 × 20 mm. Subsets {SUBSET} × {SUBSET},
step {}. Rays meet the surfaces exactly; nothing is interpolated. Not simulated: defocus (the depth of field is ± 4 mm) and imperfect gratings.

### Errors away from discontinuities

As in the thesis, every profile is registered by the rigid motion that fits it best; the columns \"not registered\" give the same in the frame of the calibration plate.
Left out are points less than {TIP_PX:.0} px from the cone's tip and {CONFINED_PX:.0} px from the step. \"Error of u\" is measured minus exactly traced disparity (thesis: 0.09 px).

",
        bench.step
    );
    text += &main_table(bench);
    text += &format!(
        "
Decoded by exact rays, calibrated from a printed plate at five heights, starting 1 % off in F and s and 1 mm off in d. An affine shape function cannot follow the
cylinder over {SUBSET} px: it takes w²/24·u'' for displacement, the same all over but for the perspective, so that most of it goes with the registration.

### What the model, the map and the correlation contribute

\"Exact pairs\" are traced, not correlated: what is left is the model's. The maps are taken through the grating from a printed flat plate in the reference plane; for `linear` the
straight carrier of each view is taken off, as a phase map does, for `ray` the plate's pose alone. The map of the −1 and +1 view is {:.3} px RMS and {:.3} px at most for `linear`
with an ideal lens ({:.3} px RMS for `ray`, the correlation's noise): it absorbs what the paraxial model leaves. `linear`, `ray` and the maps use the true F, s and d.

",
        bench.maps_px[0].0, bench.maps_px[0].1, bench.maps_px[1].0,
    );
    text += &contributions(bench);
    if let Some(lens) = &results.lens {
        text += &format!(
            "
The same through a lens that distorts by 0.1 % in the corner of the sensor; `linear` and `ray` without a map know nothing of it, the calibration finds k1 = {:.4} (true {:.4}):

",
            lens.calibration.estimate(Parameter::BrownK1).map_or(f64::NAN, |e| e.value),
            lens.truth.camera.brown.k1,
        );
        text += &contributions(lens);
    }
    text += "\n### Discontinuities\n\n";
    text += &edges(bench);
    text += "
With its edge along x both views see both levels up to the edge. With its edge along y the −1 view sees the wall and a strip of the lower level that the upper one hides
from the +1 view; distances count from that zone. A point on a step is solved with its own side of the subset, or refused; one whose whole subset
stays below a ZNCC of 0.9 is refused too (undisturbed: 0.997).

### Calibration

";
    text += &calibration(bench);
    text += "\n### Figures\n\nAs Fig. 3: the two views.\n";
    text += &row_of(&[("macro-views", "frame with two views")]);
    text += "As Fig. 6: the map of the −1 view for the thesis' formulas.\n";
    text += &row_of(&[("macro-map-x", "e_x"), ("macro-map-y", "e_y"), ("macro-map", "magnitude")]);
    for case in bench.cases.iter().filter(|c| c.shape == Shape::Quadratic) {
        let f = |name: &str| format!("macro-{}-{name}", case.file);
        let like = if case.file == "face" { "3" } else { "4, 5 and 7" };
        text += &format!("As Fig. {like}: {}.\n", case.name);
        text += &row_of(&[
            (&f("h"), "height"),
            (&f("error-linear"), "error, linear"),
            (&f("error"), "error, ray"),
        ]);
        text += &row_of(&[(&f("section"), "section"), (&f("section-error"), "errors along the section")]);
    }
    Ok(Part { name: "macro", text, figures })
}
