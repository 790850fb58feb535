//! Camera bytes to 8-bit network input; zeros below and to the right.
//!
//! ```text
//! out[y][x][c] = clamp((image[y][x][c] * factors[c] + offsets[c] + 2^19) >> 20)            rounded once, halves upwards
//! ```
//!
//! A factor is `round(2^20 / scale of the output)`, at most [`MAX_FACTOR`]; an offset `round(-2^20 * mean / scale)`, at most
//! [`MAX_OFFSET`] in magnitude. Their rounding changes a result by at most `256 * 2^-21` of a step, 1/8192. No sum leaves
//! i32: `255 * 2^22 + 2^30 + 2^19 = 2 143 813 632 < 2^31`.
//!
//! A byte has 256 values: they are looked up, which no instruction set does faster than another.

use super::normalise::fill;
use crate::quantised::clamp;

/// Bits of factors and offsets behind the binary point.
pub const FRACTION: u32 = 20;
/// The largest factor: an output's step is not less than a quarter of a byte's.
pub const MAX_FACTOR: i32 = 4 << FRACTION;
/// The largest magnitude of an offset: 1024 steps of the output.
pub const MAX_OFFSET: i32 = 1 << 30;

/// What the three channels of an image become.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NormaliseI8 {
    /// Steps of the output per step of a byte.
    pub factors: [i32; 3],
    /// What a byte of 0 becomes.
    pub offsets: [i32; 3],
}

impl NormaliseI8 {
    /// What `byte` becomes in channel `c`.
    fn value(&self, c: usize, byte: u8) -> i8 {
        let sum = i32::from(byte) * self.factors[c] + self.offsets[c] + (1 << (FRACTION - 1));
        clamp(sum >> FRACTION, false)
    }
}

/// Rows `first_row..` of the padded image into `out`, which holds whole rows of `padded_width` pixels.
///
/// `image` is `[height, width, 3]` blue first. Rows from `height` on, and pixels from `width` on, are zero.
///
/// # Panics
/// If `image` is not `height * width * 3` bytes, `out` is not whole rows, or a factor or an offset is out of range.
///
/// # Determinism
/// The same on every machine.
pub fn normalise_i8(
    args: &NormaliseI8,
    image: &[u8],
    [height, width]: [usize; 2],
    padded_width: usize,
    first_row: usize,
    out: &mut [i8],
) {
    assert!(args.factors.iter().all(|f| (0..=MAX_FACTOR).contains(f)), "factors {:?}", args.factors);
    assert!(args.offsets.iter().all(|o| (-MAX_OFFSET..=MAX_OFFSET).contains(o)), "offsets {:?}", args.offsets);
    let mut tables = [[0; 256]; 3];
    for (c, table) in tables.iter_mut().enumerate() {
        for (value, byte) in table.iter_mut().zip(0..=255) {
            *value = args.value(c, byte);
        }
    }
    let [blue, green, red] = tables;
    fill(image, [height, width], padded_width, first_row, out, |[b, g, r]| {
        [blue[usize::from(b)], green[usize::from(g)], red[usize::from(r)]]
    });
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::normalise::{BGR_MEAN, normalise};

    const UNIT: i32 = 1 << FRACTION;

    #[test]
    fn by_hand() {
        let image: Vec<u8> = (0..12).map(|i| i * 10).collect();
        // Half of blue less 3, green less 100, three times red.
        let args = NormaliseI8 { factors: [UNIT / 2, UNIT, 3 * UNIT], offsets: [-3 * UNIT, -100 * UNIT, 0] };
        let mut out = vec![9; 3 * 3 * 3];
        normalise_i8(&args, &image, [2, 2], 3, 0, &mut out);
        assert_eq!(out[..9], [-3, -90, 60, 12, -60, 127, 0, 0, 0]);
        assert_eq!(out[9..18], [27, -30, 127, 42, 0, 127, 0, 0, 0]);
        assert_eq!(out[18..], [0; 9]);
        let mut last = vec![9; 9];
        normalise_i8(&args, &image, [2, 2], 3, 1, &mut last);
        assert_eq!(last, out[9..18]);
        // 1/2 - 1/2 and -3/2: halves go upwards.
        let args = NormaliseI8 { factors: [UNIT / 2; 3], offsets: [-UNIT / 2, -2 * UNIT, -200 * UNIT] };
        normalise_i8(&args, &[1, 1, 1], [1, 1], 1, 0, &mut out[..3]);
        assert_eq!(out[..3], [0, -1, -127]);
    }

    /// Every byte, against the floating-point input divided by its scale.
    #[test]
    fn every_byte_agrees_with_f64() {
        let image: Vec<u8> = (0..=255).flat_map(|byte| [byte; 3]).collect();
        let mut real = vec![0.0; 256 * 3];
        normalise(&image, 1, 256, 256, 0, &mut real);
        for scale in [0.25, 1.196_2, 2.0, 37.5] {
            let fixed = |x: f64| (x / scale * f64::from(UNIT)).round() as i32;
            let args = NormaliseI8 { factors: [fixed(1.0); 3], offsets: BGR_MEAN.map(|mean| fixed(-f64::from(mean))) };
            let mut out = vec![9; 256 * 3];
            normalise_i8(&args, &image, [1, 256], 256, 0, &mut out);
            for (got, real) in out.iter().zip(&real) {
                let exact = (f64::from(*real) / scale).clamp(-127.0, 127.0);
                assert!((f64::from(*got) - exact).abs() < 0.5 + 1.0 / 4096.0, "{got} is not {exact}");
            }
        }
    }

    #[test]
    fn extremes_stay_inside_of_i32() {
        for (factor, offset, want) in
            [(MAX_FACTOR, MAX_OFFSET, 127), (MAX_FACTOR, -MAX_OFFSET, -4), (0, -MAX_OFFSET, -127)]
        {
            let args = NormaliseI8 { factors: [factor; 3], offsets: [offset; 3] };
            let mut out = [9; 3];
            normalise_i8(&args, &[255; 3], [1, 1], 1, 0, &mut out);
            // 255 * 4 - 1024 = -4.
            assert_eq!(out, [want; 3]);
        }
        assert!(255 * i64::from(MAX_FACTOR) + i64::from(MAX_OFFSET) + i64::from(UNIT / 2) < 1 << 31);
    }

    #[test]
    #[should_panic(expected = "factors [0, -1, 0]")]
    fn a_negative_factor() {
        normalise_i8(&NormaliseI8 { factors: [0, -1, 0], offsets: [0; 3] }, &[], [0, 0], 1, 0, &mut []);
    }

    #[test]
    #[should_panic(expected = "the output is not whole rows")]
    fn four_channels() {
        normalise_i8(&NormaliseI8 { factors: [0; 3], offsets: [0; 3] }, &[0; 3], [1, 1], 1, 0, &mut [0; 4]);
    }
}
