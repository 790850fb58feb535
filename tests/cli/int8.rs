//! Models of 8-bit integers: how they are made, what is said of them, and what is refused.

use super::*;

fn place() -> Place {
    Place::of(&small::suited(network(), Precision::I8))
}

/// An int8 model made of the checkpoint, with more arguments.
fn import_int8(place: &Place, model: &str, more: &[&str]) -> String {
    let [network, weights, scene, model] = ["network.json", "weights.pth", "scene", model].map(|f| place.text(f));
    let base = ["import", &weights, "--network", &network, "--precision", "int8", "-o", &model, "--calibrate", &scene];
    done(&[&base[..], more].concat())
}

#[test]
fn a_checkpoint_becomes_int8_runs_and_is_compared() {
    let place = place();
    let [network, weights, scene] = ["network.json", "weights.pth", "scene"].map(|f| place.text(f));
    let [int8, f32, ranges, again, out] = ["int8", "f32", "ranges.json", "again", "out.npz"].map(|f| place.text(f));
    assert!(import_int8(&place, "int8", &[]).contains("int8 weights"));
    done(&["import", &weights, "--network", &network, "--exact", "-o", &f32]);
    // Ranges apart, of the model: the same model.
    assert!(done(&["calibrate", &f32, &scene, "-o", &ranges]).contains("measured on 1 frames"));
    let base = ["import", &weights, "--network", &network, "--precision", "i8", "--ranges", &ranges];
    done(&[&base[..], &["-o", &again]].concat());
    assert_eq!(fs::read(&int8).unwrap(), fs::read(&again).unwrap());
    // The weights of the model are those of the checkpoint, rounded to f32 once more.
    done(&["import", &f32, "--precision", "int8", "--ranges", &ranges, "-o", &again]);
    done(&["selftest", &int8, "--isa", "scalar"]);
    assert!(done(&["run", "--model", &int8, &scene, "-o", &out]).contains("digest"));
    let told = done(&["inspect", &int8, "--operations"]);
    assert!(told.contains("int8       ") && told.contains("conv2d i8") && told.contains("window_attention"), "{told}");
    let told: Value = serde_json::from_str(&done(&["inspect", &int8, "--json"])).unwrap();
    assert_eq!(told["kept_f32"].as_array().unwrap().len(), 3, "the attention of three levels");
    let compare = ["compare", "--model", &int8, "--against", &f32, &scene, "--tolerance", "inf", "--json"];
    let told: Value = serde_json::from_str(&done(&compare)).unwrap();
    // With drawn weights a softmax chooses one token, and after a step another.
    let chosen = ["attention", "aspp", "fused", "volume.lvl", "logits"];
    let mut near = 0;
    for stage in told["stages"].as_array().unwrap() {
        let name = stage["stage"].as_str().unwrap();
        if name != "classes" {
            let snr = stage["snr_db"].as_f64().unwrap();
            if !chosen.iter().any(|part| name.contains(part)) {
                assert!(snr > 10.0, "{stage}");
                near += 1;
            }
        }
    }
    assert!(near > 5, "{told}");
    let told: Value =
        serde_json::from_str(&done(&["profile", "--model", &int8, &scene, "--repeat", "1", "--json"])).unwrap();
    assert!(
        told["integer_multiply_adds"].as_u64().unwrap() > 0 && told["integer_peak_multiply_adds_per_second"].is_f64()
    );
}

#[test]
fn operations_are_kept_by_name_and_by_measurement() {
    let place = place();
    let [kept, f32] = ["kept", "f32"].map(|f| place.text(f));
    import_int8(&place, "kept", &["--keep-f32", "img_backbone.layer1,occ_head"]);
    let told: Value = serde_json::from_str(&done(&["inspect", &kept, "--json"])).unwrap();
    let names: Vec<&str> = told["kept_f32"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    assert!(names.contains(&"img_backbone.layer1.0.conv1") && names.contains(&"occ_head.mlp_occ_lvl0"), "{names:?}");
    assert!(!names.contains(&"img_backbone.conv1"), "{names:?}");
    let told = import_int8(&place, "mixed", &["--auto-mixed", "60", "--calibrate-frames", "1", "--no-self-test"]);
    assert!(told.starts_with("logits at ") && told.contains("in f32 (all int8: "), "{told}");
    let decibels: f64 = told["logits at ".len()..].split(' ').next().unwrap().parse().unwrap();
    assert!(decibels >= 59.9, "{told}");
    // What was told is what a comparison finds.
    let [network, weights, scene, mixed] = ["network.json", "weights.pth", "scene", "mixed"].map(|f| place.text(f));
    done(&["import", &weights, "--network", &network, "--exact", "-o", &f32, "--no-self-test"]);
    let compare = ["compare", "--model", &mixed, "--against", &f32, &scene, "--tolerance", "inf", "--json"];
    let stages: Value = serde_json::from_str(&done(&compare)).unwrap();
    let stages = stages["stages"].as_array().unwrap();
    let logits = stages.iter().find(|stage| stage["stage"] == "logits.lvl0").unwrap();
    assert!((logits["snr_db"].as_f64().unwrap() - decibels).abs() < 0.1, "{logits} {decibels}");
}

#[test]
fn offsets_that_integers_cannot_hold_stay_in_f32_unasked() {
    let place = place();
    let mut tensors = place.tensors();
    for (name, (_, values)) in &mut tensors {
        if name.ends_with("conv_offset.weight") {
            values.iter_mut().for_each(|value| *value *= 1e4);
        }
    }
    let [network, far, scene, int8] = ["network.json", "far", "scene", "int8"].map(|f| place.text(f));
    fs::write(place.path("far"), plain_bytes(&tensors)).unwrap();
    let import = ["import", &far, "--network", &network, "--precision", "int8", "--calibrate", &scene, "-o", &int8];
    let output = voxcast(&import);
    let said = super::text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    let told: Value = serde_json::from_str(&done(&["inspect", &int8, "--json"])).unwrap();
    let kept: Vec<&str> = told["kept_f32"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    let deformed = kept.iter().filter(|name| name.ends_with("conv_offset")).count();
    assert!(deformed > 0 && kept.contains(&"img_backbone.layer3.0.conv2"), "{kept:?}");
    assert!(said.contains(&format!("note: {deformed} deformable convolutions stay in f32")), "{said}");
    done(&["selftest", &int8, "--isa", "scalar"]);
    // Said only of what nobody asked for.
    let output = voxcast(&[&import[..], &["--keep-f32", "img_backbone.layer3,img_backbone.layer4"]].concat());
    assert!(output.status.success() && !super::text(&output.stderr).contains("deformable"), "{output:?}");
}

#[test]
fn what_cannot_become_int8_is_one_line() {
    let place = place();
    let [network, weights, scene, model] = ["network.json", "weights.pth", "scene", "model"].map(|f| place.text(f));
    let [ranges, other, dead] = ["ranges.json", "other.json", "dead"].map(|f| place.text(f));
    done(&["import", &weights, "--network", &network, "-o", &model, "--no-self-test"]);
    done(&["calibrate", &model, &scene, "-o", &ranges]);
    let base = ["import", &weights, "--network", &network, "--precision", "int8", "-o", &other];
    let with =
        |more: &[&'static str]| -> Vec<String> { base.iter().chain(more).map(|&word| word.to_owned()).collect() };
    for more in [&[][..], &["--ranges", "r", "--fold", "none"], &["--ranges", "r", "--calibrate", "s"]] {
        let words = with(more);
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        assert_eq!(voxcast(&words).status.code(), Some(2), "{words:?}");
    }
    let float = ["import", &weights, "--network", &network, "-o", &other];
    for more in [&["--ranges", &ranges][..], &["--keep-f32", "a"], &["--calibrate-frames", "3"]] {
        assert_eq!(voxcast(&[&float[..], more].concat()).status.code(), Some(2), "{more:?}");
    }
    let text = fs::read_to_string(&ranges).unwrap();
    let edited = |from: &str, to: &str, expected: &str| {
        assert!(text.contains(from), "{from}");
        fs::write(&other, text.replacen(from, to, 1)).unwrap();
        let line = refused(
            "",
            &["import", &weights, "--network", &network, "--precision", "int8", "--ranges", &other, "-o", &dead],
        );
        assert!(line.contains(expected), "{line} (expected {expected})");
        assert!(!place.path("dead").exists(), "nothing is half written");
    };
    let digest = text.split("\"network\": \"").nth(1).unwrap().split('"').next().unwrap();
    edited(digest, "0000000000000000", "ranges of another network: found digest 0000000000000000");
    edited("\"img_backbone.conv1\"", "\"img_backbone.conv0\"", "tensor \"img_backbone.conv1\": the ranges lack it");
    let conv = text.split("\"img_backbone.conv1\": {").nth(1).unwrap().split('}').next().unwrap();
    let threshold = conv.split("\"threshold\": ").nth(1).unwrap().trim();
    let set = |value: &str| conv.replace(threshold, value);
    edited(conv, &set("0.0"), "\"img_backbone.conv1\": its range is 0");
    edited(conv, &set("-1.0"), "\"img_backbone.conv1\": threshold is -1");
    edited(conv, &set("1e-44"), "the scale underflows");
    edited(conv, &set("1e999"), "ranges JSON: number out of range");
    let line = refused("", &[&base[..], &["--ranges", &ranges, "--keep-f32", "img_backbone.layer9"]].concat());
    assert!(line.contains("no operation \"img_backbone.layer9\""), "{line}");
    // A scene with one dead camera is noted, one of nothing else is refused.
    let mut drawn = small::scene(&small::suited(super::network(), Precision::I8), 1);
    drawn.images[1].bgr.fill(9);
    drawn.save(&place.path("dead")).unwrap();
    let output = voxcast(&["calibrate", &model, &dead, "-o", &other]);
    let said = super::text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("dead: camera 1 \"CAM_1\": its image is of one colour throughout"), "{said}");
    drawn.images[0].bgr.fill(9);
    drawn.save(&place.path("dead")).unwrap();
    assert!(refused("dead", &["calibrate", &model, &dead, "-o", &other]).contains("every camera's image"));
    // A model of int8 is no source of weights, has no unfolded graph, and is not calibrated.
    let int8 = place.text("int8");
    import_int8(&place, "int8", &["--no-self-test"]);
    for precision in [&[][..], &["--precision", "f16"]] {
        assert!(refused("int8", &[&["import", &int8, "-o", &other], precision].concat()).contains("a model of int8"));
    }
    assert!(refused("int8", &["calibrate", &int8, &scene, "-o", &other]).contains("a model of int8"));
    assert!(
        refused("int8", &["profile", "--model", &int8, "--unfolded", &scene]).contains("without the projection fold")
    );
    assert_eq!(voxcast(&["import", &weights, "-o", &other]).status.code(), Some(2), "a checkpoint needs its network");
}
