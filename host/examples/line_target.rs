//! Writes images of a simulated line target, to try `daic calibrate distortion` without a camera:
//!
//! ```text
//! cargo run --release --example line_target -- FOLDER [WIDTHxHEIGHT] [SEED]
//! daic calibrate distortion FOLDER/along_x.png FOLDER/along_y.png --out map
//! ```
//!
//! `along_x.png` and `along_y.png` are two exposures of square-wave lines 10.3 px apart through a
//! diffraction-limited f/8 lens with 0.3 % of distortion, on a sensor with seven defects of 0.05 px and 1 % of
//! noise; in each the target lies otherwise, turned by 1° in its plane and out of it. `cross.png` shows both
//! directions at once. The same size (700x520 if left out) and seed give the same images.

// The tests use more of it.
#[allow(dead_code)]
#[path = "../tests/target/mod.rs"]
mod target;

use std::path::Path;
use target::{Lines, Noise, OTHER, POSE, Scene, grey, save};

fn main() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1);
    let usage = "usage: line_target FOLDER [WIDTHxHEIGHT] [SEED]";
    let folder = arguments.next().ok_or(usage)?;
    let side = |text: &str| text.parse::<usize>().ok().filter(|n| (200..=8192).contains(n));
    let size = match arguments.next() {
        None => [700, 520],
        Some(text) => text
            .split_once('x')
            .and_then(|(w, h)| Some([side(w)?, side(h)?]))
            .ok_or(format!("{text}: a size is WIDTHxHEIGHT, 200 to 8192 pixels each"))?,
    };
    let seed = arguments.next().map_or(Ok(7), |s| s.parse()).map_err(|_| usage)?;
    std::fs::create_dir_all(&folder).map_err(|e| format!("{folder}: {e}"))?;
    let scene = Scene::usual(size, 60.0);
    let mut noise = Noise::new(seed);
    for (name, pose, lines) in [
        ("along_x.png", OTHER, Lines::CrossedByY),
        ("along_y.png", POSE, Lines::CrossedByX),
        ("cross.png", POSE, Lines::Both),
    ] {
        let path = Path::new(&folder).join(name);
        save(&path, size, grey(&scene.brightness(&pose, lines), &mut noise));
        println!("{}", path.display());
    }
    Ok(())
}
