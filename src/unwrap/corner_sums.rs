//! Sums over the corners around each vertex, in parallel and in fixed order: how values computed face by face come
//! together at the vertices.

use super::quasi_newton::CHUNK;
use crate::numeric::Vec2;
use rayon::prelude::*;

/// For each vertex the corners `3 f + k` that lie on it, ascending, in compressed rows.
pub(super) struct CornerSums {
    first: Vec<u32>,
    corners: Vec<u32>,
}

impl CornerSums {
    pub fn new(vertex_count: usize, faces: &[[u32; 3]]) -> Self {
        let mut first = vec![0u32; vertex_count + 1];
        faces.iter().flatten().for_each(|&v| first[v as usize + 1] += 1);
        for v in 1..first.len() {
            first[v] += first[v - 1];
        }
        let mut fill = first.clone();
        let mut corners = vec![0u32; faces.len() * 3];
        for (c, &v) in faces.iter().flatten().enumerate() {
            corners[fill[v as usize] as usize] = c as u32;
            fill[v as usize] += 1;
        }
        Self { first, corners }
    }

    /// Whether a face uses the vertex.
    pub fn is_used(&self, vertex: usize) -> bool {
        self.first[vertex] < self.first[vertex + 1]
    }

    /// For each vertex, `start` of it plus the sum over its corners of what `of_face` gives the three corners of a face.
    pub fn gather(
        &self,
        start: impl Fn(usize) -> Vec2 + Sync,
        of_face: impl Fn(usize) -> [Vec2; 3] + Sync + Send,
    ) -> Vec<Vec2> {
        let of_corners: Vec<[Vec2; 3]> =
            (0..self.corners.len() / 3).into_par_iter().with_min_len(CHUNK).map(of_face).collect();
        (0..self.first.len() - 1)
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|v| {
                let around = &self.corners[self.first[v] as usize..self.first[v + 1] as usize];
                around.iter().fold(start(v), |sum, &c| sum + of_corners[(c / 3) as usize][(c % 3) as usize])
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_vertex_gets_its_corners() {
        let sums = CornerSums::new(5, &[[0, 1, 2], [2, 1, 3]]);
        let corner = |c: usize| Vec2::new(10f64.powi(c as i32), 1.0);
        let got = sums.gather(|_| Vec2::zeros(), |f| [corner(3 * f), corner(3 * f + 1), corner(3 * f + 2)]);
        let expected = [(1.0, 1.0), (10_010.0, 2.0), (1_100.0, 2.0), (100_000.0, 1.0), (0.0, 0.0)];
        assert_eq!(got, expected.map(|(x, y)| Vec2::new(x, y)));
        assert!(sums.is_used(3) && !sums.is_used(4));
    }
}
