//! A street with a known answer: a procedural world, a drive through it, its scans.
//!
//! The world frame has z up, and its origin is near the lidar at the start of the path. Poses are
//! written as camera poses of one world for all drives of a street, so a drive is found in the
//! map of another through the poses of the map:
//!
//! ```text
//! map_from_lidar(i) = inv(Tr) · inv(P₀ of the mapping drive) · Pᵢ · Tr
//! ```
//!
//! that is, with the mapping drive's `poses.txt` and `calib.txt` as `map_pose_file` and
//! `map_calib_file`. Normalised by its own first pose, as KITTI poses are read otherwise, each
//! drive has a frame of its own.
//!
//! The same configuration gives the same bytes at any number of threads.

// What the world is made of.
mod builder;
mod buildings;
pub mod classes;
mod furniture;
mod vehicles;
// Where it is.
mod ground;
mod ground_mesh;
mod layout;
mod path;
mod random;
mod street;
// What happens in it.
mod config;
mod drive;
mod odometry;
mod scanner;
mod scenes;
mod traffic;

#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

pub use builder::{Paint, PaintedMesh};
pub use config::{SimulationConfig, SimulationError};
pub use drive::{Drive, MotionConfig, SCAN_PERIOD_S};
pub use ground::{Ground, GroundConfig, Node, Surface};
pub use odometry::{OdometryConfig, drifting_odometry};
pub use path::{Path, PathPoint, PathSegment};
pub use scanner::{LabelledScan, Scanner, ScannerConfig, Target, hdl64_elevations_deg};
pub use scenes::{crest_scene, kerb_scene, slope_scene};
pub use street::{Street, StreetConfig};
pub use traffic::{Traffic, TrafficConfig};

use crate::geometry::{Pose3, Rigid3f, TriangleMesh};
use crate::recording::Calibration;
use random::{Purpose, stream};

/// Shortest path that can be driven [m].
const SHORTEST_PATH_M: f64 = 10.0;

/// A street and one drive through it.
pub struct Simulation {
    /// The static world.
    pub street: Street,
    /// Where the lidar is.
    pub drive: Drive,
    config: SimulationConfig,
    traffic: Traffic,
    scanner: Scanner,
    target: Target,
}

impl Simulation {
    /// Builds the street and plans the drive. `recorded` are lidar poses to drive along (frame
    /// with z up, one per scan); without them the path of the configuration is driven.
    pub fn new(
        config: &SimulationConfig,
        recorded: Option<&[Pose3]>,
    ) -> Result<Self, SimulationError> {
        config.check()?;
        let sensor_height_m = config.motion.sensor_height_m;
        let (path, stations_m) = match recorded {
            Some(poses) => {
                let followed = Path::from_poses(poses, sensor_height_m);
                let (path, stations_m) = followed.ok_or(too_short(0.0))?;
                (path, Some(stations_m))
            }
            None => {
                let length_m = config.path.iter().map(|segment| segment.length_m).sum();
                if length_m < SHORTEST_PATH_M {
                    return Err(too_short(length_m));
                }
                (Path::from_segments(&config.path, -sensor_height_m), None)
            }
        };
        let street = Street::new(&path, &config.street, config.seed);
        let mut drive = Drive::new(
            &path,
            stations_m.as_deref(),
            &config.motion,
            config.seed,
            config.drive,
        );
        let traffic = Traffic::new(
            &drive,
            &path,
            config.street.lane_width_m,
            &config.traffic,
            (config.seed, config.drive),
        );
        if let (Some(frame), None) = (config.motion.kidnapped_at_frame, drive.kidnapped_at()) {
            return Err(SimulationError::NowhereToBeSet {
                frame,
                by_m: config.motion.kidnapped_by_m,
                path_m: path.length_m(),
            });
        }
        // After the traffic, so that fewer scans are the start of the same drive.
        if let Ok(n_scans) = usize::try_from(config.n_scans) {
            drive.truncate(n_scans);
        }
        Ok(Self {
            target: Target::of_street(&street),
            scanner: Scanner::new(&config.scanner),
            config: config.clone(),
            street,
            drive,
            traffic,
        })
    }

    /// Number of scans.
    pub fn frames(&self) -> usize {
        self.drive.frames()
    }

    /// Time of every scan [s].
    pub fn times_s(&self) -> Vec<f64> {
        (0..self.frames())
            .map(|frame| frame as f64 * SCAN_PERIOD_S)
            .collect()
    }

    /// True pose of the lidar at a scan: `p_world = world_from_lidar * p_lidar`.
    pub fn world_from_lidar(&self, frame: usize) -> Pose3 {
        let time_s = frame as f64 * SCAN_PERIOD_S;
        self.drive.world_from_lidar(&self.street.ground, time_s)
    }

    /// True poses of all scans.
    pub fn poses(&self) -> Vec<Pose3> {
        (0..self.frames())
            .map(|frame| self.world_from_lidar(frame))
            .collect()
    }

    /// The poses that odometry reports, in the world frame, starting at the true first pose.
    pub fn odometry(&self) -> Vec<Pose3> {
        let key = (self.config.seed, self.config.drive);
        let mut felt = self.poses();
        // A drive that ends before knows nothing of it.
        let leap = self.drive.kidnapped_at();
        if let Some(leap) = leap.filter(|&leap| leap < felt.len()) {
            // As if it had driven on as before.
            let step = felt[leap - 2].inverse() * felt[leap - 1];
            let felt_from_true = felt[leap - 1] * step * felt[leap].inverse();
            for pose in &mut felt[leap..] {
                *pose = felt_from_true * *pose;
            }
        }
        drifting_odometry(&felt, &self.config.odometry, key)
    }

    /// The traffic at a scan, world frame.
    pub fn traffic_at(&self, frame: usize) -> PaintedMesh {
        let time_s = frame as f64 * SCAN_PERIOD_S;
        self.traffic
            .surface_at(time_s, &self.drive, &self.street.ground)
    }

    /// Scan number `frame`. It depends on the configuration and the number alone.
    pub fn scan(&self, frame: usize) -> LabelledScan {
        let time_s = frame as f64 * SCAN_PERIOD_S;
        let index = (u64::from(self.config.drive) << 32) | frame as u64;
        let mut rng = stream(self.config.seed, Purpose::Scan, index);
        let traffic = Target::of_surface(self.traffic_at(frame));
        let pose = |delay_s: f64| {
            self.drive
                .world_from_lidar(&self.street.ground, time_s + delay_s)
        };
        self.scanner.scan(&[&self.target, &traffic], pose, &mut rng)
    }

    /// The static world in the map frame of this drive, that is of its first lidar pose.
    pub fn truth_in_map(&self) -> TriangleMesh {
        let map_from_world = Rigid3f::from(&self.world_from_lidar(0).inverse());
        let mut mesh = self.street.mesh.clone();
        for vertex in &mut mesh.vertices {
            *vertex = map_from_world.apply(*vertex);
        }
        mesh
    }
}

/// Where the simulated lidar sits on the simulated camera: axes swapped, mounted a little askew.
pub fn calibration() -> Calibration {
    // x right = -y, y down = -z, z forward = x of the lidar.
    let swapped = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let axes = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(swapped));
    let askew = UnitQuaternion::from_euler_angles(0.007, -0.004, 0.009);
    Calibration {
        cam0_from_lidar: Pose3::from_parts(Translation3::new(0.0, -0.08, -0.27), askew * axes),
    }
}

fn too_short(length_m: f64) -> SimulationError {
    SimulationError::PathTooShort {
        length_m,
        least_m: SHORTEST_PATH_M,
    }
}
