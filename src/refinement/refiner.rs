//! Refinement of one frame: the swarm searches around the estimate, Gauss-Newton finishes.
//!
//! Each is optional, and the result of each is accepted only if it lowers the objective. With both, the swarm searches
//! where the uncertainty of the estimate exceeds the basin of Gauss-Newton, and only there.

use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::objective::FrameObjective;
use super::smoothing::SmoothingConfig;
use super::swarm::{Dimension, SwarmConfig, minimize};
use super::upright::UprightSurfaces;
use super::wide_search::{self, WideSearchConfig};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::Beam;
use crate::map::{GroundPatch, SensorAttitude};
use crate::registration::{Linearized, RegistrationConfig, RegistrationResult};
use crate::rendering::RenderError;
use crate::validation::{
    InvalidValue, Validate, in_range, nested, not_negative, positive, require,
};

/// Steps of the refinement of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// No step; the estimate is kept.
    None,
    /// The particle swarm.
    Swarm,
    /// Gauss-Newton.
    GaussNewton,
    /// The swarm where the estimate may be outside the basin of Gauss-Newton, then Gauss-Newton.
    Both,
}

/// Configuration of the refinement of a frame.
///
/// Defaults: both steps; the bounds are of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct FrameRefinementConfig {
    /// Steps of the refinement of a frame.
    #[default(Method::Both)]
    pub method: Method,
    /// The swarm.
    pub swarm: SwarmConfig,
    /// Number of the frame's beams that the swarm compares: it searches the basin, Gauss-Newton the
    /// last centimetres.
    #[default(300)]
    pub swarm_beams: usize,
    /// Number of beams, of which Gauss-Newton registers the 4,800 most informative ones, or all if these are fewer.
    #[default(9600)]
    pub registered_beams: usize,
    /// Gauss-Newton.
    pub gauss_newton: RegistrationConfig,
    /// The smoothing of the whole trajectory.
    pub smoothing: SmoothingConfig,
    /// Reach of the swarm in standard deviations of the estimate (unitless).
    #[default(3.0)]
    pub reach_sigmas: f64,
    /// Smallest reach in x and y [m].
    #[default(0.1)]
    pub min_reach_m: f64,
    /// Smallest reach in heading [rad].
    #[default(0.01)]
    pub min_reach_rad: f64,
    /// Largest reach in x and y [m].
    #[default(10.0)]
    pub max_reach_m: f64,
    /// Largest reach in heading [rad].
    #[default(1.0)]
    pub max_reach_rad: f64,
    /// The search from farther away.
    pub wide_search: WideSearchConfig,
}

impl Validate for FrameRefinementConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("swarm", &self.swarm)?;
        in_range("swarm_beams", self.swarm_beams, 1..=1_000_000)?;
        in_range("registered_beams", self.registered_beams, 1..=1_000_000)?;
        nested("gauss_newton", &self.gauss_newton)?;
        nested("wide_search", &self.wide_search)?;
        nested("smoothing", &self.smoothing)?;
        not_negative("reach_sigmas", self.reach_sigmas)?;
        positive("min_reach_m", self.min_reach_m)?;
        positive("min_reach_rad", self.min_reach_rad)?;
        let ordered = |max_key: &str, max: f64, min_key: &str, min: f64| {
            let remedy = format!("it must not be less than {min_key}, which is {min}");
            positive(max_key, max)?;
            require(max >= min, max_key, max, remedy)
        };
        let (m, rad) = (self.min_reach_m, self.min_reach_rad);
        ordered("max_reach_m", self.max_reach_m, "min_reach_m", m)?;
        ordered("max_reach_rad", self.max_reach_rad, "min_reach_rad", rad)
    }
}

impl FrameRefinementConfig {
    /// Reach of the search for an estimate with a covariance: x, y [m], heading [rad].
    pub(crate) fn reach(&self, covariance: &Matrix3<f64>) -> [f64; 3] {
        let reach = |axis: usize, least: f64, most: f64| {
            let sigma = covariance[(axis, axis)].max(0.0).sqrt();
            (self.reach_sigmas * sigma).clamp(least, most)
        };
        [
            reach(0, self.min_reach_m, self.max_reach_m),
            reach(1, self.min_reach_m, self.max_reach_m),
            reach(2, self.min_reach_rad, self.max_reach_rad),
        ]
    }

    /// Whether an estimate may be outside the basin of Gauss-Newton, so that both steps are needed.
    pub(crate) fn is_wide(&self, covariance: &Matrix3<f64>) -> bool {
        /// Reach in x and y within which Gauss-Newton needs no swarm [m].
        const BASIN_M: f64 = 0.3;
        /// The same in heading.
        const BASIN_RAD: f64 = 0.04;
        let [x, y, heading] = self.reach(covariance);
        self.method == Method::Both && (x.max(y) > BASIN_M || heading > BASIN_RAD)
    }
}

/// A frame after refinement.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinedFrame {
    /// `map_from_lidar` seen from above.
    pub pose: Pose2,
    /// `map_from_lidar` in space.
    pub map_from_lidar: Pose3,
    /// The estimate in space.
    pub start_in_space: Pose3,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    /// Attitude of the sensor above the ground.
    pub attitude: SensorAttitude,
    /// That ground, known or mapped; `None` where there is none under the pose.
    pub ground: Option<GroundPatch>,
    /// Objective at the estimate [m].
    pub cost_before_m: f64,
    /// Objective at the result, never larger than before [m].
    pub cost_after_m: f64,
}

impl RefinedFrame {
    /// Takes a pose if its cost is lower.
    fn accept(&mut self, found: Option<(Pose3, f64)>) {
        if let Some((map_from_lidar, cost_m)) = found
            && cost_m < self.cost_after_m
        {
            self.pose = pose2_from_pose3(&map_from_lidar);
            self.map_from_lidar = map_from_lidar;
            self.cost_after_m = cost_m;
        }
    }
}

/// How far from the right pose an estimate may be.
#[derive(Clone, Copy)]
pub enum Distance<'a> {
    /// Inside the basin of Gauss-Newton.
    InBasin,
    /// About half a metre: Gauss-Newton begins with a wide kernel.
    Near,
    /// Up to its covariance: the swarm searches among these surfaces of the map.
    Far(&'a UprightSurfaces),
}

/// Refines an estimate with its covariance of (x, y, heading). The attitude of the objective is an
/// initial value, which is first fitted to the mapped ground, unless it is known. `None` where no ground is mapped under the
/// estimate and none is known, or the beams do not determine the pose there, and where the scan has no beams.
pub fn refine_frame(
    objective: &FrameObjective<'_>,
    estimate: &Pose2,
    covariance: &Matrix3<f64>,
    distance: Distance<'_>,
    config: &FrameRefinementConfig,
    rng: &mut impl Rng,
) -> Result<Option<RefinedFrame>, RenderError> {
    let reach = config.reach(covariance);
    let (objective, reach_m) = match distance {
        Distance::Far(_) => (*objective, reach[0].max(reach[1])),
        Distance::InBasin | Distance::Near => (objective.with_fitted_attitude(estimate)?, 0.0),
    };
    let objective = &objective;
    let Some(lifted) = objective
        .patch_within(estimate, reach_m)?
        .filter(|_| !objective.beams.is_empty())
        .map(|patch| patch.lift(estimate, &objective.attitude))
    else {
        return Ok(None);
    };
    let cost_before_m = objective.costs_in_space(&[lifted])?[0];
    let mut frame = RefinedFrame {
        pose: *estimate,
        map_from_lidar: lifted,
        start_in_space: lifted,
        covariance: *covariance,
        attitude: objective.attitude,
        ground: None,
        cost_before_m,
        cost_after_m: cost_before_m,
    };
    match distance {
        Distance::Far(surfaces) => search_widely(objective, &mut frame, surfaces, config, rng)?,
        _ if config.method == Method::Swarm => search(objective, &mut frame, config, rng)?,
        Distance::Near if config.method == Method::Both => {
            let (gauss_newton, wide) = (&config.gauss_newton, &config.wide_search);
            frame.accept(wide_search::finish(
                objective,
                estimate,
                0.0,
                gauss_newton,
                wide,
            )?);
        }
        _ => {}
    }
    let registered = match config.method {
        Method::GaussNewton | Method::Both => finish(objective, &mut frame, config)?,
        Method::Swarm => linearized(objective, &frame, config)?.kept()?,
        Method::None => None,
    };
    let mapped = objective
        .ground
        .patch_under(&frame.pose, objective.level_m)?;
    if mapped.is_none() && registered.is_none() {
        return Ok(None);
    }
    frame.ground = objective.known_ground.or(mapped);
    if let Some(ground) = &frame.ground {
        frame.attitude = ground.attitude_of(&frame.map_from_lidar);
    }
    if config.method != Method::None {
        let covariance = registered.map(|registered| registered.planar_covariance());
        frame.covariance = covariance.unwrap_or_else(undetermined) + config.gauss_newton.of_map();
    }
    Ok(Some(frame))
}

/// Covariance of (x, y, heading) where too few beams hit the map: half a metre and 0.05 rad.
fn undetermined() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 0.0025))
}

/// Searches for a better pose with swarms over the surfaces of the map.
fn search_widely(
    objective: &FrameObjective<'_>,
    frame: &mut RefinedFrame,
    surfaces: &UprightSurfaces,
    config: &FrameRefinementConfig,
    rng: &mut impl Rng,
) -> Result<(), RenderError> {
    let found = wide_search::search(
        objective,
        surfaces,
        &frame.pose,
        config.reach(&frame.covariance),
        &config.gauss_newton,
        &config.wide_search,
        rng,
    )?;
    frame.accept(found);
    Ok(())
}

/// Searches for a better pose with the swarm.
fn search(
    objective: &FrameObjective<'_>,
    frame: &mut RefinedFrame,
    config: &FrameRefinementConfig,
    rng: &mut impl Rng,
) -> Result<(), RenderError> {
    let reach = config.reach(&frame.covariance);
    let dimensions = Dimension::around(&frame.pose, reach, 0.5);
    let patch = objective.patch_under(&frame.pose)?;
    let step = objective.beams.len().div_ceil(config.swarm_beams).max(1);
    let beams: Vec<Beam> = objective.beams.iter().step_by(step).copied().collect();
    let coarse = FrameObjective {
        beams: &beams,
        ..*objective
    };
    let batch = |positions: &[[f64; 3]]| {
        let poses: Vec<Pose2> = positions.iter().map(pose_of).collect();
        coarse.costs(&poses, patch.as_ref())
    };
    let (position, _) = minimize(&dimensions, &config.swarm, batch, rng)?;
    let pose = pose_of(&position);
    let Some(lifted) = objective.lift(&pose, patch.as_ref())? else {
        return Ok(());
    };
    let cost_m = objective.costs_in_space(&[lifted])?[0];
    if cost_m < frame.cost_after_m {
        frame.pose = pose;
        frame.map_from_lidar = lifted;
        frame.cost_after_m = cost_m;
    }
    Ok(())
}

fn pose_of(&[x, y, heading_rad]: &[f64; 3]) -> Pose2 {
    Pose2::new(nalgebra::Vector2::new(x, y), heading_rad)
}

/// The beams to be registered at the pose of a frame.
fn linearized<'a>(
    objective: &FrameObjective<'a>,
    frame: &RefinedFrame,
    config: &'a FrameRefinementConfig,
) -> Result<Linearized<'a>, RenderError> {
    let (renderer, beams) = (objective.renderer, objective.registered);
    let pose = &frame.map_from_lidar;
    Linearized::new(renderer, beams, pose, &config.gauss_newton)
}

/// Runs Gauss-Newton; the pose is kept where that does not lower the objective. `None` if the beams do not determine the pose.
fn finish(
    objective: &FrameObjective<'_>,
    frame: &mut RefinedFrame,
    config: &FrameRefinementConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    let start = linearized(objective, frame, config)?;
    let Some(registered) = start.registered()? else {
        return start.kept();
    };
    let cost_m = objective.costs_in_space(&[registered.map_from_lidar])?[0];
    if cost_m > frame.cost_after_m {
        return start.kept();
    }
    frame.map_from_lidar = registered.map_from_lidar;
    frame.pose = pose2_from_pose3(&registered.map_from_lidar);
    frame.cost_after_m = cost_m;
    Ok(Some(registered))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::geometry::Vec3;
    use crate::lidar::{LidarModel, RangeImage};
    use crate::map::world_for_tests::TestWorld;
    use crate::registration::register_informative;
    use crate::rendering::{RangeDifference, RangeRenderer, SurfaceHit};

    fn refine(method: Method, off: &Pose2, seed: u64) -> (RefinedFrame, Pose2) {
        let world = TestWorld::street();
        let truth = world.pose_at(18.0, 0.2, 0.05);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(7).collect();
        let objective = world.objective(&beams);
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.0025, 0.0025, 1e-4));
        let config = FrameRefinementConfig {
            method,
            ..FrameRefinementConfig::default()
        };
        let mut rng = StdRng::seed_from_u64(seed);
        let frame = refine_frame(
            &objective,
            &(truth * off),
            &covariance,
            Distance::InBasin,
            &config,
            &mut rng,
        );
        (frame.unwrap().unwrap(), truth)
    }

    fn error(frame: &RefinedFrame, truth: &Pose2) -> f64 {
        (frame.pose.translation.vector - truth.translation.vector).norm()
    }

    #[test]
    fn every_method_approaches_the_truth_and_method_none_keeps_the_estimate() {
        let off = Pose2::new(Vector2::new(0.08, -0.06), 0.006);
        for (method, tolerance_m) in [
            (Method::Swarm, 0.02),
            (Method::GaussNewton, 0.005),
            (Method::Both, 0.005),
        ] {
            for seed in 0..3 {
                let (frame, truth) = refine(method, &off, seed);
                assert!(
                    error(&frame, &truth) < tolerance_m,
                    "{method:?}: {}",
                    error(&frame, &truth)
                );
                assert!(frame.cost_after_m < frame.cost_before_m);
                assert!(frame.covariance.cholesky().is_some());
            }
        }
        let (frame, truth) = refine(Method::None, &off, 0);
        assert!((error(&frame, &truth) - 0.1).abs() < 1e-9);
        assert_eq!(frame.cost_after_m, frame.cost_before_m);
    }

    #[test]
    fn an_estimate_outside_the_basin_is_found_by_a_wide_kernel_or_farther_off_by_swarms() {
        let world = TestWorld::street();
        let surfaces = UprightSurfaces::new(&world.map().mesh().unwrap());
        let truth = world.pose_at(18.0, 0.2, 0.05);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(5).collect();
        let objective = world.objective(&beams);
        let covariance = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.04));
        // A narrow kernel has a narrow basin.
        let mut config = FrameRefinementConfig::default();
        config.gauss_newton.kernel_m = 0.03;
        let error_m = |[x, y, turn_rad]: [f64; 3], distance: Distance<'_>| {
            let estimate = truth * Pose2::new(Vector2::new(x, y), turn_rad);
            let mut rng = StdRng::seed_from_u64(1);
            let (objective, covariance) = (&objective, &covariance);
            let frame = refine_frame(
                objective, &estimate, covariance, distance, &config, &mut rng,
            );
            error(&frame.unwrap().unwrap(), &truth)
        };
        let reach_m = |distance: Distance<'_>| {
            let offs_m = (1..=30).map(|number| 0.1 * f64::from(number));
            let found = offs_m
                .take_while(|off_m| error_m([0.8 * off_m, -0.6 * off_m, 0.02], distance) < 0.02);
            found.last().unwrap_or(0.0)
        };
        let (in_basin_m, near_m) = (reach_m(Distance::InBasin), reach_m(Distance::Near));
        assert!(near_m > in_basin_m.max(0.45), "{in_basin_m} {near_m}");
        assert!(error_m([2.0, -1.5, 0.4], Distance::Far(&surfaces)) < 0.02);
    }

    #[test]
    fn an_estimate_is_wide_if_its_reach_exceeds_thirty_centimetres_or_a_twenty_fifth_of_a_radian() {
        let config = FrameRefinementConfig {
            reach_sigmas: 2.0,
            ..FrameRefinementConfig::default()
        };
        let is_wide = |method: Method, sigmas: [f64; 3]| {
            let config = FrameRefinementConfig {
                method,
                ..config.clone()
            };
            let sigmas = Vector3::from(sigmas);
            config.is_wide(&Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)))
        };
        for (sigmas, expected) in [
            ([0.15, 0.15, 0.02], false),
            ([0.16, 0.0, 0.0], true),
            ([0.0, 0.16, 0.0], true),
            ([0.0, 0.0, 0.021], true),
        ] {
            assert_eq!(is_wide(Method::Both, sigmas), expected, "{sigmas:?}");
            assert!(!is_wide(Method::Swarm, sigmas) && !is_wide(Method::GaussNewton, sigmas));
        }
        // From the least to the largest reach.
        let covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e4, 0.01));
        let reach = config.reach(&covariance);
        assert_eq!(reach, [config.min_reach_m, config.max_reach_m, 0.2]);
    }

    #[test]
    fn a_correct_estimate_stays_correct() {
        for seed in 0..3 {
            let (frame, truth) = refine(Method::Both, &Pose2::identity(), seed);
            assert!(frame.cost_after_m <= frame.cost_before_m);
            assert!(error(&frame, &truth) < 0.005);
        }
    }

    /// A renderer whose surfaces contradict its ranges: Gauss-Newton is led astray.
    struct Astray<'a> {
        ranges: &'a dyn RangeRenderer,
        surfaces: TestWorld,
    }

    impl RangeRenderer for Astray<'_> {
        fn name(&self) -> String {
            "astray".into()
        }

        fn render(
            &self,
            poses: &[Pose3],
            model: &LidarModel,
        ) -> Result<Vec<Vec<f32>>, RenderError> {
            self.ranges.render(poses, model)
        }

        fn cast(
            &self,
            poses: &[Pose3],
            directions: &[Vec3],
            until_m: f32,
        ) -> Result<Vec<Vec<f32>>, RenderError> {
            self.ranges.cast(poses, directions, until_m)
        }

        fn surfaces(
            &self,
            pose: &Pose3,
            beams: &[Beam],
            within_m: f32,
        ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
            self.surfaces.surfaces(pose, beams, within_m)
        }

        fn compare(
            &self,
            poses: &[Pose3],
            beams: &[Beam],
            difference: &RangeDifference,
        ) -> Result<Vec<f32>, RenderError> {
            self.ranges.compare(poses, beams, difference)
        }

        fn compare_images(
            &self,
            poses: &[Pose3],
            measured: &RangeImage,
            difference: &RangeDifference,
        ) -> Result<Vec<f32>, RenderError> {
            self.ranges.compare_images(poses, measured, difference)
        }
    }

    #[test]
    fn a_step_of_gauss_newton_that_raises_the_cost_is_rejected() {
        let world = TestWorld::street();
        let renderer = Astray {
            ranges: &world,
            surfaces: TestWorld::moved_street(Pose2::translation(0.08, 0.06)),
        };
        let truth = world.pose_at(18.0, 0.2, 0.05);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(7).collect();
        let objective = FrameObjective {
            renderer: &renderer,
            ..world.objective(&beams)
        };
        let lifted = objective.lift(&truth, None).unwrap().unwrap();
        let config = FrameRefinementConfig::default();
        let found = register_informative(&renderer, &beams, &lifted, &config.gauss_newton).unwrap();
        let led_m =
            (found.unwrap().map_from_lidar.translation.vector - lifted.translation.vector).norm();
        assert!(led_m > 0.05, "{led_m}");
        for (method, distance) in [
            (Method::GaussNewton, Distance::InBasin),
            (Method::Both, Distance::Near),
        ] {
            let config = FrameRefinementConfig {
                method,
                ..config.clone()
            };
            let (covariance, mut rng) = (1e-4 * Matrix3::identity(), StdRng::seed_from_u64(1));
            let frame = refine_frame(&objective, &truth, &covariance, distance, &config, &mut rng);
            let frame = frame.unwrap().unwrap();
            assert_eq!(frame.pose, truth);
            assert_eq!(frame.cost_after_m, frame.cost_before_m);
        }
    }

    #[test]
    fn a_registered_frame_has_the_covariance_of_its_registration() {
        let world = TestWorld::street();
        let truth = world.pose_at(18.0, 0.2, 0.05);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(7).collect();
        let estimate = truth * Pose2::new(Vector2::new(0.08, -0.06), 0.006);
        let config = FrameRefinementConfig {
            method: Method::GaussNewton,
            ..FrameRefinementConfig::default()
        };
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.0025, 0.0025, 1e-4));
        let objective = world.objective(&beams);
        let (distance, mut rng) = (Distance::InBasin, StdRng::seed_from_u64(1));
        let frame = refine_frame(
            &objective,
            &estimate,
            &covariance,
            distance,
            &config,
            &mut rng,
        );
        let frame = frame.unwrap().unwrap();
        let start = &frame.start_in_space;
        let registered = register_informative(&world, &beams, start, &config.gauss_newton);
        let registered = registered.unwrap().unwrap();
        assert_eq!(frame.map_from_lidar, registered.map_from_lidar);
        let of_map = config.gauss_newton.of_map();
        assert_eq!(frame.covariance, registered.planar_covariance() + of_map);
    }

    #[test]
    fn a_frame_whose_registration_is_rejected_has_the_covariance_of_its_scan_at_the_pose_that_is_kept()
     {
        let world = TestWorld::street();
        let truth = world.pose_at(18.0, 0.2, 0.05);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(7).collect();
        let config = FrameRefinementConfig {
            method: Method::GaussNewton,
            ..FrameRefinementConfig::default()
        };
        // The costs are least at the estimate, from which the surfaces lead away.
        let renderer = Astray {
            ranges: &world,
            surfaces: TestWorld::moved_street(Pose2::translation(0.08, 0.06)),
        };
        let objective = FrameObjective {
            renderer: &renderer,
            ..world.objective(&beams)
        };
        let (covariance, mut rng) = (1e-4 * Matrix3::identity(), StdRng::seed_from_u64(1));
        let distance = Distance::InBasin;
        let frame = refine_frame(&objective, &truth, &covariance, distance, &config, &mut rng);
        let frame = frame.unwrap().unwrap();
        assert_eq!(frame.pose, truth);
        let kept = &frame.map_from_lidar;
        let there = Linearized::new(&renderer, &beams, kept, &config.gauss_newton).unwrap();
        let expected = there.kept().unwrap().unwrap().planar_covariance();
        let expected = expected + config.gauss_newton.of_map();
        assert_eq!(frame.covariance, expected);
    }

    #[test]
    fn a_pose_that_the_swarm_finds_is_accepted_only_if_all_beams_fit_better() {
        let world = TestWorld::street();
        let truth = world.pose_at(18.0, 0.2, 0.05);
        // The beams that the swarm compares are all too long.
        let beams: Vec<Beam> = (world.scan(&truth).beams().step_by(7).enumerate())
            .map(|(number, beam)| Beam {
                range_m: beam.range_m + if number % 10 == 0 { 0.1 } else { 0.0 },
                ..beam
            })
            .collect();
        let config = FrameRefinementConfig {
            method: Method::Swarm,
            swarm_beams: beams.len().div_ceil(10),
            ..FrameRefinementConfig::default()
        };
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.0025, 0.0025, 1e-4));
        for seed in 0..3 {
            let objective = world.objective(&beams);
            let mut rng = StdRng::seed_from_u64(seed);
            let distance = Distance::InBasin;
            let frame = refine_frame(&objective, &truth, &covariance, distance, &config, &mut rng);
            let frame = frame.unwrap().unwrap();
            assert!(frame.cost_after_m <= frame.cost_before_m);
            assert!(error(&frame, &truth) < 0.01, "{}", error(&frame, &truth));
        }
    }

    #[test]
    fn a_frame_without_beams_or_ground_is_not_refined() {
        let world = TestWorld::street();
        let truth = world.pose_at(0.0, 0.0, 0.0);
        let beams: Vec<Beam> = world.scan(&truth).beams().collect();
        let config = FrameRefinementConfig::default();
        let mut rng = StdRng::seed_from_u64(1);
        let covariance = Matrix3::identity();
        let empty = world.objective(&[]);
        assert_eq!(
            refine_frame(
                &empty,
                &truth,
                &covariance,
                Distance::InBasin,
                &config,
                &mut rng
            )
            .unwrap(),
            None
        );
        let off = Pose2::translation(1e5, 0.0);
        let objective = world.objective(&beams);
        assert_eq!(
            refine_frame(
                &objective,
                &off,
                &covariance,
                Distance::InBasin,
                &config,
                &mut rng
            )
            .unwrap(),
            None
        );
    }
}
