//! Synthetic and published sets, and how networks are scored on them.

use super::*;

#[test]
fn synthetic_scenes_run_and_sets_go_on() {
    let place = Place::ready();
    let mut street = network();
    street.bounds = [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]];
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, drive, set] = ["street.json", "drive", "set"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--frames", "2", "-o", &drive]);
    let [model, scene, out] = ["model", "drive/001", "out.npz"].map(|f| place.text(f));
    done(&["run", "--model", &model, &scene, "-o", &out]);
    let arguments = ["synth", "--network", &network, "--seed", "5", "--count", "3", "--set", &set, "--pixels"];
    done(&arguments);
    let file = place.path("set/000000006.safetensors");
    let whole = fs::read(&file).unwrap();
    fs::remove_file(&file).unwrap();
    done(&arguments);
    assert!(fs::read(&file).unwrap() == whole, "the frame that was missing is made again");
    done(&["run", "--model", &model, file.to_str().unwrap(), "-o", &out]);
    let line = refused("set.json", &["synth", "--seed", "5", "--count", "3", "--set", &set]);
    assert!(line.contains("other frames"), "{line}");
    let seeds = ["synth", "--network", &network, "--seed", "999999999", "--count", "2", "--set", &set];
    assert!(refused("", &seeds).contains("seeds below 1000000000"));
}

/// nuScenes with one key frame of the images in `samples`, and its labels of both kinds: a wall of cars 10 m ahead.
fn write_nuscenes(root: &Path, images: &[String]) {
    let cameras = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"];
    let (mut sensors, mut calibrated, mut egos, mut data) = (vec![], vec![], vec![], vec![]);
    for (index, name) in cameras.into_iter().chain(["LIDAR_TOP"]).enumerate() {
        let camera = index < cameras.len();
        let turn = std::f64::consts::PI * index as f64 / 6.0;
        let intrinsic = if camera { json!([[40, 0, 32], [0, 40, 16], [0, 0, 1]]) } else { json!([]) };
        // Cameras look along +y, turned about z; the lidar's y looks along the vehicle's x.
        let (s, c) = (turn.sin() * 0.5f64.sqrt(), turn.cos() * 0.5f64.sqrt());
        let rotation = if camera { json!([c, -c, -s, s]) } else { json!([0.5f64.sqrt(), 0, 0, -0.5f64.sqrt()]) };
        let file = if camera { images[index].clone() } else { "samples/LIDAR_TOP/sweep.pcd.bin".to_owned() };
        sensors.push(json!({"token": name, "channel": name}));
        calibrated
            .push(json!({"token": name, "sensor_token": name, "translation": [1.1, 0, 2.1], "rotation": rotation,
            "camera_intrinsic": intrinsic}));
        egos.push(json!({"token": name, "translation": [5, 6, 0], "rotation": [1, 0, 0, 0]}));
        data.push(json!({"token": name, "sample_token": "a", "ego_pose_token": name, "calibrated_sensor_token": name,
            "filename": file, "is_key_frame": true, "height": 32, "width": 64}));
    }
    fs::create_dir(root.join("v1.0-mini")).unwrap();
    for (table, rows) in [
        ("sensor", sensors),
        ("calibrated_sensor", calibrated),
        ("ego_pose", egos),
        ("sample_data", data),
        ("scene", vec![json!({"token": "s", "name": "scene-0103"})]),
        ("sample", vec![json!({"token": "a", "scene_token": "s", "timestamp": 7})]),
    ] {
        fs::write(root.join(format!("v1.0-mini/{table}.json")), json!(rows).to_string()).unwrap();
    }
    // 10 to 12 m ahead of the lidar, 4 m to either side, from 2 m below to 2 m above.
    let mut rows = Vec::new();
    for i in 0..16 * 4 * 8 {
        rows.extend([92 + (i / 32) as u8, 120 + (i / 8 % 4) as u8, 6 + (i % 8) as u8, 4]);
    }
    let mut literal = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({}, 4), }}", rows.len() / 4);
    literal.push_str(&" ".repeat(117 - literal.len()));
    let file = [b"\x93NUMPY\x01\x00\x76\x00", literal.as_bytes(), b"\n", &rows].concat();
    fs::create_dir_all(root.join("occ/samples")).unwrap();
    fs::write(root.join("occ/samples/sweep.pcd.bin.npy"), file).unwrap();
    let mut semantics = vec![17u8; 640_000];
    for (x, y, z) in (0..5 * 20 * 10).map(|i| (128 + i / 200, 90 + i / 10 % 20, 3 + i % 10)) {
        semantics[(x * 200 + y) * 16 + z] = 4;
    }
    let mask = vec![1u8; 640_000];
    let arrays = [("semantics", &semantics), ("mask_lidar", &mask), ("mask_camera", &mask)]
        .map(|(name, values)| Array { name, shape: &[200, 200, 16], elements: Elements::U8(values) });
    fs::create_dir_all(root.join("gts/scene-0103/a")).unwrap();
    write_npz(&root.join("gts/scene-0103/a/labels.npz"), &arrays).unwrap();
}

#[test]
fn published_sets_are_scored() {
    let place = Place(tempfile::tempdir().unwrap());
    let network = Network { classes: 17, cameras: 6, ..network() };
    fs::write(place.path("model"), small::model_bytes(&network, Precision::F32, Rewrites::ALL, 3)).unwrap();
    let scene = small::scene(&network, 1);
    scene.save(&place.path("samples")).unwrap();
    let images: Vec<String> = scene.names.iter().map(|name| format!("samples/{name}.png")).collect();
    write_nuscenes(place.0.path(), &images);
    let (model, root) = (place.text("model"), place.0.path().to_str().unwrap());
    let (surroundocc, occ3d) = (format!("surroundocc:{root}:{root}/occ:val"), format!("occ3d:{root}:{root}/gts"));
    let scores = |predictor: [&str; 2], data: &str| -> Value {
        let json = place.text("scores.json");
        done(&["eval", predictor[0], predictor[1], "--data", data, "--json", &json]);
        serde_json::from_slice(&fs::read(json).unwrap()).unwrap()
    };
    let of_model = scores(["--model", &model], &occ3d);
    assert_eq!(of_model["frames"], 1);
    assert_eq!(of_model["regions"].as_object().unwrap().len(), 4, "{of_model}");
    assert_eq!(scores(["--model", &model], &surroundocc)["regions"].as_object().unwrap().len(), 2);
    // The same wall in the frames of lidar and vehicle.
    for predictor in [&surroundocc, &occ3d] {
        let iou = &scores(["--majority", predictor], &occ3d)["regions"]["camera"]["iou"];
        assert_eq!(iou.as_f64(), Some(1.0), "{predictor}");
    }
    let line = text(&voxcast(&["eval", "--majority", &occ3d, "--data", &surroundocc]).stderr);
    assert!(line.contains("axes of the ego vehicle"), "{line}");
    fs::remove_file(place.path("gts/scene-0103/a/labels.npz")).unwrap();
    refused("gts/scene-0103/a/labels.npz", &["eval", "--model", &model, "--data", &occ3d]);
    // Ranges are those of images.
    let ranges = voxcast(&["calibrate", &model, &occ3d, "-o", &place.text("ranges.json")]);
    assert!(text(&ranges.stdout).contains("measured on 1 frames"), "{ranges:?}");

    let kitti = place.path("kitti/sequences/08");
    fs::create_dir_all(kitti.join("voxels")).unwrap();
    fs::write(kitti.join("calib.txt"), "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
    fs::write(kitti.join("voxels/000000.label"), vec![0; 4 << 20]).unwrap();
    let data = format!("semantickitti:{root}/kitti");
    let line = refused("model", &["eval", "--model", &model, "--data", &data]);
    assert!(line.contains("a model of 17 classes") && line.contains("has 20"), "{line}");
    refused("voxels/000000.invalid", &["eval", "--majority", &data, "--data", &data]);
}

/// A model for drawn streets, and a set of four of them.
fn street_set(place: &Place) -> [String; 2] {
    let street = Network { classes: 17, bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street"), small::model_bytes(&street, Precision::F32, Rewrites::ALL, 3)).unwrap();
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, set, model] = ["street.json", "set", "street"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--count", "4", "--set", &set]);
    [model, format!("synthetic:{set}")]
}

#[test]
fn an_evaluation_that_was_stopped_goes_on() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let [journal, json, markdown] = ["scores.jsonl", "scores.json", "scores.md"].map(|f| place.text(f));
    let base = ["eval", "--model", &model, "--data", &data, "--losses"];
    let at_once = done(&[&base[..], &["--json", &json, "--markdown", &markdown]].concat());
    assert!(at_once.contains("4 frames") && at_once.contains("mIoU") && at_once.contains("lovasz"), "{at_once}");
    let whole = fs::read(&json).unwrap();
    assert!(fs::read_to_string(&markdown).unwrap().contains("| mIoU |"));

    let resumed = [&base[..], &["--resume", &journal, "--json", &json, "--workers", "2"]].concat();
    done(&[&resumed[..], &["--limit", "2"]].concat());
    // The second frame's line loses its end, as after a kill.
    let bytes = fs::read(&journal).unwrap();
    assert_eq!(bytes.iter().filter(|&&b| b == b'\n').count(), 3);
    fs::write(&journal, &bytes[..bytes.len() - 40]).unwrap();
    assert_eq!(done(&resumed), at_once);
    assert!(fs::read(&json).unwrap() == whole, "the same numbers to the last bit");
    assert_eq!(fs::read_to_string(&journal).unwrap().lines().count(), 5);
    // All is known, and nothing is computed again, but the labels must be those of then.
    let frame = place.path("set/000000007.safetensors");
    let kept = fs::read(&frame).unwrap();
    fs::copy(place.path("set/000000006.safetensors"), &frame).unwrap();
    let changed = refused("scores.jsonl", &resumed);
    assert!(changed.contains("frame 000000007 was scored against other labels than the set has now"), "{changed}");
    fs::write(&frame, "damaged").unwrap();
    let damaged = refused("000000007.safetensors", &resumed);
    assert!(!damaged.contains("scores.jsonl"), "{damaged}");
    // Frames beyond the limit are not looked at.
    done(&[&resumed[..], &["--limit", "2"]].concat());
    fs::write(&frame, kept).unwrap();
    assert_eq!(done(&resumed), at_once);
    let old = fs::read_to_string(&journal).unwrap().replacen("\"version\":4", "\"version\":3", 1);
    fs::write(place.path("old.jsonl"), old).unwrap();
    let old = refused("old.jsonl", &[&base[..], &["--resume", &place.text("old.jsonl")]].concat());
    assert!(old.contains("of version 3, expected \"evaluation\" of version 4"), "{old}");
    let line = refused("scores.jsonl", &["eval", "--model", &model, "--data", &data, "--resume", &journal]);
    assert!(line.contains("another evaluation"), "{line}");
    let line = refused("scores.jsonl", &[&resumed[..8], &["--json", &journal]].concat());
    assert!(line.contains("--resume and --json name the same file"), "{line}");
    assert_eq!(fs::read_to_string(&journal).unwrap().lines().count(), 5);
    fs::write(place.path("notes"), "my notes\n").unwrap();
    let notes = refused("notes", &["eval", "--model", &model, "--data", &data, "--resume", &place.text("notes")]);
    assert!(notes.contains("line 1: not the first line of a journal"), "{notes}");
    assert_eq!(fs::read_to_string(place.path("notes")).unwrap(), "my notes\n");
}

#[test]
fn shards_of_many_machines_are_put_together() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let base = ["eval", "--model", &model, "--data", &data, "--losses"];
    let [json, markdown] = ["scores.json", "scores.md"].map(|f| place.text(f));
    let at_once = done(&[&base[..], &["--json", &json, "--markdown", &markdown]].concat());
    let whole = [&json, &markdown].map(|file| fs::read(file).unwrap());
    let journals = ["0.jsonl", "1.jsonl", "2.jsonl"].map(|f| place.text(f));
    let shard = |index: usize, more: &[&str]| {
        let part = format!("{index}/3");
        done(&[&base[..], &["--resume", &journals[index], "--shard", &part], more].concat())
    };
    assert!(shard(0, &[]).contains("shard 0/3, 2 frames"));
    shard(2, &[]);
    // The second one comes by its engine's variables.
    let slurm = Command::new(env!("CARGO_BIN_EXE_voxcast"))
        .args(base)
        .args(["--resume", &journals[1], "--shard", "auto"])
        .envs([("SLURM_ARRAY_TASK_ID", "2"), ("SLURM_ARRAY_TASK_MIN", "1")])
        .envs([("SLURM_ARRAY_TASK_MAX", "3"), ("SLURM_ARRAY_TASK_COUNT", "3")])
        .output()
        .unwrap();
    assert!(slurm.status.success(), "{slurm:?}");

    let merge = |order: [usize; 3], more: &[&str]| {
        let [a, b, c] = order.map(|index| journals[index].as_str());
        [&["eval", "--merge", a, b, c][..], more].concat().iter().map(|&s| s.to_owned()).collect::<Vec<String>>()
    };
    for order in [[0, 1, 2], [2, 0, 1]] {
        assert_eq!(done(&words(&merge(order, &["--json", &json, "--markdown", &markdown]))), at_once);
        assert!(
            [&json, &markdown].map(|file| fs::read(file).unwrap()) == whole,
            "the numbers of one run, to the last bit"
        );
    }
    // Of the first three frames each shard has one.
    let three = done(&[&base[..], &["--limit", "3"]].concat());
    assert_eq!(done(&words(&merge([0, 1, 2], &["--limit", "3"]))), three);

    let [a, b, c] = journals.each_ref().map(String::as_str);
    let missing = refused("", &["eval", "--merge", a, c]);
    assert!(missing.contains("shards are missing: 1/3"), "{missing}");
    fs::copy(b, place.path("copy.jsonl")).unwrap();
    let overlap = refused("copy.jsonl", &["eval", "--merge", a, b, c, &place.text("copy.jsonl")]);
    assert!(overlap.contains("shard 1/3, as") && overlap.contains("1.jsonl is: they overlap"), "{overlap}");
    let text = fs::read_to_string(a).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    fs::write(a, lines[..2].join("\n") + "\n").unwrap();
    let unfinished = refused("0.jsonl", &words(&merge([0, 1, 2], &[])));
    assert!(unfinished.contains("shard 0/3: 1 of its 2 frames are missing"), "{unfinished}");
    fs::write(a, text.clone() + lines[1] + "\n").unwrap();
    // Frames stand in the order in which they were done.
    let twice = refused("0.jsonl", &words(&merge([0, 1, 2], &[])));
    assert!(twice.contains("line 4: frame 00000000") && twice.trim_end().ends_with("is there already"), "{twice}");
    fs::write(a, &text).unwrap();
    fs::write(b, fs::read_to_string(b).unwrap().replacen("model ", "model f", 1)).unwrap();
    let other = refused("1.jsonl", &words(&merge([0, 1, 2], &[])));
    assert!(other.contains("another evaluation than") && other.contains("\"predictors\": found"), "{other}");
    // A task that is run again alone is an array of one, which is another shard.
    let again = [&base[..], &["--resume", a, "--shard", "0/1"]].concat();
    assert!(refused("0.jsonl", &again).contains("it is of shard 0/3, expected 0/1"));
    let shared = refused("0.jsonl", &words(&merge([0, 1, 2], &["--json", a])));
    assert!(shared.contains("--merge and --json name the same file"), "{shared}");
    for usage in [&["--shard", "3/3", "--resume", a][..], &["--shard", "0/3"]] {
        assert_eq!(voxcast(&[&base[..], usage].concat()).status.code(), Some(2), "{usage:?}");
    }
}

#[test]
fn two_models_are_compared() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let street = Network::from_json(&fs::read_to_string(place.path("street.json")).unwrap()).unwrap();
    fs::write(place.path("half"), small::model_bytes(&street, Precision::F16, Rewrites::ALL, 3)).unwrap();
    let [half, json, picture] = ["half", "scores.json", "confusion.png"].map(|f| place.text(f));
    let told = done(&["eval", "--compare", &model, &half, "--data", &data, "--json", &json, "--confusion", &picture]);
    assert!(told.contains("B - A") && told.contains("say the same of"), "{told}");
    let scores: Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
    let equal = scores["comparison"]["equal"].as_f64().unwrap();
    assert!((0.5..1.0).contains(&equal), "f16 weights change some voxels and not all: {equal}");
    let alone = |model: &str| -> Value {
        done(&["eval", "--model", model, "--data", &data, "--json", &json]);
        serde_json::from_slice(&fs::read(&json).unwrap()).unwrap()
    };
    assert_eq!([alone(&model), alone(&half)].to_vec(), scores["reports"].as_array().unwrap()[..]);
    assert_eq!(&fs::read(place.path("confusion.png")).unwrap()[..4], b"\x89PNG");
    assert_eq!(voxcast(&["eval", "--compare", &model, "--data", &data]).status.code(), Some(2));
}

#[test]
fn confidence_is_fitted_and_its_calibration_counted() {
    let place = Place(tempfile::tempdir().unwrap());
    let [model, data] = street_set(&place);
    let [json, picture, fitted] = ["scores.json", "reliability.png", "fitted"].map(|f| place.text(f));
    let read = || serde_json::from_slice::<Value>(&fs::read(&json).unwrap()).unwrap();
    let base = ["eval", "--model", &model, "--data", &data, "--json", &json];
    let plain = done(&base);
    assert!(read()["calibration"].is_null());
    let told = done(&[&base[..], &["--calibration", "--reliability", &picture]].concat());
    let [first, second] = ["calibration error ", "occupied from "].map(|head| told.find(head).unwrap());
    assert!(told.starts_with(&plain) && plain.len() < first && first < second, "{told}");
    let scores = read();
    for region in ["all", "visible", "supported"] {
        let counts = &scores["calibration"][region]["occupied"]["counts"];
        let voxels: u64 = counts
            .as_array()
            .unwrap()
            .iter()
            .flat_map(|pair| pair.as_array().unwrap())
            .map(|n| n.as_u64().unwrap())
            .sum();
        assert_eq!(Some(voxels), scores["regions"][region]["voxels"].as_u64(), "{region}");
    }
    let all = &scores["calibration"]["all"]["occupied"];
    let thresholds = all["thresholds"].as_array().unwrap();
    let recall: Vec<f64> = thresholds.iter().map(|row| row["recall"].as_f64().unwrap()).collect();
    assert!(recall.is_sorted_by(|a, b| a >= b) && recall[18] > 0.0, "{recall:?}");
    assert!((0.0..1.0).contains(&all["expected_error"].as_f64().unwrap()));
    assert_eq!(&fs::read(&picture).unwrap()[..4], b"\x89PNG");

    // Shards give the same, and know whether they have it.
    let (whole, drawn) = (fs::read(&json).unwrap(), fs::read(&picture).unwrap());
    let journals = ["0.jsonl", "1.jsonl"].map(|f| place.text(f));
    for (index, journal) in journals.iter().enumerate() {
        let part = format!("{index}/2");
        done(&["eval", "--model", &model, "--data", &data, "--calibration", "--shard", &part, "--resume", journal]);
    }
    let merge = ["eval", "--merge", &journals[0], &journals[1], "--json", &json, "--reliability", &picture];
    assert_eq!(done(&merge), told);
    assert!(fs::read(&json).unwrap() == whole && fs::read(&picture).unwrap() == drawn);
    let without = place.text("without.jsonl");
    done(&["eval", "--model", &model, "--data", &data, "--limit", "1", "--resume", &without]);
    let line = refused("reliability.png", &["eval", "--merge", &without, "--limit", "1", "--reliability", &picture]);
    assert!(line.contains("expected an evaluation with calibration"), "{line}");

    // Drawn weights know nothing of a street; those that ship do.
    let line = refused("", &["calibrate-confidence", &model, "--data", &data, "-o", &fitted]);
    assert!(line.contains("no temperature from 0.01 to 100 fits the labels"), "{line}");
    let model = place.text("edge");
    fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/edge.safetensors"), &model).unwrap();
    let set = place.text("edge set");
    done(&["synth", "--seed", "5", "--count", "1", "--set", &set]);
    let data = format!("synthetic:{set}");
    let fit = |from: &str, threads: &str| {
        done(&["calibrate-confidence", from, "--data", &data, "-o", &fitted, "--threads", threads])
    };
    let told = fit(&model, "1");
    assert!(told.contains("(before ") && told.contains("in 1 frames"), "{told}");
    let bytes = fs::read(&fitted).unwrap();
    fit(&model, "3");
    assert!(fs::read(&fitted).unwrap() == bytes, "the same on any number of threads");
    let inspected: Value = serde_json::from_str(&done(&["inspect", &fitted, "--json"])).unwrap();
    let temperature = inspected["temperature"].as_f64().unwrap();
    assert!((0.01..100.0).contains(&temperature) && temperature != 1.0, "{temperature}");
    // In its own place, and no other than before.
    assert!(fit(&fitted, "2").contains(&format!("(before {})", temperature as f32)));
    assert!(fs::read(&fitted).unwrap() == bytes);
    let counts = |model: &str| {
        done(&["eval", "--model", model, "--data", &data, "--json", &json, "--calibration"]);
        let scores = read();
        (scores["digest"].clone(), scores["calibration"]["all"]["occupied"]["counts"].clone())
    };
    let (before, after) = (counts(&model), counts(&fitted));
    assert_eq!(before.0, after.0, "classes stay as they are");
    assert_ne!(before.1, after.1);
    refused("no/fitted", &["calibrate-confidence", &model, "--data", &data, "-o", &place.text("no/fitted")]);
}

#[test]
fn a_submission_goes_on_from_nothing() {
    let place = Place(tempfile::tempdir().unwrap());
    let [journal, file] = ["scores.jsonl", "submission.gz"].map(|f| place.text(f));
    // Neither model nor data are looked at before that is said.
    let base = ["eval", "--model", "no model", "--data", "openocc:none:none", "--submission", &file];
    for more in [&["--resume", &journal][..], &["--resume", &journal, "--shard", "0/2"], &["--calibration"]] {
        let output = voxcast(&[&base[..], more].concat());
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{more:?}: {said}");
        assert!(said.contains("'--submission <FILE.gz>' cannot be used with") && said.contains(more[0]), "{said}");
    }
    assert!(!place.path("scores.jsonl").exists() && !place.path("submission.gz").exists());
}
