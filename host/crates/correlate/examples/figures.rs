//! Draws the accuracy of the correlation: `figures FOLDER`. The star needs the golden images
//! (`DAIC_SHARED`) and is left as it is without them.

#[path = "../tests/common/mod.rs"]
mod common;
#[path = "../tests/common/score.rs"]
mod score;

use common::*;
use daic_correlate::*;
use daic_report::{Chart, Series, SeriesStyle};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::error::Error;
use std::path::Path;

type Fallible<T> = Result<T, Box<dyn Error>>;

const SIZE: usize = 256;
/// Twice the contrast of the blobs: grey levels as those of the golden images.
const CONTRAST: f64 = 2.0;

fn main() -> Fallible<()> {
    let folder = std::env::args().nth(1).ok_or("where to? figures FOLDER")?;
    let folder = Path::new(&folder);
    let write = |name: &str, chart: &Chart| -> Fallible<()> {
        let to = folder.join(name);
        let new = to.with_extension("svg.new");
        std::fs::write(&new, chart.render_svg()?.as_str())?;
        std::fs::rename(&new, &to)?;
        println!("{}", to.display());
        Ok(())
    };
    write("accuracy-bias.svg", &bias()?)?;
    write("accuracy-sigma.svg", &uncertainty()?)?;
    if let Some(dir) = shared("accuracy-star.svg", "golden/dic") {
        write("accuracy-star.svg", &star(&dir)?)?;
    }
    Ok(())
}

fn run(
    reference: Image,
    target: Image,
    guess: Option<[f64; 2]>,
    step: usize,
    settings: &Settings,
) -> Fallible<Correlation> {
    let (w, h) = (reference.width(), reference.height());
    let rectangle = Some(Rectangle { x: 40, y: 40, width: w - 80, height: h - 80 });
    let points = Points::grid(w, h, settings.subset, step, &Roi { rectangle, mask: None })?;
    let all = vec![guess; points.len()];
    let guess = if guess.is_some() { Guess::Given(&all) } else { Guess::Fft };
    let (reference, target) = (Reference::new(reference), Target::new(target, settings.interpolation));
    Ok(correlate(&reference, &target, &points, &guess, settings, &())?)
}

fn speckles(seed: u64, u: f64, v: f64) -> Vec<f64> {
    let s = Speckles::new(seed, SIZE, SIZE);
    s.image(SIZE, SIZE, |_, _| (u, v)).iter().map(|g| CONTRAST * g).collect()
}

/// Mean error against the sub-pixel shift.
fn bias() -> Fallible<Chart> {
    let a = speckles(30, 0.0, 0.0);
    let mut series = Vec::new();
    for (interpolation, name) in [(Interpolation::Cubic, "cubic"), (Interpolation::Quintic, "quintic")] {
        let mut points = Vec::new();
        for k in 0..=20 {
            let u = f64::from(k) / 20.0;
            let b = image(SIZE, SIZE, &speckles(30, u, 0.0));
            let settings = Settings { interpolation, ..Settings::default() };
            let c = run(image(SIZE, SIZE, &a), b, Some([u, 0.0]), 5, &settings)?;
            points.push((u, 1e3 * mean_std(&errors(&c.points, |_, _| (u, 0.0)).0).0));
        }
        series.push(Series::new(name, SeriesStyle::Line, points));
    }
    Ok(Chart {
        title: "Bias of the displacement, 33 × 33 affine, no noise".into(),
        x_label: "shift (px)".into(),
        y_label: "mean error (10⁻³ px)".into(),
        series,
        y_limits: None,
    })
}

/// Stated uncertainty against the scatter of noisy repeats.
fn uncertainty() -> Fallible<Chart> {
    const REPEATS: u64 = 60;
    let truth = [0.5, 0.27];
    let (a, b) = (speckles(20, 0.0, 0.0), speckles(20, truth[0], truth[1]));
    let mut series = Vec::new();
    let mut largest: f64 = 0.0;
    for (shape, name) in [(Shape::Affine, "affine"), (Shape::Quadratic, "quadratic")] {
        for (solver, how) in [(SolverChoice::Exact, "exact"), (SolverChoice::Dense, "dense")] {
            let mut points = Vec::new();
            for noise in [0.5, 1.0, 2.0, 3.5, 5.0] {
                let settings = Settings { shape, solver, ..Settings::default() };
                let (mut stated, mut seen, mut count) = (0.0, 0.0, 0.0);
                for seed in 0..REPEATS {
                    let mut rng = ChaCha8Rng::seed_from_u64(seed);
                    let [m, n] = [&a, &b].map(|g| image(SIZE, SIZE, &noisy(g, noise, &mut rng)));
                    for p in run(m, n, Some(truth), 16, &settings)?.points.iter().filter(|p| p.status.is_ok())
                    {
                        stated += f64::from(p.sigma_u).powi(2);
                        seen += (p.u - truth[0]).powi(2);
                        count += 1.0;
                    }
                }
                points.push((1e3 * (seen / count).sqrt(), 1e3 * (stated / count).sqrt()));
            }
            largest = points.iter().fold(largest, |l, p| l.max(p.0));
            series.push(Series::new(&format!("{name}, {how}"), SeriesStyle::Points, points));
        }
    }
    series.push(Series::new("equal", SeriesStyle::Dashed, vec![(0.0, 0.0), (largest, largest)]));
    Ok(Chart {
        title: "Stated σ of u against the scatter, noise of 0.5–5 grey levels".into(),
        x_label: "scatter of repeats (10⁻³ px)".into(),
        y_label: "stated σ, RMS (10⁻³ px)".into(),
        series,
        y_limits: None,
    })
}

/// Measured part of the star's amplitude against its period, along the row nearest the centre.
fn star(dir: &Path) -> Fallible<Chart> {
    let mut series = Vec::new();
    for (shape, name) in [(Shape::Affine, "affine"), (Shape::Quadratic, "quadratic")] {
        let read = |case: &str| load(&dir.join(format!("s1024_n0_{case}.png")));
        let c = run(read("ref"), read("star"), None, 5, &Settings { shape, ..Settings::default() })?;
        let ok: Vec<&Point> = c.points.iter().filter(|p| p.status.is_ok()).collect();
        let Some(row) = ok.iter().map(|p| p.y).min_by(|a, b| (a - 511.5).abs().total_cmp(&(b - 511.5).abs()))
        else {
            return Err("no point of the star was found".into());
        };
        let points = ok
            .iter()
            .filter(|p| p.y == row)
            .filter_map(|p| {
                let (_, v) = score::truth("star", 1024, p.x, p.y)?;
                Some((score::star_period(1024, p.x), p.v / v))
            })
            .collect();
        series.push(Series::new(name, SeriesStyle::Line, points));
    }
    series.push(Series::new("a tenth lost", SeriesStyle::Dashed, vec![(10.0, 0.9), (150.0, 0.9)]));
    Ok(Chart {
        title: "Golden star: amplitude found, 33 × 33".into(),
        x_label: "period (px)".into(),
        y_label: "measured / true".into(),
        series,
        y_limits: Some((-0.2, 1.1)),
    })
}
