//! Observation model: the likelihood of a scan at a pose in the map.
//!
//! ```text
//! d = mean over the beams of cost(measured, rendered)      [m]
//! L = exp(−½ d² / σ²)      reference: |difference| without limits, σ = 2 m
//! L = exp(−d / s)          robust: |difference| up to a limit
//! ```
//!
//! Robust: the beams are an evenly spread sample of the scan, the same for all particles of a frame, and are
//! cast along the directions in which they were measured. Reference: the beams are the pixels with a return of the
//! whole range image, and the map is rendered at their centres, within the limits of the range. Chen et al., *Range
//! Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021, eq. 6, for the reference.

use rand::{Rng, RngExt as _};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::Particle;
use crate::geometry::{Pose3, Rigid3f, Vec3};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::map::{GroundPatch, Map, SensorAttitude};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError, coherent_order};
use crate::validation::{
    InvalidValue, Validate, fraction, in_range, positive, positive_or_infinite,
};

/// Form of the likelihood.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Likelihood {
    /// Gaussian of the mean |difference| of whole range images without limits, as in range-mcl.
    Reference,
    /// Exponential of the mean |difference| along beams with limits.
    Robust,
}

/// Selection of beams and cost of differences.
///
/// Defaults: robust; see [`reference`](Self::reference) for the published values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ObservationConfig {
    /// Form of the likelihood.
    #[default(Likelihood::Robust)]
    pub likelihood: Likelihood,
    /// Standard deviation σ of the reference likelihood [m].
    #[default(2.0)]
    pub reference_sigma_m: f64,
    /// Scale s of the robust likelihood: a mean cost that is larger by s is e times less likely [m].
    #[default(0.002)]
    pub scale_m: f64,
    /// Limit of the cost of a return in front of the map [m].
    #[default(0.5)]
    pub short_m: f32,
    /// Limit of the cost of a return behind a surface of the map [m].
    #[default(0.5)]
    pub long_m: f32,
    /// Limit of the cost of a return where the map has no surface [m].
    #[default(0.5)]
    pub no_surface_m: f32,
    /// Beams per particle, at most.
    #[default(3600)]
    pub beams: usize,
    /// Beams per particle, at least.
    #[default(20)]
    pub min_beams: usize,
    /// Rays per update over all particles and rounds, which limits the beams per particle. Of the default number of
    /// particles, places are found by 100 beams each, and the first round of a start near a known pose, whose power is
    /// small, compares 25.
    #[default(1_000_000)]
    pub ray_budget: usize,
    /// Largest share of beams that end on the road, which looks alike everywhere (unitless).
    #[default(0.2)]
    pub road_share: f64,
}

impl Validate for ObservationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("reference_sigma_m", self.reference_sigma_m)?;
        positive("scale_m", self.scale_m)?;
        positive_or_infinite("short_m", self.short_m)?;
        positive_or_infinite("long_m", self.long_m)?;
        positive_or_infinite("no_surface_m", self.no_surface_m)?;
        in_range("beams", self.beams, 1..=1_000_000)?;
        in_range("min_beams", self.min_beams, 1..=1_000_000)?;
        in_range("ray_budget", self.ray_budget, 1..=1_000_000_000)?;
        fraction("road_share", self.road_share)
    }
}

impl ObservationConfig {
    /// The likelihood of range-mcl: no limits, σ = 2 m.
    pub fn reference() -> Self {
        Self {
            likelihood: Likelihood::Reference,
            road_share: 1.0,
            ..Self::default()
        }
    }

    /// Cost of the difference of a measured and a rendered range [m].
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
    pub(crate) fn floor_log_likelihood(&self) -> f64 {
        let worst_m = f64::from(self.short_m.max(self.long_m).max(self.no_surface_m));
        match self.likelihood {
            Likelihood::Reference => 1e-5_f64.ln(),
            Likelihood::Robust => self.log_likelihood(worst_m) + 1e-5_f64.ln(),
        }
    }

    /// Number of beams per pose for `poses` poses.
    pub(crate) fn beams_for(&self, poses: usize) -> usize {
        (self.ray_budget / poses.max(1))
            .max(self.min_beams)
            .min(self.beams)
    }
}

/// Samples about `count` beams evenly over an image, at most `road_share` of them on the road, see [`ClassifiedReturns::choose`].
pub fn choose_beams(
    image: &RangeImage,
    count: usize,
    road_share: f64,
    attitude: &SensorAttitude,
    rng: &mut impl Rng,
) -> Vec<Beam> {
    ClassifiedReturns::new(image, attitude).choose(count, road_share, rng)
}

/// The returns of a range image, on the road and above it.
pub struct ClassifiedReturns<'a> {
    image: &'a RangeImage,
    /// Of each pixel; `None` without a return.
    surfaces: Vec<Option<Surface>>,
}

/// What a beam ends on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Surface {
    Road,
    Rest,
}

impl<'a> ClassifiedReturns<'a> {
    /// Classifies the returns.
    pub fn new(image: &'a RangeImage, attitude: &SensorAttitude) -> Self {
        /// Points below this height above the plane of the road are on the road [m].
        const ROAD_TOP_M: f32 = 0.3;
        let road_from_lidar = Rigid3f::from(&attitude.road_from_lidar());
        let surface = |index: usize| {
            let is_road = || road_from_lidar.apply(image.points[index]).z < ROAD_TOP_M;
            image.has_return(index).then(|| {
                if is_road() {
                    Surface::Road
                } else {
                    Surface::Rest
                }
            })
        };
        let surfaces = (0..image.ranges.len()).into_par_iter().map(surface);
        Self {
            image,
            surfaces: surfaces.collect(),
        }
    }

    /// Samples about `count` beams evenly, at most `road_share` of them on the road; neighbours in the list are neighbours in space.
    ///
    /// The pixel of a column c is chosen if frac(c φ + u) is less than the requested share of the returns on its kind of surface,
    /// with the golden ratio φ, whose multiples are spread most evenly, and a random u for each row. Whether a pixel is chosen
    /// hardly depends on the others, so that almost equal scans give almost equal samples.
    pub fn choose(&self, count: usize, road_share: f64, rng: &mut impl Rng) -> Vec<Beam> {
        const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;
        let number_of = |kind| self.surfaces.iter().filter(|it| **it == Some(kind)).count();
        let (road, rest) = (number_of(Surface::Road), number_of(Surface::Rest));
        let largest = (road_share * count as f64).round() as usize;
        let of_road = (count * road / (road + rest).max(1)).min(largest);
        let share = |count: usize, all: usize| count as f64 / all.max(1) as f64;
        let (road_share, rest_share) = (share(of_road, road), share(count - of_road, rest));

        let LidarModel { width, height, .. } = self.image.model;
        // Of all rows, so that the numbers that are drawn afterwards do not depend on the scan.
        let mut offsets = || (0..height).map(|_| rng.random()).collect::<Vec<f64>>();
        let (road_offsets, rest_offsets) = (offsets(), offsets());
        let turns: Vec<f64> = (0..width)
            .map(|column| (column as f64 * GOLDEN_RATIO).fract())
            .collect();
        let mut chosen = Vec::new();
        for row in 0..height {
            let pixels = row * width..(row + 1) * width;
            let of_row = self.surfaces[pixels.clone()].iter().zip(&turns);
            for (pixel, (surface, turn)) in pixels.zip(of_row) {
                let (offset, share) = match surface {
                    None => continue,
                    Some(Surface::Road) => (road_offsets[row], road_share),
                    Some(Surface::Rest) => (rest_offsets[row], rest_share),
                };
                let sum = turn + offset;
                let fraction = if sum < 1.0 { sum } else { sum - 1.0 };
                if fraction < share {
                    chosen.extend(self.image.beam(pixel));
                }
            }
        }
        let directions: Vec<Vec3> = chosen.iter().map(|beam| beam.direction).collect();
        let order = coherent_order(&directions).into_iter();
        order.map(|beam| chosen[beam as usize]).collect()
    }
}

/// Returns a few thousand points near the car, most of them on the road, for
/// [`GroundMap::attitude_at`](crate::map::GroundMap::attitude_at).
pub fn near_points(image: &RangeImage) -> Vec<Vec3> {
    /// Range up to which the rings on the road are dense [m].
    const NEAR_M: f32 = 20.0;
    /// Step, coprime to common image widths, so that every column is used.
    const EVERY: usize = 7;
    (0..image.ranges.len())
        .step_by(EVERY)
        .filter(|&index| image.ranges[index] < NEAR_M)
        .map(|index| image.points[index])
        .collect()
}

/// Returns the mean cost of beams at each pose [m]; `None` for poses off the map.
pub fn costs(
    renderer: &dyn RangeRenderer,
    map_from_lidar: &[Option<Pose3>],
    beams: &[Beam],
    difference: &RangeDifference,
) -> Result<Vec<Option<f64>>, RenderError> {
    costs_by(map_from_lidar, |on_map| {
        renderer.compare(on_map, beams, difference)
    })
}

/// Returns the mean cost of a scan at each pose [m], of the beams or, for the reference likelihood, of the whole image;
/// `None` for poses off the map.
pub fn costs_of_scan(
    renderer: &dyn RangeRenderer,
    map_from_lidar: &[Option<Pose3>],
    (scan, beams): (&RangeImage, &[Beam]),
    config: &ObservationConfig,
) -> Result<Vec<Option<f64>>, RenderError> {
    let difference = config.difference();
    match config.likelihood {
        Likelihood::Robust => costs(renderer, map_from_lidar, beams, &difference),
        Likelihood::Reference => costs_by(map_from_lidar, |on_map| {
            renderer.compare_images(on_map, scan, &difference)
        }),
    }
}

fn costs_by(
    map_from_lidar: &[Option<Pose3>],
    compare: impl FnOnce(&[Pose3]) -> Result<Vec<f32>, RenderError>,
) -> Result<Vec<Option<f64>>, RenderError> {
    let on_map: Vec<Pose3> = map_from_lidar.iter().flatten().copied().collect();
    let mut compared = compare(&on_map)?.into_iter().map(f64::from);
    Ok(map_from_lidar
        .iter()
        .map(|pose| pose.as_ref().and_then(|_| compared.next()))
        .collect())
}

/// Returns the ground patch under a particle; `None` outside the mapped tiles and where there is no
/// ground. `remembered` replaces it in gaps of the map.
pub fn ground_patch_of(
    particle: &Particle,
    map: &Map,
    remembered: Option<&GroundPatch>,
) -> Result<Option<GroundPatch>, RenderError> {
    let pose = &particle.map_from_lidar;
    if map.tiles.valid_tile_of(pose).is_none() {
        return Ok(None);
    }
    let patch = map.ground.patch_under(pose, particle.level_m)?;
    Ok(patch.or(remembered.copied()))
}

/// [Signed](RangeRenderer::cast_signed) ranges of the map along beams from a pose, as far as their [`agreement`] depends on them
/// [m].
pub fn ranges_along(
    renderer: &dyn RangeRenderer,
    map_from_lidar: &Pose3,
    beams: &[Beam],
    tolerance_m: f32,
) -> Result<Vec<f32>, RenderError> {
    let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
    let farthest_m = beams.iter().map(|beam| beam.range_m).fold(0.0, f32::max);
    let until_m = farthest_m + 2.0 * tolerance_m;
    renderer.cast_signed(map_from_lidar, &directions, until_m)
}

/// Whether a beam agrees with the map: its measured and its rendered range differ by the tolerance at most. `None` if it does not
/// count: beams along which the map has no surface, those that end far in front of it, on traffic, and those that end at the back of
/// a surface or in front of it. Those that end within a quarter of the range in front of a surface that is seen from its front
/// disagree: they show a wrong pose, or ranges that are too short.
fn agrees(beam: &Beam, signed_m: f32, tolerance_m: f32) -> Option<bool> {
    /// Largest distance of a return to the surface behind it that counts, as a share of the range of the surface.
    const NEAR: f32 = 0.25;
    let rendered_m = signed_m.abs();
    let excess_m = beam.range_m - rendered_m;
    let is_traffic = excess_m < -tolerance_m && -excess_m > NEAR * rendered_m;
    // The mapping drive did not see what is there: a wall has another side.
    let is_unseen = signed_m < 0.0 && excess_m <= tolerance_m;
    let counts = rendered_m != f32::INFINITY && !is_traffic && !is_unseen;
    counts.then(|| excess_m.abs() <= tolerance_m)
}

/// Returns the share of agreeing beams among those that count; `None` if fewer than 30 count.
pub fn agreement(beams: &[Beam], rendered_m: &[f32], tolerance_m: f32) -> Option<f64> {
    /// Smallest number of beams.
    const MIN_BEAMS: usize = 30;
    let (mut on, mut counted) = (0_usize, 0_usize);
    for (beam, &rendered_m) in beams.iter().zip(rendered_m) {
        let agrees = agrees(beam, rendered_m, tolerance_m);
        counted += usize::from(agrees.is_some());
        on += usize::from(agrees == Some(true));
    }
    (counted >= MIN_BEAMS).then(|| on as f64 / counted as f64)
}

/// Whether beams agree with the map much better at one pose than at another, by its signed ranges along them there and here [m]. Of the
/// beams that count at both poses, those gained less those lost are at least half of those that disagree here, and exceed chance by
/// six standard deviations (McNemar, *Note on the sampling error of the difference between correlated proportions or percentages*,
/// 1947).
pub fn agrees_better(beams: &[Beam], [there_m, here_m]: [&[f32]; 2], tolerance_m: f32) -> bool {
    const SIGMAS: f64 = 6.0;
    let (mut gained, mut lost, mut neither) = (0.0, 0.0, 0.0);
    for (beam, (&there_m, &here_m)) in beams.iter().zip(there_m.iter().zip(here_m)) {
        let at = |rendered_m: f32| agrees(beam, rendered_m, tolerance_m);
        match (at(there_m), at(here_m)) {
            (Some(true), Some(false)) => gained += 1.0,
            (Some(false), Some(true)) => lost += 1.0,
            (Some(false), Some(false)) => neither += 1.0,
            _ => {}
        }
    }
    let gain: f64 = gained - lost;
    gain >= 0.5 * (gained + neither) && gain > SIGMAS * f64::sqrt(gained + lost)
}

/// Returns the beams that end above the road, which distinguish one place from another.
pub fn above_road(beams: &[Beam], attitude: &SensorAttitude, clearance_m: f32) -> Vec<Beam> {
    let road_from_lidar = Rigid3f::from(&attitude.road_from_lidar());
    let height_of = |point: Vec3| road_from_lidar.apply(point).z;
    beams
        .iter()
        .filter(|beam| height_of(beam.point()) > clearance_m)
        .copied()
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::geometry::{Pose2, TriangleMesh};
    use crate::map::world_for_tests::TestWorld;
    use crate::raycasting::Scene;
    use crate::rendering::CpuRenderer;

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
    fn every_pose_on_the_map_is_more_likely_than_one_off_the_map() {
        let config = ObservationConfig::default();
        assert!(config.log_likelihood(0.5) > config.floor_log_likelihood());
        assert!(config.log_likelihood(0.1) > config.log_likelihood(0.11));
    }

    #[test]
    fn beams_cover_the_image_and_few_of_them_end_on_the_road() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let mut rng = StdRng::seed_from_u64(1);
        let beams = choose_beams(&image, 1000, 0.2, &SensorAttitude::default(), &mut rng);
        assert!((950..1050).contains(&beams.len()), "{}", beams.len());
        let high = above_road(&beams, &SensorAttitude::default(), 0.3);
        assert!((795..=805).contains(&high.len()), "{}", high.len());
        // Every quarter of the circle has beams.
        for quarter in 0..4 {
            let in_quarter = |b: &&Beam| {
                let turn = f64::from(b.direction.y.atan2(b.direction.x)) / std::f64::consts::TAU;
                ((turn + 0.5) * 4.0) as usize == quarter
            };
            assert!(beams.iter().filter(in_quarter).count() > 100);
        }
    }

    #[test]
    fn a_beam_is_chosen_by_its_column_and_the_number_of_its_row() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let returns = ClassifiedReturns::new(&image, &SensorAttitude::default());
        let [mut rng, mut same] = [3; 2].map(StdRng::seed_from_u64);
        let chosen = returns.choose(1000, 0.2, &mut rng);
        let LidarModel { width, height, .. } = image.model;
        let offsets: Vec<f64> = (0..2 * height).map(|_| same.random()).collect();
        let mut expected_count = 0;
        for (kind, count, offsets) in [
            (Surface::Road, 200.0, &offsets[..height]),
            (Surface::Rest, 800.0, &offsets[height..]),
        ] {
            let of_kind = |pixel: &usize| returns.surfaces[*pixel] == Some(kind);
            let all = (0..width * height).filter(of_kind);
            let share = count / all.clone().count() as f64;
            let golden = 0.5 * (1.0 + 5.0_f64.sqrt());
            let expected = all.filter(|pixel| {
                let column = (pixel % width) as f64;
                (column * golden + offsets[pixel / width]).fract() < share
            });
            for pixel in expected {
                assert!(chosen.contains(&image.beam(pixel).unwrap()), "{pixel}");
                expected_count += 1;
            }
        }
        assert_eq!(chosen.len(), expected_count);
        let directions: Vec<Vec3> = chosen.iter().map(|beam| beam.direction).collect();
        let order = coherent_order(&directions);
        assert!(order.is_sorted());
    }

    #[test]
    fn beams_that_may_all_end_on_the_road_do_so_as_often_as_those_of_the_scan() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let attitude = SensorAttitude::default();
        let high_share =
            |beams: &[Beam]| above_road(beams, &attitude, 0.3).len() as f64 / beams.len() as f64;
        let all: Vec<Beam> = image.beams().collect();
        let mut rng = StdRng::seed_from_u64(1);
        let chosen = choose_beams(&image, 1000, 1.0, &attitude, &mut rng);
        assert_relative_eq!(high_share(&chosen), high_share(&all), epsilon = 0.02);
    }

    #[test]
    fn a_cost_that_is_larger_by_the_scale_is_e_times_less_likely() {
        let robust = ObservationConfig {
            scale_m: 0.003,
            ..ObservationConfig::default()
        };
        let ratio = robust.log_likelihood(0.05) - robust.log_likelihood(0.053);
        assert_relative_eq!(ratio, 1.0, epsilon = 1e-9);
        // A Gaussian: one standard deviation is less likely than none by the factor exp(1/2), two by exp(2).
        let reference = ObservationConfig {
            reference_sigma_m: 1.5,
            ..ObservationConfig::reference()
        };
        for (cost_m, expected) in [(0.0, 0.0), (1.5, -0.5), (3.0, -2.0)] {
            assert_relative_eq!(reference.log_likelihood(cost_m), expected);
        }
    }

    #[test]
    fn the_beams_of_all_poses_are_those_of_the_ray_budget_within_the_limits_of_a_pose() {
        let config = ObservationConfig {
            ray_budget: 1000,
            min_beams: 10,
            beams: 200,
            ..ObservationConfig::default()
        };
        let beams = [0, 1, 5, 20, 50, 100, 300].map(|poses| config.beams_for(poses));
        assert_eq!(beams, [200, 200, 200, 50, 20, 10, 10]);
    }

    #[test]
    fn near_points_are_a_seventh_of_the_returns_within_twenty_metres() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let near = near_points(&image);
        let is_near = |pixel: &usize| image.has_return(*pixel) && image.ranges[*pixel] < 20.0;
        let all = (0..image.ranges.len()).filter(is_near).count();
        assert!(near.iter().all(|point| point.length() < 20.0));
        assert!((near.len() as f64 / all as f64 - 1.0 / 7.0).abs() < 0.01);
    }

    #[test]
    fn ranges_along_beams_reach_behind_the_farthest_of_them() {
        let world = TestWorld::street();
        let truth = world.pose_at(0.0, 0.0, 0.0);
        let lifted = world.ground.lift(&truth, &SensorAttitude::default());
        let lifted = lifted.unwrap().unwrap();
        // Beams that end 0.25 m in front of the surfaces agree with them.
        let measured: Vec<Beam> = world.scan(&truth).beams().collect();
        let short = |beam: &Beam| Beam {
            range_m: beam.range_m - 0.25,
            ..*beam
        };
        let beams: Vec<Beam> = measured.iter().map(short).collect();
        let found = ranges_along(&world, &lifted, &beams, 0.3).unwrap();
        assert_eq!(found.len(), beams.len());
        for (beam, range_m) in measured.iter().zip(&found) {
            assert_relative_eq!(beam.range_m, *range_m, epsilon = 1e-3);
        }
        assert_eq!(agreement(&beams, &found, 0.3), Some(1.0));
    }

    #[test]
    fn beams_up_to_the_back_of_a_wall_do_not_count_and_those_through_it_disagree() {
        // Two walls across the x axis that face ahead: the one behind the sensor shows its front. The other was mapped from its
        // other side, and is 0.4 m thick.
        let walls = [5.0, -6.0].map(TriangleMesh::wall);
        let beams: Vec<Beam> = (0..80_u8)
            .map(|i| {
                let ahead = if i % 2 == 0 { 1.0 } else { -1.0 };
                let direction = Vec3::new(ahead, 0.005 * f32::from(i), 0.0).normalize();
                let range_m = if ahead > 0.0 { 4.6 } else { 6.0 } / direction.x.abs();
                Beam { direction, range_m }
            })
            .collect();
        let through = |beam: &Beam| Beam {
            range_m: beam.range_m + if beam.direction.x > 0.0 { 1.0 } else { 0.0 },
            ..*beam
        };
        let through: Vec<Beam> = beams.iter().map(through).collect();
        for (beams, has_fronts, expected) in [
            (&beams, true, 1.0),
            (&beams, false, 0.5),
            (&through, true, 0.5),
        ] {
            let mut scene = Scene::of_tiles(&walls);
            scene.has_fronts = has_fronts;
            let renderer = CpuRenderer::over(Arc::new(scene));
            let ranges = ranges_along(&renderer, &Pose3::identity(), beams, 0.3).unwrap();
            assert_eq!(agreement(beams, &ranges, 0.3), Some(expected));
        }
    }

    #[test]
    fn a_scan_with_few_returns_yields_all_of_them() {
        let model = LidarModel::default();
        let image = RangeImage::project(&[Vec3::new(8.0, 1.0, 0.0)], &model);
        let mut rng = StdRng::seed_from_u64(1);
        let beams = choose_beams(&image, 100, 0.2, &SensorAttitude::default(), &mut rng);
        assert_eq!(beams.len(), 1);
        let empty = RangeImage::project(&[], &model);
        assert!(choose_beams(&empty, 100, 0.2, &SensorAttitude::default(), &mut rng).is_empty());
    }

    #[test]
    fn the_cost_is_least_at_the_truth_and_poses_off_the_map_have_none() {
        let world = TestWorld::street();
        let truth = world.pose_at(3.0, 0.2, 0.1);
        let mut rng = StdRng::seed_from_u64(1);
        let image = world.scan(&truth);
        let beams = choose_beams(&image, 2000, 0.2, &SensorAttitude::default(), &mut rng);
        let lifted = |x: f64, y: f64, heading: f64| {
            let pose = Pose2::new(nalgebra::Vector2::new(x, y), heading);
            let patch = ground_patch_of(&pose.into(), &world.map(), None).unwrap();
            patch.map(|patch| patch.lift(&pose, &SensorAttitude::default()))
        };
        let poses = [
            lifted(3.0, 0.2, 0.1),
            lifted(3.1, 0.2, 0.1),
            lifted(3.0, 0.3, 0.1),
            lifted(3.0, 0.2, 0.11),
            lifted(900.0, 0.0, 0.0),
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
    fn traffic_in_front_of_the_map_does_not_count_against_a_pose() {
        let beam = |range_m| Beam {
            direction: Vec3::X,
            range_m,
        };
        let beams: Vec<Beam> = (0..90)
            .map(|i| beam(if i < 40 { 5.0 } else { 10.0 }))
            .collect();
        assert_eq!(agreement(&beams, &[10.0; 90], 0.3), Some(1.0));
        assert_eq!(agreement(&beams, &[7.0; 90], 0.3), Some(0.0));
        assert_eq!(agreement(&beams, &[f32::INFINITY; 90], 0.3), None);
        // A lorry hides surfaces that are far behind it.
        let mut rendered_m = [40.0; 90];
        rendered_m[60..].fill(10.0);
        assert_eq!(agreement(&beams, &rendered_m, 0.3), Some(1.0));
        // 40 beams end behind the surface, 50 on it.
        let mut rendered_m = [4.0; 90];
        rendered_m[40..].fill(10.2);
        assert_eq!(agreement(&beams, &rendered_m, 0.3), Some(50.0 / 90.0));
    }

    #[test]
    fn a_pose_is_much_better_by_the_beams_that_count_at_both() {
        let beams = [Beam {
            direction: Vec3::X,
            range_m: 10.0,
        }; 1000];
        // Numbers of beams in turn, with the ranges of the map there and here.
        let is_better = |parts: &[(usize, [f32; 2])]| {
            let along = |pose: usize| {
                let of_part = |&(count, ranges_m): &(usize, [f32; 2])| vec![ranges_m[pose]; count];
                parts.iter().flat_map(of_part).collect::<Vec<f32>>()
            };
            let [there, here] = [0, 1].map(along);
            assert!(there.len() <= beams.len());
            agrees_better(&beams, [&there, &here], 0.3)
        };
        let (on, off, nothing) = (10.0, 9.0, f32::INFINITY);
        let (gained, lost) = ([on, off], [off, on]);
        let (both, neither) = ([on, on], [off, off]);
        // Six standard deviations of chance: 36 beams are not enough.
        assert!(!is_better(&[(900, both), (36, gained)]));
        assert!(is_better(&[(900, both), (37, gained)]));
        assert!(!is_better(&[(800, both), (100, gained), (33, lost)]));
        assert!(is_better(&[(800, both), (100, gained), (22, lost)]));
        // Half of those that disagree here.
        assert!(is_better(&[(700, both), (100, gained), (100, neither)]));
        assert!(!is_better(&[(700, both), (100, gained), (101, neither)]));
        assert!(!is_better(&[(1000, both)]) && !is_better(&[(900, lost)]));
        // Beams that hit nothing there are no gain.
        assert!(!is_better(&[(500, both), (500, [nothing, off])]));
        assert!(!is_better(&[(500, both), (500, [on, nothing])]));
    }

    #[test]
    fn beams_that_end_just_in_front_of_the_map_count_against_a_pose() {
        let beams = [Beam {
            direction: Vec3::X,
            range_m: 9.0,
        }; 90];
        let share = |in_front: usize| {
            let mut rendered_m = [9.0; 90];
            rendered_m[..in_front].fill(10.0);
            agreement(&beams, &rendered_m, 0.3)
        };
        assert_eq!(share(0), Some(1.0));
        assert_eq!(share(45), Some(0.5));
        assert_eq!(share(90), Some(0.0));
    }
}
