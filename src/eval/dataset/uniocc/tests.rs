use super::*;
use crate::file::npz::{Array, Elements, write_npz};
use crate::image::png::write_rgb_png;
use std::fs;
use std::io::Write;
use zip::write::SimpleFileOptions;
use zip::{ZipArchive, ZipWriter};

const VOXELS: usize = 640_000;

/// The instructions that NumPy's pickler writes for values, of protocol 4 without frames and memo.
mod pickled {
    pub(super) fn text(text: &str) -> Vec<u8> {
        [&[0x8c, text.len() as u8], text.as_bytes()].concat()
    }

    pub(super) fn int(n: u8) -> Vec<u8> {
        vec![b'K', n]
    }

    pub(super) fn float(n: f64) -> Vec<u8> {
        [&b"G"[..], &n.to_be_bytes()].concat()
    }

    pub(super) fn list(values: &[Vec<u8>]) -> Vec<u8> {
        [&b"]("[..], &values.concat(), b"e"].concat()
    }

    pub(super) fn tuple(values: &[Vec<u8>]) -> Vec<u8> {
        [&b"("[..], &values.concat(), b"t"].concat()
    }

    pub(super) fn dict(pairs: &[(&str, Vec<u8>)]) -> Vec<u8> {
        let pairs = pairs.iter().map(|(key, value)| [text(key), value.clone()].concat());
        [&b"}("[..], &pairs.collect::<Vec<_>>().concat(), b"u"].concat()
    }

    pub(super) fn global(module: &str, name: &str) -> Vec<u8> {
        [text(module), text(name), vec![0x93]].concat()
    }

    fn dtype(code: &str, order: &str) -> Vec<u8> {
        let args = tuple(&[text(code), vec![0x89], vec![0x88]]);
        let state = tuple(&[int(3), text(order), b"N".to_vec(), b"N".to_vec(), b"N".to_vec(), int(0), int(0), int(0)]);
        [global("numpy", "dtype"), args, b"R".to_vec(), state, b"b".to_vec()].concat()
    }

    /// An array of `shape`, whose `data` is bytes or a list.
    pub(super) fn array(core: &str, shape: &[u8], code: &str, order: &str, fortran: bool, data: Vec<u8>) -> Vec<u8> {
        let args = tuple(&[global("numpy", "ndarray"), tuple(&[int(0)]), b"C\x01b".to_vec()]);
        let shape = tuple(&shape.iter().map(|&n| int(n)).collect::<Vec<_>>());
        let state = tuple(&[int(1), shape, dtype(code, order), vec![if fortran { 0x88 } else { 0x89 }], data]);
        let reconstruct = global(&format!("numpy.{core}.multiarray"), "_reconstruct");
        [reconstruct, args, b"R".to_vec(), state, b"b".to_vec()].concat()
    }

    pub(super) fn f8(core: &str, rows: u8, numbers: &[f64]) -> Vec<u8> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        array(core, &[rows, rows], "f8", "<", false, [&[b'C', bytes.len() as u8][..], &bytes].concat())
    }

    pub(super) fn whole(value: &[u8]) -> Vec<u8> {
        [&[0x80, 4], value, b"."].concat()
    }
}

use pickled::*;

const K: [f64; 9] = [100.0, 0.0, 50.0, 0.0, 200.0, 60.0, 0.0, 0.0, 1.0];

/// A camera that looks ahead: its x to the right (-y), its y down (-z), its z ahead (x), `x` metres ahead and 1.5 m high.
fn ahead(x: f64) -> [f64; 16] {
    [0.0, 0.0, 1.0, x, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.5, 0.0, 0.0, 0.0, 1.0]
}

fn camera(name: &str, file: &str, intrinsics: Vec<u8>, extrinsics: Vec<u8>) -> Vec<u8> {
    dict(&[("name", text(name)), ("filename", text(file)), ("intrinsics", intrinsics), ("extrinsics", extrinsics)])
}

fn objects(core: &str, values: &[Vec<u8>]) -> Vec<u8> {
    whole(&array(core, &[values.len() as u8], "O8", "|", false, list(values)))
}

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        fs::create_dir_all(place.path("mini/scene-0061")).expect("made");
        let scene = |name: &str, paths: &[&str]| {
            let paths = list(&paths.iter().map(|path| text(path)).collect::<Vec<_>>());
            dict(&[("scene_name", text(name)), ("start", float(0.5)), ("occ_in_scene_paths", paths)])
        };
        let scenes =
            list(&[scene("scene-0061", &["scene-0061/0.npz", "scene-0061/1.npz"]), scene("b", &["scene-b/7/0.npz"])]);
        fs::write(place.path("mini/scene_infos.pkl"), whole(&scenes)).expect("written");
        for camera in 0..2u8 {
            let directory = place.path(&format!("images/{camera}"));
            fs::create_dir_all(&directory).expect("made");
            write_rgb_png(&directory.join("a.png"), 3, 2, &[camera; 18]).expect("written");
        }
        place
    }

    fn path(&self, file: &str) -> PathBuf {
        self.0.path().join(file)
    }

    /// Writes the first frame: the labels at `some` places, all else free, those in the mask, and its cameras.
    fn frame(&self, some: &[(usize, u8)], inside: &[usize], cameras: &[u8]) {
        let mut labels = vec![10u8; VOXELS];
        some.iter().for_each(|&(at, label)| labels[at] = label);
        let mut mask = vec![0u8; VOXELS];
        inside.iter().for_each(|&at| mask[at] = 1);
        let array = |name, values| Array { name, shape: &[200, 200, 16], elements: Elements::U8(values) };
        let file = self.path("mini/scene-0061/0.npz");
        write_npz(&file, &[array("occ_label", &labels), array("occ_mask_camera", &mask)]).expect("written");
        let bytes = fs::read(&file).expect("written");
        let mut zip = ZipWriter::new_append(std::io::Cursor::new(bytes)).expect("an archive");
        zip.start_file("cameras.npy", SimpleFileOptions::default()).expect("an entry");
        let mut header = b"\x93NUMPY\x01\x00\x76\x00{'descr': '|O', 'fortran_order': False, 'shape': (2,), }".to_vec();
        header.resize(127, b' ');
        header.push(b'\n');
        zip.write_all(&[&header, cameras].concat()).expect("written");
        fs::write(&file, zip.finish().expect("an archive").into_inner()).expect("written");
    }

    fn open(&self) -> Result<UniOcc> {
        UniOcc::open(&self.path("mini"), &self.path("images"))
    }
}

/// Two cameras, not in the order of the ring; the second one's matrices are rows of numbers.
fn two(core: &str) -> Vec<Vec<u8>> {
    let rows = |numbers: &[f64], columns: usize| {
        list(
            &numbers
                .chunks(columns)
                .map(|row| list(&row.iter().map(|&n| float(n)).collect::<Vec<_>>()))
                .collect::<Vec<_>>(),
        )
    };
    let right = camera("CAM_FRONT_RIGHT", "1/a.png", f8(core, 3, &K), f8(core, 4, &ahead(3.0)));
    let front = camera("CAM_FRONT", "0/a.png", rows(&K, 3), rows(&ahead(2.0), 4));
    vec![right, front]
}

#[test]
fn frames_labels_and_cameras() {
    for core in ["core", "_core"] {
        let place = Place::new();
        place.frame(&[(0, 0), (3, 1), (VOXELS - 1, 9)], &[3, 4], &objects(core, &two(core)));
        let set = place.open().expect("a set");
        let ids: Vec<&str> = (0..set.len()).map(|index| set.id(index)).collect();
        assert_eq!(ids, ["scene-0061/0", "scene-0061/1", "scene-b/7/0"]);
        let Frame { scene, truth, notes } = set.frame(0).expect("a frame");
        assert!(notes.is_empty(), "{notes:?}");
        let mut expected = vec![0u8; VOXELS];
        (expected[0], expected[3], expected[VOXELS - 1]) = (10, 1, 9);
        assert!(truth.labels == expected && set.classes()[10] == "others");
        assert_eq!((0..10).filter(|&at| truth.masks[0][at] == 1).collect::<Vec<_>>(), [3, 4]);
        assert_eq!(truth.origins, [[2.5, 0.0, 1.5]]);
        // nuScenes' names come in the order of its ring.
        assert_eq!(scene.names, ["CAM_FRONT", "CAM_FRONT_RIGHT"]);
        for (camera, x) in [2.0f32, 3.0].into_iter().enumerate() {
            assert_eq!(scene.images[camera].bgr[0], camera as u8);
            // (x, y, z) of the vehicle is at (-y, 1.5 - z, x - its place) of the camera.
            let expected = [
                [50.0, -100.0, 0.0, -50.0 * x],
                [60.0, 0.0, -200.0, 300.0 - 60.0 * x],
                [1.0, 0.0, 0.0, -x],
                [0.0, 0.0, 0.0, 1.0],
            ];
            assert_eq!(scene.lidar2img[camera], expected.as_flattened(), "camera {camera}");
        }
        assert_eq!(set.scene(0).expect("a scene"), (scene, notes));
        assert_eq!(set.truth(0).expect("labels"), truth);
    }
}

#[test]
fn scenes_of_several_vehicles_and_integers_of_any_width() {
    let place = Place::new();
    let vehicle = |path: &str| dict(&[("occ_in_scene_paths", list(&[text(path)])), ("ego_name", text("e"))]);
    let scene = dict(&[("egos", list(&[vehicle("s/1061/0.npz"), vehicle("s/1062/0.npz")]))]);
    fs::write(place.path("mini/scene_infos.pkl"), whole(&list(&[scene]))).expect("written");
    let set = place.open().expect("a set");
    assert_eq!([set.id(0), set.id(1)], ["s/1061/0", "s/1062/0"]);
    let raw = |descr: &str, shape: &[usize], bytes: &[u8]| {
        RawArray { name: "a".into(), descr: descr.into(), fortran: false, shape: shape.into(), bytes: bytes.into() }
            .integers()
    };
    assert_eq!(raw("<i8", &[1], &[10, 0, 0, 0, 0, 0, 0, 0]).expect("integers"), [10]);
    assert_eq!(raw("|b1", &[2], &[1, 0]).expect("integers"), [1, 0]);
    assert!(raw("<i8", &[2], &[0; 8]).expect_err("short").message().contains("8 bytes, expected shape [2] of 8 bytes"));
    assert!(raw("<f4", &[2], &[0; 8]).expect_err("floats").message().contains("expected little-endian integers"));
}

#[test]
fn what_a_list_of_scenes_must_not_be() {
    let place = Place::new();
    let file = place.path("mini/scene_infos.pkl");
    let of = |paths: &[Vec<u8>]| whole(&list(&[dict(&[("occ_in_scene_paths", list(paths))])]));
    let call = [global("os", "system"), tuple(&[text("true")]), b"R".to_vec()].concat();
    for (bytes, expected) in [
        (whole(&call), "calls \"os.system\"; expected plain values and NumPy's arrays alone"),
        (whole(&[text("x"), b"Q".to_vec()].concat()), "a persistent id"),
        (whole(&text("x")), "the list of scenes has a string, expected a list of dicts"),
        (whole(&list(&[int(1)])), "has an int, expected a dict for each scene"),
        (whole(&list(&[dict(&[("egos", list(&[int(1)]))])])), "has an int, expected a dict for each vehicle"),
        (whole(&list(&[dict(&[("scene_name", text("x"))])])), "a scene without a list \"occ_in_scene_paths\""),
        (whole(&list(&[])), "no frames"),
        (of(&[int(3)]), "the file of a frame is an int, expected a string"),
        (of(&[text("../a.npz")]), "file \"../a.npz\", expected a named .npz below the set"),
        (of(&[text("/a.npz")]), "file \"/a.npz\", expected a named .npz below the set"),
        (of(&[text(".npz")]), "file \".npz\", expected a named .npz below the set"),
        (of(&[text("..npz")]), "file \"..npz\", expected a named .npz below the set"),
        (of(&[text("...npz")]), "file \"...npz\", expected a named .npz below the set"),
        (of(&[text("a/.npz")]), "file \"a/.npz\", expected a named .npz below the set"),
        (of(&[text("a/...npz")]), "file \"a/...npz\", expected a named .npz below the set"),
        (of(&[text("a.txt")]), "file \"a.txt\", expected a named .npz below the set"),
        (of(&[text("a.npz"), text("a.npz")]), "frame \"a\" is there twice"),
        (of(&[text("a/b.npz"), text("a//b.npz")]), "frame \"a//b\" is there twice"),
        (b"\x80\x04".to_vec(), "ends in the middle of an instruction"),
    ] {
        fs::write(&file, bytes).expect("written");
        let error = place.open().expect_err(expected);
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error} does not say {expected:?}");
    }
}

#[test]
fn what_cameras_must_not_be() {
    let place = Place::new();
    let file = place.path("mini/scene-0061/0.npz");
    let one = |intrinsics: Vec<u8>, extrinsics: Vec<u8>| vec![camera("C", "0/a.png", intrinsics, extrinsics)];
    let (k, pose) = (|| f8("core", 3, &K), || f8("core", 4, &ahead(2.0)));
    let mut scaled = ahead(2.0);
    scaled[2] = 1.1;
    // CARLA's axes: x ahead, y to the right, z up.
    let carla = [1.0, 0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.5, 0.0, 0.0, 0.0, 1.0];
    let bytes = |n: u8| [&[b'C', n][..], &vec![0; usize::from(n)]].concat();
    let odd = |code: &str, order: &str, n: u8| array("core", &[3, 3], code, order, false, bytes(n));
    for (cameras, expected) in [
        (vec![], "is an array, expected a list of cameras"),
        (vec![int(1)], "a camera is an int, expected a dict"),
        (vec![dict(&[("filename", text("a"))])], "a camera without \"name\""),
        (vec![dict(&[("cam_name", text("C"))])], "camera \"C\": no \"filename\""),
        (vec![camera("C", "", k(), pose())], "camera \"C\": \"filename\" is \"\", expected a path below"),
        (vec![camera("C", "../a.png", k(), pose())], "\"filename\" is \"../a.png\", expected a path below"),
        (
            one(f8("core", 4, &ahead(1.0)), pose()),
            "\"intrinsics\" is an array of shape [4, 4], expected [3, 3] numbers",
        ),
        (one(text("x"), pose()), "\"intrinsics\" is a string, expected [3, 3] numbers"),
        (one(list(&[list(&[]), list(&[]), list(&[])]), pose()), "3 rows that are not of 3 numbers"),
        (one(odd("f8", ">", 72), pose()), "\"intrinsics\" is 72 bytes of big-endian elements of type \"f8\""),
        (one(odd("f8", "<", 71), pose()), "\"intrinsics\" is 71 bytes of elements of type \"f8\""),
        (one(odd("c16", "<", 72), pose()), "\"intrinsics\" is 72 bytes of elements of type \"c16\""),
        (one(k(), f8("core", 4, &scaled)), "camera \"C\": \"extrinsics\": scaled: row 0"),
        (one(k(), f8("core", 4, &carla)), "\"extrinsics\" have its third axis upright"),
    ] {
        place.frame(&[], &[], &objects("core", &cameras));
        let error = place.open().expect("a set").scene(0).expect_err(expected);
        assert!(error.path() == Some(&file) && error.message().contains(expected), "{error} does not say {expected:?}");
    }
    let call = [global("builtins", "eval"), tuple(&[text("1")]), b"R".to_vec()].concat();
    place.frame(&[], &[], &whole(&call));
    let error = place.open().expect("a set").scene(0).expect_err("a call");
    let expected =
        "array \"cameras\", byte 24: calls \"builtins.eval\"; expected plain values and NumPy's arrays alone";
    assert!(error.message().contains(expected), "{error}");
}

#[test]
fn labels_that_do_not_fit_are_named() {
    let place = Place::new();
    let cameras = objects("core", &two("core"));
    place.frame(&[(70, 11)], &[], &cameras);
    let error = place.open().expect("a set").truth(0).expect_err("a label");
    assert!(error.message().contains("array \"occ_label\": voxel 70 is 11, expected 0 to 10"), "{error}");
    place.frame(&[], &[], &cameras);
    let file = place.path("mini/scene-0061/0.npz");
    let archive = ZipArchive::new(fs::File::open(&file).expect("a file")).expect("an archive");
    assert_eq!(archive.len(), 3);
    let small = [Array { name: "occ_label", shape: &[2], elements: Elements::U8(&[1, 2]) }];
    write_npz(&file, &small).expect("written");
    let error = place.open().expect("a set").truth(0).expect_err("no cameras");
    assert!(error.path() == Some(&file) && error.message().contains("no array \"cameras\""), "{error}");
    assert_eq!(place.open().expect("a set").frame(1).expect_err("no file").kind(), ErrorKind::Io);
}

#[test]
fn cameras_below_the_ground_are_noted() {
    let place = Place::new();
    let mut low = ahead(1.0);
    low[11] = -0.3;
    place.frame(&[], &[], &objects("core", &[camera("C", "0/a.png", f8("core", 3, &K), f8("core", 4, &low))]));
    let (_, notes) = place.open().expect("a set").scene(0).expect("a scene");
    assert!(notes.len() == 1 && notes[0].message().contains("below the ground of the voxels"), "{notes:?}");
}
