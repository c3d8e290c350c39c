//! Finished local maps on disk, so that an interrupted build goes on where it was.
//!
//! Beside the map lies, while it is being built, the folder `<map>.parts`: per local map a mesh,
//! its counts and the hash of its scans, and `inputs.txt`, which says what else they were made from.
//! Parts of other inputs are thrown away. A part counts as finished once its counts are there, which
//! are written last.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use serde::{Deserialize, Serialize};

use crate::app::commands::output;
use crate::geometry::TriangleMesh;
use crate::map::local_map::LocalMap;
use crate::map::{LocalMapCounts, ply};

/// What is known of a finished local map beside its mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// Hash of the scans that it was made of.
    pub scans_hash: String,
    /// What happened to its points and triangles.
    pub counts: LocalMapCounts,
}

/// The folder of finished local maps of one build.
pub struct Parts {
    folder: PathBuf,
}

impl Parts {
    /// Opens the folder beside `mesh_file`; keeps what is in it if it was made from the same inputs.
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
            fs::create_dir_all(&folder)
                .with_context(|| format!("cannot create {}", folder.display()))?;
            output::write_text(&inputs_file, inputs)?;
        }
        Ok(Self { folder })
    }

    /// Where the parts lie.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// What is known of a local map if it is finished, and its mesh is there.
    pub fn finished(&self, number: usize) -> Option<Part> {
        let text = fs::read_to_string(self.counts_file(number)).ok()?;
        let part: Part = serde_json::from_str(&text).ok()?;
        let is_whole = part.counts.triangles == 0 || self.mesh_file(number).exists();
        is_whole.then_some(part)
    }

    /// Keeps a finished local map.
    pub fn save(&self, number: usize, local_map: &LocalMap) -> Result<()> {
        self.discard(number)?;
        if !local_map.mesh.triangles.is_empty() {
            let temporary = self.folder.join("unfinished.ply");
            ply::write(&temporary, &local_map.mesh)?;
            fs::rename(&temporary, self.mesh_file(number))
                .with_context(|| format!("cannot rename {}", temporary.display()))?;
        }
        let part = Part {
            scans_hash: local_map.scans_hash.clone(),
            counts: local_map.counts.clone(),
        };
        output::write_json(&self.counts_file(number), &part)
    }

    /// Removes what there is of a part that was made of other scans, its counts first.
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

    /// All local maps 0..count as one mesh.
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
            scans_hash: "0123abcd".to_owned(),
        }
    }

    #[test]
    fn finished_parts_are_found_again_and_joined_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(1, &local_map(1.5)).unwrap();
        parts.save(0, &local_map(0.5)).unwrap();

        let again = Parts::open(&map, "inputs").unwrap();
        let part = again.finished(1).unwrap();
        assert_eq!(part.scans_hash, "0123abcd");
        assert_eq!(part.counts.scans, 7);
        assert_eq!(again.finished(2), None);
        let whole = again.join(2).unwrap();
        assert_eq!(whole.vertices[0].x, 0.5);
        assert_eq!(whole.vertices[3].x, 1.5);
    }

    #[test]
    fn parts_of_other_inputs_are_thrown_away() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(0, &local_map(0.5)).unwrap();
        assert_eq!(Parts::open(&map, "others").unwrap().finished(0), None);
    }

    #[test]
    fn a_mesh_without_its_counts_is_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join("map.ply");
        let parts = Parts::open(&map, "inputs").unwrap();
        parts.save(0, &local_map(0.5)).unwrap();
        fs::remove_file(parts.counts_file(0)).unwrap();
        assert_eq!(parts.finished(0), None);
    }

    #[test]
    fn counts_without_their_mesh_are_not_finished() {
        let folder = tempfile::tempdir().unwrap();
        let parts = Parts::open(&folder.path().join("map.ply"), "inputs").unwrap();
        parts.save(0, &local_map(0.5)).unwrap();
        fs::remove_file(parts.mesh_file(0)).unwrap();
        assert_eq!(parts.finished(0), None);
    }

    #[test]
    fn a_part_that_has_become_empty_leaves_nothing_of_what_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let parts = Parts::open(&folder.path().join("map.ply"), "inputs").unwrap();
        parts.save(0, &local_map(0.5)).unwrap();
        parts.save(0, &LocalMap::default()).unwrap();
        assert_eq!(parts.finished(0).unwrap().scans_hash, "");
        assert!(parts.join(1).unwrap().triangles.is_empty());
    }
}
