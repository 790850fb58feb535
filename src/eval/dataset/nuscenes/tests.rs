use super::super::{Axes, IGNORED, OTHERS};
use super::*;
use crate::base::error::ErrorKind;
use crate::file::npz::{Array, Elements, write_npz};
use crate::image::png::write_rgb_png;
use serde_json::{Value, json};
use std::fs;

/// Rotations by hand, as (w, x, y, z): none, and about z to the left by a quarter.
const NONE: [f64; 4] = [1.0, 0.0, 0.0, 0.0];
const LEFT: [f64; 4] = [std::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f64::consts::FRAC_1_SQRT_2];
/// A camera that looks along the vehicle's +x: its x to the right (-y), its y down (-z), its z ahead (x).
const AHEAD: [f64; 4] = [0.5, -0.5, 0.5, -0.5];

/// A published set in small: two scenes, three key frames, and what lies between.
struct Place {
    directory: tempfile::TempDir,
    tables: Vec<(&'static str, Vec<Value>)>,
}

impl Place {
    fn new() -> Self {
        let mut sensors: Vec<Value> = vec![json!({"token": "radar", "channel": "RADAR_FRONT", "modality": "radar"})];
        let mut calibrated = vec![json!({"token": "cs-radar", "sensor_token": "radar", "translation": [3, 0, 1],
            "rotation": NONE, "camera_intrinsic": []})];
        for name in CAMERAS.iter().chain([&LIDAR]) {
            sensors.push(json!({"token": name, "channel": name, "modality": "of no interest"}));
            let camera = *name != LIDAR;
            let (intrinsic, rotation) = match camera {
                true => (json!([[100, 0, 50], [0, 200, 60], [0, 0, 1]]), AHEAD),
                // The lidar's y looks ahead.
                false => (json!([]), [LEFT[0], 0.0, 0.0, -LEFT[3]]),
            };
            let translation = if camera { [2.0, 0.0, 1.5] } else { [1.0, 0.0, 2.0] };
            calibrated.push(json!({"token": format!("cs-{name}"), "sensor_token": name, "translation": translation,
                "rotation": rotation, "camera_intrinsic": intrinsic}));
        }
        let tables = vec![
            ("sensor", sensors),
            ("calibrated_sensor", calibrated),
            (
                "scene",
                vec![
                    json!({"token": "s2", "name": "scene-0103", "nbr_samples": 2, "description": "\u{e9} \"x\""}),
                    json!({"token": "s1", "name": "scene-0061", "nbr_samples": 1}),
                ],
            ),
            (
                "sample",
                vec![
                    json!({"token": "late", "timestamp": 2_000_000, "prev": "early", "next": "", "scene_token": "s2"}),
                    json!({"token": "early", "timestamp": 1_000_000, "prev": "", "next": "late", "scene_token": "s2"}),
                    json!({"token": "other", "timestamp": 9_000_000, "prev": "", "next": "", "scene_token": "s1"}),
                ],
            ),
            ("sample_data", Vec::new()),
            ("ego_pose", Vec::new()),
        ];
        let mut place = Self { directory: tempfile::tempdir().expect("a directory"), tables };
        for (at, sample) in ["late", "early", "other"].into_iter().enumerate() {
            for name in CAMERAS.into_iter().chain([LIDAR]) {
                place.see(sample, name, at as f64);
            }
            // What is not needed may refer to what is not there.
            place.table("sample_data").push(json!({"token": format!("sweep-{sample}"), "sample_token": sample,
                "ego_pose_token": "none", "calibrated_sensor_token": "none", "filename": "", "timestamp": 1,
                "is_key_frame": false, "height": 0, "width": 0, "fileformat": "jpg"}));
            place.table("sample_data").push(json!({"token": format!("radar-{sample}"), "sample_token": sample,
                "ego_pose_token": "none", "calibrated_sensor_token": "cs-radar", "filename": "a.pcd", "timestamp": 1,
                "is_key_frame": true, "height": 0, "width": 0, "fileformat": "pcd"}));
        }
        place.table("ego_pose").push(json!({"token": "unused", "translation": [], "rotation": [], "timestamp": 1}));
        fs::create_dir_all(place.root().join("v1.0-mini")).expect("made");
        place.write();
        place
    }

    fn root(&self) -> &Path {
        self.directory.path()
    }

    fn table(&mut self, name: &str) -> &mut Vec<Value> {
        &mut self.tables.iter_mut().find(|(table, _)| *table == name).expect("a table").1
    }

    /// A key frame of one sensor, with its file. While the vehicle turns to the left, each camera is a metre further than the
    /// last one; `number` is how far north the lidar is.
    fn see(&mut self, sample: &str, name: &str, number: f64) {
        let camera = CAMERAS.iter().position(|camera| *camera == name);
        let token = format!("{sample}-{name}");
        let (file, size) = match camera {
            Some(_) => (format!("samples/{name}/{token}.png"), [2, 3]),
            None => (format!("samples/{name}/{token}.pcd.bin"), [0, 0]),
        };
        // The vehicle looks east at the lidar's time, and north at the cameras'.
        let (rotation, translation) = match camera {
            Some(camera) => (LEFT, [10.0, number + camera as f64, 0.0]),
            None => (NONE, [10.0, number, 0.0]),
        };
        let ego = json!({"token": format!("ego-{token}"), "timestamp": 5, "rotation": rotation,
            "translation": translation});
        self.table("ego_pose").push(ego);
        let row = json!({"token": token, "sample_token": sample, "ego_pose_token": format!("ego-{token}"),
            "calibrated_sensor_token": format!("cs-{name}"), "filename": file, "timestamp": 5, "is_key_frame": true,
            "height": size[0], "width": size[1], "fileformat": "png", "prev": "", "next": ""});
        self.table("sample_data").push(row);
        if let Some(camera) = camera {
            let path = self.root().join(&file);
            fs::create_dir_all(path.parent().expect("a directory")).expect("made");
            write_rgb_png(&path, 3, 2, &[camera as u8; 18]).expect("written");
        }
    }

    fn write(&self) {
        for (name, rows) in &self.tables {
            // The published tables are indented.
            let text = serde_json::to_string_pretty(rows).expect("JSON");
            fs::write(self.file(name), text).expect("written");
        }
    }

    fn file(&self, table: &str) -> PathBuf {
        self.root().join(format!("v1.0-mini/{table}.json"))
    }

    fn open(&self, labels: Labels, scenes: &Scenes) -> Result<NuScenes> {
        NuScenes::open(self.root(), labels, &self.root().join("labels"), scenes)
    }
}

fn ids(set: &NuScenes) -> Vec<&str> {
    (0..set.len()).map(|index| set.id(index)).collect()
}

/// What NumPy writes.
fn npy(descr: &str, shape: &str, elements: &[u8]) -> Vec<u8> {
    let mut literal = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
    while !(literal.len() + 11).is_multiple_of(64) {
        literal.push(' ');
    }
    literal.push('\n');
    [b"\x93NUMPY\x01\x00", &(literal.len() as u16).to_le_bytes()[..], literal.as_bytes(), elements].concat()
}

fn rows(rows: &[[i64; 4]]) -> Vec<u8> {
    let elements: Vec<u8> = rows.iter().flatten().flat_map(|n| n.to_le_bytes()).collect();
    npy("<i8", &format!("({}, 4)", rows.len()), &elements)
}

#[test]
fn key_frames_in_the_order_of_scenes_and_time() {
    let place = Place::new();
    let all = place.open(Labels::SurroundOcc, &Scenes::All).expect("a set");
    assert_eq!(ids(&all), ["scene-0061/other", "scene-0103/early", "scene-0103/late"]);
    assert_eq!((all.classes().len(), all.grid().axes, all.grid().voxels()), (17, Axes::Lidar, 640_000));
    let val = place.open(Labels::Occ3d, &Scenes::Val).expect("a set");
    assert_eq!(ids(&val), ["scene-0103/early", "scene-0103/late"]);
    assert_eq!((val.masks(), val.grid().axes), (&["lidar", "camera"][..], Axes::Ego));
    let train = place.open(Labels::Occ3d, &Scenes::Train).expect("a set");
    assert_eq!(ids(&train), ["scene-0061/other"]);
    let list = place.root().join("scenes.txt");
    fs::write(&list, "scene-0061\n\n").expect("written");
    let listed = place.open(Labels::Occ3d, &Scenes::Listed(list)).expect("a set");
    assert_eq!(ids(&listed), ["scene-0061/other"]);
}

#[test]
fn projections_by_hand() {
    let place = Place::new();
    fs::create_dir_all(place.root().join("labels")).expect("made");
    fs::write(place.root().join("labels/late-LIDAR_TOP.pcd.bin.npy"), rows(&[])).expect("written");
    let frame = place.open(Labels::SurroundOcc, &Scenes::All).expect("a set").frame(2).expect("a frame");
    let scene = frame.scene;
    assert_eq!(scene.names, CAMERAS);
    for (camera, (image, found)) in scene.images.iter().zip(&scene.lidar2img).enumerate() {
        assert_eq!((image.height, image.width, image.bgr[7]), (2, 3, camera as u8));
        // A point (x, y, z) of the lidar is at (y + 1, -x, z + 2) of the vehicle, which is at (10, 0) and looks east. A camera
        // later the vehicle is at (10, camera) and looks north, so the point is at (-x - camera, -y - 1) of it. The camera
        // is 2 m ahead and 1.5 m high.
        let c = camera as f32;
        let right = [0.0, 1.0, 0.0, 1.0];
        let down = [0.0, 0.0, -1.0, -0.5];
        let ahead = [-1.0, 0.0, 0.0, -c - 2.0];
        let expected: [[f32; 4]; 4] = [
            std::array::from_fn(|i| 100.0 * right[i] + 50.0 * ahead[i]),
            std::array::from_fn(|i| 200.0 * down[i] + 60.0 * ahead[i]),
            ahead,
            [0.0, 0.0, 0.0, 1.0],
        ];
        for (found, expected) in found.iter().zip(expected.as_flattened()) {
            assert!((found - expected).abs() < 1e-4, "camera {camera}: {found}, expected {expected}");
        }
    }
}

#[test]
fn labels_of_surroundocc() {
    let place = Place::new();
    let write = |directory: &str, bytes: &[u8]| {
        let directory = place.root().join(directory);
        fs::create_dir_all(&directory).expect("made");
        fs::write(directory.join("other-LIDAR_TOP.pcd.bin.npy"), bytes).expect("written");
    };
    write("labels", &rows(&[[0, 0, 1, 4], [199, 199, 15, 16], [7, 8, 9, 0], [0, 0, 2, 5], [0, 0, 2, 6]]));
    let open = || place.open(Labels::SurroundOcc, &Scenes::All).expect("a set");
    let truth = open().truth(0).expect("labels");
    let mut expected = vec![0; 640_000];
    (expected[1], expected[639_999], expected[(7 * 200 + 8) * 16 + 9], expected[2]) = (4, 16, IGNORED, 6);
    assert!(truth.labels == expected, "other labels");
    assert_eq!((truth.origins, truth.grid_to_lidar), (vec![[0.0; 3]], Pose::IDENTITY));
    // The archive has them in a directory of its own, which goes first.
    write("labels/samples", &npy("|u1", "(1, 4)", &[1, 2, 3, 11]));
    let truth = open().truth(0).expect("labels");
    assert_eq!((truth.labels[(200 + 2) * 16 + 3], truth.labels.iter().filter(|&&l| l != 0).count()), (11, 1));

    let file = place.root().join("labels/samples/other-LIDAR_TOP.pcd.bin.npy");
    for (bytes, expected) in [
        (rows(&[[0, 0, 0, 1], [0, 200, 0, 1]]), "row 1 is voxel (0, 200, 0), expected one of 200 x 200 x 16"),
        (rows(&[[-1, 0, 0, 1]]), "row 0 is voxel (-1, 0, 0)"),
        (rows(&[[0, 0, 16, 1]]), "row 0 is voxel (0, 0, 16)"),
        (rows(&[[0, 0, 0, 17]]), "row 0 has class 17, expected 0 to 16"),
        (rows(&[[0, 0, 0, -1]]), "row 0 has class -1"),
        (npy("<i4", "(2, 3)", &[0; 24]), "shape [2, 3], expected rows"),
        (npy("<i4", "(4,)", &[0; 16]), "shape [4], expected rows"),
        (npy("<f4", "(1, 4)", &[0; 16]), "elements of type \"<f4\", expected little-endian integers"),
        (npy("<i4", "(1, 4)", &[0; 15]), "expected shape [1, 4] of 4 bytes each"),
        (b"no array".to_vec(), "expected \\x93NUMPY"),
    ] {
        fs::write(&file, bytes).expect("written");
        let error = open().truth(0).expect_err(expected);
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error}");
    }
    fs::remove_file(&file).expect("removed");
    let error = open().truth(0).expect_err("no labels");
    assert_eq!((error.kind(), error.path()), (ErrorKind::Io, Some(&*file)), "{error}");
}

#[test]
fn labels_of_occ3d() {
    let place = Place::new();
    let file = place.root().join("labels/scene-0103/early/labels.npz");
    fs::create_dir_all(file.parent().expect("a directory")).expect("made");
    let mut semantics = vec![17u8; 640_000];
    let (mut lidar, mut camera) = (vec![0u8; 640_000], vec![0u8; 640_000]);
    (semantics[3], semantics[4], semantics[639_999]) = (0, 4, 16);
    (lidar[3], camera[639_999]) = (1, 1);
    let write = |semantics: &[u8], shape: &[usize], lidar: &[u8], name: &str| {
        let array = |name, shape, elements| Array { name, shape, elements: Elements::U8(elements) };
        let whole = &[200, 200, 16];
        let arrays =
            [array("semantics", shape, semantics), array("mask_lidar", whole, lidar), array(name, whole, &camera)];
        write_npz(&file, &arrays).expect("written");
    };
    let whole = &[200, 200, 16];
    write(&semantics, whole, &lidar, "mask_camera");
    let truth = place.open(Labels::Occ3d, &Scenes::Val).expect("a set").truth(0).expect("labels");
    let mut expected = vec![0; 640_000];
    (expected[3], expected[4], expected[639_999]) = (OTHERS, 4, 16);
    assert!(truth.labels == expected && truth.masks == [lidar.clone(), camera.clone()], "other labels");
    assert_eq!(truth.origins, [[1.0, 0.0, 2.0]], "the lidar in the vehicle");
    // (x, y, z) of the vehicle is (-y, x - 1, z - 2) of the lidar.
    let found = truth.grid_to_lidar.apply([5.0, 3.0, 1.0]);
    assert!(found.iter().zip([-3.0, 4.0, -1.0]).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");

    let said = |expected: &str| {
        let error = place.open(Labels::Occ3d, &Scenes::Val).expect("a set").truth(0).expect_err(expected);
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error}");
    };
    write(&semantics, whole, &lidar, "mask_fov");
    said("no array \"mask_camera\", expected u8 [200, 200, 16]");
    write(&semantics, &[200, 16, 200], &lidar, "mask_camera");
    said("array \"semantics\" has shape [200, 16, 200], expected u8 [200, 200, 16]");
    semantics[70] = 18;
    write(&semantics, whole, &lidar, "mask_camera");
    said("array \"semantics\": voxel 70 is 18, expected 0 to 17");
    semantics[70] = 17;
    lidar[71] = 2;
    write(&semantics, whole, &lidar, "mask_camera");
    said("array \"mask_lidar\": voxel 71 is 2, expected 0 to 1");
    let wide = [Array { name: "semantics", shape: &[1], elements: Elements::U16(&[1]) }];
    write_npz(&file, &wide).expect("written");
    said("array \"semantics\" is u16, expected u8 [200, 200, 16]");
    fs::write(&file, "PK").expect("written");
    said("not an .npz");
}

#[test]
fn labels_of_openocc() {
    let place = Place::new();
    let file = place.root().join("labels/scene-0103/early/labels.npz");
    fs::create_dir_all(file.parent().expect("a directory")).expect("made");
    let mut semantics = vec![16u8; 640_000];
    // By the names that OpenOcc gives its numbers.
    let names = [
        "car",
        "truck",
        "trailer",
        "bus",
        "construction vehicle",
        "bicycle",
        "motorcycle",
        "pedestrian",
        "traffic cone",
        "barrier",
        "driveable surface",
        "other flat",
        "sidewalk",
        "terrain",
        "manmade",
        "vegetation",
        "empty",
    ];
    (0..17).for_each(|label| semantics[usize::from(label)] = label);
    let write = |semantics: &[u8]| {
        let flow = vec![0.5f32; 8];
        let arrays = [
            Array { name: "semantics", shape: &[200, 200, 16], elements: Elements::U8(semantics) },
            Array { name: "flow", shape: &[2, 2, 2], elements: Elements::F32(&flow) },
        ];
        write_npz(&file, &arrays).expect("written");
    };
    write(&semantics);
    let set = place.open(Labels::OpenOcc, &Scenes::Val).expect("a set");
    let truth = set.truth(0).expect("labels");
    let found: Vec<&str> = truth.labels[..17].iter().map(|&label| set.classes()[usize::from(label)]).collect();
    assert_eq!(found, names);
    assert!(truth.labels[17..].iter().all(|&label| label == 0) && truth.masks.is_empty());
    assert_eq!((set.masks().len(), set.published(), set.grid().axes), (0, None, Axes::Ego));
    semantics[9] = 17;
    write(&semantics);
    let error = set.truth(0).expect_err("beyond");
    assert!(error.message().contains("array \"semantics\": voxel 9 is 17, expected 0 to 16"), "{error}");
}

#[test]
fn tables_that_do_not_fit_are_refused() {
    // Table, where in it, what is put there (null removes), and what is said.
    for (table, pointer, value, expected) in [
        ("sensor", "/1/channel", Value::Null, "missing field `channel` at line"),
        ("sensor", "/1/token", json!("radar"), "token \"radar\" is there twice"),
        ("calibrated_sensor", "/1/sensor_token", json!("x"), "row \"cs-CAM_FRONT\": sensor_token \"x\" is not in"),
        (
            "calibrated_sensor",
            "/1/rotation",
            json!([1, 0, 0]),
            "row \"cs-CAM_FRONT\": rotation of 3 numbers, expected 4",
        ),
        ("calibrated_sensor", "/1/rotation", json!([0, 0, 0, 0]), "rotation [0, 0, 0, 0], expected a quaternion"),
        ("calibrated_sensor", "/1/translation", json!([1]), "translation of 1 numbers, expected 3"),
        ("calibrated_sensor", "/1/translation", json!("x"), "invalid type: string \"x\", expected a sequence at line"),
        ("scene", "/0/name", json!("../../etc"), "row \"s2\": name \"../../etc\", expected a file name"),
        ("sample", "/0/scene_token", json!("x"), "row \"late\": scene_token \"x\" is not in scene.json"),
        ("sample", "/0/timestamp", json!("noon"), "expected u64 at line"),
        ("sample", "/0/token", json!("early"), "token \"early\" is there twice"),
        ("sample", "/0/token", json!("/a"), "token \"/a\", expected a file name"),
        (
            "sample_data",
            "/0/sample_token",
            json!("x"),
            "row \"late-CAM_FRONT\": sample_token \"x\" is not in sample.json",
        ),
        ("sample_data", "/0/calibrated_sensor_token", json!("x"), "calibrated_sensor_token \"x\" is not in"),
        ("sample_data", "/0/ego_pose_token", json!("x"), "row \"late-CAM_FRONT\": ego_pose_token \"x\" is not in ego"),
        ("sample_data", "/0/filename", json!("../x.png"), "filename \"../x.png\", expected a path below the data set"),
        ("sample_data", "/0/is_key_frame", json!(false), "sample \"late\" has no key frame of CAM_FRONT"),
        ("sample_data", "/0/calibrated_sensor_token", json!("cs-CAM_BACK"), "is of the same sensor and sample as"),
        ("sample_data", "/0/width", json!(-3), "invalid value: integer `-3`, expected usize at line"),
        ("sample_data", "", json!({"a": 1}), "invalid type: map, expected a list of rows at line 1"),
        ("ego_pose", "/0/rotation", json!([1, 0, 0, 0, 0]), "row \"ego-late-CAM_FRONT\": rotation of 5 numbers"),
        ("ego_pose", "", json!([]), "ego_pose_token \"ego-other-LIDAR_TOP\" is not in ego_pose.json"),
    ] {
        let place = Place::new();
        let path = place.file(table);
        let mut rows: Value = serde_json::from_slice(&fs::read(&path).expect("a table")).expect("JSON");
        match (value, pointer.rsplit_once('/')) {
            (Value::Null, Some((row, key))) => {
                rows.pointer_mut(row).and_then(Value::as_object_mut).and_then(|row| row.remove(key)).expect("a key");
            }
            (value, _) => *rows.pointer_mut(pointer).expect("a place") = value,
        }
        fs::write(&path, rows.to_string()).expect("written");
        let error = place.open(Labels::SurroundOcc, &Scenes::All).expect_err(expected);
        assert!(error.message().contains(expected), "{error} does not say {expected:?}");
        // A pose that is missing is missed by who refers to it.
        let named = if expected.contains("is not in ego") { place.file("sample_data") } else { path };
        assert_eq!(error.path(), Some(&*named), "{error}");
    }
}

#[test]
fn camera_matrices_have_three_rows_of_three() {
    for intrinsic in [json!([]), json!([[1, 0, 0], [0, 1, 0]]), json!([[1, 0], [0, 1], [0, 0]])] {
        let mut place = Place::new();
        place.table("calibrated_sensor")[2]["camera_intrinsic"] = intrinsic;
        place.write();
        let error = place.open(Labels::SurroundOcc, &Scenes::All).expect_err("no matrix");
        let expected = "row \"cs-CAM_FRONT_RIGHT\": camera_intrinsic of another shape, expected 3 rows of 3 numbers";
        assert_eq!(error.message(), expected);
    }
}

#[test]
fn tables_are_looked_for_and_named() {
    let place = Place::new();
    let labels = place.root().join("labels");
    let open = |root: &Path| NuScenes::open(root, Labels::Occ3d, &labels, &Scenes::All);
    let mini = place.root().join("v1.0-mini");
    fs::create_dir(place.root().join("v1.0-trainval")).expect("made");
    let error = open(place.root()).expect_err("two versions");
    assert!(error.message().contains("2 versions, expected one") && error.message().contains("v1.0-mini"), "{error}");
    // Named, its samples are beside it.
    let set = open(&mini).expect("a set");
    assert_eq!((set.len(), set.root.join("samples").is_dir()), (3, true));
    fs::remove_dir(place.root().join("v1.0-trainval")).expect("removed");
    for table in ["sensor", "calibrated_sensor", "scene", "sample", "sample_data", "ego_pose"] {
        let place = Place::new();
        fs::remove_file(place.file(table)).expect("removed");
        let error = place.open(Labels::Occ3d, &Scenes::All).expect_err("a table is missing");
        assert_eq!((error.kind(), error.path()), (ErrorKind::Io, Some(&*place.file(table))), "{error}");
    }
    let empty = tempfile::tempdir().expect("a directory");
    let error = open(empty.path()).expect_err("nothing");
    assert!(error.message().contains("no tables, expected a directory such as v1.0-trainval"), "{error}");
    let list = place.root().join("scenes.txt");
    for (text, expected) in
        [("scene-0061\nscene-9999\n", "scene \"scene-9999\" is not in"), (" \n", "no names of scenes")]
    {
        fs::write(&list, text).expect("written");
        let error = place.open(Labels::Occ3d, &Scenes::Listed(list.clone())).expect_err(expected);
        assert!(error.path() == Some(&*list) && error.message().contains(expected), "{error}");
    }
}

#[test]
fn every_truncation_is_an_error() {
    let place = Place::new();
    for table in ["sensor", "ego_pose", "sample_data"] {
        let whole = fs::read(place.file(table)).expect("a table");
        for length in (0..whole.len()).step_by(97).chain([whole.len() - 1]) {
            fs::write(place.file(table), &whole[..length]).expect("written");
            let error = place.open(Labels::Occ3d, &Scenes::All).expect_err("a truncated table");
            assert_eq!((error.kind(), error.path()), (ErrorKind::Format, Some(&*place.file(table))), "{error}");
        }
        fs::write(place.file(table), [&whole[..], b"[]"].concat()).expect("written");
        assert!(place.open(Labels::Occ3d, &Scenes::All).expect_err("two tables").message().contains("trailing"));
        fs::write(place.file(table), whole).expect("written");
    }
    assert!(place.open(Labels::Occ3d, &Scenes::All).is_ok());
}

#[test]
fn images_that_do_not_fit_are_refused() {
    let place = Place::new();
    fs::create_dir_all(place.root().join("labels")).expect("made");
    fs::write(place.root().join("labels/early-LIDAR_TOP.pcd.bin.npy"), rows(&[])).expect("written");
    let set = place.open(Labels::SurroundOcc, &Scenes::Val).expect("a set");
    assert_eq!(set.frame(0).expect("a frame").scene.cameras(), 6);
    let image = place.root().join("samples/CAM_BACK/early-CAM_BACK.png");
    write_rgb_png(&image, 2, 3, &[0; 18]).expect("written");
    let error = set.frame(0).expect_err("another size");
    assert_eq!((error.kind(), error.path()), (ErrorKind::Mismatch, Some(&*image)), "{error}");
    assert!(error.message().contains("image of camera CAM_BACK: 3x2, the calibration expects 2x3"), "{error}");
    fs::remove_file(&image).expect("removed");
    assert_eq!(set.frame(0).expect_err("no image").path(), Some(&*image));
}
