//! Where the tiles of a map file are kept.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Where [`Map::load`](crate::map::Map::load) keeps the tiles and panoramas that it makes of a map file, and finds those
/// that it has made before.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapCache {
    /// Nowhere: the whole map is in memory, and nothing is written.
    #[default]
    None,
    /// In a folder next to the file, with its name and `.tiles`.
    NextToMap,
    /// In a folder of their own for each file in this folder.
    Folder(PathBuf),
}

impl MapCache {
    /// The folder of the tiles of a mesh file.
    pub(crate) fn folder_of(&self, mesh_file: &Path) -> Option<PathBuf> {
        match self {
            Self::None => None,
            Self::NextToMap => {
                let mut name = mesh_file.as_os_str().to_owned();
                name.push(".tiles");
                Some(name.into())
            }
            Self::Folder(folder) => {
                let whole = std::path::absolute(mesh_file).unwrap_or_else(|_| mesh_file.to_owned());
                let hash = crc32fast::hash(whole.as_os_str().as_encoded_bytes());
                let mut name = mesh_file.file_name().unwrap_or_default().to_owned();
                name.push(format!(".{hash:08x}.tiles"));
                Some(folder.join(name))
            }
        }
    }
}
