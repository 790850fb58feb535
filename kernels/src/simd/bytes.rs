//! Products of bytes, summed exactly in 32 bits: the loop in registers, a file per instruction set.
//!
//! A panel holds, per group of four k, 16 columns of four weights each: 64 bytes, of which every 32-bit lane belongs to one
//! column. A row's four elements of the group are copied into all lanes, and each lane adds its four products to its sum.
//!
//! Every form below gives the same sums modulo 2^32. What a form relies on is what the weights promise
//! ([`crate::matmul::int8`]); where the promise is broken sums are wrong, but nothing else is.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(super) mod avx512;
#[cfg(target_arch = "aarch64")]
pub(super) mod neon;

/// Values of k whose weights lie side by side, column by column.
pub const GROUP: usize = 4;
/// Bytes of a group of a panel.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
const STEP: usize = GROUP * super::LANES;

/// What is known of a product's operands. Weights are -127..=127.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Form {
    /// Whether left elements are -127..=127; else they are 0..=127.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "other products take signed elements anyway"))]
    pub(crate) signed: bool,
    /// Whether the products of two neighbouring groups can be added in 16 bits: in every column, the two weights of the one
    /// and the two of the other that meet in a 16-bit lane are together at most 258 in magnitude, and 127 * 258 < 2^15.
    pub(crate) pairs: bool,
}
