//! Amounts of work per submission to the device.

use crate::rendering::backend::AdapterKind;

/// Number of batches at the same time: one is read back, one runs, one is queued.
pub(super) const IN_FLIGHT: usize = 3;

/// Number of batches that work of the usual size is cut into: the first is queued and the last read back while no other
/// runs, an eighth of the time each.
const BATCHES: usize = 8;

/// Limits of one submission.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchSizes {
    /// Rays whose ranges are read back, at most.
    pub ranges: usize,
    /// Beams that are compared, at most.
    pub beams: usize,
    /// Rays or beams of which a batch takes longer than its submission, about a tenth of a millisecond.
    pub fewest: usize,
    /// Directions, which are counted in work groups of one dimension (65,535 of 64).
    pub directions: usize,
    /// Poses, which are the work groups of the other dimension.
    pub poses: usize,
    /// Images in an atlas.
    pub images: usize,
    /// Vertices of an atlas.
    pub vertices: usize,
}

impl BatchSizes {
    /// Memory of the batches in flight: their results, a copy of these that is read back, and directions [bytes].
    pub fn bytes(&self) -> f64 {
        let results = 2 * self.ranges.max(self.directions) * size_of::<f32>();
        let directions = self.directions * size_of::<[f32; 4]>();
        (IN_FLIGHT * results + directions) as f64
    }

    /// Work for a fraction of a second, and 16 MB of results; on a software adapter for some
    /// seconds.
    pub fn of(kind: AdapterKind) -> Self {
        let divisor = if kind == AdapterKind::Software { 64 } else { 1 };
        Self {
            ranges: (1 << 22) / divisor,
            beams: (1 << 24) / divisor,
            fewest: (1 << 16) / divisor,
            directions: 1 << 20,
            poses: 65_535,
            images: 64,
            vertices: (1 << 29) / divisor,
        }
    }

    /// Poses per batch for so many poses with so many rays each: several batches unless the work is small, and at most
    /// `most_rays` in each unless a single pose has more.
    pub fn poses_per_batch(&self, poses: usize, rays: usize, most_rays: usize) -> usize {
        let rays = rays.max(1);
        let fewest = self.fewest.min(most_rays).div_ceil(rays);
        (poses / BATCHES)
            .max(fewest)
            .min(most_rays / rays)
            .clamp(1, self.poses)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batches(poses: usize, rays: usize, most: impl Fn(&BatchSizes) -> usize) -> usize {
        let sizes = BatchSizes::of(AdapterKind::Discrete);
        poses.div_ceil(sizes.poses_per_batch(poses, rays, most(&sizes)))
    }

    #[test]
    fn work_of_the_usual_sizes_keeps_several_batches_in_flight() {
        for poses in [1000, 3000, 10_000] {
            for beams in [300, 600, 3600] {
                let count = batches(poses, beams, |sizes| sizes.beams);
                assert!((IN_FLIGHT..=12).contains(&count), "{poses} {beams} {count}");
            }
            let images = batches(poses, 64 * 900, |sizes| sizes.ranges);
            assert!(images >= IN_FLIGHT, "{poses} {images}");
        }
        assert_eq!(batches(10_000, 300, |sizes| sizes.beams), 8);
        assert_eq!(batches(100, 3600, |sizes| sizes.beams), 6);
    }

    #[test]
    fn small_work_is_one_batch_and_no_batch_is_too_large() {
        assert_eq!(batches(100, 600, |sizes| sizes.beams), 1);
        assert_eq!(batches(1, 1 << 23, |sizes| sizes.ranges), 1);
        assert_eq!(batches(1_000_000, 300, |sizes| sizes.beams), 18);
    }
}
