use super::*;
use std::io::Cursor;

fn floats() -> Vec<f32> {
    vec![0.0, -0.0, 1.5, f32::MIN_POSITIVE / 8.0, f32::INFINITY, -2.25]
}

fn write_sample(path: &Path) {
    let f = floats();
    let arrays = [
        Array { name: "classes", shape: &[2, 3, 2], elements: Elements::U8(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 255]) },
        Array { name: "logits", shape: &[6], elements: Elements::F32(&f) },
        Array { name: "scalar", shape: &[], elements: Elements::F32(&f[2..3]) },
        Array { name: "support", shape: &[3], elements: Elements::U16(&[0, 258, 65535]) },
        Array { name: "none", shape: &[0, 4], elements: Elements::U8(&[]) },
    ];
    write_npz(path, &arrays).unwrap();
}

fn sample() -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    write_sample(&path);
    std::fs::read(path).unwrap()
}

fn read(bytes: &[u8]) -> Result<Vec<OwnedArray>> {
    read_from(Cursor::new(bytes), bytes.len() as u64)
}

#[test]
fn round_trip_keeps_names_order_shapes_and_bits() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    write_sample(&path);
    let arrays = read_npz(&path).unwrap();
    let names: Vec<_> = arrays.iter().map(|a| (a.name.as_str(), a.shape.as_slice())).collect();
    assert_eq!(
        names,
        [("classes", &[2, 3, 2][..]), ("logits", &[6]), ("scalar", &[]), ("support", &[3]), ("none", &[0, 4])]
    );
    assert_eq!(arrays[3].elements, OwnedElements::U16(vec![0, 258, 65535]));
    assert_eq!(arrays[0].elements, OwnedElements::U8(vec![0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 255]));
    let OwnedElements::F32(found) = &arrays[1].elements else { panic!("expected floats") };
    let bits = |v: &[f32]| v.iter().map(|f| f.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(found), bits(&floats()));
    assert_eq!(sample(), sample(), "equal arrays give equal files");
}

#[test]
fn header_is_what_numpy_writes() {
    let header = npy_header("|u1", &[200, 200, 16]);
    assert_eq!(header.len(), 128);
    assert!(
        header.starts_with(
            b"\x93NUMPY\x01\x00\x76\x00{'descr': '|u1', 'fortran_order': False, 'shape': (200, 200, 16), }"
        )
    );
    assert_eq!(header.last(), Some(&b'\n'));
    assert!(String::from_utf8_lossy(&npy_header("<f4", &[7])[10..]).contains("'shape': (7,), }"));
    assert!(String::from_utf8_lossy(&npy_header("<f4", &[])[10..]).contains("'shape': (), }"));
}

#[test]
fn every_truncation_is_an_error() {
    let bytes = sample();
    for length in 0..bytes.len() {
        assert!(read(&bytes[..length]).is_err(), "{length} of {} bytes were accepted", bytes.len());
    }
}

#[test]
fn every_corrupted_byte_is_an_error_or_harmless() {
    let bytes = sample();
    let whole = read(&bytes).unwrap();
    let mut refused = 0;
    for at in 0..bytes.len() {
        let mut corrupt = bytes.clone();
        corrupt[at] ^= 0xff;
        match read(&corrupt) {
            Err(_) => refused += 1,
            // What a zip says twice, such as times and versions, may be wrong in one place, and an entry with another
            // name may be no array at all; elements may not be wrong.
            Ok(arrays) => assert!(
                arrays.iter().all(|a| whole.iter().any(|b| a.elements == b.elements && a.shape == b.shape)),
                "byte {at} changed the arrays unseen"
            ),
        }
    }
    assert!(refused > bytes.len() / 3, "only {refused} of {} corruptions were refused", bytes.len());
}

#[test]
fn headers_that_lie_are_refused() {
    for (literal, size, expected) in [
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", 4, "expected shape [2] of 4 bytes"),
        ("{'descr': '<f4', 'fortran_order': Maybe, 'shape': (1,), }", 4, "expected descr"),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (18446744073709551615, 2), }", 4, "expected shape"),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (-1,), }", 4, "expected descr"),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': 4, }", 4, "expected descr"),
        ("{'descr': '|u1', 'fortran_order': False}", 4, "expected descr"),
        ("", 4, "expected descr"),
    ] {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((literal.len() as u16).to_le_bytes());
        bytes.extend(literal.as_bytes());
        bytes.extend(vec![0u8; size]);
        let total = bytes.len() as u64;
        let error = read_array(&mut Cursor::new(bytes), total).unwrap_err();
        assert!(error.message().contains(expected), "{literal}: {error}");
    }
    let error = read_array(&mut Cursor::new(b"\x93NUMPY\x02\x00\xff\xff\xff\x7f"), 12).unwrap_err();
    assert!(error.message().contains("header of 2147483647 bytes"), "{error}");
    assert!(read_array(&mut Cursor::new(b"\x93NUMPY\x09\x00"), 8).is_err());
}

#[test]
fn arrays_that_cannot_be_written_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let array = |name, shape| Array { name, shape, elements: Elements::U8(&[1, 2, 3]) };
    for arrays in [
        &[array("", &[3])][..],
        &[array("a/b", &[3])],
        &[array("a\nb", &[3])],
        &[array("a", &[2])],
        &[array("a", &[usize::MAX, 3])],
        &[array("a", &[3]), array("a", &[3])],
    ] {
        let error = write_npz(&path, arrays).unwrap_err();
        assert_eq!((error.kind(), error.path()), (ErrorKind::Format, Some(path.as_path())));
        assert!(!path.exists());
    }
}

#[test]
fn integers_of_every_width() {
    let read = |descr: &str, shape: &[usize], bytes: &[u8]| {
        let file = [npy_header(descr, shape), bytes.to_vec()].concat();
        read_integers(&mut Cursor::new(&file), file.len() as u64)
    };
    for (descr, bytes, expected) in [
        ("|i1", &[0xff, 2][..], [-1, 2]),
        ("|u1", &[0xff, 2], [255, 2]),
        ("<i2", &[0xfe, 0xff, 0, 1], [-2, 256]),
        ("<u2", &[0xfe, 0xff, 0, 1], [65534, 256]),
        ("<i4", &[0xfe, 0xff, 0xff, 0xff, 0, 0, 1, 0], [-2, 65536]),
        ("<u4", &[0xfe, 0xff, 0xff, 0xff, 0, 0, 1, 0], [4_294_967_294, 65536]),
        ("<i8", &[0xfe, 255, 255, 255, 255, 255, 255, 255, 0, 0, 0, 0, 1, 0, 0, 0], [-2, 1 << 32]),
        ("<u8", &[7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0], [7, 1 << 32]),
    ] {
        assert_eq!(read(descr, &[1, 2], bytes).unwrap(), (vec![1, 2], expected.to_vec()), "{descr}");
        assert!(read(descr, &[1, 2], &bytes[1..]).is_err(), "{descr} cut");
        assert!(read(descr, &[3], bytes).is_err(), "{descr} of another shape");
    }
    for descr in [">i4", "<f4", "|b1", "|S4", "", "<i3", "ü1"] {
        let error = read(descr, &[1], &[0; 4]).unwrap_err();
        assert!(error.kind() == ErrorKind::Unsupported && error.message().contains("integers"), "{descr}: {error}");
    }
    let error = read("<u8", &[1], &[0xff; 8]).unwrap_err();
    assert!(error.message().contains("18446744073709551615"), "{error}");
    assert!(read("<i8", &[0, 4], &[]).unwrap().1.is_empty());
    assert!(read("<i8", &[usize::MAX, 4], &[]).is_err());
    let file = [npy_header("<i4", &[2, 1]), vec![0; 8]].concat();
    for at in 0..128 {
        let mut corrupt = file.clone();
        corrupt[at] ^= 0x41;
        // Padding and the version may be another.
        if let Ok((shape, numbers)) = read_integers(&mut Cursor::new(&corrupt), file.len() as u64) {
            assert_eq!(shape.iter().product::<usize>(), numbers.len(), "byte {at}");
        }
    }
}

/// An archive of `.npy` entries with these headers and as many bytes behind them, and of one entry more.
fn archive(entries: &[(&str, &str, usize)]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, literal, size) in entries {
        zip.start_file(*name, SimpleFileOptions::default()).unwrap();
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((literal.len() as u16).to_le_bytes());
        bytes.extend(literal.as_bytes());
        bytes.resize(bytes.len() + size, 7);
        zip.write_all(&bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

#[test]
fn what_nobody_needs_is_not_read_and_in_nobodys_way() {
    let wanted = ("classes.npy", "{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3), }", 6);
    for (literal, size, kind) in [
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 4), }", 128, "of type \"<f8\""),
        ("{'descr': '<i8', 'fortran_order': False, 'shape': (1,), }", 8, "of type \"<i8\""),
        ("{'descr': '<f2', 'fortran_order': False, 'shape': (2, 2), }", 8, "of type \"<f2\""),
        ("{'descr': '>f4', 'fortran_order': False, 'shape': (2,), }", 8, "of type \">f4\""),
        ("{'descr': '<U4', 'fortran_order': False, 'shape': (), }", 16, "of type \"<U4\""),
        ("{'descr': '|S3', 'fortran_order': False, 'shape': (2,), }", 6, "of type \"|S3\""),
        ("{'descr': '<c8', 'fortran_order': False, 'shape': (1,), }", 8, "of type \"<c8\""),
        ("{'descr': '<M8[ns]', 'fortran_order': False, 'shape': (1,), }", 8, "of type \"<M8[ns]\""),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (), }", 41, "of type \"|O\""),
        ("{'descr': [('x', '<f4'), ('y', '<f4')], 'fortran_order': False, 'shape': (1,), }", 8, "of type \"records\""),
        ("{'descr': '|u1', 'fortran_order': True, 'shape': (2, 2), }", 4, "in Fortran order"),
    ] {
        for entries in [[wanted, ("other.npy", literal, size)], [("other.npy", literal, size), wanted]] {
            let bytes = archive(&entries);
            let arrays = read(&bytes).unwrap_or_else(|e| panic!("{literal}: {e}"));
            let find = |name: &str| arrays.iter().find(|a| a.name == name).unwrap();
            assert_eq!(find("classes").elements, OwnedElements::U8(vec![7; 6]), "{literal}");
            assert_eq!(find("other").elements.kind(), kind);
            for length in 0..bytes.len() {
                assert!(read(&bytes[..length]).is_err(), "{literal}: {length} bytes");
            }
        }
    }
    // One axis is in both orders, and what is no .npy is no array.
    let line = archive(&[("a.npy", "{'descr': '|u1', 'fortran_order': True, 'shape': (3,), }", 3), ("b.txt", "", 3)]);
    let arrays = read(&line).unwrap();
    assert_eq!((arrays.len(), &arrays[0].elements), (1, &OwnedElements::U8(vec![7; 3])));
    let cut = archive(&[("a.npy", "{'descr': '<f4', 'fortran_order': True, 'shape': (2, 2), }", 15)]);
    assert_eq!(read(&cut).unwrap()[0].elements.kind(), "in Fortran order", "its length is nobody's concern");
}
