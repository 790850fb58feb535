//! Files that are well formed and not what they should be: refused, or said.

use super::*;
use voxcast::container::Container;

/// The calibration of the place's scene, changed by `change`, as a scene of its own.
fn changed(place: &Place, name: &str, change: impl Fn(&mut Value)) -> String {
    fs::create_dir_all(place.path(name)).unwrap();
    for entry in fs::read_dir(place.path("scene")).unwrap() {
        let file = entry.unwrap();
        fs::copy(file.path(), place.path(name).join(file.file_name())).unwrap();
    }
    let path = place.path(name).join("calibration.json");
    let mut calibration = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    change(&mut calibration);
    fs::write(&path, calibration.to_string()).unwrap();
    place.text(name)
}

/// Standard output as JSON, and the notes on standard error, which must be the same as in it.
fn noted(arguments: &[&str]) -> (Value, Vec<String>) {
    let output = voxcast(arguments);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
    let value: Value = serde_json::from_str(&text(&output.stdout)).unwrap();
    let notes: Vec<String> =
        value["notes"].as_array().unwrap().iter().map(|n| n.as_str().unwrap().to_owned()).collect();
    let lines: Vec<&str> = said.lines().map(|line| line.strip_prefix("voxcast: note: ").unwrap()).collect();
    assert_eq!(lines, notes);
    (value, notes)
}

#[test]
fn a_rig_is_of_its_calibration() {
    let place = Place::ready();
    let [model, rig, scene, out] = ["model", "rig", "scene", "out.npz"].map(|f| place.text(f));
    let run = |scene: &str, rig: &str, more: &[&str]| {
        let arguments = ["run", "--model", &model, "--rig", rig, scene, "-o", &out, "--json"];
        [&arguments[..], more].concat().into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let (own, notes) = noted(&words(&run(&scene, &rig, &[])));
    assert!(notes.is_empty() && own["seen"].as_f64().unwrap() > 0.1, "{own}");
    let turned = changed(&place, "turned", |c| c["cameras"].as_array_mut().unwrap().reverse());
    let moved = changed(&place, "moved", |c| c["cameras"][1]["lidar2img"][0][3] = json!(0.25));
    for (other, expected) in [(&turned, "another order"), (&moved, "camera 1 of")] {
        let line = refused(&rig, &words(&run(other, &rig, &[])));
        assert!(line.contains("a rig of another calibration") && line.contains(expected), "{line}");
        assert!(line.contains("--any-rig"), "{line}");
        let (_, notes) = noted(&words(&run(other, &rig, &["--any-rig"])));
        assert!(
            notes.len() == 1 && notes[0].contains(expected) && notes[0].contains("because of --any-rig"),
            "{notes:?}"
        );
        for command in ["profile", "compare"] {
            let more: &[&str] = if command == "profile" { &["--repeat", "1"] } else { &[] };
            let arguments = [&[command, "--model", &model, "--rig", &rig, other][..], more].concat();
            assert!(refused(&rig, &arguments).contains("another calibration"));
        }
    }
    // A rig of another program says nothing of itself.
    let plain = place.text("plain");
    let container = Container::open(Path::new(&rig)).unwrap();
    let tensors: Vec<_> = container
        .names()
        .into_iter()
        .map(|name| {
            let (dtype, shape, bytes) = container.tensor(&name).unwrap();
            (name.clone(), safetensors::tensor::TensorView::new(dtype, shape.to_vec(), bytes).unwrap())
        })
        .collect();
    fs::write(&plain, safetensors::serialize(tensors, None).unwrap()).unwrap();
    let (result, notes) = noted(&words(&run(&scene, &plain, &[])));
    assert!(notes.len() == 1 && notes[0].contains("does not say of which calibration"), "{notes:?}");
    assert_eq!(result["digest"], own["digest"]);
}

/// Matrices that are sound and see next to nothing, or of which one camera does.
#[test]
fn cameras_that_see_nothing_are_told() {
    let place = Place::ready();
    let [model, scene, out, rig] = ["model", "scene", "out.npz", "other rig"].map(|f| place.text(f));
    let seen = |scene: &str, said: usize, about: &str| {
        for arguments in [
            ["run", "--model", &model, scene, "-o", &out, "--json"],
            ["rig", "--model", &model, scene, "-o", &rig, "--json"],
        ] {
            let (value, notes) = noted(&arguments);
            let seen = value["seen"].as_f64().unwrap();
            assert_eq!(notes.len(), said, "{seen}: {notes:?}");
            assert!(notes.iter().any(|note| note.contains(about)) || said == 0, "{notes:?}");
            assert_eq!(about == "cameras see", seen < 0.1, "{seen}");
        }
    };
    seen(&scene, 0, "");
    let rows = |c: &mut Value, change: &dyn Fn(&mut [f64; 12])| {
        for camera in c["cameras"].as_array_mut().unwrap() {
            let m = &mut camera["lidar2img"];
            let mut numbers: [f64; 12] = std::array::from_fn(|i| m[i / 4][i % 4].as_f64().unwrap());
            change(&mut numbers);
            (0..12).for_each(|i| m[i / 4][i % 4] = json!(numbers[i]));
        }
    };
    type Change = fn(&mut [f64; 12]);
    let cases: [(&str, Change); 4] = [
        ("millimetres", |m| [3, 7, 11].into_iter().for_each(|i| m[i] *= 1000.0)),
        ("of an image ten times the size", |m| (0..8).for_each(|i| m[i] *= 10.0)),
        ("an origin far away", |m| [3, 7, 11].into_iter().for_each(|i| m[i] -= 500.0 * m[i - 1])),
        ("behind the camera", |m| {
            (0..12).for_each(|i| m[i] = if i < 8 { m[i] } else { -m[i] - 1e4 * f64::from(u8::from(i == 11)) })
        }),
    ];
    for (name, change) in cases {
        let path = changed(&place, name, |c| rows(c, &change));
        let output = voxcast(&["run", "--model", &model, &path, "-o", &out, "--json"]);
        // A translation that is too long can also leave one camera that sees everything at one pixel.
        let said = text(&output.stderr);
        assert!(said.contains("of the voxels, expected at least"), "{name}: {said}");
    }
    let blind = changed(&place, "blind", |c| {
        // Everything is behind it.
        c["cameras"][1]["lidar2img"][2][3] = json!(-1e4);
    });
    let output = voxcast(&["run", "--model", &model, &blind, "-o", &out]);
    assert!(text(&output.stderr).contains("CAM_1 sees"), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains("cameras see"), "the summary tells the share");
}

#[test]
fn what_a_scene_says_and_is_not_obeyed() {
    let place = Place::ready();
    let [model, out] = ["model", "out.npz"].map(|f| place.text(f));
    for (name, key, value, expected) in [
        ("unused", "camera2ego", json!([[1]]), "keys that are not used: camera2ego"),
        ("unused too", "post_tran", json!([1, 2]), "keys that are not used: post_tran"),
        ("matrix", "lidar2camera", json!(1), "\"lidar2camera\" is not used"),
        ("file", "file", json!("CAM_1.png"), "have the same image"),
    ] {
        let scene = changed(&place, name, |c| c["cameras"][0][key] = value.clone());
        let (_, notes) = noted(&["run", "--model", &model, &scene, "-o", &out, "--json"]);
        assert!(notes.len() == 1 && notes[0].contains(expected), "{name}: {notes:?}");
        assert!(notes[0].contains("calibration.json"), "{notes:?}");
    }
    let lens = changed(&place, "lens", |c| c["cameras"][0]["distortion"] = json!([-0.3, 0.1]));
    assert!(refused("calibration.json", &["run", "--model", &model, &lens, "-o", &out]).contains("\"distortion\""));
    let large = changed(&place, "large", |c| {
        (c["cameras"][0]["width"], c["cameras"][0]["height"]) = (json!(640), json!(480));
    });
    let calibration = format!("{large}/calibration.json");
    let line = refused(&calibration, &["rig", &calibration, "--model", &model, "-o", &out]);
    assert!(line.contains("pads to 480x640"), "{line}");
}

#[test]
fn checkpoints_in_any_wrapper() {
    let place = Place::new();
    let [network, model] = ["network.json", "model"].map(|f| place.text(f));
    let tensors = place.tensors();
    let import = |name: &str, bytes: Vec<u8>| {
        fs::write(place.path(name), bytes).unwrap();
        voxcast(&["import", &place.text(name), "--network", &network, "-o", &model, "--no-self-test"])
    };
    let plain = import("plain", plain_bytes(&tensors));
    let expected = text(&plain.stdout);
    let file = |prefix: &str, more: &[&str]| {
        let mut all: Tensors = tensors.iter().map(|(name, t)| (format!("{prefix}{name}"), t.clone())).collect();
        all.extend(more.iter().map(|name| ((*name).to_owned(), (vec![1], vec![3.0]))));
        all
    };
    for (prefix, more, said) in [
        ("", &[][..], ""),
        ("module.", &[], "names without module."),
        ("module.", &["steps"], "names without module."),
        ("module._orig_mod.", &["n_averaged"], "names without module."),
        ("model.", &["epoch.num_batches_tracked"], "names without module."),
        (
            "_orig_mod.",
            &["loss.weight", "aux.bias"],
            "2 tensors that the network does not have: \"aux.bias\", \"loss.weight\"",
        ),
    ] {
        for (format, bytes) in [("zip", pth_bytes(&file(prefix, more))), ("legacy", legacy_bytes(&file(prefix, more)))]
        {
            let output = import("wrapped", bytes);
            let notes = text(&output.stderr);
            assert_eq!(output.status.code(), Some(0), "{prefix} {format}: {notes}");
            assert_eq!(text(&output.stdout), expected, "{prefix} {format}: the same model");
            assert!(notes.contains(said) && notes.is_empty() == said.is_empty(), "{prefix} {format}: {notes}");
        }
    }
    // A name that nobody can know.
    let mut odd = file("net.", &[]);
    let output = import("odd", pth_bytes(&odd));
    let line = assert_refused(&output, "odd", "odd names");
    assert!(line.contains("is missing") && line.contains("the nearest names are \"net."), "{line}");
    odd = BTreeMap::from([("x".to_owned(), (vec![1], vec![1.0]))]);
    let line = assert_refused(&import("other", pth_bytes(&odd)), "other", "another network");
    assert!(line.contains("its names begin with \"x\""), "{line}");
}
