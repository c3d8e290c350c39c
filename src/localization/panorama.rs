//! Where in the map the car may be, without a guess: one panorama per place scores all headings.
//!
//! A panorama is rendered once per cell of the road, level over the ground, heading along x. A car
//! there with heading θ sees the same panorama shifted,
//!
//! ```text
//! cost(cell, s) = mean over the pixels of min(|panorama(row, c) − scan(row, c + s)|, limit)
//! θ = 2π s / width
//! ```
//!
//! so that every heading costs one comparison and no rendering. First all cells at a part of the
//! columns and headings, then the best of them at all. The memory is 4 · rows · columns bytes per
//! cell: with the defaults 4.3 kB, 12 MB for 700 m of road in cells of one metre. Where roads cross
//! above one another, a cell has a panorama on each level.

use std::cell::OnceCell;
use std::f32::consts::{PI, TAU};

use glam::Vec3;
use nalgebra::Point2;
use rand::{Rng, RngExt as _};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::initialization::{Cells, uniform_in_cell};
use super::localizer::Surroundings;
use super::particles::Hypothesis;
use super::resampling::systematic;
use crate::geometry::{Pose2, Pose3, Rigid3f, wrap_angle};
use crate::lidar::{LidarModel, RangeImage};
use crate::map::Stance;
use crate::rendering::RenderError;
use crate::validation::{InvalidValue, Validate, fraction, in_range, positive, require};

/// Size of the panoramas and of the search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PanoramaConfig {
    /// Side of a cell: one panorama each [m]; `grid_res` of `localization.yml`.
    #[serde(skip)]
    pub cell_m: f64,
    /// Rows of a panorama.
    pub rows: usize,
    /// Columns of a panorama over 360 degrees.
    pub columns: usize,
    /// Lower edge of the panorama below the horizon: lower beams see the road alone [rad].
    pub lowest_rad: f32,
    /// Limit of the difference of a pixel [m].
    pub limit_m: f32,
    /// The first pass takes every n-th column and heading.
    pub coarse_step: usize,
    /// Share of the cells that the second pass takes.
    pub refined_share: f64,
    /// A cell whose mean cost is larger by this gets e times fewer particles [m].
    pub scale_m: f64,
    /// Standard deviation of the headings around the best heading of a cell [rad]; `yaw_sigma` of
    /// `localization.yml`.
    #[serde(skip)]
    pub yaw_sigma_rad: f64,
}

impl Default for PanoramaConfig {
    /// `yaw_sigma` of range-mcl, 2 degrees; the rest is ours.
    fn default() -> Self {
        Self {
            cell_m: 1.0,
            rows: 6,
            columns: 180,
            lowest_rad: 0.12,
            limit_m: 2.0,
            coarse_step: 2,
            refined_share: 0.1,
            scale_m: 0.03,
            yaw_sigma_rad: 2.0_f64.to_radians(),
        }
    }
}

impl Validate for PanoramaConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("rows", self.rows, 1..=4096)?;
        in_range("columns", self.columns, 1..=65_536)?;
        require(
            self.lowest_rad.is_finite(),
            "lowest_rad",
            self.lowest_rad,
            "it must be an angle below the horizon, such as 0.12",
        )?;
        positive("limit_m", self.limit_m)?;
        in_range("coarse_step", self.coarse_step, 1..=self.columns)?;
        fraction("refined_share", self.refined_share)?;
        positive("scale_m", self.scale_m)
    }
}

/// What the map looks like from every cell.
#[derive(Clone, Debug)]
pub struct PanoramaIndex {
    config: PanoramaConfig,
    model: LidarModel,
    /// Cells that are on the map: middle and height of the ground [m].
    places: Vec<(Point2<f64>, f64)>,
    cell_m: f64,
    /// One panorama per cell, row-major; [`FAR_M`] where there is no surface.
    images: Vec<Vec<f32>>,
}

/// Panoramas that are rendered when they are first asked for: a filter that knows where it begins
/// and is never lost needs none.
pub struct Panoramas<'a> {
    /// The places, and what is rendered there.
    pub cells: Cells,
    /// The map; its own panoramas are not asked for.
    pub surroundings: Surroundings<'a>,
    /// The sensor whose scans will be looked up.
    pub lidar: LidarModel,
    /// Its height over the road [m].
    pub height_m: f64,
    /// Size of the panoramas and of the search.
    pub config: PanoramaConfig,
    /// Empty until asked for.
    pub index: OnceCell<PanoramaIndex>,
}

impl Panoramas<'_> {
    /// The panoramas, rendered now if they were not yet.
    pub fn index(&self) -> Result<&PanoramaIndex, RenderError> {
        if let Some(index) = self.index.get() {
            return Ok(index);
        }
        let index = PanoramaIndex::build(
            &self.cells,
            &self.surroundings,
            &self.lidar,
            self.height_m,
            &self.config,
        )?;
        Ok(self.index.get_or_init(|| index))
    }
}

/// A place where the car may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seed {
    /// Middle of the cell [m].
    pub center: Point2<f64>,
    /// Height of the ground there [m].
    pub level_m: f64,
    /// The heading that fits best there [rad].
    pub heading_rad: f64,
    /// Mean truncated difference [m].
    pub cost_m: f64,
}

/// Farther than everything, and finite: differences of it are beyond every limit.
const FAR_M: f32 = 1e9;

impl PanoramaIndex {
    /// Renders the panoramas of all cells that are on the map. `lidar` is the sensor whose scans
    /// will be looked up, `height_m` its height over the road.
    pub fn build(
        cells: &Cells,
        surroundings: &Surroundings<'_>,
        lidar: &LidarModel,
        height_m: f64,
        config: &PanoramaConfig,
    ) -> Result<Self, RenderError> {
        /// Panoramas per call: what a renderer makes at once is kept only as thumbnails.
        const BATCH: usize = 512;
        let upright = Stance {
            height_m,
            roll_rad: 0.0,
            pitch_rad: 0.0,
        };
        let Surroundings { ground, tiles, .. } = surroundings;
        let on_map = |center: &&Point2<f64>| {
            let pose = Pose2::from(center.coords);
            tiles.valid_tile_of(&pose).is_some()
        };
        let levels = |center: &Point2<f64>| {
            let (center, pose) = (*center, Pose2::from(center.coords));
            let patches = ground.levels_at(center.x, center.y);
            patches
                .into_iter()
                .map(move |patch| ((center, patch.height_m), patch.lift(&pose, &upright)))
        };
        let (places, poses): (Vec<(Point2<f64>, f64)>, Vec<Pose3>) =
            cells.centers.iter().filter(on_map).flat_map(levels).unzip();
        let model = panorama_model(lidar, config);
        let mut images = Vec::with_capacity(poses.len());
        for batch in poses.chunks(BATCH) {
            for mut image in surroundings.renderer.render(batch, &model)? {
                image.iter_mut().for_each(|range| *range = range.min(FAR_M));
                images.push(image);
            }
        }
        Ok(Self {
            config: config.clone(),
            model,
            places,
            cell_m: cells.cell_m,
            images,
        })
    }

    /// Number of panoramas.
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Whether no cell was on the map.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// Memory that the panoramas take [bytes].
    pub fn size_bytes(&self) -> usize {
        self.len() * self.model.len() * size_of::<f32>()
    }

    /// The best heading of the cells that may be where the scan was taken, best cell first.
    pub fn search(&self, scan: &RangeImage, stance: &Stance) -> Vec<Seed> {
        let scan = DoubledScan::new(scan, stance, &self.model);
        let step = self.config.coarse_step.max(1);
        let coarse_scan = scan.thinned(step);
        let limit_m = self.config.limit_m;
        let mut coarse: Vec<(f32, usize)> = self
            .images
            .par_iter()
            .enumerate()
            .map(|(cell, image)| {
                let coarse_image = thinned(image, self.model.width, step);
                (best_shift(&coarse_image, &coarse_scan, limit_m).0, cell)
            })
            .collect();
        coarse.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let kept = (self.config.refined_share * coarse.len() as f64).ceil() as usize;
        coarse.truncate(kept.max(1));
        let mut seeds: Vec<Seed> = coarse
            .par_iter()
            .map(|&(_, cell)| {
                let (cost_m, shift) = best_shift(&self.images[cell], &scan, limit_m);
                Seed {
                    center: self.places[cell].0,
                    level_m: self.places[cell].1,
                    heading_rad: wrap_angle(
                        f64::from(TAU) * shift as f64 / self.model.width as f64,
                    ),
                    cost_m: f64::from(cost_m),
                }
            })
            .collect();
        // Stable: cells that cost the same stay in their order.
        seeds.sort_by(|a, b| a.cost_m.total_cmp(&b.cost_m));
        seeds
    }

    /// Hypotheses in the cells of the search, the more the better a cell fits. None without cells.
    pub fn sample(
        &self,
        scan: &RangeImage,
        stance: &Stance,
        count: usize,
        rng: &mut impl Rng,
    ) -> Vec<Hypothesis> {
        let seeds = self.search(scan, stance);
        let Some(best) = seeds.first() else {
            return Vec::new();
        };
        let best_m = best.cost_m;
        let mut weights: Vec<f64> = seeds
            .iter()
            .map(|seed| ((best_m - seed.cost_m) / self.config.scale_m).exp())
            .collect();
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
        let half_column_rad = f64::from(PI) / self.model.width as f64;
        systematic(&weights, count, rng)
            .into_iter()
            .map(|seed| {
                let Seed {
                    center,
                    level_m,
                    heading_rad,
                    ..
                } = seeds[seed];
                let place = uniform_in_cell(center, self.cell_m, rng);
                let deviate: f64 = StandardNormal.sample(rng);
                let turn_rad = self.config.yaw_sigma_rad * deviate
                    + rng.random_range(-half_column_rad..=half_column_rad);
                Hypothesis {
                    map_from_lidar: Pose2::new(place, heading_rad + turn_rad),
                    level_m: Some(level_m),
                }
            })
            .collect()
    }
}

/// Every `step`-th column of rows of a width, from the first.
fn thinned(rows: &[f32], width: usize, step: usize) -> Vec<f32> {
    rows.chunks(width)
        .flat_map(|row| row.iter().copied().step_by(step))
        .collect()
}

/// Least cost [m] and its shift.
fn best_shift(panorama: &[f32], scan: &DoubledScan, limit_m: f32) -> (f32, usize) {
    (0..scan.width)
        .map(|shift| (cost(panorama, scan, shift, limit_m), shift))
        .fold((f32::INFINITY, 0), |best, next| {
            if next.0 < best.0 { next } else { best }
        })
}

/// Mean truncated difference of a panorama and the shifted scan [m].
fn cost(panorama: &[f32], scan: &DoubledScan, shift: usize, limit_m: f32) -> f32 {
    /// Sums that grow beside each other, in one register.
    const LANES: usize = 8;
    let width = scan.width;
    let difference = |rendered: f32, measured: f32| {
        let difference = (rendered - measured).abs();
        if difference < limit_m {
            difference
        } else {
            limit_m
        }
    };
    let mut sums = [0.0; LANES];
    let mut rest = 0.0;
    for (row, rendered) in panorama.chunks(width).enumerate() {
        let measured = &scan.ranges[2 * row * width + shift..][..width];
        let (rendered, last_rendered) = rendered.as_chunks::<LANES>();
        let (measured, last_measured) = measured.as_chunks::<LANES>();
        for (rendered, measured) in rendered.iter().zip(measured) {
            for lane in 0..LANES {
                sums[lane] += difference(rendered[lane], measured[lane]);
            }
        }
        for (&rendered, &measured) in last_rendered.iter().zip(last_measured) {
            rest += difference(rendered, measured);
        }
    }
    (sums.iter().sum::<f32>() + rest) / panorama.len() as f32
}

/// The projection of the panoramas: the upper part of what the sensor sees.
fn panorama_model(lidar: &LidarModel, config: &PanoramaConfig) -> LidarModel {
    LidarModel {
        height: config.rows,
        width: config.columns,
        fov_down: lidar.fov_down.abs().min(config.lowest_rad.to_degrees()),
        ..*lidar
    }
}

/// A scan as a panorama, level, every row twice over, so that a shift is a slice.
struct DoubledScan {
    /// Columns of a row before it was doubled.
    width: usize,
    ranges: Vec<f32>,
}

impl DoubledScan {
    /// Of the returns in a pixel, the one nearest to its centre counts. Pixels without a return
    /// differ from everything by the limit, at every heading alike.
    fn new(scan: &RangeImage, stance: &Stance, model: &LidarModel) -> Self {
        let road_from_lidar = Rigid3f::from(&stance.road_from_lidar());
        let directions = model.directions();
        let mut nearest = vec![(-1.0_f32, -FAR_M); model.len()];
        for beam in scan.beams() {
            let direction: Vec3 = road_from_lidar.rotate(beam.direction);
            let Some(pixel) = model.pixel_of(direction) else {
                continue;
            };
            let index = model.index_of(pixel);
            let closeness = direction.dot(directions[index]);
            if closeness > nearest[index].0 {
                nearest[index] = (closeness, beam.range_m);
            }
        }
        let ranges = nearest
            .chunks(model.width)
            .flat_map(|row| row.iter().chain(row))
            .map(|&(_, range_m)| range_m)
            .collect();
        Self {
            width: model.width,
            ranges,
        }
    }

    /// Every `step`-th column.
    fn thinned(&self, step: usize) -> Self {
        let halves = thinned(&self.ranges, self.width, step);
        Self {
            width: self.width.div_ceil(step),
            ranges: halves,
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{SeedableRng, rngs::StdRng};

    use super::super::initialization::ROAD_HALF_WIDTH_M;
    use super::*;
    use crate::rendering::test_world::TestWorld;

    fn index(world: &TestWorld) -> PanoramaIndex {
        let config = PanoramaConfig::default();
        let cells = Cells::along_road(&world.road(), ROAD_HALF_WIDTH_M, config.cell_m);
        let lidar = LidarModel::default();
        PanoramaIndex::build(&cells, &world.surroundings(), &lidar, 1.73, &config).unwrap()
    }

    #[test]
    fn the_best_cell_is_where_the_scan_was_taken_at_any_heading() {
        let world = TestWorld::street();
        let index = index(&world);
        for (x, y, heading) in [
            (10.0, 0.3, 0.0),
            (-20.3, -0.8, 2.0),
            (61.6, 1.1, -1.3),
            (90.0, 0.0, 3.1),
        ] {
            let truth = world.pose_at(x, y, heading);
            let best = index.search(&world.scan(&truth), &Stance::default())[0];
            let distance = (best.center.coords - truth.translation.vector).norm();
            let turn = wrap_angle(best.heading_rad - heading).abs();
            assert!(distance < 1.5, "{distance} m from {x} {y}");
            assert!(turn < 0.06, "{turn} rad from {heading}");
        }
    }

    #[test]
    fn turning_the_car_by_whole_columns_shifts_the_best_heading_and_nothing_else() {
        let world = TestWorld::street();
        let index = index(&world);
        let turn = 10.0 * std::f64::consts::TAU / index.model.width as f64;
        let search = |heading: f64| {
            index.search(
                &world.scan(&world.pose_at(25.2, 0.1, heading)),
                &Stance::default(),
            )[0]
        };
        let (straight, turned) = (search(0.0), search(turn));
        assert_eq!(straight.center, turned.center);
        assert!(wrap_angle(turned.heading_rad - straight.heading_rad - turn).abs() < 0.04);
    }

    #[test]
    fn samples_lie_around_the_truth() {
        let world = TestWorld::street();
        let truth = world.pose_at(33.0, 0.4, 0.2);
        let mut rng = StdRng::seed_from_u64(1);
        let poses = index(&world).sample(&world.scan(&truth), &Stance::default(), 1000, &mut rng);
        let near = poses
            .iter()
            .map(|hypothesis| hypothesis.map_from_lidar.translation.vector)
            .filter(|place| (place - truth.translation.vector).norm() < 1.5)
            .count();
        assert!(near > 300, "{near} of {}", poses.len());
    }

    #[test]
    fn without_cells_there_is_nothing_to_find() {
        let world = TestWorld::street();
        let cells = Cells {
            centers: vec![Point2::new(9e3, 0.0)],
            cell_m: 1.0,
        };
        let config = PanoramaConfig::default();
        let index = PanoramaIndex::build(
            &cells,
            &world.surroundings(),
            &LidarModel::default(),
            1.73,
            &config,
        )
        .unwrap();
        let scan = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        assert!(index.is_empty());
        assert!(
            index
                .sample(&scan, &Stance::default(), 10, &mut StdRng::seed_from_u64(1))
                .is_empty()
        );
    }
}
