//! NEON: a vector is four 4-lane registers.
//!
//! Where an instruction has no intrinsic in the oldest compiler that this crate supports, it is written as assembly.

use super::bytes::{self, Form};
use super::{Kernel, LANES, Simd, Tile, TileRows};
use crate::isa::Neon;
use core::arch::aarch64::*;
use core::arch::asm;
use half::f16;

/// Lanes of a register.
const QUARTER: usize = 4;

/// Instantiates `kernel`'s body with the instructions enabled.
///
/// Never inlined: every processor of the architecture has NEON, so that a body might become part of a caller that is compiled
/// for size.
///
/// # Safety
/// The CPU must have NEON, which a [`Neon`] token proves.
#[inline(never)]
#[target_feature(enable = "neon")]
pub(crate) unsafe fn run<K: Kernel>(token: Neon, kernel: K) -> K::Output {
    kernel.run(token)
}

/// Applies a lane-wise intrinsic to all four quarters.
macro_rules! quarters {
    ($op:ident($($x:expr),*)) => {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { [$op($($x[0]),*), $op($($x[1]),*), $op($($x[2]),*), $op($($x[3]),*)] }
    };
}

/// The mask's choice of two vectors.
macro_rules! select {
    ($mask:expr, $a:expr, $b:expr) => {{
        let mask = $mask;
        quarters!(vbslq_f32(mask, $a, $b))
    }};
}

/// The same bits as signed integers.
macro_rules! signed {
    ($x:expr) => {{
        let x = $x;
        quarters!(vreinterpretq_s32_u32(x))
    }};
}

/// The same bits as unsigned integers.
macro_rules! unsigned {
    ($x:expr) => {{
        let x = $x;
        quarters!(vreinterpretq_u32_s32(x))
    }};
}

/// [`crate::quantised::requantise`].
#[inline]
#[target_feature(enable = "neon")]
fn requantise(sum: int32x4_t, multiplier: int32x4_t) -> int32x4_t {
    let low = vmull_s32(vget_low_s32(sum), vget_low_s32(multiplier));
    vrshrn_high_n_s64::<32>(vrshrn_n_s64::<32>(low), vmull_high_s32(sum, multiplier))
}

impl Simd for Neon {
    type V = [float32x4_t; 4];
    type I = [uint32x4_t; 4];
    type M = [uint32x4_t; 4];
    type H = [int16x8_t; 2];
    type B = int8x16_t;
    // 24 accumulators of 4 lanes, a register of four k of each row, and 2 of weights fill the 32 registers.
    const TILE: Tile = Tile { rows: 6, panels: 1 };
    const MASKED: bool = false;

    #[inline(always)]
    fn rows<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        // Only the last block of rows has less than whole tiles; 5 and 3 rows in two calls keep a third of the code away.
        match left {
            6.. => (body.run::<6>(self), 6).1,
            4.. => (body.run::<4>(self), 4).1,
            2.. => (body.run::<2>(self), 2).1,
            _ => (body.run::<1>(self), 1).1,
        }
    }

    /// Four k of a row are loaded at once and multiplied by lane: a load that fills all lanes with one number takes a slot
    /// of the multipliers on many cores, and there are four times as many of them.
    #[inline(always)]
    unsafe fn multiply<const N: usize, const P: usize>(
        self,
        left: [*const f32; N],
        panels: [*const f32; P],
        depth: usize,
        mut sums: [[Self::V; P]; N],
    ) -> [[Self::V; P]; N] {
        /// `sums += left[.][LANE] * w` for the registers `q` of the panels `j`.
        macro_rules! step {
            ($lane:literal, $a:ident, $k:expr) => {
                for j in 0..P {
                    for q in 0..QUARTER {
                        let w = vld1q_f32(panels[j].add(($k + $lane) * LANES + q * QUARTER));
                        for r in 0..N {
                            sums[r][j][q] = vfmaq_laneq_f32::<$lane>(sums[r][j][q], w, $a[r]);
                        }
                    }
                }
            };
        }
        let whole = depth / QUARTER * QUARTER;
        // SAFETY: every k is below `depth`, so the caller's promise holds for all loads; the token proves NEON.
        unsafe {
            for k in (0..whole).step_by(QUARTER) {
                let mut a = [vdupq_n_f32(0.0); N];
                for r in 0..N {
                    a[r] = vld1q_f32(left[r].add(k));
                }
                step!(0, a, k);
                step!(1, a, k);
                step!(2, a, k);
                step!(3, a, k);
            }
            for k in whole..depth {
                let mut a = [vdupq_n_f32(0.0); N];
                for r in 0..N {
                    a[r] = vld1q_dup_f32(left[r].add(k));
                }
                step!(0, a, k);
            }
        }
        sums
    }

    const BYTE_PANELS: usize = 1;
    #[inline(always)]
    fn byte_rows(self) -> usize {
        bytes::neon::tile_rows(self)
    }
    #[inline(always)]
    fn rows_of_bytes<B: TileRows<Self>>(self, left: usize, body: B) -> usize {
        bytes::neon::rows(self, left, body)
    }
    #[inline(always)]
    fn shifts_bytes(self) -> bool {
        false
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
        unsafe { bytes::neon::multiply(self, form, left, panels, depth, sums) }
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { [vdupq_n_f32(x); 4] }
    }
    #[inline(always)]
    unsafe fn load_ptr(self, p: *const f32) -> Self::V {
        // SAFETY: the caller promises 16 readable f32 at `p`; the token proves NEON.
        unsafe { [0, 1, 2, 3].map(|q| vld1q_f32(p.add(q * QUARTER))) }
    }
    #[inline(always)]
    unsafe fn store_ptr(self, p: *mut f32, v: Self::V) {
        for q in 0..4 {
            // SAFETY: the caller promises 16 writable f32 at `p`; the token proves NEON.
            unsafe { vst1q_f32(p.add(q * QUARTER), v[q]) }
        }
    }
    #[inline(always)]
    fn widen(self, x: &[f16; LANES]) -> Self::V {
        let p = x.as_ptr().cast::<u16>();
        // SAFETY: the array is 32 bytes, read as two unaligned 16-byte halves; the token proves NEON, of which `fcvtl` is a
        // part. Intrinsics for it, and the type of four half-precision numbers, came with Rust 1.94.
        unsafe {
            let halves = [vld1q_u16(p), vld1q_u16(p.add(8))];
            let mut out = self.splat(0.0);
            for (h, half) in halves.into_iter().enumerate() {
                let (low, high);
                asm!("fcvtl {:v}.4s, {:v}.4h", lateout(vreg) low, in(vreg) half, options(pure, nomem, nostack, preserves_flags));
                asm!("fcvtl2 {:v}.4s, {:v}.8h", lateout(vreg) high, in(vreg) half, options(pure, nomem, nostack, preserves_flags));
                (out[2 * h], out[2 * h + 1]) = (low, high);
            }
            out
        }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(vaddq_f32(a, b))
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(vsubq_f32(a, b))
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(vmulq_f32(a, b))
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        quarters!(vdivq_f32(a, b))
    }
    #[inline(always)]
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        quarters!(vfmaq_f32(c, a, b))
    }
    // Not `fmax` and `fmin`: they give NaN where either operand is NaN, and order the zeros.
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        select!(quarters!(vcgtq_f32(a, b)), a, b)
    }
    #[inline(always)]
    fn min(self, a: Self::V, b: Self::V) -> Self::V {
        select!(quarters!(vcltq_f32(a, b)), a, b)
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        quarters!(vrndnq_f32(a))
    }
    #[inline(always)]
    fn exp2_int(self, n: Self::V) -> Self::V {
        // SAFETY: the token `self` proves that the CPU has NEON.
        n.map(|n| unsafe {
            let biased = vaddq_s32(vcvtq_s32_f32(n), vdupq_n_s32(127));
            vreinterpretq_f32_s32(vshlq_n_s32::<23>(biased))
        })
    }
    #[inline(always)]
    fn splat_int(self, x: u32) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { [vdupq_n_u32(x); 4] }
    }
    #[inline(always)]
    fn truncate(self, a: Self::V) -> Self::I {
        quarters!(vcvtq_u32_f32(a))
    }
    #[inline(always)]
    fn shift_right(self, a: Self::I, bits: u32) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has NEON, whose left shift by a negative number is one to the right.
        a.map(|a| unsafe { vshlq_u32(a, vdupq_n_s32(-bits.cast_signed())) })
    }
    #[inline(always)]
    fn add_int(self, a: Self::I, b: Self::I) -> Self::I {
        quarters!(vaddq_u32(a, b))
    }
    #[inline(always)]
    fn mul_int(self, a: Self::I, b: Self::I) -> Self::I {
        quarters!(vmulq_u32(a, b))
    }
    #[inline(always)]
    fn keep(self, mask: Self::M, a: Self::I) -> Self::I {
        quarters!(vandq_u32(mask, a))
    }
    #[inline(always)]
    unsafe fn load_int_ptr(self, p: *const i32) -> Self::I {
        // SAFETY: the caller promises 16 readable integers at `p`; the token proves NEON.
        unsafe {
            let p = p.cast::<u32>();
            [vld1q_u32(p), vld1q_u32(p.add(QUARTER)), vld1q_u32(p.add(2 * QUARTER)), vld1q_u32(p.add(3 * QUARTER))]
        }
    }
    #[inline(always)]
    unsafe fn store_int_ptr(self, p: *mut i32, v: Self::I) {
        for q in 0..4 {
            // SAFETY: the caller promises 16 writable integers at `p`; the token proves NEON.
            unsafe { vst1q_u32(p.add(q * QUARTER).cast(), v[q]) }
        }
    }
    #[inline(always)]
    fn shift_right_signed(self, a: Self::I, bits: u32) -> Self::I {
        // A left shift by a negative number is one to the right.
        // SAFETY: the token `self` proves that the CPU has NEON.
        let left = unsafe { [vdupq_n_s32(-bits.cast_signed()); 4] };
        let a = signed!(a);
        unsigned!(quarters!(vshlq_s32(a, left)))
    }
    #[inline(always)]
    fn max_int(self, a: Self::I, b: Self::I) -> Self::I {
        let (a, b) = (signed!(a), signed!(b));
        unsigned!(quarters!(vmaxq_s32(a, b)))
    }
    #[inline(always)]
    fn mul_short(self, a: Self::I, b: Self::I) -> Self::I {
        self.mul_int(a, b)
    }
    #[inline(always)]
    fn requantise(self, sum: Self::I, multiplier: Self::I) -> Self::I {
        let (sum, multiplier) = (signed!(sum), signed!(multiplier));
        unsigned!(quarters!(requantise(sum, multiplier)))
    }
    #[inline(always)]
    fn to_float(self, a: Self::I) -> Self::V {
        let a = signed!(a);
        quarters!(vcvtq_f32_s32(a))
    }
    #[inline(always)]
    fn nearest(self, a: Self::V) -> Self::I {
        unsigned!(quarters!(vcvtnq_s32_f32(a)))
    }
    #[inline(always)]
    unsafe fn load_bytes_ptr(self, p: *const i8) -> Self::B {
        // SAFETY: the caller promises 16 readable bytes at `p`; the token proves NEON.
        unsafe { vld1q_s8(p) }
    }
    #[inline(always)]
    unsafe fn store_bytes_ptr(self, p: *mut i8, v: Self::B) {
        // SAFETY: the caller promises 16 writable bytes at `p`; the token proves NEON.
        unsafe { vst1q_s8(p, v) }
    }
    #[inline(always)]
    fn splat_bytes(self, x: i8) -> Self::B {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { vdupq_n_s8(x) }
    }
    #[inline(always)]
    fn max_bytes(self, a: Self::B, b: Self::B) -> Self::B {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { vmaxq_s8(a, b) }
    }
    #[inline(always)]
    fn bytes_to_int(self, a: Self::B) -> Self::I {
        self.short_to_int(self.bytes_to_short(a))
    }
    #[inline(always)]
    fn bytes_to_short(self, a: Self::B) -> Self::H {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { [vmovl_s8(vget_low_s8(a)), vmovl_high_s8(a)] }
    }
    #[inline(always)]
    fn add_short(self, a: Self::H, b: Self::H) -> Self::H {
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe { [vaddq_s16(a[0], b[0]), vaddq_s16(a[1], b[1])] }
    }
    #[inline(always)]
    fn short_to_int(self, a: Self::H) -> Self::I {
        // SAFETY: the token `self` proves that the CPU has NEON.
        let quarters = unsafe {
            let [a, b] = a;
            let (low_a, low_b) = (vmovl_s16(vget_low_s16(a)), vmovl_s16(vget_low_s16(b)));
            [low_a, vmovl_high_s16(a), low_b, vmovl_high_s16(b)]
        };
        unsigned!(quarters)
    }
    #[inline(always)]
    fn narrow(self, a: Self::I) -> Self::B {
        let a = signed!(a);
        // SAFETY: the token `self` proves that the CPU has NEON.
        unsafe {
            let (low, high) = (vqmovn_high_s32(vqmovn_s32(a[0]), a[1]), vqmovn_high_s32(vqmovn_s32(a[2]), a[3]));
            vqmovn_high_s16(vqmovn_s16(low), high)
        }
    }
    #[inline(always)]
    fn at_least(self, a: Self::V, b: Self::V) -> Self::M {
        quarters!(vcgeq_f32(a, b))
    }
    #[inline(always)]
    fn exceeds(self, a: Self::V, b: Self::V) -> Self::M {
        quarters!(vcgtq_f32(a, b))
    }
    #[inline(always)]
    unsafe fn transpose_ptr(self, from: *const f32, stride: usize, to: *mut f32) {
        for (row, column) in
            (0..LANES).step_by(QUARTER).flat_map(|row| (0..LANES).step_by(QUARTER).map(move |c| (row, c)))
        {
            // SAFETY: four values in each of four rows of what the caller promises; the token proves NEON.
            unsafe {
                let from = from.add(row * stride + column);
                let rows = [0, 1, 2, 3].map(|r| vld1q_f32(from.add(r * stride)));
                // Pairs of the first two rows and of the last two, even columns and odd ones.
                let even = [vtrn1q_f32(rows[0], rows[1]), vtrn1q_f32(rows[2], rows[3])];
                let odd = [vtrn2q_f32(rows[0], rows[1]), vtrn2q_f32(rows[2], rows[3])];
                let [even, odd] = [even, odd].map(|pairs| pairs.map(|x| vreinterpretq_f64_f32(x)));
                let to = to.add(column * LANES + row);
                vst1q_f32(to, vreinterpretq_f32_f64(vtrn1q_f64(even[0], even[1])));
                vst1q_f32(to.add(LANES), vreinterpretq_f32_f64(vtrn1q_f64(odd[0], odd[1])));
                vst1q_f32(to.add(2 * LANES), vreinterpretq_f32_f64(vtrn2q_f64(even[0], even[1])));
                vst1q_f32(to.add(3 * LANES), vreinterpretq_f32_f64(vtrn2q_f64(odd[0], odd[1])));
            }
        }
    }
    #[inline(always)]
    fn both(self, a: Self::M, b: Self::M) -> Self::M {
        quarters!(vandq_u32(a, b))
    }
    #[inline(always)]
    fn prefetch<T>(self, p: *const T) {
        // SAFETY: a prefetch is a hint that never faults. The compiler has no stable intrinsic for it.
        unsafe { asm!("prfm pldl1keep, [{}]", in(reg) p, options(readonly, nostack, preserves_flags)) }
    }
}
