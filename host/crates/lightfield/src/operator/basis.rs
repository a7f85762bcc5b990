//! Even and odd parts of the pixels of a cell, and of its voxels.

/// Channels of a cell: two axes of sub-positions, and what lies innermost (planes).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cell {
    /// Sub-positions (y, x).
    pub(crate) n: [usize; 2],
    /// Innermost extent.
    pub(crate) inner: usize,
}

impl Cell {
    pub(crate) fn channels(&self) -> usize {
        self.n[0] * self.n[1] * self.inner
    }

    pub(crate) fn at(&self, y: usize, x: usize, i: usize) -> usize {
        (y * self.n[1] + x) * self.inner + i
    }

    /// (y, x, i) of a channel.
    pub(crate) fn split(&self, c: usize) -> (usize, usize, usize) {
        (c / self.inner / self.n[1], c / self.inner % self.n[1], c % self.inner)
    }

    /// +1 for the even channels of an axis in the parity basis, −1 for the odd ones.
    pub(crate) fn parity(&self, axis: usize, u: usize) -> f32 {
        if u < self.n[axis] - self.n[axis] / 2 { 1.0 } else { -1.0 }
    }

    /// Square of the length of a channel's basis vector: 2 for each axis on which it is one of a pair.
    pub(crate) fn weight(&self, c: usize) -> f32 {
        let (y, x, _) = self.split(c);
        let of = |n: usize, u: usize| if n % 2 == 1 && u == n / 2 { 1.0 } else { 2.0 };
        of(self.n[0], y) * of(self.n[1], x)
    }

    /// To and from the parity basis, in place: of positions j and n−1−j the first becomes the sum, the
    /// second the difference. Its own transpose; twice it multiplies by [`Cell::weight`].
    #[inline(always)]
    pub(crate) fn butterfly(&self, values: &mut [f32]) {
        let [ny, nx] = self.n;
        let row = nx * self.inner;
        for j in 0..ny / 2 {
            let (a, b) = values.split_at_mut((ny - 1 - j) * row);
            pair(&mut a[j * row..][..row], &mut b[..row]);
        }
        if nx < 2 {
            return;
        }
        for r in values[..ny * row].chunks_exact_mut(row) {
            if self.inner == 1 {
                for j in 0..nx / 2 {
                    let (p, q) = (r[j], r[nx - 1 - j]);
                    r[j] = p + q;
                    r[nx - 1 - j] = p - q;
                }
            } else {
                for j in 0..nx / 2 {
                    let (a, b) = r.split_at_mut((nx - 1 - j) * self.inner);
                    pair(&mut a[j * self.inner..][..self.inner], &mut b[..self.inner]);
                }
            }
        }
    }
}

#[inline(always)]
fn pair(a: &mut [f32], b: &mut [f32]) {
    for (a, b) in a.iter_mut().zip(b) {
        (*a, *b) = (*a + *b, *a - *b);
    }
}
