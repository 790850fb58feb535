use super::*;
use glam::{Vec2, Vec3};
use objects::Model;
use solid::Object;
use world::World;

fn edge() -> Network {
    Network::built_in("edge").expect("a built-in name")
}

/// A small image and grid, with the voxels of the edge network.
fn small() -> Network {
    let grids = [[28, 28, 4], [14, 14, 2], [7, 7, 1]];
    Network { image: [64, 160], grids, bounds: [[-27.0, 27.0], [-27.0, 27.0], [-5.3, 2.7]], ..edge() }
}

fn bytes(frame: &Frame) -> Vec<u8> {
    let mut bytes = frame.labels.clone();
    bytes.extend(&frame.visible);
    frame.scene.images.iter().for_each(|i| bytes.extend(&i.bgr));
    frame.pixel_classes.iter().for_each(|c| bytes.extend(c));
    frame.pixel_depths.iter().flatten().for_each(|d| bytes.extend(d.to_le_bytes()));
    frame.scene.lidar2img.iter().flatten().for_each(|d| bytes.extend(d.to_le_bytes()));
    bytes
}

#[test]
fn a_seed_gives_the_bytes_that_it_always_gave() {
    let synthesiser = Synthesiser::new(&small()).expect("17 classes");
    let digest = |frame: &Frame| format!("{:016x}", crate::base::digest::bytes(&bytes(frame)));
    let found = [digest(&synthesiser.frame(1)), digest(&synthesiser.frame(2)), digest(&synthesiser.frame_of(2, 3, 8))];
    assert_eq!(found, PINNED, "models were trained on the worlds that seeds gave");
    assert_eq!(bytes(&synthesiser.frame(1)), bytes(&synthesiser.frame(1)));
}

/// Of the frames in the test above.
const PINNED: [&str; 3] = ["9df72d14837c108f", "f172cf99fee29156", "8d16dfe411c280b0"];

#[test]
fn every_class_is_common() {
    let synthesiser = Synthesiser::new(&Network { image: [32, 64], ..edge() }).expect("17 classes");
    let (mut scenes, mut voxels) = ([0usize; 17], [0usize; 17]);
    let count = 30;
    for seed in 0..count {
        let frame = synthesiser.frame(40_000 + seed);
        let mut here = [0usize; 17];
        frame.labels.iter().for_each(|&class| here[usize::from(class)] += 1);
        for class in 0..17 {
            scenes[class] += usize::from(here[class] > 0);
            voxels[class] += here[class];
        }
    }
    for class in 0..17 {
        assert!(scenes[class] * 2 > count as usize, "{} in {} of {count} scenes", CLASSES[class], scenes[class]);
    }
    let empty = voxels[0] as f64 / voxels.iter().sum::<usize>() as f64;
    assert!((0.6..0.95).contains(&empty), "{empty} of the voxels are empty");
}

#[test]
fn what_a_pixel_sees_is_in_the_voxel_at_its_end_and_that_is_visible() {
    let network = edge();
    let synthesiser = Synthesiser::new(&network).expect("17 classes");
    let frame = synthesiser.frame(3);
    let ([nx, ny, nz], edge) = (network.output_grid(), network.voxel_size());
    let (mut same, mut near, mut all) = (0usize, 0usize, 0usize);
    for (camera, pinhole) in synthesiser.cameras.iter().enumerate() {
        let [height, width] = pinhole.size;
        for pixel in (0..height * width).step_by(7) {
            let (class, depth) = (frame.pixel_classes[camera][pixel], frame.pixel_depths[camera][pixel]);
            if class == SKY {
                assert!(depth.is_infinite());
                continue;
            }
            let ray = pinhole.ray((pixel % width) as f64, (pixel / width) as f64).as_vec3();
            let at = pinhole.at.as_vec3() + ray * depth;
            // The vehicle drives along +y of the lidar frame.
            let lidar = Vec3::new(-at.y, at.x, at.z);
            let index = |axis: usize| ((lidar[axis] - network.bounds[axis][0]) / edge[axis]).floor();
            let inside = [nx, ny, nz].iter().enumerate().all(|(axis, &n)| (0.0..n as f32).contains(&index(axis)));
            if !inside {
                continue;
            }
            let voxel = |dx: f32, dy: f32, dz: f32| {
                let clamped =
                    |axis: usize, step: f32, n: usize| (index(axis) + step).clamp(0.0, n as f32 - 1.0) as usize;
                let (x, y, z) = (clamped(0, dx, nx), clamped(1, dy, ny), clamped(2, dz, nz));
                (x * ny + y) * nz + z
            };
            all += 1;
            let here = voxel(0.0, 0.0, 0.0);
            assert_eq!(frame.visible[here], 1, "camera {camera}, pixel {pixel}");
            same += usize::from(frame.labels[here] == class);
            let around = [-1.0, 0.0, 1.0];
            near += usize::from(
                around
                    .iter()
                    .any(|&x| around.iter().any(|&y| around.iter().any(|&z| frame.labels[voxel(x, y, z)] == class))),
            );
        }
    }
    assert!(all > 5000, "{all} pixels end in the grid");
    assert!(same as f64 / all as f64 > 0.75, "{same} of {all} pixels end in a voxel of their class");
    assert!(near as f64 / all as f64 > 0.95, "{near} of {all} pixels end beside a voxel of their class");
}

#[test]
fn the_calibration_is_that_of_the_images() {
    for network in [small(), Network { cameras: 1, bounds: [[0.0, 50.0], [-25.0, 25.0], [-2.0, 4.0]], ..small() }] {
        let synthesiser = Synthesiser::new(&network).expect("17 classes");
        let forward = forward_of(&network.bounds);
        let matrices: Vec<_> = synthesiser.cameras.iter().map(|c| (c.name.clone(), c.lidar2img)).collect();
        let again = synthesiser.clone().with_cameras(&matrices).expect("cameras");
        for (camera, other) in synthesiser.cameras.iter().zip(&again.cameras) {
            for [u, v] in [[0.0, 0.0], [100.0, 31.0], [17.5, 60.0]] {
                let at = (camera.at + camera.ray(u, v) * 12.0).as_vec3();
                let [fx, fy] = forward;
                let lidar = [at.x * fx - at.y * fy, at.x * fy + at.y * fx, at.z, 1.0];
                let row = |r: usize| (0..4).map(|c| camera.lidar2img[4 * r + c] * lidar[c]).sum::<f32>();
                let depth = row(2);
                assert!((depth - 12.0).abs() < 1e-3, "{depth}");
                assert!((row(0) / depth - u as f32).abs() < 1e-2 && (row(1) / depth - v as f32).abs() < 1e-2);
                assert!((camera.ray(u, v) - other.ray(u, v)).length() < 1e-4, "a camera made of its matrix");
                assert!((camera.at - other.at).length() < 1e-3);
            }
        }
    }
}

#[test]
fn the_ego_vehicle_drives_and_others_too() {
    let worlds = [0.0f32, 4.0].map(|travelled| World::new(9, 40.0, travelled));
    let step = (worlds[1].ego.0 - worlds[0].ego.0).truncate();
    assert!((step.length() - 4.0).abs() < 0.5 && step.dot(worlds[0].ego.1) > 3.5, "{step}");
    let places =
        |world: &World| world.objects.iter().map(|o| o.at.truncate().round().to_array().map(|v| v as i32)).collect();
    let [before, after]: [std::collections::BTreeSet<[i32; 2]>; 2] = [places(&worlds[0]), places(&worlds[1])];
    let stay = before.intersection(&after).count();
    assert!(stay * 2 > before.len(), "most things stand: {stay} of {}", before.len());
    assert!(before.len() - stay > 5, "some move");
}

#[test]
fn rays_and_points_agree_on_every_shape() {
    let mut random = Random::new(5);
    let makers: [fn(&mut Random) -> Model; 8] = [
        objects::car,
        objects::bus,
        objects::truck,
        objects::construction_vehicle,
        objects::pedestrian,
        objects::traffic_cone,
        objects::tree,
        objects::pole,
    ];
    for make in makers {
        let model = make(&mut random);
        let along = Vec2::new(0.6, 0.8);
        let object = Object::new(model.class, Vec3::new(3.0, -2.0, 1.0), along, model.parts);
        let [low, high] = object.bounds();
        let (mut hits, mut deep) = (0, 0);
        for _ in 0..2000 {
            let within = |a: f32, b: f32, random: &mut Random| random.range(a, b);
            let target = Vec3::new(
                within(low.x, high.x, &mut random),
                within(low.y, high.y, &mut random),
                within(low.z, high.z, &mut random),
            );
            let from = target + Vec3::new(random.range(-1.0, 1.0), random.range(-1.0, 1.0), 0.5).normalize() * 40.0;
            let ray = (target - from).normalize();
            let found = object.hit(from, ray, 100.0, 0..object.parts.len());
            let inside = |distance: f32, thick: f32| {
                let at = object.inwards(from + ray * distance - object.at);
                object.parts.iter().any(|p| p.contains(at, thick))
            };
            if let Some((_, hit)) = found {
                hits += 1;
                // A ray that only grazes a part is out of it again at once.
                deep += usize::from([1e-3, 4e-3, 1e-2].into_iter().any(|step| inside(hit.distance + step, 0.02)));
                assert!(hit.normal.dot(ray) < 1e-3 && (hit.normal.length() - 1.0).abs() < 1e-3);
                let inner = object.inwards(ray);
                let shades = |limit| object.shades(from, [inner, inner.recip()], limit, 0..object.parts.len());
                assert!(shades(100.0) && !shades(hit.distance - 0.01));
            }
            let aim = (target - from).length();
            let point = object.inwards(target - object.at);
            if object.parts.iter().any(|p| p.contains(point, 0.0)) {
                let first = found.map_or(f32::INFINITY, |(_, hit)| hit.distance);
                assert!(first <= aim + 1e-2, "a point inside is behind the surface");
            }
        }
        assert!(hits > 100, "{hits} hits");
        assert!(deep * 50 > hits * 49, "{deep} of {hits} hits lead into a part");
    }
}

#[test]
fn what_cannot_be_is_refused() {
    let few = Network { classes: 9, ..small() };
    assert!(Synthesiser::new(&few).expect_err("nine classes").to_string().contains("9 classes"));
    let synthesiser = Synthesiser::new(&small()).expect("17 classes");
    assert!(synthesiser.clone().with_cameras(&[]).is_err());
    let error = synthesiser.with_cameras(&[("flat".to_owned(), [0.0; 16])]).expect_err("no camera");
    assert!(error.to_string().contains("flat"), "{error}");
}

#[cfg(all(feature = "images", feature = "npz"))]
#[test]
fn files_are_scenes_and_hold_what_the_frame_has() {
    use crate::file::npz::{OwnedElements, read_npz};
    let directory = tempfile::tempdir().expect("a directory");
    let network = small();
    let synthesiser = Synthesiser::new(&network).expect("17 classes");
    let frame = synthesiser.frame(4);
    let path = directory.path().join(set_file(4));
    frame.save_tensors(&path, crate::network::Grid::of(&network), true).expect("written");
    let scene = Scene::open(&path).expect("a scene");
    assert_eq!((&scene.images, &scene.lidar2img), (&frame.scene.images, &frame.scene.lidar2img));
    let place = directory.path().join("scene");
    frame.save_scene(&place, crate::network::Grid::of(&network)).expect("written");
    assert_eq!(Scene::open(&place).expect("a scene"), frame.scene);
    let arrays = read_npz(&place.join("labels.npz")).expect("arrays");
    assert_eq!(arrays[0].elements, OwnedElements::U8(frame.labels.clone()));
    assert_eq!(arrays[1].elements, OwnedElements::U8(frame.visible.clone()));
    // SurroundOcc's rows, read by hand.
    let rows = std::fs::read(place.join("labels.npy")).expect("a file");
    let start = 10 + usize::from(u16::from_le_bytes([rows[8], rows[9]]));
    assert_eq!((&rows[..6], start % 64), (&b"\x93NUMPY"[..], 0));
    let mut labels = vec![0u8; frame.labels.len()];
    let [_, ny, nz] = network.output_grid();
    for row in rows[start..].chunks_exact(32) {
        let value = |i: usize| i64::from_le_bytes(row[8 * i..8 * i + 8].try_into().expect("eight")) as usize;
        labels[(value(0) * ny + value(1)) * nz + value(2)] = value(3) as u8;
    }
    assert_eq!(labels, frame.labels);
}

#[cfg(all(feature = "images", feature = "npz"))]
#[test]
fn a_set_goes_on_where_it_was_and_takes_no_other_network() {
    let directory = tempfile::tempdir().expect("a directory");
    let synthesiser = Synthesiser::new(&small()).expect("17 classes");
    synthesiser.begin_set(directory.path()).expect("begun");
    synthesiser.begin_set(directory.path()).expect("gone on with");
    let other = Synthesiser::new(&Network { image: [32, 64], ..small() }).expect("17 classes");
    let error = other.begin_set(directory.path()).expect_err("another network");
    assert!(error.to_string().contains("set.json"), "{error}");
}
