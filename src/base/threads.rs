//! Who computes: the calling thread, workers of its own, or a rayon pool. Work is cut into tiles that any worker may take.
//!
//! A session's frames must not allocate. Rayon allocates now and then when a thread outside its pool hands it work, so
//! [`Threads::new`] makes plain threads that wait for one thing only; [`Threads::pool`] shares a pool where its owner
//! prefers that.

use rayon::ThreadPool;
use std::any::Any;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// The threads of a session. Their number cannot change a result.
#[derive(Clone)]
pub struct Threads(Kind);

#[derive(Clone)]
enum Kind {
    Calling,
    Own(Arc<Workers>),
    Pool(Arc<ThreadPool>),
}

impl fmt::Debug for Threads {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Threads({})", self.count())
    }
}

impl Threads {
    /// Only the thread that calls.
    pub fn calling() -> Self {
        Self(Kind::Calling)
    }

    /// An existing pool, shared with whoever else uses it. Handing a frame to it from outside allocates a little, once in
    /// some sixty frames.
    pub fn pool(pool: Arc<ThreadPool>) -> Self {
        Self(Kind::Pool(pool))
    }

    /// The calling thread and `count` - 1 of their own; the calling thread alone for 0 or 1. They end with the last clone.
    ///
    /// Sessions may share them. Where two run at once, one has the threads for an operation and the other does with its own.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`](crate::ErrorKind::Unsupported) with the system's, if threads cannot be started.
    pub fn new(count: usize) -> crate::Result<Self> {
        if count <= 1 {
            return Ok(Self::calling());
        }
        let workers = Workers::new(count).map_err(|e| {
            crate::Error::new(crate::ErrorKind::Unsupported, format!("cannot start {count} threads: {e}"))
        })?;
        Ok(Self(Kind::Own(Arc::new(workers))))
    }

    /// Threads that compute.
    pub fn count(&self) -> usize {
        match &self.0 {
            Kind::Calling => 1,
            Kind::Own(own) => own.count(),
            Kind::Pool(pool) => pool.current_num_threads(),
        }
    }

    /// Runs `f` on every thread at once.
    pub fn broadcast<R: Send>(&self, f: impl Fn() -> R + Sync) -> Vec<R> {
        match &self.0 {
            Kind::Calling => vec![f()],
            Kind::Own(own) => {
                let results: Vec<Mutex<Option<R>>> = (0..own.count()).map(|_| Mutex::new(None)).collect();
                let turn = own.turn.lock().unwrap_or_else(PoisonError::into_inner);
                own.run(turn, own.count(), &|worker| *lock(&results[worker]) = Some(f()));
                results.into_iter().filter_map(|r| r.into_inner().unwrap_or_else(PoisonError::into_inner)).collect()
            }
            Kind::Pool(pool) => pool.broadcast(|_| f()),
        }
    }

    /// Runs `f`, which calls [`Threads::for_each_tile`], where that is cheapest.
    pub(crate) fn enter<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        match &self.0 {
            Kind::Pool(pool) => pool.install(f),
            Kind::Calling | Kind::Own(_) => f(),
        }
    }

    /// Calls `tile(worker, index)` once for every index below `tiles`, on up to `workers` threads. At any moment each
    /// worker number is in use by one call at most. Allocates nothing.
    ///
    /// # Panics
    /// If a tile does, once no other is running.
    pub(crate) fn for_each_tile(&self, workers: usize, tiles: usize, tile: &(dyn Fn(usize, usize) + Sync)) {
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
        let workers = workers.min(tiles).min(self.count());
        match &self.0 {
            _ if workers <= 1 => work(0),
            Kind::Calling => work(0),
            // Another session's operation is under way: waiting for it would take longer than going alone.
            Kind::Own(own) => match own.turn.try_lock() {
                Ok(turn) => own.run(turn, workers, &work),
                Err(std::sync::TryLockError::Poisoned(turn)) => own.run(turn.into_inner(), workers, &work),
                Err(std::sync::TryLockError::WouldBlock) => work(0),
            },
            Kind::Pool(_) => fork(0, workers, &work),
        }
    }
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

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// How often a thread looks for news before it sleeps: some ten microseconds, the time that waking takes.
const SPINS: usize = 400;

/// Threads that wait for work and do it together with the thread that brings it.
struct Workers {
    shared: Arc<Shared>,
    /// Held by the one that brings work.
    turn: Mutex<()>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    job: Mutex<Job>,
    /// A round began, or the workers end.
    start: Condvar,
    /// Nobody is left working.
    done: Condvar,
    /// Copies of the job's `round` and `left`, to look at without the lock. Only the job decides.
    round: AtomicU64,
    left: AtomicUsize,
}

#[derive(Default)]
struct Job {
    /// Counts pieces of work.
    round: u64,
    work: Option<Work>,
    /// Worker numbers from 1 to below this take part.
    workers: usize,
    /// Threads that have not finished this round.
    left: usize,
    /// What the first of them to panic said.
    panic: Option<Box<dyn Any + Send>>,
    end: bool,
}

/// The closure of a round, without its type and lifetime.
#[derive(Clone, Copy)]
struct Work {
    closure: *const (),
    call: unsafe fn(*const (), usize),
}

// SAFETY: `Work::new` takes only closures that are `Sync`.
unsafe impl Send for Work {}

impl Work {
    fn new<W: Fn(usize) + Sync>(work: &W) -> Self {
        /// # Safety
        /// `closure` points to a living `W`.
        unsafe fn call<W: Fn(usize)>(closure: *const (), worker: usize) {
            // SAFETY: as the caller promises.
            unsafe { (*closure.cast::<W>())(worker) }
        }
        Self { closure: std::ptr::from_ref(work).cast(), call: call::<W> }
    }
}

impl Workers {
    fn new(count: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        // Dropping workers ends and joins those that were started, also when a later one cannot be.
        let mut own = Self { shared, turn: Mutex::new(()), threads: vec![] };
        for worker in 1..count {
            let shared = own.shared.clone();
            let builder = std::thread::Builder::new().name(format!("voxcast {worker}"));
            own.threads.push(builder.spawn(move || shared.serve(worker))?);
        }
        Ok(own)
    }

    fn count(&self) -> usize {
        self.threads.len() + 1
    }

    /// Runs `work(0)` here and `work(1)` to `work(workers - 1)` on the others, and returns when all of them have.
    fn run<W: Fn(usize) + Sync>(&self, turn: MutexGuard<'_, ()>, workers: usize, work: &W) {
        let shared = &*self.shared;
        {
            let mut job = lock(&shared.job);
            job.round += 1;
            job.work = Some(Work::new(work));
            job.workers = workers.min(self.count());
            job.left = job.workers - 1;
            shared.left.store(job.left, Ordering::Release);
            shared.round.store(job.round, Ordering::Release);
        }
        shared.start.notify_all();
        // Also after a panic here, others still use `work`.
        let own = catch_unwind(AssertUnwindSafe(|| work(0)));
        for _ in 0..SPINS {
            if shared.left.load(Ordering::Acquire) == 0 {
                break;
            }
            std::hint::spin_loop();
        }
        let mut job = lock(&shared.job);
        while job.left > 0 {
            job = shared.done.wait(job).unwrap_or_else(PoisonError::into_inner);
        }
        job.work = None;
        let theirs = job.panic.take();
        drop(job);
        drop(turn);
        if let Some(panic) = own.err().or(theirs) {
            resume_unwind(panic);
        }
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        lock(&self.shared.job).end = true;
        self.shared.start.notify_all();
        for thread in self.threads.drain(..) {
            // A worker catches every panic of the work, so there is none to pass on.
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// The life of thread `worker`.
    fn serve(&self, worker: usize) {
        let mut seen = 0;
        loop {
            for _ in 0..SPINS {
                if self.round.load(Ordering::Acquire) != seen {
                    break;
                }
                std::hint::spin_loop();
            }
            let mut job = lock(&self.job);
            while job.round == seen && !job.end {
                job = self.start.wait(job).unwrap_or_else(PoisonError::into_inner);
            }
            if job.end {
                return;
            }
            seen = job.round;
            if worker >= job.workers {
                continue;
            }
            let Some(Work { closure, call }) = job.work else { continue };
            drop(job);
            // SAFETY: this thread is one of those that the round's `left` counts, and `Workers::run`, which borrows the
            // closure that the work was made of, does not end before `left` is 0.
            let result = catch_unwind(AssertUnwindSafe(|| unsafe { call(closure, worker) }));
            let mut job = lock(&self.job);
            job.left -= 1;
            self.left.store(job.left, Ordering::Release);
            if let Err(panic) = result {
                job.panic.get_or_insert(panic);
            }
            if job.left == 0 {
                self.done.notify_one();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicU32;

    /// Every kind of threads with `count` of them.
    fn kinds(count: usize) -> Vec<Threads> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().expect("threads");
        vec![Threads::new(count).expect("threads"), Threads::pool(Arc::new(pool))]
    }

    #[test]
    fn every_tile_once_and_no_worker_twice_at_once() {
        for threads in [1, 2, 3, 8].into_iter().flat_map(kinds) {
            let count = threads.count();
            for (workers, tiles) in [(count, 1000), (count, 0), (count, 1), (count, 2), (1, 50), (2, 50)] {
                let seen: Vec<AtomicU32> = (0..tiles).map(|_| AtomicU32::new(0)).collect();
                let busy: Vec<AtomicU32> = (0..workers).map(|_| AtomicU32::new(0)).collect();
                threads.enter(|| {
                    threads.for_each_tile(workers, tiles, &|worker, index| {
                        assert_eq!(busy[worker].fetch_add(1, Ordering::SeqCst), 0);
                        seen[index].fetch_add(1, Ordering::SeqCst);
                        busy[worker].fetch_sub(1, Ordering::SeqCst);
                    });
                });
                assert!(seen.iter().all(|n| n.load(Ordering::SeqCst) == 1), "{workers} workers, {tiles} tiles");
            }
        }
    }

    #[test]
    fn many_short_rounds_from_many_sides() {
        let threads = Threads::new(3).expect("threads");
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    for round in 0..3000 {
                        let sum = AtomicUsize::new(0);
                        threads.for_each_tile(3, round % 7, &|_, index| {
                            sum.fetch_add(index + 1, Ordering::Relaxed);
                        });
                        let tiles = round % 7;
                        assert_eq!(sum.load(Ordering::Relaxed), tiles * (tiles + 1) / 2);
                    }
                });
            }
        });
    }

    #[test]
    fn broadcasts_reach_every_thread() {
        for threads in [1, 2, 5].into_iter().flat_map(kinds) {
            let mut ids = threads.broadcast(|| std::thread::current().id());
            assert_eq!(ids.len(), threads.count());
            ids.sort_by_key(|id| format!("{id:?}"));
            ids.dedup();
            assert_eq!(ids.len(), threads.count(), "different threads");
        }
    }

    #[test]
    fn a_panic_arrives_and_harms_nobody() {
        for threads in kinds(3) {
            for bad in [0, 1, 499] {
                let result = catch_unwind(AssertUnwindSafe(|| {
                    threads.enter(|| threads.for_each_tile(3, 500, &|_, index| assert_ne!(index, bad, "tile {bad}")));
                }));
                let panic = result.expect_err("a tile panicked");
                let text = panic.downcast_ref::<String>().expect("a message");
                assert!(text.contains(&format!("tile {bad}")), "{text}");
            }
            let sum = AtomicUsize::new(0);
            threads.enter(|| {
                threads.for_each_tile(3, 100, &|_, index| {
                    sum.fetch_add(index, Ordering::Relaxed);
                });
            });
            assert_eq!(sum.into_inner(), 4950);
        }
    }

    #[test]
    fn none_and_one_are_the_caller() {
        for count in [0, 1] {
            let threads = Threads::new(count).expect("nothing to start");
            assert_eq!(threads.count(), 1);
            let here = std::thread::current().id();
            threads.for_each_tile(4, 10, &|worker, _| {
                assert_eq!((worker, std::thread::current().id()), (0, here));
            });
        }
        assert_eq!(format!("{:?}", Threads::new(2).expect("threads")), "Threads(2)");
    }
}
