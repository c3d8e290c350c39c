//! Results of localization and refinement: particles, estimates and ground truth, one row per frame.
//!
//! Stored as a NumPy `.npz` file. Its first three arrays are those of range-mcl (Chen et al., ICRA
//! 2021): range-mcl's evaluation script reads our files, and its files are read here.
//!
//! | array | shape | type | content |
//! |---|---|---|---|
//! | `particles` | (rows, N, 4) | float32 | x, y [m], heading [rad], weight; zeros after the last particle |
//! | `start_idx` | () | int64 | first localized row; the rows before it are zero |
//! | `numParticles` | () | int64 | N |
//! | `frames` | (rows) | int64 | number of the frame in its recording |
//! | `estimates`, `refined`, `ground_truth`, `odometry` | (rows, 3) | float64 | x, y [m], heading [rad] |
//! | `estimates_in_space`, `refined_in_space`, `ground_truth_in_space` | (rows, 7) | float64 | x, y, z [m], quaternion x, y, z, w |
//! | `covariances`, `refined_covariances` | (rows, 9) | float64 | of x, y, heading, row-major [m², m rad, rad²] |
//! | `times_s`, `runtimes_s`, `refine_runtimes_s` | (rows) | float64 | time of the frame; computing time [s] |
//! | `agreements` | (rows) | float64 | share of beams above the road that agree with the map, −1 where unknown |
//! | `places` | (rows) | float64 | number of places where the car may be |
//! | `states` | (rows) | uint8 | state of the filter |
//! | `scan_outlines` | (rows, 512) | int16 | x, y of up to 256 points of the scan at the height of the sensor, in the lidar frame [cm]; zeros after the last |
//! | `selected_frames` | () | int64 | number of frames to localize; only where not all were |
//! | `times_are_assumed` | () | int64 | 1; only where `times_s` are not recorded: ten frames per second are assumed |
//!
//! All but the first three are optional, and so are `particles` where there are `frames`: a trajectory without a map.
//! They are NaN in rows before `start_idx`, and the ground truth in those of frames without a true pose.

use std::borrow::Cow;
use std::io;
use std::ops::RangeInclusive;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use bytemuck::Pod;
use glam::Vec3;
use nalgebra::Matrix3;

use super::columns::Column;
use super::row_log::RowLog;
use crate::evaluation::{ParticleRow, RangeMclRules};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Motion, Scan};

/// Particles of many frames, without the padding of the stored array.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleLog {
    /// Largest number of particles per frame: `numParticles`, the extent of the stored array.
    capacity: usize,
    frames: RowLog<ParticleRow>,
    /// Factor of the positions, if it is not one.
    scale: Option<f32>,
}

impl ParticleLog {
    /// An empty log of frames with up to `capacity` particles, whose file is in a folder.
    pub fn new(capacity: usize, folder: &Path) -> Self {
        Self {
            capacity,
            frames: RowLog::in_folder(folder),
            scale: None,
        }
    }

    /// Appends the particles of the next frame; the capacity grows if they exceed it.
    pub fn push_frame(&mut self, particles: &[ParticleRow]) -> io::Result<()> {
        self.capacity = self.capacity.max(particles.len());
        self.frames.push(particles)
    }

    /// The particles of a frame by its row.
    pub fn frame(&self, row: usize) -> io::Result<Vec<ParticleRow>> {
        let mut particles = self.frames.row(row)?;
        if let Some(factor) = self.scale {
            for [x, y, ..] in &mut particles {
                *x *= factor;
                *y *= factor;
            }
        }
        Ok(particles)
    }

    /// Number of particles of a frame by its row.
    pub fn count(&self, row: usize) -> usize {
        self.frames.row_len(row)
    }

    /// Multiplies the positions of all particles.
    pub fn scale_positions(&mut self, factor: f32) {
        self.scale = Some(self.scale.unwrap_or(1.0) * factor);
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Largest number of particles per frame.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

/// Horizontal positions of points of a scan in the lidar frame [cm].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScanOutline(pub Vec<[i16; 2]>);

impl ScanOutline {
    /// Largest number of points.
    pub const MAX: usize = 256;
    /// Largest number of frames of a run that keeps the outlines of its scans: 50 MB in its page.
    pub const MOST_FRAMES: usize = 50_000;

    /// Points at the height of the sensor, at even distances in the order of the scan, moved to the moment of its pose.
    pub fn of(scan: &Scan, motion: Option<&Motion>) -> Self {
        const HEIGHTS_M: RangeInclusive<f32> = -1.0..=1.0;
        /// Largest coordinate that is kept, that of the type [m].
        const FARTHEST_M: f32 = 327.0;
        let is_seen = |point: &Vec3| {
            HEIGHTS_M.contains(&point.z) && point.truncate().abs().max_element() < FARTHEST_M
        };
        let seen: Vec<usize> = (0..scan.len())
            .filter(|&k| is_seen(&scan.points[k]))
            .collect();
        let step = seen.len().div_ceil(Self::MAX).max(1);
        let chosen: Vec<usize> = seen.into_iter().step_by(step).collect();
        let mut outline = Scan {
            points: chosen.iter().map(|&k| scan.points[k]).collect(),
            times_s: (chosen.iter())
                .filter_map(|&k| scan.times_s.get(k).copied())
                .collect(),
            time_s: scan.time_s,
            gyroscope: scan.gyroscope.clone(),
            ..Scan::default()
        };
        if let Some(motion) = motion {
            motion.deskew(&mut outline);
        }
        let centimetres =
            |point: &Vec3| [point.x, point.y].map(|metres| (100.0 * metres).round() as i16);
        Self(outline.points.iter().map(centimetres).collect())
    }

    /// The outline of a stored row: zeros after the last point that is not zero.
    pub fn from_row(row: &[f64; 2 * Self::MAX]) -> Self {
        let points = row.as_chunks().0.iter();
        let mut points: Vec<_> = points.map(|it: &[f64; 2]| it.map(|it| it as i16)).collect();
        let is_point = |it: &[i16; 2]| *it != [0, 0];
        points.truncate(points.iter().rposition(is_point).map_or(0, |last| last + 1));
        Self(points)
    }
}

/// Results of a run, one row per localized frame; `None` if not computed or not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LocalizationResults {
    /// Numbers of the frames in their recording, ascending.
    pub frames: Column<usize>,
    /// Particles after motion, weighting and resampling.
    pub particles: ParticleLog,
    /// The filter's estimates.
    pub estimates: Option<Column<Pose2>>,
    /// The refined trajectory.
    pub refined: Option<Column<Pose2>>,
    /// The ground truth; not a number where a frame has no true pose.
    pub ground_truth: Option<Column<Pose2>>,
    /// The filter's estimates in space, `map_from_lidar`.
    pub estimates_in_space: Option<Column<Pose3>>,
    /// The refined trajectory in space.
    pub refined_in_space: Option<Column<Pose3>>,
    /// The ground truth in space.
    pub ground_truth_in_space: Option<Column<Pose3>>,
    /// The odometry increment into each frame, `previous_from_current`.
    pub odometry: Option<Column<Pose2>>,
    /// Covariances of the estimates in x, y [m], heading [rad].
    pub covariances: Option<Column<Matrix3<f64>>>,
    /// Covariances of the refined poses.
    pub refined_covariances: Option<Column<Matrix3<f64>>>,
    /// Times of the frames [s].
    pub times_s: Option<Column<f64>>,
    /// Computing time of localization per frame [s].
    pub runtimes_s: Option<Column<f64>>,
    /// Computing time of refinement per frame [s].
    pub refine_runtimes_s: Option<Column<f64>>,
    /// Share of the beams above the road that agree with the map, −1 where unknown (unitless).
    pub agreements: Option<Column<f64>>,
    /// Number of places where the car may be.
    pub places: Option<Column<f64>>,
    /// State of the filter as a number.
    pub states: Option<Column<u8>>,
    /// The estimates in space and, before the first tracked frame, poses that follow from it by the odometry and agree
    /// with the map; `None` where the estimates are the trajectory.
    pub trajectory_in_space: Option<Column<Pose3>>,
    /// State of each pose of that trajectory as a number.
    pub trajectory_states: Option<Column<u8>>,
    /// State of each refined pose as a number.
    pub refined_states: Option<Column<u8>>,
    /// Mean cost of the differences to the map before and after the refinement of a frame [m]; −1 where it was not refined.
    pub refinement_costs_m: Option<Column<[f64; 2]>>,
    /// Share of the compared beams that agree with the map before and after, −1 where unknown (unitless).
    pub refinement_agreements: Option<Column<[f64; 2]>>,
    /// Outlines of the scans, for pictures.
    pub scan_outlines: Option<RowLog<[i16; 2]>>,
    /// Number of frames to localize; a file has it only if the run ended before the last of them.
    pub selected: Option<usize>,
    /// Whether the times were not recorded: ten frames per second are assumed.
    pub times_are_assumed: bool,
}

/// Applies a macro to the names of all columns that may be missing, in the order of the file.
macro_rules! columns {
    ($apply:ident) => {
        $apply!(
            estimates,
            refined,
            ground_truth,
            estimates_in_space,
            refined_in_space,
            ground_truth_in_space,
            odometry,
            covariances,
            refined_covariances,
            times_s,
            runtimes_s,
            refine_runtimes_s,
            agreements,
            places,
            states,
            trajectory_in_space,
            trajectory_states,
            refined_states,
            refinement_costs_m,
            refinement_agreements
        )
    };
}
pub(super) use columns;

impl LocalizationResults {
    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Times of the frames that were recorded [s]; `None` if ten frames per second were assumed.
    pub fn recorded_times(&self) -> Option<&[f64]> {
        self.times_s.as_deref().filter(|_| !self.times_are_assumed)
    }

    /// Covariances of the refined poses, else of the estimates, in x, y [m], heading [rad].
    pub fn best_covariances(&self) -> Option<&[Matrix3<f64>]> {
        let refined = self.refined_covariances.as_deref();
        refined.or(self.covariances.as_deref())
    }

    /// How many of the frames were localized, if not all.
    pub fn shortfall(&self) -> Option<String> {
        let found = self.len();
        let selected = self.selected.filter(|&selected| found < selected)?;
        Some(format!("only {found} of {selected} frames were localized"))
    }

    /// The results of a subset of the rows.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        fn pick<T: Pod>(column: &Option<Column<T>>, rows: &[usize]) -> Option<Column<T>> {
            let column = column.as_ref()?;
            Some(rows.iter().map(|&row| column[row]).collect())
        }
        let particles = match &self.particles {
            none if none.is_empty() => none.clone(),
            all => ParticleLog {
                frames: all.frames.select(rows),
                ..*all
            },
        };
        let scan_outlines = self.scan_outlines.as_ref().map(|all| all.select(rows));
        let frames = rows.iter().map(|&row| self.frames[row]).collect();
        let times_are_assumed = self.times_are_assumed;
        macro_rules! select {
            ($($name:ident),*) => {
                Self { frames, particles, scan_outlines, selected: None, times_are_assumed, $($name: pick(&self.$name, rows)),* }
            };
        }
        columns!(select)
    }

    /// The stored estimates, or if there are none, weighted means of the particles; those in space, projected,
    /// of a trajectory without particles.
    pub fn estimates_or_particle_means(&self, rules: &RangeMclRules) -> Result<Cow<'_, [Pose2]>> {
        if let Some(estimates) = &self.estimates {
            return Ok((**estimates).into());
        }
        if let (true, Some(estimates)) = (self.particles.is_empty(), &self.estimates_in_space) {
            return Ok(estimates.iter().map(pose2_from_pose3).collect());
        }
        ensure!(
            self.particles.len() == self.len(),
            "the file holds neither estimates nor particles; run localize again"
        );
        let capacity = self.particles.capacity();
        (0..self.particles.len())
            .map(|row| {
                let mean = rules.estimate(&self.particles.frame(row)?, capacity);
                let frame = self.frames[row];
                mean.with_context(|| {
                    format!(
                        "the particles of frame {frame} have no weight, and the file holds no estimates; run localize again"
                    )
                })
            })
            .collect()
    }
}
