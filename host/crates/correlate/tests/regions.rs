//! Regions against the same areas tested pixel by pixel with other formulas.

use daic_correlate::*;

const W: usize = 90;
const H: usize = 70;

fn mask(region: Vec<Region>) -> Mask {
    Regions { region }.mask(W, H).unwrap()
}

fn same(found: &Mask, expected: impl Fn(f64, f64) -> bool) {
    for y in 0..H {
        for x in 0..W {
            assert_eq!(found.contains(x, y), expected(x as f64, y as f64), "({x}, {y})");
        }
    }
}

fn polygon(points: &[[f64; 2]], holes: Vec<Vec<[f64; 2]>>, effect: Effect) -> Region {
    Region::Polygon { points: points.to_vec(), holes, effect }
}

/// Winding number of an outline about a point that is not on it.
fn winding(outline: &[[f64; 2]], x: f64, y: f64) -> i32 {
    let n = outline.len();
    let turn: f64 = (0..n)
        .map(|k| {
            let (a, b) = (outline[k], outline[(k + 1) % n]);
            let (ax, ay, bx, by) = (a[0] - x, a[1] - y, b[0] - x, b[1] - y);
            (ax * by - ay * bx).atan2(ax * bx + ay * by)
        })
        .sum();
    (turn / std::f64::consts::TAU).round() as i32
}

#[test]
fn simple_forms_hold_the_pixels_whose_centres_are_inside() {
    let effect = Effect::Add;
    let r = Region::Rectangle { x: 10.0, y: -3.5, width: 20.5, height: 30.0, effect };
    same(&mask(vec![r]), |x, y| (10.0..30.5).contains(&x) && y < 26.5);
    // centres on the outline included: (40 ± 13, 35), (40 ± 5, 35 ± 12)
    let c = Region::Circle { centre: [40.0, 35.0], radius: 13.0, effect };
    let m = mask(vec![c]);
    same(&m, |x, y| (x - 40.0).powi(2) + (y - 35.0).powi(2) <= 169.0);
    assert!(m.contains(53, 35) && m.contains(45, 47) && !m.contains(54, 35));
    let e = Region::Ellipse { centre: [44.3, 33.1], semi_axes: [30.0, 11.0], angle: 30.0, effect };
    let (s, c) = 30f64.to_radians().sin_cos();
    same(&mask(vec![e]), |x, y| {
        let (x, y) = (x - 44.3, y - 33.1);
        ((c * x + s * y) / 30.0).powi(2) + ((c * y - s * x) / 11.0).powi(2) <= 1.0
    });
}

#[test]
fn polygons_with_holes_agree_with_winding_numbers() {
    let outline = [[5.3, 8.1], [60.7, 3.2], [84.1, 40.9], [50.2, 30.3], [33.3, 66.6], [12.1, 50.2]];
    let hole = vec![[30.1, 15.2], [45.3, 14.1], [40.2, 25.7]];
    let m = mask(vec![polygon(&outline, vec![hole.clone()], Effect::Add)]);
    same(&m, |x, y| winding(&outline, x, y) != 0 && winding(&hole, x, y) == 0);
    // a hole beyond the outline adds nothing
    let far = vec![vec![[70.1, 50.2], [80.3, 50.1], [75.2, 60.7]]];
    let m = mask(vec![polygon(&outline, far, Effect::Add)]);
    same(&m, |x, y| winding(&outline, x, y) != 0);
    // two triangles that share an edge through pixel centres share no pixel and leave none out
    let (a, b) = ([[10.0, 10.0], [50.0, 10.0], [10.0, 50.0]], [[50.0, 10.0], [50.0, 50.0], [10.0, 50.0]]);
    let (m, n) = (mask(vec![polygon(&a, vec![], Effect::Add)]), mask(vec![polygon(&b, vec![], Effect::Add)]));
    assert!(m.pixels().iter().zip(n.pixels()).all(|(p, q)| !(*p && *q)));
    assert_eq!(m.count() + n.count(), 1600);
}

#[test]
fn regions_are_added_and_taken_away_in_order() {
    let disc = |x, y, radius, effect| Region::Circle { centre: [x, y], radius, effect };
    let m = mask(vec![
        disc(30.0, 30.0, 15.0, Effect::Add),
        disc(60.0, 30.0, 15.0, Effect::Add),
        disc(45.0, 30.0, 8.0, Effect::Remove),
        disc(45.0, 30.0, 2.0, Effect::Add),
    ]);
    let r = |x: f64, y: f64, cx: f64| (x - cx).powi(2) + (y - 30.0).powi(2);
    same(&m, |x, y| {
        r(x, y, 45.0) <= 4.0 || (r(x, y, 45.0) > 64.0 && (r(x, y, 30.0) <= 225.0 || r(x, y, 60.0) <= 225.0))
    });
    // a list that begins by taking away begins with everything
    same(&mask(vec![disc(30.0, 30.0, 15.0, Effect::Remove)]), |x, y| r(x, y, 30.0) > 225.0);
}

#[test]
fn unusable_regions_are_refused_by_name() {
    let effect = Effect::Add;
    let try_one = |r: Region| Regions { region: vec![r] }.mask(W, H).unwrap_err();
    let line = [[1.0, 1.0], [20.0, 20.0], [40.0, 40.0]];
    let triangle = [[1.0, 1.0], [40.0, 3.0], [20.0, 40.0]];
    assert_eq!(try_one(polygon(&line, vec![], effect)), RegionError::Area { index: 0, field: "points" });
    assert_eq!(
        try_one(polygon(&line[..2], vec![], effect)),
        RegionError::Corners { index: 0, field: "points", found: 2 }
    );
    assert_eq!(
        try_one(polygon(&triangle, vec![line.to_vec()], effect)),
        RegionError::Area { index: 0, field: "holes" }
    );
    let bad = [[1.0, f64::NAN], [40.0, 3.0], [20.0, 40.0]];
    assert!(matches!(try_one(polygon(&bad, vec![], effect)), RegionError::Number { field: "points", .. }));
    let far = Region::Circle { centre: [-50.0, 20.0], radius: 5.0, effect };
    assert_eq!(try_one(far), RegionError::NoPixel { index: 0, width: W, height: H });
    let speck = Region::Circle { centre: [20.5, 20.5], radius: 0.1, effect };
    assert!(matches!(try_one(speck), RegionError::NoPixel { .. }));
    let flat = Region::Rectangle { x: 3.0, y: 3.0, width: 0.0, height: 5.0, effect };
    assert_eq!(try_one(flat), RegionError::Length { index: 0, field: "width", value: 0.0 });
    let huge = Region::Ellipse { centre: [1e9, 0.0], semi_axes: [1.0, 1.0], angle: 0.0, effect };
    assert!(matches!(try_one(huge), RegionError::Number { field: "centre", .. }));
    assert_eq!(Regions::default().mask(W, H), Err(RegionError::None));
    let all = Region::Rectangle { x: -1.0, y: -1.0, width: 200.0, height: 200.0, effect: Effect::Remove };
    assert_eq!(try_one(all), RegionError::Nothing);
    let some = Region::Circle { centre: [0.0, 0.0], radius: 5.0, effect };
    assert_eq!(Regions { region: vec![some] }.mask(0, 5), Err(RegionError::Size { width: 0, height: 5 }));
}
