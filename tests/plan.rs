//! The plan: pinned for a small network, told before it is taken, and free of overlaps whatever the network.

#[path = "support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;

use proptest::prelude::*;
use small::Images;
use std::ops::Range;
use std::path::Path;
use voxcast::graph::{Graph, Lifetime, Results, Rewrites, Scale, Scope, TensorId};
use voxcast::network::Block;
use voxcast::plan::{Place, Plan, Region};
use voxcast::weights::Precision;
use voxcast::{Network, Session, SessionOptions, Threads};

/// A change here is a change of every user's memory: bless it with `VOXCAST_BLESS=1` once it is wanted.
#[test]
fn plan_is_the_golden_one() {
    assert_plan(&small::network(), Precision::F32, "tests/plan.golden.txt");
    assert_plan(&small::suited(small::network(), Precision::I8), Precision::I8, "tests/plan_i8.golden.txt");
}

fn assert_plan(network: &Network, precision: Precision, golden: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(golden);
    let graph = graph(network, precision, Results::default(), Rewrites::ALL);
    let found = Plan::new(&graph, network.cameras, 2).unwrap().to_string();
    if std::env::var_os("VOXCAST_BLESS").is_some_and(|v| v == "1") {
        std::fs::write(&path, &found).unwrap();
    }
    let golden = std::fs::read_to_string(&path).unwrap();
    for (line, (found, golden)) in found.lines().zip(golden.lines()).enumerate() {
        assert_eq!(found, golden, "line {} of {}", line + 1, path.display());
    }
    assert_eq!(found, golden);
}

/// The graph of a model of this precision; where it is of integers, each tensor's largest stands for 1.
fn graph(network: &Network, precision: Precision, results: Results, rewrites: Rewrites) -> Graph {
    match precision {
        Precision::F32 | Precision::F16 => Graph::build(network, results).rewritten(rewrites),
        Precision::I8 => {
            let rewrites = Rewrites { batch_norm: true, winograd: false, ..rewrites };
            let graph = Graph::build(network, results).rewritten(rewrites);
            graph.quantise(&[], &mut |_| Scale::of_range(1.0)).unwrap()
        }
    }
}

#[test]
fn memory_is_what_was_told() {
    for precision in [Precision::F32, Precision::I8] {
        assert_told(precision);
    }
}

fn assert_told(precision: Precision) {
    let network = small::suited(small::network(), precision);
    let model = small::model(&network, precision, Rewrites::ALL, 1);
    let rig = small::rig(&network, 0.3);
    for threads in [1, 3] {
        for flags in 0..16 {
            let options = SessionOptions {
                threads: Threads::new(threads).unwrap(),
                // int8 has no graph but the folded one.
                unfolded: precision == Precision::F32 && flags & 1 != 0,
                logits: flags & 2 != 0,
                coarse_heads: flags & 4 != 0,
                confidence: flags & 8 != 0,
                ..SessionOptions::default()
            };
            let told = Session::memory(&model, network.cameras, &options).unwrap();
            let session = Session::new(model.clone(), rig.clone(), &options).unwrap();
            assert_eq!(session.taken(), told, "{options:?}");
            assert_eq!(told.arena, session.plan().bytes(Region::Arena));
            assert_eq!(told.total(), told.arena + told.images + told.output + told.tables);
        }
    }
    let more = Session::memory(&model, 7, &SessionOptions::default()).unwrap();
    assert!(more.arena > Session::memory(&model, 1, &SessionOptions::default()).unwrap().arena);
}

/// Any network that is quick to run.
fn networks() -> impl Strategy<Value = Network> {
    let shape = (1usize..4, 1usize..4, 1usize..3, 1usize..4, 1usize..4, 1usize..4);
    let channels = (1usize..20, 1usize..4, 1usize..4, 1usize..4, 1usize..20, 1usize..5);
    let rest = (any::<[bool; 4]>(), any::<bool>(), prop::array::uniform4(1usize..3), 2usize..20);
    (shape, channels, rest).prop_map(|((x, y, z, h, w, cameras), (c0, c1, c2, c3, fpn, width), rest)| {
        let (dcn, basic, depths, classes) = rest;
        Network {
            depths,
            width,
            dcn: if basic { [false; 4] } else { dcn },
            block: if basic { Block::Basic } else { Block::Bottleneck },
            fpn,
            channels: [c0, 8 * c1, 8 * c2, 8 * c3],
            key_dims: [c1, c2, c3],
            classes,
            image: [32 * h, 32 * w],
            grids: [[4 * x, 4 * y, 4 * z], [2 * x, 2 * y, 2 * z], [x, y, z]],
            samples: [1, 2, 1],
            cameras,
            ..small::network()
        }
    })
}

fn rewrites() -> impl Strategy<Value = Rewrites> {
    prop::sample::select(vec![
        Rewrites::ALL,
        Rewrites::NONE,
        Rewrites { projection: false, ..Rewrites::ALL },
        Rewrites { winograd: false, ..Rewrites::ALL },
    ])
}

/// Operations from the first that writes a tensor to the last that reads it. Features outlive the frame.
fn life(graph: &Graph, id: TensorId) -> Option<Range<usize>> {
    let uses = |i: &usize| {
        let operation = &graph.operations[*i];
        operation.outputs.contains(&id) || operation.reads().any(|t| t == id)
    };
    let all = 0..graph.operations.len();
    let first = all.clone().find(uses)?;
    let last = all.clone().rfind(uses)?;
    Some(if graph.tensor(id).lifetime == Lifetime::Camera || graph.tensor(id).scope != Scope::Inner {
        all
    } else {
        first..last + 1
    })
}

/// Whether `operation` may write its output over the tensor `id` that it reads.
fn may_replace(graph: &Graph, index: usize, id: TensorId) -> bool {
    let operation = &graph.operations[index];
    let starts = operation.residual.is_some_and(|r| r.tensor == id && !r.after) && !operation.inputs.contains(&id);
    operation.in_place() == Some(id) || (starts && operation.op.description().overwrites_residual())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn nothing_that_lives_at_once_overlaps(
        network in networks(),
        rewrites in rewrites(),
        precision in prop::sample::select(vec![Precision::F32, Precision::I8]),
        coarse in any::<bool>(),
        workers in 1usize..4,
    ) {
        network.check().unwrap();
        let results = Results { logits: coarse, coarse_heads: coarse, ..Results::default() };
        let graph = graph(&network, precision, results, rewrites);
        let plan = Plan::new(&graph, network.cameras, workers).unwrap();
        let mut blocks: Vec<(Option<TensorId>, Place, Range<usize>)> = (0..workers)
            .map(|w| (None, Place { region: Region::Arena, bytes: plan.scratch(w) }, 0..graph.operations.len()))
            .collect();
        for id in (0..graph.tensors.len()).map(TensorId) {
            let Some(life) = life(&graph, id) else { continue };
            let tensor = graph.tensor(id);
            let bytes = tensor.bytes() * tensor.copies(network.cameras);
            prop_assert!(plan.place(id).bytes.len() >= bytes, "{} is too small", tensor.name);
            let region = match tensor.scope {
                Scope::Input => Region::Input,
                Scope::Inner => Region::Arena,
                Scope::Output => Region::Output,
            };
            prop_assert_eq!(plan.place(id).region, region);
            blocks.push((Some(id), plan.place(id), life));
        }
        for (i, (a, a_place, a_life)) in blocks.iter().enumerate() {
            prop_assert!(a_place.bytes.start % 64 == 0 && a_place.bytes.end <= plan.bytes(a_place.region));
            for (b, b_place, b_life) in &blocks[i + 1..] {
                let apart = a_place.region != b_place.region
                    || a_place.bytes.end <= b_place.bytes.start
                    || b_place.bytes.end <= a_place.bytes.start;
                let shared = a_life.start.max(b_life.start)..a_life.end.min(b_life.end);
                if apart || shared.is_empty() {
                    continue;
                }
                // The only excuse: one operation ends the one and begins the other at the same place.
                let (Some(a), Some(b)) = (a, b) else {
                    return Err(TestCaseError::fail("a tensor lies in a worker's scratch"));
                };
                let (old, new) = if a_life.start < b_life.start { (a, b) } else { (b, a) };
                prop_assert!(
                    shared.len() == 1
                        && a_place == b_place
                        && graph.operations[shared.start].output() == *new
                        && plan.replaced(shared.start) == Some(*old)
                        && may_replace(&graph, shared.start, *old),
                    "{} and {} overlap in operations {shared:?}",
                    graph.tensor(*a).name,
                    graph.tensor(*b).name
                );
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    /// Folding changes rounding and nothing else.
    #[test]
    fn rewrites_keep_the_result(network in networks(), seed in any::<u64>()) {
        let rig = small::rig(&network, 0.3);
        let images = Images::new(&network, seed);
        let logits = |rewrites, unfolded| {
            let model = small::tempered(&network, rewrites, seed);
            let options = SessionOptions { logits: true, unfolded, ..SessionOptions::default() };
            let mut session = Session::new(model, rig.clone(), &options).unwrap();
            session.run(&images.views()).unwrap().logits.unwrap().to_vec()
        };
        let plain = logits(Rewrites::NONE, false);
        let rms = (plain.iter().map(|v| f64::from(v * v)).sum::<f64>() / plain.len() as f64).sqrt();
        let batch_norm = Rewrites { projection: false, ..Rewrites::ALL };
        let kept = logits(batch_norm, false);
        for (found, what) in [(&kept, "batch norm"), (&logits(Rewrites::ALL, false), "projection")] {
            let far = found.iter().zip(&plain).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
            prop_assert!(far <= 5e-3 * rms, "{what}: {far:e} of {rms:e}");
            prop_assert!(found.iter().all(|v| v.is_finite()));
        }
        prop_assert_eq!(logits(Rewrites::ALL, true), kept, "without its projection a model is as if it never had it");
    }
}
