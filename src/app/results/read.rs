//! Reading: particles stream in, the zeros after the last of each frame left out.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use nalgebra::Matrix3;
use zip::ZipArchive;
use zip::result::ZipError;

use super::localization_results::{LocalizationResults, ParticleLog, ResultsError};
use super::npy::{NpyError, NpyReader};
use crate::geometry::Pose2;

impl LocalizationResults {
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

/// The arrays of one file.
struct ResultsReader<'a> {
    path: &'a Path,
    archive: ZipArchive<BufReader<File>>,
}

impl ResultsReader<'_> {
    fn read(mut self) -> Result<LocalizationResults, ResultsError> {
        let (rows, start_idx, particles) = self.read_particles()?;
        let frames = self.read_frames(rows, start_idx)?;
        let mut covariances = |name: &'static str| {
            let table = self.table::<9>(name, rows, start_idx)?;
            Ok::<_, ResultsError>(table.map(|rows| rows.iter().map(matrix_of).collect()))
        };
        let (localized, refined) = (
            covariances("covariances")?,
            covariances("refined_covariances")?,
        );
        let states = self.table::<1>("states", rows, start_idx)?;
        let results = LocalizationResults {
            frames,
            particles,
            estimates: self.poses("estimates", rows, start_idx)?,
            refined: self.poses("refined", rows, start_idx)?,
            ground_truth: self.poses("ground_truth", rows, start_idx)?,
            odometry: self.poses("odometry", rows, start_idx)?,
            covariances: localized,
            refined_covariances: refined,
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
