//! The one allocation of a session, and the only way to look into it.
//!
//! Operations read some ranges of the arena while several threads write others. The borrow checker cannot see that those
//! ranges are apart; the plan guarantees it, and [`crate::runtime::executor`] checks it once per operation when a session is made.

use bytemuck::{Pod, Zeroable};
use std::marker::PhantomData;
use std::ops::Range;
use voxcast_kernels::LANES;

/// A cache line of f32.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LANES]);

/// 64-byte aligned, zeroed memory of fixed size.
pub(crate) struct Arena {
    lines: Vec<Line>,
}

impl Arena {
    /// `len` numbers, rounded up to whole lines; `None` if the system has no memory for them.
    pub(crate) fn new(len: usize) -> Option<Self> {
        let mut lines = Vec::new();
        lines.try_reserve_exact(len.div_ceil(LANES)).ok()?;
        // Writing every line also makes every page present, so that no frame waits for one.
        lines.resize(len.div_ceil(LANES), Line([0.0; LANES]));
        Some(Self { lines })
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        std::mem::size_of_val(&self.lines[..])
    }

    /// A view that threads may share.
    pub(crate) fn view(&mut self) -> View<'_> {
        let numbers: &mut [f32] = bytemuck::cast_slice_mut(&mut self.lines);
        View { base: numbers.as_mut_ptr(), len: numbers.len(), arena: PhantomData }
    }
}

/// Shared access to the arena while an operation runs.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    base: *mut f32,
    len: usize,
    arena: PhantomData<&'a mut [f32]>,
}

// SAFETY: a view is a pointer into memory that `'a` keeps alive and exclusively borrowed; what may be read and written
// through it at one time is the contract of the two methods.
unsafe impl Send for View<'_> {}
// SAFETY: as above.
unsafe impl Sync for View<'_> {}

impl<'a> View<'a> {
    /// The numbers in `range`.
    ///
    /// # Safety
    /// Nothing in `range` may be written while the result lives.
    ///
    /// # Panics
    /// If `range` is not within the arena.
    pub(crate) unsafe fn read(self, range: Range<usize>) -> &'a [f32] {
        assert!(range.start <= range.end && range.end <= self.len, "range outside the arena");
        // SAFETY: in bounds as just checked, initialised since `Arena::new`, and unwritten as the caller promises.
        unsafe { std::slice::from_raw_parts(self.base.add(range.start), range.len()) }
    }

    /// The numbers in `range`, to be written.
    ///
    /// # Safety
    /// Nothing in `range` may be read or written through another reference while the result lives.
    ///
    /// # Panics
    /// If `range` is not within the arena.
    pub(crate) unsafe fn write(self, range: Range<usize>) -> &'a mut [f32] {
        assert!(range.start <= range.end && range.end <= self.len, "range outside the arena");
        // SAFETY: in bounds as just checked, initialised since `Arena::new`, and exclusive as the caller promises.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(range.start), range.len()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligned_zeroed_and_bounded() {
        let mut arena = Arena::new(100).expect("small");
        let view = arena.view();
        // SAFETY: nothing else refers to the arena.
        let numbers = unsafe { view.read(0..112) };
        assert_eq!(numbers.as_ptr() as usize % 64, 0);
        assert!(numbers.iter().all(|&v| v == 0.0));
        // SAFETY: the call panics before it makes a reference.
        let outside = std::panic::AssertUnwindSafe(|| unsafe { view.read(0..113).len() });
        assert!(std::panic::catch_unwind(outside).is_err());
    }

    #[test]
    fn impossible_sizes_are_refused() {
        assert!(Arena::new(usize::MAX / 4).is_none());
    }
}
