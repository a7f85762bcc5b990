//! A small fixed amount of work, to be counted by callgrind: `guard WORK`, where WORK is `nothing`,
//! `prepare`, `search`, `exact-affine`, `exact-quadratic` or `dense-affine`. Prints the SIMD level.
//!
//! Everything runs on the main thread: an idle thread's waiting would be counted too.

use daic_correlate::*;

const SIZE: usize = 192;

/// A smooth texture without symmetry, moved by (u, v).
fn texture(u: f64, v: f64) -> Vec<u8> {
    let mut pixels = Vec::with_capacity(SIZE * SIZE);
    for y in 0..SIZE {
        for x in 0..SIZE {
            let (x, y) = (x as f64 - u, y as f64 - v);
            let waves = (0.61 * x + 0.2 * y).sin()
                + (0.47 * y - 0.33 * x).cos()
                + (0.13 * x * (1.0 + 0.002 * y)).sin();
            let fine = (0.9 * x + 0.7 * y + 0.004 * x * y).sin();
            pixels.push((120.0 + 30.0 * waves + 20.0 * fine).clamp(0.0, 255.0) as u8);
        }
    }
    pixels
}

fn image(pixels: &[u8]) -> Image {
    Image::from_u8(SIZE, SIZE, pixels).expect("the size is that of the texture")
}

fn work(name: &str) -> Option<usize> {
    let (a, b) = (texture(0.0, 0.0), texture(0.3, -0.2));
    if name == "nothing" {
        return Some(a.len() + b.len());
    }
    let (shape, solver, step) = match name {
        "prepare" | "search" => (Shape::Affine, SolverChoice::Exact, 128),
        "exact-affine" => (Shape::Affine, SolverChoice::Exact, 8),
        "exact-quadratic" => (Shape::Quadratic, SolverChoice::Exact, 10),
        "dense-affine" => (Shape::Affine, SolverChoice::Auto, 4),
        _ => return None,
    };
    let settings = Settings { shape, solver, ..Settings::default() };
    let (reference, target) = (Reference::new(image(&a)), Target::new(image(&b), settings.interpolation));
    if name == "prepare" {
        return Some(reference.image().width() + target.image().width());
    }
    let points = Points::grid(SIZE, SIZE, settings.subset, step, &Roi::default()).expect("the grid fits");
    let given = vec![Some([0.0, 0.0]); points.len()];
    // the searches by FFT are counted apart from the solvers
    let guess = if name == "search" { Guess::Fft } else { Guess::Given(&given) };
    let c = correlate(&reference, &target, &points, &guess, &settings, &()).expect("settings are valid");
    assert_eq!(c.converged(), points.len(), "all points of an undisturbed texture are found");
    Some(c.converged())
}

fn main() -> std::process::ExitCode {
    let name = std::env::args().nth(1).unwrap_or_default();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
    // the pool lives on this thread until the end
    let done = pool.ok().and_then(|_pool| work(&name));
    if done.is_none() {
        eprintln!("guard: no work `{name}`");
        return std::process::ExitCode::FAILURE;
    }
    println!("{}", simd_level());
    std::process::ExitCode::SUCCESS
}
