//! The golden files made anew on the adapter that is here, and the reference against PyTorch. Without an adapter these fail
//! and say what to install.

use voxcast_reference::cases::{self, Case, Row, Tolerance, entries_apart};
use voxcast_reference::gpu::Gpu;
use voxcast_reference::network::Stage;

fn gpu() -> Gpu {
    Gpu::open().unwrap_or_else(|failure| panic!("{failure}"))
}

fn table(name: &str, rows: &[Row]) -> String {
    let lines = rows.iter().map(|row| format!("{row}\n")).collect::<String>();
    format!("{name}: differences over the stage's rms; of integers, count and share\n{lines}")
}

/// Every stage of `case` within the tolerance, with the expected matrices; the reference's own within `entries`.
fn check(gpu: &Gpu, case: &Case, tolerance: Tolerance, entries: f64) {
    let expected = case.expected().unwrap();
    let found = case.run(gpu, Some(&expected)).unwrap();
    let rows = cases::compare(&found, &expected, tolerance).unwrap();
    assert!(rows.len() > 40, "{}: {} stages show little", case.name, rows.len());
    assert!(rows.iter().all(|row| row.fits), "{}", table(&case.name, &rows));
    for (own, theirs) in case.matrices(gpu).iter().flatten().zip(cases::matrices(&expected).unwrap().iter().flatten()) {
        let (apart, all) = entries_apart(own, theirs);
        assert!(apart as f64 <= entries * all as f64, "{}: {apart} of {all} entries differ", case.name);
    }
}

fn share_of_entries(manifest: &serde_json::Value) -> f64 {
    manifest["tolerance"]["entries"]["share"].as_f64().unwrap()
}

#[test]
fn operations_are_regenerated() {
    let own = cases::own();
    let expected = cases::read_stages(&own.join("operations.safetensors")).unwrap();
    let manifest = cases::manifest(&own).unwrap();
    let found = cases::operation_stages(&gpu());
    assert_eq!(found.len(), expected.len());
    let (attention, others): (Vec<Stage>, Vec<Stage>) =
        expected.into_iter().partition(|stage| stage.name.starts_with("attention."));
    for (kind, expected) in [("attention", attention), ("operation", others)] {
        assert!(!expected.is_empty());
        let rows = cases::compare(&found, &expected, Tolerance::named(&manifest, kind).unwrap()).unwrap();
        assert!(rows.iter().all(|row| row.fits), "{}", table(kind, &rows));
    }
}

#[test]
fn operations_on_bytes_are_regenerated_without_tolerance() {
    let expected = cases::read_stages(&cases::own().join("operations_i8.safetensors")).unwrap();
    let found = cases::operation_i8_stages(&gpu());
    assert_eq!(found.len(), expected.len());
    let rows = cases::compare(&found, &expected, Tolerance::NONE).unwrap();
    assert!(rows.iter().all(|row| row.fits), "{}", table("8 bits", &rows));
}

#[test]
fn networks_are_regenerated() {
    let own = cases::own();
    let manifest = cases::manifest(&own).unwrap();
    let gpu = gpu();
    for case in Case::listed(&own).unwrap() {
        check(&gpu, &case, Tolerance::named(&manifest, "f32").unwrap(), share_of_entries(&manifest));
    }
}

/// Every stage of integers, the logits and the classes are equal; what stays in f32 is within the tolerance of f32.
#[test]
fn networks_in_integers_are_regenerated_without_tolerance() {
    let own = cases::own();
    let tolerance = Tolerance::named(&cases::manifest(&own).unwrap(), "f32").unwrap();
    let gpu = gpu();
    let cases: Vec<Case> = Case::listed(&own).unwrap().into_iter().filter(Case::has_i8).collect();
    assert!(cases.len() >= 2);
    for case in cases {
        let expected = case.expected_i8().unwrap();
        let found = case.run_i8(&gpu, &case.expected().unwrap()).unwrap();
        let [floats, equal]: [Vec<Stage>; 2] = [true, false].map(|float| {
            let is_float = |s: &&Stage| s.dtype == safetensors::Dtype::F32 && !s.name.starts_with("logits.");
            expected.iter().filter(|s| is_float(s) == float).cloned().collect()
        });
        assert!(equal.len() > 30, "{}: {} stages of integers show little", case.name, equal.len());
        for (expected, tolerance) in [(floats, tolerance), (equal, Tolerance::NONE)] {
            let rows = cases::compare(&found, &expected, tolerance).unwrap();
            assert!(rows.iter().all(|row| row.fits), "{}", table(&case.name, &rows));
        }
    }
}

#[test]
fn networks_agree_with_pytorch() {
    let golden = cases::golden();
    let tolerance = Tolerance::of(&golden).unwrap();
    let share = share_of_entries(&cases::manifest(&cases::own()).unwrap());
    let gpu = gpu();
    for case in Case::listed(&golden).unwrap() {
        check(&gpu, &case, tolerance, share);
    }
}

#[test]
fn a_changed_number_is_noticed() {
    let stage = |name: &str, values: &[f32]| Stage {
        name: name.to_owned(),
        dtype: safetensors::Dtype::F32,
        shape: vec![values.len()],
        bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
    };
    let tolerance = Tolerance { max: 1e-2, rms: 1e-2, classes: 1.0 };
    let fits = |found: &[f32]| {
        let rows = cases::compare(&[stage("x", found)], &[stage("x", &[1.0, -2.0, 3.0])], tolerance).unwrap();
        rows.iter().all(|row| row.fits)
    };
    assert!(fits(&[1.0, -2.0, 3.0]) && fits(&[1.0, -2.0, 3.01]));
    assert!(!fits(&[1.0, -2.0, 3.1]) && !fits(&[1.0, f32::NAN, 3.0]));
    assert!(cases::compare(&[], &[stage("x", &[1.0])], tolerance).is_err());
    assert!(cases::compare(&[stage("x", &[1.0, 2.0])], &[stage("x", &[1.0])], tolerance).is_err());
}
