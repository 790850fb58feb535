//! The checkpoint reader, against files that are written here byte by byte.

mod formats;
mod hostile;
#[path = "../support/pth.rs"]
mod pth;
