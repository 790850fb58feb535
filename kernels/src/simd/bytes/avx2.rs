//! 256 bits: without VNNI sums of two products in 16 bits (`vpmaddubsw`), which cannot saturate, widened by `vpmaddwd`; with
//! VNNI one instruction.

use super::{Form, GROUP, STEP};
use crate::isa::Avx2;
use crate::simd::{LANES, TileRows};
use core::arch::asm;
use core::arch::x86_64::*;

/// Sixteen sums.
type Sums = [__m256i; 2];

/// Rows of a tile. Without VNNI the multipliers are always busy, and eight sums leave registers for two groups of weights.
/// `vpdpbusd` takes some five cycles, two a cycle: twelve sums keep it busy.
#[inline(always)]
pub(crate) fn tile_rows(token: Avx2) -> usize {
    if token.vnni().is_some() { 6 } else { 4 }
}

#[inline(always)]
pub(crate) fn rows<B: TileRows<Avx2>>(token: Avx2, left: usize, body: B) -> usize {
    match left {
        6.. if token.vnni().is_some() => (body.run::<6>(token), 6).1,
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
    token: Avx2,
    form: Form,
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    // SAFETY: the caller's promise is passed on. The token proves AVX2, and its `vnni` AVX-VNNI.
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
/// `row` must be valid for reading 4 bytes; the CPU must have AVX2.
#[inline(always)]
unsafe fn splat(row: *const i8) -> __m256i {
    // SAFETY: the caller promises the bytes, which need no alignment, and AVX2.
    unsafe { _mm256_set1_epi32(row.cast::<i32>().read_unaligned()) }
}

/// A group of a panel.
///
/// # Safety
/// `panel` must be valid for reading 64 bytes; the CPU must have AVX2.
#[inline(always)]
unsafe fn load(panel: *const i8) -> Sums {
    // SAFETY: the caller promises the bytes, which need no alignment, and AVX2.
    unsafe { [_mm256_loadu_si256(panel.cast()), _mm256_loadu_si256(panel.add(32).cast())] }
}

/// Sums of two products in 16 bits. Of signed elements the sign is moved to the weights' place: |w| * (a * sign(w)).
///
/// # Safety
/// The CPU must have AVX2.
#[inline(always)]
unsafe fn twos<const SIGNED: bool>(a: __m256i, w: __m256i, magnitude: __m256i) -> __m256i {
    // SAFETY: the caller promises AVX2.
    unsafe { if SIGNED { _mm256_maddubs_epi16(magnitude, _mm256_sign_epi8(a, w)) } else { _mm256_maddubs_epi16(a, w) } }
}

/// What [`twos`] needs of the weights besides themselves, once for all rows.
///
/// # Safety
/// The CPU must have AVX2.
#[inline(always)]
unsafe fn magnitudes<const SIGNED: bool>(w: Sums) -> Sums {
    // SAFETY: the caller promises AVX2.
    if SIGNED { unsafe { [_mm256_abs_epi8(w[0]), _mm256_abs_epi8(w[1])] } } else { w }
}

/// Each group widened by itself.
///
/// # Safety
/// As [`multiply`]; the CPU must have AVX2.
#[inline(always)]
unsafe fn plain<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let ones = _mm256_set1_epi16(1);
        for group in 0..depth / GROUP {
            for j in 0..P {
                let w = load(panels[j].add(group * STEP));
                let magnitude = magnitudes::<SIGNED>(w);
                for r in 0..N {
                    let a = splat(left[r].add(group * GROUP));
                    for half in 0..2 {
                        let twos = twos::<SIGNED>(a, w[half], magnitude[half]);
                        let fours = _mm256_madd_epi16(twos, ones);
                        sums[r][j][half] = _mm256_add_epi32(sums[r][j][half], fours);
                    }
                }
            }
        }
    }
    sums
}

/// Two groups added in 16 bits, then widened.
///
/// # Safety
/// As [`multiply`]; the CPU must have AVX2.
#[inline(always)]
unsafe fn pairs<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    let even = depth / (2 * GROUP) * (2 * GROUP);
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let ones = _mm256_set1_epi16(1);
        for k in (0..even).step_by(2 * GROUP) {
            for j in 0..P {
                let panel = panels[j].add(k * LANES);
                let (w, next) = (load(panel), load(panel.add(STEP)));
                let (magnitude, next_magnitude) = (magnitudes::<SIGNED>(w), magnitudes::<SIGNED>(next));
                for r in 0..N {
                    let (a, b) = (splat(left[r].add(k)), splat(left[r].add(k + GROUP)));
                    for half in 0..2 {
                        let fours = _mm256_add_epi16(
                            twos::<SIGNED>(a, w[half], magnitude[half]),
                            twos::<SIGNED>(b, next[half], next_magnitude[half]),
                        );
                        let eights = _mm256_madd_epi16(fours, ones);
                        sums[r][j][half] = _mm256_add_epi32(sums[r][j][half], eights);
                    }
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
/// As [`multiply`]; the CPU must have AVX2 and AVX-VNNI.
#[inline(always)]
unsafe fn dot<const N: usize, const P: usize, const SIGNED: bool>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        let shift = _mm256_set1_epi8(i8::MIN);
        for group in 0..depth / GROUP {
            for j in 0..P {
                let w = load(panels[j].add(group * STEP));
                for r in 0..N {
                    let row = left[r].add(group * GROUP);
                    let a = if SIGNED { _mm256_xor_si256(splat_first(row), shift) } else { splat(row) };
                    for half in 0..2 {
                        sums[r][j][half] = dpbusd(sums[r][j][half], a, w[half]);
                    }
                }
            }
        }
    }
    sums
}

/// [`splat`] of bytes that are changed afterwards: compilers would change four of them and copy those into the lanes, which takes
/// one instruction more and occupies a multiplier's port.
///
/// # Safety
/// `row` must be valid for reading 4 bytes; the CPU must have AVX2.
#[inline]
#[target_feature(enable = "avx2")]
unsafe fn splat_first(row: *const i8) -> __m256i {
    let all;
    // SAFETY: the caller promises the bytes, which need no alignment; only `all` changes.
    unsafe {
        asm!("vpbroadcastd {all}, dword ptr [{row}]", all = lateout(ymm_reg) all, row = in(reg) row,
            options(pure, readonly, nostack, preserves_flags));
    }
    all
}

/// `sum + a * w` of unsigned and signed bytes, modulo 2^32. Not the intrinsic: it could not be inlined into a function that
/// is compiled for AVX2 alone.
///
/// # Safety
/// The CPU must have AVX-VNNI.
#[inline]
#[target_feature(enable = "avx2")]
unsafe fn dpbusd(mut sum: __m256i, a: __m256i, w: __m256i) -> __m256i {
    // SAFETY: the caller promises AVX-VNNI; only `sum` changes.
    unsafe {
        asm!("{{vex}} vpdpbusd {sum}, {a}, {w}", sum = inout(ymm_reg) sum, a = in(ymm_reg) a, w = in(ymm_reg) w,
            options(pure, nomem, nostack, preserves_flags));
    }
    sum
}
