//! Room that a C program gives for a line of text.

use std::ffi::c_char;

/// Room for one line of text.
pub(super) struct Text {
    start: *mut c_char,
    capacity: usize,
}

impl Text {
    /// The room that starts at `start`, none if it is null.
    ///
    /// # Safety
    /// If `start` is not null, `capacity` bytes from it may be written as long as the value lives.
    pub(super) unsafe fn new(start: *mut c_char, capacity: usize) -> Self {
        Self { start, capacity: if start.is_null() { 0 } else { capacity } }
    }

    /// Writes as much of `text` as there is room for in whole characters, and a NUL.
    pub(super) fn write(&self, text: &str) {
        let Some(most) = self.capacity.checked_sub(1) else { return };
        let end = (0..=most.min(text.len())).rev().find(|&end| text.is_char_boundary(end)).unwrap_or(0);
        let text = &text[..end];
        // SAFETY: `text` and the NUL are at most `capacity` bytes, which `new`'s caller lets be written. Rust's string is
        // not within them: nothing of the library's was ever handed out for writing.
        unsafe {
            std::ptr::copy_nonoverlapping(text.as_ptr(), self.start.cast(), text.len());
            self.start.add(text.len()).write(0);
        }
    }
}
