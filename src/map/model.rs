//! The map that a car is localized in.

use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::{Arc, Mutex};

use glam::Vec3;

use super::config::MapOptions;
use super::elevation::GroundMap;
use super::ground_surface::GroundSurface;
use super::mapping_path::MappingPath;
use super::mesh_error::MeshFileError;
use super::mesh_file;
use super::panorama::{PanoramaIndex, PanoramaRequest};
use super::ply;
use super::tiles::{self, TileGrid};
use super::vertex_ground::is_ground_color;
use crate::geometry::TriangleMesh;
use crate::memory::{self, MemoryError};
use crate::rendering::{RangeRenderer, RenderError, renderer};

/// Cell size of the elevation of the ground [m].
const GROUND_CELL_M: f64 = 0.5;

/// Extents between which a map in metres lies [m].
const PLAUSIBLE_M: RangeInclusive<f32> = 2.0..=20_000.0;

/// Memory per triangle while a map is prepared: mesh, tiles and hierarchies [bytes].
const TRIANGLE_BYTES: f64 = 150.0;

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
    File(#[from] MeshFileError),
    #[error(
        "none of the {triangles} triangles of the map has an area: no beam can hit it; build the map again"
    )]
    NoArea { triangles: usize },
    #[error(
        "the map has no ground: no near-horizontal surface of 4 m² or more lies below the others{}", hint(*.is_y_up)
    )]
    NoGround { is_y_up: bool },
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl Map {
    /// Prepares a mesh in the map frame. Its vertices are [snapped](TriangleMesh::snap) to a lattice of 0.49 mm.
    ///
    /// The ground consists of the triangles with more red than blue, as `build-map` and range-mcl
    /// colour them; in a mesh without such colours, it is found by its shape (see `ground_surface`).
    pub fn new(
        mut mesh: TriangleMesh,
        path: MappingPath,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        mesh.snap();
        let triangles = mesh.triangles.len();
        if (0..triangles).all(|triangle| mesh.scaled_normal(triangle) == glam::Vec3::ZERO) {
            return Err(MapError::NoArea { triangles });
        }
        let has_path = !path.map_from_lidar.is_empty();
        let bounds = mesh.bounds();
        let tiles = match has_path {
            true => TileGrid::count(&path.map_from_lidar, &options.tiles),
            false => TileGrid::count_of_mesh(&bounds, &options.tiles),
        };
        memory::require(
            "the map",
            triangles as f64 * TRIANGLE_BYTES + tiles * TILE_BYTES,
            "choose a smaller map, or check the poses of its mapping drive",
        )?;
        let ground = ground_of(&mesh, has_path)?;
        let tiles = match has_path {
            true => TileGrid::around(&path.map_from_lidar, &options.tiles),
            false => TileGrid::of_mesh(&mesh, &options.tiles),
        };
        let parts = tiles::cut(&mesh, &tiles);
        let renderer = renderer(&parts, options.backend, options.max_poses)?;
        drop(parts);
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

    /// Reads a map that [`save`](Self::save) or `build-map` wrote, or a mesh from elsewhere (PLY, OBJ or
    /// STL). A map of range-mcl does not contain the path of its mapping drive: give
    /// [`mesh_file::read`] and that path to [`new`](Self::new).
    pub fn load(path: &Path, options: &MapOptions) -> Result<Self, MapError> {
        let (mesh, mapping_path) = mesh_file::read(path)?;
        Self::new(mesh, mapping_path.unwrap_or_default(), options)
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
                request.require_memory(&self.path.map_from_lidar, &self.tiles)?;
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

/// Builds the elevation map of the red triangles; in a mesh without any, of the ground found by its shape.
///
/// Colours of a mesh without a mapping drive mark the ground only if they are between red and blue: others
/// are those of a photograph.
fn ground_of(mesh: &TriangleMesh, has_path: bool) -> Result<GroundMap, MapError> {
    let is_marked = has_path || mesh.colors.iter().all(|[_, green, _]| *green == 0);
    let is_red = |triangle: usize| {
        let mut vertices = mesh.triangles[triangle].iter();
        vertices.all(|&vertex| {
            mesh.colors
                .get(vertex as usize)
                .is_some_and(is_ground_color)
        })
    };
    if is_marked && (0..mesh.triangles.len()).any(is_red) {
        return Ok(GroundMap::from_mesh(mesh, is_red, GROUND_CELL_M));
    }
    warn_of_extent(mesh);
    let ground = GroundSurface::of_mesh(mesh);
    let area_m2 = ground.area_m2();
    let y_up_area_m2 = GroundSurface::of_mesh(&turned_from_y_up(mesh)).area_m2();
    let is_y_up = y_up_area_m2 > 2.0 * area_m2;
    if area_m2 == 0.0 {
        return Err(MapError::NoGround { is_y_up });
    }
    if is_y_up {
        tracing::warn!(
            "the map has {area_m2:.0} m² of ground, and would have {y_up_area_m2:.0} m²{}",
            hint(true)
        );
    }
    tracing::info!("the map has no ground marked red: {area_m2:.0} m² were found by their shape");
    let is_ground = |triangle| ground.has_triangle(mesh, triangle);
    Ok(GroundMap::from_mesh(mesh, is_ground, GROUND_CELL_M))
}

/// Warns of an extent that is not that of a map in metres.
fn warn_of_extent(mesh: &TriangleMesh) {
    let extent_m = mesh.bounds().size().max_element();
    if !PLAUSIBLE_M.contains(&extent_m) {
        tracing::warn!(
            "the map is {extent_m:.2} m across: if its unit is not the metre, scale it before exporting (from millimetres by 0.001)"
        );
    }
}

/// A mesh whose y points up with z up.
fn turned_from_y_up(mesh: &TriangleMesh) -> TriangleMesh {
    let turned = |&Vec3 { x, y, z }: &Vec3| Vec3::new(x, -z, y);
    TriangleMesh {
        vertices: mesh.vertices.iter().map(turned).collect(),
        triangles: mesh.triangles.clone(),
        ..TriangleMesh::default()
    }
}

/// What to do about a mesh that seems to have y up.
fn hint(is_y_up: bool) -> &'static str {
    match is_y_up {
        true => " if its y axis pointed up: export it with z up, or turn it by 90 degrees about x",
        false => "; the z axis of a map points up and its unit is the metre",
    }
}
