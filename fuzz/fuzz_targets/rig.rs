//! Any numbers as a rig: an error, or matrices that a session can use.
//!
//! The input edits the matrices of a sound rig, five or more bytes at a time. Taken as a whole file it is tried too.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::cell::RefCell;
use std::sync::Arc;
use voxcast::container::Container;
use voxcast::rig::RigBuilder;
use voxcast::{Isa, Rig, Session, SessionOptions};
use voxcast_fuzz::{images, model, network, sealed, split, views};

const CAMERAS: usize = 2;

/// Names and numbers of a sound rig's twelve tensors.
fn sound() -> Vec<(String, Vec<u32>)> {
    let camera = [20., 0., 8., 30., 0., 20., 0., 15., 0.1, 0., 0.5, 1., 0., 0., 0., 1.];
    let other = [-20., 5., 8., 30., 0., -20., 0., 15., 0.1, 0., -0.5, 1., 0., 0., 0., 1.];
    let mut builder = RigBuilder::new(&network(), CAMERAS, voxcast::Isa::best()).expect("a small network");
    let rig = builder.build(&[camera, other]).expect("a small rig");
    let mut tensors = vec![];
    for l in 0..3 {
        let level = rig.level(l);
        for (name, words) in [
            ("volume.ptr", level.volume.ptr),
            ("volume.col", level.volume.col),
            ("bev.ptr", level.bev.ptr),
            ("bev.col", level.bev.col),
        ] {
            tensors.push((format!("level{}.{name}", l + 1), words.to_vec()));
        }
    }
    tensors
}

/// Applies one edit and returns the rest of the input.
fn edit<'a>(tensors: &mut [(String, Vec<u32>)], input: &'a [u8]) -> Option<&'a [u8]> {
    let (&[which, how, a, b, c], rest) = input.split_first_chunk()?;
    let count = tensors.len();
    let words = &mut tensors[usize::from(which) % count].1;
    let at = usize::from(u16::from_le_bytes([a, b])) % words.len().max(1);
    let value = u32::from(c);
    match how % 8 {
        0 if !words.is_empty() => words[at] = value,
        1 if !words.is_empty() => words[at] = words[at].wrapping_add(value),
        2 if !words.is_empty() => words[at] = words[at].wrapping_sub(value),
        3 if !words.is_empty() => words[at] = u32::MAX - value,
        4 => words.insert(at, value),
        5 if !words.is_empty() => drop(words.remove(at)),
        6 => words.truncate(at),
        // An entry more in one row: the row pointers that follow move with it.
        7 if which % 2 == 1 => {
            words.insert(at, value);
            let ptr = &mut tensors[usize::from(which - 1) % count].1;
            ptr.iter_mut().filter(|end| **end as usize > at).for_each(|end| *end = end.wrapping_add(1));
        }
        _ => {}
    }
    Some(rest)
}

fn file(tensors: &[(String, Vec<u32>)]) -> Vec<u8> {
    let (mut header, mut data) = (String::new(), vec![]);
    for (name, words) in tensors {
        let from = data.len();
        data.extend(words.iter().flat_map(|w| w.to_le_bytes()));
        let comma = if header.is_empty() { '{' } else { ',' };
        let (len, to) = (words.len(), data.len());
        header += &format!("{comma}\"{name}\":{{\"dtype\":\"U32\",\"shape\":[{len}],\"data_offsets\":[{from},{to}]}}");
    }
    header.push('}');
    sealed(header.as_bytes(), &data)
}

fn session(rig: Arc<Rig>) -> Session {
    let options = SessionOptions { isa: Isa::best(), ..SessionOptions::default() };
    Session::new(model(), rig, &options).expect("a rig of the network")
}

fn try_file(bytes: Vec<u8>) {
    thread_local! { static SESSION: RefCell<Option<Session>> = const { RefCell::new(None) } }
    let Ok(container) = Container::from_bytes(bytes) else { return };
    let Ok(rig) = Rig::from_container(container, &network(), CAMERAS) else { return };
    let rig = Arc::new(rig);
    SESSION.with_borrow_mut(|cell| {
        let session = cell.get_or_insert_with(|| session(rig.clone()));
        session.set_rig(rig).expect("a rig of the network");
        let pixels = images(&network(), CAMERAS);
        let result = session.run(&views(&network(), &pixels)).expect("images of the network's size");
        assert!(result.classes.iter().all(|&c| usize::from(c) < network().classes));
    });
}

fuzz_target!(|bytes: &[u8]| {
    let mut tensors = sound();
    let mut rest = bytes;
    while let Some(next) = edit(&mut tensors, rest) {
        rest = next;
    }
    try_file(file(&tensors));
    try_file(bytes.to_vec());
    if bytes.len() >= 8 && u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) <= bytes.len() as u64 - 8 {
        let (header, data) = split(bytes);
        try_file(sealed(header, data));
    }
});
