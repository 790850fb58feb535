//! Files that are damaged, hostile, or do not belong together.

use super::*;

#[test]
fn damaged_models_and_rigs() {
    let place = Place::ready();
    for name in ["model", "rig"] {
        let bytes = fs::read(place.path(name)).unwrap();
        let damaged = cuts(bytes.len()).into_iter().map(|n| bytes[..n].to_vec());
        let damaged = damaged.chain(flips(bytes.len()).into_iter().map(|bit| flip(&bytes, bit)));
        let bad = place.text("bad");
        let run = if name == "model" { place.run("bad", "rig", "scene") } else { place.run("model", "bad", "scene") };
        for (i, damaged) in damaged.enumerate() {
            fs::write(&bad, damaged).unwrap();
            refused(&bad, &["inspect", &bad]);
            if i % 4 == 0 {
                refused(&bad, &words(&run));
            }
        }
    }
    // Sound files of the other kind.
    let [model, rig] = ["model", "rig"].map(|f| place.text(f));
    refused(&rig, &words(&place.run("rig", "rig", "scene")));
    refused(&model, &words(&place.run("model", "model", "scene")));
    let weights = place.text("weights.safetensors");
    refused(&weights, &words(&place.run("weights.safetensors", "rig", "scene")));
    refused(&weights, &words(&place.run("model", "weights.safetensors", "scene")));
    refused(&weights, &["inspect", &weights]);
    assert!(!place.path("out.npz").exists());
}

#[test]
fn rigs_that_do_not_belong_here() {
    let place = Place::ready();
    let other = Network { grids: [[16, 12, 4], [8, 6, 2], [4, 3, 1]], ..network() };
    let bad = place.text("bad");
    small::rig(&other, 0.3).save(Path::new(&bad), &other).unwrap();
    let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
    assert!(line.contains("grids"), "{line}");
    let three = Network { cameras: 3, ..network() };
    small::rig(&three, 0.3).save(Path::new(&bad), &three).unwrap();
    let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
    assert!(line.contains("3 cameras"), "{line}");

    // Plain rigs, which other programs write: no checksum guards their numbers.
    let bytes = fs::read(place.path("rig")).unwrap();
    let rig = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let plain = |name: &str, edit: &dyn Fn(&mut Vec<u32>)| {
        let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
        for (key, tensor) in rig.tensors() {
            let mut words: Vec<u32> = tensor.data().as_chunks().0.iter().map(|&b| u32::from_le_bytes(b)).collect();
            if key == name {
                edit(&mut words);
            }
            let from = data.len();
            data.extend(words.iter().flat_map(|w| w.to_le_bytes()));
            header.insert(key, json!({"dtype": "U32", "shape": [words.len()], "data_offsets": [from, data.len()]}));
        }
        let header = Value::Object(header).to_string();
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
    };
    fs::write(&bad, plain("", &|_| ())).unwrap();
    let output = voxcast(&words(&place.run("model", "bad", "scene")));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    type Edit<'a> = &'a dyn Fn(&mut Vec<u32>);
    let cases: [(&str, Edit<'_>, &str); 7] = [
        ("level1.volume.col", &|w| *w.last_mut().unwrap() = u32::MAX, "4294967295"),
        ("level3.bev.col", &|w| *w.last_mut().unwrap() = 4, "less than 4"),
        ("level1.bev.ptr", &|w| w[5] = u32::MAX, "row 4"),
        ("level2.volume.ptr", &|w| w[0] = 1, "row 0 starts at entry 1"),
        ("level2.volume.ptr", &|w| w[3] = 0, "level2.volume.ptr: row"),
        ("level2.bev.ptr", &|w| w.truncate(24), "level2.bev.ptr has 23 rows, expected 24"),
        ("level3.volume.ptr", &|w| *w.last_mut().unwrap() += 1, "the length of"),
    ];
    for (name, edit, expected) in cases {
        fs::write(&bad, plain(name, edit)).unwrap();
        let line = refused(&bad, &words(&place.run("model", "bad", "scene")));
        assert!(line.contains(name) && line.contains(expected), "{name}: {line}");
    }
    let bytes = plain("", &|_| ());
    for bit in flips(bytes.len()) {
        fs::write(&bad, flip(&bytes, bit)).unwrap();
        refused_or_done(&bad, &words(&place.run("model", "bad", "scene")));
    }
}

#[test]
fn damaged_checkpoints_leave_the_old_model() {
    let place = Place::new();
    let out = place.path("out");
    for name in ["weights.pth", "weights.safetensors"] {
        let bytes = fs::read(place.path(name)).unwrap();
        let bad = place.text("bad");
        for n in cuts(bytes.len()) {
            fs::write(&out, "the old model").unwrap();
            fs::write(&bad, &bytes[..n]).unwrap();
            refused(&bad, &words(&place.import("bad", "network.json")));
            assert_eq!(fs::read(&out).unwrap(), b"the old model", "{name} cut to {n}");
        }
        for bit in flips(bytes.len()) {
            fs::write(&out, "the old model").unwrap();
            fs::write(&bad, flip(&bytes, bit)).unwrap();
            refused_or_done(&bad, &words(&place.import("bad", "network.json")));
            let model = fs::read(&out).unwrap();
            assert!(model == b"the old model" || voxcast::Model::from_bytes(model).is_ok(), "{name}, bit {bit}");
        }
        let left: Vec<_> = fs::read_dir(place.path("")).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(!left.iter().any(|f| f.to_string_lossy().ends_with(".tmp")), "{left:?}");
    }
}

#[test]
fn weights_that_cannot_be_used_are_named() {
    let place = Place::new();
    let sound = place.tensors();
    type Edit<'a> = &'a dyn Fn(&mut Tensors);
    let edits: [(&str, Edit<'_>, &str); 6] = [
        ("img_backbone.conv1.weight", &|t| t.get_mut("img_backbone.conv1.weight").unwrap().1[7] = f32::NAN, "NaN"),
        ("img_neck.fpn_convs.1.conv.bias", &|t| drop(t.remove("img_neck.fpn_convs.1.conv.bias")), "missing"),
        (
            "occ_head.mlp_occ_lvl0.4.bias",
            &|t| t.get_mut("occ_head.mlp_occ_lvl0.4.bias").unwrap().1[2] = f32::INFINITY,
            "inf",
        ),
        (
            "img_backbone.bn1.running_var",
            &|t| t.get_mut("img_backbone.bn1.running_var").unwrap().1[1] = -1.0,
            "variance",
        ),
        (
            "view_transformer.up_sample2.0.weight",
            &|t| t.get_mut("view_transformer.up_sample2.0.weight").unwrap().0.swap(0, 1),
            "expects",
        ),
        (
            "img_backbone.layer1.0.conv1",
            &|t| t.get_mut("img_backbone.layer1.0.conv1.weight").unwrap().1.fill(f32::MAX),
            "finite",
        ),
    ];
    for (name, edit, expected) in edits {
        let mut tensors = sound.clone();
        edit(&mut tensors);
        for (file, bytes) in [("bad.pth", pth_bytes(&tensors)), ("bad.safetensors", plain_bytes(&tensors))] {
            fs::write(place.path(file), bytes).unwrap();
            fs::write(place.path("out"), "the old model").unwrap();
            let line = refused(&place.text(file), &words(&place.import(file, "network.json")));
            assert!(line.contains(name) && line.contains(expected), "{line}");
            assert_eq!(fs::read(place.path("out")).unwrap(), b"the old model");
        }
    }
    // Half precision cannot hold it.
    let mut tensors = sound.clone();
    tensors.get_mut("occ_head.mlp_occ_lvl0.4.weight").unwrap().1[0] = 1e6;
    fs::write(place.path("bad.pth"), pth_bytes(&tensors)).unwrap();
    done(&words(&place.import("bad.pth", "network.json")));
    let import = place.import("bad.pth", "network.json");
    let import = [&words(&import)[..], &["--precision", "f16"]].concat();
    let line = refused("bad.pth", &import);
    assert!(line.contains("mlp_occ_lvl0") && line.contains("65504"), "{line}");
}

#[test]
fn a_pickle_that_would_call_something_is_refused() {
    let place = Place::new();
    let marker = place.text("marker");
    for (module, name) in [("os", "system"), ("builtins", "eval"), ("posix", "system"), ("subprocess", "check_output")]
    {
        let evil = pth::Pickle::new(2).global(module, name).text(&format!("touch {marker}")).raw(b"\x85R").stop();
        fs::write(place.path("evil.pth"), pth::pth_of(evil, &["0"])).unwrap();
        let line = refused("evil.pth", &words(&place.import("evil.pth", "network.json")));
        assert!(line.contains(&format!("{module}.{name}")) || line.contains(&format!("{module} {name}")), "{line}");
        assert!(!Path::new(&marker).exists());
    }
}

#[test]
fn damaged_scenes() {
    let place = Place::ready();
    let run = place.run("model", "rig", "scene");
    done(&words(&run));
    let entries = fs::read_dir(place.path("scene")).unwrap().map(|e| e.unwrap().path());
    let image = entries.filter(|p| p.extension().is_some_and(|e| e == "png")).min().unwrap();
    let sound = fs::read(&image).unwrap();
    for n in cuts(sound.len()) {
        fs::write(&image, &sound[..n]).unwrap();
        refused_or_done(image.to_str().unwrap(), &words(&run));
        if n < sound.len() / 2 {
            refused(image.to_str().unwrap(), &words(&run));
        }
    }
    for bit in flips(sound.len()) {
        fs::write(&image, flip(&sound, bit)).unwrap();
        refused_or_done(image.to_str().unwrap(), &words(&run));
    }
    fs::write(&image, &sound).unwrap();

    let calibration = place.path("scene/calibration.json");
    let sound = fs::read_to_string(&calibration).unwrap();
    let named = calibration.to_str().unwrap();
    for n in [0, 1, 10, sound.len() / 2, sound.len() - 3] {
        fs::write(&calibration, &sound[..n]).unwrap();
        refused(named, &words(&run));
        refused(named, &["rig", named, "--model", &place.text("model"), "-o", &place.text("out")]);
    }
    for (from, to) in [
        ("\"lidar2img\"", "\"lidar\""),
        ("\"width\":64", "\"width\":65"),
        ("\"width\":64", "\"width\":-64"),
        ("\"width\":64", "\"width\":1e99"),
        ("\"file\":\"", "\"file\":\"../"),
        ("\"cameras\"", "\"kameras\""),
        ("[", "[null,"),
    ] {
        assert!(sound.contains(from), "{from} in {sound}");
        fs::write(&calibration, sound.replacen(from, to, 1)).unwrap();
        refused(&place.text("scene"), &words(&run));
    }
    // A sound scene of the wrong size.
    let other = Network { image: [64, 64], ..network() };
    small::scene(&other, 1).save(&place.path("other")).unwrap();
    let line = refused(&place.text("other"), &words(&place.run("model", "rig", "other")));
    assert!(line.contains("64x64") && line.contains("32x64"), "{line}");
    // And of another number of cameras.
    let other = Network { cameras: 1, ..network() };
    small::scene(&other, 1).save(&place.path("one")).unwrap();
    let line = refused(&place.text("rig"), &words(&place.run("model", "rig", "one")));
    assert!(line.contains("2 cameras, expected 1"), "{line}");
}

#[test]
fn absurd_networks() {
    let place = Place::new();
    let sound = serde_json::to_value(network()).unwrap();
    let cases = [
        ("depths", json!([65536, 1, 1, 1]), "depths"),
        ("depths", json!([0, 1, 1, 1]), "depths"),
        ("depths", json!([1, 1, 1]), "length 3"),
        ("width", json!(0), "width"),
        ("width", json!(-1), "-1"),
        ("width", json!(1e300), "1e"),
        ("width", json!(u64::MAX), "width"),
        ("fpn", json!("many"), "many"),
        ("channels", json!([1, 2, 3, 4]), "channels"),
        ("key_dims", json!([1, 1, 1]), "key_dims"),
        ("image", json!([31, 64]), "image"),
        ("image", json!([65536, 65536]), "image"),
        ("grids", json!([[32768, 32768, 4096], [16384, 16384, 2048], [8192, 8192, 1024]]), "grids"),
        ("grids", json!([[8, 12, 4], [4, 6, 2], [2, 3, 2]]), "grids"),
        ("grids", json!([[0, 0, 0], [0, 0, 0], [0, 0, 0]]), "grids"),
        ("bounds", json!([[1, 0], [0, 1], [0, 1]]), "bounds"),
        ("bounds", json!([[0, 1e60], [0, 1], [0, 1]]), ""),
        ("classes", json!(1), "classes"),
        ("classes", json!(300), "classes"),
        ("samples", json!([1, 2, 0]), "samples"),
        ("strides", json!([4, 8, 16]), "strides"),
        ("cameras", json!(0), "cameras"),
        ("sampling", json!("random"), "random"),
        ("block", json!("vgg"), "vgg"),
        ("nonsense", json!(1), "nonsense"),
    ];
    for (key, value, expected) in cases {
        let mut network = sound.clone();
        network[key] = value;
        fs::write(place.path("bad.json"), network.to_string()).unwrap();
        let line = refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
        assert!(line.contains(expected), "{key}: {line}");
    }
    let whole = sound.to_string();
    for n in [0, 1, whole.len() / 2, whole.len() - 1] {
        fs::write(place.path("bad.json"), &whole[..n]).unwrap();
        refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
    }
    fs::write(place.path("bad.json"), "[".repeat(100_000)).unwrap();
    refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
    fs::write(place.path("bad.json"), b"\xff\xfe{}").unwrap();
    refused("bad.json", &words(&place.import("weights.pth", "bad.json")));
}

/// Sizes that the weights do not show and that no machine of this memory can hold.
#[test]
fn sizes_beyond_memory_are_refused_before_they_are_taken() {
    let place = Place::new();
    let sound = serde_json::to_value(network()).unwrap();
    let cases = [
        // More rows than a matrix may have.
        ("grids", json!([[8, 49152, 1024], [4, 24576, 512], [2, 12288, 256]]), "voxels"),
        ("samples", json!([65536, 65536, 65536]), "sample points"),
        ("samples", json!([1, 1, 60000]), "sample points"),
    ];
    for (key, value, expected) in cases {
        let mut network = sound.clone();
        network[key] = value;
        fs::write(place.path("large.json"), network.to_string()).unwrap();
        // Import computes the self-test, which such a model cannot have.
        let import = place.import("weights.pth", "large.json");
        let line = refused(&place.text("out"), &words(&import));
        assert!(line.contains(expected) && line.contains("--no-self-test"), "{line}");
        done(&[&words(&import)[..], &["--no-self-test"]].concat());
        let [model, scene, out] = ["out", "scene", "out.npz"].map(|f| place.text(f));
        let output = bounded(&["inspect", &model, "--operations"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let line = refused(&model, &["rig", &scene, "--model", &model, "-o", &out]);
        assert!(line.contains(expected), "{line}");
        let line = refused(&model, &["run", "--model", &model, &scene, "-o", &out]);
        assert!(line.contains(expected), "{line}");
    }
}
