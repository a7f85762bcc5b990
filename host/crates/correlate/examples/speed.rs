//! Points per second of a correlation: `speed REF DEF [subset] [step] [order] [csv] [repeats] [exact|dense|auto]
//! [cubic|quintic|septic] [threads]`, one thread by default. Everything from the 8-bit grey levels on is counted.

use daic_correlate::*;
use std::io::Write;
use std::time::Instant;

/// CPU seconds of this process's threads, where the system tells.
fn cpu() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else {
        return f64::NAN;
    };
    tasks
        .flatten()
        .filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok())
        .filter_map(|s| s.split(' ').next()?.parse::<f64>().ok())
        .sum::<f64>()
        * 1e-9
}

struct Grey {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

impl Grey {
    fn load(path: &str) -> Self {
        let i = image::open(path).expect("an image").to_luma8();
        Self { width: i.width() as usize, height: i.height() as usize, pixels: i.into_raw() }
    }

    fn image(&self) -> Image {
        Image::from_u8(self.width, self.height, &self.pixels).expect("a size")
    }
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let number = |k: usize, d: usize| args.get(k).map_or(d, |a| a.parse().expect("a number"));
    let (a, b) = (Grey::load(&args[1]), Grey::load(&args[2]));
    let shape = match number(5, 1) {
        0 => Shape::Translation,
        1 => Shape::Affine,
        _ => Shape::Quadratic,
    };
    let solver = match args.get(8).map(String::as_str) {
        Some("exact") => SolverChoice::Exact,
        Some("dense") => SolverChoice::Dense,
        _ => SolverChoice::Auto,
    };
    let interpolation = match args.get(9).map(String::as_str) {
        Some("cubic") => Interpolation::Cubic,
        Some("septic") => Interpolation::Septic,
        _ => Interpolation::Quintic,
    };
    let settings = Settings { subset: number(3, 33), shape, solver, interpolation, ..Settings::default() };
    let mut workspace = Workspace::new();
    let mut kept: Option<(Reference, Target)> = None;
    let roi = Roi {
        rectangle: Some(Rectangle { x: 40, y: 40, width: a.width - 80, height: a.height - 80 }),
        mask: None,
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(number(10, 1)).build().expect("a thread");
    let points = Points::grid(a.width, a.height, settings.subset, number(4, 5), &roi).expect("a grid");
    for _ in 0..number(7, 3) {
        let (start, cpu0) = (Instant::now(), cpu());
        let (c, prepare) = pool.install(|| {
            match &mut kept {
                Some((reference, target)) => {
                    reference.assign(a.width, a.height, a.width, &a.pixels).expect("a size");
                    target.assign(b.width, b.height, b.width, &b.pixels).expect("a size");
                }
                none => {
                    *none = Some((Reference::new(a.image()), Target::new(b.image(), settings.interpolation)))
                }
            }
            let Some((reference, target)) = &kept else { unreachable!("made above") };
            let prepare = start.elapsed();
            let c = workspace
                .correlate(reference, target, &points, &Guess::Fft, &settings, &())
                .expect("a correlation");
            (c, prepare)
        });
        let total = cpu() - cpu0;
        let iterations: u32 = c.points.iter().map(|p| u32::from(p.iterations)).sum();
        println!(
            "{} points, {} ok, {} dense, prepare {:.1} ms, init {:.1} ms, solve {:.1} ms, {:.2} iterations: {:.0} points/CPU-s, {:.0} points/s ({})",
            points.len(),
            c.converged(),
            c.points.iter().filter(|p| p.solver == SolvedBy::Dense && p.status.is_ok()).count(),
            prepare.as_secs_f64() * 1e3,
            c.timing.init.as_secs_f64() * 1e3,
            c.timing.solve.as_secs_f64() * 1e3,
            f64::from(iterations) / points.len() as f64,
            points.len() as f64 / total,
            points.len() as f64 / (prepare + c.timing.init + c.timing.solve).as_secs_f64(),
            simd_level(),
        );
        if let Some(path) = args.get(6).filter(|p| *p != "-") {
            let mut f = std::io::BufWriter::new(std::fs::File::create(path).expect("a file"));
            writeln!(f, "x,y,u,v,su,sv,zncc,iters,status,ok").expect("space");
            for p in &c.points {
                writeln!(
                    f,
                    "{},{},{:.7},{:.7},{:.3e},{:.3e},{:.6},{},{},{}",
                    p.x,
                    p.y,
                    p.u,
                    p.v,
                    p.sigma_u,
                    p.sigma_v,
                    p.zncc,
                    p.iterations,
                    p.status,
                    u8::from(p.status.is_ok())
                )
                .expect("space");
            }
        }
    }
}
