//! The map that a car is localized in.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use glam::{DVec3, Vec3};
use nalgebra::Point2;

use super::build::config::MapOptions;
use super::build::vertex_ground::{GROUND, REST};
use super::files::mapped_ply::MappedPly;
use super::files::mapping_path::MappingPath;
use super::files::mesh_error::{MeshFileError, MeshFileProblem};
use super::files::mesh_file;
use super::files::ply;
use super::ground::elevation::GroundMap;
use super::ground::heights::{GROUND_CELL_M, GroundTriangles};
use super::ground::surface::GroundSurface;
use super::mesh_view::MeshView;
use super::places::panorama::{PanoramaIndex, PanoramaRequest};
use super::places::panorama_file::Panoramas;
use super::tiles::cache::MapCache;
use super::tiles::contents::{mark_used, remove_unused};
use super::tiles::file::Source;
use super::tiles::grid::{self, TileConfig, TileGrid, TileIndex};
use super::tiles::store::TileStore;
use super::unit::unit_doubt;
use crate::geometry::mesh::on_lattice;
use crate::geometry::{Aabb, TriangleMesh};
use crate::memory::{MemoryBudget, MemoryError};
use crate::raycasting::Scene;
use crate::rendering::selection::{self, BackendChoice};
use crate::rendering::{RangeRenderer, RenderError};

/// Memory per triangle while a mapped file is divided into tiles: its index, as one of a tile and of the ground [bytes].
const DIVIDED_BYTES: f64 = 16.0;

/// What to do about a map that needs too much memory.
const SMALLER_MAP: &str = "build a smaller map with a larger local_map.simplify_resolution_m";

/// What to do about a mesh whose y axis points up.
const TURN: &str = "export it with z up, or turn it by 90 degrees about x";

/// Memory per triangle while a map is prepared: mesh, ground, tiles and hierarchies [bytes].
const TRIANGLE_BYTES: f64 = 150.0;

/// A mesh prepared for localization, with its tile grid, elevation map, renderer and the path of the
/// mapping drive. All poses in it are `map_from_lidar`.
///
/// A map that is [loaded](Self::load) keeps in memory what is around the car. Clones share their data.
#[derive(Clone)]
pub struct Map {
    surface: Surface,
    /// Frame of the map and path of the mapping drive.
    pub path: Arc<MappingPath>,
    /// Division of the plane into tiles, and which of them the mapping drive visited.
    pub tiles: Arc<TileGrid>,
    /// Elevation of the ground.
    pub ground: Arc<GroundMap>,
    /// Renders the map from any pose.
    pub renderer: Arc<dyn RangeRenderer>,
    /// Memory for panoramas, and of drives that are found in the map.
    pub(crate) memory_budget: MemoryBudget,
    /// The panoramas of the last request.
    panoramas: Arc<Mutex<Option<CachedPanoramas>>>,
}

/// Where the triangles of a map are.
#[derive(Clone)]
enum Surface {
    Memory(Arc<TriangleMesh>),
    Disk {
        mesh_file: PathBuf,
        tiles: Arc<TileStore>,
    },
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
        "the map has no ground: no near-horizontal surface of {smallest_m2:.0} m² or more lies below the others; {}",
        y_up_m2.map_or_else(
            || "the z axis of a map points up and its unit is the metre".to_owned(),
            |area_m2| format!("if its y axis pointed up, it would have {area_m2:.0} m²: {TURN}"),
        )
    )]
    NoGround {
        smallest_m2: f64,
        y_up_m2: Option<f64>,
    },
    #[error("the map {} has changed while it was read; load it again", file.display())]
    Changed { file: PathBuf },
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
    ///
    /// # Errors
    /// No triangle has an area, there is no ground, memory does not suffice, or the graphics card cannot be used.
    pub fn new(
        mut mesh: TriangleMesh,
        path: MappingPath,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let is_ground = prepare(&mut mesh, &path, options.memory_budget)?;
        let choice = selection::choose(options.backend, options.method)?;
        Self::in_memory(mesh, path, &is_ground, options, &choice)
    }

    fn in_memory(
        mesh: TriangleMesh,
        path: MappingPath,
        is_ground: &[bool],
        options: &MapOptions,
        choice: &BackendChoice,
    ) -> Result<Self, MapError> {
        let (indices, parts): (Vec<TileIndex>, Vec<TriangleMesh>) =
            grid::cut(&mesh, options.tiles.side_m).into_iter().unzip();
        let boxes = std::iter::zip(indices, parts.iter().map(TriangleMesh::bounds));
        let tiles = grid_of(&path, boxes, &options.tiles);
        let mut scene = Scene::of_tiles(&parts);
        scene.has_fronts = path.has_fronts();
        let renderer = choice.renderer(Arc::new(scene), options.memory_budget)?;
        let ground = (0..mesh.triangles.len()).filter(|&triangle| is_ground[triangle]);
        let corners = ground.map(|triangle| MeshView::corners(&mesh, triangle));
        let ground = GroundTriangles::new(corners.collect(), GROUND_CELL_M);
        let ground = GroundMap::over(Arc::new(ground), GROUND_CELL_M);
        Ok(Self {
            memory_budget: options.memory_budget,
            ..Self::from_parts(mesh, path, tiles, ground, renderer)
        })
    }

    /// Assembles a map from its parts.
    pub(crate) fn from_parts(
        mesh: TriangleMesh,
        path: MappingPath,
        tiles: TileGrid,
        ground: GroundMap,
        renderer: Arc<dyn RangeRenderer>,
    ) -> Self {
        Self {
            surface: Surface::Memory(mesh.into()),
            path: path.into(),
            tiles: tiles.into(),
            ground: ground.into(),
            renderer,
            memory_budget: MemoryBudget::default(),
            panoramas: Arc::default(),
        }
    }

    /// Opens a map that [`save`](Self::save) or `build-map` wrote, or a mesh from elsewhere (PLY, OBJ or
    /// STL).
    ///
    /// With a [cache](MapOptions::cache), the mesh is divided into tiles on first use, and when it has changed; of
    /// these, those around the car are kept in memory, and on a graphics card. Without one, and where that next to the
    /// map cannot be written, which is a warning, all of the map is, and nothing is written; nor is it of a few triangles
    /// that cover so much ground that their tiles would be larger than they are.
    ///
    /// # Errors
    /// The file cannot be read, or the folder that is given for the cache not written; else as [`new`](Self::new).
    pub fn load(mesh_file: &Path, options: &MapOptions) -> Result<Self, MapError> {
        Self::load_with_path(mesh_file, None, options)
    }

    /// Opens a map like [`load`](Self::load), with the path of its mapping drive if it is not in the file: maps of
    /// range-mcl do not contain theirs.
    pub(crate) fn load_with_path(
        mesh_file: &Path,
        given: Option<MappingPath>,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let choice = selection::choose(options.backend, options.method)?;
        let cache = options.cache.folder_of(mesh_file);
        let mut cache = match &cache {
            Some(folder) => {
                let side_m = options.tiles.side_m;
                let of_file = |error| MeshFileProblem::Read(error).of(mesh_file);
                let opened = TileStore::open(mesh_file, folder, given.is_some(), side_m);
                if let Some(store) = opened.map_err(of_file)? {
                    return Self::on_disk((mesh_file, store), given, options, &choice);
                }
                // Of the file before it is read: what is read is not of an earlier file.
                let source = TileStore::source(mesh_file, given.is_some(), side_m);
                Some((folder, source.map_err(of_file)?))
            }
            None => None,
        };
        if let Some((folder, source)) = cache
            && let Some(mesh) = MappedPly::open(mesh_file)
            && has_red_ground(&mesh, mesh.has_path() || given.is_some())
        {
            let bytes = mesh.triangles() as f64 * DIVIDED_BYTES;
            let budget = options.memory_budget;
            budget.require("the tiles of the map", bytes, SMALLER_MAP)?;
            let is_ground = |triangle| mesh.is_red(triangle);
            let path = mesh.path.clone();
            let files = (mesh_file, &**folder, &options.cache);
            match divided(files, source, &mesh, &is_ground, path)? {
                Some(store) => return Self::on_disk((mesh_file, store), given, options, &choice),
                None => cache = None,
            }
        }
        let (mut mesh, own) = mesh_file::read(mesh_file)?;
        let path = own.clone().or_else(|| given.clone()).unwrap_or_default();
        let is_ground = prepare(&mut mesh, &path, options.memory_budget)?;
        if let Some((folder, source)) = cache
            && let Some(store) = divided(
                (mesh_file, folder, &options.cache),
                source,
                &mesh,
                &|triangle| is_ground[triangle],
                own,
            )?
        {
            return Self::on_disk((mesh_file, store), given, options, &choice);
        }
        Self::in_memory(mesh, path, &is_ground, options, &choice)
    }

    fn on_disk(
        (mesh_file, store): (&Path, TileStore),
        given: Option<MappingPath>,
        options: &MapOptions,
        choice: &BackendChoice,
    ) -> Result<Self, MapError> {
        let path = store.path.clone().or(given).unwrap_or_default();
        let tiles = grid_of(&path, store.boxes(), &options.tiles);
        let store = Arc::new(store);
        let renderer = choice.renderer(store.clone(), options.memory_budget)?;
        Ok(Self {
            surface: Surface::Disk {
                mesh_file: mesh_file.to_owned(),
                tiles: store.clone(),
            },
            path: path.into(),
            tiles: tiles.into(),
            ground: GroundMap::over(store, GROUND_CELL_M).into(),
            renderer,
            memory_budget: options.memory_budget,
            panoramas: Arc::default(),
        })
    }

    /// Writes the map as a binary PLY file that is complete by itself: mesh, colours of the ground, path of the mapping drive.
    ///
    /// # Errors
    /// The file cannot be written, or that of the map cannot be read.
    pub fn save(&self, path: &Path) -> Result<(), MapError> {
        Ok(ply::write(path, &*self.mesh()?, Some(&self.path))?)
    }

    /// Number of triangles.
    pub fn triangle_count(&self) -> u64 {
        match &self.surface {
            Surface::Memory(mesh) => mesh.triangles.len() as u64,
            Surface::Disk { tiles, .. } => tiles.triangles(),
        }
    }

    /// The whole surface, map frame. That of a map on disk is read from its file again, on the lattice of maps.
    ///
    /// # Errors
    /// The file of the map cannot be read again.
    pub fn mesh(&self) -> Result<Arc<TriangleMesh>, MapError> {
        match &self.surface {
            Surface::Memory(mesh) => Ok(mesh.clone()),
            Surface::Disk { mesh_file, .. } => {
                let (mut mesh, _) = mesh_file::read(mesh_file)?;
                mesh.snap();
                Ok(mesh.into())
            }
        }
    }

    /// The surface around some positions [m] (without any, everywhere), at least as far as `radius_m`, relative to
    /// `origin` in the map frame: that of the tiles there, or, of a map in memory, all of it. Of tiles, ground is red and the rest blue, and there are no
    /// normals; if they have more than `most_triangles`, vertices are merged in cells, for pictures.
    pub(crate) fn mesh_near(
        &self,
        positions: &[Point2<f64>],
        radius_m: f64,
        origin: DVec3,
        most_triangles: u64,
    ) -> Result<Arc<TriangleMesh>, MapError> {
        let tiles = match &self.surface {
            Surface::Memory(mesh) if origin == DVec3::ZERO => return Ok(mesh.clone()),
            Surface::Memory(mesh) => {
                let relative = |vertex: &Vec3| (vertex.as_dvec3() - origin).as_vec3();
                let mut moved = TriangleMesh::clone(mesh);
                moved.vertices = mesh.vertices.iter().map(relative).collect();
                return Ok(moved.into());
            }
            Surface::Disk { tiles, .. } => tiles,
        };
        let is_near = |bounds: &Aabb| {
            let [min, max] = [bounds.min, bounds.max].map(|corner| corner.as_dvec3());
            positions.is_empty()
                || positions.iter().any(|position| {
                    let x_m = (min.x - position.x).max(position.x - max.x).max(0.0);
                    let y_m = (min.y - position.y).max(position.y - max.y).max(0.0);
                    x_m.hypot(y_m) <= radius_m
                })
        };
        let mesh = tiles.mesh_of(origin, most_triangles, is_near);
        Ok(mesh.map_err(RenderError::from)?.into())
    }

    /// Returns the panoramas of the cells in which place recognition searches. They are rendered if the
    /// last request was a different one.
    pub(crate) fn panoramas(
        &self,
        request: &PanoramaRequest,
    ) -> Result<Arc<PanoramaIndex>, RenderError> {
        let mut last = self.panoramas.lock().unwrap_or_else(|e| e.into_inner());
        match &*last {
            Some((made_for, index)) if made_for == request => Ok(index.clone()),
            _ => {
                let index = Arc::new(self.find_panoramas(request)?);
                *last = Some((request.clone(), index.clone()));
                Ok(index)
            }
        }
    }
}

impl Map {
    /// Opens the panoramas of a map on disk that were made before, or renders them.
    fn find_panoramas(&self, request: &PanoramaRequest) -> Result<PanoramaIndex, RenderError> {
        let mut path = crc32fast::Hasher::new();
        for pose in &self.path.map_from_lidar {
            path.update(bytemuck::cast_slice(pose.translation.vector.as_slice()));
        }
        let words = format!("{} along {:08x}", request.words(), path.finalize());
        let file = match &self.surface {
            Surface::Memory(_) => None,
            Surface::Disk { tiles, .. } => Some(tiles.file_of_panoramas(&words)),
        };
        if let Some(file) = &file
            && let Some(panoramas) = Panoramas::open(file, &words)
        {
            mark_used(file);
            return Ok(PanoramaIndex::over(panoramas, request));
        }
        let budget = self.memory_budget;
        request.require_memory(&self.path.map_from_lidar, &self.tiles, budget)?;
        let cells = request.cells(&self.path.map_from_lidar, &self.tiles);
        let (renderer, ground) = (&*self.renderer, &self.ground);
        let named = file.as_ref().map(|file| (&**file, &*words));
        let built = PanoramaIndex::build(
            &cells,
            renderer,
            ground,
            &self.tiles,
            request,
            named,
            budget,
        )?;
        if let Some(file) = &file
            && let Err(error) = remove_unused(file)
        {
            let file = file.display();
            tracing::warn!("old panoramas next to {file} cannot be removed: {error}");
        }
        Ok(built)
    }
}

/// Divides the mesh of a file into tiles in a folder of a cache; `None` if they cannot be written next to it, after a
/// warning, or would be larger than the mesh.
fn divided(
    (mesh_file, folder, cache): (&Path, &Path, &MapCache),
    source: Source,
    mesh: &dyn MeshView,
    is_ground: &dyn Fn(usize) -> bool,
    own_path: Option<MappingPath>,
) -> Result<Option<TileStore>, MapError> {
    if is_sparse(mesh, is_ground, source.side_m) {
        tracing::info!("all of the map is kept in memory: its tiles would be larger");
        return Ok(None);
    }
    match TileStore::make(mesh_file, folder, source, mesh, is_ground, own_path) {
        Ok(Some(store)) => Ok(Some(store)),
        Ok(None) => Err(MapError::Changed {
            file: mesh_file.to_owned(),
        }),
        Err(error) if matches!(cache, MapCache::Folder(_)) => {
            Err(MeshFileProblem::Write(error).of(folder).into())
        }
        Err(error) => {
            tracing::warn!(
                "the tiles of {} cannot be written to {} ({error}): all of the map is kept in memory",
                mesh_file.display(),
                folder.display()
            );
            Ok(None)
        }
    }
}

/// Whether the tiles of a mesh would take much space, and more than the mesh takes in memory: those of a few triangles
/// that are far apart or cover much ground.
fn is_sparse(mesh: &dyn MeshView, is_ground: &dyn Fn(usize) -> bool, side_m: f64) -> bool {
    /// Space that tiles may take in any case [bytes].
    const SMALL_BYTES: f64 = (64_u64 << 20) as f64;
    /// Space of a small file [bytes].
    const FILE_BYTES: f64 = 4096.0;
    const HEIGHT_BYTES: f64 = 4.0;
    let mut tiles = HashSet::new();
    let mut ground_m2 = 0.0;
    for triangle in 0..mesh.triangles() {
        let [a, b, c] = mesh.corners(triangle);
        let middle = (a + b + c) / 3.0;
        tiles.insert(TileIndex::of(middle.x, middle.y, side_m));
        if is_ground(triangle) {
            ground_m2 += 0.5 * (b - a).truncate().perp_dot((c - a).truncate()).abs();
        }
    }
    let heights = ground_m2 / (GROUND_CELL_M * GROUND_CELL_M);
    let bytes = FILE_BYTES * tiles.len() as f64 + HEIGHT_BYTES * heights;
    bytes > SMALL_BYTES.max(TRIANGLE_BYTES * mesh.triangles() as f64)
}

/// Moves the vertices of a mesh to the lattice of maps and finds its ground: which triangles are ground.
fn prepare(
    mesh: &mut TriangleMesh,
    path: &MappingPath,
    budget: MemoryBudget,
) -> Result<Vec<bool>, MapError> {
    mesh.snap();
    let triangles = mesh.triangles.len();
    if (0..triangles).all(|triangle| mesh.scaled_normal(triangle) == Vec3::ZERO) {
        return Err(MapError::NoArea { triangles });
    }
    budget.require("the map", triangles as f64 * TRIANGLE_BYTES, SMALLER_MAP)?;
    if let Some(doubt) = unit_doubt(&mesh.bounds()) {
        tracing::warn!("{doubt}");
    }
    ground_of(mesh, !path.map_from_lidar.is_empty(), budget)
}

/// The tiles around the path of the mapping drive; without one, those of the triangles.
fn grid_of(
    path: &MappingPath,
    boxes: impl IntoIterator<Item = (TileIndex, Aabb)>,
    config: &TileConfig,
) -> TileGrid {
    if path.map_from_lidar.is_empty() {
        TileGrid::of_boxes(boxes, config.side_m)
    } else {
        TileGrid::around(&path.map_from_lidar, config)
    }
}

/// The surface of a mesh file, to which that of a newer drive can be added: with normals, ground red and the rest blue. A
/// file that has all of this is mapped into memory, others are read.
pub fn surface_of(mesh_file: &Path) -> Result<Arc<dyn MeshView>, MapError> {
    if let Some(mesh) = MappedPly::open(mesh_file)
        && mesh.has_normals()
        && has_red_ground(&mesh, mesh.has_path())
    {
        return Ok(Arc::new(mesh));
    }
    let (mut mesh, path) = mesh_file::read(mesh_file)?;
    let has_path = path.is_some_and(|path| !path.map_from_lidar.is_empty());
    if !has_red_ground(&mesh, has_path) {
        let is_ground = ground_of(&mesh, has_path, MemoryBudget::default())?;
        mesh.colors = vec![REST; mesh.vertices.len()];
        for (corners, _) in std::iter::zip(&mesh.triangles, is_ground).filter(|(_, ground)| *ground)
        {
            for &vertex in corners {
                mesh.colors[vertex as usize] = GROUND;
            }
        }
    }
    if mesh.normals.is_empty() {
        mesh.compute_normals();
    }
    Ok(Arc::new(mesh))
}

/// Whether triangles that have an area are red: the ground of maps. Colours of a mesh without a mapping drive mark the
/// ground only if they are between red and blue: others are those of a photograph.
fn has_red_ground(mesh: &dyn MeshView, has_path: bool) -> bool {
    let mut vertices = 0..mesh.vertices() as u32;
    (has_path || vertices.all(|vertex| mesh.vertex(vertex).color[1] == 0))
        && (0..mesh.triangles())
            .any(|triangle| mesh.is_red(triangle) && has_area(mesh.corners(triangle)))
}

/// Whether a triangle has an area once its corners are on the lattice of maps.
fn has_area(corners: [DVec3; 3]) -> bool {
    let [a, b, c] = corners.map(on_lattice);
    (b - a).cross(c - a) != DVec3::ZERO
}

/// Finds the ground: the red triangles; in a mesh without any, those that their shape tells.
fn ground_of(
    mesh: &TriangleMesh,
    has_path: bool,
    budget: MemoryBudget,
) -> Result<Vec<bool>, MapError> {
    if has_red_ground(mesh, has_path) {
        return Ok((0..mesh.triangles.len())
            .map(|triangle| mesh.is_red(triangle))
            .collect());
    }
    let ground = GroundSurface::of_mesh(mesh, budget)?;
    let area_m2 = ground.area_m2();
    let y_up_m2 = GroundSurface::of_mesh(&turned_from_y_up(mesh), budget)?.area_m2();
    let y_up_m2 = Some(y_up_m2).filter(|&y_up_m2| y_up_m2 > 2.0 * area_m2);
    if area_m2 == 0.0 {
        return Err(MapError::NoGround {
            smallest_m2: ground.smallest_m2(),
            y_up_m2,
        });
    }
    if let Some(y_up_m2) = y_up_m2 {
        tracing::warn!(
            "the map has {area_m2:.0} m² of ground, and would have {y_up_m2:.0} m² if its y axis pointed up: {TURN}"
        );
    }
    tracing::info!("the map has no ground marked red: {area_m2:.0} m² were found by their shape");
    let triangles = 0..mesh.triangles.len();
    Ok(triangles
        .map(|triangle| ground.has_triangle(mesh, triangle))
        .collect())
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

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::time::{Duration, SystemTime};

    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Pose3;
    use crate::lidar::LidarModel;
    use crate::map::places::panorama::{PanoramaConfig, SearchRegion};
    use crate::map::tiles::contents::{CacheKind, files_of};
    use crate::rendering::Backend;
    use crate::sensor::Sensor;

    /// A road of 100 m, 12 m wide, between walls of 6 m.
    fn street() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let mut add = |origin: Vec3, across: Vec3, color: [u8; 3]| {
            for (a, b) in (0..100).flat_map(|along| (0..6).map(move |row| (along, row))) {
                let corner = |along: u8, row: u8| {
                    origin + f32::from(along) * Vec3::X + f32::from(row) * across
                };
                let first = mesh.vertices.len() as u32;
                let corners = [(a, b), (a + 1, b), (a + 1, b + 1), (a, b + 1)];
                (mesh.vertices).extend(corners.map(|(along, row)| corner(along, row)));
                mesh.colors.extend([color; 4]);
                (mesh.triangles).extend([[0, 1, 2], [0, 2, 3]].map(|it| it.map(|at| first + at)));
            }
        };
        add(-6.0 * Vec3::Y, 2.0 * Vec3::Y, GROUND);
        add(-6.0 * Vec3::Y, Vec3::Z, REST);
        add(6.0 * Vec3::Y, Vec3::Z, REST);
        mesh
    }

    /// Area of the red triangles, and of all [m²].
    fn areas_m2(mesh: &dyn MeshView) -> [f64; 2] {
        let area_m2 = |is_counted: &dyn Fn(usize) -> bool| -> f64 {
            let triangles = (0..mesh.triangles()).filter(|&triangle| is_counted(triangle));
            triangles.map(|triangle| mesh.area_m2(triangle)).sum()
        };
        [
            area_m2(&|triangle| mesh.is_red(triangle)),
            area_m2(&|_| true),
        ]
    }

    #[test]
    fn a_map_that_needs_more_than_its_budget_is_an_error_and_others_are_not_bounded() {
        let prepared = |memory_budget| {
            let options = MapOptions {
                memory_budget,
                ..MapOptions::default()
            };
            Map::new(street(), MappingPath::default(), &options)
        };
        let small = MemoryBudget { bytes: 1000 };
        let message = prepared(small).err().unwrap().to_string();
        assert!(message.starts_with("the map would need"), "{message}");
        prepared(MemoryBudget::default()).unwrap();
    }

    #[test]
    fn walls_of_a_map_of_scans_are_seen_from_their_front_and_others_from_both_sides() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        let options = MapOptions {
            backend: Backend::Cpu,
            cache: MapCache::NextToMap,
            ..MapOptions::default()
        };
        for sensor in [Some(Sensor::hdl32e()), None] {
            let path = MappingPath {
                sensor,
                map_from_lidar: vec![Pose3::translation(20.0, 0.0, 2.0)],
                ..MappingPath::default()
            };
            ply::write(&file, &street(), Some(&path)).unwrap();
            // The other wall faces away from the road.
            let sign = if path.has_fronts() { -1.0 } else { 1.0 };
            let maps = [
                Map::new(street(), path, &options),
                Map::load(&file, &options),
            ];
            for map in maps.map(Result::unwrap) {
                let directions = [Vec3::NEG_Z, Vec3::Y, Vec3::NEG_Y];
                let here = Pose3::translation(50.2, 0.1, 2.0);
                let found = map.renderer.cast_signed(&here, &directions, 80.0);
                let expected = [2.0, 5.9, sign * 6.1];
                for (found, expected) in found.unwrap().into_iter().zip(expected) {
                    assert_relative_eq!(found, expected, epsilon = 1e-3);
                }
            }
        }
    }

    #[test]
    fn of_the_panoramas_of_many_heights_the_least_recently_used_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        let path = MappingPath {
            map_from_lidar: (10..90)
                .map(|x| Pose3::translation(f64::from(x), 0.0, 2.0))
                .collect(),
            ..MappingPath::default()
        };
        ply::write(&file, &street(), Some(&path)).unwrap();
        let options = MapOptions {
            backend: Backend::Cpu,
            cache: MapCache::NextToMap,
            ..MapOptions::default()
        };
        let map = Map::load(&file, &options).unwrap();
        let search_from = |sensor_height_m| {
            let request = PanoramaRequest {
                region: SearchRegion::Road,
                lidar: LidarModel::default(),
                sensor_height_m,
                config: PanoramaConfig {
                    cell_m: 5.0,
                    ..PanoramaConfig::default()
                },
            };
            map.panoramas(&request).unwrap();
        };
        let kept = || -> Vec<PathBuf> {
            let files = files_of(&options.cache.folder_of(&file).unwrap()).unwrap();
            let panoramas = files
                .into_iter()
                .filter(|it| it.kind == CacheKind::Panoramas);
            panoramas.map(|it| it.path).collect()
        };
        // Sparse files of 40 MiB, two of which are too large together.
        let age = |panoramas: &Path, hours: u64| {
            let file = File::options().write(true).open(panoramas).unwrap();
            file.set_len(40 << 20).unwrap();
            let used = SystemTime::now() - Duration::from_secs(3600 * hours);
            file.set_modified(used).unwrap();
        };
        search_from(1.5);
        let first = kept().remove(0);
        age(&first, 3);
        search_from(2.0);
        let second = kept().into_iter().find(|it| *it != first).unwrap();
        age(&second, 2);
        search_from(1.5);
        search_from(2.5);
        let left = kept();
        assert_eq!(left.len(), 2);
        assert!(left.contains(&first) && !left.contains(&second));
    }

    #[test]
    fn a_surface_to_which_a_drive_is_added_has_red_ground_and_normals_whatever_the_file_has() {
        let whole = street();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        let mut photographed = whole.clone();
        photographed.colors = vec![[120, 90, 80]; whole.vertices.len()];
        for mesh in [&whole, &photographed] {
            ply::write(&file, mesh, None).unwrap();
            let surface = surface_of(&file).unwrap();
            let ([red, all], [expected, expected_all]) = (areas_m2(&*surface), areas_m2(&whole));
            assert!((all - expected_all).abs() < 1e-3 * expected_all);
            assert!((red - expected).abs() < 0.1 * expected, "{red} {expected}");
        }
        // Rows of vertices without normals, as other programs write them.
        let header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
             element face 1\nproperty list uchar int vertex_indices\nend_header\n";
        let mut bytes = header.as_bytes().to_vec();
        for position in [[0.0_f32, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
            bytes.extend(position.into_iter().flat_map(f32::to_le_bytes));
            bytes.extend([255, 0, 0]);
        }
        bytes.push(3);
        bytes.extend([0, 1, 2].into_iter().flat_map(i32::to_le_bytes));
        std::fs::write(&file, bytes).unwrap();
        let surface = surface_of(&file).unwrap();
        assert_eq!(surface.vertex(1).normal, Vec3::X);
    }
}
