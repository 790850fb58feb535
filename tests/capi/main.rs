//! The library for C: the header says what the library has, the example is what it claims to be, and nothing that a
//! program may do wrong does harm. Needs gcc, g++, binutils and valgrind.

mod build;
mod header;
#[path = "../support/small.rs"]
#[allow(dead_code, reason = "other tests use the rest")]
mod small;
#[path = "../../src/capi/types.rs"]
#[allow(dead_code, reason = "the library uses the rest")]
mod types;

use build::{LIBRARY, Link, compile, run, tool, under_valgrind};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use voxcast::container::{self, Container, Data, Layout, Tensor};
use voxcast::graph::Rewrites;
use voxcast::weights::Precision;
use voxcast::{ImageView, Isa, Model, Session, SessionOptions, Threads, selftest};

/// Files for C programs, and the digest that they must find.
struct Files {
    directory: tempfile::TempDir,
    images: Vec<PathBuf>,
    size: [usize; 2],
    /// Bytes of a session with classes alone, of one that keeps logits, and of one that says how sure it is.
    memory: [usize; 3],
    digest: String,
    logits_digest: String,
}

impl Files {
    fn new(precision: Precision) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        let network = small::suited(small::tiny(), precision);
        std::fs::write(path("model"), small::model_bytes(&network, precision, Rewrites::ALL, 1)).unwrap();
        std::fs::copy(path("model"), path("mute")).unwrap();
        selftest::record(&path("model"), Isa::best(), &Threads::calling()).unwrap();
        damage_self_test(&path("model"), &path("faulty"));
        let model = Arc::new(Model::open(&path("model")).unwrap());
        let rig = small::rig(&network, 0.3);
        rig.save(&path("rig"), &network).unwrap();
        let images = small::Images::new(&network, 5);
        let images = images.views();
        let matrices: Vec<u8> =
            small::lidar2img(&network, 0.3).as_flattened().iter().flat_map(|v| v.to_ne_bytes()).collect();
        std::fs::write(path("matrices"), matrices).unwrap();
        std::fs::write(path("images"), images.iter().flat_map(|i| i.pixels).copied().collect::<Vec<u8>>()).unwrap();
        let options = SessionOptions { logits: true, ..SessionOptions::default() };
        let sure = SessionOptions { confidence: true, ..SessionOptions::default() };
        let memory = [&SessionOptions::default(), &options, &sure]
            .map(|options| Session::memory(&model, network.cameras, options).unwrap().total());
        let mut session = Session::new(model, rig, &options).unwrap();
        let result = session.run(&images).unwrap();
        Self {
            digest: format!("digest {:016x}", result.digest()),
            logits_digest: format!("of logits {:016x}", result.logits_digest().unwrap()),
            images: images.iter().enumerate().map(|(i, view)| ppm(&path(&format!("{i}.ppm")), view)).collect(),
            size: [images[0].height, images[0].width],
            memory,
            directory,
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// `command` with the arguments of `examples/infer.c`.
    fn infer<'a>(&self, command: &'a mut Command) -> &'a mut Command {
        command.arg(self.path("model")).arg(self.path("rig")).args(&self.images)
    }

    /// `command` with the arguments of `conformance.c`.
    fn conformance<'a>(&self, command: &'a mut Command) -> &'a mut Command {
        command.args(["model", "rig", "images"].map(|name| self.path(name)));
        command
            .args(self.size.map(|side| side.to_string()))
            .args(["matrices", "faulty", "mute"].map(|name| self.path(name)))
            .args(self.memory.map(|bytes| bytes.to_string()))
    }

    fn assert_digest(&self, command: &mut Command) -> String {
        let found = String::from_utf8(run(command).stdout).unwrap();
        assert!(found.contains(&self.digest), "{command:?}: {found}, expected {}", self.digest);
        found
    }
}

/// Copies a model and changes what its self-test says of the classes.
fn damage_self_test(from: &Path, to: &Path) {
    let model = Container::open(from).unwrap();
    let mut metadata = model.metadata().clone();
    let test = metadata.get_mut(selftest::KEY).unwrap();
    let mut value: selftest::SelfTest = serde_json::from_str(test).unwrap();
    value.classes = "0123456789abcdef".to_owned();
    *test = serde_json::to_string(&value).unwrap();
    let tensors = model.names().into_iter().map(|name| {
        let (dtype, shape, bytes) = model.tensor(&name).unwrap();
        Tensor { dtype, shape: shape.to_vec(), data: Data::Bytes(bytes), name }
    });
    container::write(to, tensors.collect(), &metadata, Layout::Aligned).unwrap();
}

/// Writes a binary PPM and says where.
fn ppm(path: &Path, image: &ImageView<'_>) -> PathBuf {
    let mut bytes = format!("P6\n{} {}\n255\n", image.width, image.height).into_bytes();
    bytes.extend(image.pixels.as_chunks().0.iter().flat_map(|[b, g, r]| [*r, *g, *b]));
    std::fs::write(path, bytes).unwrap();
    path.to_owned()
}

#[test]
fn the_example_gives_the_digest_of_a_rust_session() {
    for precision in [Precision::F32, Precision::I8] {
        let files = Files::new(precision);
        for link in [Link::Shared, Link::Archive { wrapped: false }] {
            let program = compile("examples/infer.c", link, files.directory.path());
            files.assert_digest(files.infer(&mut Command::new(&program)));
            files.assert_digest(files.infer(&mut under_valgrind(&program)));
        }
    }
}

#[test]
fn the_example_says_what_is_wrong() {
    let files = Files::new(Precision::F32);
    let program = compile("examples/infer.c", Link::Shared, files.directory.path());
    let bad = files.path("bad.ppm");
    std::fs::write(&bad, "P6 58 29 255\nshort").unwrap();
    let fails = |arguments: &[&Path], code: i32, says: &str| {
        let output = under_valgrind(&program).args(arguments).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(code) && said.contains(says), "{}: {said}", output.status);
    };
    let (model, rig, image) = (&files.path("model"), &files.path("rig"), &files.images[0]);
    fails(&[], 2, "usage: infer");
    fails(&[model, rig, &bad, image], 1, "bad.ppm: cannot read");
    fails(&[&bad, rig, image, image], 1, "bad.ppm: ");
    fails(&[model, rig, image], 1, "rig: ");
}

#[test]
fn every_promise_of_the_header_holds_natively_and_under_valgrind() {
    for precision in [Precision::F32, Precision::I8] {
        let files = Files::new(precision);
        let program = compile("tests/capi/conformance.c", Link::Archive { wrapped: true }, files.directory.path());
        for command in [&mut Command::new(&program), &mut under_valgrind(&program)] {
            let found = files.assert_digest(files.conformance(command));
            assert!(found.contains(&files.logits_digest), "{found}, expected {}", files.logits_digest);
        }
    }
}

/// Names that a library defines for others.
fn exported(command: &mut Command) -> BTreeSet<String> {
    let symbols = String::from_utf8(run(command).stdout).unwrap();
    let names = symbols.lines().filter_map(|line| line.split_once(" T ")).map(|(_, name)| name);
    names.filter(|name| name.starts_with("voxcast_")).map(str::to_owned).collect()
}

#[test]
fn the_libraries_export_what_the_header_declares() {
    let declared: BTreeSet<String> = header::functions().into_iter().collect();
    assert!(declared.len() > 20 && declared.contains("voxcast_abi"), "{declared:?}");
    let nm = || tool("nm", "binutils");
    let shared = exported(nm().args(["--dynamic", "--defined-only"]).arg(&LIBRARY.shared));
    assert_eq!(shared, declared, "shared library");
    let archive = exported(nm().args(["--extern-only", "--defined-only"]).arg(&LIBRARY.archive));
    assert_eq!(archive, declared, "archive");
}

#[test]
fn the_header_has_the_librarys_constants() {
    assert_eq!(header::defined("VOXCAST_ABI"), types::ABI);
    let statuses = types::Status::NAMES.map(|(status, name)| (name.to_str().unwrap().to_owned(), status as i32));
    let numbered = |names: &[&str], values: &[i32]| -> Vec<(String, i32)> {
        names.iter().zip(values).map(|(name, &value)| (format!("VOXCAST_{name}"), value)).collect()
    };
    let mut expected = statuses.to_vec();
    expected.extend(numbered(&["BGR", "RGB"], &types::ORDERS));
    expected.extend(numbered(&["UNLIMITED", "NANOSECONDS", "SLICES"], &types::BUDGETS));
    expected.extend(numbered(&["IDLE", "RUNNING", "COMPLETE"], &types::STEPS));
    assert_eq!(header::constants(), expected);
}

/// Where a struct's fields lie, a line each: name, first byte, bytes.
macro_rules! layout {
    ($name:literal, $struct:ident, [$($field:ident),*]) => {{
        // Does not compile if a field is left out.
        let sizes = |types::$struct { $($field),* }: types::$struct| [$(size_of_val(&$field)),*];
        // SAFETY: zeros are numbers and null pointers, of which the struct is made.
        let sizes = sizes(unsafe { std::mem::zeroed() });
        let places = [$((stringify!($field), std::mem::offset_of!(types::$struct, $field))),*];
        let mut lines = format!("{} 0 {}\n", $name, size_of::<types::$struct>());
        for ((field, place), size) in places.into_iter().zip(sizes) {
            writeln!(lines, "{}.{field} {place} {size}", $name).unwrap();
        }
        lines
    }};
}

#[test]
fn structs_lie_as_in_c() {
    let expected = [
        layout!("voxcast_network", Network, [size, cameras, classes, height, width, grid, voxels, bounds, checksum]),
        layout!("voxcast_options", Options, [size, isa, threads, logits, slice_cost, confidence, reserved]),
        layout!("voxcast_image", Image, [pixels, length, height, width, stride, order, reserved]),
        layout!("voxcast_camera", Camera, [image, age, masked, reserved]),
    ];
    let mut source = "#include <stdio.h>\n#include \"voxcast.h\"\nint main(void) {\n".to_owned();
    for (name, fields) in header::structs() {
        writeln!(source, "printf(\"{name} 0 %zu\\n\", sizeof({name}));").unwrap();
        for field in fields {
            let size = format!("sizeof((({name} *)0)->{field})");
            let print = format!("printf(\"{name}.{field} %zu %zu\\n\", offsetof({name}, {field}), {size});");
            writeln!(source, "{print}").unwrap();
        }
    }
    source += "}\n";
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("layout.c");
    std::fs::write(&file, source).unwrap();
    let program = compile(file.to_str().unwrap(), Link::Shared, directory.path());
    assert_eq!(String::from_utf8(run(&mut Command::new(program)).stdout).unwrap(), expected.concat());
}

#[test]
fn the_header_is_c99_and_cxx() {
    let header = concat!(env!("CARGO_MANIFEST_DIR"), "/include/voxcast.h");
    let strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only"];
    run(tool("gcc", "gcc").args(strict).args(["-std=c99", "-x", "c", header]));
    run(tool("g++", "g++").args(strict).args(["-std=c++11", "-x", "c++", header]));
}

/// The programs in the documentation.
fn fences(text: &str) -> Vec<&str> {
    let starts = text.split("\n```c\n").skip(1);
    starts.map(|rest| rest.split_once("\n```").expect("fences end").0).collect()
}

#[test]
fn programs_in_the_documentation_compile_and_link() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let directory = tempfile::tempdir().unwrap();
    let mut programs = 0;
    for page in ["README.md", "docs/embedding.md"] {
        let text = std::fs::read_to_string(root.join(page)).unwrap();
        for program in fences(&text) {
            let file = directory.path().join(format!("program_{programs}.c"));
            std::fs::write(&file, format!("{program}\n\nint main(void)\n{{\n    return 0;\n}}\n")).unwrap();
            compile(file.to_str().unwrap(), Link::Shared, directory.path());
            programs += 1;
        }
    }
    assert!(programs > 0);
}
