//! What a localization run leaves on disk: particles, estimates and truth, one row per frame.
//!
//! The file is a NumPy `.npz`. Its first three arrays are those of range-mcl (Chen et al., ICRA
//! 2021), so that the parent's evaluation reads our files, and files that hold nothing but these
//! three are read here:
//!
//! | array | shape | type | content |
//! |---|---|---|---|
//! | `particles` | (rows, N, 4) | float32 | x, y [m], heading [rad], weight; rows of zeros after the last particle |
//! | `start_idx` | () | int64 | first row that was localized; the rows before it are zero |
//! | `numParticles` | () | int64 | N |
//! | `frames` | (rows) | int64 | number of the frame in its recording |
//! | `estimates`, `refined`, `ground_truth`, `odometry` | (rows, 3) | float64 | x, y [m], heading [rad] |
//! | `covariances`, `refined_covariances` | (rows, 9) | float64 | of x, y, heading, row-major [m², m rad, rad²] |
//! | `times_s`, `runtimes_s`, `refine_runtimes_s` | (rows) | float64 | time of the frame; time spent on it [s] |
//! | `states` | (rows) | uint8 | what the filter said about itself |
//!
//! All but the first three may be absent. In rows before `start_idx` they are NaN.

use std::path::PathBuf;

use nalgebra::Matrix3;

use super::npy::NpyError;
use crate::evaluation::{ParticleRow, RangeMclRules};
use crate::geometry::Pose2;

/// Particles of many frames; as much memory as there were particles, however many there may be.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleLog {
    /// Most particles that a frame may have.
    capacity: usize,
    rows: Vec<ParticleRow>,
    /// Where the particles of each frame end in `rows`.
    ends: Vec<usize>,
}

impl ParticleLog {
    /// An empty log of frames with up to `capacity` particles.
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity,
            ..Self::default()
        }
    }

    /// Appends the particles of the next frame; where there are more than the capacity, it grows.
    pub fn push_frame(&mut self, particles: impl IntoIterator<Item = ParticleRow>) {
        let before = self.rows.len();
        self.rows.extend(particles);
        self.ends.push(self.rows.len());
        self.capacity = self.capacity.max(self.rows.len() - before);
    }

    /// The particles of a frame by its row.
    pub fn frame(&self, row: usize) -> &[ParticleRow] {
        let begin = if row == 0 { 0 } else { self.ends[row - 1] };
        &self.rows[begin..self.ends[row]]
    }

    /// Multiplies the positions of all particles.
    pub fn scale_positions(&mut self, factor: f32) {
        for row in &mut self.rows {
            row[0] *= factor;
            row[1] *= factor;
        }
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// `numParticles`: the extent of the stored array.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

/// One row per localized frame; what is absent was not asked for or is not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LocalizationResults {
    /// Numbers of the frames in their recording, ascending.
    pub frames: Vec<usize>,
    /// Particles after motion, weighting and resampling.
    pub particles: ParticleLog,
    /// The filter's estimate.
    pub estimates: Option<Vec<Pose2>>,
    /// The refined trajectory.
    pub refined: Option<Vec<Pose2>>,
    /// The ground truth.
    pub ground_truth: Option<Vec<Pose2>>,
    /// The odometry that came to each frame, `previous_from_current`.
    pub odometry: Option<Vec<Pose2>>,
    /// Covariance of the estimate in x, y [m], heading [rad].
    pub covariances: Option<Vec<Matrix3<f64>>>,
    /// Covariance of the refined pose.
    pub refined_covariances: Option<Vec<Matrix3<f64>>>,
    /// Times of the frames [s].
    pub times_s: Option<Vec<f64>>,
    /// Time that localization spent on each frame [s].
    pub runtimes_s: Option<Vec<f64>>,
    /// Time that refinement spent on each frame [s].
    pub refine_runtimes_s: Option<Vec<f64>>,
    /// What the filter said about itself, as a number.
    pub states: Option<Vec<u8>>,
}

impl LocalizationResults {
    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The results of some of the frames, by their rows.
    #[must_use]
    pub fn rows(&self, rows: &[usize]) -> Self {
        fn pick<T: Clone>(column: &Option<Vec<T>>, rows: &[usize]) -> Option<Vec<T>> {
            let column = column.as_ref()?;
            Some(rows.iter().map(|&row| column[row].clone()).collect())
        }
        let mut particles = ParticleLog::new(self.particles.capacity());
        if !self.particles.is_empty() {
            for &row in rows {
                particles.push_frame(self.particles.frame(row).iter().copied());
            }
        }
        Self {
            frames: rows.iter().map(|&row| self.frames[row]).collect(),
            particles,
            estimates: pick(&self.estimates, rows),
            refined: pick(&self.refined, rows),
            ground_truth: pick(&self.ground_truth, rows),
            odometry: pick(&self.odometry, rows),
            covariances: pick(&self.covariances, rows),
            refined_covariances: pick(&self.refined_covariances, rows),
            times_s: pick(&self.times_s, rows),
            runtimes_s: pick(&self.runtimes_s, rows),
            refine_runtimes_s: pick(&self.refine_runtimes_s, rows),
            states: pick(&self.states, rows),
        }
    }

    /// The stored estimates; where the file has none, those that `rules` make of the particles.
    pub fn estimates_or_particle_means(
        &self,
        rules: &RangeMclRules,
    ) -> Result<Vec<Pose2>, ResultsError> {
        if let Some(estimates) = &self.estimates {
            return Ok(estimates.clone());
        }
        let capacity = self.particles.capacity();
        self.frames
            .iter()
            .enumerate()
            .map(|(row, &frame)| {
                rules
                    .estimate(self.particles.frame(row), capacity)
                    .ok_or(ResultsError::ZeroWeights { frame })
            })
            .collect()
    }

    /// Names and lengths of the arrays that are there, to check that all have one row per frame.
    pub(super) fn lengths(&self) -> Vec<(&'static str, usize)> {
        fn length<T>(column: &Option<Vec<T>>) -> Option<usize> {
            column.as_ref().map(Vec::len)
        }
        [
            ("particles", Some(self.particles.len())),
            ("estimates", length(&self.estimates)),
            ("refined", length(&self.refined)),
            ("ground_truth", length(&self.ground_truth)),
            ("odometry", length(&self.odometry)),
            ("covariances", length(&self.covariances)),
            ("refined_covariances", length(&self.refined_covariances)),
            ("times_s", length(&self.times_s)),
            ("runtimes_s", length(&self.runtimes_s)),
            ("refine_runtimes_s", length(&self.refine_runtimes_s)),
            ("states", length(&self.states)),
        ]
        .into_iter()
        .filter_map(|(name, length)| Some((name, length?)))
        .collect()
    }
}

/// What can be wrong with a result file.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum ResultsError {
    #[error("cannot read {}: {source}", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot write {}: {source}", path.display())]
    Write {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{} is not a result file (.npz) or is cut off: {source}; run localize again", path.display())]
    NotNpz {
        path: PathBuf,
        source: zip::result::ZipError,
    },
    #[error("{} has no array `{array}`; it needs `particles` and `start_idx`, as localize and range-mcl write them", path.display())]
    MissingArray { path: PathBuf, array: &'static str },
    #[error("{}, array `{array}`: {source}", path.display())]
    BadArray {
        path: PathBuf,
        array: &'static str,
        source: NpyError,
    },
    #[error("{}, array `{array}`, row {row}: {value} is not a number that can stand there", path.display())]
    BadNumber {
        path: PathBuf,
        array: &'static str,
        row: usize,
        value: f64,
    },
    #[error("{}: start_idx is {start_idx}, but there are {rows} rows", path.display())]
    StartBehindEnd {
        path: PathBuf,
        start_idx: f64,
        rows: usize,
    },
    #[error("{}: `{array}` has {found} rows for {expected} frames", path.display())]
    WrongLength {
        path: PathBuf,
        array: &'static str,
        found: usize,
        expected: usize,
    },
    #[error(
        "the particles of frame {frame} have no weight, and the file holds no estimates; run localize again"
    )]
    ZeroWeights { frame: usize },
    #[error("{} is not a report of fpmcl: {source}; run evaluate again", path.display())]
    BadReport {
        path: PathBuf,
        source: serde_json::Error,
    },
}
