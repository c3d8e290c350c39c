//! Processing order of rays and poses: neighbours in the list are neighbours in space.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use crate::geometry::{Pose3, Vec3, morton};
use crate::lidar::LidarModel;
use crate::raycasting::RAYS;

/// Typical range of a surface, by which an angle moves the end of a ray [m].
const LEVER_M: f64 = 10.0;
/// Cells of the curve over poses, per axis.
const CELLS: u32 = 1 << 10;

/// Pixels in blocks of four columns and two rows, the blocks column by column: the nodes in one
/// direction stay in the cache.
pub(super) fn pixel_order(model: &LidarModel) -> Vec<u32> {
    let mut order: Vec<u32> = Vec::with_capacity(model.len());
    for left in (0..model.width).step_by(4) {
        for top in (0..model.height).step_by(2) {
            for row in top..model.height.min(top + 2) {
                for column in left..model.width.min(left + 4) {
                    order.push((row * model.width + column) as u32);
                }
            }
        }
    }
    order
}

/// Directions along a Z-order curve over azimuth and elevation (Morton 1966).
pub(crate) fn coherent_order(directions: &[Vec3]) -> Vec<u32> {
    let mut keyed: Vec<(u64, u32)> = directions
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
            let cell = [turn + 2.0, direction.z + 1.0, 0.0].map(|x| (x * 4096.0) as u32);
            (morton::encode(cell), ray as u32)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, ray)| ray).collect()
}

/// Indices of poses, square of the plane by square: what is around one square is in memory at a time.
pub(super) fn poses_by_square(poses: &[Pose3]) -> Vec<Vec<usize>> {
    const SQUARE_M: f64 = 200.0;
    let mut squares: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
    for (number, pose) in poses.iter().enumerate() {
        let place = pose.translation.vector;
        let square = [place.x, place.y].map(|along| (along / SQUARE_M).floor() as i64);
        squares.entry(square).or_default().push(number);
    }
    squares.into_values().collect()
}

/// Indices of poses along a Z-order curve over positions and headings: neighbours see about the
/// same surfaces, which are still in the cache.
pub(super) fn pose_order(poses: &[Pose3]) -> Vec<u32> {
    let places = || poses.iter().map(place_and_heading_m);
    let start = Vector3::repeat(f64::INFINITY);
    let least = places().fold(start, |least, place| least.inf(&place));
    let most = places().fold(-start, |most, place| most.sup(&place));
    let cells_per_m = f64::from(CELLS - 1) / (most - least).max().max(1e-3);
    let mut keyed: Vec<(u64, u32)> = places()
        .zip(0..)
        .map(|(place, pose)| {
            let cell = ((place - least) * cells_per_m).map(|cell| cell as u32);
            (morton::encode(cell.into()), pose)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, pose)| pose).collect()
}

/// Position of a pose, and how far its heading moves the end of a ray [m].
pub(super) fn place_and_heading_m(pose: &Pose3) -> Vector3<f64> {
    let ahead = pose.rotation * Vector3::x();
    let place = pose.translation.vector;
    Vector3::new(place.x, place.y, LEVER_M * ahead.y.atan2(ahead.x))
}

/// Mean distance between the ends of the rays of a bundle, one beam from neighbouring poses [m].
pub(super) fn bundle_width_m(poses: &[Pose3]) -> f64 {
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

/// Mean distance between the ends of the rays of a packet of neighbouring beams [m].
pub(super) fn packet_width_m(directions: &[Vec3], order: &[u32]) -> f64 {
    let direction_of = |ray: u32| directions[ray as usize];
    let widths = order.chunks(RAYS).map(|rays| {
        let first = direction_of(rays[0]);
        rays.iter()
            .map(|&ray| f64::from((direction_of(ray) - first).length()))
            .fold(0.0, f64::max)
    });
    LEVER_M * widths.sum::<f64>() / order.len().div_ceil(RAYS).max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lidar::LidarModel;

    #[test]
    fn the_coherent_order_is_a_permutation_with_similar_neighbours() {
        let directions = LidarModel::default().directions();
        let order = coherent_order(&directions);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(
            sorted
                .iter()
                .enumerate()
                .all(|(i, &place)| i == place as usize)
        );

        let widest = |order: &[u32]| -> f32 {
            let groups = order.chunks(32);
            let widths = groups.map(|group| {
                let first = directions[group[0] as usize];
                group
                    .iter()
                    .map(|&place| first.angle_between(directions[place as usize]))
                    .fold(0.0, f32::max)
            });
            widths.sum()
        };
        let row_by_row: Vec<u32> = (0..order.len() as u32).collect();
        assert!(widest(&order) < 0.7 * widest(&row_by_row));
    }
}
