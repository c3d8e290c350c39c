//! Configurations of keys with arbitrary values.

use std::sync::LazyLock;

use arbtest::arbitrary::{Result, Unstructured};
use fpmcl::internals::app::ComparisonConfig;
use fpmcl::internals::app::settings::{
    BuildMapConfig, CommandConfig, EvaluationConfig, GroundCommandConfig, LocalizationConfig,
    RefinementConfig,
};
use fpmcl::simulation::SimulationConfig;

use super::mutation::EXTREMES;

/// The defaults of a command.
struct Defaults {
    /// The text of each key at the top level with what is below it.
    blocks: Vec<String>,
    /// All keys, dotted.
    keys: Vec<String>,
}

/// Number of commands with a configuration, in the order of their numbers in [`file`] and
/// [`setting`].
pub const COMMANDS: usize = 7;

static DEFAULTS: LazyLock<[Defaults; COMMANDS]> = LazyLock::new(|| {
    [
        defaults::<BuildMapConfig>(),
        defaults::<LocalizationConfig>(),
        defaults::<RefinementConfig>(),
        defaults::<EvaluationConfig>(),
        defaults::<SimulationConfig>(),
        defaults::<ComparisonConfig>(),
        defaults::<GroundCommandConfig>(),
    ]
});

fn defaults<T: CommandConfig>() -> Defaults {
    let text = T::default().to_yaml().unwrap();
    let mut blocks: Vec<String> = Vec::new();
    let mut keys = Vec::new();
    let mut path: Vec<(usize, &str)> = Vec::new();
    for line in text.lines() {
        if line.starts_with([' ', '-']) {
            let block = blocks.last_mut().unwrap();
            *block += &format!("{line}\n");
        } else {
            blocks.push(format!("{line}\n"));
        }
        let content = line.trim_start();
        if let Some((name, _)) = content
            .split_once(':')
            .filter(|_| !content.starts_with('-'))
        {
            let depth = line.len() - content.len();
            path.retain(|&(above, _)| above < depth);
            path.push((depth, name));
            let names: Vec<&str> = path.iter().map(|&(_, name)| name).collect();
            keys.push(names.join("."));
        }
    }
    Defaults { blocks, keys }
}

/// A text that starts with `#` and the number of its command.
pub fn file(u: &mut Unstructured) -> Result<Vec<u8>> {
    let command = u.choose_index(COMMANDS)?;
    let mut text = format!("#{command}\n");
    for _ in 0..u.int_in_range(0..=4)? {
        let block = u.choose(&DEFAULTS[command].blocks)?;
        match u.arbitrary::<u8>()? {
            0..64 => text += &replace_value(u, block)?,
            _ => text += block,
        }
    }
    Ok(text.into_bytes())
}

/// Replaces the value on one line of a block.
fn replace_value(u: &mut Unstructured, block: &str) -> Result<String> {
    let lines: Vec<&str> = block.lines().collect();
    let replaced = u.choose_index(lines.len())?;
    let mut text = String::new();
    for (index, line) in lines.into_iter().enumerate() {
        let (key, _) = line.split_once(':').unwrap_or((line, ""));
        if index == replaced {
            text += &format!("{key}: {}\n", value(u)?);
        } else {
            text += &format!("{line}\n");
        }
    }
    Ok(text)
}

/// The number of a command and up to three settings, one per line.
pub fn setting(u: &mut Unstructured) -> Result<Vec<u8>> {
    let command = u.choose_index(COMMANDS)?;
    let mut text = format!("{command}");
    for _ in 0..u.int_in_range(1..=3)? {
        let key = u.choose(&DEFAULTS[command].keys)?;
        text += &format!("\n{key}={}", value(u)?);
    }
    Ok(text.into_bytes())
}

fn value(u: &mut Unstructured) -> Result<String> {
    Ok(match u.arbitrary::<u8>()? {
        0..160 => (*u.choose(EXTREMES)?).to_owned(),
        160..200 => f64::from_bits(u.arbitrary()?).to_string(),
        200..240 => u.arbitrary::<i16>()?.to_string(),
        _ => format!("[{}, {}]", u.choose(EXTREMES)?, u.choose(EXTREMES)?),
    })
}
