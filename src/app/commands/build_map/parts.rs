//! Finished local maps on disk, from which an interrupted build resumes.
//!
//! While a map is being built, the folder `<map>.parts` beside it holds per local map a mesh, and its
//! counts with the hash of its scans, and `inputs.txt` with all other inputs. Parts of other inputs are
//! deleted. A part is finished once its counts exist, which are written last.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use blake3::Hash;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::app::commands::output;
use crate::geometry::TriangleMesh;
use crate::map::{LocalMap, LocalMapCounts, ply};
use crate::recording::Frame;

/// A finished local map beside its mesh.
#[derive(Serialize, Deserialize)]
struct Part {
    /// Hash of the scans that it was made of.
    scans_hash: String,
    counts: LocalMapCounts,
}

/// The folder of finished local maps of one build.
pub struct Parts {
    folder: PathBuf,
}

impl Parts {
    /// Opens the folder beside `mesh_file`; deletes its content if it was made from other inputs.
    pub fn open(mesh_file: &Path, inputs: &str) -> Result<Self> {
        let mut name = mesh_file.file_name().unwrap_or_default().to_owned();
        name.push(".parts");
        let folder = mesh_file.with_file_name(name);
        let inputs_file = folder.join("inputs.txt");
        let same = fs::read_to_string(&inputs_file).is_ok_and(|found| found == inputs);
        if !same {
            if folder.exists() {
                fs::remove_dir_all(&folder)
                    .with_context(|| format!("cannot remove {}", folder.display()))?;
            }
            output::write_text(&inputs_file, inputs)?;
        }
        Ok(Self { folder })
    }

    /// The folder of the parts.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The counts of a local map if it is finished, with its mesh, and made of these scans.
    pub fn finished(
        &self,
        number: usize,
        scans_hash: impl FnOnce() -> io::Result<String>,
    ) -> Option<LocalMapCounts> {
        let text = fs::read_to_string(self.counts_file(number)).ok()?;
        let part: Part = serde_json::from_str(&text).ok()?;
        let is_whole = part.counts.triangles == 0 || self.mesh_file(number).exists();
        // A scan that cannot be read is reported by the build.
        let is_same = || scans_hash().is_ok_and(|hash| hash == part.scans_hash);
        (is_whole && is_same()).then_some(part.counts)
    }

    /// Keeps a finished local map.
    pub fn save(&self, number: usize, local_map: &LocalMap, scans_hash: &str) -> Result<()> {
        self.discard(number)?;
        if !local_map.mesh.triangles.is_empty() {
            ply::write(&self.mesh_file(number), &local_map.mesh, None)?;
        }
        let part = Part {
            scans_hash: scans_hash.to_owned(),
            counts: local_map.counts.clone(),
        };
        output::write_json(&self.counts_file(number), &part)
    }

    /// Deletes a part that was made of other scans, its counts first.
    fn discard(&self, number: usize) -> Result<()> {
        for file in [self.counts_file(number), self.mesh_file(number)] {
            match fs::remove_file(&file) {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    return Err(error).with_context(|| format!("cannot remove {}", file.display()));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Joins the meshes of the local maps 0..count.
    pub fn join(&self, count: usize) -> Result<TriangleMesh> {
        let mut whole = TriangleMesh::default();
        for number in 0..count {
            let file = self.mesh_file(number);
            if file.exists() {
                whole.append(&ply::read(&file)?);
            }
        }
        Ok(whole)
    }

    /// Removes the folder.
    pub fn remove(self) -> Result<()> {
        fs::remove_dir_all(&self.folder)
            .with_context(|| format!("cannot remove {}", self.folder.display()))
    }

    fn mesh_file(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number:04}.ply"))
    }

    fn counts_file(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number:04}.json"))
    }
}

/// BLAKE3 hash of the files of scans, in order.
pub fn hash_of_scans(frames: &[Frame]) -> io::Result<String> {
    let hash = |frame: &Frame| Ok(blake3::hash(&read_scan_file(frame)?));
    let hashes: Vec<Hash> = frames.par_iter().map(hash).collect::<io::Result<_>>()?;
    Ok(joint_hash(hashes))
}

/// Hash of the hashes of scans, in order.
pub fn joint_hash(hashes: impl IntoIterator<Item = Hash>) -> String {
    let mut joint = blake3::Hasher::new();
    for hash in hashes {
        joint.update(hash.as_bytes());
    }
    joint.finalize().to_hex().to_string()
}

/// Reads the file of a scan; an error names it.
pub fn read_scan_file(frame: &Frame) -> io::Result<Vec<u8>> {
    let path = &frame.scan_path;
    let named = |error: io::Error| {
        let message = format!("cannot read {}: {error}", path.display());
        io::Error::new(error.kind(), message)
    };
    fs::read(path).map_err(named)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

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
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(1, &local_map(1.5), "0123").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();

        let again = Parts::open(&map, "inputs").unwrap();
        assert_eq!(again.finished(1, || Ok("0123".into())).unwrap().scans, 7);
        assert_eq!(again.finished(1, || Ok("4567".into())), None);
        assert_eq!(again.finished(2, || Ok("0123".into())), None);
        let whole = again.join(2).unwrap();
        assert_eq!(whole.vertices[0].x, 0.5);
        assert_eq!(whole.vertices[3].x, 1.5);
    }

    #[test]
    fn parts_of_other_inputs_are_deleted() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        assert_eq!(
            Parts::open(&map, "others")
                .unwrap()
                .finished(0, || Ok("0123".into())),
            None
        );
    }

    #[test]
    fn a_mesh_without_its_counts_is_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        fs::remove_file(parts.counts_file(0)).unwrap();
        assert_eq!(parts.finished(0, || Ok("0123".into())), None);
    }

    #[test]
    fn counts_without_their_mesh_are_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let parts = Parts::open(&folder.path().join("map.ply"), "inputs").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        fs::remove_file(parts.mesh_file(0)).unwrap();
        assert_eq!(parts.finished(0, || Ok("0123".into())), None);
    }

    #[test]
    fn an_empty_part_replaces_the_mesh_of_an_earlier_one() {
        let folder = tempfile::tempdir().unwrap();
        let parts = Parts::open(&folder.path().join("map.ply"), "inputs").unwrap();
        parts.save(0, &local_map(0.5), "0123").unwrap();
        parts.save(0, &LocalMap::default(), "").unwrap();
        assert!(parts.finished(0, || Ok("".into())).is_some());
        assert!(parts.join(1).unwrap().triangles.is_empty());
    }
}
