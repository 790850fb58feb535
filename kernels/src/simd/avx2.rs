//! AVX2 + FMA + F16C: a vector is a pair of 8-lane registers.

use super::bytes::{self, Form};
use super::{Kernel, LANES, Simd, Tile, TileRows};
use crate::isa::Avx2;
use core::arch::x86_64::*;
use half::f16;

/// Instantiates `kernel`'s body with the instructions enabled.
///
/// # Safety
/// The CPU must have AVX2, FMA and F16C, which an [`Avx2`] token proves.
#[target_feature(enable = "avx2,fma,f16c")]
pub(crate) unsafe fn run<K: Kernel>(token: Avx2, kernel: K) -> K::Output {
    kernel.run(token)
}

/// Applies a lane-wise intrinsic to both halves.
macro_rules! halves {
    ($op:ident($($x:expr),*)) => {
        // SAFETY: the token `self` proves that the CPU has AVX2 and FMA.
        unsafe { [$op($($x[0]),*), $op($($x[1]),*)] }
    };
}

// What takes more than an instruction or two is a function of its own: a closure has no instructions enabled, and what it
// calls may stay a call.

/// The nearest integers, ties to even.
#[inline]
#[target_feature(enable = "avx2")]
fn round(a: __m256) -> __m256 {
    _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a)
}

/// Where `a >= b`.
#[inline]
#[target_feature(enable = "avx2")]
fn at_least(a: __m256, b: __m256) -> __m256 {
    _mm256_cmp_ps::<_CMP_GE_OQ>(a, b)
}

/// Where `a > b`.
#[inline]
#[target_feature(enable = "avx2")]
fn exceeds(a: __m256, b: __m256) -> __m256 {
    _mm256_cmp_ps::<_CMP_GT_OQ>(a, b)
}

/// Writes the transpose of 8 rows of 8, `stride` apart, to rows 16 apart.
///
/// # Safety
/// `from` must be valid for reading 8 values at every multiple of `stride` below 8 times that, `to` for writing 8 at every
/// multiple of 16 below 128.
#[inline]
#[target_feature(enable = "avx2")]
unsafe fn transpose_eight(from: *const f32, stride: usize, to: *mut f32) {
    // Four columns of the rows r and r + 4, so that what is left goes on within halves.
    let four = |r: usize, column: usize| {
        // SAFETY: r + 4 < 8 and column + 4 <= 8, which the caller promises to be readable.
        unsafe {
            let low = _mm_loadu_ps(from.add(r * stride + column));
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), _mm_loadu_ps(from.add((r + 4) * stride + column)))
        }
    };
    for column in [0, 4] {
        let rows = [four(0, column), four(1, column), four(2, column), four(3, column)];
        let low = [_mm256_unpacklo_ps(rows[0], rows[1]), _mm256_unpacklo_ps(rows[2], rows[3])];
        let high = [_mm256_unpackhi_ps(rows[0], rows[1]), _mm256_unpackhi_ps(rows[2], rows[3])];
        let turned = [
            _mm256_shuffle_ps::<0b01_00_01_00>(low[0], low[1]),
            _mm256_shuffle_ps::<0b11_10_11_10>(low[0], low[1]),
            _mm256_shuffle_ps::<0b01_00_01_00>(high[0], high[1]),
            _mm256_shuffle_ps::<0b11_10_11_10>(high[0], high[1]),
        ];
        for (i, turned) in turned.into_iter().enumerate() {
            // SAFETY: column + i < 8, and the caller promises room for 8 rows.
            unsafe { _mm256_storeu_ps(to.add((column + i) * LANES), turned) }
        }
    }
}

/// [`Simd::transpose_ptr`].
///
/// # Safety
/// As for that.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) unsafe fn transpose(from: *const f32, stride: usize, to: *mut f32) {
    for [row, column] in [[0, 0], [0, 8], [8, 0], [8, 8]] {
        // SAFETY: a quarter of what the caller promises.
        unsafe { transpose_eight(from.add(row * stride + column), stride, to.add(column * LANES + row)) }
    }
}

/// `a` where the mask holds, else 0.
#[inline]
#[target_feature(enable = "avx2")]
fn keep(mask: __m256, a: __m256i) -> __m256i {
    _mm256_and_si256(_mm256_castps_si256(mask), a)
}

/// 2 to the power of each lane.
#[inline]
#[target_feature(enable = "avx2")]
fn exp2_int(n: __m256) -> __m256 {
    let biased = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
    _mm256_castsi256_ps(_mm256_slli_epi32::<23>(biased))
}

/// [`crate::quantised::requantise`], of products of 64 bits of the even lanes, and of the odd ones.
#[inline]
#[target_feature(enable = "avx2")]
fn requantise(sum: __m256i, multiplier: __m256i) -> __m256i {
    let half = _mm256_set1_epi64x(1 << 31);
    let odd = _mm256_mul_epi32(_mm256_srli_epi64::<32>(sum), _mm256_srli_epi64::<32>(multiplier));
    let even = _mm256_srli_epi64::<32>(_mm256_add_epi64(_mm256_mul_epi32(sum, multiplier), half));
    _mm256_blend_epi32::<0b1010_1010>(even, _mm256_add_epi64(odd, half))
}

/// `a * b` of lanes that fit into 16 bits: a sum of two products, of the halves of a lane. Without the sign in `b`'s upper
/// half the second is 0.
#[inline]
#[target_feature(enable = "avx2")]
fn mul_short(a: __m256i, b: __m256i) -> __m256i {
    _mm256_madd_epi16(a, _mm256_and_si256(b, _mm256_set1_epi32(0xffff)))
}

impl Simd for Avx2 {
    type V = [__m256; 2];
    type I = [__m256i; 2];
    type M = [__m256; 2];
    type H = __m256i;
    type B = __m128i;
    // 12 accumulators of 8 lanes, 2 registers of weights and broadcasts, the most that 16 registers hold.
    const TILE: Tile = Tile { rows: 6, panels: 1 };
    const MASKED: bool = false;

    #[inline(always)]
    fn rows<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        match left {
            6.. => body.run::<6>(self),
            5 => body.run::<5>(self),
            4 => body.run::<4>(self),
            3 => body.run::<3>(self),
            2 => body.run::<2>(self),
            _ => body.run::<1>(self),
        }
        left.min(6)
    }

    const BYTE_PANELS: usize = 1;
    #[inline(always)]
    fn byte_rows(self) -> usize {
        bytes::avx2::tile_rows(self)
    }
    #[inline(always)]
    fn rows_of_bytes<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        bytes::avx2::rows(self, left, body)
    }
    #[inline(always)]
    fn shifts_bytes(self) -> bool {
        self.vnni().is_some()
    }
    #[inline(always)]
    unsafe fn multiply_bytes<const N: usize, const P: usize>(
        self,
        form: Form,
        left: [*const i8; N],
        panels: [*const i8; P],
        depth: usize,
        sums: [[Self::I; P]; N],
    ) -> [[Self::I; P]; N] {
        // SAFETY: the caller's promise is passed on.
        unsafe { bytes::avx2::multiply(self, form, left, panels, depth, sums) }
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { [_mm256_set1_ps(x); 2] }
    }
    #[inline(always)]
    unsafe fn load_ptr(self, p: *const f32) -> Self::V {
        // SAFETY: the caller promises 16 readable f32 at `p`; the token proves AVX2.
        unsafe { [_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))] }
    }
    #[inline(always)]
    unsafe fn store_ptr(self, p: *mut f32, v: Self::V) {
        // SAFETY: the caller promises 16 writable f32 at `p`; the token proves AVX2.
        unsafe {
            _mm256_storeu_ps(p, v[0]);
            _mm256_storeu_ps(p.add(8), v[1]);
        }
    }
    #[inline(always)]
    fn widen(self, x: &[f16; LANES]) -> Self::V {
        let p = x.as_ptr().cast::<__m128i>();
        // SAFETY: the array is 32 bytes, read as two unaligned 16-byte halves; the token proves F16C.
        unsafe { [_mm256_cvtph_ps(_mm_loadu_si128(p)), _mm256_cvtph_ps(_mm_loadu_si128(p.add(1)))] }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_add_ps(a, b))
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_sub_ps(a, b))
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_mul_ps(a, b))
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_div_ps(a, b))
    }
    #[inline(always)]
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        halves!(_mm256_fmadd_ps(a, b, c))
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_max_ps(a, b))
    }
    #[inline(always)]
    fn min(self, a: Self::V, b: Self::V) -> Self::V {
        halves!(_mm256_min_ps(a, b))
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        halves!(round(a))
    }
    #[inline(always)]
    fn exp2_int(self, n: Self::V) -> Self::V {
        halves!(exp2_int(n))
    }
    #[inline(always)]
    fn splat_int(self, x: u32) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { [_mm256_set1_epi32(x.cast_signed()); 2] }
    }
    #[inline(always)]
    fn truncate(self, a: Self::V) -> Self::I {
        halves!(_mm256_cvttps_epi32(a))
    }
    #[inline(always)]
    fn shift_right(self, a: Self::I, bits: u32) -> Self::I {
        // SAFETY: x86-64 always has SSE2.
        let bits = unsafe { [_mm_cvtsi32_si128(bits.cast_signed()); 2] };
        halves!(_mm256_srl_epi32(a, bits))
    }
    #[inline(always)]
    fn add_int(self, a: Self::I, b: Self::I) -> Self::I {
        halves!(_mm256_add_epi32(a, b))
    }
    #[inline(always)]
    fn mul_int(self, a: Self::I, b: Self::I) -> Self::I {
        halves!(_mm256_mullo_epi32(a, b))
    }
    #[inline(always)]
    fn keep(self, mask: Self::M, a: Self::I) -> Self::I {
        halves!(keep(mask, a))
    }
    #[inline(always)]
    unsafe fn load_int_ptr(self, p: *const i32) -> Self::I {
        // SAFETY: the caller promises 16 readable i32 at `p`; the token proves AVX2.
        unsafe { [_mm256_loadu_si256(p.cast()), _mm256_loadu_si256(p.add(8).cast())] }
    }
    #[inline(always)]
    unsafe fn store_int_ptr(self, p: *mut i32, v: Self::I) {
        // SAFETY: the caller promises 16 writable i32 at `p`; the token proves AVX2.
        unsafe {
            _mm256_storeu_si256(p.cast(), v[0]);
            _mm256_storeu_si256(p.add(8).cast(), v[1]);
        }
    }
    #[inline(always)]
    fn shift_right_signed(self, a: Self::I, bits: u32) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe {
            let bits = _mm_cvtsi32_si128(bits.cast_signed());
            [_mm256_sra_epi32(a[0], bits), _mm256_sra_epi32(a[1], bits)]
        }
    }
    #[inline(always)]
    fn max_int(self, a: Self::I, b: Self::I) -> Self::I {
        halves!(_mm256_max_epi32(a, b))
    }
    #[inline(always)]
    fn mul_short(self, a: Self::I, b: Self::I) -> Self::I {
        halves!(mul_short(a, b))
    }
    #[inline(always)]
    fn requantise(self, sum: Self::I, multiplier: Self::I) -> Self::I {
        halves!(requantise(sum, multiplier))
    }
    #[inline(always)]
    fn to_float(self, a: Self::I) -> Self::V {
        halves!(_mm256_cvtepi32_ps(a))
    }
    #[inline(always)]
    fn nearest(self, a: Self::V) -> Self::I {
        halves!(_mm256_cvtps_epi32(a))
    }
    #[inline(always)]
    unsafe fn load_bytes_ptr(self, p: *const i8) -> Self::B {
        // SAFETY: the caller promises 16 readable bytes at `p`; x86-64 always has SSE2.
        unsafe { _mm_loadu_si128(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store_bytes_ptr(self, p: *mut i8, v: Self::B) {
        // SAFETY: the caller promises 16 writable bytes at `p`; x86-64 always has SSE2.
        unsafe { _mm_storeu_si128(p.cast(), v) }
    }
    #[inline(always)]
    fn splat_bytes(self, x: i8) -> Self::B {
        // SAFETY: x86-64 always has SSE2.
        unsafe { _mm_set1_epi8(x) }
    }
    #[inline(always)]
    fn max_bytes(self, a: Self::B, b: Self::B) -> Self::B {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { _mm_max_epi8(a, b) }
    }
    #[inline(always)]
    fn bytes_to_int(self, a: Self::B) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { [_mm256_cvtepi8_epi32(a), _mm256_cvtepi8_epi32(_mm_unpackhi_epi64(a, a))] }
    }
    #[inline(always)]
    fn bytes_to_short(self, a: Self::B) -> Self::H {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { _mm256_cvtepi8_epi16(a) }
    }
    #[inline(always)]
    fn add_short(self, a: Self::H, b: Self::H) -> Self::H {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe { _mm256_add_epi16(a, b) }
    }
    #[inline(always)]
    fn short_to_int(self, a: Self::H) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe {
            let upper = _mm256_extracti128_si256::<1>(a);
            [_mm256_cvtepi16_epi32(_mm256_castsi256_si128(a)), _mm256_cvtepi16_epi32(upper)]
        }
    }
    #[inline(always)]
    fn narrow(self, a: Self::I) -> Self::B {
        // SAFETY: the token `self` proves that the CPU has AVX2.
        unsafe {
            // Each 128 bits are packed by themselves: the quarters lie as 0, 2, 1, 3.
            let short = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi32(a[0], a[1]));
            _mm_packs_epi16(_mm256_castsi256_si128(short), _mm256_extracti128_si256::<1>(short))
        }
    }
    #[inline(always)]
    fn at_least(self, a: Self::V, b: Self::V) -> Self::M {
        halves!(at_least(a, b))
    }
    #[inline(always)]
    fn exceeds(self, a: Self::V, b: Self::V) -> Self::M {
        halves!(exceeds(a, b))
    }
    #[inline(always)]
    unsafe fn transpose_ptr(self, from: *const f32, stride: usize, to: *mut f32) {
        // SAFETY: the caller's promise is passed on; the token proves AVX2.
        unsafe { transpose(from, stride, to) }
    }
    #[inline(always)]
    fn both(self, a: Self::M, b: Self::M) -> Self::M {
        halves!(_mm256_and_ps(a, b))
    }
    #[inline(always)]
    fn prefetch<T>(self, p: *const T) {
        // SAFETY: a prefetch is a hint that never faults; x86-64 always has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }
}
