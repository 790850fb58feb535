//! Checkpoints as damage and malice make them: an error that says what is wrong, or the right values; never anything else.

use crate::pth::{self, Entry, Pickle, Tensor, Wrap, pth_of};
use proptest::prelude::*;
use std::io::Write;
use voxcast::checkpoint::Checkpoint;
use voxcast::{Error, ErrorKind};

/// The error of a file that must be refused.
fn refused(bytes: Vec<u8>) -> Error {
    match Checkpoint::from_bytes(bytes) {
        Err(error) => error,
        Ok(checkpoint) => panic!("accepted: {:?}", checkpoint.names().collect::<Vec<_>>()),
    }
}

fn message(bytes: Vec<u8>) -> String {
    refused(bytes).to_string()
}

/// Reads every tensor of a file that may be refused anywhere.
fn read_all(bytes: Vec<u8>) -> voxcast::Result<Vec<(String, Vec<f64>)>> {
    let checkpoint = Checkpoint::from_bytes(bytes)?;
    let read = |name| {
        let tensor = checkpoint.get(name).expect("a listed name");
        tensor.to_f32()?;
        Ok((name.to_owned(), tensor.to_f64()?))
    };
    checkpoint.names().map(read).collect()
}

fn small() -> [(&'static str, Tensor); 2] {
    [("a", Tensor::f32(&[2, 2], &[1.0, -2.0, 3.5, 4.0])), ("b", Tensor::f32(&[1], &[5.0]))]
}

fn small_entries() -> Vec<Entry> {
    let tensors = small();
    pth::entries(pth::pickle(2, Wrap::Runner, &tensors), tensors.iter().map(|(_, t)| t))
}

/// Small valid files of all kinds: stored, deflated, safetensors.
fn small_files() -> [Vec<u8>; 3] {
    let header = br#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;
    let plain = [&(header.len() as u64).to_le_bytes()[..], header, &[0; 8]].concat();
    let deflated: Vec<_> = small_entries().iter().map(|e| Entry::deflated(&e.name, &e.bytes)).collect();
    [pth::zip(&small_entries()), pth::zip(&deflated), plain]
}

/// A pickle that begins with `middle` and then is `{"x": tensor}` if nothing went wrong.
fn with_tensor(middle: Pickle) -> Vec<u8> {
    let p = middle.raw(b"0").raw(b"}").text("x").tensor("0", &Tensor::f32(&[1], &[0.0; 16])).raw(b"s");
    pth_of(p.stop(), &["0"])
}

#[test]
fn every_truncation_is_an_error() {
    for file in small_files() {
        read_all(file.clone()).unwrap();
        for len in 0..file.len() {
            assert!(read_all(file[..len].to_vec()).is_err(), "cut to {len} of {} bytes", file.len());
        }
    }
}

#[test]
fn every_flipped_bit_is_an_error_or_harmless() {
    let [stored, deflated, plain] = small_files();
    for file in [stored, deflated] {
        let want = read_all(file.clone()).unwrap();
        let mut harmless = 0;
        for bit in 0..file.len() * 8 {
            let mut bad = file.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            if let Ok(got) = read_all(bad) {
                assert_eq!(got, want, "bit {bit}");
                harmless += 1;
            }
        }
        // Dates, versions, attributes and the like; everything else must have been noticed.
        assert!(harmless < file.len() * 8 / 4, "{harmless} flips of {} went unnoticed", file.len() * 8);
    }
    // No checksums here: a value may change, nothing else may happen.
    for bit in 0..plain.len() * 8 {
        let mut bad = plain.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        let _ = read_all(bad);
    }
}

#[test]
fn damaged_elements_are_noticed_when_they_are_read() {
    let tensors = small();
    let mut file = pth::zip(&small_entries());
    let at = file.windows(16).position(|w| w == tensors[0].1.bytes).unwrap();
    file[at] ^= 1;
    let checkpoint = Checkpoint::from_bytes(file).unwrap();
    let a = checkpoint.get("a").unwrap();
    for _ in 0..2 {
        let want = "tensor \"a\": its bytes do not have the CRC-32 that the archive states";
        assert_eq!(a.to_f32().unwrap_err().to_string(), want);
    }
    assert_eq!(checkpoint.get("b").unwrap().to_f32().unwrap(), [5.0]);
}

#[test]
fn a_pickle_that_calls_anything_is_refused_by_name() {
    let names = [
        ("posix", "system"),
        ("os", "system"),
        ("nt", "system"),
        ("builtins", "eval"),
        ("__builtin__", "exec"),
        ("builtins", "getattr"),
        ("builtins", "__import__"),
        ("subprocess", "Popen"),
        ("functools", "partial"),
        ("copyreg", "_reconstructor"),
        ("torch.storage", "_load_from_bytes"),
        ("torch.nn.modules.linear", "Linear"),
        ("collections", "OrderedDict.fromkeys"),
        ("torch", "load"),
        ("numpy", "load"),
        ("pickle", "loads"),
    ];
    for (module, name) in names {
        for protocol in [2, 4] {
            let p = || Pickle::new(protocol);
            let args = |p: Pickle| p.raw(b"(").text("echo").raw(b"t");
            let calls = [
                args(p().global(module, name)).raw(b"R"),
                args(p().global(module, name)).raw(b"\x81"),
                args(p().global(module, name)).raw(b"}\x92"),
                p().raw(b"(").global(module, name).text("echo").raw(b"o"),
                p().raw(b"(").text("echo").raw(format!("i{module}\n{name}\n").as_bytes()),
                // Handed to one of ours to be called.
                p().global("torch._tensor", "_rebuild_from_type_v2").raw(b"(").global(module, name).raw(b"N))tR"),
            ];
            for (i, call) in calls.into_iter().enumerate() {
                let text = message(with_tensor(call));
                let want =
                    format!("calls \"{module}.{name}\"; a checkpoint may only build tensors and plain containers");
                assert!(text.starts_with("data.pkl, byte ") && text.ends_with(&want), "call {i}: {text}");
            }
            // To name it is not to call it.
            read_all(with_tensor(p().global(module, name))).unwrap();
        }
    }
}

#[test]
fn the_message_tells_the_byte() {
    let p = Pickle::new(2).global("posix", "system").text("id").raw(b"\x85R.").0;
    let want = "data.pkl, byte 24: calls \"posix.system\"; a checkpoint may only build tensors and plain containers";
    assert_eq!(message(pth_of(p, &[])), want);
}

#[test]
fn other_ways_to_run_something_are_refused() {
    let p = || Pickle::new(2);
    let refusal = "; a checkpoint may only build tensors and plain containers";
    let cases = [
        (p().raw(b"\x82\x01"), "names extension 1, which only the writer's Python can resolve"),
        (p().raw(b"\x83\x01\x02"), "names extension 513, which only the writer's Python can resolve"),
        (p().raw(b"\x84\x01\0\0\0"), "names extension 1, which only the writer's Python can resolve"),
        (p().global("a", "B").raw(b"}b"), "sets the state of a class or function"),
        (p().raw(b"]}b"), "sets the state of a list"),
        // What a call returned, called; a string, called.
        (p().global("numpy", "dtype").raw(b")R)R"), "calls an object"),
        (p().text("posix.system").raw(b")R"), "calls a string"),
        // getattr of anything but the one class, or with a name that is not a string.
        (
            p().global("builtins", "getattr").global("os", "environ").text("get").raw(b"\x86R"),
            "calls \"builtins.getattr\"",
        ),
        (p().global("builtins", "getattr").raw(b"]").text("pop").raw(b"\x86R"), "calls \"builtins.getattr\""),
        (
            p().global("torch._tensor", "_rebuild_from_type_v2").raw(b"(").global("numpy", "dtype").raw(b"N)NtR"),
            "calls \"numpy.dtype\"",
        ),
        (p().raw(b"Pid\n"), "instruction 0x50, expected one of protocols 2 to 5"),
        (p().raw(b"\x97"), "instruction 0x97, expected one of protocols 2 to 5"),
    ];
    for (pickle, want) in cases {
        let text = message(with_tensor(pickle));
        assert!(text.contains(want), "{text}\nexpected {want}");
        assert_eq!(text.contains("calls"), text.ends_with(refusal), "{text}");
    }
}

#[test]
fn declared_lengths_are_checked_before_anything_is_allocated() {
    let huge32 = [0xff, 0xff, 0xff, 0x7f];
    let huge64 = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f];
    for op in [b'X', b'T', b'B', 0x8b] {
        let text = message(with_tensor(Pickle::new(4).raw(&[op]).raw(&huge32)));
        assert!(text.contains("declares 2147483647 bytes, "), "{op:#x}: {text}");
    }
    for op in [0x8d, 0x8e, 0x96] {
        let text = message(with_tensor(Pickle::new(5).raw(&[op]).raw(&huge64)));
        assert!(text.contains("declares 9223372036854775807 bytes, "), "{op:#x}: {text}");
    }
    let text = message(with_tensor(Pickle::new(4).raw(b"\x95").raw(&huge64)));
    assert!(text.contains("a frame of 9223372036854775807 bytes, "), "{text}");
    for op in [0x8c, b'U', b'C', 0x8a] {
        let text = message(pth_of(Pickle::new(4).raw(&[op, 200]).stop(), &[]));
        assert!(text.contains("declares 200 bytes, 1 are left"), "{op:#x}: {text}");
    }
    let text = message(with_tensor(Pickle::new(2).raw(b"Nr").raw(&huge32)));
    assert!(text.contains("writes memo 2147483647, the next one is 0"), "{text}");
    let text = message(with_tensor(Pickle::new(2).raw(b"j").raw(&huge32)));
    assert!(text.contains("reads memo 2147483647, which was not written"), "{text}");
}

#[test]
fn malformed_pickles_are_refused() {
    let p = || Pickle::new(2);
    let cases: [(Vec<u8>, &str); 22] = [
        (vec![], "ends in the middle of an instruction"),
        (p().0, "ends in the middle of an instruction"),
        (vec![0x80, 6, b'N', b'.'], "protocol 6, expected 2 to 5"),
        (vec![0x80, 1, b'N', b'.'], "protocol 1, expected 2 to 5"),
        (p().stop(), "takes a value from an empty stack"),
        (p().raw(b"NN").stop(), "stops with more than one value on its stack"),
        (p().raw(b"(N").stop(), "stops with more than one value on its stack"),
        (p().raw(b"N..").0, "stops 1 bytes before the end of the entry"),
        (p().raw(b"(\x85").stop(), "takes a value from an empty stack"),
        (p().raw(b"N(\x85").stop(), "takes a value from an empty stack"),
        (p().raw(b"t").stop(), "no mark on the stack"),
        (p().raw(b"}(Nu").stop(), "a key without its value"),
        (p().raw(b"(Nd").stop(), "a key without its value"),
        (p().raw(b"Na").stop(), "looks at an empty stack"),
        (p().raw(b"]NNs").stop(), "adds to a list"),
        (p().raw(b"}Na").stop(), "adds to a dict"),
        (p().raw(b"NNa").stop(), "adds to None"),
        (p().raw(b"cos").0, "a name without an end"),
        (p().int(1).int(2).raw(b"\x93").stop(), "a class whose name is not a string"),
        (p().raw(b"(o").stop(), "an object without a class"),
        (p().raw(b"NQ").stop(), "a persistent id, expected ('storage', class, key, location, length)"),
        (p().storage("FloatStorage", "0", -1).stop(), "a persistent id, expected"),
    ];
    for (pickle, want) in cases {
        let text = message(pth_of(pickle.clone(), &["0"]));
        assert!(text.contains(want), "{pickle:02x?}: {text}\nexpected {want}");
    }
    let text = message(pth_of(p().storage("MagicStorage", "0", 1).stop(), &["0"]));
    assert!(text.ends_with("a storage of class \"torch.MagicStorage\""), "{text}");
}

#[test]
fn arguments_of_the_wrong_kind_are_refused() {
    const UTILS: &str = "torch._utils";
    let call = |module: &str, name: &str, args: fn(Pickle) -> Pickle| {
        message(pth_of(args(Pickle::new(2).global(module, name).raw(b"(")).raw(b"tR").stop(), &["0"]))
    };
    fn storage(p: Pickle) -> Pickle {
        p.storage("FloatStorage", "0", 16)
    }
    let texts = [
        call(UTILS, "_rebuild_tensor_v2", |p| p),
        call(UTILS, "_rebuild_tensor_v2", |p| p.int(0).int(0).ints(&[1]).ints(&[1])),
        call(UTILS, "_rebuild_tensor_v2", |p| storage(p).text("0").ints(&[1]).ints(&[1])),
        call(UTILS, "_rebuild_tensor_v2", |p| storage(p).int(0).int(1).ints(&[1])),
        call(UTILS, "_rebuild_tensor_v2", |p| storage(p).int(0).ints(&[1]).raw(b"N")),
        call(UTILS, "_rebuild_tensor_v3", |p| storage(p).int(0).ints(&[1]).ints(&[1]).raw(b"NN").text("f")),
        call(UTILS, "_rebuild_parameter", |p| p.int(0)),
        call("torch._tensor", "_rebuild_from_type_v2", |p| p.global(UTILS, "_rebuild_tensor_v2").raw(b"N)")),
        call("torch", "Size", |p| p.int(0)),
        call("collections", "OrderedDict", |p| p.int(0)),
        call("collections", "OrderedDict", |p| p.raw(b"]Na")),
    ];
    for text in texts {
        assert!(text.contains("calls \"") && text.ends_with(" with arguments that it does not take"), "{text}");
    }
    let text = message(pth_of(Pickle::new(2).global("numpy", "dtype").raw(b"NR").stop(), &[]));
    assert!(text.ends_with("calls \"numpy.dtype\" with None, expected a tuple"), "{text}");
}

#[test]
fn depth_costs_no_stack() {
    const DEPTH: usize = 1_000_000;
    let nest = |open: &[u8], close: &[u8]| Pickle::new(2).raw(&open.repeat(DEPTH)).raw(b"N").raw(&close.repeat(DEPTH));
    for (open, close) in [(&b"]"[..], &b"a"[..]), (b"", b"\x85"), (b"}N", b"s"), (b"(", b"t")] {
        read_all(with_tensor(nest(open, close))).unwrap();
        let text = message(pth_of(nest(open, close).stop(), &[]));
        assert!(text.contains("expected a dict") || text.contains("no state_dict; it has no named keys"), "{text}");
    }
}

#[test]
fn cycles_do_not_hang() {
    // A list in itself, a dict as its own value, and a state dict that holds itself and a tensor.
    read_all(with_tensor(Pickle::new(2).raw(b"]q\0h\0a"))).unwrap();
    read_all(with_tensor(Pickle::new(2).raw(b"}q\0").text("x").raw(b"h\0s"))).unwrap();
    let p = Pickle::new(2).raw(b"}q\0(").text("state_dict").raw(b"h\0").text("x");
    let p = p.tensor("0", &Tensor::f32(&[1], &[0.0; 16])).raw(b"u").stop();
    assert_eq!(read_all(pth_of(p, &["0"])).unwrap(), [("x".to_owned(), vec![0.0])]);
    // A size that is in itself.
    let p = Pickle::new(2).raw(b"}").text("x").global("torch._utils", "_rebuild_tensor_v2").raw(b"(");
    let p = p.storage("FloatStorage", "0", 16).int(0).raw(b"]q\0h\0ah\0tRs").stop();
    assert_eq!(message(pth_of(p, &["0"])), "tensor \"x\": a size or stride that is a list, expected an int");
}

#[test]
fn one_list_cannot_be_copied_without_end() {
    // A list of 1000 pairs, made into a dict 1000 times.
    let p =
        Pickle::new(2).global("collections", "OrderedDict").raw(b"q\0](").raw(b"NN\x86q\x01".repeat(1000).as_slice());
    let p = p.raw(b"e\x85q\x02").raw(b"h\0h\x02R0".repeat(1000).as_slice());
    let error = refused(with_tensor(p.raw(b"R")));
    assert_eq!(error.kind(), ErrorKind::TooLarge);
    assert!(error.to_string().ends_with("copies more pairs than it has bytes"), "{error}");
}

#[test]
fn too_many_values_are_refused() {
    let p = Pickle::new(2).raw(b"(").raw(b"]".repeat(9_000_000).as_slice()).raw(b"t");
    let error = refused(with_tensor(p));
    assert_eq!(error.kind(), ErrorKind::TooLarge);
    assert!(error.to_string().ends_with("builds more than 8388608 values"), "{error}");
}

#[test]
fn bounds_of_every_tensor_are_checked_on_opening() {
    const BIG: i64 = i64::MAX;
    let cases: [(i64, &[i64], &[i64], &str); 16] = [
        (0, &[17], &[1], "leave its storage of 16 elements"),
        (16, &[1], &[1], "leave its storage of 16 elements"),
        (1, &[16], &[1], "leave its storage of 16 elements"),
        (0, &[2, 8], &[9, 1], "leave its storage of 16 elements"),
        (BIG, &[1], &[1], "leave its storage of 16 elements"),
        (BIG, &[3], &[BIG], "leave its storage of 16 elements"),
        (0, &[BIG], &[BIG], "leave its storage of 16 elements"),
        (1, &[2], &[BIG], "leave its storage of 16 elements"),
        (0, &[BIG, BIG], &[0, 0], "has more elements than its storage, 16, and than an expanded view may have, 65536"),
        (0, &[65537], &[0], "has more elements than its storage, 16, and than an expanded view may have, 65536"),
        (-1, &[1], &[1], "offset -1, expected 0 or more"),
        (0, &[-1], &[1], "a size or stride of -1, expected 0 or more"),
        (0, &[1], &[-1], "a size or stride of -1, expected 0 or more"),
        (0, &[1, 1], &[1], "shape [1, 1] and strides [1] have different lengths"),
        (0, &[1; 17], &[1; 17], "17 dimensions, expected at most 16"),
        (0, &[0, BIG, BIG], &[1, 1, 1], ""),
    ];
    for (offset, shape, stride, want) in cases {
        let tensor = Tensor { offset, shape: shape.into(), stride: stride.into(), ..Tensor::f32(&[16], &[0.0; 16]) };
        let file = pth::pth(2, Wrap::Runner, &[("fine", Tensor::f32(&[1], &[0.0])), ("x", tensor)]);
        if want.is_empty() {
            assert_eq!(read_all(file).unwrap()[1], ("x".to_owned(), vec![]));
            continue;
        }
        let text = message(file);
        assert!(text.starts_with("tensor \"x\": ") && text.ends_with(want), "{text}\nexpected {want}");
    }
}

#[test]
fn storages_have_the_declared_length() {
    let file = |tensor: Tensor| pth::pth(2, Wrap::Bare, &[("x", tensor)]);
    let sound = Tensor::f32(&[2], &[1.0, 2.0]);
    for numel in [0, 1, 3, 1 << 40, i64::MAX] {
        let text = message(file(Tensor { numel, shape: vec![1], ..sound.clone() }));
        let want = format!("tensor \"x\": its storage has 8 bytes, declared are {numel} elements of 4");
        assert_eq!(text, want);
    }
    let text = message(file(Tensor { class: "DoubleStorage", shape: vec![1], ..sound.clone() }));
    assert_eq!(text, "tensor \"x\": its storage has 8 bytes, declared are 2 elements of 8");
    for key in ["1", "../byteorder", "", "0/", "\u{0}"] {
        let p = Pickle::new(2).raw(b"}").text("x").tensor(key, &sound).raw(b"s").stop();
        let text = message(pth_of(p, &["0"]));
        assert!(text.starts_with("tensor \"x\": no zip entry \"archive/data/"), "{text}");
    }
}

#[test]
fn state_dicts_that_are_none() {
    let tensor = Tensor::f32(&[1], &[0.0; 16]);
    let p = || Pickle::new(2);
    let cases = [
        (p().raw(b"N"), "the checkpoint is None, expected a dict"),
        (p().tensor("0", &tensor), "the checkpoint is a tensor, expected a dict"),
        (p().raw(b"}"), "no state_dict; it has no named keys, expected state_dict or tensors by name"),
        (
            p().raw(b"}(").text("epoch").int(3).text("net").raw(b"}u"),
            "no state_dict; its keys begin with \"epoch\", \"net\", expected state_dict or tensors by name",
        ),
        (p().raw(b"}").text("state_dict").raw(b"]s"), "state_dict is a list, expected a dict"),
        (p().raw(b"}").text("state_dict").raw(b"}s"), "the state dict holds no tensors; it has no named keys"),
        (
            p().raw(b"}(").text("x").tensor("0", &tensor).text("x").tensor("0", &tensor).raw(b"u"),
            "two tensors are called \"x\"",
        ),
        (p().raw(b"}X\x01\0\0\0\xff").tensor("0", &tensor).raw(b"s"), "the state dict has a name that is not UTF-8"),
    ];
    for (pickle, want) in cases {
        assert_eq!(message(pth_of(pickle.stop(), &["0"])), want);
    }
}

/// The small file after `change`.
fn changed(change: impl FnOnce(&mut Vec<Entry>)) -> Vec<u8> {
    let mut entries = small_entries();
    change(&mut entries);
    pth::zip(&entries)
}

#[test]
fn archives_that_lie_are_refused() {
    read_all(changed(|_| ())).unwrap();
    let data = |entries: &[Entry]| entries.iter().position(|e| e.name == "archive/data/0").unwrap();
    let at = data(&small_entries());
    let cases: [(&str, Vec<u8>); 15] = [
        ("one name", changed(|e| e.push(e[at].clone()))),
        ("filename mismatch", changed(|e| e[at].offset = Some(0))),
        ("overlapping", changed(|e| (e[at].size, e[at].packed) = (40, 40))),
        ("zip: ", changed(|e| e[at + 1].offset = Some(3))),
        ("stored in 16 bytes, but 8 long", changed(|e| e[at].size = 8)),
        ("stored in 16 bytes, but 4294967294 long", changed(|e| e[at].size = u32::MAX - 1)),
        ("overlapping", changed(|e| (e[at].size, e[at].packed) = (1 << 30, 1 << 30))),
        ("encrypted, expected plain", changed(|e| e[at].flags |= 1)),
        ("compression ", changed(|e| e[at].method = 12)),
        ("compression ", changed(|e| e[at].method = 99)),
        ("two pickles, in \"archive/\" and in \"other/\"", changed(|e| e.push(Entry::new("other/data.pkl", vec![])))),
        ("a zip without a folder that holds data.pkl", changed(|e| drop(e.remove(0)))),
        ("data.pkl\": its bytes do not have the CRC-32", changed(|e| e[0].crc ^= 1)),
        ("byteorder\": its bytes do not have the CRC-32", changed(|e| e[1].crc ^= 1)),
        ("zip: ", [&b"PK\x03\x04"[..], &changed(|_| ())].concat()),
    ];
    for (want, file) in cases {
        let text = message(file);
        assert!(text.contains(want), "{text}\nexpected {want}");
    }
    assert!(read_all(changed(|e| e[at].crc ^= 1)).is_err(), "a wrong checksum of a tensor");
}

#[test]
fn inflation_is_bounded() {
    type Change = fn(&mut Entry);
    let tensors = small();
    let at = 2;
    let deflated = |change: Change| {
        changed(|e| {
            e[at] = Entry::deflated("archive/data/0", &tensors[0].1.bytes);
            change(&mut e[at]);
        })
    };
    assert_eq!(read_all(deflated(|_| ())).unwrap(), read_all(pth::zip(&small_entries())).unwrap());
    let cases: [(&str, Change); 5] = [
        ("inflates to 16 bytes or more, 17 declared", |e| e.size = 17),
        ("zip entry \"archive/data/0\": ", |e| e.size = 15),
        ("inflates to 4294967294 bytes; a file of ", |e| e.size = u32::MAX - 1),
        ("zip entry \"archive/data/0\": ", |e| e.crc ^= 1),
        ("zip entry \"archive/data/0\": ", |e| e.bytes[0] = 7),
    ];
    for (want, change) in cases {
        let text = message(deflated(change));
        assert!(text.contains(want), "{text}\nexpected {want}");
    }
    // 16 MiB of zeros in some kilobytes, as a tensor that is otherwise sound.
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
    let zeros = Tensor::new("ByteStorage", &[1 << 24], 1 << 24, vec![0; 1 << 24]);
    for entry in pth::entries(pth::pickle(2, Wrap::Bare, &[("x", zeros.clone())]), [&zeros]) {
        zip.start_file(entry.name, options).unwrap();
        zip.write_all(&entry.bytes).unwrap();
    }
    let file = zip.finish().unwrap().into_inner();
    assert!(file.len() < 1 << 16);
    let error = refused(file);
    assert_eq!(error.kind(), ErrorKind::TooLarge);
    assert!(error.to_string().contains("inflates to 16777216 bytes; a file of "), "{error}");
}

#[test]
fn malformed_safetensors_are_refused() {
    let file = |header: &str, data: usize| {
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &vec![0; data]].concat()
    };
    let entry = |dtype: &str, shape: &str, end: usize| {
        format!(r#"{{"x":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[0,{end}]}}}}"#)
    };
    read_all(file(&entry("F32", "[2]", 8), 8)).unwrap();
    for (header, data) in [
        (entry("F32", "[2]", 8), 7),
        (entry("F32", "[2]", 8), 9),
        (entry("F32", "[3]", 8), 8),
        (entry("F32", "[-2]", 8), 8),
        (entry("F33", "[2]", 8), 8),
        (entry("F32", "[4294967296,4294967296,4]", 0), 0),
        (entry("F32", "[1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1]", 4), 4),
        ("{".repeat(1000), 0),
        (r#"{"x":"#.repeat(1000), 0),
    ] {
        assert_eq!(refused(file(&header, data)).kind(), ErrorKind::Format, "{header}");
    }
    let long = [&(1u64 << 40).to_le_bytes()[..], b"{}"].concat();
    assert_eq!(refused(long).kind(), ErrorKind::TooLarge);
    let error = read_all(file(&entry("F8_E4M3", "[8]", 8), 8)).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Unsupported);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4096))]

    /// Any instructions in a sound archive: an error or tensors.
    #[test]
    fn any_pickle(body in proptest::collection::vec(instruction(), 0..40)) {
        let p = body.iter().fold(Pickle::new(2), |p, bytes| p.raw(bytes));
        let _ = read_all(pth_of(p.stop(), &["0"]));
    }
}

/// One instruction, mostly whole.
fn instruction() -> impl Strategy<Value = Vec<u8>> {
    let plain = b"(N)]}\x88\x89tld\x85\x86\x87aesu012R\x81\x92boQ\x8f\x90\x91\x93\x94.";
    let p = |p: Pickle| Just(p.0);
    prop_oneof![
        8 => proptest::sample::select(&plain[..]).prop_map(|op| vec![op]),
        3 => (proptest::sample::select(&b"qhK"[..]), 0u8..4).prop_map(|(op, n)| vec![op, n]),
        2 => proptest::sample::select(vec!["storage", "state_dict", "x", "0", "cpu"])
            .prop_map(|s| [&[b'X', s.len() as u8, 0, 0, 0], s.as_bytes()].concat()),
        1 => p(Pickle::new(2).global("torch", "FloatStorage")),
        1 => p(Pickle::new(2).global("torch._utils", "_rebuild_tensor_v2")),
        1 => p(Pickle::new(2).ordered_dict()),
        1 => p(Pickle::new(2).storage("FloatStorage", "0", 16)),
        2 => p(Pickle::new(2).tensor("0", &Tensor::f32(&[2, 2], &[0.0; 16]))),
        1 => proptest::collection::vec(any::<u8>(), 0..6),
    ]
}
