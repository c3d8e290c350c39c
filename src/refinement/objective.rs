//! Objective of the refinement: the range difference between a scan and the map at a pose.
//!
//! ```text
//! f(x, y, θ) = mean over the beams of cost(measured, rendered from lift(x, y, θ))      [m]
//! ```
//!
//! The pose is above the ground of the map, or above a known one, as in localization: x, y and heading are free.

use crate::geometry::{Pose2, Pose3, Vec3};
use crate::lidar::Beam;
use crate::localization::observation::costs;
use crate::map::{GroundMap, GroundPatch, SensorAttitude};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError};

/// The objective of one frame.
#[derive(Clone, Copy)]
pub struct FrameObjective<'a> {
    /// Renders the map.
    pub renderer: &'a dyn RangeRenderer,
    /// Ground of the map.
    pub ground: &'a GroundMap,
    /// The beams of the frame whose ranges are compared, lidar frame.
    pub beams: &'a [Beam],
    /// The beams of the frame that the last Gauss-Newton registers.
    pub registered: &'a [Beam],
    /// Approximate height of the ground [m], which selects among several levels; `None` selects the
    /// lowest.
    pub level_m: Option<f64>,
    /// Attitude of the sensor above the ground.
    pub attitude: SensorAttitude,
    /// The ground above which that is known; `None` for that of the map under a pose, above which it is an initial value.
    pub known_ground: Option<GroundPatch>,
    /// Cost of a difference.
    pub difference: RangeDifference,
}

impl FrameObjective<'_> {
    /// Aligns a pose to the ground; `remembered` replaces it where the map has none.
    pub fn lift(
        &self,
        pose: &Pose2,
        remembered: Option<&GroundPatch>,
    ) -> Result<Option<Pose3>, RenderError> {
        let patch = self.patch_under(pose)?;
        let patch = patch.as_ref().or(remembered);
        Ok(patch.map(|patch| patch.lift(pose, &self.attitude)))
    }

    /// The ground under a pose, or that above which the attitude is known.
    pub fn patch_under(&self, pose: &Pose2) -> Result<Option<GroundPatch>, RenderError> {
        Ok(match self.known_ground {
            None => self.ground.patch_under(pose, self.level_m)?,
            known => known,
        })
    }

    /// The ground under a pose, or the nearest part of it within a distance [m].
    pub fn patch_within(
        &self,
        pose: &Pose2,
        distance_m: f64,
    ) -> Result<Option<GroundPatch>, RenderError> {
        let mut patch = self.patch_under(pose)?;
        let t = pose.translation.vector;
        for radius_m in [4.0, 8.0] {
            if patch.is_none() && radius_m <= distance_m + 2.0 {
                patch = self.ground.patch_at(t.x, t.y, radius_m, self.level_m)?;
            }
        }
        Ok(patch)
    }

    /// Returns the objective with the attitude fitted at a pose, so that the beams on the road end on the
    /// mapped ground; unchanged where too few of them do, and where it is known.
    pub fn with_fitted_attitude(&self, pose: &Pose2) -> Result<Self, RenderError> {
        if self.known_ground.is_some() {
            return Ok(*self);
        }
        let points: Vec<Vec3> = self.beams.iter().map(Beam::point).collect();
        let attitude = self
            .ground
            .attitude_at(pose, self.level_m, &self.attitude, &points)?;
        Ok(Self {
            attitude: attitude.unwrap_or(self.attitude),
            ..*self
        })
    }

    /// Returns the objective on the level of the ground where it is smallest at a pose, for an unknown
    /// level.
    pub fn on_best_level(&self, pose: &Pose2) -> Result<Self, RenderError> {
        let place = pose.translation.vector;
        let levels = self.ground.levels_at(place.x, place.y)?;
        let mut best = (f64::INFINITY, *self);
        for patch in &levels {
            let level_m = Some(patch.height_m);
            let on_level = Self { level_m, ..*self };
            if levels.len() == 1 {
                return Ok(on_level);
            }
            let fitted = on_level.with_fitted_attitude(pose)?;
            let lifted = patch.lift(pose, &fitted.attitude);
            let cost_m = self.costs_in_space(&[lifted])?[0];
            if cost_m < best.0 {
                best = (cost_m, on_level);
            }
        }
        Ok(best.1)
    }

    /// Returns the mean cost at each pose [m]; infinite where there is no ground.
    pub fn costs(
        &self,
        poses: &[Pose2],
        remembered: Option<&GroundPatch>,
    ) -> Result<Vec<f64>, RenderError> {
        let lifted: Vec<Option<Pose3>> = poses
            .iter()
            .map(|pose| self.lift(pose, remembered))
            .collect::<Result<_, _>>()?;
        let costs = costs(self.renderer, &lifted, self.beams, &self.difference)?;
        Ok(costs
            .into_iter()
            .map(|cost_m| cost_m.unwrap_or(f64::INFINITY))
            .collect())
    }

    /// Returns the mean cost at poses in space [m].
    pub fn costs_in_space(&self, map_from_lidar: &[Pose3]) -> Result<Vec<f64>, RenderError> {
        let costs = self
            .renderer
            .compare(map_from_lidar, self.beams, &self.difference)?;
        Ok(costs.into_iter().map(f64::from).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::TriangleMesh;
    use crate::lidar::{LidarModel, RangeImage};
    use crate::map::world_for_tests::TestWorld;
    use crate::rendering::CpuRenderer;

    impl TestWorld {
        /// The objective of a scan from the street.
        pub fn objective<'a>(&'a self, beams: &'a [Beam]) -> FrameObjective<'a> {
            FrameObjective {
                renderer: self,
                ground: &self.ground,
                beams,
                registered: beams,
                level_m: None,
                attitude: SensorAttitude::default(),
                known_ground: None,
                difference: RangeDifference::truncated(0.5),
            }
        }
    }

    #[test]
    fn of_an_unknown_level_the_one_where_the_scan_fits_is_found() {
        // A deck of 20 m over a yard of 60 m with a wall of 4 m.
        let mut mesh = TriangleMesh::default();
        let mut quad = |corners: [[f32; 3]; 4]| {
            mesh.append(&TriangleMesh {
                vertices: corners.map(Vec3::from).to_vec(),
                triangles: vec![[0, 1, 2], [0, 2, 3]],
                ..TriangleMesh::default()
            });
        };
        for (half, z) in [(30.0, 0.0), (10.0, 6.0)] {
            let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
            quad(corners.map(|(x, y)| [x, y, z]));
        }
        for turn in 0..4 {
            let wall = [(-30.0, 0.0), (30.0, 0.0), (30.0, 4.0), (-30.0, 4.0)];
            quad(wall.map(|(along, z)| match turn {
                0 => [along, 30.0, z],
                1 => [along, -30.0, z],
                2 => [30.0, along, z],
                _ => [-30.0, along, z],
            }));
        }
        let ground = GroundMap::from_mesh(&mesh, |triangle| triangle < 4, 0.5);
        let renderer = CpuRenderer::new(std::slice::from_ref(&mesh));
        let pose = Pose2::new(nalgebra::Vector2::new(1.0, -2.0), 0.3);
        for level_m in [0.0, 6.0] {
            let patch = ground.patch_under(&pose, Some(level_m)).unwrap().unwrap();
            let lifted = patch.lift(&pose, &SensorAttitude::default());
            let model = LidarModel {
                height: 32,
                width: 360,
                ..LidarModel::default()
            };
            let image = renderer.render(&[lifted], &model).unwrap().remove(0);
            let beams: Vec<Beam> = RangeImage::from_ranges(image, &model).beams().collect();
            let objective = FrameObjective {
                renderer: &renderer,
                ground: &ground,
                beams: &beams,
                registered: &beams,
                level_m: None,
                attitude: SensorAttitude::default(),
                known_ground: None,
                difference: RangeDifference::truncated(0.5),
            };
            let found = objective.on_best_level(&pose).unwrap().level_m.unwrap();
            assert!((found - level_m).abs() < 0.01, "{found}");
            // Next to the deck there is one level.
            let next_to_deck = objective.on_best_level(&Pose2::translation(20.0, 0.0));
            assert!(next_to_deck.unwrap().level_m.unwrap().abs() < 0.01);
        }
    }

    #[test]
    fn ground_next_to_a_pose_is_found_within_a_distance() {
        // The ground ends at x = 401 m.
        let world = TestWorld::street();
        let objective = world.objective(&[]);
        for (x, distance_m, expected) in [
            (400.0, 0.0, true),
            (401.8, 1.9, false),
            (401.8, 2.0, true),
            (402.5, 5.9, false),
            (402.5, 6.0, true),
        ] {
            let found = objective.patch_within(&Pose2::translation(x, 0.5), distance_m);
            assert_eq!(found.unwrap().is_some(), expected, "{x} {distance_m}");
        }
    }

    #[test]
    fn where_there_is_no_ground_the_cost_is_infinite_unless_ground_is_remembered() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let beams: Vec<Beam> = image.beams().collect();
        let objective = world.objective(&beams);
        let off = [Pose2::translation(5e3, 0.0), world.pose_at(0.0, 0.0, 0.0)];
        let costs = objective.costs(&off, None).unwrap();
        assert_eq!(costs[0], f64::INFINITY);
        assert!(costs[1] < 1e-3);
        let patch = world.ground.patch_under(&off[1], None).unwrap();
        assert!(objective.costs(&off, patch.as_ref()).unwrap()[0].is_finite());
    }
}
