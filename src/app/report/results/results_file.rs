//! [`LocalizationResults`] as a `.npz` file.

use std::io::{self, Seek, Write};
use std::iter::repeat_n;
use std::path::Path;

use anyhow::{Result, ensure};

use super::columns::Row;
use super::localization_results::{LocalizationResults, ParticleLog, columns};
use super::npz::{Array, NpzReader, NpzWriter, not_valid, write_npy};
use crate::app::run::output;
use crate::evaluation::ParticleRow;
use crate::geometry::Pose2;

/// Largest number of particles in empty rows, 4 GiB of zeros.
const MOST_EMPTY_PARTICLES: usize = 1 << 28;

impl LocalizationResults {
    /// Reads a file of fpmcl or of range-mcl.
    pub fn read(path: &Path) -> Result<Self> {
        let mut npz = NpzReader::open(path)?;
        let (rows, first, particles) = read_particles(path, &mut npz)?;
        let selected = read_selected(&mut npz)?;
        let mut file = RowReader {
            path,
            npz,
            rows,
            first,
        };
        let frames = file.frames()?;
        macro_rules! read {
            ($($name:ident),*) => {
                Self { frames, particles, selected, $($name: file.column(stringify!($name))?),* }
            };
        }
        Ok(columns!(read))
    }

    /// Writes the file, replacing an existing one only when the new one is complete.
    ///
    /// Row k is frame k, as in range-mcl, if the frames are consecutive and the rows before the first
    /// are not too many; otherwise there is one row per localized frame.
    pub fn write(&self, path: &Path) -> Result<()> {
        output::write_file(path, |file| self.write_to(file))
    }

    fn write_to(&self, file: impl Write + Seek) -> io::Result<()> {
        let has_particles = !self.particles.is_empty();
        debug_assert!(!has_particles || self.particles.len() == self.len());
        let leading = self.leading_rows();
        let rows = leading + self.len();
        let capacity = self.particles.capacity();
        let mut npz = NpzWriter::new(file);
        if has_particles || self.is_empty() {
            npz.add(
                "particles",
                &[rows, capacity, 4],
                repeat_n([0.0; 4], leading * capacity)
                    .chain((0..self.len()).flat_map(|row| self.padded_particles(row)))
                    .flatten(),
            )?;
        }
        npz.add("start_idx", &[], [leading as i64])?;
        npz.add("numParticles", &[], [capacity as i64])?;
        let frames = (0..leading).chain(self.frames.iter().copied());
        npz.add("frames", &[rows], frames.map(|frame| frame as i64))?;
        if let Some(selected) = self.selected.filter(|&selected| self.len() < selected) {
            npz.add("selected_frames", &[], [selected as i64])?;
        }
        let mut file = RowWriter { npz, leading };
        macro_rules! write {
            ($($name:ident),*) => { $(file.column(stringify!($name), self.$name.as_deref())?;)* };
        }
        columns!(write);
        file.npz.finish()
    }

    /// The number of empty rows before the first frame that make row k frame k; none where these
    /// would be a file of gigabytes.
    fn leading_rows(&self) -> usize {
        let first = self.frames.first().copied().unwrap_or(0);
        let is_consecutive = (first..)
            .zip(&self.frames)
            .all(|(row, &frame)| frame == row);
        let particles = first.saturating_mul(self.particles.capacity().max(1));
        let is_possible = particles <= MOST_EMPTY_PARTICLES;
        if is_consecutive && is_possible {
            first
        } else {
            0
        }
    }

    /// The particles of a frame, padded with zeros to the capacity.
    fn padded_particles(&self, row: usize) -> impl Iterator<Item = ParticleRow> {
        let particles = self.particles.frame(row);
        let padding = self.particles.capacity() - particles.len();
        particles.iter().copied().chain(repeat_n([0.0; 4], padding))
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
    let mut log = ParticleLog::new(capacity);
    for row in 0..rows {
        let particles = next_particles(&mut array, row, capacity)?;
        if row >= first {
            log.push_frame(particles);
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

/// Reads the number of frames to localize, which only a run that ended early wrote.
fn read_selected(npz: &mut NpzReader) -> Result<Option<usize>> {
    let Some(mut array) = npz.array("selected_frames")? else {
        return Ok(None);
    };
    array.expect_shape(&[], "one number ()")?;
    let [selected] = array.next_finite_row(0)?;
    Ok(Some(selected as usize))
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
    /// Reads an array of finite numbers, a row per item. `None` if it is missing, or empty, which means the
    /// same in range-mcl.
    fn column<T: Row<N>, const N: usize>(&mut self, name: &'static str) -> Result<Option<Vec<T>>> {
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
        let item = |row| {
            let numbers = array.next_finite_row(row)?;
            T::from_row(numbers).ok_or_else(|| not_valid(self.path, name, row, numbers[0]))
        };
        let items: Result<_> = (self.first..self.rows).map(item).collect();
        items.map(Some)
    }

    /// Reads the frame of each row: the row itself if the file does not contain `frames`.
    fn frames(&mut self) -> Result<Vec<usize>> {
        let Some(frames) = self.column::<f64, 1>("frames")? else {
            return Ok((self.first..self.rows).collect());
        };
        let mut previous = -1.0;
        for (row, &frame) in (self.first..).zip(&frames) {
            if frame <= previous || frame.fract() != 0.0 {
                return Err(not_valid(self.path, "frames", row, frame));
            }
            previous = frame;
        }
        Ok(frames.iter().map(|&frame| frame as usize).collect())
    }
}
