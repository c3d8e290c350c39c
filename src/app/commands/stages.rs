//! What several commands begin with: the map with its renderer, and a recording seen in it.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};

use super::{Context, input};
use crate::geometry::{Pose3, TriangleMesh, Vec3};
use crate::ground::{GroundClassifier, road_plane};
use crate::lidar::{LidarModel, RangeImage};
use crate::map::{GroundMap, Stance, TileConfig, TileGrid, ply, tiles};
use crate::recording::{Frame, MapFrame, RecordingError, Sequence};
use crate::rendering::{Batched, RangeRenderer, renderer};

/// Edge of the cells of the ground's elevation [m].
const GROUND_CELL_M: f64 = 0.5;

/// What localize and refine read: a map with the poses that it was built with, and a recording.
pub struct Inputs<'a> {
    pub map_file: &'a Path,
    pub map_pose_file: &'a Path,
    pub map_calib_file: &'a Path,
    pub scan_folder: &'a Path,
    pub pose_file: &'a Path,
    pub calib_file: &'a Path,
}

/// A file of the mapping drive, which every map needs.
pub fn mapping_file<'a>(key: &str, path: Option<&'a Path>) -> Result<&'a Path> {
    path.with_context(|| format!("{key} is null; give the file of the drive that was mapped"))
}

impl Inputs<'_> {
    /// Makes sure that all of them are there, before any work is done.
    pub fn require(&self) -> Result<()> {
        input::require_file("map_file", self.map_file)?;
        input::require_file("map_pose_file", self.map_pose_file)?;
        input::require_file("map_calib_file", self.map_calib_file)?;
        input::require_folder("scan_folder", self.scan_folder)?;
        input::require_file("pose_file", self.pose_file)?;
        input::require_file("calib_file", self.calib_file)
    }
}

/// A map ready to be looked at.
pub struct LoadedMap {
    /// All of it.
    pub mesh: TriangleMesh,
    /// Where it is.
    pub frame: MapFrame,
    /// The poses that it was built with, `map_from_lidar`.
    pub mapping_poses: Vec<Pose3>,
    /// Its tiles.
    pub grid: TileGrid,
    /// Its ground.
    pub ground: GroundMap,
    /// Shows it.
    pub renderer: Box<dyn RangeRenderer>,
}

impl LoadedMap {
    /// Reads a map and the poses that it was built with, and makes it ready on the backend that the
    /// user asked for, with at most `batch` poses rendered at once.
    pub fn load(inputs: &Inputs, batch: Option<usize>, context: &Context) -> Result<Self> {
        let Inputs {
            map_file,
            map_pose_file,
            map_calib_file,
            ..
        } = *inputs;
        let mesh = ply::read(map_file)?;
        let frame = MapFrame::read(map_pose_file, map_calib_file)
            .context("map_pose_file and map_calib_file say where the map is")?;
        let mapping_poses = crate::recording::poses::CameraPoses::read(map_pose_file)?
            .map_from_lidar(&frame.calibration);
        ensure!(
            (0..mesh.triangles.len())
                .any(|triangle| mesh.scaled_normal(triangle) != glam::Vec3::ZERO),
            "map_file is {}, and none of its {} triangles has an area: there is nothing that a beam could meet",
            map_file.display(),
            mesh.triangles.len()
        );
        let grid = TileGrid::around(&mapping_poses, &TileConfig::default());
        let ground = ground_of(&mesh);
        let mut renderer = renderer(&tiles::cut(&mesh, &grid), context.backend)?;
        if let Some(max_poses) = batch {
            renderer = Box::new(Batched {
                renderer,
                max_poses,
            });
        }
        tracing::info!(
            "map {}: {} triangles in {} tiles, rendered by {}",
            map_file.display(),
            mesh.triangles.len(),
            grid.len(),
            renderer.name()
        );
        Ok(Self {
            mesh,
            frame,
            mapping_poses,
            grid,
            ground,
            renderer,
        })
    }

    /// The selected frames of a recording with their poses in this map.
    pub fn sequence(
        &self,
        inputs: &Inputs,
        selection: &crate::recording::Selection,
    ) -> Result<Sequence> {
        let Inputs {
            scan_folder,
            pose_file,
            calib_file,
            ..
        } = *inputs;
        Ok(Sequence::open(scan_folder, pose_file, calib_file, selection)?.in_map(&self.frame))
    }
}

/// The ground of a map: its red triangles; in a map without colours, all that look up.
fn ground_of(mesh: &TriangleMesh) -> GroundMap {
    let is_red = |triangle: usize| {
        mesh.triangles[triangle].iter().all(|&vertex| {
            mesh.colors
                .get(vertex as usize)
                .is_some_and(|[red, _, blue]| red > blue)
        })
    };
    if (0..mesh.triangles.len()).any(is_red) {
        return GroundMap::from_mesh(mesh, is_red, GROUND_CELL_M);
    }
    tracing::warn!("no ground is marked in the map (red); taking every level surface for ground");
    let is_level =
        |triangle: usize| mesh.scaled_normal(triangle).normalize_or_zero().z.abs() > 0.97;
    GroundMap::from_mesh(mesh, is_level, GROUND_CELL_M)
}

/// Makes scans into observations.
pub struct Observer<'a> {
    /// Projection and limits.
    pub model: LidarModel,
    /// The own car, as in [`ScanSettings`](crate::map::scan_cloud::ScanSettings).
    pub own_car_m: [f32; 4],
    /// Tells the road.
    pub classifier: &'a dyn GroundClassifier,
}

impl Observer<'_> {
    /// Reads a frame without looking at it.
    pub fn read(&self, frame: &Frame) -> Result<Vec<Vec3>, RecordingError> {
        Ok(frame.read()?.points)
    }

    /// The points of a scan as an image, without the own car and what is out of range.
    pub fn image(&self, mut points: Vec<Vec3>) -> RangeImage {
        let [x_min, x_max, y_min, y_max] = self.own_car_m;
        points.retain(|p| {
            let on_own_car = p.x > x_min && p.x < x_max && p.y > y_min && p.y < y_max;
            !on_own_car
        });
        RangeImage::project(&points, &self.model)
    }

    /// How the sensor stands over the ground that it sees; `None` where it sees too little.
    pub fn stance(&self, image: &RangeImage) -> Option<Stance> {
        let seen: Vec<Vec3> = (0..image.ranges.len())
            .filter(|&index| image.has_return(index))
            .map(|index| image.points[index])
            .collect();
        let ground = self.classifier.ground_confidence(&seen);
        road_plane(&seen, &ground).map(|plane| Stance::from_plane(plane.up, plane.height_m))
    }
}
