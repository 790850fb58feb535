//! Running a model: the plan of its memory, the arena, the executor of operations, and the session that callers hold.

pub(crate) mod arena;
pub(crate) mod executor;
pub mod plan;
pub mod session;
