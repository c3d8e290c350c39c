//! Files of tiles: what localization needs of a square of a map, to be mapped into memory, and an index of them.
//!
//! ```text
//! COLUMN_ROW.STAMP.tile      header, scene (see [`Tile`]), one bit per triangle: whether it is ground, table of the
//!                            chunks of the ground, their heights
//! index                      header, path of the mapping drive, tiles
//! ```
//!
//! Each part begins at a multiple of 64 bytes. Numbers are little-endian; on another machine the version
//! differs. The checksums (CRC-32) of a tile are those of its triangles and of its ground, that of an index is of its
//! path and its tiles. The stamp is that of the map and of how it was divided.

use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::grid::TileIndex;
use crate::geometry::{Aabb, TriangleMesh, Vec3};
use crate::map::files::mapping_path::MappingPath;
use crate::map::ground::heights::Cell;
use crate::raycasting::{Tile, TileProblem};
use crate::shared_bytes::{SharedBytes, join};

/// Version of both files.
const VERSION: u32 = 3;
pub(crate) const TILE_MAGIC: [u8; 8] = *b"fpmcltil";
pub(crate) const INDEX_MAGIC: [u8; 8] = *b"fpmclidx";

/// Name of the index in its folder.
pub(crate) const INDEX: &str = "index";
/// Ending of the names of tiles.
pub(crate) const ENDING: &str = ".tile";

/// What a tile begins with.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct TileHeader {
    magic: [u8; 8],
    version: u32,
    /// Checksum of the scene and the bits.
    scene_checksum: u32,
    scene_bytes: u64,
    chunks: u64,
    chunk_bytes: u64,
    triangles: u64,
    /// Checksum of the table and the heights.
    ground_checksum: u32,
    /// Stamp of its name.
    stamp: u32,
    column: i64,
    row: i64,
    unused: [u8; 56],
}

impl TileHeader {
    /// Sizes of the header and of all parts, in their order [bytes].
    fn sizes(&self) -> [u64; 5] {
        [
            size_of::<Self>() as u64,
            self.scene_bytes,
            self.triangles.div_ceil(8),
            (self.chunks).saturating_mul(size_of::<ChunkEntry>() as u64),
            self.chunk_bytes,
        ]
    }
}

/// A chunk of the ground.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct ChunkEntry {
    column: i64,
    row: i64,
    /// Where its heights begin among those of all chunks [bytes].
    begin: u64,
    /// Number of the bytes.
    bytes: u64,
}

/// What localization needs of a square of a map. The ground is read when the file is opened, the triangles when they are
/// needed.
#[derive(Debug)]
pub(crate) struct TileFile {
    scene: SharedBytes,
    is_ground: SharedBytes,
    scene_checksum: u32,
    chunks: Vec<ChunkEntry>,
    heights: SharedBytes,
}

/// The triangles of a tile.
#[derive(Debug)]
pub(crate) struct TileScene {
    /// `None` where no triangle has an area.
    pub tile: Option<Tile>,
    is_ground: SharedBytes,
}

/// The bytes of a tile: a part of the mesh of a map relative to `origin`, the chunks of the ground in it, and which
/// triangles are ground.
pub(crate) fn encode(
    (index, stamp): (TileIndex, u32),
    part: &TriangleMesh,
    origin: DVec3,
    chunks: &[(Cell, SharedBytes)],
    is_ground: impl Fn(usize) -> bool,
) -> (Vec<u8>, Option<Aabb>) {
    let scene = Tile::at(origin, part);
    let mut entries = Vec::new();
    let mut heights = Vec::new();
    for ((column, row), bytes) in chunks {
        entries.push(ChunkEntry {
            column: *column,
            row: *row,
            begin: heights.len() as u64,
            bytes: bytes.len() as u64,
        });
        heights.extend_from_slice(bytes);
    }
    let mut bits = vec![0_u8; part.triangles.len().div_ceil(8)];
    (0..part.triangles.len())
        .filter(|&triangle| is_ground(triangle))
        .for_each(|triangle| bits[triangle / 8] |= 1 << (triangle % 8));
    let mut header = TileHeader {
        magic: TILE_MAGIC,
        version: VERSION,
        scene_checksum: 0,
        scene_bytes: scene.as_ref().map_or(0, |tile| tile.as_bytes().len()) as u64,
        chunks: entries.len() as u64,
        chunk_bytes: heights.len() as u64,
        triangles: part.triangles.len() as u64,
        ground_checksum: 0,
        stamp,
        column: index.column,
        row: index.row,
        unused: [0; 56],
    };
    let parts: [&[u8]; 4] = [
        scene.as_ref().map_or(&[], Tile::as_bytes),
        &bits,
        bytemuck::cast_slice(&entries),
        &heights,
    ];
    header.scene_checksum = checksum_of([parts[0], parts[1]]);
    header.ground_checksum = checksum_of([parts[2], parts[3]]);
    let [scene_bytes, bits, entries, heights] = parts;
    let header = bytemuck::bytes_of(&header);
    let bytes = join(&[header, scene_bytes, bits, entries, heights]);
    (bytes, scene.map(|tile| tile.bounds()))
}

impl TileFile {
    /// Maps the file of a tile into memory and checks it.
    pub fn open(path: &Path, index: TileIndex, stamp: u32) -> Result<Self, TileProblem> {
        Self::decode(&SharedBytes::of_file(path)?, index, stamp)
    }

    /// Whether a file is a tile of this version, and as long as its header says.
    pub fn is_whole(path: &Path) -> bool {
        let file = SharedBytes::of_file(path);
        file.is_ok_and(|file| {
            let header: Option<TileHeader> = file.header(TILE_MAGIC, VERSION);
            header.is_some_and(|header| file.parts(header.sizes()).is_some())
        })
    }

    fn decode(file: &SharedBytes, index: TileIndex, stamp: u32) -> Result<Self, TileProblem> {
        let header = file.header(TILE_MAGIC, VERSION);
        let header: TileHeader = header.ok_or(TileProblem::Format)?;
        if (header.column, header.row, header.stamp) != (index.column, index.row, stamp) {
            return Err(TileProblem::Name);
        }
        let parts = file.parts(header.sizes()).ok_or(TileProblem::Format)?;
        let [_, scene, is_ground, entries, heights] = parts;
        if checksum_of([&entries, &heights]) != header.ground_checksum {
            return Err(TileProblem::Checksum);
        }
        Ok(Self {
            scene,
            is_ground,
            scene_checksum: header.scene_checksum,
            chunks: bytemuck::cast_slice(&entries).to_vec(),
            heights,
        })
    }

    /// The triangles, checked.
    pub fn scene(&self) -> Result<TileScene, TileProblem> {
        if checksum_of([&self.scene, &self.is_ground]) != self.scene_checksum {
            return Err(TileProblem::Checksum);
        }
        let tile = if self.scene.is_empty() {
            None
        } else {
            Some(Tile::from_bytes(self.scene.clone()).ok_or(TileProblem::Format)?)
        };
        Ok(TileScene {
            tile,
            is_ground: self.is_ground.clone(),
        })
    }

    /// Memory of the ground [bytes].
    pub fn ground_bytes(&self) -> usize {
        /// What systems map besides, around the pages that are looked at.
        const AROUND: usize = 128 << 10;
        self.heights.len() + AROUND
    }

    /// The heights of a chunk of the ground; `None` where the tile has none.
    pub fn chunk(&self, (column, row): Cell) -> Option<SharedBytes> {
        let is_it = |entry: &&ChunkEntry| (entry.column, entry.row) == (column, row);
        let entry = self.chunks.iter().find(is_it)?;
        let begin = entry.begin as usize;
        self.heights.part(begin..begin + entry.bytes as usize)
    }
}

impl TileScene {
    /// Size [bytes].
    pub fn bytes(&self) -> usize {
        self.tile.as_ref().map_or(0, |tile| tile.as_bytes().len())
    }

    /// Whether a triangle is ground.
    pub fn is_ground(&self, triangle: u32) -> bool {
        let byte = self.is_ground.get(triangle as usize / 8);
        byte.is_some_and(|byte| byte >> (triangle % 8) & 1 == 1)
    }
}

/// Checksum of two parts.
fn checksum_of(parts: [&[u8]; 2]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    parts.iter().for_each(|part| hasher.update(part));
    hasher.finalize()
}

/// A map as it was when its tiles were made.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Source {
    /// Length of the file [bytes].
    pub bytes: u64,
    /// When it was changed last [ns since 1970].
    pub modified_ns: u64,
    /// Checksum of its bytes.
    pub checksum: u32,
    /// Whether a path was given next to the map.
    pub has_given_path: u32,
    /// Side of a tile [m].
    pub side_m: f64,
    /// Edge of a cell of the ground [m].
    pub ground_cell_m: f64,
}

impl Source {
    /// What tells tiles of this map from others: the same for a copy.
    pub fn stamp(&self) -> u32 {
        let timeless = Self {
            modified_ns: 0,
            ..*self
        };
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(&VERSION.to_le_bytes());
        hasher.update(bytemuck::bytes_of(&timeless));
        hasher.finalize()
    }
}

/// A tile in the index.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct TileEntry {
    pub column: i64,
    pub row: i64,
    /// Lower and upper corner of the triangles [m]; not finite where none has an area.
    bounds: [f32; 6],
    pub triangles: u64,
}

impl TileEntry {
    pub fn new(index: TileIndex, bounds: Option<Aabb>, triangles: usize) -> Self {
        let Aabb { min, max } = bounds.unwrap_or(Aabb::EMPTY);
        Self {
            column: index.column,
            row: index.row,
            bounds: [min.x, min.y, min.z, max.x, max.y, max.z],
            triangles: triangles as u64,
        }
    }

    pub fn index(&self) -> TileIndex {
        TileIndex {
            column: self.column,
            row: self.row,
        }
    }

    /// Box around the triangles [m].
    pub fn bounds(&self) -> Aabb {
        let [a, b, c, d, e, f] = self.bounds;
        Aabb {
            min: Vec3::new(a, b, c),
            max: Vec3::new(d, e, f),
        }
    }

    /// Name of the file.
    pub fn file(&self, folder: &Path, stamp: u32) -> PathBuf {
        folder.join(format!("{}_{}.{stamp:08x}{ENDING}", self.column, self.row))
    }
}

/// What an index begins with.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct IndexHeader {
    magic: [u8; 8],
    version: u32,
    checksum: u32,
    source: Source,
    /// Length of the comments of the path; 0 without one [bytes].
    path_bytes: u64,
    tiles: u64,
    unused: [u8; 56],
}

/// The tiles of a map.
#[derive(Clone, Debug)]
pub(crate) struct TileFileIndex {
    pub source: Source,
    /// That of the mesh file.
    pub path: Option<MappingPath>,
    pub tiles: Vec<TileEntry>,
}

impl TileFileIndex {
    pub fn encode(&self) -> Vec<u8> {
        let path = self.path.as_ref().map(|path| path.to_comments().join("\n"));
        let path = path.unwrap_or_default();
        let mut header = IndexHeader {
            magic: INDEX_MAGIC,
            version: VERSION,
            checksum: 0,
            source: self.source,
            path_bytes: path.len() as u64,
            tiles: self.tiles.len() as u64,
            unused: [0; 56],
        };
        let parts = [path.as_bytes(), bytemuck::cast_slice(&self.tiles)];
        header.checksum = checksum_of(parts);
        join(&[bytemuck::bytes_of(&header), parts[0], parts[1]])
    }

    pub fn decode(bytes: &[u8]) -> Result<Self, TileProblem> {
        let file = SharedBytes::from(bytes);
        let header = file.header(INDEX_MAGIC, VERSION);
        let header: IndexHeader = header.ok_or(TileProblem::Format)?;
        let sizes = [
            size_of::<IndexHeader>() as u64,
            header.path_bytes,
            header.tiles.saturating_mul(size_of::<TileEntry>() as u64),
        ];
        let [_, path, tiles] = file.parts(sizes).ok_or(TileProblem::Format)?;
        if checksum_of([&path, &tiles]) != header.checksum {
            return Err(TileProblem::Checksum);
        }
        let path = std::str::from_utf8(&path).ok();
        let path = path.and_then(|text| MappingPath::from_comments(text.lines()).ok());
        Ok(Self {
            source: header.source,
            path: path.ok_or(TileProblem::Format)?,
            tiles: bytemuck::cast_slice(&tiles).to_vec(),
        })
    }
}
