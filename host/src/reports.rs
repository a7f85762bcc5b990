//! `report.html` of single frames and pairs.

use crate::error::Error;
use crate::figures::{self, Unit};
use crate::measure::{self, Displacement, Profile, Reference, Settings, plane_of, spread};
use daic_dataset::GreyImage;
use daic_optics::Decoder;
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

fn provenance(decoder: Decoder, settings: &Settings) -> Vec<(String, String)> {
    let dic = &settings.dic;
    vec![
        ("measured with".to_owned(), format!("daic {}", env!("CARGO_PKG_VERSION"))),
        ("decoder".to_owned(), format!("{decoder:?}").to_lowercase()),
        ("subset, step".to_owned(), format!("{0} × {0} px, every {1} px", dic.subset, settings.step)),
        ("shape function".to_owned(), format!("{:?}", dic.shape).to_lowercase()),
        ("interpolation".to_owned(), format!("{:?} B-spline", dic.interpolation).to_lowercase()),
    ]
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
    linear: &Profile,
    decoder: Decoder,
    settings: &Settings,
) -> Result<String, Error> {
    let height = measure::height_map(profile);
    let ok = || profile.points.iter().filter(|p| p.status.is_ok());
    let heights = spread(ok().map(|p| p.point_mm[2]));
    let gaps = spread(ok().map(|p| 1e3 * p.gap_mm));
    let sigmas = spread(ok().map(|p| 1e3 * p.sigma_mm[2]));
    let number = |v: f64, unit: &str| Cell::Number(plain(v, 3, unit));
    let row = |name: &str, value: Cell| vec![Cell::Text(name.to_owned()), value];
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
            row("σ of a single height, RMS", number(sigmas.rms, "µm")),
            row("gap of the two rays, mean", number(gaps.mean, "µm")),
        ],
    };
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
    let report = Report {
        title: "daic profile".to_owned(),
        subtitle: "Height of a surface from the two first-order views of one frame".to_owned(),
        verdict: None,
        sections: vec![
            Section {
                title: "Surface".to_owned(),
                text: Vec::new(),
                tables: vec![numbers],
                figures: vec![
                    figures::map_figure(
                        &height,
                        "Height",
                        "h",
                        Unit::Millimetre,
                        "Height towards the camera over the reference plane, on the pixel grid of the −1 view.",
                    )?,
                    figures::surface_figure(&height, "Surface", "Drag to turn, scroll to zoom.")?,
                ],
            },
            views(frame, reference)?,
            Section {
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
            },
        ],
        provenance: provenance(decoder, settings),
    };
    Ok(report.render()?)
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

/// The page of a displacement field.
///
/// # Errors
/// If a figure cannot be drawn.
pub fn displacement_page(
    frame: &GreyImage,
    reference: &Reference,
    field: &Displacement,
    decoder: Decoder,
    settings: &Settings,
) -> Result<String, Error> {
    let [height, u, v, w] = measure::displacement_maps(field);
    let ok = || field.points.iter().filter(|p| p.status.is_ok());
    let rows = ["u (right)", "v (down)", "w (towards the camera)"]
        .into_iter()
        .enumerate()
        .map(|(i, name)| {
            let values = spread(ok().map(|p| 1e3 * p.displacement_mm[i]));
            let sigma = spread(ok().map(|p| 1e3 * p.sigma_mm[i]));
            vec![
                Cell::Text(name.to_owned()),
                Cell::Number(plain(values.mean, 3, "µm")),
                Cell::Number(plain(values.std, 3, "µm")),
                Cell::Number(plain(sigma.rms, 3, "µm")),
            ]
        })
        .collect();
    let table = TableBlock {
        caption: format!("Points: {}", measure::status_counts(field.points.iter().map(|p| p.status))),
        head: ["component", "mean", "scatter", "σ of a point, RMS"].map(str::to_owned).to_vec(),
        rows,
    };
    let mut maps = Vec::new();
    for (map, symbol) in [(&u, "u"), (&v, "v"), (&w, "w")] {
        let title = format!("Displacement {symbol}");
        maps.push(figures::map_figure(map, &title, symbol, Unit::Micrometre, "")?);
    }
    let report = Report {
        title: "daic displacement".to_owned(),
        subtitle: "Displacement of material points between two frames (Lagrangian)".to_owned(),
        verdict: None,
        sections: vec![
            Section {
                title: "Displacement".to_owned(),
                text: Vec::new(),
                tables: vec![table],
                figures: maps,
            },
            Section {
                title: "Shape of the reference".to_owned(),
                text: Vec::new(),
                tables: Vec::new(),
                figures: vec![
                    figures::map_figure(&height, "Height", "h", Unit::Millimetre, "")?,
                    figures::surface_figure(&height, "Surface", "Drag to turn, scroll to zoom.")?,
                ],
            },
            views(frame, reference)?,
        ],
        provenance: provenance(decoder, settings),
    };
    Ok(report.render()?)
}
