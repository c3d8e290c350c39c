//! A local map: the scans of a stretch of road turned into a mesh.

use blake3::Hash;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::confidence::{self, ConfidenceConfig};
use super::plan::{LocalMapPlan, Ownership};
use super::scan_cloud::{PointCounts, ScanCloud, ScanSettings};
use super::seam;
use super::vertex_ground;
use super::visibility::{self, VisibilityConfig};
use crate::geometry::{PointCloud, TriangleMesh};
use crate::ground::GroundClassifier;
use crate::meshing::{self, MeshingError, PoissonConfig, Reconstruction};
use crate::recording::{Frame, RecordingError, velodyne};
use crate::validation::{
    InvalidValue, Validate, fraction, nested, not_negative, positive, require,
};

/// Vertices that are gathered in neighbouring cells are less than two cells apart along an axis.
const CELLS_PER_EDGE: f32 = 2.0;

/// How scans become a mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalMapSettings {
    /// What of a scan is used.
    pub scan: ScanSettings,
    /// How much each point counts.
    pub confidence: ConfidenceConfig,
    /// Surface reconstruction.
    pub poisson: PoissonConfig,
    /// Vertices below this quantile of density are dropped (unitless).
    pub min_density: f64,
    /// Surface farther than this from every point is invented and dropped [m].
    pub max_distance_m: f32,
    /// Free-space votes.
    pub visibility: VisibilityConfig,
    /// A vertex is ground from this confidence on (unitless).
    pub ground_threshold: f32,
    /// The ground is simplified as if its vertices were gathered in cells of this edge [m]: no new
    /// edge is longer than two of them; 0 leaves the ground as it is.
    pub simplify_resolution_m: f32,
    /// Rounds of smoothing of the simplified ground.
    pub smoothing_iterations: usize,
    /// Colour of what is surely ground; the less sure, the nearer to `rest_color`.
    pub ground_color: [u8; 3],
    /// Colour of what surely is none.
    pub rest_color: [u8; 3],
}

impl Default for LocalMapSettings {
    /// range-mcl's values where it has them.
    fn default() -> Self {
        Self {
            scan: ScanSettings::default(),
            confidence: ConfidenceConfig::default(),
            poisson: PoissonConfig::default(),
            min_density: 0.1,
            max_distance_m: 0.25,
            visibility: VisibilityConfig::default(),
            ground_threshold: 0.5,
            simplify_resolution_m: 1.0,
            smoothing_iterations: 1,
            ground_color: [255, 0, 0],
            rest_color: [0, 0, 255],
        }
    }
}

impl Validate for LocalMapSettings {
    /// With the keys of `build_map.yml`.
    fn validate(&self) -> Result<(), InvalidValue> {
        self.scan.validate()?;
        nested("confidence", &self.confidence)?;
        nested("poisson", &self.poisson)?;
        require(
            (0.0..1.0).contains(&self.min_density),
            "min_density",
            self.min_density,
            "it is the fraction of the vertices to remove, 0 or greater and less than 1",
        )?;
        positive("max_distance_m", self.max_distance_m)?;
        nested("visibility", &self.visibility)?;
        fraction("ground_threshold", self.ground_threshold)?;
        not_negative("simplify_resolution", self.simplify_resolution_m)
    }
}

/// What happened to the points and triangles of a local map.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LocalMapCounts {
    /// Scans meshed.
    pub scans: usize,
    /// Points, summed over the scans.
    pub points: PointCounts,
    /// Points that moved.
    pub dynamic_points: usize,
    /// Points that the reconstruction could not use: merged from opposite normals, they have none.
    pub unusable_points: usize,
    /// Triangles as reconstructed.
    pub reconstructed_triangles: usize,
    /// Triangles dropped for few points around them.
    pub sparse_triangles: usize,
    /// Triangles dropped for distance to all points.
    pub distant_triangles: usize,
    /// Triangles that beams pass through.
    pub crossed_triangles: usize,
    /// Triangles saved by simplifying the ground.
    pub simplified_triangles: usize,
    /// Triangles left to neighbouring local maps.
    pub foreign_triangles: usize,
    /// Triangles of the finished local map.
    pub triangles: usize,
    /// Whether it was left out because it had too few points to mesh.
    #[serde(default)]
    pub is_empty: bool,
}

/// A finished local map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LocalMap {
    /// What it owns of the surface; empty where there were too few points.
    pub mesh: TriangleMesh,
    /// What happened to its points and triangles.
    pub counts: LocalMapCounts,
    /// Hash of the scans that it was made of, see [`scans_hash`].
    pub scans_hash: String,
}

/// Who watches a build and may stop it.
#[derive(Clone, Copy)]
pub struct Watcher<'a> {
    /// Called after each scan that was read.
    pub scan_done: &'a (dyn Fn() + Sync),
    /// Called with the name of each stage that begins.
    pub stage: &'a (dyn Fn(&'static str) + Sync),
    /// Asked between steps; the build ends with [`LocalMapError::Interrupted`] once it says so.
    pub cancelled: &'a (dyn Fn() -> bool + Sync),
}

impl Watcher<'_> {
    fn check(&self) -> Result<(), LocalMapError> {
        if (self.cancelled)() {
            Err(LocalMapError::Interrupted)
        } else {
            Ok(())
        }
    }

    fn begin(&self, stage: &'static str) -> Result<(), LocalMapError> {
        (self.stage)(stage);
        self.check()
    }
}

/// Why a local map could not be made.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum LocalMapError {
    #[error("interrupted")]
    Interrupted,
    #[error(transparent)]
    Scan(#[from] RecordingError),
    #[error("local map {number} (frames {first} to {last}): {source}")]
    Meshing {
        number: usize,
        first: usize,
        last: usize,
        source: MeshingError,
    },
}

/// Reads, cleans, meshes and colours the scans of one local map.
pub fn build(
    frames: &[Frame],
    plan: &LocalMapPlan,
    ownership: &Ownership,
    settings: &LocalMapSettings,
    classifier: &dyn GroundClassifier,
    watcher: &Watcher,
) -> Result<LocalMap, LocalMapError> {
    let mut counts = LocalMapCounts::default();
    watcher.begin("scans")?;
    let scans = prepare_scans(&frames[plan.used.clone()], settings, classifier, watcher)?;
    counts.scans = scans.len();
    scans
        .iter()
        .for_each(|scan| counts.points.add(&scan.counts));
    let scans_hash = joint_hash(scans.iter().map(|scan| scan.hash));

    watcher.begin("moving points")?;
    let (cloud, weights) = static_cloud(&scans, settings, &mut counts);

    watcher.begin("surface")?;
    let surface = reconstruct(&cloud, weights.as_deref(), settings, &mut counts);
    let surface = surface.map_err(|source| LocalMapError::Meshing {
        number: plan.number,
        first: frames[plan.own.start].number,
        last: frames[plan.own.end - 1].number,
        source,
    })?;
    let Some(mut surface) = surface else {
        let mesh = TriangleMesh::default();
        return Ok(LocalMap {
            mesh,
            counts,
            scans_hash,
        });
    };
    counts.reconstructed_triangles = surface.mesh.triangles.len();
    counts.sparse_triangles = meshing::trim_by_density(&mut surface, settings.min_density);
    let mut mesh = surface.mesh;
    counts.distant_triangles =
        meshing::trim_by_distance(&mut mesh, &cloud.positions, settings.max_distance_m);

    watcher.begin("false surfaces")?;
    if settings.visibility.enabled {
        counts.crossed_triangles =
            visibility::remove_crossed_triangles(&mut mesh, &scans, &settings.visibility);
    }
    drop(scans);

    watcher.begin("ground")?;
    counts.foreign_triangles = seam::keep_own(&mut mesh, ownership, plan.number);
    meshing::split_fans(&mut mesh);
    let is_held = seam::on_border(&mesh.vertices, ownership, plan.number);
    finish_ground(&mut mesh, &cloud, &is_held, settings, &mut counts);
    counts.triangles = mesh.triangles.len();
    Ok(LocalMap {
        mesh,
        counts,
        scans_hash,
    })
}

/// The hash that a local map has if it is made of these frames as they lie on disk now.
pub fn scans_hash(frames: &[Frame], plan: &LocalMapPlan) -> Result<String, RecordingError> {
    let hashes: Vec<Hash> = frames[plan.used.clone()]
        .par_iter()
        .map(|frame| velodyne::hash_of_scan(&frame.scan_path))
        .collect::<Result<_, _>>()?;
    Ok(joint_hash(hashes))
}

fn joint_hash(hashes: impl IntoIterator<Item = Hash>) -> String {
    let mut hasher = blake3::Hasher::new();
    for hash in hashes {
        hasher.update(hash.as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}

fn prepare_scans(
    frames: &[Frame],
    settings: &LocalMapSettings,
    classifier: &dyn GroundClassifier,
    watcher: &Watcher,
) -> Result<Vec<ScanCloud>, LocalMapError> {
    frames
        .par_iter()
        .map(|frame| {
            watcher.check()?;
            let scan = ScanCloud::prepare(frame, &settings.scan, classifier)?;
            (watcher.scan_done)();
            Ok(scan)
        })
        .collect()
}

/// All points that did not move, of all scans, and how much they count.
fn static_cloud(
    scans: &[ScanCloud],
    settings: &LocalMapSettings,
    counts: &mut LocalMapCounts,
) -> (PointCloud, Option<Vec<f32>>) {
    let model = &settings.scan.range_image;
    let is_static = settings
        .visibility
        .enabled
        .then(|| visibility::static_points(scans, model, &settings.visibility));
    let mut all = PointCloud::default();
    let mut weights: Option<Vec<f32>> = None;
    for (number, scan) in scans.iter().enumerate() {
        let mut cloud = scan.cloud.clone();
        let is_kept = |index: usize| is_static.as_ref().is_none_or(|all| all[number][index]);
        if let Some(confidences) = settings.confidence.of(scan) {
            let kept = confidences
                .into_iter()
                .enumerate()
                .filter(|(index, _)| is_kept(*index));
            weights
                .get_or_insert_default()
                .extend(kept.map(|(_, confidence)| confidence));
        }
        if is_static.is_some() {
            cloud.retain(is_kept);
            counts.dynamic_points += scan.cloud.len() - cloud.len();
        }
        all.append(cloud);
    }
    if let Some(weights) = &mut weights {
        confidence::balance(weights);
    }
    (all, weights)
}

/// The surface through the points; `None` where there are too few, which is a hole in the map, and
/// no reason to have no map.
fn reconstruct(
    cloud: &PointCloud,
    weights: Option<&[f32]>,
    settings: &LocalMapSettings,
    counts: &mut LocalMapCounts,
) -> Result<Option<Reconstruction>, MeshingError> {
    match meshing::reconstruct(cloud, weights, &settings.poisson) {
        Ok(surface) => {
            counts.unusable_points = surface.dropped_points;
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

/// Colours the mesh by confidence and simplifies what is ground, apart from the vertices that are
/// held.
fn finish_ground(
    mesh: &mut TriangleMesh,
    cloud: &PointCloud,
    is_held: &[bool],
    settings: &LocalMapSettings,
    counts: &mut LocalMapCounts,
) {
    let cell_m = settings
        .max_distance_m
        .max(2.0 * settings.scan.voxel_size_m);
    let confidences = vertex_ground::mean_confidences(&mesh.vertices, cloud, cell_m);
    let threshold = settings.ground_threshold;
    let (rest, ground) = (settings.rest_color, settings.ground_color);
    mesh.colors = confidences
        .iter()
        .map(|&confidence| vertex_ground::color(confidence, threshold, rest, ground))
        .collect();
    if settings.simplify_resolution_m <= 0.0 {
        return;
    }
    let before = mesh.triangles.len();
    *mesh = meshing::simplify_ground(
        mesh,
        &vertex_ground::ground_triangles(mesh, &confidences, threshold),
        is_held,
        CELLS_PER_EDGE * settings.simplify_resolution_m,
        settings.smoothing_iterations,
    );
    counts.simplified_triangles = before.saturating_sub(mesh.triangles.len());
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

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
            let place = Vec3::new((i % 40) as f32, (i / 40) as f32, 0.0);
            cloud.push(0.1 * place, normal, 1.0);
        }
        cloud
    }

    fn unusable(cloud: &PointCloud) -> (bool, usize) {
        let mut counts = LocalMapCounts::default();
        let settings = LocalMapSettings {
            poisson: PoissonConfig {
                depth: 5,
                ..PoissonConfig::default()
            },
            ..LocalMapSettings::default()
        };
        let surface = reconstruct(cloud, None, &settings, &mut counts).unwrap();
        assert_eq!(surface.is_none(), counts.is_empty);
        (counts.is_empty, counts.unusable_points)
    }

    /// Sees a point at 5 m, through which its own beams pass, and two behind it.
    fn scan() -> ScanCloud {
        let mut cloud = PointCloud::default();
        for range_m in [5.0, 10.0, 20.0] {
            cloud.push(range_m * Vec3::X, Vec3::NEG_X, 0.0);
        }
        ScanCloud {
            map_from_lidar: Rigid3f::from(&Pose3::identity()),
            cloud,
            returns: Vec::new(),
            free_range_m: vec![7.0; ScanSettings::default().range_image.len()],
            hash: blake3::hash(&[]),
            counts: PointCounts::default(),
        }
    }

    #[test]
    fn weights_go_with_the_points_that_did_not_move() {
        let scans = [scan(), scan(), scan()];
        let mut settings = LocalMapSettings::default();
        let mut counts = LocalMapCounts::default();
        let (_, weights) = static_cloud(&scans, &settings, &mut counts);
        assert_eq!(weights, None);

        settings.confidence.half_range_m = Some(10.0);
        counts.dynamic_points = 0;
        let (cloud, weights) = static_cloud(&scans, &settings, &mut counts);
        assert_eq!((cloud.len(), counts.dynamic_points), (6, 3));
        // 1/2 and 1/5 with a mean of 1.
        let expected = [10.0 / 7.0, 4.0 / 7.0].repeat(3);
        for (weight, expected) in weights.unwrap().into_iter().zip(&expected) {
            assert!(
                (weight - expected).abs() < 1e-5_f32,
                "{weight} for {expected}"
            );
        }
    }

    #[test]
    fn points_that_the_reconstruction_cannot_use_are_counted_also_where_nothing_is_left() {
        assert_eq!(unusable(&floor(0)), (false, 0));
        assert_eq!(unusable(&floor(7)), (false, 7));
        assert_eq!(unusable(&floor(1597)), (true, 1597));
    }
}
