//! Smoothing, local mid-levels and reduction of images.

use super::GreyView;

/// A plane of grey values in which pixels that are not used have been filled.
#[derive(Clone, Debug)]
pub(crate) struct Plane {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) data: Vec<f32>,
    /// Whether the pixel was used; none if all were.
    pub(crate) used: Option<Vec<bool>>,
}

impl Plane {
    /// A copy in which pixels that are not used have the mean of the others; none if there are no
    /// others.
    pub(crate) fn of(view: &GreyView<'_>) -> Option<Self> {
        let n = view.data.len();
        let (mut sum, mut count) = (0.0, 0_usize);
        for v in (0..n).filter_map(|i| view.at(i)) {
            sum += v;
            count += 1;
        }
        if count == 0 {
            return None;
        }
        let mean = (sum / count as f64) as f32;
        let data = (0..n).map(|i| view.at(i).map_or(mean, |v| v as f32)).collect();
        let used = (count < n).then(|| (0..n).map(|i| view.at(i).is_some()).collect());
        Some(Self { width: view.width, height: view.height, data, used })
    }

    /// Convolution with a Gaussian; at the borders the outermost pixels are repeated.
    pub(crate) fn smoothed(&self, sigma: f64) -> Self {
        let radius = (3.0 * sigma).ceil() as i64;
        let raw: Vec<f64> = (-radius..=radius).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
        let sum: f64 = raw.iter().sum();
        let kernel: Vec<f32> = raw.iter().map(|w| (w / sum) as f32).collect();
        let (w, h) = (self.width, self.height);
        let mut rows = vec![0.0_f32; w * h];
        let mut padded = vec![0.0_f32; w + 2 * radius as usize];
        for y in 0..h {
            let line = &self.data[y * w..(y + 1) * w];
            for (k, p) in padded.iter_mut().enumerate() {
                *p = line[(k as i64 - radius).clamp(0, w as i64 - 1) as usize];
            }
            for (x, out) in rows[y * w..(y + 1) * w].iter_mut().enumerate() {
                *out = kernel.iter().zip(&padded[x..]).map(|(k, v)| k * v).sum();
            }
        }
        let mut data = vec![0.0_f32; w * h];
        for y in 0..h {
            let out = &mut data[y * w..(y + 1) * w];
            for (k, weight) in kernel.iter().enumerate() {
                let from = (y as i64 + k as i64 - radius).clamp(0, h as i64 - 1) as usize;
                for (o, v) in out.iter_mut().zip(&rows[from * w..(from + 1) * w]) {
                    *o += weight * v;
                }
            }
        }
        Self { data, used: self.used.clone(), ..*self }
    }

    /// Means over 2 × 2 pixels: pixel (i, j) has its centre at (2i + ½, 2j + ½) of this plane.
    pub(crate) fn halved(&self) -> Self {
        let (w, h) = (self.width / 2, self.height / 2);
        let mut data = Vec::with_capacity(w * h);
        let mut used = self.used.as_ref().map(|_| Vec::with_capacity(w * h));
        for y in 0..h {
            for x in 0..w {
                let i = 2 * y * self.width + 2 * x;
                let four = [i, i + 1, i + self.width, i + self.width + 1];
                data.push(0.25 * four.iter().map(|&k| self.data[k]).sum::<f32>());
                if let (Some(all), Some(out)) = (&self.used, &mut used) {
                    out.push(four.iter().all(|&k| all[k]));
                }
            }
        }
        Self { width: w, height: h, data, used }
    }

    pub(crate) fn is_used(&self, index: usize) -> bool {
        self.used.as_ref().is_none_or(|u| u[index])
    }

    /// For every pixel the level halfway between the two populations of a two-valued pattern, from
    /// mean, variance and third moment over a window of (2·half + 1)² pixels, and the standard
    /// deviation there. A pattern that takes values a and b on shares f and 1 − f of the window has
    /// (a + b)/2 = mean + m₃/(2 m₂), whatever f is; noise adds to m₂ only and moves the level
    /// towards the mean.
    pub(crate) fn mid_levels(&self, half: usize) -> (Vec<f32>, Vec<f32>) {
        let (w, h) = (self.width, self.height);
        let level = f64::from(self.data.iter().copied().sum::<f32>()) / self.data.len() as f64;
        // Sums over columns of the window's rows; they slide down the image.
        let mut columns = vec![[0.0_f64; 4]; w];
        let add = |columns: &mut [[f64; 4]], y: usize, sign: f64| {
            for (x, c) in columns.iter_mut().enumerate() {
                let i = y * w + x;
                if self.is_used(i) {
                    let v = f64::from(self.data[i]) - level;
                    for (sum, term) in c.iter_mut().zip([1.0, v, v * v, v * v * v]) {
                        *sum += sign * term;
                    }
                }
            }
        };
        (0..half.min(h)).for_each(|y| add(&mut columns, y, 1.0));
        let (mut mid, mut std) = (vec![0.0_f32; w * h], vec![0.0_f32; w * h]);
        for y in 0..h {
            if y + half < h {
                add(&mut columns, y + half, 1.0);
            }
            if y > half {
                add(&mut columns, y - half - 1, -1.0);
            }
            let mut sums = [0.0_f64; 4];
            let slide = |sums: &mut [f64; 4], x: usize, sign: f64| {
                sums.iter_mut().zip(&columns[x]).for_each(|(s, c)| *s += sign * c);
            };
            (0..half.min(w)).for_each(|x| slide(&mut sums, x, 1.0));
            for x in 0..w {
                if x + half < w {
                    slide(&mut sums, x + half, 1.0);
                }
                if x > half {
                    slide(&mut sums, x - half - 1, -1.0);
                }
                let n = sums[0].max(1.0);
                let [m, s, c] = [sums[1] / n, sums[2] / n, sums[3] / n];
                let variance = (s - m * m).max(0.0);
                let third = c - 3.0 * m * s + 2.0 * m * m * m;
                let shift = if variance > 0.0 { 0.5 * third / variance } else { 0.0 };
                // Outliers can throw the third moment far out; a two-valued pattern cannot.
                let limit = 2.5 * variance.sqrt();
                mid[y * w + x] = (level + m + shift.clamp(-limit, limit)) as f32;
                std[y * w + x] = variance.sqrt() as f32;
            }
        }
        (mid, std)
    }

    /// Standard deviation of the noise from the median of a difference that constants, slopes and
    /// straight edges along the axes do not pass (Immerkær 1996).
    pub(crate) fn noise(&self) -> f64 {
        let w = self.width;
        let mut values: Vec<f32> = Vec::with_capacity(self.data.len());
        for y in 1..self.height - 1 {
            for x in 1..w - 1 {
                let k = y * w + x;
                let d = |i: usize| self.data[i];
                let corners = d(k - w - 1) + d(k - w + 1) + d(k + w - 1) + d(k + w + 1);
                let sides = d(k - 1) + d(k + 1) + d(k - w) + d(k + w);
                values.push((corners - 2.0 * sides + 4.0 * d(k)).abs());
            }
        }
        let half = values.len() / 2;
        // The weights' squares sum to 36.
        1.4826 / 6.0 * f64::from(*values.select_nth_unstable_by(half, f32::total_cmp).1)
    }

    /// Grey value between pixels, bilinear; `None` outside.
    pub(crate) fn sample(&self, x: f64, y: f64) -> Option<f64> {
        if !(x >= 0.0 && y >= 0.0 && x <= (self.width - 1) as f64 && y <= (self.height - 1) as f64) {
            return None;
        }
        let (i, j) = ((x as usize).min(self.width - 2), (y as usize).min(self.height - 2));
        let (fx, fy) = (x - i as f64, y - j as f64);
        let at = |i: usize, j: usize| f64::from(self.data[j * self.width + i]);
        let top = at(i, j) * (1.0 - fx) + at(i + 1, j) * fx;
        let low = at(i, j + 1) * (1.0 - fx) + at(i + 1, j + 1) * fx;
        Some(top * (1.0 - fy) + low * fy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mid_level_of_a_two_valued_pattern_is_halfway() {
        // 20 % of the pixels at 40, the others at 200; the window holds whole periods.
        let n = 45;
        let data: Vec<f32> =
            (0..n * n).map(|k| if (k % n + k / n) % 5 == 0 { 40.0 } else { 200.0 }).collect();
        let plane = Plane { width: n, height: n, data, used: None };
        let (mid, std) = plane.mid_levels(7);
        let middle = n / 2 * n + n / 2;
        assert!((mid[middle] - 120.0).abs() < 1e-3, "{}", mid[middle]);
        // 160·√(0.2·0.8)
        assert!((std[middle] - 64.0).abs() < 1e-3, "{}", std[middle]);
    }

    #[test]
    fn smoothing_keeps_a_ramp_and_halving_averages() {
        let (w, h) = (40, 24);
        let data = (0..w * h).map(|k| (k % w) as f32 + 2.0 * (k / w) as f32).collect();
        let plane = Plane { width: w, height: h, data, used: None };
        let s = plane.smoothed(1.5);
        assert!((s.data[12 * w + 20] - 44.0).abs() < 1e-4);
        let half = plane.halved();
        assert_eq!((half.width, half.height), (20, 12));
        assert_eq!(half.data[3 * 20 + 5], 10.5 + 2.0 * 6.5);
        assert_eq!(half.sample(5.5, 3.0), Some(11.5 + 2.0 * 6.5));
    }
}
