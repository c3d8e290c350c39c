//! A local map: the mesh of the scans of a stretch of road.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::changes::{self, Changes};
use super::plan::Domain;
use super::scan_cloud::{PointCounts, ScanCloud, ScanPreparation};
use super::seam;
use super::vertex_ground::{self, GroundConfidences};
use super::visibility::{self, VisibilityConfig};
use crate::geometry::{KdTree, PointCloud, TriangleMesh};
use crate::lidar::{LidarModel, NormalConfig};
use crate::map::mesh_view::MeshView;
use crate::memory::MemoryBudget;
use crate::meshing::{self, MeshingError, PoissonConfig, Reconstruction};
use crate::sensor::Sensor;
use crate::validation::{InvalidValue, Validate, fraction, in_range, nested, require};

/// Longest edge of the simplified surface in cells: vertices of neighbouring cells are less than two
/// cells apart along an axis.
const CELLS_PER_EDGE: f32 = 2.0;

/// Size of the cells far from the path, relative to the distance from it (unitless). With half of it a map has up to twice as
/// many triangles and the same errors, with one and a half times it errors begin to grow; docs/method.md has the table.
const CELL_PER_DISTANCE: f32 = 1.0 / 64.0;

/// Processing of scans into a mesh.
///
/// Defaults: range-mcl's values where it has them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct LocalMapConfig {
    /// Normals of the points.
    pub normals: NormalConfig,
    /// Edge of the voxels for downsampling, in the lidar frame [m].
    #[default(0.1)]
    pub voxel_size_m: f32,
    /// Half length of the box around the sensor in which points are kept [m]; null: the range of the sensor.
    pub crop_x_m: Option<f32>,
    /// Half width of that box [m]; null: the range of the sensor.
    pub crop_y_m: Option<f32>,
    /// Half height of that box [m]; null: the range of the sensor.
    pub crop_z_m: Option<f32>,
    /// Surface reconstruction.
    pub poisson: PoissonConfig,
    /// Vertices below this quantile of density are removed (unitless).
    #[default(0.1)]
    pub min_density: f64,
    /// Surface farther than this from every point is extrapolated and removed [m].
    #[default(0.25)]
    pub max_distance_m: f32,
    /// Free-space votes.
    pub visibility: VisibilityConfig,
    /// A vertex with at least this ground confidence is ground (unitless).
    #[default(0.5)]
    pub ground_threshold: f32,
    /// Cell size of the simplification [m]: no new edge is longer than two cells; 0
    /// disables it.
    #[default(1.0)]
    pub simplify_resolution_m: f32,
    /// Smoothing iterations of the simplified ground.
    #[default(1)]
    pub smoothing_iterations: usize,
    /// Red, green and blue of confidence 1, each from 0 to 1; lower confidences are interpolated towards `rest_color`.
    #[default([1.0, 0.0, 0.0])]
    pub ground_color: [f64; 3],
    /// Red, green and blue of confidence 0, each from 0 to 1.
    #[default([0.0, 0.0, 1.0])]
    pub rest_color: [f64; 3],
}

/// Largest half extent of the crop box [m]: beyond the range of any sensor.
const MAX_CROP_M: f32 = 500.0;

impl LocalMapConfig {
    /// Half extent of the box around a sensor in which points are kept [m].
    pub(crate) fn crop_m(&self, sensor: &LidarModel) -> Vec3 {
        let extent_m = [self.crop_x_m, self.crop_y_m, self.crop_z_m];
        Vec3::from(extent_m.map(|m| m.unwrap_or(sensor.max_range)))
    }

    /// How scans of a sensor are prepared.
    pub(super) fn scan_preparation(&self, sensor: &Sensor) -> ScanPreparation {
        ScanPreparation {
            sensor: sensor.clone(),
            normals: self.normals,
            voxel_size_m: self.voxel_size_m,
            crop_m: self.crop_m(&sensor.range_image),
        }
    }
}

fn color(key: &str, rgb: [f64; 3]) -> Result<(), InvalidValue> {
    require(
        rgb.iter().all(|share| (0.0..=1.0).contains(share)),
        key,
        format_args!("{rgb:?}"),
        "red, green and blue must lie between 0 and 1",
    )
}

impl Validate for LocalMapConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("normals", &self.normals)?;
        in_range("voxel_size_m", self.voxel_size_m, 0.001..=100.0)?;
        let crop = [
            ("crop_x_m", self.crop_x_m),
            ("crop_y_m", self.crop_y_m),
            ("crop_z_m", self.crop_z_m),
        ];
        for (key, extent_m) in crop {
            if let Some(extent_m) = extent_m {
                in_range(key, extent_m, 0.001..=MAX_CROP_M)?;
            }
        }
        nested("poisson", &self.poisson)?;
        require(
            (0.0..1.0).contains(&self.min_density),
            "min_density",
            self.min_density,
            "it is the fraction of the vertices to remove, 0 or greater and less than 1",
        )?;
        in_range("max_distance_m", self.max_distance_m, 0.001..=1000.0)?;
        nested("visibility", &self.visibility)?;
        fraction("ground_threshold", self.ground_threshold)?;
        let resolution_m = self.simplify_resolution_m;
        require(
            resolution_m == 0.0 || (0.01..=100.0).contains(&resolution_m),
            "simplify_resolution_m",
            resolution_m,
            "it must lie between 0.01 and 100; 0 disables the simplification",
        )?;
        in_range("smoothing_iterations", self.smoothing_iterations, 0..=1000)?;
        color("ground_color", self.ground_color)?;
        color("rest_color", self.rest_color)
    }
}

/// Numbers of points and triangles at each step of a local map.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct LocalMapCounts {
    /// Scans meshed.
    pub scans: usize,
    /// Points, summed over the scans.
    pub points: PointCounts,
    /// Points removed as dynamic.
    pub dynamic_points: usize,
    /// Points without a normal, merged from opposite ones, which the reconstruction cannot use.
    pub unusable_points: usize,
    /// Edge of the finest octree cells [m].
    #[serde(default)]
    pub cell_m: f32,
    /// Triangles as reconstructed.
    pub reconstructed_triangles: usize,
    /// Triangles removed for low point density.
    pub sparse_triangles: usize,
    /// Triangles removed for their distance to all points.
    pub distant_triangles: usize,
    /// Triangles removed because beams pass through them.
    pub crossed_triangles: usize,
    /// Triangles saved by simplification.
    pub simplified_triangles: usize,
    /// Triangles in regions of neighbouring local maps.
    pub foreign_triangles: usize,
    /// Triangles that the older map has already, where there is one.
    #[serde(default)]
    pub known_triangles: usize,
    /// Triangles of the finished local map.
    pub triangles: usize,
    /// Triangles of the older map that are gone.
    #[serde(default)]
    pub gone_triangles: usize,
    /// Whether it had too few points to mesh.
    #[serde(default)]
    pub is_empty: bool,
}

/// A finished local map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LocalMap {
    /// The part of the surface that it owns; empty where there were too few points.
    pub mesh: TriangleMesh,
    /// Origin of the coordinates of its mesh in the map frame [m], not zero far away from that of the map.
    pub origin: DVec3,
    /// Triangles of the older map that are gone, ascending.
    pub gone: Vec<u32>,
    /// Numbers of points and triangles at each step.
    pub counts: LocalMapCounts,
    /// Median share of the points of a scan that are on surfaces of the next one, from 0 to 1; below
    /// 0.8 the poses are doubtful. `None` if no scans could be compared.
    pub agreement: Option<f32>,
    /// Key scans that agree with neither neighbour as well as the others do: their poses are doubtful.
    pub doubtful_scans: Vec<usize>,
}

impl LocalMap {
    /// Its mesh in the map frame, rounded to single precision.
    pub(crate) fn in_map(&self) -> TriangleMesh {
        let position = |vertex: &Vec3| (self.origin + vertex.as_dvec3()).as_vec3();
        TriangleMesh {
            vertices: self.mesh.vertices.iter().map(position).collect(),
            ..self.mesh.clone()
        }
    }
}

/// Meshes the prepared scans of a local map and colours the mesh by ground confidence; of an older map, it finds what
/// is gone, and keeps what is not in it. `begin_stage` is called at the start of each stage and may end the work with an
/// error.
pub(crate) fn build<E: From<MeshingError>>(
    scans: Vec<ScanCloud>,
    domain: Domain,
    older: Option<&dyn MeshView>,
    model: &LidarModel,
    config: &LocalMapConfig,
    budget: MemoryBudget,
    begin_stage: impl Fn(&'static str) -> Result<(), E>,
) -> Result<LocalMap, E> {
    let mut counts = LocalMapCounts {
        scans: scans.len(),
        ..LocalMapCounts::default()
    };
    for scan in &scans {
        counts.points.add(&scan.counts);
    }
    begin_stage("moving points")?;
    let cloud = static_cloud(&scans, model, config, &mut counts);

    begin_stage("surface")?;
    let resolution_m = resolution_around(&scans, config);
    let Some(mut mesh) = surface(&cloud, config, resolution_m, budget, &mut counts)? else {
        return Ok(LocalMap {
            counts,
            ..LocalMap::default()
        });
    };

    begin_stage("false surfaces")?;
    if config.visibility.enabled {
        counts.crossed_triangles =
            visibility::remove_crossed_triangles(&mut mesh, &scans, &config.visibility);
    }
    let mut changes = Changes::default();
    if let Some(older) = older {
        begin_stage("changes")?;
        changes = changes::compare(older, &mut mesh, &scans, domain, &config.visibility);
        counts.known_triangles = changes.known;
        counts.gone_triangles = changes.gone.len();
    }
    drop(scans);

    begin_stage("ground")?;
    Ok(LocalMap {
        gone: changes.gone,
        ..finish(mesh, &cloud, domain, config, counts)
    })
}

/// Meshes oriented points with ground confidences, as [`build`] does after the preparation of the scans.
pub(crate) fn build_of_cloud<E: From<MeshingError>>(
    cloud: &PointCloud,
    domain: Domain,
    config: &LocalMapConfig,
    budget: MemoryBudget,
    begin_stage: impl Fn(&'static str) -> Result<(), E>,
) -> Result<LocalMap, E> {
    let mut counts = LocalMapCounts::default();
    begin_stage("surface")?;
    let Some(mesh) = surface(cloud, config, |_| 0.0, budget, &mut counts)? else {
        return Ok(LocalMap {
            counts,
            ..LocalMap::default()
        });
    };
    begin_stage("ground")?;
    Ok(finish(mesh, cloud, domain, config, counts))
}

/// Returns the size of the cells at a position [m], by its horizontal distance from the nearest scan; 0, that of the finest
/// cells, where a depth is given.
fn resolution_around(
    scans: &[ScanCloud],
    config: &LocalMapConfig,
) -> impl Fn(Vec3) -> f32 + Sync + use<> {
    let level = |point: Vec3| Vec3::new(point.x, point.y, 0.0);
    let path: Vec<Vec3> = (scans.iter())
        .map(|scan| level(scan.map_from_lidar.translation))
        .collect();
    let path = config.poisson.depth.is_none().then(|| KdTree::new(&path));
    move |position| {
        let mut nearest = Vec::with_capacity(1);
        if let Some(path) = &path {
            path.nearest(level(position), 1, &mut nearest);
        }
        nearest
            .first()
            .map_or(0.0, |(squared, _)| CELL_PER_DISTANCE * squared.sqrt())
    }
}

/// Reconstructs and trims the surface; `None` where there are too few points.
fn surface(
    cloud: &PointCloud,
    config: &LocalMapConfig,
    resolution_m: impl Fn(Vec3) -> f32 + Sync,
    budget: MemoryBudget,
    counts: &mut LocalMapCounts,
) -> Result<Option<TriangleMesh>, MeshingError> {
    let Some(Reconstruction {
        mut mesh,
        mut densities,
        cell_m,
        ..
    }) = reconstruct(cloud, config, &resolution_m, budget, counts)?
    else {
        return Ok(None);
    };
    counts.reconstructed_triangles = mesh.triangles.len();
    // Densities relative to the cells at each vertex.
    (densities.par_iter_mut().zip(&mesh.vertices))
        .for_each(|(depth, &vertex)| *depth += (resolution_m(vertex) / cell_m).max(1.0).log2());
    counts.sparse_triangles = meshing::trim_by_density(&mut mesh, &densities, config.min_density);
    counts.distant_triangles = meshing::trim_by_distance(
        &mut mesh,
        &cloud.positions,
        config.max_distance_m,
        resolution_m,
    );
    Ok(Some(mesh))
}

/// Clips a mesh to what a local map owns, simplifies and colours it.
fn finish(
    mut mesh: TriangleMesh,
    cloud: &PointCloud,
    domain: Domain,
    config: &LocalMapConfig,
    mut counts: LocalMapCounts,
) -> LocalMap {
    let region = domain.region(&mesh.bounds());
    counts.foreign_triangles = seam::keep_own(&mut mesh, &region, domain.origin);
    meshing::split_fans(&mut mesh);
    let is_held = |mesh: &TriangleMesh| seam::on_border(&mesh.vertices, &region, domain.origin);
    simplify_and_colour(&mut mesh, cloud, is_held, config, &mut counts);
    mesh.snap();
    counts.triangles = mesh.triangles.len();
    LocalMap {
        mesh,
        origin: domain.origin,
        counts,
        ..LocalMap::default()
    }
}

/// Returns the static points of all scans.
fn static_cloud(
    scans: &[ScanCloud],
    model: &LidarModel,
    config: &LocalMapConfig,
    counts: &mut LocalMapCounts,
) -> PointCloud {
    let is_static = config
        .visibility
        .enabled
        .then(|| visibility::static_points(scans, model, &config.visibility));
    let mut all = PointCloud::default();
    for (number, scan) in scans.iter().enumerate() {
        let mut cloud = scan.cloud.clone();
        let is_kept = |index: usize| is_static.as_ref().is_none_or(|all| all[number][index]);
        if is_static.is_some() {
            cloud.retain(is_kept);
            counts.dynamic_points += scan.cloud.len() - cloud.len();
        }
        all.append(cloud);
    }
    all
}

/// Reconstructs the surface; `None` where there are too few points, which leaves a hole in the map.
fn reconstruct(
    cloud: &PointCloud,
    config: &LocalMapConfig,
    resolution_m: impl Fn(Vec3) -> f32 + Sync,
    budget: MemoryBudget,
    counts: &mut LocalMapCounts,
) -> Result<Option<Reconstruction>, MeshingError> {
    match meshing::reconstruct_resolved(cloud, &config.poisson, resolution_m, budget) {
        Ok(surface) => {
            counts.unusable_points = surface.dropped_points;
            counts.cell_m = surface.cell_m;
            Ok(Some(surface))
        }
        Err(MeshingError::TooFewPoints { usable, given, .. }) => {
            counts.unusable_points = given - usable;
            counts.is_empty = true;
            Ok(None)
        }
        Err(other) => Err(other),
    }
}

/// Simplifies the ground and the rest, and colours the mesh by ground confidence. Held vertices, and those between ground and
/// rest, stay.
fn simplify_and_colour(
    mesh: &mut TriangleMesh,
    cloud: &PointCloud,
    is_held: impl Fn(&TriangleMesh) -> Vec<bool>,
    config: &LocalMapConfig,
    counts: &mut LocalMapCounts,
) {
    let cell_m = config.max_distance_m.max(2.0 * config.voxel_size_m);
    let confidences = GroundConfidences::new(cloud, cell_m, CELL_PER_DISTANCE * MAX_CROP_M);
    let threshold = config.ground_threshold;
    let before = mesh.triangles.len();
    if config.simplify_resolution_m > 0.0 {
        let edge_m = CELLS_PER_EDGE * config.simplify_resolution_m;
        for (of_ground, smoothing_iterations) in [(false, 0), (true, config.smoothing_iterations)] {
            let vertices = confidences.of(&mesh.vertices);
            let is_ground = vertex_ground::ground_triangles(mesh, &vertices, threshold);
            let is_part: Vec<bool> = is_ground.iter().map(|&it| it == of_ground).collect();
            *mesh = meshing::simplify(mesh, &is_part, &is_held(mesh), edge_m, smoothing_iterations);
        }
    }
    counts.simplified_triangles = before.saturating_sub(mesh.triangles.len());
    let byte = |share: f64| (255.0 * share).round() as u8;
    let (rest, ground) = (config.rest_color.map(byte), config.ground_color.map(byte));
    let color = |&confidence: &f32| vertex_ground::color(confidence, threshold, rest, ground);
    mesh.colors = confidences.of(&mesh.vertices).iter().map(color).collect();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Pose3, Rigid3f};

    /// A floor of 4 m x 4 m, of which some points have no normal.
    fn floor(without_normal: usize) -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in 0..1600 {
            let normal = if i < without_normal {
                Vec3::ZERO
            } else {
                Vec3::Z
            };
            let corner = Vec3::new((i % 40) as f32, (i / 40) as f32, 0.0);
            cloud.push(0.1 * corner, normal, 1.0);
        }
        cloud
    }

    fn unusable(cloud: &PointCloud) -> (bool, usize) {
        let mut counts = LocalMapCounts::default();
        let settings = LocalMapConfig {
            poisson: PoissonConfig {
                depth: Some(5),
                ..PoissonConfig::default()
            },
            ..LocalMapConfig::default()
        };
        let budget = MemoryBudget::default();
        let surface = reconstruct(cloud, &settings, |_| 0.0, budget, &mut counts).unwrap();
        assert_eq!(surface.is_none(), counts.is_empty);
        (counts.is_empty, counts.unusable_points)
    }

    /// A scan with a point at 5 m in its own free space, and two points behind that.
    fn scan() -> ScanCloud {
        let mut cloud = PointCloud::default();
        for range_m in [5.0, 10.0, 20.0] {
            cloud.push(range_m * Vec3::X, Vec3::NEG_X, 0.0);
        }
        ScanCloud {
            map_from_lidar: Rigid3f::from(&Pose3::identity()),
            cloud,
            returns: Vec::new(),
            free_range_m: vec![7.0; LidarModel::default().len()],
            counts: PointCounts::default(),
        }
    }

    #[test]
    fn points_behind_free_space_are_left_out_and_counted() {
        let scans = [scan(), scan(), scan()];
        let mut counts = LocalMapCounts::default();
        let config = LocalMapConfig::default();
        let cloud = static_cloud(&scans, &LidarModel::default(), &config, &mut counts);
        assert_eq!((cloud.len(), counts.dynamic_points), (6, 3));
    }

    #[test]
    fn points_without_normals_are_counted_also_where_too_few_points_remain() {
        assert_eq!(unusable(&floor(0)), (false, 0));
        assert_eq!(unusable(&floor(7)), (false, 7));
        assert_eq!(unusable(&floor(1597)), (true, 1597));
    }
}
