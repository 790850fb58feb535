//! After the first frame nothing is allocated, on any thread of the process.
//!
//! This file holds one test only: a second one would run beside it, and its allocations would count.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use small::Images;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use voxcast::graph::Rewrites;
use voxcast::weights::Precision;
use voxcast::{Isa, Session, SessionOptions, Threads};

/// The system's allocator, which counts while it is told to.
struct Counting;

static COUNTING: AtomicBool = AtomicBool::new(false);
static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);

fn count(bytes: usize) {
    if COUNTING.load(Ordering::SeqCst) {
        CALLS.fetch_add(1, Ordering::SeqCst);
        BYTES.fetch_add(bytes, Ordering::SeqCst);
    }
}

// SAFETY: every call goes to the system's allocator unchanged; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: the caller's promises are those of `System::alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(0);
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size);
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Calls of the allocator while `work` runs, and the bytes they asked for.
fn counted(work: impl FnOnce()) -> (usize, usize) {
    CALLS.store(0, Ordering::SeqCst);
    BYTES.store(0, Ordering::SeqCst);
    COUNTING.store(true, Ordering::SeqCst);
    work();
    COUNTING.store(false, Ordering::SeqCst);
    (CALLS.load(Ordering::SeqCst), BYTES.load(Ordering::SeqCst))
}

/// Queues that grow by blocks would show after some dozens of frames.
const FRAMES: usize = 200;

#[test]
fn frames_after_the_first_allocate_nothing() {
    let (calls, bytes) = counted(|| drop(std::hint::black_box(vec![0u8; 100])));
    assert_eq!((calls, bytes), (2, 100), "the counter counts");
    let mut network = small::network();
    network.image = [32, 64];
    network.grids = [[8, 12, 4], [4, 6, 2], [2, 3, 1]];
    let rigs = [0.3, 1.0].map(|turn| small::rig(&network, turn));
    let images = Images::new(&network, 5);
    let images = images.views();
    for (precision, rewrites) in [(Precision::F32, Rewrites::ALL), (Precision::F16, Rewrites::NONE)] {
        let model = small::model(&network, precision, rewrites, 1);
        for threads in [1, 2, 3] {
            let options = SessionOptions {
                isa: Isa::best(),
                threads: Threads::new(threads).unwrap(),
                logits: true,
                ..SessionOptions::default()
            };
            let mut session = Session::new(model.clone(), rigs[0].clone(), &options).unwrap();
            session.run(&images).unwrap();
            let mut occupied = 0;
            let found = counted(|| {
                for frame in 0..FRAMES {
                    occupied += session.run(&images).unwrap().classes.iter().filter(|&&c| c != 0).count();
                    session.set_rig(rigs[(frame + 1) % 2].clone()).unwrap();
                }
            });
            assert!(occupied > 0);
            assert_eq!(found, (0, 0), "calls and bytes in {FRAMES} frames on {threads} threads, {precision:?}");
        }
    }
}
