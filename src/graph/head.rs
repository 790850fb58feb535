//! The occupancy heads.

use super::{Builder, Op, Recipe, TensorId};
use crate::network::Network;

/// The volumes of levels 0 to 3 to classes; only level 0 unless `coarse`.
pub(super) fn build(b: &mut Builder, network: &Network, volumes: [TensorId; 4], coarse: bool) {
    for level in (0..if coarse { 4 } else { 1 }).rev() {
        let name = format!("occ_head.mlp_occ_lvl{level}");
        let extent = b.graph.tensor(volumes[level]).extent;
        b.push(&name, Op::Head { level }, &[volumes[level]], extent, network.classes);
        b.last().recipe = Recipe::Head(name);
        b.stage(format!("logits.lvl{level}"));
    }
}
