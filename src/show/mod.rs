//! Results to look at: pictures, and a page for a browser.

#[cfg(feature = "html")]
pub mod html;
#[cfg(feature = "images")]
pub mod picture;
