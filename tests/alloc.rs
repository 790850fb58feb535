//! A session takes what it said it would, and after the first frame nothing is allocated, on any thread of the process.
//!
//! This file holds one test only: a second one would run beside it, and its allocations would count.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use small::Images;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicIsize, AtomicUsize, Ordering};
use std::time::Duration;
use voxcast::graph::Rewrites;
use voxcast::rig::RigBuilder;
use voxcast::weights::Precision;
use voxcast::{Budget, ImageView, Isa, Model, Network, Rig, Session, SessionOptions, Step, Threads};

/// The system's allocator, which counts while it is told to.
struct Counting;

static COUNTING: AtomicBool = AtomicBool::new(false);
/// Whether the process's first thread is the test harness's, which allocates when it says that a test takes long.
static FIRST_IS_HARNESS: AtomicBool = AtomicBool::new(false);
static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);
static HELD: AtomicIsize = AtomicIsize::new(0);

/// Whether this is the process's first thread, so far as that is known. Allocates nothing.
fn is_first() -> bool {
    #[cfg(target_os = "linux")]
    // SAFETY: both only ask the kernel for a number.
    let first = unsafe { libc::gettid() == libc::getpid() };
    #[cfg(not(target_os = "linux"))]
    let first = false;
    first
}

fn count(asked: usize, given_back: usize) {
    if COUNTING.load(Ordering::SeqCst) && !(FIRST_IS_HARNESS.load(Ordering::SeqCst) && is_first()) {
        CALLS.fetch_add(1, Ordering::SeqCst);
        BYTES.fetch_add(asked, Ordering::SeqCst);
        HELD.fetch_add(asked as isize - given_back as isize, Ordering::SeqCst);
    }
}

// SAFETY: every call goes to the system's allocator unchanged; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promises are those of `System::alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
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

/// What the allocator holds more of after `work` than before, in bytes, and how often `work` called it.
fn held<R>(work: impl FnOnce() -> R) -> (R, isize, usize) {
    HELD.store(0, Ordering::SeqCst);
    let mut result = None;
    let (calls, _) = counted(|| result = Some(work()));
    (result.expect("work was done"), HELD.load(Ordering::SeqCst), calls)
}

/// Frames of every session: queues that grow by blocks would show after some dozens of them. `VOXCAST_ALLOC_FRAMES` asks for another
/// number, where an emulator takes a minute for a session. Twelve are all ways in which `control` makes a frame.
fn frames() -> usize {
    match std::env::var("VOXCAST_ALLOC_FRAMES") {
        Ok(number) => number.parse().ok().filter(|&n| n > 0).expect("VOXCAST_ALLOC_FRAMES is a number of frames"),
        Err(_) => 100,
    }
}

#[test]
fn everything_is_allocated_when_a_session_is_made_and_known_before() {
    FIRST_IS_HARNESS.store(!is_first(), Ordering::SeqCst);
    let frames = frames();
    // Even where the harness keeps what tests print.
    let said = format!("allocations are counted over {frames} frames of every session\n");
    std::io::Write::write_all(&mut std::io::stderr(), said.as_bytes()).expect("standard error");
    let (calls, bytes) = counted(|| drop(std::hint::black_box(vec![0u8; 100])));
    assert_eq!((calls, bytes), (2, 100), "the counter counts");
    let (kept, bytes, calls) = held(|| std::hint::black_box(vec![0u8; 100]));
    assert_eq!((kept.len(), bytes, calls), (100, 100, 1), "what is held is counted");
    let stored = [(Precision::F32, Rewrites::ALL), (Precision::F16, Rewrites::NONE), (Precision::I8, Rewrites::ALL)];
    for (precision, rewrites) in stored {
        let mut network = small::suited(small::network(), precision);
        network.image = [32, 64];
        network.grids = [[8, 12, 4], [4, 6, 2], [2, 3, 1]];
        let images = Images::new(&network, 5);
        let images = images.views();
        opening_takes_the_same_each_time(&network, precision, rewrites);
        let model = small::model(&network, precision, rewrites, 1);
        for threads in [1, 2, 3] {
            let options = SessionOptions {
                isa: Isa::best(),
                threads: Threads::new(threads).unwrap(),
                logits: threads != 2,
                confidence: threads != 1,
                coarse_heads: threads == 3,
                slice_cost: 1000,
                ..SessionOptions::default()
            };
            // What a thread still frees of its own start is not the session's.
            options.threads.broadcast(|| ());
            let promised = Session::memory(&model, 2, &options).unwrap();
            let own = small::rig(&network, 0.3);
            let make = || Session::new(model.clone(), own.clone(), &options).unwrap();
            let (first, bytes, calls) = held(make);
            let (mut session, again, calls_again) = held(make);
            assert_eq!(bytes, promised.total() as isize, "{promised:?} on {threads} threads, {precision:?}");
            assert_eq!((again, calls_again), (bytes, calls), "a session takes the same each time");
            assert_eq!(first.taken(), promised);
            drop((first, own));
            session.run(&images).unwrap();
            let mut occupied = 0;
            let mut calibration = Calibration::new(&network, &options.threads);
            // Rig, spare and builder have memory each, which must once have held every calibration.
            (0..6).for_each(|turn| calibration.swap(&mut session, turn));
            let found = counted(|| {
                for frame in 0..frames {
                    occupied += session.run(&images).unwrap().classes.iter().filter(|&&c| c != 0).count();
                    control(&mut session, &mut calibration, &images, frame);
                }
            });
            assert!(occupied > 0);
            assert_eq!(found, (0, 0), "calls and bytes in {frames} frames on {threads} threads, {precision:?}");
        }
    }
}

/// A model's file is mapped; what is allocated is what its header says.
fn opening_takes_the_same_each_time(network: &Network, precision: Precision, rewrites: Rewrites) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("model");
    std::fs::write(&path, small::model_bytes(network, precision, rewrites, 1)).unwrap();
    let (model, bytes, calls) = held(|| Model::open(&path).unwrap());
    let (_again, bytes_again, calls_again) = held(|| Model::open(&path).unwrap());
    assert_eq!((bytes, calls), (bytes_again, calls_again));
    assert!(bytes > 0 && bytes < model.file_size() as isize / 2, "{bytes} bytes for a model of {}", model.file_size());
}

/// A frame as a controller makes it: one camera's image, steps, another rig, a mask.
fn control(session: &mut Session, calibration: &mut Calibration, images: &[ImageView<'_>], frame: usize) {
    session.set_camera(frame % 2, images[frame % 2]).unwrap();
    let budget = if frame.is_multiple_of(3) { Budget::Time(Duration::from_micros(500)) } else { Budget::Slices(40) };
    for _ in 0..3 {
        session.step(budget);
    }
    calibration.swap(session, frame);
    session.set_masked(1, frame.is_multiple_of(4)).unwrap();
    while session.step(budget) == Step::Running {}
    let mut bits = [0; 4096];
    let result = session.occupancy().unwrap();
    result.write_bits(&mut bits[..result.bits_len()]);
}

/// A rig that is built in steps while another is in use.
struct Calibration {
    builder: RigBuilder,
    spare: Arc<Rig>,
    matrices: [Vec<[f32; 16]>; 2],
}

impl Calibration {
    fn new(network: &Network, threads: &Threads) -> Self {
        let builder = RigBuilder::new(network, 2, Isa::best()).unwrap().with_threads(threads.clone());
        let matrices = [0.3, 1.0].map(|turn| small::lidar2img(network, turn));
        Self { builder, spare: small::rig(network, 0.5), matrices }
    }

    fn swap(&mut self, session: &mut Session, turn: usize) {
        self.builder.begin(&self.matrices[turn % 2]).unwrap();
        let rig = Arc::get_mut(&mut self.spare).expect("a rig that no session uses");
        while !self.builder.advance(20, rig).unwrap() {}
        self.spare = session.set_rig(self.spare.clone()).unwrap();
    }
}
