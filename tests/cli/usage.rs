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
