//! Who belongs to whom: best and clearly best, both ways.

use super::FeatureMatch;
use super::describe::{Feature, LENGTH};
use rayon::prelude::*;

/// The best must be nearer than this part of the distance of the second (Lowe's ratio).
const RATIO: f32 = 0.85;
/// Features nearer than this many of their scales are the same place in another orientation or
/// scale, no rivals.
const SAME: f32 = 1.5;
/// Features that are compared with the same block of the others, so that it stays in cache.
const BLOCK: usize = 64;

/// Nearest and second nearest.
#[derive(Clone, Copy)]
struct Nearest {
    best: usize,
    similarity: f32,
    second: f32,
}

const NOTHING: Nearest = Nearest { best: usize::MAX, similarity: -2.0, second: -2.0 };

fn dot(a: &[f32; LENGTH], b: &[f32; LENGTH]) -> f32 {
    let mut sums = [0.0f32; 16];
    for (x, y) in a.chunks_exact(16).zip(b.chunks_exact(16)) {
        for k in 0..16 {
            sums[k] += x[k] * y[k];
        }
    }
    sums.iter().sum()
}

fn near(a: &Feature, b: &Feature) -> bool {
    let limit = SAME * a.scale.max(b.scale);
    (a.x - b.x).powi(2) + (a.y - b.y).powi(2) < limit * limit
}

/// For every feature of `from` the nearest of `to` and the next one at another place.
fn nearest(from: &[&Feature], to: &[Feature]) -> Vec<Nearest> {
    let found: Vec<Vec<Nearest>> = from
        .par_chunks(BLOCK)
        .map(|chunk| {
            let mut found = vec![NOTHING; chunk.len()];
            for (block, others) in to.chunks(BLOCK).enumerate() {
                for (f, n) in chunk.iter().zip(&mut found) {
                    for (k, other) in others.iter().enumerate() {
                        let s = dot(&f.description, &other.description);
                        if s <= n.second {
                            continue;
                        }
                        let rival = n.best == usize::MAX || !near(&to[n.best], other);
                        if s > n.similarity {
                            if rival {
                                n.second = n.similarity;
                            }
                            (n.best, n.similarity) = (block * BLOCK + k, s);
                        } else if rival {
                            n.second = s;
                        }
                    }
                }
            }
            found
        })
        .collect();
    found.into_iter().flatten().collect()
}

/// Pairs that are each other's best, clearly; in the order of `a`, each place once.
pub(super) fn mutual(a: &[Feature], b: &[Feature]) -> Vec<FeatureMatch> {
    let all: Vec<&Feature> = a.iter().collect();
    let forward = nearest(&all, b);
    // squared distance of unit vectors: 2 − 2 cos
    let clear = |n: &Nearest| n.best < b.len() && 1.0 - n.similarity < RATIO * RATIO * (1.0 - n.second);
    let candidates: Vec<usize> = (0..a.len()).filter(|&k| clear(&forward[k])).collect();
    let back: Vec<&Feature> = candidates.iter().map(|&k| &b[forward[k].best]).collect();
    let backward = nearest(&back, a);
    let mut out: Vec<FeatureMatch> = Vec::new();
    for (&k, n) in candidates.iter().zip(&backward) {
        let Some(returned) = a.get(n.best) else {
            continue;
        };
        let (f, g) = (&a[k], &b[forward[k].best]);
        if n.best != k && !near(returned, f) {
            continue;
        }
        let m = FeatureMatch {
            reference: [f.x, f.y].map(f64::from),
            target: [g.x, g.y].map(f64::from),
            scale: f64::from(f.scale),
            rotation: f64::from(g.angle - f.angle),
            similarity: forward[k].similarity,
            group: None,
        };
        // orientations of one blob follow each other
        if out.last().is_some_and(|l| l.reference == m.reference && l.target == m.target) {
            continue;
        }
        out.push(m);
    }
    out
}
