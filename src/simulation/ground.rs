//! The ground of the simulated world: a height everywhere, and a distance to the carriageway
//! everywhere, both as one field over the plane, so that roads may cross and loops close.
//!
//! Heights blend the heights hᵢ of all knots xᵢ of the paths (Shepard, *A two-dimensional
//! interpolation function for irregularly-spaced data*, 1968, smoothed by σ):
//!
//! ```text
//! h(x) = Σ wᵢ hᵢ / Σ wᵢ        wᵢ = (|x − xᵢ|² + σ²)⁻³
//! ```
//!
//! The carriageway is a union of shapes, kept as their least signed distance: negative on it,
//! zero at the kerb.

use glam::{DVec2, Vec3};
use nalgebra::Point2;
use rand::RngExt as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::path::{Path, PathPoint};
use super::random::{Purpose, stream};
use crate::geometry::Grid2;

/// σ of the height field [m].
const HEIGHT_SMOOTHING_M: f64 = 4.0;
/// Distance to the carriageway where nothing nearer is known [m].
const FAR_M: f32 = 1e3;

/// The cross-section of the street.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GroundConfig {
    /// Edge of the squares that the ground is made of [m].
    pub cell_m: f64,
    /// How far from the carriageway there is ground [m].
    pub reach_m: f64,
    /// Of the pavement [m].
    pub sidewalk_width_m: f64,
    /// Of the pavement over the carriageway [m].
    pub kerb_height_m: f64,
    /// Rise from the gutter towards the middle of the road, per metre, over three metres at most.
    pub crown_slope: f64,
    /// Height of the waves in gardens and grass [m].
    pub undulation_m: f64,
}

impl Default for GroundConfig {
    /// A residential street.
    fn default() -> Self {
        Self {
            cell_m: 1.0,
            reach_m: 45.0,
            sidewalk_width_m: 2.2,
            kerb_height_m: 0.12,
            crown_slope: 0.025,
            undulation_m: 0.15,
        }
    }
}

/// What a part of the ground is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surface {
    /// Carriageway or parking bay, the distance to the kerb negative.
    Carriageway,
    /// Up to the sidewalk's width beyond the kerb.
    Sidewalk,
    /// Beyond.
    Terrain,
}

/// A band around a line, or a rectangle, that belongs to the carriageway.
#[derive(Clone, Debug, PartialEq)]
pub enum Paving {
    /// Road along a path.
    Road { path: Path, half_width_m: f64 },
    /// Parking bays along a path.
    Bays { path: Path, half_width_m: f64 },
    /// An open square.
    Square {
        center: DVec2,
        forward: DVec2,
        half_size_m: DVec2,
    },
}

/// Fields on the corners of a grid.
#[derive(Clone, Debug, PartialEq)]
pub struct Ground {
    /// How the street is shaped.
    pub config: GroundConfig,
    grid: Grid2,
    nodes: Vec<Node>,
}

/// The ground at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Node {
    /// Height without crown, kerb and waves [m].
    pub height_m: f32,
    /// Signed distance to the carriageway with its bays and squares [m].
    pub kerb_m: f32,
    /// Signed distance to the roads alone [m].
    pub road_m: f32,
    /// Height of the waves that gardens have here [m].
    pub waves_m: f32,
}

impl Node {
    /// The node at a share `t` of the way to another.
    pub fn lerp(self, other: Self, t: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * t;
        Self {
            height_m: mix(self.height_m, other.height_m),
            kerb_m: mix(self.kerb_m, other.kerb_m),
            road_m: mix(self.road_m, other.road_m),
            waves_m: mix(self.waves_m, other.waves_m),
        }
    }
}

impl Ground {
    /// Ground around paved shapes, with the heights of `paths`.
    pub fn new(paths: &[Path], pavings: &[Paving], config: &GroundConfig, seed: u64) -> Self {
        let grid = grid_around(pavings, config);
        let knots: Vec<(DVec2, f64)> = paths.iter().flat_map(Path::knots).collect();
        let waves = Waves::new(seed);
        let mut nodes: Vec<Node> = (0..grid.len())
            .into_par_iter()
            .map(|index| {
                let position = corner(&grid, index);
                Node {
                    height_m: blended_height(&knots, position) as f32,
                    kerb_m: FAR_M,
                    road_m: FAR_M,
                    waves_m: waves.at(position) as f32,
                }
            })
            .collect();
        for paving in pavings {
            stamp(paving, &grid, config.reach_m + 3.0, &mut nodes);
        }
        Self {
            config: config.clone(),
            grid,
            nodes,
        }
    }

    /// Number of cells along x and y.
    pub fn cells(&self) -> (usize, usize) {
        (self.grid.columns - 1, self.grid.rows - 1)
    }

    /// A corner of the grid: its position and what the ground is there.
    pub fn node(&self, column: usize, row: usize) -> (DVec2, Node) {
        let index = row * self.grid.columns + column;
        (corner(&self.grid, index), self.nodes[index])
    }

    /// The ground at a place, between the corners of its cell; the nearest known outside.
    pub fn at(&self, position: DVec2) -> Node {
        let along = |value: f64, origin: f64, cells: usize| {
            let cells_from_origin = ((value - origin) / self.grid.cell_m).clamp(0.0, cells as f64);
            let cell = (cells_from_origin as usize).min(cells - 1);
            (cell, (cells_from_origin - cell as f64) as f32)
        };
        let (columns, rows) = self.cells();
        let (column, u) = along(position.x, self.grid.origin.x, columns);
        let (row, v) = along(position.y, self.grid.origin.y, rows);
        let lower = self
            .node(column, row)
            .1
            .lerp(self.node(column + 1, row).1, u);
        let upper = self
            .node(column, row + 1)
            .1
            .lerp(self.node(column + 1, row + 1).1, u);
        lower.lerp(upper, v)
    }

    /// Signed distance to the carriageway, positive beside it [m].
    pub fn kerb_distance_m(&self, position: DVec2) -> f64 {
        f64::from(self.at(position).kerb_m)
    }

    /// Which part of the ground a distance to the kerb belongs to.
    pub fn surface_of(&self, kerb_m: f32) -> Surface {
        if kerb_m < 0.0 {
            Surface::Carriageway
        } else if f64::from(kerb_m) < self.config.sidewalk_width_m {
            Surface::Sidewalk
        } else {
            Surface::Terrain
        }
    }

    /// Height of a surface, crown, kerb and waves included [m]. At a kerb two surfaces meet at
    /// different heights, hence the argument.
    pub fn surface_height_m(&self, node: &Node, surface: Surface) -> f32 {
        let config = &self.config;
        let offset_m = match surface {
            Surface::Carriageway => (-node.kerb_m).clamp(0.0, 3.0) * config.crown_slope as f32,
            Surface::Sidewalk => config.kerb_height_m as f32,
            Surface::Terrain => {
                // The waves rise from nothing within four metres of the pavement.
                let share = (node.kerb_m - config.sidewalk_width_m as f32) / 4.0;
                let share = share.clamp(0.0, 1.0);
                let rise = share * share * (3.0 - 2.0 * share);
                config.kerb_height_m as f32 + rise * (config.undulation_m as f32) * node.waves_m
            }
        };
        node.height_m + offset_m
    }

    /// The point on the ground over a place in the plane.
    pub fn point_at(&self, position: DVec2) -> Vec3 {
        let node = self.at(position);
        let height_m = self.surface_height_m(&node, self.surface_of(node.kerb_m));
        Vec3::new(position.x as f32, position.y as f32, height_m)
    }

    /// Goes sideways from a path (left for +1, right for -1) until the kerb is `kerb_m` behind;
    /// `None` where that is more than `limit_m` away from the path.
    pub fn beside(&self, point: &PathPoint, side: f64, kerb_m: f64, limit_m: f64) -> Option<DVec2> {
        const STEP_M: f64 = 0.1;
        (0..=(limit_m / STEP_M) as usize)
            .map(|step| point.beside(side * STEP_M * step as f64))
            .find(|&position| self.kerb_distance_m(position) >= kerb_m)
    }
}

fn grid_around(pavings: &[Paving], config: &GroundConfig) -> Grid2 {
    let (mut min, mut max) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    let mut grow = |position: DVec2, margin_m: f64| {
        min = min.min(position - margin_m);
        max = max.max(position + margin_m);
    };
    for paving in pavings {
        match paving {
            Paving::Road { path, half_width_m } | Paving::Bays { path, half_width_m } => {
                path.knots().for_each(|(p, _)| grow(p, *half_width_m));
            }
            Paving::Square {
                center,
                half_size_m,
                ..
            } => grow(*center, half_size_m.length()),
        }
    }
    let margin = config.reach_m + 2.0 * config.cell_m;
    Grid2::covering(
        Point2::new(min.x - margin, min.y - margin),
        Point2::new(max.x + margin, max.y + margin),
        config.cell_m,
    )
}

/// Lower corner of a cell.
fn corner(grid: &Grid2, index: usize) -> DVec2 {
    let (column, row) = (index % grid.columns, index / grid.columns);
    DVec2::new(
        grid.origin.x + column as f64 * grid.cell_m,
        grid.origin.y + row as f64 * grid.cell_m,
    )
}

fn blended_height(knots: &[(DVec2, f64)], position: DVec2) -> f64 {
    let (mut heights, mut weights) = (0.0, 0.0);
    for &(knot, height_m) in knots {
        let squared = knot.distance_squared(position) + HEIGHT_SMOOTHING_M * HEIGHT_SMOOTHING_M;
        let weight = 1.0 / (squared * squared * squared);
        heights += weight * height_m;
        weights += weight;
    }
    heights / weights
}

/// Lowers the distances of the nodes around a shape to the distance to it.
fn stamp(paving: &Paving, grid: &Grid2, reach_m: f64, nodes: &mut [Node]) {
    match paving {
        Paving::Road { path, half_width_m } => {
            stamp_line(path, *half_width_m, grid, reach_m, nodes, true);
        }
        Paving::Bays { path, half_width_m } => {
            stamp_line(path, *half_width_m, grid, reach_m, nodes, false);
        }
        Paving::Square {
            center,
            forward,
            half_size_m,
        } => {
            let radius_m = half_size_m.length() + reach_m;
            for_nodes_within(grid, *center - radius_m, *center + radius_m, |index| {
                let offset = corner(grid, index) - *center;
                let local = DVec2::new(offset.dot(*forward), offset.dot(forward.perp()));
                let beyond = local.abs() - *half_size_m;
                let outside_m = beyond.max(DVec2::ZERO).length();
                let distance_m = (outside_m + beyond.max_element().min(0.0)) as f32;
                nodes[index].kerb_m = nodes[index].kerb_m.min(distance_m);
            });
        }
    }
}

fn stamp_line(
    path: &Path,
    half_width_m: f64,
    grid: &Grid2,
    reach_m: f64,
    nodes: &mut [Node],
    is_road: bool,
) {
    let knots: Vec<DVec2> = path.knots().map(|(position, _)| position).collect();
    let radius_m = half_width_m + reach_m;
    for ends in knots.windows(2) {
        let [a, b] = [ends[0], ends[1]];
        for_nodes_within(grid, a.min(b) - radius_m, a.max(b) + radius_m, |index| {
            let offset = corner(grid, index) - a;
            let share = (offset.dot(b - a) / a.distance_squared(b)).clamp(0.0, 1.0);
            let distance_m = (offset.distance(share * (b - a)) - half_width_m) as f32;
            let node = &mut nodes[index];
            node.kerb_m = node.kerb_m.min(distance_m);
            if is_road {
                node.road_m = node.road_m.min(distance_m);
            }
        });
    }
}

fn for_nodes_within(grid: &Grid2, min: DVec2, max: DVec2, mut visit: impl FnMut(usize)) {
    let cell = |value: f64, origin: f64, cells: usize| {
        (((value - origin) / grid.cell_m).max(0.0) as usize).min(cells - 1)
    };
    let columns =
        cell(min.x, grid.origin.x, grid.columns)..=cell(max.x, grid.origin.x, grid.columns);
    for row in cell(min.y, grid.origin.y, grid.rows)..=cell(max.y, grid.origin.y, grid.rows) {
        for column in columns.clone() {
            visit(row * grid.columns + column);
        }
    }
}

/// A sum of plane waves of several lengths, between -1 and 1.
struct Waves(Vec<(DVec2, f64)>);

impl Waves {
    fn new(seed: u64) -> Self {
        let mut rng = stream(seed, Purpose::Undulation, 0);
        let waves = (0..8)
            .map(|_| {
                let length_m: f64 = rng.random_range(3.0..17.0);
                let direction = DVec2::from_angle(rng.random_range(0.0..std::f64::consts::TAU));
                let phase = rng.random_range(0.0..std::f64::consts::TAU);
                (std::f64::consts::TAU / length_m * direction, phase)
            })
            .collect();
        Self(waves)
    }

    fn at(&self, position: DVec2) -> f64 {
        let sum: f64 = self
            .0
            .iter()
            .map(|(wave, phase)| (wave.dot(position) + phase).sin())
            .sum();
        sum / self.0.len() as f64
    }
}
