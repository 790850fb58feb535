//! The records of an MCAP file that matter here, as views of its bytes. A length is believed only as far as the bytes reach, so
//! that nothing is allocated for what a record merely claims.

use crate::base::error::{Error, Result};
use mcap::records::op;
use std::ops::Range;

/// A record's operation and where it lies.
pub(super) struct Frame {
    pub(super) op: u8,
    pub(super) start: usize,
    pub(super) body: Range<usize>,
}

impl Frame {
    /// The record at `at`, if all of it is there.
    pub(super) fn at(bytes: &[u8], at: usize) -> Option<Self> {
        let (&[op], rest) = bytes.get(at..)?.split_first_chunk()?;
        let (length, rest) = rest.split_first_chunk()?;
        let length = usize::try_from(u64::from_le_bytes(*length)).ok().filter(|&length| length <= rest.len())?;
        Some(Self { op, start: at, body: at + 9..at + 9 + length })
    }

    /// The record at `at` as far as the bytes reach, if they end in its body.
    pub(super) fn cut(bytes: &[u8], at: usize) -> Option<Self> {
        let op = *bytes.get(at..at.checked_add(9)?)?.first()?;
        Some(Self { op, start: at, body: at + 9..bytes.len() })
    }
}

/// What a record says.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Record<'a> {
    Schema { id: u16, name: &'a str, encoding: &'a str },
    Channel { id: u16, schema: u16, topic: &'a str, encoding: &'a str },
    Message { channel: u16, data: &'a [u8] },
    Chunk { size: u64, crc: u32, compression: &'a str, data: &'a [u8] },
    Other,
}

impl<'a> Record<'a> {
    /// Parses a record; of a chunk that is `cut` off, what there is of its data.
    pub(super) fn parse(op: u8, body: &'a [u8], cut: bool) -> Result<Self> {
        let mut fields = Fields(body);
        Ok(match op {
            op::SCHEMA => Record::Schema { id: fields.u16()?, name: fields.text()?, encoding: fields.text()? },
            op::CHANNEL => Record::Channel {
                id: fields.u16()?,
                schema: fields.u16()?,
                topic: fields.text()?,
                encoding: fields.text()?,
            },
            op::MESSAGE => {
                let channel = fields.u16()?;
                // Sequence, and the times at which it was recorded and sent: stamps are in the messages.
                fields.take(4 + 8 + 8)?;
                Record::Message { channel, data: fields.0 }
            }
            op::CHUNK => {
                // The times of its messages.
                fields.take(8 + 8)?;
                let (size, crc, compression) = (fields.u64()?, fields.u32()?, fields.text()?);
                let packed = fields.u64()?;
                let whole = |&packed: &usize| packed <= fields.0.len();
                let data = usize::try_from(packed).ok().filter(whole).or(cut.then_some(fields.0.len()));
                let data = data.ok_or_else(|| {
                    Error::format(format!("{packed} bytes of packed data, {} are left", fields.0.len()))
                })?;
                Record::Chunk { size, crc, compression, data: &fields.0[..data] }
            }
            _ => Record::Other,
        })
    }
}

/// What is left of a record.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, len: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self
            .0
            .split_at_checked(len)
            .ok_or_else(|| Error::format(format!("{len} bytes expected, {} are left", self.0.len())))?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    fn u16(&mut self) -> Result<u16> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Result<&'a str> {
        let len = self.u32()? as usize;
        std::str::from_utf8(self.take(len)?).map_err(|_| Error::format("text is not UTF-8"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_by_hand() {
        let schema = [&[7u8, 0, 2, 0, 0, 0][..], b"ab", &[1, 0, 0, 0], b"c", &[0; 4]].concat();
        let parsed = Record::parse(op::SCHEMA, &schema, false).expect("a schema");
        assert_eq!(parsed, Record::Schema { id: 7, name: "ab", encoding: "c" });
        let message = [&[5u8, 0][..], &[0; 20], b"data"].concat();
        assert_eq!(
            Record::parse(op::MESSAGE, &message, false).expect("a message"),
            Record::Message { channel: 5, data: b"data" }
        );
        assert_eq!(Record::parse(op::STATISTICS, &[], false).expect("passed over"), Record::Other);
        let framed = [&[op::MESSAGE][..], &26u64.to_le_bytes(), &message].concat();
        assert_eq!(Frame::at(&framed, 0).map(|frame| frame.body), Some(9..35));
        assert!(Frame::at(&framed[..34], 0).is_none() && Frame::at(&framed, 35).is_none());
    }

    #[test]
    fn lengths_that_lie_are_refused() {
        let long = [&[7u8, 0][..], &u32::MAX.to_le_bytes(), b"ab"].concat();
        assert!(
            Record::parse(op::SCHEMA, &long, false)
                .unwrap_err()
                .message()
                .contains("4294967295 bytes expected, 2 are left")
        );
        let chunk = [&[0u8; 16 + 8 + 4 + 4][..], &u64::MAX.to_le_bytes()].concat();
        assert!(Record::parse(op::CHUNK, &chunk, false).unwrap_err().message().contains("of packed data, 0 are left"));
        assert!(Record::parse(op::MESSAGE, &[0; 21], false).is_err());
    }
}
