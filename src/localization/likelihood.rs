//! Profiles of the likelihood around a pose, along, across and in heading.

use super::observation::{ObservationConfig, costs};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::Beam;
use crate::map::{GroundMap, SensorAttitude};
use crate::rendering::{RangeRenderer, RenderError};

/// Number of offsets on each side of the pose; they are denser near it, where the peak is.
const STEPS: i32 = 60;

/// Direction of an offset from a pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Forward [m].
    Along,
    /// To the left [m].
    Across,
    /// Turn to the left [deg].
    Heading,
}

impl Direction {
    /// All directions.
    pub const ALL: [Self; 3] = [Self::Along, Self::Across, Self::Heading];

    /// Largest offset [m or deg].
    pub fn reach(self) -> f64 {
        match self {
            Self::Along | Self::Across => 2.0,
            Self::Heading => 10.0,
        }
    }

    /// Moves a pose by an offset [m or deg].
    pub fn moved(self, pose: &Pose2, offset: f64) -> Pose2 {
        let step = match self {
            Self::Along => Pose2::translation(offset, 0.0),
            Self::Across => Pose2::translation(0.0, offset),
            Self::Heading => Pose2::rotation(offset.to_radians()),
        };
        pose * step
    }
}

/// Scan and map of a profile.
#[derive(Clone, Copy)]
pub struct View<'a> {
    /// Renders the map.
    pub renderer: &'a dyn RangeRenderer,
    /// Ground of the map.
    pub ground: &'a GroundMap,
    /// Approximate height of the ground [m], which selects among several levels.
    pub level_m: Option<f64>,
    /// Attitude of the sensor above the ground.
    pub attitude: SensorAttitude,
    /// Beams of the scan, lidar frame.
    pub beams: &'a [Beam],
}

/// Returns (offset [m or deg], likelihood relative to the best offset), offsets ascending, without those
/// that have no ground below.
pub fn profile(
    view: &View,
    pose: &Pose2,
    direction: Direction,
    config: &ObservationConfig,
) -> Result<Vec<(f64, f64)>, RenderError> {
    let offsets: Vec<f64> = (-STEPS..=STEPS)
        .map(|step| {
            let share = f64::from(step) / f64::from(STEPS);
            direction.reach() * share * share.abs()
        })
        .collect();
    let lifted: Vec<Option<Pose3>> = offsets
        .iter()
        .map(|&offset| {
            let moved = direction.moved(pose, offset);
            let patch = view.ground.patch_under(&moved, view.level_m)?;
            Ok(patch.map(|patch| patch.lift(&moved, &view.attitude)))
        })
        .collect::<Result<_, RenderError>>()?;
    let costs_m = costs(view.renderer, &lifted, view.beams, &config.difference())?;
    let logs: Vec<(f64, f64)> = offsets
        .into_iter()
        .zip(costs_m)
        .filter_map(|(offset, cost_m)| Some((offset, config.log_likelihood(cost_m?))))
        .collect();
    let best = logs
        .iter()
        .fold(f64::NEG_INFINITY, |best, &(_, log)| best.max(log));
    Ok(logs
        .into_iter()
        .map(|(offset, log)| (offset, (log - best).exp()))
        .collect())
}

/// Width of the peak of a profile at half its height [m or deg]; `None` where the profile does not fall
/// that far on both sides.
pub fn width_at_half(profile: &[(f64, f64)]) -> Option<f64> {
    let peak = (0..profile.len()).max_by(|&a, &b| profile[a].1.total_cmp(&profile[b].1))?;
    let half = 0.5 * profile[peak].1;
    let crossing = |above: usize, below: usize| {
        let ((x0, y0), (x1, y1)) = (profile[above], profile[below]);
        x0 + (x1 - x0) * (y0 - half) / (y0 - y1)
    };
    let left = (0..peak).rev().find(|&index| profile[index].1 <= half)?;
    let right = (peak + 1..profile.len()).find(|&index| profile[index].1 <= half)?;
    Some(crossing(right - 1, right) - crossing(left + 1, left))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn the_width_of_a_triangle_is_half_its_base_and_a_plateau_has_none() {
        let triangle: Vec<(f64, f64)> = (-10..=10)
            .map(|k| (f64::from(k), 1.0 - 0.1 * f64::from(k).abs()))
            .collect();
        assert_relative_eq!(width_at_half(&triangle).unwrap(), 10.0, epsilon = 1e-12);
        let plateau: Vec<(f64, f64)> = (0..5).map(|k| (f64::from(k), 1.0)).collect();
        assert_eq!(width_at_half(&plateau), None);
        assert_eq!(width_at_half(&[]), None);
    }

    #[test]
    fn an_offset_is_in_the_axes_of_the_car() {
        let pose = Pose2::new(
            nalgebra::Vector2::new(1.0, 2.0),
            std::f64::consts::FRAC_PI_2,
        );
        let ahead = Direction::Along.moved(&pose, 0.5).translation;
        assert_relative_eq!(
            ahead.vector,
            nalgebra::Vector2::new(1.0, 2.5),
            epsilon = 1e-12
        );
        let left = Direction::Across.moved(&pose, 0.5).translation;
        assert_relative_eq!(
            left.vector,
            nalgebra::Vector2::new(0.5, 2.0),
            epsilon = 1e-12
        );
        let turned = Direction::Heading.moved(&pose, 90.0);
        assert_relative_eq!(
            turned.rotation.angle().abs(),
            std::f64::consts::PI,
            epsilon = 1e-12
        );
    }

    #[test]
    fn the_robust_likelihood_is_more_peaked_than_the_reference_and_its_peak_is_at_the_truth() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.1, 0.05);
        let image = world.scan(&truth);
        let beams: Vec<Beam> = image.beams().collect();
        let view = View {
            renderer: &world,
            ground: &world.ground,
            level_m: None,
            attitude: SensorAttitude::default(),
            beams: &beams,
        };
        for direction in Direction::ALL {
            let of =
                |config: &ObservationConfig| profile(&view, &truth, direction, config).unwrap();
            let robust = of(&ObservationConfig::default());
            let best = robust.iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            assert!(best.0.abs() < 0.05, "{direction:?}: {best:?}");
            let narrow = width_at_half(&robust).unwrap();
            assert!(narrow < 0.1 * direction.reach(), "{direction:?}: {narrow}");
            let wide = width_at_half(&of(&ObservationConfig::reference()));
            assert!(
                wide.is_none_or(|wide| wide > 4.0 * narrow),
                "{direction:?}: {wide:?}"
            );
        }
    }
}
