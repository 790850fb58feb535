//! The fast builder against a naive one, and the file format against damage.

use super::*;
use crate::base::error::ErrorKind;
use crate::base::threads::Threads;
use crate::file::container::{self, Data, Layout, Tensor};
use crate::network::{Network, Sampling};
use proptest::prelude::*;
use safetensors::Dtype;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::sync::Arc;
use voxcast_kernels::Isa;

type Matrix = [f32; 16];

fn network(grid3: [usize; 3], samples: [usize; 3], image: [usize; 2], sampling: Sampling) -> Network {
    let mut network = Network::built_in("nuscenes-200").unwrap();
    network.grids = [grid3.map(|v| 4 * v), grid3.map(|v| 2 * v), grid3];
    (network.samples, network.image, network.sampling) = (samples, image, sampling);
    network.check().unwrap();
    network
}

fn small() -> Network {
    network([2, 1, 1], [2, 1, 3], [64, 96], Sampling::Linspace)
}

/// Pinhole cameras in a ring that look outwards.
fn ring(cameras: usize, [height, width]: [usize; 2], turn: f32) -> Vec<Matrix> {
    let (centre_u, centre_v, focal) = (width as f32 / 2.0, height as f32 / 2.0, width as f32 * 0.8);
    (0..cameras)
        .map(|i| {
            let (s, c) = (std::f32::consts::TAU * i as f32 / cameras as f32 + turn).sin_cos();
            let (right, down, ahead) = ([s, -c, 0.0, 0.1], [0.0, 0.0, -1.0, 0.3], [c, s, 0.0, -0.5]);
            let row = |a: [f32; 4], f: f32, centre: f32| std::array::from_fn(|k| f * a[k] + centre * ahead[k]);
            [row(right, focal, centre_u), row(down, focal, centre_v), ahead, [0.0, 0.0, 0.0, 1.0]]
                .concat()
                .try_into()
                .unwrap()
        })
        .collect()
}

/// Every sample point of every voxel in every camera, from the text of the definition.
fn naive(network: &Network, level: usize, cameras: &[Matrix]) -> [Vec<Vec<u32>>; 2] {
    let ([gx, gy, gz], n) = (network.grids[level], network.samples[level]);
    let axes: Vec<Vec<f32>> =
        (0..3).map(|a| axis::axis(network.sampling, network.bounds[a], network.grids[level][a] * n)).collect();
    let [height, width] = network.image.map(|v| v as f32);
    let [h, w] = network.feature_size(level);
    let stride = network.strides[level] as f32;
    let mut rows = [vec![BTreeSet::new(); gx * gy * gz], vec![BTreeSet::new(); gx * gy]];
    for (i, &x) in axes[0].iter().enumerate() {
        for (j, &y) in axes[1].iter().enumerate() {
            for (k, &z) in axes[2].iter().enumerate() {
                for (camera, m) in cameras.iter().enumerate() {
                    let p: Vec<f32> = m
                        .chunks(4)
                        .take(3)
                        .map(|r| match cameras.len() {
                            1 => (r[0] * x + r[2] * z) + (r[1] * y + r[3]),
                            _ => 1f32.mul_add(r[3], z.mul_add(r[2], y.mul_add(r[1], x * r[0]))),
                        })
                        .collect();
                    let (u, v, d) = (p[0] / p[2], p[1] / p[2], p[2]);
                    if !(u >= 0.0 && u <= width - 1.0 && v >= 0.0 && v <= height - 1.0 && d >= 0.0) {
                        continue;
                    }
                    let flat = camera * h * w + (v / stride).floor() as usize * w + (u / stride).floor() as usize;
                    if flat > 0 {
                        let column = (i / n) * gy + j / n;
                        rows[0][column * gz + k / n].insert(flat as u32);
                        rows[1][column].insert(flat as u32);
                    }
                }
            }
        }
    }
    rows.map(|rows| rows.into_iter().map(|r| r.into_iter().collect()).collect())
}

fn rows(csr: Csr<'_>) -> Vec<Vec<u32>> {
    csr.ptr.windows(2).map(|e| csr.col[e[0] as usize..e[1] as usize].to_vec()).collect()
}

fn assert_naive(network: &Network, cameras: &[Matrix], rig: &Rig) {
    for l in 0..3 {
        let [volume, bev] = naive(network, l, cameras);
        assert_eq!(rows(rig.level(l).volume), volume, "volume of level {}", l + 1);
        assert_eq!(rows(rig.level(l).bev), bev, "BEV of level {}", l + 1);
    }
}

fn build(network: &Network, cameras: &[Matrix]) -> Rig {
    RigBuilder::new(network, cameras.len(), Isa::best()).unwrap().build(cameras).unwrap()
}

/// u = 8 x, v = 8 y, wherever z is.
const DOWN: Matrix = [8., 0., 0., 0., 0., 8., 0., 0., 0., 0., 0., 1., 0., 0., 0., 1.];

#[test]
fn matrices_by_hand() {
    // Voxels of 1 m at level 1, seen from above: voxel (x, y) covers exactly feature pixel (u, v) = (x, y) of 4 x 4.
    let mut network = network([1, 1, 1], [1, 1, 1], [32, 32], Sampling::Centres);
    network.bounds = [[0.0, 4.0]; 3];
    let rig = build(&network, &[DOWN, DOWN]);
    assert_eq!(rig.cameras(), 2);
    let level = rig.level(0);
    for x in 0..4u32 {
        for y in 0..4u32 {
            let pixel = y * 4 + x;
            let expected = if pixel == 0 { vec![16] } else { vec![pixel, 16 + pixel] };
            let column = (x * 4 + y) as usize;
            assert_eq!(rows(level.bev)[column], expected, "column {x}, {y}: pixel 0 of camera 0 never counts");
            for z in 0..4 {
                assert_eq!(rows(level.volume)[column * 4 + z], expected, "voxel {x}, {y}, {z}");
            }
        }
    }
    // Level 2: 2 x 2 pixels, centres at 1 m and 3 m; level 3: one pixel, the 0th.
    assert_eq!(rows(rig.level(1).bev), [vec![4], vec![2, 6], vec![1, 5], vec![3, 7]]);
    assert_eq!(rows(rig.level(2).bev), [vec![1]]);
    assert_eq!(rig.level(2).volume, rig.level(2).bev);
}

#[test]
fn linspace_reaches_the_bounds() {
    // Two points per axis at level 1's four voxels: 0, 4/7, ..., 4 m. The last is u = 32, outside of 0..=31.
    let mut network = network([1, 1, 1], [2, 1, 1], [32, 32], Sampling::Linspace);
    network.bounds = [[0.0, 4.0]; 3];
    let rig = build(&network, &[DOWN, DOWN]);
    // Voxel 3 along x has points at 24/7 and 4 m: u = 27.4 and 32.
    assert_eq!(rows(rig.level(0).bev)[12], [3, 19]);
    // Level 3 has the one point 0, 0, 0.
    assert_eq!(rows(rig.level(2).bev), [vec![1]]);
}

fn sampling() -> impl Strategy<Value = Sampling> {
    prop_oneof![Just(Sampling::Linspace), Just(Sampling::Centres)]
}

fn wild() -> impl Strategy<Value = Matrix> {
    let number = prop_oneof![4 => -100.0f32..100.0, 2 => Just(0.0f32), 1 => prop::num::f32::ANY];
    prop::array::uniform16(number)
}

/// Matrices whose products overflow, vanish or turn into -0 in f32 but not in f64.
fn extreme() -> impl Strategy<Value = Matrix> {
    let number = prop_oneof![
        Just(0.0f32),
        Just(-0.0f32),
        (any::<bool>(), -149i32..128, 1.0f32..2.0).prop_map(|(negative, exponent, m)| {
            let v = (f64::from(m) * 2f64.powi(exponent)) as f32;
            if negative { -v } else { v }
        }),
    ];
    prop::array::uniform16(number)
}

fn networks() -> impl Strategy<Value = Network> {
    let grid = (1usize..4, 1usize..3, 1usize..3).prop_map(|(x, y, z)| [x, y, z]);
    let image = (1usize..5, 1usize..9).prop_map(|(h, w)| [h * 32, w * 32]);
    (grid, prop::array::uniform3(1usize..4), image, sampling()).prop_map(|(g, n, i, s)| network(g, n, i, s))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn builder_is_naive(network in networks(), cameras in 1usize..7, turn in 0.0f32..6.3) {
        let cameras = ring(cameras, network.image, turn);
        let rig = build(&network, &cameras);
        assert_naive(&network, &cameras, &rig);
        let mut scalar = RigBuilder::new(&network, cameras.len(), Isa::Scalar).unwrap();
        prop_assert!(scalar.build(&cameras).unwrap() == rig);
    }

    #[test]
    fn builder_is_naive_on_absurd_calibrations(
        network in networks(),
        cameras in prop::collection::vec(prop_oneof![wild(), extreme()], 1..4),
    ) {
        assert_naive(&network, &cameras, &build(&network, &cameras));
    }

    #[test]
    fn rebuilding_is_building(network in networks(), turns in prop::collection::vec(0.0f32..6.3, 2..4)) {
        let mut builder = RigBuilder::new(&network, 3, Isa::best()).unwrap();
        let mut rig = builder.build(&ring(3, network.image, 1.0)).unwrap();
        for turn in turns {
            let cameras = ring(3, network.image, turn);
            builder.rebuild(&cameras, &mut rig).unwrap();
            prop_assert!(rig == build(&network, &cameras));
        }
    }
}

#[test]
fn many_pixels_and_slabs() {
    // 17 x 9 columns at level 3, 2448 at level 1: more than a slab each, the last one short. 24576 pixels: six words of
    // the set's summary.
    let network = network([17, 9, 1], [2, 2, 1], [512, 1024], Sampling::Linspace);
    let cameras = ring(3, network.image, 0.3);
    let rig = build(&network, &cameras);
    assert_naive(&network, &cameras, &rig);
    assert!(rig.level(0).volume.col.len() > 10_000);
}

#[test]
fn threads_do_not_show() {
    let network = network([9, 7, 2], [3, 2, 2], [96, 160], Sampling::Linspace);
    let cameras = ring(5, network.image, 0.7);
    let one = build(&network, &cameras);
    assert_naive(&network, &cameras, &one);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let crews = [0, 1, 2, 3, 8].map(|threads| Threads::new(threads).unwrap());
    for threads in crews.into_iter().chain([Threads::pool(Arc::new(pool))]) {
        let mut builder = RigBuilder::new(&network, 5, Isa::best()).unwrap().with_threads(threads.clone());
        assert!(builder.build(&cameras).unwrap() == one, "{threads:?}");
    }
}

#[test]
fn steps_do_not_show() {
    let network = network([9, 7, 2], [3, 2, 2], [96, 160], Sampling::Linspace);
    let [cameras, others] = [0.7, 0.2].map(|turn| ring(5, network.image, turn));
    let (expected, before) = (build(&network, &cameras), build(&network, &others));
    assert!(expected != before);
    for (threads, steps) in [(1, 1), (2, 1), (2, 7), (3, 1000), (1, usize::MAX), (1, 0)] {
        let builder = RigBuilder::new(&network, 5, Isa::best()).unwrap();
        let mut builder = builder.with_threads(Threads::new(threads).unwrap());
        let mut rig = builder.build(&others).unwrap();
        // What was begun before is dropped.
        builder.begin(&others).unwrap();
        assert!(steps == usize::MAX || !builder.advance(3, &mut rig).unwrap());
        builder.begin(&cameras).unwrap();
        let mut calls = 1;
        while !builder.advance(steps, &mut rig).unwrap() {
            assert!(rig == before, "unchanged until it is complete");
            calls += 1;
        }
        assert!(rig == expected, "{threads} threads, {steps} steps");
        assert_eq!(calls, builder.steps().div_ceil(steps.max(1)));
        let error = builder.advance(1, &mut rig).unwrap_err();
        assert_eq!(
            (error.kind(), error.message()),
            (ErrorKind::Mismatch, "no rig was begun, expected a call of `begin` first")
        );
    }
}

#[test]
fn rebuilding_keeps_memory() {
    let network = small();
    let cameras = ring(6, network.image, 0.2);
    let mut builder = RigBuilder::new(&network, 6, Isa::best()).unwrap();
    let mut rig = builder.build(&cameras).unwrap();
    let at = |rig: &Rig| [0, 1, 2].map(|l| (rig.level(l).volume.col.as_ptr(), rig.level(l).bev.ptr.as_ptr()));
    let first = at(&rig);
    builder.rebuild(&cameras, &mut rig).unwrap();
    let second = at(&rig);
    for expected in [first, second, first] {
        builder.rebuild(&cameras, &mut rig).unwrap();
        assert_eq!(at(&rig), expected, "two memories take turns");
    }
}

#[test]
fn a_refused_rebuild_changes_nothing() {
    let network = small();
    let mut builder = RigBuilder::new(&network, 2, Isa::best()).unwrap();
    let mut rig = builder.build(&ring(2, network.image, 0.2)).unwrap();
    let e = builder.rebuild(&[DOWN; 3], &mut rig).unwrap_err();
    assert_eq!((e.kind(), e.message()), (ErrorKind::Mismatch, "3 camera matrices, the builder expects 2"));
    assert!(rig == build(&network, &ring(2, network.image, 0.2)));
}

#[test]
fn nothing_seen_is_a_rig() {
    let network = small();
    for value in [0.0, f32::NAN, f32::INFINITY] {
        let rig = build(&network, &[[value; 16]; 2]);
        for l in 0..3 {
            assert_eq!(rig.level(l).volume.col.len(), 0, "{value}");
            assert!(rig.level(l).bev.ptr.iter().all(|&p| p == 0));
            assert_eq!(rig.level(l).volume.ptr.len(), network.grids[l].iter().product::<usize>() + 1);
        }
    }
}

#[test]
fn negative_coordinates_that_vanish_count() {
    // u is -0: -1e-30 / 1e20 underflows, and -1 / (x * 1e38) divides by an overflowed infinity.
    let constant = |u: f32, d: f32| [[0., 0., 0., u], [0.; 4], [0., 0., 0., d], [0.; 4]].concat().try_into().unwrap();
    let mut overflowing: Matrix = constant(-1.0, 0.0);
    overflowing[8] = 1e38;
    let network = small();
    let cameras = [constant(-1e-30, 1e20), constant(-1e-30, 1e20), overflowing];
    let rig = build(&network, &cameras);
    assert_naive(&network, &cameras, &rig);
    let pixels = network.feature_pixels(0) as u32;
    assert_eq!(rows(rig.level(0).bev)[0], [pixels], "x = -50: the third camera looks the other way");
    assert_eq!(rows(rig.level(0).bev).last().unwrap()[..], [pixels, 2 * pixels]);
}

#[test]
fn what_cannot_be_built_is_refused_at_once() {
    let refused = |network: Network, cameras: usize, expected: &str| {
        let e = RigBuilder::new(&network, cameras, Isa::best()).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::TooLarge);
        assert!(e.message().contains(expected), "{e}");
    };
    refused(network([4096, 2048, 1], [1; 3], [64, 64], Sampling::Linspace), 1, "536870912 voxels");
    refused(network([25, 25, 2], [4, 5, 512], [64, 64], Sampling::Linspace), 6, "level 3");
    refused(network([1, 1, 1], [1, 1, 2048], [64, 64], Sampling::Linspace), 1, "of a column");
    refused(network([1, 1, 1], [1; 3], [16384, 16384], Sampling::Linspace), 1025, "feature pixels of all cameras");
    let mut all = network([4096, 2048, 1], [65536; 3], [16384, 16384], Sampling::Linspace);
    refused(all.clone(), usize::MAX, "voxels");
    all.image = [33, 32];
    assert_eq!(RigBuilder::new(&all, 1, Isa::best()).unwrap_err().kind(), ErrorKind::Format, "an unchecked network");
    assert_eq!(RigBuilder::new(&small(), 0, Isa::best()).unwrap_err().kind(), ErrorKind::Format);
}

// Files.

fn saved() -> (tempfile::TempDir, std::path::PathBuf, Network, Rig) {
    let mut network = network([1, 1, 1], [2, 2, 3], [32, 64], Sampling::Linspace);
    network.bounds = [[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.5]];
    let rig = build(&network, &ring(2, network.image, 0.1));
    assert!(rig.level(0).volume.col.len() > 40 && (1..3).all(|l| !rig.level(l).bev.col.is_empty()), "{rig:?}");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rig.safetensors");
    rig.save(&path, &network).unwrap();
    (dir, path, network, rig)
}

#[test]
fn a_saved_rig_maps_back() {
    let (dir, path, network, rig) = saved();
    let mut mapped = Rig::open(&path, &network, 2).unwrap();
    assert!(mapped == rig);
    assert!(mapped.is_mapped() && !rig.is_mapped());
    assert_eq!(mapped.cameras(), 2);
    let again = dir.path().join("again");
    mapped.save(&again, &network).unwrap();
    assert_eq!(fs::read(&again).unwrap(), fs::read(&path).unwrap());
    // A mapped rig can be rebuilt, and the file stays as it is.
    let cameras = ring(2, network.image, 2.0);
    RigBuilder::new(&network, 2, Isa::best()).unwrap().rebuild(&cameras, &mut mapped).unwrap();
    assert!(mapped == build(&network, &cameras) && !mapped.is_mapped());
    assert!(Rig::open(&path, &network, 2).unwrap() == rig);
    let metadata = Container::open(&path).unwrap().metadata().clone();
    assert_eq!(metadata["format"], "voxcast-rig-1");
    assert_eq!(metadata["cameras"], "2");
    assert_eq!(Network::from_json(&metadata["network"]).unwrap(), network);
}

#[test]
fn every_truncation_and_bit_flip_of_a_saved_rig_is_refused() {
    let (_dir, path, network, _) = saved();
    let bytes = fs::read(&path).unwrap();
    let read = |bytes: &[u8]| {
        Container::from_bytes(bytes.to_vec()).and_then(|c| Rig::from_container(c, &network, 2)).map(|_| ())
    };
    read(&bytes).unwrap();
    for n in 0..bytes.len() {
        assert!(read(&bytes[..n]).is_err(), "cut to {n} bytes");
    }
    let mut damaged = bytes.clone();
    for bit in 0..bytes.len() * 8 {
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(read(&damaged).is_err(), "bit {bit} flipped");
        damaged[bit / 8] ^= 1 << (bit % 8);
    }
    for n in [0, 1, 8, 100, bytes.len() - 1] {
        fs::write(&path, &bytes[..n]).unwrap();
        let e = Rig::open(&path, &network, 2).unwrap_err();
        assert_eq!((e.kind(), e.path()), (ErrorKind::Format, Some(&*path)), "{e}");
    }
}

#[test]
fn a_rig_of_another_network_says_so() {
    let (dir, path, network, rig) = saved();
    let refused = |network: &Network, cameras: usize, expected: &str| {
        let e = Rig::open(&path, network, cameras).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Mismatch, "{e}");
        assert!(e.message().contains(expected), "{e}");
    };
    refused(&network, 3, "a rig of 2 cameras, expected 3");
    refused(&small(), 2, "another network: its image is [32, 64], expected [64, 96]");
    let samples = Network { samples: [1, 1, 2], ..network.clone() };
    refused(&samples, 2, "its samples is [2, 2, 3], expected [1, 1, 2]");
    let centres = Network { sampling: Sampling::Centres, ..network.clone() };
    refused(&centres, 2, "its sampling is Linspace, expected Centres");
    // What the matrices do not depend on may differ.
    let deeper = Network { depths: [3, 4, 6, 3], classes: 20, ..network };
    assert!(Rig::open(&path, &deeper, 2).unwrap() == rig);
    let e = rig.save(&dir.path().join("other"), &small()).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Mismatch);
    assert!(!dir.path().join("other").exists());
}

#[test]
fn files_of_other_formats_say_so() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a");
    for (format, kind) in [("voxcast-rig-2", ErrorKind::Unsupported), ("voxcast-model-1", ErrorKind::Mismatch)] {
        let metadata = BTreeMap::from([("format".to_owned(), format.to_owned())]);
        container::write(&path, vec![], &metadata, Layout::Packed).unwrap();
        let e = Rig::open(&path, &small(), 1).unwrap_err();
        assert_eq!(e.kind(), kind, "{e}");
        assert!(e.message().contains(format));
    }
}

/// Tensors of a plain rig by name.
type Plain = BTreeMap<String, Vec<u32>>;

fn plain(rig: &Rig) -> Plain {
    let mut tensors = Plain::new();
    for l in 0..3 {
        let level = rig.level(l);
        for (which, csr) in [("volume", level.volume), ("bev", level.bev)] {
            tensors.insert(format!("level{}.{which}.ptr", l + 1), csr.ptr.to_vec());
            tensors.insert(format!("level{}.{which}.col", l + 1), csr.col.to_vec());
        }
    }
    tensors
}

/// As the reference library writes it, with the header `shift` bytes longer than it chose.
fn plain_bytes(tensors: &Plain, shift: usize) -> Vec<u8> {
    let bytes: BTreeMap<_, Vec<u8>> =
        tensors.iter().map(|(k, v)| (k.as_str(), v.iter().flat_map(|w| w.to_le_bytes()).collect())).collect();
    let views = bytes
        .iter()
        .map(|(k, v)| (*k, safetensors::tensor::TensorView::new(Dtype::U32, vec![v.len() / 4], v).unwrap()));
    let mut file = safetensors::serialize(views, None).unwrap();
    let header = u64::from_le_bytes(*file.first_chunk().unwrap()) as usize;
    file.splice(8 + header..8 + header, std::iter::repeat_n(b' ', shift));
    file[..8].copy_from_slice(&((header + shift) as u64).to_le_bytes());
    file
}

#[test]
fn plain_rigs_are_accepted() {
    let (dir, _, network, rig) = saved();
    let path = dir.path().join("plain");
    for shift in 0..4 {
        fs::write(&path, plain_bytes(&plain(&rig), shift)).unwrap();
        let read = Rig::open(&path, &network, 2).unwrap();
        assert!(read == rig);
        assert_eq!(read.is_mapped(), shift == 0 && cfg!(target_endian = "little"), "misaligned tensors are copied");
    }
    let mut more = plain(&rig);
    more.insert("another.tensor".into(), vec![1, 2, 3]);
    fs::write(&path, plain_bytes(&more, 0)).unwrap();
    assert!(Rig::open(&path, &network, 2).unwrap() == rig);
}

#[test]
fn every_truncation_of_a_plain_rig_is_refused() {
    let (_dir, _, network, rig) = saved();
    let bytes = plain_bytes(&plain(&rig), 0);
    for n in 0..bytes.len() {
        let read = Container::from_bytes(bytes[..n].to_vec()).and_then(|c| Rig::from_container(c, &network, 2));
        assert!(read.is_err(), "cut to {n} bytes");
    }
}

#[test]
fn broken_rules_of_plain_rigs_are_named() {
    let (_dir, _, network, rig) = saved();
    let good = plain(&rig);
    let read = |tensors: &Plain| -> Result<Rig> {
        Rig::from_container(Container::from_bytes(plain_bytes(tensors, 0))?, &network, 2)
    };
    read(&good).unwrap();
    for name in good.keys() {
        let mut tensors = good.clone();
        tensors.remove(name);
        let e = read(&tensors).unwrap_err();
        assert!(e.kind() == ErrorKind::Format && e.message().contains(&format!("no tensor {name}")), "{e}");
    }
    let refused = |name: &str, change: &dyn Fn(&mut Vec<u32>), kind: ErrorKind, expected: &str| {
        let mut tensors = good.clone();
        change(tensors.get_mut(name).unwrap());
        let e = read(&tensors).unwrap_err();
        assert_eq!(e.kind(), kind, "{e}");
        assert!(e.message().contains(name) && e.message().contains(expected), "{e} (expected {expected})");
    };
    let format = ErrorKind::Format;
    let ptr = "level1.volume.ptr";
    refused(ptr, &|p| p[0] = 1, format, "row 0 starts at entry 1, expected 0");
    refused(ptr, &|p| p.push(p[64]), ErrorKind::Mismatch, "65 rows, expected 64");
    refused(ptr, &|p| p.clear(), ErrorKind::Mismatch, "0 rows, expected 64");
    refused(ptr, &|p| p[64] += 1, format, "the last row ends at entry");
    refused(ptr, &|p| p[9] = u32::MAX, format, "row 8 is entries");
    refused("level3.bev.ptr", &|p| p[1] = 0, format, "the last row ends at entry 0");
    let descent = good[ptr].iter().position(|&p| p > 0).unwrap();
    assert!(descent < 63, "a row in the middle");
    refused(ptr, &|p| p[descent + 1] = 0, format, &format!("row {descent} is entries {} to 0", good[ptr][descent]));
    refused("level2.bev.col", &|c| c.truncate(c.len() - 1), format, "the last row ends at entry");
    let row = good[ptr].windows(2).position(|e| e[1] - e[0] >= 2).unwrap();
    let at = good[ptr][row] as usize;
    let col = "level1.volume.col";
    refused(col, &|c| c.swap(at, at + 1), format, &format!("row {row} holds"));
    refused(col, &|c| c[at + 1] = c[at], format, "expected ascending pixels");
    refused(col, &|c| c[at + 1] = 64, format, "holds pixel 64, expected less than 64");
    refused(col, &|c| c[at + 1] = u32::MAX, format, "holds pixel 4294967295, expected less than 64");
}

#[test]
fn other_types_and_shapes_are_refused() {
    let network = small();
    for (dtype, shape, expected) in [
        (Dtype::I64, vec![4], "I64 of shape [4], expected U32 of one dimension"),
        (Dtype::U32, vec![2, 4], "U32 of shape [2, 4]"),
        (Dtype::U32, vec![], "U32 of shape []"),
        (Dtype::F32, vec![8], "F32 of shape [8]"),
    ] {
        let bytes = vec![0; shape.iter().product::<usize>() * dtype.bitsize() / 8];
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        let tensor = Tensor { name: "level1.volume.ptr".into(), dtype, shape, data: Data::Bytes(&bytes) };
        container::write(&path, vec![tensor], &BTreeMap::new(), Layout::Packed).unwrap();
        let e = Rig::open(&path, &network, 1).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Format);
        assert!(e.message().contains(expected), "{e}");
    }
}
