//! Agreement of neighbouring scans at their poses: wrong poses are found before a surface is made of
//! them.

use foldhash::{HashMap, HashMapExt as _};
use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::scan_cloud::ScanCloud;
use crate::geometry::PointCloud;

/// Points of a scan that are compared, at most.
const POINTS: usize = 2000;
/// A scan with fewer points cannot be compared.
const MIN_POINTS: usize = 100;
/// Distance within which a point is compared with a point of the other scan [m].
const REACH_M: f32 = 1.0;
/// Distance to the plane of that point below which they agree [m].
const TOLERANCE_M: f32 = 0.2;
/// Median agreement of the scans of a local map below which their poses are wrong. Measured on KITTI
/// raw 2011_09_26 drive 0005: 0.98 with its poses, 0.93 with 16 rows of the scans and 0.6 s between
/// them, 0.73 with the poses of another drive, 0.21 with poses of the camera taken for those of the
/// lidar.
pub const WRONG: f32 = 0.5;
/// Median agreement below which the poses are doubtful.
pub const DOUBTFUL: f32 = 0.8;
/// A scan is doubtful if its agreement with both neighbours is less than this share of the median: one
/// that is displaced by 0.3 m has 0.85, by 1 m 0.7.
const DOUBTFUL_SHARE: f32 = 0.86;

/// Agreement of each scan with the next one, from 0 to 1: the share of its points that are on a
/// surface of the next scan, of those that have one near. `None` where one has too few points.
pub fn of_neighbours(scans: &[ScanCloud]) -> Vec<Option<f32>> {
    let agree = |pair: &[ScanCloud]| agreement(&pair[0].cloud, &pair[1].cloud);
    scans.par_windows(2).map(agree).collect()
}

/// Indices of scans that agree with neither neighbour as well as the others do.
pub fn doubtful_scans(agreements: &[Option<f32>]) -> Vec<usize> {
    let limit = DOUBTFUL_SHARE * median(agreements).unwrap_or(0.0);
    (0..=agreements.len())
        .filter(|&scan| {
            let pairs = &agreements[scan.saturating_sub(1)..(scan + 1).min(agreements.len())];
            !pairs.is_empty()
                && pairs
                    .iter()
                    .all(|pair| pair.is_some_and(|share| share < limit))
        })
        .collect()
}

/// The median of the agreements; `None` if no scans could be compared.
pub fn median(agreements: &[Option<f32>]) -> Option<f32> {
    let mut sorted: Vec<f32> = agreements.iter().flatten().copied().collect();
    sorted.sort_by(f32::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// Agreement of a scan with another; 0 where less than a tenth of its points have one of the other near.
fn agreement(scan: &PointCloud, other: &PointCloud) -> Option<f32> {
    if scan.len().min(other.len()) < MIN_POINTS {
        return None;
    }
    let cell_of = |position: Vec3| (position / REACH_M).floor().as_ivec3();
    let mut cells: HashMap<IVec3, Vec<usize>> = HashMap::new();
    for (index, &position) in other.positions.iter().enumerate() {
        cells.entry(cell_of(position)).or_default().push(index);
    }
    let nearest = |position: Vec3| {
        let cell = cell_of(position);
        let near = (-1..=1).flat_map(|x| (-1..=1).map(move |y| (x, y)));
        near.flat_map(|(x, y)| (-1..=1).map(move |z| cell + IVec3::new(x, y, z)))
            .filter_map(|cell| cells.get(&cell))
            .flatten()
            .map(|&index| (other.positions[index].distance_squared(position), index))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .filter(|(squared, _)| *squared <= REACH_M * REACH_M)
    };
    let step = scan.len().div_ceil(POINTS).max(1);
    let (mut compared, mut near, mut agreeing) = (0, 0, 0);
    for &position in scan.positions.iter().step_by(step) {
        compared += 1;
        if let Some((_, index)) = nearest(position) {
            near += 1;
            let offset_m = other.normals[index].dot(position - other.positions[index]);
            agreeing += usize::from(offset_m.abs() <= TOLERANCE_M);
        }
    }
    if near < compared / 10 {
        return Some(0.0);
    }
    Some(agreeing as f32 / near.max(1) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on a road and a wall, displaced along x and y.
    fn scan(x: f32, y: f32) -> PointCloud {
        let mut cloud = PointCloud::default();
        for row in 0..30 {
            for column in 0..30 {
                let (a, b) = (0.4 * row as f32, 0.25 * column as f32);
                cloud.push(Vec3::new(a + x, b + y, 0.0), Vec3::Z, 1.0);
                cloud.push(Vec3::new(a + x, 10.0 + y, 0.1 + b), Vec3::Y, 0.0);
            }
        }
        cloud
    }

    #[test]
    fn scans_agree_along_their_surfaces_and_not_across_them() {
        assert_eq!(agreement(&scan(0.0, 0.0), &scan(0.3, 0.0)), Some(1.0));
        let across = agreement(&scan(0.0, 0.0), &scan(0.0, 0.6)).unwrap();
        assert!((0.4..0.6).contains(&across), "{across}");
        assert_eq!(agreement(&scan(0.0, 0.0), &scan(0.0, 500.0)), Some(0.0));
        assert_eq!(agreement(&PointCloud::default(), &scan(0.0, 0.0)), None);
    }

    #[test]
    fn one_wrong_pose_is_the_one_that_agrees_with_neither_neighbour() {
        let doubtful =
            |shares: &[f32]| doubtful_scans(&shares.iter().map(|&s| Some(s)).collect::<Vec<_>>());
        assert_eq!(doubtful(&[0.97, 0.96, 0.7, 0.69, 0.96]), [3]);
        assert_eq!(doubtful(&[0.3, 0.97, 0.96, 0.98]), [0]);
        assert!(doubtful(&[0.97, 0.96, 0.98]).is_empty());
        assert!(doubtful(&[]).is_empty());
        assert!(doubtful_scans(&[None, Some(0.9), None]).is_empty());
    }
}
