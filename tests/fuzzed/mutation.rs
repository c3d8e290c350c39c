//! Changes of a file: bytes, lines and numbers.

use arbtest::arbitrary::{Result, Unstructured};

/// Numbers at and beyond the limits of types, and what is no number.
pub const EXTREMES: &[&str] = &[
    "0",
    "-0",
    "-1",
    "1",
    "1e300",
    "-1e300",
    "1e-320",
    "1e999",
    "nan",
    "NaN",
    ".nan",
    "inf",
    "-inf",
    ".inf",
    "-.inf",
    "255",
    "256",
    "65536",
    "2147483647",
    "2147483648",
    "4294967295",
    "4294967296",
    "4294967297",
    "9007199254740993",
    "9223372036854775807",
    "9223372036854775808",
    "-9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
    "1000000000000",
    "1e9",
    "40000001",
    "1e10",
    "0.5",
    "+1",
    "0x10",
    "1_000",
    "１",
    "",
    "null",
    "~",
    "True",
    "[]",
    "{}",
    "''",
];

/// Pieces of syntax of the formats.
const PIECES: &[&str] = &[
    "\n",
    "\r\n",
    "\r",
    "\t",
    " ",
    "\0",
    "\u{feff}",
    "#",
    "é",
    "\u{2028}",
    "- ",
    ": ",
    ":",
    "&a ",
    "*a",
    "<<: *a",
    "!!float ",
    "| \n",
    "? ",
    "[",
    "]",
    "{",
    "}",
    "'",
    "\"",
    "\\",
    "---\n",
    "...\n",
    "%YAML 9.9\n",
    "(",
    ")",
    ",",
    "=",
    ".",
    "end_header\n",
    "comment ",
    "element face 3\n",
    "property float x\n",
    "property list uchar int vertex_indices\n",
    "obj_info a\n",
];

/// Largest file after the changes [bytes].
const LARGEST: usize = 1 << 18;

/// What changes, drawn before the file so that it does not run out of randomness.
pub struct Mutations(Vec<Mutation>);

struct Mutation {
    kind: u8,
    at: u32,
    length: u16,
    value: u32,
}

impl Mutations {
    /// Up to four changes; none for a quarter of the files.
    pub fn new(u: &mut Unstructured) -> Result<Self> {
        let count = [0, 0, 1, 1, 1, 2, 3, 4][usize::from(u.arbitrary::<u8>()? % 8)];
        let mutation = |u: &mut Unstructured| {
            let (kind, at, length, value) = u.arbitrary()?;
            Ok(Mutation {
                kind,
                at,
                length,
                value,
            })
        };
        Ok(Self(
            (0..count).map(|_| mutation(u)).collect::<Result<_>>()?,
        ))
    }

    /// Changes a file.
    pub fn apply(&self, bytes: &mut Vec<u8>) {
        for mutation in &self.0 {
            mutation.apply(bytes);
            bytes.truncate(LARGEST);
        }
    }
}

impl Mutation {
    fn apply(&self, bytes: &mut Vec<u8>) {
        let at = self.at as usize % (bytes.len() + 1);
        let value = self.value as usize;
        let range = at..bytes.len().min(at + usize::from(self.length % 128));
        match self.kind % 16 {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(range)),
            2 => {
                let copy = bytes[range].to_vec();
                insert(bytes, value, &copy);
            }
            3 => {
                let copies = bytes[range].repeat(value % 2000);
                insert(bytes, at, &copies);
            }
            4 => insert(bytes, at, &self.value.to_le_bytes()),
            5 => overwrite(bytes, at, &self.value.to_le_bytes()),
            6 => {
                let extremes = [f32::NAN, f32::INFINITY, -0.0, f32::MAX, f32::MIN_POSITIVE];
                overwrite(bytes, at, &extremes[value % 5].to_le_bytes());
            }
            7 => {
                let extremes = [u32::MAX, 1 << 31, 0, i32::MAX as u32];
                overwrite(bytes, at, &extremes[value % 4].to_le_bytes());
            }
            8 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte ^= 1 << (value % 8);
                }
            }
            9 => {
                let piece = PIECES[value % PIECES.len()];
                // Some often: deep nesting, long lines.
                let times = if self.length.is_multiple_of(8) {
                    usize::from(self.length) % 3000
                } else {
                    1
                };
                insert(bytes, at, piece.repeat(times).as_bytes());
            }
            10 => swap_lines(bytes, at, value),
            11 => repeat_line(bytes, at, value % 300),
            _ => replace_number(bytes, at, EXTREMES[value % EXTREMES.len()]),
        }
    }
}

fn insert(bytes: &mut Vec<u8>, at: usize, piece: &[u8]) {
    let at = at % (bytes.len() + 1);
    bytes.splice(at..at, piece.iter().copied());
}

fn overwrite(bytes: &mut [u8], at: usize, piece: &[u8]) {
    for (byte, new) in bytes.iter_mut().skip(at).zip(piece) {
        *byte = *new;
    }
}

/// The line around a position, with its end.
fn line_at(bytes: &[u8], at: usize) -> std::ops::Range<usize> {
    let start = bytes[..at].iter().rposition(|&b| b == b'\n');
    let end = bytes[at..].iter().position(|&b| b == b'\n');
    start.map_or(0, |start| start + 1)..end.map_or(bytes.len(), |end| at + end + 1)
}

fn swap_lines(bytes: &mut Vec<u8>, at: usize, to: usize) {
    let line: Vec<u8> = bytes.drain(line_at(bytes, at)).collect();
    let to = to % (bytes.len() + 1);
    let to = line_at(bytes, to).start;
    insert(bytes, to, &line);
}

fn repeat_line(bytes: &mut Vec<u8>, at: usize, times: usize) {
    let line = line_at(bytes, at);
    let start = line.start;
    let copies = bytes[line].repeat(times);
    insert(bytes, start, &copies);
}

/// Replaces the first number after a position, or else the first of the file.
fn replace_number(bytes: &mut Vec<u8>, at: usize, by: &str) {
    let is_part = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'+' | b'e');
    let digit = |from: usize| Some(from + bytes[from..].iter().position(u8::is_ascii_digit)?);
    let Some(digit) = digit(at).or_else(|| digit(0)) else {
        return;
    };
    let start = bytes[..digit].iter().rposition(|b| !is_part(b));
    let end = bytes[digit..].iter().position(|b| !is_part(b));
    let range = start.map_or(0, |start| start + 1)..end.map_or(bytes.len(), |end| digit + end);
    bytes.splice(range, by.bytes());
}
