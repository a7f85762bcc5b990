//! Time and memory of whole runs, from 8-bit pixels to points with σ and status.

use crate::pictures::Grey;
use crate::{Work, clock};
use daic_correlate::*;
use serde_json::{Value, json};
use std::time::Instant;

/// What is kept over a series.
struct Series {
    reference: Reference,
    target: Target,
    points: Points,
    workspace: Workspace,
}

struct Run {
    cpu: f64,
    wall: f64,
    correlation: Correlation,
}

fn image(g: &Grey) -> Result<Image, String> {
    Image::from_u8(g.width, g.height, &g.pixels).map_err(|e| e.to_string())
}

fn timed(run: impl FnOnce() -> Result<Correlation, String>) -> Result<Run, String> {
    let (start, cpu) = (Instant::now(), clock::cpu());
    let correlation = run()?;
    Ok(Run { cpu: clock::cpu() - cpu, wall: start.elapsed().as_secs_f64(), correlation })
}

impl Series {
    /// The first pair: everything is made new, the grid of points too.
    fn cold(work: &Work, a: &Grey, b: &Grey) -> Result<(Self, Run), String> {
        let mut series = None;
        let run = timed(|| {
            let reference = Reference::new(image(a)?);
            let target = Target::new(image(b)?, work.settings.interpolation);
            let points = work.grid(a.width, a.height)?;
            let s = series.insert(Series { reference, target, points, workspace: Workspace::new() });
            s.correlate(work)
        })?;
        Ok((series.ok_or("nothing was kept")?, run))
    }

    /// A further pair: both images are new, memory and grid are used again.
    fn warm(&mut self, work: &Work, a: &Grey, b: &Grey) -> Result<Run, String> {
        timed(|| {
            let failed = |e: ImageError| e.to_string();
            self.reference.assign(a.width, a.height, a.width, &a.pixels).map_err(failed)?;
            self.target.assign(b.width, b.height, b.width, &b.pixels).map_err(failed)?;
            self.correlate(work)
        })
    }

    fn correlate(&mut self, work: &Work) -> Result<Correlation, String> {
        let Self { reference, target, points, workspace } = self;
        workspace
            .correlate(reference, target, points, &Guess::Fft, &work.settings, &())
            .map_err(|e| e.to_string())
    }
}

fn summary(work: &Work, a: &Grey, c: &Correlation) -> Value {
    let dense = c.points.iter().filter(|p| p.solver == SolvedBy::Dense).count();
    let iterations: f64 = c.points.iter().map(|p| f64::from(p.iterations)).sum();
    json!({
        "width": a.width, "height": a.height, "points": c.points.len(), "ok": c.converged(),
        "dense": dense, "iterations": iterations / c.points.len() as f64, "simd": simd_level(),
        "settings": work.settings, "step": work.step, "threads": work.threads,
    })
}

fn times(r: &Run) -> Value {
    let t = r.correlation.timing;
    json!({ "cpu": r.cpu, "wall": r.wall, "init": t.init.as_secs_f64(), "solve": t.solve.as_secs_f64() })
}

/// The first run of this process and `repeats` warm ones.
pub fn speed(work: &Work, a: &Grey, b: &Grey) -> Result<Value, String> {
    let pool = work.pool(work.threads)?;
    pool.install(|| {
        let (mut series, cold) = Series::cold(work, a, b)?;
        let mut warm = Vec::new();
        for _ in 0..work.repeats {
            warm.push(times(&series.warm(work, a, b)?));
        }
        let mut out = summary(work, a, &cold.correlation);
        out["cold"] = times(&cold);
        out["warm"] = Value::Array(warm);
        Ok(out)
    })
}

/// Warm runs on one and on two threads, in turn; the results must be the same, bit for bit.
pub fn threads(work: &Work, a: &Grey, b: &Grey) -> Result<Value, String> {
    let pools = [work.pool(1)?, work.pool(2)?];
    let (mut series, first) = pools[0].install(|| Series::cold(work, a, b))?;
    let mut wall = [Vec::new(), Vec::new()];
    let mut cpu = [Vec::new(), Vec::new()];
    let mut identical = true;
    for _ in 0..work.repeats {
        for (k, pool) in pools.iter().enumerate() {
            let run = pool.install(|| series.warm(work, a, b))?;
            wall[k].push(run.wall);
            cpu[k].push(run.cpu);
            identical &= same(&first.correlation, &run.correlation);
        }
    }
    let mut out = summary(work, a, &first.correlation);
    out["wall"] = json!(wall);
    out["cpu"] = json!(cpu);
    out["identical"] = json!(identical);
    Ok(out)
}

fn same(a: &Correlation, b: &Correlation) -> bool {
    let bits = |p: &Point| {
        let sigma = [p.sigma_u.to_bits(), p.sigma_v.to_bits(), p.zncc.to_bits()];
        (p.u.to_bits(), p.v.to_bits(), sigma, p.status, p.solver)
    };
    a.points.len() == b.points.len() && a.points.iter().zip(&b.points).all(|(p, q)| bits(p) == bits(q))
}

/// What a series of three frames adds to the resident memory of a process that holds the two 8-bit
/// images; results of the last frame are held.
pub fn memory(work: &Work, a: &Grey, b: &Grey) -> Result<Value, String> {
    let pool = work.pool(work.threads)?;
    // where the peak cannot be reset, that of the decoder may hide some of it
    let reset = clock::reset_peak();
    let before = clock::resident().ok_or("this system does not tell the resident memory")?;
    let (frames, correlation) = pool.install(|| {
        let mut peaks = Vec::new();
        let (mut series, run) = Series::cold(work, a, b)?;
        peaks.push(clock::peak());
        let mut last = run.correlation;
        for _ in 0..2 {
            last = series.warm(work, a, b)?.correlation;
            peaks.push(clock::peak());
        }
        Ok::<_, String>((peaks, last))
    })?;
    let mut out = summary(work, a, &correlation);
    out["before"] = json!(before);
    out["peaks"] = json!(frames);
    out["reset"] = json!(reset);
    Ok(out)
}
