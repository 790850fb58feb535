//! The rules that all kernels of 8-bit tensors share.
//!
//! ```text
//! real              = scale * q            q: i8, -127..=127, one scale per tensor, zero at 0
//! requantise(a, m)  = floor((a * m + 2^31) / 2^32)                 64-bit product; m: 0..2^31, a factor below 1/2
//! clamp(a)          = min(127, max(-127, a)), or min(127, max(0, a)) where ReLU follows
//! sigmoid_q10(t)    = round(1024 / (1 + e^(-t / 64)))              t clamped to -512..=511
//! ```
//!
//! Sums are exact: i32, and nothing rounds before [`requantise`]. Who makes the weights proves that no sum can leave i32;
//! a sum that leaves it nevertheless wraps around, on every instruction set alike.

/// Bits of a factor below 1/2 that [`requantise`] multiplies by.
pub const MULTIPLIER_BITS: u32 = 32;

/// `sum * multiplier / 2^32`, rounded to the nearest integer, halves upwards.
///
/// For any `sum` and any `multiplier`: neither the product, of at most 2^62, nor its sum with 2^31 leaves 64 bits.
#[inline(always)]
pub const fn requantise(sum: i32, multiplier: i32) -> i32 {
    ((sum as i64 * multiplier as i64 + (1 << (MULTIPLIER_BITS - 1))) >> MULTIPLIER_BITS) as i32
}

/// The lowest value of an 8-bit tensor, after ReLU or not. The highest is 127.
#[inline(always)]
pub const fn lowest(relu: bool) -> i8 {
    if relu { 0 } else { -127 }
}

/// The nearest value that an 8-bit tensor can hold.
#[inline(always)]
pub fn clamp(x: i32, relu: bool) -> i8 {
    x.clamp(lowest(relu).into(), 127) as i8
}

/// Logits outside are clamped: there the sigmoid is within 1/2048 of 0 or 1.
const LOGITS: core::ops::RangeInclusive<i32> = -512..=511;

/// Values of [`sigmoid_q10`], from the lowest logit on.
static SIGMOID: [i16; 1024] = sigmoid_table();

/// The sigmoid of `logit / 64` in units of 1/1024, from 0 to 1024: a table that was made in integers.
#[inline(always)]
pub fn sigmoid_q10(logit: i32) -> i32 {
    let index = logit.clamp(*LOGITS.start(), *LOGITS.end()) - LOGITS.start();
    i32::from(SIGMOID[index as usize])
}

/// Powers of e^(-1/64), each rounded down in units of 2^-60. All errors together are below 2^-50, and no value of the table
/// lies so close to a half (`tests` see to it), so the table is the correctly rounded one.
const fn sigmoid_table() -> [i16; 1024] {
    const ONE: u128 = 1 << 60;
    // e^(-1/64) by its series, whose terms alternate.
    let (mut ratio, mut term, mut k) = (0, ONE, 0);
    while term > 0 {
        ratio = if k % 2 == 0 { ratio + term } else { ratio - term };
        k += 1;
        term /= 64 * k;
    }
    let mut table = [0; 1024];
    let (mut power, mut t) = (ONE, 0);
    while t <= 512 {
        // The nearest to 1024 * 1 / (1 + power), and to what is missing from 1024 on the other side.
        let value = (2 * 1024 * ONE + (ONE + power)) / (2 * (ONE + power));
        if t < 512 {
            table[512 + t] = value as i16;
        }
        table[512 - t] = 1024 - value as i16;
        power = power * ratio / ONE;
        t += 1;
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requantise_by_hand() {
        assert_eq!(requantise(100, 1 << 30), 25);
        // Halves go upwards: 0.5, 1.5, -0.5, -1.5.
        assert_eq!([2, 6, -2, -6].map(|sum| requantise(sum, 1 << 30)), [1, 2, 0, -1]);
        assert_eq!(requantise(1, i32::MAX), 0);
        assert_eq!(requantise(3, i32::MAX), 1);
        assert_eq!(requantise(i32::MAX, i32::MAX), (1 << 30) - 1);
        assert_eq!(requantise(i32::MIN, i32::MAX), -(1 << 30) + 1);
        assert_eq!(requantise(i32::MIN, i32::MIN), 1 << 30);
        assert_eq!(requantise(i32::MIN, 0), 0);
    }

    #[test]
    fn clamp_by_hand() {
        let x = [i32::MIN, -128, -127, -1, 0, 1, 127, 128, i32::MAX];
        assert_eq!(x.map(|x| clamp(x, false)), [-127, -127, -127, -1, 0, 1, 127, 127, 127]);
        assert_eq!(x.map(|x| clamp(x, true)), [0, 0, 0, 0, 0, 1, 127, 127, 127]);
    }

    #[test]
    fn the_sigmoid_is_correctly_rounded() {
        for t in -512..=511 {
            let exact = 1024.0 / (1.0 + (-f64::from(t) / 64.0).exp());
            assert!((exact.fract() - 0.5).abs() > 1e-9, "{t} is close to a half");
            assert_eq!(f64::from(sigmoid_q10(t)), exact.round(), "{t}");
        }
        assert_eq!([i32::MIN, -513, -512, 0, 511, 512, i32::MAX].map(sigmoid_q10), [0, 0, 0, 512, 1024, 1024, 1024]);
        assert!((-513..513).all(|t| sigmoid_q10(t) <= sigmoid_q10(t + 1)));
    }
}
