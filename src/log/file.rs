//! An MCAP file as a place of messages: read from the start, as far as it is whole, without trust in what it says.
//!
//! The summary at the end is not used: a recorder that lost power has written none. Of a chunk that is cut off at the end, the
//! messages that are whole are read, although its checksum cannot be compared.

use super::message::Kind;
use super::records::{Frame, Record};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::backing::Backing;
use mcap::records::op;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io::Read;
use std::ops::Range;
use std::sync::Arc;

/// Bytes that a chunk may unpack to. Recorders write a few megabytes, or one message if that is larger.
const MAX_CHUNK: u64 = 1 << 30;

/// Bytes of unpacked chunks that are kept for the messages that are asked for next.
const KEPT: usize = 256 << 20;

/// How a log ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// With its footer.
    Whole,
    /// All records are whole, but the footer is missing.
    NoFooter,
    /// In the middle of a record or chunk.
    Cut,
}

/// How much of a log could be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Bytes of the file up to the end of the last record that is whole.
    pub read: u64,
    /// Bytes of the file.
    pub length: u64,
    /// How it ends.
    pub ending: Ending,
}

impl fmt::Display for Extent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { read, length, ending } = self;
        match ending {
            Ending::Whole => write!(f, "whole, {length} bytes"),
            Ending::NoFooter => write!(f, "whole records up to its end at byte {length}, without a footer"),
            Ending::Cut => write!(f, "cut off: read up to byte {read} of {length}"),
        }
    }
}

/// Who sends messages of what kind.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Channel {
    pub(super) topic: String,
    /// None for what is of no use here.
    pub(super) kind: Option<Kind>,
    /// Schema and encoding, for people.
    pub(super) described: String,
}

/// Where a message's data lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    /// Which chunk; none for what lies in the file itself.
    chunk: Option<u32>,
    start: usize,
    len: usize,
}

/// A chunk as its record describes it.
#[derive(Clone, Debug)]
struct Chunk {
    /// Packed bytes, in the file.
    range: Range<usize>,
    /// Where its record begins.
    at: usize,
    compression: String,
    size: u64,
    crc: u32,
    /// Whether the file ends in it.
    cut: bool,
}

/// An open log.
pub(super) struct Log {
    bytes: Backing,
    pub(super) channels: BTreeMap<u16, Channel>,
    pub(super) extent: Extent,
    chunks: Vec<Chunk>,
    kept: VecDeque<(u32, Arc<Vec<u8>>)>,
}

/// What [`Log::visit`] calls for every message, in the order of the file.
pub(super) type Visitor<'a> = dyn FnMut(&Channel, Place, &[u8]) -> Result<()> + 'a;

impl Log {
    /// Reads a log and visits all its messages.
    pub(super) fn read(bytes: Backing, visit: &mut Visitor<'_>) -> Result<Self> {
        if !bytes.starts_with(mcap::MAGIC) {
            let head = &bytes[..bytes.len().min(8)];
            return Err(Error::format(format!("begins with bytes {head:02x?}, expected an MCAP file")));
        }
        let extent = Extent { read: 0, length: bytes.len() as u64, ending: Ending::NoFooter };
        let mut log = Self { bytes, channels: BTreeMap::new(), extent, chunks: Vec::new(), kept: VecDeque::new() };
        let mut schemas = BTreeMap::new();
        log.extent = log.scan(&mut schemas, visit)?;
        Ok(log)
    }

    fn scan(&mut self, schemas: &mut Schemas, visit: &mut Visitor<'_>) -> Result<Extent> {
        let length = self.bytes.len() as u64;
        let (mut at, mut ended) = (mcap::MAGIC.len(), false);
        let ending = loop {
            let Some(frame) = Frame::at(&self.bytes, at) else {
                if let Some(frame) = Frame::cut(&self.bytes, at).filter(|frame| frame.op == op::CHUNK && !ended) {
                    self.chunk(&frame, true, schemas, visit)?;
                }
                let rest = &self.bytes[at.min(self.bytes.len())..];
                break match (ended, rest) {
                    (true, rest) if rest == mcap::MAGIC => Ending::Whole,
                    (_, []) => Ending::NoFooter,
                    _ => Ending::Cut,
                };
            };
            match frame.op {
                op::FOOTER => ended = true,
                op::CHUNK if !ended => self.chunk(&frame, false, schemas, visit)?,
                op::SCHEMA | op::CHANNEL | op::MESSAGE if !ended => {
                    let bytes = std::mem::replace(&mut self.bytes, Backing::Bytes((&[]).into()));
                    let done = self.record(&bytes, &frame, None, schemas, visit);
                    self.bytes = bytes;
                    done.map_err(|e| said(e, "record", frame.start))?;
                }
                // What follows repeats what was read: the summary.
                op::DATA_END => {}
                // A preallocated file is zero where nothing was written.
                0 => break Ending::Cut,
                _ => {}
            }
            at = frame.body.end;
        };
        Ok(Extent { read: if ending == Ending::Whole { length } else { at as u64 }, length, ending })
    }

    /// Visits the messages of a chunk; of one that is cut off, those that are whole.
    fn chunk(&mut self, frame: &Frame, cut: bool, schemas: &mut Schemas, visit: &mut Visitor<'_>) -> Result<()> {
        let body = &self.bytes[frame.body.clone()];
        let record = match Record::parse(frame.op, body, cut) {
            Ok(record) => record,
            // Cut off before its data begins.
            Err(_) if cut => return Ok(()),
            Err(e) => return Err(said(e, "chunk", frame.start)),
        };
        let Record::Chunk { size, crc, compression, data } = record else { return Ok(()) };
        let start = frame.body.start + (data.as_ptr().addr() - body.as_ptr().addr());
        let range = start..start + data.len();
        let chunk = Chunk { range, at: frame.start, compression: compression.to_owned(), size, crc, cut };
        let index =
            u32::try_from(self.chunks.len()).map_err(|_| Error::new(ErrorKind::TooLarge, "more than 2^32 chunks"))?;
        let unpacked = chunk.unpack(&self.bytes)?;
        self.chunks.push(chunk);
        let mut at = 0;
        while let Some(record) = Frame::at(&unpacked, at) {
            self.record(&unpacked, &record, Some(index), schemas, visit).map_err(|e| said(e, "chunk", frame.start))?;
            at = record.body.end;
        }
        if at != unpacked.len() && !cut {
            let message = format!("{} bytes behind its last record", unpacked.len() - at);
            return Err(said(Error::format(message), "chunk", frame.start));
        }
        Ok(())
    }

    fn record(
        &mut self,
        bytes: &[u8],
        frame: &Frame,
        chunk: Option<u32>,
        schemas: &mut Schemas,
        visit: &mut Visitor<'_>,
    ) -> Result<()> {
        let body = &bytes[frame.body.clone()];
        match Record::parse(frame.op, body, false)? {
            Record::Schema { id, name, encoding } => {
                let schema = (name.to_owned(), encoding.to_owned());
                if schemas.insert(id, schema.clone()).is_some_and(|other| other != schema) {
                    return Err(Error::format(format!("schema {id} is there twice, with different contents")));
                }
            }
            Record::Channel { id, schema, topic, encoding } => {
                let (name, described) = match schemas.get(&schema) {
                    Some((name, encoding)) => (name.as_str(), encoding.as_str()),
                    None if schema == 0 => ("", ""),
                    None => return Err(Error::format(format!("topic {topic}: schema {schema} is not there"))),
                };
                let kind = Kind::of(name, described, encoding, topic);
                let channel = Channel { topic: topic.to_owned(), kind, described: format!("{name} ({encoding})") };
                if self.channels.insert(id, channel.clone()).is_some_and(|other| other != channel) {
                    return Err(Error::format(format!("channel {id} is there twice, with different contents")));
                }
            }
            Record::Message { channel: id, data } => {
                let channel = self.channels.get(&id);
                let channel =
                    channel.ok_or_else(|| Error::format(format!("a message of channel {id}, which is not there")))?;
                let place = Place { chunk, start: frame.body.end - data.len(), len: data.len() };
                let topic = |e: Error| Error::new(e.kind(), format!("topic {}: {}", channel.topic, e.message()));
                visit(channel, place, data).map_err(topic)?;
            }
            Record::Chunk { .. } | Record::Other => {}
        }
        Ok(())
    }

    /// Hands `read` a message's data again.
    pub(super) fn message<T>(&mut self, place: Place, read: impl FnOnce(&[u8]) -> Result<T>) -> Result<T> {
        let range = place.start..place.start + place.len;
        let Some(index) = place.chunk else { return read(&self.bytes[range]) };
        let found = self.kept.iter().find(|(kept, _)| *kept == index).map(|(_, bytes)| bytes.clone());
        let unpacked = match found {
            Some(unpacked) => unpacked,
            None => {
                let unpacked = Arc::new(self.chunks[index as usize].unpack(&self.bytes)?);
                self.kept.push_back((index, unpacked.clone()));
                while self.kept.len() > 1 && self.kept.iter().map(|(_, bytes)| bytes.len()).sum::<usize>() > KEPT {
                    self.kept.pop_front();
                }
                unpacked
            }
        };
        read(&unpacked[range])
    }
}

/// Name and encoding of schemas by number.
type Schemas = BTreeMap<u16, (String, String)>;

impl Chunk {
    fn unpack(&self, bytes: &[u8]) -> Result<Vec<u8>> {
        self.unpacked(&bytes[self.range.clone()]).map_err(|e| said(e, "chunk", self.at))
    }

    fn unpacked(&self, packed: &[u8]) -> Result<Vec<u8>> {
        if self.size > MAX_CHUNK {
            let message = format!("{} bytes unpacked, expected at most {MAX_CHUNK}", self.size);
            return Err(Error::new(ErrorKind::TooLarge, message));
        }
        let mut unpacked = Vec::new();
        // Memory grows with what really comes, and one byte more than claimed is enough to know the claim wrong.
        let limit = self.size + 1;
        let read = match self.compression.as_str() {
            "" => packed.take(limit).read_to_end(&mut unpacked),
            "lz4" => lz4_flex::frame::FrameDecoder::new(packed).take(limit).read_to_end(&mut unpacked),
            "zstd" => zstd::stream::read::Decoder::new(packed).and_then(|d| d.take(limit).read_to_end(&mut unpacked)),
            other => {
                let message = format!("compression {other:?}, expected none, \"lz4\" or \"zstd\"");
                return Err(Error::new(ErrorKind::Unsupported, message));
            }
        };
        if self.cut {
            return Ok(unpacked);
        }
        read.map_err(|e| Error::format(format!("cannot be unpacked: {e}")))?;
        if unpacked.len() as u64 != self.size {
            let message = format!("other than {} bytes unpacked, expected as many", self.size);
            return Err(Error::format(message));
        }
        let found = crc32fast::hash(&unpacked);
        if self.crc != 0 && found != self.crc {
            return Err(Error::format(format!("checksum {found:08x}, expected {:08x}", self.crc)));
        }
        Ok(unpacked)
    }
}

/// The error, said of what begins at byte `at`.
fn said(error: Error, what: &str, at: usize) -> Error {
    Error::new(error.kind(), format!("{what} at byte {at}: {}", error.message()))
}
