//! The tiles of a map on disk: made on first use, read where rays and cars go, dropped behind them.
//!
//! What a ray hits and what ground is known never depends on which tiles are in memory: one that is missing is
//! read when it is needed. Tiles ahead are read in the background, and those far away are dropped once all take more
//! than [`KEPT_BYTES`].

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::{self, BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use std::time::UNIX_EPOCH;

use glam::{DVec3, Vec3};

use super::contents::{CacheKind, PANORAMAS, files_of, is_in_use};
use super::file::{
    self, INDEX, INDEX_MAGIC, Source, TILE_MAGIC, TileEntry, TileFile, TileFileIndex, TileScene,
};
use super::grid::{TileIndex, triangles_of_tiles};
use crate::files::{
    FolderClaim, UnlockedOnDrop, remove_abandoned, require_no_link, require_own, write_atomically,
};
use crate::geometry::mesh::on_lattice;
use crate::geometry::{Aabb, TriangleMesh};
use crate::map::build::plan::origin_near;
use crate::map::build::vertex_ground::{GROUND, REST};
use crate::map::files::mapping_path::MappingPath;
use crate::map::ground::heights::{
    Cell, ChunkSource, GROUND_CELL_M, chunk_at, chunks_of_triangles, chunks_reached,
    middle_of_chunk, window_of,
};
use crate::map::mesh_view::{MeshView, part_on_lattice};
use crate::raycasting::{Scene, SceneSource, Tile, TileError, TileSource};
use crate::shared_bytes::SharedBytes;

/// Memory of tiles above which those far from the rays are dropped [bytes].
const KEPT_BYTES: u64 = 96 << 20;
/// Tiles nearer to the origins of rays are not dropped [m].
const KEPT_M: f64 = 120.0;
/// Tiles nearer to the origins of rays are read ahead [m].
const AHEAD_M: f64 = 70.0;

/// The tiles of a map on disk.
#[derive(Debug)]
pub(crate) struct TileStore {
    files: Arc<Files>,
    /// Path of the mapping drive, if it is in the mesh file.
    pub path: Option<MappingPath>,
    /// The boxes of all tiles, without the tiles.
    scene: Scene<TileError>,
    resident: RwLock<Arc<Resident>>,
    is_reading_ahead: Arc<AtomicBool>,
}

/// Where the tiles are, and how much of them is in memory.
#[derive(Debug)]
struct Files {
    folder: PathBuf,
    stamp: u32,
    side_m: f64,
    tiles: Vec<TileEntry>,
    numbers: HashMap<TileIndex, usize>,
    /// In memory [bytes].
    bytes: Arc<AtomicU64>,
    /// Memory above which tiles are dropped [bytes].
    kept_bytes: u64,
    /// The folder, locked so that no other process removes files from it.
    _in_use: Option<UnlockedOnDrop>,
}

/// The tiles that are in memory or cannot be read, and those that were not needed yet.
#[derive(Debug)]
struct Resident {
    files: Arc<Files>,
    slots: Vec<OnceLock<Result<Arc<LoadedTile>, TileError>>>,
}

/// A tile in memory; its bytes are counted as long as it is.
#[derive(Debug)]
struct LoadedTile {
    number: usize,
    file: TileFile,
    scene: OnceLock<Result<TileScene, TileError>>,
    /// Those of all tiles.
    bytes: Arc<AtomicU64>,
}

impl Drop for LoadedTile {
    fn drop(&mut self) {
        let scene = self.scene.get().and_then(|scene| scene.as_ref().ok());
        let bytes = self.file.ground_bytes() + scene.map_or(0, TileScene::bytes);
        self.bytes.fetch_sub(bytes as u64, Ordering::Relaxed);
    }
}

impl Resident {
    fn get(&self, number: usize) -> Result<&Arc<LoadedTile>, &TileError> {
        let tile = self.slots[number].get_or_init(|| self.files.read(number));
        tile.as_ref()
    }

    fn scene(&self, number: usize) -> Result<&TileScene, &TileError> {
        let tile = self.get(number)?;
        let scene = tile.scene.get_or_init(|| self.files.scene_of(tile));
        scene.as_ref()
    }
}

impl TileSource<TileError> for Resident {
    #[inline]
    fn tile(&self, number: usize) -> Result<Option<&Tile>, &TileError> {
        // The tile of a ray without a hit has a number that no tile has.
        if number >= self.slots.len() {
            return Ok(None);
        }
        Ok(self.scene(number)?.tile.as_ref())
    }
}

impl Files {
    fn read(&self, number: usize) -> Result<Arc<LoadedTile>, TileError> {
        let path = self.path(number);
        let index = self.tiles[number].index();
        let file = TileFile::open(&path, index, self.stamp);
        let file = file.map_err(|problem| TileError::new(path, problem))?;
        self.bytes
            .fetch_add(file.ground_bytes() as u64, Ordering::Relaxed);
        Ok(Arc::new(LoadedTile {
            number,
            file,
            scene: OnceLock::new(),
            bytes: self.bytes.clone(),
        }))
    }

    fn scene_of(&self, tile: &LoadedTile) -> Result<TileScene, TileError> {
        let scene = tile.file.scene();
        let scene = scene.map_err(|problem| TileError::new(self.path(tile.number), problem))?;
        self.bytes
            .fetch_add(scene.bytes() as u64, Ordering::Relaxed);
        Ok(scene)
    }

    fn path(&self, number: usize) -> PathBuf {
        self.tiles[number].file(&self.folder, self.stamp)
    }
}

impl TileStore {
    /// The tiles of a mesh file in a folder, if they are those of what the file contains now.
    ///
    /// # Errors
    /// Those of the mesh file. Tiles whose index cannot be read are made again, after a warning.
    pub fn open(
        mesh_file: &Path,
        folder: &Path,
        has_given_path: bool,
        side_m: f64,
    ) -> io::Result<Option<Self>> {
        // What others put there is reported when tiles are to be made.
        if require_own_index(folder).is_err() {
            return Ok(None);
        }
        let in_use = in_use(folder);
        let bytes = match fs::read(folder.join(INDEX)) {
            Ok(bytes) => bytes,
            Err(error) => {
                if error.kind() != io::ErrorKind::NotFound {
                    let folder = folder.display();
                    tracing::warn!("the tiles in {folder} are made again: {error}");
                }
                return Ok(None);
            }
        };
        let index = match TileFileIndex::decode(&bytes) {
            Ok(index) => index,
            Err(problem) => {
                let folder = folder.display();
                tracing::info!("the tiles in {folder} are made again: {problem}");
                return Ok(None);
            }
        };
        let mut now = source_of(mesh_file, index.source.checksum, has_given_path, side_m)?;
        if now.stamp() != index.source.stamp() {
            return Ok(None);
        }
        if now != index.source {
            // A copy has another time, and so has a mesh that was changed.
            now.checksum = checksum_of(mesh_file)?;
            if now.stamp() != index.source.stamp() {
                return Ok(None);
            }
        }
        let stamp = now.stamp();
        let is_there = |tile: &TileEntry| {
            let file = tile.file(folder, stamp);
            !file.is_symlink() && TileFile::is_whole(&file)
        };
        let are_all_there = index.tiles.iter().all(is_there);
        Ok(are_all_there.then(|| Self::over(folder.to_owned(), in_use, index, KEPT_BYTES)))
    }

    /// A mesh file as it is now, and how it is to be divided.
    pub fn source(mesh_file: &Path, has_given_path: bool, side_m: f64) -> io::Result<Source> {
        source_of(mesh_file, checksum_of(mesh_file)?, has_given_path, side_m)
    }

    /// Writes the tiles of a mesh into a folder, on the lattice of maps, and opens them. Files of older tiles that no
    /// process uses are removed, and after an error, as on a full disk, those that were written. In memory are the indices
    /// of the triangles, and one tile.
    ///
    /// The source is that of the file before the mesh was opened; `None` if the file has changed since.
    pub fn make(
        mesh_file: &Path,
        folder: &Path,
        source: Source,
        mesh: &dyn MeshView,
        is_ground: &dyn Fn(usize) -> bool,
        own_path: Option<MappingPath>,
    ) -> io::Result<Option<Self>> {
        let stamp = source.stamp();
        require_own_index(folder)?;
        fs::create_dir_all(folder)?;
        // What replaces it while the tiles are made is not followed.
        let _claim = FolderClaim::new(folder)?;
        remove_abandoned(folder)?;
        let write = || {
            let tiles = write_tiles(folder, &source, mesh, is_ground)?;
            let has_given_path = source.has_given_path != 0;
            if Self::source(mesh_file, has_given_path, source.side_m).ok() != Some(source) {
                return Ok(None);
            }
            let index = TileFileIndex {
                source,
                path: own_path,
                tiles,
            };
            require_own_index(folder)?;
            write_atomically(&folder.join(INDEX), |out| out.write_all(&index.encode()))?;
            io::Result::Ok(Some(index))
        };
        let written = write();
        if !matches!(written, Ok(Some(_))) {
            // The first error is the one to report.
            let _ = remove_unless_in_use(folder, stamp, |kind, is_new| {
                kind == CacheKind::Tile && is_new
            });
        }
        let Some(index) = written? else {
            return Ok(None);
        };
        remove_unless_in_use(folder, stamp, |kind, is_new| {
            kind != CacheKind::Index && !is_new
        })?;
        let (folder, in_use) = (folder.to_owned(), in_use(folder));
        Ok(Some(Self::over(folder, in_use, index, KEPT_BYTES)))
    }

    /// The tiles of an index, none of them in memory.
    fn over(
        folder: PathBuf,
        in_use: Option<UnlockedOnDrop>,
        index: TileFileIndex,
        kept_bytes: u64,
    ) -> Self {
        let numbers = index.tiles.iter().map(TileEntry::index).zip(0..).collect();
        let bounds: Vec<Aabb> = index.tiles.iter().map(TileEntry::bounds).collect();
        let mut triangles = 0_u32;
        let first_triangles = (index.tiles.iter())
            .map(|tile| {
                let first = triangles;
                triangles = triangles.wrapping_add(tile.triangles as u32);
                first
            })
            .collect();
        let files = Arc::new(Files {
            folder,
            stamp: index.source.stamp(),
            side_m: index.source.side_m,
            numbers,
            bytes: Arc::default(),
            kept_bytes,
            _in_use: in_use,
            tiles: index.tiles,
        });
        let resident = Arc::new(Resident {
            slots: files.tiles.iter().map(|_| OnceLock::new()).collect(),
            files: files.clone(),
        });
        let mut scene = Scene::over(&bounds, first_triangles, Arc::new(Vec::new()));
        scene.has_fronts = index.path.as_ref().is_some_and(MappingPath::has_fronts);
        Self {
            files,
            path: index.path,
            scene,
            resident: RwLock::new(resident),
            is_reading_ahead: Arc::default(),
        }
    }

    /// The file of the panoramas of a request, given in words.
    pub fn file_of_panoramas(&self, request: &str) -> PathBuf {
        let (stamp, request) = (self.files.stamp, crc32fast::hash(request.as_bytes()));
        (self.files.folder).join(format!("panoramas-{request:08x}.{stamp:08x}{PANORAMAS}"))
    }

    /// Number of triangles of the map.
    pub fn triangles(&self) -> u64 {
        self.files.tiles.iter().map(|tile| tile.triangles).sum()
    }

    /// All tiles, and the boxes around their triangles.
    pub fn boxes(&self) -> impl Iterator<Item = (TileIndex, Aabb)> {
        let tiles = self.files.tiles.iter();
        tiles
            .map(|tile| (tile.index(), tile.bounds()))
            .filter(|(_, bounds)| !bounds.is_empty())
    }

    /// The triangles of the tiles whose boxes are wanted, relative to `origin` [m], red where they are ground and blue
    /// elsewhere; if there are more than `most_triangles`, about as many, of vertices merged in cells.
    pub fn mesh_of(
        &self,
        origin: DVec3,
        most_triangles: u64,
        is_wanted: impl Fn(&Aabb) -> bool,
    ) -> Result<TriangleMesh, TileError> {
        let wanted = self.files.tiles.iter().enumerate();
        let wanted: Vec<_> = wanted
            .filter(|(_, entry)| is_wanted(&entry.bounds()))
            .collect();
        let triangles: u64 = wanted.iter().map(|(_, entry)| entry.triangles).sum();
        // The surface of a tile is about twice its square, and a cell that it passes through has about four triangles.
        let cell_m = (triangles > most_triangles).then(|| {
            let area_m2 = 2.0 * wanted.len() as f64 * self.files.side_m.powi(2);
            (4.0 * area_m2 / most_triangles.max(1) as f64).sqrt()
        });
        let mut mesh = TriangleMesh::default();
        for (number, entry) in wanted {
            let resident = self.resident();
            let scene = resident.scene(number).map_err(TileError::clone)?;
            let Some(tile) = &scene.tile else {
                continue;
            };
            let mut vertices: HashMap<([u64; 3], bool), u32> = HashMap::new();
            tile.for_each_triangle(|corners, triangle| {
                let is_ground = scene.is_ground(triangle);
                let indices = corners.map(|corner| {
                    let place = cell_m.map_or(corner, |cell_m| (corner / cell_m).floor());
                    let bits = place.to_array().map(f64::to_bits);
                    *vertices.entry((bits, is_ground)).or_insert_with(|| {
                        mesh.vertices.push((corner - origin).as_vec3());
                        mesh.colors.push(if is_ground { GROUND } else { REST });
                        mesh.vertices.len() as u32 - 1
                    })
                });
                let [a, b, c] = indices;
                if cell_m.is_none() || (a != b && b != c && c != a) {
                    mesh.triangles.push(indices);
                }
            });
            self.drop_beyond(entry.bounds());
        }
        Ok(mesh)
    }

    fn resident(&self) -> Arc<Resident> {
        self.resident
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Drops the tiles that are far from a box, if all together take much memory.
    fn drop_beyond(&self, bounds: Aabb) {
        if self.files.bytes.load(Ordering::Relaxed) <= self.files.kept_bytes {
            return;
        }
        let mut resident = self
            .resident
            .write()
            .unwrap_or_else(PoisonError::into_inner);
        let slots = resident.slots.iter().zip(&self.files.tiles);
        let kept = slots.map(|(slot, tile)| {
            if is_near(&tile.bounds(), &bounds, KEPT_M) {
                slot.clone()
            } else {
                OnceLock::new()
            }
        });
        *resident = Arc::new(Resident {
            slots: kept.collect(),
            files: self.files.clone(),
        });
    }

    /// Reads the tiles around a box that are not in memory, in the background.
    fn read_ahead(&self, resident: &Arc<Resident>, bounds: &Aabb) {
        let at = |corner: Vec3, offset_m: f64| {
            let [x, y] = [corner.x, corner.y].map(|along| f64::from(along) + offset_m);
            TileIndex::of(x, y, self.files.side_m)
        };
        let is_missing = |number: &usize| {
            let tile = resident.slots[*number].get();
            tile.is_none_or(|tile| tile.as_ref().is_ok_and(|tile| tile.scene.get().is_none()))
        };
        let missing: Vec<usize> =
            TileIndex::range(at(bounds.min, -AHEAD_M), at(bounds.max, AHEAD_M))
                .filter_map(|tile| self.files.numbers.get(&tile).copied())
                .filter(is_missing)
                .collect();
        if missing.is_empty() || self.is_reading_ahead.swap(true, Ordering::Acquire) {
            return;
        }
        let (resident, reading) = (resident.clone(), Reading(self.is_reading_ahead.clone()));
        std::thread::spawn(move || {
            for number in missing {
                // An error is kept for the call that needs the tile.
                let _ = resident.scene(number);
            }
            // Dropped first: who sees that the reading has ended sees what is kept.
            drop(resident);
            drop(reading);
        });
    }
}

/// Tiles are being read ahead, until it is dropped, also where the thread does not come to its end.
struct Reading(Arc<AtomicBool>);

impl Drop for Reading {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

impl SceneSource for TileStore {
    fn scene(&self, origins: &[DVec3]) -> Scene<TileError> {
        let finite = origins.iter().filter(|origin| origin.is_finite());
        let bounds = Aabb::from_points(finite.map(|origin| origin.as_vec3()));
        if !bounds.is_empty() {
            self.drop_beyond(bounds);
        }
        let resident = self.resident();
        if !bounds.is_empty() && f64::from(bounds.size().truncate().max_element()) < KEPT_M {
            self.read_ahead(&resident, &bounds);
        }
        self.scene.with_tiles(resident)
    }

    fn tiles(&self) -> Vec<(Aabb, u64)> {
        let tiles = self.files.tiles.iter();
        tiles.map(|tile| (tile.bounds(), tile.triangles)).collect()
    }

    /// The tile is not kept in memory.
    fn triangles(&self, tile: usize) -> Result<Vec<[DVec3; 3]>, TileError> {
        let loaded = self.files.read(tile)?;
        let scene = loaded.scene.get_or_init(|| self.files.scene_of(&loaded));
        let tile = &scene.as_ref().map_err(TileError::clone)?.tile;
        Ok(tile.as_ref().map_or_else(Vec::new, Tile::corners))
    }

    fn has_fronts(&self) -> bool {
        self.scene.has_fronts
    }
}

impl ChunkSource for TileStore {
    fn chunk(&self, chunk: Cell) -> Result<Option<SharedBytes>, TileError> {
        let tile = tile_of_chunk(chunk, self.files.side_m);
        let Some(&number) = self.files.numbers.get(&tile) else {
            return Ok(None);
        };
        let resident = self.resident();
        let loaded = resident.get(number).map_err(TileError::clone)?;
        let heights = loaded.file.chunk(chunk);
        if self.files.bytes.load(Ordering::Relaxed) > self.files.kept_bytes * 3 / 2 {
            self.drop_beyond(self.files.tiles[number].bounds());
        }
        Ok(heights)
    }
}

/// Writes the tiles of a mesh into a folder.
fn write_tiles(
    folder: &Path,
    source: &Source,
    mesh: &dyn MeshView,
    is_ground: &dyn Fn(usize) -> bool,
) -> io::Result<Vec<TileEntry>> {
    let (side_m, stamp) = (source.side_m, source.stamp());
    let mut triangles_of = triangles_of_tiles(mesh, side_m);
    let ground_of = ground_of_tiles(mesh, is_ground, side_m);
    for tile in ground_of.keys() {
        triangles_of.entry(*tile).or_default();
    }
    let mut tiles = Vec::with_capacity(triangles_of.len());
    for (tile, triangles) in &triangles_of {
        let middle = DVec3::new(tile.column as f64, tile.row as f64, 0.0) * side_m;
        let origin = origin_near(middle);
        let part = part_on_lattice(mesh, triangles, origin);
        let ground = ground_of.get(tile).map_or(&[][..], Vec::as_slice).iter();
        let corners = ground.map(|&triangle| mesh.corners(triangle as usize).map(on_lattice));
        let ends = [-0.5, 0.5].map(|side| middle + DVec3::splat(side * side_m));
        let [first, last] = ends.map(|end| chunk_at(end, GROUND_CELL_M));
        let chunks = chunks_of_triangles(corners, GROUND_CELL_M, window_of(first, last));
        let chunks: Vec<(Cell, SharedBytes)> = (chunks.into_iter())
            .filter(|(chunk, _)| tile_of_chunk(*chunk, side_m) == *tile)
            .collect();
        let of_part = |triangle: usize| is_ground(triangles[triangle] as usize);
        let (bytes, bounds) = file::encode((*tile, stamp), &part, origin, &chunks, of_part);
        if triangles.is_empty() && chunks.is_empty() {
            continue;
        }
        let entry = TileEntry::new(*tile, bounds, triangles.len());
        let file = entry.file(folder, stamp);
        require_own(&file, Some(TILE_MAGIC))?;
        write_atomically(&file, |out| out.write_all(&bytes))?;
        tiles.push(entry);
    }
    Ok(tiles)
}

/// The triangles of the ground that reach chunks of each tile.
fn ground_of_tiles(
    mesh: &dyn MeshView,
    is_ground: &dyn Fn(usize) -> bool,
    side_m: f64,
) -> BTreeMap<TileIndex, Vec<u32>> {
    let mut ground_of: BTreeMap<TileIndex, Vec<u32>> = BTreeMap::new();
    for triangle in (0..mesh.triangles()).filter(|&triangle| is_ground(triangle)) {
        let mut tiles: Vec<TileIndex> = chunks_reached(mesh.corners(triangle), GROUND_CELL_M)
            .map(|chunk| tile_of_chunk(chunk, side_m))
            .collect();
        tiles.sort_unstable();
        tiles.dedup();
        for tile in tiles {
            ground_of.entry(tile).or_default().push(triangle as u32);
        }
    }
    ground_of
}

/// The tile whose file a chunk of the ground is in: that of its middle.
fn tile_of_chunk(chunk: Cell, side_m: f64) -> TileIndex {
    let middle = middle_of_chunk(chunk, GROUND_CELL_M);
    TileIndex::of(middle.x, middle.y, side_m)
}

/// Whether boxes are within a distance of each other along x and y.
fn is_near(a: &Aabb, b: &Aabb, distance_m: f64) -> bool {
    let distance = Vec3::splat(distance_m as f32);
    let overlap = (a.min - distance).cmple(b.max) & (b.min - distance).cmple(a.max);
    overlap.x && overlap.y
}

/// A mesh file as it is now, with the checksum of its bytes.
fn source_of(
    mesh_file: &Path,
    checksum: u32,
    has_given_path: bool,
    side_m: f64,
) -> io::Result<Source> {
    let metadata = fs::metadata(mesh_file)?;
    let modified = metadata.modified().ok();
    let since = modified.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    Ok(Source {
        bytes: metadata.len(),
        modified_ns: since.map_or(0, |since| since.as_nanos() as u64),
        checksum,
        has_given_path: has_given_path.into(),
        side_m,
        ground_cell_m: GROUND_CELL_M,
    })
}

/// Checksum of a file.
fn checksum_of(path: &Path) -> io::Result<u32> {
    let mut file = BufReader::with_capacity(1 << 20, File::open(path)?);
    let mut hasher = crc32fast::Hasher::new();
    loop {
        let bytes = file.fill_buf()?;
        if bytes.is_empty() {
            return Ok(hasher.finalize());
        }
        hasher.update(bytes);
        let count = bytes.len();
        file.consume(count);
    }
}

/// Requires that a folder of tiles is no link and has no index that others wrote.
fn require_own_index(folder: &Path) -> io::Result<()> {
    require_no_link(folder)?;
    require_own(&folder.join(INDEX), Some(INDEX_MAGIC))
}

/// A folder of tiles, locked as one that is in use; `None` where there are no such locks.
fn in_use(folder: &Path) -> Option<UnlockedOnDrop> {
    let opened = File::open(folder).ok()?;
    opened
        .lock_shared()
        .is_ok()
        .then_some(UnlockedOnDrop(opened))
}

/// Removes files of a cache by what they are and whether they have a stamp, unless a process may use them.
fn remove_unless_in_use(
    folder: &Path,
    stamp: u32,
    is_removed: impl Fn(CacheKind, bool) -> bool,
) -> io::Result<()> {
    if is_in_use(folder) {
        return Ok(());
    }
    let stamp = format!(".{stamp:08x}");
    for file in files_of(folder)? {
        let name = file.path.file_stem().unwrap_or_default();
        if is_removed(file.kind, name.to_string_lossy().ends_with(&stamp)) {
            fs::remove_file(&file.path)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::thread;
    use std::time::Duration;

    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::geometry::Pose3;
    use crate::lidar::{Beam, LidarModel};
    use crate::map::ground::elevation::GroundMap;
    use crate::map::{Map, MapCache, MapError, MapOptions};
    use crate::rendering::{Backend, RenderError};

    /// A road of 1.2 km along x, walls next to it, and a ramp.
    fn street() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let mut quad = |corners: [Vec3; 4], color: [u8; 3]| {
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend(corners);
            mesh.colors.extend([color; 4]);
            mesh.triangles.push([first, first + 1, first + 2]);
            mesh.triangles.push([first, first + 2, first + 3]);
        };
        for number in 0..240_u16 {
            let x = 5.0 * f32::from(number);
            let z = 0.004 * x;
            let at = |dx: f32, y: f32, up: f32| Vec3::new(x + dx, y, z + 0.004 * dx + up);
            quad(
                [
                    at(0.0, -9.0, 0.0),
                    at(5.0, -9.0, 0.0),
                    at(5.0, 9.0, 0.0),
                    at(0.0, 9.0, 0.0),
                ],
                [255, 0, 0],
            );
            let set_back = f32::from(number % 7);
            quad(
                [
                    at(0.0, 9.0 + set_back, 0.0),
                    at(5.0, 9.0 + set_back, 0.0),
                    at(5.0, 9.0 + set_back, 6.0),
                    at(0.0, 9.0 + set_back, 6.0),
                ],
                [0, 0, 255],
            );
        }
        mesh
    }

    fn options() -> MapOptions {
        MapOptions {
            backend: Backend::Cpu,
            cache: MapCache::NextToMap,
            ..MapOptions::default()
        }
    }

    /// The folder of the tiles of a file.
    fn folder_of(file: &Path) -> PathBuf {
        MapCache::NextToMap.folder_of(file).unwrap()
    }

    fn open(file: &Path) -> Option<TileStore> {
        TileStore::open(file, &folder_of(file), false, 100.0).unwrap()
    }

    /// A folder with the street as `map.ply`.
    fn saved() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        crate::map::files::ply::write(&file, &street(), Some(&path())).unwrap();
        (folder, file)
    }

    /// Makes the tiles of a map; the file of the one at (x, 0).
    fn tile_at(file: &Path, x_m: f64) -> PathBuf {
        drop(Map::load(file, &options()).unwrap());
        let files = open(file).unwrap().files.clone();
        TileEntry::new(TileIndex::of(x_m, 0.0, 100.0), None, 0).file(&files.folder, files.stamp)
    }

    fn path() -> MappingPath {
        MappingPath {
            map_from_lidar: (0..1200)
                .map(|x| Pose3::translation(f64::from(x), 0.0, 2.0))
                .collect(),
            ..MappingPath::default()
        }
    }

    /// Ranges from many poses along the street, and the ground there.
    fn seen(map: &Map) -> (Vec<Vec<f32>>, Vec<Option<f64>>) {
        let mut rng = StdRng::seed_from_u64(1);
        let directions: Vec<Vec3> = (0..200)
            .map(|_| {
                let mut along = || rng.random_range(-1.0_f32..1.0);
                Vec3::new(along(), along(), 0.3 * along()).normalize()
            })
            .collect();
        let xs: Vec<f64> = (0..60).map(|_| rng.random_range(5.0..1190.0)).collect();
        let poses = xs
            .iter()
            .map(|&x| Pose3::translation(x, 1.0, 2.0 + 0.004 * x));
        let ranges = poses.map(|pose| {
            map.renderer
                .cast(&[pose], &directions, 150.0)
                .unwrap()
                .remove(0)
        });
        let ranges = ranges.collect();
        let heights = xs
            .iter()
            .map(|&x| Some(map.ground.patch_at(x, 0.0, 2.0, None).unwrap()?.height_m));
        (ranges, heights.collect())
    }

    #[test]
    fn a_map_on_disk_is_seen_as_in_memory_also_when_tiles_are_dropped_and_read_again() {
        let (_folder, file) = saved();
        let expected = seen(&Map::new(street(), path(), &options()).unwrap());
        assert!(
            expected
                .0
                .iter()
                .flatten()
                .any(|range_m| range_m.is_finite())
        );
        assert!(expected.1.iter().all(Option::is_some));
        for _ in ["the tiles are made", "the tiles are read"] {
            let map = Map::load(&file, &options()).unwrap();
            assert!(seen(&map) == expected);
        }
        let folder = folder_of(&file);
        let index = TileFileIndex::decode(&fs::read(folder.join(INDEX)).unwrap()).unwrap();
        let length = |tile: &TileEntry| {
            let file = tile.file(&folder, index.source.stamp());
            fs::metadata(file).unwrap().len()
        };
        let all: u64 = index.tiles.iter().map(length).sum();
        let store = Arc::new(TileStore::over(folder.clone(), None, index, all / 4));
        let mut map = Map::load(&file, &options()).unwrap();
        map.renderer = Arc::new(crate::rendering::CpuRenderer::over(store.clone()));
        map.ground = Arc::new(GroundMap::over(store.clone(), GROUND_CELL_M));
        assert!(seen(&map) == expected);
        let origin = DVec3::new(600.0, 0.0, 2.0);
        // Tiles that are being read in the background may come after the others are dropped. The three around the
        // origin stay, of thirteen, and a tile in memory counts for about twice its file.
        let kept = || store.files.bytes.load(Ordering::Relaxed);
        let is_settled = || {
            let is_reading = store.is_reading_ahead.load(Ordering::Acquire);
            !is_reading && (1..=all).contains(&kept())
        };
        for _ in 0..60_000 {
            if is_settled() {
                break;
            }
            drop(store.scene(&[origin]));
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(is_settled(), "{} of {all}", kept());
    }

    #[test]
    fn tiles_ahead_of_a_drive_are_in_memory_before_they_are_needed() {
        let (_folder, file) = saved();
        drop(Map::load(&file, &options()).unwrap());
        let files = open(&file).unwrap().files.clone();
        let in_memory = |origin: DVec3| {
            let store = open(&file).unwrap();
            drop(store.scene(&[origin]));
            for _ in 0..60_000 {
                if !store.is_reading_ahead.load(Ordering::Acquire) {
                    break;
                }
                thread::sleep(Duration::from_millis(1));
            }
            let is_there = |number: &usize| store.resident().slots[*number].get().is_some();
            let numbers = 0..store.files.tiles.len();
            numbers.filter(is_there).collect::<BTreeSet<usize>>()
        };
        let number = |x_m: f64| files.numbers[&TileIndex::of(x_m, 0.0, files.side_m)];
        for x in [600.0, 640.0] {
            // Tiles are longer than the way that is read ahead.
            let ahead_m = [-AHEAD_M, 0.0, AHEAD_M];
            let expected: BTreeSet<usize> = ahead_m.map(|ahead_m| number(x + ahead_m)).into();
            assert_eq!(in_memory(DVec3::new(x, 0.0, 2.0)), expected, "{x}");
        }
    }

    #[test]
    #[cfg(feature = "gpu")]
    fn a_map_on_disk_is_seen_as_in_memory_on_a_graphics_adapter_too() {
        let options = MapOptions {
            backend: Backend::Gpu,
            ..options()
        };
        let (_folder, file) = saved();
        let expected = match Map::new(street(), path(), &options) {
            Ok(map) => seen(&map),
            Err(error) => {
                let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|it| it == "1");
                assert!(!required, "FPMCL_REQUIRE_GPU=1, and {error}");
                crate::skips_for_tests::skipped(error);
                return;
            }
        };
        for _ in ["the tiles are made", "the tiles are read"] {
            let map = Map::load(&file, &options).unwrap();
            assert!(
                map.renderer.name().starts_with("gpu"),
                "{}",
                map.renderer.name()
            );
            assert!(seen(&map) == expected);
        }
    }

    #[test]
    fn tiles_serve_a_copy_and_are_made_again_for_a_mesh_that_changed() {
        let (_folder, file) = saved();
        let map = Map::load(&file, &options()).unwrap();
        let tiles = folder_of(&file);
        let names = || -> Vec<_> {
            let entries = fs::read_dir(&tiles).unwrap();
            entries.map(|entry| entry.unwrap().file_name()).collect()
        };
        let (first, triangles) = (names(), map.triangle_count());
        // The same bytes at another time.
        fs::write(&file, fs::read(&file).unwrap()).unwrap();
        assert!(open(&file).is_some());
        let mut less = street();
        less.triangles.truncate(100);
        crate::map::files::ply::write(&file, &less, Some(&path())).unwrap();
        assert!(open(&file).is_none());
        let abandoned = tiles.join(".fpmcl-6_0.tile-123456.part");
        fs::write(&abandoned, "of a killed process").unwrap();
        drop(map);
        let changed = Map::load(&file, &options()).unwrap();
        assert_eq!((triangles, changed.triangle_count()), (960, 100));
        let second = names();
        let is_tile = |name: &&std::ffi::OsString| *name != INDEX;
        assert!(
            second
                .iter()
                .filter(is_tile)
                .all(|name| !first.contains(name))
        );
        assert!(!abandoned.exists());
    }

    #[test]
    fn tiles_that_are_in_use_stay_when_others_are_made() {
        let (_folder, file) = saved();
        let map = Map::load(&file, &options()).unwrap();
        let expected = seen(&map);
        let tiles = folder_of(&file);
        let count = || fs::read_dir(&tiles).unwrap().count();
        let first = count();
        drop(map);
        // No tile of it was read yet.
        let old = Map::load(&file, &options()).unwrap();
        let mut less = street();
        less.triangles.truncate(100);
        crate::map::files::ply::write(&file, &less, Some(&path())).unwrap();
        drop(Map::load(&file, &options()).unwrap());
        let both = count();
        assert!(both > first);
        assert_eq!(seen(&old), expected);
        drop(old);
        // A process that another test starts holds the locks of this one until its program begins.
        let are_gone = (1..100).rev().any(|triangles| {
            less.triangles.truncate(triangles);
            crate::map::files::ply::write(&file, &less, Some(&path())).unwrap();
            drop(Map::load(&file, &options()).unwrap());
            thread::sleep(Duration::from_millis(10));
            count() < first
        });
        assert!(are_gone);
    }

    #[test]
    fn a_mesh_that_is_replaced_while_it_is_divided_has_no_tiles() {
        let (_folder, file) = saved();
        let source = TileStore::source(&file, false, 100.0).unwrap();
        let make = || {
            let is_ground = |triangle| MeshView::is_red(&street(), triangle);
            TileStore::make(
                &file,
                &folder_of(&file),
                source,
                &street(),
                &is_ground,
                Some(path()),
            )
        };
        let mut moved = street();
        moved.vertices.iter_mut().for_each(|vertex| vertex.z += 5.0);
        crate::map::files::ply::write(&file, &moved, Some(&path())).unwrap();
        assert!(make().unwrap().is_none());
        assert!(open(&file).is_none());
    }

    #[cfg(unix)]
    #[test]
    fn a_link_that_replaces_the_folder_while_tiles_are_made_is_not_followed() {
        let (folder, file) = saved();
        let (tiles, mine) = (folder_of(&file), folder.path().join("mine"));
        fs::create_dir(&mine).unwrap();
        fs::write(mine.join(INDEX), "mine").unwrap();
        let is_ground = |triangle| {
            if !tiles.is_symlink() {
                fs::rename(&tiles, folder.path().join("moved")).unwrap();
                std::os::unix::fs::symlink(&mine, &tiles).unwrap();
            }
            MeshView::is_red(&street(), triangle)
        };
        let source = TileStore::source(&file, false, 100.0).unwrap();
        let made = TileStore::make(&file, &tiles, source, &street(), &is_ground, Some(path()));
        let error = made.err().unwrap().to_string();
        assert!(error.contains("was replaced"), "{error}");
        let found: Vec<_> = fs::read_dir(&mine).unwrap().collect();
        assert_eq!(found.len(), 1);
        assert_eq!(fs::read_to_string(mine.join(INDEX)).unwrap(), "mine");
    }

    #[test]
    fn a_damaged_tile_is_an_error_of_each_call_that_needs_it() {
        let (_folder, file) = saved();
        let tile = tile_at(&file, 600.0);
        let whole = fs::read(&tile).unwrap();
        let damaged = |byte: usize| {
            let mut bad = whole.clone();
            bad[byte] ^= 1;
            bad
        };
        let of_other_square = fs::read(tile_at(&file, 300.0)).unwrap();
        let (_other_folder, other_map) = saved();
        let mut less = street();
        less.triangles.pop();
        crate::map::files::ply::write(&other_map, &less, Some(&path())).unwrap();
        let of_other_map = fs::read(tile_at(&other_map, 600.0)).unwrap();
        let pose = Pose3::translation(600.0, 0.0, 4.4);
        for (bytes, problem, has_ground) in [
            (&damaged(300)[..], "checksum", true),
            (&damaged(whole.len() - 1), "checksum", false),
            (&of_other_square, "another tile", false),
            (&of_other_map, "another tile", false),
        ] {
            // Replaced as a whole, as files that may be mapped have to be.
            fs::remove_file(&tile).unwrap();
            fs::write(&tile, bytes).unwrap();
            let map = Map::load(&file, &options()).unwrap();
            let (renderer, ground) = (&*map.renderer, &map.ground);
            let beam = Beam {
                direction: Vec3::Y,
                range_m: 10.0,
            };
            let failing = |call: &str| -> Option<RenderError> {
                match call {
                    "cast" => renderer.cast(&[pose], &[Vec3::Y], 50.0).err(),
                    "surfaces" => renderer.surfaces(&pose, &[beam], 50.0).err(),
                    "render" => renderer.render(&[pose], &LidarModel::default()).err(),
                    "mesh" => map
                        .mesh_near(&[[600.0, 0.0].into()], 10.0, DVec3::ZERO, u64::MAX)
                        .err()
                        .map(|error| match error {
                            MapError::Render(error) => error,
                            other => panic!("{other}"),
                        }),
                    "patch" => ground.patch_at(600.0, 0.0, 2.0, None).err().map(Into::into),
                    _ => ground.levels_at(600.0, 0.0).err().map(Into::into),
                }
            };
            let calls = ["cast", "surfaces", "render", "mesh", "patch", "levels"];
            for call in [calls, calls].into_iter().flatten() {
                if has_ground && matches!(call, "patch" | "levels") {
                    assert!(failing(call).is_none(), "{call}");
                    continue;
                }
                let message = failing(call).unwrap().to_string();
                assert!(
                    message.contains("6_0.") && message.contains(problem),
                    "{call}: {message}"
                );
            }
            // Rays and ground elsewhere do not need the tile.
            let elsewhere = Pose3::translation(300.0, 0.0, 3.2);
            assert!(renderer.cast(&[elsewhere], &[Vec3::Y], 50.0).is_ok());
            assert!(ground.patch_at(300.0, 0.0, 2.0, None).unwrap().is_some());
        }
    }

    #[test]
    fn tiles_that_were_cut_short_are_made_again_and_an_index_of_others_is_left_alone() {
        let (_folder, file) = saved();
        let tile = tile_at(&file, 600.0);
        let whole = fs::read(&tile).unwrap();
        let expected = seen(&Map::new(street(), path(), &options()).unwrap());
        for length in [whole.len() - 1, 300, 0] {
            // Replaced as a whole, as files that may be mapped have to be.
            fs::remove_file(&tile).unwrap();
            fs::write(&tile, &whole[..length]).unwrap();
            let map = Map::load(&file, &options()).unwrap();
            assert!(seen(&map) == expected);
            assert_eq!(fs::read(&tile).unwrap(), whole, "{length}");
        }
        let index = folder_of(&file).join(INDEX);
        fs::write(&index, b"nothing").unwrap();
        assert!(seen(&Map::load(&file, &options()).unwrap()) == expected);
        assert_eq!(fs::read(&index).unwrap(), b"nothing");
    }

    #[test]
    fn tiles_that_were_written_before_an_error_are_removed() {
        let (_folder, file) = saved();
        let (tile, tiles) = (tile_at(&file, 600.0), folder_of(&file));
        fs::remove_dir_all(&tiles).unwrap();
        fs::create_dir(&tiles).unwrap();
        // In the way of one of them, which is not the first.
        fs::write(&tile, "my own").unwrap();
        let map = Map::load(&file, &options()).unwrap();
        assert_eq!(map.triangle_count(), 960);
        let left = fs::read_dir(&tiles).unwrap();
        let left: Vec<PathBuf> = left.map(|entry| entry.unwrap().path()).collect();
        assert_eq!(left, std::slice::from_ref(&tile));
        assert_eq!(fs::read(&tile).unwrap(), b"my own");
    }

    #[test]
    fn without_a_cache_nothing_is_written_and_a_folder_has_the_tiles_of_several_maps() {
        let ((one, file), (other, other_file)) = (saved(), saved());
        let names = |folder: &Path| -> Vec<_> {
            let entries = fs::read_dir(folder).unwrap();
            entries.map(|entry| entry.unwrap().file_name()).collect()
        };
        let load = |file: &Path, cache: MapCache| {
            let options = MapOptions { cache, ..options() };
            Map::load(file, &options).unwrap()
        };
        let in_memory = load(&file, MapCache::None);
        assert_eq!(names(one.path()), ["map.ply"]);
        let folder = tempfile::tempdir().unwrap();
        let cache = || MapCache::Folder(folder.path().to_owned());
        let on_disk = load(&file, cache());
        load(&other_file, cache());
        assert!(seen(&on_disk) == seen(&in_memory));
        assert_eq!(names(folder.path()).len(), 2);
        assert_eq!(
            (names(one.path()), names(other.path())),
            (vec!["map.ply".into()], vec!["map.ply".into()])
        );
        // The tiles of the one stay when those of the other are made.
        assert!(
            TileStore::open(&file, &cache().folder_of(&file).unwrap(), false, 100.0)
                .unwrap()
                .is_some()
        );
    }

    #[test]
    fn where_no_tiles_can_be_written_all_is_in_memory() {
        let (_folder, file) = saved();
        fs::write(folder_of(&file), "in the way").unwrap();
        let map = Map::load(&file, &options()).unwrap();
        assert!(seen(&map) == seen(&Map::new(street(), path(), &options()).unwrap()));
        // A folder that was asked for is not left out.
        let cache = MapCache::Folder(folder_of(&file));
        let loaded = Map::load(&file, &MapOptions { cache, ..options() });
        let message = loaded.err().unwrap().to_string();
        assert!(message.contains("cannot be written"), "{message}");
    }

    #[test]
    fn the_surface_around_a_place_is_that_of_the_mesh_with_its_ground() {
        let (_folder, file) = saved();
        let map = Map::load(&file, &options()).unwrap();
        let near = map
            .mesh_near(&[[600.0, 0.0].into()], 10.0, DVec3::ZERO, u64::MAX)
            .unwrap();
        let area_m2 = |mesh: &TriangleMesh, is_ground: bool| -> f32 {
            let of_kind = |&triangle: &usize| {
                let red = mesh.colors[mesh.triangles[triangle][0] as usize][0] > 0;
                let middle: Vec3 = mesh.corners(triangle).into_iter().sum::<Vec3>() / 3.0;
                red == is_ground && (550.0..650.0).contains(&middle.x)
            };
            let triangles = (0..mesh.triangles.len()).filter(of_kind);
            triangles
                .map(|triangle| mesh.scaled_normal(triangle).length() / 2.0)
                .sum()
        };
        for is_ground in [true, false] {
            let (found, expected) = (area_m2(&near, is_ground), area_m2(&street(), is_ground));
            assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
        }
        let fewer = near.triangles.len() as u64 / 2;
        let coarse = map
            .mesh_near(&[[600.0, 0.0].into()], 10.0, DVec3::ZERO, fewer)
            .unwrap();
        assert!((1..=fewer).contains(&(coarse.triangles.len() as u64)));
        assert!((coarse.vertices.iter()).all(|vertex| near.vertices.contains(vertex)));
    }
}
