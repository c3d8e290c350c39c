//! Which renderer does the work: the processor or a graphics card, and why.
//!
//! `auto` takes a discrete graphics card, else an integrated one, else the processor. It never
//! takes a software adapter (a graphics driver that runs on the processor): the ray packets of
//! the CPU renderer do the same work there many times faster.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::RenderError;

/// What the user asks for with `--backend`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// A graphics card if there is one, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// A graphics adapter, be it a software one; without any an error.
    Gpu,
}

/// Which adapters may be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AdapterChoice {
    /// Discrete and integrated graphics cards.
    Hardware,
    /// All, graphics cards first; software adapters are for tests.
    Any,
}

/// What an adapter is, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[expect(missing_docs, reason = "the names say it")]
pub enum AdapterKind {
    Discrete,
    Integrated,
    Virtual,
    Unknown,
    Software,
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Discrete => "discrete graphics card",
            Self::Integrated => "integrated graphics",
            Self::Virtual => "virtual graphics card",
            Self::Unknown => "graphics adapter of unknown type",
            Self::Software => "software adapter",
        })
    }
}

/// A graphics adapter of this machine, and what it allows.
#[derive(Clone, Debug, PartialEq)]
pub struct AdapterReport {
    /// As the driver calls it.
    pub name: String,
    /// What it is.
    pub kind: AdapterKind,
    /// The interface that it is reached through: `vulkan`, `gl`.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer that a shader can read [bytes].
    pub max_binding_bytes: u64,
    /// Largest buffer [bytes].
    pub max_buffer_bytes: u64,
    /// Largest edge of a texture [pixels].
    pub max_texture_size: u32,
    /// Why it cannot render here; `None` where it can.
    pub obstacle: Option<&'static str>,
}

impl fmt::Display for AdapterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {})", self.name, self.kind, self.api)
    }
}

/// The renderer that is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The processor.
    Cpu,
    /// The adapter at this index of [`BackendChoice::adapters`].
    Gpu(usize),
}

/// What was chosen, among what, and why.
#[derive(Clone, Debug, PartialEq)]
pub struct BackendChoice {
    /// The renderer that is taken.
    pub target: Target,
    /// Its name: `cpu`, or the adapter's.
    pub name: String,
    /// Why this one, as the end of "… because".
    pub reason: String,
    /// All adapters of this machine, best first.
    pub adapters: Vec<AdapterReport>,
}

/// Looks at the adapters of this machine and takes one, or the processor.
///
/// # Errors
/// [`RenderError::NoAdapter`] if a graphics adapter is asked for and there is none.
pub fn choose(wanted: Backend) -> Result<BackendChoice, RenderError> {
    let adapters = match wanted {
        Backend::Cpu => Vec::new(),
        Backend::Auto | Backend::Gpu => adapters(),
    };
    decide(wanted, adapters)
}

/// All graphics adapters of this machine, best first; none if the crate was built without the
/// feature `gpu`.
pub fn adapters() -> Vec<AdapterReport> {
    #[cfg(feature = "gpu")]
    return super::gpu::adapters();
    #[cfg(not(feature = "gpu"))]
    return Vec::new();
}

/// The best of the adapters that can render and may be taken.
pub fn best(adapters: &[AdapterReport], choice: AdapterChoice) -> Option<usize> {
    let may_be_taken = |kind| match choice {
        AdapterChoice::Hardware => kind <= AdapterKind::Integrated,
        AdapterChoice::Any => true,
    };
    (0..adapters.len())
        .filter(|&index| adapters[index].obstacle.is_none() && may_be_taken(adapters[index].kind))
        .min_by_key(|&index| adapters[index].kind)
}

fn decide(wanted: Backend, adapters: Vec<AdapterReport>) -> Result<BackendChoice, RenderError> {
    let cpu = |reason: String, adapters| BackendChoice {
        target: Target::Cpu,
        name: "cpu".to_owned(),
        reason,
        adapters,
    };
    let choice = match wanted {
        Backend::Cpu => return Ok(cpu("it was asked for".to_owned(), adapters)),
        Backend::Auto => AdapterChoice::Hardware,
        Backend::Gpu => AdapterChoice::Any,
    };
    match (best(&adapters, choice), wanted) {
        (Some(index), _) => Ok(BackendChoice {
            target: Target::Gpu(index),
            name: adapters[index].to_string(),
            reason: match wanted {
                Backend::Gpu => "a graphics adapter was asked for, and it is the best".to_owned(),
                _ => format!("it is the best {}", adapters[index].kind),
            },
            adapters,
        }),
        (None, Backend::Gpu) => Err(RenderError::NoAdapter),
        (None, _) => Ok(cpu(why_no_card(&adapters), adapters)),
    }
}

/// Why `auto` takes none of the adapters.
fn why_no_card(adapters: &[AdapterReport]) -> String {
    let Some(first) = adapters.first() else {
        return if cfg!(feature = "gpu") {
            "there is no graphics adapter".to_owned()
        } else {
            "this program was built without the feature `gpu`".to_owned()
        };
    };
    match first.obstacle {
        Some(obstacle) => format!("{first} cannot render: {obstacle}"),
        None => {
            format!("{first} is no graphics card of this machine, so the CPU is faster or safer")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(name: &str, kind: AdapterKind) -> AdapterReport {
        AdapterReport {
            name: name.to_owned(),
            kind,
            api: "vulkan".to_owned(),
            driver: "1.0".to_owned(),
            max_binding_bytes: 1 << 27,
            max_buffer_bytes: 1 << 28,
            max_texture_size: 8192,
            obstacle: None,
        }
    }

    #[test]
    fn auto_takes_the_discrete_card_wherever_it_stands_in_the_list() {
        let card = adapter("card", AdapterKind::Discrete);
        let chip = adapter("chip", AdapterKind::Integrated);
        let software = adapter("software", AdapterKind::Software);
        let choice = decide(Backend::Auto, vec![software, chip, card]).unwrap();
        assert_eq!(choice.target, Target::Gpu(2));
        assert!(choice.reason.contains("discrete"), "{}", choice.reason);
    }

    #[test]
    fn auto_never_takes_a_software_adapter_and_names_it() {
        let software = adapter("llvmpipe", AdapterKind::Software);
        let choice = decide(Backend::Auto, vec![software]).unwrap();
        assert_eq!(choice.target, Target::Cpu);
        assert!(choice.reason.contains("llvmpipe"), "{}", choice.reason);
    }

    #[test]
    fn who_asks_for_a_graphics_adapter_gets_a_software_one_rather_than_none() {
        let software = adapter("llvmpipe", AdapterKind::Software);
        let choice = decide(Backend::Gpu, vec![software]).unwrap();
        assert_eq!(choice.target, Target::Gpu(0));
        assert!(matches!(
            decide(Backend::Gpu, Vec::new()),
            Err(RenderError::NoAdapter)
        ));
    }

    #[test]
    fn an_adapter_with_an_obstacle_is_never_taken() {
        let old = AdapterReport {
            obstacle: Some("it has no compute shaders"),
            ..adapter("old", AdapterKind::Discrete)
        };
        let choice = decide(Backend::Auto, vec![old.clone()]).unwrap();
        assert_eq!(choice.target, Target::Cpu);
        assert!(choice.reason.contains("compute"), "{}", choice.reason);
        assert!(decide(Backend::Gpu, vec![old]).is_err());
    }

    #[test]
    fn the_words_of_the_configuration_are_lowercase() {
        for (word, backend) in [
            ("auto", Backend::Auto),
            ("cpu", Backend::Cpu),
            ("gpu", Backend::Gpu),
        ] {
            assert_eq!(serde_yaml::from_str::<Backend>(word).unwrap(), backend);
        }
        assert!(serde_yaml::from_str::<Backend>("GPU").is_err());
    }
}
