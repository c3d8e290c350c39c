//! Place recognition without an initial pose: one panorama per cell gives the costs of all headings.
//!
//! A panorama is rendered once per cell of the road, level above the ground, heading along x. At
//! heading θ a sensor there sees the same panorama shifted,
//!
//! ```text
//! cost(cell, s) = mean over the pixels of min(|panorama(row, c) − scan(row, c + s)|, limit)
//! θ = 2π s / width
//! ```
//!
//! so a heading costs one comparison and no rendering. The first pass compares all cells with a subset
//! of columns and headings, the second the best cells with all of them. The memory is
//! 4 · rows · columns bytes per cell: with the defaults 4.3 kB, 12 MB for 700 m of road in cells of one
//! metre. Where roads cross above one another, a cell has one panorama per level.

use std::collections::BTreeSet;
use std::f32::consts::TAU;
use std::ops::RangeInclusive;

use glam::Vec3;
use nalgebra::Point2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::cells::{self, ROAD_HALF_WIDTH_M};
use super::elevation::{GroundMap, SensorAttitude};
use super::tiles::TileGrid;
use crate::geometry::{Pose2, Pose3, Rigid3f, pose2_from_pose3, wrap_angle};
use crate::lidar::{LidarModel, Projection, RangeImage};
use crate::memory::{self, MemoryError};
use crate::rendering::{RangeRenderer, RenderError};
use crate::validation::{InvalidValue, Validate, fraction, in_range, not_negative, positive};

/// Size of the panoramas and of the search.
///
/// Defaults: `yaw_sigma` of range-mcl, 2 degrees; the rest is ours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct PanoramaConfig {
    /// Side of a cell, which has one panorama per level [m]; `grid_res` of `localization.yml`.
    #[serde(skip)]
    #[default(1.0)]
    pub cell_m: f64,
    /// Rows of a panorama.
    #[default(6)]
    pub rows: usize,
    /// Columns of a panorama over 360 degrees.
    #[default(180)]
    pub columns: usize,
    /// Lower edge of the panorama below the horizon: lower beams see only the road [rad].
    #[default(0.12)]
    pub lowest_rad: f32,
    /// Limit of the range difference of a pixel [m].
    #[default(2.0)]
    pub limit_m: f32,
    /// The first pass takes every n-th column and heading.
    #[default(2)]
    pub coarse_step: usize,
    /// Share of the cells in the second pass (unitless).
    #[default(0.1)]
    pub refined_share: f64,
    /// Increase of the mean cost for which a cell gets e times fewer particles [m].
    #[default(0.03)]
    pub scale_m: f64,
    /// Standard deviation of the headings around the best heading of a cell [rad]; `yaw_sigma` of
    /// `localization.yml`.
    #[serde(skip)]
    #[default(2.0_f64.to_radians())]
    pub yaw_sigma_rad: f64,
}

impl PanoramaConfig {
    /// Allowed sides of a cell [m].
    pub const CELLS_M: RangeInclusive<f64> = 0.05..=1000.0;
}

impl Validate for PanoramaConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("cell_m", self.cell_m, Self::CELLS_M)?;
        in_range("rows", self.rows, 1..=256)?;
        in_range("columns", self.columns, 1..=3600)?;
        in_range("lowest_rad", self.lowest_rad, -1.5..=1.5)?;
        positive("limit_m", self.limit_m)?;
        in_range("coarse_step", self.coarse_step, 1..=self.columns)?;
        fraction("refined_share", self.refined_share)?;
        positive("scale_m", self.scale_m)?;
        not_negative("yaw_sigma_rad", self.yaw_sigma_rad)
    }
}

/// Part of the map in which place recognition searches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SearchRegion {
    /// The mapped road: within 2 m of the mapping poses; in a map without them, anywhere.
    Road,
    /// All ground of the map.
    Anywhere,
}

/// Panoramas for a search.
#[derive(Clone, Debug, PartialEq)]
pub struct PanoramaRequest {
    /// Cells that have panoramas.
    pub region: SearchRegion,
    /// Sensor of the scans.
    pub lidar: LidarModel,
    /// Height of that sensor above the ground [m].
    pub sensor_height_m: f64,
    /// Size of the panoramas and of the search.
    pub config: PanoramaConfig,
}

impl PanoramaRequest {
    /// Requires the memory of the centres of all cells in the extent of the map, for a search anywhere.
    pub fn require_memory(&self, path: &[Pose3], tiles: &TileGrid) -> Result<(), MemoryError> {
        const CELL_BYTES: f64 = 16.0;
        let (min, max) = tiles.extent();
        let cells = (max.x - min.x) * (max.y - min.y) / self.config.cell_m.powi(2);
        match self.is_along(path) {
            true => Ok(()),
            false => memory::require("the search grid", cells * CELL_BYTES, "raise grid_res"),
        }
    }

    /// Returns the centres of the cells of the region in a map [m].
    pub fn cells(&self, path: &[Pose3], tiles: &TileGrid) -> Vec<Point2<f64>> {
        let cell_m = self.config.cell_m;
        if !self.is_along(path) {
            return cells::over_map(tiles, cell_m);
        }
        let poses: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
        cells::along_road(&poses, ROAD_HALF_WIDTH_M, cell_m)
    }

    /// Whether the region is the road along the path of the mapping drive.
    fn is_along(&self, path: &[Pose3]) -> bool {
        self.region == SearchRegion::Road && !path.is_empty()
    }
}

/// Panoramas of the map from every cell.
#[derive(Clone, Debug)]
pub struct PanoramaIndex {
    /// Size of the panoramas and of the search.
    pub config: PanoramaConfig,
    /// Projection of the panoramas.
    pub model: LidarModel,
    /// Cells that are on the map: centre and height of the ground [m].
    places: Vec<(Point2<f64>, f64)>,
    /// One panorama per cell, row-major; [`FAR_M`] where there is no surface.
    images: Vec<Vec<f32>>,
}

/// A candidate pose of the car.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanoramaSeed {
    /// Centre of the cell [m].
    pub center: Point2<f64>,
    /// Height of the ground there [m].
    pub level_m: f64,
    /// Heading with the lowest cost [rad].
    pub heading_rad: f64,
    /// Mean limited difference [m].
    pub cost_m: f64,
}

/// Range of pixels without a surface: finite, and every difference from it exceeds the limit.
const FAR_M: f32 = 1e9;

impl PanoramaIndex {
    /// Renders the panoramas of all cells, given by their centres [m], with ground in valid tiles.
    pub fn build(
        cells: &[Point2<f64>],
        renderer: &dyn RangeRenderer,
        ground: &GroundMap,
        tiles: &TileGrid,
        request: &PanoramaRequest,
    ) -> Result<Self, RenderError> {
        /// Panoramas rendered per call.
        const BATCH: usize = 512;
        let upright = SensorAttitude {
            height_m: request.sensor_height_m,
            roll_rad: 0.0,
            pitch_rad: 0.0,
        };
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
            cells.iter().filter(on_map).flat_map(levels).unzip();
        let model = panorama_model(&request.lidar, &request.config);
        memory::require(
            "the panoramas of the map",
            4.0 * model.len() as f64 * (poses.len() + poses.len().min(BATCH)) as f64,
            "raise grid_res, or lower panorama.rows or panorama.columns",
        )?;
        let mut images = Vec::with_capacity(poses.len());
        for batch in poses.chunks(BATCH) {
            for mut image in renderer.render(batch, &model)? {
                image.iter_mut().for_each(|range| *range = range.min(FAR_M));
                images.push(image);
            }
        }
        Ok(Self {
            config: request.config.clone(),
            model,
            places,
            images,
        })
    }

    /// Whether no cell has ground.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// Returns the best heading of each cell of the second pass, the lowest cost first.
    pub fn search(&self, scan: &RangeImage, attitude: &SensorAttitude) -> Vec<PanoramaSeed> {
        let scan = DoubledScan::new(scan, attitude, &self.model);
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
        self.keep_best_and_one_per_square(&mut coarse, kept.max(1));
        let mut seeds: Vec<PanoramaSeed> = coarse
            .par_iter()
            .map(|&(_, cell)| {
                let (cost_m, shift) = best_shift(&self.images[cell], &scan, limit_m);
                PanoramaSeed {
                    center: self.places[cell].0,
                    level_m: self.places[cell].1,
                    heading_rad: wrap_angle(
                        f64::from(TAU) * shift as f64 / self.model.width as f64,
                    ),
                    cost_m: f64::from(cost_m),
                }
            })
            .collect();
        // Stable: cells of equal cost keep their order.
        seeds.sort_by(|a, b| a.cost_m.total_cmp(&b.cost_m));
        seeds
    }

    /// Keeps the first cells of a list, and the first one in each square: where little stands around the road, a
    /// coarse panorama hardly shows which place is right.
    fn keep_best_and_one_per_square(&self, cells: &mut Vec<(f32, usize)>, best: usize) {
        const SQUARE_M: f64 = 5.0;
        let mut squares = BTreeSet::new();
        let mut rank = 0;
        cells.retain(|&(_, cell)| {
            let square = (self.places[cell].0.coords / SQUARE_M).map(|m| m.floor() as i64);
            rank += 1;
            squares.insert([square.x, square.y]) || rank <= best
        });
    }
}

/// Returns every `step`-th column of rows of a width.
fn thinned(rows: &[f32], width: usize, step: usize) -> Vec<f32> {
    rows.chunks(width)
        .flat_map(|row| row.iter().copied().step_by(step))
        .collect()
}

/// Returns the lowest cost [m] and its shift.
fn best_shift(panorama: &[f32], scan: &DoubledScan, limit_m: f32) -> (f32, usize) {
    (0..scan.width)
        .map(|shift| (cost(panorama, scan, shift, limit_m), shift))
        .fold((f32::INFINITY, 0), |best, next| {
            if next.0 < best.0 { next } else { best }
        })
}

/// Mean limited difference of a panorama and the shifted scan [m].
fn cost(panorama: &[f32], scan: &DoubledScan, shift: usize, limit_m: f32) -> f32 {
    /// Partial sums per SIMD register.
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

/// Projection of the panoramas: the upper part of the field of view of the sensor.
fn panorama_model(lidar: &LidarModel, config: &PanoramaConfig) -> LidarModel {
    LidarModel {
        height: config.rows,
        width: config.columns,
        fov_down: lidar.fov_down.abs().min(config.lowest_rad.to_degrees()),
        elevations: None,
        ..lidar.clone()
    }
}

/// A scan as a level panorama with each row repeated, so that a shift is a slice.
struct DoubledScan {
    /// Columns of a panorama.
    width: usize,
    ranges: Vec<f32>,
}

impl DoubledScan {
    /// Takes the return nearest to the centre of each pixel. Pixels without a return differ from every
    /// range by the limit, at all headings.
    fn new(scan: &RangeImage, attitude: &SensorAttitude, model: &LidarModel) -> Self {
        let road_from_lidar = Rigid3f::from(&attitude.road_from_lidar());
        let (directions, projection) = (model.directions(), Projection::of(model));
        let mut nearest = vec![(-1.0_f32, -FAR_M); model.len()];
        for beam in scan.beams() {
            let direction: Vec3 = road_from_lidar.rotate(beam.direction);
            let Some(index) = projection.pixel_of(direction) else {
                continue;
            };
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

    /// Returns every `step`-th column.
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
    use super::super::test_world::TestWorld;
    use super::*;

    fn request() -> PanoramaRequest {
        PanoramaRequest {
            region: SearchRegion::Road,
            lidar: LidarModel::default(),
            sensor_height_m: 1.73,
            config: PanoramaConfig::default(),
        }
    }

    fn index(world: &TestWorld) -> std::sync::Arc<PanoramaIndex> {
        world.map().panoramas(&request()).unwrap()
    }

    #[test]
    fn the_best_cell_contains_the_true_position_at_any_heading() {
        let world = TestWorld::street();
        let index = index(&world);
        for (x, y, heading) in [
            (10.0, 0.3, 0.0),
            (-20.3, -0.8, 2.0),
            (61.6, 1.1, -1.3),
            (90.0, 0.0, 3.1),
        ] {
            let truth = world.pose_at(x, y, heading);
            let best = index.search(&world.scan(&truth), &SensorAttitude::default())[0];
            let distance = (best.center.coords - truth.translation.vector).norm();
            let turn = wrap_angle(best.heading_rad - heading).abs();
            assert!(distance < 1.5, "{distance} m from {x} {y}");
            assert!(turn < 0.06, "{turn} rad from {heading}");
        }
    }

    #[test]
    fn a_turn_by_whole_columns_changes_only_the_best_heading() {
        let world = TestWorld::street();
        let index = index(&world);
        let turn = 10.0 * std::f64::consts::TAU / index.model.width as f64;
        let search = |heading: f64| {
            index.search(
                &world.scan(&world.pose_at(25.2, 0.1, heading)),
                &SensorAttitude::default(),
            )[0]
        };
        let (straight, turned) = (search(0.0), search(turn));
        assert_eq!(straight.center, turned.center);
        assert!(wrap_angle(turned.heading_rad - straight.heading_rad - turn).abs() < 0.04);
    }

    #[test]
    fn the_same_request_returns_the_same_panoramas() {
        let map = TestWorld::street().map();
        let first = map.panoramas(&request()).unwrap();
        assert!(std::sync::Arc::ptr_eq(
            &first,
            &map.panoramas(&request()).unwrap()
        ));
        let higher = PanoramaRequest {
            sensor_height_m: 2.0,
            ..request()
        };
        assert!(!std::sync::Arc::ptr_eq(
            &first,
            &map.panoramas(&higher).unwrap()
        ));
    }

    #[test]
    fn panoramas_of_the_whole_map_have_ground_and_a_valid_tile() {
        let world = TestWorld::street();
        let anywhere = PanoramaRequest {
            region: SearchRegion::Anywhere,
            config: PanoramaConfig {
                cell_m: 10.0,
                ..PanoramaConfig::default()
            },
            ..request()
        };
        let index = world.map().panoramas(&anywhere).unwrap();
        assert!(!index.is_empty());
        for (center, _) in &index.places {
            let pose = Pose2::from(center.coords);
            assert!(world.ground.patch_under(&pose, None).is_some());
            assert!(world.tiles.valid_tile_of(&pose).is_some());
        }
    }

    #[test]
    fn without_cells_on_the_map_the_search_is_empty() {
        let world = TestWorld::street();
        let cells = [Point2::new(9e3, 0.0)];
        let index =
            PanoramaIndex::build(&cells, &world, &world.ground, &world.tiles, &request()).unwrap();
        let scan = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        assert!(index.is_empty());
        assert!(index.search(&scan, &SensorAttitude::default()).is_empty());
    }
}
