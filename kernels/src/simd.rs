//! Sixteen virtual lanes: the one vector type that kernel bodies are written over.
//!
//! A body is written once as `fn run<S: Simd>(self, s: S)` and instantiated per instruction set by [`dispatch`]. A vector
//! always has [`LANES`] lanes, whatever the register width (AVX2 uses a pair of registers, AVX-512 one), so that packed
//! weights, partial sums and tails look the same everywhere. The scalar instruction set has no vector: it runs the
//! kernel's `reference`, which is the specification.
//!
//! A file per instruction set implements [`Simd`] for its token and says which register tile suits it.

use crate::isa::Isa;
use crate::quantised::lowest;
use bytes::Form;
use half::f16;

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod bytes;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod scalar;
#[cfg(test)]
mod tests;

/// Lanes of a vector on every instruction set, and columns of a packed weight panel.
pub const LANES: usize = 16;

/// What a product computes in registers at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Rows.
    pub rows: usize,
    /// Vectors of [`LANES`] columns.
    pub panels: usize,
}

/// Work that is compiled for every number of rows that a tile can have.
pub(crate) trait TileRows<S: Simd> {
    /// Does `N` rows. Must be `#[inline(always)]`.
    fn run<const N: usize>(self, s: S);
}

/// The vector operations of one instruction set.
///
/// Implementors are zero-sized tokens that prove the instructions exist; their methods are `#[inline(always)]` so that
/// they compile inside the one `#[target_feature]` function of [`dispatch`].
pub(crate) trait Simd: Copy {
    /// Sixteen f32 lanes.
    type V: Copy;
    /// Sixteen lanes of 32-bit integers.
    type I: Copy;
    /// Sixteen lanes of 16-bit integers.
    type H: Copy;
    /// Sixteen lanes of 8-bit integers.
    type B: Copy;
    /// Sixteen truth values.
    type M: Copy;
    /// The largest register tile: as many accumulators as fit beside the weights and a broadcast.
    const TILE: Tile;
    /// Whether a part of a vector is loaded and stored as fast as a whole one.
    const MASKED: bool;

    /// Calls `body` for as many rows as a tile can have and `left`, which is not 0, allow. Returns how many those were.
    fn rows<B: TileRows<Self>>(self, left: usize, body: B) -> usize;

    /// `sums[r][j] += left[r][k] * panels[j][k]` for k ascending, each a chain of fused multiply-adds.
    ///
    /// # Safety
    /// Each pointer in `left` must be valid for reading `depth` elements, each in `panels` for `depth` times [`LANES`].
    #[inline(always)]
    unsafe fn multiply<const N: usize, const P: usize>(
        self,
        left: [*const f32; N],
        panels: [*const f32; P],
        depth: usize,
        mut sums: [[Self::V; P]; N],
    ) -> [[Self::V; P]; N] {
        for k in 0..depth {
            // SAFETY: k < depth, so the caller's promise holds.
            unsafe {
                let w = panels.map(|panel| self.load_ptr(panel.add(k * LANES)));
                for r in 0..N {
                    let a = self.splat(*left[r].add(k));
                    for j in 0..P {
                        sums[r][j] = self.mul_add(a, w[j], sums[r][j]);
                    }
                }
            }
        }
        sums
    }

    /// Panels of the largest register tile of bytes.
    const BYTE_PANELS: usize;
    /// Rows of the largest register tile of bytes.
    fn byte_rows(self) -> usize;
    /// As [`Simd::rows`], for tiles of bytes.
    fn rows_of_bytes<B: TileRows<Self>>(self, left: usize, body: B) -> usize;
    /// Whether [`Simd::multiply_bytes`] reads signed left elements 128 too large, so that sums must start as much lower.
    fn shifts_bytes(self) -> bool;
    /// `sums[r][j] += left[r][k] * panels[j][k]` modulo 2^32, exact where the operands are of the form `form`. A panel has 16
    /// columns of four weights for every four k.
    ///
    /// # Safety
    /// Each pointer in `left` must be valid for reading `depth` bytes, a multiple of 4, each in `panels` for [`LANES`] times
    /// as many.
    unsafe fn multiply_bytes<const N: usize, const P: usize>(
        self,
        form: Form,
        left: [*const i8; N],
        panels: [*const i8; P],
        depth: usize,
        sums: [[Self::I; P]; N],
    ) -> [[Self::I; P]; N];

    /// All lanes `x`.
    fn splat(self, x: f32) -> Self::V;
    /// Reads 16 lanes from `p`.
    ///
    /// # Safety
    /// `p` must be valid for reading 16 consecutive f32; no alignment is needed.
    unsafe fn load_ptr(self, p: *const f32) -> Self::V;
    /// Writes 16 lanes to `p`.
    ///
    /// # Safety
    /// `p` must be valid for writing 16 consecutive f32; no alignment is needed.
    unsafe fn store_ptr(self, p: *mut f32, v: Self::V);
    /// Widens 16 half-precision values, exactly.
    fn widen(self, x: &[f16; LANES]) -> Self::V;
    /// `a + b`.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a - b`.
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b`.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a / b`, correctly rounded.
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `if a > b { a } else { b }` in every lane: `b` where either is NaN or both are zero.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// `if a < b { a } else { b }` in every lane: `b` where either is NaN or both are zero.
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    /// Nearest integer, ties to even.
    fn round(self, a: Self::V) -> Self::V;
    /// 2 to the power `n`, for integral lanes from -126 to 127.
    fn exp2_int(self, n: Self::V) -> Self::V;

    /// All integer lanes `x`.
    fn splat_int(self, x: u32) -> Self::I;
    /// Whole part of each lane, for lanes from 0 up to 2^31; any integer for others.
    fn truncate(self, a: Self::V) -> Self::I;
    /// `a >> bits`, for `bits` below 32, with zeros shifted in.
    fn shift_right(self, a: Self::I, bits: u32) -> Self::I;
    /// `a + b` modulo 2^32.
    fn add_int(self, a: Self::I, b: Self::I) -> Self::I;
    /// `a * b` modulo 2^32.
    fn mul_int(self, a: Self::I, b: Self::I) -> Self::I;
    /// `a` where `mask` holds, else 0.
    fn keep(self, mask: Self::M, a: Self::I) -> Self::I;
    /// Reads 16 integer lanes from `p`.
    ///
    /// # Safety
    /// `p` must be valid for reading 16 consecutive i32; no alignment is needed.
    unsafe fn load_int_ptr(self, p: *const i32) -> Self::I;
    /// Writes 16 integer lanes to `p`.
    ///
    /// # Safety
    /// `p` must be valid for writing 16 consecutive i32; no alignment is needed.
    unsafe fn store_int_ptr(self, p: *mut i32, v: Self::I);
    /// `a >> bits`, for `bits` below 32, with copies of the sign shifted in.
    fn shift_right_signed(self, a: Self::I, bits: u32) -> Self::I;
    /// The larger of signed integers.
    fn max_int(self, a: Self::I, b: Self::I) -> Self::I;
    /// `a * b` for lanes from -2^15 up to 2^15 - 1; any integer for others. Fast where `b` is a loop's constant.
    fn mul_short(self, a: Self::I, b: Self::I) -> Self::I;
    /// [`crate::quantised::requantise`] of signed integers.
    fn requantise(self, sum: Self::I, multiplier: Self::I) -> Self::I;
    /// The nearest f32 to each signed integer, ties to even.
    fn to_float(self, a: Self::I) -> Self::V;
    /// The nearest integer, ties to even, for lanes from -2^31 up to 2^31 - 128; any integer for others.
    fn nearest(self, a: Self::V) -> Self::I;

    /// Reads 16 bytes from `p`.
    ///
    /// # Safety
    /// `p` must be valid for reading 16 consecutive i8; no alignment is needed.
    unsafe fn load_bytes_ptr(self, p: *const i8) -> Self::B;
    /// Writes 16 bytes to `p`.
    ///
    /// # Safety
    /// `p` must be valid for writing 16 consecutive i8; no alignment is needed.
    unsafe fn store_bytes_ptr(self, p: *mut i8, v: Self::B);
    /// All byte lanes `x`.
    fn splat_bytes(self, x: i8) -> Self::B;
    /// The larger of signed bytes.
    fn max_bytes(self, a: Self::B, b: Self::B) -> Self::B;
    /// Signed bytes as 32-bit integers.
    fn bytes_to_int(self, a: Self::B) -> Self::I;
    /// Signed bytes as 16-bit integers.
    fn bytes_to_short(self, a: Self::B) -> Self::H;
    /// `a + b` modulo 2^16.
    fn add_short(self, a: Self::H, b: Self::H) -> Self::H;
    /// Signed 16-bit integers as 32-bit integers.
    fn short_to_int(self, a: Self::H) -> Self::I;
    /// Signed integers clamped to -128..=127.
    fn narrow(self, a: Self::I) -> Self::B;
    /// `a >= b` in every lane: false where either is NaN.
    fn at_least(self, a: Self::V, b: Self::V) -> Self::M;
    /// `a > b` in every lane: false where either is NaN.
    fn exceeds(self, a: Self::V, b: Self::V) -> Self::M;
    /// Writes the transpose of 16 rows of 16, which are `stride` apart, to `to`, row after row.
    ///
    /// # Safety
    /// `from` must be valid for reading 16 values at every multiple of `stride` below 16 times that, `to` for writing 256.
    unsafe fn transpose_ptr(self, from: *const f32, stride: usize, to: *mut f32);
    /// Where both hold.
    fn both(self, a: Self::M, b: Self::M) -> Self::M;

    /// Names the cache line of `p` to the first-level cache. Any address will do; nothing is read.
    fn prefetch<T>(self, p: *const T);

    /// Reads 16 lanes.
    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> Self::V {
        // SAFETY: the array holds exactly 16 f32.
        unsafe { self.load_ptr(x.as_ptr()) }
    }
    /// Writes 16 lanes.
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES], v: Self::V) {
        // SAFETY: the array holds exactly 16 f32.
        unsafe { self.store_ptr(x.as_mut_ptr(), v) }
    }
    /// Reads the first lanes from up to 16 values; the others are 0.
    #[inline(always)]
    fn load_part(self, x: &[f32]) -> Self::V {
        match x.first_chunk() {
            Some(x) => self.load(x),
            None => {
                let mut lanes = [0.0; LANES];
                lanes[..x.len()].copy_from_slice(x);
                self.load(&lanes)
            }
        }
    }
    /// Writes the first lanes into up to 16 values.
    #[inline(always)]
    fn store_part(self, x: &mut [f32], v: Self::V) {
        match x.first_chunk_mut() {
            Some(x) => self.store(x, v),
            None => {
                let mut lanes = [0.0; LANES];
                self.store(&mut lanes, v);
                let n = x.len();
                x.copy_from_slice(&lanes[..n]);
            }
        }
    }
    /// Reads 16 integer lanes.
    #[inline(always)]
    fn load_int(self, x: &[i32; LANES]) -> Self::I {
        // SAFETY: the array holds exactly 16 i32.
        unsafe { self.load_int_ptr(x.as_ptr()) }
    }
    /// Writes 16 integer lanes.
    #[inline(always)]
    fn store_int(self, x: &mut [u32; LANES], v: Self::I) {
        // SAFETY: the array holds exactly 16 integers of 32 bits.
        unsafe { self.store_int_ptr(x.as_mut_ptr().cast(), v) }
    }
    /// Reads the first integer lanes from up to 16 values; the others are 0.
    #[inline(always)]
    fn load_int_part(self, x: &[i32]) -> Self::I {
        match x.first_chunk() {
            Some(x) => self.load_int(x),
            None => {
                let mut lanes = [0; LANES];
                lanes[..x.len()].copy_from_slice(x);
                self.load_int(&lanes)
            }
        }
    }
    /// Writes the first integer lanes into up to 16 values.
    #[inline(always)]
    fn store_int_part(self, x: &mut [i32], v: Self::I) {
        match x.first_chunk_mut::<LANES>() {
            // SAFETY: the array holds exactly 16 i32.
            Some(x) => unsafe { self.store_int_ptr(x.as_mut_ptr(), v) },
            None => {
                let n = x.len();
                x.copy_from_slice(&self.int_lanes(v)[..n]);
            }
        }
    }
    /// The integer lanes as values.
    #[inline(always)]
    fn int_lanes(self, v: Self::I) -> [i32; LANES] {
        let mut lanes = [0; LANES];
        // SAFETY: the array holds exactly 16 i32.
        unsafe { self.store_int_ptr(lanes.as_mut_ptr(), v) }
        lanes
    }
    /// Reads 16 bytes.
    #[inline(always)]
    fn load_bytes(self, x: &[i8; LANES]) -> Self::B {
        // SAFETY: the array holds exactly 16 i8.
        unsafe { self.load_bytes_ptr(x.as_ptr()) }
    }
    /// Writes 16 bytes.
    #[inline(always)]
    fn store_bytes(self, x: &mut [i8; LANES], v: Self::B) {
        // SAFETY: the array holds exactly 16 i8.
        unsafe { self.store_bytes_ptr(x.as_mut_ptr(), v) }
    }
    /// Reads the first lanes from up to 16 bytes; the others are 0.
    #[inline(always)]
    fn load_bytes_part(self, x: &[i8]) -> Self::B {
        match x.first_chunk() {
            Some(x) => self.load_bytes(x),
            None => {
                let mut lanes = [0; LANES];
                lanes[..x.len()].copy_from_slice(x);
                self.load_bytes(&lanes)
            }
        }
    }
    /// Writes the first lanes into up to 16 bytes.
    #[inline(always)]
    fn store_bytes_part(self, x: &mut [i8], v: Self::B) {
        match x.first_chunk_mut() {
            Some(x) => self.store_bytes(x, v),
            None => {
                let mut lanes = [0; LANES];
                self.store_bytes(&mut lanes, v);
                let n = x.len();
                x.copy_from_slice(&lanes[..n]);
            }
        }
    }
    /// [`crate::quantised::clamp`] of signed integers.
    #[inline(always)]
    fn quantised(self, a: Self::I, relu: bool) -> Self::B {
        self.max_bytes(self.narrow(a), self.splat_bytes(lowest(relu)))
    }
    /// `if x < 0 { 0 } else { x }`: NaN and -0 pass.
    #[inline(always)]
    fn relu(self, x: Self::V) -> Self::V {
        self.max(self.splat(0.0), x)
    }
    /// The lanes as values.
    #[inline(always)]
    fn lanes(self, v: Self::V) -> [f32; LANES] {
        let mut lanes = [0.0; LANES];
        self.store(&mut lanes, v);
        lanes
    }
}

/// ReLU of the specification: `if x < 0 { 0 } else { x }`, so that NaN stays visible.
#[inline(always)]
pub fn relu(x: f32) -> f32 {
    if x < 0.0 { 0.0 } else { x }
}

/// Sum of 16 lanes by one fixed tree: halves, quarters, pairs.
#[inline(always)]
pub(crate) fn tree_sum(mut x: [f32; LANES]) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            x[i] += x[i + half];
        }
    }
    x[0]
}

/// One kernel call with its arguments: the specification, and the body that vector instruction sets share.
pub(crate) trait Kernel: Sized {
    /// What the call returns.
    type Output;
    /// The specification: plain loops in the order of the bit contract. Must be `#[inline(always)]`, like everything in
    /// it that multiplies and adds; see [`scalar::run`].
    fn reference(self) -> Self::Output;
    /// The same bits with vectors. Must be `#[inline(always)]`.
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

/// Runs `kernel` on `isa`: the one door to every body.
#[inline]
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    match isa {
        Isa::Scalar => scalar::run(kernel),
        Isa::Avx2(token) => token.run(kernel),
        Isa::Avx512(token) => token.run(kernel),
        Isa::Neon(token) => token.run(kernel),
    }
}
