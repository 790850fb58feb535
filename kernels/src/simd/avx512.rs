//! AVX-512 F, VL, DQ and BW: a vector is one 16-lane register, and a part of one is a mask.

use super::bytes::{self, Form};
use super::{Kernel, LANES, Simd, Tile, TileRows};
use crate::isa::Avx512;
use core::arch::x86_64::*;
use half::f16;

/// Instantiates `kernel`'s body with the instructions enabled.
///
/// # Safety
/// The CPU must have AVX-512 F, VL, DQ and BW, AVX2, FMA and F16C, which an [`Avx512`] token proves.
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma,f16c")]
pub(crate) unsafe fn run<K: Kernel>(token: Avx512, kernel: K) -> K::Output {
    kernel.run(token)
}

/// The mask of the first `n` lanes, at most all of them.
#[inline(always)]
fn first(n: usize) -> __mmask16 {
    ((1u32 << n.min(LANES)) - 1) as __mmask16
}

/// Calls a lane-wise intrinsic.
macro_rules! lanewise {
    ($($op:tt)*) => {
        // SAFETY: the token `self` proves that the CPU has AVX-512 F, VL, DQ and BW.
        unsafe { $($op)* }
    };
}

impl Simd for Avx512 {
    type V = __m512;
    type I = __m512i;
    type M = __mmask16;
    type H = __m256i;
    type B = __m128i;
    // 12 accumulators, which keep two multipliers of four cycles busy with some to spare. With two panels there would be fewer
    // loads, but the sums' ends and the rows' addresses no longer fit into registers, and sums would have to wait twice as
    // often: where both were measured, networks took a twentieth longer.
    const TILE: Tile = Tile { rows: 12, panels: 1 };
    const MASKED: bool = true;

    #[inline(always)]
    fn rows<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        match left {
            12.. => (body.run::<12>(self), 12).1,
            6.. => (body.run::<6>(self), 6).1,
            3.. => (body.run::<3>(self), 3).1,
            _ => (body.run::<1>(self), 1).1,
        }
    }

    const BYTE_PANELS: usize = bytes::avx512::TILE_PANELS;
    #[inline(always)]
    fn byte_rows(self) -> usize {
        bytes::avx512::TILE_ROWS
    }
    #[inline(always)]
    fn rows_of_bytes<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        bytes::avx512::rows(self, left, body)
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
        unsafe { bytes::avx512::multiply(self, form, left, panels, depth, sums) }
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        lanewise!(_mm512_set1_ps(x))
    }
    #[inline(always)]
    unsafe fn load_ptr(self, p: *const f32) -> Self::V {
        // SAFETY: the caller promises 16 readable f32 at `p`; the token proves AVX-512 F.
        unsafe { _mm512_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn store_ptr(self, p: *mut f32, v: Self::V) {
        // SAFETY: the caller promises 16 writable f32 at `p`; the token proves AVX-512 F.
        unsafe { _mm512_storeu_ps(p, v) }
    }
    #[inline(always)]
    fn widen(self, x: &[f16; LANES]) -> Self::V {
        // SAFETY: the array is 32 bytes, read as one unaligned piece; the token proves AVX-512 F.
        unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(x.as_ptr().cast())) }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_add_ps(a, b))
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_sub_ps(a, b))
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_mul_ps(a, b))
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_div_ps(a, b))
    }
    #[inline(always)]
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        lanewise!(_mm512_fmadd_ps(a, b, c))
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_max_ps(a, b))
    }
    #[inline(always)]
    fn min(self, a: Self::V, b: Self::V) -> Self::V {
        lanewise!(_mm512_min_ps(a, b))
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        // The upper half of the immediate, the number of fraction bits to keep, is 0.
        lanewise!(_mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a))
    }
    #[inline(always)]
    fn exp2_int(self, n: Self::V) -> Self::V {
        lanewise!({
            let biased = _mm512_add_epi32(_mm512_cvtps_epi32(n), _mm512_set1_epi32(127));
            _mm512_castsi512_ps(_mm512_slli_epi32::<23>(biased))
        })
    }
    #[inline(always)]
    fn splat_int(self, x: u32) -> Self::I {
        lanewise!(_mm512_set1_epi32(x.cast_signed()))
    }
    #[inline(always)]
    fn truncate(self, a: Self::V) -> Self::I {
        lanewise!(_mm512_cvttps_epi32(a))
    }
    #[inline(always)]
    fn shift_right(self, a: Self::I, bits: u32) -> Self::I {
        lanewise!(_mm512_srl_epi32(a, _mm_cvtsi32_si128(bits.cast_signed())))
    }
    #[inline(always)]
    fn add_int(self, a: Self::I, b: Self::I) -> Self::I {
        lanewise!(_mm512_add_epi32(a, b))
    }
    #[inline(always)]
    fn mul_int(self, a: Self::I, b: Self::I) -> Self::I {
        lanewise!(_mm512_mullo_epi32(a, b))
    }
    #[inline(always)]
    fn keep(self, mask: Self::M, a: Self::I) -> Self::I {
        lanewise!(_mm512_maskz_mov_epi32(mask, a))
    }
    #[inline(always)]
    unsafe fn load_int_ptr(self, p: *const i32) -> Self::I {
        // SAFETY: the caller promises 16 readable i32 at `p`; the token proves AVX-512 F.
        unsafe { _mm512_loadu_si512(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store_int_ptr(self, p: *mut i32, v: Self::I) {
        // SAFETY: the caller promises 16 writable i32 at `p`; the token proves AVX-512 F.
        unsafe { _mm512_storeu_si512(p.cast(), v) }
    }
    #[inline(always)]
    fn shift_right_signed(self, a: Self::I, bits: u32) -> Self::I {
        lanewise!(_mm512_sra_epi32(a, _mm_cvtsi32_si128(bits.cast_signed())))
    }
    #[inline(always)]
    fn max_int(self, a: Self::I, b: Self::I) -> Self::I {
        lanewise!(_mm512_max_epi32(a, b))
    }
    #[inline(always)]
    fn mul_short(self, a: Self::I, b: Self::I) -> Self::I {
        // A sum of two products, of the halves of a lane. Without the sign in `b`'s upper half the second is 0.
        lanewise!(_mm512_madd_epi16(a, _mm512_and_si512(b, _mm512_set1_epi32(0xffff))))
    }
    #[inline(always)]
    fn requantise(self, sum: Self::I, multiplier: Self::I) -> Self::I {
        // Products of 64 bits of the even lanes, and of the odd ones.
        lanewise!({
            let half = _mm512_set1_epi64(1 << 31);
            let odd = _mm512_mul_epi32(_mm512_srli_epi64::<32>(sum), _mm512_srli_epi64::<32>(multiplier));
            let even = _mm512_srli_epi64::<32>(_mm512_add_epi64(_mm512_mul_epi32(sum, multiplier), half));
            _mm512_mask_blend_epi32(0b1010_1010_1010_1010, even, _mm512_add_epi64(odd, half))
        })
    }
    #[inline(always)]
    fn to_float(self, a: Self::I) -> Self::V {
        lanewise!(_mm512_cvtepi32_ps(a))
    }
    #[inline(always)]
    fn nearest(self, a: Self::V) -> Self::I {
        lanewise!(_mm512_cvtps_epi32(a))
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
        lanewise!(_mm_set1_epi8(x))
    }
    #[inline(always)]
    fn max_bytes(self, a: Self::B, b: Self::B) -> Self::B {
        lanewise!(_mm_max_epi8(a, b))
    }
    #[inline(always)]
    fn bytes_to_int(self, a: Self::B) -> Self::I {
        lanewise!(_mm512_cvtepi8_epi32(a))
    }
    #[inline(always)]
    fn bytes_to_short(self, a: Self::B) -> Self::H {
        lanewise!(_mm256_cvtepi8_epi16(a))
    }
    #[inline(always)]
    fn add_short(self, a: Self::H, b: Self::H) -> Self::H {
        lanewise!(_mm256_add_epi16(a, b))
    }
    #[inline(always)]
    fn short_to_int(self, a: Self::H) -> Self::I {
        lanewise!(_mm512_cvtepi16_epi32(a))
    }
    #[inline(always)]
    fn narrow(self, a: Self::I) -> Self::B {
        lanewise!(_mm512_cvtsepi32_epi8(a))
    }
    #[inline(always)]
    fn at_least(self, a: Self::V, b: Self::V) -> Self::M {
        lanewise!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, b))
    }
    #[inline(always)]
    fn exceeds(self, a: Self::V, b: Self::V) -> Self::M {
        lanewise!(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, b))
    }
    #[inline(always)]
    unsafe fn transpose_ptr(self, from: *const f32, stride: usize, to: *mut f32) {
        // SAFETY: the caller's promise is passed on; the token proves AVX2.
        unsafe { super::avx2::transpose(from, stride, to) }
    }
    #[inline(always)]
    fn both(self, a: Self::M, b: Self::M) -> Self::M {
        a & b
    }
    #[inline(always)]
    fn prefetch<T>(self, p: *const T) {
        // SAFETY: a prefetch is a hint that never faults; x86-64 always has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(p.cast()) }
    }

    #[inline(always)]
    fn load_part(self, x: &[f32]) -> Self::V {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not read; the token proves AVX-512 F.
        unsafe { _mm512_maskz_loadu_ps(first(x.len()), x.as_ptr()) }
    }
    #[inline(always)]
    fn store_part(self, x: &mut [f32], v: Self::V) {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not written; the token proves AVX-512 F.
        unsafe { _mm512_mask_storeu_ps(x.as_mut_ptr(), first(x.len()), v) }
    }
    #[inline(always)]
    fn load_bytes_part(self, x: &[i8]) -> Self::B {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not read; the token proves AVX-512 BW and VL.
        unsafe { _mm_maskz_loadu_epi8(first(x.len()), x.as_ptr()) }
    }
    #[inline(always)]
    fn store_bytes_part(self, x: &mut [i8], v: Self::B) {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not written; the token proves AVX-512 BW and VL.
        unsafe { _mm_mask_storeu_epi8(x.as_mut_ptr(), first(x.len()), v) }
    }
    #[inline(always)]
    fn store_int_part(self, x: &mut [i32], v: Self::I) {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not written; the token proves AVX-512 F.
        unsafe { _mm512_mask_storeu_epi32(x.as_mut_ptr(), first(x.len()), v) }
    }
    #[inline(always)]
    fn load_int_part(self, x: &[i32]) -> Self::I {
        // SAFETY: lanes beyond the slice are masked, and masked lanes are not read; the token proves AVX-512 F.
        unsafe { _mm512_maskz_loadu_epi32(first(x.len()), x.as_ptr()) }
    }
}
