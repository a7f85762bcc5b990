//! Numbers over a field.

/// Mean, scatter and size of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Standard deviation about the mean.
    pub std: f64,
    /// Root mean square about zero.
    pub rms: f64,
    /// Number of finite values.
    pub count: usize,
}

/// Mean and scatter of the finite values; NaN where there is none.
pub fn spread(values: impl IntoIterator<Item = f64>) -> Spread {
    let values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
    let rms = (values.iter().map(|v| v * v).sum::<f64>() / n).sqrt();
    Spread { mean, std, rms, count: values.len() }
}

/// h = offset + x·slope_x + y·slope_y.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// h at (0, 0).
    pub offset: f64,
    /// dh/dx.
    pub slope_x: f64,
    /// dh/dy.
    pub slope_y: f64,
}

/// Least-squares plane through (x, y, h); `None` for fewer than three points or points on a line.
pub fn plane_of(points: &[[f64; 3]]) -> Option<Plane> {
    let n = points.len() as f64;
    let mean = |i: usize| points.iter().map(|p| p[i]).sum::<f64>() / n;
    let (mx, my, mh) = (mean(0), mean(1), mean(2));
    let (mut xx, mut xy, mut yy, mut xh, mut yh) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for &[x, y, h] in points {
        let (x, y, h) = (x - mx, y - my, h - mh);
        xx += x * x;
        xy += x * y;
        yy += y * y;
        xh += x * h;
        yh += y * h;
    }
    let determinant = xx * yy - xy * xy;
    if points.len() < 3 || determinant.is_nan() || determinant <= 1e-12 * (xx * yy).max(f64::MIN_POSITIVE) {
        return None;
    }
    let slope_x = (xh * yy - yh * xy) / determinant;
    let slope_y = (yh * xx - xh * xy) / determinant;
    Some(Plane { offset: mh - slope_x * mx - slope_y * my, slope_x, slope_y })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_comes_back() {
        let points: Vec<_> = (0..30)
            .map(|i| (f64::from(i % 6), f64::from(i / 6)))
            .map(|(x, y)| [x, y, 0.5 - 0.25 * x + 2.0 * y])
            .collect();
        let plane = plane_of(&points).expect("points span a plane");
        assert!((plane.offset - 0.5).abs() < 1e-13);
        assert!((plane.slope_x + 0.25).abs() < 1e-13);
        assert!((plane.slope_y - 2.0).abs() < 1e-13);
    }

    #[test]
    fn a_line_is_no_plane() {
        let points: Vec<_> = (0..9).map(|i| [f64::from(i), 2.0 * f64::from(i), 1.0]).collect();
        assert_eq!(plane_of(&points), None);
        assert_eq!(plane_of(&[]), None);
    }

    #[test]
    fn missing_values_do_not_count() {
        let s = spread([1.0, f64::NAN, 3.0]);
        assert_eq!((s.mean, s.std, s.count), (2.0, 1.0, 2));
        assert!((s.rms - 5.0f64.sqrt()).abs() < 1e-15);
    }
}
