//! What a session refuses, and what it says of itself.

use super::*;
use crate::graph::Rewrites;
use crate::graph::parts::Precision;
use crate::rig::RigBuilder;
use crate::small::{self, tiny};

fn model() -> Arc<Model> {
    small::model(&tiny(), Precision::F32, Rewrites::ALL, 1)
}

/// Looks ahead along x.
const AHEAD: [f32; 16] = [32., -40., 0., 0., 16., 0., -40., 0., 1., 0., 0., 0., 0., 0., 0., 1.];

fn rig(network: &Network, cameras: usize) -> Arc<Rig> {
    let built = RigBuilder::new(network, cameras, Isa::best()).and_then(|mut b| b.build(&vec![AHEAD; cameras]));
    Arc::new(built.expect("a rig"))
}

fn session() -> Session {
    Session::new(model(), rig(&tiny(), 2), &SessionOptions::default()).expect("a session")
}

#[test]
fn images_that_do_not_fit_are_refused() {
    let mut session = session();
    let bytes = vec![9u8; 32 * 64 * 3];
    let view = |height: usize, width, len| ImageView::bgr(height, width, &bytes[..len]);
    let sound = view(32, 64, 6144);
    for (images, expected) in [
        (vec![], "0 images, the rig has 2 cameras"),
        (vec![sound], "1 images"),
        (vec![sound; 3], "3 images"),
        (vec![sound, view(64, 32, 6144)], "image 1: 64x32 (height x width), the network expects"),
        (vec![view(32, 64, 6143), sound], "image 0: 6143 bytes"),
        (vec![view(33, 60, 33 * 60 * 3), sound], "pads to 32x64"),
        (vec![view(0, 64, 0), sound], "image 0"),
        (vec![ImageView { height: usize::MAX, ..sound }, sound], &format!("image 0: {}x64", usize::MAX)),
        (vec![view(1 << (usize::BITS - 1), 64, 0), sound], "image 0"),
    ] {
        let error = session.run(&images).expect_err(expected);
        assert_eq!(error.kind(), ErrorKind::Mismatch);
        assert!(error.message().contains(expected), "{error}");
    }
    let classes = session.run(&[sound; 2]).expect("sound images").classes.to_vec();
    assert_eq!(classes.len(), 16 * 8 * 8);
    // The smallest size that pads to the network's.
    assert!(session.run(&[view(1, 33, 99); 2]).is_ok());
}

#[test]
fn scenes_that_do_not_fit_are_refused() {
    let mut session = session();
    let scene = small::scene(&tiny(), 1);
    assert_eq!(session.run_scene(&scene).expect("a scene of this network").grid.size, [16, 8, 8]);
    let other = small::scene(&Network { image: [32, 32], ..tiny() }, 1);
    assert!(session.run_scene(&other).expect_err("another size").message().contains("32x32"));
    let fewer = small::scene(&Network { cameras: 1, ..tiny() }, 1);
    assert!(session.run_scene(&fewer).expect_err("another number").message().contains("1 images"));
}

#[test]
fn rigs_of_other_networks_are_refused() {
    let mut session = session();
    let wider = Network { grids: [[16, 4, 4], [8, 2, 2], [4, 1, 1]], ..tiny() };
    let finer = Network { image: [64, 128], ..tiny() };
    for (rig, expected) in [
        (rig(&tiny(), 3), "the rig has 3 cameras, expected 2"),
        (rig(&wider, 2), "level 1: the rig's volume matrix has 256 rows, the network expects 128"),
        (rig(&finer, 2), "level 1: the rig's volume matrix names pixel"),
    ] {
        let error = session.set_rig(rig).expect_err(expected);
        assert_eq!(error.kind(), ErrorKind::Mismatch);
        assert!(error.message().contains(expected), "{error}");
    }
    session.set_rig(rig(&tiny(), 2)).expect("its own");
    let error = Session::new(model(), rig(&wider, 2), &SessionOptions::default()).expect_err("another network");
    assert_eq!(error.kind(), ErrorKind::Mismatch);
}

#[test]
fn memory_that_cannot_be_addressed_is_refused() {
    let model = model();
    let error = Session::memory(&model, usize::MAX / 2, &SessionOptions::default()).expect_err("too many cameras");
    assert_eq!(error.kind(), ErrorKind::TooLarge);
}

#[test]
fn events_come_in_running_order() {
    let mut session = session();
    let graph = session.graph().clone();
    let scene = small::scene(&tiny(), 1);
    let mut events = vec![];
    session
        .run_observed(&views(&scene), &mut |e| events.push((e.operation.name.clone(), e.camera, e.output.len())))
        .expect("a frame");
    let passes = graph.camera_operations;
    assert_eq!(events.len(), 2 * passes + graph.operations.len() - passes);
    for (i, (name, camera, len)) in events.iter().enumerate() {
        let index = if i < 2 * passes { i % passes } else { i - passes };
        assert_eq!(*name, graph.operations[index].name);
        assert_eq!(*camera, (i < 2 * passes).then_some(i / passes), "{name}");
        assert_eq!(*len, graph.tensor(graph.operations[index].result()).len(), "{name}");
    }
    assert_eq!(session.cameras(), 2);
    assert!(format!("{session:?}").starts_with("Session"));
}

#[test]
fn results_that_are_taken_out_stay_and_lend_their_memory() {
    let options = SessionOptions { logits: true, ..SessionOptions::default() };
    let mut session = Session::new(model(), rig(&tiny(), 2), &options).expect("a session");
    let pixels = [1, 2].map(|seed| (0..32 * 64 * 3).map(|i| (i * i * seed) as u8).collect::<Vec<u8>>());
    let frame = |which: usize| [ImageView::bgr(32, 64, &pixels[which]); 2];
    assert!(session.take(None).expect("nothing to allocate").is_none());
    // Classes of so small a network are much the same whatever it sees.
    let digest = |result: &Occupancy<'_>| result.logits_digest().expect("logits");
    let expected = [0, 1].map(|which| digest(&session.run(&frame(which)).expect("a frame")));
    assert_ne!(expected[0], expected[1], "images that can be told apart");

    session.set_cameras(&frame(0)).expect("sound images");
    assert_eq!(session.step(Budget::Unlimited), Step::Complete);
    let first = session.take(None).expect("memory").expect("a result");
    assert!(session.occupancy().is_none() && session.take(None).expect("nothing to allocate").is_none());
    let place = first.view().classes.as_ptr();
    // A frame that was begun is dropped.
    session.set_camera(0, frame(0)[0]).expect("sound images");
    assert_eq!(session.step(Budget::Slices(1)), Step::Running);
    session.set_cameras(&frame(1)).expect("sound images");
    assert_eq!(session.step(Budget::Unlimited), Step::Complete);
    assert_eq!([digest(&first.view()), digest(&session.occupancy().expect("a result"))], expected);
    assert_eq!(first.view().grid.size, [16, 8, 8]);

    let second = session.take(Some(first)).expect("memory").expect("a result");
    assert_eq!(digest(&second.view()), expected[1]);
    // The memory comes back as the one that is read, after one that is written.
    let places = [0, 1].map(|which| session.run(&frame(which)).expect("a frame").classes.as_ptr());
    assert!(places.contains(&place));
    assert_eq!(digest(&second.view()), expected[1]);
}

#[test]
fn the_memory_of_another_sessions_result_does_not_lend_its_support() {
    let pixels = vec![9u8; 32 * 64 * 3];
    let images = [ImageView::bgr(32, 64, &pixels); 2];
    let turned = || Session::new(model(), small::rig(&tiny(), 0.0), &SessionOptions::default()).expect("a session");
    let expected = turned().run(&images).expect("a frame").support.to_vec();
    let mut other = session();
    assert_ne!(other.run(&images).expect("a frame").support, expected, "rigs that can be told apart");
    let mut session = turned();
    session.run(&images).expect("a frame");
    let spare = other.take(None).expect("memory");
    session.take(spare).expect("memory").expect("a result");
    for _ in 0..3 {
        assert_eq!(session.run(&images).expect("a frame").support, expected);
    }
}
