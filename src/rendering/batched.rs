//! Rendering in batches of poses, which bounds the memory of a renderer.

use super::{RangeDifference, RangeRenderer, RenderError, SurfaceHit};
use crate::geometry::{Pose3, Vec3};
use crate::lidar::{Beam, LidarModel};

/// Passes poses to another renderer in batches; the results are the same.
pub struct Batched {
    /// Renders the batches.
    pub renderer: Box<dyn RangeRenderer>,
    /// Maximum number of poses per call, at least 1: range-mcl's `max_instance`.
    pub max_poses: usize,
}

impl Batched {
    fn in_batches<T>(
        &self,
        poses: &[Pose3],
        render: impl Fn(&[Pose3]) -> Result<Vec<T>, RenderError>,
    ) -> Result<Vec<T>, RenderError> {
        let mut all = Vec::with_capacity(poses.len());
        for batch in poses.chunks(self.max_poses.max(1)) {
            all.extend(render(batch)?);
        }
        Ok(all)
    }
}

impl RangeRenderer for Batched {
    fn name(&self) -> String {
        self.renderer.name()
    }

    fn render(
        &self,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        self.in_batches(map_from_lidar, |poses| self.renderer.render(poses, model))
    }

    fn cast(
        &self,
        map_from_lidar: &[Pose3],
        directions: &[Vec3],
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        self.in_batches(map_from_lidar, |poses| {
            self.renderer.cast(poses, directions)
        })
    }

    fn surfaces(
        &self,
        map_from_lidar: &Pose3,
        directions: &[Vec3],
    ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
        self.renderer.surfaces(map_from_lidar, directions)
    }

    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        self.in_batches(map_from_lidar, |poses| {
            self.renderer.compare(poses, beams, difference)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Records the number of poses of each call, and renders x of each pose.
    struct Counting(std::sync::Arc<Mutex<Vec<usize>>>);

    impl RangeRenderer for Counting {
        fn name(&self) -> String {
            "counting".to_owned()
        }

        fn render(&self, _: &[Pose3], _: &LidarModel) -> Result<Vec<Vec<f32>>, RenderError> {
            Ok(Vec::new())
        }

        fn cast(&self, poses: &[Pose3], _: &[Vec3]) -> Result<Vec<Vec<f32>>, RenderError> {
            self.0.lock().unwrap().push(poses.len());
            Ok(poses.iter().map(|p| vec![p.translation.x as f32]).collect())
        }

        fn compare(
            &self,
            poses: &[Pose3],
            _: &[Beam],
            _: &RangeDifference,
        ) -> Result<Vec<f32>, RenderError> {
            Ok(poses.iter().map(|p| p.translation.x as f32).collect())
        }
    }

    #[test]
    fn no_call_has_more_poses_than_allowed_and_none_is_lost_or_moved() {
        let calls = std::sync::Arc::default();
        let batched = Batched {
            renderer: Box::new(Counting(std::sync::Arc::clone(&calls))),
            max_poses: 3,
        };
        let poses: Vec<Pose3> = (0..8)
            .map(|i| Pose3::translation(f64::from(i), 0.0, 0.0))
            .collect();
        let ranges = batched.cast(&poses, &[Vec3::X]).unwrap();
        assert_eq!(*calls.lock().unwrap(), [3, 3, 2]);
        let expected: Vec<Vec<f32>> = (0..8_u8).map(|i| vec![f32::from(i)]).collect();
        assert_eq!(ranges, expected);
    }
}
