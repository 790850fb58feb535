//! What the commands give: the whole path from a checkpoint to pictures and pages.

use super::*;

#[test]
fn the_whole_path() {
    let place = Place::new();
    let [net, pth, plain, model, half, rig, scene, out, dump] =
        ["network.json", "weights.pth", "weights.safetensors", "model", "half", "rig", "scene", "out.npz", "dump"]
            .map(|f| place.text(f));
    done(&["import", &pth, "--network", &net, "-o", &model]);
    let first = fs::read(&model).unwrap();
    done(&["import", &plain, "--network", &net, "-o", &model]);
    assert_eq!(fs::read(&model).unwrap(), first, "both formats hold the same weights");
    done(&["import", &pth, "--network", &net, "--precision", "f16", "-o", &half]);
    assert!(fs::metadata(&half).unwrap().len() < first.len() as u64);

    done(&["rig", &scene, "--model", &model, "-o", &rig]);
    let built = fs::read(&rig).unwrap();
    done(&["rig", &place.text("scene/calibration.json"), "--model", &model, "-o", &rig, "--threads", "3"]);
    assert_eq!(fs::read(&rig).unwrap(), built);
    done(&["rig", &scene, "--network", &net, "-o", &rig]);
    assert_eq!(fs::read(&rig).unwrap(), built, "matrices follow from the network alone");

    let run = |more: &[&str]| -> Value {
        let arguments = [&["run", "--model", &model, &scene, "-o", &out, "--json"][..], more].concat();
        serde_json::from_str(&done(&arguments)).unwrap()
    };
    let summary = run(&["--logits", "--rig", &rig]);
    let arrays = read_npz(Path::new(&out)).unwrap();
    assert_eq!((arrays[0].name.as_str(), &arrays[0].shape[..]), ("classes", &[16, 24, 8][..]));
    assert_eq!((arrays[1].name.as_str(), &arrays[1].shape[..]), ("logits", &[16, 24, 8, 19][..]));
    let OwnedElements::U8(classes) = &arrays[0].elements else { panic!("classes are bytes") };
    for (class, count) in summary["counts"].as_array().unwrap().iter().enumerate() {
        assert_eq!(count.as_u64().unwrap() as usize, classes.iter().filter(|&&c| usize::from(c) == class).count());
    }
    assert_eq!((arrays[2].name.as_str(), &arrays[2].shape[..]), ("support", &[16, 24, 8][..]));
    assert_eq!(arrays[3].name, "bounds");
    assert_eq!(arrays[3].elements, OwnedElements::F32(network().bounds.concat()));
    assert_eq!((arrays[4].name.as_str(), &arrays[4].shape[..]), ("colours", &[network().classes, 3][..]));
    let support = |out: &str| {
        let mut arrays = read_npz(Path::new(out)).unwrap().into_iter();
        match arrays.find(|a| a.name == "support").unwrap().elements {
            OwnedElements::U16(support) => support,
            other => panic!("support is u16, not {other:?}"),
        }
    };
    let all = support(&out);
    let digest = run(&["--confidence"])["digest"].clone();
    assert_eq!(digest, summary["digest"]);
    let sure = read_npz(Path::new(&out)).unwrap();
    let names: Vec<&str> = sure.iter().map(|array| array.name.as_str()).collect();
    assert_eq!(names, ["classes", "confidence_occupied", "confidence_class", "support", "bounds", "colours"]);
    let [OwnedElements::U8(occupied), OwnedElements::U8(class)] = [&sure[1].elements, &sure[2].elements] else {
        panic!("confidences are bytes")
    };
    for ((&voxel, &occupied), &class) in classes.iter().zip(occupied).zip(class) {
        assert!(if voxel == 0 { occupied.abs_diff(255 - class) < 2 } else { class <= occupied.saturating_add(1) });
    }
    let sure_page = place.text("sure.html");
    done(&["view", &out, "-o", &sure_page]);
    assert!(page(&sure_page)["confidence"].is_string());
    let picture = |more: &[&str]| {
        let png = place.text("sure.png");
        run(&[&["--png", &png], more].concat());
        fs::read(png).unwrap()
    };
    assert!(picture(&["--hide-below", "0"]) == picture(&[]), "nothing is less likely than 0");
    assert_eq!(voxcast(&["run", "--model", &model, &scene, "-o", &out, "--hide-below", "1.5"]).status.code(), Some(2));
    let aimless = voxcast(&["run", "--model", &model, &scene, "-o", &out, "--hide-below", "0.5"]);
    assert!(
        aimless.status.code() == Some(2) && text(&aimless.stderr).contains("--png <FILE>|--animation <FILE.png>"),
        "{aimless:?}"
    );
    assert!(all.contains(&0) && all.iter().any(|&n| n > 1), "seen and unseen places");
    let masked = run(&["--mask", "1"]);
    assert_ne!(masked["digest"], summary["digest"]);
    let fewer = support(&out);
    assert!(fewer.iter().zip(&all).all(|(a, b)| a <= b) && fewer != all);
    assert_eq!(run(&["--mask", "CAM_1"])["digest"], masked["digest"], "by name");
    run(&["--mask", "0,1"]);
    assert!(support(&out).iter().all(|&n| n == 0));
    let (png, html) = (place.text("out.png"), place.text("out.html"));
    for more in [
        &["--threads", "1"][..],
        &["--threads", "5", "--rig", &rig],
        &["--isa", "scalar"],
        &["--png", &png, "--html", &html],
        &["--dump", &dump, "--stages", "level1.fused,logits.lvl2"],
    ] {
        assert_eq!(run(more)["digest"], summary["digest"], "{more:?}");
    }
    assert!(fs::read(&png).unwrap().starts_with(b"\x89PNG"));
    let page = page(&html);
    assert_eq!((&page["title"], &page["digest"]), (&json!("out.npz"), &summary["digest"]));
    assert_eq!((page["cameras"].as_array().unwrap().len(), page["classes"].as_array().unwrap().len()), (2, 19));
    run(&["--dump", &dump]);
    let stages = fs::read(place.path("dump/stages.safetensors")).unwrap();
    let stages = safetensors::SafeTensors::deserialize(&stages).unwrap();
    assert_eq!(stages.tensor("level1.gather.volume").unwrap().shape(), [1, 17, 8, 12, 4]);
    assert_eq!(stages.tensor("backbone.c5").unwrap().shape(), [2, 96, 1, 2]);
    assert_eq!(stages.tensor("classes").unwrap().shape(), [16, 24, 8]);

    let inspected: Value = serde_json::from_str(&done(&["inspect", &model, "--json", "--threads", "2"])).unwrap();
    assert_eq!((&inspected["kind"], &inspected["network"]["classes"]), (&json!("model"), &json!(19)));
    assert!(inspected["session_bytes"].as_u64() > inspected["arena_bytes"].as_u64());
    let inspected: Value = serde_json::from_str(&done(&["inspect", &rig, "--json"])).unwrap();
    assert_eq!((&inspected["kind"], &inspected["cameras"]), (&json!("rig"), &json!(2)));
    for more in ["--operations", "--plan", "--tensors"] {
        assert!(done(&["inspect", &model, more]).contains("refine_lvl0"), "{more}");
    }
    assert!(done(&["inspect", &rig]).contains("level 3"));

    let trace = place.text("trace.json");
    let profile = done(&["profile", "--model", &model, &scene, "--repeat", "1", "--json", "--trace", &trace]);
    let profile: Value = serde_json::from_str(&profile).unwrap();
    assert!(profile["rows"].as_array().unwrap().len() > 50);
    assert!(profile["longest_slice_seconds"].as_f64() > Some(0.0) && profile["slices"].as_u64() > Some(100));
    serde_json::from_slice::<Value>(&fs::read(&trace).unwrap()).unwrap();
    for by in ["part", "kind", "operation"] {
        assert!(done(&["profile", "--model", &model, &scene, "--repeat", "1", "--by", by]).contains("GMAC/s"));
    }
}

#[cfg(feature = "shipped")]
#[test]
fn the_demo_needs_no_other_file() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("a/b").to_str().unwrap().to_owned();
    let digest_in = |told: &str| told.split("digest ").nth(1).unwrap().split_whitespace().next().unwrap().to_owned();
    // The same on every machine, until the network or the street is another; last, and what is looked at, what runs by default.
    // In f32 and f16 no voxel of this street is of another class; the models are others.
    let [wide, narrow] = ["f32", "f16"].map(|precision| {
        let told = done(&["demo", "-o", &directory, "--threads", "2", "--precision", precision]);
        assert_eq!(digest_in(&told), "ab69a26c6122ecee", "{precision}");
        fs::metadata(format!("{directory}/model.safetensors")).unwrap().len()
    });
    assert!(wide > 2 * narrow, "{wide} bytes, {narrow} bytes");
    let told = done(&["demo", "-o", &directory, "--threads", "2"]);
    let digest = &*digest_in(&told);
    assert_eq!(digest, "5908978c56c53402");
    let file = |name: &str| format!("{directory}/{name}");
    let (model, scene, out) = (file("model.safetensors"), file("scene"), file("again.npz"));
    let again = done(&["run", "--model", &model, &scene, "-o", &out]);
    assert!(told.contains("mIoU") && again.contains(digest), "{again} {told}");
    assert_eq!(fs::read(file("occupancy.npz")).unwrap(), fs::read(&out).unwrap());
    assert!(fs::read(file("occupancy.png")).unwrap().starts_with(b"\x89PNG"));
    let shown = page(&file("demo.html"));
    assert_eq!((&shown["digest"], &shown["truth"]["caption"]), (&json!(digest), &json!("truth")));

    // The same page from the files, but for its title.
    let (result, labels, view) = (file("occupancy.npz"), file("scene/labels.npy"), file("view.html"));
    done(&["view", &result, "--scene", &scene, "--truth", &labels, "-o", &view]);
    let mut viewed = page(&view);
    assert_eq!((&viewed["title"], &viewed["subtitle"]), (&json!("occupancy.npz"), &json!("scene")));
    viewed["title"] = shown["title"].clone();
    viewed["subtitle"] = shown["subtitle"].clone();
    assert!(viewed == shown);
}

#[test]
fn the_demo_of_a_model() {
    let place = tempfile::tempdir().unwrap();
    let text = |name: &str| place.path().join(name).to_str().unwrap().to_owned();
    let [directory, model, out] = ["demo", "model.safetensors", "again.npz"].map(text);
    fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/edge.safetensors"), &model).unwrap();
    let told = done(&["demo", "-o", &directory, "--threads", "2", "--model", &model]);
    assert!(told.contains("mIoU") && told.contains(&format!("run --model {model} ")), "{told}");
    let file = |name: &str| format!("{directory}/{name}");
    done(&["run", "--model", &model, "--rig", &file("rig.safetensors"), &file("scene"), "-o", &out]);
    assert_eq!(fs::read(file("occupancy.npz")).unwrap(), fs::read(&out).unwrap());
    assert_eq!(page(&file("demo.html"))["subtitle"], json!("a drawn street"));
    assert!(!Path::new(&file("model.safetensors")).exists(), "a copy of what is there");

    // A model that what is written would replace, one of other classes, and precisions, of which a model has one.
    let rig = file("rig.safetensors");
    fs::copy(&model, &rig).unwrap();
    let line = refused(&rig, &["demo", "-o", &directory, "--model", &rig]);
    assert!(line.contains("--model and --output name the same file"), "{line}");
    let other = Place::ready();
    let small = other.text("model");
    let line = refused(&small, &["demo", "-o", &directory, "--model", &small]);
    assert!(line.contains("a network of 19 classes, expected the 17 of drawn streets"), "{line}");
    let output = voxcast(&["demo", "-o", &directory, "--model", &model, "--precision", "f16"]);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
}

#[cfg(not(feature = "shipped"))]
#[test]
fn the_demo_without_the_network_that_ships() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("demo").to_str().unwrap().to_owned();
    for precision in ["f32", "f16", "int8"] {
        let line = refused("--model FILE", &["demo", "-o", &directory, "--precision", precision]);
        assert!(line.contains("built without the network that ships"), "{line}");
    }
}

/// The data of a page.
fn page(path: &str) -> Value {
    let html = fs::read_to_string(path).unwrap();
    let (_, json) = html.split_once("<script type=\"application/json\" id=\"data\">").unwrap();
    serde_json::from_str(json.split_once("</script>").unwrap().0).unwrap()
}

#[test]
fn pages_of_results() {
    let place = tempfile::tempdir().unwrap();
    let file = |name: &str| place.path().join(name).to_str().unwrap().to_owned();
    let (classes, wide) = ([4u8; 24], [4u16; 24]);
    let bounds = [-2.0f32, 2.0, 0.0, 3.0, -1.0, 1.0];
    let array = |name, shape, elements| Array { name, shape, elements };
    let good = [
        array("classes", &[4, 3, 2], Elements::U8(&classes)),
        array("bounds", &[3, 2], Elements::F32(&bounds)),
        array("colours", &[8, 3], Elements::U8(&classes)),
    ];
    let out = file("out.npz");
    let write = |arrays: &[Array<'_>]| write_npz(Path::new(&out), arrays).unwrap();

    // Beside the result unless told otherwise; of another program, with the numbers of a network.
    write(&good);
    assert!(done(&["view", &out]).contains("out.html of "));
    let shown = page(&file("out.html"));
    assert_eq!(
        (&shown["classes"][3], &shown["support"]),
        (&json!({ "name": "class 3", "rgb": [4, 4, 4] }), &Value::Null)
    );
    assert_eq!(shown["bounds"], json!([[-2.0, 2.0], [0.0, 3.0], [-1.0, 1.0]]));
    // Of another program, with the numbers of a network, unless the file says others.
    let (network, json) = (network(), file("network.json"));
    fs::write(&json, network.to_json()).unwrap();
    let grid = network.output_grid();
    let many = vec![4u8; grid.iter().product()];
    let foreign = array("classes", &grid, Elements::U8(&many));
    write(&[foreign]);
    done(&["view", &out, "--network", &json]);
    let shown = page(&file("out.html"));
    assert_eq!((shown["classes"].as_array().unwrap().len(), &shown["bounds"]), (19, &json!(network.bounds)));
    fs::remove_file(file("out.html")).unwrap();

    for (arrays, expected) in [
        (vec![], "no array \"classes\", expected u8 [X, Y, Z]"),
        (vec![array("classes", &[4, 6], Elements::U8(&classes))], "\"classes\" is u8 [4, 6], expected u8 [X, Y, Z]"),
        (vec![array("classes", &[4, 3, 2], Elements::U16(&wide))], "\"classes\" is u16 [4, 3, 2]"),
        (vec![array("classes", &[4, 0, 2], Elements::U8(&[])), good[1], good[2]], "at least one voxel"),
        (good[..1].to_vec(), "no array \"bounds\", expected f32 [3, 2], or --network"),
        (good[..2].to_vec(), "no array \"colours\", expected u8 [K, 3], or --network"),
        (vec![good[0], array("bounds", &[2, 3], Elements::F32(&bounds)), good[2]], "\"bounds\" is f32 [2, 3]"),
        (vec![good[0], array("bounds", &[3, 2], Elements::F32(&[f32::NAN; 6])), good[2]], "bounds [NaN, NaN] on x"),
        (vec![good[0], good[1], array("colours", &[6, 4], Elements::U8(&classes))], "\"colours\" is u8 [6, 4]"),
        (vec![good[0], good[1], good[2], array("support", &[24], Elements::U16(&wide))], "\"support\" is u16 [24]"),
    ] {
        write(&arrays);
        let line = refused(&out, &["view", &out]);
        assert!(line.contains(expected), "{line}");
    }
    write(&[foreign, good[1], good[2]]);
    assert!(refused(&out, &["view", &out, "--network", &json]).contains("those of --network are"));
    write(&good);
    assert!(refused(&out, &["view", &out, "--network", &json]).contains("a grid of [4, 3, 2]"));
    write(&[good[0], good[1], array("colours", &[4, 3], Elements::U8(&classes[..12]))]);
    let line = refused(&out, &["view", &out]);
    assert!(line.contains("prediction: 24 voxels of class 4, the first at 0, expected 0 to 3"), "{line}");
    fs::write(&out, b"no zip").unwrap();
    refused(&out, &["view", &out]);
    refused(&file("none"), &["view", &file("none")]);
    write(&good);
    refused(&file("none"), &["view", &out, "--scene", &file("none")]);
    refused(&file("none"), &["view", &out, "--truth", &file("none")]);
    refused(&file("no/out.html"), &["view", &out, "-o", &file("no/out.html")]);
    let truth = file("truth.npz");
    write_npz(Path::new(&truth), &[array("classes", &[2, 3, 4], Elements::U8(&classes))]).unwrap();
    let line = refused(&truth, &["view", &out, "--truth", &truth]);
    assert!(line.contains("shape [2, 3, 4], expected [4, 3, 2]"), "{line}");
    assert!(!Path::new(&file("out.html")).exists(), "nothing is written on failure");
}

#[test]
fn an_imported_model_tests_the_machine() {
    let place = Place::ready();
    let model = place.text("model");
    let told = done(&["selftest", &model, "--threads", "3"]);
    assert!(told.contains("operations give what they must") && told.contains("3 threads"), "{told}");
    let report: Value = serde_json::from_str(&done(&["selftest", &model, "--json", "--isa", "scalar"])).unwrap();
    assert!(report["fault"].is_null() && report["operations"].as_u64().unwrap() > 100, "{report}");
    let [network, weights, plain] = ["network.json", "weights.pth", "plain"].map(|f| place.text(f));
    done(&["import", &weights, "--network", &network, "-o", &plain, "--no-self-test"]);
    assert!(refused(&plain, &["selftest", &plain]).contains("no self-test"));
}

#[test]
fn direct_sums_are_kept_or_transformed() {
    let place = Place::ready();
    let [network, weights, scene, exact, model] =
        ["network.json", "weights.pth", "scene", "exact", "transformed"].map(|f| place.text(f));
    done(&["import", &weights, "--network", &network, "--exact", "-o", &exact]);
    done(&["import", &exact, "-o", &model]);
    let told = |model: &str| -> Value { serde_json::from_str(&done(&["inspect", model, "--json"])).unwrap() };
    let [kept, used] = [&exact, &model].map(|model| told(model));
    assert_eq!((&kept["winograd_used"], &used["winograd_used"]), (&json!(false), &json!(true)));
    assert_eq!(
        (&kept["executed_multiply_adds"], &kept["multiply_adds"]),
        (&used["multiply_adds"], &used["multiply_adds"])
    );
    assert!(used["executed_multiply_adds"].as_u64() < used["multiply_adds"].as_u64());
    assert!(done(&["inspect", &model, "--operations"]).contains("conv3d F(4,3)"));
    assert!(!done(&["inspect", &exact, "--operations"]).contains("F(4,3)"));
    assert!(done(&["selftest", &model]).contains("give what they must"));
    let logits = |model: &str| -> Value {
        let arguments = ["run", "--model", model, &scene, "-o", &place.text("o.npz"), "--logits", "--json"];
        serde_json::from_str::<Value>(&done(&arguments)).unwrap()["logits_digest"].clone()
    };
    assert_ne!(logits(&exact), logits(&model), "other roundings");
    assert!(refused(&model, &["import", &model, "-o", &exact]).contains("already"));
    let output = voxcast(&["import", &weights, "-o", &place.text("none")]);
    assert_eq!((output.status.code(), place.path("none").exists()), (Some(2), false));
    assert!(text(&output.stderr).contains("--network, unless the checkpoint is a model"), "{}", text(&output.stderr));
}

#[test]
fn comparing_names_the_first_stage_that_differs() {
    let place = Place::ready();
    let [model, scene, out] = ["model", "scene", "out.npz"].map(|f| place.text(f));
    let [first, second] = ["first", "second"].map(|f| place.text(f));
    let run = |dump: &str, more: &[&str]| {
        let arguments = [&["run", "--model", &model, &scene, "-o", &out, "--dump", dump][..], more].concat();
        done(&arguments);
    };
    run(&first, &["--unfolded"]);
    run(&second, &["--unfolded", "--threads", "3"]);
    assert!(done(&["compare", &first, &second]).contains("agree"));
    assert!(done(&["compare", "--model", &model, &scene, "--against-isa", "scalar"]).contains("agree"));
    fs::remove_dir_all(place.path("second")).unwrap();
    run(&second, &["--unfolded", "--mask", "1"]);
    let output = voxcast(&["compare", &first, &second, "--common", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let table: Value = serde_json::from_slice(&output.stdout).unwrap();
    let stages = table["stages"].as_array().unwrap();
    let named = stages.iter().find(|s| s["diverges"] == true).unwrap();
    assert_eq!(table["first"], named["stage"], "{table}");
    assert_eq!(voxcast(&["compare", &first]).status.code(), Some(2));
    fs::write(place.path("no dump"), "no dump").unwrap();
    refused("no dump", &["compare", &first, &place.text("no dump")]);
}
