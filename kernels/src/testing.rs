//! What the kernels' tests share: numbers to compute with, and comparisons that name the place of a difference.

/// A small generator (splitmix64), so that tests see the same numbers everywhere.
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform on [-1, 1).
    pub(crate) fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    /// `n` numbers of order one.
    pub(crate) fn ordinary(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.unit()).collect()
    }

    /// `n` finite numbers over 24 binary orders of magnitude, with zeros of both signs and subnormals among them.
    pub(crate) fn wide(&mut self, n: usize) -> Vec<f32> {
        let mut one = || {
            let x = self.unit();
            match self.bits() % 16 {
                0 => 0.0,
                1 => -0.0,
                2 => x * f32::MIN_POSITIVE,
                _ => x * f32::from_bits(((115 + self.bits() % 24) as u32) << 23),
            }
        };
        (0..n).map(|_| one()).collect()
    }

    /// Like [`Rng::wide`], but about one number in 80 is infinite or NaN.
    pub(crate) fn special(&mut self, n: usize) -> Vec<f32> {
        let mut x = self.wide(n);
        for x in &mut x {
            match self.bits() % 240 {
                0 => *x = f32::INFINITY,
                1 => *x = f32::NEG_INFINITY,
                2 => *x = f32::NAN,
                _ => {}
            }
        }
        x
    }
}

/// A source of numbers: [`Rng::ordinary`], [`Rng::wide`] or [`Rng::special`].
pub(crate) type Fill = fn(&mut Rng, usize) -> Vec<f32>;

/// Asserts equal bits, except that any NaN equals any NaN.
#[track_caller]
pub(crate) fn assert_same_bits(got: &[f32], want: &[f32], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let same = g.to_bits() == w.to_bits() || (g.is_nan() && w.is_nan());
        assert!(same, "{what}: element {i} is {g:e} ({:08x}), not {w:e} ({:08x})", g.to_bits(), w.to_bits());
    }
}

/// Asserts that a comparison of these values means something: at least half are finite, and they are not all equal.
#[track_caller]
pub(crate) fn assert_lively(values: &[f32], what: &str) {
    let finite = values.iter().filter(|v| v.is_finite()).count();
    assert!(2 * finite >= values.len(), "{what}: only {finite} of {} values are finite", values.len());
    assert!(values.iter().any(|v| v.is_finite() && *v != values[0]), "{what}: all values are {}", values[0]);
}

/// Asserts |got - want| <= tolerance * (1 + |want|).
#[track_caller]
pub(crate) fn assert_close(got: &[f32], want: &[f64], tolerance: f64, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}: lengths differ");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*g) - w).abs();
        assert!(error <= tolerance * (1.0 + w.abs()), "{what}: element {i} is {g:e}, not {w:e}");
    }
}

/// Pads every row of `channels` numbers to a multiple of 16 with `junk`, which a kernel must not let show.
pub(crate) fn pad_rows(x: &[f32], channels: usize, junk: f32) -> Vec<f32> {
    let padded = channels.next_multiple_of(crate::LANES);
    let mut out = vec![junk; x.len() / channels * padded];
    for (from, to) in x.chunks_exact(channels).zip(out.chunks_exact_mut(padded)) {
        to[..channels].copy_from_slice(from);
    }
    out
}
