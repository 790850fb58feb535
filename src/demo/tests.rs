use super::*;

fn network(cameras: usize, image: [usize; 2]) -> Network {
    Network { cameras, image, ..Network::built_in("nuscenes-200").unwrap() }
}

#[test]
fn scene_fits_its_network_and_repeats() {
    for (cameras, image) in [(6, [64, 96]), (1, [32, 128]), (3, [32, 32])] {
        let network = network(cameras, image);
        let scene = demo_scene(&network, 3);
        scene.check(&network).unwrap();
        assert_eq!((scene.cameras(), scene.names.len(), scene.lidar2img.len()), (cameras, cameras, cameras));
        assert!(scene.images.iter().all(|i| [i.height, i.width] == image && i.bgr.len() == image[0] * image[1] * 3));
        assert_eq!(scene, demo_scene(&network, 3));
        assert_ne!(scene.images, demo_scene(&network, 4).images);
    }
}

#[test]
fn bytes_are_the_same_on_every_machine() {
    let scene = demo_scene(&network(6, [64, 96]), 1);
    let bytes: Vec<u8> = scene.images.iter().flat_map(|i| i.bgr.iter().copied()).collect();
    assert_eq!(xxhash_rust::xxh3::xxh3_64(&bytes), 18_052_180_888_502_589_278);
}

#[test]
fn calibration_projects_where_the_ray_caster_looked() {
    for (name, forward) in [("nuscenes-200", [0.0f32, 1.0]), ("semantickitti-256", [1.0, 0.0])] {
        let network = Network { cameras: 6, image: [64, 96], ..Network::built_in(name).unwrap() };
        let scene = demo_scene(&network, 0);
        for (index, matrix) in scene.lidar2img.iter().enumerate() {
            // A point ten metres along the camera's axis must land on the principal point.
            let camera = Pinhole::new(index, &network);
            let p = (camera.at + camera.ahead * 10.0).as_vec3();
            let [fx, fy] = forward;
            let p = [p.x * fx - p.y * fy, p.x * fy + p.y * fx, p.z, 1.0];
            let row = |r: usize| (0..4).map(|c| matrix[4 * r + c] * p[c]).sum::<f32>();
            assert!((row(2) - 10.0).abs() < 1e-4);
            assert!((row(0) / row(2) - 48.0).abs() < 1e-3 && (row(1) / row(2) - 0.53 * 64.0).abs() < 1e-3);
        }
    }
}

#[test]
fn sine_and_cosine_are_right() {
    for degrees in -360..=360 {
        let (sin, cos) = sin_cos(f64::from(degrees));
        let (s, c) = f64::from(degrees).to_radians().sin_cos();
        assert!((sin - s).abs() < 1e-14 && (cos - c).abs() < 1e-14, "{degrees}");
    }
}
