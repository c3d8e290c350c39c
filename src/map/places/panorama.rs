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
//! so a heading costs one comparison and no rendering. The first pass compares the descriptors of all cells of a large
//! map, the second the best of them with a subset of columns and headings, the last the best of these with all of
//! them.
//! A panorama has 2 · rows · columns bytes: with the defaults 2.2 kB, 6 MB for 700 m of road in cells of one
//! metre, in a file next to the tiles of the map or in memory. Where roads cross above one another, a cell has one panorama
//! per level.

use std::collections::BTreeSet;
use std::f32::consts::TAU;
use std::ops::{Range, RangeInclusive};
use std::path::Path;

use nalgebra::Point2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::cells::{self, ROAD_HALF_WIDTH_M};
use super::descriptor::ScanDescriptor;
use super::panorama_file::{BATCH, Panoramas, Place};
use super::scan_panorama::{MOST_LIMIT_M, STEP_M, ScanPanorama, limit_of, thinned};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3, wrap_angle};
use crate::lidar::{LidarModel, RangeImage};
use crate::map::ground::elevation::{GroundMap, SensorAttitude};
use crate::map::ground::heights::LEVEL_GAP_M;
use crate::map::tiles::grid::TileGrid;
use crate::memory::{MemoryBudget, MemoryError};
use crate::raycasting::TileError;
use crate::rendering::{RangeRenderer, RenderError};
use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Size of the panoramas and of the search.
///
/// Defaults: `yaw_sigma` of range-mcl, 2 degrees; the rest is ours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PanoramaConfig {
    /// Side of a cell of the search, which has one panorama per level [m].
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
    /// Increase of the mean cost for which a cell gets e times fewer particles [m].
    #[default(0.03)]
    pub scale_m: f64,
    /// Standard deviation of the headings around the best heading of a cell [deg].
    #[default(2.0)]
    pub yaw_sigma_deg: f64,
}

impl PanoramaConfig {
    /// Allowed sides of a cell [m].
    pub(crate) const CELLS_M: RangeInclusive<f64> = 0.05..=1000.0;
}

impl Validate for PanoramaConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("cell_m", self.cell_m, Self::CELLS_M)?;
        in_range("rows", self.rows, 1..=256)?;
        in_range("columns", self.columns, 1..=3600)?;
        in_range("lowest_rad", self.lowest_rad, -1.5..=1.5)?;
        in_range("limit_m", self.limit_m, STEP_M..=MOST_LIMIT_M)?;
        in_range("coarse_step", self.coarse_step, 1..=self.columns)?;
        positive("scale_m", self.scale_m)?;
        not_negative("yaw_sigma_deg", self.yaw_sigma_deg)
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
    /// Attitude of the sensor of the panoramas.
    fn attitude(&self) -> SensorAttitude {
        SensorAttitude {
            height_m: self.sensor_height_m,
            roll_rad: 0.0,
            pitch_rad: 0.0,
        }
    }

    /// Requires the memory of the centres of all cells in the extent of the map, for a search anywhere.
    pub fn require_memory(
        &self,
        path: &[Pose3],
        tiles: &TileGrid,
        budget: MemoryBudget,
    ) -> Result<(), MemoryError> {
        const CELL_BYTES: f64 = 16.0;
        let (min, max) = tiles.extent();
        let cells = (max.x - min.x) * (max.y - min.y) / self.config.cell_m.powi(2);
        if self.is_along(path) {
            Ok(())
        } else {
            budget.require(
                "the search grid",
                cells * CELL_BYTES,
                "raise panorama.cell_m",
            )
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

    /// What the panoramas depend on, besides the map.
    pub(crate) fn words(&self) -> String {
        let model = panorama_model(&self.lidar, &self.config);
        let (region, height_m, cell_m) = (self.region, self.sensor_height_m, self.config.cell_m);
        format!("{region:?}, {height_m} m above the ground, cells of {cell_m} m: {model:?}")
    }

    /// Whether the region is the road along the path of the mapping drive.
    fn is_along(&self, path: &[Pose3]) -> bool {
        self.region == SearchRegion::Road && !path.is_empty()
    }
}

/// Panoramas of the map from every cell, and descriptors of them.
#[derive(Clone, Debug)]
pub struct PanoramaIndex {
    /// Size of the panoramas and of the search.
    pub config: PanoramaConfig,
    /// Projection of the panoramas.
    pub model: LidarModel,
    panoramas: Panoramas,
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

impl PanoramaIndex {
    /// Renders the panoramas of all cells, given by their centres [m], with ground in valid tiles; into a file, or if
    /// there is none, into memory, within the budget.
    pub(crate) fn build(
        cells: &[Point2<f64>],
        renderer: &dyn RangeRenderer,
        ground: &GroundMap,
        tiles: &TileGrid,
        request: &PanoramaRequest,
        file: Option<(&Path, &str)>,
        budget: MemoryBudget,
    ) -> Result<Self, RenderError> {
        let upright = request.attitude();
        let on_map = |center: &&Point2<f64>| {
            let pose = Pose2::from(center.coords);
            tiles.valid_tile_of(&pose).is_some()
        };
        let model = panorama_model(&request.lidar, &request.config);
        // Also of those in a file, so that a fine grid does not fill the disk.
        let bytes =
            |places: usize| 2.0 * model.len() as f64 * (places + 3 * places.min(BATCH)) as f64;
        let (mut places, mut poses) = (Vec::new(), Vec::new());
        for (earlier, center) in (cells.iter().enumerate()).filter(|(_, center)| on_map(center)) {
            let pose = Pose2::from(center.coords);
            for patch in ground.levels_at(center.x, center.y)? {
                places.push(Place {
                    x: center.x,
                    y: center.y,
                    level_m: patch.height_m,
                });
                poses.push(patch.lift(&pose, &upright));
            }
            // Before the places of a large map fill the memory; the rest of it has as many per cell.
            if bytes(places.len()) > budget.bytes as f64 {
                budget.require(
                    "the panoramas of the map",
                    bytes(places.len()) * cells.len() as f64 / (earlier + 1) as f64,
                    "raise panorama.cell_m, or lower panorama.rows or panorama.columns",
                )?;
            }
        }
        let render = |places: Range<usize>| renderer.render(&poses[places], &model);
        let on_disk = match file {
            Some((path, request)) => Panoramas::write(path, request, &places, &model, render),
            None => Ok(None),
        };
        let panoramas = match on_disk? {
            Some(panoramas) => panoramas,
            None => Panoramas::render(&places, &model, render)?,
        };
        Ok(Self::over(panoramas, request))
    }

    /// Panoramas that were made for a request.
    pub(crate) fn over(panoramas: Panoramas, request: &PanoramaRequest) -> Self {
        Self {
            config: request.config.clone(),
            model: panorama_model(&request.lidar, &request.config),
            panoramas,
        }
    }

    /// Returns the best heading of each cell of the last pass, the lowest cost first.
    ///
    /// In a large map, the first pass compares the descriptors of all cells, and the best of them are searched.
    pub fn search(
        &self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
    ) -> Result<Vec<PanoramaSeed>, RenderError> {
        let scan = ScanPanorama::new(scan, attitude, &self.model);
        let step = self.config.coarse_step.max(1);
        let coarse_scan = scan.thinned(step);
        let limit = limit_of(self.config.limit_m);
        let candidates = self.described(&scan);
        let reader = || self.panoramas.reader();
        let mut coarse: Vec<(f32, usize)> = candidates
            .par_iter()
            .map_init(reader, |reader, &cell| {
                let coarse_image = thinned(&reader.read(cell)?, self.model.width, step);
                Ok((best_shift(&coarse_image, &coarse_scan, limit).0, cell))
            })
            .collect::<Result<_, TileError>>()?;
        coarse.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        /// Share of the cells in the second pass (unitless).
        const REFINED_SHARE: f64 = 0.1;
        let kept = (REFINED_SHARE * coarse.len() as f64).ceil() as usize;
        self.keep_best_and_one_per_square(&mut coarse, kept.max(1));
        let places = self.panoramas.places();
        let mut seeds: Vec<PanoramaSeed> = coarse
            .par_iter()
            .map_init(reader, |reader, &(_, cell)| {
                let (cost_m, shift) = best_shift(&reader.read(cell)?, &scan, limit);
                Ok(PanoramaSeed {
                    center: Point2::new(places[cell].x, places[cell].y),
                    level_m: places[cell].level_m,
                    heading_rad: wrap_angle(
                        f64::from(TAU) * shift as f64 / self.model.width as f64,
                    ),
                    cost_m: f64::from(cost_m),
                })
            })
            .collect::<Result<_, TileError>>()?;
        // Stable: cells of equal cost keep their order.
        seeds.sort_by(|a, b| a.cost_m.total_cmp(&b.cost_m));
        Ok(seeds)
    }

    /// The cells whose descriptors are most like that of the scan, and the best one of each square; of few cells, all.
    fn described(&self, scan: &ScanPanorama) -> Vec<usize> {
        /// Cells that are searched without looking at their descriptors.
        const FEW: usize = 4000;
        /// Share of the others that is.
        const SHARE: f64 = 0.05;
        let descriptors = self.panoramas.descriptors();
        let all = 0..self.panoramas.places().len();
        if all.len() <= FEW {
            return all.collect();
        }
        let scan = ScanDescriptor::of(scan);
        let mut cells: Vec<(f32, usize)> = all
            .into_par_iter()
            .map(|cell| (scan.difference(&descriptors[cell]), cell))
            .collect();
        cells.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let best = (SHARE * cells.len() as f64) as usize;
        self.keep_best_and_one_per_square(&mut cells, best.max(FEW));
        let mut cells: Vec<usize> = cells.into_iter().map(|(_, cell)| cell).collect();
        // In the order of the file.
        cells.sort_unstable();
        cells
    }

    /// Keeps the first cells of a list, and the first one in each square on each level: where little stands around the road, a
    /// coarse panorama hardly shows which place is right.
    fn keep_best_and_one_per_square(&self, cells: &mut Vec<(f32, usize)>, best: usize) {
        const SQUARE_M: f64 = 5.0;
        let places = self.panoramas.places();
        let mut squares = BTreeSet::new();
        let mut rank = 0;
        cells.retain(|&(_, cell)| {
            let place = &places[cell];
            let square = [
                place.x / SQUARE_M,
                place.y / SQUARE_M,
                place.level_m / LEVEL_GAP_M,
            ];
            rank += 1;
            squares.insert(square.map(|along| along.floor() as i64)) || rank <= best
        });
    }
}

/// Returns the lowest cost [m] and its shift.
fn best_shift(panorama: &[u16], scan: &ScanPanorama, limit: u16) -> (f32, usize) {
    let (cost, shift) = (0..scan.width)
        .map(|shift| (cost(panorama, scan, shift, limit), shift))
        .min()
        .unwrap_or((0, 0));
    (cost as f32 * STEP_M / panorama.len() as f32, shift)
}

/// Sum of the limited differences of a panorama and the shifted scan [steps].
fn cost(panorama: &[u16], scan: &ScanPanorama, shift: usize, limit: u16) -> u64 {
    let width = scan.width;
    let mut sum = 0;
    for (row, rendered) in panorama.chunks(width).enumerate() {
        let measured = &scan.ranges[2 * row * width + shift..][..width];
        let differences = rendered.iter().zip(measured);
        let of_row: u32 = differences
            .map(|(&rendered, &measured)| u32::from(rendered.abs_diff(measured).min(limit)))
            .sum();
        sum += u64::from(of_row);
    }
    sum
}

/// Projection of the panoramas: the upper part of the field of view of the sensor, in whole degrees and metres, so that
/// sensors of one kind share the panoramas.
fn panorama_model(lidar: &LidarModel, config: &PanoramaConfig) -> LidarModel {
    LidarModel {
        height: config.rows,
        width: config.columns,
        fov_up: lidar.fov_up.round(),
        fov_down: lidar.fov_down.abs().min(config.lowest_rad.to_degrees()),
        max_range: lidar.max_range.round().max(1.0),
        min_range: lidar.min_range.round().min(0.5 * lidar.max_range),
        elevations: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::places::scan_panorama::{NOTHING, steps_of};
    use crate::map::world_for_tests::TestWorld;

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
            let scan = world.scan(&truth);
            let best = index.search(&scan, &SensorAttitude::default()).unwrap()[0];
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
            let scan = world.scan(&world.pose_at(25.2, 0.1, heading));
            index.search(&scan, &SensorAttitude::default()).unwrap()[0]
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
        assert!(!index.panoramas.places().is_empty());
        for place in index.panoramas.places() {
            let pose = Pose2::translation(place.x, place.y);
            assert!(world.ground.patch_under(&pose, None).unwrap().is_some());
            assert!(world.tiles.valid_tile_of(&pose).is_some());
        }
    }

    #[test]
    fn without_cells_on_the_map_the_search_is_empty() {
        let world = TestWorld::street();
        let cells = [Point2::new(9e3, 0.0)];
        let index = PanoramaIndex::build(
            &cells,
            &world,
            &world.ground,
            &world.tiles,
            &request(),
            None,
            MemoryBudget::default(),
        )
        .unwrap();
        let scan = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        assert!(index.panoramas.places().is_empty());
        assert!(
            index
                .search(&scan, &SensorAttitude::default())
                .unwrap()
                .is_empty()
        );
    }

    /// Ranges of a place that no other has, row by row.
    fn ranges_at(place: usize, model: &LidarModel) -> Vec<f32> {
        let phase = 0.618 * place as f32;
        let range_m = |column: usize| {
            let turns = column as f32 / model.width as f32;
            25.0 + 14.0 * (TAU * (3.0 * turns + phase)).sin()
                + 9.0 * (TAU * (5.0 * turns + 3.7 * phase)).cos()
        };
        let row: Vec<f32> = (0..model.width).map(range_m).collect();
        row.repeat(model.height)
    }

    #[test]
    fn among_many_places_that_of_the_scan_is_searched_though_most_are_not() {
        const PLACES: usize = 12_000;
        let request = request();
        let model = panorama_model(&request.lidar, &request.config);
        let places: Vec<Place> = (0..PLACES)
            .map(|number| Place {
                // In one square, so that its size decides nothing.
                x: 1e-4 * number as f64,
                y: 0.5,
                level_m: 0.0,
            })
            .collect();
        let render =
            |numbers: Range<usize>| Ok(numbers.map(|place| ranges_at(place, &model)).collect());
        let panoramas = Panoramas::render(&places, &model, render).unwrap();
        let index = PanoramaIndex::over(panoramas, &request);
        for place in [0, 77, 5000, 11_999] {
            let row = &ranges_at(place, &model)[..model.width];
            // Turned, with noise and without a tenth of the returns.
            let turned: Vec<u16> = (0..model.width)
                .map(|column| match column % 10 {
                    3 => NOTHING,
                    _ => steps_of(row[(column + 40) % model.width] + 0.3 * (column % 3) as f32),
                })
                .collect();
            let scan = ScanPanorama {
                width: model.width,
                ranges: turned.repeat(2 * model.height),
            };
            let searched = index.described(&scan);
            assert!(
                searched.len() < PLACES / 2 && searched.contains(&place),
                "{place}"
            );
        }
    }

    #[test]
    fn panoramas_of_a_file_are_those_in_memory_and_a_damaged_one_is_an_error() {
        let world = TestWorld::street();
        let (in_memory, request) = (index(&world), request());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("street.panoramas");
        let abandoned = folder.path().join(".fpmcl-street.panoramas-123456.part");
        std::fs::write(&abandoned, "of a killed process").unwrap();
        let cells = request.cells(&world.map().path.map_from_lidar, &world.tiles);
        let made = PanoramaIndex::build(
            &cells,
            &world,
            &world.ground,
            &world.tiles,
            &request,
            Some((&file, "the street")),
            MemoryBudget::default(),
        );
        assert!(!abandoned.exists());
        assert!(Panoramas::open(&file, "another street").is_none());
        let opened = Panoramas::open(&file, "the street").unwrap();
        let opened = PanoramaIndex::over(opened, &request);
        let scan = world.scan(&world.pose_at(25.2, 0.1, 1.0));
        let attitude = SensorAttitude::default();
        let expected = in_memory.search(&scan, &attitude).unwrap();
        for index in [&made.unwrap(), &opened] {
            assert_eq!(index.search(&scan, &attitude).unwrap(), expected);
        }
        let mut bytes = std::fs::read(&file).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        // In place: an open file stays readable when another one replaces it.
        std::fs::write(&file, &bytes).unwrap();
        let message = opened.search(&scan, &attitude).unwrap_err().to_string();
        assert!(
            message.contains("street.panoramas") && message.contains("checksum"),
            "{message}"
        );
        bytes[70] ^= 1;
        std::fs::write(&file, &bytes[..]).unwrap();
        assert!(Panoramas::open(&file, "the street").is_none());
        std::fs::write(&file, &bytes[..1000]).unwrap();
        assert!(Panoramas::open(&file, "the street").is_none());
    }
}
