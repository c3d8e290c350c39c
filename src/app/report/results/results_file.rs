//! [`LocalizationResults`] as a `.npz` file.

use std::io::{self, Seek, Write};
use std::iter::repeat_n;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};

use bytemuck::Pod;

use super::columns::{Column, Row};
use super::localization_results::{LocalizationResults, ParticleLog, ScanOutline, columns};
use super::npz::{Array, NpzReader, not_valid, write_npy};
use super::npz_writer::{ArrayStream, NpzWriter};
use super::row_log::RowLog;
use crate::app::run::output;
use crate::evaluation::ParticleRow;
use crate::files::{AtomicFile, folder_of};
use crate::geometry::Pose2;
use crate::shared_bytes::unnamed_file;

/// Largest number of particles in empty rows, 4 GiB of zeros.
const MOST_EMPTY_PARTICLES: usize = 1 << 28;

impl LocalizationResults {
    /// Reads a file of fpmcl or of range-mcl.
    pub fn read(path: &Path) -> Result<Self> {
        let mut npz = NpzReader::open(path)?;
        let (rows, first, particles) = read_particles(path, &mut npz)?;
        let selected = read_number(&mut npz, "selected_frames")?;
        let times_are_assumed =
            read_number(&mut npz, "times_are_assumed")?.is_some_and(|it| it != 0);
        let mut file = RowReader {
            path,
            npz,
            rows,
            first,
        };
        let frames = file.frames()?;
        let scan_outlines = file.outlines()?;
        macro_rules! read {
            ($($name:ident),*) => {
                Self { frames, particles, scan_outlines, selected, times_are_assumed, $($name: file.column(stringify!($name))?),* }
            };
        }
        Ok(columns!(read))
    }

    /// Writes the file, replacing an existing one only when the new one is complete.
    ///
    /// Row k is frame k, as in range-mcl, if the frames are consecutive and the rows before the first
    /// are not too many; otherwise there is one row per localized frame.
    pub fn write(&self, path: &Path) -> Result<()> {
        self.writer(path, &self.frames)?.finish(self)
    }

    /// A writer of the file that has the rows so far, of a run of these frames.
    pub fn writer(&self, path: &Path, frames: &[usize]) -> Result<ResultWriter> {
        let begin = || {
            let has_particles = !self.particles.is_empty() || self.is_empty();
            let capacity = self.particles.capacity();
            let leading = leading_rows(frames, capacity);
            let mut writer = ResultWriter {
                file: AtomicFile::create(path)?,
                path: path.to_owned(),
                particles: None,
                outlines: None,
                leading,
                capacity,
            };
            if has_particles {
                let file = writer.file.file().try_clone()?;
                let mut stream = ArrayStream::begin(file, "particles", "<f4", &[capacity, 4])?;
                let empty = vec![[0.0_f32; 4]; capacity];
                (0..leading).try_for_each(|_| stream.push(bytemuck::cast_slice(&empty)))?;
                writer.particles = Some(stream);
            }
            if self.scan_outlines.is_some() {
                let file = unnamed_file(Some(folder_of(path)))?;
                let row = [2 * ScanOutline::MAX];
                let mut stream = ArrayStream::begin(file, "scan_outlines", "<i2", &row)?;
                let empty = [[0_i16; 2]; ScanOutline::MAX];
                (0..leading).try_for_each(|_| stream.push(bytemuck::cast_slice(&empty)))?;
                writer.outlines = Some(stream);
            }
            (0..self.len()).try_for_each(|row| writer.push(self, row))?;
            io::Result::Ok(writer)
        };
        begin().with_context(|| format!("cannot write {}", path.display()))
    }
}

/// The number of empty rows before the first frame that make row k frame k; none where these
/// would be a file of gigabytes.
fn leading_rows(frames: &[usize], capacity: usize) -> usize {
    let first = frames.first().copied().unwrap_or(0);
    let is_consecutive = (first..).zip(frames).all(|(row, &frame)| frame == row);
    let is_possible = first.saturating_mul(capacity.max(1)) <= MOST_EMPTY_PARTICLES;
    if is_consecutive && is_possible {
        first
    } else {
        0
    }
}

/// A result that is being written: particles and outlines of the scans frame by frame, the rest at the end.
pub struct ResultWriter {
    file: AtomicFile,
    path: PathBuf,
    particles: Option<ArrayStream>,
    /// In a file of its own, as the particles take up the other.
    outlines: Option<ArrayStream>,
    leading: usize,
    capacity: usize,
}

impl ResultWriter {
    /// Largest number of particles of a frame.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Appends a row of the results.
    pub fn push(&mut self, results: &LocalizationResults, row: usize) -> io::Result<()> {
        if let Some(stream) = &mut self.particles {
            let mut particles = results.particles.frame(row)?;
            particles.resize(self.capacity, [0.0; 4]);
            stream.push(bytemuck::cast_slice(&particles))?;
        }
        if results.scan_outlines.is_none() {
            self.outlines = None;
        }
        if let (Some(stream), Some(outlines)) = (&mut self.outlines, &results.scan_outlines) {
            let mut points = outlines.row(row)?;
            points.resize(ScanOutline::MAX, [0; 2]);
            stream.push(bytemuck::cast_slice(&points))?;
        }
        Ok(())
    }

    /// Completes the file, which then replaces an existing one.
    pub fn finish(self, results: &LocalizationResults) -> Result<()> {
        let path = self.path.clone();
        self.complete(results)
            .with_context(|| format!("cannot write {}", path.display()))
    }

    fn complete(self, results: &LocalizationResults) -> io::Result<()> {
        let leading = self.leading;
        let rows = leading + results.len();
        let mut npz = match self.particles {
            Some(stream) => NpzWriter::after(stream)?,
            None => NpzWriter::new(self.file.file().try_clone()?),
        };
        npz.add("start_idx", &[], [leading as i64])?;
        npz.add("numParticles", &[], [self.capacity as i64])?;
        let frames = (0..leading).chain(results.frames.iter().copied());
        npz.add("frames", &[rows], frames.map(|frame| frame as i64))?;
        if let Some(selected) = (results.selected).filter(|&selected| results.len() < selected) {
            npz.add("selected_frames", &[], [selected as i64])?;
        }
        if results.times_are_assumed {
            npz.add("times_are_assumed", &[], [1_i64])?;
        }
        let mut file = RowWriter { npz, leading };
        macro_rules! write {
            ($($name:ident),*) => { $(file.column(stringify!($name), results.$name.as_deref())?;)* };
        }
        columns!(write);
        if let Some(stream) = self.outlines {
            file.npz.add_stream(stream)?;
        }
        file.npz.finish()?;
        self.file.persist()
    }
}

/// Writes poses as a NumPy array (rows, 3) of x, y [m] and heading [rad].
pub fn write_poses_npy(path: &Path, poses: &[Pose2]) -> Result<()> {
    let numbers = poses.iter().flat_map(Row::to_row);
    output::write_file(path, |file| write_npy(file, &[poses.len(), 3], numbers))
}

/// Writes arrays of one row per frame after `leading` empty rows.
struct RowWriter<W: Write + Seek> {
    npz: NpzWriter<W>,
    leading: usize,
}

impl<W: Write + Seek> RowWriter<W> {
    fn column<T: Row<N>, const N: usize>(
        &mut self,
        name: &str,
        items: Option<&[T]>,
    ) -> io::Result<()> {
        let Some(items) = items else { return Ok(()) };
        let rows = repeat_n([T::EMPTY; N], self.leading).chain(items.iter().map(T::to_row));
        let shape = [self.leading + items.len(), N];
        let axes = if N == 1 { 1 } else { 2 };
        self.npz.add(name, &shape[..axes], rows.flatten())
    }
}

/// Reads the number of rows, the first row that was localized, and the particles from there on; a trajectory has none.
fn read_particles(path: &Path, npz: &mut NpzReader) -> Result<(usize, usize, ParticleLog)> {
    let [start_idx] = {
        let mut array = npz.required("start_idx")?;
        array.expect_shape(&[], "one number ()")?;
        array.next_row()?
    };
    let rows = npz
        .array("frames")?
        .and_then(|array| array.shape.first().copied());
    if let (None, Some(rows)) = (npz.array("particles")?, rows) {
        let first = first_row(path, start_idx, rows)?;
        return Ok((rows, first, ParticleLog::default()));
    }
    let mut array = npz.required("particles")?;
    array.expect_shape(&[None, None, Some(4)], "(frames, N, 4)")?;
    let (rows, capacity) = (array.shape[0], array.shape[1]);
    if capacity == 0 {
        // Any number of rows would need no data.
        array.expect_shape(&[Some(0), None, None], "(frames, N, 4) with N > 0")?;
    }
    let first = first_row(path, start_idx, rows)?;
    let mut log = ParticleLog::new(capacity, folder_of(path));
    for row in 0..rows {
        let particles = next_particles(&mut array, row, capacity)?;
        if row >= first {
            log.push_frame(&particles)?;
        }
    }
    Ok((rows, first, log))
}

/// The first row that was localized.
fn first_row(path: &Path, start_idx: f64, rows: usize) -> Result<usize> {
    ensure!(
        start_idx >= 0.0 && start_idx.fract() == 0.0 && (start_idx as usize) < rows.max(1),
        "{}: start_idx is {start_idx}, but there are {rows} rows",
        path.display()
    );
    Ok(start_idx as usize)
}

/// Reads a number that not every file has.
fn read_number(npz: &mut NpzReader, name: &'static str) -> Result<Option<usize>> {
    let Some(mut array) = npz.array(name)? else {
        return Ok(None);
    };
    array.expect_shape(&[], "one number ()")?;
    let [number] = array.next_finite_row(0)?;
    Ok(Some(number as usize))
}

/// Reads the particles of a frame without the padding after the last.
fn next_particles(array: &mut Array, row: usize, capacity: usize) -> Result<Vec<ParticleRow>> {
    let mut particles = Vec::new();
    let mut zeros = 0;
    for _ in 0..capacity {
        let particle: [f64; 4] = array.next_finite_row(row)?;
        if particle == [0.0; 4] {
            zeros += 1;
        } else {
            particles.resize(particles.len() + zeros, [0.0; 4]);
            zeros = 0;
            particles.push(particle.map(|number| number as f32));
        }
    }
    Ok(particles)
}

/// Reads arrays of one row per frame without the rows before the first localized frame.
struct RowReader<'a> {
    path: &'a Path,
    npz: NpzReader<'a>,
    rows: usize,
    first: usize,
}

impl RowReader<'_> {
    /// Reads an array of finite numbers, or unknown true poses, a row per item. `None` if it is missing, or empty, which means the
    /// same in range-mcl.
    fn column<T: Row<N> + Pod, const N: usize>(
        &mut self,
        name: &'static str,
    ) -> Result<Option<Column<T>>> {
        let Some(mut array) = self.npz.array(name)? else {
            return Ok(None);
        };
        if array.shape.first() == Some(&0) && self.rows > 0 {
            return Ok(None);
        }
        if N == 1 {
            array.expect_shape(&[Some(self.rows)], "one number per frame")?;
        } else {
            array.expect_shape(&[Some(self.rows), Some(N)], "one row per frame")?;
        }
        for _ in 0..self.first {
            array.next_row::<N>()?;
        }
        // Not every frame has a true pose.
        let may_be_unknown = name.starts_with("ground_truth");
        let item = |row| {
            let numbers = if may_be_unknown {
                array.next_row_or_unknown(row)?
            } else {
                array.next_finite_row(row)?
            };
            T::from_row(numbers).ok_or_else(|| not_valid(self.path, name, row, numbers[0]))
        };
        let items: Result<_> = (self.first..self.rows).map(item).collect();
        items.map(Some)
    }

    /// Reads the outlines of the scans.
    fn outlines(&mut self) -> Result<Option<RowLog<[i16; 2]>>> {
        const NAME: &str = "scan_outlines";
        const NUMBERS: usize = 2 * ScanOutline::MAX;
        let Some(mut array) = self.npz.array(NAME)? else {
            return Ok(None);
        };
        if array.shape.first() == Some(&0) && self.rows > 0 {
            return Ok(None);
        }
        array.expect_shape(&[Some(self.rows), Some(NUMBERS)], "one row per frame")?;
        let mut outlines = RowLog::in_folder(folder_of(self.path));
        for row in 0..self.rows {
            let numbers: [f64; NUMBERS] = array.next_finite_row(row)?;
            if row >= self.first {
                outlines.push(&ScanOutline::from_row(&numbers).0)?;
            }
        }
        Ok(Some(outlines))
    }

    /// Reads the frame of each row: the row itself if the file does not contain `frames`.
    fn frames(&mut self) -> Result<Column<usize>> {
        let Some(frames) = self.column::<f64, 1>("frames")? else {
            return Ok((self.first..self.rows).collect());
        };
        let mut previous = -1.0;
        for (row, &frame) in (self.first..).zip(&*frames) {
            if frame <= previous || frame.fract() != 0.0 {
                return Err(not_valid(self.path, "frames", row, frame));
            }
            previous = frame;
        }
        Ok(frames.iter().map(|&frame| frame as usize).collect())
    }
}
