//! Logs written by the tests, whole and damaged, and what is made of them.

mod bags;
mod damaged;
mod foxglove;
mod written;

use super::schema::{Schema, descriptors};
use super::*;
use crate::base::error::{ErrorKind, Result};
use crate::network::Network;
use crate::scene::Scene;
use crate::synth::Synthesiser;
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::OnceLock;

const SECOND: u64 = 1_000_000_000;

fn network() -> Network {
    Network { image: [32, 64], cameras: 2, ..Network::built_in("edge").expect("built in") }
}

/// Two small images of noise, and where the cameras of a drawn scene stand.
fn scene(seed: u64) -> Scene {
    static DRAWN: OnceLock<Scene> = OnceLock::new();
    let drawn = || Synthesiser::new(&network()).expect("17 classes").frame(1).scene;
    let mut scene = DRAWN.get_or_init(drawn).clone();
    let mut random = crate::random::Random::new(seed);
    for image in &mut scene.images {
        image.bgr.iter_mut().for_each(|v| *v = random.next_u64() as u8);
    }
    scene
}

/// A log as a recorder would write it, message by message.
struct Recorder {
    writer: Writer<Cursor<Vec<u8>>>,
    sequence: u32,
}

impl Recorder {
    fn new(compression: Option<Compression>) -> Self {
        let options = WriteOptions::new().compression(compression).compression_threads(0).chunk_size(Some(4096));
        Self { writer: options.create(Cursor::new(Vec::new())).expect("memory"), sequence: 0 }
    }

    fn bytes(&mut self, topic: &str, [schema, encoding, messages]: [&str; 3], data: &[u8]) {
        let described = if encoding == "protobuf" { descriptors(schema) } else { b"# text".to_vec() };
        let schema = self.writer.add_schema(schema, encoding, &described).expect("a schema");
        let channel_id = self.writer.add_channel(schema, topic, messages, &BTreeMap::new()).expect("a channel");
        self.sequence += 1;
        let time = u64::from(self.sequence);
        let header = MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
        self.writer.write_to_known_channel(&header, data).expect("memory");
    }

    fn foxglove<M: Schema>(&mut self, topic: &str, message: &M) {
        self.bytes(topic, [M::NAME, "protobuf", "protobuf"], &message.encode_to_vec());
    }

    fn finish(mut self) -> Vec<u8> {
        self.writer.finish().expect("memory");
        self.writer.into_inner().into_inner()
    }
}

fn replay(bytes: &[u8]) -> Result<Replay> {
    Replay::from_bytes(bytes.to_vec(), &network(), &ReplayOptions::default())
}

fn refused(bytes: &[u8], expected: &str) -> ErrorKind {
    let error = replay(bytes).err().unwrap_or_else(|| panic!("accepted, expected {expected}"));
    assert!(error.message().contains(expected), "{error} does not say {expected:?}");
    error.kind()
}
