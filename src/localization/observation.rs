//! How well the map explains a scan from a pose.
//!
//! ```text
//! d = mean over the beams of cost(measured, rendered)      [m]
//! L = exp(−½ d² / σ²)      reference: |difference| without limits, σ = 2 m
//! L = exp(−d / s)          robust: |difference| up to a limit
//! ```
//!
//! The beams are a stratified part of the scan, the same for every particle of a frame, and are
//! cast along the directions in which they were measured. Chen et al., *Range Image-based LiDAR
//! Localization for Autonomous Vehicles*, ICRA 2021, eq. 6, for the reference.

use rand::{Rng, RngExt as _};
use serde::{Deserialize, Serialize};

use super::particles::Hypothesis;
use crate::geometry::{Pose3, Rigid3f, Vec3};
use crate::lidar::{Beam, RangeImage};
use crate::map::{GroundMap, GroundPatch, Stance, TileGrid};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError};
use crate::validation::{
    InvalidValue, Validate, at_least_one, fraction, positive, positive_or_infinite,
};

/// From the mean cost of the beams to a likelihood.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Likelihood {
    /// range-mcl's: a Gaussian of the mean |difference| without limits.
    Reference,
    /// Exponential in the mean |difference| with limits.
    Robust,
}

/// Which beams are compared, and what a difference means.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObservationConfig {
    /// The form of the likelihood.
    pub likelihood: Likelihood,
    /// Standard deviation σ of the reference likelihood [m].
    pub reference_sigma_m: f64,
    /// Scale s of the robust likelihood: a mean cost that is larger by s is e times less likely [m].
    pub scale_m: f64,
    /// Limit of the cost of a return nearer than the map: something that the map does not have [m].
    pub short_m: f32,
    /// Limit of the cost of a return behind a surface of the map [m].
    pub long_m: f32,
    /// Limit of the cost of a return where the map has nothing [m].
    pub no_surface_m: f32,
    /// Beams per particle, at most.
    pub beams: usize,
    /// Beams per particle, at least, however many particles there are.
    pub min_beams: usize,
    /// Rays per update over all particles: many particles get fewer beams each.
    pub ray_budget: usize,
    /// At most this share of the beams looks at the road, which looks the same from everywhere.
    pub road_share: f64,
}

impl Default for ObservationConfig {
    /// Robust; see [`reference`](Self::reference) for the published values.
    fn default() -> Self {
        Self {
            likelihood: Likelihood::Robust,
            reference_sigma_m: 2.0,
            scale_m: 0.002,
            short_m: 0.5,
            long_m: 0.5,
            no_surface_m: 0.5,
            beams: 3600,
            min_beams: 300,
            ray_budget: 1_000_000,
            road_share: 0.2,
        }
    }
}

impl Validate for ObservationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("reference_sigma_m", self.reference_sigma_m)?;
        positive("scale_m", self.scale_m)?;
        positive_or_infinite("short_m", self.short_m)?;
        positive_or_infinite("long_m", self.long_m)?;
        positive_or_infinite("no_surface_m", self.no_surface_m)?;
        at_least_one("beams", self.beams)?;
        at_least_one("min_beams", self.min_beams)?;
        at_least_one("ray_budget", self.ray_budget)?;
        fraction("road_share", self.road_share)
    }
}

impl ObservationConfig {
    /// The likelihood of range-mcl, on our beams: no limits, σ = 2 m.
    pub fn reference() -> Self {
        Self {
            likelihood: Likelihood::Reference,
            road_share: 1.0,
            ..Self::default()
        }
    }

    /// What a difference of ranges costs.
    pub fn difference(&self) -> RangeDifference {
        match self.likelihood {
            Likelihood::Reference => RangeDifference::UNLIMITED,
            Likelihood::Robust => RangeDifference {
                short_m: self.short_m,
                long_m: self.long_m,
                no_surface_m: self.no_surface_m,
            },
        }
    }

    /// Logarithm of the likelihood of a mean cost [m], up to a constant (unitless).
    pub fn log_likelihood(&self, cost_m: f64) -> f64 {
        match self.likelihood {
            Likelihood::Reference => -0.5 * (cost_m / self.reference_sigma_m).powi(2),
            Likelihood::Robust => -cost_m / self.scale_m,
        }
    }

    /// Logarithm of the likelihood of a pose that is not on the map: range-mcl's 1e-5, and never
    /// better than the worst that a pose on the map can get.
    pub fn floor_log_likelihood(&self) -> f64 {
        let worst_m = f64::from(self.short_m.max(self.long_m).max(self.no_surface_m));
        match self.likelihood {
            Likelihood::Reference => 1e-5_f64.ln(),
            Likelihood::Robust => self.log_likelihood(worst_m) + 1e-5_f64.ln(),
        }
    }

    /// How many beams each of `poses` poses gets.
    pub fn beams_for(&self, poses: usize) -> usize {
        (self.ray_budget / poses.max(1))
            .max(self.min_beams)
            .min(self.beams)
    }
}

/// Draws beams of a scan, evenly over the image, at most `road_share` of them from the road.
/// In the order of the image: neighbours stay neighbours.
pub fn choose_beams(
    image: &RangeImage,
    count: usize,
    road_share: f64,
    stance: &Stance,
    rng: &mut impl Rng,
) -> Vec<Beam> {
    /// What is lower than this over the plane of the road is the road [m].
    const ROAD_TOP_M: f32 = 0.3;
    let road_from_lidar = Rigid3f::from(&stance.road_from_lidar());
    let is_road = |index: usize| road_from_lidar.apply(image.points[index]).z < ROAD_TOP_M;
    let returns = (0..image.ranges.len()).filter(|&index| image.has_return(index));
    let (road, rest): (Vec<usize>, Vec<usize>) = returns.partition(|&index| is_road(index));

    let most_of_road = (road_share * count as f64).round() as usize;
    let fair = count * road.len() / (road.len() + rest.len()).max(1);
    let of_road = fair.min(most_of_road);
    let mut chosen = stratified(&road, of_road, rng);
    chosen.extend(stratified(&rest, count - of_road, rng));
    chosen.sort_unstable();
    chosen
        .into_iter()
        .filter_map(|index| image.beam(index))
        .collect()
}

/// One member from each of `count` equal stretches of a list; the whole list where it is shorter.
fn stratified(list: &[usize], count: usize, rng: &mut impl Rng) -> Vec<usize> {
    if list.len() <= count {
        return list.to_vec();
    }
    let stretch = list.len() as f64 / count as f64;
    (0..count)
        .map(|k| {
            let place = (k as f64 + rng.random::<f64>()) * stretch;
            list[(place as usize).min(list.len() - 1)]
        })
        .collect()
}

/// A few thousand of the returns near the car, most of them from the road: for
/// [`GroundMap::stance_at`].
pub fn near_points(image: &RangeImage) -> Vec<Vec3> {
    /// As far as the rings on the road are dense [m].
    const NEAR_M: f32 = 20.0;
    /// Coprime to the widths of images, so that no column is left out.
    const EVERY: usize = 7;
    (0..image.ranges.len())
        .step_by(EVERY)
        .filter(|&index| image.ranges[index] < NEAR_M)
        .map(|index| image.points[index])
        .collect()
}

/// Mean cost of the beams from each pose [m]; `None` for poses that are not on the map.
pub fn costs(
    renderer: &dyn RangeRenderer,
    map_from_lidar: &[Option<Pose3>],
    beams: &[Beam],
    difference: &RangeDifference,
) -> Result<Vec<Option<f64>>, RenderError> {
    let on_map: Vec<Pose3> = map_from_lidar.iter().flatten().copied().collect();
    let mut rendered = renderer
        .compare(&on_map, beams, difference)?
        .into_iter()
        .map(f64::from);
    Ok(map_from_lidar
        .iter()
        .map(|pose| pose.as_ref().and_then(|_| rendered.next()))
        .collect())
}

/// The ground that a hypothesis on the map stands on; `None` outside the tiles that were mapped and
/// where there is no ground. `remembered` is a patch to stand on where the map has a gap.
pub fn footing(
    hypothesis: &Hypothesis,
    ground: &GroundMap,
    tiles: &TileGrid,
    remembered: Option<&GroundPatch>,
) -> Option<GroundPatch> {
    let pose = &hypothesis.map_from_lidar;
    tiles.valid_tile_of(pose)?;
    let patch = ground.patch_under(pose, hypothesis.level_m);
    patch.or(remembered.copied())
}

/// How the beams of a scan meet the map from one pose, as counts. Beams that look at the road
/// and beams without a surface behind them say nothing and are not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fit {
    /// The return is where the map has a surface.
    pub hit: usize,
    /// The return is nearer: something stands in front of the map.
    pub short: usize,
    /// The return is farther: the beam went through a surface of the map.
    pub long: usize,
    /// The map has nothing along the beam.
    pub missing: usize,
}

impl Fit {
    /// Compares measured with rendered ranges, one of each per beam.
    pub fn of(beams: &[Beam], rendered_m: &[f32], tolerance_m: f32) -> Self {
        let mut fit = Self::default();
        for (beam, &rendered_m) in beams.iter().zip(rendered_m) {
            let excess_m = beam.range_m - rendered_m;
            let count = if rendered_m == f32::INFINITY {
                &mut fit.missing
            } else if excess_m.abs() <= tolerance_m {
                &mut fit.hit
            } else if excess_m < 0.0 {
                &mut fit.short
            } else {
                &mut fit.long
            };
            *count += 1;
        }
        fit
    }

    /// Of the beams that reached the map, how many met it where it is; `None` where too few did
    /// to tell. What stands in the way (traffic) does not count against a pose.
    pub fn agreement(&self) -> Option<f64> {
        /// Fewer beams than this tell nothing.
        const ENOUGH: usize = 30;
        let reached = self.hit + self.long;
        (reached >= ENOUGH).then(|| self.hit as f64 / reached as f64)
    }
}

/// The beams that end above the road: what tells one place from another.
pub fn above_road(beams: &[Beam], stance: &Stance, clearance_m: f32) -> Vec<Beam> {
    let road_from_lidar = Rigid3f::from(&stance.road_from_lidar());
    let height_of = |point: Vec3| road_from_lidar.apply(point).z;
    beams
        .iter()
        .filter(|beam| height_of(beam.point()) > clearance_m)
        .copied()
        .collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::geometry::Pose2;
    use crate::lidar::LidarModel;
    use crate::rendering::test_world::TestWorld;

    #[test]
    fn the_reference_likelihood_is_the_published_one() {
        let config = ObservationConfig::reference();
        assert_eq!(config.difference(), RangeDifference::UNLIMITED);
        for cost in [0.0, 0.5, 2.0, 7.0_f64] {
            let published = (-0.5 * cost * cost / 4.0).exp();
            assert_relative_eq!(
                config.log_likelihood(cost).exp(),
                published,
                epsilon = 1e-12
            );
        }
        assert_relative_eq!(config.floor_log_likelihood().exp(), 1e-5, epsilon = 1e-12);
    }

    #[test]
    fn nothing_on_the_map_is_worse_than_off_the_map_for_the_robust_likelihood() {
        let config = ObservationConfig::default();
        assert!(config.log_likelihood(0.5) > config.floor_log_likelihood());
        assert!(config.log_likelihood(0.1) > config.log_likelihood(0.11));
    }

    #[test]
    fn beams_are_spread_over_the_image_and_few_of_them_look_at_the_road() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let mut rng = StdRng::seed_from_u64(1);
        let beams = choose_beams(&image, 1000, 0.2, &Stance::default(), &mut rng);
        assert_eq!(beams.len(), 1000);
        let high = above_road(&beams, &Stance::default(), 0.3);
        assert!((795..=805).contains(&high.len()), "{}", high.len());
        // All round: no quarter of the circle is left out.
        for quarter in 0..4 {
            let in_quarter = |b: &&Beam| {
                let turn = f64::from(b.direction.y.atan2(b.direction.x)) / std::f64::consts::TAU;
                ((turn + 0.5) * 4.0) as usize == quarter
            };
            assert!(beams.iter().filter(in_quarter).count() > 100);
        }
    }

    #[test]
    fn a_scan_with_few_returns_gives_what_it_has() {
        let model = LidarModel::default();
        let image = RangeImage::project(&[Vec3::new(8.0, 1.0, 0.0)], &model);
        let mut rng = StdRng::seed_from_u64(1);
        let beams = choose_beams(&image, 100, 0.2, &Stance::default(), &mut rng);
        assert_eq!(beams.len(), 1);
        let empty = RangeImage::project(&[], &model);
        assert!(choose_beams(&empty, 100, 0.2, &Stance::default(), &mut rng).is_empty());
    }

    #[test]
    fn the_cost_is_least_at_the_truth_and_poses_off_the_map_have_none() {
        let world = TestWorld::street();
        let truth = world.pose_at(3.0, 0.2, 0.1);
        let mut rng = StdRng::seed_from_u64(1);
        let image = world.scan(&truth);
        let beams = choose_beams(&image, 2000, 0.2, &Stance::default(), &mut rng);
        let place = |x: f64, y: f64, heading: f64| {
            let pose = Pose2::new(nalgebra::Vector2::new(x, y), heading);
            let patch = footing(&pose.into(), &world.ground, &world.tiles, None);
            patch.map(|patch| patch.lift(&pose, &Stance::default()))
        };
        let poses = [
            place(3.0, 0.2, 0.1),
            place(3.1, 0.2, 0.1),
            place(3.0, 0.3, 0.1),
            place(3.0, 0.2, 0.11),
            place(900.0, 0.0, 0.0),
        ];
        let difference = ObservationConfig::default().difference();
        let costs = costs(&world, &poses, &beams, &difference).unwrap();
        assert_eq!(costs[4], None);
        assert!(costs[0].unwrap() < 1e-3);
        assert!(
            costs[1..4].iter().all(|cost| cost.unwrap() > 0.005),
            "{costs:?}"
        );
    }

    #[test]
    fn what_stands_in_the_way_does_not_count_against_a_pose() {
        let beam = |range_m| Beam {
            direction: Vec3::X,
            range_m,
        };
        let beams: Vec<Beam> = (0..90)
            .map(|i| beam(if i < 40 { 5.0 } else { 10.0 }))
            .collect();
        let fit = Fit::of(&beams, &[10.0; 90], 0.3);
        assert_eq!((fit.hit, fit.short, fit.long), (50, 40, 0));
        assert_eq!(fit.agreement(), Some(1.0));
        assert_eq!(Fit::of(&beams, &[7.0; 90], 0.3).agreement(), Some(0.0));
        assert_eq!(Fit::of(&beams, &[f32::INFINITY; 90], 0.3).agreement(), None);
    }
}
