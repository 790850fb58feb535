//! Directories of scenes.

use super::*;

#[test]
fn a_drive_is_run_with_one_session() {
    let place = Place::ready();
    let street = Network { bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, model, drive, out] = ["street.json", "model", "drive", "out"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--frames", "3", "-o", &drive]);
    let film = place.text("drive.png");
    let run = ["run", "--model", &model, &drive, "-o", &out];
    let told = done(&[&run[..], &["--animation", &film, "--width", "320", "--mask", "1"]].concat());
    assert!(told.contains("3 scenes") && told.contains("99th percentile"), "{told}");
    // The number of frames is in the animation's control chunk.
    let bytes = fs::read(&film).unwrap();
    let control = bytes.windows(4).position(|w| w == b"acTL").unwrap();
    assert_eq!(bytes[control + 4..control + 8], [0, 0, 0, 3]);
    for name in ["000", "001", "002"] {
        let (scene, alone) = (format!("{drive}/{name}"), place.text("alone.npz"));
        done(&["run", "--model", &model, &scene, "-o", &alone, "--mask", "1"]);
        let one = fs::read(&alone).unwrap();
        assert!(fs::read(place.path(&format!("out/{name}.npz"))).unwrap() == one, "{name} alone gives the same");
    }
    let summary: Value = serde_json::from_str(&done(&[&run[..], &["--json"]].concat())).unwrap();
    assert_eq!(summary["scenes"].as_array().unwrap().len(), 3);
    assert!(summary["seconds"]["frame"]["worst"].as_f64() >= summary["seconds"]["frame"]["median"].as_f64());
    assert!(refused("drive", &[&run[..], &["--png", &film]].concat()).contains("--png shows one scene"));
    let one = place.text("drive/000");
    refused("000", &["run", "--model", &model, &one, "-o", &place.text("o.npz"), "--animation", &film]);
    let rig = place.text("rig of the drive");
    done(&["rig", &one, "--model", &model, "-o", &rig]);
    let with_rig = [&run[..], &["--rig", &rig, "--json"]].concat();
    let again: Value = serde_json::from_str(&done(&with_rig)).unwrap();
    assert_eq!((&again["digest"], &again["rigs"]), (&summary["digest"], &json!(1)));
    // A camera that moves gets matrices of its own, unless a rig is given.
    let calibration = place.path("drive/002/calibration.json");
    let mut moved: Value = serde_json::from_slice(&fs::read(&calibration).unwrap()).unwrap();
    moved["cameras"][0]["lidar2img"][0][3] = json!(1.5);
    fs::write(&calibration, moved.to_string()).unwrap();
    let again: Value = serde_json::from_str(&done(&[&run[..], &["--json"]].concat())).unwrap();
    assert_eq!(again["rigs"], 2);
    assert!(refused("drive/002", &with_rig).contains("another calibration"));
    fs::write(place.path("drive/001/calibration.json"), "{}").unwrap();
    refused("drive/001/calibration.json", &[&run[..], &["--animation", &film]].concat());
    assert!(fs::read(&film).unwrap() == bytes, "the old animation stays");
}

#[test]
fn a_set_is_completed_with_what_it_was_begun_with() {
    let place = Place::ready();
    let street = Network { bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, set] = ["street.json", "set"].map(|f| place.text(f));
    let synth = |count: &'static str| ["synth", "--network", &network, "--seed", "5", "--set", &set, "--count", count];
    done(&synth("1"));
    let frame = fs::read(place.path("set/000000005.safetensors")).unwrap();
    let line = refused("000000005.safetensors", &[&synth("2")[..], &["--pixels"]].concat());
    assert!(line.contains("drawn without --pixels"), "{line}");
    assert_eq!(done(&synth("2")).trim_end(), format!("2 frames in {set}"));
    assert!(fs::read(place.path("set/000000005.safetensors")).unwrap() == frame);
    // The other way round there is only more than what was asked for.
    fs::remove_dir_all(place.path("set")).unwrap();
    done(&[&synth("1")[..], &["--pixels"]].concat());
    done(&[&synth("2")[..], &["--pixels"]].concat());
    done(&synth("2"));
}
