//! scratch: experiments
use daic_correlate::*;
fn load(path: &str) -> Image {
    let bytes = std::fs::read(path).unwrap();
    if let Ok(i) = image::load_from_memory(&bytes) {
        let i = i.to_luma8();
        return Image::from_u8(i.width() as usize, i.height() as usize, i.as_raw()).unwrap();
    }
    let (w, h, g) = palette(&bytes);
    Image::from_u8(w, h, &g).unwrap()
}
fn palette(b: &[u8]) -> (usize, usize, Vec<u8>) {
    let u16_ = |o: usize| u16::from_le_bytes([b[o], b[o + 1]]) as usize;
    let u32_ = |o: usize| u32::from_le_bytes([b[o], b[o + 1], b[o + 2], b[o + 3]]) as usize;
    let ifd = u32_(4);
    let (mut w, mut h, mut strips, mut counts) = (0, 0, vec![], vec![]);
    for k in 0..u16_(ifd) {
        let e = ifd + 2 + 12 * k;
        let (tag, ty, n) = (u16_(e), u16_(e + 2), u32_(e + 4));
        let size = if ty == 3 { 2 } else { 4 };
        let base = if n * size <= 4 { e + 8 } else { u32_(e + 8) };
        let val = |i: usize| if ty == 3 { u16_(base + 2 * i) } else { u32_(base + 4 * i) };
        match tag {
            256 => w = val(0),
            257 => h = val(0),
            273 => strips = (0..n).map(val).collect(),
            279 => counts = (0..n).map(val).collect(),
            _ => {}
        }
    }
    let mut g = vec![];
    for (s, c) in strips.iter().zip(&counts) {
        g.extend_from_slice(&b[*s..s + c]);
    }
    g.truncate(w * h);
    (w, h, g)
}
fn hist(c: &Correlation) -> String {
    let mut s = String::new();
    for st in Status::ALL {
        let n = c.points.iter().filter(|p| p.status == st).count();
        if n > 0 {
            s += &format!("{st} {n} ");
        }
    }
    let mut z: Vec<f32> = c.points.iter().map(|p| p.zncc).filter(|z| z.is_finite()).collect();
    z.sort_by(f32::total_cmp);
    if !z.is_empty() {
        let q = |f: f64| z[((z.len() - 1) as f64 * f) as usize];
        s += &format!("zncc min {:.3} 1% {:.3} 50% {:.3} 99% {:.3} max {:.3}", q(0.), q(0.01), q(0.5), q(0.99), q(1.));
    }
    s
}
fn main() {
    let a: Vec<String> = std::env::args().collect();
    match a[1].as_str() {
        "views" => {
            for p in &a[2..] {
                let i = load(p);
                let t = std::time::Instant::now();
                match find_views(&i) {
                    Ok(v) => println!("{p}: {:?} {} | {:?} {} {:?}", v.minus.bounds, v.minus.mask.count(), v.plus.bounds, v.plus.mask.count(), t.elapsed()),
                    Err(e) => println!("{p}: {e}"),
                }
            }
        }
        // pair REF DEF subset step x y w h [sig]
        "pair" => {
            let (r, d) = (load(&a[2]), load(&a[3]));
            let (w, h) = (r.width().min(d.width()), r.height().min(d.height()));
            let crop = |i: &Image| Image::from_f32(w, h, (0..h).flat_map(|y| i.row(y)[..w].to_vec()).collect()).unwrap();
            let (r, d) = (crop(&r), crop(&d));
            let n = |k: usize| a[k].parse::<usize>().unwrap();
            let mut s = Settings { subset: n(4), ..Settings::default() };
            if let Some(v) = a.get(10) { s.significance = v.parse().unwrap(); }
            if let Some(v) = a.get(11) { s.shape = if v == "2" { Shape::Quadratic } else { Shape::Affine }; }
            if s.significance == 0.0 { s.min_zncc = 0.0; }
            let roi = Roi { rectangle: Some(Rectangle { x: n(6), y: n(7), width: n(8).min(w - n(6)), height: n(9).min(h - n(7)) }), mask: None };
            let p = Points::grid(w, h, s.subset, n(5), &roi).unwrap();
            let t = std::time::Instant::now();
            let (r, d) = (Reference::new(r), Target::new(d, s.interpolation));
            let c = correlate(&r, &d, &p, &Guess::Fft, &s, &()).unwrap();
            let ok: Vec<&Point> = c.points.iter().filter(|p| p.status.is_ok()).collect();
            let m = ok.len().max(1) as f64;
            let (mu, mv) = (ok.iter().map(|p| p.u).sum::<f64>() / m, ok.iter().map(|p| p.v).sum::<f64>() / m);
            println!("{} points, ok {:.3} %, mean {mu:.4} {mv:.4}, {:?}: {}", p.len(), 100. * ok.len() as f64 / p.len() as f64, t.elapsed(), hist(&c));
        }
        "cfrp" => {
            let dir = &a[2];
            let f = |k: usize| load(&format!("{dir}/oht_cfrp_{k:02}.tiff"));
            let r0 = f(0);
            let (w, h) = (r0.width(), r0.height());
            let subset: usize = a[3].parse().unwrap();
            let mask = Mask::new(w, h, (0..w * h).map(|k| {
                let (x, y) = ((k % w) as f64, (k / w) as f64);
                (42.0..348.0).contains(&x) && (20.0..1020.0).contains(&y) && (x - 193.0).hypot(y - 541.0) > 56.0
            }).collect()).unwrap();
            let s = Settings { subset, ..Settings::default() };
            let p = Points::grid(w, h, s.subset, 5, &Roi { rectangle: None, mask: Some(&mask) }).unwrap();
            let r = Reference::new(r0);
            for k in 1..12 {
                let d = Target::new(f(k), s.interpolation);
                let c = correlate(&r, &d, &p, &Guess::Fft, &s, &()).unwrap();
                println!("{k}: {} points, ok {:.3} %, {}", p.len(), 100. * c.converged() as f64 / p.len() as f64, hist(&c));
                let mut o = String::from("x,y,u,v,zncc,ok\n");
                for q in &c.points { o += &format!("{},{},{},{},{},{}\n", q.x, q.y, q.u, q.v, q.zncc, q.status.is_ok() as u8); }
                std::fs::write(format!("/tmp/cfrp_{k}.csv"), o).unwrap();
            }
        }
        "match" => {
            let i = load(&a[2]);
            let v = find_views(&i).unwrap();
            for (subset, shape) in [(33, Shape::Affine), (59, Shape::Quadratic)] {
                let s = Settings { subset, shape, ..Settings::default() };
                let roi = Roi { rectangle: Some(v.minus.bounds), mask: Some(&v.minus.mask) };
                let p = Points::grid(i.width(), i.height(), subset, 5, &roi).unwrap();
                let t = std::time::Instant::now();
                let (r, d) = (Reference::new(i.clone()), Target::new(i.clone(), s.interpolation));
                let c = correlate(&r, &d, &p, &Guess::Search { u: (600., 2400.), v: (-5., 5.) }, &s, &()).unwrap();
                let uu: Vec<f64> = c.points.iter().filter(|p| p.status.is_ok()).map(|p| p.u).collect();
                println!("{} points, ok {}, u {:.1}..{:.1} {:?}: {}", p.len(), uu.len(), uu.iter().copied().fold(f64::MAX, f64::min), uu.iter().copied().fold(0., f64::max), t.elapsed(), hist(&c));
                let bad: Vec<_> = c.points.iter().filter(|p| !p.status.is_ok()).map(|p| (p.x, p.y, p.status.name())).take(8).collect();
                println!("{bad:?}");
            }
        }
        _ => {}
    }
}
