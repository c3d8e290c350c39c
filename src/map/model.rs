//! The map that a car is localized in.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::config::MapOptions;
use super::elevation::GroundMap;
use super::mapping_path::MappingPath;
use super::panorama::{PanoramaIndex, PanoramaRequest};
use super::ply::{self, PlyError};
use super::tiles::{self, TileGrid};
use super::vertex_ground::is_ground_color;
use crate::geometry::TriangleMesh;
use crate::memory::{self, MemoryError};
use crate::rendering::{RangeRenderer, RenderError, renderer};

/// Cell size of the elevation of the ground [m].
const GROUND_CELL_M: f64 = 0.5;

/// Cosine of the steepest slope that counts as ground in a map without ground colours.
const LEVEL_COSINE: f32 = 0.97;

/// Memory per triangle, in the mesh, the tiles and the renderer's hierarchy [bytes].
const TRIANGLE_BYTES: f64 = 300.0;

/// Memory per tile [bytes].
const TILE_BYTES: f64 = 1000.0;

/// A mesh prepared for localization, with its tile grid, elevation map, renderer and the path of the
/// mapping drive. All poses in it are `map_from_lidar`.
///
/// Clones share their data.
#[derive(Clone)]
pub struct Map {
    /// The surface, map frame.
    pub mesh: Arc<TriangleMesh>,
    /// Frame of the map and path of the mapping drive.
    pub path: Arc<MappingPath>,
    /// Division of the plane into tiles, and which of them the mapping drive visited.
    pub tiles: Arc<TileGrid>,
    /// Elevation of the ground.
    pub ground: Arc<GroundMap>,
    /// Renders the map from any pose.
    pub renderer: Arc<dyn RangeRenderer>,
    /// The panoramas of the last request.
    panoramas: Arc<Mutex<Option<CachedPanoramas>>>,
}

/// Rendered panoramas and the request that they answer.
type CachedPanoramas = (PanoramaRequest, Arc<PanoramaIndex>);

/// Why a map cannot be loaded or prepared.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum MapError {
    #[error(transparent)]
    Ply(#[from] PlyError),
    #[error(
        "none of the {triangles} triangles of the map has an area: no beam can hit it; build the map again"
    )]
    NoArea { triangles: usize },
    #[error("{} does not contain the path of its mapping drive; give the poses that it was built with (map_pose_file and map_calib_file)", path.display())]
    NoPath { path: PathBuf },
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl Map {
    /// Prepares a mesh in the map frame.
    ///
    /// The ground consists of the triangles with more red than blue, as `build-map` and range-mcl
    /// colour them; in a mesh without such triangles, of all nearly horizontal ones.
    pub fn new(
        mesh: TriangleMesh,
        path: MappingPath,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let triangles = mesh.triangles.len();
        if (0..triangles).all(|triangle| mesh.scaled_normal(triangle) == glam::Vec3::ZERO) {
            return Err(MapError::NoArea { triangles });
        }
        memory::require(
            "the map",
            triangles as f64 * TRIANGLE_BYTES
                + TileGrid::count(&path.map_from_lidar, &options.tiles) * TILE_BYTES,
            "choose a smaller map, or check the poses of its mapping drive",
        )?;
        let tiles = TileGrid::around(&path.map_from_lidar, &options.tiles);
        let parts = tiles::cut(&mesh, &tiles);
        let renderer = renderer(&parts, options.backend, options.max_poses)?;
        drop(parts);
        let ground = ground_of(&mesh);
        Ok(Self::from_parts(mesh, path, tiles, ground, renderer.into()))
    }

    /// Assembles a map from its parts.
    pub fn from_parts(
        mesh: TriangleMesh,
        path: MappingPath,
        tiles: TileGrid,
        ground: GroundMap,
        renderer: Arc<dyn RangeRenderer>,
    ) -> Self {
        Self {
            mesh: mesh.into(),
            path: path.into(),
            tiles: tiles.into(),
            ground: ground.into(),
            renderer,
            panoramas: Arc::default(),
        }
    }

    /// Reads a map that [`save`](Self::save) or `build-map` wrote. A map of range-mcl does not contain
    /// the path of its mapping drive: give [`ply::read`] and that path to [`new`](Self::new).
    pub fn load(path: &Path, options: &MapOptions) -> Result<Self, MapError> {
        let (mesh, mapping_path) = ply::read_map(path)?;
        let mapping_path = mapping_path.ok_or_else(|| MapError::NoPath {
            path: path.to_owned(),
        })?;
        Self::new(mesh, mapping_path, options)
    }

    /// Writes the map as a PLY file that is complete by itself; see [`ply::write`].
    pub fn save(&self, path: &Path) -> Result<(), MapError> {
        Ok(ply::write(path, &self.mesh, Some(&self.path))?)
    }

    /// Returns the panoramas of the cells in which place recognition searches. They are rendered if the
    /// last request was a different one.
    pub fn panoramas(&self, request: &PanoramaRequest) -> Result<Arc<PanoramaIndex>, RenderError> {
        let mut last = self.panoramas.lock().unwrap_or_else(|e| e.into_inner());
        match &*last {
            Some((made_for, index)) if made_for == request => Ok(index.clone()),
            _ => {
                request.require_memory(&self.tiles)?;
                let cells = request.cells(&self.path.map_from_lidar, &self.tiles);
                let index = PanoramaIndex::build(
                    &cells,
                    &*self.renderer,
                    &self.ground,
                    &self.tiles,
                    request,
                )?;
                let index = Arc::new(index);
                *last = Some((request.clone(), index.clone()));
                Ok(index)
            }
        }
    }
}

/// Builds the elevation map of the red triangles; in a mesh without any, of the nearly horizontal ones.
fn ground_of(mesh: &TriangleMesh) -> GroundMap {
    let is_red = |triangle: usize| {
        let mut vertices = mesh.triangles[triangle].iter();
        vertices.all(|&vertex| {
            mesh.colors
                .get(vertex as usize)
                .is_some_and(is_ground_color)
        })
    };
    if (0..mesh.triangles.len()).any(is_red) {
        return GroundMap::from_mesh(mesh, is_red, GROUND_CELL_M);
    }
    tracing::warn!("the map has no ground marked red; every nearly horizontal surface is used");
    let is_level = |triangle: usize| {
        let normal = mesh.scaled_normal(triangle).normalize_or_zero();
        normal.z.abs() > LEVEL_COSINE
    };
    GroundMap::from_mesh(mesh, is_level, GROUND_CELL_M)
}
