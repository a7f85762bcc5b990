//! `daic decode`, `daic profile`, `daic displacement`, `daic track`.

use super::arguments::{DecodeArgs, DecoderArg, DicArgs, DisplacementArgs, ProfileArgs, TrackArgs};
use super::commands::{apply, as_json, make_folder, rectangle, table_writer};
use super::output::{Answer, Output};
use daic::measure::{self, GapSummary, Grid, ObjectOptions, Reference};
use daic::microscope::{self, MicroscopeFile};
use daic::optics_file::CalibratedOptics;
use daic::{Error, images, pairs, process as processing, reports};
use daic_dataset::{GreyImage, atomic};
use daic_optics::{Decoder, surface};
use daic_rig::experiment;
use serde_json::json;
use std::fmt::Write as _;
use std::path::Path;

fn decoder(decoder: DecoderArg) -> Decoder {
    match decoder {
        DecoderArg::Ray => Decoder::Ray,
        DecoderArg::Closed => Decoder::Closed,
        DecoderArg::Linear => Decoder::Linear,
    }
}

fn measure_settings(arguments: &DicArgs, bayer: Option<experiment::Bayer>) -> measure::Settings {
    let lattice = daic::settings::lattice(bayer);
    let mut settings = measure::Settings { lattice, ..measure::Settings::default() };
    apply(arguments, &mut settings.dic, &mut settings.step);
    settings
}

/// What makes points of pixel pairs.
enum Setup {
    /// Camera behind gratings.
    Gratings(Box<CalibratedOptics>),
    /// A microscope, as `daic calibrate microscope` wrote it.
    Microscope(Box<MicroscopeFile>),
}

impl Setup {
    /// A microscope's file says so in its first key; everything else is an optics or experiment file.
    fn load(path: &Path) -> Result<Self, Error> {
        if MicroscopeFile::is_one(path) {
            Ok(Self::Microscope(Box::new(MicroscopeFile::load(path)?)))
        } else {
            Ok(Self::Gratings(Box::new(CalibratedOptics::load(path)?)))
        }
    }

    fn matched(
        &self,
        frame: &GreyImage,
        arguments: &Looking<'_>,
        settings: &measure::Settings,
        output: &Output,
    ) -> Result<Reference, Error> {
        match self {
            Self::Gratings(optics) => {
                let model = optics.instrument(decoder(arguments.decoder))?.model;
                Reference::new(frame, &model, settings, output)
            }
            Self::Microscope(_) => Reference::by_outlines(frame, arguments.search, settings, output),
        }
    }

    /// Name of what decodes.
    fn decoder(&self, decoder: DecoderArg) -> String {
        match self {
            Self::Gratings(_) => format!("{:?}", self::decoder(decoder)).to_lowercase(),
            Self::Microscope(file) => {
                format!(
                    "microscope, {}; heights count from the mean of the reference",
                    file.microscope.form.name()
                )
            }
        }
    }
}

/// How the views of a frame are found.
struct Looking<'a> {
    decoder: DecoderArg,
    search: f64,
    out: &'a Path,
}

fn gap_text(gap: &GapSummary) -> String {
    let numbers = format!(
        "gap of the rays {:.3} µm RMS, expected {:.3}; its smooth part {:.3} µm, expected {:.3}",
        gap.rms_um, gap.expected_um, gap.smooth_um, gap.expected_smooth_um
    );
    if gap.consistent { numbers } else { format!("{numbers}\nwarning: {}", gap.verdict()) }
}

/// `σ of a height 0.60 µm from the match, 1.20 µm from the calibration`.
fn sigma_text(match_um: f64, cal_um: Option<f64>) -> String {
    match cal_um {
        Some(cal) => format!("{match_um:.3} µm from the match, {cal:.3} µm from the calibration"),
        None => format!("{match_um:.3} µm from the match (the optics file states no uncertainty)"),
    }
}

pub fn decode(arguments: &DecodeArgs) -> Result<Answer, Error> {
    let setup = Setup::load(&arguments.optics)?;
    let write = table_writer(&arguments.out)?;
    let matches = pairs::read(&arguments.pairs, arguments.sigma)?;
    let points = match &setup {
        Setup::Gratings(optics) => pairs::decode(&matches, &optics.instrument(decoder(arguments.decoder))?)?,
        Setup::Microscope(file) => {
            let instrument = file.instrument(microscope::mean_disparity(&matches))?;
            microscope::profile(&Grid::none(), &matches, &instrument).with_points()?
        }
    };
    write(&measure::profile_table(&points)?, &arguments.out)?;
    let summary = processing::profile_summary(&points, 1.0);
    let mut text = format!("{} of {} pairs have a point", summary.ok, summary.points);
    if summary.ok < summary.points {
        write!(text, " ({})", measure::status_counts(points.points.iter().map(|p| p.status))).ok();
    }
    write!(text, "\nσ of a height: {}", sigma_text(summary.sigma_h_um, summary.sigma_h_cal_um)).ok();
    write!(text, "\n{}", gap_text(&summary.gap)).ok();
    Ok(Answer::new(as_json(&summary)?, text))
}

pub fn profile(arguments: &ProfileArgs, output: &Output) -> Result<Answer, Error> {
    let setup = Setup::load(&arguments.optics)?;
    let frame = images::read(&arguments.frame)?;
    let settings = measure_settings(&arguments.dic, arguments.bayer);
    let how = Looking { decoder: arguments.decoder, search: arguments.search, out: &arguments.out };
    let reference = setup.matched(&frame, &how, &settings, output)?;
    let (grid, matches) = (&reference.grid, &reference.matches);
    let (profile, linear) = match &setup {
        Setup::Gratings(optics) => {
            let instrument = optics.instrument(decoder(arguments.decoder))?;
            let other = optics.instrument_for_comparison(Decoder::Linear)?;
            let linear = measure::profile(grid, matches, &other);
            (measure::profile(grid, matches, &instrument), Some(linear))
        }
        Setup::Microscope(file) => {
            let instrument = file.instrument(microscope::mean_disparity(matches))?;
            (microscope::profile(grid, matches, &instrument), None)
        }
    };
    let profile = profile.with_points()?;
    // whatever can fail does so before the first file
    let name = setup.decoder(arguments.decoder);
    let page = reports::profile_page(&frame, &reference, &profile, linear.as_ref(), &name, &settings)?;
    make_folder(how.out)?;
    let object = ObjectOptions { step_mm: arguments.object_step, overlap: settings.overlap() };
    measure::write_profile(how.out, &profile, &object)?;
    atomic::write_bytes(&how.out.join("report.html"), page.as_bytes())?;
    let summary = processing::profile_summary(&profile, settings.points_per_measurement());
    let text = format!(
        "{} of {} points, mean height {:.4} mm\nσ of a height: {}\n{}\nreport: {}",
        summary.ok,
        summary.points,
        summary.mean_h_mm,
        sigma_text(summary.sigma_h_um, summary.sigma_h_cal_um),
        gap_text(&summary.gap),
        how.out.join("report.html").display()
    );
    Ok(Answer::new(as_json(&summary)?, text))
}

pub fn displacement(arguments: &DisplacementArgs, output: &Output) -> Result<Answer, Error> {
    let setup = Setup::load(&arguments.optics)?;
    let (frame, deformed) = images::read_pair(&arguments.reference, &arguments.deformed)?;
    let settings = measure_settings(&arguments.dic, arguments.bayer);
    let how = Looking { decoder: arguments.decoder, search: arguments.search, out: &arguments.out };
    let reference = setup.matched(&frame, &how, &settings, output)?;
    let tracks = reference.track(&deformed, output)?;
    let (grid, matches) = (&reference.grid, &reference.matches);
    let field = match &setup {
        Setup::Gratings(optics) => {
            let instrument = optics.instrument(decoder(arguments.decoder))?;
            measure::displacement(grid, matches, &tracks, &instrument, settings.height_mm)
        }
        Setup::Microscope(file) => {
            let instrument = file.instrument(microscope::mean_disparity(matches))?;
            microscope::displacement(grid, matches, &tracks, &instrument)
        }
    }
    .with_points()?;
    let strain = arguments.surface_strain.then(|| {
        let window = usize::from(arguments.strain_window);
        let how = surface::Settings { window, overlap: settings.overlap(), ..surface::Settings::default() };
        measure::surface_strain(&field, &how, settings.dic.subset)
    });
    let strain = strain.transpose()?;
    let name = setup.decoder(arguments.decoder);
    let page = reports::displacement_page(&frame, &reference, &field, strain.as_ref(), &name, &settings)?;
    make_folder(how.out)?;
    let object = ObjectOptions { step_mm: arguments.object_step, overlap: settings.overlap() };
    measure::write_displacement(how.out, &field, strain.as_ref(), &object)?;
    atomic::write_bytes(&how.out.join("report.html"), page.as_bytes())?;
    let summary = processing::field_summary(&field, settings.points_per_measurement());
    let mut text = format!("{} of {} points\n", summary.ok, summary.points);
    for (i, name) in ["u", "v", "w"].into_iter().enumerate() {
        let cal = summary.sigma_cal_um.map(|s| s[i]);
        let (mean, std) = (summary.measured_um[i], summary.std_um[i]);
        let sigma = sigma_text(summary.sigma_um[i], cal);
        writeln!(text, "{name} {mean:.3} µm (scatter {std:.3}); σ: {sigma}").ok();
    }
    writeln!(text, "{}", gap_text(&summary.gap)).ok();
    let mut json = as_json(&summary)?;
    if let Some(strain) = &strain {
        let s = strain.summary();
        for (i, name) in ["E11", "E22", "E12"].into_iter().enumerate() {
            let (mean, std, sigma) = (1e6 * s.mean[i], 1e6 * s.std[i], 1e6 * s.sigma[i]);
            let points = s.ok;
            writeln!(
                text,
                "{name} {mean:.1} µm/m (scatter {std:.1}, σ from the match {sigma:.1}), {points} points"
            )
            .ok();
        }
        json["surface_strain"] = as_json(&s)?;
    }
    write!(text, "report: {}", how.out.join("report.html").display()).ok();
    Ok(Answer::new(json, text))
}

pub fn track(arguments: &TrackArgs, output: &Output) -> Result<Answer, Error> {
    let mut settings = measure_settings(&arguments.dic, arguments.bayer);
    if let Some(roi) = arguments.roi {
        settings.roi = Some(rectangle(roi, &images::read(&arguments.reference)?)?);
    }
    let options = daic::microscope::TrackOptions {
        reference: arguments.reference.clone(),
        frames: arguments.frames.clone(),
        search_px: arguments.search,
        settings,
        out: arguments.out.clone(),
        plate: arguments.plate.clone(),
    };
    let found = daic::microscope::track(&options, output)?;
    let mut text = String::new();
    for t in &found {
        let [a, b, c, d] = t.mean_px;
        let (frame, ok, points, field) = (&t.frame, t.ok, t.points, &t.field);
        writeln!(text, "{frame}: {ok} of {points} points, −1 view ({a:.3}, {b:.3}) px, +1 view ({c:.3}, {d:.3}) px (mean) -> {field}").ok();
    }
    match &arguments.plate {
        Some(plate) => write!(
            text,
            "next: daic calibrate rig {} --moves FILE with the stage's moves, for the scale",
            plate.display()
        )
        .ok(),
        None => write!(text, "next: name the fields in a file of moves for daic calibrate microscope").ok(),
    };
    let all = found.iter().all(|t| t.ok > 0);
    Ok(Answer::new(json!({ "frames": as_json(&found)? }), text).checked(all))
}
