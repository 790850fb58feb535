//! The library for C as a user builds it, and programs linked to it.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

/// The two libraries for C.
pub(crate) struct Library {
    pub(crate) shared: PathBuf,
    pub(crate) archive: PathBuf,
}

/// Built once for all tests, by the command in the header but for the profile, into the target directory of this test:
/// most crates are there already.
pub(crate) static LIBRARY: LazyLock<Library> = LazyLock::new(|| {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("the target directory holds it");
    let cargo = std::env::var_os("CARGO").expect("cargo runs the tests");
    let mut command = Command::new(cargo);
    command
        .args(["rustc", "--lib", "--no-default-features", "--features", "capi", "--crate-type", "cdylib,staticlib"])
        .args(["--manifest-path", concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml"), "--message-format", "json"])
        .arg("--target-dir")
        .arg(target)
        // A sanitizer or a CPU that the tests are compiled for is none of a C program's.
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS");
    let output = run(&mut command);
    let files = files(&output.stdout);
    let find = |suffix: &str| {
        let found = files.iter().find(|f| f.extension() == Some(OsStr::new(suffix)));
        found.unwrap_or_else(|| panic!("no .{suffix} among {files:?}")).clone()
    };
    Library { shared: find(std::env::consts::DLL_EXTENSION), archive: find("a") }
});

/// The files that cargo's messages name for the package's library.
fn files(messages: &[u8]) -> Vec<PathBuf> {
    let artifacts = messages.split(|&byte| byte == b'\n').filter_map(|line| {
        let message: serde_json::Value = serde_json::from_slice(line).ok()?;
        let is_ours = message["reason"] == "compiler-artifact" && message["target"]["name"] == "voxcast";
        is_ours.then(|| message["filenames"].as_array().cloned())?
    });
    artifacts.flatten().filter_map(|file| file.as_str().map(PathBuf::from)).collect()
}

/// How a program is linked.
#[derive(Clone, Copy)]
pub(crate) enum Link {
    Shared,
    /// With the functions that allocate reached through `__wrap_*` if the program has them.
    Archive {
        wrapped: bool,
    },
}

/// Compiles a C file of the project, with every warning an error, into `directory`.
pub(crate) fn compile(source: &str, link: Link, directory: &Path) -> PathBuf {
    let program = directory.join(Path::new(source).file_stem().expect("a file name"));
    let mut command = tool("gcc", "gcc");
    command
        .args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-D_POSIX_C_SOURCE=200809L", "-g"])
        .arg(concat!("-I", env!("CARGO_MANIFEST_DIR"), "/include"))
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join(source))
        .arg("-o")
        .arg(&program);
    match link {
        Link::Shared => {
            let directory = LIBRARY.shared.parent().expect("a file in a directory");
            command.arg("-L").arg(directory).arg("-lvoxcast").arg(format!("-Wl,-rpath,{}", directory.display()));
        }
        Link::Archive { wrapped } => {
            if wrapped {
                let functions = ["malloc", "calloc", "realloc", "posix_memalign"];
                command.args(functions.map(|f| format!("-Wl,--wrap={f}")));
            }
            command.arg(&LIBRARY.archive).args(["-lpthread", "-ldl", "-lm"]);
        }
    }
    run(&mut command);
    program
}

/// A program of the system, which `package` brings.
pub(crate) fn tool(name: &str, package: &str) -> Command {
    let found = Command::new(name).arg("--version").output();
    if !found.is_ok_and(|output| output.status.success()) {
        panic!("`{name}` does not run: this test needs the package {package}");
    }
    Command::new(name)
}

/// `program` under valgrind, which ends with 99 if it finds an access to memory that is not the program's, a decision on
/// bytes that nobody wrote, or memory that is lost.
pub(crate) fn under_valgrind(program: &Path) -> Command {
    let mut command = tool("valgrind", "valgrind");
    command
        .args(["--quiet", "--error-exitcode=99", "--leak-check=full", "--show-leak-kinds=all"])
        .arg("--errors-for-leak-kinds=all")
        .arg(program);
    command
}

/// Runs `command`, which has to succeed.
pub(crate) fn run(command: &mut Command) -> Output {
    let output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{err}", output.status);
    output
}
