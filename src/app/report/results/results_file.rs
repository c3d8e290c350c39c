//! [`LocalizationResults`] as a `.npz` file.

use std::io::{self, Seek, Write};
use std::iter::repeat_n;
use std::path::Path;

use anyhow::{Context as _, Result, anyhow, ensure};
use nalgebra::{Matrix3, Quaternion, Translation3, UnitQuaternion, Vector2};

use super::localization_results::{LocalizationResults, ParticleLog, ScanOutline};
use super::npz::{Array, NpzReader, NpzWriter, write_npy};
use crate::evaluation::ParticleRow;
use crate::files::write_atomically;
use crate::geometry::{Pose2, Pose3};

/// Largest number of particles in empty rows, 4 GiB of zeros.
const MOST_EMPTY_PARTICLES: usize = 1 << 28;

/// Numbers in a row of an outline.
const OUTLINE_NUMBERS: usize = 2 * ScanOutline::MAX;

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
        let mut poses = |name| file.rows(name, pose_from_row);
        let (estimates, refined) = (poses("estimates")?, poses("refined")?);
        let (ground_truth, odometry) = (poses("ground_truth")?, poses("odometry")?);
        let mut spatial = |name| file.rows(name, pose_in_space_from_row);
        let (estimates_in_space, refined_in_space) =
            (spatial("estimates_in_space")?, spatial("refined_in_space")?);
        let ground_truth_in_space = spatial("ground_truth_in_space")?;
        let mut matrices = |name| file.rows(name, |row: [f64; 9]| Matrix3::from_row_slice(&row));
        let (covariances, refined_covariances) =
            (matrices("covariances")?, matrices("refined_covariances")?);
        Ok(Self {
            frames,
            particles,
            estimates,
            refined,
            ground_truth,
            estimates_in_space,
            refined_in_space,
            ground_truth_in_space,
            odometry,
            covariances,
            refined_covariances,
            times_s: file.rows("times_s", |[time_s]| time_s)?,
            runtimes_s: file.rows("runtimes_s", |[time_s]| time_s)?,
            refine_runtimes_s: file.rows("refine_runtimes_s", |[time_s]| time_s)?,
            agreements: file.rows("agreements", |[share]| share)?,
            places: file.rows("places", |[places]| places)?,
            states: file.states()?,
            scan_outlines: file.rows("scan_outlines", outline_from_row)?,
            selected,
        })
    }

    /// Writes the file, replacing an existing one only when the new one is complete.
    ///
    /// Row k is frame k, as in range-mcl, if the frames are consecutive and the rows before the first
    /// are not too many; otherwise there is one row per localized frame.
    pub fn write(&self, path: &Path) -> Result<()> {
        write_atomically(path, |file| self.write_to(file))
            .with_context(|| format!("cannot write {}", path.display()))
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
        file.rows("estimates", &self.estimates, row_from_pose)?;
        file.rows("refined", &self.refined, row_from_pose)?;
        file.rows("ground_truth", &self.ground_truth, row_from_pose)?;
        for (name, poses) in [
            ("estimates_in_space", &self.estimates_in_space),
            ("refined_in_space", &self.refined_in_space),
            ("ground_truth_in_space", &self.ground_truth_in_space),
        ] {
            file.rows(name, poses, row_from_pose_in_space)?;
        }
        file.rows("odometry", &self.odometry, row_from_pose)?;
        file.rows("covariances", &self.covariances, row_from_matrix)?;
        file.rows(
            "refined_covariances",
            &self.refined_covariances,
            row_from_matrix,
        )?;
        file.numbers("times_s", &self.times_s, f64::NAN)?;
        file.numbers("runtimes_s", &self.runtimes_s, f64::NAN)?;
        file.numbers("refine_runtimes_s", &self.refine_runtimes_s, f64::NAN)?;
        file.numbers("agreements", &self.agreements, f64::NAN)?;
        file.numbers("places", &self.places, f64::NAN)?;
        file.numbers("states", &self.states, 0)?;
        file.outlines(&self.scan_outlines)?;
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
    let numbers = poses.iter().flat_map(row_from_pose);
    write_atomically(path, |file| write_npy(file, &[poses.len(), 3], numbers))
        .with_context(|| format!("cannot write {}", path.display()))
}

fn pose_from_row([x, y, heading]: [f64; 3]) -> Pose2 {
    Pose2::new(Vector2::new(x, y), heading)
}

fn row_from_pose(pose: &Pose2) -> [f64; 3] {
    let t = pose.translation;
    [t.x, t.y, pose.rotation.angle()]
}

/// The rotation of a row of zeros is the identity.
fn pose_in_space_from_row([x, y, z, i, j, k, w]: [f64; 7]) -> Pose3 {
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), f64::MIN_POSITIVE);
    Pose3::from_parts(Translation3::new(x, y, z), rotation.unwrap_or_default())
}

fn row_from_pose_in_space(pose: &Pose3) -> [f64; 7] {
    let (t, q) = (pose.translation, pose.rotation);
    [t.x, t.y, t.z, q.i, q.j, q.k, q.w]
}

fn row_from_matrix(matrix: &Matrix3<f64>) -> [f64; 9] {
    std::array::from_fn(|index| matrix[(index / 3, index % 3)])
}

/// The points of a row up to the last that is not zero.
fn outline_from_row(row: [f64; OUTLINE_NUMBERS]) -> ScanOutline {
    let mut points: Vec<[i16; 2]> = row
        .as_chunks()
        .0
        .iter()
        .map(|point: &[f64; 2]| point.map(|it| it as i16))
        .collect();
    while points.last() == Some(&[0, 0]) {
        points.pop();
    }
    ScanOutline(points)
}

/// Writes arrays of one row per frame after `leading` empty rows.
struct RowWriter<W: Write + Seek> {
    npz: NpzWriter<W>,
    leading: usize,
}

impl<W: Write + Seek> RowWriter<W> {
    fn rows<T, const N: usize>(
        &mut self,
        name: &str,
        items: &Option<Vec<T>>,
        row: impl Fn(&T) -> [f64; N],
    ) -> io::Result<()> {
        let Some(items) = items else { return Ok(()) };
        let numbers = repeat_n([f64::NAN; N], self.leading).chain(items.iter().map(row));
        let shape = [self.leading + items.len(), N];
        self.npz.add(name, &shape, numbers.flatten())
    }

    fn outlines(&mut self, items: &Option<Vec<ScanOutline>>) -> io::Result<()> {
        let Some(items) = items else { return Ok(()) };
        let shape = [self.leading + items.len(), OUTLINE_NUMBERS];
        let row = |outline: &ScanOutline| -> Vec<i16> {
            let mut row = outline.0.concat();
            row.resize(OUTLINE_NUMBERS, 0);
            row
        };
        let numbers = repeat_n(0, self.leading * OUTLINE_NUMBERS);
        let numbers = numbers.chain(items.iter().flat_map(row));
        self.npz.add("scan_outlines", &shape, numbers)
    }

    fn numbers<T: npyz::AutoSerialize + Copy>(
        &mut self,
        name: &str,
        items: &Option<Vec<T>>,
        empty: T,
    ) -> io::Result<()> {
        let Some(items) = items else { return Ok(()) };
        let numbers = repeat_n(empty, self.leading).chain(items.iter().copied());
        self.npz.add(name, &[self.leading + items.len()], numbers)
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
    /// Reads an array of `N` finite numbers per row. `None` if it is missing, or empty, which
    /// means the same in range-mcl.
    fn rows<const N: usize, T>(
        &mut self,
        name: &'static str,
        item: impl Fn([f64; N]) -> T,
    ) -> Result<Option<Vec<T>>> {
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
        (self.first..self.rows)
            .map(|row| Ok(item(array.next_finite_row(row)?)))
            .collect::<Result<_, _>>()
            .map(Some)
    }

    /// Reads the frame of each row: the row itself if the file does not contain `frames`.
    fn frames(&mut self) -> Result<Vec<usize>> {
        let Some(frames) = self.rows("frames", |[frame]| frame)? else {
            return Ok((self.first..self.rows).collect());
        };
        let mut previous = -1.0;
        for (row, &frame) in (self.first..).zip(&frames) {
            if frame <= previous || frame.fract() != 0.0 {
                return Err(self.invalid("frames", row, frame));
            }
            previous = frame;
        }
        Ok(frames.iter().map(|&frame| frame as usize).collect())
    }

    /// Reads the states of the filter.
    fn states(&mut self) -> Result<Option<Vec<u8>>> {
        let Some(states) = self.rows("states", |[state]| state)? else {
            return Ok(None);
        };
        let state_in = |(row, &state): (usize, &f64)| match state as u8 {
            number if f64::from(number) == state => Ok(number),
            _ => Err(self.invalid("states", row, state)),
        };
        let states = (self.first..).zip(&states).map(state_in);
        states.collect::<Result<_>>().map(Some)
    }

    fn invalid(&self, name: &str, row: usize, value: f64) -> anyhow::Error {
        let path = self.path.display();
        anyhow!("{path}, array `{name}`, row {row}: {value} is not a valid value")
    }
}
