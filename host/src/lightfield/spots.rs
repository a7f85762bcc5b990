//! Bright spots of a volume: beads.

/// A spot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Centroid (z, y, x) in voxels.
    pub place: [f64; 3],
    /// Its largest value.
    pub peak: f32,
}

/// The spots of a volume, brightest first: maxima above `share` of the largest value, none within `apart` voxels (y, x)
/// of a brighter one in any plane. A spot ends where the volume falls below a tenth of its maximum: much of a bead
/// that is smaller than a voxel lies in the neighbours.
pub fn find(values: &[f32], [nz, ny, nx]: [usize; 3], share: f32, apart: f64) -> Vec<Spot> {
    let mut left = values.to_vec();
    let mut spots: Vec<Spot> = Vec::new();
    let largest = values.iter().copied().fold(0.0f32, f32::max);
    loop {
        let Some(top) = (0..left.len()).max_by(|&a, &b| left[a].total_cmp(&left[b])) else { return spots };
        let peak = left[top];
        if peak <= share * largest || peak <= 0.0 {
            return spots;
        }
        let end = 0.1 * peak;
        let (mut open, mut seen) = (vec![top], vec![false; left.len()]);
        seen[top] = true;
        let (mut sum, mut moment) = (0.0, [0.0; 3]);
        while let Some(i) = open.pop() {
            let place = [i / (ny * nx), i / nx % ny, i % nx];
            let weight = f64::from(values[i]);
            sum += weight;
            for k in 0..3 {
                moment[k] += weight * place[k] as f64;
            }
            for (k, (n, stride)) in [(nz, ny * nx), (ny, nx), (nx, 1)].into_iter().enumerate() {
                let neighbours = [(place[k] > 0).then(|| i - stride), (place[k] + 1 < n).then(|| i + stride)];
                for j in neighbours.into_iter().flatten() {
                    if !seen[j] && values[j] > end {
                        seen[j] = true;
                        open.push(j);
                    }
                }
            }
        }
        let place = moment.map(|m| m / sum);
        spots.push(Spot { place, peak });
        for (i, v) in left.iter_mut().enumerate() {
            let d = [(i / nx % ny) as f64 - place[1], (i % nx) as f64 - place[2]];
            if seen[i] || d[0].hypot(d[1]) < apart {
                *v = 0.0;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_bells_are_found_where_they_are() {
        let shape = [9, 20, 22];
        let bell =
            |p: [f64; 3], c: [f64; 3]| (-0.5 * (0..3).map(|k| (p[k] - c[k]).powi(2)).sum::<f64>()).exp();
        let centres = [[4.25, 5.5, 6.0], [3.0, 14.0, 15.75]];
        let values: Vec<f32> = (0..shape.iter().product())
            .map(|i: usize| {
                let p = [(i / 440) as f64, (i / 22 % 20) as f64, (i % 22) as f64];
                (bell(p, centres[0]) + 0.5 * bell(p, centres[1])) as f32
            })
            .collect();
        let spots = find(&values, shape, 0.3, 5.0);
        assert_eq!(spots.len(), 2);
        for (spot, centre) in spots.iter().zip(centres) {
            for k in 0..3 {
                // a bell of σ = 1 voxel cut at a tenth by the grid
                assert!((spot.place[k] - centre[k]).abs() < 0.05, "{spot:?} {centre:?}");
            }
        }
        assert!(find(&[0.0; 8], [2, 2, 2], 0.1, 1.0).is_empty());
    }
}
