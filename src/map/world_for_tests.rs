//! A street of boxes with a renderer without a mesh, for tests.

use glam::Vec3;
use nalgebra::{Point2, Vector2};

use super::{GroundMap, Map, MappingPath, SensorAttitude, TileConfig, TileGrid};
use crate::geometry::{Pose2, Pose3, Rigid3f, TriangleMesh};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError};

/// Axis-aligned boxes on flat ground, in a street frame at any pose in the map.
#[derive(Clone)]
pub struct TestWorld {
    /// Lower and upper corners, street frame.
    boxes: Vec<(Vec3, Vec3)>,
    /// `p_map = map_from_street * p_street`.
    pub map_from_street: Pose2,
    pub ground: GroundMap,
    pub tiles: TileGrid,
    model: LidarModel,
}

/// Height of the ground in the map [m].
const GROUND_M: f64 = -1.73;

impl TestWorld {
    /// 200 m of street along x with houses, gaps, parked cars and poles at irregular positions.
    pub fn street() -> Self {
        Self::moved_street(Pose2::identity())
    }

    /// The same street at another pose in the map.
    pub fn moved_street(map_from_street: Pose2) -> Self {
        let mut boxes = Vec::new();
        let mut state = 12345_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        for side in [-1.0_f32, 1.0] {
            let mut x = -60.0;
            while x < 140.0 {
                let (length, setback, gap) = (
                    6.0 + 9.0 * random(),
                    7.0 + 3.0 * random(),
                    1.0 + 5.0 * random(),
                );
                boxes.push(footprint(
                    x,
                    x + length,
                    side * setback,
                    side * (setback + 8.0),
                    8.0,
                ));
                x += length + gap;
                if random() < 0.6 {
                    let car = x + 4.0 * random();
                    boxes.push(footprint(car, car + 4.2, side * 3.6, side * 5.3, 1.5));
                }
                let pole = x + 6.0 * random();
                boxes.push(footprint(pole, pole + 0.3, side * 5.8, side * 6.1, 6.0));
            }
        }
        let mapping: Vec<Pose3> = (-50..130)
            .map(|x| {
                let pose = map_from_street * Pose2::translation(f64::from(x), 0.0);
                crate::geometry::pose3_from_pose2(&pose, 0.0)
            })
            .collect();
        Self {
            boxes,
            map_from_street,
            ground: GroundMap::flat(
                Point2::new(-400.0, -400.0),
                Point2::new(400.0, 400.0),
                GROUND_M,
            ),
            tiles: TileGrid::around(&mapping, &TileConfig::default()),
            model: LidarModel {
                height: 32,
                width: 360,
                ..LidarModel::default()
            },
        }
    }

    /// The mapping poses, one per metre, in the map.
    pub fn road(&self) -> Vec<Pose2> {
        (-50..130)
            .map(|x| self.map_from_street * Pose2::translation(f64::from(x), 0.0))
            .collect()
    }

    /// The street as a map.
    pub fn map(&self) -> Map {
        let road = self.road();
        let path = MappingPath {
            world_from_map: Pose3::identity(),
            map_from_lidar: road
                .iter()
                .map(|pose| crate::geometry::pose3_from_pose2(pose, 0.0))
                .collect(),
            ..MappingPath::default()
        };
        let (tiles, ground) = (self.tiles.clone(), self.ground.clone());
        let renderer = std::sync::Arc::new(self.clone());
        Map::from_parts(self.walls(), path, tiles, ground, renderer)
    }

    /// The sides of the boxes.
    fn walls(&self) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for (low, high) in &self.boxes {
            let around = [
                (low.x, low.y),
                (high.x, low.y),
                (high.x, high.y),
                (low.x, high.y),
            ];
            for side in 0..4 {
                let first = mesh.vertices.len() as u32;
                for (corner, z) in [
                    (side, low.z),
                    (side + 1, low.z),
                    (side + 1, high.z),
                    (side, high.z),
                ] {
                    let (x, y) = around[corner % 4];
                    let p = self.map_from_street * Point2::new(f64::from(x), f64::from(y));
                    mesh.vertices.push(Vec3::new(p.x as f32, p.y as f32, z));
                }
                for [a, b, c] in [[0, 1, 2], [0, 2, 3]] {
                    mesh.triangles.push([first + a, first + b, first + c]);
                }
            }
        }
        mesh
    }

    /// A pose of the street in the map.
    pub fn pose_at(&self, x: f64, y: f64, heading: f64) -> Pose2 {
        self.map_from_street * Pose2::new(Vector2::new(x, y), heading)
    }

    /// The range image at a pose.
    pub fn scan(&self, pose: &Pose2) -> RangeImage {
        let lifted = self.ground.lift(pose, &SensorAttitude::default());
        self.scan_in_space(&lifted.unwrap().unwrap())
    }

    /// The scan of a sensor at a pose in space.
    pub fn scan_in_space(&self, map_from_lidar: &Pose3) -> RangeImage {
        let ranges = self.ranges(map_from_lidar, &self.model.directions());
        let limited = ranges
            .into_iter()
            .map(|range| {
                if self.model.accepts_range(range) {
                    range
                } else {
                    f32::INFINITY
                }
            })
            .collect();
        RangeImage::from_ranges(limited, &self.model)
    }

    /// Adds a box to the street; ground and tiles are unchanged.
    pub fn put_box(&mut self, x: (f32, f32), y: (f32, f32), height: f32) {
        self.boxes.push(footprint(x.0, x.1, y.0, y.1, height));
    }

    /// Raises the ground of the street by a step beyond x, both in the street frame [m].
    pub fn put_step(&mut self, x: f32, height_m: f32) {
        const FAR_M: f32 = 60.0;
        self.put_box((x, x + FAR_M), (-FAR_M, FAR_M), height_m);
        let mut mesh = TriangleMesh::default();
        for (x0, x1, z) in [(x - FAR_M, x, 0.0), (x, x + FAR_M, height_m)] {
            let corners = [(x0, -FAR_M), (x1, -FAR_M), (x1, FAR_M), (x0, FAR_M)];
            mesh.append(&TriangleMesh {
                vertices: corners
                    .map(|(x, y)| Vec3::new(x, y, GROUND_M as f32 + z))
                    .into(),
                triangles: vec![[0, 1, 2], [0, 2, 3]],
                ..TriangleMesh::default()
            });
        }
        self.ground = GroundMap::from_mesh(&mesh, |_| true, 0.25);
    }

    /// Poses of a sensor that is carried along the street over a step of 1.2 m at constant height, and the world with that step.
    pub fn carried_over_a_step() -> (Self, Vec<Pose3>) {
        let mut world = Self::street();
        world.put_step(10.0, 1.2);
        let pose = |frame: u32| Pose3::translation(6.0 + 0.27 * f64::from(frame), 0.3, 0.9);
        (world, (0..30).map(pose).collect())
    }

    fn ranges(&self, map_from_lidar: &Pose3, directions: &[Vec3]) -> Vec<f32> {
        let map_from_street = crate::geometry::pose3_from_pose2(&self.map_from_street, 0.0);
        let street_from_lidar = Rigid3f::from(&(map_from_street.inverse() * map_from_lidar));
        let origin = street_from_lidar.translation;
        directions
            .iter()
            .map(|&direction| {
                let ray = street_from_lidar.rotate(direction);
                let ground = (GROUND_M as f32 - origin.z) / ray.z;
                let nearest = self
                    .boxes
                    .iter()
                    .map(|corners| enter(corners, origin, ray))
                    .fold(f32::INFINITY, f32::min);
                if ground > 0.0 {
                    nearest.min(ground)
                } else {
                    nearest
                }
            })
            .collect()
    }
}

fn footprint(x0: f32, x1: f32, y0: f32, y1: f32, height: f32) -> (Vec3, Vec3) {
    let (a, b) = (
        Vec3::new(x0, y0, GROUND_M as f32),
        Vec3::new(x1, y1, GROUND_M as f32 + height),
    );
    (a.min(b), a.max(b))
}

/// Range at which a ray enters a box from outside; infinite if it does not.
fn enter(corners: &(Vec3, Vec3), origin: Vec3, ray: Vec3) -> f32 {
    let (a, b) = ((corners.0 - origin) / ray, (corners.1 - origin) / ray);
    let (enter, exit) = (a.min(b).max_element(), a.max(b).min_element());
    if enter > 0.0 && enter <= exit {
        enter
    } else {
        f32::INFINITY
    }
}

impl RangeRenderer for TestWorld {
    fn name(&self) -> String {
        "boxes".into()
    }

    fn render(&self, poses: &[Pose3], model: &LidarModel) -> Result<Vec<Vec<f32>>, RenderError> {
        let images = self.cast(poses, &model.directions(), f32::INFINITY)?;
        let limit = |range: f32| {
            if model.accepts_range(range) {
                range
            } else {
                f32::INFINITY
            }
        };
        Ok(images
            .into_iter()
            .map(|image| image.into_iter().map(limit).collect())
            .collect())
    }

    fn cast(
        &self,
        poses: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        use rayon::prelude::*;
        let limited = |range_m: f32| {
            if range_m < until_m {
                range_m
            } else {
                f32::INFINITY
            }
        };
        let ranges = |pose| {
            let ranges = self.ranges(pose, directions);
            ranges.into_iter().map(limited).collect()
        };
        Ok(poses.par_iter().map(ranges).collect())
    }

    fn compare_images(
        &self,
        poses: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let returns = || (0..measured.ranges.len()).filter(|&pixel| measured.has_return(pixel));
        let count = returns().count().max(1) as f64;
        let mean_cost = |rendered: Vec<f32>| {
            let cost = |pixel: usize| difference.cost(measured.ranges[pixel], rendered[pixel]);
            (returns().map(cost).map(f64::from).sum::<f64>() / count) as f32
        };
        let images = self.render(poses, &measured.model)?;
        Ok(images.into_iter().map(mean_cost).collect())
    }

    fn compare(
        &self,
        poses: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
        let mean = |ranges: Vec<f32>| {
            let costs = beams
                .iter()
                .zip(ranges)
                .map(|(beam, range)| difference.cost(beam.range_m, range));
            costs.sum::<f32>() / beams.len().max(1) as f32
        };
        Ok(self
            .cast(poses, &directions, f32::INFINITY)?
            .into_iter()
            .map(mean)
            .collect())
    }
}
