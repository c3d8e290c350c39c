//! The ground of the simulated world: height and distance to the carriageway as fields over the
//! plane, so that roads may cross and loops close.
//!
//! Heights blend the heights hᵢ of all knots xᵢ of the driven centreline (Shepard, *A
//! two-dimensional interpolation function for irregularly-spaced data*, 1968, smoothed by σ):
//!
//! ```text
//! h(x) = Σ wᵢ hᵢ / Σ wᵢ        wᵢ = (|x − xᵢ|² + σ²)⁻³
//! ```
//!
//! The carriageway is a union of shapes, stored as their least signed distance: negative on it,
//! zero at the kerb.

use std::f64::consts::TAU;

use glam::{DVec2, Mat3, Vec3};
use nalgebra::Point2;
use rand::RngExt as _;
use rayon::prelude::*;

use super::centreline::{Centreline, CentrelinePoint};
use super::layout::{Footprint, StreetLayout, Strip};
use super::random::{Purpose, stream};
use super::street_config::CrossSectionConfig;
use crate::geometry::{Grid2, Rigid3f};

/// σ of the height field [m].
const HEIGHT_SMOOTHING_M: f64 = 4.0;
/// Distance to the carriageway beyond its surroundings [m].
const FAR_M: f32 = 1e3;

/// A zone of the cross-section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroundZone {
    /// Carriageway, parking bay or square: the distance to the kerb is negative.
    Carriageway,
    /// From the kerb to the back of the sidewalk.
    Sidewalk,
    /// Gardens and grass behind the sidewalk.
    Terrain,
}

/// Fields over the plane, sampled at the nodes of a grid.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundField {
    /// The cross-section.
    pub config: CrossSectionConfig,
    /// One sample at the lower corner of each cell.
    grid: Grid2,
    samples: Vec<GroundSample>,
}

/// The fields at a position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundSample {
    /// Height without crown, kerb and undulation [m].
    pub height_m: f32,
    /// Signed distance to the carriageway with its bays and squares [m].
    pub kerb_m: f32,
    /// Signed distance to the roads alone [m].
    pub road_m: f32,
    /// Undulation of gardens, -1 to 1.
    pub undulation: f32,
}

impl GroundSample {
    /// Linear interpolation, a share `t` of the way to another sample.
    pub fn lerp(self, other: Self, t: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * t;
        Self {
            height_m: mix(self.height_m, other.height_m),
            kerb_m: mix(self.kerb_m, other.kerb_m),
            road_m: mix(self.road_m, other.road_m),
            undulation: mix(self.undulation, other.undulation),
        }
    }
}

impl GroundField {
    /// The ground around a layout, with the heights of the driven centreline.
    pub fn new(
        lane: &Centreline,
        layout: &StreetLayout,
        config: &CrossSectionConfig,
        seed: u64,
    ) -> Self {
        let grid = grid_around(layout, config);
        let undulation = Undulation::new(seed);
        let samples = (0..grid.len())
            .into_par_iter()
            .map(|index| {
                let position = node_position(&grid, index);
                GroundSample {
                    height_m: blended_height_m(lane, position) as f32,
                    kerb_m: FAR_M,
                    road_m: FAR_M,
                    undulation: undulation.at(position) as f32,
                }
            })
            .collect();
        let mut field = Self {
            config: config.clone(),
            grid,
            samples,
        };
        for road in &layout.roads {
            field.pave_strip(road, true);
        }
        for bays in &layout.bays {
            field.pave_strip(bays, false);
        }
        if let Some(square) = &layout.square {
            field.pave_square(square);
        }
        field
    }

    /// Number of cells between nodes along x and y.
    pub fn cells(&self) -> (usize, usize) {
        (self.grid.columns - 1, self.grid.rows - 1)
    }

    /// Position of a node of the grid and the fields there.
    pub fn node(&self, column: usize, row: usize) -> (DVec2, GroundSample) {
        let index = row * self.grid.columns + column;
        (node_position(&self.grid, index), self.samples[index])
    }

    /// The fields at a position, bilinear; those at the nearest edge of the grid outside of it.
    pub fn at(&self, position: DVec2) -> GroundSample {
        let along = |value: f64, origin: f64, cells: usize| {
            let cells_from_origin = ((value - origin) / self.grid.cell_m).clamp(0.0, cells as f64);
            let cell = (cells_from_origin as usize).min(cells - 1);
            (cell, (cells_from_origin - cell as f64) as f32)
        };
        let (columns, rows) = self.cells();
        let (column, u) = along(position.x, self.grid.origin.x, columns);
        let (row, v) = along(position.y, self.grid.origin.y, rows);
        let [lower, upper] = [row, row + 1].map(|row| {
            let [left, right] = [column, column + 1].map(|column| self.node(column, row).1);
            left.lerp(right, u)
        });
        lower.lerp(upper, v)
    }

    /// Signed distance to the carriageway, positive outside it [m].
    pub fn kerb_distance_m(&self, position: DVec2) -> f64 {
        f64::from(self.at(position).kerb_m)
    }

    /// The zone at a signed distance to the kerb.
    pub fn zone_of(&self, kerb_m: f32) -> GroundZone {
        if kerb_m < 0.0 {
            GroundZone::Carriageway
        } else if f64::from(kerb_m) < self.config.sidewalk_width_m {
            GroundZone::Sidewalk
        } else {
            GroundZone::Terrain
        }
    }

    /// Height of a zone with crown, kerb and undulation [m]. At a kerb two zones meet at different
    /// heights, hence the argument.
    pub fn zone_height_m(&self, sample: &GroundSample, zone: GroundZone) -> f32 {
        let config = &self.config;
        let offset_m = match zone {
            GroundZone::Carriageway => (-sample.kerb_m).clamp(0.0, 3.0) * config.crown_slope as f32,
            GroundZone::Sidewalk => config.kerb_height_m as f32,
            GroundZone::Terrain => {
                // The undulation rises to its full amplitude within four metres of the sidewalk.
                let share = (sample.kerb_m - config.sidewalk_width_m as f32) / 4.0;
                let share = share.clamp(0.0, 1.0);
                let rise = share * share * (3.0 - 2.0 * share);
                config.kerb_height_m as f32
                    + rise * (config.undulation_m as f32) * sample.undulation
            }
        };
        sample.height_m + offset_m
    }

    /// The point on the ground above or below a position in the plane.
    pub fn point_at(&self, position: DVec2) -> Vec3 {
        let sample = self.at(position);
        let height_m = self.zone_height_m(&sample, self.zone_of(sample.kerb_m));
        Vec3::new(position.x as f32, position.y as f32, height_m)
    }

    /// An upright frame on the ground, x along `forward`: `p_world = world_from_local * p_local`.
    pub fn upright_frame(&self, position: DVec2, forward: DVec2) -> Rigid3f {
        let forward = Vec3::new(forward.x as f32, forward.y as f32, 0.0);
        Rigid3f {
            rotation: Mat3::from_cols(forward, Vec3::Z.cross(forward), Vec3::Z),
            translation: self.point_at(position),
        }
    }

    /// A frame on the ground, x along `forward`, whose x-y plane has the slope between the points
    /// a metre before, behind and to the side: `p_world = world_from_local * p_local`.
    pub fn tangent_frame(&self, position: DVec2, forward: DVec2) -> Rigid3f {
        let height_m = |offset: DVec2| f64::from(self.at(position + offset).height_m);
        let tangent = |direction: DVec2| {
            let slope = (0.5 * (height_m(direction) - height_m(-direction))) as f32;
            Vec3::new(direction.x as f32, direction.y as f32, slope)
        };
        let along = tangent(forward).normalize();
        let up = along.cross(tangent(forward.perp())).normalize();
        Rigid3f {
            rotation: Mat3::from_cols(along, up.cross(along), up),
            translation: self.point_at(position),
        }
    }

    /// Steps sideways from a centreline (left for +1, right for -1) until the kerb is `kerb_m`
    /// behind; `None` if that is more than `limit_m` away from the centreline.
    pub fn beyond_kerb(
        &self,
        point: &CentrelinePoint,
        side: f64,
        kerb_m: f64,
        limit_m: f64,
    ) -> Option<DVec2> {
        const STEP_M: f64 = 0.1;
        (0..=(limit_m / STEP_M) as usize)
            .map(|step| point.beside(side * STEP_M * step as f64))
            .find(|&position| self.kerb_distance_m(position) >= kerb_m)
    }

    /// Lowers the distances around a strip to the distance to it.
    fn pave_strip(&mut self, strip: &Strip, is_road: bool) {
        let half_width_m = strip.half_width_m;
        for ends in strip.centreline.knots.windows(2) {
            let [a, b] = [ends[0].position, ends[1].position];
            self.pave([a.min(b), a.max(b)], half_width_m, is_road, |position| {
                let offset = position - a;
                let share = (offset.dot(b - a) / a.distance_squared(b)).clamp(0.0, 1.0);
                offset.distance(share * (b - a)) - half_width_m
            });
        }
    }

    /// Lowers the distances around a square to the distance to it.
    fn pave_square(&mut self, square: &Footprint) {
        let Footprint {
            center,
            forward,
            half_m,
        } = *square;
        self.pave([center; 2], half_m.length(), false, |position| {
            let offset = position - center;
            let local = DVec2::new(offset.dot(forward), offset.dot(forward.perp()));
            let beyond = local.abs() - half_m;
            beyond.max(DVec2::ZERO).length() + beyond.max_element().min(0.0)
        });
    }

    /// Lowers the distances to the carriageway, and those to the road if it is one, around a box
    /// with a margin.
    fn pave(
        &mut self,
        [min, max]: [DVec2; 2],
        margin_m: f64,
        is_road: bool,
        distance_m: impl Fn(DVec2) -> f64,
    ) {
        let grid = self.grid;
        let radius_m = margin_m + (self.config.reach_m + 3.0);
        let cells = |min: f64, max: f64, origin: f64, cells: usize| {
            let [first, last] = [min - radius_m, max + radius_m]
                .map(|value| (((value - origin) / grid.cell_m).max(0.0) as usize).min(cells - 1));
            first..=last
        };
        for row in cells(min.y, max.y, grid.origin.y, grid.rows) {
            for column in cells(min.x, max.x, grid.origin.x, grid.columns) {
                let index = row * grid.columns + column;
                let distance_m = distance_m(node_position(&grid, index)) as f32;
                let sample = &mut self.samples[index];
                sample.kerb_m = sample.kerb_m.min(distance_m);
                if is_road {
                    sample.road_m = sample.road_m.min(distance_m);
                }
            }
        }
    }
}

fn grid_around(layout: &StreetLayout, config: &CrossSectionConfig) -> Grid2 {
    let strips = layout.roads.iter().chain(&layout.bays).flat_map(|strip| {
        let knots = strip.centreline.knots.iter();
        knots.map(|knot| (knot.position, strip.half_width_m))
    });
    let squares = layout.square.iter();
    let squares = squares.map(|square| (square.center, square.half_m.length()));
    let (mut min, mut max) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for (position, margin_m) in strips.chain(squares) {
        min = min.min(position - margin_m);
        max = max.max(position + margin_m);
    }
    let margin_m = config.reach_m + 2.0 * config.cell_m;
    Grid2::covering(
        Point2::new(min.x - margin_m, min.y - margin_m),
        Point2::new(max.x + margin_m, max.y + margin_m),
        config.cell_m,
    )
}

/// Lower corner of a cell.
fn node_position(grid: &Grid2, index: usize) -> DVec2 {
    let (column, row) = (index % grid.columns, index / grid.columns);
    DVec2::new(
        grid.origin.x + column as f64 * grid.cell_m,
        grid.origin.y + row as f64 * grid.cell_m,
    )
}

fn blended_height_m(lane: &Centreline, position: DVec2) -> f64 {
    let (mut heights, mut weights) = (0.0, 0.0);
    for knot in &lane.knots {
        let squared =
            knot.position.distance_squared(position) + HEIGHT_SMOOTHING_M * HEIGHT_SMOOTHING_M;
        let weight = 1.0 / (squared * squared * squared);
        heights += weight * knot.height_m;
        weights += weight;
    }
    heights / weights
}

/// Mean of plane waves of several lengths, between -1 and 1: wave vectors and phases.
struct Undulation([(DVec2, f64); 8]);

impl Undulation {
    fn new(seed: u64) -> Self {
        let mut rng = stream(seed, Purpose::Undulation, 0);
        Self([(); 8].map(|()| {
            let length_m: f64 = rng.random_range(3.0..17.0);
            let direction = DVec2::from_angle(rng.random_range(0.0..TAU));
            (TAU / length_m * direction, rng.random_range(0.0..TAU))
        }))
    }

    fn at(&self, position: DVec2) -> f64 {
        let waves = self.0.iter();
        let sum: f64 = waves
            .map(|(wave, phase)| (wave.dot(position) + phase).sin())
            .sum();
        sum / self.0.len() as f64
    }
}
