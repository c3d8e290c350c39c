//! `compare`: sequences x configurations x seeds.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::path;
use crate::app::comparison::{Contrast, Variant};
use crate::validation::{InvalidValue, Validate, at_least_one, require};

/// Keys of a stage's configuration with their values, as `--set` has them: `range_image.width: 450`.
/// A block of keys stands for each of its keys.
pub type Overrides = BTreeMap<String, serde_json::Value>;

/// What is compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ComparisonConfig {
    /// Everything that it makes.
    pub output_folder: PathBuf,
    /// What random choices of the runs follow from; a run per seed.
    pub seeds: Vec<u64>,
    /// What all runs have in common.
    pub base: StageOverrides,
    /// The drives.
    pub sequences: Vec<SequenceConfig>,
    /// What is done with each of them.
    pub configurations: Vec<VariantConfig>,
    /// Which configurations are compared with which; none: all with the first.
    pub contrasts: Vec<Contrast>,
    /// Success against the number of particles.
    pub particles: Option<ParticleSweep>,
}

/// What differs from the stages' defaults.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StageOverrides {
    /// Keys of `build_map.yml`.
    pub build_map: Overrides,
    /// Keys of `localization.yml`.
    pub localization: Overrides,
    /// Keys of `refinement.yml`.
    pub refinement: Overrides,
}

/// A drive to map and a drive to find the car in.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SequenceConfig {
    /// In tables and folders.
    pub name: String,
    /// Whether it is left out, with a word, where its files are not there.
    pub optional: bool,
    /// Keys of `simulation.yml`: drive 1 is mapped, the car of drive 2 is found. None of a recording.
    pub simulation: Option<Overrides>,
    /// Keys of `build_map.yml`, such as the files of a recording.
    pub build_map: Overrides,
    /// Keys of `localization.yml`.
    pub localization: Overrides,
    /// Keys of `refinement.yml`; files, frames and odometry are those of the localization.
    pub refinement: Overrides,
}

/// A configuration that takes part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VariantConfig {
    /// In tables and folders.
    pub name: String,
    /// Whether the trajectory is refined.
    pub refine: bool,
    /// The average positional error that the report claims for it [m].
    pub claimed_m: Option<f64>,
    /// Keys of `build_map.yml`.
    pub build_map: Overrides,
    /// Keys of `localization.yml`.
    pub localization: Overrides,
    /// Keys of `refinement.yml`.
    pub refinement: Overrides,
}

/// Runs of one configuration with more and more particles.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ParticleSweep {
    /// Numbers of particles at the start.
    pub counts: Vec<usize>,
    /// The configuration that they are put into.
    pub configuration: String,
    /// The sequences.
    pub sequences: Vec<String>,
    /// A run per seed.
    pub seeds: Vec<u64>,
    /// Keys of `localization.yml`, such as a start anywhere on the road.
    pub localization: Overrides,
}

impl Default for ComparisonConfig {
    /// Nothing to compare yet, with five seeds.
    fn default() -> Self {
        Self {
            output_folder: "results/comparison".into(),
            seeds: (1..=5).collect(),
            base: StageOverrides::default(),
            sequences: Vec::new(),
            configurations: Vec::new(),
            contrasts: Vec::new(),
            particles: None,
        }
    }
}

impl ComparisonConfig {
    /// The configurations as they stand in tables.
    pub fn variants(&self) -> Vec<Variant> {
        let variant = |variant: &VariantConfig| Variant {
            name: variant.name.clone(),
            claimed_m: variant.claimed_m,
        };
        self.configurations.iter().map(variant).collect()
    }

    /// The contrasts as told, or else of each configuration against the first.
    pub fn contrasts(&self) -> Vec<Contrast> {
        let names = || self.configurations.iter().map(|variant| &variant.name);
        if !self.contrasts.is_empty() {
            return self.contrasts.clone();
        }
        let against = names().next();
        against
            .into_iter()
            .flat_map(|first| {
                names().skip(1).map(|of| Contrast {
                    of: of.clone(),
                    against: first.clone(),
                })
            })
            .collect()
    }
}

/// Overrides as dotted keys with YAML values, blocks before what is in them.
pub fn settings(overrides: &Overrides) -> Vec<(String, String)> {
    fn add(prefix: &str, value: &serde_json::Value, found: &mut Vec<(String, String)>) {
        match value {
            serde_json::Value::Object(block) if !block.is_empty() => {
                for (key, value) in block {
                    add(&format!("{prefix}.{key}"), value, found);
                }
            }
            // JSON is YAML.
            value => found.push((prefix.to_owned(), value.to_string())),
        }
    }
    let mut found = Vec::new();
    for (key, value) in overrides {
        add(key, value, &mut found);
    }
    found
}

impl Validate for ComparisonConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("output_folder", &self.output_folder)?;
        at_least_one("seeds", self.seeds.len())?;
        let sequences: Vec<&str> = self.sequences.iter().map(|s| s.name.as_str()).collect();
        let variants: Vec<&str> = self
            .configurations
            .iter()
            .map(|c| c.name.as_str())
            .collect();
        names("sequences", &sequences)?;
        names("configurations", &variants)?;
        let once: BTreeSet<&u64> = self.seeds.iter().collect();
        require(
            once.len() == self.seeds.len(),
            "seeds",
            format_args!("{:?}", self.seeds),
            "give each seed once",
        )?;
        for name in self.contrasts.iter().flat_map(|c| [&c.of, &c.against]) {
            known("contrasts", name, &variants)?;
        }
        let Some(particles) = &self.particles else {
            return Ok(());
        };
        at_least_one("particles.counts", particles.counts.len())?;
        at_least_one("particles.seeds", particles.seeds.len())?;
        known(
            "particles.configuration",
            &particles.configuration,
            &variants,
        )?;
        for name in &particles.sequences {
            known("particles.sequences", name, &sequences)?;
        }
        require(
            !particles.counts.contains(&0),
            "particles.counts",
            format_args!("{:?}", particles.counts),
            "each must be 1 or greater",
        )
    }
}

/// At least one name, each once, and each fit for a folder.
fn names(key: &str, names: &[&str]) -> Result<(), InvalidValue> {
    at_least_one(key, names.len())?;
    for (index, name) in names.iter().enumerate() {
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
        require(
            name.chars().all(is_plain) && name.starts_with(|c: char| c.is_ascii_alphanumeric()),
            key,
            format_args!("named `{name}`"),
            "a name has letters, digits, -, _, + and . only, and begins with a letter or a digit; it is the name of a folder, too",
        )?;
        require(
            !names[..index].contains(name),
            key,
            format_args!("named `{name}` twice"),
            "give each a name of its own",
        )?;
    }
    Ok(())
}

fn known(key: &str, name: &str, names: &[&str]) -> Result<(), InvalidValue> {
    let remedy = format!("it must be one of {}", names.join(", "));
    require(names.contains(&name), key, name, remedy)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::config;

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
        config::load(Some(&path), &[]).map_err(|error| error.to_string())
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
    fn the_effective_configuration_comes_back() {
        let loaded = load(TEXT).unwrap();
        assert_eq!(load(&config::to_yaml(&loaded).unwrap()), Ok(loaded));
    }

    #[test]
    fn without_contrasts_all_are_compared_with_the_first() {
        let of: Vec<String> = load(TEXT)
            .unwrap()
            .contrasts()
            .into_iter()
            .map(|contrast| format!("{} - {}", contrast.of, contrast.against))
            .collect();
        assert_eq!(of, ["Fuzzy-MCL - PCA-MCL", "Fuzzy-PSO-MCL - PCA-MCL"]);
    }

    #[test]
    fn names_that_are_no_folders_or_not_there_are_told() {
        for (from, to, told) in [
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
            assert!(message.contains(told), "{message}");
        }
    }
}
