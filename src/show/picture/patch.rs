//! What the 3-D view is made of.

use glam::DVec3;

/// A flat piece in space: a parallelogram of two edges, or half of it.
#[derive(Clone, Copy)]
pub(crate) struct Patch {
    pub(crate) corner: DVec3,
    pub(crate) edges: [DVec3; 2],
    pub(crate) triangle: bool,
}
