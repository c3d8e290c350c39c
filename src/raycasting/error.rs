//! Errors of the tiles of a map.

use std::path::PathBuf;
use std::sync::Arc;

/// A tile of a map cannot be read. Clones share the cause.
#[derive(Clone, Debug, thiserror::Error)]
#[error("the tile {}: {problem}; delete this file: it is made again from the map", file.display())]
pub struct TileError {
    /// File of the tile.
    pub file: PathBuf,
    /// What is wrong with it.
    pub problem: Arc<TileProblem>,
}

impl TileError {
    /// A file and what is wrong with it.
    pub(crate) fn new(file: PathBuf, problem: TileProblem) -> Self {
        Self {
            file,
            problem: Arc::new(problem),
        }
    }
}

/// What is wrong with a tile.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum TileProblem {
    #[error("{0}")]
    Read(#[from] std::io::Error),
    #[error("it is not a tile of this version of fpmcl, or it is incomplete")]
    Format,
    #[error("it is another tile under this name")]
    Name,
    #[error("its checksum is wrong")]
    Checksum,
}
