//! Panoramas of places and their descriptors, in memory or in a file next to the tiles of a map.
//!
//! ```text
//! header, request, places, panoramas, checksums of the panoramas, descriptors, checksum of all but the panoramas
//! ```
//!
//! Each part begins at a multiple of 64 bytes; numbers are little-endian.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};

use super::descriptor::PlaceDescriptor;
use super::scan_panorama::{FAR, steps_of};
use crate::files::{folder_of, remove_abandoned, require_no_link, require_own, write_atomically};
use crate::lidar::LidarModel;
use crate::raycasting::{TileError, TileProblem};
use crate::rendering::RenderError;
use crate::shared_bytes::{SharedBytes, pad, ranges_of, write_part};

/// Panoramas rendered at a time.
pub(crate) const BATCH: usize = 512;
/// From this number of places on, each tenth that is rendered is logged: they take about five seconds.
const MANY_PLACES: usize = 20_000;

pub(crate) const MAGIC: [u8; 8] = *b"fpmclpan";
const VERSION: u32 = 1;

/// A cell of the search on a level of the ground.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Place {
    /// Centre of the cell [m].
    pub x: f64,
    pub y: f64,
    /// Height of the ground [m].
    pub level_m: f64,
}

/// Panoramas of places, and their descriptors.
#[derive(Clone, Debug)]
pub(crate) struct Panoramas {
    places: Vec<Place>,
    descriptors: Vec<PlaceDescriptor>,
    checksums: Vec<u32>,
    /// Pixels of a panorama.
    pixels: usize,
    source: Source,
}

#[derive(Clone, Debug)]
enum Source {
    Memory(Arc<[u16]>),
    /// A file, where in it the panoramas begin, and the opened file: another process may remove it.
    File(PathBuf, u64, Arc<File>),
}

/// Reads panoramas, one after the other.
pub(crate) struct PanoramaReader<'a>(&'a Panoramas);

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Header {
    magic: [u8; 8],
    version: u32,
    unused: u32,
    request_bytes: u64,
    places: u64,
    pixels: u64,
    rest: [u8; 24],
}

impl Header {
    /// Sizes of all parts, in their order [bytes].
    fn sizes(&self) -> [u64; 7] {
        let of = |size: usize| self.places.saturating_mul(size as u64);
        [
            size_of::<Self>() as u64,
            self.request_bytes,
            of(size_of::<Place>()),
            of(2).saturating_mul(self.pixels),
            of(size_of::<u32>()),
            of(size_of::<PlaceDescriptor>()),
            size_of::<u32>() as u64,
        ]
    }
}

/// What panoramas are described and checked by.
struct Described {
    descriptors: Vec<PlaceDescriptor>,
    checksums: Vec<u32>,
}

impl Panoramas {
    /// Renders the panoramas into memory.
    pub fn render(
        places: &[Place],
        model: &LidarModel,
        render: impl Fn(Range<usize>) -> Result<Vec<Vec<f32>>, RenderError>,
    ) -> Result<Self, RenderError> {
        let mut images = Vec::with_capacity(places.len() * model.len());
        let described = render_all(places.len(), model, render, |image| {
            images.extend_from_slice(image);
            Ok::<_, RenderError>(())
        })?;
        Ok(Self {
            places: places.to_vec(),
            descriptors: described.descriptors,
            checksums: described.checksums,
            pixels: model.len(),
            source: Source::Memory(images.into()),
        })
    }

    /// Renders the panoramas into a file, which is that of a request; `None` if it cannot be written.
    pub fn write(
        path: &Path,
        request: &str,
        places: &[Place],
        model: &LidarModel,
        render: impl Fn(Range<usize>) -> Result<Vec<Vec<f32>>, RenderError>,
    ) -> Result<Option<Self>, RenderError> {
        let header = Header {
            magic: MAGIC,
            version: VERSION,
            unused: 0,
            request_bytes: request.len() as u64,
            places: places.len() as u64,
            pixels: model.len() as u64,
            rest: [0; 24],
        };
        let Some([_, _, _, images, ..]) = ranges_of(header.sizes()) else {
            return Ok(None);
        };
        // What cannot be removed is reported when the file cannot be written.
        let _ = remove_abandoned(path);
        let write = || {
            require_no_link(folder_of(path))?;
            require_own(path, Some(MAGIC))?;
            let described = write_atomically(path, |out| {
                let mut hasher = crc32fast::Hasher::new();
                let mut write = |out: &mut dyn Write, part: &[u8]| -> io::Result<()> {
                    hasher.update(part);
                    write_part(out, part)
                };
                write(out, bytemuck::bytes_of(&header))?;
                write(out, request.as_bytes())?;
                write(out, bytemuck::cast_slice(places))?;
                let described = render_all(places.len(), model, &render, |image| {
                    Ok::<_, Failure>(out.write_all(bytemuck::cast_slice(image))?)
                })?;
                pad(out, images.len())?;
                write(out, bytemuck::cast_slice(&described.checksums))?;
                write(out, bytemuck::cast_slice(&described.descriptors))?;
                write_part(out, &hasher.finalize().to_le_bytes())?;
                Ok::<_, Failure>(described)
            })?;
            Ok((described, File::open(path)?))
        };
        match write() {
            Ok((described, file)) => Ok(Some(Self {
                places: places.to_vec(),
                descriptors: described.descriptors,
                checksums: described.checksums,
                pixels: model.len(),
                source: Source::File(path.to_owned(), images.start as u64, file.into()),
            })),
            Err(Failure::Render(error)) => Err(error),
            Err(Failure::Write(error)) => {
                let path = path.display();
                tracing::warn!(
                    "{path} cannot be written ({error}): the panoramas are kept in memory"
                );
                Ok(None)
            }
        }
    }

    /// Opens the panoramas of a request; `None` if the file does not have them.
    pub fn open(path: &Path, request: &str) -> Option<Self> {
        if path.is_symlink() {
            return None;
        }
        let file = SharedBytes::of_file(path).ok()?;
        let header: Header = file.header(MAGIC, VERSION)?;
        let images_begin = ranges_of(header.sizes())?[3].start as u64;
        let [first, of, places, _, checksums, descriptors, checksum] =
            file.parts(header.sizes())?;
        let mut hasher = crc32fast::Hasher::new();
        for part in [&first, &of, &places, &checksums, &descriptors] {
            hasher.update(part);
        }
        let is_it = *of == *request.as_bytes() && *checksum == hasher.finalize().to_le_bytes();
        let opened = if is_it {
            File::open(path).ok()?
        } else {
            return None;
        };
        Some(Self {
            places: bytemuck::cast_slice(&places).to_vec(),
            descriptors: bytemuck::cast_slice(&descriptors).to_vec(),
            checksums: bytemuck::cast_slice(&checksums).to_vec(),
            pixels: header.pixels as usize,
            source: Source::File(path.to_owned(), images_begin, opened.into()),
        })
    }

    pub fn places(&self) -> &[Place] {
        &self.places
    }

    pub fn descriptors(&self) -> &[PlaceDescriptor] {
        &self.descriptors
    }

    pub fn reader(&self) -> PanoramaReader<'_> {
        PanoramaReader(self)
    }
}

impl PanoramaReader<'_> {
    /// The panorama of a place, row-major [steps].
    pub fn read(&self, place: usize) -> Result<Cow<'_, [u16]>, TileError> {
        let pixels = self.0.pixels;
        match &self.0.source {
            Source::Memory(images) => Ok(images[place * pixels..(place + 1) * pixels].into()),
            Source::File(path, first, file) => {
                let mut image = vec![0_u16; pixels];
                let begin = first + 2 * (place * pixels) as u64;
                read_at(file, path, begin, bytemuck::cast_slice_mut(&mut image))
                    .map_err(TileProblem::from)
                    .and_then(|()| {
                        let checksum = crc32fast::hash(bytemuck::cast_slice(&image));
                        if checksum == self.0.checksums[place] {
                            Ok(image.into())
                        } else {
                            Err(TileProblem::Checksum)
                        }
                    })
                    .map_err(|problem| TileError::new(path.clone(), problem))
            }
        }
    }
}

#[cfg(unix)]
fn read_at(file: &File, _path: &Path, begin: u64, bytes: &mut [u8]) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, begin)
}

/// Elsewhere, a file that is open is not removed.
#[cfg(not(unix))]
fn read_at(_file: &File, path: &Path, begin: u64, bytes: &mut [u8]) -> io::Result<()> {
    use std::io::{Read as _, Seek as _, SeekFrom};
    let mut file = File::open(path)?;
    file.seek(SeekFrom::Start(begin))?;
    file.read_exact(bytes)
}

/// Why panoramas cannot be rendered into a file.
enum Failure {
    Render(RenderError),
    Write(io::Error),
}

impl From<RenderError> for Failure {
    fn from(error: RenderError) -> Self {
        Self::Render(error)
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Write(error)
    }
}

/// Renders panoramas, a few at a time, and describes them.
fn render_all<E: From<RenderError>>(
    places: usize,
    model: &LidarModel,
    render: impl Fn(Range<usize>) -> Result<Vec<Vec<f32>>, RenderError>,
    mut add: impl FnMut(&[u16]) -> Result<(), E>,
) -> Result<Described, E> {
    let mut described = Described {
        descriptors: Vec::with_capacity(places),
        checksums: Vec::with_capacity(places),
    };
    let steps = |&range_m: &f32| {
        if range_m.is_finite() {
            steps_of(range_m)
        } else {
            FAR
        }
    };
    for first in (0..places).step_by(BATCH) {
        let last = places.min(first + BATCH);
        let tenths = |count: usize| 10 * count / places;
        if places >= MANY_PLACES && (first == 0 || tenths(first) > tenths(first - BATCH)) {
            let percent = 10 * tenths(first);
            tracing::info!(places, percent, "rendering panoramas of the map");
        }
        for image in render(first..last)? {
            let image: Vec<u16> = image.iter().map(steps).collect();
            described
                .descriptors
                .push(PlaceDescriptor::of(&image, model.width));
            described
                .checksums
                .push(crc32fast::hash(bytemuck::cast_slice(&image)));
            add(&image)?;
        }
    }
    Ok(described)
}
