//! 128 bits: a group of a panel is four registers of four columns. Plain NEON multiplies into 16 bits and adds neighbours;
//! `sdot` and `smmla` do it in one instruction, and take signed elements. They are written as assembly: the oldest compiler
//! that this crate supports has no intrinsics for them.
//!
//! Rows are loaded by loops, not by `map`: its closure is not inlined everywhere, and a call spills all sums.

use super::{Form, GROUP, STEP};
use crate::isa::Neon;
use crate::simd::{LANES, TileRows};
use core::arch::aarch64::*;
use core::arch::asm;

/// Sixteen sums.
type Sums = [uint32x4_t; 4];
/// Columns of a register.
const QUARTER: usize = 4;
/// Bytes of a register.
const WIDTH: usize = 16;

/// Rows of a tile: with one instruction per product 24 sums, the left elements and the weights fill the 32 registers; in
/// 16 bits there are products besides.
#[inline(always)]
pub(crate) fn tile_rows(token: Neon) -> usize {
    if token.dot().is_some() { 6 } else { 4 }
}

#[inline(always)]
pub(crate) fn rows<B: TileRows<Neon>>(token: Neon, left: usize, body: B) -> usize {
    match left {
        6.. if token.dot().is_some() => (body.run::<6>(token), 6).1,
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
    token: Neon,
    form: Form,
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    // SAFETY: the caller's promise is passed on. The token proves NEON, its `dot` FEAT_DotProd, its `i8mm` FEAT_I8MM.
    unsafe {
        match (token.i8mm(), token.dot()) {
            (Some(_), _) if N.is_multiple_of(2) => squares(left, panels, depth, sums),
            (_, Some(_)) => dot(left, panels, depth, sums),
            _ if form.pairs => pairs(left, panels, depth, sums),
            _ => plain(left, panels, depth, sums),
        }
    }
}

/// Four elements of a row, in all lanes.
///
/// # Safety
/// `row` must be valid for reading 4 bytes; the CPU must have NEON.
#[inline(always)]
unsafe fn splat(row: *const i8) -> int8x16_t {
    // SAFETY: the caller promises the bytes, which need no alignment, and NEON.
    unsafe { vreinterpretq_s8_s32(vdupq_n_s32(row.cast::<i32>().read_unaligned())) }
}

/// `sum` plus neighbours of `low` and `high`, of which two make a column.
///
/// # Safety
/// The CPU must have NEON.
#[inline(always)]
unsafe fn widen(sum: uint32x4_t, low: int16x8_t, high: int16x8_t) -> uint32x4_t {
    // SAFETY: the caller promises NEON.
    unsafe { vreinterpretq_u32_s32(vpadalq_s16(vreinterpretq_s32_u32(sum), vpaddq_s16(low, high))) }
}

/// Each group widened by itself: a 16-bit lane gets two products. Registers are loaded by halves, which `smull` takes as they
/// are: of whole ones the compiler takes the upper half out first, and then has too few registers for the sums.
///
/// # Safety
/// As [`multiply`]; the CPU must have NEON.
#[inline(always)]
unsafe fn plain<const N: usize, const P: usize>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        for k in (0..depth).step_by(GROUP) {
            let mut a = [vdup_n_s8(0); N];
            for r in 0..N {
                a[r] = vreinterpret_s8_s32(vdup_n_s32(left[r].add(k).cast::<i32>().read_unaligned()));
            }
            for j in 0..P {
                for q in 0..QUARTER {
                    let w = panels[j].add(k * LANES + q * WIDTH);
                    let (w, next) = (vld1_s8(w), vld1_s8(w.add(WIDTH / 2)));
                    for r in 0..N {
                        sums[r][j][q] = widen(sums[r][j][q], vmull_s8(w, a[r]), vmull_s8(next, a[r]));
                    }
                }
            }
        }
    }
    sums
}

/// Two groups added in 16 bits: a lane gets four products.
///
/// # Safety
/// As [`multiply`]; the CPU must have NEON.
#[inline(always)]
unsafe fn pairs<const N: usize, const P: usize>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    let even = depth / (2 * GROUP) * (2 * GROUP);
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        for k in (0..even).step_by(2 * GROUP) {
            let mut a = [[vdupq_n_s8(0); 2]; N];
            for r in 0..N {
                a[r] = [splat(left[r].add(k)), splat(left[r].add(k + GROUP))];
            }
            for j in 0..P {
                for q in 0..QUARTER {
                    let w = panels[j].add(k * LANES + q * WIDTH);
                    let (w, next) = (vld1q_s8(w), vld1q_s8(w.add(STEP)));
                    for r in 0..N {
                        let [a, b] = a[r];
                        let low = vmull_s8(vget_low_s8(w), vget_low_s8(a));
                        let low = vmlal_s8(low, vget_low_s8(next), vget_low_s8(b));
                        let high = vmlal_high_s8(vmull_high_s8(w, a), next, b);
                        sums[r][j][q] = widen(sums[r][j][q], low, high);
                    }
                }
            }
        }
        if even < depth {
            let (left, panels) = (left.map(|left| left.add(even)), panels.map(|panel| panel.add(even * LANES)));
            sums = plain(left, panels, depth - even, sums);
        }
    }
    sums
}

/// Four products a lane in one instruction. Four groups of a row are loaded at once and multiplied by lane.
///
/// # Safety
/// As [`multiply`]; the CPU must have NEON and FEAT_DotProd.
#[inline(always)]
unsafe fn dot<const N: usize, const P: usize>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    /// `sums += a[.][LANE] * w` for group `group`.
    macro_rules! step {
        ($lane:literal, $a:ident, $group:expr) => {
            for j in 0..P {
                for q in 0..QUARTER {
                    let w = vld1q_s8(panels[j].add($group * STEP + q * WIDTH));
                    for r in 0..N {
                        sums[r][j][q] = sdot::<$lane>(sums[r][j][q], w, $a[r]);
                    }
                }
            }
        };
    }
    let groups = depth / GROUP;
    let whole = groups / QUARTER * QUARTER;
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        for group in (0..whole).step_by(QUARTER) {
            let mut a = [vdupq_n_s8(0); N];
            for r in 0..N {
                a[r] = vld1q_s8(left[r].add(group * GROUP));
            }
            step!(0, a, group);
            step!(1, a, group + 1);
            step!(2, a, group + 2);
            step!(3, a, group + 3);
        }
        for group in whole..groups {
            let mut a = [vdupq_n_s8(0); N];
            for r in 0..N {
                a[r] = splat(left[r].add(group * GROUP));
            }
            step!(0, a, group);
        }
    }
    sums
}

/// `sum + w * a[LANE]`: dot products of four signed bytes each.
///
/// # Safety
/// The CPU must have FEAT_DotProd.
#[inline(always)]
unsafe fn sdot<const LANE: usize>(mut sum: uint32x4_t, w: int8x16_t, a: int8x16_t) -> uint32x4_t {
    // SAFETY: the caller promises FEAT_DotProd; only `sum` changes.
    unsafe {
        asm!(".arch_extension dotprod", "sdot {sum:v}.4s, {w:v}.16b, {a:v}.4b[{lane}]",
            sum = inout(vreg) sum, w = in(vreg) w, a = in(vreg) a, lane = const LANE,
            options(pure, nomem, nostack, preserves_flags));
    }
    sum
}

/// Two rows by two columns of eight products each in one instruction. The weights of two groups are paired for all rows.
///
/// # Safety
/// As [`multiply`], for an even number of rows; the CPU must have NEON, FEAT_DotProd and FEAT_I8MM.
#[inline(always)]
unsafe fn squares<const N: usize, const P: usize>(
    left: [*const i8; N],
    panels: [*const i8; P],
    depth: usize,
    mut sums: [[Sums; P]; N],
) -> [[Sums; P]; N] {
    let even = depth / (2 * GROUP) * (2 * GROUP);
    // SAFETY: every group is below `depth`, so the caller's promise holds for all loads.
    unsafe {
        exchange(&mut sums);
        for k in (0..even).step_by(2 * GROUP) {
            let mut a = [vdupq_n_s8(0); N];
            for r in (0..N).step_by(2) {
                a[r] = vcombine_s8(vld1_s8(left[r].add(k)), vld1_s8(left[r + 1].add(k)));
            }
            for j in 0..P {
                for q in 0..QUARTER {
                    let w = panels[j].add(k * LANES + q * WIDTH);
                    let (w, next) = (vreinterpretq_s32_s8(vld1q_s8(w)), vreinterpretq_s32_s8(vld1q_s8(w.add(STEP))));
                    let low = vreinterpretq_s8_s32(vzip1q_s32(w, next));
                    let high = vreinterpretq_s8_s32(vzip2q_s32(w, next));
                    for r in (0..N).step_by(2) {
                        sums[r][j][q] = smmla(sums[r][j][q], a[r], low);
                        sums[r + 1][j][q] = smmla(sums[r + 1][j][q], a[r], high);
                    }
                }
            }
        }
        exchange(&mut sums);
        if even < depth {
            let (left, panels) = (left.map(|left| left.add(even)), panels.map(|panel| panel.add(even * LANES)));
            sums = dot(left, panels, depth - even, sums);
        }
    }
    sums
}

/// Of each two rows by four columns makes two rows by the first two columns and two rows by the last two, or the other way
/// round.
///
/// # Safety
/// `N` must be even; the CPU must have NEON.
#[inline(always)]
unsafe fn exchange<const N: usize, const P: usize>(sums: &mut [[Sums; P]; N]) {
    for r in (0..N).step_by(2) {
        for j in 0..P {
            for q in 0..QUARTER {
                // SAFETY: the caller promises NEON.
                unsafe {
                    let a = vreinterpretq_u64_u32(sums[r][j][q]);
                    let b = vreinterpretq_u64_u32(sums[r + 1][j][q]);
                    sums[r][j][q] = vreinterpretq_u32_u64(vzip1q_u64(a, b));
                    sums[r + 1][j][q] = vreinterpretq_u32_u64(vzip2q_u64(a, b));
                }
            }
        }
    }
}

/// `sum + a * w`: two rows of eight signed bytes by two columns.
///
/// # Safety
/// The CPU must have FEAT_I8MM.
#[inline(always)]
unsafe fn smmla(mut sum: uint32x4_t, a: int8x16_t, w: int8x16_t) -> uint32x4_t {
    // SAFETY: the caller promises FEAT_I8MM; only `sum` changes.
    unsafe {
        asm!(".arch_extension i8mm", "smmla {sum:v}.4s, {a:v}.16b, {w:v}.16b",
            sum = inout(vreg) sum, a = in(vreg) a, w = in(vreg) w,
            options(pure, nomem, nostack, preserves_flags));
    }
    sum
}
