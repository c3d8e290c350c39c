//! Arrays as a `.npz` file: a zip file of NumPy arrays, of which one may be written while its rows arise.
//!
//! The layout is that of PKWARE's APPNOTE.TXT 6.3.10: local headers (4.3.7) with their data, the central
//! directory (4.3.12) and its end (4.3.14 to 4.3.16), always with the 64-bit fields (4.5.3). Number of rows,
//! checksum and sizes of an [`ArrayStream`] are filled in when it ends: its compressed data begin with a
//! stored block (RFC 1951, 3.2.4) that holds NumPy's header, of a length that does not depend on the rows.

use std::fs::File;
use std::io::{self, Read as _, Seek, SeekFrom, Write};

use bytemuck::Pod;
use crc32fast::Hasher;
use flate2::Compression;
use flate2::write::DeflateEncoder;
use npyz::AutoSerialize;

use super::npz::write_npy;

const STORED: u16 = 0;
const DEFLATED: u16 = 8;
/// Version that is needed to read the 64-bit fields.
const VERSION: u16 = 45;
/// 1 January 1980, the first date of the format: equal results are equal files.
const DATE: u16 = 0x21;
/// In a field of 32 or 16 bits: its value is in the 64-bit fields.
const IN_64_BITS: u32 = u32::MAX;

/// Length of NumPy's header [bytes].
const NPY_HEADER: usize = 128;

/// An array in the file.
struct Entry {
    name: String,
    method: u16,
    crc: u32,
    compressed: u64,
    bytes: u64,
    offset: u64,
}

impl Entry {
    fn local_header(&self) -> Vec<u8> {
        let mut header = 0x0403_4b50_u32.to_le_bytes().to_vec();
        self.put_common(&mut header, 20);
        header.extend(self.name.as_bytes());
        header.extend([1, 0, 16, 0]);
        put_64(&mut header, &[self.bytes, self.compressed]);
        header
    }

    fn central_header(&self) -> Vec<u8> {
        let mut header = 0x0201_4b50_u32.to_le_bytes().to_vec();
        header.extend(VERSION.to_le_bytes());
        self.put_common(&mut header, 28);
        // No comment, first disk, no attributes.
        header.extend([0; 10]);
        header.extend(IN_64_BITS.to_le_bytes());
        header.extend(self.name.as_bytes());
        header.extend([1, 0, 24, 0]);
        put_64(&mut header, &[self.bytes, self.compressed, self.offset]);
        header
    }

    fn put_common(&self, header: &mut Vec<u8>, extra: u16) {
        for field in [VERSION, 0, self.method, 0, DATE] {
            header.extend(field.to_le_bytes());
        }
        for field in [self.crc, IN_64_BITS, IN_64_BITS] {
            header.extend(field.to_le_bytes());
        }
        for field in [self.name.len() as u16, extra] {
            header.extend(field.to_le_bytes());
        }
    }
}

fn put_64(bytes: &mut Vec<u8>, fields: &[u64]) {
    bytes.extend(fields.iter().flat_map(|field| field.to_le_bytes()));
}

/// An array whose rows are appended, compressed as they come.
pub struct ArrayStream {
    entry: Entry,
    /// Type and extents of a row in NumPy's header.
    element: &'static str,
    row: String,
    rows: usize,
    crc: Hasher,
    encoder: DeflateEncoder<File>,
}

impl ArrayStream {
    /// Begins an array at the start of an empty file.
    pub fn begin(
        mut file: File,
        name: &str,
        element: &'static str,
        row: &[usize],
    ) -> io::Result<Self> {
        let entry = Entry {
            name: format!("{name}.npy"),
            method: DEFLATED,
            crc: 0,
            compressed: 0,
            bytes: NPY_HEADER as u64,
            offset: 0,
        };
        file.write_all(&entry.local_header())?;
        file.write_all(&[0; 5 + NPY_HEADER])?;
        Ok(Self {
            entry,
            element,
            row: row.iter().map(|extent| format!(", {extent}")).collect(),
            rows: 0,
            crc: Hasher::new(),
            encoder: DeflateEncoder::new(file, Compression::fast()),
        })
    }

    /// Appends a row.
    pub fn push(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.rows += 1;
        self.entry.bytes += bytes.len() as u64;
        self.crc.update(bytes);
        self.encoder.write_all(bytes)
    }

    fn npy_header(&self) -> Vec<u8> {
        let (element, rows, row) = (self.element, self.rows, &self.row);
        let text =
            format!("{{'descr': '{element}', 'fortran_order': False, 'shape': ({rows}{row}), }}");
        let mut header = b"\x93NUMPY\x01\x00".to_vec();
        header.extend((NPY_HEADER as u16 - 10).to_le_bytes());
        header.extend(text.as_bytes());
        header.resize(NPY_HEADER - 1, b' ');
        header.push(b'\n');
        header
    }

    /// Completes the array and fills in its headers; the file is at its end.
    fn finish(self) -> io::Result<(File, Entry)> {
        let header = self.npy_header();
        let mut file = self.encoder.finish()?;
        let mut entry = self.entry;
        let mut crc = Hasher::new();
        crc.update(&header);
        crc.combine(&self.crc);
        entry.crc = crc.finalize();
        let data = entry.local_header().len() as u64;
        entry.compressed = file.stream_position()? - data;
        file.rewind()?;
        file.write_all(&entry.local_header())?;
        let length = NPY_HEADER as u16;
        file.write_all(&[0])?;
        file.write_all(&length.to_le_bytes())?;
        file.write_all(&(!length).to_le_bytes())?;
        file.write_all(&header)?;
        file.seek(SeekFrom::End(0))?;
        Ok((file, entry))
    }
}

/// A `.npz` file that is being written.
pub struct NpzWriter<W: Write + Seek> {
    file: W,
    entries: Vec<Entry>,
}

impl NpzWriter<File> {
    /// Continues the file of an array that is complete.
    pub fn after(array: ArrayStream) -> io::Result<Self> {
        let (file, entry) = array.finish()?;
        Ok(Self {
            file,
            entries: vec![entry],
        })
    }

    /// Adds an array that was written to another file.
    pub fn add_stream(&mut self, array: ArrayStream) -> io::Result<()> {
        let (mut other, mut entry) = array.finish()?;
        other.seek(SeekFrom::Start(entry.local_header().len() as u64))?;
        entry.offset = self.file.stream_position()?;
        self.file.write_all(&entry.local_header())?;
        io::copy(&mut other.take(entry.compressed), &mut self.file)?;
        self.entries.push(entry);
        Ok(())
    }
}

impl<W: Write + Seek> NpzWriter<W> {
    /// Starts an empty file.
    pub fn new(file: W) -> Self {
        Self {
            file,
            entries: Vec::new(),
        }
    }

    /// Adds an array of a shape with all its numbers in row-major order, not compressed: that would take
    /// long for many frames, and numbers of double precision hardly get smaller.
    pub fn add<T: AutoSerialize + Pod>(
        &mut self,
        name: &str,
        shape: &[usize],
        numbers: impl IntoIterator<Item = T>,
    ) -> io::Result<()> {
        let mut entry = Entry {
            name: format!("{name}.npy"),
            method: STORED,
            crc: 0,
            compressed: 0,
            bytes: 0,
            offset: self.file.stream_position()?,
        };
        self.file.write_all(&entry.local_header())?;
        let mut data = Data {
            file: &mut self.file,
            crc: Hasher::new(),
            bytes: 0,
        };
        write_npy(&mut data, shape, numbers)?;
        (entry.bytes, entry.compressed) = (data.bytes, data.bytes);
        entry.crc = data.crc.finalize();
        let end = self.file.stream_position()?;
        self.file.seek(SeekFrom::Start(entry.offset))?;
        self.file.write_all(&entry.local_header())?;
        self.file.seek(SeekFrom::Start(end))?;
        self.entries.push(entry);
        Ok(())
    }

    /// Writes the directory of the file.
    pub fn finish(mut self) -> io::Result<()> {
        let start = self.file.stream_position()?;
        let headers: Vec<u8> = (self.entries.iter())
            .flat_map(Entry::central_header)
            .collect();
        let (count, length) = (self.entries.len() as u64, headers.len() as u64);
        let mut end = 0x0606_4b50_u32.to_le_bytes().to_vec();
        put_64(&mut end, &[44]);
        end.extend([VERSION.to_le_bytes(), VERSION.to_le_bytes()].as_flattened());
        end.extend([0; 8]);
        put_64(&mut end, &[count, count, length, start]);
        end.extend(0x0706_4b50_u32.to_le_bytes());
        end.extend([0; 4]);
        put_64(&mut end, &[start + length]);
        end.extend(1_u32.to_le_bytes());
        end.extend(0x0605_4b50_u32.to_le_bytes());
        end.extend([0; 4]);
        end.extend([0xff; 12]);
        end.extend([0; 2]);
        self.file.write_all(&headers)?;
        self.file.write_all(&end)?;
        self.file.flush()
    }
}

/// Data of an array, with their checksum.
struct Data<W> {
    file: W,
    crc: Hasher,
    bytes: u64,
}

impl<W: Write> Write for Data<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.crc.update(&bytes[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
