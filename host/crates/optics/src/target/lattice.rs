//! Indices on a lattice: points that continue each other along two directions.

use std::collections::{BTreeMap, VecDeque};

use super::Index;

/// A point that may belong to the lattice.
#[derive(Clone, Debug)]
pub(crate) struct Node {
    pub(crate) at: [f64; 2],
    /// Direction into which a checkerboard's corner is bright; it turns by 90° to each neighbour.
    pub(crate) bright: Option<[f64; 2]>,
    /// Area in pixels, 1 where there is none.
    pub(crate) area: f64,
}

/// A node and the way to its neighbours.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seed {
    pub(crate) node: usize,
    pub(crate) a: [f64; 2],
    pub(crate) b: [f64; 2],
}

/// The four neighbours: axis and sign.
const STEPS: [(usize, i32); 4] = [(0, 1), (0, -1), (1, 1), (1, -1)];
/// How far from its expected place a neighbour may be, relative to the shorter lattice vector.
const REACH: f64 = 0.3;
/// How far from the mean of two opposite neighbours a point may be, in the same unit.
const SMOOTH: f64 = 0.12;

/// Points sorted into square cells.
pub(crate) struct Cells {
    cell: f64,
    columns: i64,
    rows: i64,
    members: Vec<Vec<usize>>,
}

impl Cells {
    pub(crate) fn new(nodes: &[Node], width: usize, height: usize) -> Self {
        let cell = ((width * height) as f64 / nodes.len().max(1) as f64).sqrt().max(4.0);
        let count = |n: usize| (n as f64 / cell) as i64 + 1;
        let (columns, rows) = (count(width), count(height));
        let mut members = vec![Vec::new(); (columns * rows) as usize];
        for (k, node) in nodes.iter().enumerate() {
            let [x, y] = node.at.map(|v| (v / cell) as i64);
            members[(y.clamp(0, rows - 1) * columns + x.clamp(0, columns - 1)) as usize].push(k);
        }
        Self { cell, columns, rows, members }
    }

    /// Nodes not farther than `radius` from `p`, in no particular but always the same order.
    pub(crate) fn within(&self, nodes: &[Node], p: [f64; 2], radius: f64) -> Vec<usize> {
        let range = |c: f64, n: i64| {
            let low = ((c - radius) / self.cell).floor().max(0.0) as i64;
            let high = ((c + radius) / self.cell).floor().min((n - 1) as f64) as i64;
            low..=high
        };
        let mut found = Vec::new();
        for y in range(p[1], self.rows) {
            for x in range(p[0], self.columns) {
                let cell = &self.members[(y * self.columns + x) as usize];
                found.extend(cell.iter().copied().filter(|&k| distance(nodes[k].at, p) <= radius));
            }
        }
        found
    }

    /// At least `count` nodes about `p` if there are as many within `limit`.
    pub(crate) fn about(&self, nodes: &[Node], p: [f64; 2], count: usize, limit: f64) -> Vec<usize> {
        let mut radius = self.cell;
        loop {
            let found = self.within(nodes, p, radius.min(limit));
            if found.len() >= count || radius >= limit {
                return found;
            }
            radius *= 1.6;
        }
    }
}

pub(crate) fn difference(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

pub(crate) fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

pub(crate) fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn length(a: [f64; 2]) -> f64 {
    a[0].hypot(a[1])
}

/// Nodes by their lattice indices.
pub(crate) type Lattice = BTreeMap<Index, usize>;

/// The lattice with most nodes that grows from one of the seeds; of equal ones the first.
pub(crate) fn largest(nodes: &[Node], cells: &Cells, seeds: &[Seed]) -> Lattice {
    let mut tried = vec![false; nodes.len()];
    let mut best = Lattice::new();
    for seed in seeds {
        if tried[seed.node] {
            continue;
        }
        let grown = consistent(nodes, grow(nodes, cells, seed));
        grown.values().for_each(|&k| tried[k] = true);
        tried[seed.node] = true;
        if grown.len() > best.len() {
            best = grown;
        }
    }
    upright(nodes, &best)
}

fn compatible(a: &Node, b: &Node) -> bool {
    let turned = match (a.bright, b.bright) {
        (Some(u), Some(v)) => dot(u, v).abs() < 0.6,
        _ => true,
    };
    turned && (0.2..5.0).contains(&(a.area / b.area))
}

fn neighbour(index: Index, axis: usize, sign: i32) -> Index {
    let mut next = index;
    next[axis] += sign;
    next
}

/// Adds neighbour after neighbour. Where the point behind is known the step is continued, else the
/// step of the point it comes from is taken.
fn grow(nodes: &[Node], cells: &Cells, seed: &Seed) -> Lattice {
    let mut lattice = Lattice::from([([0, 0], seed.node)]);
    let mut taken = BTreeMap::from([(seed.node, [seed.a, seed.b])]);
    let mut queue = VecDeque::from([[0, 0]]);
    while let Some(index) = queue.pop_front() {
        let node = lattice[&index];
        let from = &nodes[node];
        for (axis, sign) in STEPS {
            let next = neighbour(index, axis, sign);
            if lattice.contains_key(&next) {
                continue;
            }
            let vectors = taken[&node];
            let behind = lattice.get(&neighbour(index, axis, -sign));
            let step = match behind {
                Some(&k) => difference(from.at, nodes[k].at),
                None => vectors[axis].map(|v| v * f64::from(sign)),
            };
            let expected = [from.at[0] + step[0], from.at[1] + step[1]];
            let reach = REACH * length(vectors[0]).min(length(vectors[1]));
            let nearest = cells
                .within(nodes, expected, reach)
                .into_iter()
                .filter(|k| !taken.contains_key(k) && compatible(from, &nodes[*k]))
                .min_by(|a, b| distance(nodes[*a].at, expected).total_cmp(&distance(nodes[*b].at, expected)));
            if let Some(found) = nearest {
                let mut own = vectors;
                own[axis] = difference(nodes[found].at, from.at).map(|v| v * f64::from(sign));
                taken.insert(found, own);
                lattice.insert(next, found);
                queue.push_back(next);
            }
        }
    }
    lattice
}

/// Drops points that are not where their neighbours have them, and what then hangs on nothing.
fn consistent(nodes: &[Node], mut lattice: Lattice) -> Lattice {
    for _ in 0..4 {
        let at = |index: Index| lattice.get(&index).map(|&k| nodes[k].at);
        let bad: Vec<Index> = lattice
            .iter()
            .filter(|&(&index, &k)| {
                let p = nodes[k].at;
                let mut off = false;
                for axis in 0..2 {
                    let ahead = at(neighbour(index, axis, 1));
                    let behind = at(neighbour(index, axis, -1));
                    let (expected, step, limit) = match (ahead, behind) {
                        (Some(a), Some(b)) => {
                            ([0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])], 0.5 * distance(a, b), SMOOTH)
                        }
                        (Some(a), None) | (None, Some(a)) => {
                            let sign = if ahead.is_some() { 2 } else { -2 };
                            let Some(b) = at(neighbour(index, axis, sign)) else { continue };
                            ([2.0 * a[0] - b[0], 2.0 * a[1] - b[1]], distance(a, b), 2.0 * SMOOTH)
                        }
                        (None, None) => continue,
                    };
                    off |= distance(p, expected) > limit * step;
                }
                off
            })
            .map(|(&index, _)| index)
            .collect();
        if bad.is_empty() {
            break;
        }
        for index in bad {
            lattice.remove(&index);
        }
        lattice = connected(&lattice);
    }
    lattice
}

/// The largest part whose points hang together through neighbours.
pub(crate) fn connected(lattice: &Lattice) -> Lattice {
    let mut rest = lattice.clone();
    let mut best = Lattice::new();
    while let Some((&first, _)) = rest.first_key_value() {
        let mut part = Lattice::new();
        let mut stack = vec![first];
        while let Some(index) = stack.pop() {
            if let Some(node) = rest.remove(&index) {
                part.insert(index, node);
                stack.extend(STEPS.map(|(axis, sign)| neighbour(index, axis, sign)));
            }
        }
        if part.len() > best.len() {
            best = part;
        }
    }
    best
}

/// Indices such that the first grows to the right, the second downwards (as near as the lattice
/// goes) and the smallest are 0.
fn upright(nodes: &[Node], lattice: &Lattice) -> Lattice {
    let mut mean = [[0.0; 2]; 2];
    for (&index, &k) in lattice {
        for (axis, sum) in mean.iter_mut().enumerate() {
            if let Some(&n) = lattice.get(&neighbour(index, axis, 1)) {
                let d = difference(nodes[n].at, nodes[k].at);
                *sum = [sum[0] + d[0], sum[1] + d[1]];
            }
        }
    }
    let unit = mean.map(|v| v.map(|c| c / length(v).max(1e-300)));
    let first = usize::from(unit[1][0].abs() > unit[0][0].abs());
    let sign = if unit[first][0] < 0.0 { -1 } else { 1 };
    let a = unit[first].map(|c| c * f64::from(sign));
    let b = unit[1 - first];
    let other = if a[0] * b[1] - a[1] * b[0] < 0.0 { -1 } else { 1 };
    let turned = |index: &Index| [sign * index[first], other * index[1 - first]];
    let least = |axis: usize| lattice.keys().map(|i| turned(i)[axis]).min().unwrap_or(0);
    let (i0, j0) = (least(0), least(1));
    lattice
        .iter()
        .map(|(index, &k)| {
            let [i, j] = turned(index);
            ([i - i0, j - j0], k)
        })
        .collect()
}
