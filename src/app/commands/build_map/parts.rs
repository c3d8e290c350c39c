//! Finished local maps on disk, from which an interrupted build resumes.
//!
//! While a map is being built, the folder `<map>.parts` next to it holds per local map a mesh, and its
//! counts with the hashes of its scans and of the mesh; the claim of the map with the key of all other inputs; and a
//! file that the build locks. Parts of other inputs are deleted, files of others never. A part is finished once its
//! counts exist, which are written last.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::app::run::artefact::hash::{hash_of_file, hash_of_texts};
use crate::app::run::{CLAIMS_FILE, Claims, Lock, output};
use crate::files::remove_abandoned;
use crate::map::files::mapped_ply::MappedPly;
use crate::map::files::ply;
use crate::map::{LocalMap, LocalMapCounts};
use crate::recording::RecordingError;

const LOCK_FILE: &str = "lock";

/// A finished local map next to its mesh.
#[derive(Serialize, Deserialize)]
struct Part {
    /// Hash of the scans that it was made of.
    scans_hash: String,
    /// Hash of the file of its mesh; `None` if it has no triangles.
    mesh_hash: Option<String>,
    counts: LocalMapCounts,
    /// Triangles of the older map that are gone.
    #[serde(default)]
    gone: Vec<u32>,
    /// Origin of the coordinates of its mesh in the map frame [m].
    #[serde(default)]
    origin: [f64; 3],
}

/// What local maps add to a map, and what is gone from it.
pub struct Joined {
    /// The meshes of the local maps, in order.
    pub meshes: Vec<MappedPly>,
    /// Triangles of the older map that are gone, ascending.
    pub gone: Vec<u32>,
}

/// What a process does of a build.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// All of it, or what comes before the local maps; alone. Parts of other inputs are deleted.
    Build,
    /// What comes after the local maps, which jobs have built; alone.
    Collect,
    /// One local map, next to other jobs.
    Job,
}

/// The folder of finished local maps of one build, locked. Dropping it removes the folder unless jobs were listed in it.
pub struct Parts {
    mesh_file: PathBuf,
    role: Role,
    folder: PathBuf,
    lock: Lock,
}

impl Drop for Parts {
    fn drop(&mut self) {
        let [claims, lock] = [CLAIMS_FILE, LOCK_FILE].map(|name| self.folder.join(name));
        // Another build may have locked the folder since the parts were removed.
        if claims.exists() || !self.lock.is_in_place() {
            return;
        }
        if fs::remove_file(lock).is_ok() && fs::remove_dir(&self.folder).is_err() {
            tracing::warn!("{} is kept: it has other files", self.folder.display());
        }
    }
}

impl Parts {
    /// Locks the folder next to `mesh_file`. A build makes it where it does not exist.
    pub fn lock(mesh_file: &Path, role: Role) -> Result<Self> {
        let mut name = mesh_file.file_name().unwrap_or_default().to_owned();
        name.push(".parts");
        let folder = mesh_file.with_file_name(name);
        let context = || format!("cannot use {} for unfinished maps", folder.display());
        match role {
            Role::Build => output::create_subfolder(&folder)?,
            _ => ensure!(folder.join(CLAIMS_FILE).exists(), not_listed(mesh_file)),
        }
        let is_early = |entry: &fs::DirEntry| {
            let name = entry.file_name();
            // A full disk may have kept the claim from being written.
            [LOCK_FILE, CLAIMS_FILE].iter().any(|early| name == *early)
                || name.to_string_lossy().starts_with(".fpmcl-")
        };
        ensure!(
            Claims::read(&folder)?.key(mesh_file).is_some()
                || entries(&folder)?.iter().all(is_early),
            "{} is needed for unfinished maps, but has files that fpmcl did not write; move it, or choose another mesh_file",
            folder.display()
        );
        let lock = lock(&folder, mesh_file, role)?;
        remove_abandoned(&folder).with_context(context)?;
        Ok(Self {
            mesh_file: mesh_file.to_owned(),
            role,
            folder,
            lock,
        })
    }

    /// Requires that the parts were made from `inputs`; a build deletes others.
    pub fn keep_those_of(&self, inputs: &str) -> Result<()> {
        let key = hash_of_texts(&[inputs]);
        if Claims::read(&self.folder)?.key(&self.mesh_file) == Some(key.as_str()) {
            return Ok(());
        }
        ensure!(self.role == Role::Build, not_listed(&self.mesh_file));
        self.remove_parts()?;
        Claims::read(&self.folder)?.begin_with_key(&self.mesh_file, &key)
    }

    /// The folder of the parts.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Whether a local map is finished and its mesh is there; its content is checked when the meshes are joined.
    pub fn has(&self, number: usize) -> bool {
        let part = self.read_counts(number);
        part.is_ok_and(|part| part.mesh_hash.is_none() || self.mesh_file(number).exists())
    }

    /// The counts of a local map if it is finished, with its mesh, and made of these scans.
    pub fn finished(
        &self,
        number: usize,
        scans_hash: impl FnOnce() -> Result<String, RecordingError>,
    ) -> Option<LocalMapCounts> {
        let part = self.read(number).ok()?;
        // A scan that cannot be read is reported by the build.
        let is_same = || scans_hash().is_ok_and(|hash| hash == part.scans_hash);
        is_same().then_some(part.counts)
    }

    /// Deletes a local map, its counts first.
    pub fn discard(&self, number: usize) -> Result<()> {
        output::remove_if_exists(&self.counts_file(number))?;
        output::remove_if_exists(&self.mesh_file(number))
    }

    /// Keeps a finished local map, after deleting one that was made of other scans.
    pub fn save(&self, number: usize, local_map: &LocalMap, scans_hash: &str) -> Result<()> {
        self.discard(number)?;
        let (counts, mesh) = (self.counts_file(number), self.mesh_file(number));
        let mut mesh_hash = None;
        if !local_map.mesh.triangles.is_empty() {
            ply::write(&mesh, &local_map.mesh, None)?;
            mesh_hash = Some(hash_of_file(&mesh)?);
        }
        let part = Part {
            scans_hash: scans_hash.to_owned(),
            mesh_hash,
            counts: local_map.counts.clone(),
            gone: local_map.gone.clone(),
            origin: local_map.origin.to_array(),
        };
        output::write_json(&counts, &part)
    }

    /// The meshes of the local maps 0..count, mapped into memory; an error if one is missing or damaged.
    pub fn joined(&self, count: usize) -> Result<Joined> {
        let (mut meshes, mut gone) = (Vec::with_capacity(count), Vec::new());
        for number in 0..count {
            let part = self.read(number).with_context(|| {
                let folder = self.folder.display();
                format!("{folder} has lost local map {number}; run the same command again")
            })?;
            if part.mesh_hash.is_some() {
                let path = self.mesh_file(number);
                let mut mesh = MappedPly::open(&path)
                    .with_context(|| format!("{} is damaged", path.display()))?;
                mesh.origin = DVec3::from_array(part.origin);
                meshes.push(mesh);
            }
            gone.extend(part.gone);
        }
        gone.sort_unstable();
        gone.dedup();
        Ok(Joined { meshes, gone })
    }

    /// Removes the parts, and the folder unless others have files in it.
    pub fn remove(self) -> Result<()> {
        self.remove_parts()
    }

    /// Reads a part; an error if it is missing, or its mesh is not the one that was written.
    fn read(&self, number: usize) -> Result<Part> {
        let part = self.read_counts(number)?;
        if let Some(hash) = &part.mesh_hash {
            let mesh = self.mesh_file(number);
            ensure!(
                hash_of_file(&mesh)? == *hash,
                "{} is damaged",
                mesh.display()
            );
        }
        Ok(part)
    }

    fn read_counts(&self, number: usize) -> Result<Part> {
        let counts = self.counts_file(number);
        let text =
            fs::read(&counts).with_context(|| format!("cannot read {}", counts.display()))?;
        serde_json::from_slice(&text).with_context(|| format!("{} is damaged", counts.display()))
    }

    /// Removes the parts, and after them the claim, which makes the folder ours.
    fn remove_parts(&self) -> Result<()> {
        let names = entries(&self.folder)?.into_iter();
        let names = names.map(|entry| entry.file_name().to_string_lossy().into_owned());
        let mut names: Vec<String> = names.filter(|name| is_part(name)).collect();
        names.sort();
        (names.iter().map(String::as_str))
            .chain([CLAIMS_FILE])
            .try_for_each(|name| output::remove_if_exists(&self.folder.join(name)))
    }

    fn mesh_file(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number:04}.ply"))
    }

    fn counts_file(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number:04}.json"))
    }
}

/// Whether a name is that of a file of a local map.
fn is_part(name: &str) -> bool {
    let is_number = |stem: &str| stem.len() >= 4 && stem.bytes().all(|b| b.is_ascii_digit());
    (name.split_once('.'))
        .is_some_and(|(stem, extension)| is_number(stem) && ["ply", "json"].contains(&extension))
}

fn entries(folder: &Path) -> Result<Vec<fs::DirEntry>> {
    let entries = fs::read_dir(folder).and_then(Iterator::collect);
    entries.with_context(|| format!("cannot read {}", folder.display()))
}

/// Locks a folder of parts; an error if another build has locked it.
fn lock(folder: &Path, mesh_file: &Path, role: Role) -> Result<Lock> {
    let path = folder.join(LOCK_FILE);
    Lock::now(&path, role == Role::Job)?.with_context(|| {
        format!(
            "{} is being built by another build-map, which has locked {}; wait for it, or choose another mesh_file",
            mesh_file.display(),
            path.display()
        )
    })
}

/// Why jobs cannot be done or collected.
pub fn not_listed(mesh_file: &Path) -> String {
    format!(
        "the jobs of {} were not listed with this configuration, recording and program; list them again with --list-jobs",
        mesh_file.display()
    )
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    use crate::geometry::TriangleMesh;
    use crate::map::mesh_view::MeshView as _;

    const INPUTS: &str = "# fpmcl inputs";

    fn open(map: &Path, inputs: &str) -> Result<Parts> {
        open_as(map, inputs, Role::Build)
    }

    fn open_as(map: &Path, inputs: &str, role: Role) -> Result<Parts> {
        let parts = Parts::lock(map, role)?;
        parts.keep_those_of(inputs)?;
        Ok(parts)
    }

    fn local_map(x: f32) -> LocalMap {
        LocalMap {
            mesh: TriangleMesh {
                vertices: vec![Vec3::new(x, 0.0, 0.0), Vec3::X, Vec3::Y],
                normals: vec![Vec3::Z; 3],
                colors: vec![[255, 0, 0]; 3],
                triangles: vec![[0, 1, 2]],
            },
            counts: LocalMapCounts {
                scans: 7,
                triangles: 1,
                ..LocalMapCounts::default()
            },
            ..LocalMap::default()
        }
    }

    #[test]
    fn finished_parts_are_found_again_and_joined_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = open(&map, INPUTS).unwrap();
        parts.save(1, &local_map(1.5), "0123").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();

        drop(parts);
        let again = open(&map, INPUTS).unwrap();
        assert_eq!(again.finished(1, || Ok("0123".into())).unwrap().scans, 7);
        assert_eq!(again.finished(1, || Ok("4567".into())), None);
        assert_eq!(again.finished(2, || Ok("0123".into())), None);
        let meshes = again.joined(2).unwrap().meshes;
        assert_eq!(meshes[0].position(0).x, 0.5);
        assert_eq!(meshes[1].position(0).x, 1.5);
    }

    #[test]
    fn parts_of_other_inputs_are_deleted() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = open(&map, INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        drop(parts);
        assert_eq!(
            open(&map, "# fpmcl others")
                .unwrap()
                .finished(0, || Ok("0123".into())),
            None
        );
    }

    #[test]
    fn a_mesh_without_its_counts_is_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = open(&map, INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        fs::remove_file(parts.counts_file(0)).unwrap();
        assert_eq!(parts.finished(0, || Ok("0123".into())), None);
    }

    #[test]
    fn counts_without_their_mesh_are_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let parts = open(&folder.path().join("map.ply"), INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        assert!(parts.has(0));
        fs::remove_file(parts.mesh_file(0)).unwrap();
        assert!(!parts.has(0));
        assert_eq!(parts.finished(0, || Ok("0123".into())), None);
    }

    #[test]
    fn a_truncated_mesh_is_not_finished_and_not_joined() {
        let folder = tempfile::tempdir().unwrap();
        let parts = open(&folder.path().join("map.ply"), INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        let bytes = fs::read(parts.mesh_file(0)).unwrap();
        fs::write(parts.mesh_file(0), &bytes[..bytes.len() - 1]).unwrap();
        assert_eq!(parts.finished(0, || Ok("0123".into())), None);
        let message = format!("{:#}", parts.joined(1).err().unwrap());
        assert!(message.contains("has lost local map 0"), "{message}");
        assert!(message.contains("0000.ply is damaged"), "{message}");
    }

    #[test]
    fn an_empty_part_replaces_the_mesh_of_an_earlier_one() {
        let folder = tempfile::tempdir().unwrap();
        let parts = open(&folder.path().join("map.ply"), INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        parts.save(0, &LocalMap::default(), "").unwrap();
        assert!(parts.finished(0, || Ok("".into())).is_some());
        assert!(parts.joined(1).unwrap().meshes.is_empty());
    }

    #[test]
    fn a_folder_whose_claim_a_full_disk_cut_is_used_and_one_with_files_of_others_is_not() {
        for cut in ["", "unfinished:01", "unfinished:0123 map.p"] {
            let folder = tempfile::tempdir().unwrap();
            let map = folder.path().join("map.ply");
            let claims = folder.path().join("map.ply.parts").join(CLAIMS_FILE);
            fs::create_dir(claims.parent().unwrap()).unwrap();
            fs::write(&claims, cut).unwrap();
            let parts = open(&map, INPUTS).unwrap();
            parts.save(0, &local_map(0.5), "0123").unwrap();
            drop(parts);
            let again = open(&map, INPUTS).unwrap();
            assert!(again.finished(0, || Ok("0123".into())).is_some(), "{cut}");
            drop(again);
            fs::write(&claims, cut).unwrap();
            let refused = format!("{:#}", open(&map, INPUTS).err().unwrap());
            assert!(refused.contains("fpmcl did not write"), "{refused}");
        }
    }

    #[test]
    fn jobs_share_the_parts_of_the_inputs_that_were_listed_and_of_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let job = |inputs: &str| open_as(&map, inputs, Role::Job);
        for role in [Role::Job, Role::Collect] {
            let message = format!("{:#}", open_as(&map, INPUTS, role).err().unwrap());
            assert!(message.contains("--list-jobs"), "{message}");
            assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        }
        let parts = open(&map, INPUTS).unwrap();
        parts.save(0, &local_map(0.5), "").unwrap();
        drop(parts);
        assert!(open_as(&map, "# fpmcl others", Role::Collect).is_err());
        assert!(open_as(&map, INPUTS, Role::Collect).unwrap().has(0));
        let jobs = [job(INPUTS).unwrap(), job(INPUTS).unwrap()];
        assert!(job("# fpmcl others").is_err());
        assert!(open(&map, INPUTS).is_err());
        drop(jobs);
        assert!(open(&map, INPUTS).is_ok());
    }

    #[test]
    fn a_local_map_far_from_the_origin_is_joined_where_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let parts = open(&folder.path().join("map.ply"), INPUTS).unwrap();
        let origin = DVec3::new(1_003_520.0, -4096.0, 0.0);
        let far = LocalMap {
            origin,
            ..local_map(0.25)
        };
        parts.save(0, &far, "").unwrap();
        let joined = parts.joined(1).unwrap();
        assert_eq!(joined.meshes[0].position(0), origin + DVec3::X * 0.25);
    }
}
