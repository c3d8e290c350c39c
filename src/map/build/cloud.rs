//! A map of a point cloud from elsewhere, without scans and poses.
//!
//! ```text
//! voxels  ->  normals  ->  ground by shape  ->  orientation  ->  per block: Poisson surface, trimming,
//!                                                               clipping, simplified ground
//! ```
//!
//! The plane is divided into square blocks, which are meshed with the points a few metres around them and
//! cut exactly at their borders, as local maps are.

use std::ops::ControlFlow;

use glam::{DVec3, Vec3};
use nalgebra::Point2;

use super::builder::{BuildError, BuildEvent};
use super::cloud_normals;
use super::local_map::{self, LocalMap, LocalMapConfig};
use super::plan::{Domain, LocalMapPlan, Ownership};
use crate::geometry::{Aabb, KdTree, PointCloud, Pose3};
use crate::map::ground::surface::GroundSurface;
use crate::memory::MemoryBudget;
use crate::validation::Validate as _;

/// Edge of a block [m].
const BLOCK_M: f32 = 50.0;

/// Width around a block whose points it is meshed with [m].
const OVERLAP_M: f32 = 5.0;

/// Smallest number of points of a block: fewer are outliers.
const MIN_POINTS: usize = 100;

/// Largest coordinate that single precision resolves to a centimetre or better [m].
const FARTHEST_M: f32 = 131_072.0;

/// Memory per point, in the cloud, the tree of its neighbours and the propagation [bytes].
const POINT_BYTES: f64 = 400.0;

/// A point cloud with oriented normals and ground, divided into blocks.
pub struct CloudPlan {
    /// Points of all blocks, map frame.
    pub cloud: PointCloud,
    config: LocalMapConfig,
    memory_budget: MemoryBudget,
    /// Centres of the blocks [m].
    centers: Vec<Point2<f32>>,
    ownership: Ownership,
}

impl CloudPlan {
    /// Prepares a cloud in the map frame [m]. Its normals are those given, one unit vector per point, else those of
    /// planes of neighbours. They face the nearest of the positions of the sensor [m]; without any, given ones that
    /// face up on the ground keep their orientation, and that of others is propagated from the ground. Of the
    /// configuration, what follows the preparation of scans is used, and the voxel size.
    pub fn new(
        points: &[Vec3],
        normals: Option<&[Vec3]>,
        sensor_positions: &[Vec3],
        config: &LocalMapConfig,
        memory_budget: MemoryBudget,
        on_event: &dyn Fn(BuildEvent) -> ControlFlow<()>,
    ) -> Result<Self, BuildError> {
        config.validate()?;
        let begin_stage = |name| notify(on_event, name);
        begin_stage("voxels")?;
        let remedy = "raise local_map.voxel_size_m, or divide the cloud";
        memory_budget.require(
            "the points of the cloud",
            points.len() as f64 * 60.0,
            remedy,
        )?;
        let mut cloud = voxels(points, normals, config.voxel_size_m)?;
        memory_budget.require(
            "the neighbours in the cloud",
            cloud.len() as f64 * POINT_BYTES,
            remedy,
        )?;

        begin_stage("normals")?;
        if normals.is_none() {
            let tree = KdTree::new(&cloud.positions);
            let estimated = cloud_normals::estimate(&cloud.positions, &tree);
            let or_zero = estimated.iter().map(|normal| normal.unwrap_or_default());
            cloud.normals = or_zero.collect();
            cloud.retain(|index| estimated[index].is_some());
        }

        begin_stage("ground")?;
        let ground = GroundSurface::of_points(&cloud.positions, &cloud.normals);
        if ground.area_m2() == 0.0 {
            return Err(BuildError::CloudWithoutGround {
                points: cloud.len(),
            });
        }
        let oriented = cloud.positions.iter().zip(&cloud.normals);
        let is_ground: Vec<bool> = oriented.map(|(&p, &n)| ground.has_point(p, n)).collect();
        cloud.ground = is_ground
            .iter()
            .map(|&is_ground| f32::from(u8::from(is_ground)))
            .collect();

        begin_stage("orientation")?;
        let is_oriented = normals.is_some() && face_up(&cloud.normals, &is_ground);
        if sensor_positions.is_empty() && !is_oriented {
            let tree = KdTree::new(&cloud.positions);
            cloud_normals::propagate(&cloud.positions, &mut cloud.normals, &is_ground, &tree);
        } else if !sensor_positions.is_empty() {
            cloud_normals::face_sensor(&cloud.positions, &mut cloud.normals, sensor_positions);
        }
        let centers = blocks(&cloud.positions);
        let poses: Vec<Pose3> = (centers.iter())
            .map(|center| Pose3::translation(center.x.into(), center.y.into(), 0.0))
            .collect();
        if poses.is_empty() {
            return Err(BuildError::Empty { scans: 0 });
        }
        let plan = |number: usize| LocalMapPlan {
            number,
            own: number..number + 1,
            used: number..number + 1,
        };
        let plans: Vec<LocalMapPlan> = (0..poses.len()).map(plan).collect();
        Ok(Self {
            cloud,
            config: config.clone(),
            memory_budget,
            centers,
            ownership: Ownership::new(&poses, &plans),
        })
    }

    /// Number of blocks.
    pub fn blocks(&self) -> usize {
        self.centers.len()
    }

    /// Builds the mesh of a block.
    pub fn build_block(
        &self,
        number: usize,
        on_event: &dyn Fn(BuildEvent) -> ControlFlow<()>,
    ) -> Result<LocalMap, BuildError> {
        let center = self.centers[number];
        let mut cloud = PointCloud::default();
        for (index, point) in self.cloud.positions.iter().enumerate() {
            let apart_m = (point.x - center.x).abs().max((point.y - center.y).abs());
            if apart_m <= 0.5 * BLOCK_M + OVERLAP_M {
                cloud.push(*point, self.cloud.normals[index], self.cloud.ground[index]);
            }
        }
        let begin_stage = |name| notify(on_event, name);
        let domain = Domain {
            number,
            origin: DVec3::ZERO,
            ownership: &self.ownership,
        };
        local_map::build_of_cloud(
            &cloud,
            domain,
            &self.config,
            self.memory_budget,
            begin_stage,
        )
    }
}

fn notify(
    on_event: &dyn Fn(BuildEvent) -> ControlFlow<()>,
    stage: &'static str,
) -> Result<(), BuildError> {
    match on_event(BuildEvent::Stage(stage)) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(BuildError::Interrupted),
    }
}

/// Whether almost all normals of the ground point up, as they do if all are oriented.
fn face_up(normals: &[Vec3], is_ground: &[bool]) -> bool {
    /// Share of them, at least (unitless).
    const MIN_UP: f32 = 0.95;
    let ground = || normals.iter().zip(is_ground).filter(|(_, is)| **is);
    let up = ground().filter(|(normal, _)| normal.z > 0.0).count();
    up as f32 >= MIN_UP * ground().count() as f32
}

/// The finite points, one per voxel, with the normals that are given.
fn voxels(
    points: &[Vec3],
    normals: Option<&[Vec3]>,
    voxel_m: f32,
) -> Result<PointCloud, BuildError> {
    let mut cloud = PointCloud::with_capacity(points.len());
    for (index, &point) in points.iter().enumerate() {
        if !point.is_finite() {
            continue;
        }
        if point.abs().max_element() > FARTHEST_M {
            return Err(BuildError::CloudTooFar { position: point });
        }
        let normal = normals.map_or(Vec3::ZERO, |normals| normals[index]);
        cloud.push(point, normal, 0.0);
    }
    if u32::try_from(cloud.len()).is_err() {
        return Err(BuildError::CloudTooLarge {
            points: cloud.len(),
        });
    }
    Ok(cloud.downsample(voxel_m))
}

/// Centres of the blocks with points, by row and column.
fn blocks(points: &[Vec3]) -> Vec<Point2<f32>> {
    let bounds = Aabb::from_points(points.iter().copied());
    let cell = |point: &Vec3| {
        ((*point - bounds.min) / BLOCK_M)
            .floor()
            .truncate()
            .as_ivec2()
    };
    let mut cells: Vec<[i32; 2]> = points.iter().map(|point| cell(point).to_array()).collect();
    cells.sort_unstable();
    let blocks = cells
        .chunk_by(|a, b| a == b)
        .filter(|cells| cells.len() >= MIN_POINTS);
    let center = |[column, row]: [i32; 2]| {
        let along = |cell: i32, min_m: f32| min_m + (cell as f32 + 0.5) * BLOCK_M;
        Point2::new(along(column, bounds.min.x), along(row, bounds.min.y))
    };
    blocks.map(|cells| center(cells[0])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::TriangleMesh;
    use crate::raycasting::{Hit, Scene};

    /// A street of 120 m between walls, which all beams from its middle hit.
    fn street() -> Vec<Vec3> {
        let mut points = Vec::new();
        for i in 0..1200 {
            let x = 0.1 * i as f32;
            for j in -60..=60 {
                points.push(Vec3::new(x, 0.1 * j as f32, 0.02 * x));
            }
            for j in 1..40 {
                let z = 0.02 * x + 0.1 * j as f32;
                points.extend([Vec3::new(x, -6.0, z), Vec3::new(x, 6.0, z)]);
            }
        }
        points
    }

    fn config() -> LocalMapConfig {
        let mut config = LocalMapConfig {
            min_density: 0.0,
            ..LocalMapConfig::default()
        };
        config.poisson.depth = Some(7);
        config.max_distance_m = 0.5;
        config
    }

    fn build(points: &[Vec3], sensor_positions: &[Vec3]) -> (CloudPlan, TriangleMesh) {
        let go_on = |_| ControlFlow::Continue(());
        let plan = CloudPlan::new(
            points,
            None,
            sensor_positions,
            &config(),
            MemoryBudget::default(),
            &go_on,
        )
        .unwrap();
        let mut mesh = TriangleMesh::default();
        for block in 0..plan.blocks() {
            mesh.append(&plan.build_block(block, &go_on).unwrap().mesh);
        }
        (plan, mesh)
    }

    #[test]
    fn a_street_is_meshed_in_blocks_without_gaps_and_its_ground_is_red() {
        let path: Vec<Vec3> = (0..12)
            .map(|i| Vec3::new(10.0 * i as f32, 0.0, 0.2 * i as f32 + 2.0))
            .collect();
        for sensor_positions in [&[][..], &path] {
            let (plan, mesh) = build(&street(), sensor_positions);
            assert_eq!(plan.blocks(), 3);
            let inwards = plan.cloud.positions.iter().zip(&plan.cloud.normals);
            let is_inwards = |(point, normal): &(&Vec3, &Vec3)| {
                let axis = Vec3::new(point.x, 0.0, 0.02 * point.x + 2.0);
                normal.dot(axis - **point) > 0.0
            };
            assert_eq!(inwards.filter(is_inwards).count(), plan.cloud.len());
            let scene = Scene::new(&mesh);
            let range_m = |sensor: Vec3, direction: Vec3| {
                let mut hits = [Hit::MISS];
                scene.cast(sensor, &[direction], &mut hits);
                hits[0].range_m
            };
            for x in (4..116).map(|x| x as f32 + 0.13) {
                let sensor = Vec3::new(x, 0.31, 0.02 * x + 1.5);
                let down_m = range_m(sensor, Vec3::NEG_Z);
                assert!((down_m - 1.5).abs() < 0.05, "{down_m} at {x}");
                let left_m = range_m(sensor, Vec3::Y);
                assert!((left_m - 5.69).abs() < 0.05, "{left_m} at {x}");
            }
            for (vertex, [red, _, blue]) in mesh.vertices.iter().zip(&mesh.colors) {
                if vertex.y.abs() < 5.0 {
                    assert!(red > blue, "{vertex}");
                } else if vertex.z > 0.02 * vertex.x + 1.0 {
                    assert!(blue > red, "{vertex}");
                }
            }
        }
    }

    #[test]
    fn given_normals_are_used_as_they_are_and_oriented_if_they_are_not() {
        let points = street();
        let slope = Vec3::new(-0.02, 0.0, 1.0).normalize();
        let inwards = |point: &Vec3| {
            if point.y.abs() < 5.9 || point.z < 0.02 * point.x + 0.05 {
                slope
            } else {
                Vec3::new(0.0, -point.y.signum(), 0.0)
            }
        };
        let given: Vec<Vec3> = points.iter().map(inwards).collect();
        let alternating = given.iter().enumerate();
        let alternating: Vec<Vec3> = alternating
            .map(|(index, &normal)| if index % 2 == 0 { normal } else { -normal })
            .collect();
        let config = LocalMapConfig {
            voxel_size_m: 0.05,
            ..config()
        };
        let go_on = |_| ControlFlow::Continue(());
        // Estimated ones would be those of neither surface at the edges.
        for normals in [&given, &alternating] {
            let plan = CloudPlan::new(
                &points,
                Some(normals),
                &[],
                &config,
                MemoryBudget::default(),
                &go_on,
            )
            .unwrap();
            assert_eq!(plan.cloud.len(), points.len());
            for (index, (point, normal)) in points.iter().zip(&plan.cloud.normals).enumerate() {
                assert!(normal.distance(given[index]) < 1e-5, "{point}: {normal}");
            }
        }
    }

    #[test]
    fn unusable_clouds_are_errors() {
        let error_of = |points: &[Vec3]| {
            let go_on = |_| ControlFlow::Continue(());
            CloudPlan::new(
                points,
                None,
                &[],
                &config(),
                MemoryBudget::default(),
                &go_on,
            )
            .err()
            .unwrap()
        };
        assert!(matches!(
            error_of(&[]),
            BuildError::CloudWithoutGround { points: 0 }
        ));
        let far = [Vec3::new(448_000.0, 5_400_000.0, 0.0)];
        assert!(matches!(error_of(&far), BuildError::CloudTooFar { .. }));
        let stop = |_| ControlFlow::Break(());
        let stopped = CloudPlan::new(
            &street(),
            None,
            &[],
            &config(),
            MemoryBudget::default(),
            &stop,
        );
        assert!(matches!(stopped.err().unwrap(), BuildError::Interrupted));
    }
}
