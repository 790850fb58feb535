//! Who computes: the calling thread, or a pool. Work is cut into tiles that any worker may take.

use rayon::ThreadPool;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The threads of a session. Their number cannot change a result.
#[derive(Clone)]
pub struct Threads(Option<Arc<ThreadPool>>);

impl fmt::Debug for Threads {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Threads({})", self.count())
    }
}

impl Threads {
    /// Only the thread that calls.
    pub fn calling() -> Self {
        Self(None)
    }

    /// An existing pool, shared with whoever else uses it.
    pub fn pool(pool: Arc<ThreadPool>) -> Self {
        Self(Some(pool))
    }

    /// A pool of its own with `count` threads; the calling thread alone for 0 or 1.
    ///
    /// # Errors
    /// The system's, if threads cannot be started.
    pub fn new(count: usize) -> crate::Result<Self> {
        if count <= 1 {
            return Ok(Self::calling());
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().map_err(|e| {
            crate::Error::new(crate::ErrorKind::Unsupported, format!("cannot start {count} threads: {e}"))
        })?;
        Ok(Self(Some(Arc::new(pool))))
    }

    /// Threads that compute.
    pub fn count(&self) -> usize {
        self.0.as_ref().map_or(1, |pool| pool.current_num_threads())
    }

    /// Runs `f` on every thread at once.
    pub fn broadcast<R: Send>(&self, f: impl Fn() -> R + Sync) -> Vec<R> {
        match &self.0 {
            Some(pool) => pool.broadcast(|_| f()),
            None => vec![f()],
        }
    }

    /// Runs `f` on these threads: what it does in parallel with rayon stays among them.
    pub fn install<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        match &self.0 {
            Some(pool) => pool.install(f),
            None => f(),
        }
    }
}

/// Calls `tile(worker, index)` once for every index below `tiles`, on up to `workers` threads of the current pool. At any
/// moment each worker number is in use by one call at most. Allocates nothing.
pub(crate) fn for_each_tile(workers: usize, tiles: usize, tile: &(dyn Fn(usize, usize) + Sync)) {
    let next = AtomicUsize::new(0);
    let work = |worker: usize| {
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            if index >= tiles {
                return;
            }
            tile(worker, index);
        }
    };
    fork(0, workers.min(tiles), &work);
}

/// Runs `work` for each worker number in `first..end`, as far as possible at once.
fn fork(first: usize, end: usize, work: &(dyn Fn(usize) + Sync)) {
    match end - first {
        0 => {}
        1 => work(first),
        n => {
            let middle = first + n / 2;
            rayon::join(|| fork(first, middle, work), || fork(middle, end, work));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicU32;

    #[test]
    fn every_tile_once_and_no_worker_twice_at_once() {
        for count in [1, 2, 3, 8] {
            let threads = Threads::new(count).expect("threads");
            assert_eq!(threads.count(), count);
            let seen: Vec<AtomicU32> = (0..1000).map(|_| AtomicU32::new(0)).collect();
            let busy: Vec<AtomicU32> = (0..count).map(|_| AtomicU32::new(0)).collect();
            threads.install(|| {
                for_each_tile(count, seen.len(), &|worker, index| {
                    assert_eq!(busy[worker].fetch_add(1, Ordering::SeqCst), 0);
                    seen[index].fetch_add(1, Ordering::SeqCst);
                    busy[worker].fetch_sub(1, Ordering::SeqCst);
                });
            });
            assert!(seen.iter().all(|n| n.load(Ordering::SeqCst) == 1));
        }
    }
}
