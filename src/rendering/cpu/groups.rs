//! Poses that are close to each other, eight by eight.
//!
//! Where eight poses are closer to each other than eight neighbouring beams are, the rays of one
//! beam from all eight go through the scene as a bundle; otherwise the beams of each pose go in
//! packets. Both meet the same, but for rays within rounding of an edge.

use nalgebra::UnitQuaternion;

use crate::geometry::{Pose3, Vec3, yaw};
use crate::raycasting::RAYS;

/// Surfaces are about this far away: how far an angle moves the end of a ray [m].
const LEVER_M: f64 = 10.0;
/// Poses are put in order to a cube's edge over 2 to this power.
const BITS_PER_AXIS: u32 = 20;
/// How much wider than a packet of beams a bundle may be and still take no longer: measured with
/// `benches/rendering.rs`.
const WORTHWHILE: f64 = 0.4;

/// Up to eight poses.
pub(super) struct Group {
    /// Their numbers.
    pub poses: Vec<u32>,
    /// Whether their rays should go through the scene in bundles.
    pub is_bundled: bool,
}

/// Groups of neighbours; every pose is in one.
pub(super) fn groups_of(poses: &[Pose3], directions: &[Vec3], order: &[u32]) -> Vec<Group> {
    let width_of_packets_m = mean_width_m(directions, order);
    order_of(poses)
        .chunks(RAYS)
        .map(|numbers| {
            // Places that are not filled cost as much as the others.
            let width_m = width_m(poses, numbers) * RAYS as f64 / numbers.len() as f64;
            Group {
                poses: numbers.to_vec(),
                is_bundled: numbers.len() > RAYS / 2 && width_m < WORTHWHILE * width_of_packets_m,
            }
        })
        .collect()
}

/// The numbers of poses along a Z-shaped curve over place and heading (Morton 1966).
fn order_of(poses: &[Pose3]) -> Vec<u32> {
    let coordinates: Vec<[f64; 3]> = poses
        .iter()
        .map(|pose| {
            let place = pose.translation.vector;
            [place.x, place.y, LEVER_M * yaw(pose)]
        })
        .collect();
    let least = [0, 1, 2].map(|axis| fold(&coordinates, axis, f64::INFINITY, f64::min));
    let most = [0, 1, 2].map(|axis| fold(&coordinates, axis, f64::NEG_INFINITY, f64::max));
    let extent = std::iter::zip(least, most).fold(0.0, |extent, (a, b)| f64::max(extent, b - a));
    let cells_per_m = f64::from((1_u32 << BITS_PER_AXIS) - 1) / extent.max(1e-3);
    let mut keyed: Vec<(u64, u32)> = coordinates
        .iter()
        .zip(0..)
        .map(|(coordinates, number)| {
            let key = (0..3).fold(0, |key, axis| {
                let cell = (coordinates[axis] - least[axis]) * cells_per_m;
                key | spread(cell as u64) << axis
            });
            (key, number)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, number)| number).collect()
}

fn fold(all: &[[f64; 3]], axis: usize, start: f64, choose: fn(f64, f64) -> f64) -> f64 {
    all.iter().map(|one| one[axis]).fold(start, choose)
}

/// Puts two zeros before each of the lower 21 bits.
fn spread(bits: u64) -> u64 {
    let bits = bits & 0x001f_ffff;
    let bits = (bits | bits << 32) & 0x001f_0000_0000_ffff;
    let bits = (bits | bits << 16) & 0x001f_0000_ff00_00ff;
    let bits = (bits | bits << 8) & 0x100f_00f0_0f00_f00f;
    let bits = (bits | bits << 4) & 0x10c3_0c30_c30c_30c3;
    (bits | bits << 2) & 0x1249_2492_4924_9249
}

/// How far the rays of one beam are from each other where they end, about [m].
fn width_m(poses: &[Pose3], numbers: &[u32]) -> f64 {
    let pose_of = |number: u32| &poses[number as usize];
    let first = pose_of(numbers[0]);
    let turn = |rotation: &UnitQuaternion<f64>| first.rotation.angle_to(rotation);
    numbers
        .iter()
        .map(|&number| pose_of(number))
        .map(|pose| {
            let shift = (pose.translation.vector - first.translation.vector).norm();
            shift + LEVER_M * turn(&pose.rotation)
        })
        .fold(0.0, f64::max)
}

/// How far the rays of a packet of neighbouring beams are from each other where they end [m].
fn mean_width_m(directions: &[Vec3], order: &[u32]) -> f64 {
    let direction_of = |ray: u32| directions[ray as usize];
    let widths = order.chunks(RAYS).map(|rays| {
        let first = direction_of(rays[0]);
        rays.iter()
            .map(|&ray| f64::from((direction_of(ray) - first).length()))
            .fold(0.0, f64::max)
    });
    LEVER_M * widths.sum::<f64>() / order.len().div_ceil(RAYS).max(1) as f64
}
