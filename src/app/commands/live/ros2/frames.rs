//! The frames of a robot, a tree of transforms of which some move: odometry, suspension, masts.

use std::collections::BTreeMap;

use super::pose_buffer::PoseBuffer;
use crate::geometry::Pose3;
use crate::recording::FramePose;
use crate::recording::bags::at_nearest_common;

/// Largest number of static transforms: those of a robot with many sensors.
const MOST_STATIC: usize = 1000;

/// Largest number of transforms that move: only those above a few frames are kept.
const MOST_MOVING: usize = 32;

/// Transforms by their children.
#[derive(Default)]
pub struct FrameTree(BTreeMap<String, Link>);

/// The transform of a child.
struct Link {
    parent: String,
    parent_from_child: Joint,
}

enum Joint {
    Fixed(Pose3),
    Moving(PoseBuffer),
}

/// Pose of a frame in another one to which transforms connect it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Relation {
    /// Pose of the frame; `None` where a transform between the two is not known at the time.
    pub pose: Option<Pose3>,
    /// Whether a transform between the two moves.
    pub is_moving: bool,
}

impl Relation {
    /// A frame in itself.
    fn identity() -> Self {
        Self {
            pose: Some(Pose3::identity()),
            is_moving: false,
        }
    }
}

impl FrameTree {
    /// Adds a transform that does not change; it replaces what was known of its child.
    pub fn add_static(&mut self, transform: FramePose) {
        let fixed = |it: &&Link| matches!(it.parent_from_child, Joint::Fixed(_));
        let is_full = self.0.values().filter(fixed).count() >= MOST_STATIC;
        if is_full && !self.0.get(&transform.child).as_ref().is_some_and(fixed) {
            return;
        }
        let link = Link {
            parent: transform.parent,
            parent_from_child: Joint::Fixed(transform.parent_from_child),
        };
        self.0.insert(transform.child, link);
    }

    /// Adds a pose of a moving transform if its child is one of the frames `below` or an ancestor of one; returns whether it is.
    /// The first parent of a child is kept.
    pub fn add_moving(&mut self, transform: &FramePose, below: &[&str]) -> bool {
        let FramePose {
            time_s,
            parent,
            child,
            parent_from_child,
        } = transform;
        // Moving transforms of other parts, such as wheels, are not needed.
        if !below.iter().any(|frame| self.is_above(child, frame)) {
            return false;
        }
        if let Some(link) = self.0.get_mut(child) {
            if let Joint::Moving(poses) = &mut link.parent_from_child
                && link.parent == *parent
            {
                poses.push(*time_s, *parent_from_child);
            }
            return true;
        }
        let moving = |it: &&Link| matches!(it.parent_from_child, Joint::Moving(_));
        let is_full = self.0.values().filter(moving).count() >= MOST_MOVING;
        if is_full || self.is_above(child, parent) {
            return true;
        }
        let mut poses = PoseBuffer::default();
        poses.push(*time_s, *parent_from_child);
        let link = Link {
            parent: parent.clone(),
            parent_from_child: Joint::Moving(poses),
        };
        self.0.insert(child.clone(), link);
        true
    }

    /// Pose of `source` in `target` at a time [s], `p_target = pose * p_source`; `None` if no transforms connect the frames.
    pub fn between(&self, target: &str, source: &str, time_s: f64) -> Option<Relation> {
        let [above_target, above_source] =
            [target, source].map(|frame| self.ancestors(frame, time_s));
        let [of_target, of_source] = at_nearest_common(&above_target, &above_source)?;
        let pose = of_target.pose.zip(of_source.pose);
        Some(Relation {
            pose: pose.map(|(target, source)| target.inverse() * source),
            is_moving: of_target.is_moving || of_source.is_moving,
        })
    }

    /// Root of the tree above a frame, which may be the frame itself, and the pose of the frame in it at a time [s].
    pub fn top_above<'a>(&'a self, frame: &'a str, time_s: f64) -> (&'a str, Relation) {
        let above = self.ancestors(frame, time_s);
        above
            .last()
            .copied()
            .unwrap_or_else(|| (frame, Relation::identity()))
    }

    /// A frame and its ancestors, each with the pose of the frame in it at a time [s].
    fn ancestors<'a>(&'a self, frame: &'a str, time_s: f64) -> Vec<(&'a str, Relation)> {
        let mut below = Relation::identity();
        let above = self.links(frame).map(|link| {
            let (pose, is_moving) = match &link.parent_from_child {
                Joint::Fixed(pose) => (Some(*pose), false),
                Joint::Moving(poses) => (poses.at(time_s), true),
            };
            let pose = pose.zip(below.pose);
            below = Relation {
                pose: pose.map(|(parent_from_child, child)| parent_from_child * child),
                is_moving: is_moving || below.is_moving,
            };
            (link.parent.as_str(), below)
        });
        std::iter::once((frame, Relation::identity()))
            .chain(above)
            .collect()
    }

    fn is_above(&self, ancestor: &str, frame: &str) -> bool {
        ancestor == frame || self.links(frame).any(|link| link.parent == ancestor)
    }

    /// The transforms from a frame upwards.
    fn links<'a>(&'a self, frame: &str) -> impl Iterator<Item = &'a Link> {
        let next = |link: &&'a Link| self.0.get(&link.parent);
        // A tree has no longer path; a loop of static transforms ends here.
        std::iter::successors(self.0.get(frame), next).take(self.0.len())
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    fn at(parent: &str, child: &str, time_s: f64, parent_from_child: Pose3) -> FramePose {
        FramePose {
            time_s,
            parent: parent.to_owned(),
            child: child.to_owned(),
            parent_from_child,
        }
    }

    /// A car on a circle.
    fn driven(time_s: f64) -> Pose3 {
        Pose3::rotation(Vector3::z() * 0.3 * time_s) * Pose3::translation(20.0, 0.0, 0.0)
    }

    /// Its body on the springs.
    fn sprung(time_s: f64) -> Pose3 {
        Pose3::new(Vector3::z() * 0.5, Vector3::y() * 0.4 * (time_s - 10.0))
    }

    fn mounted() -> Pose3 {
        Pose3::translation(1.0, 0.0, 1.5)
    }

    /// odom → footprint → base → lidar, of which two move, with clocks of their own.
    fn robot() -> FrameTree {
        let mut tree = FrameTree::default();
        tree.add_static(at("base", "lidar", 0.0, mounted()));
        for step in 0..4 {
            let time_s = 10.0 + 0.1 * f64::from(step);
            let sprung = at("footprint", "base", time_s, sprung(time_s));
            assert!(tree.add_moving(&sprung, &["lidar"]));
            let time_s = time_s + 0.03;
            let driven = at("odom", "footprint", time_s, driven(time_s));
            assert!(tree.add_moving(&driven, &["lidar"]));
        }
        tree
    }

    #[test]
    fn several_transforms_that_move_are_composed_at_the_time_each_between_its_poses() {
        let tree = robot();
        for time_s in [10.03, 10.1, 10.17, 10.29, 10.35] {
            let expected = driven(time_s) * sprung(time_s) * mounted();
            let (top, relation) = tree.top_above("lidar", time_s);
            assert_eq!((top, relation.is_moving), ("odom", true));
            assert_relative_eq!(relation.pose.unwrap(), expected, epsilon = 1e-3);
            let in_footprint = tree.between("footprint", "lidar", time_s).unwrap();
            let expected = sprung(time_s) * mounted();
            assert_relative_eq!(in_footprint.pose.unwrap(), expected, epsilon = 1e-6);
            let above = tree.between("lidar", "footprint", time_s).unwrap();
            assert_relative_eq!(above.pose.unwrap(), expected.inverse(), epsilon = 1e-6);
        }
        let in_base = tree.between("base", "lidar", 99.0).unwrap();
        assert_eq!((in_base.pose, in_base.is_moving), (Some(mounted()), false));
    }

    #[test]
    fn where_one_transform_is_not_known_the_frames_are_joined_and_their_pose_is_unknown() {
        let tree = robot();
        // The footprint is not known before 10.03 s, the base not after 10.4 s.
        for (time_s, is_base_known) in [(10.01, true), (10.42, false)] {
            let (top, relation) = tree.top_above("lidar", time_s);
            assert_eq!((top, relation.pose), ("odom", None));
            let in_footprint = tree.between("footprint", "lidar", time_s).unwrap();
            assert_eq!(in_footprint.pose.is_some(), is_base_known, "{time_s}");
        }
        assert_eq!(tree.between("wheel", "lidar", 10.1), None);
        assert_eq!(
            tree.top_above("wheel", 10.1),
            ("wheel", Relation::identity())
        );
    }

    #[test]
    fn transforms_elsewhere_second_parents_and_loops_change_nothing() {
        let mut tree = robot();
        let elsewhere = Pose3::translation(99.0, 0.0, 0.0);
        let mut add = |parent, child| {
            tree.add_moving(&at(parent, child, 10.4, elsewhere), &["lidar"]);
        };
        add("base", "wheel");
        add("odom", "base");
        add("base", "lidar");
        add("lidar", "odom");
        assert_eq!(tree.0.len(), 3);
        assert_eq!(
            tree.top_above("lidar", 10.2),
            robot().top_above("lidar", 10.2)
        );
        // Of static transforms, one may follow that closes a loop.
        tree.add_static(at("lidar", "odom", 0.0, elsewhere));
        assert_eq!(tree.between("wheel", "lidar", 10.2), None);
    }

    #[test]
    fn the_number_of_transforms_is_limited() {
        let mut tree = FrameTree::default();
        for number in 0..2 * MOST_STATIC {
            let [parent, child] = [0, 1].map(|it| format!("fixed{}", number + it));
            tree.add_static(at(&parent, &child, 0.0, mounted()));
        }
        assert_eq!(tree.0.len(), MOST_STATIC);
        for number in 0..2 * MOST_MOVING {
            let [child, parent] = [0, 1].map(|it| format!("moving{}", number + it));
            tree.add_moving(&at(&parent, &child, 1.0, mounted()), &["moving0"]);
        }
        assert_eq!(tree.0.len(), MOST_STATIC + MOST_MOVING);
    }
}
