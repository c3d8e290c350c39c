//! The files in a folder of tiles that the program wrote, and how many it keeps.
//!
//! Each height and sensor has panoramas of its own, about 9 MB for a town. Of these, the least recently used are removed
//! once all take more than [`PANORAMA_BYTES`].

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::file::{ENDING, INDEX, INDEX_MAGIC, TILE_MAGIC};
use crate::files::{Place, UnlockedOnDrop, require_no_link, require_own};
use crate::map::places::panorama_file::MAGIC as PANORAMA_MAGIC;

/// Ending of the names of files of panoramas.
pub(super) const PANORAMAS: &str = ".panoramas";

/// Largest size of all panoramas of a map, about those of seven heights and sensors in a town; the newest are kept in any
/// case [bytes].
const PANORAMA_BYTES: u64 = 64 << 20;

/// What a file of a cache is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CacheKind {
    Index,
    Tile,
    Panoramas,
}

/// A file of a cache, which the program wrote.
#[derive(Clone, Debug)]
pub(crate) struct CacheFile {
    pub path: PathBuf,
    pub kind: CacheKind,
    /// Size [bytes].
    pub bytes: u64,
    /// When it was written or, of panoramas, used.
    used: SystemTime,
}

/// The files of a cache, without those of others; none where there is no folder.
pub(crate) fn files_of(folder: &Path) -> io::Result<Vec<CacheFile>> {
    require_no_link(folder)?;
    // An error where the folder was claimed and another one is in its place now.
    Place::of(&folder.join(INDEX))?;
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let (kind, magic) = match &*name {
            INDEX => (CacheKind::Index, INDEX_MAGIC),
            name if name.ends_with(ENDING) => (CacheKind::Tile, TILE_MAGIC),
            name if name.ends_with(PANORAMAS) => (CacheKind::Panoramas, PANORAMA_MAGIC),
            _ => continue,
        };
        // Another process may have removed it by now.
        if let (Ok(()), Ok(found)) = (require_own(&path, Some(magic)), fs::symlink_metadata(&path))
        {
            files.push(CacheFile {
                bytes: found.len(),
                used: found.modified()?,
                path,
                kind,
            });
        }
    }
    files.sort_by(|a, b| (a.used, &a.path).cmp(&(b.used, &b.path)));
    Ok(files)
}

/// Marks panoramas as used now.
pub(crate) fn mark_used(panoramas: &Path) {
    // Without permission they count as unused.
    let _ = File::open(panoramas).and_then(|file| file.set_modified(SystemTime::now()));
}

/// Removes the least recently used panoramas next to a file of panoramas, which is kept.
pub(crate) fn remove_unused(newest: &Path) -> io::Result<()> {
    let files = files_of(newest.parent().unwrap_or(Path::new("")))?;
    let panoramas = || files.iter().filter(|it| it.kind == CacheKind::Panoramas);
    let mut bytes: u64 = panoramas().map(|it| it.bytes).sum();
    for file in panoramas().filter(|it| it.path != newest) {
        if bytes <= PANORAMA_BYTES {
            break;
        }
        fs::remove_file(&file.path)?;
        bytes -= file.bytes;
    }
    Ok(())
}

/// Whether a process uses the tiles of a folder.
pub(crate) fn is_in_use(folder: &Path) -> bool {
    let opened = File::open(folder).map(UnlockedOnDrop);
    opened.is_ok_and(|it| matches!(it.0.try_lock(), Err(TryLockError::WouldBlock)))
}

/// Removes a cache; files of others, and their folder, stay.
pub(crate) fn clear(folder: &Path) -> io::Result<()> {
    if is_in_use(folder) {
        return Err(io::Error::other("another process uses it"));
    }
    for file in files_of(folder)? {
        fs::remove_file(file.path)?;
    }
    match fs::remove_dir(folder) {
        Err(error)
            if !matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::DirectoryNotEmpty
            ) =>
        {
            Err(error)
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_least_recently_used_panoramas_go_and_files_of_others_stay() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        // Sparse files.
        let write = |name: &str, bytes: u64, age_s: u64| {
            fs::write(path(name), PANORAMA_MAGIC).unwrap();
            let file = File::options().write(true).open(path(name)).unwrap();
            file.set_len(bytes).unwrap();
            let age = Duration::from_secs(age_s);
            file.set_modified(SystemTime::now() - age).unwrap();
        };
        let third = PANORAMA_BYTES / 3;
        for (name, age_s) in [("a", 40), ("b", 30), ("c", 20), ("d", 10)] {
            write(&format!("{name}{PANORAMAS}"), third, age_s);
        }
        fs::write(path("own.panoramas"), "my own").unwrap();
        mark_used(&path("a.panoramas"));
        remove_unused(&path("d.panoramas")).unwrap();
        let left = |name: &str| path(name).exists();
        assert!(left("a.panoramas") && !left("b.panoramas") && left("c.panoramas"));
        assert!(left("d.panoramas") && left("own.panoramas"));
        write("huge.panoramas", 2 * PANORAMA_BYTES, 50);
        remove_unused(&path("huge.panoramas")).unwrap();
        assert_eq!(files_of(folder.path()).unwrap().len(), 1);
        clear(folder.path()).unwrap();
        assert!(!left("huge.panoramas") && left("own.panoramas"));
        fs::remove_file(path("own.panoramas")).unwrap();
        clear(folder.path()).unwrap();
        assert!(!folder.path().exists());
        clear(folder.path()).unwrap();
    }
}
