//! Atomic writing of files: a file is complete or does not exist.
//!
//! The temporary file of `map.ply` is `.fpmcl-map.ply-XXXXXX.part` in the same folder. It is locked
//! while it is written, so that one that a killed process left is known by being unlocked.
//!
//! Nothing is written below a claimed folder once its path leads elsewhere, such as through a link that
//! replaced the folder while the program ran. On Linux files are opened relative to the folder that was claimed, so that
//! this holds between a check and a write, too.

use std::fs::{self, File, TryLockError};
use std::io::{self, BufWriter, Read as _, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tempfile::{Builder, NamedTempFile};

/// Temporary files of writes that are under way.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Claimed folders.
static CLAIMED: Mutex<Vec<Claimed>> = Mutex::new(Vec::new());

/// A folder as it was when it was claimed.
#[derive(Clone)]
struct Claimed {
    path: PathBuf,
    identity: Identity,
    folder: Arc<Folder>,
}

/// What tells a folder from another at the same path: device and inode.
#[cfg(unix)]
type Identity = (u64, u64);
/// What tells a folder from another at the same path: the path without links.
#[cfg(not(unix))]
type Identity = PathBuf;

/// An open folder, which keeps its path valid when it is moved.
#[cfg(target_os = "linux")]
type Folder = std::os::fd::OwnedFd;
/// Nothing where paths cannot begin at an open folder.
#[cfg(not(target_os = "linux"))]
type Folder = ();

const PREFIX: &str = ".fpmcl-";
/// Random characters in the name of a temporary file.
const RANDOM: usize = 6;
const SUFFIX: &str = ".part";

/// Writes a temporary file in the folder of `path`, which must exist, and renames it to `path` once
/// it is complete. On an error or an interruption, `path` is unchanged.
pub fn write_atomically<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> Result<T, E>,
) -> Result<T, E> {
    let mut file = AtomicFile::create(path)?;
    let mut writer = BufWriter::new(file.temporary.as_file_mut());
    let outcome = write(&mut writer)?;
    writer.flush()?;
    drop(writer);
    file.persist()?;
    Ok(outcome)
}

/// A temporary file that becomes the file at a path once it is complete; dropped, it is removed.
pub struct AtomicFile {
    path: PathBuf,
    temporary: NamedTempFile,
    _unfinished: Unfinished,
    place: Place,
}

impl AtomicFile {
    /// Creates the temporary file in the folder of `path`, which must exist.
    pub fn create(path: &Path) -> io::Result<Self> {
        let place = Place::of(path)?;
        let mut unfinished = unfinished();
        let temporary = temporary_next_to(&place.path)?;
        unfinished.push(temporary.path().to_owned());
        Ok(Self {
            path: path.to_owned(),
            _unfinished: Unfinished(temporary.path().to_owned()),
            temporary,
            place,
        })
    }

    /// The temporary file.
    pub fn file(&self) -> &File {
        self.temporary.as_file()
    }

    /// Renames the temporary file to the path.
    pub fn persist(self) -> io::Result<()> {
        check_claimed(&self.path)?;
        let persisted = self.temporary.persist(&self.place.path);
        persisted.map(drop).map_err(|failed| failed.error)
    }
}

/// A file that is written under a name of its own and renamed by [`persist`](Self::persist). Without that, or
/// [`remove`](Self::remove), it stays, as after SIGKILL or on a full disk; it is locked while it is written.
pub struct GrowingFile {
    path: PathBuf,
    file: File,
    unfinished: Place,
    place: Place,
}

impl GrowingFile {
    /// Creates the file at `unfinished`, in the folder of `path`, which must exist, and replaces one that no process has locked.
    pub fn create(path: &Path, unfinished: &Path) -> io::Result<Self> {
        let (place, unfinished) = (Place::of(path)?, Place::of(unfinished)?);
        if let Ok(left) = File::open(&unfinished.path) {
            let is_written = matches!(left.try_lock(), Err(TryLockError::WouldBlock));
            if is_written {
                return Err(io::Error::other("another process is writing there"));
            }
            fs::remove_file(&unfinished.path)?;
        }
        // Through no link.
        let file = (File::options().write(true).create_new(true)).open(&unfinished.path)?;
        // Some file systems have no locks.
        let _ = file.try_lock();
        Ok(Self {
            path: path.to_owned(),
            file,
            unfinished,
            place,
        })
    }

    /// The file.
    pub fn file(&self) -> &File {
        &self.file
    }

    /// Renames the file to its final path.
    pub fn persist(self) -> io::Result<()> {
        check_claimed(&self.path)?;
        fs::rename(&self.unfinished.path, &self.place.path)
    }

    /// Removes the file.
    pub fn remove(self) -> io::Result<()> {
        fs::remove_file(&self.unfinished.path)
    }
}

/// An open file that is unlocked when it is dropped. Closing it is not enough: a process that is being started holds a copy of it
/// for a moment.
#[derive(Debug)]
pub struct UnlockedOnDrop(pub File);

impl Drop for UnlockedOnDrop {
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

/// Where a file is written: below a claimed folder, at a path that begins at the folder that was claimed.
pub struct Place {
    /// The path, valid as long as this lives.
    pub path: PathBuf,
    _folder: Option<Arc<Folder>>,
}

impl Place {
    /// The place of a file; an error if a claimed folder above it was replaced, or a folder between them is a link.
    pub fn of(path: &Path) -> io::Result<Self> {
        let elsewhere = Self {
            path: path.to_owned(),
            _folder: None,
        };
        let Some((claimed, below)) = check_claimed(path)? else {
            return Ok(elsewhere);
        };
        let Some(name) = path.file_name() else {
            return Ok(elsewhere);
        };
        Ok(match inside(&claimed.folder, &below)? {
            Some((folder, path)) => Self {
                path: path.join(name),
                _folder: Some(folder),
            },
            None => elsewhere,
        })
    }
}

/// The open folder at a path below an open one, through no link, and its path; `None` where there are no such paths.
#[cfg(target_os = "linux")]
fn inside(folder: &Arc<Folder>, below: &Path) -> io::Result<Option<(Arc<Folder>, PathBuf)>> {
    use std::os::fd::AsRawFd as _;
    let mut folder = Arc::clone(folder);
    for name in below {
        folder = Arc::new(rustix::fs::openat(
            &*folder,
            name,
            FOLDER | rustix::fs::OFlags::NOFOLLOW,
            rustix::fs::Mode::empty(),
        )?);
    }
    let path = Path::new("/proc/self/fd").join(folder.as_raw_fd().to_string());
    Ok(path.is_dir().then_some((folder, path)))
}

#[cfg(not(target_os = "linux"))]
fn inside(_folder: &Arc<Folder>, _below: &Path) -> io::Result<Option<(Arc<Folder>, PathBuf)>> {
    Ok(None)
}

/// How a folder is opened that paths begin at: it need not be readable.
#[cfg(target_os = "linux")]
const FOLDER: rustix::fs::OFlags = rustix::fs::OFlags::PATH
    .union(rustix::fs::OFlags::DIRECTORY)
    .union(rustix::fs::OFlags::CLOEXEC);

#[cfg(target_os = "linux")]
fn open_folder(path: &Path) -> io::Result<Folder> {
    Ok(rustix::fs::open(path, FOLDER, rustix::fs::Mode::empty())?)
}

#[cfg(not(target_os = "linux"))]
fn open_folder(_path: &Path) -> io::Result<Folder> {
    Ok(())
}

/// Remembers which folder a path is now; [`check_claimed`] compares.
pub fn claim_folder(path: &Path) -> io::Result<()> {
    let claim = Claimed {
        path: path.to_owned(),
        identity: identity(path)?,
        folder: Arc::new(open_folder(path)?),
    };
    let mut claimed = lock(&CLAIMED);
    claimed.retain(|other| other.path != path);
    claimed.push(claim);
    Ok(())
}

/// A folder that is claimed while this lives, for work in it that ends.
pub struct FolderClaim(PathBuf);

impl FolderClaim {
    /// As [`claim_folder`].
    pub fn new(path: &Path) -> io::Result<Self> {
        claim_folder(path)?;
        Ok(Self(path.to_owned()))
    }
}

impl Drop for FolderClaim {
    fn drop(&mut self) {
        lock(&CLAIMED).retain(|claimed| claimed.path != self.0);
    }
}

/// An error if a claimed folder above `path` was replaced, or a folder between them is a link. Returns the claimed folder,
/// if there is one, and the path from there to the folder of `path`.
fn check_claimed(path: &Path) -> io::Result<Option<(Claimed, PathBuf)>> {
    let mut innermost: Option<(Claimed, PathBuf)> = None;
    for claimed in lock(&CLAIMED).iter() {
        let folder = &claimed.path;
        let Ok(below) = folder_of(path).strip_prefix(folder) else {
            continue;
        };
        if identity(folder)? != claimed.identity {
            return Err(replaced(folder));
        }
        for inner in below.ancestors().filter(|it| !it.as_os_str().is_empty()) {
            let inner = folder.join(inner);
            if fs::symlink_metadata(&inner).is_ok_and(|found| found.is_symlink()) {
                return Err(replaced(&inner));
            }
        }
        let is_inner =
            (innermost.as_ref()).is_none_or(|(other, _)| folder.starts_with(&other.path));
        if is_inner {
            innermost = Some((claimed.clone(), below.to_owned()));
        }
    }
    Ok(innermost)
}

fn replaced(folder: &Path) -> io::Error {
    io::Error::other(format!(
        "the folder {} was replaced while the program ran; nothing is written there",
        folder.display()
    ))
}

#[cfg(unix)]
fn identity(folder: &Path) -> io::Result<Identity> {
    use std::os::unix::fs::MetadataExt as _;
    let found = fs::metadata(folder)?;
    Ok((found.dev(), found.ino()))
}

#[cfg(not(unix))]
fn identity(folder: &Path) -> io::Result<Identity> {
    folder.canonicalize()
}

/// Requires that a file of this program can be written at a path: there is none, or one that is empty or begins with
/// `magic`, which is `None` for files that are always empty. A link, or a file of another program, is an error.
pub fn require_own(path: &Path, magic: Option<[u8; 8]>) -> io::Result<()> {
    let begins_with_magic = || {
        let mut begin = [0; 8];
        let read = File::open(path).and_then(|mut file| file.read_exact(&mut begin));
        read.is_ok() && Some(begin) == magic
    };
    match fs::symlink_metadata(path) {
        Ok(found) if found.is_file() && (found.len() == 0 || begins_with_magic()) => Ok(()),
        Ok(_) => Err(io::Error::other(format!(
            "{} is not a file that fpmcl wrote; move it elsewhere",
            path.display()
        ))),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
    }
}

/// Requires that a file or folder is not a link to one elsewhere.
pub fn require_no_link(path: &Path) -> io::Result<()> {
    if fs::symlink_metadata(path).is_ok_and(|found| found.is_symlink()) {
        return Err(io::Error::other("it is a link; remove it"));
    }
    Ok(())
}

/// Removes the temporary files of all writes that are under way, and lets none finish; for the moment
/// before the process ends.
pub fn abandon_writes() {
    let unfinished = unfinished();
    for path in unfinished.iter() {
        // There is nobody left to whom a failure matters.
        let _ = fs::remove_file(path);
    }
    // A write that goes on must not begin another file.
    std::mem::forget(unfinished);
}

fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    lock(&UNFINISHED)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Entry of a temporary file among the unfinished ones.
struct Unfinished(PathBuf);

impl Drop for Unfinished {
    fn drop(&mut self) {
        unfinished().retain(|path| *path != self.0);
    }
}

/// Creates the temporary file of `path` in its folder. Its permissions are those that the umask
/// allows, as of other files.
pub fn temporary_next_to(path: &Path) -> io::Result<NamedTempFile> {
    let mut builder = Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    let temporary = builder
        .prefix(&temporary_prefix(path))
        .rand_bytes(RANDOM)
        .suffix(SUFFIX)
        .tempfile_in(folder_of(path))
        .map_err(without_path)?;
    // Some file systems have no locks; what is left there stays.
    let _ = temporary.as_file().try_lock();
    Ok(temporary)
}

/// The error of the system in one that names a temporary file, which means nothing to users.
fn without_path(error: io::Error) -> io::Error {
    let inner = error.get_ref().and_then(|inner| inner.source());
    let inner = inner.and_then(|inner| inner.downcast_ref::<io::Error>());
    let code = inner.and_then(io::Error::raw_os_error);
    code.map_or(error, io::Error::from_raw_os_error)
}

/// Removes the temporary files of `path` that killed processes left, and if it is a folder, those
/// of all files below it.
pub fn remove_abandoned(path: &Path) -> io::Result<()> {
    let prefix = temporary_prefix(path);
    let length = prefix.len() + RANDOM + SUFFIX.len();
    remove_unlocked(folder_of(path), &|name| {
        name.starts_with(&prefix) && name.len() == length
    })?;
    remove_abandoned_below(path)
}

fn remove_abandoned_below(folder: &Path) -> io::Result<()> {
    if !fs::symlink_metadata(folder).is_ok_and(|found| found.is_dir()) {
        return Ok(());
    }
    for entry in fs::read_dir(folder)? {
        remove_abandoned_below(&entry?.path())?;
    }
    remove_unlocked(folder, &|name| name.starts_with(PREFIX))
}

/// Removes the unlocked temporary files of a folder whose names match.
fn remove_unlocked(folder: &Path, matches: &dyn Fn(&str) -> bool) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.ends_with(SUFFIX)
            && matches(&name)
            && entry.file_type()?.is_file()
            && File::open(entry.path()).is_ok_and(|file| file.try_lock().is_ok())
        {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Whether the name of a file ends in an extension, in small or capital letters.
pub fn has_extension(path: &Path, extension: &str) -> bool {
    (path.extension()).is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// The folder of a file.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The start of the names of the temporary files of `path`, short enough for file systems.
fn temporary_prefix(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let name: String = name.chars().take(50).collect();
    format!("{PREFIX}{name}-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_what_was_there_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.json");
        fs::write(&path, "old").unwrap();
        let outcome: io::Result<()> = write_atomically(&path, |writer| {
            writer.write_all(b"half of the n")?;
            Err(io::Error::other("the disk is full"))
        });
        assert_eq!(outcome.unwrap_err().to_string(), "the disk is full");
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_whole_write_replaces_what_was_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.json");
        for text in ["old", "new"] {
            write(&path, text).unwrap();
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
    }

    #[cfg(unix)]
    #[test]
    fn nothing_is_written_through_a_link_that_replaced_a_claimed_folder() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in ["results/plots", "others/plots"] {
            fs::create_dir_all(path(name)).unwrap();
        }
        fs::write(path("others/frames.csv"), "theirs").unwrap();
        claim_folder(&path("results")).unwrap();
        write(&path("results/plots/map.png"), "ours").unwrap();

        fs::rename(path("results/plots"), path("results/moved")).unwrap();
        symlink(path("others/plots"), path("results/plots")).unwrap();
        let failed = write(&path("results/plots/map.png"), "ours").unwrap_err();
        assert!(failed.to_string().contains("was replaced"), "{failed}");
        assert!(!path("others/plots/map.png").exists());
        write(&path("results/frames.csv"), "ours").unwrap();

        // Replaced while the file is being written.
        let replaced: io::Result<()> = write_atomically(&path("results/frames.csv"), |writer| {
            fs::rename(path("results"), path("moved"))?;
            symlink(path("others"), path("results"))?;
            writer.write_all(b"new")
        });
        let failed = replaced.unwrap_err();
        assert!(failed.to_string().contains("was replaced"), "{failed}");
        let failed = write(&path("results/frames.csv"), "ours").unwrap_err();
        assert!(failed.to_string().contains("was replaced"), "{failed}");
        let read = |name: &str| fs::read_to_string(path(name)).unwrap();
        assert_eq!(read("others/frames.csv"), "theirs");
        assert_eq!(read("moved/frames.csv"), "ours");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_place_that_was_checked_stays_in_the_folder_that_was_claimed() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in ["results/plots", "others/plots"] {
            fs::create_dir_all(path(name)).unwrap();
        }
        claim_folder(&path("results")).unwrap();
        let places = ["results/frames.csv", "results/plots/map.png"];
        let places = places.map(|name| Place::of(&path(name)).unwrap());
        fs::rename(path("results"), path("moved")).unwrap();
        std::os::unix::fs::symlink(path("others"), path("results")).unwrap();
        for place in &places {
            fs::write(&place.path, "ours").unwrap();
        }
        for name in ["frames.csv", "plots/map.png"] {
            assert_eq!(
                fs::read_to_string(path("moved").join(name)).unwrap(),
                "ours"
            );
            assert!(!path("others").join(name).exists());
        }
    }

    #[test]
    fn a_folder_that_vanished_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gone/report.json");
        assert_eq!(
            write(&path, "text").unwrap_err().kind(),
            io::ErrorKind::NotFound
        );
        assert!(!folder.path().join("gone").exists());
    }

    #[test]
    fn only_unlocked_temporary_files_of_the_same_target_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::create_dir_all(path("plots/inner")).unwrap();
        let others = [".fpmcl-a-b-123456.part", ".fpmcl-ab-123456.part", "a"];
        let abandoned = [".fpmcl-a-123456.part", "plots/inner/.fpmcl-c-123456.part"];
        for name in others.iter().chain(&abandoned) {
            fs::write(path(name), "").unwrap();
        }
        let in_use = temporary_next_to(&path("a")).unwrap();
        for name in ["a", "plots", "missing"] {
            remove_abandoned(&path(name)).unwrap();
        }
        assert!(others.iter().all(|name| path(name).exists()));
        assert!(!abandoned.iter().any(|name| path(name).exists()));
        assert!(in_use.path().exists());
    }

    fn write(path: &Path, text: &str) -> io::Result<()> {
        write_atomically(path, |writer| writer.write_all(text.as_bytes()))
    }
}
