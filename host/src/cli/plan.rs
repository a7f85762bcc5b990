//! `daic plan`.

use super::arguments::numbers;
use super::commands::as_json;
use super::output::Answer;
use clap::Args;
use daic::{Error, optics_section};
use daic_optics::plan::{Plan, Request, plan as planned};
use daic_rig::experiment::{Experiment, OpticsFile};
use daic_rig::units::Length;
use std::fmt::Write as _;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct PlanArgs {
    /// Optics file, or an experiment file with its [optics]
    pub optics: PathBuf,
    /// Columns and rows of the sensor [default: the experiment's camera, else twice the principal point]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub sensor: Option<Pair>,
    /// Standard deviation of the disparity in pixels
    #[arg(long, value_name = "PX", default_value_t = 0.09)]
    pub sigma: f64,
    /// Lowest and highest point of the specimen
    #[arg(long, value_name = "LOW,HIGH", default_value = "-2 mm,2 mm", value_parser = parse_lengths, allow_hyphen_values = true)]
    pub heights: Pair,
    /// Width and height of the specimen, such as "18 mm,14 mm" [default: nine tenths of the field]
    #[arg(long, value_name = "WIDTH,HEIGHT", value_parser = parse_lengths)]
    pub specimen: Option<Pair>,
    /// Width of the light's spectrum
    #[arg(long, value_name = "LENGTH", default_value = "2 nm")]
    pub bandwidth: Length,
    /// Drift of the wavelength
    #[arg(long, value_name = "LENGTH", default_value = "0.1 nm")]
    pub drift: Length,
    /// Errors of d (grating to reference plane) and s (pinhole to grating)
    #[arg(long, value_name = "D,S", default_value = "0.1 mm,0.1 mm", value_parser = parse_lengths)]
    pub errors: Pair,
    /// Diameter of the lens's entrance pupil, for the depth of field
    #[arg(long, value_name = "LENGTH")]
    pub pupil: Option<Length>,
    /// Side of the subsets in pixels
    #[arg(long, value_name = "PX", default_value_t = 33.0)]
    pub subset: f64,
    /// The grating lets no light through undiffracted
    #[arg(long)]
    pub no_zeroth_order: bool,
}

/// Two numbers: pixels, or lengths in millimetres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair(pub [f64; 2]);

fn parse_size(text: &str) -> Result<Pair, String> {
    numbers(&text.replace(['x', '×'], ","), "WIDTHxHEIGHT in pixels, for example 2592x1944").map(Pair)
}

fn parse_lengths(text: &str) -> Result<Pair, String> {
    let parsed: Result<Vec<Length>, _> = text.split(',').map(str::parse).collect();
    match parsed.map_err(|e| e.to_string())?.as_slice() {
        [a, b] => Ok(Pair([a.mm(), b.mm()])),
        found => {
            Err(format!("found {} lengths in `{text}`, wanted 2, for example \"-2 mm,2 mm\"", found.len()))
        }
    }
}

pub fn plan(arguments: &PlanArgs) -> Result<Answer, Error> {
    let file = OpticsFile::load(&arguments.optics)?;
    let optics = optics_section::from_section(&file.optics)?;
    let (sensor_px, from) = match (arguments.sensor, Experiment::load(&arguments.optics)) {
        (Some(size), _) => (size.0, "as given"),
        (None, Ok(e)) => {
            ([f64::from(e.rig.camera.width), f64::from(e.rig.camera.height)], "of the experiment's camera")
        }
        (None, Err(_)) => (
            optics.camera.principal_point_px.map(|c| 2.0 * c + 1.0),
            "taken as centred on the principal point",
        ),
    };
    let request = Request {
        sensor_px,
        sigma_px: [arguments.sigma; 2],
        heights_mm: arguments.heights.0,
        specimen_mm: arguments.specimen.map(|s| s.0),
        bandwidth_mm: arguments.bandwidth.mm(),
        drift_mm: arguments.drift.mm(),
        distance_errors_mm: arguments.errors.0,
        pupil_mm: arguments.pupil.map(Length::mm),
        subset_px: arguments.subset,
        zeroth_order: !arguments.no_zeroth_order,
    };
    let found = planned(&optics, &request)?;
    let mut json = as_json(&found)?;
    let lines = |items: Vec<String>| serde_json::Value::from(items);
    json["warning_texts"] = lines(found.warnings.iter().map(ToString::to_string).collect());
    json["suggestion_texts"] = lines(found.suggestions.iter().map(ToString::to_string).collect());
    json["request"] = as_json(&request)?;
    Ok(Answer::new(json, table(&found, &request, from)))
}

fn table(p: &Plan, r: &Request, sensor: &str) -> String {
    let mut t = String::new();
    let mut row = |name: &str, value: String| {
        writeln!(t, "{name:<34}{value}").ok();
    };
    let [w, h] = r.sensor_px;
    row("sensor", format!("{w:.0} × {h:.0} px, {sensor}"));
    row("first order", format!("{:.2}° and {:.2}°", p.angle_deg[0], p.angle_deg[1]));
    row(
        "field of both views",
        format!(
            "{:.2} × {:.2} mm (x {:.2} to {:.2})",
            p.field_mm.x.length(),
            p.field_mm.y.length(),
            p.field_mm.x.low,
            p.field_mm.x.high
        ),
    );
    row(
        "specimen",
        format!(
            "{:.2} × {:.2} mm, heights {} to {} mm",
            p.specimen_mm.x.length(),
            p.specimen_mm.y.length(),
            r.heights_mm[0],
            r.heights_mm[1]
        ),
    );
    row(
        "pixel on the specimen",
        format!(
            "{:.2} × {:.2} µm (b' = {:.2} µm)",
            p.pixel_mm[0] * 1e3,
            p.pixel_mm[1] * 1e3,
            p.paraxial.pixel_mm * 1e3
        ),
    );
    row("subset on the specimen", format!("{:.2} mm ({} px)", p.subset_mm, r.subset_px));
    let [minus, zero, plus] = p.columns_px;
    row(
        "columns of −1, 0, +1",
        format!(
            "{:.0} to {:.0}, {:.0} to {:.0}, {:.0} to {:.0} px",
            minus.low, minus.high, zero.low, zero.high, plus.low, plus.high
        ),
    );
    row(
        "free between −1 and 0, 0 and +1",
        format!(
            "{:.0} and {:.0} px; between −1 and +1 {:.0} px",
            p.free_px[0], p.free_px[1], p.free_between_views_px
        ),
    );
    row("widest specimen without overlap", format!("{:.2} mm", p.widest_specimen_mm));
    let [a, b] = p.footprints_mm;
    row(
        "footprints on the gratings",
        format!(
            "x {:.1} to {:.1} and {:.1} to {:.1} mm, y {:.1} to {:.1} mm",
            a.x.low,
            a.x.high,
            b.x.low,
            b.x.high,
            a.y.low.min(b.y.low),
            a.y.high.max(b.y.high)
        ),
    );
    row("whole specimen seen", format!("from {:.2} to {:.2} mm", p.depth.seen_mm[0], p.depth.seen_mm[1]));
    if let Some([low, high]) = p.depth.sharp_mm {
        row("sharp", format!("from {low:.2} to {high:.2} mm"));
    }
    let [x, y, h] = p.sigma.centre_mm.map(|s| s * 1e3);
    row("σ of x, y, h on the axis", format!("{x:.2}, {y:.2}, {h:.2} µm ({} px of disparity)", r.sigma_px[0]));
    row(
        "σ of h: worst, and by (2.10)",
        format!("{:.2} and {:.2} µm", p.sigma.worst_mm[2] * 1e3, p.paraxial.sigma_h_mm * 1e3),
    );
    let [u, v] = [p.disparity_px.u_px, p.disparity_px.v_px];
    row("disparity", format!("u {:.1} to {:.1} px, v {:.2} to {:.2} px", u[0], u[1], v[0], v[1]));
    row(
        "smear by the bandwidth",
        format!(
            "{:.2} px for {:.3} nm (paraxial {:.2})",
            p.light.smear_px,
            r.bandwidth_mm * 1e6,
            p.light.smear_paraxial_px
        ),
    );
    row(
        "drift of h with the wavelength",
        format!(
            "{:.1} µm for {:.3} nm (paraxial {:.1})",
            p.light.drift_h_mm * 1e3,
            r.drift_mm * 1e6,
            p.light.drift_h_paraxial_mm * 1e3
        ),
    );
    row(
        "constant offset from d, s",
        format!(
            "{:.1} and {:.1} µm for errors of {} and {} mm",
            p.light.offset_d_mm * 1e3,
            p.light.offset_s_mm * 1e3,
            r.distance_errors_mm[0],
            r.distance_errors_mm[1]
        ),
    );
    writeln!(
        t,
        "\nerror of h over its plane, µm, by (2.9) corrected\n{:>10}{:>12}{:>12}{:>12}{:>12}",
        "h / mm", "disparity", "d", "s", "total"
    )
    .ok();
    for b in &p.budget {
        let [u, d, s, all] = [b.from_disparity_mm, b.from_d_mm, b.from_s_mm, b.total_mm].map(|v| v * 1e3);
        writeln!(t, "{:>10.3}{u:>12.2}{d:>12.2}{s:>12.2}{all:>12.2}", b.height_mm).ok();
    }
    writeln!(
        t,
        "\n{:<22}{:>10}{:>18}{:>12}{:>14}",
        "with", "σ_h / µm", "field / mm", "smear / px", "free / px"
    )
    .ok();
    for v in &p.variants {
        let field = format!("{:.1} × {:.1}", v.field_mm[0], v.field_mm[1]);
        writeln!(
            t,
            "{:<22}{:>10.2}{field:>18}{:>12.2}{:>14.0}",
            v.change,
            v.sigma_h_mm * 1e3,
            v.smear_px,
            v.free_px
        )
        .ok();
    }
    t.push('\n');
    for warning in &p.warnings {
        writeln!(t, "warning: {warning}").ok();
    }
    for suggestion in &p.suggestions {
        writeln!(t, "suggestion: {suggestion}").ok();
    }
    t
}
