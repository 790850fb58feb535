//! Checks of what was computed: the self-test that a model carries, and two results compared stage by stage.

pub mod compare;
pub mod selftest;
