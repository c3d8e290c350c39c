//! Simulation with exact ground truth: a procedural street, a drive through it, its LiDAR scans.
//!
//! The world frame has z up, and its origin is near the lidar at the start of the path. Poses are
//! written as camera poses in one world frame for all drives of a street, so a drive is found in
//! the map of another through the poses of the map:
//!
//! ```text
//! map_from_lidar(i) = inv(Tr) · inv(P₀ of the mapping drive) · Pᵢ · Tr
//! ```
//!
//! that is, with the mapping drive's `poses.txt` and `calib.txt` as `map_pose_file` and
//! `map_calib_file`. Normalised by its own first pose, as KITTI poses are read otherwise, each
//! drive has its own frame.
//!
//! The same configuration gives the same bytes at any number of threads.

// Surfaces.
mod builder;
mod buildings;
pub mod classes;
mod furniture;
mod vehicles;
// Positions.
mod centreline;
mod ground;
mod ground_mesh;
mod layout;
mod random;
mod street;
mod street_config;
mod structure;
// Drives and measurements.
mod config;
pub mod drive_files;
mod ego_motion;
mod given_poses;
mod gnss;
mod inertial;
mod odometry;
mod scanner;
mod scenes;
mod traffic;

#[cfg(test)]
mod inertial_tests;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

pub use builder::{LabelledMesh, Material};
pub use centreline::{Centreline, CentrelinePoint, PathSegment};
pub use config::{SimulationConfig, SimulationError};
pub use ego_motion::{EgoMotion, MotionConfig, SCAN_PERIOD_S};
pub use given_poses::GivenPosesConfig;
pub use gnss::SimulatedGnssConfig;
pub use ground::{GroundField, GroundSample, GroundZone};
pub use inertial::{ImuGrade, SimulatedImuConfig};
pub use odometry::SimulatedOdometryConfig;
pub use scanner::{LabelledScan, ScannerConfig};
pub use scenes::{crest_scene, ground_scenes, kerb_scene, slope_scene};
pub use street::Street;
pub use street_config::{ChangesConfig, CrossSectionConfig, StreetConfig};
pub use structure::Structure;
pub use traffic::TrafficConfig;

use crate::geometry::{Pose3, Rigid3f, TriangleMesh};
use crate::georeference::{GeodeticFix, ProjectionError};
use crate::inertial::ImuSample;
use crate::memory::{MemoryBudget, MemoryError};
use crate::random::Generator;
use crate::recording::Calibration;
use crate::validation::Validate as _;
use centreline::SHORTEST_M;
use given_poses::bent_poses;
use odometry::drifting_odometry;
use random::{Purpose, stream};
use scanner::{ScanTarget, simulate_scan};
use traffic::Traffic;

/// A street and one drive through it.
pub struct Simulation {
    /// The static world.
    pub street: Street,
    /// Motion of the lidar.
    pub ego_motion: EgoMotion,
    /// Motion on drive 1, which is mapped.
    mapping_motion: EgoMotion,
    config: SimulationConfig,
    traffic: Traffic,
    street_target: ScanTarget,
}

impl Simulation {
    /// Builds the street and plans the drive. `recorded` are lidar poses to drive along (frame
    /// with z up, one per scan); without them the path of the configuration is driven.
    pub fn new(
        config: &SimulationConfig,
        recorded: Option<&[Pose3]>,
        memory_budget: MemoryBudget,
    ) -> Result<Self, SimulationError> {
        config.validate()?;
        let (path, stations_m) = driven_path(config, recorded)?;
        let length_m = path.length_m();
        require_memory(&path, &config.street, memory_budget)?;
        let street = Street::new(&path, &config.street, config.seed);
        let motion_on = |drive| {
            let recorded_m = stations_m.as_deref();
            EgoMotion::new(path.clone(), recorded_m, &config.motion, config.seed, drive)
        };
        let (mut ego_motion, mapping_motion) = (motion_on(config.drive), motion_on(1));
        let traffic = Traffic::new(
            &ego_motion,
            config.street.lane_width_m,
            &config.traffic,
            &mut stream(config.seed, Purpose::Traffic, config.drive.into()),
        );
        if let (Some(frame), None) = (config.motion.kidnapped_at_frame, ego_motion.kidnapped_at) {
            return Err(SimulationError::KidnappedBeyondPath {
                frame,
                by_m: config.motion.kidnapped_by_m,
                length_m,
            });
        }
        // After the traffic, so that fewer scans are the start of the same drive.
        if let Ok(n_scans) = usize::try_from(config.n_scans) {
            ego_motion.stations_m.truncate(n_scans);
        }
        Ok(Self {
            street_target: ScanTarget::new(street.surface.clone()),
            config: config.clone(),
            street,
            ego_motion,
            mapping_motion,
            traffic,
        })
    }

    /// Number of scans.
    pub fn frames(&self) -> usize {
        self.ego_motion.stations_m.len()
    }

    /// Time of every scan [s].
    pub fn times_s(&self) -> Vec<f64> {
        (0..self.frames()).map(time_s).collect()
    }

    /// True lidar poses of all scans: `p_world = world_from_lidar * p_lidar`.
    pub fn poses(&self) -> Vec<Pose3> {
        self.poses_on(&self.ego_motion, 0.0)
    }

    /// The poses that odometry reports, in the world frame, starting at the true first pose.
    pub fn odometry(&self) -> Vec<Pose3> {
        let mut poses = self.poses_on(&self.ego_motion, self.delay_s());
        // A drive that ends before the vehicle is displaced is not affected.
        let kidnapped_at = self.ego_motion.kidnapped_at;
        if let Some(frame) = kidnapped_at.filter(|&frame| frame < poses.len()) {
            // Odometry continues with the last step before.
            let step = poses[frame - 2].inverse() * poses[frame - 1];
            let reported_from_true = poses[frame - 1] * step * poses[frame].inverse();
            for pose in &mut poses[frame..] {
                *pose = reported_from_true * *pose;
            }
        }
        let mut rng = stream(
            self.config.seed,
            Purpose::Odometry,
            self.config.drive.into(),
        );
        drifting_odometry(&poses, &self.config.odometry, &mut rng)
    }

    /// What the inertial sensor of the drive has measured; nothing without one.
    pub fn imu_samples(&self) -> Vec<ImuSample> {
        let mut rng = stream(self.config.seed, Purpose::Imu, self.config.drive.into());
        let duration_s = time_s(self.frames().saturating_sub(1));
        let pose_at = |time_s| self.world_from_lidar(time_s);
        inertial::imu_samples(&self.config.imu, duration_s, pose_at, &mut rng)
    }

    /// The poses that the drive comes with, world frame.
    pub fn given_poses(&self) -> Vec<Pose3> {
        let config = &self.config.given_poses;
        let mut rng = self.given_stream(self.config.drive);
        let poses = self.poses_on(&self.ego_motion, self.delay_s());
        let poses = config.without_noise(&poses, &mut rng);
        config.with_noise(&poses, &mut rng)
    }

    /// The true poses, as the map of drive 1 has them that is built with its given poses.
    pub fn poses_in_map(&self) -> Vec<Pose3> {
        let mapped = self.poses_on(&self.mapping_motion, 0.0);
        let delayed = self.poses_on(&self.mapping_motion, self.delay_s());
        let config = &self.config.given_poses;
        let given = config.without_noise(&delayed, &mut self.given_stream(1));
        bent_poses(&self.poses(), &mapped, &given)
    }

    /// The positions that the receiver reports.
    ///
    /// # Errors
    /// None on the Earth.
    pub fn fixes(&self) -> Result<Vec<GeodeticFix>, ProjectionError> {
        let rng = stream(self.config.seed, Purpose::Gnss, self.config.drive.into());
        let last_s = self.times_s().last().copied().unwrap_or_default();
        let pose = |time_s| self.world_from_lidar(time_s);
        gnss::fixes(&self.config.gnss, last_s, pose, rng)
    }

    fn given_stream(&self, drive: u32) -> Generator {
        stream(self.config.seed, Purpose::GivenPoses, drive.into())
    }

    fn delay_s(&self) -> f64 {
        self.config.given_poses.delay_s
    }

    /// True poses on a drive, a delay after each of its scans.
    fn poses_on(&self, motion: &EgoMotion, delay_s: f64) -> Vec<Pose3> {
        (0..motion.stations_m.len())
            .map(|frame| motion.world_from_lidar(&self.street.ground, time_s(frame) + delay_s))
            .collect()
    }

    /// Surfaces of the traffic at a scan, world frame.
    pub fn traffic_at(&self, frame: usize) -> LabelledMesh {
        self.traffic
            .surface_at(time_s(frame), &self.ego_motion, &self.street.ground)
    }

    /// Scan number `frame`. It depends on the configuration and the number alone.
    pub fn scan(&self, frame: usize) -> LabelledScan {
        let index = (u64::from(self.config.drive) << 32) | frame as u64;
        let mut rng = stream(self.config.seed, Purpose::Scan, index);
        let traffic = ScanTarget::new(self.traffic_at(frame));
        let pose = |delay_s: f64| self.world_from_lidar(time_s(frame) + delay_s);
        let targets = [&self.street_target, &traffic];
        simulate_scan(&self.config.scanner, &targets, pose, &mut rng)
    }

    /// The static world in the map frame of this drive, that is of its first lidar pose.
    pub fn street_in_map(&self) -> TriangleMesh {
        let map_from_world = Rigid3f::from(&self.world_from_lidar(0.0).inverse());
        let mut mesh = self.street.surface.mesh.clone();
        for vertex in &mut mesh.vertices {
            *vertex = map_from_world.apply(*vertex);
        }
        mesh
    }

    fn world_from_lidar(&self, time_s: f64) -> Pose3 {
        self.ego_motion
            .world_from_lidar(&self.street.ground, time_s)
    }
}

/// Mounting of the simulated lidar on the simulated camera: axes swapped, slightly rotated.
pub fn calibration() -> Calibration {
    // x right = -y, y down = -z, z forward = x of the lidar.
    let swapped = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let axes = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(swapped));
    let tilt = UnitQuaternion::from_euler_angles(0.007, -0.004, 0.009);
    Calibration {
        cam0_from_lidar: Pose3::from_parts(Translation3::new(0.0, -0.08, -0.27), tilt * axes),
    }
}

/// The driven path, and the station of each scan if it follows recorded poses [m].
fn driven_path(
    config: &SimulationConfig,
    recorded: Option<&[Pose3]>,
) -> Result<(Centreline, Option<Vec<f64>>), SimulationError> {
    let too_short = |length_m: f64| SimulationError::PathTooShort {
        length_m,
        least_m: SHORTEST_M,
    };
    let sensor_height_m = config.motion.sensor_height_m;
    if let Some(poses) = recorded {
        let followed = Centreline::from_poses(poses, sensor_height_m);
        let (path, stations_m) = followed.ok_or_else(|| too_short(0.0))?;
        return Ok((path, Some(stations_m)));
    }
    let length_m = config.path.iter().map(|segment| segment.length_m).sum();
    if length_m < SHORTEST_M {
        return Err(too_short(length_m));
    }
    let path = Centreline::from_segments(&config.path, -sensor_height_m);
    Ok((path, None))
}

/// Memory of a sample of the ground, and of the triangles of a cell with their hierarchy [bytes].
const SAMPLE_BYTES: f64 = 16.0;
const CELL_BYTES: f64 = 1000.0;

/// Requires the memory of the ground: its samples in the rectangle around the path and side streets, and
/// its triangles with their hierarchy within reach of the path; and that of the structures.
fn require_memory(
    path: &Centreline,
    street: &StreetConfig,
    budget: MemoryBudget,
) -> Result<(), MemoryError> {
    let ground = &street.ground;
    let area_m2: f64 = street.structures.iter().map(Structure::area_m2).sum();
    budget.require(
        "the structures of the street",
        area_m2 * CELL_BYTES,
        "shorten those of street.structures",
    )?;
    let (mut min, mut max) = (path.at(0.0).position, path.at(0.0).position);
    let length_m = path.length_m();
    for step in 0..=(length_m / 10.0) as usize {
        let position = path.at(10.0 * step as f64).position;
        (min, max) = (min.min(position), max.max(position));
    }
    let margin_m = 2.0 * (ground.reach_m + layout::EXTENSION_M);
    let samples = (max.x - min.x + margin_m) * (max.y - min.y + margin_m);
    let cells = 2.0 * ground.reach_m * (length_m + margin_m);
    budget.require(
        "the ground of the street",
        (samples * SAMPLE_BYTES + cells * CELL_BYTES) / ground.cell_m.powi(2),
        "raise street.ground.cell_m, or shorten path or street.ground.reach_m",
    )
}

/// Time of a scan [s].
fn time_s(frame: usize) -> f64 {
    frame as f64 * SCAN_PERIOD_S
}
