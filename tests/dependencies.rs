//! `docs/dependencies.md` against the manifests: every crate that they name, with its licence.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

/// Names of the crates that the package at `manifest` is built on, and licences of all packages that it knows.
fn dependencies(manifest: &str, package: &str) -> (BTreeSet<String>, BTreeMap<String, String>) {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["metadata", "--format-version", "1", "--all-features", "--locked", "--manifest-path"]);
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join(manifest);
    let output = cargo.arg(manifest).output().expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: Value = serde_json::from_slice(&output.stdout).expect("cargo writes JSON");
    let packages = metadata["packages"].as_array().expect("packages");
    let text = |value: &Value| value.as_str().expect("a text").to_owned();
    let own = packages.iter().find(|p| p["name"] == package).expect("the package is there");
    let names = own["dependencies"].as_array().expect("dependencies").iter();
    let names = names.filter(|d| d["kind"].is_null()).map(|d| text(&d["name"]));
    let licences = packages.iter().filter(|p| !p["license"].is_null());
    (names.collect(), licences.map(|p| (text(&p["name"]), text(&p["license"]))).collect())
}

#[test]
fn the_page_names_every_crate_and_its_licence() {
    let page = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/dependencies.md")).unwrap();
    let rows = page.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| crate"));
    let listed: BTreeMap<&str, &str> = rows
        .map(|row| {
            let cells: Vec<&str> = row.split('|').map(str::trim).collect();
            assert_eq!(cells.len(), 6, "{row}");
            (cells[1], cells[4])
        })
        .collect();
    let mut found = BTreeMap::new();
    for (manifest, package) in
        [("Cargo.toml", "voxcast"), ("Cargo.toml", "voxcast-kernels"), ("python/Cargo.toml", "voxcast-python")]
    {
        let (names, licences) = dependencies(manifest, package);
        for name in names.into_iter().filter(|name| !name.starts_with("voxcast")) {
            found.insert(name.clone(), licences[&name].clone());
        }
    }
    let found: BTreeMap<&str, &str> = found.iter().map(|(name, licence)| (&name[..], &licence[..])).collect();
    assert_eq!(found, listed);
}
