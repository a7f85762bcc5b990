//! `report.html` of single frames and pairs.

use crate::error::Error;
use crate::figures::{self, Unit};
use crate::measure::{
    self, Displacement, GapSummary, Profile, Reference, Settings, SurfaceField, map_named, plane_of, spread,
};
use daic_dataset::{FloatMap, GreyImage};
use daic_report::{Cell, Figure, Report, Section, TableBlock, plain};

fn views(frame: &GreyImage, reference: &Reference) -> Result<Section, Error> {
    let overlay = figures::views_overlay(frame, reference.minus, reference.plus, "Frame");
    Ok(Section {
        title: "The two views".to_owned(),
        text: Vec::new(),
        tables: Vec::new(),
        figures: vec![Figure {
            id: "views".to_owned(),
            title: "Views as the program found them".to_owned(),
            caption: "Check that each frame encloses one image of the specimen.".to_owned(),
            body: overlay.render_svg()?,
        }],
    })
}

fn provenance(decoder: &str, settings: &Settings) -> Vec<(String, String)> {
    let dic = &settings.dic;
    vec![
        ("measured with".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
        ("decoder".to_owned(), decoder.to_owned()),
        ("subset, step".to_owned(), format!("{0} × {0} px, every {1} px", dic.subset, settings.step)),
        ("shape function".to_owned(), format!("{:?}", dic.shape).to_lowercase()),
        ("interpolation".to_owned(), format!("{:?} B-spline", dic.interpolation).to_lowercase()),
    ]
}

fn number(v: f64, unit: &str) -> Cell {
    Cell::Number(plain(v, 3, unit))
}

fn row(name: &str, value: Cell) -> Vec<Cell> {
    vec![Cell::Text(name.to_owned()), value]
}

fn gap_rows(gap: &GapSummary) -> [Vec<Cell>; 4] {
    [
        row("gap of the two rays, RMS", number(gap.rms_um, "µm")),
        row("the same, to be expected", number(gap.expected_um, "µm")),
        row("its part that varies smoothly over the field, RMS", number(gap.smooth_um, "µm")),
        row("the same, to be expected", number(gap.expected_smooth_um, "µm")),
    ]
}

/// The section that says whether the calibration fits the frame.
fn consistency(maps: &[FloatMap], gap: &GapSummary) -> Result<Section, Error> {
    let mut figures = Vec::new();
    if let Some(map) = map_named(maps, "gap_mm") {
        let title = "Gap of the two rays";
        figures.push(figures::map_figure(map, title, "gap", Unit::Micrometre, figures::GAP_CAPTION)?);
    }
    Ok(Section {
        title: "Does the calibration fit this frame?".to_owned(),
        text: vec![gap.verdict()],
        tables: vec![TableBlock {
            caption: String::new(),
            head: vec!["quantity".to_owned(), "value".to_owned()],
            rows: gap_rows(gap).into(),
        }],
        figures,
    })
}

/// The page of a profile; `linear` is the same matches decoded by the linearised model of the literature,
/// whose deviation is shown beside.
///
/// # Errors
/// If a figure cannot be drawn.
pub fn profile_page(
    frame: &GreyImage,
    reference: &Reference,
    profile: &Profile,
    linear: Option<&Profile>,
    decoder: &str,
    settings: &Settings,
) -> Result<String, Error> {
    let maps = measure::profile_maps(profile);
    let height = map_named(&maps, "h_mm").ok_or(Error::NoMap { name: "h_mm" })?.clone();
    let ok = || profile.points.iter().filter(|p| p.status.is_ok());
    let heights = spread(ok().map(|p| p.point_mm[2]));
    let sigma = |i: usize| spread(ok().map(|p| 1e3 * p.sigma_mm()[i])).rms;
    let common = |i: usize| spread(ok().map(|p| 1e3 * p.common_sigma_mm()[i])).rms;
    let unknown = || Cell::Text("not stated by the optics file".to_owned());
    let numbers = TableBlock {
        caption: String::new(),
        head: vec!["quantity".to_owned(), "value".to_owned()],
        rows: vec![
            row(
                "points with a result",
                Cell::Number(format!("{} of {}", heights.count, profile.points.len())),
            ),
            row(
                "points by status",
                Cell::Text(measure::status_counts(profile.points.iter().map(|p| p.status))),
            ),
            row("mean height", number(heights.mean, "mm")),
            row("σ of a single x, RMS", number(sigma(0), "µm")),
            row("σ of a single y, RMS", number(sigma(1), "µm")),
            row("σ of a single height, RMS", number(sigma(2), "µm")),
            row(
                "σ of heights from the calibration, in common, RMS",
                if profile.states_common { number(common(2), "µm") } else { unknown() },
            ),
        ],
    };
    let mut pictures = vec![
        figures::map_figure(
            &height,
            "Height",
            "h",
            Unit::Millimetre,
            "Height towards the camera over the reference plane, on the pixel grid of the −1 view.",
        )?,
        figures::surface_figure(&height, "Surface", "Drag to turn, scroll to zoom.")?,
    ];
    let uncertain = [
        ("sigma_h_mm", "σ of the height", "From the noise of the match."),
        (
            "sigma_h_cal_mm",
            "σ of the height from the calibration",
            "In common for all points: no mean over points lowers it.",
        ),
    ];
    for (name, title, caption) in uncertain {
        if let Some(map) = map_named(&maps, name) {
            pictures.push(figures::map_figure(map, title, "σ", Unit::Micrometre, caption)?);
        }
    }
    let mut sections = vec![
        Section { title: "Surface".to_owned(), text: Vec::new(), tables: vec![numbers], figures: pictures },
        consistency(&maps, &profile.gap_summary(settings.points_per_measurement()))?,
        views(frame, reference)?,
    ];
    if let Some(linear) = linear {
        sections.push(of_linear(profile, linear, &height)?);
    }
    let report = Report {
        title: "daic profile".to_owned(),
        subtitle: "Height of a surface from the two first-order views of one frame".to_owned(),
        verdict: None,
        sections,
        provenance: provenance(decoder, settings),
    };
    Ok(report.render()?)
}

/// What the decoder `linear` makes of the same matches.
fn of_linear(profile: &Profile, linear: &Profile, height: &FloatMap) -> Result<Section, Error> {
    let difference = linear_minus(profile, linear);
    let offset = spread(difference.iter().map(|d| d[2]));
    let mut text = vec![format!(
        "The same matches decoded by the linearised virtual-object model (decoder `linear`) lie {} {} in the mean",
        plain(offset.mean.abs(), 1, "µm"),
        if offset.mean < 0.0 { "lower" } else { "higher" }
    )];
    if let Some(plane) = plane_of(&difference) {
        let rest = spread(
            difference.iter().map(|d| d[2] - plane.offset - plane.slope_x * d[0] - plane.slope_y * d[1]),
        );
        text = vec![format!(
            "{}, and {} RMS off after the best plane is taken out.",
            text[0],
            plain(rest.rms, 1, "µm")
        )];
    }
    let mut map = height.clone();
    "linear_minus_ray".clone_into(&mut map.name);
    map.data = profile.grid.spread_over_nodes(|k| {
        let (a, b) = (&profile.points[k], &linear.points[k]);
        if a.status.is_ok() && b.status.is_ok() { b.point_mm[2] - a.point_mm[2] } else { f64::NAN }
    });
    Ok(Section {
        title: "What the linearised model makes of it".to_owned(),
        text,
        tables: Vec::new(),
        figures: vec![figures::map_figure(
            &map,
            "Height by `linear` minus height here",
            "Δh",
            Unit::Micrometre,
            "",
        )?],
    })
}

/// (x, y, Δh) in mm, mm, µm where both decoders have a point.
fn linear_minus(profile: &Profile, linear: &Profile) -> Vec<[f64; 3]> {
    profile
        .points
        .iter()
        .zip(&linear.points)
        .filter(|(a, b)| a.status.is_ok() && b.status.is_ok())
        .map(|(a, b)| [a.point_mm[0], a.point_mm[1], 1e3 * (b.point_mm[2] - a.point_mm[2])])
        .collect()
}

/// The page of a displacement field, perhaps with the strain of the surface.
///
/// # Errors
/// If a figure cannot be drawn.
pub fn displacement_page(
    frame: &GreyImage,
    reference: &Reference,
    field: &Displacement,
    strain: Option<&SurfaceField>,
    decoder: &str,
    settings: &Settings,
) -> Result<String, Error> {
    let all = measure::displacement_maps(field, strain);
    let named = |name: &'static str| map_named(&all, name).ok_or(Error::NoMap { name });
    let height = named("h_mm")?;
    let ok = || field.points.iter().filter(|p| p.status.is_ok());
    let rows = ["u (right)", "v (down)", "w (towards the camera)"]
        .into_iter()
        .enumerate()
        .map(|(i, name)| {
            let values = spread(ok().map(|p| 1e3 * p.displacement_mm[i]));
            let sigma = spread(ok().map(|p| 1e3 * p.sigma_mm()[i]));
            let common = spread(ok().map(|p| 1e3 * p.common_sigma_mm()[i]));
            vec![
                Cell::Text(name.to_owned()),
                Cell::Number(plain(values.mean, 3, "µm")),
                Cell::Number(plain(values.std, 3, "µm")),
                Cell::Number(plain(sigma.rms, 3, "µm")),
                if field.states_common {
                    Cell::Number(plain(common.rms, 3, "µm"))
                } else {
                    Cell::Text("not stated".to_owned())
                },
            ]
        })
        .collect();
    let table = TableBlock {
        caption: format!("Points: {}", measure::status_counts(field.points.iter().map(|p| p.status))),
        head: ["component", "mean", "scatter", "σ of a point, RMS", "σ from the calibration, in common"]
            .map(str::to_owned)
            .to_vec(),
        rows,
    };
    let mut maps = Vec::new();
    for (name, symbol) in [("u_mm", "u"), ("v_mm", "v"), ("w_mm", "w")] {
        let title = format!("Displacement {symbol}");
        maps.push(figures::map_figure(named(name)?, &title, symbol, Unit::Micrometre, "")?);
    }
    let mut sections = vec![Section {
        title: "Displacement".to_owned(),
        text: Vec::new(),
        tables: vec![table],
        figures: maps,
    }];
    if let Some(strain) = strain {
        sections.push(strain_section(strain, &all)?);
    }
    sections.extend([
        Section {
            title: "Shape of the reference".to_owned(),
            text: Vec::new(),
            tables: Vec::new(),
            figures: vec![
                figures::map_figure(height, "Height", "h", Unit::Millimetre, "")?,
                figures::surface_figure(height, "Surface", "Drag to turn, scroll to zoom.")?,
            ],
        },
        consistency(&all, &field.gap_summary(settings.points_per_measurement()))?,
        views(frame, reference)?,
    ]);
    let report = Report {
        title: "daic displacement".to_owned(),
        subtitle: "Displacement of material points between two frames (Lagrangian)".to_owned(),
        verdict: None,
        sections,
        provenance: provenance(decoder, settings),
    };
    Ok(report.render()?)
}

fn strain_section(strain: &SurfaceField, maps: &[FloatMap]) -> Result<Section, Error> {
    let summary = strain.summary();
    let micro = |v: f64| Cell::Number(plain(1e6 * v, 1, "µm/m"));
    let rows = ["E11", "E22", "E12"].into_iter().enumerate().map(|(i, name)| {
        let values = [summary.mean[i], summary.std[i], summary.sigma[i]];
        std::iter::once(Cell::Text(name.to_owned())).chain(values.map(micro)).collect()
    });
    let table = TableBlock {
        caption: format!(
            "{} points; every one an average over {} × {} points with their subsets, {} px",
            summary.ok, strain.settings.window, strain.settings.window, summary.gauge_px
        ),
        head: ["component", "mean", "scatter", "σ of a point, RMS"].map(str::to_owned).to_vec(),
        rows: rows.collect(),
    };
    let mut figures = Vec::new();
    for name in ["e11", "e22", "e12", "e1", "e2"] {
        if let Some(map) = map_named(maps, name) {
            let body = figures::map_drawing(map, &format!("Surface strain {name}"), name)?;
            let (id, title) = (map.name.clone(), format!("Surface strain {name}"));
            figures.push(Figure { id, title, caption: String::new(), body });
        }
    }
    Ok(Section {
        title: "Strain on the surface".to_owned(),
        text: vec![
            "Green–Lagrange in the tangent plane of the measured surface: e₁ as near to x as the plane allows, e₂ \
             square to it towards y; a rigid motion has none. e1 and e2 are the principal strains."
                .to_owned(),
        ],
        tables: vec![table],
        figures,
    })
}
