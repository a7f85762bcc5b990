//! Nodes and weights of the integrals over a pixel, a spectrum and a pupil.

/// Gauss–Legendre nodes and weights on [−½, ½], weights summing to 1; exact for polynomials of degree 2n − 1.
pub fn legendre(n: usize) -> Vec<(f64, f64)> {
    let n = n.max(1);
    let mut nodes: Vec<(f64, f64)> = (0..n)
        .map(|i| {
            // Tricomi's estimate, then Newton on P_n; the estimate is good to 1e-2 already for n = 2.
            let mut x = (std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..100 {
                let (mut before, mut here) = (1.0, x);
                for k in 2..=n {
                    let k = k as f64;
                    (before, here) = (here, ((2.0 * k - 1.0) * x * here - (k - 1.0) * before) / k);
                }
                slope = n as f64 * (x * here - before) / (x * x - 1.0);
                let step = here / slope;
                x -= step;
                if step.abs() < 1e-15 {
                    break;
                }
            }
            (0.5 * x, 1.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect();
    nodes.reverse();
    nodes
}

/// Nodes and weights over the unit disk, weights summing to 1: Gauss–Legendre in r² with `rings` nodes, 4·`rings`
/// equidistant angles on each; exact for polynomials of degree 4·`rings` − 1 in x and y. With 0 rings the centre alone.
pub fn disk(rings: usize) -> Vec<([f64; 2], f64)> {
    if rings == 0 {
        return vec![([0.0; 2], 1.0)];
    }
    let spokes = 4 * rings;
    let mut nodes = Vec::with_capacity(rings * spokes);
    for (ring, (square, weight)) in legendre(rings).into_iter().enumerate() {
        let radius = (square + 0.5).sqrt();
        for spoke in 0..spokes {
            // Neighbouring rings are turned against each other by half a spoke.
            let angle = std::f64::consts::TAU * (spoke as f64 + 0.5 * (ring % 2) as f64) / spokes as f64;
            nodes.push(([radius * angle.cos(), radius * angle.sin()], weight / spokes as f64));
        }
    }
    nodes
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ∫ x^k over [−½, ½] is 2^−k/(k + 1) for even k, 0 for odd.
    #[test]
    fn legendre_is_exact_to_its_degree() {
        for n in 1..=40 {
            for k in 0..(2 * n as i32) {
                let sum: f64 = legendre(n).iter().map(|(x, w)| w * (2.0 * x).powi(k)).sum();
                let exact = if k % 2 == 0 { 1.0 / f64::from(k + 1) } else { 0.0 };
                assert!((sum - exact).abs() < 1e-13, "{n} nodes, power {k}: {sum} {exact}");
            }
        }
        // The one just beyond is wrong.
        let sum: f64 = legendre(2).iter().map(|(x, w)| w * (2.0 * x).powi(4)).sum();
        assert!((sum - 0.2).abs() > 0.01);
    }

    /// Mean over the unit disk of x^2a y^2b is (2a)! (2b)! / (4^(a+b) a! b! (a+b+1)!).
    #[test]
    fn disk_is_exact_to_its_degree() {
        let factorial = |n: i32| (1..=n).map(f64::from).product::<f64>();
        for rings in 1..=4usize {
            let degree = 4 * rings as i32 - 1;
            for a in 0..=degree {
                for b in 0..=degree - a {
                    let sum: f64 = disk(rings).iter().map(|([x, y], w)| w * x.powi(a) * y.powi(b)).sum();
                    let exact = if a % 2 == 1 || b % 2 == 1 {
                        0.0
                    } else {
                        factorial(a) * factorial(b)
                            / (2.0_f64.powi(a + b)
                                * factorial(a / 2)
                                * factorial(b / 2)
                                * factorial((a + b) / 2 + 1))
                    };
                    assert!((sum - exact).abs() < 1e-13, "{rings} rings, x^{a} y^{b}: {sum} {exact}");
                }
            }
        }
        assert_eq!(disk(0), [([0.0; 2], 1.0)]);
    }
}
