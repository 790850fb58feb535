//! Sample points to feature pixels of one camera.
//!
//! ```text
//! for each x in xs, each y in ys, each z in zs:
//!     p[r]  = matrix[r] . (x, y, z, 1)          for r in 0..3, in the order that `Sum` names
//!     u, v  = p[0] / p[2], p[1] / p[2]
//!     valid = 0 <= u <= width - 1  and  0 <= v <= height - 1  and  p[2] >= 0
//!     out   = base + floor(v / stride) * (width / stride) + floor(u / stride)   if valid, else 0
//! ```
//!
//! Flat pixel 0 never counts in a projection matrix, so 0 doubles as the mark of a sample that hits nothing. NaN fails
//! every comparison and so is invalid. Strides are powers of two: dividing a coordinate by one is exact, hence
//! `floor(u / stride)` is a shift of the integer part.
//!
//! The body computes sixteen points of a plane of constant x at once, wherever its lines end, and for these lanes all x: lines are
//! short (20 z at level 2 of `nuscenes-200`), and lanes beyond their ends would be work for nothing.

use crate::isa::Isa;
#[cfg(not(feature = "std"))]
use crate::math::Float as _;
use crate::simd::{Kernel, LANES, Simd, dispatch};

/// Rounding of the products: in which order, and with which roundings, a row is multiplied with a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sum {
    /// `fma(m2, z, fma(m1, y, m0 * x)) + m3`: one chain, ascending.
    Chain,
    /// `(m0 * x + m2 * z) + (m1 * y + m3)`, every operation rounded. The published code's matrix product takes this
    /// order for a single camera, where its left operand has only one matrix's rows.
    Pairs,
}

/// One camera's projection onto the flat feature pixels of one level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// The first three rows of lidar2img, row-major: lidar-frame metres to (u * d, v * d, d) in image pixels.
    pub matrix: [f32; 12],
    /// How a row is summed.
    pub sum: Sum,
    /// Pixels per row of the padded image, a multiple of the stride.
    pub width: u32,
    /// Rows of the padded image, a multiple of the stride.
    pub height: u32,
    /// Image pixels per feature pixel and axis, as a power of two: 3 for stride 8.
    pub stride_log2: u32,
    /// Flat index of this camera's first feature pixel.
    pub base: u32,
}

impl Projection {
    /// Every rule that the arithmetic relies on.
    fn check(&self, points: [usize; 3], out: &[u32]) {
        let samples = points[0].checked_mul(points[1]).and_then(|v| v.checked_mul(points[2]));
        assert_eq!(samples, Some(out.len()), "out holds one pixel per sample point");
        assert!(self.stride_log2 < 16, "stride is at most 2^15");
        let stride = 1 << self.stride_log2;
        for size in [self.width, self.height] {
            assert!(
                size > 0 && size <= 1 << 20 && size % stride == 0,
                "image of 1 to 2^20 pixels, a multiple of the stride"
            );
        }
        let pixels = u64::from(self.width / stride) * u64::from(self.height / stride);
        assert!(u64::from(self.base) + pixels <= 1 << 32, "flat pixels fit 32 bits");
    }

    #[inline(always)]
    fn dot(&self, row: usize, x: f32, y: f32, z: f32) -> f32 {
        let [m0, m1, m2, m3] = [0, 1, 2, 3].map(|k| self.matrix[row * 4 + k]);
        match self.sum {
            Sum::Chain => z.mul_add(m2, y.mul_add(m1, m0 * x)) + m3,
            Sum::Pairs => (m0 * x + m2 * z) + (m1 * y + m3),
        }
    }

    /// The flat pixel that a point hits, or 0.
    #[inline(always)]
    fn pixel(&self, x: f32, y: f32, z: f32) -> u32 {
        let d = self.dot(2, x, y, z);
        let u = self.dot(0, x, y, z) / d;
        let v = self.dot(1, x, y, z) / d;
        let inside = |t: f32, size: u32| t >= 0.0 && t <= (size - 1) as f32;
        if inside(u, self.width) && inside(v, self.height) && d >= 0.0 {
            let s = self.stride_log2;
            self.base + (v as u32 >> s) * (self.width >> s) + (u as u32 >> s)
        } else {
            0
        }
    }
}

/// Projects the points (xs\[i\], ys\[j\], zs\[k\]) as the module says: `out[(i * ys.len() + j) * zs.len() + k]` becomes the
/// flat pixel that the point hits, or 0 where it hits none. Returns whether any point hits one.
///
/// # Panics
/// If `out` does not hold one element per point, or `p` breaks a rule of its fields.
///
/// # Determinism
/// The same on every instruction set.
pub fn project_points(isa: Isa, p: &Projection, xs: &[f32], ys: &[f32], zs: &[f32], out: &mut [u32]) -> bool {
    p.check([xs.len(), ys.len(), zs.len()], out);
    dispatch(isa, Run { p, xs, ys, zs, out })
}

struct Run<'a> {
    p: &'a Projection,
    xs: &'a [f32],
    ys: &'a [f32],
    zs: &'a [f32],
    out: &'a mut [u32],
}

impl Run<'_> {
    /// Whether any point hit a pixel.
    #[inline(always)]
    fn hits(&self) -> bool {
        self.out.iter().fold(0, |all, pixel| all | pixel) != 0
    }
}

impl Kernel for Run<'_> {
    type Output = bool;

    #[inline(always)]
    fn reference(self) -> bool {
        let points = self.xs.iter().flat_map(|&x| self.ys.iter().map(move |&y| (x, y)));
        let points = points.flat_map(|(x, y)| self.zs.iter().map(move |&z| (x, y, z)));
        for ((x, y, z), out) in points.zip(self.out.iter_mut()) {
            *out = self.p.pixel(x, y, z);
        }
        self.hits()
    }

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> bool {
        match self.p.sum {
            Sum::Chain => self.all::<S, false>(s),
            Sum::Pairs => self.all::<S, true>(s),
        }
        self.hits()
    }
}

impl Run<'_> {
    #[inline(always)]
    fn all<S: Simd, const PAIRS: bool>(&mut self, s: S) {
        let camera = Constants::<S>::new(s, self.p);
        let plane = self.ys.len() * self.zs.len();
        let mut places = Places { ys: self.ys, zs: self.zs, z: 0 };
        for at in (0..plane).step_by(LANES) {
            let terms = camera.plane_terms::<PAIRS>(s, places.next(s));
            for (&x, out) in self.xs.iter().zip(self.out.chunks_exact_mut(plane)) {
                let pixels = camera.flat(s, camera.dots::<PAIRS>(s, x, &terms));
                let out = &mut out[at..];
                match out.first_chunk_mut() {
                    Some(out) => s.store_int(out, pixels),
                    None => {
                        let mut lanes = [0; LANES];
                        s.store_int(&mut lanes, pixels);
                        out.copy_from_slice(&lanes[..out.len()]);
                    }
                }
            }
        }
    }
}

/// The points of a plane of constant x, sixteen at a time.
struct Places<'a> {
    /// The y of the point to come, and those after it.
    ys: &'a [f32],
    zs: &'a [f32],
    /// Index of the z of the point to come.
    z: usize,
}

impl Places<'_> {
    /// The y and z of the next sixteen points. Lanes beyond the last point hold anything.
    #[inline(always)]
    fn next<S: Simd>(&mut self, s: S) -> [S::V; 2] {
        if let (Some(z), Some(&y)) = (self.zs[self.z..].first_chunk(), self.ys.first()) {
            self.advance(LANES);
            return [s.splat(y), s.load(z)];
        }
        let (mut y_lanes, mut z_lanes) = ([0.0; LANES], [0.0; LANES]);
        let mut filled = 0;
        while let Some(&y) = self.ys.first().filter(|_| filled < LANES) {
            let line = &self.zs[self.z..];
            let count = line.len().min(LANES - filled);
            y_lanes[filled..][..count].fill(y);
            z_lanes[filled..][..count].copy_from_slice(&line[..count]);
            filled += count;
            self.advance(count);
        }
        [s.load(&y_lanes), s.load(&z_lanes)]
    }

    /// Leaves `count` points of a line behind.
    #[inline(always)]
    fn advance(&mut self, count: usize) {
        self.z += count;
        if self.z == self.zs.len() {
            (self.ys, self.z) = (&self.ys[1..], 0);
        }
    }
}

/// What all points share: a camera, one constant for all lanes.
struct Constants<'a, S: Simd> {
    matrix: &'a [f32; 12],
    last_column: S::V,
    last_row: S::V,
    pixels_per_row: S::I,
    base: S::I,
    stride_log2: u32,
}

impl<'a, S: Simd> Constants<'a, S> {
    #[inline(always)]
    fn new(s: S, p: &'a Projection) -> Self {
        Self {
            matrix: &p.matrix,
            last_column: s.splat((p.width - 1) as f32),
            last_row: s.splat((p.height - 1) as f32),
            pixels_per_row: s.splat_int(p.width >> p.stride_log2),
            base: s.splat_int(p.base),
            stride_log2: p.stride_log2,
        }
    }

    /// What all x share, of each row: y and z for a chain, `m2 * z` and `m1 * y + m3` for pairs.
    #[inline(always)]
    fn plane_terms<const PAIRS: bool>(&self, s: S, [y, z]: [S::V; 2]) -> [[S::V; 2]; 3] {
        let mut terms = [[y, z]; 3];
        if PAIRS {
            for r in 0..3 {
                let [m1, m2, m3] = [1, 2, 3].map(|k| s.splat(self.matrix[r * 4 + k]));
                terms[r] = [s.mul(m2, z), s.add(s.mul(m1, y), m3)];
            }
        }
        terms
    }

    /// The three rows' products.
    #[inline(always)]
    fn dots<const PAIRS: bool>(&self, s: S, x: f32, terms: &[[S::V; 2]; 3]) -> [S::V; 3] {
        let mut dots = [s.splat(0.0); 3];
        for r in 0..3 {
            let m = &self.matrix[r * 4..r * 4 + 4];
            let (first, [a, b]) = (s.splat(m[0] * x), terms[r]);
            dots[r] = if PAIRS {
                s.add(s.add(first, a), b)
            } else {
                s.add(s.mul_add(s.splat(m[2]), b, s.mul_add(s.splat(m[1]), a, first)), s.splat(m[3]))
            };
        }
        dots
    }

    /// Products of sixteen points to flat pixels; 0 where invalid.
    #[inline(always)]
    fn flat(&self, s: S, [u, v, d]: [S::V; 3]) -> S::I {
        let (u, v, zero) = (s.div(u, d), s.div(v, d), s.splat(0.0));
        let valid = s.both(s.at_least(d, zero), s.both(inside(s, u, self.last_column), inside(s, v, self.last_row)));
        // Lanes that are not valid truncate to anything; the mask drops them.
        let column = s.shift_right(s.truncate(u), self.stride_log2);
        let row = s.shift_right(s.truncate(v), self.stride_log2);
        s.keep(valid, s.add_int(s.add_int(s.mul_int(row, self.pixels_per_row), column), self.base))
    }
}

/// `0 <= t <= last`, false for NaN.
#[inline(always)]
fn inside<S: Simd>(s: S, t: S::V, last: S::V) -> S::M {
    s.both(s.at_least(t, s.splat(0.0)), s.at_least(last, t))
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Pinhole at the origin that looks along z: u = 16 + 16 x / z, v = 16 + 16 y / z.
    fn pinhole() -> Projection {
        Projection {
            matrix: [16.0, 0.0, 16.0, 0.0, 0.0, 16.0, 16.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            sum: Sum::Chain,
            width: 64,
            height: 32,
            stride_log2: 3,
            base: 100,
        }
    }

    fn one(p: &Projection, [x, y, z]: [f32; 3]) -> u32 {
        let mut out = [7];
        let any = project_points(Isa::Scalar, p, &[x], &[y], &[z], &mut out);
        assert_eq!(any, out[0] != 0);
        out[0]
    }

    #[test]
    fn pinhole_by_hand() {
        let p = pinhole();
        for (point, expected, why) in [
            ([0.0, 0.0, 1.0], 100 + 2 * 8 + 2, "the axis: u = v = 16"),
            ([-1.0, -1.0, 1.0], 100, "the first pixel: u = v = 0"),
            ([2.9375, 0.9375, 1.0], 100 + 3 * 8 + 7, "u = 63, v = 31 are the last that count"),
            ([2.94, 0.0, 1.0], 0, "u = 63.04"),
            ([0.0, 0.94, 1.0], 0, "v = 31.04"),
            ([-1.001, 0.0, 1.0], 0, "u < 0"),
            ([0.0, 0.0, -1.0], 0, "behind: u = v = 16 but d = -1"),
            ([0.0, 0.0, 0.0], 0, "0 / 0"),
            ([1.0, 1.0, 0.0], 0, "infinite"),
            ([0.0, 0.0, f32::NAN], 0, "NaN"),
            ([0.0, f32::INFINITY, 1.0], 0, "infinite v"),
        ] {
            assert_eq!(one(&p, point), expected, "{why}");
        }
    }

    #[test]
    fn flat_pixel_zero_counts_as_none() {
        let first = Projection { base: 0, ..pinhole() };
        assert_eq!(one(&first, [-1.0, -1.0, 1.0]), 0);
        assert_eq!(one(&first, [-0.5, -1.0, 1.0]), 1);
    }

    #[test]
    fn sums_round_as_they_say() {
        let mut p = pinhole();
        // 1 + 2^-12 squared is 1 + 2^-11 + 2^-24: the fused sum keeps the last term, the rounded product drops it.
        let e = 1.0 + 1.0 / 4096.0;
        p.matrix[..4].copy_from_slice(&[-1.0, 0.0, e, 0.0]);
        assert_eq!(p.dot(0, 1.0, 0.0, e), 1.0 / 2048.0 + 1.0 / 16_777_216.0, "fused");
        p.sum = Sum::Pairs;
        assert_eq!(p.dot(0, 1.0, 0.0, e), 1.0 / 2048.0, "product rounded first");
        // Pairs adds m0 x to m2 z before anything else: 2^25 - 2^25 is exactly 0, and the 1s survive.
        p.matrix[..4].copy_from_slice(&[33_554_432.0, 1.0, -33_554_432.0, 1.0]);
        assert_eq!(p.dot(0, 1.0, 1.0, 1.0), 2.0);
        p.sum = Sum::Chain;
        assert_eq!(p.dot(0, 1.0, 1.0, 1.0), 1.0, "the chain loses the first 1 in 2^25 + 1");
    }

    #[test]
    #[should_panic(expected = "one pixel per sample point")]
    fn short_output_is_refused() {
        project_points(Isa::Scalar, &pinhole(), &[0.0], &[0.0], &[1.0, 2.0], &mut [0]);
    }

    #[test]
    #[should_panic(expected = "flat pixels fit 32 bits")]
    fn overflowing_base_is_refused() {
        let p = Projection { base: u32::MAX - 30, ..pinhole() };
        project_points(Isa::Scalar, &p, &[0.0], &[0.0], &[1.0], &mut [0]);
    }

    #[test]
    #[should_panic(expected = "a multiple of the stride")]
    fn ragged_image_is_refused() {
        let p = Projection { width: 60, ..pinhole() };
        project_points(Isa::Scalar, &p, &[0.0], &[0.0], &[1.0], &mut [0]);
    }

    fn number() -> impl Strategy<Value = f32> {
        prop_oneof![
            12 => -60.0f32..60.0,
            1 => Just(0.0f32),
            1 => Just(-0.0f32),
            1 => prop::num::f32::ANY,
        ]
    }

    fn projections() -> impl Strategy<Value = Projection> {
        let plausible =
            (number(), number(), number(), -3.2f32..3.2, 20.0f32..300.0).prop_map(|(x, y, z, yaw, focal)| {
                let (s, c) = yaw.sin_cos();
                let rows = [[s, -c, 0.0, x / 50.0], [0.0, 0.0, -1.0, y / 50.0], [c, s, 0.0, z / 50.0]];
                let image = |r: usize, centre: f32| {
                    std::array::from_fn::<_, 4, _>(|k| focal * rows[r][k] + centre * rows[2][k])
                };
                [image(0, 160.0), image(1, 96.0), rows[2]].concat().try_into().unwrap()
            });
        let wild = prop::array::uniform12(number());
        (prop_oneof![3 => plausible, 1 => wild], any::<bool>(), 3u32..6, 1u32..12, 1u32..12, 0u32..1000).prop_map(
            |(matrix, pairs, stride_log2, w, h, base)| Projection {
                matrix,
                sum: if pairs { Sum::Pairs } else { Sum::Chain },
                width: w * 32,
                height: h * 32,
                stride_log2,
                base,
            },
        )
    }

    proptest! {
        #[test]
        fn pixels_are_in_range(p in projections(), x in number(), y in number(), z in number()) {
            let pixel = one(&p, [x, y, z]);
            let last = p.base + (p.width >> p.stride_log2) * (p.height >> p.stride_log2);
            prop_assert!(pixel == 0 || (p.base..last).contains(&pixel));
        }
    }

    #[test]
    fn every_isa_is_the_specification_where_most_points_hit() {
        let axis: Vec<f32> = (0..61).map(|i| -1.0 + i as f32 * 0.07).collect();
        for sum in [Sum::Chain, Sum::Pairs] {
            let p = Projection { sum, ..pinhole() };
            let mut expected = vec![0; axis.len().pow(3)];
            let mut found = expected.clone();
            project_points(Isa::Scalar, &p, &axis, &axis, &axis, &mut expected);
            for isa in Isa::available() {
                project_points(isa, &p, &axis, &axis, &axis, &mut found);
                assert_eq!(expected, found);
            }
            let hits = expected.iter().filter(|&&v| v != 0).count();
            assert!(hits * 5 > expected.len(), "{hits} of {} hit", expected.len());
        }
    }
}
