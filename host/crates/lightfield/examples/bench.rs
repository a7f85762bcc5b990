//! Speed of the light-field reconstruction; one JSON line for each measurement. Used by
//! `cargo xtask bench lightfield`.
//!
//! Arguments: what is to be measured (`psf`, `rl`, `isra`, `dlfm`, `size`, `psf-plane`, `stream`), threads, repeats, and the only case to time.

use daic_lightfield::{
    DiffractionModel, Frame, Grating, Method, Model, Normal, Operator, OperatorSettings, Order, Oversampling,
    Psf, PsfParameters, Radius, Settings, Storage, native_widths, reconstruct,
};
use std::time::Instant;

/// Seconds of processor time of this process; NaN where the system does not tell.
fn cpu() -> f64 {
    #[cfg(unix)]
    {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        t.tv_sec as f64 + 1e-9 * t.tv_nsec as f64
    }
    #[cfg(not(unix))]
    f64::NAN
}

/// Bytes that [`stream`] reads: more than a cache holds for one thread.
const STREAM_BYTES: usize = 64 << 20;
/// Sums that [`stream`] keeps apart, so that additions do not wait for each other.
const STREAM_LANES: usize = 64;

/// Bytes per second that one thread reads from memory.
fn stream(repeats: usize) {
    let values: Vec<f32> = (0..STREAM_BYTES / 4).map(|i| (i % 7) as f32).collect();
    let mut walls = Vec::new();
    for _ in 0..repeats {
        let begin = Instant::now();
        let mut sums = [0f32; STREAM_LANES];
        for chunk in std::hint::black_box(&values).as_chunks::<STREAM_LANES>().0 {
            for (s, v) in sums.iter_mut().zip(chunk) {
                *s += v;
            }
        }
        std::hint::black_box(&sums);
        walls.push(begin.elapsed().as_secs_f64());
    }
    let (middle, best, _) = median(walls);
    let rate = |seconds: f64| 1e-9 * STREAM_BYTES as f64 / seconds;
    println!("{{\"case\":\"stream\",\"gb_s\":{:.2},\"gb_s_best\":{:.2}}}", rate(middle), rate(best));
}

/// A number in JSON, which has no NaN.
fn json(v: f64) -> String {
    if v.is_finite() { format!("{v:.6}") } else { "null".into() }
}

fn list(v: &[f64]) -> String {
    format!("[{}]", v.iter().map(|v| json(*v)).collect::<Vec<_>>().join(","))
}

fn median(mut v: Vec<f64>) -> (f64, f64, f64) {
    v.sort_by(f64::total_cmp);
    (v[v.len() / 2], v[0], v[v.len() - 1])
}

/// The `bench` geometry: z = −20…20 µm.
fn parameters(grating: Option<Grating>) -> PsfParameters {
    PsfParameters {
        grating,
        radius: Radius::Cells(if grating.is_some() { 5 } else { 4 }),
        oversampling: Oversampling::Samples(5),
        allow_under_sampling: true,
        ..PsfParameters::thesis((0..17).map(|z| -20.0 + 2.5 * f64::from(z)).collect())
    }
}

fn psf(grating: Option<Grating>) -> (Psf, f64) {
    let before = cpu();
    let psf = Psf::compute(&parameters(grating)).expect("the published microscope");
    (psf, cpu() - before)
}

/// Beads on a weak background, the same in every run.
fn volume(n: usize) -> Vec<f32> {
    let mut state = 1u64;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let u = (state >> 40) as f32 / (1u64 << 24) as f32;
            if u < 0.01 { 50.0 * u * 100.0 } else { 0.05 }
        })
        .collect()
}

struct Case<'a> {
    name: &'a str,
    model: Model,
    settings: Settings,
    build: f64,
}

fn time(case: &Case<'_>, repeats: usize) {
    if std::env::args().nth(4).is_some_and(|only| only != case.name) {
        return;
    }
    let m = &case.model;
    let shape = m.operator.volume_shape();
    let g = volume(shape.iter().product());
    let mut image = m.operator.project(&[&g]).expect("sizes fit").remove(0);
    // darkness comes out with both signs by rounding
    image.iter_mut().for_each(|v| *v = v.max(0.0));
    let width = m.operator.image_shape()[1];
    let images: Vec<Vec<f32>> = (0..m.orders)
        .map(|o| match o {
            0 => image.clone(),
            _ => {
                image.chunks_exact(width).flat_map(|r| r.iter().rev().copied().collect::<Vec<_>>()).collect()
            }
        })
        .collect();
    let frame = [Frame { images: images.iter().map(Vec::as_slice).collect(), ..Frame::default() }];
    let (mut cpus, mut walls, mut first_cpus) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..repeats {
        // iterations alone: the time of eight minus that of none is not asked; everything after the operator
        let (c, w) = (cpu(), Instant::now());
        let mut marks = Vec::new();
        reconstruct(m, &frame, &case.settings, None, &mut |_| {
            marks.push(cpu());
            true
        })
        .expect("a frame that can be reconstructed");
        cpus.push(cpu() - c);
        walls.push(w.elapsed().as_secs_f64());
        if let [a, .., b] = marks[..] {
            first_cpus.push((b - a) / (marks.len() - 1) as f64);
        }
    }
    let memory = m.operator.memory();
    let bytes = m.normal.as_ref().map_or(memory.blocks, Normal::bytes);
    println!(
        "{{\"case\":\"{}\",\"threads\":{},\"cpu\":{},\"wall\":{},\"iteration_cpu\":{},\"iterations\":{},\"block_bytes\":{bytes},\"peak_bytes\":{},\"reduction\":\"{:?}\",\"grid\":[{},{}],\"build_cpu\":{}}}",
        case.name,
        rayon::current_num_threads(),
        list(&cpus),
        list(&walls),
        list(&first_cpus),
        case.settings.iterations,
        memory.peak(),
        m.normal.as_ref().map_or(memory.reduction, Normal::reduction),
        memory.grid[0],
        memory.grid[1],
        json(case.build),
    );
}

fn model(psf: &Psf, settings: &OperatorSettings, orders: usize, normal: bool) -> (Model, f64) {
    let before = cpu();
    let model = Model {
        operator: Operator::new(psf, settings).expect("a possible grid"),
        orders,
        normal: if normal { Normal::new(psf, settings.cells, settings.storage, orders) } else { None },
        voxel_um: [2.5; 3],
        widths: native_widths(&psf.parameters),
    };
    (model, cpu() - before)
}

fn run(what: &str, repeats: usize) {
    let plus = Grating { pitch_um: 0.9, order: Order::Plus, model: DiffractionModel::Virtual };
    let cells = [35, 35];
    match what {
        "psf" => {
            for (name, grating) in [("psf", None), ("psf-dlfm", Some(plus))] {
                let seconds = psf(grating).1;
                println!("{{\"case\":\"{name}\",\"cpu\":{},\"planes\":17}}", json(seconds));
            }
        }
        "stream" => stream(repeats),
        "psf-plane" => {
            // one plane at sufficient sampling, 75 samples a lenslet as the peer at Nnum 75
            let p = PsfParameters { planes_um: vec![20.0], ..parameters(None) };
            let before = cpu();
            Psf::compute(&p).expect("the published microscope");
            println!("{{\"case\":\"psf-plane\",\"cpu\":{},\"planes\":1}}", json(cpu() - before));
        }
        "rl" | "isra" | "dlfm" => {
            let dlfm = what == "dlfm";
            let (psf, _) = psf(dlfm.then_some(plus));
            let orders = if dlfm { 2 } else { 1 };
            let margin = psf.radius as isize;
            let storages = [("f32", Storage::F32), ("f16", Storage::F16)];
            for (name, storage) in storages {
                let same = OperatorSettings { storage, ..OperatorSettings::new(cells) };
                let large = OperatorSettings { margin, ..same };
                let mut list = Vec::new();
                if what != "isra" {
                    list.push(("rl", same, Method::Rl, false));
                }
                if what != "rl" {
                    list.push(("isra-normal", large, Method::Isra, true));
                    list.push(("isra-two-passes", same, Method::Isra, false));
                }
                for (kind, settings, method, normal) in list {
                    let (model, build) = model(&psf, &settings, orders, normal);
                    let name = format!("{}{kind}-{name}", if dlfm { "dlfm-" } else { "" });
                    let case = Case { name: &name, model, settings: Settings::new(method, 8), build };
                    time(&case, repeats);
                }
            }
            if what == "rl" {
                let settings = OperatorSettings { use_symmetry: false, ..OperatorSettings::new(cells) };
                let (model, build) = model(&psf, &settings, 1, false);
                let case =
                    Case { name: "rl-complex-f32", model, settings: Settings::new(Method::Rl, 8), build };
                time(&case, repeats);
            }
        }
        "size" => {
            // cost against lenslets and planes
            for (n, planes) in [(35, 17), (50, 17), (70, 17), (35, 9), (35, 31), (101, 31)] {
                let p = PsfParameters {
                    planes_um: (0..planes)
                        .map(|z| -20.0 + 40.0 * f64::from(z) / f64::from(planes - 1))
                        .collect(),
                    ..parameters(None)
                };
                let psf = Psf::compute(&p).expect("the published microscope");
                let (model, build) = model(&psf, &OperatorSettings::new([n, n]), 1, false);
                let name = format!("rl-f32-{n}x{n}x{planes}");
                let case = Case { name: &name, model, settings: Settings::new(Method::Rl, 8), build };
                time(&case, repeats.min(3));
            }
            let peak = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
            let peak = peak.lines().find_map(|l| l.strip_prefix("VmHWM:"));
            let kib: f64 = peak.and_then(|v| v.split_whitespace().next()?.parse().ok()).unwrap_or(f64::NAN);
            println!("{{\"case\":\"size-memory\",\"peak_mib\":{}}}", json((kib / 1024.0).round()));
        }
        other => eprintln!("nothing is called `{other}`"),
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |i: usize, default: usize| arguments.get(i).and_then(|v| v.parse().ok()).unwrap_or(default);
    let what = arguments.first().map_or("rl", String::as_str).to_owned();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(number(1, 1)).build().expect("threads");
    pool.install(|| run(&what, number(2, 15)));
}
