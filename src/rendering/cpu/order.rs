//! In which order rays and poses are worked on, so that neighbours in the list are neighbours in
//! space.

use nalgebra::Vector3;

use crate::geometry::{Pose3, Vec3};
use crate::lidar::{LidarModel, Pixel};
use crate::raycasting::RAYS;

/// Surfaces are about this far away: how far an angle moves the end of a ray [m].
const LEVER_M: f64 = 10.0;
/// Cells of the curve over poses, per axis.
const CELLS: u32 = 1 << 10;

/// Pixels in blocks of four columns and two rows, the blocks column by column: what lies in one
/// direction stays in the cache.
pub(super) fn pixel_order(model: &LidarModel) -> Vec<u32> {
    let mut order: Vec<u32> = Vec::with_capacity(model.len());
    for left in (0..model.width).step_by(4) {
        for top in (0..model.height).step_by(2) {
            for row in top..model.height.min(top + 2) {
                for column in left..model.width.min(left + 4) {
                    order.push(model.index_of(Pixel { row, column }) as u32);
                }
            }
        }
    }
    order
}

/// Directions along a Z-shaped curve over azimuth and elevation (Morton 1966).
pub(super) fn coherent_order(directions: &[Vec3]) -> Vec<u32> {
    let mut keyed: Vec<(u32, u32)> = directions
        .iter()
        .enumerate()
        .map(|(ray, direction)| {
            // Grows with the azimuth, from -2 to 2.
            let along = direction.x / (direction.x.abs() + direction.y.abs());
            let turn = if direction.y < 0.0 {
                along - 1.0
            } else {
                1.0 - along
            };
            // As fine in elevation as in azimuth: half a turn is a half of both.
            let key = spread(((turn + 2.0) * 4096.0) as u32)
                | spread(((direction.z + 1.0) * 4096.0) as u32) << 1;
            (key, ray as u32)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, ray)| ray).collect()
}

/// The numbers of poses along a Z-shaped curve over their places and headings: neighbours see about
/// the same, and what one has seen is still in the cache for the next.
pub(super) fn order_of_poses(poses: &[Pose3]) -> Vec<u32> {
    let places = || poses.iter().map(place_and_turn_m);
    let start = Vector3::repeat(f64::INFINITY);
    let least = places().fold(start, |least, place| least.inf(&place));
    let most = places().fold(-start, |most, place| most.sup(&place));
    let cells_per_m = f64::from(CELLS - 1) / (most - least).max().max(1e-3);
    let mut keyed: Vec<(u32, u32)> = places()
        .zip(0..)
        .map(|(place, pose)| {
            let cell = ((place - least) * cells_per_m).map(|cell| spread_by_three(cell as u32));
            (cell.x | cell.y << 1 | cell.z << 2, pose)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, pose)| pose).collect()
}

/// Where a pose is, and how far its heading moves the end of a ray [m].
pub(super) fn place_and_turn_m(pose: &Pose3) -> Vector3<f64> {
    let ahead = pose.rotation * Vector3::x();
    let place = pose.translation.vector;
    Vector3::new(place.x, place.y, LEVER_M * ahead.y.atan2(ahead.x))
}

/// How far the rays of a beam are from each other where they end, from neighbouring poses [m].
pub(super) fn width_of_bundles_m(poses: &[Pose3]) -> f64 {
    let widths = poses.chunks(RAYS).map(|bundle| {
        let first = &bundle[0];
        let apart_m = |pose: &Pose3| {
            let away_m = (pose.translation.vector - first.translation.vector).norm();
            away_m + LEVER_M * pose.rotation.angle_to(&first.rotation)
        };
        bundle.iter().map(apart_m).fold(0.0, f64::max)
    });
    // A bundle that is not full costs as much as a full one.
    if poses.len() < RAYS {
        return f64::INFINITY;
    }
    widths.sum::<f64>() / poses.len().div_ceil(RAYS) as f64
}

/// How far the rays of a packet of neighbouring beams are from each other where they end [m].
pub(super) fn width_of_packets_m(directions: &[Vec3], order: &[u32]) -> f64 {
    let direction_of = |ray: u32| directions[ray as usize];
    let widths = order.chunks(RAYS).map(|rays| {
        let first = direction_of(rays[0]);
        rays.iter()
            .map(|&ray| f64::from((direction_of(ray) - first).length()))
            .fold(0.0, f64::max)
    });
    LEVER_M * widths.sum::<f64>() / order.len().div_ceil(RAYS).max(1) as f64
}

/// Puts two zeros before each of the lower 10 bits.
fn spread_by_three(bits: u32) -> u32 {
    let bits = bits & (CELLS - 1);
    let bits = (bits | bits << 16) & 0x0300_00ff;
    let bits = (bits | bits << 8) & 0x0300_f00f;
    let bits = (bits | bits << 4) & 0x030c_30c3;
    (bits | bits << 2) & 0x0924_9249
}

/// Puts a zero before each of the lower 16 bits.
fn spread(bits: u32) -> u32 {
    let bits = bits & 0xffff;
    let bits = (bits | bits << 8) & 0x00ff_00ff;
    let bits = (bits | bits << 4) & 0x0f0f_0f0f;
    let bits = (bits | bits << 2) & 0x3333_3333;
    (bits | bits << 1) & 0x5555_5555
}
