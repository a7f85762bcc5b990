//! Frames per second from pixels in memory to height maps:
//! `live OPTICS SHAPE THREADS REPEATS FRAME…`, SHAPE affine or quadratic. The frames are taken in turn.

use daic::measure::{Live, Settings};
use daic::{Silent, images, optics_section};
use daic_correlate::Shape;
use daic_optics::{Decoder, OpticalModel};
use daic_rig::experiment::OpticsFile;
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [optics, shape, threads, repeats, files @ ..] = arguments.as_slice() else {
        return Err("live OPTICS affine|quadratic THREADS REPEATS FRAME…".into());
    };
    let model =
        OpticalModel::new(&optics_section::from_section(&OpticsFile::load(Path::new(optics))?.optics)?)?;
    let mut settings = Settings::default();
    settings.dic.shape = if shape == "affine" { Shape::Affine } else { Shape::Quadratic };
    let frames: Vec<_> = files.iter().map(|f| images::read(Path::new(f))).collect::<Result<_, _>>()?;
    let bytes: Vec<Vec<u8>> = frames.iter().map(|f| f.data.iter().map(|&g| g as u8).collect()).collect();
    let first = frames.first().ok_or("no frame")?;
    let (width, height) = (first.width as usize, first.height as usize);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.parse()?).build()?;
    pool.install(|| {
        let mut live = Live::new(first, &model, Decoder::Ray, &settings, &Silent)?;
        let mut times = Vec::new();
        for k in 0..repeats.parse()? {
            let start = Instant::now();
            let profile = live.frame(width, height, &bytes[k % bytes.len()])?;
            times.push(start.elapsed().as_secs_f64());
            let ok: Vec<_> = profile.points.iter().filter(|p| p.status.is_ok()).collect();
            let mean = ok.iter().map(|p| p.point_mm[2]).sum::<f64>() / ok.len() as f64;
            let sigma = ok.iter().map(|p| p.sigma_mm()[2]).sum::<f64>() / ok.len() as f64;
            println!(
                "frame {k}: {} of {} points, mean height {mean:.4} mm, σ {:.2} µm, {:.1} ms",
                ok.len(),
                live.points(),
                sigma * 1e3,
                times[k] * 1e3
            );
        }
        times.sort_by(f64::total_cmp);
        println!("median {:.1} frames/s with {threads} threads", 1.0 / times[times.len() / 2]);
        Ok(())
    })
}
