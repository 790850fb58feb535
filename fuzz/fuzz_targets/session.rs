//! Any numbers as a network: it is refused, or it becomes a model, rigs and a session, for which any sequence of calls
//! gives the bits of whole frames of fresh sessions of the scalar code.
//!
//! Images, weights and calibrations are drawn, also such that sums overflow: then NaN takes part.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use voxcast::graph::{Graph, Results, Rewrites, Scale};
use voxcast::import::{Integers, Source, import, import_int8};
use voxcast::model::Options;
use voxcast::model::ranges::{Range, Ranges};
use voxcast::network::{Block, Sampling};
use voxcast::plan::Plan;
use voxcast::random::Random;
use voxcast::rig::RigBuilder;
use voxcast::seeded::SeededWeights;
use voxcast::weights::Precision;
use voxcast::{Budget, ErrorKind, ImageView, Isa, Model, Network, Rig, Session, SessionOptions, Step, Threads};
use voxcast_fuzz::{scratch_file, views};
use voxcast_kernels::cases::{Draw, Output};

/// Multiply-adds, which each weight takes part in, and sample points of a frame, and bytes of a session.
const MAX_WORK: u64 = 1 << 22;
const MAX_POINTS: usize = 1 << 13;
const MAX_MEMORY: usize = 1 << 25;
/// Calls of one input.
const MAX_CALLS: usize = 24;

/// Mostly small numbers that fit each other. One in eight networks has one number that any other could be.
fn network(input: &mut Draw) -> Network {
    let basic = input.flag();
    let top = [input.extent(1, 3), input.extent(1, 3), input.extent(1, 2)];
    let key_dims: [usize; 3] = std::array::from_fn(|_| input.extent(1, 3));
    let mut network = Network {
        depths: std::array::from_fn(|_| input.extent(1, 2)),
        width: input.extent(1, 5),
        dcn: std::array::from_fn(|_| input.flag() && !basic),
        block: if basic { Block::Basic } else { Block::Bottleneck },
        fpn: input.extent(1, 20),
        channels: [input.extent(1, 20), key_dims[0] * 8, key_dims[1] * 8, key_dims[2] * 8],
        key_dims,
        strides: [8, 16, 32],
        bounds: [[-8.0, 8.0], [-8.0, 8.0], [-2.0, 2.0]],
        classes: input.extent(2, 20),
        image: [32 * input.extent(1, 2), 32 * input.extent(1, 2)],
        grids: [4, 2, 1].map(|scale| top.map(|v| v * scale)),
        samples: std::array::from_fn(|_| input.extent(1, 3)),
        sampling: if input.flag() { Sampling::Linspace } else { Sampling::Centres },
        cameras: input.extent(1, 3),
    };
    if input.byte().is_multiple_of(8) {
        let any = [0, 1, 7, 255, 256, 257, 16_384, 65_535, 65_536, usize::MAX][input.extent(0, 9)];
        match input.extent(0, 9) {
            0 => network.depths[input.extent(0, 3)] = any,
            1 => network.width = any,
            2 => network.fpn = any,
            3 => network.channels[input.extent(0, 3)] = any,
            4 => network.key_dims[input.extent(0, 2)] = any,
            5 => network.classes = any,
            6 => network.image[input.extent(0, 1)] = any,
            7 => network.samples[input.extent(0, 2)] = any,
            8 => network.cameras = any,
            _ => {
                let (level, axis) = (input.extent(0, 3), input.extent(0, 2));
                match network.grids.get_mut(level) {
                    Some(grid) => grid[axis] = any,
                    None => network.bounds[axis] = [input.value(), input.value()],
                }
            }
        }
    }
    network
}

/// Drawn weights, some of them times a number that makes sums overflow.
struct Weights {
    seed: u64,
    factor: f64,
}

impl Source for Weights {
    fn tensor(&self, name: &str, shape: &[usize]) -> voxcast::Result<Vec<f64>> {
        let mut values = SeededWeights { seed: self.seed }.tensor(name, shape)?;
        if name.contains("layer2") || name.contains("up_sample") {
            values.iter_mut().for_each(|v| *v *= self.factor);
        }
        Ok(values)
    }
}

/// The network's model, unless there is something to refuse or too much to compute.
fn model(input: &mut Draw, network: &Network) -> Option<Arc<Model>> {
    let sound = network.check();
    assert_eq!(sound.is_ok(), Network::from_json(&network.to_json()).is_ok_and(|read| read == *network));
    if let Err(refused) = sound {
        assert_eq!(refused.kind(), ErrorKind::Format, "{refused}");
        assert!(RigBuilder::new(network, 1, Isa::best()).is_err());
        return None;
    }
    let rewrites = [
        Rewrites::ALL,
        Rewrites::NONE,
        Rewrites { projection: false, ..Rewrites::ALL },
        Rewrites { winograd: false, ..Rewrites::ALL },
    ];
    let rewrites = rewrites[input.extent(0, 3)];
    let precision = Precision::ALL[input.extent(0, 2)];
    let source =
        Weights { seed: u64::from(input.byte()), factor: [1.0, 1.0, 0.0, 1e3, 1e18, -1e30][input.extent(0, 5)] };
    for rewrites in [Rewrites::NONE, rewrites] {
        let graph = Graph::build(network, Results::ALL).rewritten(rewrites);
        if !is_small(&graph) {
            // Either answer will do.
            drop(Plan::new(&graph, network.cameras, 3));
            return None;
        }
    }
    let file = scratch_file("session");
    let written = match precision {
        Precision::I8 => {
            let ranges = ranges(input, network, rewrites)?;
            import_int8(&source, network, &Integers { rewrites, ranges: &ranges, keep_f32: &[] }, &file, &mut |_, _| ())
        }
        _ => import(&source, network, Options { precision, rewrites }, &file, &mut |_, _| ()),
    };
    // What can be refused is a weight or a fold that overflows, and steps that do not go with the weights.
    if let Err(e) = written {
        assert_ne!(e.kind(), ErrorKind::Io, "{e}");
        return None;
    }
    let bytes = std::fs::read(&file).expect("what was just written");
    Some(Arc::new(Model::from_bytes(bytes).expect("what import wrote")))
}

/// Ranges of every tensor that integers have a scale for, around one that is drawn; none if batch norms stay.
fn ranges(input: &mut Draw, network: &Network, rewrites: Rewrites) -> Option<Ranges> {
    let graph = Graph::build(network, Results::ALL).rewritten(Rewrites { winograd: false, ..rewrites });
    let mut names = vec![];
    let scale = &mut |name: &str| {
        names.push(name.to_owned());
        Scale::of_range(1.0)
    };
    graph.quantise(&[], scale).ok()?;
    let (middle, mut random) =
        ([1e-6, 0.1, 1.0, 10.0, 300.0, 1e9][input.extent(0, 5)], Random::new(input.byte().into()));
    let mut range = |name| {
        let threshold = middle * f64::from(random.range(0.2, 5.0));
        (name, Range { max: threshold, threshold })
    };
    Some(Ranges::new(network, 1, names.into_iter().map(&mut range).collect()))
}

fn is_small(graph: &Graph) -> bool {
    let work = graph.operations.iter().map(|o| graph.multiply_adds(o)).fold(0, u64::saturating_add);
    let network = &graph.network;
    let points = |l: usize| {
        let axes = network.grids[l].iter().map(|v| v.saturating_mul(network.samples[l]));
        axes.fold(1, usize::saturating_mul)
    };
    network.cameras <= 4
        && work.saturating_mul(network.cameras as u64) <= MAX_WORK
        && (0..3).all(|l| points(l) <= MAX_POINTS)
}

/// A calibration: a camera that looks around, somewhat wrong or any numbers at all.
fn calibration(input: &mut Draw, network: &Network) -> [f32; 16] {
    let [height, width] = network.image.map(|v| v as f32);
    let turn = f32::from(input.byte()) / 40.0;
    let (s, c) = turn.sin_cos();
    let (right, down, ahead) = ([s, -c, 0.0, 0.1], [0.0, 0.0, -1.0, 0.3], [c, s, 0.0, 0.5]);
    let row = |a: [f32; 4], f: f32, centre: f32| std::array::from_fn::<f32, 4, _>(|k| f * a[k] + centre * ahead[k]);
    let rows = [row(right, width * 0.7, width / 2.0), row(down, width * 0.7, height / 2.0), ahead, [0., 0., 0., 1.]];
    let mut matrix: [f32; 16] = rows.concat().try_into().expect("four rows of four");
    if input.byte().is_multiple_of(4) {
        matrix[input.extent(0, 15)] = input.value();
    }
    matrix
}

/// Everything that a session computes from, but the images.
struct Bench {
    model: Arc<Model>,
    rigs: [Arc<Rig>; 2],
    images: [Vec<Vec<u8>>; 2],
    unfolded: bool,
}

/// What the session under test was last told.
#[derive(Clone)]
struct Told {
    /// For each camera, the set of each image that it was given.
    given: Vec<Vec<usize>>,
    masked: Vec<bool>,
    rig: usize,
}

impl Bench {
    fn new(input: &mut Draw, model: Arc<Model>) -> Option<Self> {
        let network = model.network().clone();
        let mut builder = RigBuilder::new(&network, network.cameras, Isa::best()).ok()?;
        let matrices = [0, 1].map(|_| (0..network.cameras).map(|_| calibration(input, &network)).collect::<Vec<_>>());
        let mut scalar = RigBuilder::new(&network, network.cameras, Isa::Scalar).ok()?;
        // The second is built in the memory of another, in steps.
        let first = scalar.build(&matrices[0]).expect("a small rig");
        let mut second = builder.build(&matrices[0]).expect("a small rig");
        assert!(first == second, "scalar and vector rigs differ");
        builder.begin(&matrices[1]).expect("as many matrices as cameras");
        while !builder.advance(1, &mut second).expect("a small rig") {}
        assert!(second == scalar.build(&matrices[1]).expect("a small rig"), "a rig built in steps differs");
        let seed = u64::from(input.byte());
        let images = [seed, seed + 1].map(|seed| drawn_images(&network, seed));
        let unfolded = input.flag() && has_unfolded(&model, network.cameras);
        Some(Self { model, rigs: [first, second].map(Arc::new), images, unfolded })
    }

    fn view(&self, set: usize, camera: usize) -> ImageView<'_> {
        let [height, width] = self.model.network().image;
        ImageView::bgr(height, width, &self.images[set][camera])
    }

    /// The session's result is a whole frame of a fresh session of the scalar code.
    fn check(&self, session: &Session, told: &Told) {
        let found = session.occupancy().expect("a result");
        let options = SessionOptions {
            isa: Isa::Scalar,
            unfolded: self.unfolded,
            logits: true,
            confidence: true,
            ..SessionOptions::default()
        };
        let mut fresh =
            Session::new(self.model.clone(), self.rigs[told.rig].clone(), &options).expect("a small session");
        let images: Vec<ImageView<'_>> = (0..told.given.len())
            .map(|camera| {
                let status = found.cameras[camera];
                assert_eq!(status.masked, told.masked[camera], "camera {camera}");
                fresh.set_masked(camera, status.masked).expect("a camera");
                let set = if status.masked { 0 } else { told.given[camera][status.image as usize - 1] };
                self.view(set, camera)
            })
            .collect();
        let expected = fresh.run(&images).expect("images of the network's size");
        assert_eq!(found.support, expected.support);
        assert_eq!(found.classes, expected.classes);
        if let Some(logits) = found.logits {
            let difference = Output::from(logits).difference(&Output::from(expected.logits.expect("asked for")));
            assert_eq!(difference, None, "logits");
        }
        if found.confidence.is_some() {
            assert_eq!(found.confidence, expected.confidence);
        }
    }
}

/// Whether the model has a graph without the projection fold. One of int8 has not, and a session says so.
fn has_unfolded(model: &Model, cameras: usize) -> bool {
    let integers = model.quantisation().is_some();
    if integers {
        let options = SessionOptions { unfolded: true, ..SessionOptions::default() };
        let told = Session::memory(model, cameras, &options).expect_err("int8 without the fold");
        assert_eq!(told.kind(), ErrorKind::Unsupported, "{told}");
    }
    !integers
}

fn drawn_images(network: &Network, seed: u64) -> Vec<Vec<u8>> {
    let mut random = Random::new(seed);
    let mut image = || (0..network.image[0] * network.image[1] * 3).map(|_| random.next_u64() as u8).collect();
    (0..network.cameras).map(|_| image()).collect()
}

/// Threads are started once: starting them takes longer than a frame.
fn threads(count: usize) -> Threads {
    static THREADS: OnceLock<[Threads; 3]> = OnceLock::new();
    THREADS.get_or_init(|| [1, 2, 3].map(|n| Threads::new(n).expect("a few threads")))[count - 1].clone()
}

fn options(input: &mut Draw, unfolded: bool) -> SessionOptions {
    let sets: Vec<Isa> = Isa::available().collect();
    SessionOptions {
        isa: sets[input.extent(0, sets.len() - 1)],
        threads: threads(input.extent(1, 3)),
        unfolded,
        logits: !input.byte().is_multiple_of(4),
        coarse_heads: input.flag(),
        slice_cost: [0, 1, 500, 50_000, u64::MAX][input.extent(0, 4)],
        confidence: input.flag(),
    }
}

fn budget(input: &mut Draw) -> Budget {
    match input.extent(0, 3) {
        0 => Budget::Unlimited,
        1 => Budget::Time(Duration::from_micros(u64::from(input.byte()))),
        _ => Budget::Slices(u32::from(input.byte())),
    }
}

/// Some calls, each of whose results is compared.
fn drive(input: &mut Draw, bench: &Bench, session: &mut Session) {
    let cameras = session.cameras();
    let mut told = Told { given: vec![vec![]; cameras], masked: vec![false; cameras], rig: 0 };
    for _ in 0..MAX_CALLS {
        let camera = input.extent(0, cameras - 1);
        match input.byte() % 16 {
            0..5 => {
                let set = input.extent(0, 1);
                session.set_camera(camera, bench.view(set, camera)).expect("an image of the network's size");
                told.given[camera].push(set);
            }
            5..12 => {
                if session.step(budget(input)) == Step::Complete {
                    bench.check(session, &told);
                }
            }
            12 => {
                told.masked[camera] = input.flag();
                session.set_masked(camera, told.masked[camera]).expect("a camera");
            }
            13 => {
                told.rig = input.extent(0, 1);
                session.set_rig(bench.rigs[told.rig].clone()).expect("a rig of the network");
            }
            14 => {
                let set = input.extent(0, 1);
                session.run(&views(bench.model.network(), &bench.images[set])).expect("images of the network's size");
                told.given.iter_mut().for_each(|sets| sets.push(set));
                bench.check(session, &told);
            }
            // The input has ended, or might as well have.
            _ => return,
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    let mut input = Draw::new(bytes);
    let network = network(&mut input);
    let Some(model) = model(&mut input, &network) else { return };
    let Some(bench) = Bench::new(&mut input, model) else { return };
    let options = options(&mut input, bench.unfolded);
    let memory = Session::memory(&bench.model, network.cameras, &options).expect("a small session");
    if memory.total() > MAX_MEMORY {
        return;
    }
    let mut session = Session::new(bench.model.clone(), bench.rigs[0].clone(), &options).expect("a small session");
    assert_eq!(session.taken(), memory, "what was told beforehand");
    drive(&mut input, &bench, &mut session);
});
