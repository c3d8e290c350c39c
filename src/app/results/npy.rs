//! NumPy's array format, read as a stream: the header first, then numbers in row-major order.
//!
//! Nothing is allocated on the word of a header: memory grows with what the file really holds.
//! Format: NumPy Enhancement Proposal 1 (versions 1.0 to 3.0).

use std::io::{self, Read};

/// What is wrong with an array.
#[derive(Debug, thiserror::Error)]
pub enum NpyError {
    #[error("it does not begin as a NumPy array")]
    NotNpy,
    #[error("its header is `{header}`, which is not understood")]
    BadHeader { header: String },
    #[error(
        "its numbers are of type `{found}`; `<f4`, `<f8`, `<i4`, `<i8` and `|u1` are understood"
    )]
    UnknownType { found: String },
    #[error("it is in Fortran order; save it with numpy.ascontiguousarray")]
    FortranOrder,
    #[error("its shape is {found:?}, but {expected} belongs here")]
    WrongShape {
        found: Vec<usize>,
        expected: &'static str,
    },
    #[error("its shape {shape:?} needs {needed} bytes of numbers, but there are {found}")]
    WrongSize {
        shape: Vec<usize>,
        needed: u128,
        found: u64,
    },
    #[error("its data cannot be read: {0}")]
    Read(#[from] io::Error),
}

/// Number types that results are made of, all little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Element {
    F32,
    F64,
    I32,
    I64,
    U8,
}

impl Element {
    fn parse(descriptor: &str) -> Option<Self> {
        match descriptor {
            "<f4" => Some(Self::F32),
            "<f8" => Some(Self::F64),
            "<i4" => Some(Self::I32),
            "<i8" => Some(Self::I64),
            "|u1" | "|b1" => Some(Self::U8),
            _ => None,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::F32 | Self::I32 => 4,
            Self::F64 | Self::I64 => 8,
            Self::U8 => 1,
        }
    }
}

/// An array whose numbers are still to be read.
pub struct NpyReader<R> {
    /// Extent per axis; empty for a scalar.
    pub shape: Vec<usize>,
    element: Element,
    reader: R,
}

impl<R: Read> NpyReader<R> {
    /// Reads the header of an array that has `bytes` bytes with its header, and checks that the
    /// two agree.
    pub fn new(mut reader: R, bytes: u64) -> Result<Self, NpyError> {
        let (header, header_bytes) = read_header(&mut reader)?;
        let (element, shape) = parse_header(&header)?;
        let needed = shape
            .iter()
            .fold(element.bytes() as u128, |product, &extent| {
                product.saturating_mul(extent as u128)
            });
        let found = bytes.saturating_sub(header_bytes);
        if needed != u128::from(found) {
            return Err(NpyError::WrongSize {
                shape,
                needed,
                found,
            });
        }
        Ok(Self {
            shape,
            element,
            reader,
        })
    }

    /// Checks the shape against a pattern, in which `None` is any extent.
    pub fn expect_shape(
        &self,
        pattern: &[Option<usize>],
        expected: &'static str,
    ) -> Result<(), NpyError> {
        let fits = self.shape.len() == pattern.len()
            && self
                .shape
                .iter()
                .zip(pattern)
                .all(|(&found, wanted)| wanted.is_none_or(|wanted| wanted == found));
        if fits {
            Ok(())
        } else {
            Err(NpyError::WrongShape {
                found: self.shape.clone(),
                expected,
            })
        }
    }

    /// The next `N` numbers.
    pub fn next_row<const N: usize>(&mut self) -> Result<[f64; N], NpyError> {
        let mut row = [0.0; N];
        for number in &mut row {
            *number = self.next_number()?;
        }
        Ok(row)
    }

    /// The next number; integers beyond 2⁵³ are rounded.
    pub fn next_number(&mut self) -> Result<f64, NpyError> {
        let mut bytes = [0; 8];
        self.reader.read_exact(&mut bytes[..self.element.bytes()])?;
        let [a, b, c, d, ..] = bytes;
        Ok(match self.element {
            Element::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Element::F64 => f64::from_le_bytes(bytes),
            Element::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Element::I64 => i64::from_le_bytes(bytes) as f64,
            Element::U8 => f64::from(a),
        })
    }
}

/// The header's dictionary and how many bytes came before the numbers.
fn read_header(reader: &mut impl Read) -> Result<(String, u64), NpyError> {
    let mut start = [0; 8];
    reader.read_exact(&mut start)?;
    if &start[..6] != b"\x93NUMPY" {
        return Err(NpyError::NotNpy);
    }
    let (length, before) = if start[6] == 1 {
        let mut bytes = [0; 2];
        reader.read_exact(&mut bytes)?;
        (u64::from(u16::from_le_bytes(bytes)), 10)
    } else {
        let mut bytes = [0; 4];
        reader.read_exact(&mut bytes)?;
        (u64::from(u32::from_le_bytes(bytes)), 12)
    };
    let mut header = Vec::new();
    reader.take(length).read_to_end(&mut header)?;
    if header.len() as u64 != length {
        return Err(NpyError::NotNpy);
    }
    let header = String::from_utf8_lossy(&header).trim().to_owned();
    Ok((header, before + length))
}

/// Element and shape of `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }`.
fn parse_header(header: &str) -> Result<(Element, Vec<usize>), NpyError> {
    let bad = || NpyError::BadHeader {
        header: header.chars().take(200).collect(),
    };
    let value_of = |key: &str| {
        let (_, rest) = header.split_once(&format!("'{key}':")).ok_or_else(bad)?;
        Ok::<&str, NpyError>(rest.trim_start())
    };
    let descriptor = value_of("descr")?
        .strip_prefix('\'')
        .and_then(|rest| rest.split_once('\''))
        .map(|(descriptor, _)| descriptor)
        .ok_or_else(bad)?;
    let shape = value_of("shape")?
        .strip_prefix('(')
        .and_then(|rest| rest.split_once(')'))
        .ok_or_else(bad)?
        .0
        .split(',')
        .map(str::trim)
        .filter(|extent| !extent.is_empty())
        .map(str::parse)
        .collect::<Result<Vec<usize>, _>>()
        .map_err(|_extent| bad())?;
    if value_of("fortran_order")?.starts_with("True") && shape.len() > 1 {
        return Err(NpyError::FortranOrder);
    }
    let element = Element::parse(descriptor).ok_or_else(|| NpyError::UnknownType {
        found: descriptor.to_owned(),
    })?;
    Ok((element, shape))
}

/// The header of a row-major array, padded so that the numbers begin at a multiple of 64 bytes.
pub fn header_bytes(descriptor: &str, shape: &[usize]) -> Vec<u8> {
    let extents: String = shape.iter().map(|extent| format!("{extent}, ")).collect();
    let mut header =
        format!("{{'descr': '{descriptor}', 'fortran_order': False, 'shape': ({extents}), }}");
    // Before the header stand ten bytes: magic, version, length.
    let padding = (64 - (10 + header.len() + 1) % 64) % 64;
    header.push_str(&" ".repeat(padding));
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
    bytes.extend_from_slice(header.as_bytes());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(bytes: &[u8]) -> Result<NpyReader<&[u8]>, NpyError> {
        NpyReader::new(bytes, bytes.len() as u64)
    }

    #[test]
    fn a_header_that_is_written_is_read_back_whatever_the_shape() {
        for shape in [&[][..], &[7], &[2, 3], &[1, 1, 4]] {
            let mut bytes = header_bytes("<i4", shape);
            assert_eq!(bytes.len() % 64, 0);
            let count: usize = shape.iter().product();
            for number in 0..count {
                bytes.extend_from_slice(&(number as i32).to_le_bytes());
            }
            let mut array = open(&bytes).unwrap();
            assert_eq!(array.shape, shape);
            for number in 0..count {
                assert_eq!(array.next_number().unwrap(), number as f64);
            }
        }
    }

    #[test]
    fn a_shape_that_the_data_does_not_fill_is_an_error_and_costs_no_memory() {
        let bytes = header_bytes("<f8", &[usize::MAX, 1 << 40, 4]);
        let message = open(&bytes).err().unwrap().to_string();
        assert!(message.contains("but there are 0"), "{message}");
    }

    #[test]
    fn what_is_not_understood_is_quoted() {
        let message = open(&header_bytes("<c16", &[])).err().unwrap().to_string();
        assert!(message.contains("`<c16`"), "{message}");
        let message = open(b"{\"a json\": 1}").err().unwrap().to_string();
        assert!(message.contains("does not begin as"), "{message}");
    }
}
