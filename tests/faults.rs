//! In steady state no page is missing: frames neither wait for the system nor depend on what it does.
//!
//! This file holds one test only: another's page faults would count.
#![cfg(target_os = "linux")]

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use small::Images;
use voxcast::graph::Rewrites;
use voxcast::weights::Precision;
use voxcast::{Budget, Isa, Model, Session, SessionOptions, Step, Threads};

/// Page faults of this process so far, those that read a disk and those that did not.
fn faults() -> [libc::c_long; 2] {
    // SAFETY: zeros are a valid `rusage`.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: `usage` is writable and of the type that the call fills.
    let status = unsafe { libc::getrusage(libc::RUSAGE_SELF, &mut usage) };
    assert_eq!(status, 0, "the system counts page faults");
    [usage.ru_majflt, usage.ru_minflt]
}

#[test]
fn frames_in_steady_state_fault_no_page() {
    let before = faults();
    let pages = std::hint::black_box(vec![1u8; 4 << 20]);
    assert!(faults()[1] > before[1], "the counter counts: {} bytes are new", pages.len());

    for precision in [Precision::F32, Precision::I8] {
        assert_no_faults(precision);
    }
}

fn assert_no_faults(precision: Precision) {
    let mut network = small::suited(small::network(), precision);
    network.image = [64, 96];
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("model");
    std::fs::write(&path, small::model_bytes(&network, precision, Rewrites::ALL, 1)).unwrap();
    let model = std::sync::Arc::new(Model::open(&path).unwrap());
    let options = SessionOptions {
        isa: Isa::best(),
        threads: Threads::new(2).unwrap(),
        logits: true,
        slice_cost: 1000,
        ..SessionOptions::default()
    };
    let mut session = Session::new(model, small::rig(&network, 0.3), &options).unwrap();
    let images = Images::new(&network, 5);
    let images = images.views();
    let mut windows = vec![];
    for _ in 0..20 {
        let before = faults();
        for frame in 0..20 {
            session.run(&images).unwrap();
            session.set_camera(frame % 2, images[frame % 2]).unwrap();
            while session.step(Budget::Slices(10)) == Step::Running {}
        }
        let after = faults();
        windows.push([after[0] - before[0], after[1] - before[1]]);
        // The first frames may touch stacks and tables for the first time, and the system may move pages about at any
        // time; a page that every frame needs anew would show in every window.
        if windows.last() == Some(&[0, 0]) {
            return;
        }
    }
    panic!("{precision:?}: page faults, from disk and others, in each 20 frames: {windows:?}");
}
