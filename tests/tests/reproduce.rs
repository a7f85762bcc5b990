//! Chapters 2, 3 and 4 of the thesis on small fields: what `cargo xtask reproduce` does in full.

use daic_correlate::Shape;
use daic_tests::reproduce::macroscopic::{self, CONFINED_PX, Decoding};
use daic_tests::reproduce::microscopic::{self, RIGID, THESIS, Way};
use daic_tests::reproduce::{Extent, document, lightfield};

#[test]
fn chapter_2_on_a_small_field() {
    let results = macroscopic::run(Extent::Quick, &|what| eprintln!("{what}")).expect("runs");
    let part = macroscopic::part(&results).expect("a page");
    eprintln!("{}", part.text);
    let of = |file, shape| results.ideal.case(file, shape).expect("a case");
    for file in ["cylinder", "step"] {
        let case = of(file, Shape::Quadratic);
        // the limit is the specification's; the thesis has 10 µm
        let error = case.um(Decoding::Calibrated);
        assert!(error <= 2.0, "{file}: {error} µm");
        assert!(case.points[1] * 10 >= case.points[0] * 9, "{file}: {:?}", case.points);
        // exact rays through the true set-up leave nothing of exact pairs but what the registration rounds
        assert!(case.exact(Decoding::Ray) < 1e-4, "{file}: {} µm", case.exact(Decoding::Ray));
        assert!(case.exact(Decoding::Linear) > 3.0 * error, "{file}: {}", case.exact(Decoding::Linear));
        assert!(case.correlation_px < 0.02, "{file}: {} px", case.correlation_px);
    }
    let spread = of("step", Shape::Quadratic).spread_px;
    assert!(spread <= CONFINED_PX, "the step's error reaches {spread} px");
    // under-matching: L²/24·u'' is the same all over a small cylinder and goes with the registration, but
    // not from the frame of the plate
    let [affine, quadratic] = [Shape::Affine, Shape::Quadratic].map(|s| of("cylinder", s).measured_um[4][1]);
    assert!(affine > 1.5 * quadratic, "{affine} µm against {quadratic} µm");
}

#[test]
fn chapter_3_on_a_small_field() {
    let results = microscopic::run(Extent::Quick).expect("runs");
    let part = microscopic::part(&results).expect("a page");
    eprintln!("{}", part.text);
    let (translation, tilt, ball) = THESIS;
    for (number, thesis) in [translation, tilt].into_iter().enumerate() {
        let ours = results.motion(number, RIGID, Way::Perspective).expect("a motion");
        for (error, limit) in ours.rms_um.into_iter().zip(thesis) {
            // "each at least 5× smaller"
            assert!(5.0 * error <= limit, "{}: {:?} µm", ours.name, ours.rms_um);
        }
    }
    let measured = results.ball(Shape::Quadratic).expect("the ball");
    assert!(5.0 * measured.rms_um[1] <= ball, "{:?} µm", measured.rms_um);

    let folder = tempfile::TempDir::new().expect("folder");
    document::write(folder.path(), &part).expect("written");
    let page = std::fs::read_to_string(folder.path().join("reproduction.md")).expect("page");
    assert!(page.contains("Table 1") && page.contains("Not run yet: `cargo xtask reproduce macro`"));
    for (name, _) in &part.figures {
        assert!(page.contains(&format!("figures/{name}.svg")), "{name} is drawn but not shown");
        assert!(folder.path().join(format!("figures/{name}.svg")).is_file());
    }
}

#[test]
fn chapter_4_on_a_small_field() {
    let results = lightfield::run(Extent::Quick, None, &|what| eprintln!("{what}")).expect("runs");
    let part = lightfield::part(&results).expect("a page");
    eprintln!("{}", part.text);
    let of = |degrees: f64| &results.angles.iter().find(|a| a.degrees == degrees).expect("an angle").widths;
    let (plain, with) = (of(0.0), of(30.0));
    // the grating makes the bead shorter (9.7 against 16.5 µm) at equal lateral resolution, and it is where it is
    assert!(with.fwhm_um[2] < 0.65 * plain.fwhm_um[2], "{plain:?} {with:?}");
    assert!((with.peak_um - 20.0).abs() <= 2.5, "{with:?}");
    for k in 0..2 {
        assert!((with.fwhm_um[k] - plain.fwhm_um[k]).abs() < 0.6, "{plain:?} {with:?}");
    }
    assert!(results.convergence.windows(2).all(|w| w[1].last < w[0].last), "{:?}", results.convergence);
    for (name, _) in &part.figures {
        assert!(part.text.contains(&format!("figures/{name}.svg")), "{name} is drawn but not shown");
    }
}
