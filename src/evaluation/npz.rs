//! Result files on disk: streamed in and out, one particle at a time.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, Write};
use std::path::Path;

use nalgebra::Matrix3;
use ndarray::{Array1, Array2, arr0, aview1};
use ndarray_npy::{NpzWriter, WriteNpyError, WriteNpyExt, WriteNpzError};
use zip::ZipArchive;
use zip::result::ZipError;
use zip::write::SimpleFileOptions;

use super::npy::{NpyError, NpyReader, header_bytes};
use super::results::{LocalizationResults, ParticleLog, ResultsError};
use super::write_atomically;
use crate::geometry::Pose2;

/// Largest entry of a zip file without 64-bit extensions [bytes].
const ZIP32_LIMIT: usize = u32::MAX as usize;

impl LocalizationResults {
    /// Writes the file, replacing one that is there only when the new one is whole.
    ///
    /// Rows are frames from 0 on, as range-mcl has them, where no frames are left out between
    /// the first and the last; otherwise there is one row per localized frame.
    pub fn write(&self, path: &Path) -> Result<(), ResultsError> {
        for (array, found) in self.lengths() {
            if found != self.len() {
                return Err(ResultsError::WrongLength {
                    path: path.to_owned(),
                    array,
                    found,
                    expected: self.len(),
                });
            }
        }
        write_atomically(path, |file| self.write_to(file).map_err(into_io)).map_err(|source| {
            ResultsError::Write {
                path: path.to_owned(),
                source,
            }
        })
    }

    fn write_to<W: Write + Seek>(&self, file: W) -> Result<(), WriteNpzError> {
        let leading = self.leading_rows();
        let particles = PaddedParticles {
            log: &self.particles,
            leading,
        };
        let options = SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Deflated)
            .large_file(particles.bytes() > ZIP32_LIMIT);
        let mut npz = NpzWriter::new_with_options(file, options);
        npz.add_array("particles", &particles)?;
        npz.add_array("start_idx", &arr0(leading as i64))?;
        npz.add_array("numParticles", &arr0(self.particles.capacity() as i64))?;
        let frames = (0..leading).chain(self.frames.iter().copied());
        npz.add_array(
            "frames",
            &frames.map(|frame| frame as i64).collect::<Array1<_>>(),
        )?;
        for (name, poses) in [
            ("estimates", &self.estimates),
            ("refined", &self.refined),
            ("ground_truth", &self.ground_truth),
            ("odometry", &self.odometry),
        ] {
            if let Some(poses) = poses {
                npz.add_array(name, &table(leading, poses, pose_row))?;
            }
        }
        if let Some(covariances) = &self.covariances {
            npz.add_array("covariances", &table(leading, covariances, matrix_row))?;
        }
        for (name, numbers) in [
            ("times_s", &self.times_s),
            ("runtimes_s", &self.runtimes_s),
            ("refine_runtimes_s", &self.refine_runtimes_s),
        ] {
            if let Some(numbers) = numbers {
                npz.add_array(name, &column(leading, numbers, f64::NAN))?;
            }
        }
        if let Some(states) = &self.states {
            npz.add_array("states", &column(leading, states, 0))?;
        }
        npz.finish()?;
        Ok(())
    }

    /// How many rows of nothing stand before the first frame, so that row k is frame k.
    fn leading_rows(&self) -> usize {
        let first = self.frames.first().copied().unwrap_or(0);
        let contiguous = self
            .frames
            .iter()
            .enumerate()
            .all(|(row, &frame)| frame == first + row);
        if contiguous { first } else { 0 }
    }

    /// Reads a file of ours or of range-mcl.
    pub fn read(path: &Path) -> Result<Self, ResultsError> {
        let file = File::open(path).map_err(|source| ResultsError::Read {
            path: path.to_owned(),
            source,
        })?;
        let archive = ZipArchive::new(BufReader::new(file)).map_err(|source| match source {
            ZipError::Io(source) => ResultsError::Read {
                path: path.to_owned(),
                source,
            },
            source => ResultsError::NotNpz {
                path: path.to_owned(),
                source,
            },
        })?;
        ResultsReader { path, archive }.read()
    }
}

/// Writes poses as a NumPy array (rows, 3) of x, y [m] and heading [rad].
pub fn write_poses_npy(path: &Path, poses: &[Pose2]) -> Result<(), ResultsError> {
    let poses = table(0, poses, pose_row);
    write_atomically(path, |file| match poses.write_npy(file) {
        Err(WriteNpyError::Io(error)) => Err(error),
        outcome => outcome.map_err(io::Error::other),
    })
    .map_err(|source| ResultsError::Write {
        path: path.to_owned(),
        source,
    })
}

/// The arrays of one file.
struct ResultsReader<'a> {
    path: &'a Path,
    archive: ZipArchive<BufReader<File>>,
}

impl ResultsReader<'_> {
    fn read(mut self) -> Result<LocalizationResults, ResultsError> {
        let (rows, start_idx, particles) = self.read_particles()?;
        let frames = self.read_frames(rows, start_idx)?;
        let covariances = self.table::<9>("covariances", rows, start_idx)?;
        let states = self.table::<1>("states", rows, start_idx)?;
        let results = LocalizationResults {
            frames,
            particles,
            estimates: self.poses("estimates", rows, start_idx)?,
            refined: self.poses("refined", rows, start_idx)?,
            ground_truth: self.poses("ground_truth", rows, start_idx)?,
            odometry: self.poses("odometry", rows, start_idx)?,
            covariances: covariances.map(|rows| rows.iter().map(matrix_of).collect()),
            times_s: self.column("times_s", rows, start_idx)?,
            runtimes_s: self.column("runtimes_s", rows, start_idx)?,
            refine_runtimes_s: self.column("refine_runtimes_s", rows, start_idx)?,
            states: states.map(|rows| rows.iter().map(|&[state]| state as u8).collect()),
        };
        Ok(results)
    }

    /// Number of stored rows, the first that counts, and the particles from there on.
    fn read_particles(&mut self) -> Result<(usize, usize, ParticleLog), ResultsError> {
        let path = self.path.to_owned();
        let start_idx = self.required("start_idx", |array| {
            array.expect_shape(&[], "one number ()")?;
            array.next_number()
        })?;
        let particles = self.required("particles", |array| {
            array.expect_shape(&[None, None, Some(4)], "(frames, N, 4)")?;
            let (rows, capacity) = (array.shape[0], array.shape[1]);
            if !(start_idx >= 0.0 && (start_idx as usize) < rows.max(1)) {
                return Ok(Err(ResultsError::StartBehindEnd {
                    path: path.clone(),
                    start_idx,
                    rows,
                }));
            }
            let mut log = ParticleLog::new(capacity);
            for row in 0..rows {
                let particles = match next_particles(array, capacity)? {
                    Ok(particles) => particles,
                    Err(value) => {
                        return Ok(Err(ResultsError::BadNumber {
                            path: path.clone(),
                            array: "particles",
                            row,
                            value,
                        }));
                    }
                };
                if row >= start_idx as usize {
                    log.push_frame(particles);
                }
            }
            Ok(Ok((rows, log)))
        })?;
        let (rows, log) = particles?;
        Ok((rows, start_idx as usize, log))
    }

    /// The frame of each row: the row itself, where the file does not say.
    fn read_frames(&mut self, rows: usize, start_idx: usize) -> Result<Vec<usize>, ResultsError> {
        let Some(frames) = self.column("frames", rows, start_idx)? else {
            return Ok((start_idx..rows).collect());
        };
        let mut previous = -1.0;
        for (row, &frame) in frames.iter().enumerate() {
            if frame <= previous || frame.fract() != 0.0 {
                return Err(ResultsError::BadNumber {
                    path: self.path.to_owned(),
                    array: "frames",
                    row: start_idx + row,
                    value: frame,
                });
            }
            previous = frame;
        }
        Ok(frames.iter().map(|&frame| frame as usize).collect())
    }

    fn poses(
        &mut self,
        name: &'static str,
        rows: usize,
        start_idx: usize,
    ) -> Result<Option<Vec<Pose2>>, ResultsError> {
        let table = self.table::<3>(name, rows, start_idx)?;
        Ok(table.map(|rows| {
            rows.iter()
                .map(|&[x, y, heading]| Pose2::new(nalgebra::Vector2::new(x, y), heading))
                .collect()
        }))
    }

    fn column(
        &mut self,
        name: &'static str,
        rows: usize,
        start_idx: usize,
    ) -> Result<Option<Vec<f64>>, ResultsError> {
        let table = self.table::<1>(name, rows, start_idx)?;
        Ok(table.map(|rows| rows.iter().map(|&[number]| number).collect()))
    }

    /// The rows from `start_idx` on of an array of `N` numbers a row, all finite; `None` where
    /// there is no such array, or an empty one, which is how range-mcl says the same.
    fn table<const N: usize>(
        &mut self,
        name: &'static str,
        rows: usize,
        start_idx: usize,
    ) -> Result<Option<Vec<[f64; N]>>, ResultsError> {
        let table = self.array(name, |array| {
            if array.shape.first() == Some(&0) && rows > 0 {
                return Ok(None);
            }
            if N == 1 {
                array.expect_shape(&[Some(rows)], "one number per frame")?;
            } else {
                array.expect_shape(&[Some(rows), Some(N)], "one row per frame")?;
            }
            let table: Result<Vec<[f64; N]>, NpyError> =
                (0..rows).map(|_| array.next_row()).collect();
            Ok(Some(table?.split_off(start_idx)))
        })?;
        let table = table.flatten();
        for (row, numbers) in table.iter().flatten().enumerate() {
            if let Some(&value) = numbers.iter().find(|number| !number.is_finite()) {
                return Err(ResultsError::BadNumber {
                    path: self.path.to_owned(),
                    array: name,
                    row: start_idx + row,
                    value,
                });
            }
        }
        Ok(table)
    }

    fn required<T>(
        &mut self,
        name: &'static str,
        read: impl FnOnce(&mut NpyReader<&mut dyn Read>) -> Result<T, NpyError>,
    ) -> Result<T, ResultsError> {
        self.array(name, read)?
            .ok_or_else(|| ResultsError::MissingArray {
                path: self.path.to_owned(),
                array: name,
            })
    }

    fn array<T>(
        &mut self,
        name: &'static str,
        read: impl FnOnce(&mut NpyReader<&mut dyn Read>) -> Result<T, NpyError>,
    ) -> Result<Option<T>, ResultsError> {
        let entry = match self.archive.by_name(&format!("{name}.npy")) {
            Ok(entry) => entry,
            Err(ZipError::FileNotFound) => return Ok(None),
            Err(source) => {
                return Err(ResultsError::NotNpz {
                    path: self.path.to_owned(),
                    source,
                });
            }
        };
        let bytes = entry.size();
        let mut entry = BufReader::with_capacity(1 << 16, entry);
        NpyReader::new(&mut entry as &mut dyn Read, bytes)
            .and_then(|mut array| read(&mut array))
            .map(Some)
            .map_err(|source| ResultsError::BadArray {
                path: self.path.to_owned(),
                array: name,
                source,
            })
    }
}

/// The particles of the next frame without the zeros after the last, or a number that is not finite.
fn next_particles(
    array: &mut NpyReader<&mut dyn Read>,
    capacity: usize,
) -> Result<Result<Vec<[f32; 4]>, f64>, NpyError> {
    let mut particles = Vec::new();
    let mut zeros = 0;
    for _ in 0..capacity {
        let row: [f64; 4] = array.next_row()?;
        if let Some(&value) = row.iter().find(|number| !number.is_finite()) {
            return Ok(Err(value));
        }
        if row == [0.0; 4] {
            zeros += 1;
        } else {
            particles.resize(particles.len() + zeros, [0.0; 4]);
            zeros = 0;
            particles.push(row.map(|number| number as f32));
        }
    }
    Ok(Ok(particles))
}

fn matrix_of(row: &[f64; 9]) -> Matrix3<f64> {
    Matrix3::from_row_slice(row)
}

fn pose_row(pose: &Pose2) -> [f64; 3] {
    [
        pose.translation.x,
        pose.translation.y,
        pose.rotation.angle(),
    ]
}

fn matrix_row(matrix: &Matrix3<f64>) -> [f64; 9] {
    std::array::from_fn(|index| matrix[(index / 3, index % 3)])
}

/// An array of one row per item, after `leading` rows of NaN.
fn table<T, const N: usize>(
    leading: usize,
    items: &[T],
    row: impl Fn(&T) -> [f64; N],
) -> Array2<f64> {
    let mut table = Array2::from_elem((leading + items.len(), N), f64::NAN);
    for (mut cells, item) in table.rows_mut().into_iter().skip(leading).zip(items) {
        cells.assign(&aview1(&row(item)));
    }
    table
}

/// An array of one number per item, after `leading` times `absent`.
fn column<T: Copy>(leading: usize, items: &[T], absent: T) -> Array1<T> {
    std::iter::repeat_n(absent, leading)
        .chain(items.iter().copied())
        .collect()
}

fn into_io(error: WriteNpzError) -> io::Error {
    match error {
        WriteNpzError::Zip(ZipError::Io(error)) | WriteNpzError::Npy(WriteNpyError::Io(error)) => {
            error
        }
        other => io::Error::other(other),
    }
}

/// Particles as the array (rows, N, 4) that they stand for.
struct PaddedParticles<'a> {
    log: &'a ParticleLog,
    leading: usize,
}

impl PaddedParticles<'_> {
    fn shape(&self) -> [usize; 3] {
        [self.leading + self.log.len(), self.log.capacity(), 4]
    }

    fn bytes(&self) -> usize {
        self.shape().iter().product::<usize>() * size_of::<f32>()
    }
}

impl WriteNpyExt for PaddedParticles<'_> {
    fn write_npy<W: Write>(&self, writer: W) -> Result<(), WriteNpyError> {
        let mut writer = BufWriter::new(writer);
        let zero = [0.0_f32; 4];
        writer.write_all(&header_bytes("<f4", &self.shape()))?;
        for _ in 0..self.leading * self.log.capacity() {
            write_floats(&mut writer, &zero)?;
        }
        for row in 0..self.log.len() {
            let particles = self.log.frame(row);
            for particle in particles {
                write_floats(&mut writer, particle)?;
            }
            for _ in particles.len()..self.log.capacity() {
                write_floats(&mut writer, &zero)?;
            }
        }
        writer.flush()?;
        Ok(())
    }
}

fn write_floats(writer: &mut impl Write, numbers: &[f32; 4]) -> io::Result<()> {
    numbers
        .iter()
        .try_for_each(|number| writer.write_all(&number.to_le_bytes()))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use approx::assert_relative_eq;
    use ndarray::Array3;
    use ndarray_npy::NpzReader;

    use super::*;

    fn results(frames: impl Iterator<Item = usize>) -> LocalizationResults {
        let frames: Vec<usize> = frames.collect();
        let mut particles = ParticleLog::new(5);
        for row in 0..frames.len() {
            // Of every frame the second particle is at the origin and weightless.
            particles.push_frame([[row as f32, 1.0, 2.0, 0.5], [0.0; 4], [3.0, 4.0, 5.0, 0.5]]);
        }
        let poses = |offset: f64| {
            let pose = |&frame: &usize| Pose2::new([frame as f64, offset].into(), 3.0 - offset);
            Some(frames.iter().map(pose).collect::<Vec<_>>())
        };
        let numbers = |scale: f64| Some(frames.iter().map(|&f| scale * f as f64).collect());
        let matrix = |&frame: &usize| Matrix3::from_diagonal_element(1.0 + frame as f64);
        LocalizationResults {
            particles,
            estimates: poses(0.1),
            refined: poses(0.2),
            ground_truth: poses(0.3),
            odometry: poses(0.4),
            covariances: Some(frames.iter().map(matrix).collect()),
            times_s: numbers(0.1),
            runtimes_s: numbers(0.01),
            refine_runtimes_s: numbers(0.02),
            states: Some(frames.iter().map(|&frame| frame as u8 % 3).collect()),
            frames,
        }
    }

    fn assert_same(a: &LocalizationResults, b: &LocalizationResults) {
        let poses = |results: &LocalizationResults| -> Vec<Pose2> {
            [
                &results.estimates,
                &results.refined,
                &results.ground_truth,
                &results.odometry,
            ]
            .into_iter()
            .flat_map(|poses| poses.clone().unwrap())
            .collect()
        };
        for (a, b) in poses(a).iter().zip(&poses(b)) {
            assert_relative_eq!(a, b, epsilon = 1e-15);
        }
        let without_poses = |results: &LocalizationResults| LocalizationResults {
            estimates: None,
            refined: None,
            ground_truth: None,
            odometry: None,
            ..results.clone()
        };
        assert_eq!(without_poses(a), without_poses(b));
    }

    #[test]
    fn what_is_written_is_read_back_from_the_start_from_later_and_with_gaps() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        for written in [
            results(0..4),
            results(7..11),
            results((1..20).step_by(2)),
            results(0..0),
        ] {
            written.write(&path).unwrap();
            assert_same(&LocalizationResults::read(&path).unwrap(), &written);
        }
    }

    #[test]
    fn arrays_have_the_shapes_and_types_of_range_mcl() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        results(2..4).write(&path).unwrap();
        let mut npz = NpzReader::new(File::open(&path).unwrap()).unwrap();
        let particles: Array3<f32> = npz.by_name("particles").unwrap();
        assert_eq!(particles.shape(), [4, 5, 4]);
        assert!(
            particles
                .slice(ndarray::s![..2, .., ..])
                .iter()
                .all(|&x| x == 0.0)
        );
        assert_eq!(particles[(3, 0, 0)], 1.0);
        let start_idx: ndarray::Array0<i64> = npz.by_name("start_idx").unwrap();
        let count: ndarray::Array0<i64> = npz.by_name("numParticles").unwrap();
        assert_eq!((start_idx[()], count[()]), (2, 5));
    }

    #[test]
    fn a_file_of_range_mcl_alone_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        let mut npz = NpzWriter::new_compressed(File::create(&path).unwrap());
        let particles =
            Array3::<f32>::from_shape_fn(
                (3, 2, 4),
                |(frame, row, _)| {
                    if frame > 0 && row == 0 { 1.0 } else { 0.0 }
                },
            );
        npz.add_array("particles", &particles).unwrap();
        npz.add_array("start_idx", &arr0(1_i64)).unwrap();
        npz.add_array("numParticles", &arr0(2_i64)).unwrap();
        npz.finish().unwrap();
        let results = LocalizationResults::read(&path).unwrap();
        assert_eq!(results.frames, [1, 2]);
        assert_eq!(results.particles.frame(1), [[1.0; 4]]);
        assert_eq!(results.estimates, None);
    }

    #[test]
    fn a_file_that_is_cut_off_anywhere_is_an_error_that_names_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        results(0..4).write(&path).unwrap();
        let whole = fs::read(&path).unwrap();
        for length in (0..whole.len()).step_by(97) {
            fs::write(&path, &whole[..length]).unwrap();
            let message = LocalizationResults::read(&path).unwrap_err().to_string();
            assert!(message.contains("results.npz"), "{length}: {message}");
        }
    }

    #[test]
    fn a_flipped_byte_is_never_a_panic() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        results(0..4).write(&path).unwrap();
        let whole = fs::read(&path).unwrap();
        for position in (0..whole.len()).step_by(41) {
            let mut broken = whole.clone();
            broken[position] ^= 0x55;
            fs::write(&path, &broken).unwrap();
            if let Err(error) = LocalizationResults::read(&path) {
                assert!(error.to_string().contains("results.npz"));
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_said_with_its_array() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("results.npz");
        let write = |particles: Array3<f32>, start_idx: i64| {
            let mut npz = NpzWriter::new_compressed(File::create(&path).unwrap());
            npz.add_array("particles", &particles).unwrap();
            npz.add_array("start_idx", &arr0(start_idx)).unwrap();
            npz.finish().unwrap();
            LocalizationResults::read(&path).unwrap_err().to_string()
        };
        let message = write(Array3::zeros((2, 2, 3)), 0);
        assert!(
            message.contains("`particles`: its shape is [2, 2, 3]"),
            "{message}"
        );
        let message = write(Array3::zeros((2, 2, 4)), 2);
        assert!(
            message.contains("start_idx is 2, but there are 2 rows"),
            "{message}"
        );
        let message = write(Array3::zeros((2, 2, 4)), -1);
        assert!(message.contains("start_idx is -1"), "{message}");
        let message = write(Array3::from_elem((2, 2, 4), f32::NAN), 0);
        assert!(message.contains("`particles`, row 0: NaN"), "{message}");

        let mut confused = results(0..3);
        confused.frames = vec![4, 6, 5];
        confused.write(&path).unwrap();
        let message = LocalizationResults::read(&path).unwrap_err().to_string();
        assert!(message.contains("`frames`, row 2: 5"), "{message}");

        let mut short = results(0..3);
        short.estimates = short.estimates.map(|poses| poses[..2].to_vec());
        let message = short.write(&path).unwrap_err().to_string();
        assert!(
            message.contains("`estimates` has 2 rows for 3 frames"),
            "{message}"
        );
    }
}
