//! The self-test as a model carries it; [`crate::check::selftest`] records and runs it.

use serde::{Deserialize, Serialize};

/// Metadata key of a model file under which its self-test stands, as JSON.
pub const KEY: &str = "self_test";

/// A stimulus and what it must give.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelfTest {
    /// What the images are drawn from.
    pub seed: u64,
    /// Per operation in running order, of each camera in turn: its name and 16 hexadecimal digits, the
    /// [digest](crate::base::digest::floats) of what it writes.
    pub operations: Vec<(String, String)>,
    /// Digest of the classes.
    pub classes: String,
    /// Digest of the logits.
    pub logits: String,
}
