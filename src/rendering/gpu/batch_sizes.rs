//! Amounts of work per submission to the device.

use crate::rendering::backend::AdapterKind;

/// Number of batches at the same time: one is read back, one runs, one is queued.
pub(super) const IN_FLIGHT: usize = 3;

/// Limits of one submission.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchSizes {
    /// Rays whose ranges are read back.
    pub ranges: usize,
    /// Beams that are compared.
    pub beams: usize,
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
            directions: 1 << 20,
            poses: 65_535,
            images: 64,
            vertices: (1 << 29) / divisor,
        }
    }
}
