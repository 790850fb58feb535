//! CDR as ROS 2 writes it: a header of four bytes, then numbers aligned to their size from there on.

use crate::base::error::{Error, ErrorKind, Result};

/// Reads values one after the other. What is not there is an error; nothing is allocated.
pub(super) struct Cdr<'a> {
    body: &'a [u8],
    at: usize,
    little: bool,
}

impl<'a> Cdr<'a> {
    /// # Errors
    /// [`ErrorKind::Unsupported`] for another encapsulation than plain CDR (XCDR1), in either byte order.
    pub(super) fn new(bytes: &'a [u8]) -> Result<Self> {
        let Some((header, body)) = bytes.split_first_chunk::<4>() else {
            return Err(Error::format(format!("{} bytes, expected a CDR header of 4", bytes.len())));
        };
        let little = match header[..2] {
            [0, 0] => false,
            [0, 1] => true,
            _ => {
                let message = format!("CDR encapsulation {:02x?}, expected 00 00 or 00 01", &header[..2]);
                return Err(Error::new(ErrorKind::Unsupported, message));
            }
        };
        Ok(Self { body, at: 0, little })
    }

    fn take(&mut self, len: usize) -> Result<&'a [u8]> {
        let rest = self.body.len() - self.at;
        if len > rest {
            return Err(Error::format(format!("CDR byte {}: {len} bytes expected, {rest} are left", self.at + 4)));
        }
        self.at += len;
        Ok(&self.body[self.at - len..self.at])
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N]> {
        let padding = self.at.next_multiple_of(N) - self.at;
        self.take(padding)?;
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        if !self.little {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(super) fn u8(&mut self) -> Result<u8> {
        Ok(self.take(1)?[0])
    }

    pub(super) fn u32(&mut self) -> Result<u32> {
        self.number().map(u32::from_le_bytes)
    }

    pub(super) fn i32(&mut self) -> Result<i32> {
        self.number().map(i32::from_le_bytes)
    }

    pub(super) fn f64(&mut self) -> Result<f64> {
        self.number().map(f64::from_le_bytes)
    }

    pub(super) fn array<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut array = [0.0; N];
        for value in &mut array {
            *value = self.f64()?;
        }
        Ok(array)
    }

    /// Text, which ends in a zero that its length counts.
    pub(super) fn text(&mut self) -> Result<&'a str> {
        let len = self.u32()? as usize;
        let bytes = self.take(len)?;
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(text).map_err(|_| Error::format(format!("CDR byte {}: text is not UTF-8", self.at + 4)))
    }

    /// A sequence of bytes.
    pub(super) fn bytes(&mut self) -> Result<&'a [u8]> {
        let len = self.u32()? as usize;
        self.take(len)
    }

    /// Length of a sequence whose elements take at least `least` bytes each, and so cannot be more than the rest holds.
    pub(super) fn count(&mut self, least: usize) -> Result<usize> {
        let count = self.u32()? as usize;
        let rest = self.body.len() - self.at;
        if count > rest / least {
            let message = format!("CDR byte {}: {count} elements, {rest} bytes are left", self.at + 4);
            return Err(Error::format(message));
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_by_hand() {
        let little = [0, 1, 0, 0, 7, 9, 9, 9, 1, 2, 0, 0, 3, 0, 0, 0, b'h', b'i', 0, 5, 1, 0, 0, 0, 42, 0, 0, 0];
        let mut cdr = Cdr::new(&little).expect("a header");
        assert_eq!((cdr.u8().unwrap(), cdr.u32().unwrap(), cdr.text().unwrap()), (7, 513, "hi"));
        assert_eq!(cdr.bytes().unwrap(), [42]);
        let number = 1.5f64.to_be_bytes();
        let big = [&[0, 0, 0, 0, 0xff, 0xff, 0xff, 0xfe, 9, 9, 9, 9][..], &number[1..]].concat();
        let mut cdr = Cdr::new(&big).expect("a header");
        assert_eq!(cdr.i32().unwrap(), -2);
        // Eight bytes begin at a multiple of eight behind the header.
        assert!(cdr.f64().unwrap_err().message().contains("byte 12: 8 bytes expected, 7 are left"));
        let big = [&[0, 0, 0, 0][..], &number].concat();
        assert_eq!(Cdr::new(&big).expect("a header").f64().unwrap(), 1.5);
    }

    #[test]
    fn lengths_that_lie_are_refused() {
        let claimed = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2, 3];
        let read = |f: fn(&mut Cdr<'_>) -> Option<Error>| f(&mut Cdr::new(&claimed).expect("a header"));
        for error in [
            read(|c| c.text().err()),
            read(|c| c.bytes().err()),
            read(|c| c.count(1).err()),
            read(|c| c.f64().err()),
            read(|c| c.array::<9>().err()),
        ] {
            assert!(error.expect("refused").message().contains("are left"));
        }
        assert!(Cdr::new(&[0, 1]).is_err());
        assert!(Cdr::new(&[0, 7, 0, 0]).err().expect("XCDR2").message().contains("encapsulation"));
    }
}
