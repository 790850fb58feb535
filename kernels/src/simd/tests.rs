//! The integer lanes of every instruction set, comparisons and transposes against plain arithmetic.

use super::{Kernel, LANES, Simd, dispatch};
use crate::isa::Isa;
use crate::quantised::{clamp, requantise};
use crate::testing::Rng;
use std::array::from_fn;

type Lanes<T> = [T; LANES];

/// Operands of all integer operations.
#[derive(Clone, Copy)]
struct Operands {
    a: Lanes<i32>,
    b: Lanes<i32>,
    /// Fit into 16 bits.
    short: [Lanes<i32>; 2],
    bytes: [Lanes<i8>; 2],
    bits: u32,
    /// Fit into 31 bits.
    reals: Lanes<f32>,
    /// Lanes of parts of vectors.
    part: usize,
}

/// Their results.
#[derive(Debug, PartialEq)]
struct Results {
    ints: Vec<(&'static str, Lanes<i32>)>,
    bytes: Vec<(&'static str, Lanes<i8>)>,
    reals: Lanes<u32>,
}

impl Kernel for Operands {
    type Output = Results;

    #[inline(always)]
    fn reference(self) -> Results {
        let Self { a, b, short, bytes, bits, reals, part } = self;
        let pair = |f: fn(i32, i32) -> i32| from_fn(|i| f(a[i], b[i]));
        Results {
            ints: vec![
                ("shift_right", a.map(|a| (a.cast_unsigned() >> bits).cast_signed())),
                ("shift_right_signed", a.map(|a| a >> bits)),
                ("add_int", pair(i32::wrapping_add)),
                ("mul_int", pair(i32::wrapping_mul)),
                ("max_int", pair(i32::max)),
                ("mul_short", from_fn(|i| short[0][i] * short[1][i])),
                ("requantise", pair(requantise)),
                ("nearest", reals.map(|x| x.round_ties_even() as i32)),
                ("bytes_to_int", bytes[0].map(i32::from)),
                ("short_to_int", from_fn(|i| i32::from(bytes[0][i]) + i32::from(bytes[1][i]))),
                ("load_int_part", from_fn(|i| if i < part { a[i] } else { 0 })),
                ("load_bytes_part", from_fn(|i| if i < part { bytes[0][i].into() } else { 0 })),
            ],
            bytes: vec![
                ("max_bytes", from_fn(|i| bytes[0][i].max(bytes[1][i]))),
                ("narrow", a.map(|a| a.clamp(-128, 127) as i8)),
                ("quantised", a.map(|a| clamp(a, false))),
                ("quantised with ReLU", a.map(|a| clamp(a, true))),
                ("store_bytes_part", from_fn(|i| bytes[usize::from(i >= part)][i])),
            ],
            reals: a.map(|a| (a as f32).to_bits()),
        }
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Results {
        let [a, b] = [self.a, self.b].map(|x| s.load_int(&x));
        let short = self.short.map(|x| s.load_int(&x));
        let bytes = self.bytes.map(|x| s.load_bytes(&x));
        let store = |v| {
            let mut lanes = [0; LANES];
            s.store_bytes(&mut lanes, v);
            lanes
        };
        let mut part = self.bytes[1];
        s.store_bytes_part(&mut part[..self.part], bytes[0]);
        let [byte_a, byte_b] = bytes.map(|x| s.bytes_to_short(x));
        Results {
            ints: [
                ("shift_right", s.shift_right(a, self.bits)),
                ("shift_right_signed", s.shift_right_signed(a, self.bits)),
                ("add_int", s.add_int(a, b)),
                ("mul_int", s.mul_int(a, b)),
                ("max_int", s.max_int(a, b)),
                ("mul_short", s.mul_short(short[0], short[1])),
                ("requantise", s.requantise(a, b)),
                ("nearest", s.nearest(s.load(&self.reals))),
                ("bytes_to_int", s.bytes_to_int(bytes[0])),
                ("short_to_int", s.short_to_int(s.add_short(byte_a, byte_b))),
                ("load_int_part", s.load_int_part(&self.a[..self.part])),
                ("load_bytes_part", s.bytes_to_int(s.load_bytes_part(&self.bytes[0][..self.part]))),
            ]
            .map(|(name, v)| (name, s.int_lanes(v)))
            .to_vec(),
            bytes: [
                ("max_bytes", store(s.max_bytes(bytes[0], bytes[1]))),
                ("narrow", store(s.narrow(a))),
                ("quantised", store(s.quantised(a, false))),
                ("quantised with ReLU", store(s.quantised(a, true))),
                ("store_bytes_part", part),
            ]
            .to_vec(),
            reals: s.lanes(s.to_float(a)).map(f32::to_bits),
        }
    }
}

/// Values that are small, at the ends, at the ends of narrower integers, or anything.
fn integer(rng: &mut Rng) -> i32 {
    let bits = rng.bits();
    let near = (bits >> 8) as i32 % 3 - 1;
    match bits % 8 {
        0 => near,
        1 => i32::MAX - near.abs(),
        2 => i32::MIN + near.abs(),
        3 => ((1 << (bits >> 16 & 15)) + near) * if bits & 1 << 32 == 0 { 1 } else { -1 },
        4 => (bits >> 40) as i32 % 256 - 128,
        _ => (bits >> 32) as i32,
    }
}

#[test]
fn every_isa_has_the_integers_of_plain_arithmetic() {
    let mut rng = Rng::new(1);
    for round in 0..20_000u32 {
        let mut lanes = || from_fn(|_| integer(&mut rng));
        let (a, b) = (lanes(), lanes());
        let short = [lanes(), lanes()].map(|x| x.map(|x| i32::from(x as i16)));
        let bytes = [lanes(), lanes()].map(|x| x.map(|x| x as i8));
        // Halves among them, which go to the even neighbour.
        let reals = match round % 3 {
            0 => lanes().map(|x| x as f32 * 0.5),
            1 => lanes().map(|x| (x % 4096) as f32 * 0.5),
            _ => lanes().map(|x| (x % 1000) as f32 * 0.013),
        };
        let operands = Operands { a, b, short, bytes, bits: round % 32, reals, part: round as usize / 32 % 17 };
        let want = operands.reference();
        for isa in Isa::available() {
            assert_eq!(dispatch(isa, operands), want, "{}", isa.name());
        }
    }
}

/// Sixteen rows of `stride` values, of which the first 16 are transposed; and where each exceeds the one behind it in its row.
struct Turned<'a> {
    rows: &'a [f32],
    stride: usize,
}

impl Kernel for Turned<'_> {
    type Output = (Vec<f32>, Vec<Lanes<i32>>);

    #[inline(always)]
    fn reference(self) -> Self::Output {
        let at = |r: usize, c: usize| self.rows[r * self.stride + c];
        let turned = (0..LANES * LANES).map(|i| at(i % LANES, i / LANES)).collect();
        let exceeds = (1..LANES).map(|c| from_fn(|r| i32::from(at(r, c - 1) > at(r, c)))).collect();
        (turned, exceeds)
    }

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        assert!(self.stride >= LANES && self.rows.len() >= (LANES - 1) * self.stride + LANES);
        let mut turned = vec![f32::NAN; LANES * LANES];
        // SAFETY: the last of 16 rows ends within `rows`, and `turned` has 256 values.
        unsafe { s.transpose_ptr(self.rows.as_ptr(), self.stride, turned.as_mut_ptr()) }
        let mut exceeds = vec![];
        for pair in turned.as_chunks::<LANES>().0.windows(2) {
            let mask = s.exceeds(s.load(&pair[0]), s.load(&pair[1]));
            exceeds.push(s.int_lanes(s.keep(mask, s.splat_int(1))));
        }
        (turned, exceeds)
    }
}

#[test]
fn transposes_and_comparisons_are_those_of_plain_code() {
    let mut rng = Rng::new(9);
    for stride in [16, 17, 32, 51] {
        // Without a value behind the last row's.
        let rows = rng.special((LANES - 1) * stride + LANES);
        let want = dispatch(Isa::Scalar, Turned { rows: &rows, stride });
        assert!(want.1.iter().flatten().any(|&v| v == 1) && want.1.iter().flatten().any(|&v| v == 0));
        for isa in Isa::available() {
            let got = dispatch(isa, Turned { rows: &rows, stride });
            let bits = |x: &[f32]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!((bits(&got.0), got.1), (bits(&want.0), want.1.clone()), "{} {stride}", isa.name());
        }
    }
}
