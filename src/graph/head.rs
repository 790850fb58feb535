//! The occupancy heads.

use super::builder::Builder;
use super::element::Element;
use super::ops::Head;
use super::options::Results;
use super::recipe::Recipe;
use super::tensor::{Scope, Section, Tensor, TensorId};
use crate::network::Network;

/// The volumes of levels 0 to 3 to classes. What is no result of the frame is for observers.
pub(super) fn build(b: &mut Builder, network: &Network, volumes: [TensorId; 4], results: Results) {
    let Results { logits, coarse_heads, confidence } = results;
    b.section = Section::Head;
    for level in (0..if coarse_heads { 4 } else { 1 }).rev() {
        let name = format!("occ_head.mlp_occ_lvl{level}");
        let x = b.graph.tensor(volumes[level]).clone();
        let scope = |kept: bool| if level == 0 && kept { Scope::Output } else { Scope::Inner };
        let result = |what: &str, element, scope, channels| Tensor {
            name: format!("{name}.{what}"),
            element,
            section: Section::Head,
            scope,
            channels,
            ..x.clone()
        };
        let classes = b.add(result("classes", Element::U8, scope(true), 1));
        let confidence = confidence.filter(|_| level == 0);
        let mut outputs = vec![];
        if confidence.is_some() {
            let mut code = |what: &str| b.add(result(what, Element::U8, scope(true), 1));
            outputs.extend([code("confidence.occupied"), code("confidence.class")]);
        }
        outputs.push(classes);
        if logits || coarse_heads {
            outputs.push(b.add(result("logits", Element::F32, scope(logits), network.classes)));
        }
        b.push_into(&name, Head { classes: network.classes, confidence }, &[volumes[level]], &outputs, 0, 1);
        b.last().recipe = Recipe::Module(name);
        b.stage(format!("logits.lvl{level}"));
    }
}
