//! Projections against independent arrays and against themselves.

mod common;
use common::{Case, SMALL, f32s, f64s, psf_of, random, relative, shared, symmetric};
use daic_lightfield::{Direct, Operator, OperatorSettings, Reduction, Storage};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

const CASES: [Case; 9] = [
    SMALL,
    Case { cells: [7, 5], margin: 1, ..SMALL },
    Case { pixels: [6, 6], voxels: [2, 2], radius: 2, cells: [6, 9], ..SMALL },
    Case { symmetry: Reduction::RealMirrors, pixels: [4, 7], voxels: [2, 3], cells: [3, 8], ..SMALL },
    Case { symmetry: Reduction::Real, pixels: [7, 4], voxels: [1, 2], margin: 2, radius: 2, ..SMALL },
    Case { symmetry: Reduction::ComplexMirrorY, planes: 3, margin: -1, cells: [6, 5], ..SMALL },
    Case { symmetry: Reduction::ComplexMirrorX, pixels: [5, 6], voxels: [3, 2], cells: [5, 7], ..SMALL },
    Case { symmetry: Reduction::Complex, pixels: [3, 9], voxels: [2, 1], planes: 5, margin: 1, ..SMALL },
    Case {
        symmetry: Reduction::Complex,
        pixels: [2, 3],
        voxels: [1, 1],
        planes: 1,
        radius: 0,
        cells: [1, 1],
        ..SMALL
    },
];

/// Every reduction, odd and even sizes, margins: as the plain sums, and the exact adjoint.
#[test]
fn projections_are_those_of_the_plain_sums() {
    let seed = 20;
    println!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for case in CASES {
        let psf = symmetric(&mut rng, &case);
        let direct = Direct::new(&psf, case.cells, case.margin).unwrap();
        for (storage, limit) in [(Storage::F32, 4e-7), (Storage::F16, 2e-4)] {
            let settings =
                OperatorSettings { margin: case.margin, storage, ..OperatorSettings::new(case.cells) };
            let operator = Operator::new(&psf, &settings).unwrap();
            assert_eq!(operator.memory().reduction, case.symmetry, "{case:?}");
            let g: Vec<Vec<f32>> =
                (0..3).map(|_| random(&mut rng, operator.volume_shape().iter().product())).collect();
            let f: Vec<Vec<f32>> =
                (0..3).map(|_| random(&mut rng, operator.image_shape().iter().product())).collect();
            let refs = |v: &'static str, list: &[Vec<f32>]| -> Vec<Vec<f32>> {
                let list: Vec<&[f32]> = list.iter().map(Vec::as_slice).collect();
                if v == "g" {
                    operator.project(&list).unwrap()
                } else {
                    operator.back_project(&list).unwrap()
                }
            };
            let (hg, htf) = (refs("g", &g), refs("f", &f));
            for i in 0..3 {
                let up = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
                let forward = relative(up(&hg[i]), direct.project(&g[i]).unwrap());
                let back = relative(up(&htf[i]), direct.back_project(&f[i]).unwrap());
                let (a, b) = (dot(&hg[i], &f[i]), dot(&g[i], &htf[i]));
                println!("{:?} {storage:?} {forward:.1e} {back:.1e} {:.1e}", case.symmetry, a / b - 1.0);
                assert!(forward < limit && back < limit, "{case:?} {storage:?} {forward:e} {back:e}");
                // 1.5e-7 is the worst measured
                assert!((a / b - 1.0).abs() < 2e-7, "{case:?} {storage:?} {a} {b}");
            }
        }
    }
}

/// A point spread function that is not quite symmetric is not taken for symmetric.
#[test]
fn symmetry_is_tested() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut psf = symmetric(&mut rng, &CASES[0]);
    psf.values[17] *= 1.0 + 1e-5;
    let operator = Operator::new(&psf, &OperatorSettings::new([4, 4])).unwrap();
    assert_eq!(operator.memory().reduction, Reduction::Complex);
}

#[test]
fn tiles_give_the_same() {
    let seed = 21;
    println!("seed {seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for (margin, symmetry) in
        [(0, Reduction::RealSquare), (2, Reduction::Complex), (-1, Reduction::ComplexMirrorY)]
    {
        let case = Case { cells: [11, 13], margin, symmetry, ..CASES[0] };
        let psf = symmetric(&mut rng, &case);
        let settings = OperatorSettings { margin, ..OperatorSettings::new(case.cells) };
        let whole = Operator::new(&psf, &settings).unwrap();
        let limit = whole.memory().peak() / 3;
        let tiled = Operator::new(&psf, &OperatorSettings { memory_limit: Some(limit), ..settings }).unwrap();
        let memory = tiled.memory();
        assert!(memory.tile.is_some() && memory.peak() <= limit, "{memory:?}");
        let g = random(&mut rng, whole.volume_shape().iter().product());
        let f = random(&mut rng, whole.image_shape().iter().product());
        for (a, b) in [
            (whole.project(&[&g]).unwrap(), tiled.project(&[&g]).unwrap()),
            (whole.back_project(&[&f]).unwrap(), tiled.back_project(&[&f]).unwrap()),
        ] {
            let up = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
            let error = relative(up(&b[0]), up(&a[0]));
            println!("{margin} {symmetry:?} {:?} {error:.1e}", memory.tile);
            // 1.5e-7 is the worst measured, of tiles
            assert!(error < 2e-7, "{error:e}");
        }
    }
    let psf = symmetric(&mut rng, &CASES[0]);
    let small = OperatorSettings { memory_limit: Some(1000), ..OperatorSettings::new([9, 9]) };
    assert!(Operator::new(&psf, &small).is_err());
}

#[test]
fn golden_projections() {
    let Some(dir) = shared("golden_projections", "golden/lightfield") else { return };
    for (file, radius, forward) in [
        ("H_f32.npy", 3, "forward_f64.npy"),
        ("H_plus_f32.npy", 4, "forward_plus_f64.npy"),
        ("H_minus_f32.npy", 4, "forward_minus_f64.npy"),
    ] {
        let psf = psf_of([15; 2], [3; 2], 5, radius, f32s(dir.join(file)));
        let operator = Operator::new(&psf, &OperatorSettings::new([9, 9])).unwrap();
        let volume = volume(&f64s(dir.join("volume_f64.npy")));
        let image = operator.project(&[&volume]).unwrap().remove(0);
        let truth = f64s(dir.join(forward));
        let error = relative(image.iter().map(|&v| f64::from(v)), truth.iter().copied());
        println!("{file} {:?} {error:.1e}", operator.memory().reduction);
        // 1.2e-7 is the worst measured
        assert!(error < 2e-7, "{error:e}");
        if radius == 3 {
            assert_eq!(operator.memory().reduction, Reduction::RealSquare);
            let image: Vec<f32> = truth.iter().map(|&v| v as f32).collect();
            let back = operator.back_project(&[&image]).unwrap().remove(0);
            let truth = volume_of(&f64s(dir.join("backproj_of_forward_f64.npy")));
            let error = relative(back.iter().map(|&v| f64::from(v)), truth);
            println!("back {error:.1e}");
            // 2.4e-7 measured
            assert!(error < 3e-7, "{error:e}");
        } else {
            assert_eq!(operator.memory().reduction, Reduction::ComplexMirrorY);
        }
    }
}

/// From (y, x, z) to (z, y, x).
fn volume_of(golden: &[f64]) -> Vec<f64> {
    (0..5).flat_map(|z| (0..27 * 27).map(move |p| golden[p * 5 + z])).collect()
}

fn volume(golden: &[f64]) -> Vec<f32> {
    volume_of(golden).iter().map(|&v| v as f32).collect()
}
