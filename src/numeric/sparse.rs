//! Sparse symmetric (or Hermitian) positive definite systems on meshes: pattern, assembly by slots, Cholesky with a reusable
//! analysis.
//!
//! A [`Pattern`] is built once from the faces of a mesh (no triplets, so no triplet peak) and tells each face where its
//! entries go ([`Pattern::face_slots`]). Values are a plain vector beside it, real or complex ([`Entry`]), so an iteration only refills numbers.
//! [`Analysis`] (fill-reducing ordering, AMD or a given one, and symbolic factorization) is made once a pattern, [`Cholesky`] once a set
//! of values. Everything runs in one fixed order on the calling thread: same values, same bytes.
//!
//! Nothing is regularized behind the caller's back: a matrix that is not positive definite is
//! [`Error::NotPositiveDefinite`], and a caller who wants a shift adds it with [`Pattern::add_to_diagonal`] and says so.

use std::ops::{AddAssign, Mul, Sub, SubAssign};
use std::sync::Arc;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::LltRegularization;
use faer::perm::PermRef;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::traits::ComplexField;
use faer::{Conj, MatMut, Par, Side, Spec};
use rayon::prelude::*;

/// A complex number: (u, v) of one vertex as `u + i v`.
pub type Complex = nalgebra::Complex<f64>;

/// What the entries of a matrix and its vectors are: real or complex numbers in double precision.
pub trait Entry:
    ComplexField + Copy + Send + Sync + Mul<Output = Self> + Sub<Output = Self> + AddAssign + SubAssign + From<f64>
{
    /// The complex conjugate.
    fn conjugate(self) -> Self;
    /// The absolute value.
    fn size(self) -> f64;
}

impl Entry for f64 {
    fn conjugate(self) -> Self {
        self
    }
    fn size(self) -> f64 {
        self.abs()
    }
}

impl Entry for Complex {
    fn conjugate(self) -> Self {
        self.conj()
    }
    fn size(self) -> f64 {
        self.norm()
    }
}

/// Why a sparse system was not solved.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The numbers of unknowns or entries do not fit the 32-bit index.
    #[error("a sparse system of {unknowns} unknowns and {entries} entries is too large for 32-bit indices")]
    TooLarge {
        /// Unknowns.
        unknowns: usize,
        /// Entries of the lower triangle.
        entries: usize,
    },
    /// A value is NaN or infinite.
    #[error("the matrix entry in row {row}, column {column} is not finite")]
    NotFinite {
        /// Row of the entry.
        row: usize,
        /// Column of the entry.
        column: usize,
    },
    /// A pivot is zero or negative.
    #[error(
        "the matrix of {unknowns} unknowns is not positive definite (pivot {pivot} in elimination order): \
         something is left free, or a coefficient is negative"
    )]
    NotPositiveDefinite {
        /// Unknowns.
        unknowns: usize,
        /// Position of the bad pivot in the elimination order.
        pivot: usize,
    },
    /// The factorization does not fit into memory.
    #[error("no memory for the factor of {unknowns} unknowns")]
    OutOfMemory {
        /// Unknowns.
        unknowns: usize,
    },
}

/// The lower triangle of a symmetric or Hermitian sparse matrix in compressed columns: rows ascend, the diagonal comes first.
#[derive(Clone, Debug, PartialEq)]
pub struct Pattern {
    starts: Vec<u32>,
    rows: Vec<u32>,
}

/// Where the entries of one face go: the diagonals of its three corners, then its edges 0-1, 1-2, 2-0.
pub type FaceSlots = [u32; 6];

impl Pattern {
    /// One unknown a vertex, coupled along the edges of `faces`.
    ///
    /// # Errors
    /// [`Error::TooLarge`].
    pub fn of_vertices(vertex_count: usize, faces: &[[u32; 3]]) -> Result<Self, Error> {
        let edges = || faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        Self::of_pairs(vertex_count, edges)
    }

    /// One unknown each, coupled for the pairs that `pairs` lists (twice, so it is called twice). Doubles are merged.
    ///
    /// # Errors
    /// [`Error::TooLarge`].
    pub fn of_pairs<I: Iterator<Item = (u32, u32)>>(unknowns: usize, pairs: impl Fn() -> I) -> Result<Self, Error> {
        let mut starts = vec![1u64; unknowns + 1];
        starts[0] = 0;
        for (a, b) in pairs() {
            if a != b {
                starts[a.min(b) as usize + 1] += 1;
            }
        }
        for j in 0..unknowns {
            starts[j + 1] += starts[j];
        }
        let entries = starts[unknowns] as usize;
        // The factor's own indices are what overflows first; a generous bound on A keeps that far away.
        if unknowns >= u32::MAX as usize / 2 || entries >= u32::MAX as usize / 4 {
            return Err(Error::TooLarge { unknowns, entries });
        }
        let mut rows = vec![0u32; entries];
        let mut fill: Vec<u32> = starts[..unknowns].iter().map(|&s| s as u32).collect();
        for (j, next) in fill.iter_mut().enumerate() {
            rows[*next as usize] = j as u32;
            *next += 1;
        }
        for (a, b) in pairs() {
            if a != b {
                let next = &mut fill[a.min(b) as usize];
                rows[*next as usize] = a.max(b);
                *next += 1;
            }
        }
        drop(fill);
        // Sort and merge each column in place.
        let mut compact = Vec::with_capacity(unknowns + 1);
        let mut write = 0usize;
        for j in 0..unknowns {
            compact.push(write as u32);
            let (begin, end) = (starts[j] as usize, starts[j + 1] as usize);
            rows[begin..end].sort_unstable();
            for read in begin..end {
                if read == begin || rows[read] != rows[read - 1] {
                    // `write` never overtakes `read`, and `rows[read - 1]` is compared before it is overwritten
                    // because merged entries are equal to it.
                    rows[write] = rows[read];
                    write += 1;
                }
            }
        }
        compact.push(write as u32);
        rows.truncate(write);
        rows.shrink_to_fit();
        Ok(Self { starts: compact, rows })
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.starts.len() - 1
    }

    /// Number of stored entries (lower triangle with diagonal).
    pub fn entries(&self) -> usize {
        self.rows.len()
    }

    /// Rows of column `j`: `j` itself, then ascending.
    pub fn column(&self, j: usize) -> &[u32] {
        &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize]
    }

    /// Slot of the diagonal entry of unknown `j`.
    pub fn diagonal(&self, j: usize) -> usize {
        self.starts[j] as usize
    }

    /// Slot of the entry that couples `a` and `b` (either order), if the pattern has it.
    pub fn slot(&self, a: u32, b: u32) -> Option<usize> {
        let (column, row) = (a.min(b) as usize, a.max(b));
        self.column(column).binary_search(&row).ok().map(|p| self.starts[column] as usize + p)
    }

    /// The slots of each face of the mesh this pattern was built from.
    ///
    /// Panics if an edge of `faces` is not in the pattern.
    pub fn face_slots(&self, faces: &[[u32; 3]]) -> Vec<FaceSlots> {
        let edge = |a: u32, b: u32| self.slot(a, b).expect("every edge of the mesh is in its pattern") as u32;
        let diagonal = |v: u32| self.starts[v as usize];
        faces
            .iter()
            .map(|&[a, b, c]| [diagonal(a), diagonal(b), diagonal(c), edge(a, b), edge(b, c), edge(c, a)])
            .collect()
    }

    /// The same couplings for two interleaved unknowns a node: node `i` owns unknowns `2 i` and `2 i + 1`, every pair of
    /// coupled nodes all four entries. [`Pattern::block_slots`] tells where they are.
    ///
    /// # Errors
    /// [`Error::TooLarge`].
    pub fn two_per_node(&self) -> Result<Self, Error> {
        let n = self.unknowns();
        let entries = 4 * self.entries() - n;
        if 2 * n >= u32::MAX as usize / 2 || entries >= u32::MAX as usize / 4 {
            return Err(Error::TooLarge { unknowns: 2 * n, entries });
        }
        let mut starts = Vec::with_capacity(2 * n + 1);
        let mut rows = Vec::with_capacity(entries);
        for j in 0..n {
            starts.push(rows.len() as u32);
            self.column(j).iter().for_each(|&i| rows.extend([2 * i, 2 * i + 1]));
            starts.push(rows.len() as u32);
            rows.push(2 * j as u32 + 1);
            self.column(j)[1..].iter().for_each(|&i| rows.extend([2 * i, 2 * i + 1]));
        }
        starts.push(rows.len() as u32);
        Ok(Self { starts, rows })
    }

    /// For the entry at `slot` of this pattern, in column `j`: the four slots of its 2x2 block in
    /// [`Pattern::two_per_node`], ordered (row 2i, column 2j), (2i+1, 2j), (2i, 2j+1), (2i+1, 2j+1). On the diagonal the
    /// third is the second, because only the lower triangle is stored.
    pub fn block_slots(&self, slot: usize, j: usize) -> [usize; 4] {
        let start = self.starts[j] as usize;
        let (place, length) = (slot - start, self.starts[j + 1] as usize - start);
        let first = 4 * start - j;
        let second = first + 2 * length;
        if place == 0 {
            [first, first + 1, first + 1, second]
        } else {
            [first + 2 * place, first + 2 * place + 1, second + 2 * place - 1, second + 2 * place]
        }
    }

    /// Adds `shift[j]` to each diagonal entry.
    pub fn add_to_diagonal<T: Entry>(&self, values: &mut [T], shift: impl Fn(usize) -> f64) {
        for j in 0..self.unknowns() {
            values[self.starts[j] as usize] += T::from(shift(j));
        }
    }

    /// Fixes the unknowns with `fixed[j] = Some(x)`: their rows and columns become those of the identity and `right` is
    /// changed so that the other unknowns see the fixed values.
    pub fn fix_unknowns<T: Entry>(&self, values: &mut [T], right: &mut [T], fixed: impl Fn(usize) -> Option<T>) {
        for j in 0..self.unknowns() {
            let at_j = fixed(j);
            for slot in self.starts[j] as usize + 1..self.starts[j + 1] as usize {
                let i = self.rows[slot] as usize;
                match (at_j, fixed(i)) {
                    (None, None) => continue,
                    (Some(x), None) => right[i] -= values[slot] * x,
                    (None, Some(x)) => right[j] -= values[slot].conjugate() * x,
                    (Some(_), Some(_)) => {}
                }
                values[slot] = T::from(0.0);
            }
        }
        for j in 0..self.unknowns() {
            if let Some(x) = fixed(j) {
                values[self.starts[j] as usize] = T::from(1.0);
                right[j] = x;
            }
        }
    }

    /// The product of the matrix with `x`.
    pub fn multiply<T: Entry>(&self, values: &[T], x: &[T]) -> Vec<T> {
        let mut y = vec![T::from(0.0); self.unknowns()];
        for j in 0..self.unknowns() {
            let mut sum = values[self.starts[j] as usize] * x[j];
            for slot in self.starts[j] as usize + 1..self.starts[j + 1] as usize {
                let i = self.rows[slot] as usize;
                sum += values[slot].conjugate() * x[i];
                y[i] += values[slot] * x[j];
            }
            y[j] += sum;
        }
        y
    }

    /// `|A x - b| / (|A| |x| + |b|)` in the largest-entry norms: near 1e-16 for a good solve.
    pub fn relative_residual<T: Entry>(&self, values: &[T], x: &[T], b: &[T]) -> f64 {
        let largest = |v: &[T]| v.iter().fold(0.0f64, |m, a| m.max(a.size()));
        let r = self.multiply(values, x).iter().zip(b).fold(0.0f64, |m, (y, b)| m.max((*y - *b).size()));
        let scale = largest(values) * largest(x) + largest(b);
        if scale == 0.0 { r } else { r / scale }
    }

    /// An elimination order with the same fill as `order` in which every subtree of the elimination tree is contiguous, as
    /// a supernodal factorization wants it (J. W. H. Liu, "The role of elimination trees in sparse factorization", SIAM
    /// Journal on Matrix Analysis and Applications 11(1), 1990, doi:10.1137/0611010).
    fn postordered(&self, order: &[u32]) -> Vec<u32> {
        const NONE: u32 = u32::MAX;
        let n = order.len();
        let mut place = vec![0u32; n];
        order.iter().enumerate().for_each(|(k, &i)| place[i as usize] = k as u32);
        // For each unknown, in the new order, its earlier neighbours in compressed rows.
        let pairs = || {
            (0..n).flat_map(|j| self.column(j)[1..].iter().map(move |&i| (i, j))).map(|(i, j)| {
                let (a, b) = (place[i as usize], place[j]);
                (a.max(b), a.min(b))
            })
        };
        let mut start = vec![0u32; n + 1];
        pairs().for_each(|(late, _)| start[late as usize + 1] += 1);
        for k in 0..n {
            start[k + 1] += start[k];
        }
        let mut fill = start.clone();
        let mut earlier = vec![0u32; start[n] as usize];
        pairs().for_each(|(late, early)| {
            earlier[fill[late as usize] as usize] = early;
            fill[late as usize] += 1;
        });
        let (mut parent, mut ancestor) = (vec![NONE; n], vec![NONE; n]);
        for k in 0..n {
            for &from in &earlier[start[k] as usize..start[k + 1] as usize] {
                let mut i = from;
                while i != NONE && (i as usize) < k {
                    let next = std::mem::replace(&mut ancestor[i as usize], k as u32);
                    if next == NONE {
                        parent[i as usize] = k as u32;
                    }
                    i = next;
                }
            }
        }
        // Children of each unknown, first to last; the roots hang on one more.
        let (mut first, mut sibling) = (vec![NONE; n + 1], vec![NONE; n]);
        for k in (0..n).rev() {
            let above = if parent[k] == NONE { n } else { parent[k] as usize };
            sibling[k] = std::mem::replace(&mut first[above], k as u32);
        }
        let mut result = Vec::with_capacity(n);
        let mut path: Vec<u32> = Vec::new();
        let mut next = first[n];
        loop {
            while next != NONE {
                path.push(next);
                next = std::mem::replace(&mut first[next as usize], NONE);
            }
            let Some(done) = path.pop() else { return result };
            result.push(order[done as usize]);
            next = sibling[done as usize];
        }
    }

    fn as_faer(&self) -> SymbolicSparseColMatRef<'_, u32> {
        let n = self.unknowns();
        SymbolicSparseColMatRef::new_checked(n, n, &self.starts, None, &self.rows)
    }
}

/// Ordering and symbolic factorization of a [`Pattern`]; cheap to clone.
#[derive(Clone, Debug)]
pub struct Analysis {
    symbolic: Arc<SymbolicCholesky<u32>>,
}

impl Analysis {
    /// Analyses a pattern (AMD ordering).
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn new(pattern: &Pattern) -> Result<Self, Error> {
        let unknowns = pattern.unknowns();
        let symbolic = factorize_symbolic_cholesky(
            pattern.as_faer(),
            Side::Lower,
            SymmetricOrdering::Amd,
            CholeskySymbolicParams::default(),
        )
        .map_err(|_| Error::OutOfMemory { unknowns })?;
        Ok(Self { symbolic: Arc::new(symbolic) })
    }

    /// Analyses a pattern with two interleaved unknowns a node, such as [`Pattern::two_per_node`], by the AMD ordering of its
    /// nodes: half the unknowns and a quarter of the entries to order, and the same fill where the two unknowns of a node
    /// have the same neighbours.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn of_paired(nodes: &Pattern, pattern: &Pattern) -> Result<Self, Error> {
        let unknowns = pattern.unknowns();
        let n = nodes.unknowns();
        assert_eq!(unknowns, 2 * n);
        let no_memory = || Error::OutOfMemory { unknowns };
        let (mut forward, mut inverse) = (vec![0u32; n], vec![0u32; n]);
        let need = amd::order_maybe_unsorted_scratch::<u32>(n, nodes.entries());
        let mut memory = MemBuffer::try_new(need).map_err(|_| no_memory())?;
        let stack = MemStack::new(&mut memory);
        amd::order_maybe_unsorted(&mut forward, &mut inverse, nodes.as_faer(), amd::Control::default(), stack)
            .map_err(|_| no_memory())?;
        drop(memory);
        let pairs: Vec<u32> = forward.iter().flat_map(|&p| [2 * p, 2 * p + 1]).collect();
        Self::in_order(pattern, &pairs)
    }

    /// Analyses a pattern whose unknowns are eliminated in a given order, or in one with the same fill. Panics unless
    /// every unknown comes once.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`].
    pub fn in_order(pattern: &Pattern, order: &[u32]) -> Result<Self, Error> {
        let unknowns = pattern.unknowns();
        let order = pattern.postordered(order);
        let mut place = vec![0u32; unknowns];
        order.iter().enumerate().for_each(|(k, &i)| place[i as usize] = k as u32);
        let ordering = SymmetricOrdering::Custom(PermRef::new_checked(&order, &place, unknowns));
        let symbolic = factorize_symbolic_cholesky(pattern.as_faer(), Side::Lower, ordering, Default::default())
            .map_err(|_| Error::OutOfMemory { unknowns })?;
        Ok(Self { symbolic: Arc::new(symbolic) })
    }

    /// Numbers stored in the factor.
    pub fn factor_entries(&self) -> usize {
        self.symbolic.len_val()
    }
}

/// A Cholesky factorization `A = L L^T` (`L L^*` where the entries are complex).
#[derive(Debug)]
pub struct Cholesky<T = f64> {
    analysis: Analysis,
    factor: Vec<T>,
}

impl<T: Entry> Cholesky<T> {
    /// Factors the matrix with this pattern, its analysis and these values.
    ///
    /// # Errors
    /// [`Error::NotFinite`], [`Error::NotPositiveDefinite`] or [`Error::OutOfMemory`].
    pub fn new(pattern: &Pattern, analysis: &Analysis, values: &[T]) -> Result<Self, Error> {
        let factor = vec![T::from(0.0); analysis.symbolic.len_val()];
        let mut cholesky = Self { analysis: analysis.clone(), factor };
        cholesky.refactor(pattern, values)?;
        Ok(cholesky)
    }

    /// Analyses and factors in one go.
    ///
    /// # Errors
    /// As [`Cholesky::new`].
    pub fn of(pattern: &Pattern, values: &[T]) -> Result<Self, Error> {
        Self::new(pattern, &Analysis::new(pattern)?, values)
    }

    /// Factors other values of the same pattern into the same memory.
    ///
    /// # Errors
    /// As [`Cholesky::new`]; afterwards the factor must not be used.
    pub fn refactor(&mut self, pattern: &Pattern, values: &[T]) -> Result<(), Error> {
        let unknowns = pattern.unknowns();
        if let Some(slot) = values.iter().position(|v| !v.size().is_finite()) {
            let column = pattern.starts.partition_point(|&s| s as usize <= slot) - 1;
            return Err(Error::NotFinite { row: pattern.rows[slot] as usize, column });
        }
        let symbolic = &self.analysis.symbolic;
        let need = symbolic.factorize_numeric_llt_scratch::<T>(Par::Seq, Spec::default());
        let mut memory = MemBuffer::try_new(need).map_err(|_| Error::OutOfMemory { unknowns })?;
        symbolic
            .factorize_numeric_llt::<T>(
                &mut self.factor,
                SparseColMatRef::new(pattern.as_faer(), values),
                Side::Lower,
                LltRegularization::default(),
                Par::Seq,
                MemStack::new(&mut memory),
                Spec::default(),
            )
            .map_err(|e| {
                let faer::linalg::cholesky::llt::factor::LltError::NonPositivePivot { index } = e;
                Error::NotPositiveDefinite { unknowns, pivot: index }
            })?;
        Ok(())
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.analysis.symbolic.nrows()
    }

    /// Replaces right-hand sides (column after column) by solutions, each column on its own, so that they do not depend on
    /// each other or on the number of threads. Panics if the length is no multiple of the unknowns.
    pub fn solve_in_place(&self, right: &mut [T]) {
        let n = self.unknowns();
        assert!(n > 0 && right.len().is_multiple_of(n));
        right.par_chunks_mut(n).for_each(|column| {
            let mut memory = MemBuffer::new(self.analysis.symbolic.solve_in_place_scratch::<T>(1, Par::Seq));
            LltRef::<u32, T>::new(&self.analysis.symbolic, &self.factor).solve_in_place_with_conj(
                Conj::No,
                MatMut::from_column_major_slice_mut(column, n, 1),
                Par::Seq,
                MemStack::new(&mut memory),
            );
        });
    }

    /// Solves for one right-hand side, with one step of iterative refinement: half the digits that a badly conditioned
    /// matrix costs come back for the price of a product and a solve.
    pub fn solve_refined(&self, pattern: &Pattern, values: &[T], right: &[T]) -> Vec<T> {
        let mut x = right.to_vec();
        self.solve_in_place(&mut x);
        let mut rest = pattern.multiply(values, &x);
        rest.iter_mut().zip(right).for_each(|(r, b)| *r = *b - *r);
        self.solve_in_place(&mut rest);
        x.iter_mut().zip(&rest).for_each(|(x, d)| *x += *d);
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of `n` x `n` vertices, two triangles a cell.
    fn grid(n: u32) -> Vec<[u32; 3]> {
        let at = |i: u32, j: u32| i * n + j;
        (0..n - 1)
            .flat_map(|i| (0..n - 1).map(move |j| (i, j)))
            .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
            .collect()
    }

    /// Graph Laplacian with a tiny shift on the diagonal.
    fn laplacian(pattern: &Pattern, shift: f64) -> Vec<f64> {
        let mut values = vec![0.0; pattern.entries()];
        for j in 0..pattern.unknowns() {
            for &i in &pattern.column(j)[1..] {
                values[pattern.slot(i, j as u32).unwrap()] = -1.0;
                values[pattern.diagonal(i as usize)] += 1.0;
                values[pattern.diagonal(j)] += 1.0;
            }
        }
        pattern.add_to_diagonal(&mut values, |_| shift);
        values
    }

    #[test]
    fn pattern_of_two_triangles() {
        let p = Pattern::of_vertices(5, &[[0, 2, 1], [2, 0, 3]]).unwrap();
        assert_eq!(
            (0..5).map(|j| p.column(j).to_vec()).collect::<Vec<_>>(),
            [vec![0, 1, 2, 3], vec![1, 2], vec![2, 3], vec![3], vec![4]]
        );
        assert_eq!(p.slot(3, 0), Some(3));
        assert_eq!(p.slot(3, 1), None);
        assert_eq!(p.face_slots(&[[0, 2, 1]]), vec![[0, 6, 4, 2, 5, 1]]);
    }

    #[test]
    fn block_slots_address_their_block() {
        let p = Pattern::of_vertices(16, &grid(4)).unwrap();
        let b = p.two_per_node().unwrap();
        for j in 0..16usize {
            for (k, &i) in p.column(j).iter().enumerate() {
                let slots = p.block_slots(p.diagonal(j) + k, j);
                for (slot, (di, dj)) in slots.into_iter().zip([(0, 0), (1, 0), (0, 1), (1, 1)]) {
                    assert_eq!(b.slot(2 * i + di, 2 * j as u32 + dj), Some(slot));
                }
            }
        }
    }

    #[test]
    fn an_order_of_nodes_serves_their_pairs() {
        let n = 40u32;
        let nodes = Pattern::of_vertices((n * n) as usize, &grid(n)).unwrap();
        let pattern = nodes.two_per_node().unwrap();
        // Diagonally dominant: positive definite whatever the signs.
        let mut values: Vec<f64> = (0..pattern.entries()).map(|s| (s as f64 * 0.7).sin()).collect();
        for j in 0..pattern.unknowns() {
            values[pattern.diagonal(j)] = 40.0;
        }
        let truth: Vec<f64> = (0..pattern.unknowns()).map(|i| (i as f64 * 0.37).cos()).collect();
        let right = pattern.multiply(&values, &truth);
        let analysis = Analysis::of_paired(&nodes, &pattern).unwrap();
        let mut x = right;
        Cholesky::new(&pattern, &analysis, &values).unwrap().solve_in_place(&mut x);
        assert!(x.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-12));
        let plain = Analysis::new(&pattern).unwrap();
        assert!((analysis.factor_entries() as f64) < 1.2 * plain.factor_entries() as f64);
    }

    #[test]
    fn a_postorder_is_a_permutation_with_subtrees_together() {
        // A path 0-2-4-1-3 eliminated as 0, 1, 2, 3, 4: 0 -> 2, 1 -> 3, 3 -> 4, 2 -> 4.
        let pattern = Pattern::of_pairs(5, || [(0, 2), (2, 4), (4, 1), (1, 3)].into_iter()).unwrap();
        assert_eq!(pattern.postordered(&[0, 1, 2, 3, 4]), [0, 2, 1, 3, 4]);
    }

    #[test]
    fn solves_a_laplacian_small_and_large() {
        for n in [2u32, 5, 60] {
            let pattern = Pattern::of_vertices((n * n) as usize, &grid(n)).unwrap();
            let values = laplacian(&pattern, 1e-6);
            let truth: Vec<f64> = (0..n * n).map(|i| f64::from(i * 37 % 101) - 50.0).collect();
            let right = pattern.multiply(&values, &truth);
            let cholesky = Cholesky::of(&pattern, &values).unwrap();
            let mut two = [right.clone(), right.iter().map(|b| 2.0 * b).collect()].concat();
            cholesky.solve_in_place(&mut two);
            let (x, y) = two.split_at(right.len());
            assert!(pattern.relative_residual(&values, x, &right) < 1e-13);
            assert!(x.iter().zip(y).all(|(a, b)| (2.0 * a - b).abs() < 1e-5));
            let refined = cholesky.solve_refined(&pattern, &values, &right);
            assert!(refined.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-6));
        }
    }

    #[test]
    fn fixed_unknowns_keep_their_value() {
        let pattern = Pattern::of_vertices(25, &grid(5)).unwrap();
        let mut values = laplacian(&pattern, 0.0);
        let original = values.clone();
        let mut right = vec![0.0; 25];
        pattern.fix_unknowns(&mut values, &mut right, |j| [Some(3.0), None, None, Some(-1.0)].get(j % 23).copied()?);
        let mut x = right;
        Cholesky::of(&pattern, &values).unwrap().solve_in_place(&mut x);
        assert!((x[0] - 3.0).abs() < 1e-14 && (x[3] + 1.0).abs() < 1e-14 && (x[23] - 3.0).abs() < 1e-14);
        let rest = pattern.multiply(&original, &x);
        assert!((0..25).filter(|j| ![0, 3, 23].contains(j)).all(|j| rest[j].abs() < 1e-13));
    }

    #[test]
    fn a_hermitian_system_keeps_its_fixed_unknowns() {
        let pattern = Pattern::of_vertices(400, &grid(20)).unwrap();
        let mut values: Vec<Complex> = laplacian(&pattern, 0.5).into_iter().map(Complex::from).collect();
        for j in 0..400 {
            for slot in pattern.diagonal(j) + 1..pattern.diagonal(j) + pattern.column(j).len() {
                values[slot].im = 0.4 * (slot as f64).sin();
            }
        }
        let truth: Vec<Complex> = (0..400).map(|i| Complex::new(f64::from(i).cos(), f64::from(i * 3).sin())).collect();
        let mut right = pattern.multiply(&values, &truth);
        let x = Cholesky::of(&pattern, &values).unwrap().solve_refined(&pattern, &values, &right);
        assert!(pattern.relative_residual(&values, &x, &right) < 1e-14);
        assert!(x.iter().zip(&truth).all(|(a, b)| (a - b).norm() < 1e-11));
        // Held where they are, all others stay where they are.
        let held = |j: usize| j.is_multiple_of(7).then(|| truth[j]);
        pattern.fix_unknowns(&mut values, &mut right, held);
        Cholesky::of(&pattern, &values).unwrap().solve_in_place(&mut right);
        assert!(right.iter().zip(&truth).all(|(a, b)| (a - b).norm() < 1e-11));
    }

    #[test]
    fn a_singular_or_indefinite_matrix_is_an_error() {
        let pattern = Pattern::of_vertices(9, &grid(3)).unwrap();
        let mut values = laplacian(&pattern, 0.0);
        values[pattern.diagonal(4)] = -1.0;
        assert!(matches!(Cholesky::of(&pattern, &values), Err(Error::NotPositiveDefinite { unknowns: 9, .. })));
        values[pattern.slot(1, 2).unwrap()] = f64::NAN;
        assert_eq!(Cholesky::of(&pattern, &values).err(), Some(Error::NotFinite { row: 2, column: 1 }));
    }
}
