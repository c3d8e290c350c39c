//! Writing: particles stream out, padded with zeros as they go.

use std::io::{self, BufWriter, Seek, Write};
use std::path::Path;

use nalgebra::Matrix3;
use ndarray::{Array1, Array2, arr0, aview1};
use ndarray_npy::{NpzWriter, WriteNpyError, WriteNpyExt, WriteNpzError};
use zip::result::ZipError;
use zip::write::SimpleFileOptions;

use super::localization_results::{LocalizationResults, ParticleLog, ResultsError};
use super::npy::header_bytes;
use crate::app::output::write_atomically;
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
        for (name, covariances) in [
            ("covariances", &self.covariances),
            ("refined_covariances", &self.refined_covariances),
        ] {
            if let Some(covariances) = covariances {
                npz.add_array(name, &table(leading, covariances, matrix_row))?;
            }
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
