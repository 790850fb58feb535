//! Checkpoints as training writes them: what is in a file comes out of it, in row-major order.

use crate::pth::{self, Entry, Pickle, Tensor, Wrap, pth};
use half::{bf16, f16};
use proptest::prelude::*;
use std::collections::BTreeMap;
use voxcast::ErrorKind;
use voxcast::checkpoint::{Checkpoint, Dtype};

fn read(bytes: Vec<u8>) -> Checkpoint {
    Checkpoint::from_bytes(bytes).unwrap()
}

fn values(checkpoint: &Checkpoint, name: &str) -> Vec<f64> {
    let tensor =
        checkpoint.get(name).unwrap_or_else(|| panic!("no {name} in {:?}", checkpoint.names().collect::<Vec<_>>()));
    let f64s = tensor.to_f64().unwrap();
    assert_eq!(f64s.len(), tensor.len());
    assert_eq!(f64s.iter().map(|&v| v as f32).collect::<Vec<_>>(), tensor.to_f32().unwrap());
    f64s
}

/// Bytes of each value by `$to`.
macro_rules! le {
    ($($v:expr),*) => { [$(&$v.to_le_bytes()[..]),*].concat() };
}

/// Every element type: storage class, dtype, bytes of three elements, values.
fn dtypes() -> Vec<(&'static str, Dtype, Vec<u8>, [f64; 3])> {
    let h = f16::from_f64;
    let bf = bf16::from_f64;
    vec![
        ("DoubleStorage", Dtype::F64, le![1.5f64, -0.1f64, 1e30f64], [1.5, -0.1, 1e30]),
        ("FloatStorage", Dtype::F32, le![1.5f32, -2.0f32, 1e30f32], [1.5, -2.0, f64::from(1e30f32)]),
        ("HalfStorage", Dtype::F16, le![h(1.5), h(-65504.0), h(6e-8)], [1.5, -65504.0, f64::from(h(6e-8))]),
        ("BFloat16Storage", Dtype::Bf16, le![bf(1.5), bf(-3e38), bf(0.0)], [1.5, f64::from(bf(-3e38)), 0.0]),
        ("LongStorage", Dtype::I64, le![1i64 << 40, -7i64, 0i64], [(1i64 << 40) as f64, -7.0, 0.0]),
        ("IntStorage", Dtype::I32, le![i32::MIN, 7i32, 0i32], [f64::from(i32::MIN), 7.0, 0.0]),
        ("ShortStorage", Dtype::I16, le![i16::MIN, 7i16, 0i16], [-32768.0, 7.0, 0.0]),
        ("CharStorage", Dtype::I8, le![-128i8, 7i8, 0i8], [-128.0, 7.0, 0.0]),
        ("ByteStorage", Dtype::U8, le![255u8, 7u8, 0u8], [255.0, 7.0, 0.0]),
        ("BoolStorage", Dtype::Bool, le![1u8, 0u8, 255u8], [1.0, 0.0, 1.0]),
    ]
}

#[test]
fn every_element_type_in_every_wrapping_and_protocol() {
    let all = dtypes();
    let tensors: Vec<_> =
        all.iter().map(|(class, _, bytes, _)| (*class, Tensor::new(class, &[3], 3, bytes.clone()))).collect();
    for protocol in 2..=5 {
        for wrap in [Wrap::Runner, Wrap::Bare, Wrap::Dict] {
            let checkpoint = read(pth(protocol, wrap, &tensors));
            assert_eq!(checkpoint.len(), all.len());
            assert!(checkpoint.names().is_sorted());
            for (class, dtype, _, want) in &all {
                let tensor = checkpoint.get(class).unwrap();
                assert_eq!((tensor.name(), tensor.dtype(), tensor.shape()), (*class, *dtype, &[3usize][..]));
                assert_eq!(values(&checkpoint, class), want, "{class}, protocol {protocol}, {wrap:?}");
            }
        }
    }
}

#[test]
fn newer_element_types_come_with_untyped_storages() {
    let cases: [(&str, Dtype, Vec<u8>, Vec<f64>); 3] = [
        ("uint16", Dtype::U16, le![65535u16, 2u16], vec![65535.0, 2.0]),
        ("uint32", Dtype::U32, le![u32::MAX, 2u32], vec![f64::from(u32::MAX), 2.0]),
        ("uint64", Dtype::U64, le![u64::MAX, 2u64], vec![u64::MAX as f64, 2.0]),
    ];
    for (name, dtype, bytes, want) in cases {
        let len = bytes.len() as i64;
        let p = Pickle::new(2).raw(b"}").text("x").global("torch._utils", "_rebuild_tensor_v3").raw(b"(");
        let p = p.storage("UntypedStorage", "0", len).int(0).ints(&[2]).ints(&[1]).raw(b"\x89").ordered_dict();
        let p = p.global("torch", name).raw(b"tRs").stop();
        let checkpoint = read(pth::zip(&pth::entries(p, [&Tensor::new("", &[], 0, bytes)])));
        assert_eq!(checkpoint.get("x").unwrap().dtype(), dtype);
        assert_eq!(values(&checkpoint, "x"), want);
    }
}

#[test]
fn parameters_and_tensors_with_attributes_are_tensors() {
    let tensor = Tensor::f32(&[2], &[1.0, 2.0]);
    let p = Pickle::new(2).raw(b"}(").text("parameter");
    let p = p.global("torch._utils", "_rebuild_parameter").raw(b"(").tensor("0", &tensor).raw(b"\x88").ordered_dict();
    let p = p.raw(b"tR").text("attributes").global("torch._tensor", "_rebuild_from_type_v2").raw(b"(");
    let p = p.global("torch._utils", "_rebuild_tensor_v2").global("torch", "Tensor").raw(b"(");
    let p = p.storage("FloatStorage", "0", 2).int(1).ints(&[1]).ints(&[1]).raw(b"\x89").ordered_dict().raw(b"t");
    let p = p.raw(b"}").text("tag").int(1).raw(b"stR");
    // torch.Size is a tuple with a name.
    let p = p.text("sized").global("torch._utils", "_rebuild_tensor").raw(b"(").storage("FloatStorage", "0", 2).int(0);
    let p = p.global("torch", "Size").raw(b"(").ints(&[2, 1]).raw(b"tR").ints(&[1, 1]).raw(b"tRu").stop();
    let checkpoint = read(pth::zip(&pth::entries(p, [&tensor])));
    assert_eq!(values(&checkpoint, "parameter"), [1.0, 2.0]);
    assert_eq!(values(&checkpoint, "attributes"), [2.0]);
    assert_eq!(values(&checkpoint, "sized"), [1.0, 2.0]);
    assert_eq!(checkpoint.get("sized").unwrap().shape(), [2, 1]);
}

#[test]
fn views_are_read_by_their_strides() {
    let base: Vec<f32> = (0..24).map(|v| v as f32).collect();
    let view = |offset, shape: &[i64], stride: &[i64]| Tensor {
        offset,
        stride: stride.to_vec(),
        shape: shape.to_vec(),
        ..Tensor::f32(&[24], &base)
    };
    let cases: [(&str, Tensor, &[f64]); 8] = [
        ("transposed", view(0, &[2, 3], &[1, 2]), &[0.0, 2.0, 4.0, 1.0, 3.0, 5.0]),
        ("offset", view(20, &[2, 2], &[2, 1]), &[20.0, 21.0, 22.0, 23.0]),
        ("sliced", view(5, &[2, 2], &[12, 3]), &[5.0, 8.0, 17.0, 20.0]),
        ("diagonal", view(0, &[4], &[7]), &[0.0, 7.0, 14.0, 21.0]),
        ("channels_last", view(0, &[1, 2, 2, 2], &[8, 1, 4, 2]), &[0.0, 2.0, 4.0, 6.0, 1.0, 3.0, 5.0, 7.0]),
        ("expanded", view(3, &[2, 2], &[0, 1]), &[3.0, 4.0, 3.0, 4.0]),
        ("scalar", view(9, &[], &[]), &[9.0]),
        ("empty", view(99, &[0, 5], &[5, 1]), &[]),
    ];
    let tensors: Vec<_> = cases.iter().map(|(name, t, _)| (*name, t.clone())).collect();
    let checkpoint = read(pth(2, Wrap::Bare, &tensors));
    for (name, tensor, want) in cases {
        assert_eq!(values(&checkpoint, name), want, "{name}");
        let shape: Vec<i64> = checkpoint.get(name).unwrap().shape().iter().map(|&n| n as i64).collect();
        assert_eq!(shape, tensor.shape, "{name}");
        assert_eq!(checkpoint.get(name).unwrap().is_empty(), want.is_empty());
    }
}

proptest! {
    /// A stepped, permuted slice of a dense array gives the elements that indexing the array gives.
    #[test]
    fn any_view_of_an_array(
        (dims, start, step, order) in proptest::collection::vec(1usize..6, 1..5).prop_flat_map(|dims| {
            let start: Vec<_> = dims.iter().map(|&n| 0..n).collect();
            let step = proptest::collection::vec(1usize..4, dims.len());
            let order = Just((0..dims.len()).collect::<Vec<_>>()).prop_shuffle();
            (Just(dims), start, step, order)
        })
    ) {
        let numel: usize = dims.iter().product();
        let dense = |d: usize| dims[d + 1..].iter().product::<usize>();
        let len = |d: usize| (dims[d] - start[d]).div_ceil(step[d]);
        let shape: Vec<usize> = order.iter().map(|&d| len(d)).collect();
        let mut want = Vec::new();
        for flat in 0..shape.iter().product() {
            let mut rest: usize = flat;
            let mut at = 0;
            for (i, &d) in order.iter().enumerate().rev() {
                at += (start[d] + rest % shape[i] * step[d]) * dense(d);
                rest /= shape[i];
            }
            want.push(at as f64);
        }
        let data: Vec<f32> = (0..numel).map(|v| v as f32).collect();
        let tensor = Tensor {
            offset: (0..dims.len()).map(|d| start[d] * dense(d)).sum::<usize>() as i64,
            shape: shape.iter().map(|&n| n as i64).collect(),
            stride: order.iter().map(|&d| (dense(d) * step[d]) as i64).collect(),
            ..Tensor::f32(&[numel as i64], &data)
        };
        let checkpoint = read(pth(4, Wrap::Runner, &[("x", tensor)]));
        prop_assert_eq!(values(&checkpoint, "x"), want);
    }
}

#[test]
fn what_wrappers_put_in_front_is_taken_off_name_by_name() {
    let one = || Tensor::f32(&[1], &[1.0]);
    let names = |names: &[&str]| {
        let tensors: Vec<_> = names.iter().map(|name| (*name, one())).collect();
        let checkpoint = read(pth(2, Wrap::Bare, &tensors));
        assert_eq!(checkpoint.notes().is_empty(), checkpoint.names().eq(names.iter().copied()), "what is done is said");
        checkpoint.names().map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(names(&["module.a.w", "module.b"]), ["a.w", "b"]);
    assert_eq!(names(&["module.b", "steps"]), ["b", "steps"]);
    assert_eq!(names(&["model.module._orig_mod.b"]), ["b"]);
    assert_eq!(names(&["b", "module.b"]), ["b", "module.b"]);
    assert_eq!(names(&["module."]), ["module."]);
}

/// A dict of state dicts, each of one tensor, the first with the value 0, the next with 1, and so on.
fn states(keys: &[&str]) -> Vec<u8> {
    let mut p = Pickle::new(2).raw(b"}(");
    let tensors: Vec<_> = (0..keys.len()).map(|i| Tensor::f32(&[1], &[i as f32])).collect();
    for (i, (key, tensor)) in keys.iter().zip(&tensors).enumerate() {
        p = p.text(key).raw(b"}").text("w").tensor(&i.to_string(), tensor).raw(b"s");
    }
    pth::zip(&pth::entries(p.raw(b"u").stop(), &tensors))
}

#[test]
fn of_several_states_one_is_taken_and_the_others_are_named() {
    for (keys, value, said) in [
        (&["state_dict"][..], 0.0, None),
        (&["optimizer", "state_dict"], 1.0, None),
        (&["ema_state_dict", "state_dict"], 1.0, Some("under \"state_dict\"; not used: ema_state_dict")),
        (&["model"], 0.0, Some("under \"model\"")),
        (&["module", "optimizer"], 0.0, Some("under \"module\"")),
        (&["model_ema", "model_state_dict"], 1.0, Some("under \"model_state_dict\"; not used: model_ema")),
        (&["net", "model", "epoch"], 1.0, Some("under \"model\"; not used: net")),
    ] {
        let checkpoint = read(states(keys));
        assert_eq!(values(&checkpoint, "w"), [value], "{keys:?}");
        let notes: Vec<String> = checkpoint.notes().iter().map(ToString::to_string).collect();
        assert_eq!(notes.len(), usize::from(said.is_some()), "{notes:?}");
        assert!(notes.iter().all(|note| note.contains(said.unwrap_or_default())), "{notes:?}");
    }
    let error = Checkpoint::from_bytes(states(&["weights", "optimizer"])).unwrap_err();
    assert!(error.message().contains("its keys begin with \"weights\", \"optimizer\""), "{error}");
}

#[test]
fn what_was_not_asked_for_is_known() {
    let one = || Tensor::f32(&[1], &[1.0]);
    let checkpoint = read(pth(2, Wrap::Bare, &[("module.a.w", one()), ("module.b.w", one()), ("steps", one())]));
    assert_eq!(checkpoint.unused().collect::<Vec<_>>(), ["a.w", "b.w", "steps"]);
    checkpoint.get("a.w").unwrap();
    assert!(checkpoint.get("c.w").is_none());
    assert_eq!(checkpoint.unused().collect::<Vec<_>>(), ["b.w", "steps"]);
    assert_eq!(checkpoint.nearest("x.a.w"), ["a.w"]);
}

#[test]
fn files_without_a_zip_hold_the_same() {
    let all = dtypes();
    let tensors: Vec<_> =
        all.iter().map(|(class, _, bytes, _)| (*class, Tensor::new(class, &[3], 3, bytes.clone()))).collect();
    for wrap in [Wrap::Runner, Wrap::Bare, Wrap::Dict] {
        let checkpoint = read(pth::legacy(wrap, &tensors));
        for (class, dtype, _, want) in &all {
            assert_eq!(checkpoint.get(class).unwrap().dtype(), *dtype);
            assert_eq!(values(&checkpoint, class), want, "{class}, {wrap:?}");
        }
    }
    // torch writes None behind the length of a storage; a view of one, and a frame around the number of newer protocols.
    let tensor = Tensor { offset: 1, shape: vec![2], stride: vec![2], ..Tensor::f32(&[4], &[1.0, 2.0, 3.0, 4.0]) };
    let pickle = pth::pickle(2, Wrap::Dict, &[("w", tensor.clone())]);
    let at = pickle.windows(2).position(|w| w == b"tQ").unwrap();
    let with = |what: &[u8]| [&pickle[..at], what, &pickle[at..]].concat();
    let file = |pickle: Vec<u8>| pth::legacy_of(pickle, &[("0", 4, tensor.bytes.clone())]);
    let plain = file(with(b"N"));
    assert_eq!(values(&read(plain.clone()), "w"), [2.0, 4.0]);
    let framed = [&b"\x80\x04\x95\x0d\0\0\0\0\0\0\0"[..], &plain[2..]].concat();
    assert_eq!(values(&read(framed), "w"), [2.0, 4.0]);
    let message = |bytes: Vec<u8>| Checkpoint::from_bytes(bytes).unwrap_err().message().to_owned();
    let part = with(&Pickle::new(2).text("1").0[2..]);
    assert!(message(file(part)).contains("a storage that is a part of another"));
    for length in 0..plain.len() {
        assert!(Checkpoint::from_bytes(plain[..length].to_vec()).is_err(), "{length} of {} bytes", plain.len());
    }
    assert!(message([&plain[..], b"x"].concat()).contains("1 bytes behind the last storage"));
    let edit = |from: &[u8], to: &[u8]| {
        let at = plain.windows(from.len()).position(|w| w == from).unwrap();
        [&plain[..at], to, &plain[at + from.len()..]].concat()
    };
    for (bytes, expected) in [
        (edit(b"little_endian\x88", b"little_endian\x89"), "little_endian is False"),
        (edit(b"little_endian\x88", b"little_endiam\x88"), "does not say its byte order"),
        (edit(b"M\xe9\x03.", b"M\xe8\x03."), "version 1000 of torch.save's format, expected 1001"),
        (edit(b"\x04\0\0\0\0\0\0\0", b"\x05\0\0\0\0\0\0\0"), "5 elements of 4 bytes, 16 bytes are left"),
        (edit(b"\x04\0\0\0\0\0\0\0", b"\x03\0\0\0\0\0\0\0"), "4 bytes behind the last storage"),
        (edit(b"\x04\0\0\0\0\0\0\0", &[0xff; 8]), "-1 elements of 4 bytes"),
        (pth::legacy_of(with(b"N"), &[]), "no storage \"0\" behind the pickle"),
        (pth::legacy_of(with(b"N"), &[("0", 4, vec![0; 12])]), "declared are 4 elements"),
        (pth::legacy_of(with(b"N"), &[("0", 4, vec![0; 16]), ("0", 4, vec![0; 16])]), "it is there twice"),
        (pth::legacy_of(with(b"N"), &[("0", 4, vec![0; 16]), ("7", 4, vec![])]), "no tensor has it"),
    ] {
        let text = message(bytes);
        assert!(text.contains(expected), "{text} (expected {expected})");
    }
}

#[test]
fn tensors_that_mean_something_else_than_they_store_are_refused() {
    let tensor = Tensor::f32(&[2], &[1.0, 2.0]);
    let v2 = |metadata: &[u8]| {
        let p = Pickle::new(2).raw(b"}").text("w").global("torch._utils", "_rebuild_tensor_v2").raw(b"(");
        let p = p.storage("FloatStorage", "0", 2).int(0).ints(&[2]).ints(&[1]).raw(b"\x89").ordered_dict();
        pth::zip(&pth::entries(p.raw(metadata).raw(b"tRs").stop(), [&tensor]))
    };
    let negated = Pickle::new(2).raw(b"}").text("neg").raw(b"\x88s").0;
    assert_eq!(values(&read(v2(b"N")), "w"), [1.0, 2.0]);
    assert_eq!(values(&read(v2(b"}")), "w"), [1.0, 2.0]);
    let error = Checkpoint::from_bytes(v2(&negated[2..])).unwrap_err();
    assert!(error.kind() == ErrorKind::Unsupported && error.message().contains("marked to be negated"), "{error}");
    let of_class = |module: &str, class: &str| {
        let p = Pickle::new(2).raw(b"}").text("w").global("torch._tensor", "_rebuild_from_type_v2").raw(b"(");
        let p = p.global("torch._utils", "_rebuild_tensor_v2").global(module, class).raw(b"(");
        let p = p.storage("FloatStorage", "0", 2).int(0).ints(&[2]).ints(&[1]).raw(b"\x89").ordered_dict().raw(b"t");
        pth::zip(&pth::entries(p.raw(b"}tRs").stop(), [&tensor]))
    };
    assert_eq!(values(&read(of_class("torch.nn.parameter", "Parameter")), "w"), [1.0, 2.0]);
    let error = Checkpoint::from_bytes(of_class("torchao.dtypes", "AffineQuantizedTensor")).unwrap_err();
    assert!(error.message().contains("a tensor of class \"torchao.dtypes.AffineQuantizedTensor\""), "{error}");
}

#[test]
fn other_values_and_other_keys_are_ignored() {
    let tensor = Tensor::f32(&[1], &[5.0]);
    // {"ema_state_dict": {"other": t}, "state_dict": OrderedDict([("x", t), ("note", "text"), (3, t)])}
    let p = Pickle::new(2).raw(b"}(").text("ema_state_dict").raw(b"}").text("other").tensor("0", &tensor).raw(b"s");
    let p = p.text("state_dict").global("collections", "OrderedDict").raw(b"(](").raw(b"]").text("x").raw(b"a");
    let p = p.tensor("0", &tensor).raw(b"a").text("note").text("text").raw(b"\x86").int(3).tensor("0", &tensor);
    let p = p.raw(b"\x86etRu").stop();
    let checkpoint = read(pth::zip(&pth::entries(p, [&tensor])));
    assert_eq!(checkpoint.names().collect::<Vec<_>>(), ["x"]);
    assert_eq!(values(&checkpoint, "x"), [5.0]);
    assert!(checkpoint.get("note").is_none());
}

/// What mmengine's runner leaves beside the weights: log buffers, numpy values, paths, times.
#[test]
fn the_rest_of_a_runner_checkpoint_is_skipped() {
    let tensor = Tensor::f32(&[1], &[5.0]);
    for protocol in [2, 4] {
        let (reconstruct, array) = (("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"));
        let buffer = ("mmengine.logging.history_buffer", "HistoryBuffer");
        let p = Pickle::new(protocol).raw(b"}(").text("message_hub").global(buffer.0, buffer.1).raw(b")\x81");
        let p = p.raw(b"}(").text("statistics_methods").raw(b"}").text("min").global("__builtin__", "getattr");
        let p = p.global(buffer.0, buffer.1).text("min").raw(b"\x86Rs").text("_log_history");
        let p = p.global(reconstruct.0, reconstruct.1).global(array.0, array.1).raw(b"K\0\x85C\x01b\x87R(").int(1);
        let p = p
            .ints(&[1])
            .global("numpy", "dtype")
            .text("f8")
            .raw(b"\x89\x88\x87R(")
            .int(3)
            .text("<")
            .raw(b"NtbC\x01xtbub");
        let p = p
            .text("seed")
            .global("numpy.core.multiarray", "scalar")
            .raw(b"N")
            .global("_codecs", "encode")
            .text("\u{1}");
        let p =
            p.text("latin1").raw(b"\x86R\x86R").text("deque").global("collections", "deque").raw(b")\x8a\x01\x03\x86R");
        let p = p.raw(b"(").int(1).raw(b"e").text("set").raw(b"\x8f(").int(1).raw(b"\x90").text("default");
        let p =
            p.global("collections", "defaultdict").global("__builtin__", "list").raw(b"\x85R(").int(1).int(2).raw(b"u");
        let p = p.text("float").raw(b"G\0\0\0\0\0\0\0\0").text("mention").global("os", "system").text("path");
        let p =
            p.global("pathlib", "PosixPath").raw(b"(").text("/").raw(b"tR").text("long").raw(b"\x8a\x09").raw(&[1; 9]);
        let p = p.text("state_dict").raw(b"}").text("x").tensor("0", &tensor).raw(b"su").stop();
        let checkpoint = read(pth::zip(&pth::entries(p, [&tensor])));
        assert_eq!(values(&checkpoint, "x"), [5.0]);
    }
}

#[test]
fn deflated_archives_are_read() {
    let tensors = [("a", Tensor::f32(&[2, 2], &[1.0, 2.0, 3.0, 4.0])), ("b", Tensor::f32(&[1], &[5.0]))];
    let stored = pth::entries(pth::pickle(2, Wrap::Runner, &tensors), tensors.iter().map(|(_, t)| t));
    let deflated: Vec<_> = stored.iter().map(|e| Entry::deflated(&e.name, &e.bytes)).collect();
    let checkpoint = read(pth::zip(&deflated));
    assert_eq!(values(&checkpoint, "a"), [1.0, 2.0, 3.0, 4.0]);
    assert_eq!(values(&checkpoint, "b"), [5.0]);
}

#[test]
fn safetensors_hold_the_same() {
    let bytes = le![1.0f32, -2.0f32, 0.5f32, 4.0f32];
    let header = br#"{"module.w":{"dtype":"F32","shape":[2,2],"data_offsets":[0,16]},"module.n":{"dtype":"I64","shape":[],"data_offsets":[16,24]}}"#;
    let file = [&(header.len() as u64).to_le_bytes()[..], header, &bytes, &3i64.to_le_bytes()].concat();
    let checkpoint = read(file);
    assert_eq!(checkpoint.names().collect::<Vec<_>>(), ["n", "w"]);
    assert_eq!(values(&checkpoint, "w"), [1.0, -2.0, 0.5, 4.0]);
    assert_eq!(values(&checkpoint, "n"), [3.0]);
    assert_eq!(checkpoint.get("w").unwrap().shape(), [2, 2]);
}

#[test]
fn the_first_element_that_is_not_finite_is_named() {
    let long = le![0.0f64, 1e300f64];
    let half = le![f16::ONE, f16::ONE, f16::NEG_INFINITY, f16::NAN];
    let nan = [1.0, 2.0, 3.0, 4.0, 5.0, f32::NAN];
    let tensors = [
        ("nan", Tensor::f32(&[2, 3], &nan)),
        ("turned", Tensor { shape: vec![3, 2], stride: vec![1, 3], ..Tensor::f32(&[6], &nan) }),
        ("half", Tensor::new("HalfStorage", &[4], 4, half)),
        ("long", Tensor::new("DoubleStorage", &[2], 2, long)),
        ("complex", Tensor::new("ComplexFloatStorage", &[1], 1, vec![0; 8])),
    ];
    let checkpoint = read(pth(2, Wrap::Bare, &tensors));
    let message = |name: &str| checkpoint.get(name).unwrap().to_f32().unwrap_err().to_string();
    assert_eq!(message("nan"), "tensor \"nan\": element [1, 2] is NaN");
    assert_eq!(message("turned"), "tensor \"turned\": element [2, 1] is NaN");
    assert_eq!(message("half"), "tensor \"half\": element [2] is -inf");
    assert_eq!(message("long"), "tensor \"long\": element [1] is 1e300, beyond the range of f32");
    assert_eq!(checkpoint.get("long").unwrap().to_f64().unwrap(), [0.0, 1e300]);
    assert_eq!(checkpoint.get("nan").unwrap().to_f64().unwrap_err().to_string(), message("nan"));
    let complex = checkpoint.get("complex").unwrap();
    assert_eq!(complex.dtype(), Dtype::Other);
    assert_eq!(complex.to_f32().unwrap_err().kind(), ErrorKind::Unsupported);
}

#[test]
fn files_are_known_by_their_content() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("weights.safetensors");
    let message = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let error = Checkpoint::open(&path).unwrap_err();
        assert_eq!(error.path(), Some(&*path));
        (error.kind(), error.message().to_owned())
    };
    let tensors = [("a", Tensor::f32(&[1], &[5.0]))];
    std::fs::write(&path, pth(2, Wrap::Bare, &tensors)).unwrap();
    assert_eq!(values(&Checkpoint::open(&path).unwrap(), "a"), [5.0]);

    assert_eq!(message(b"").0, ErrorKind::Format);
    assert_eq!(
        message(b"hello").1,
        "begins with bytes [68, 65, 6c, 6c, 6f], expected a zip as torch.save writes it (PK\\x03\\x04), its older format, or a safetensors header"
    );
    assert_eq!(Checkpoint::open(dir.path().join("none")).unwrap_err().kind(), ErrorKind::Io);

    let with = |extra: Entry| {
        let mut entries = pth::entries(pth::pickle(2, Wrap::Bare, &tensors), tensors.iter().map(|(_, t)| t));
        entries.retain(|e| e.name != extra.name);
        entries.push(extra);
        pth::zip(&entries)
    };
    let refused = BTreeMap::from([
        ("archive/constants.pkl", ("", "a TorchScript archive; save the model's state_dict with torch.save")),
        ("archive/byteorder", ("big", "byteorder is \"big\", expected \"little\"; re-save on a little-endian machine")),
        ("archive/version", ("11\n", "archive version \"11\\n\", expected 1 to 10")),
    ]);
    for (name, (content, want)) in refused {
        let entry = Entry::new(name, content.as_bytes().to_vec());
        assert_eq!(message(&with(entry)), (ErrorKind::Unsupported, want.to_owned()));
    }
}

#[test]
fn views_may_be_read_from_several_threads() {
    let data: Vec<f32> = (0..5000).map(|v| v as f32).collect();
    let checkpoint = read(pth(2, Wrap::Bare, &[("a", Tensor::f32(&[5000], &data))]));
    let view = checkpoint.get("a").unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| assert_eq!(view.to_f32().unwrap(), data));
        }
    });
}
