//! Rows of a matrix in the making: the set of a row's pixels, and rows one after the other.

use crate::base::error::{Error, ErrorKind, Result};

pub(super) fn too_many_entries() -> Error {
    Error::new(ErrorKind::TooLarge, "a projection matrix has more entries than 32 bits count")
}

pub(super) fn out_of_memory(_: std::collections::TryReserveError) -> Error {
    Error::new(ErrorKind::TooLarge, "no memory for the projection matrices")
}

/// Rows that grow: a slab's rows while it is computed, so that slabs themselves take no more memory than they need.
#[derive(Default)]
pub(super) struct Growing {
    pub(super) ends: Vec<u32>,
    /// Entries, the first `used` of it.
    pub(super) col: Vec<u32>,
    pub(super) used: usize,
}

impl Growing {
    pub(super) fn clear(&mut self) {
        self.ends.clear();
        self.used = 0;
    }

    /// Becomes empty, with room for so many rows and entries.
    pub(super) fn grow_to(&mut self, [rows, entries]: [usize; 2]) -> Result<()> {
        self.clear();
        self.ends.try_reserve_exact(rows).map_err(out_of_memory)?;
        self.reserve(entries)
    }

    /// Rows and entries that there is room for.
    pub(super) fn room(&self) -> [usize; 2] {
        [self.ends.capacity(), self.col.len()]
    }

    /// Room for `more` entries.
    pub(super) fn reserve(&mut self, more: usize) -> Result<()> {
        let needed = self.used + more;
        if needed > u32::MAX as usize {
            return Err(too_many_entries());
        }
        if needed > self.col.len() {
            self.col.try_reserve(needed - self.col.len()).map_err(out_of_memory)?;
            // Whatever the allocator gave, so that this happens seldom.
            self.col.resize(self.col.capacity(), 0);
        }
        Ok(())
    }

    /// Moves the pixels of `set`, ascending, into a new row; tells `each` the words that hold them. `reserve` made room.
    pub(super) fn push_row(&mut self, set: &mut PixelSet, mut each: impl FnMut(usize, u64)) {
        let (col, mut used) = (&mut self.col[..], self.used);
        set.drain(|word, mut bits| {
            each(word, bits);
            let base = (word * 64) as u32;
            while bits != 0 {
                col[used] = base + bits.trailing_zeros();
                used += 1;
                bits &= bits - 1;
            }
        });
        self.used = used;
        self.ends.push(used as u32);
    }
}

/// A set of flat pixels: a bitmap, and a bitmap of its words that are not 0.
pub(super) struct PixelSet {
    words: Vec<u64>,
    summary: Vec<u64>,
    /// Words of the summary that may be set.
    first: usize,
    last: usize,
}

impl Default for PixelSet {
    fn default() -> Self {
        Self { words: Vec::new(), summary: Vec::new(), first: usize::MAX, last: 0 }
    }
}

impl PixelSet {
    pub(super) fn reserve(&mut self, pixels: usize) -> Result<()> {
        let summary = pixels.div_ceil(4096);
        if summary > self.summary.len() {
            self.summary.try_reserve_exact(summary - self.summary.len()).map_err(out_of_memory)?;
            self.words.try_reserve_exact(summary * 64 - self.words.len()).map_err(out_of_memory)?;
            self.summary.resize(summary, 0);
            self.words.resize(summary * 64, 0);
        }
        Ok(())
    }

    /// Adds the pixels at `from..from + n` of each line of `hits` that are not 0.
    pub(super) fn insert_voxel(&mut self, hits: &[u32], line: usize, from: usize, n: usize) {
        let (mut least, mut most) = (u32::MAX, 0);
        for line in hits.chunks_exact(line) {
            for &pixel in &line[from..from + n] {
                if pixel != 0 {
                    let word = pixel as usize / 64;
                    self.words[word] |= 1 << (pixel % 64);
                    self.summary[word / 64] |= 1 << (word % 64);
                    least = least.min(pixel);
                    most = most.max(pixel);
                }
            }
        }
        if most != 0 {
            self.first = self.first.min(least as usize / 4096);
            self.last = self.last.max(most as usize / 4096);
        }
    }

    /// Adds the pixels `word * 64 + i` of the bits i, of which at least one is set.
    pub(super) fn insert_word(&mut self, word: usize, bits: u64) {
        self.words[word] |= bits;
        self.summary[word / 64] |= 1 << (word % 64);
        self.first = self.first.min(word / 64);
        self.last = self.last.max(word / 64);
    }

    /// Empties the set, telling `each` its words that are not 0, ascending.
    pub(super) fn drain(&mut self, mut each: impl FnMut(usize, u64)) {
        if self.first > self.last {
            return;
        }
        for (s, summary) in self.summary.iter_mut().enumerate().take(self.last + 1).skip(self.first) {
            let mut bits = std::mem::take(summary);
            while bits != 0 {
                let word = s * 64 + bits.trailing_zeros() as usize;
                each(word, std::mem::take(&mut self.words[word]));
                bits &= bits - 1;
            }
        }
        (self.first, self.last) = (usize::MAX, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_count_to_32_bits() {
        let mut rows = Growing { used: u32::MAX as usize - 3, ..Growing::default() };
        assert_eq!(rows.reserve(4).unwrap_err().kind(), ErrorKind::TooLarge);
        assert_eq!(rows.col.capacity(), 0, "refused before allocating");
    }

    #[test]
    fn a_pixel_set_drains_ascending_and_clean() {
        let mut set = PixelSet::default();
        set.reserve(300_000).unwrap();
        for _ in 0..2 {
            let mut rows = Growing::default();
            rows.reserve(10).unwrap();
            set.insert_voxel(&[9, 299_999, 0, 9, 64, 4096, 9, 262_144, 0], 3, 1, 2);
            set.insert_word(1, 0b11);
            let mut words = Vec::new();
            rows.push_row(&mut set, |w, _| words.push(w));
            assert_eq!(rows.col[..rows.used], [64, 65, 4096, 262_144, 299_999], "column 0 of each line stays out");
            assert_eq!(words, [1, 64, 4096, 4687]);
            assert_eq!(rows.ends, [5]);
            assert!(set.words.iter().chain(&set.summary).all(|&w| w == 0));
        }
    }
}
