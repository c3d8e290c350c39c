//! Configuration of `compare`: sequences × configurations × seeds.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::app::run::arguments::yaml;
use crate::app::settings::{command_configs, require_path};
use crate::file_path::FilePath;
use crate::validation::{InvalidValue, Validate, at_least_one, require};

/// Keys of the configuration of a stage with their values, dotted as in `--set`
/// (`range_image.width: 450`) or nested.
pub type Overrides = BTreeMap<String, serde_json::Value>;

/// Configuration of a comparison.
///
/// Defaults: no sequences and configurations; five seeds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct ComparisonConfig {
    /// Folder of all results.
    #[default("results/comparison".into())]
    pub output_folder: FilePath,
    /// Seeds of the runs, one run per seed.
    #[default((1..=5).collect())]
    pub seeds: Vec<u64>,
    /// Overrides for all runs.
    pub base: StageOverrides,
    /// Sequences.
    pub sequences: Vec<SequenceConfig>,
    /// Configurations that every sequence is run with.
    pub configurations: Vec<VariantConfig>,
    /// Pairs of configurations to compare; if empty, each configuration with the first.
    pub contrasts: Vec<Contrast>,
    /// Success rate against the number of particles.
    pub particles: Option<ParticleSweep>,
}

command_configs!(ComparisonConfig: "comparison");

/// Overrides of the defaults of the stages.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageOverrides {
    /// Keys of `simulate`, for simulated sequences.
    pub simulation: Overrides,
    /// Keys of `build-map`.
    pub build_map: Overrides,
    /// Keys of `localize`.
    pub localization: Overrides,
    /// Keys of `refine`.
    pub refinement: Overrides,
}

/// A drive to map and a drive to localize.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SequenceConfig {
    /// Name in tables and folders.
    pub name: String,
    /// What is hard about it, for the page of cases; empty for sequences that are no cases.
    pub about: String,
    /// What was tried against its failures, for the page of cases.
    pub tried: String,
    /// Whether to skip the sequence, with a log message, if its files are missing.
    pub optional: bool,
    /// Keys of `simulate` for a simulated sequence, of which drive 1 is mapped and drive 2
    /// localized; `None` for a recording.
    pub simulation: Option<Overrides>,
    /// Keys of `simulate` for drive 2 alone.
    pub second_drive: Overrides,
    /// Keys of `build-map`, such as the files of a recording.
    pub build_map: Overrides,
    /// Keys of `localize`.
    pub localization: Overrides,
    /// Keys of `refine`; files, frames and odometry default to those of the localization.
    pub refinement: Overrides,
}

/// A configuration to compare.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VariantConfig {
    /// Name in tables and folders.
    pub name: String,
    /// Whether to refine the trajectory.
    pub refine: bool,
    /// Average positional error that the report claims for the configuration [m].
    pub claimed_m: Option<f64>,
    /// Keys of `build-map`.
    pub build_map: Overrides,
    /// Keys of `localize`.
    pub localization: Overrides,
    /// Keys of `refine`.
    pub refinement: Overrides,
}

/// Two configurations to compare.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Contrast {
    /// Name of the configuration.
    pub of: String,
    /// Name of the configuration to compare it with.
    pub against: String,
}

/// Runs of one configuration with several numbers of particles.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ParticleSweep {
    /// Initial numbers of particles.
    pub counts: Vec<usize>,
    /// Name of the configuration.
    pub configuration: String,
    /// Names of the sequences.
    pub sequences: Vec<String>,
    /// Seeds of the runs, one run per seed.
    pub seeds: Vec<u64>,
    /// Keys of `localize`, such as global initialization.
    pub localization: Overrides,
}

impl ComparisonConfig {
    /// The configured contrasts; without any, each configuration against the first.
    pub fn contrasts(&self) -> Vec<Contrast> {
        match &self.configurations[..] {
            [first, others @ ..] if self.contrasts.is_empty() => {
                let contrast = |other: &VariantConfig| Contrast {
                    of: other.name.clone(),
                    against: first.name.clone(),
                };
                others.iter().map(contrast).collect()
            }
            _ => self.contrasts.clone(),
        }
    }
}

/// Overrides as pairs of dotted key and YAML value.
pub fn settings(overrides: &Overrides) -> Vec<(String, String)> {
    let pairs = overrides.iter().flat_map(|(key, value)| match value {
        serde_json::Value::Object(block) if !block.is_empty() => {
            let block = block
                .iter()
                .map(|(inner, value)| (format!("{key}.{inner}"), value.clone()));
            settings(&block.collect())
        }
        value => vec![(key.clone(), yaml(value))],
    });
    pairs.collect()
}

impl Validate for ComparisonConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        require_path("output_folder", &self.output_folder)?;
        at_least_one("seeds", self.seeds.len())?;
        let sequences: Vec<&str> = self.sequences.iter().map(|s| s.name.as_str()).collect();
        let configurations = self.configurations.iter();
        let configurations: Vec<&str> = configurations.map(|c| c.name.as_str()).collect();
        check_names("sequences", &sequences)?;
        check_names("configurations", &configurations)?;
        let unique: BTreeSet<&u64> = self.seeds.iter().collect();
        require(
            unique.len() == self.seeds.len(),
            "seeds",
            format_args!("{:?}", self.seeds),
            "give each seed once",
        )?;
        for name in self.contrasts.iter().flat_map(|c| [&c.of, &c.against]) {
            check_known("contrasts", name, &configurations)?;
        }
        let Some(particles) = &self.particles else {
            return Ok(());
        };
        at_least_one("particles.counts", particles.counts.len())?;
        at_least_one("particles.seeds", particles.seeds.len())?;
        check_known(
            "particles.configuration",
            &particles.configuration,
            &configurations,
        )?;
        for name in &particles.sequences {
            check_known("particles.sequences", name, &sequences)?;
        }
        require(
            !particles.counts.contains(&0),
            "particles.counts",
            format_args!("{:?}", particles.counts),
            "each must be 1 or greater",
        )
    }
}

/// At least one name, without duplicates, each valid as the name of a folder.
fn check_names(key: &str, names: &[&str]) -> Result<(), InvalidValue> {
    at_least_one(key, names.len())?;
    for (index, name) in names.iter().enumerate() {
        let is_valid = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
        require(
            name.chars().all(is_valid) && name.starts_with(|c: char| c.is_ascii_alphanumeric()),
            key,
            format_args!("named `{name}`"),
            "a name consists of letters, digits, -, _, + and ., and begins with a letter or a digit; it is also the name of a folder",
        )?;
        require(
            !names[..index].contains(name),
            key,
            format_args!("named `{name}` twice"),
            "choose unique names",
        )?;
    }
    Ok(())
}

fn check_known(key: &str, name: &str, names: &[&str]) -> Result<(), InvalidValue> {
    let remedy = format!("it must be one of {}", names.join(", "));
    require(names.contains(&name), key, name, remedy)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::settings;

    const TEXT: &str = "\
seeds: [3, 4]
base:
  localization: {numParticles: 500, range_image: {width: 450, height: 32}}
  build_map:
    poisson.point_weight: 2
sequences:
- {name: town, simulation: {seed: 7}}
configurations:
- {name: PCA-MCL, claimed_m: 1.45, build_map: {ground_method: pca}}
- {name: Fuzzy-MCL}
- {name: Fuzzy-PSO-MCL, refine: True}
";

    fn load(text: &str) -> Result<ComparisonConfig, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("comparison.yml");
        std::fs::write(&path, text).unwrap();
        settings::load(Some(&path), &[]).map_err(|error| error.to_string())
    }

    #[test]
    fn blocks_and_dotted_keys_are_the_same_settings() {
        let loaded = load(TEXT).unwrap();
        let expected = [
            ("numParticles", "500"),
            ("range_image.height", "32"),
            ("range_image.width", "450"),
        ]
        .map(|(key, value)| (key.to_owned(), value.to_owned()));
        assert_eq!(settings(&loaded.base.localization), expected);
        let expected = [("poisson.point_weight".to_owned(), "2".to_owned())];
        assert_eq!(settings(&loaded.base.build_map), expected);
        assert!(loaded.configurations[2].refine);
    }

    #[test]
    fn the_effective_configuration_loads_again() {
        let loaded = load(TEXT).unwrap();
        assert_eq!(load(&settings::to_yaml(&loaded).unwrap()), Ok(loaded));
    }

    #[test]
    fn by_default_all_configurations_are_compared_with_the_first() {
        let of: Vec<String> = load(TEXT)
            .unwrap()
            .contrasts()
            .into_iter()
            .map(|contrast| format!("{} - {}", contrast.of, contrast.against))
            .collect();
        assert_eq!(of, ["Fuzzy-MCL - PCA-MCL", "Fuzzy-PSO-MCL - PCA-MCL"]);
    }

    #[test]
    fn invalid_and_unknown_names_are_reported() {
        for (from, to, expected) in [
            ("name: town", "name: ../town", "letters, digits"),
            ("name: Fuzzy-MCL", "name: PCA-MCL", "twice"),
            ("seeds: [3, 4]", "seeds: [3, 3]", "each seed once"),
            (
                "seeds: [3, 4]",
                "seeds: [3]\ncontrasts: [{of: PCA-MCL, against: FCA}]",
                "one of PCA-MCL, Fuzzy-MCL",
            ),
            ("refine: True", "refined: True", "did you mean `refine`"),
        ] {
            let message = load(&TEXT.replace(from, to)).unwrap_err();
            assert!(message.contains(expected), "{message}");
        }
    }
}
