//! What the thread that receives knows and the one that computes needs: frames, odometry, and poses that were proposed.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::frames::{FrameTree, Relation};
use super::pose_buffer::PoseBuffer;
use crate::app::commands::live::robot::MeasuredPose;
use crate::geometry::{Pose3, pose2_from_pose3};
use crate::localization::Start;
use crate::localization::initialization::{StartDistribution, StartSpread};
use crate::recording::FramePose;

/// Number of clouds whose exact moments are kept.
const MOST_MOMENTS: usize = 2000;

/// Least standard deviations of a pose that was proposed: nobody points better [m, rad].
const LEAST_DEVIATIONS: [f64; 2] = [0.1, 0.02];

/// Largest ones: the area is searched that they mean [m, rad].
const LARGEST_DEVIATIONS: [f64; 2] = [10.0, 1.0];

/// Shared by the two threads.
pub struct Shared {
    /// Frame of the map.
    pub map_frame: String,
    /// Frame of the robot.
    pub base_frame: String,
    known: Mutex<Known>,
}

#[derive(Default)]
struct Known {
    /// Frame of the clouds.
    lidar_frame: Option<String>,
    /// The frames of the robot below that of the map.
    frames: FrameTree,
    /// The frame above the robot that was reported.
    reported_top: Option<String>,
    /// Poses of the topic of odometry, the frame that they are in, and the one whose poses they are.
    odometry: PoseBuffer,
    odometry_parent: String,
    odometry_child: String,
    proposal: Option<(Pose3, [f64; 2])>,
    /// Numbers of clouds and their moments [ns].
    moments: VecDeque<(usize, u64)>,
    has_warned_of_mounting: bool,
    /// Whether it was reported that the motion is that of the transforms.
    has_reported_motion: bool,
    /// Numbers of damaged messages by their topics.
    damaged: BTreeMap<String, u64>,
}

/// What of the robot is known at a scan.
pub struct Place {
    /// The frame whose pose is published: that of the robot if it is connected to the lidar, else that of the lidar.
    pub child: String,
    /// `p_child = child_from_lidar * p_lidar`; `None` while a transform between them that moves is not known.
    pub child_from_lidar: Option<Pose3>,
    /// The topmost frame above the child, such as that of the odometry, or the child itself; while the lidar is not connected
    /// to a robot that moves, the topmost above the robot.
    pub top_frame: String,
    /// Pose of the child in it: `p_top = top.pose * p_child`.
    pub top: Relation,
    /// The moment, that of a scan where it is known exactly [ns].
    pub moment_ns: u64,
}

impl Shared {
    /// Nothing is known but the names of two frames.
    pub fn new(map_frame: &str, base_frame: &str) -> Self {
        Self {
            map_frame: frame_name(map_frame).to_owned(),
            base_frame: frame_name(base_frame).to_owned(),
            known: Mutex::default(),
        }
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes the frame and the moment of a cloud [ns].
    pub fn cloud(&self, number: usize, frame: &str, moment_ns: u64) {
        let mut known = self.known();
        if known.lidar_frame.as_deref() != Some(frame) {
            known.lidar_frame = Some(frame.to_owned());
        }
        known.moments.push_back((number, moment_ns));
        if known.moments.len() > MOST_MOMENTS {
            known.moments.pop_front();
        }
    }

    /// Takes transforms that do not change.
    pub fn static_transforms(&self, transforms: Vec<FramePose>) {
        let mut known = self.known();
        let below_map = |it: &FramePose| it.parent != self.map_frame;
        for transform in transforms.into_iter().filter(below_map) {
            known.frames.add_static(transform);
        }
    }

    /// Takes poses of moving transforms. Those whose parent is the frame of the map are published by this program, and left out.
    pub fn transforms(&self, transforms: Vec<FramePose>) {
        let mut known = self.known();
        let Known {
            frames,
            lidar_frame,
            odometry_child,
            ..
        } = &mut *known;
        let lidar = lidar_frame.as_deref().unwrap_or_default();
        let below: [&str; 3] = [lidar, &self.base_frame, odometry_child];
        let mut left = transforms;
        left.retain(|it| it.parent != self.map_frame);
        // One may be above another that follows in the message.
        loop {
            let before = left.len();
            left.retain(|it| !frames.add_moving(it, &below));
            if left.len() == before {
                break;
            }
        }
    }

    /// Takes poses of the topic of odometry.
    pub fn odometry(&self, poses: Vec<FramePose>) {
        let mut known = self.known();
        for pose in poses {
            known.odometry.push(pose.time_s, pose.parent_from_child);
            (known.odometry_parent, known.odometry_child) = (pose.parent, pose.child);
        }
    }

    /// Pose by the topic of odometry at a time [s].
    pub fn measured(&self, time_s: f64) -> Option<MeasuredPose> {
        let mut known = self.known();
        let odom_from_child = known.odometry.at(time_s)?;
        let child = known.odometry_child.clone();
        let child_from_lidar = match known.lidar_in(&child, time_s) {
            Some(relation) => Some(relation.pose?),
            None => None,
        };
        if child_from_lidar.is_none() && !known.has_warned_of_mounting {
            known.has_warned_of_mounting = true;
            let lidar = known.lidar_frame.as_deref().unwrap_or_default();
            tracing::warn!(
                "no static transform joins {child} to {lidar}: the odometry is taken as that of the lidar; publish the mounting on /tf_static"
            );
        }
        Some(MeasuredPose {
            odom_frame: known.odometry_parent.clone(),
            odom_from_child,
            child_from_lidar,
        })
    }

    /// Pose by the moving transforms above the robot at a time [s]: where nobody sends a topic of odometry, `/tf` has the same.
    pub fn measured_by_transforms(&self, time_s: f64) -> Option<MeasuredPose> {
        let place = self.place_at(time_s)?;
        if !place.top.is_moving {
            return None;
        }
        let measured = MeasuredPose {
            odom_from_child: place.top.pose?,
            child_from_lidar: Some(place.child_from_lidar?),
            odom_frame: place.top_frame,
        };
        if !std::mem::replace(&mut self.known().has_reported_motion, true) {
            tracing::info!(
                "the motion is that of {} in {}, by /tf",
                place.child,
                measured.odom_frame
            );
        }
        Some(measured)
    }

    /// Counts a damaged message of a topic; returns how many it has had.
    pub fn count_damaged(&self, topic: &str) -> u64 {
        let mut known = self.known();
        let count = known.damaged.entry(topic.to_owned()).or_default();
        *count += 1;
        *count
    }

    /// Number of damaged messages of all topics.
    pub fn damaged(&self) -> u64 {
        self.known().damaged.values().sum()
    }

    /// Takes a pose in the map that was proposed, with standard deviations of position [m] and heading [rad].
    pub fn propose(&self, pose: FramePose, deviations: [f64; 2]) {
        if pose.parent != self.map_frame {
            tracing::warn!(
                "a pose in {} was proposed, and is left out: it must be in {}, the Fixed Frame of rviz",
                pose.parent,
                self.map_frame
            );
            return;
        }
        self.known().proposal = Some((pose.parent_from_child, deviations));
    }

    /// The start of the last pose that was proposed, once.
    pub fn proposed(&self) -> Option<Start> {
        let mut known = self.known();
        // The mounting is known with the frame of the clouds.
        let time_s = 1e-9 * known.moments.back()?.1 as f64;
        let base_from_lidar = match known.lidar_in(&self.base_frame, time_s) {
            Some(relation) => relation.pose?,
            None => Pose3::identity(),
        };
        let (map_from_base, deviations) = known.proposal.take()?;
        let limited = |k: usize| deviations[k].clamp(LEAST_DEVIATIONS[k], LARGEST_DEVIATIONS[k]);
        Some(Start::Pose {
            map_from_lidar: pose2_from_pose3(&(map_from_base * base_from_lidar)),
            // Who points at a map in the plane knows no height.
            height_m: None,
            spread: StartSpread {
                distribution: StartDistribution::Gaussian,
                position_m: limited(0),
                heading_rad: limited(1),
            },
        })
    }

    /// What is known at a cloud; `time_s` is its moment.
    pub fn place(&self, number: usize, time_s: f64) -> Option<Place> {
        let place = self.place_at(time_s)?;
        let known = self.known();
        let moment = known.moments.iter().find(|it| it.0 == number);
        Some(Place {
            moment_ns: moment.map_or(place.moment_ns, |it| it.1),
            ..place
        })
    }

    /// What is known at a time [s].
    pub fn place_at(&self, time_s: f64) -> Option<Place> {
        let mut known = self.known();
        let lidar = known.lidar_frame.clone()?;
        let base = &self.base_frame;
        let (child, child_from_lidar) = match known.lidar_in(base, time_s) {
            Some(relation) => (base.clone(), relation.pose),
            None => (lidar, Some(Pose3::identity())),
        };
        let (mut top_frame, mut top) = known.frames.top_above(&child, time_s);
        let (above_base, of_base) = known.frames.top_above(base, time_s);
        if child != *base && of_base.is_moving {
            // The odometry is known, and the mounting not yet.
            (top_frame, top.pose) = (above_base, None);
        }
        let top_frame = top_frame.to_owned();
        if top_frame != child && known.reported_top.as_ref() != Some(&top_frame) {
            tracing::info!("the transform leads from {} to {top_frame}", self.map_frame);
            known.reported_top = Some(top_frame.clone());
        }
        Some(Place {
            child,
            child_from_lidar,
            top_frame,
            top,
            moment_ns: (1e9 * time_s) as u64,
        })
    }
}

impl Known {
    /// Pose of the lidar in a frame at a time [s]; `None` if no transforms connect the two.
    fn lidar_in(&self, frame: &str, time_s: f64) -> Option<Relation> {
        self.frames
            .between(frame, self.lidar_frame.as_deref()?, time_s)
    }
}

/// The name of a frame in messages, without a slash before it.
fn frame_name(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    fn transform(parent: &str, child: &str, time_s: f64, x: f64, turn_rad: f64) -> FramePose {
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::z() * turn_rad);
        FramePose {
            time_s,
            parent: parent.to_owned(),
            child: child.to_owned(),
            parent_from_child: Pose3::from_parts(nalgebra::Translation3::new(x, 0.0, 0.0), turn),
        }
    }

    /// The lidar is 1 m ahead of the base.
    fn robot() -> Shared {
        let shared = Shared::new("/map", "base_link");
        shared.cloud(3, "lidar", 5_000_000_001);
        shared.static_transforms(vec![transform("base_link", "lidar", 0.0, 1.0, 0.0)]);
        shared
    }

    #[test]
    fn poses_are_those_of_the_base_where_it_is_joined_to_the_lidar_else_those_of_the_lidar() {
        let place = robot().place(3, 5.0).unwrap();
        assert_eq!(
            (place.child.as_str(), place.moment_ns),
            ("base_link", 5_000_000_001)
        );
        let mounting = Pose3::translation(1.0, 0.0, 0.0);
        assert_eq!(place.child_from_lidar, Some(mounting));
        assert_eq!(
            (place.top_frame.as_str(), place.top.is_moving),
            ("base_link", false)
        );
        let alone = Shared::new("map", "base_link");
        assert!(alone.place(0, 5.0).is_none());
        alone.cloud(0, "lidar", 1);
        let place = alone.place(0, 5.0).unwrap();
        assert_eq!(
            (place.child, place.child_from_lidar),
            ("lidar".to_owned(), Some(Pose3::identity()))
        );
        assert_eq!(place.top_frame, "lidar");
    }

    #[test]
    fn the_transform_leads_to_the_topmost_frame_above_the_base() {
        let shared = robot();
        let footprint = transform("footprint", "base_link", 0.0, 0.5, 0.0);
        shared.static_transforms(vec![
            footprint,
            transform("map", "footprint", 0.0, 9.0, 0.0),
        ]);
        let place = shared.place(3, 5.0).unwrap();
        assert_eq!(
            (place.child.as_str(), place.top_frame.as_str()),
            ("base_link", "footprint")
        );
        let expected = Relation {
            pose: Some(Pose3::translation(0.5, 0.0, 0.0)),
            is_moving: false,
        };
        assert_eq!(place.top, expected);
    }

    #[test]
    fn odometry_and_mounting_may_go_over_several_transforms_that_move() {
        let shared = Shared::new("map", "base_link");
        shared.cloud(3, "lidar", 5_000_000_000);
        shared.static_transforms(vec![transform("mast", "lidar", 0.0, 1.0, 0.0)]);
        for (time_s, moved_m) in [(4.9, 2.0), (5.1, 3.0)] {
            // From the top, as a message may have them.
            shared.transforms(vec![
                transform("odom", "footprint", time_s, moved_m, 0.0),
                transform("footprint", "base_link", time_s, 0.1 * moved_m, 0.0),
                transform("base_link", "mast", time_s, 10.0 * moved_m, 0.0),
            ]);
            shared.odometry(vec![transform("odom", "footprint", time_s, moved_m, 0.0)]);
        }
        let x = |pose: Option<Pose3>| pose.unwrap().translation.x;
        let place = shared.place(3, 5.0).unwrap();
        assert_eq!(
            (place.child.as_str(), place.top_frame.as_str()),
            ("base_link", "odom")
        );
        assert_relative_eq!(x(place.child_from_lidar), 26.0, epsilon = 1e-9);
        assert_relative_eq!(x(place.top.pose), 2.75, epsilon = 1e-9);
        let measured = shared.measured(5.0).unwrap();
        assert_relative_eq!(measured.odom_from_child.translation.x, 2.5, epsilon = 1e-9);
        assert_relative_eq!(x(measured.child_from_lidar), 26.25, epsilon = 1e-9);
        shared.propose(transform("map", "", 5.0, 7.0, 0.0), [0.5, 0.2]);
        let Some(Start::Pose { map_from_lidar, .. }) = shared.proposed() else {
            panic!("no pose");
        };
        assert_relative_eq!(map_from_lidar.translation.x, 33.0, epsilon = 1e-9);
        // The mast is joined, and where it is now is not known.
        shared.odometry(vec![transform("odom", "footprint", 5.3, 4.0, 0.0)]);
        assert!(shared.measured(5.3).is_none());
        let place = shared.place(3, 5.3).unwrap();
        assert_eq!((place.child_from_lidar, place.top.pose), (None, None));
        assert_eq!(place.top_frame, "odom");
    }

    #[test]
    fn the_odometry_of_tf_is_that_of_the_base_and_transforms_from_the_map_are_not_taken_for_it() {
        let shared = robot();
        shared.transforms(vec![
            transform("map", "base_link", 5.0, 9.0, 0.0),
            transform("odom", "wheel", 5.0, 9.0, 0.0),
        ]);
        assert_eq!(shared.place(3, 5.0).unwrap().top_frame, "base_link");
        shared.transforms(vec![
            transform("odom", "base_link", 4.9, 2.0, 0.0),
            transform("odom", "base_link", 5.1, 3.0, 0.0),
        ]);
        let place = shared.place(3, 5.0).unwrap();
        assert_eq!(place.top_frame, "odom");
        assert_relative_eq!(
            place.top.pose.unwrap(),
            Pose3::translation(2.5, 0.0, 0.0),
            epsilon = 1e-12
        );
        let on_ground = robot();
        on_ground.static_transforms(vec![transform("footprint", "base_link", 0.0, 0.5, 0.0)]);
        on_ground.transforms(vec![transform("odom", "footprint", 5.0, 2.0, 0.0)]);
        let place = on_ground.place(3, 5.0).unwrap();
        assert_relative_eq!(
            place.top.pose.unwrap(),
            Pose3::translation(2.5, 0.0, 0.0),
            epsilon = 1e-12
        );
        // It is not known any more, which is not the same as that there is none.
        let place = shared.place(3, 9.0).unwrap();
        assert_eq!((place.top_frame.as_str(), place.top.pose), ("odom", None));
        // The lidar is not joined to the robot yet: it gets no second parent.
        let early = Shared::new("map", "base_link");
        early.cloud(0, "lidar", 1);
        early.transforms(vec![transform("odom", "base_link", 5.0, 2.0, 0.0)]);
        let place = early.place(0, 5.0).unwrap();
        assert_eq!(
            (
                place.child.as_str(),
                place.top_frame.as_str(),
                place.top.pose
            ),
            ("lidar", "odom", None)
        );
    }

    #[test]
    fn the_motion_is_that_of_the_transforms_above_the_robot_if_they_move() {
        let shared = robot();
        assert!(shared.measured_by_transforms(5.0).is_none());
        // A mast moves, and the robot does not as far as is known.
        let mast = Shared::new("map", "base_link");
        mast.cloud(3, "lidar", 5_000_000_000);
        mast.transforms(vec![transform("base_link", "lidar", 5.0, 2.0, 0.0)]);
        assert!(mast.measured_by_transforms(5.0).is_none());
        for (time_s, x, turn_rad) in [(5.0, 2.0, 0.0), (5.1, 3.0, 0.1)] {
            shared.transforms(vec![transform("odom", "base_link", time_s, x, turn_rad)]);
        }
        let [first, last] = [5.0, 5.1].map(|it| shared.measured_by_transforms(it).unwrap());
        assert_eq!(first.odom_frame, "odom");
        // The lidar is 1 m ahead of the base, which turns.
        let moved = last.since(&first, 0.1).unwrap().translation;
        assert_relative_eq!(moved.x, 0.1_f64.cos(), epsilon = 1e-12);
        assert_relative_eq!(moved.y, 0.1_f64.sin(), epsilon = 1e-12);
        // Not known any more, and in another frame.
        assert!(shared.measured_by_transforms(9.0).is_none());
        shared.transforms(vec![transform("world", "odom", 5.1, 7.0, 0.0)]);
        let other = shared.measured_by_transforms(5.1).unwrap();
        assert_eq!(other.odom_frame, "world");
        assert!(other.since(&first, 0.1).is_none());
    }

    #[test]
    fn damaged_messages_are_counted_by_topic() {
        let shared = robot();
        assert_eq!(shared.damaged(), 0);
        let counts = ["/tf", "/odom", "/tf"].map(|topic| shared.count_damaged(topic));
        assert_eq!((counts, shared.damaged()), ([1, 1, 2], 3));
    }

    #[test]
    fn the_odometry_of_a_topic_is_that_of_the_lidar() {
        let shared = robot();
        assert!(shared.measured(5.0).is_none());
        shared.odometry(vec![transform("odom", "base_link", 5.0, 2.0, 0.5)]);
        let pose = shared.measured(5.0).unwrap();
        let odom_from_lidar = pose.odom_from_child * pose.child_from_lidar.unwrap();
        let x = 2.0 + 0.5_f64.cos();
        assert_relative_eq!(odom_from_lidar.translation.x, x, epsilon = 1e-12);
    }

    #[test]
    fn a_pose_is_proposed_once_for_the_lidar_and_only_in_the_map() {
        // Before a cloud the lidar is not known: the proposal waits for it.
        let early = Shared::new("map", "base_link");
        early.propose(transform("map", "", 5.0, 7.0, 0.0), [0.5, 0.2]);
        assert!(early.proposed().is_none());
        early.cloud(0, "lidar", 5);
        assert!(early.proposed().is_some());
        let shared = robot();
        shared.propose(transform("odom", "", 5.0, 7.0, 0.0), [0.5, 0.2]);
        assert!(shared.proposed().is_none());
        shared.propose(transform("map", "", 5.0, 7.0, 0.0), [0.0, 99.0]);
        let Some(Start::Pose {
            map_from_lidar,
            spread,
            height_m,
        }) = shared.proposed()
        else {
            panic!("no pose");
        };
        assert_relative_eq!(map_from_lidar.translation.x, 8.0);
        assert_eq!(
            (spread.position_m, spread.heading_rad, height_m),
            (0.1, 1.0, None)
        );
        assert!(shared.proposed().is_none());
    }
}
