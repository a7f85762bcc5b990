//! From light to counts: photon noise, well, read noise, gain, offset, quantisation.

use rayon::prelude::*;

use crate::config::CameraConfig;
use crate::hash::{mix, unit};

/// A sensor and its noise.
#[derive(Debug, Clone)]
pub struct Sensor {
    width: usize,
    config: CameraConfig,
    seed: u64,
}

impl Sensor {
    /// A sensor whose noise is drawn from `seed`.
    pub fn new(config: &CameraConfig, seed: u64) -> Self {
        Self { width: config.width, config: config.clone(), seed }
    }

    /// Reads frame `frame` with the expected photo-electrons `expected`, row by row.
    ///
    /// Every pixel draws from its own place in a counter-based stream of (seed, frame, row), so the
    /// result does not depend on threads.
    pub fn read(&self, frame: u64, expected: &[f32]) -> Vec<u16> {
        let mut counts = vec![0u16; expected.len()];
        counts.par_chunks_mut(self.width).zip(expected.par_chunks(self.width)).enumerate().for_each(
            |(y, (out, row))| {
                let stream = mix(mix(mix(self.seed ^ 0x7365_6e73_6f72_2121) ^ frame) ^ y as u64);
                for (x, (count, &mean)) in out.iter_mut().zip(row).enumerate() {
                    *count = self.pixel(stream ^ ((x as u64) << 1), f64::from(mean));
                }
            },
        );
        counts
    }

    #[inline]
    fn pixel(&self, stream: u64, mean: f64) -> u16 {
        let c = &self.config;
        let [photons, amplifier] = normals(stream);
        let collected = if c.photon_noise && mean > 0.0 { poisson(mean, photons, stream) } else { mean };
        let electrons = collected.min(c.full_well_electrons) + c.read_noise_electrons * amplifier;
        let largest = f64::from((1u32 << c.bits) - 1);
        (c.offset_dn + electrons / c.electrons_per_dn).round().clamp(0.0, largest) as u16
    }
}

/// Two independent standard normal numbers by Box–Muller.
#[inline]
fn normals(stream: u64) -> [f64; 2] {
    // The complement is never another pixel's stream: those of a row share their lowest bit.
    let (u, v) = (unit(mix(stream)), unit(mix(!stream)));
    let radius = (-2.0 * u.ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * v).sin_cos();
    [radius * cos, radius * sin]
}

/// Below this mean a Poisson number is drawn exactly.
const EXACT_BELOW: f64 = 16.0;

/// A Poisson number of mean `mean`.
///
/// Small means by inversion, exactly. Large ones by the Cornish–Fisher expansion of the quantile at
/// the normal `z`, rounded. Rounding adds 1/12 to the variance, which is taken off beforehand
/// (Sheppard's correction).
#[inline]
fn poisson(mean: f64, z: f64, stream: u64) -> f64 {
    if mean >= EXACT_BELOW {
        let sigma = (mean - 1.0 / 12.0).sqrt();
        let skew = (z * z - 1.0) / 6.0;
        return (mean + sigma * z + skew - z * skew / (12.0 * sigma)).round().max(0.0);
    }
    let u = unit(mix(stream ^ 0x706f_6973_736f_6e21));
    let mut term = (-mean).exp();
    let mut cumulative = term;
    let mut k = 0.0;
    while u > cumulative && k < 200.0 {
        k += 1.0;
        term *= mean / k;
        cumulative += term;
    }
    k
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(values: impl Iterator<Item = f64> + Clone) -> [f64; 3] {
        let n = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / n;
        let central = |k| values.clone().map(|v| (v - mean).powi(k)).sum::<f64>() / n;
        [mean, central(2), central(3)]
    }

    /// Mean, variance and third moment of a Poisson number are all its mean.
    #[test]
    fn poisson_numbers_have_poisson_moments() {
        let n = 400_000u64;
        for mean in [0.05, 0.7, 3.0, 15.9, 16.0, 16.5, 40.0, 300.0, 9000.0] {
            let draw = |i: u64| {
                let stream = mix(i ^ 77);
                poisson(mean, normals(stream)[0], stream)
            };
            let [m, v, t] = moments((0..n).map(draw));
            // Five standard errors: of the mean √(λ/n), of the variance √((λ + 2λ²)/n), of the third
            // moment about √((15λ³ + 40λ² + λ)/n).
            let n = n as f64;
            assert!((m - mean).abs() < 5.0 * (mean / n).sqrt(), "mean of {mean}: {m}");
            assert!(
                (v - mean).abs() < 5.0 * ((mean + 2.0 * mean * mean) / n).sqrt(),
                "variance of {mean}: {v}"
            );
            let error = ((15.0 * mean.powi(3) + 40.0 * mean * mean + mean) / n).sqrt();
            assert!((t - mean).abs() < 5.0 * error, "third moment of {mean}: {t}");
        }
    }

    /// Photon transfer: mean = offset + e/g, variance = (e + r²)/g² + 1/12.
    #[test]
    fn photon_transfer_curve() {
        let config = CameraConfig { width: 500, height: 400, ..CameraConfig::default() };
        let sensor = Sensor::new(&config, 3);
        let n = (config.width * config.height) as f64;
        for (frame, electrons) in [(0, 0.0f32), (1, 10.0), (2, 100.0), (3, 1000.0), (4, 7000.0)] {
            let counts = sensor.read(frame, &vec![electrons; config.width * config.height]);
            let [m, v, _] = moments(counts.iter().map(|&c| f64::from(c)));
            let (e, g) = (f64::from(electrons), config.electrons_per_dn);
            let variance = (e + config.read_noise_electrons.powi(2)) / (g * g) + 1.0 / 12.0;
            assert!((m - config.offset_dn - e / g).abs() < 5.0 * (variance / n).sqrt(), "mean at {e}: {m}");
            assert!(
                (v / variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(),
                "variance at {e}: {v}, not {variance}"
            );
        }
    }

    /// Light and amplifier noise are independent, in even rows as in odd ones.
    #[test]
    fn normals_are_standard_and_independent() {
        for base in [0x1234_5678, 0x1234_5679] {
            let n = 200_000u64;
            let pairs: Vec<[f64; 2]> = (0..n).map(|x| normals(base ^ (x << 1))).collect();
            let limit = 5.0 / (n as f64).sqrt();
            for k in 0..2 {
                let [m, v, t] = moments(pairs.iter().map(|p| p[k]));
                assert!(
                    m.abs() < limit && (v - 1.0).abs() < 1.5 * limit && t.abs() < 4.0 * limit,
                    "{m} {v} {t}"
                );
            }
            let product = pairs.iter().map(|p| p[0] * p[1]).sum::<f64>() / n as f64;
            let squares = pairs.iter().map(|p| p[0] * p[0] * p[1] * p[1]).sum::<f64>() / n as f64;
            assert!(product.abs() < limit && (squares - 1.0).abs() < 9.0 * limit, "{product} {squares}");
        }
    }

    #[test]
    fn well_and_converter_saturate() {
        let mut config =
            CameraConfig { width: 4, height: 1, read_noise_electrons: 0.0, ..CameraConfig::default() };
        config.photon_noise = false;
        let read = |config: &CameraConfig| Sensor::new(config, 0).read(0, &[0.0, 25.0, 9_000.0, 20_000.0]);
        assert_eq!(read(&config), [192, 202, 3792, 4095]);
        config.bits = 16;
        // The well of 10 000 electrons ends below the converter's range.
        assert_eq!(read(&config), [192, 202, 3792, 4192]);
        (config.bits, config.electrons_per_dn, config.offset_dn) = (8, 40.0, 12.0);
        assert_eq!(read(&config), [12, 13, 237, 255]);
    }

    #[test]
    fn noise_differs_between_frames_rows_and_seeds_and_repeats() {
        let config = CameraConfig { width: 64, height: 2, ..CameraConfig::default() };
        let read = |seed, frame| Sensor::new(&config, seed).read(frame, &[1000.0; 128]);
        assert_eq!(read(1, 1), read(1, 1));
        assert_ne!(read(1, 1), read(1, 2));
        assert_ne!(read(1, 1), read(2, 1));
        let one = read(1, 1);
        assert_ne!(one[..64], one[64..]);
    }
}
