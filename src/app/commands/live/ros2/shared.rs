//! What the thread that receives knows and the one that computes needs: frames, odometry, and poses that were proposed.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::pose_buffer::PoseBuffer;
use crate::app::commands::live::robot::MeasuredPose;
use crate::geometry::{Pose3, pose2_from_pose3};
use crate::localization::Start;
use crate::localization::initialization::{StartDistribution, StartSpread};
use crate::recording::FramePose;
use crate::recording::bags::transform_between;

/// Number of static transforms that are kept: those of a robot with many sensors.
const MOST_TRANSFORMS: usize = 1000;

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
    /// Transforms that do not change, one of each child.
    static_transforms: Vec<FramePose>,
    /// Poses of the topic of odometry, and the frame whose poses they are.
    odometry: PoseBuffer,
    odometry_child: String,
    /// The frame that the robot moves in by /tf, and the poses of the robot or of the lidar in it.
    odom_frame: Option<String>,
    odom_from_moving: PoseBuffer,
    moving_frame: String,
    proposal: Option<(Pose3, [f64; 2])>,
    /// Numbers of clouds and their moments [ns].
    moments: VecDeque<(usize, u64)>,
    has_warned_of_mounting: bool,
}

/// What of the robot is known at a scan.
pub struct Place {
    /// The frame of the robot where it is joined to the lidar, else that of the lidar.
    pub child: String,
    /// `p_child = child_from_lidar * p_lidar`.
    pub child_from_lidar: Pose3,
    /// The frame of the odometry, and where that has the child; the latter is `None` while it is not known. The whole is `None` if
    /// nobody publishes it.
    pub odom_from_child: Option<(String, Option<Pose3>)>,
    /// The moment of the scan [ns].
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
        let known = &mut known.static_transforms;
        for transform in transforms {
            match known.iter().position(|it| it.child == transform.child) {
                Some(before) => known[before] = transform,
                None if known.len() < MOST_TRANSFORMS => known.push(transform),
                None => {}
            }
        }
    }

    /// Takes transforms that change, of which one may be where the odometry has the robot. Those from the map are our own.
    pub fn transforms(&self, transforms: Vec<FramePose>) {
        let mut known = self.known();
        for it in transforms {
            // Those of wheels and doors move, too, and a lidar may be on a mast.
            let carries_lidar =
                |frame: &str| *frame == self.base_frame || known.lidar_in(frame).is_some();
            if !carries_lidar(&it.child) || carries_lidar(&it.parent) || it.parent == self.map_frame
            {
                continue;
            }
            let odom_frame = known.odom_frame.get_or_insert_with(|| {
                tracing::info!(
                    "{} moves in {}, to which the transform leads",
                    it.child,
                    it.parent
                );
                it.parent.clone()
            });
            // A robot moves in one frame of odometry.
            if *odom_frame != it.parent {
                continue;
            }
            known.moving_frame = it.child;
            known.odom_from_moving.push(it.time_s, it.parent_from_child);
        }
    }

    /// Takes poses of the topic of odometry.
    pub fn odometry(&self, poses: Vec<FramePose>) {
        let mut known = self.known();
        for pose in poses {
            known.odometry.push(pose.time_s, pose.parent_from_child);
            known.odometry_child = pose.child;
        }
    }

    /// Pose by the topic of odometry at a time [s].
    pub fn measured(&self, time_s: f64) -> Option<MeasuredPose> {
        let mut known = self.known();
        let odom_from_child = known.odometry.at(time_s)?;
        let child = known.odometry_child.clone();
        let child_from_lidar = known.lidar_in(&child);
        if child_from_lidar.is_none() && !known.has_warned_of_mounting {
            known.has_warned_of_mounting = true;
            let lidar = known.lidar_frame.as_deref().unwrap_or_default();
            tracing::warn!(
                "no static transform joins {child} to {lidar}: the odometry is taken as that of the lidar; publish the mounting on /tf_static"
            );
        }
        Some(MeasuredPose {
            odom_from_child,
            child_from_lidar: child_from_lidar.unwrap_or_default(),
        })
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
        known.lidar_frame.as_ref()?;
        let (map_from_base, deviations) = known.proposal.take()?;
        let base_from_lidar = known.lidar_in(&self.base_frame).unwrap_or_default();
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
        let known = self.known();
        let lidar_frame = known.lidar_frame.clone()?;
        let found = known.lidar_in(&self.base_frame);
        let (child, child_from_lidar) = match found {
            Some(base_from_lidar) => (self.base_frame.clone(), base_from_lidar),
            None => (lidar_frame, Pose3::identity()),
        };
        let odom_from_child = known.odom_frame.clone().map(|odom| {
            let moving_from_lidar = known.lidar_in(&known.moving_frame);
            let odom_from_lidar = known.odom_from_moving.at(time_s).zip(moving_from_lidar);
            let pose = odom_from_lidar.map(|(odom_from_moving, moving_from_lidar)| {
                odom_from_moving * moving_from_lidar * child_from_lidar.inverse()
            });
            (odom, pose)
        });
        let moment = known.moments.iter().find(|it| it.0 == number);
        Some(Place {
            child,
            child_from_lidar,
            odom_from_child,
            moment_ns: moment.map_or((1e9 * time_s) as u64, |it| it.1),
        })
    }
}

impl Known {
    /// `p_frame = frame_from_lidar * p_lidar`, where static transforms join the two.
    fn lidar_in(&self, frame: &str) -> Option<Pose3> {
        let lidar = self.lidar_frame.as_deref()?;
        if frame == lidar {
            return Some(Pose3::identity());
        }
        transform_between(&self.static_transforms, frame, lidar)
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
        assert_relative_eq!(place.child_from_lidar, Pose3::translation(1.0, 0.0, 0.0));
        assert!(place.odom_from_child.is_none());
        let alone = Shared::new("map", "base_link");
        assert!(alone.place(0, 5.0).is_none());
        alone.cloud(0, "lidar", 1);
        let place = alone.place(0, 5.0).unwrap();
        assert_eq!(
            (place.child, place.child_from_lidar),
            ("lidar".to_owned(), Pose3::identity())
        );
    }

    #[test]
    fn the_odometry_of_tf_is_that_of_the_base_and_transforms_from_the_map_are_not_taken_for_it() {
        let shared = robot();
        shared.transforms(vec![
            transform("map", "base_link", 5.0, 9.0, 0.0),
            transform("odom", "wheel", 5.0, 9.0, 0.0),
        ]);
        assert!(shared.place(3, 5.0).unwrap().odom_from_child.is_none());
        shared.transforms(vec![
            transform("odom", "base_link", 4.9, 2.0, 0.0),
            transform("odom", "base_link", 5.1, 3.0, 0.0),
        ]);
        let (frame, pose) = shared.place(3, 5.0).unwrap().odom_from_child.unwrap();
        assert_eq!(frame, "odom");
        assert_relative_eq!(
            pose.unwrap(),
            Pose3::translation(2.5, 0.0, 0.0),
            epsilon = 1e-12
        );
        let on_ground = robot();
        on_ground.static_transforms(vec![transform("footprint", "base_link", 0.0, 0.5, 0.0)]);
        on_ground.transforms(vec![transform("odom", "footprint", 5.0, 2.0, 0.0)]);
        let (_, pose) = on_ground.place(3, 5.0).unwrap().odom_from_child.unwrap();
        assert_relative_eq!(
            pose.unwrap(),
            Pose3::translation(2.5, 0.0, 0.0),
            epsilon = 1e-12
        );
        // It is not known any more, which is not the same as that there is none.
        assert!(matches!(
            shared.place(3, 9.0).unwrap().odom_from_child,
            Some((_, None))
        ));
    }

    #[test]
    fn the_odometry_of_a_topic_is_that_of_the_lidar() {
        let shared = robot();
        assert!(shared.measured(5.0).is_none());
        shared.odometry(vec![transform("odom", "base_link", 5.0, 2.0, 0.5)]);
        let pose = shared.measured(5.0).unwrap();
        let odom_from_lidar = pose.odom_from_child * pose.child_from_lidar;
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
