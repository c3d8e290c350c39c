//! The fields of a message, one after the other, in the serialization of ROS 1 or in CDR.

use super::index::Serialization;

/// Fields that have not been read.
pub struct Fields<'a> {
    bytes: &'a [u8],
    at: usize,
    is_big_endian: bool,
    is_aligned: bool,
}

impl<'a> Fields<'a> {
    /// The fields of a message.
    pub fn new(message: &'a [u8], serialization: Serialization) -> Result<Self, String> {
        let (bytes, is_big_endian, is_aligned) = match (serialization, message) {
            (Serialization::Ros1, bytes) => (bytes, false, false),
            (Serialization::Cdr, [0, order @ (0 | 1), _, _, rest @ ..]) => {
                (rest, *order == 0, true)
            }
            (Serialization::Cdr, _) => {
                return Err("does not begin with the header of plain CDR".to_owned());
            }
        };
        Ok(Self {
            bytes,
            at: 0,
            is_big_endian,
            is_aligned,
        })
    }

    /// Skips to a multiple of a size, where CDR has padding.
    pub fn align(&mut self, size: usize) {
        if self.is_aligned {
            self.at = self.at.next_multiple_of(size);
        }
    }

    /// Distance between structures of a size that begin with a number of four bytes [bytes].
    pub fn stride(&self, size: usize) -> usize {
        if self.is_aligned {
            size.next_multiple_of(4)
        } else {
            size
        }
    }

    /// Whether headers begin with a sequence number.
    pub fn has_sequence_numbers(&self) -> bool {
        !self.is_aligned
    }

    /// The order of the bytes of a number.
    pub fn is_big_endian(&self) -> bool {
        self.is_big_endian
    }

    /// A number of bytes; an error if the message has fewer.
    pub fn bytes(&mut self, length: usize) -> Result<&'a [u8], String> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let bytes = rest.get(..length).ok_or_else(|| {
            let left = rest.len();
            format!("is truncated: a field of {length} bytes has {left} left")
        })?;
        self.at += length;
        Ok(bytes)
    }

    /// All bytes that are left.
    pub fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], String> {
        self.align(N);
        let mut number = [0; N];
        number.copy_from_slice(self.bytes(N)?);
        if self.is_big_endian {
            number.reverse();
        }
        Ok(number)
    }

    pub fn u8(&mut self) -> Result<u8, String> {
        self.number().map(u8::from_le_bytes)
    }

    pub fn u16(&mut self) -> Result<u16, String> {
        self.number().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Result<u32, String> {
        self.number().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Result<u64, String> {
        self.number().map(u64::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, String> {
        self.number().map(f64::from_le_bytes)
    }

    /// A text, without the zero at its end in CDR.
    pub fn text(&mut self) -> Result<String, String> {
        let length = self.u32()?;
        let text = self.bytes(length as usize)?;
        Ok(String::from_utf8_lossy(text)
            .trim_end_matches('\0')
            .to_owned())
    }
}
