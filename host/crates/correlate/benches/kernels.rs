//! The kernels by themselves, 33×33 subsets and a 512² image, with the scalar reference beside them:
//! `cargo bench -p daic-correlate --features bench`. Groups are kernels, `simd` and `scalar` their
//! two forms.

use criterion::{Criterion, criterion_group, criterion_main};
use daic_correlate::bench_support::Bench;
use daic_correlate::{
    Guess, Image, Interpolation, Points, Reference, Roi, Settings, Shape, Target, Workspace,
};
use std::hint::black_box;
use std::time::Duration;

const SIZE: usize = 512;

/// A texture that is never the same twice.
fn texture(u: f64, v: f64) -> Image {
    let grey = (0..SIZE * SIZE)
        .map(|k| {
            let (x, y) = ((k % SIZE) as f64 - u, (k / SIZE) as f64 - v);
            let waves = (0.61 * x + 0.2 * y).sin() + (0.47 * y - 0.33 * x).cos();
            (120.0 + 35.0 * waves + 20.0 * (0.9 * x + 0.7 * y + 0.004 * x * y).sin()) as f32
        })
        .collect();
    Image::from_f32(SIZE, SIZE, grey).expect("the size is that of the texture")
}

fn bench(shape: Shape) -> Bench {
    Bench::new(texture(0.0, 0.0), texture(1.3, -0.4), Settings { shape, ..Settings::default() })
}

fn planes(c: &mut Criterion) {
    let mut b = bench(Shape::Affine);
    for (name, kind) in [
        ("cubic", Interpolation::Cubic),
        ("quintic", Interpolation::Quintic),
        ("septic", Interpolation::Septic),
    ] {
        c.benchmark_group(format!("image 512², load and prefilter, {name}"))
            .bench_function("simd", |t| t.iter(|| b.prefilter(kind)));
    }
    c.benchmark_group("image 512², load and both gradients")
        .bench_function("simd", |t| t.iter(|| b.gradients()));
}

fn subsets(c: &mut Criterion) {
    let mut b = bench(Shape::Affine);
    let mut group = c.benchmark_group("subset, load and moments, affine");
    group.bench_function("simd", |t| t.iter(|| black_box(b.subset_affine())));
    group.bench_function("scalar", |t| t.iter(|| black_box(b.subset_scalar(1))));
    group.finish();
    let mut b = bench(Shape::Quadratic);
    let mut group = c.benchmark_group("subset, load and moments, quadratic");
    group.bench_function("simd", |t| t.iter(|| black_box(b.subset_quadratic())));
    group.bench_function("scalar", |t| t.iter(|| black_box(b.subset_scalar(2))));
    group.finish();
}

fn sweeps(c: &mut Criterion) {
    let mut b = bench(Shape::Affine);
    let mut group = c.benchmark_group("exact, one sweep, affine");
    group.bench_function("simd", |t| t.iter(|| black_box(b.sweep_affine())));
    group.bench_function("scalar", |t| t.iter(|| black_box(b.sweep_scalar(1))));
    group.finish();
    let mut b = bench(Shape::Quadratic);
    let mut group = c.benchmark_group("exact, one sweep, quadratic");
    group.bench_function("simd", |t| t.iter(|| black_box(b.sweep_quadratic())));
    group.bench_function("scalar", |t| t.iter(|| black_box(b.sweep_scalar(2))));
    group.finish();
}

fn search(c: &mut Criterion) {
    let mut b = bench(Shape::Affine);
    let mut find = b.search(47);
    c.benchmark_group("search, ±47 px by FFT").bench_function("simd", |t| t.iter(|| black_box(find())));
}

/// The dense form as a whole: it has no scalar twin; the tests hold it to the exact form, which has one.
fn dense(c: &mut Criterion) {
    for (name, shape) in [("affine", Shape::Affine), ("quadratic", Shape::Quadratic)] {
        let settings = Settings { shape, ..Settings::default() };
        let reference = Reference::new(texture(0.0, 0.0));
        let target = Target::new(texture(1.3, -0.4), settings.interpolation);
        let points = Points::grid(SIZE, SIZE, settings.subset, 5, &Roi::default()).expect("a grid");
        let mut workspace = Workspace::new();
        c.benchmark_group(format!("dense, 512² pair, {name}")).bench_function("simd", |t| {
            t.iter(|| {
                let run = workspace.correlate(&reference, &target, &points, &Guess::Fft, &settings, &());
                black_box(run.expect("a correlation"))
            })
        });
    }
}

criterion_group! {
    name = kernels;
    config = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1));
    targets = planes, subsets, sweeps, search, dense
}
criterion_main!(kernels);
