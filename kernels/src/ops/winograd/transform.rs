//! The three transforms of every scheme, and how weights are stored.
//!
//! With points p, the polynomial product of Toom and Cook transposed (Winograd 1980; Lavin and Gray, arXiv 1509.09308) gives
//! `y = A^T [(G w) * (B^T d)]`. `F(2,3)` and `F(3,2)` have the points 0, 1, -1 and infinity, and so the same B; `F(4,3)` has
//! 0, a, -a, b, -b and infinity with a = 5/8 and b = 25/16. Their product is close to 1, which keeps the rounding error near the lowest that any four symmetric
//! points give (Barabasz et al., arXiv 1803.10986, on why), and all numbers in A and B are exact in f32.

use super::Shape;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::matmul::layout::{packed_index, packed_len};
use crate::simd::Simd;

/// Most values of a transform along one axis.
pub(super) const SIDE: usize = 6;

/// a, a^2, a^3.
const A: [f32; 3] = powers(0.625);
/// b, b^2, b^3.
const B: [f32; 3] = powers(1.5625);
/// a^2 + b^2.
const SUM: f32 = A[1] + B[1];
/// a^2 * b^2.
const PRODUCT: f32 = A[1] * B[1];

const fn powers(x: f32) -> [f32; 3] {
    [x, x * x, x * x * x]
}

/// How many outputs a tile has along each of the two axes, and so at how many points it is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Scheme {
    /// F(2,3): 2 x 2 outputs from 4 x 4 inputs, with 16 multiplications per channel in place of 36.
    Two,
    /// F(3,2): 3 x 3 outputs of one parity of a transposed convolution from 4 x 4 inputs, with 16 multiplications per
    /// channel in place of 36.
    Three,
    /// F(4,3): 4 x 4 outputs from 6 x 6 inputs, with 36 multiplications per channel in place of 144.
    Four,
}

impl Scheme {
    /// Outputs of a tile along an axis.
    pub const fn outputs(self) -> usize {
        match self {
            Scheme::Two => 2,
            Scheme::Three => 3,
            Scheme::Four => 4,
        }
    }

    /// Taps along an axis of the plane.
    pub const fn taps(self) -> usize {
        match self {
            Scheme::Two | Scheme::Four => 3,
            Scheme::Three => 2,
        }
    }

    /// Inputs of a tile along an axis.
    pub const fn inputs(self) -> usize {
        self.outputs() + self.taps() - 1
    }

    /// Points of a tile.
    pub const fn points(self) -> usize {
        self.inputs() * self.inputs()
    }

    /// G: the weight of each tap at each point.
    fn weights(self) -> [[f64; 3]; SIDE] {
        match self {
            Scheme::Two => [[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0.0, 0.0, 1.0], [0.0; 3], [0.0; 3]],
            Scheme::Three => [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 1.0, 0.0], [0.0; 3], [0.0; 3]],
            Scheme::Four => {
                let [a, b] = [A, B].map(|p| f64::from(p[0]));
                let points = [0.0, a, -a, b, -b];
                let mut rows = [[0.0, 0.0, 1.0]; SIDE];
                for (row, p) in rows.iter_mut().zip(points) {
                    let scale: f64 = points.iter().filter(|&&q| q != p).map(|q| p - q).product();
                    *row = [1.0 / scale, p / scale, p * p / scale];
                }
                rows
            }
        }
    }

    /// B^T of one line, in the order of the specification.
    #[inline(always)]
    pub(super) fn input(self, d: [f32; SIDE]) -> [f32; SIDE] {
        match self {
            Scheme::Two | Scheme::Three => [d[0] - d[2], d[1] + d[2], d[2] - d[1], d[3] - d[1], 0.0, 0.0],
            Scheme::Four => {
                let (even_a, odd_a) = ((-B[1]).mul_add(d[2], d[4]), (-B[1]).mul_add(d[1], d[3]));
                let (even_b, odd_b) = ((-A[1]).mul_add(d[2], d[4]), (-A[1]).mul_add(d[1], d[3]));
                [
                    (-SUM).mul_add(d[2], PRODUCT.mul_add(d[0], d[4])),
                    A[0].mul_add(odd_a, even_a),
                    (-A[0]).mul_add(odd_a, even_a),
                    B[0].mul_add(odd_b, even_b),
                    (-B[0]).mul_add(odd_b, even_b),
                    (-SUM).mul_add(d[3], PRODUCT.mul_add(d[1], d[5])),
                ]
            }
        }
    }

    /// A^T of one line, in the order of the specification.
    #[inline(always)]
    pub(super) fn output(self, m: [f32; SIDE]) -> [f32; SIDE] {
        match self {
            Scheme::Two => [(m[0] + m[1]) + m[2], (m[1] - m[2]) + m[3], 0.0, 0.0, 0.0, 0.0],
            Scheme::Three => {
                let sum = m[1] + m[2];
                [m[0] + sum, m[1] - m[2], sum + m[3], 0.0, 0.0, 0.0]
            }
            Scheme::Four => {
                let (even_a, odd_a) = (m[1] + m[2], m[1] - m[2]);
                let (even_b, odd_b) = (m[3] + m[4], m[3] - m[4]);
                [
                    (m[0] + even_a) + even_b,
                    B[0].mul_add(odd_b, A[0] * odd_a),
                    B[1].mul_add(even_b, A[1] * even_a),
                    B[2].mul_add(odd_b, A[2].mul_add(odd_a, m[5])),
                    0.0,
                    0.0,
                ]
            }
        }
    }
}

/// A [`Scheme`] that is known when its body is compiled.
pub(super) trait Transform {
    const SCHEME: Scheme;
    const OUTPUTS: usize = Self::SCHEME.outputs();
    const INPUTS: usize = Self::SCHEME.inputs();

    /// [`Scheme::input`] of 16 lines.
    fn input<S: Simd>(s: S, d: [S::V; SIDE]) -> [S::V; SIDE];
    /// [`Scheme::output`] of 16 lines.
    fn output<S: Simd>(s: S, m: [S::V; SIDE]) -> [S::V; SIDE];
}

pub(super) struct Two;

impl Transform for Two {
    const SCHEME: Scheme = Scheme::Two;

    #[inline(always)]
    fn input<S: Simd>(s: S, d: [S::V; SIDE]) -> [S::V; SIDE] {
        [s.sub(d[0], d[2]), s.add(d[1], d[2]), s.sub(d[2], d[1]), s.sub(d[3], d[1]), d[4], d[5]]
    }

    #[inline(always)]
    fn output<S: Simd>(s: S, m: [S::V; SIDE]) -> [S::V; SIDE] {
        let (sum, difference) = (s.add(m[0], m[1]), s.sub(m[1], m[2]));
        [s.add(sum, m[2]), s.add(difference, m[3]), m[2], m[3], m[4], m[5]]
    }
}

pub(super) struct Three;

impl Transform for Three {
    const SCHEME: Scheme = Scheme::Three;

    #[inline(always)]
    fn input<S: Simd>(s: S, d: [S::V; SIDE]) -> [S::V; SIDE] {
        Two::input(s, d)
    }

    #[inline(always)]
    fn output<S: Simd>(s: S, m: [S::V; SIDE]) -> [S::V; SIDE] {
        let sum = s.add(m[1], m[2]);
        [s.add(m[0], sum), s.sub(m[1], m[2]), s.add(sum, m[3]), m[3], m[4], m[5]]
    }
}

pub(super) struct Four;

impl Transform for Four {
    const SCHEME: Scheme = Scheme::Four;

    #[inline(always)]
    fn input<S: Simd>(s: S, d: [S::V; SIDE]) -> [S::V; SIDE] {
        let fma = |x: f32, a, b| s.mul_add(s.splat(x), a, b);
        let (even_a, odd_a) = (fma(-B[1], d[2], d[4]), fma(-B[1], d[1], d[3]));
        let (even_b, odd_b) = (fma(-A[1], d[2], d[4]), fma(-A[1], d[1], d[3]));
        [
            fma(-SUM, d[2], fma(PRODUCT, d[0], d[4])),
            fma(A[0], odd_a, even_a),
            fma(-A[0], odd_a, even_a),
            fma(B[0], odd_b, even_b),
            fma(-B[0], odd_b, even_b),
            fma(-SUM, d[3], fma(PRODUCT, d[1], d[5])),
        ]
    }

    #[inline(always)]
    fn output<S: Simd>(s: S, m: [S::V; SIDE]) -> [S::V; SIDE] {
        let fma = |x: f32, a, b| s.mul_add(s.splat(x), a, b);
        let mul = |x: f32, a| s.mul(s.splat(x), a);
        let (even_a, odd_a) = (s.add(m[1], m[2]), s.sub(m[1], m[2]));
        let (even_b, odd_b) = (s.add(m[3], m[4]), s.sub(m[3], m[4]));
        [
            s.add(s.add(m[0], even_a), even_b),
            fma(B[0], odd_b, mul(A[0], odd_a)),
            fma(B[1], even_b, mul(A[1], even_a)),
            fma(B[2], odd_b, fma(A[2], odd_a, m[5])),
            m[4],
            m[5],
        ]
    }
}

impl Shape {
    /// Products of an output that is computed directly.
    pub fn direct_depth(&self) -> usize {
        self.scheme.taps() * self.scheme.taps() * self.depth()
    }

    /// Products per output and point.
    pub fn depth(&self) -> usize {
        self.layer_taps * self.channels
    }

    /// Numbers that the transformed weights of one point take.
    pub(super) fn point_len(&self) -> usize {
        packed_len(self.depth(), self.columns)
    }

    /// Numbers that the transformed weights of one part take.
    pub(super) fn part_len(&self) -> usize {
        self.scheme.points() * self.point_len()
    }

    /// Numbers that the transformed weights take.
    pub fn weights_len(&self) -> usize {
        self.parts() * self.part_len()
    }

    /// Transforms the weights, in f64, and packs them: for each part, for each point, row by row, a matrix as
    /// [`crate::panels`] stores it, with k over (taps of the layers, channels).
    ///
    /// `w(part, k, n)` is the weight that [`crate::conv`] has for output channel `n` at k, over (taps of the plane, taps of
    /// the layers, channels); of a transposed convolution, the one that [`crate::deconv3d`] has for the parity `part`.
    ///
    /// # Panics
    /// If `out` is not [`Shape::weights_len`] long.
    pub fn pack(&self, w: impl Fn(usize, usize, usize) -> f64, out: &mut [f32]) {
        assert_eq!(out.len(), self.weights_len(), "transformed weights have another size");
        let (depth, side, points) = (self.depth(), self.scheme.inputs(), self.scheme.weights());
        let taps = self.scheme.taps();
        out.fill(0.0);
        for (part, out) in out.chunks_exact_mut(self.part_len()).enumerate() {
            for n in 0..self.columns {
                for k in 0..depth {
                    let square: [[f64; 3]; 3] = core::array::from_fn(|i| {
                        core::array::from_fn(|j| match i.max(j) < taps {
                            true => w(part, (i * taps + j) * depth + k, n),
                            false => 0.0,
                        })
                    });
                    for (point, out) in out.chunks_exact_mut(self.point_len()).enumerate() {
                        let (rows, columns) = (points[point / side], points[point % side]);
                        let mut sum = 0.0;
                        for (taps, row) in square.iter().zip(rows) {
                            sum += row * (taps[0] * columns[0] + taps[1] * columns[1] + taps[2] * columns[2]);
                        }
                        out[packed_index(depth, k, n)] = sum as f32;
                    }
                }
            }
        }
    }
}
