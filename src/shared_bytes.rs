//! Bytes of files that are mapped into memory: shared ones, of a file or a buffer, and those that are appended to.

use std::fmt;
use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom, Write};
use std::ops::{Deref, DerefMut, Range};
use std::path::Path;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use memmap2::{Mmap, MmapMut};

/// A multiple of it is where the bytes begin: a line of the cache.
pub const ALIGNMENT: usize = 64;

/// Bytes that begin at a multiple of [`ALIGNMENT`], so that they can be read as arrays of numbers.
///
/// Clones and parts share them. Those of a file are read when they are looked at, and take no memory that the system
/// could not have back.
#[derive(Clone)]
pub struct SharedBytes {
    source: Arc<Source>,
    range: Range<usize>,
}

enum Source {
    Buffer(Vec<Line>),
    File(Mmap),
}

/// As many bytes as the alignment.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([u8; ALIGNMENT]);

impl SharedBytes {
    /// Maps a file into memory. It must not be changed as long as the bytes are in use; files that
    /// [`write_atomically`](crate::files::write_atomically) replaces are not.
    pub fn of_file(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        #[expect(unsafe_code, reason = "another program could change the file")]
        // SAFETY: fpmcl writes files once, under another name, and then renames them; that other programs replace maps in
        // this way, too, is said in the documentation.
        let map = unsafe { Mmap::map(&file) }?;
        let range = 0..map.len();
        Ok(Self {
            source: Source::File(map).into(),
            range,
        })
    }

    /// A part; `None` if there are not as many bytes, or if it begins elsewhere than at a multiple of [`ALIGNMENT`].
    pub fn part(&self, range: Range<usize>) -> Option<Self> {
        let is_inside = range.start <= range.end && range.end <= self.len();
        (is_inside && range.start.is_multiple_of(ALIGNMENT)).then(|| Self {
            source: self.source.clone(),
            range: self.range.start + range.start..self.range.start + range.end,
        })
    }
}

impl SharedBytes {
    /// The parts of some sizes that follow each other; `None` if there are not as many bytes.
    pub fn parts<const N: usize>(&self, sizes: [u64; N]) -> Option<[Self; N]> {
        let parts: Option<Vec<Self>> = ranges_of(sizes)?
            .into_iter()
            .map(|range| self.part(range))
            .collect();
        parts?.try_into().ok()
    }

    /// The header that they begin with, if it begins with `magic` and a version as a number of 32 bits.
    pub fn header<H: Pod>(&self, magic: [u8; 8], version: u32) -> Option<H> {
        let bytes = self.get(..size_of::<H>())?;
        let is_it =
            bytes.starts_with(&magic) && bytes[magic.len()..].starts_with(&version.to_ne_bytes());
        is_it.then(|| bytemuck::pod_read_unaligned(bytes))
    }
}

impl From<&[u8]> for SharedBytes {
    fn from(bytes: &[u8]) -> Self {
        let mut lines = vec![Line::zeroed(); bytes.len().div_ceil(ALIGNMENT)];
        bytemuck::cast_slice_mut(&mut lines)[..bytes.len()].copy_from_slice(bytes);
        Self {
            source: Source::Buffer(lines).into(),
            range: 0..bytes.len(),
        }
    }
}

impl Deref for SharedBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let all = match &*self.source {
            Source::Buffer(lines) => bytemuck::cast_slice(lines),
            Source::File(map) => map,
        };
        &all[self.range.clone()]
    }
}

impl fmt::Debug for SharedBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} bytes", self.len())
    }
}

/// Bytes that are appended to an unnamed file: they take no memory that the system could not have back.
#[derive(Debug)]
pub struct GrowingBytes {
    file: File,
    map: MmapMut,
    /// Size of the part of the file that is mapped.
    reserved: usize,
    len: usize,
}

impl GrowingBytes {
    /// Most bytes that are reserved at a time.
    const LARGEST_STEP: usize = 1 << 22;

    /// Bytes whose file is in a folder, or if none can be made there, among temporary files.
    pub fn in_folder(folder: Option<&Path>, bytes: &[u8]) -> io::Result<Self> {
        let file = unnamed_file(folder)?;
        let map = MmapMut::map_anon(1)?;
        let mut all = Self {
            file,
            map,
            reserved: 0,
            len: 0,
        };
        all.extend(bytes)?;
        Ok(all)
    }

    /// Appends bytes; an error where the disk is full.
    pub fn extend(&mut self, bytes: &[u8]) -> io::Result<()> {
        let len = self.len + bytes.len();
        if len > self.reserved {
            // Written, not only claimed: a page that a full disk cannot hold would end the process when it is touched.
            let step = (len.clamp(1 << 16, Self::LARGEST_STEP)).max(len - self.reserved);
            self.file.seek(SeekFrom::Start(self.reserved as u64))?;
            io::copy(&mut io::repeat(0).take(step as u64), &mut &self.file)?;
            #[expect(unsafe_code, reason = "another program could change the file")]
            // SAFETY: the file has no name, and no other handle.
            let map = unsafe { MmapMut::map_mut(&self.file) }?;
            self.map = map;
            self.reserved += step;
        }
        self.map[self.len..len].copy_from_slice(bytes);
        self.len = len;
        Ok(())
    }
}

impl Deref for GrowingBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.map[..self.len]
    }
}

impl DerefMut for GrowingBytes {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.map[..self.len]
    }
}

/// A file without a name in a folder, or if none can be made there, among temporary files.
pub fn unnamed_file(folder: Option<&Path>) -> io::Result<File> {
    let in_folder = folder.and_then(|folder| tempfile::tempfile_in(folder).ok());
    in_folder.map_or_else(tempfile::tempfile, Ok)
}

/// Where parts of some sizes are that follow each other, each beginning at a multiple of [`ALIGNMENT`]; `None` if they are
/// longer than any file.
pub fn ranges_of<const N: usize>(sizes: [u64; N]) -> Option<[Range<usize>; N]> {
    let mut ranges = [const { 0..0 }; N];
    let mut begin = 0_usize;
    for (range, size) in ranges.iter_mut().zip(sizes) {
        let end = begin.checked_add(usize::try_from(size).ok()?)?;
        *range = begin..end;
        begin = end.checked_next_multiple_of(ALIGNMENT)?;
    }
    Some(ranges)
}

/// Writes a part of which the next one begins at a multiple of [`ALIGNMENT`].
pub fn write_part(out: &mut dyn Write, part: &[u8]) -> io::Result<()> {
    out.write_all(part)?;
    pad(out, part.len())
}

/// Writes zeros behind a part of some bytes, up to the next multiple of [`ALIGNMENT`].
pub fn pad(out: &mut dyn Write, bytes: usize) -> io::Result<()> {
    out.write_all(&[0; ALIGNMENT][..bytes.next_multiple_of(ALIGNMENT) - bytes])
}

/// Parts that follow each other.
pub fn join(parts: &[&[u8]]) -> Vec<u8> {
    let padded = |part: &&[u8]| part.len().next_multiple_of(ALIGNMENT);
    let mut bytes = Vec::with_capacity(parts.iter().map(padded).sum());
    for part in parts {
        bytes.extend_from_slice(part);
        bytes.resize(bytes.len().next_multiple_of(ALIGNMENT), 0);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_and_a_buffer_have_the_same_parts_at_aligned_addresses() {
        let bytes: Vec<u8> = (0..200).collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("numbers");
        std::fs::write(&path, &bytes).unwrap();
        for shared in [
            SharedBytes::from(&*bytes),
            SharedBytes::of_file(&path).unwrap(),
        ] {
            assert_eq!(&*shared, &*bytes);
            let part = shared.part(64..190).unwrap();
            assert_eq!(&*part, &bytes[64..190]);
            assert_eq!(&*part.part(64..70).unwrap(), &bytes[128..134]);
            assert!((part.as_ptr() as usize).is_multiple_of(ALIGNMENT));
            assert!(shared.part(63..100).is_none());
            assert!(shared.part(64..201).is_none());
            assert!(part.part(0..127).is_none());
        }
    }

    #[test]
    fn bytes_that_are_appended_stay_where_they_are_while_their_file_grows() {
        let folder = tempfile::tempdir().unwrap();
        let block: Vec<u8> = (0..=255).cycle().take(100_003).collect();
        for folder in [None, Some(folder.path()), Some(Path::new("no such folder"))] {
            let mut bytes = GrowingBytes::in_folder(folder, &block).unwrap();
            (1..60).for_each(|_| bytes.extend(&block).unwrap());
            bytes[7] = 99;
            assert_eq!(bytes.len(), 60 * block.len());
            assert_eq!(bytes[7], 99);
            bytes[7] = 7;
            assert!(bytes.chunks(block.len()).all(|chunk| chunk == block));
        }
    }

    #[test]
    fn parts_that_are_joined_are_found_again_and_those_of_a_shorter_file_are_not() {
        let (a, b, c) = ([1_u8; 70], [2_u8; 64], [3_u8; 5]);
        let bytes = join(&[&a, &b, &c]);
        let mut written = Vec::new();
        [&a[..], &b, &c]
            .iter()
            .for_each(|part| write_part(&mut written, part).unwrap());
        assert_eq!(bytes, written);
        let shared = SharedBytes::from(&*bytes);
        let [x, y, z] = shared.parts([70, 64, 5]).unwrap();
        assert!(*x == a && *y == b && *z == c);
        assert!(shared.parts([70, 64, 65]).is_none());
        assert!(shared.parts([70, u64::MAX]).is_none());
    }
}
