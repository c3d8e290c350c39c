//! Messages that the node publishes: pose, odometry, transform, diagnostics, and the map once.
//!
//! The transform is that of REP-105 (Meeussen, *Coordinate Frames for Mobile Platforms*, 2010): from the map to the frame of the
//! odometry where somebody publishes the robot in it, else to the robot: to the topmost frame above the robot, as a frame has one
//! parent; and only while tracking or coasting.

use std::time::{Duration, Instant};

use anyhow::Result;
use glam::Vec3;
use nalgebra::{Matrix3, Matrix6, Vector3};

use super::arguments::{DIAGNOSTICS, MAP, ODOMETRY, POSE, Ros2Args, TRANSFORMS};
use super::cdr::Cdr;
use super::node::{Node, Quality, Writer};
use super::shared::{Place, Shared};
use crate::app::commands::live::robot::Waiting;
use crate::app::report::export::LiveFrame;
use crate::evaluation::trust::Axes;
use crate::geometry::{Pose3, TriangleMesh, sample_surface, surface_area_m2};
use crate::lidar::Motion;
use crate::live::{LivePose, LiveState, Reason};
use crate::localization::motion::jacobian_of_step;

/// Time between two diagnostics of the same state.
const DIAGNOSTICS_PERIOD: Duration = Duration::from_secs(1);

/// Largest number of points of the map that is published, and their smallest spacing [m].
const MOST_POINTS: f64 = 500_000.0;
const SPACING_M: f64 = 0.2;

/// A variance that is not known, as `sensor_msgs/Imu` has it. `ekf_localization_node` of robot_localization takes its absolute
/// value (and 1e-9 for zero, which is certainty); rviz draws a pose whose z, roll and pitch have none in the plane.
const UNKNOWN_VARIANCE: f64 = -1.0;

/// Messages that are kept for slow readers of reliable topics.
const DEPTH: i32 = 10;

/// The topics that are offered.
pub struct Publisher<'a> {
    shared: &'a Shared,
    pose: Writer,
    odometry: Writer,
    transforms: Writer,
    diagnostics: Writer,
    map: Writer,
    /// Time after a scan for which its transform is sent [s].
    tolerance_s: f64,
    /// Name of the status in the diagnostics.
    status_name: String,
    /// The reason of the last diagnostics, and when they were sent.
    last: Option<(Reason, Instant)>,
    /// What the diagnostics have of the last scan that was localized.
    of_last_scan: Vec<(&'static str, String)>,
}

/// Scans that did not get a pose so far.
struct Missed {
    dropped: u64,
    rejected: u64,
}

/// The transform from the map.
#[derive(Debug, PartialEq)]
struct TransformToSend<'a> {
    stamp_ns: u64,
    child: &'a str,
    /// `p_map = map_from_child * p_child`.
    map_from_child: Pose3,
}

impl<'a> Publisher<'a> {
    /// Offers the topics.
    pub fn new(node: &mut Node, args: &Ros2Args, shared: &'a Shared) -> Result<Self> {
        let mut writer = |topic: &str, message_type: &str, quality, depth| {
            node.writer(args.remapped(topic), message_type, quality, depth)
        };
        let reliable = Quality::Reliable;
        let own = |name| args.own_topic(name);
        Ok(Self {
            shared,
            pose: writer(
                &own(POSE),
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                reliable,
                DEPTH,
            )?,
            odometry: writer(&own(ODOMETRY), "nav_msgs/msg/Odometry", reliable, DEPTH)?,
            transforms: writer(TRANSFORMS, "tf2_msgs/msg/TFMessage", reliable, DEPTH)?,
            diagnostics: writer(
                DIAGNOSTICS,
                "diagnostic_msgs/msg/DiagnosticArray",
                reliable,
                DEPTH,
            )?,
            map: writer(
                &own(MAP),
                "sensor_msgs/msg/PointCloud2",
                Quality::Latched,
                1,
            )?,
            tolerance_s: args.transform_tolerance,
            status_name: format!("{}: localization", args.node_name),
            last: None,
            of_last_scan: vec![],
        })
    }

    /// Publishes points on the surface of the map.
    pub fn map(&self, mesh: &TriangleMesh, stamp_ns: u64) {
        let spacing_m = (surface_area_m2(mesh) / MOST_POINTS).sqrt().max(SPACING_M);
        let points = sample_surface(mesh, spacing_m);
        self.map
            .send(cloud(&points, stamp_ns, &self.shared.map_frame));
    }

    /// Publishes a frame that was localized.
    pub fn localized(&mut self, frame: &LiveFrame) {
        let Some(place) = self.shared.place(frame.number, frame.time_s) else {
            return;
        };
        let estimate = &frame.estimate;
        if frame.reason.state().is_believed() {
            let pose = LivePose {
                map_from_lidar: estimate.map_from_lidar,
                covariance: estimate.covariance,
            };
            self.publish_pose(&pose, estimate.motion.as_ref(), &place);
        }
        let deviations = Axes::new(&estimate.covariance, &estimate.pose);
        let [_, _, heading_rad] = estimate.standard_deviations();
        let agreement = estimate.agreement.map(|it| format!("{it:.3}"));
        let latency_ms = 1e3 * frame.latency.as_secs_f64();
        self.of_last_scan = vec![
            ("agreement", agreement.unwrap_or("unknown".to_owned())),
            ("latency [ms]", format!("{latency_ms:.1}")),
            ("places", estimate.places.to_string()),
            (
                "larger standard deviation of the position [m]",
                format!("{:.3}", deviations.long_m),
            ),
            (
                "standard deviation of the heading [deg]",
                format!("{:.3}", heading_rad.to_degrees()),
            ),
            ("frame", frame.number.to_string()),
        ];
        let missed = Missed {
            dropped: frame.dropped,
            rejected: frame.rejected,
        };
        self.diagnose(frame.reason, place.moment_ns, &missed);
    }

    /// Publishes what is known while no scan is localized: the pose as long as the motion carries it, and the state with what
    /// the last scan showed.
    pub fn waiting(&mut self, waiting: &Waiting) {
        if let Some(carried) = &waiting.carried
            && let Some(place) = self.shared.place_at(waiting.time_s)
        {
            self.publish_pose(&carried.pose, Some(&carried.motion), &place);
        }
        let missed = Missed {
            dropped: waiting.dropped,
            rejected: waiting.rejected,
        };
        let stamp_ns = (1e9 * waiting.time_s.max(0.0)) as u64;
        self.diagnose(waiting.reason, stamp_ns, &missed);
    }

    fn publish_pose(&self, pose: &LivePose, motion: Option<&Motion>, place: &Place) {
        let (map, stamp_ns) = (self.shared.map_frame.as_str(), place.moment_ns);
        // A lidar on a mast whose transform is late.
        let Some(child_from_lidar) = place.child_from_lidar else {
            return;
        };
        let lidar_from_child = child_from_lidar.inverse();
        let map_from_child = pose.map_from_lidar * lidar_from_child;
        let lever = map_from_child.translation.vector - pose.map_from_lidar.translation.vector;
        let covariance = covariance_of_child(&pose.covariance, &lever);
        let message = Cdr::with_header(stamp_ns, map).pose(&map_from_child);
        self.pose.send(message.covariance(&covariance));
        let motion = motion.map(|it| of_child(it, &lidar_from_child));
        let [linear, angular] = velocity(motion.as_ref());
        let odometry = Cdr::with_header(stamp_ns, map).text(&place.child);
        let odometry = odometry.pose(&map_from_child).covariance(&covariance);
        let odometry = odometry.twist(linear, angular);
        let unknown = Matrix6::from_diagonal_element(UNKNOWN_VARIANCE);
        self.odometry.send(odometry.covariance(&unknown));
        if let Some(transform) =
            transform_to_send(&map_from_child, motion.as_ref(), place, self.tolerance_s)
        {
            let message = Cdr::default().u32(1).header(transform.stamp_ns, map);
            let message = message.text(transform.child);
            self.transforms
                .send(message.pose(&transform.map_from_child));
        }
    }

    /// Publishes the state, where it has changed or was not published for a while.
    fn diagnose(&mut self, reason: Reason, stamp_ns: u64, missed: &Missed) {
        let is_recent =
            |(last, at): &(Reason, Instant)| *last == reason && at.elapsed() < DIAGNOSTICS_PERIOD;
        if self.last.as_ref().is_some_and(is_recent) {
            return;
        }
        self.last = Some((reason, Instant::now()));
        let damaged = self.shared.damaged();
        let values = diagnostic_values(reason, missed, damaged, &self.of_last_scan);
        let state = reason.state();
        let array = Cdr::with_header(stamp_ns, "").u32(1).u8(level(state));
        let status = array
            .text(&self.status_name)
            .text(&format!("{}: {}", state.word(), reason.words()))
            .text("fpmcl");
        self.diagnostics.send(status.values(&values));
    }
}

/// Names and values of the diagnostics.
fn diagnostic_values(
    reason: Reason,
    missed: &Missed,
    damaged: u64,
    of_last_scan: &[(&'static str, String)],
) -> Vec<(&'static str, String)> {
    let now = [
        ("state", reason.state().word().to_owned()),
        ("reason", reason.words().to_owned()),
        ("dropped scans", missed.dropped.to_string()),
        ("rejected scans", missed.rejected.to_string()),
        ("damaged messages", damaged.to_string()),
    ];
    now.into_iter()
        .chain(of_last_scan.iter().cloned())
        .collect()
}

/// The transform from the map to the topmost frame above the child, for a time after the moment of the pose: as it is where that
/// frame is one of odometry, else extrapolated by the motion. `None` while it is not known.
fn transform_to_send<'a>(
    map_from_child: &Pose3,
    motion_of_child: Option<&Motion>,
    place: &'a Place,
    tolerance_s: f64,
) -> Option<TransformToSend<'a>> {
    let top_from_child = place.top.pose?;
    // A driver may name no frame.
    if place.top_frame.is_empty() {
        return None;
    }
    let ahead = match motion_of_child {
        Some(motion) if !place.top.is_moving => motion.after(tolerance_s),
        _ => Pose3::identity(),
    };
    Some(TransformToSend {
        stamp_ns: (place.moment_ns).saturating_add((1e9 * tolerance_s) as u64),
        child: &place.top_frame,
        map_from_child: map_from_child * ahead * top_from_child.inverse(),
    })
}

/// Levels of `diagnostic_msgs/DiagnosticStatus`: OK, WARN, ERROR.
fn level(state: LiveState) -> u8 {
    match state {
        LiveState::Tracking => 0,
        LiveState::Starting | LiveState::Searching | LiveState::Coasting => 1,
        LiveState::Lost => 2,
    }
}

/// The covariance of the child frame, x, y, z, roll, pitch, yaw: that of the lidar, whose heading moves a frame that is
/// d = (dx, dy) away by (−dy, dx) per radian. The variances of z, roll and pitch are not known.
fn covariance_of_child(of_lidar: &Matrix3<f64>, d: &Vector3<f64>) -> Matrix6<f64> {
    /// Rows of x, y and heading.
    const ROWS: [usize; 3] = [0, 1, 5];
    let lever = jacobian_of_step(&d.xy());
    let planar = lever * of_lidar * lever.transpose();
    let mut covariance = Matrix6::from_diagonal_element(UNKNOWN_VARIANCE);
    for (i, row) in ROWS.into_iter().enumerate() {
        for (j, column) in ROWS.into_iter().enumerate() {
            covariance[(row, column)] = planar[(i, j)];
        }
    }
    covariance
}

/// Motion of the child frame.
fn of_child(of_lidar: &Motion, lidar_from_child: &Pose3) -> Motion {
    let moved = of_lidar.previous_from_current;
    Motion {
        previous_from_current: lidar_from_child.inverse() * moved * lidar_from_child,
        duration_s: of_lidar.duration_s,
    }
}

/// Velocity [m/s] and turn rate [rad/s] of a motion; zero while it is not known.
fn velocity(motion: Option<&Motion>) -> [Vector3<f64>; 2] {
    let Some(motion) = motion else {
        return [Vector3::zeros(); 2];
    };
    let moved = &motion.previous_from_current;
    let [linear, angular] = [moved.translation.vector, moved.rotation.scaled_axis()];
    [linear / motion.duration_s, angular / motion.duration_s]
}

/// `sensor_msgs/PointCloud2` of points, of 32 bits each.
fn cloud(points: &[Vec3], stamp_ns: u64, frame: &str) -> Cdr {
    const FLOAT_32: u8 = 7;
    const POINT_BYTES: u32 = 12;
    let count = points.len() as u32;
    let mut cloud = Cdr::with_header(stamp_ns, frame).u32(1).u32(count).u32(3);
    for (name, offset) in [("x", 0), ("y", 4), ("z", 8)] {
        cloud = cloud.text(name).u32(offset).u8(FLOAT_32).u32(1);
    }
    let cloud = cloud.u8(false).u32(POINT_BYTES).u32(POINT_BYTES * count);
    cloud.bytes(bytemuck::cast_slice(points)).u8(true)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::frames::Relation;
    use super::*;
    use crate::recording::bags::received::{
        ReceivedCloud, read_odometry, read_pose_with_deviations, read_transforms,
    };

    /// A message with the header of little-endian CDR.
    fn received(message: Cdr) -> Vec<u8> {
        [&[0, 1, 0, 0], message.finish().as_slice()].concat()
    }

    fn pose() -> Pose3 {
        Pose3::new(Vector3::new(4.0, -2.0, 1.5), Vector3::new(0.1, -0.2, 2.0))
    }

    #[test]
    fn what_is_sent_is_read_again_as_it_was() {
        let points: Vec<Vec3> = (0..5).map(|k| Vec3::new(k as f32, -1.0, 0.5)).collect();
        // Names of all lengths: what follows is aligned.
        for name in ["m", "ma", "map", "map1", "map12"] {
            let sent = received(cloud(&points, 1_700_000_000_123_456_789, name));
            let read = ReceivedCloud::read(&sent, 0).unwrap();
            assert_eq!(
                (read.scan.points, read.frame.as_str()),
                (points.clone(), name)
            );
            assert_eq!(read.moment_ns, 1_700_000_000_123_456_789);
            let mut covariance = Matrix6::zeros();
            (covariance[(0, 0)], covariance[(1, 1)], covariance[(5, 5)]) = (0.04, 0.25, 0.01);
            let message = Cdr::with_header(5, name)
                .pose(&pose())
                .covariance(&covariance);
            let (read, deviations) = read_pose_with_deviations(&received(message)).unwrap();
            assert_relative_eq!(read.parent_from_child, pose(), epsilon = 1e-12);
            assert_relative_eq!(
                deviations.as_slice(),
                [0.5, 0.1].as_slice(),
                epsilon = 1e-12
            );
            let message = Cdr::default()
                .u32(1)
                .header(5, "map")
                .text(name)
                .pose(&pose());
            let read = read_transforms(&received(message)).unwrap();
            assert_eq!(
                (read[0].parent.as_str(), read[0].child.as_str()),
                ("map", name)
            );
            assert_relative_eq!(read[0].parent_from_child, pose(), epsilon = 1e-12);
            let message = Cdr::with_header(5, "odom").text(name).pose(&pose());
            assert_eq!(read_odometry(&received(message)).unwrap()[0].child, name);
        }
    }

    #[test]
    fn a_cloud_without_a_stamp_has_that_of_its_arrival() {
        let sent = received(cloud(&[Vec3::ONE], 0, "lidar"));
        assert_eq!(ReceivedCloud::read(&sent, 17).unwrap().moment_ns, 17);
    }

    #[test]
    fn the_heading_of_the_lidar_makes_a_frame_behind_it_uncertain_across() {
        // The frame is 2 m behind along x: y moves by -2 m per radian.
        let of_lidar = Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 0.01));
        let covariance = covariance_of_child(&of_lidar, &Vector3::new(-2.0, 0.0, 0.0));
        assert_relative_eq!(covariance[(1, 1)], 0.04, epsilon = 1e-12);
        assert_relative_eq!(covariance[(1, 5)], -0.02, epsilon = 1e-12);
        assert_relative_eq!(covariance[(5, 5)], 0.01, epsilon = 1e-12);
        assert_eq!(covariance[(0, 0)], 0.0);
        for unknown in 2..5 {
            assert_eq!(covariance[(unknown, unknown)], -1.0);
            assert_eq!(covariance[(unknown, 5)], 0.0);
        }
    }

    /// A robot whose base is 3 m ahead of the topmost frame.
    fn place(is_moving: bool) -> Place {
        Place {
            child: "base_link".to_owned(),
            child_from_lidar: Some(Pose3::identity()),
            top_frame: "top".to_owned(),
            top: Relation {
                pose: Some(Pose3::translation(3.0, 0.0, 0.0)),
                is_moving,
            },
            moment_ns: 7_000_000_000,
        }
    }

    #[test]
    fn the_transform_is_stamped_later_and_extrapolated_only_where_no_odometry_moves_the_robot() {
        let heading = Pose3::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let map_from_base = Pose3::translation(10.0, 0.0, 0.0) * heading;
        let motion = Motion {
            previous_from_current: Pose3::translation(0.5, 0.0, 0.0),
            duration_s: 0.1,
        };
        let sent = |place: &Place, motion: Option<&Motion>, tolerance_s: f64| {
            let sent = transform_to_send(&map_from_base, motion, place, tolerance_s).unwrap();
            assert_eq!(sent.child, "top");
            let t = sent.map_from_child.translation.vector;
            (sent.stamp_ns, [t.x, t.y, t.z])
        };
        let close = |(stamp_ns, [x, y, z]): (u64, [f64; 3]), expected_ns: u64, expected_y: f64| {
            assert_eq!(stamp_ns, expected_ns);
            assert_relative_eq!(x, 10.0, epsilon = 1e-9);
            assert_relative_eq!(y, expected_y, epsilon = 1e-9);
            assert_relative_eq!(z, 0.0, epsilon = 1e-9);
        };
        // The robot drives along y of the map, 5 m/s.
        let [odom, base] = [true, false].map(place);
        for tolerance_s in [0.0, 0.2] {
            let stamp_ns = 7_000_000_000 + (1e9 * tolerance_s) as u64;
            close(sent(&odom, Some(&motion), tolerance_s), stamp_ns, -3.0);
            let ahead_m = 5.0 * tolerance_s;
            close(
                sent(&base, Some(&motion), tolerance_s),
                stamp_ns,
                ahead_m - 3.0,
            );
            close(sent(&base, None, tolerance_s), stamp_ns, -3.0);
        }
    }

    #[test]
    fn a_transform_that_is_not_known_or_has_no_name_is_not_sent() {
        let mut late = place(true);
        late.top.pose = None;
        let mut nameless = place(true);
        nameless.top_frame.clear();
        for place in [late, nameless] {
            assert_eq!(transform_to_send(&pose(), None, &place, 0.0), None);
        }
    }

    #[test]
    fn diagnostics_without_a_scan_have_the_counts_of_now_and_the_numbers_of_the_last_scan() {
        let of_last_scan = [("agreement", "0.912".to_owned())];
        let missed = Missed {
            dropped: 4,
            rejected: 2,
        };
        let values = diagnostic_values(Reason::SensorStalled, &missed, 3, &of_last_scan);
        let expected = [
            ("state", "coasting"),
            ("reason", Reason::SensorStalled.words()),
            ("dropped scans", "4"),
            ("rejected scans", "2"),
            ("damaged messages", "3"),
            ("agreement", "0.912"),
        ];
        let values = values.iter().map(|(name, value)| (*name, value.as_str()));
        assert!(values.eq(expected));
    }

    #[test]
    fn the_velocity_is_that_of_the_child_frame() {
        // Turning on the spot: a frame 2 m ahead of the lidar moves to the left.
        let motion = Motion {
            previous_from_current: Pose3::rotation(Vector3::z() * 1e-3),
            duration_s: 0.1,
        };
        let ahead = Pose3::translation(2.0, 0.0, 0.0);
        let [linear, angular] = velocity(Some(&of_child(&motion, &ahead)));
        assert_relative_eq!(linear, Vector3::new(0.0, 0.02, 0.0), epsilon = 1e-4);
        assert_relative_eq!(angular, Vector3::new(0.0, 0.0, 0.01), epsilon = 1e-9);
        assert_eq!(velocity(None), [Vector3::zeros(); 2]);
    }
}
