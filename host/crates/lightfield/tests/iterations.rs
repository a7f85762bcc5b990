//! Reconstructions against their formulas written out, on small random point spread functions.

mod common;
use common::{Case, SMALL, model, random, relative, symmetric, up};
use daic_lightfield::{
    Direct, Frame, Method, Model, OperatorSettings, Path, Reconstruction, Reduction, Settings, Storage,
    reconstruct,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const CASE: Case = Case { planes: 3, cells: [5, 6], ..SMALL };
const ITERATIONS: usize = 3;

/// Rows of `width` numbers, each turned round.
fn mirrored<T: Copy>(v: &[T], width: usize) -> Vec<T> {
    v.chunks_exact(width).flat_map(|r| r.iter().rev().copied().collect::<Vec<_>>()).collect()
}

/// Images of all orders, with weights and background.
struct Data {
    images: Vec<Vec<f32>>,
    weights: Option<Vec<Vec<f32>>>,
    background: Option<Vec<Vec<f32>>>,
}

impl Data {
    fn frame(&self) -> Frame<'_> {
        fn all(v: &Option<Vec<Vec<f32>>>) -> Option<Vec<&[f32]>> {
            Some(v.as_ref()?.iter().map(|v| &v[..]).collect())
        }
        Frame {
            images: self.images.iter().map(|v| &v[..]).collect(),
            weights: all(&self.weights),
            background: all(&self.background),
        }
    }
}

/// The rules as they are printed in the documentation, in double precision.
fn plainly(direct: &Direct<'_>, widths: [usize; 2], data: &Data, method: Method) -> Vec<f64> {
    let [volume_width, image_width] = widths;
    let single = |v: &[f64]| v.iter().map(|&v| v as f32).collect::<Vec<_>>();
    let project = |g: &[f64], order: usize| match order {
        0 => direct.project(&single(g)).unwrap(),
        _ => mirrored(&direct.project(&single(&mirrored(g, volume_width))).unwrap(), image_width),
    };
    let back = |f: &[f64], order: usize| match order {
        0 => direct.back_project(&single(f)).unwrap(),
        _ => mirrored(&direct.back_project(&single(&mirrored(f, image_width))).unwrap(), volume_width),
    };
    let sum = |of: &dyn Fn(usize) -> Vec<f64>| -> Vec<f64> {
        let mut out = of(0);
        for order in 1..data.images.len() {
            out.iter_mut().zip(of(order)).for_each(|(a, b)| *a += b);
        }
        out
    };
    let n = data.images[0].len();
    let at = |v: &Option<Vec<Vec<f32>>>, order: usize, i: usize, other: f64| {
        v.as_ref().map_or(other, |v| f64::from(v[order][i]))
    };
    let pixels = |order: usize, value: &dyn Fn(f64, f64, f64, usize) -> f64| -> Vec<f64> {
        let image = &data.images[order];
        let of = |i: usize| {
            let (w, b) = (at(&data.weights, order, i, 1.0), at(&data.background, order, i, 0.0));
            value(f64::from(image[i]), w, b, i)
        };
        (0..n).map(of).collect()
    };
    let seen = sum(&|o| back(&pixels(o, &|_, w, _, _| w), o));
    let data_back = sum(&|o| back(&pixels(o, &|f, w, b, _| w * (f - b).max(0.0)), o));
    let mut g = vec![1.0; seen.len()];
    for _ in 0..ITERATIONS {
        let seen_now = sum(&|o| {
            let hg = project(&g, o);
            back(
                &pixels(o, &|f, w, b, i| match method {
                    Method::Rl => w * f / (hg[i] + b),
                    Method::Isra => w * hg[i],
                }),
                o,
            )
        });
        for (i, g) in g.iter_mut().enumerate() {
            *g *= match method {
                Method::Rl => seen_now[i] / seen[i],
                Method::Isra => data_back[i] / seen_now[i],
            };
        }
    }
    g
}

fn one(model: &Model, data: &Data, settings: &Settings) -> (Reconstruction, Path) {
    let (mut out, path) = reconstruct(model, &[data.frame()], settings, None, &mut |_| true).unwrap();
    (out.remove(0), path)
}

/// Both rules; whole, in tiles and by the normal matrix; one order and two; weights and background.
#[test]
fn iterations_obey_their_formulas() {
    let seed = 31;
    println!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut worst = 0.0f64;
    for (symmetry, orders) in [
        (Reduction::RealSquare, 1),
        (Reduction::RealMirrors, 2),
        (Reduction::ComplexMirrorY, 2),
        (Reduction::Complex, 1),
    ] {
        let psf = symmetric(&mut rng, &Case { symmetry, ..CASE });
        for margin in [0, 1] {
            let settings = OperatorSettings { margin, ..OperatorSettings::new(CASE.cells) };
            let whole = model(&psf, &settings, orders, margin == 1 && symmetry != Reduction::Complex);
            let limit = Some(whole.operator.memory().peak() / 2);
            let tiled = model(&psf, &OperatorSettings { memory_limit: limit, ..settings }, orders, false);
            assert!(tiled.operator.memory().tile.is_some());
            let n = whole.operator.image_shape().iter().product();
            let mut images = |from: f32| -> Vec<Vec<f32>> {
                (0..orders).map(|_| random(&mut rng, n).iter().map(|v| v + from).collect()).collect()
            };
            let plain = Data { images: images(0.5), weights: None, background: None };
            let full = Data {
                images: images(0.5),
                weights: Some(images(0.0)),
                background: Some(images(-0.5).iter().map(|v| v.iter().map(|v| v.abs()).collect()).collect()),
            };
            let direct = Direct::new(&psf, CASE.cells, margin).unwrap();
            let widths = [whole.operator.volume_shape()[2], whole.operator.image_shape()[1]];
            for (data, method) in
                [&plain, &full].into_iter().flat_map(|d| [(d, Method::Rl), (d, Method::Isra)])
            {
                let truth = plainly(&direct, widths, data, method);
                for model in [&whole, &tiled] {
                    let (found, path) = one(model, data, &Settings::new(method, ITERATIONS));
                    let normal = method == Method::Isra && model.normal.is_some() && data.weights.is_none();
                    assert_eq!(path == Path::Normal, normal, "{path:?}");
                    let error = relative(up(&found.state.volume), truth.iter().copied());
                    // 4.4e-7 is the worst of all cases
                    assert!(
                        error < 6e-7,
                        "{error:e}: {symmetry:?}, {orders} orders, {margin}, {method:?}, {path:?}"
                    );
                    worst = worst.max(error);
                }
            }
        }
    }
    println!("worst {worst:.1e}");
}

/// Bit for bit the same with one thread and with three, alone and with others; and when interrupted.
#[test]
fn results_do_not_depend_on_company() {
    let seed = 32;
    println!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for (symmetry, orders, method, storage) in [
        (Reduction::RealSquare, 1, Method::Rl, Storage::F32),
        (Reduction::RealSquare, 1, Method::Isra, Storage::F16),
        (Reduction::RealMirrors, 2, Method::Isra, Storage::F32),
        (Reduction::ComplexMirrorY, 2, Method::Rl, Storage::F16),
        (Reduction::Complex, 1, Method::Rl, Storage::F32),
    ] {
        let psf = symmetric(&mut rng, &Case { symmetry, ..CASE });
        let settings = OperatorSettings { margin: 1, storage, ..OperatorSettings::new(CASE.cells) };
        let model = model(&psf, &settings, orders, method == Method::Isra);
        let n = model.operator.image_shape().iter().product();
        let frames: Vec<Data> = (0..3)
            .map(|_| Data {
                images: (0..orders).map(|_| random(&mut rng, n)).collect(),
                weights: None,
                background: None,
            })
            .collect();
        for momentum in [false, true] {
            let settings = Settings { momentum, ..Settings::new(method, 4) };
            let list: Vec<Frame<'_>> = frames.iter().map(Data::frame).collect();
            let with = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| reconstruct(&model, &list, &settings, None, &mut |_| true).unwrap())
            };
            let (all, path) = with(1);
            assert_eq!(path == Path::Normal, method == Method::Isra, "{path:?}");
            for (a, b) in all.iter().zip(&with(3).0) {
                assert_eq!((&a.state, &a.changes), (&b.state, &b.changes), "{symmetry:?} {momentum}");
            }
            for (together, frame) in all.iter().zip(&frames) {
                let alone = one(&model, frame, &settings).0;
                assert_eq!(alone.state, together.state, "{symmetry:?} {momentum}: batch");
                assert_eq!(alone.changes, together.changes, "{symmetry:?} {momentum}: batch");
            }
            for stop in 1..4 {
                let mut left = stop;
                let part = reconstruct(&model, &list, &settings, None, &mut |_| {
                    left -= 1;
                    left > 0
                });
                let states: Vec<_> = part.unwrap().0.into_iter().map(|r| r.state).collect();
                let (rest, _) = reconstruct(&model, &list, &settings, Some(&states), &mut |_| true).unwrap();
                for (a, b) in rest.iter().zip(&all) {
                    assert_eq!(a.state, b.state, "{symmetry:?} {momentum}: stopped after {stop}");
                }
            }
        }
    }
}
