//! Robot logs, out and in.

use super::*;

#[test]
fn a_drive_becomes_a_log_that_runs_again() {
    let place = Place::ready();
    let street = Network { bounds: [[-20.0, 20.0], [-20.0, 20.0], [-5.3, 2.7]], ..network() };
    fs::write(place.path("street.json"), street.to_json()).unwrap();
    let [network, model, drive, log, out] = ["street.json", "model", "drive", "out.mcap", "out"].map(|f| place.text(f));
    done(&["synth", "--network", &network, "--seed", "5", "--frames", "2", "-o", &drive]);
    let json = |arguments: &[&str]| -> Value { serde_json::from_str(&done(arguments)).unwrap() };
    let digests = |told: &Value| -> Vec<String> {
        told["scenes"].as_array().unwrap().iter().map(|s| s["digest"].as_str().unwrap().to_owned()).collect()
    };
    let npz = json(&["run", "--model", &model, &drive, "-o", &out, "--json"]);
    let written = json(&["run", "--model", &model, &drive, "-o", &log, "--json"]);
    assert_eq!(digests(&written), digests(&npz));
    assert!(written.get("log").is_none());
    let again = json(&["run", "--model", &model, &log, "-o", &out, "--json"]);
    assert_eq!(digests(&again), digests(&npz));
    let [first, second] = [0, 1].map(|index| &again["scenes"][index]);
    assert_eq!((&first["stamp"], &second["stamp"], &second["missing"]), (&json!(0), &json!(500_000_000), &json!([])));
    assert_eq!(again["log"]["frame"], "lidar");
    assert!(again["log"]["extent"].as_str().unwrap().starts_with("whole, "));
    let result = |name: &str| fs::read(place.path(&format!("out/{name}.npz"))).unwrap();
    assert!(result("000000") == result("000") && result("000001") == result("001"));
    // A single scene becomes a log of one frame.
    let one = place.text("one.mcap");
    let told = done(&["run", "--model", &model, &format!("{drive}/001"), "-o", &one]);
    assert!(told.starts_with("1 scenes with one session"), "{told}");
    assert_eq!(digests(&json(&["run", "--model", &model, &one, "-o", &out, "--json"])), digests(&npz)[1..]);

    let told = done(&["run", "--model", &model, &log, "-o", &out]);
    assert!(told.contains("0 frames lack an image, 0 images belong to no frame, 0 frames have no transform"), "{told}");
    let cut = place.text("cut.mcap");
    let bytes = fs::read(&log).unwrap();
    fs::write(&cut, &bytes[..bytes.len() * 7 / 10]).unwrap();
    let told = done(&["run", "--model", &model, &cut, "-o", &out]);
    assert!(told.contains("log cut off: read up to byte "), "{told}");
}

#[test]
fn what_cannot_be_run_is_said() {
    let place = Place::ready();
    let [model, scene, log, out] = ["model", "scene", "out.mcap", "out"].map(|f| place.text(f));
    done(&["run", "--model", &model, &scene, "-o", &log]);
    let base = ["run", "--model", &model, &log, "-o", &out];
    fn with<'a>(base: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
        [base, more].concat()
    }
    assert!(refused("out.mcap", &with(&base, &["--frame", "map"])).contains("no frame \"map\", expected one of:"));
    assert!(refused("out.mcap", &with(&base, &["--camera", "a=/a"])).contains("camera a: no images on topic /a"));
    assert!(
        refused("out.mcap", &with(&base, &["--png", "a.png"])).contains("--png shows one scene, and this is a log")
    );
    assert!(
        refused("scene", &["run", "--model", &model, &scene, "-o", &out, "--frame", "map"]).contains("are about logs")
    );
    let wrong = voxcast(&with(&base, &["--camera", "front"]));
    assert_eq!(wrong.status.code(), Some(2));
    fs::write(place.path("bad.mcap"), "nothing").unwrap();
    let bad = place.text("bad.mcap");
    assert!(refused("bad.mcap", &["run", "--model", &model, &bad, "-o", &out]).contains("expected an MCAP file"));
    fs::write(&bad, "").unwrap();
    let empty = refused("bad.mcap", &["run", "--model", &model, &bad, "-o", &out]);
    assert!(empty.contains("the file is empty, expected an MCAP file"), "{empty}");
    // A log may hold more than what is read of it, and is not replaced by its results.
    let before = fs::read(&log).unwrap();
    let itself = refused("out.mcap", &["run", "--model", &model, &log, "-o", &log]);
    assert!(itself.contains("SCENE and --output name the same file") && fs::read(&log).unwrap() == before, "{itself}");
    let one = place.text("one.npz");
    assert!(refused("one.npz", &["run", "--model", &model, &log, "-o", &one]).contains("one file for many frames"));
    assert!(!place.path("one.npz").exists());
    refused("scene", &["run", "--model", &model, &scene, "-o", &out, "--tolerance", "50"]);
}
