//! AVX-512 F, VL, DQ and BW: a vector is one 16-lane register, and a part of one is a mask.

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
        // SAFETY: the token `self` proves that the CPU has AVX-512 F.
        unsafe { $($op)* }
    };
}

impl Simd for Avx512 {
    type V = __m512;
    type I = __m512i;
    type M = __mmask16;
    // 24 accumulators and 2 registers of weights in 32 registers; each broadcast serves two multiply-adds, so that loads do
    // not limit the speed.
    const TILE: Tile = Tile { rows: 12, panels: 2 };
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
    fn store_int(self, x: &mut [u32; LANES], v: Self::I) {
        // SAFETY: the array is 64 bytes, written unaligned; the token proves AVX-512 F.
        unsafe { _mm512_storeu_si512(x.as_mut_ptr().cast(), v) }
    }
    #[inline(always)]
    fn at_least(self, a: Self::V, b: Self::V) -> Self::M {
        lanewise!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, b))
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
}
