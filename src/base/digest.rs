//! Digests of results, by which two of them are compared at a glance.

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

/// XXH3-64 (seed 0) of bytes, such as classes.
pub fn bytes(bytes: &[u8]) -> u64 {
    xxh3_64(bytes)
}

/// XXH3-64 (seed 0) of f32 values as little-endian bytes; every NaN counts as 0x7fc00000, because its payload is not promised.
/// Allocates nothing.
pub fn floats(values: &[f32]) -> u64 {
    let mut hash = Xxh3::new();
    let mut block = [0u8; 1024];
    for values in values.chunks(block.len() / 4) {
        for (bytes, &value) in block.chunks_exact_mut(4).zip(values) {
            let value = if value.is_nan() { f32::from_bits(0x7fc0_0000) } else { value };
            bytes.copy_from_slice(&value.to_le_bytes());
        }
        hash.update(&block[..4 * values.len()]);
    }
    hash.digest()
}

/// XXH3-64 (seed 0) of bytes that come in parts.
#[cfg(feature = "eval")]
pub(crate) struct Digest(Xxh3);

#[cfg(feature = "eval")]
impl Digest {
    pub(crate) fn new() -> Self {
        Self(Xxh3::new())
    }

    pub(crate) fn add(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    pub(crate) fn finish(&self) -> u64 {
        self.0.digest()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_are_their_bytes_and_any_nan_is_the_same() {
        let values: Vec<f32> = (0..1000).map(|i| i as f32 * 0.37 - 11.0).collect();
        assert_eq!(floats(&values), bytes(bytemuck::cast_slice(&values)));
        assert_ne!(floats(&[0.0]), floats(&[-0.0]));
        assert_eq!(floats(&[f32::NAN, 1.0]), floats(&[-f32::NAN, 1.0]));
        assert_ne!(floats(&[f32::NAN]), floats(&[f32::INFINITY]));
    }
}
