//! The network written down as a graph.

use super::builder::Builder;
use super::operation::Graph;
use super::options::{Results, Rewrites};
use super::tensor::Lifetime;
use super::{backbone, head, neck, view};
use crate::network::Network;

impl Graph {
    /// The network's operations as published, one by one.
    pub fn build(network: &Network, results: Results) -> Self {
        let mut b = Builder::new(network);
        let stages = backbone::build(&mut b, network);
        let features = neck::build(&mut b, network, stages);
        b.graph.camera_operations = b.graph.operations.len();
        b.lifetime = Lifetime::Frame;
        let volumes = view::build(&mut b, network, features);
        head::build(&mut b, network, volumes, results);
        b.graph
    }

    /// The graph with the rewrites that are asked for.
    #[must_use]
    pub fn rewritten(self, rewrites: Rewrites) -> Self {
        let graph = if rewrites.batch_norm { self.fold_batch_norm() } else { self };
        let graph = if rewrites.projection { graph.fold_projection() } else { graph };
        if rewrites.winograd { graph.use_winograd() } else { graph }
    }
}
