//! Errors on images of known fields (`s1024_n0_t02.png` and so on).

use crate::Work;
use crate::score::{score, star_period_at_tenth};
use daic_correlate::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use std::io::Write;
use std::path::Path;

/// Field, noise level, shape function, subset.
type Case = (&'static str, &'static str, Shape, usize);

const FEW: [Case; 3] =
    [("t02", "n0", Shape::Affine, 33), ("t02", "n2", Shape::Affine, 33), ("aff1", "n0", Shape::Affine, 33)];

const REST: [Case; 12] = [
    ("t05", "n0", Shape::Affine, 33),
    ("t05", "n2", Shape::Affine, 33),
    ("t02", "n0", Shape::Affine, 59),
    ("t02", "n2", Shape::Affine, 59),
    ("t02", "n0", Shape::Quadratic, 33),
    ("t02", "n2", Shape::Quadratic, 33),
    ("aff1", "n2", Shape::Affine, 33),
    ("quad", "n0", Shape::Quadratic, 33),
    ("quad", "n2", Shape::Quadratic, 33),
    ("star", "n0", Shape::Affine, 33),
    ("star", "n0", Shape::Quadratic, 33),
    ("step", "n0", Shape::Affine, 33),
];

/// Seeds of the check for a bias from noise, and its noise in grey levels.
const SEEDS: u64 = 20;
const NOISE: f64 = 2.0;

fn load(dir: &Path, noise: &str, field: &str) -> Result<Image, String> {
    let g = crate::pictures::read(&dir.join(format!("s1024_{noise}_{field}.png")))?;
    Image::from_u8(g.width, g.height, &g.pixels).map_err(|e| e.to_string())
}

fn run(work: &Work, settings: &Settings, a: Image, b: Image) -> Result<Correlation, String> {
    let points = Work { settings: settings.clone(), ..work.clone() }.grid(a.width(), a.height())?;
    let (reference, target) = (Reference::new(a), Target::new(b, settings.interpolation));
    correlate(&reference, &target, &points, &Guess::Fft, settings, &()).map_err(|e| e.to_string())
}

fn plain(points: &[Point]) -> Vec<([f64; 4], bool)> {
    points.iter().map(|p| ([p.x, p.y, p.u, p.v], p.status.is_ok())).collect()
}

/// Root mean square distance of u and v, over the points that both accept.
fn distance(a: &[Point], b: &[Point]) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for (p, q) in a.iter().zip(b).filter(|(p, q)| p.status.is_ok() && q.status.is_ok()) {
        sum += (p.u - q.u).powi(2) + (p.v - q.v).powi(2);
        n += 2.0;
    }
    (sum / n).sqrt()
}

fn csv(path: &Path, points: &[Point]) -> std::io::Result<()> {
    let mut f = std::io::BufWriter::new(std::fs::File::create(path)?);
    writeln!(f, "x,y,u,v,su,sv,zncc,iters,status,solver,ok")?;
    for p in points {
        writeln!(
            f,
            "{},{},{:.9},{:.9},{:.3e},{:.3e},{:.6},{},{},{},{}",
            p.x,
            p.y,
            p.u,
            p.v,
            p.sigma_u,
            p.sigma_v,
            p.zncc,
            p.iterations,
            p.status,
            p.solver,
            u8::from(p.status.is_ok())
        )?;
    }
    f.flush()
}

/// Prints one line per case.
pub fn all(work: &Work, dir: &Path, few: bool, out: Option<&Path>) -> Result<(), String> {
    let pool = work.pool(work.threads)?;
    let solver = serde_json::to_value(work.settings.solver).map_err(|e| e.to_string())?;
    let name = solver.as_str().unwrap_or_default().to_owned();
    for &(field, noise, shape, subset) in FEW.iter().chain(if few { &[][..] } else { &REST[..] }) {
        let settings = Settings { shape, subset, ..work.settings.clone() };
        let (a, b) = (load(dir, noise, "ref")?, load(dir, noise, field)?);
        let size = a.width();
        let c = pool.install(|| run(work, &settings, a.clone(), b.clone()))?;
        let points = plain(&c.points);
        let s = score(field, size, &points).ok_or_else(|| format!("no truth for `{field}`"))?;
        let squares: f64 =
            c.points.iter().filter(|p| p.status.is_ok()).map(|p| f64::from(p.sigma_u).powi(2)).sum();
        let mut line = json!({
            "field": field, "noise": noise, "shape": shape, "subset": subset, "solver": &solver,
            "points": s.points, "ok": s.ok, "outliers": s.outliers, "bias": s.bias, "scatter": s.scatter,
            "sigma_u": (squares / s.ok as f64).sqrt(),
            "dense": c.points.iter().filter(|p| p.solver == SolvedBy::Dense).count(),
        });
        if field == "star" {
            line["period"] = json!(star_period_at_tenth(size, &points));
        }
        if matches!(field, "t02" | "aff1") && settings.solver != SolverChoice::Exact {
            let exact = Settings { solver: SolverChoice::Exact, tolerance: 1e-6, ..settings.clone() };
            let e = pool.install(|| run(work, &exact, a, b))?;
            line["from_exact"] = json!(distance(&c.points, &e.points));
        }
        if let Some(folder) = out {
            let shape = serde_json::to_value(shape).map_err(|e| e.to_string())?;
            let file =
                format!("s1024_{noise}_{field}.{name}.{}.{subset}.csv", shape.as_str().unwrap_or_default());
            let path = folder.join(file);
            csv(&path, &c.points).map_err(|e| format!("{}: {e}", path.display()))?;
            line["csv"] = json!(path);
        }
        println!("{line}");
    }
    if !few {
        noise_bias(work, dir)?;
    }
    Ok(())
}

/// Mean over many seeds of the mean error under fresh noise in both images: what noise does to the
/// mean, not to the scatter.
fn noise_bias(work: &Work, dir: &Path) -> Result<(), String> {
    let (a, b) = (load(dir, "n0", "ref")?, load(dir, "n0", "t02")?);
    let pool = work.pool(work.threads)?;
    let settings = &work.settings;
    let step = Work { step: 8, ..work.clone() };
    let mean = |a: Image, b: Image| -> Result<[f64; 2], String> {
        let size = a.width();
        let c = pool.install(|| run(&step, settings, a, b))?;
        score("t02", size, &plain(&c.points)).map(|s| s.bias).ok_or_else(|| "no truth".into())
    };
    let still = mean(a.clone(), b.clone())?;
    let mut sum = [0.0; 2];
    for seed in 0..SEEDS {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let m = mean(noisy(&a, &mut rng)?, noisy(&b, &mut rng)?)?;
        for c in 0..2 {
            sum[c] += m[c] / SEEDS as f64;
        }
    }
    println!(
        "{}",
        json!({ "noise_bias": sum, "without_noise": still, "seeds": SEEDS, "grey_levels": NOISE,
                "solver": settings.solver })
    );
    Ok(())
}

fn noisy(image: &Image, rng: &mut ChaCha8Rng) -> Result<Image, String> {
    let grey = image
        .grey()
        .iter()
        .map(|g| {
            let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
            let n = NOISE * (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos();
            (f64::from(*g) + n).round().clamp(0.0, 255.0) as f32
        })
        .collect();
    Image::from_f32(image.width(), image.height(), grey).map_err(|e| e.to_string())
}
