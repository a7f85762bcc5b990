//! Tables and figures of chapter 3.

use super::super::document::{Part, row_of, table};
use super::super::pictures::{Field, chart};
use super::super::{ReproduceError, SUBSET};
use super::rigid::{Decoded, Way};
use super::{Ball, MotionErrors, Results, SEED};
use daic_correlate::Shape;
use daic_report::{Markup, Overlay, SeriesStyle};

/// A frame for a figure.
#[derive(Debug)]
pub struct Picture {
    /// Title above it.
    pub title: &'static str,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Grey levels.
    pub grey: Vec<u16>,
}

/// What the figures show.
#[derive(Debug, Default)]
pub struct Drawn {
    /// Frames of the slide and of the ball.
    pub views: Vec<Picture>,
    /// Decoded displacements of the two motions of Table 1.
    pub motions: Vec<Vec<Decoded>>,
    /// Midpoint and (u₋, v₋, u₊, v₊), px, of the same.
    pub moved_px: Vec<Vec<([f64; 2], [f64; 4])>>,
}

/// Table 1 of the thesis, µm: (u, v, w) of the translation and of the tilt, h of the ball.
pub const THESIS: ([f64; 3], [f64; 3], f64) = ([0.038, 0.022, 0.232], [0.084, 0.031, 0.296], 1.345);

const NAMES: [&str; 3] = ["u", "v", "w"];

/// What the ball's blurred rim costs.
fn rim(ball: Option<&Ball>) -> String {
    let Some((last, inner)) = ball.and_then(|b| b.rings.split_last()) else { return String::new() };
    let points: usize = inner.iter().map(|r| r.points).sum();
    let squares: f64 = inner.iter().map(|r| r.points as f64 * r.rms_um.powi(2)).sum();
    let (rms, to) = ((squares / points as f64).sqrt(), inner.last().map_or(0.0, |r| r.to_um));
    format!(
        "The ball's error comes from its rim, as in the thesis: {:.3} µm in the outermost ring, where the image of a point is a disc of {:.0} px radius that
changes across the subset; up to {to:.0} µm from the top it is {rms:.3} µm, {:.1} times less than the thesis' error of the whole.

",
        last.rms_um,
        last.blur_px,
        THESIS.2 / rms
    )
}

/// Shape function of the rigid motions of a flat slide: nothing in their fields is curved over a subset, and the six more
/// parameters of second order cost noise alone. The ball is curved and has second order.
pub const RIGID: Shape = Shape::Affine;

impl Results {
    /// Errors of a motion of Table 1 (0: translation, 1: tilt).
    pub fn motion(&self, number: usize, s: Shape, way: Way) -> Option<&MotionErrors> {
        let name = ["translation of 10 µm", "tilt of 6°"].get(number)?;
        self.motions.iter().find(|m| m.name == *name && m.shape == s && m.way == way)
    }

    /// The ball with a shape function.
    pub fn ball(&self, s: Shape) -> Option<&Ball> {
        self.balls.iter().find(|b| b.shape == s)
    }

    fn table_1(&self) -> String {
        let cell = |number: usize, i: usize, s: Shape, way: Way| {
            self.motion(number, s, way).map_or(String::from("–"), |m| format!("{:.4}", m.rms_um[i]))
        };
        let mut rows = Vec::new();
        for (number, (label, thesis)) in
            [("translation", THESIS.0), ("rotation", THESIS.1)].into_iter().enumerate()
        {
            for i in 0..3 {
                let ours = self.motion(number, RIGID, Way::Perspective).map(|m| m.rms_um[i]);
                let mut row = vec![format!("{label} {}", NAMES[i]), format!("{:.3}", thesis[i])];
                row.push(format!("**{}**", cell(number, i, RIGID, Way::Perspective)));
                row.push(cell(number, i, Shape::Quadratic, Way::Perspective));
                row.push(ours.map_or(String::from("–"), |o| format!("{:.1}×", thesis[i] / o)));
                let noise = self.motion(number, RIGID, Way::Perspective).map(|m| m.noise_um[i]);
                row.push(noise.map_or(String::from("–"), |n| format!("{n:.4}")));
                row.push(cell(number, i, RIGID, Way::OwnFit));
                row.push(cell(number, i, RIGID, Way::Linear));
                row.push(cell(number, i, RIGID, Way::Rays));
                rows.push(row);
            }
        }
        let ball =
            |s: Shape, i: usize| self.ball(s).map_or(String::from("–"), |b| format!("{:.4}", b.rms_um[i]));
        let factor = self.ball(Shape::Quadratic).map(|b| THESIS.2 / b.rms_um[1]);
        rows.push(vec![
            "ball h".to_owned(),
            format!("{:.3}", THESIS.2),
            ball(Shape::Affine, 1),
            format!("**{}**", ball(Shape::Quadratic, 1)),
            factor.map_or(String::from("–"), |f| format!("{f:.1}×")),
            self.ball(Shape::Quadratic).map_or(String::from("–"), |b| format!("{:.4}", b.noise_um)),
            "–".to_owned(),
            ball(Shape::Quadratic, 0),
            ball(Shape::Quadratic, 2),
        ]);
        let head = [
            "RMS error, µm",
            "thesis",
            "ours, affine",
            "ours, quadratic",
            "thesis ÷ ours",
            "noise alone",
            "own fit",
            "linear form",
            "exact rays, known geometry",
        ];
        table(&head, &rows)
    }

    fn ball_table(&self) -> String {
        let mut rows = Vec::new();
        let (Some(a), Some(q)) = (self.ball(Shape::Affine), self.ball(Shape::Quadratic)) else {
            return String::new();
        };
        for (r, s) in a.rings.iter().zip(&q.rings) {
            rows.push(vec![
                format!("up to {:.0}", r.to_um),
                format!("{:.1}", r.blur_px),
                s.points.to_string(),
                format!("{:.4}", r.rms_um),
                format!("{:.4}", s.rms_um),
            ]);
        }
        let head = [
            "distance from the top, µm",
            "defocus disc, radius in px",
            "points",
            "affine, µm",
            "quadratic, µm",
        ];
        table(&head, &rows)
    }

    fn parameter_table(&self) -> String {
        let [found, truth] = self.parameters.map(|p| p.to_array());
        let names = ["β₁, µm/px", "β₂, µm/px", "β₃, 1/px", "β₄, 1/px", "x_c, px", "y_c, px"];
        let mut rows: Vec<Vec<String>> = (0..6)
            .map(|i| {
                let k = if i < 2 { 1e3 } else { 1.0 };
                let digits = [6, 6, 8, 8, 2, 2][i];
                vec![
                    names[i].to_owned(),
                    format!("{:.digits$}", k * found[i]),
                    format!("{:.digits$}", k * self.sigma[i]),
                    format!("{:.digits$}", k * truth[i]),
                ]
            })
            .collect();
        let [found, truth] = self.aspect.map(|a| format!("{a:.5}"));
        rows.push(vec!["pixel along y ÷ along x".to_owned(), found, "–".to_owned(), truth]);
        table(&["", "calibrated", "σ", "of the geometry"], &rows)
    }
}

fn motion_figures(results: &Results, out: &mut Vec<(String, Markup)>) -> Result<(), ReproduceError> {
    let pitch = 1.5 * results.step as f64 * 0.53;
    for (k, file) in ["translation", "tilt"].into_iter().enumerate() {
        let Some(decoded) = results.figures.motions.get(k) else { continue };
        let field =
            |title: &'static str, quantity: &'static str, value: &dyn Fn(&Decoded) -> f64, most| Field {
                title,
                quantity,
                unit: "µm",
                length: "µm",
                points: decoded.iter().map(|d| [d.place_um[0], d.place_um[1], value(d)]).collect(),
                pitch,
                symmetric: most,
            };
        for (i, name) in NAMES.into_iter().enumerate() {
            let measured = field(name, name, &|d| d.found_um[i], None);
            out.push((format!("micro-{file}-{name}"), measured.map()?));
        }
        let errors = field("error of w", "Δw", &|d| d.found_um[2] - d.truth_um[2], Some(0.05));
        out.push((format!("micro-{file}-error"), errors.map()?));
        let mut series = Vec::new();
        for (i, name) in NAMES.into_iter().enumerate() {
            let along = field("", "", &|d| d.found_um[i], None).section(1, 0.0);
            series.push((name, SeriesStyle::Line, along));
        }
        series.push((
            "w imposed",
            SeriesStyle::Dashed,
            field("", "", &|d| d.truth_um[2], None).section(1, 0.0),
        ));
        let title = ["Translation of 10 µm, along y = 0", "Tilt of 6°, along y = 0"][k];
        out.push((
            format!("micro-{file}-section"),
            chart(title, "x / µm", "displacement / µm", series, None)?,
        ));
    }
    if let Some(moved) = results.figures.moved_px.first() {
        for (i, name) in ["u₋", "u₊", "v₋", "v₊"].into_iter().enumerate() {
            let from = [0, 2, 1, 3][i];
            let field = Field {
                title: name,
                quantity: name,
                unit: "px",
                length: "px",
                points: moved.iter().map(|(at, by)| [at[0], at[1], by[from]]).collect(),
                pitch: 1.5 * results.step as f64,
                symmetric: None,
            };
            out.push((format!("micro-moved-{}", ["um", "up", "vm", "vp"][i]), field.map()?));
        }
    }
    Ok(())
}

fn ball_figures(results: &Results, out: &mut Vec<(String, Markup)>) -> Result<(), ReproduceError> {
    let Some(ball) = results.ball(Shape::Quadratic) else { return Ok(()) };
    let field = |title: &'static str, quantity: &'static str, at: usize, most| Field {
        title,
        quantity,
        unit: "µm",
        length: "µm",
        points: ball.surface_um.iter().map(|p| [p[0], p[1], p[at]]).collect(),
        pitch: 1.5 * results.step as f64 * 0.53,
        symmetric: most,
    };
    out.push(("micro-ball-h".to_owned(), field("Height of the ball", "h", 2, None).map()?));
    out.push(("micro-ball-error".to_owned(), field("Error of the height", "Δh", 3, Some(0.3)).map()?));
    let h = field("", "", 2, None);
    let truth: Vec<(f64, f64)> = (-160..=160)
        .step_by(4)
        .map(|x| (f64::from(x), (340f64.powi(2) - f64::from(x * x)).sqrt() - 340.0))
        .collect();
    let series = vec![
        ("along x", SeriesStyle::Points, h.section(1, 0.0)),
        ("along y", SeriesStyle::Points, h.section(0, 0.0)),
        ("true", SeriesStyle::Dashed, truth),
    ];
    out.push((
        "micro-ball-section".to_owned(),
        chart("Ball, two sections", "x or y / µm", "h / µm", series, None)?,
    ));
    let e = field("", "", 3, None);
    let series = vec![
        ("along x", SeriesStyle::Line, e.section(1, 0.0)),
        ("along y", SeriesStyle::Line, e.section(0, 0.0)),
    ];
    out.push((
        "micro-ball-section-error".to_owned(),
        chart("Ball, error along two sections", "x or y / µm", "Δh / µm", series, None)?,
    ));
    Ok(())
}

/// The part of the page and its figures.
///
/// # Errors
/// A figure without points.
pub fn part(results: &Results) -> Result<Part, ReproduceError> {
    let mut figures = Vec::new();
    for (file, p) in ["micro-views", "micro-ball-views"].into_iter().zip(&results.figures.views) {
        let overlay = Overlay {
            title: p.title.to_owned(),
            width: p.size[0],
            height: p.size[1],
            grey: p.grey.clone(),
            display: None,
            marks: Vec::new(),
            most_pixels: 800,
        };
        figures.push((file.to_owned(), overlay.render_svg()?));
    }
    motion_figures(results, &mut figures)?;
    ball_figures(results, &mut figures)?;
    let at_minus = results.ball(Shape::Quadratic).map_or(f64::NAN, |b| b.at_minus_um);
    let points = results.motion(0, Shape::Quadratic, Way::Perspective).map_or(0, |m| m.points);
    let in_ball = results.ball(Shape::Quadratic).map_or(0, |b| b.points);
    let mut text = format!(
        "
## Chapter 3: the microscope

`cargo xtask reproduce micro`, seed {SEED}. Exact rays through the geometry of the set-up (450 nm, grating of 2000 nm, 13.00°, relay of two 20× objectives,
0.53 µm/px, perspective of 0.3/mm before and 0.08/mm behind the grating); {0:.0} × {1:.0} µm of fluorescent spheres of 1–5 µm, blurred by diffraction and by
the defocused cone of an aperture of {2:.2}; 16 bit, full well of 25 000 e⁻ with photon noise, 10 e⁻ of read noise. Subsets {SUBSET} × {SUBSET}, step {4}.
Calibrated by {3}, none of them in the table. Not simulated: aberrations, and the shift of a defocused cone's centroid behind the grating, which a
calibration by z moves takes up as a factor.

",
        2e3 * results.half_mm[0],
        2e3 * results.half_mm[1],
        super::scene::APERTURE,
        results.moves.join(", "),
        results.step,
    );
    text += "### Table 1\n\n";
    text += &results.table_1();
    let rim = rim(results.ball(Shape::Quadratic));
    text += &format!(
        "
Motions over {points} points, the reference blurred to the focus of every moved frame before it is correlated (how much is found from the two images); errors are decoded minus imposed displacement of each material point, means included, nothing registered; a tilt moves points in-plane
by x (cos 6° − 1) as well, which is in the truth. \"Ours\" predicts the motion with the perspective form of the six parameters from the other moves; \"own fit\" has the
motion itself among the calibration's, as the thesis' translation had; \"noise alone\" is what the photons' and the camera's noise make of it by the correlation's own σ; \"linear form\" are the thesis' formulas, calibrated by the other moves; \"exact rays\" decode through the true geometry: what
is left is the correlation's. A rigid motion of a flat slide has no curvature over a subset: first order is its shape function (bold, and the
columns to its right), the second order beside it adds noise alone; the curved ball is second order. The ball is registered by a rigid motion, within 160 µm of its top ({in_ball} points).

{rim}Taking the ball's coordinates from the −1 view alone, as (3.5) is printed, gives {at_minus:.3} µm instead.

"
    );
    text += "### Calibration\n\n";
    text += &results.parameter_table();
    text += &format!(
        "
RMS residual {:.4} px, χ² over degrees of freedom {:.1}, {} points left out. (3.1) has one magnification in the plane, but behind the grating the intermediate image stands at
D/cos³θ along the grating vector and at D/cos θ across it, and an objective that is not telecentric sees the two at different sizes: y is counted in pixels of x, by the
ratio that the two moves in the plane show, before the six parameters are fitted. Without it these moves contradict each other by 0.06 px, twenty times their noise.
",
        results.residual_px, results.chi_square, results.rejected
    );
    text += "\n### The ball over the distance from its top\n\n";
    text += &results.ball_table();
    text += "\n### Figures\n\nAs Fig. 9 and 13a: the two views.\n";
    text += &row_of(&[("micro-views", "views of the slide"), ("micro-ball-views", "views of the ball")]);
    text += "As Fig. 10: image displacements of a translation of 10 µm along z.\n";
    text += &row_of(&[("micro-moved-um", "u of the −1 view"), ("micro-moved-up", "u of the +1 view")]);
    text += &row_of(&[("micro-moved-vm", "v of the −1 view"), ("micro-moved-vp", "v of the +1 view")]);
    for (file, number) in [("translation", 11), ("tilt", 12)] {
        text += &format!(
            "As Fig. {number}: the decoded displacements of the {file}, the error of w, and a section.\n"
        );
        let f = |name: &str| format!("micro-{file}-{name}");
        text += &row_of(&[(&f("u"), "u"), (&f("v"), "v"), (&f("w"), "w")]);
        text += &row_of(&[(&f("error"), "error of w"), (&f("section"), "section along x")]);
    }
    text += "As Fig. 13: topography of the ball, its error, and sections.\n";
    text += &row_of(&[("micro-ball-h", "height"), ("micro-ball-error", "error")]);
    text += &row_of(&[
        ("micro-ball-section", "sections"),
        ("micro-ball-section-error", "errors along the sections"),
    ]);
    Ok(Part { name: "micro", text, figures })
}
