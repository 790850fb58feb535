//! Slices whose neighbours cannot be touched.

use half::f16;
use std::ops::{Deref, DerefMut};
use std::vec::Vec;

/// Where a case's slices lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Memory {
    /// On the heap.
    Heap,
    /// Each slice begins where a page ends that can be neither read nor written. A step before it ends the process.
    #[cfg(unix)]
    Front,
    /// Each slice ends where such a page begins.
    #[cfg(unix)]
    Back,
}

impl Memory {
    /// All of them.
    pub const ALL: &[Self] = &[
        Self::Heap,
        #[cfg(unix)]
        Self::Front,
        #[cfg(unix)]
        Self::Back,
    ];

    /// A copy of `values` there.
    pub fn hold<T: Plain>(self, values: &[T]) -> Held<T> {
        match self {
            Memory::Heap => Held(Kind::Heap(values.to_vec())),
            #[cfg(unix)]
            Memory::Front | Memory::Back => Held(Kind::Guarded(guarded::Guarded::new(self, values))),
        }
    }

    /// `len` times `value` there.
    pub fn filled<T: Plain>(self, len: usize, value: T) -> Held<T> {
        self.hold(&std::vec![value; len])
    }
}

/// Plain values without padding, which can be copied byte by byte.
pub trait Plain: Copy {}
impl Plain for bool {}
impl Plain for u8 {}
impl Plain for i8 {}
impl Plain for i32 {}
impl Plain for u32 {}
impl Plain for f16 {}
impl Plain for f32 {}

/// A slice in some [`Memory`].
pub struct Held<T: Plain>(Kind<T>);

enum Kind<T: Plain> {
    Heap(Vec<T>),
    #[cfg(unix)]
    Guarded(guarded::Guarded<T>),
}

impl<T: Plain> Deref for Held<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        match &self.0 {
            Kind::Heap(values) => values,
            #[cfg(unix)]
            Kind::Guarded(values) => values,
        }
    }
}

impl<T: Plain> DerefMut for Held<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.0 {
            Kind::Heap(values) => values,
            #[cfg(unix)]
            Kind::Guarded(values) => values,
        }
    }
}

#[cfg(unix)]
mod guarded {
    use super::{Memory, Plain};
    use std::ops::{Deref, DerefMut};
    use std::ptr::NonNull;

    /// A slice between two pages that cannot be touched, against one of them.
    pub(super) struct Guarded<T: Plain> {
        map: NonNull<u8>,
        map_len: usize,
        first: NonNull<T>,
        len: usize,
    }

    impl<T: Plain> Guarded<T> {
        pub(super) fn new(side: Memory, values: &[T]) -> Self {
            // SAFETY: sysconf takes no pointers.
            let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).expect("pages have a size");
            let bytes = size_of_val(values);
            let inside = bytes.next_multiple_of(page);
            let map_len = inside + 2 * page;
            // SAFETY: a new anonymous mapping overlaps nothing.
            let map = unsafe {
                libc::mmap(std::ptr::null_mut(), map_len, libc::PROT_NONE, libc::MAP_PRIVATE | libc::MAP_ANON, -1, 0)
            };
            assert!(map != libc::MAP_FAILED, "mmap failed");
            let map = NonNull::new(map.cast::<u8>()).expect("a mapping has an address");
            // SAFETY: the pages from the second to the last but one belong to the mapping.
            let allowed =
                unsafe { libc::mprotect(map.as_ptr().add(page).cast(), inside, libc::PROT_READ | libc::PROT_WRITE) };
            assert!(inside == 0 || allowed == 0, "mprotect failed");
            let at = if side == Memory::Front { page } else { page + inside - bytes };
            // SAFETY: `at` is inside the mapping; it is a multiple of T's size and so of its alignment, because pages and
            // `bytes` are.
            let first = unsafe { map.add(at) }.cast::<T>();
            // SAFETY: from `first` on, `bytes` bytes are writable and belong to nothing else.
            unsafe { std::ptr::copy_nonoverlapping(values.as_ptr(), first.as_ptr(), values.len()) };
            Self { map, map_len, first, len: values.len() }
        }
    }

    impl<T: Plain> Deref for Guarded<T> {
        type Target = [T];
        fn deref(&self) -> &[T] {
            // SAFETY: `new` wrote `len` values from `first` on; they live until `drop`.
            unsafe { std::slice::from_raw_parts(self.first.as_ptr(), self.len) }
        }
    }

    impl<T: Plain> DerefMut for Guarded<T> {
        fn deref_mut(&mut self) -> &mut [T] {
            // SAFETY: as in `deref`, and `self` is borrowed mutably.
            unsafe { std::slice::from_raw_parts_mut(self.first.as_ptr(), self.len) }
        }
    }

    impl<T: Plain> Drop for Guarded<T> {
        fn drop(&mut self) {
            // SAFETY: the mapping is `new`'s, and nothing borrows from it any more.
            unsafe { libc::munmap(self.map.as_ptr().cast(), self.map_len) };
        }
    }
}
