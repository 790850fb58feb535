//! Aligned memory that a session takes once, and the only way to look into it.
//!
//! Operations read some ranges of the arena while several threads write others. The borrow checker cannot see that those
//! ranges are apart; the plan guarantees it, and [`crate::runtime::executor`] checks it once per operation when a session is made.

use crate::runtime::plan::{ALIGNMENT, Region};
use bytemuck::{Pod, Zeroable};
use std::marker::PhantomData;
use std::ops::Range;

/// A cache line.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([u8; ALIGNMENT]);

/// 64-byte aligned, zeroed memory of fixed size.
pub(crate) struct Arena {
    lines: Vec<Line>,
}

impl Arena {
    /// `len` bytes, rounded up to whole lines; `None` if the system has no memory for them.
    pub(crate) fn new(len: usize) -> Option<Self> {
        let mut lines = Vec::new();
        lines.try_reserve_exact(len.div_ceil(ALIGNMENT)).ok()?;
        #[cfg(target_os = "linux")]
        ask_for_huge_pages(&mut lines);
        // Writing every line also makes every page present, so that no frame waits for one.
        lines.resize(len.div_ceil(ALIGNMENT), Line([0; ALIGNMENT]));
        Some(Self { lines })
    }

    /// How many bytes it has.
    pub(crate) fn len(&self) -> usize {
        std::mem::size_of_val(&self.lines[..])
    }

    /// Its bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.lines)
    }

    /// Its bytes, to be written.
    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        bytemuck::cast_slice_mut(&mut self.lines)
    }

    /// A view that threads may share.
    pub(crate) fn view(&mut self) -> Shared<'_> {
        let bytes = self.bytes_mut();
        Shared { base: bytes.as_mut_ptr(), len: bytes.len(), memory: PhantomData }
    }
}

/// Asks Linux for huge pages, which are present sooner and found faster. Nothing depends on whether there are any.
#[cfg(target_os = "linux")]
fn ask_for_huge_pages(lines: &mut Vec<Line>) {
    const PAGE: usize = 4096;
    let start = lines.as_mut_ptr().cast::<u8>();
    let skip = start.align_offset(PAGE);
    let len = (lines.capacity() * ALIGNMENT).saturating_sub(skip) / PAGE * PAGE;
    // SAFETY: whole pages of memory that `lines` owns; the advice changes what backs them, not what they hold.
    unsafe { libc::madvise(start.wrapping_add(skip).cast(), len, libc::MADV_HUGEPAGE) };
}

/// Shared access to memory while an operation runs.
#[derive(Clone, Copy)]
pub(crate) struct Shared<'a> {
    base: *mut u8,
    len: usize,
    memory: PhantomData<&'a mut [u8]>,
}

// SAFETY: a view is a pointer into memory that `'a` keeps alive and exclusively borrowed; what may be read and written
// through it at one time is the contract of the two methods.
unsafe impl Send for Shared<'_> {}
// SAFETY: as above.
unsafe impl Sync for Shared<'_> {}

impl<'a> Shared<'a> {
    /// The bytes in `range`.
    ///
    /// # Safety
    /// Nothing in `range` may be written while the result lives.
    ///
    /// # Panics
    /// If `range` is not within the memory.
    pub(crate) unsafe fn read(self, range: Range<usize>) -> &'a [u8] {
        assert!(range.start <= range.end && range.end <= self.len, "range outside the memory");
        // SAFETY: in bounds as just checked, initialised since `Arena::new`, and unwritten as the caller promises.
        unsafe { std::slice::from_raw_parts(self.base.add(range.start), range.len()) }
    }

    /// The bytes in `range`, to be written.
    ///
    /// # Safety
    /// Nothing in `range` may be read or written through another reference while the result lives.
    ///
    /// # Panics
    /// If `range` is not within the memory.
    pub(crate) unsafe fn write(self, range: Range<usize>) -> &'a mut [u8] {
        assert!(range.start <= range.end && range.end <= self.len, "range outside the memory");
        // SAFETY: in bounds as just checked, initialised since `Arena::new`, and exclusive as the caller promises.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(range.start), range.len()) }
    }
}

/// All memory that a graph's tensors lie in.
#[derive(Clone, Copy)]
pub(crate) struct Regions<'a> {
    pub(crate) input: Shared<'a>,
    pub(crate) arena: Shared<'a>,
    pub(crate) output: Shared<'a>,
}

impl<'a> Regions<'a> {
    pub(crate) fn of(&self, region: Region) -> Shared<'a> {
        match region {
            Region::Input => self.input,
            Region::Arena => self.arena,
            Region::Output => self.output,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligned_zeroed_and_bounded() {
        let mut arena = Arena::new(400).expect("small");
        assert_eq!(arena.len(), 448);
        let view = arena.view();
        // SAFETY: nothing else refers to the arena.
        let bytes = unsafe { view.read(0..448) };
        assert_eq!(bytes.as_ptr() as usize % 64, 0);
        assert!(bytes.iter().all(|&v| v == 0));
        // SAFETY: the call panics before it makes a reference.
        let outside = std::panic::AssertUnwindSafe(|| unsafe { view.read(0..449).len() });
        assert!(std::panic::catch_unwind(outside).is_err());
    }

    #[test]
    fn impossible_sizes_are_refused() {
        assert!(Arena::new(usize::MAX / 2).is_none());
    }
}
