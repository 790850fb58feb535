//! What the registry promises of every kernel: the bits of the specification on every instruction set, and no step beyond
//! a slice. A read or write of one value too many ends the process with a segmentation fault.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::path::Path;
use voxcast_kernels::Isa;
#[cfg(all(target_arch = "x86_64", target_os = "linux", target_env = "gnu"))]
use voxcast_kernels::cases::carried_out;
use voxcast_kernels::cases::{Draw, Entry, Exact, Memory, Output, REGISTRY, agree, isas, isas_in_words};

/// Draws of each kernel.
const DRAWS: u64 = 200;

/// Runs the first [`DRAWS`] seeds that are not too much work. Returns how often a value was written, and how many finite
/// values there were, each once per draw.
fn all(entry: &Entry, memories: &[Memory]) -> [usize; 2] {
    let (mut outputs, mut telling) = (0, 0);
    let isas: Vec<_> = isas().collect();
    let mut cases = (0..).filter_map(|seed| (entry.draw)(&mut Draw::seeded(seed)));
    for _ in 0..DRAWS {
        let Output { values, codes } = agree(entry.name, &*cases.next().expect("seeds do not end"), &isas, memories);
        let finite = values.iter().filter(|v| v.is_finite()).map(|v| v.to_bits());
        outputs += values.len() + codes.len();
        telling += finite.collect::<BTreeSet<_>>().len() + codes.iter().collect::<BTreeSet<_>>().len();
    }
    [outputs, telling]
}

#[test]
fn every_isa_gives_the_bits_of_the_specification() {
    // Not `eprintln`, which the harness would keep to itself.
    writeln!(std::io::stderr(), "{} kernels are compared on: {}", REGISTRY.len(), isas_in_words())
        .expect("standard error");
    for entry in REGISTRY {
        let [outputs, telling] = all(entry, &[Memory::Heap]);
        assert!(telling > 200 && 50 * telling > outputs, "{}: {telling} of {outputs} outputs tell", entry.name);
    }
}

/// Where a signal handler carries out AVX-VNNI's instruction, it does so for every product of bytes: a body without would be
/// compared for nothing.
#[cfg(all(target_arch = "x86_64", target_os = "linux", target_env = "gnu"))]
#[test]
fn products_of_bytes_come_to_the_handler() {
    let Some(isa) = isas().find(|isa| Isa::parse(isa.name()).is_err()) else { return };
    for entry in REGISTRY {
        let before = carried_out();
        for case in (0..20).filter_map(|seed| (entry.draw)(&mut Draw::seeded(seed))) {
            case.run(isa, Memory::Heap);
        }
        let products = ["conv_i8", "deconv3d_i8", "deform_conv2d_i8", "head_i8"].contains(&entry.name);
        assert_eq!(carried_out() > before, products, "{}", entry.name);
    }
}

/// Of the kernels whose cases are `exact`; products and what is made of them have tests with f64 of their own.
#[test]
fn the_specification_agrees_with_f64() {
    let mut compared = Vec::new();
    for entry in REGISTRY {
        let mut values = 0;
        for case in (0..DRAWS).filter_map(|seed| (entry.draw)(&mut Draw::ordinary(seed))) {
            let Some(Exact { values: want, tolerance }) = case.exact() else { break };
            let got = case.run(Isa::Scalar, Memory::Heap).values;
            assert_eq!(got.len(), want.len(), "{}", entry.name);
            for (i, (&got, &want)) in got.iter().zip(&want).enumerate() {
                let error = (f64::from(got) - want).abs();
                assert!(error <= tolerance * (1.0 + want.abs()), "{}: value {i} is {got:e}, not {want:e}", entry.name);
            }
            values += want.len();
        }
        if values > 0 {
            assert!(values > 1000, "{}: {values} values", entry.name);
            compared.push(entry.name);
        }
    }
    for name in ["depthwise", "gate", "gather", "max_pool", "pool", "scale_shift", "upsample_add"] {
        assert!(compared.contains(&name), "{name}");
    }
}

#[cfg(unix)]
#[test]
fn no_kernel_leaves_its_slices() {
    for entry in REGISTRY {
        all(entry, &[Memory::Front, Memory::Back]);
    }
}

/// A file in `ops` that no line of the registry names would be tested by nothing here.
#[test]
fn every_kernel_is_in_the_registry() {
    let ops = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/ops");
    let files = std::fs::read_dir(ops).expect("the kernels' directory").map(|entry| entry.expect("an entry").path());
    let files: BTreeSet<String> = files
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .map(|path| path.file_stem().expect("a name").to_string_lossy().into_owned())
        .collect();
    let known: BTreeSet<String> = REGISTRY.iter().map(|entry| entry.name.to_owned()).collect();
    assert_eq!(files, known, "kernels/src/ops against the registry in kernels/src/ops.rs");
}

#[test]
fn every_kernel_has_a_bench() {
    for entry in REGISTRY {
        let benches = (entry.benches)();
        assert!(!benches.is_empty(), "{}", entry.name);
        for bench in benches {
            assert!(bench.bytes > 0, "{} {}", entry.name, bench.name);
        }
    }
}

/// The comparison that all of this rests on sees the last bit, the sign of zero, subnormals, NaN and every code.
#[test]
fn one_changed_bit_is_noticed() {
    let want = Output { values: vec![f32::NAN, 1.0, 0.0, f32::MIN_POSITIVE / 2.0, f32::INFINITY], codes: vec![7, 0] };
    assert_eq!(want.difference(&want), None);
    for (place, bit) in (0..want.values.len()).flat_map(|place| (0..32).map(move |bit| (place, bit))) {
        let mut got = want.clone();
        got.values[place] = f32::from_bits(got.values[place].to_bits() ^ 1 << bit);
        let alike = got.values[place].is_nan() && want.values[place].is_nan();
        assert_eq!(got.difference(&want).is_none(), alike, "{place} {bit}");
    }
    for place in 0..want.codes.len() {
        let mut got = want.clone();
        got.codes[place] ^= 1;
        assert!(got.difference(&want).is_some());
    }
    assert!(Output::from(&want.values[1..]).difference(&Output::from(&want.values[..])).is_some());
}

/// The guard itself: the kernel of the machine refuses to copy a byte from there into a pipe.
#[cfg(unix)]
#[test]
fn the_guard_cannot_be_read() {
    let mut pipe = [0; 2];
    // SAFETY: `pipe` has room for the two descriptors.
    assert_eq!(unsafe { libc::pipe(pipe.as_mut_ptr()) }, 0, "pipe failed");
    // SAFETY: the call checks the address itself, and fails where it cannot be read.
    let readable = |address: *const f32| unsafe { libc::write(pipe[1], address.cast(), 1) } == 1;
    for memory in [Memory::Front, Memory::Back] {
        let values = memory.filled(5, 1.0f32);
        let first = values.as_ptr();
        assert!(readable(first) && readable(first.wrapping_add(4)), "{memory:?}: the slice cannot be read");
        let beyond = if memory == Memory::Front { first.wrapping_sub(1) } else { first.wrapping_add(5) };
        assert!(!readable(beyond), "{memory:?}: the guard can be read");
    }
    for end in pipe {
        // SAFETY: the descriptors are open, and not used again.
        unsafe { libc::close(end) };
    }
}
