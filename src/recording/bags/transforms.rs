//! Transforms between the frames of a robot that do not change.

use std::collections::BTreeMap;

use super::message::FramePose;
use crate::geometry::Pose3;

/// `p_target = target_from_source * p_source`, through the tree of transforms; `None` if no path joins the
/// frames. Names are those of messages, with or without a slash before them.
pub fn transform_between(transforms: &[FramePose], target: &str, source: &str) -> Option<Pose3> {
    let (target, source) = (
        target.trim_start_matches('/'),
        source.trim_start_matches('/'),
    );
    let by_child = transforms
        .iter()
        .map(|it| (it.child.as_str(), it))
        .collect();
    let [ancestor_from_target, ancestor_from_source] =
        at_nearest_common(&ancestors(&by_child, target), &ancestors(&by_child, source))?;
    Some(ancestor_from_target.inverse() * ancestor_from_source)
}

/// What two paths upwards, of frames and what is known of each, have at their nearest common frame; `None` if there is none.
pub fn at_nearest_common<T: Copy>(a: &[(&str, T)], b: &[(&str, T)]) -> Option<[T; 2]> {
    a.iter().find_map(|(frame, of_a)| {
        let (_, of_b) = b.iter().find(|it| it.0 == *frame)?;
        Some([*of_a, *of_b])
    })
}

/// A frame, its parent and so on, each with its transform `ancestor_from_frame`.
fn ancestors<'a>(
    by_child: &BTreeMap<&'a str, &'a FramePose>,
    frame: &'a str,
) -> Vec<(&'a str, Pose3)> {
    let mut path = vec![(frame, Pose3::identity())];
    // A tree has no longer path; a loop ends here.
    for _ in 0..by_child.len() {
        let Some(&(frame, ancestor_from_frame)) = path.last() else {
            break;
        };
        let Some(transform) = by_child.get(frame) else {
            break;
        };
        let parent_from_frame = transform.parent_from_child * ancestor_from_frame;
        path.push((&transform.parent, parent_from_frame));
    }
    path
}
