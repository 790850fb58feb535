//! 512 bits: a group of a panel is one register. See [`super::avx2`] for the forms.

use super::{Form, GROUP, STEP};
use crate::isa::Avx512;
use crate::simd::{LANES, TileRows};
use core::arch::asm;
use core::arch::x86_64::*;

/// Rows of a tile of two panels: sixteen sums keep two multipliers of five cycles busy. With more, the ends of the sums and
/// the rows' addresses no longer fit into registers, which costs a quarter of the time where sums have few products.
pub(crate) const TILE_ROWS: usize = 8;
/// A broadcast serves two multiplications, or loads would limit the speed.
pub(crate) const TILE_PANELS: usize = 2;

#[inline(always)]
pub(crate) fn rows<B: TileRows<Avx512>>(token: Avx512, left: usize, body: B) -> usize {
    match left {
        8.. => (body.run::<8>(token), 8).1,
        4.. => (body.run::<4>(token), 4).1,
        2.. => (body.run::<2>(token), 2).1,
        _ => (body.run::<1>(token), 1).1,
    }
}

/// `sums[r][j] += left[r][k] * panels[j][k]`
///
/// # Safety
/// Each pointer in `left` must be valid for reading `depth` bytes, a multiple of 4, each in `panels` for 16 times as many.
#[inline(always)]
pub(crate) unsafe fn multiply<const N: usize, const P: usize>(
    token: Avx512,
    form: Form,
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    sums: [[__m512i; P]; N],
) -> [[__m512i; P]; N] {
    // SAFETY: the caller's promise is passed on. The token proves AVX-512 F and BW, and its `vnni` AVX-512 VNNI.
    unsafe {
        match (token.vnni(), form) {
            (Some(_), Form { signed: false, .. }) => dot::<N, P, false>(left, panels, depth, sums),
            (Some(_), Form { signed: true, .. }) => dot::<N, P, true>(left, panels, depth, sums),
            (None, Form { signed: false, pairs: false }) => plain::<N, P, false>(left, panels, depth, sums),
            (None, Form { signed: true, pairs: false }) => plain::<N, P, true>(left, panels, depth, sums),
            (None, Form { signed: false, pairs: true }) => pairs::<N, P, false>(left, panels, depth, sums),
            (None, Form { signed: true, pairs: true }) => pairs::<N, P, true>(left, panels, depth, sums),
        }
    }
}

/// Four elements of a row, in all lanes.
///
/// # Safety
/// `row` must be valid for reading 4 bytes; the CPU must have AVX-512 F.
#[inline(always)]
unsafe fn splat(row: *const i8) -> __m512i {
    // SAFETY: the caller promises the bytes, which need no alignment, and AVX-512 F.
    unsafe { _mm512_set1_epi32(row.cast::<i32>().read_unaligned()) }
}

/// Weights, their magnitudes and where they are negative. Without signed left elements only the first is needed.
#[derive(Clone, Copy)]
struct Weights(__m512i, __m512i, __mmask64);

impl Weights {
    /// # Safety
    /// `panel` must be valid for reading 64 bytes; the CPU must have AVX-512 F and BW.
    #[inline(always)]
    unsafe fn load(panel: *const i8) -> Self {
        // SAFETY: the caller promises the bytes, which need no alignment, and AVX-512 F and BW.
        unsafe {
            let w = _mm512_loadu_si512(panel.cast());
            Self(w, _mm512_abs_epi8(w), _mm512_movepi8_mask(w))
        }
    }

    /// The same of each panel, from byte `at` on.
    ///
    /// # Safety
    /// As [`Weights::load`], for each panel.
    #[inline(always)]
    unsafe fn group<const P: usize>(panels: [*const i8; P], at: usize) -> [Self; P] {
        // SAFETY: the caller's promise is passed on.
        unsafe {
            // Not by closures: those have no instructions enabled.
            let mut w = [Self::load(panels[0].add(at)); P];
            for j in 1..P {
                w[j] = Self::load(panels[j].add(at));
            }
            w
        }
    }

    /// Sums of two products in 16 bits. Of signed elements the sign is moved from the weights: |w| * (a * sign(w)).
    ///
    /// # Safety
    /// The CPU must have AVX-512 F and BW.
    #[inline(always)]
    unsafe fn twos<const SIGNED: bool>(self, a: __m512i) -> __m512i {
        let Self(w, magnitude, negative) = self;
        // SAFETY: the caller promises AVX-512 F and BW.
        unsafe {
            if SIGNED {
                _mm512_maddubs_epi16(magnitude, _mm512_mask_sub_epi8(a, negative, _mm512_setzero_si512(), a))
            } else {
                _mm512_maddubs_epi16(a, w)
            }
        }
    }
}

/// Each group widened by itself.
///
/// # Safety
/// As [`multiply`]; the CPU must have AVX-512 F and BW.
#[inline(always)]
unsafe fn plain<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[__m512i; P]; N],
) -> [[__m512i; P]; N] {
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let ones = _mm512_set1_epi16(1);
        for group in 0..depth / GROUP {
            let w = Weights::group(panels, group * STEP);
            for r in 0..N {
                let a = splat(left[r].add(group * GROUP));
                for j in 0..P {
                    let fours = _mm512_madd_epi16(w[j].twos::<SIGNED>(a), ones);
                    sums[r][j] = _mm512_add_epi32(sums[r][j], fours);
                }
            }
        }
    }
    sums
}

/// Two groups added in 16 bits, then widened.
///
/// # Safety
/// As [`multiply`]; the CPU must have AVX-512 F and BW.
#[inline(always)]
unsafe fn pairs<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[__m512i; P]; N],
) -> [[__m512i; P]; N] {
    let even = depth / (2 * GROUP) * (2 * GROUP);
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let ones = _mm512_set1_epi16(1);
        for k in (0..even).step_by(2 * GROUP) {
            let w = Weights::group(panels, k * LANES);
            let next = Weights::group(panels, k * LANES + STEP);
            for r in 0..N {
                let (a, b) = (splat(left[r].add(k)), splat(left[r].add(k + GROUP)));
                for j in 0..P {
                    let fours = _mm512_add_epi16(w[j].twos::<SIGNED>(a), next[j].twos::<SIGNED>(b));
                    sums[r][j] = _mm512_add_epi32(sums[r][j], _mm512_madd_epi16(fours, ones));
                }
            }
        }
        if even < depth {
            let (left, panels) = (left.map(|left| left.add(even)), panels.map(|panel| panel.add(even * LANES)));
            sums = plain::<N, P, SIGNED>(left, panels, depth - even, sums);
        }
    }
    sums
}

/// Four products a lane in one instruction. Its left elements are unsigned: signed ones are read 128 too large, for which
/// the sums start as much lower.
///
/// # Safety
/// As [`multiply`]; the CPU must have AVX-512 F and VNNI.
#[inline(always)]
unsafe fn dot<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[__m512i; P]; N],
) -> [[__m512i; P]; N] {
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let shift = _mm512_set1_epi8(i8::MIN);
        for group in 0..depth / GROUP {
            let w = Weights::group(panels, group * STEP);
            for r in 0..N {
                let row = left[r].add(group * GROUP);
                let a = if SIGNED { splat_xor(row, shift) } else { splat(row) };
                for j in 0..P {
                    sums[r][j] = dpbusd(sums[r][j], a, w[j].0);
                }
            }
        }
    }
    sums
}

/// Four elements of a row in all lanes, with the bits of `mask` changed. In one instruction: compilers change four bytes first and
/// copy them into the lanes afterwards, which takes three and occupies a multiplier's port.
///
/// # Safety
/// `row` must be valid for reading 4 bytes; the CPU must have AVX-512 F.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn splat_xor(row: *const i8, mask: __m512i) -> __m512i {
    let all;
    // SAFETY: the caller promises the bytes, which need no alignment; only `all` changes.
    unsafe {
        asm!("vpxord {all}, {mask}, dword ptr [{row}]{{1to16}}", all = lateout(zmm_reg) all, mask = in(zmm_reg) mask,
            row = in(reg) row, options(pure, readonly, nostack, preserves_flags));
    }
    all
}

/// `sum + a * w` of unsigned and signed bytes, modulo 2^32. Not the intrinsic: it could not be inlined into a function that
/// is compiled without VNNI.
///
/// # Safety
/// The CPU must have AVX-512 VNNI.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn dpbusd(mut sum: __m512i, a: __m512i, w: __m512i) -> __m512i {
    // SAFETY: the caller promises AVX-512 VNNI; only `sum` changes.
    unsafe {
        asm!("vpdpbusd {sum}, {a}, {w}", sum = inout(zmm_reg) sum, a = in(zmm_reg) a, w = in(zmm_reg) w,
            options(pure, nomem, nostack, preserves_flags));
    }
    sum
}
