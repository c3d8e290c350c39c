//! Every run of a comparison with its effective configurations.

use anyhow::{Context as _, Result};

use crate::app::comparison::RunId;
use crate::app::config::{
    self, BuildMapConfig, ComparisonConfig, LocalizationConfig, OdometrySource, Overrides,
    RefinementConfig, SequenceConfig, VariantConfig, settings,
};
use crate::simulation::SimulationConfig;
use crate::validation::Validate;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// A run that is to be done; where its files go is decided when it is done.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedRun {
    /// Which run.
    pub id: RunId,
    /// The drives to be simulated; none of a recording.
    pub drives: Option<[SimulationConfig; 2]>,
    /// How the map is built.
    pub build_map: BuildMapConfig,
    /// How the car is found.
    pub localization: LocalizationConfig,
    /// How the trajectory is refined, if it is.
    pub refinement: Option<RefinementConfig>,
    /// Particles at the start, in runs that ask for success against their number.
    pub particles: Option<usize>,
}

/// All runs, sequence by sequence. Optional sequences whose files are absent are left out, with a
/// word.
pub fn runs(config: &ComparisonConfig) -> Result<Vec<PlannedRun>> {
    let mut runs = Vec::new();
    for sequence in &config.sequences {
        let drives = drives(config, sequence)
            .with_context(|| format!("in the sequence {}", sequence.name))?;
        for variant in &config.configurations {
            let first = planned(config, sequence, variant, drives.as_ref()).with_context(|| {
                format!(
                    "in the sequence {} with the configuration {}",
                    sequence.name, variant.name
                )
            })?;
            if sequence.optional && !first.build_map.scan_folder.is_dir() && drives.is_none() {
                tracing::info!(
                    "sequence {} is left out: there is no folder {}",
                    sequence.name,
                    first.build_map.scan_folder.display()
                );
                break;
            }
            runs.extend(config.seeds.iter().map(|&seed| first.with_seed(seed)));
            runs.extend(particle_runs(config, &first)?);
        }
    }
    Ok(runs)
}

impl PlannedRun {
    fn with_seed(&self, seed: u64) -> Self {
        let mut run = self.clone();
        run.id.seed = seed;
        run.localization.seed = seed;
        if let Some(refinement) = &mut run.refinement {
            refinement.seed = seed;
        }
        run
    }
}

/// The two drives of a simulated sequence.
fn drives(
    config: &ComparisonConfig,
    sequence: &SequenceConfig,
) -> Result<Option<[SimulationConfig; 2]>> {
    let Some(overrides) = &sequence.simulation else {
        return Ok(None);
    };
    let street = applied(SimulationConfig::default(), "simulation", &[overrides])?;
    let folder = config.output_folder.join("sequences").join(&sequence.name);
    Ok(Some([1, 2].map(|drive| SimulationConfig {
        output_folder: folder.clone(),
        drive,
        ..street.clone()
    })))
}

/// The run of the first seed.
fn planned(
    config: &ComparisonConfig,
    sequence: &SequenceConfig,
    variant: &VariantConfig,
    drives: Option<&[SimulationConfig; 2]>,
) -> Result<PlannedRun> {
    let mut build_map = BuildMapConfig {
        visualize: false,
        ..BuildMapConfig::default()
    };
    let mut localization = LocalizationConfig::default();
    if let Some([first, second]) = drives.map(|drives| drives.each_ref().map(|d| d.drive_folder()))
    {
        build_map.scan_folder = first.join("velodyne");
        build_map.pose_file = first.join("poses.txt");
        build_map.calib_file = first.join("calib.txt");
        localization.scan_folder = second.join("velodyne");
        localization.pose_file = second.join("poses.txt");
        localization.calib_file = second.join("calib.txt");
        localization.odometry = OdometrySource::File;
        localization.odometry_file = Some(second.join("odometry.txt"));
    }
    let (base, own, asked) = (&config.base, sequence, variant);
    let build_map = applied(
        build_map,
        "build_map",
        &[&base.build_map, &own.build_map, &asked.build_map],
    )?;
    let localization = applied(
        localization,
        "localization",
        &[&base.localization, &own.localization, &asked.localization],
    )?;
    let localization = LocalizationConfig {
        map_pose_file: Some(build_map.pose_file.clone()),
        map_calib_file: Some(build_map.calib_file.clone()),
        ..localization
    };
    let refinement = if variant.refine {
        Some(applied(
            RefinementConfig::of(localization.clone()),
            "refinement",
            &[&base.refinement, &own.refinement, &asked.refinement],
        )?)
    } else {
        None
    };
    Ok(PlannedRun {
        id: RunId {
            sequence: sequence.name.clone(),
            configuration: variant.name.clone(),
            seed: 0,
        },
        drives: drives.cloned(),
        build_map,
        localization,
        refinement,
        particles: None,
    })
}

/// Runs of the same with other numbers of particles, without refinement.
fn particle_runs(config: &ComparisonConfig, like: &PlannedRun) -> Result<Vec<PlannedRun>> {
    let mut runs = Vec::new();
    let asked = config.particles.iter().filter(|particles| {
        particles.configuration == like.id.configuration
            && particles.sequences.contains(&like.id.sequence)
    });
    for particles in asked {
        let localization = applied(
            like.localization.clone(),
            "particles.localization",
            &[&particles.localization],
        )?;
        for &count in &particles.counts {
            for &seed in &particles.seeds {
                let mut run = like.with_seed(seed);
                run.id.configuration = format!("{}-{count}-particles", like.id.configuration);
                run.localization = LocalizationConfig {
                    num_particles: count,
                    num_reduced: localization.num_reduced.min(count),
                    seed,
                    ..localization.clone()
                };
                run.refinement = None;
                run.particles = Some(count);
                runs.push(run);
            }
        }
    }
    Ok(runs)
}

/// A configuration with overrides, the later ones on top.
fn applied<T>(config: T, block: &str, overrides: &[&Overrides]) -> Result<T>
where
    T: Validate + Serialize + DeserializeOwned,
{
    let all: Vec<(String, String)> = overrides.iter().flat_map(|keys| settings(keys)).collect();
    config::with_settings(config, &all).with_context(|| format!("among the keys of {block}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "\
output_folder: out
seeds: [3, 4]
base:
  localization: {numParticles: 500}
sequences:
- name: town
  simulation: {seed: 7, n_scans: 20}
- name: drive
  build_map: {scan_folder: a/velodyne, pose_file: a/poses.txt, frame_step: 2}
  localization: {scan_folder: b/velodyne, start_idx: 1, numParticles: 600}
- name: elsewhere
  optional: True
  build_map: {scan_folder: nowhere/velodyne}
configurations:
- {name: PCA-MCL, build_map: {ground_method: pca}}
- name: Fuzzy-PSO-MCL
  refine: True
  localization: {numParticles: 700}
  refinement: {refinement.method: swarm}
particles: {counts: [50, 2000], configuration: PCA-MCL, sequences: [town], seeds: [1], localization: {pose_tracking: False}}
";

    fn planned(text: &str) -> Result<Vec<PlannedRun>> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join("comparison.yml");
        std::fs::write(&path, text)?;
        runs(&config::load(Some(&path), &[])?)
    }

    fn find<'a>(runs: &'a [PlannedRun], id: &str) -> &'a PlannedRun {
        runs.iter().find(|run| run.id.to_string() == id).unwrap()
    }

    #[test]
    fn every_sequence_meets_every_configuration_with_every_seed() {
        let runs = planned(TEXT).unwrap();
        assert_eq!(runs.len(), 2 * 2 * 2 + 2);
        let run = find(&runs, "town/Fuzzy-PSO-MCL/4");
        assert_eq!((run.localization.seed, run.build_map.seed), (4, 0));
        assert_eq!(run.refinement.as_ref().unwrap().seed, 4);
        assert!(find(&runs, "town/PCA-MCL/3").refinement.is_none());
    }

    #[test]
    fn the_configuration_overrides_the_sequence_and_that_the_base() {
        let runs = planned(TEXT).unwrap();
        let particles = |id| find(&runs, id).localization.num_particles;
        assert_eq!(particles("town/PCA-MCL/3"), 500);
        assert_eq!(particles("drive/PCA-MCL/3"), 600);
        assert_eq!(particles("drive/Fuzzy-PSO-MCL/3"), 700);
        let run = find(&runs, "drive/Fuzzy-PSO-MCL/3");
        assert_eq!(
            run.build_map.ground_method,
            crate::ground::GroundMethod::Fuzzy
        );
        let run = find(&runs, "drive/PCA-MCL/3");
        assert_eq!(
            run.build_map.ground_method,
            crate::ground::GroundMethod::Pca
        );
    }

    #[test]
    fn the_refinement_looks_at_what_was_localized() {
        let runs = planned(TEXT).unwrap();
        let refinement = find(&runs, "drive/Fuzzy-PSO-MCL/3")
            .refinement
            .clone()
            .unwrap();
        assert_eq!(refinement.scan_folder, std::path::Path::new("b/velodyne"));
        assert_eq!(refinement.start_idx, 1);
        assert_eq!(refinement.map_pose_file, Some("a/poses.txt".into()));
    }

    #[test]
    fn the_first_drive_is_mapped_and_the_car_of_the_second_is_found() {
        let runs = planned(TEXT).unwrap();
        let run = find(&runs, "town/PCA-MCL/3");
        let ends = |path: &std::path::Path, end| assert!(path.ends_with(end), "{path:?}");
        ends(
            &run.build_map.scan_folder,
            "sequences/town/drive_1/velodyne",
        );
        ends(
            &run.localization.scan_folder,
            "sequences/town/drive_2/velodyne",
        );
        let [first, second] = run.drives.as_ref().unwrap();
        assert_eq!((first.seed, first.drive, second.drive), (7, 1, 2));
    }

    #[test]
    fn runs_with_other_numbers_of_particles_are_of_the_configuration_that_is_named() {
        let runs = planned(TEXT).unwrap();
        let few = find(&runs, "town/PCA-MCL-50-particles/1");
        assert_eq!(few.localization.num_particles, 50);
        assert_eq!(
            (few.localization.num_reduced, few.particles),
            (50, Some(50))
        );
        assert!(!few.localization.pose_tracking);
        let many = find(&runs, "town/PCA-MCL-2000-particles/1");
        assert_eq!(many.build_map, find(&runs, "town/PCA-MCL/3").build_map);
    }

    #[test]
    fn a_key_that_a_stage_does_not_have_is_told_with_its_place() {
        let wrong = TEXT.replace("ground_method: pca", "ground_metod: pca");
        let message = format!("{:#}", planned(&wrong).unwrap_err());
        for part in [
            "town",
            "PCA-MCL",
            "build_map",
            "did you mean `ground_method`",
        ] {
            assert!(message.contains(part), "{message}");
        }
    }
}
