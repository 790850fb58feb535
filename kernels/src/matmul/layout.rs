//! The layout of packed weights: what the model file stores and what every product kernel reads.
//!
//! A matrix of `depth` rows (k) and `columns` columns (outputs) is cut into panels of [`LANES`] columns. A panel is
//! k-major, so that a kernel walks it once from start to end; the last panel is filled with zero columns:
//!
//! ```text
//! packed[(n / 16 * depth + k) * 16 + n % 16] = w[k][n]
//! ```

use crate::simd::{LANES, Simd};
use half::f16;

/// Packed weights in the precision that they are stored in. Arithmetic is f32 in both cases; widening is exact.
#[derive(Clone, Copy, Debug)]
pub enum Panels<'a> {
    /// Single precision.
    F32(&'a [f32]),
    /// Half precision, widened panel by panel while it is used.
    F16(&'a [f16]),
}

impl Panels<'_> {
    /// Numbers stored, the zero columns included.
    pub fn len(&self) -> usize {
        match self {
            Panels::F32(w) => w.len(),
            Panels::F16(w) => w.len(),
        }
    }

    /// Whether nothing is stored.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The 16 values from packed position `i` on, widened. For the specification; bodies read whole panels.
    #[inline(always)]
    pub(crate) fn lanes(&self, i: usize) -> [f32; LANES] {
        match self {
            Panels::F32(w) => *w[i..].first_chunk().expect("panels are whole"),
            Panels::F16(w) => w[i..].first_chunk::<LANES>().expect("panels are whole").map(f16::to_f32),
        }
    }
}

/// Packed weights as a tile reads them.
pub(crate) trait Packed<S: Simd> {
    /// What a tile reads.
    type Element: Copy;
    /// `len` elements from packed position `i` on: where they are stored, or in `spare`, which then holds as many, if they
    /// are stored in another form.
    fn read<'a>(&'a self, s: S, i: usize, len: usize, spare: &'a mut [Self::Element]) -> &'a [Self::Element];
    /// Where packed position `i` is stored, if a tile reads it there, else null.
    fn address(&self, i: usize) -> *const Self::Element;
}

impl<S: Simd> Packed<S> for Panels<'_> {
    type Element = f32;

    #[inline(always)]
    fn read<'a>(&'a self, s: S, i: usize, len: usize, spare: &'a mut [f32]) -> &'a [f32] {
        match self {
            Panels::F32(w) => &w[i..][..len],
            Panels::F16(w) => {
                let spare = &mut spare[..len];
                let (narrow, _) = w[i..][..len].as_chunks();
                for (narrow, wide) in narrow.iter().zip(spare.as_chunks_mut().0) {
                    s.store(wide, s.widen(narrow));
                }
                spare
            }
        }
    }

    #[inline(always)]
    fn address(&self, i: usize) -> *const f32 {
        match self {
            Panels::F32(w) => w[i..].as_ptr(),
            Panels::F16(_) => core::ptr::null(),
        }
    }
}

/// Values that a packed `depth` x `columns` matrix takes.
pub const fn packed_len(depth: usize, columns: usize) -> usize {
    columns.div_ceil(LANES) * LANES * depth
}

/// Where element (`k`, `n`) of a matrix of `depth` rows is stored.
#[inline]
pub const fn packed_index(depth: usize, k: usize, n: usize) -> usize {
    (n / LANES * depth + k) * LANES + n % LANES
}

/// Packs the matrix whose element (k, n) is `w(k, n)`.
///
/// # Panics
/// If `out` is not [`packed_len`] long.
pub fn pack(depth: usize, columns: usize, w: impl Fn(usize, usize) -> f32, out: &mut [f32]) {
    assert_eq!(out.len(), packed_len(depth, columns), "packed weights have another size");
    out.fill(0.0);
    for n in 0..columns {
        for k in 0..depth {
            out[packed_index(depth, k, n)] = w(k, n);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isa::Isa;
    use crate::simd::{Kernel, dispatch};

    #[test]
    fn every_element_has_its_own_place_and_the_rest_is_zero() {
        for (depth, columns) in [(1, 1), (3, 16), (2, 17), (5, 40)] {
            let mut out = vec![9.0; packed_len(depth, columns)];
            pack(depth, columns, |k, n| (k * 100 + n + 1) as f32, &mut out);
            for n in 0..columns {
                for k in 0..depth {
                    assert_eq!(out[packed_index(depth, k, n)], (k * 100 + n + 1) as f32);
                }
            }
            assert_eq!(out.iter().filter(|&&v| v != 0.0).count(), depth * columns);
        }
    }

    #[test]
    fn both_precisions_are_read_as_stored() {
        let wide: [f32; 17] = std::array::from_fn(|i| 1.5 - i as f32);
        let narrow = wide.map(f16::from_f32);
        for panels in [Panels::F32(&wide), Panels::F16(&narrow)] {
            assert_eq!(
                (panels.len(), panels.lanes(0), panels.lanes(1)),
                (17, wide[..16].try_into().unwrap(), wide[1..].try_into().unwrap())
            );
            assert!(!panels.is_empty());
        }
        assert!(Panels::F32(&[]).is_empty() && Panels::F16(&[]).is_empty());
    }

    struct Widen<'a>(&'a [f16; LANES], &'a mut [f32; LANES]);

    impl Kernel for Widen<'_> {
        type Output = ();
        #[inline(always)]
        fn reference(self) {
            *self.1 = Panels::F16(self.0).lanes(0);
        }
        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            s.store(self.1, s.widen(self.0));
        }
    }

    #[test]
    fn every_half_precision_number_widens_to_the_same_bits() {
        for isa in Isa::available() {
            for first in (0..=u16::MAX).step_by(LANES) {
                let narrow = std::array::from_fn(|i| f16::from_bits(first + i as u16));
                let mut wide = [0.0; LANES];
                dispatch(isa, Widen(&narrow, &mut wide));
                for (bits, got) in (first..=u16::MAX).zip(wide) {
                    // The value from its fields: sign, 5 bits of exponent, 10 of fraction.
                    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023) / 1024.0);
                    let value = match exponent {
                        0 => fraction * 2f64.powi(-14),
                        31 if fraction == 0.0 => f64::INFINITY,
                        31 => f64::NAN,
                        _ => (1.0 + fraction) * 2f64.powi(exponent - 15),
                    };
                    let want = if bits >> 15 == 0 { value } else { -value } as f32;
                    let same = got.to_bits() == want.to_bits() || (got.is_nan() && want.is_nan());
                    assert!(same, "{}: {bits:04x} is {got:e}, not {want:e}", isa.name());
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "packed weights have another size")]
    fn no_room_for_the_zero_columns() {
        pack(2, 17, |_, _| 1.0, &mut [0.0; 34]);
    }
}
