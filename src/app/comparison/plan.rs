//! Plan of a comparison: all runs with their effective configurations.

use anyhow::{Context as _, Result};

use super::record::RunId;
use crate::app::comparison::config::{
    ComparisonConfig, Overrides, SequenceConfig, VariantConfig, settings,
};
use crate::app::settings::{
    self, BuildMapConfig, LocalizationConfig, OdometrySource, RefinementConfig,
};
use crate::configuration::Configuration;
use crate::simulation::SimulationConfig;
use crate::simulation::drive_files::{GIVEN_POSES_FILE, POSES_IN_MAP_FILE};

/// A run to execute. Paths of its results are set on execution.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedRun {
    /// Identity of the run.
    pub id: RunId,
    /// The two drives of a simulated sequence; empty for a recording.
    pub drives: Vec<SimulationConfig>,
    /// Configuration of the map builder.
    pub build_map: BuildMapConfig,
    /// Configuration of the localization.
    pub localization: LocalizationConfig,
    /// Configuration of the refinement, if the run refines.
    pub refinement: Option<RefinementConfig>,
    /// Number of particles, for runs of the particle sweep.
    pub particles: Option<usize>,
}

/// All runs, sequence by sequence. Skips optional sequences whose files are missing, with a log
/// message.
pub fn planned_runs(config: &ComparisonConfig) -> Result<Vec<PlannedRun>> {
    let mut runs = Vec::new();
    for sequence in &config.sequences {
        let drives = drives(config, sequence)
            .with_context(|| format!("in the sequence {}", sequence.name))?;
        for variant in &config.configurations {
            let run = planned_run(config, sequence, variant, &drives).with_context(|| {
                format!(
                    "in the sequence {} with the configuration {}",
                    sequence.name, variant.name
                )
            })?;
            let scan_folder = &run.build_map.recording.scan_folder;
            if sequence.optional && drives.is_empty() && !scan_folder.exists() {
                tracing::info!(
                    "sequence {} is skipped: there is no {}",
                    sequence.name,
                    scan_folder.display()
                );
                break;
            }
            runs.extend(config.seeds.iter().map(|&seed| run.with_seed(seed)));
            runs.extend(particle_runs(config, &run)?);
        }
    }
    Ok(runs)
}

impl PlannedRun {
    fn with_seed(&self, seed: u64) -> Self {
        let mut run = self.clone();
        run.id.seed = seed;
        run.localization.tracker.seed = seed;
        if let Some(refinement) = &mut run.refinement {
            refinement.seed = seed;
        }
        run
    }
}

/// The mapping drive and the localization drive of a simulated sequence.
fn drives(config: &ComparisonConfig, sequence: &SequenceConfig) -> Result<Vec<SimulationConfig>> {
    let Some(overrides) = &sequence.simulation else {
        return Ok(Vec::new());
    };
    let output_folder = config.output_folder.join("sequences").join(&sequence.name);
    let drive = |drive| SimulationConfig {
        output_folder: output_folder.clone().into(),
        drive,
        ..SimulationConfig::default()
    };
    let base = &config.base.simulation;
    let first = with_overrides(drive(1), "simulation", &[base, overrides])?;
    let second = [base, overrides, &sequence.second_drive];
    let second = with_overrides(drive(2), "second_drive", &second)?;
    Ok(vec![first, second])
}

/// The run of a configuration in a sequence, with seed 0.
fn planned_run(
    config: &ComparisonConfig,
    sequence: &SequenceConfig,
    variant: &VariantConfig,
    drives: &[SimulationConfig],
) -> Result<PlannedRun> {
    let mut build_map = BuildMapConfig::default();
    build_map.output.plots = false;
    let mut localization = LocalizationConfig::default();
    if let [first, second] = drives {
        let has_errors = first.given_poses.has_errors();
        let [first, second] = [first, second].map(SimulationConfig::drive_folder);
        build_map.recording.scan_folder = first.join("velodyne").into();
        build_map.given_poses.pose_file = Some(first.join("poses.txt").into());
        build_map.given_poses.calib_file = Some(first.join("calib.txt").into());
        localization.recording.scan_folder = second.join("velodyne").into();
        localization.given_poses.pose_file = Some(second.join("poses.txt").into());
        localization.given_poses.calib_file = Some(second.join("calib.txt").into());
        localization.motion.odometry = OdometrySource::File;
        localization.motion.odometry_file = Some(second.join("odometry.txt").into());
        if has_errors {
            build_map.given_poses.pose_file = Some(first.join(GIVEN_POSES_FILE).into());
            localization.given_poses.pose_file = Some(second.join(POSES_IN_MAP_FILE).into());
        }
    }
    let base = &config.base;
    let build_map = with_overrides(
        build_map,
        "build_map",
        &[&base.build_map, &sequence.build_map, &variant.build_map],
    )?;
    let localization = with_overrides(
        localization,
        "localization",
        &[
            &base.localization,
            &sequence.localization,
            &variant.localization,
        ],
    )?;
    let refinement = || {
        with_overrides(
            RefinementConfig::of(localization.clone()),
            "refinement",
            &[&base.refinement, &sequence.refinement, &variant.refinement],
        )
    };
    Ok(PlannedRun {
        id: RunId {
            sequence: sequence.name.clone(),
            configuration: variant.name.clone(),
            seed: 0,
        },
        drives: drives.to_vec(),
        refinement: variant.refine.then(refinement).transpose()?,
        build_map,
        localization,
        particles: None,
    })
}

/// The particle sweep of a run, without refinement.
fn particle_runs(config: &ComparisonConfig, run: &PlannedRun) -> Result<Vec<PlannedRun>> {
    let mut runs = Vec::new();
    let Some(sweep) = config.particles.as_ref().filter(|sweep| {
        sweep.configuration == run.id.configuration && sweep.sequences.contains(&run.id.sequence)
    }) else {
        return Ok(runs);
    };
    let localization = with_overrides(
        run.localization.clone(),
        "particles.localization",
        &[&sweep.localization],
    )?;
    for &count in &sweep.counts {
        for &seed in &sweep.seeds {
            let mut localization = localization.clone();
            localization.tracker.seed = seed;
            let filter = &mut localization.tracker.localizer;
            filter.num_particles = count;
            filter.num_reduced = filter.num_reduced.min(count);
            let mut run = PlannedRun {
                localization,
                refinement: None,
                particles: Some(count),
                ..run.with_seed(seed)
            };
            run.id.configuration = format!("{}-{count}-particles", run.id.configuration);
            runs.push(run);
        }
    }
    Ok(runs)
}

/// Applies overrides in order, the last with the highest precedence.
fn with_overrides<T: Configuration>(config: T, block: &str, overrides: &[&Overrides]) -> Result<T> {
    let all: Vec<(String, String)> = overrides.iter().flat_map(|keys| settings(keys)).collect();
    settings::with_settings(config, &all).with_context(|| format!("in the block {block}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file_path::FilePath;

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
        planned_runs(&settings::load(Some(&path), &[])?)
    }

    fn find<'a>(runs: &'a [PlannedRun], id: &str) -> &'a PlannedRun {
        runs.iter().find(|run| run.id.to_string() == id).unwrap()
    }

    #[test]
    fn every_sequence_is_combined_with_every_configuration_and_seed() {
        let runs = planned(TEXT).unwrap();
        assert_eq!(runs.len(), 2 * 2 * 2 + 2);
        let run = find(&runs, "town/Fuzzy-PSO-MCL/4");
        assert_eq!(
            (run.localization.tracker.seed, run.build_map.map.seed),
            (4, 0)
        );
        assert_eq!(run.refinement.as_ref().unwrap().seed, 4);
        assert!(find(&runs, "town/PCA-MCL/3").refinement.is_none());
    }

    #[test]
    fn the_configuration_overrides_the_sequence_and_the_sequence_overrides_the_base() {
        let runs = planned(TEXT).unwrap();
        let particles = |id| find(&runs, id).localization.tracker.localizer.num_particles;
        assert_eq!(particles("town/PCA-MCL/3"), 500);
        assert_eq!(particles("drive/PCA-MCL/3"), 600);
        assert_eq!(particles("drive/Fuzzy-PSO-MCL/3"), 700);
        let run = find(&runs, "drive/Fuzzy-PSO-MCL/3");
        assert_eq!(
            run.build_map.map.ground.method,
            crate::ground::GroundMethod::Fuzzy
        );
        let run = find(&runs, "drive/PCA-MCL/3");
        assert_eq!(
            run.build_map.map.ground.method,
            crate::ground::GroundMethod::Pca
        );
    }

    #[test]
    fn the_refinement_uses_the_recording_of_the_localization() {
        let runs = planned(TEXT).unwrap();
        let refinement = find(&runs, "drive/Fuzzy-PSO-MCL/3")
            .refinement
            .clone()
            .unwrap();
        assert_eq!(refinement.recording.scan_folder, "b/velodyne".into());
        assert_eq!(refinement.recording.frames.start_idx, 1);
        // The map contains the path of its drive.
        assert_eq!(refinement.map_input.map_pose_file, None);
    }

    #[test]
    fn the_first_drive_is_mapped_and_the_second_is_localized() {
        let runs = planned(TEXT).unwrap();
        let run = find(&runs, "town/PCA-MCL/3");
        let ends = |path: &std::path::Path, end| assert!(path.ends_with(end), "{path:?}");
        ends(
            &run.build_map.recording.scan_folder,
            "sequences/town/drive_1/velodyne",
        );
        ends(
            &run.localization.recording.scan_folder,
            "sequences/town/drive_2/velodyne",
        );
        let [first, second] = &run.drives[..] else {
            panic!("{run:?}")
        };
        assert_eq!((first.seed, first.drive, second.drive), (7, 1, 2));
    }

    #[test]
    fn keys_of_the_second_drive_do_not_change_the_first_and_given_poses_are_mapped() {
        let text = TEXT.replace(
            "simulation: {seed: 7, n_scans: 20}",
            "simulation: {given_poses.noise_m: 0.02}\n  second_drive: {scanner.range_noise_m: 0.07}",
        );
        let runs = planned(&text.replace("base:", "base:\n  simulation: {n_scans: 9}")).unwrap();
        let run = find(&runs, "town/PCA-MCL/3");
        let noises = [0, 1].map(|drive| run.drives[drive].scanner.range_noise_m);
        assert_eq!(noises, [0.02, 0.07]);
        assert!(run.drives.iter().all(|drive| drive.n_scans == 9));
        let pose_file = |path: &Option<FilePath>| path.clone().unwrap();
        assert!(
            pose_file(&run.build_map.given_poses.pose_file).ends_with("drive_1/given_poses.txt")
        );
        assert!(
            pose_file(&run.localization.given_poses.pose_file)
                .ends_with("drive_2/poses_in_map.txt")
        );
    }

    #[test]
    fn the_particle_sweep_varies_the_named_configuration() {
        let runs = planned(TEXT).unwrap();
        let few = find(&runs, "town/PCA-MCL-50-particles/1");
        assert_eq!(few.localization.tracker.localizer.num_particles, 50);
        assert_eq!(
            (
                few.localization.tracker.localizer.num_reduced,
                few.particles
            ),
            (50, Some(50))
        );
        assert_eq!(few.localization.pose_tracking, Some(false));
        let many = find(&runs, "town/PCA-MCL-2000-particles/1");
        assert_eq!(many.build_map, find(&runs, "town/PCA-MCL/3").build_map);
    }

    #[test]
    fn an_unknown_key_of_a_stage_is_reported_with_its_place() {
        let wrong = TEXT.replace("ground_method: pca", "ground_metod: pca");
        let message = format!("{:#}", planned(&wrong).unwrap_err());
        for part in [
            "town",
            "PCA-MCL",
            "build_map",
            "did you mean `ground.method`",
        ] {
            assert!(message.contains(part), "{message}");
        }
    }
}
