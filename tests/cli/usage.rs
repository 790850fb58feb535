//! Help, and arguments, names and files that are not there.

use super::*;

#[test]
fn help_and_usage() {
    assert!(done(&["--version"]).starts_with("voxcast "));
    let help = done(&["--help"]);
    for command in [
        "calibrate-confidence",
        "compare",
        "demo",
        "eval",
        "import",
        "inspect",
        "profile",
        "rig",
        "run",
        "selftest",
        "synth",
        "view",
    ] {
        assert!(help.contains(command));
        assert!(done(&[command, "--help"]).contains("Examples:"), "{command}");
        assert!(done(&["help", command]).contains("Usage:"), "{command}");
    }
    for bad in [
        &[][..],
        &["nonsense"],
        &["run"],
        &["run", "scene"],
        &["run", "--model", "m", "scene"],
        &["run", "--model", "m", "scene", "-o", "x", "--stages", "a"],
        &["run", "--model", "m", "scene", "-o", "x", "--threads", "0"],
        &["run", "--model", "m", "scene", "-o", "x", "--threads", "many"],
        &["run", "--model", "m", "scene", "-o", "x", "--nonsense"],
        &["import", "a.pth", "-o", "b"],
        &["import", "a.pth", "--network", "x", "-o", "b", "--precision", "f8"],
        &["import", "a.pth", "--network", "x", "-o", "b", "--fold", "paper"],
        &["rig", "--model", "m", "-o", "x"],
        &["rig", "s", "-o", "x"],
        &["rig", "s", "--model", "m", "--network", "n", "-o", "x"],
        &["inspect"],
        &["inspect", "m", "--cameras", "65"],
        &["profile", "--model", "m", "scene", "--by", "day"],
        &["profile", "--model", "m", "scene", "--repeat", "0"],
        &["demo", "--seed", "-1"],
        &["eval", "--data", "synthetic:d"],
        &["eval", "--model", "m", "--data", "occ3d:d"],
        &["eval", "--model", "m", "--data", "semantickitti:d:22"],
        &["eval", "--compare", "a", "b", "--compare", "c", "d", "--data", "synthetic:d"],
        &["view"],
    ] {
        let output = voxcast(bad);
        assert_eq!((output.status.code(), output.stdout.is_empty()), (Some(2), true), "{bad:?}");
        assert!(text(&output.stderr).contains("--help"), "{bad:?}");
    }
}

#[test]
fn files_that_are_not_there() {
    let place = Place::ready();
    let nothing = place.text("nothing");
    let [net, weights, model, rig, scene, out] =
        ["network.json", "weights.pth", "model", "rig", "scene", "out.npz"].map(|f| place.text(f));
    refused(&nothing, &["import", &nothing, "--network", &net, "-o", &out]);
    refused(&nothing, &["import", &weights, "--network", &nothing, "-o", &out]);
    refused(&nothing, &["rig", &nothing, "--model", &model, "-o", &out]);
    refused(&nothing, &["rig", &scene, "--model", &nothing, "-o", &out]);
    refused(&nothing, &["run", "--model", &nothing, &scene, "-o", &out]);
    refused(&nothing, &["run", "--model", &model, &nothing, "-o", &out]);
    refused(&nothing, &["run", "--model", &model, "--rig", &nothing, &scene, "-o", &out]);
    refused(&nothing, &["inspect", &nothing]);
    refused(&nothing, &["profile", "--model", &nothing, &scene]);
    assert!(!place.path("out.npz").exists());

    // Directories where files belong, and the other way round.
    for arguments in [
        &["inspect", &scene][..],
        &["view", &scene],
        &["import", &scene, "--network", &net, "-o", &out],
        &["selftest", &scene],
    ] {
        assert!(refused(&scene, arguments).contains("cannot open: not a regular file"), "{arguments:?}");
    }
    let drawn = place.text("drawn");
    fs::create_dir(place.path("drawn")).unwrap();
    fs::rename(place.path("scene"), place.path("drawn/a")).unwrap();
    for (output, expected) in [(&model, "a file is there, expected a directory"), (&out, "one file for many frames")] {
        let line = refused(output, &["run", "--model", &model, &drawn, "-o", output]);
        assert!(line.contains(expected), "{line}");
    }
    fs::rename(place.path("drawn/a"), place.path("scene")).unwrap();
    for arguments in [
        &["synth", "-o", &model][..],
        &["synth", "--frames", "2", "-o", &model],
        &["synth", "--count", "1", "--set", &model],
        &["demo", "-o", &model],
        &["run", "--model", &model, &scene, "-o", &out, "--dump", &model],
    ] {
        assert!(refused(&model, arguments).contains("a file is there, expected a directory"), "{arguments:?}");
    }
    // What is no scene, and may be taken for one.
    let calibration = place.text("scene/calibration.json");
    let line = refused(&calibration, &["run", "--model", &model, &calibration, "-o", &out]);
    assert!(line.contains("expected a scene: a directory with calibration.json, or a .safetensors file"), "{line}");
    refused(&scene, &["inspect", &scene]);
    refused(&scene, &["import", &scene, "--network", &net, "-o", &out]);
    refused(&scene, &["import", &weights, "--network", &scene, "-o", &out]);
    refused(&model, &["run", "--model", &model, &model, "-o", &out]);
    refused(&scene, &["run", "--model", &model, &scene, "-o", &scene]);
    refused(&scene, &["import", &weights, "--network", &net, "-o", &scene]);
    refused(&scene, &["rig", &scene, "--model", &model, "-o", &scene]);

    let missing = place.text("no/such/out");
    // Before the frame, not after it: the model is not even looked for.
    refused(&missing, &["run", "--model", &nothing, &scene, "-o", &missing]);
    refused(&missing, &["run", "--model", &model, &scene, "-o", &out, "--png", &missing]);
    refused(&missing, &["import", &weights, "--network", &net, "-o", &missing]);
    refused(&missing, &["rig", &scene, "--model", &model, "-o", &missing]);
    refused(&missing, &["profile", "--model", &model, &scene, "--repeat", "1", "--trace", &missing]);
    let inside = place.text("model/demo");
    refused(&inside, &["demo", "-o", &inside]);
    refused(&inside, &["run", "--model", &model, &scene, "-o", &out, "--dump", &inside]);

    let image = fs::read_dir(place.path("scene")).unwrap().map(|e| e.unwrap().path());
    let image = image.filter(|p| p.extension().is_some_and(|e| e == "png")).min().unwrap();
    fs::remove_file(&image).unwrap();
    refused(image.to_str().unwrap(), &["run", "--model", &model, "--rig", &rig, &scene, "-o", &out]);
}

#[test]
fn outputs_in_the_place_of_another_or_of_an_input() {
    let place = Place::ready();
    let [net, weights, model, rig, scene, out] =
        ["network.json", "weights.pth", "model", "rig", "scene", "out.npz"].map(|f| place.text(f));
    let run = ["run", "--model", &model, &scene, "-o"];
    done(&[&run[..], &[&out]].concat());
    let [labels, tensors] = ["labels.npz", "scene.safetensors"].map(|f| place.text(f));
    fs::copy(&out, &labels).unwrap();
    fs::copy(place.path("weights.pth"), place.path("scene.safetensors")).unwrap();
    // A path need not be spelt the same.
    let model_again = place.text("scene/../model");
    for (names, file, arguments) in [
        ("--model and --output", "model", &[&run[..], &[&model_again]].concat()[..]),
        ("--rig and --output", "rig", &["run", "--model", &model, "--rig", &rig, &scene, "-o", &rig]),
        ("SCENE and --output", "scene.safetensors", &["run", "--model", &model, &tensors, "-o", &tensors]),
        ("--output and --png", "out.npz", &[&run[..], &[&out, "--png", &out]].concat()),
        (
            "--png and --html",
            "new",
            &[&run[..], &[&out, "--png", &place.text("new"), "--html", &place.text("new")]].concat(),
        ),
        ("CHECKPOINT and --output", "weights.pth", &["import", &weights, "--network", &net, "-o", &weights]),
        ("--model and --output", "model", &["rig", &scene, "--model", &model, "-o", &model]),
        (
            "SCENE and --output",
            "calibration.json",
            &[
                "rig",
                &place.text("scene/calibration.json"),
                "--model",
                &model,
                "-o",
                &place.text("scene/calibration.json"),
            ],
        ),
        ("OUT.npz and --output", "out.npz", &["view", &out, "-o", &out]),
        ("--truth and --output", "labels.npz", &["view", &out, "--truth", &labels, "-o", &labels]),
        ("MODEL and --output", "model", &["calibrate", &model, &scene, "-o", &model]),
        ("--model and --trace", "model", &["profile", "--model", &model, &scene, "--trace", &model]),
        ("--model and --json", "model", &["eval", "--model", &model, "--data", "synthetic:none", "--json", &model]),
    ] {
        let before = fs::read(place.path(file)).ok();
        let line = refused(file, arguments);
        assert!(line.contains(&format!("{names} name the same file")), "{line}");
        assert!(fs::read(place.path(file)).ok() == before, "{arguments:?}");
    }
}

/// Commands that print line by line, at once, and a table.
fn printing(place: &Place) -> [Vec<String>; 3] {
    let [model, scene, out] = ["model", "scene", "out.npz"].map(|f| place.text(f));
    [
        vec!["inspect", &model, "--operations", "--plan"],
        vec!["run", "--model", &model, &scene, "-o", &out],
        vec!["compare", &out, &out],
    ]
    .map(|arguments| arguments.into_iter().map(str::to_owned).collect())
}

#[test]
#[cfg(unix)]
fn a_reader_that_has_gone_is_no_fault() {
    let place = Place::ready();
    for arguments in printing(&place) {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = Command::new(env!("CARGO_BIN_EXE_voxcast")).args(&arguments).stdout(writer).output().unwrap();
        assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()), "{arguments:?}");
    }
    assert!(place.path("out.npz").exists(), "the work is done all the same");
}

#[test]
#[cfg(target_os = "linux")]
fn an_output_that_takes_nothing_is_said() {
    let place = Place::ready();
    for arguments in printing(&place) {
        let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_voxcast")).args(&arguments).stdout(full).output().unwrap();
        assert_refused(&output, "standard output: cannot write", &format!("{arguments:?}"));
    }
}

#[test]
fn names_and_numbers_that_are_unknown() {
    let place = Place::ready();
    let [weights, model, scene, out, dump] =
        ["weights.pth", "model", "scene", "out.npz", "dump"].map(|f| place.text(f));
    let line = refused("nuscenes-999", &["import", &weights, "--network", "nuscenes-999", "-o", &out]);
    assert!(line.contains("nuscenes-200"), "{line}");
    let line = refused("--isa", &["run", "--model", &model, &scene, "-o", &out, "--isa", "mmx"]);
    assert!(line.contains("scalar, avx2"), "{line}");
    let line = refused("no stage", &["run", "--model", &model, &scene, "-o", &out, "--dump", &dump, "--stages", "c9"]);
    assert!(line.contains("\"c9\"") && line.contains("logits.lvl0"), "{line}");
    let line = refused(&scene, &["run", "--model", &model, &scene, "-o", &out, "--mask", "0,2"]);
    assert!(line.contains("camera \"2\"") && line.contains("CAM_0, CAM_1"), "{line}");
    // The wrong published network for these weights.
    let line = refused(&weights, &["import", &weights, "--network", "nuscenes-200", "-o", &out]);
    assert!(line.contains("img_backbone.") && line.contains("expects"), "{line}");
}
