//! The reference on the command line: makes, dumps and compares golden cases. `tests/run` and docs/reference.md say when.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a program")]

use serde_json::Value;
use std::path::Path;
use std::process::ExitCode;
use voxcast_reference::cases::{self, Case, Row, Tolerance};
use voxcast_reference::gpu::Gpu;
use voxcast_reference::network::Stage;
use voxcast_reference::{Failure, cases::entries_apart};

const USAGE: &str = "\
usage: voxcast-reference adapter            names the Vulkan adapter
       voxcast-reference compare DIR...     runs golden cases and compares every stage with expected.safetensors
       voxcast-reference dump DIR -o OUT    runs a golden case and writes OUT/stages.safetensors
       voxcast-reference bless              rewrites tests/golden/reference

A golden case is a directory with network.json, scene.safetensors, checkpoint.safetensors or checkpoint.pth, and
expected.safetensors. Stages are computed with its expected matrices, if it has them.";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match arguments.as_slice() {
        ["adapter"] => adapter(),
        ["compare", directories @ ..] if !directories.is_empty() => compare(directories),
        ["dump", directory, "-o", out] => dump(directory, out),
        ["bless"] => bless(),
        ["--help" | "-h"] => {
            println!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(failure) => {
            eprintln!("error: {failure}");
            ExitCode::FAILURE
        }
    }
}

fn adapter() -> Result<bool, Failure> {
    let gpu = Gpu::open()?;
    println!("{}, {}", gpu.adapter(), gpu.driver());
    Ok(true)
}

fn compare(directories: &[&str]) -> Result<bool, Failure> {
    let gpu = Gpu::open()?;
    let tolerance = Tolerance::of(&cases::golden())?;
    let mut good = true;
    for directory in directories {
        let case = Case::open(Path::new(directory))?;
        let expected = case.expected()?;
        println!("{directory}: differences over the stage's rms; of integers, count and share");
        println!("{:24} {:>9} {:>10} {:>10}", "stage", "elements", "max", "rms");
        let rows = cases::compare(&case.run(&gpu, Some(&expected))?, &expected, tolerance)?;
        rows.iter().for_each(|row| println!("{row}"));
        good &= rows.iter().all(|row| row.fits);
        for (level, (own, theirs)) in case.matrices(&gpu).iter().zip(cases::matrices(&expected)?).enumerate() {
            for (kind, (a, b)) in ["volume", "bev"].into_iter().zip(own.iter().zip(&theirs)) {
                let (apart, all) = entries_apart(a, b);
                println!("level {} {kind} matrix: {apart} of {all} entries differ", level + 1);
            }
        }
    }
    Ok(good)
}

fn dump(directory: &str, out: &str) -> Result<bool, Failure> {
    let gpu = Gpu::open()?;
    let case = Case::open(Path::new(directory))?;
    let expected = case.expected().ok();
    let stages = case.run(&gpu, expected.as_deref())?;
    std::fs::create_dir_all(out).map_err(|e| Failure(format!("{out}: cannot create: {e}")))?;
    cases::write_stages(&Path::new(out).join("stages.safetensors"), &stages)?;
    println!("{} stages to {out}", stages.len());
    Ok(true)
}

fn bless() -> Result<bool, Failure> {
    let gpu = Gpu::open()?;
    let own = cases::own();
    for (name, stages) in
        [("operations", cases::operation_stages(&gpu)), ("operations_i8", cases::operation_i8_stages(&gpu))]
    {
        let path = own.join(format!("{name}.safetensors"));
        report(name, &stages, cases::read_stages(&path).ok().as_deref());
        cases::write_stages(&path, &stages)?;
    }
    let mut manifest = cases::manifest(&own)?;
    for (case, entry) in Case::listed(&own)?.iter().zip(manifest["cases"].as_array().into_iter().flatten()) {
        let left_out = entry["left_out"].as_array().into_iter().flatten().filter_map(Value::as_str);
        let before = case.expected().ok();
        case.bless(&gpu, &left_out.collect::<Vec<_>>())?;
        report(&case.name, &case.expected()?, before.as_deref());
        if entry["int8"].as_bool() == Some(true) {
            let before = case.expected_i8().ok();
            case.bless_i8(&gpu)?;
            report(&format!("{} in 8 bits", case.name), &case.expected_i8()?, before.as_deref());
        }
    }
    manifest["adapter"] = gpu.adapter().into();
    manifest["driver"] = gpu.driver().into();
    let text = serde_json::to_string_pretty(&manifest).map_err(|e| Failure(e.to_string()))?;
    let path = own.join("manifest.json");
    std::fs::write(&path, text + "\n").map_err(|e| Failure(format!("{}: {e}", path.display())))?;
    Ok(true)
}

/// Says how far the new stages are from those that were there.
fn report(name: &str, stages: &[Stage], before: Option<&[Stage]>) {
    let changed = before.map(|before| cases::compare(stages, before, Tolerance::NONE));
    match changed {
        None => println!("{name}: {} stages, new", stages.len()),
        Some(Err(failure)) => println!("{name}: {} stages, of other shapes: {failure}", stages.len()),
        Some(Ok(rows)) => {
            let changed: Vec<&Row> = rows.iter().filter(|row| !row.fits).collect();
            println!("{name}: {} stages, {} changed", stages.len(), changed.len());
            changed.iter().for_each(|row| println!("{row}"));
        }
    }
}
