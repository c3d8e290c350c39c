//! Arguments that commands share, and the way from them to a configuration: a flag that stands for a key is a
//! field that serializes under the name of that key.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;
use clap::builder::{
    MapValueParser, OsStringValueParser, PathBufValueParser, TypedValueParser, ValueParserFactory,
};
use serde::Serialize;
use serde_json::{Value, json};

use super::context::{Context, MachineArgs};
use super::visible::{visible, visible_in_line};
use crate::app::settings::{self, CommandConfig};
use crate::file_path::{FilePath, text_of};
use crate::files::has_extension;
use crate::recording::Layout;

/// Configuration and machine.
#[derive(Clone, Debug, Args)]
pub struct ConfigArgs {
    /// Configuration (.yml), or the input: a recording (odometry, build-map, localize), a point cloud (build-map), a result (refine, evaluate) or a trajectory (evaluate). Without it, the command's file under config/ or, if there is none, built-in values.
    #[arg(value_name = "CONFIG | INPUT")]
    pub config: Option<FilePath>,

    /// Override a key, such as range_image.width=1024; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = settings_parser())]
    pub settings: Vec<(String, String)>,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

impl ConfigArgs {
    /// The configuration file.
    pub fn config_file(&self) -> Option<&Path> {
        self.config.as_deref().filter(|path| is_config(path))
    }

    /// What the command works on, where the argument is no configuration.
    pub fn input(&self) -> Option<&Path> {
        self.config.as_deref().filter(|path| !is_config(path))
    }
}

impl ValueParserFactory for FilePath {
    type Parser = MapValueParser<PathBufValueParser, fn(PathBuf) -> Self>;

    fn value_parser() -> Self::Parser {
        PathBufValueParser::new().map(Self::from)
    }
}

/// Whether a path is that of a configuration.
pub fn is_config(path: &Path) -> bool {
    has_extension(path, "yml") || has_extension(path, "yaml")
}

/// Arguments of a stage.
#[derive(Clone, Debug, Args, Serialize)]
pub struct RunArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(skip)]
    pub source: ConfigArgs,

    /// Seed of all random choices; overrides the key `seed` where it exists.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Replace existing output; sets the key `force` where it exists.
    #[arg(long)]
    pub force: bool,
}

/// Arguments of a command that reads a recording.
#[derive(Clone, Debug, Args, Serialize)]
pub struct RecordingArgs {
    /// Layout of the recording, such as kitti, mulran or nuscenes; by default as its files show. Sets the key `layout`.
    #[arg(long, value_name = "NAME")]
    pub layout: Option<Layout>,
}

/// Loads the configuration of a command, and notes its file. Where the argument of the command is no
/// configuration but an input, flags and settings change `base`, and the input is the value of `input_key`.
pub fn configured<T: CommandConfig>(
    args: &impl Serialize,
    source: &ConfigArgs,
    input_key: &str,
    base: impl FnOnce() -> T,
    context: &Context,
) -> anyhow::Result<(T, Context)> {
    let path = source.config_file();
    let settings = with_flags::<T>(args, source, input_key)?;
    if source.input().is_some() {
        return Ok((settings::with_settings(base(), &settings)?, context.clone()));
    }
    let config = settings::load(path, &settings)?;
    require_input(&config, path, input_key)?;
    Ok((config, context.with_config_file(path, T::PATH)))
}

/// Requires an input from the user where the default one does not exist, so that no message is about a path that the user
/// did not give.
pub fn require_input<T: CommandConfig>(
    config: &T,
    path: Option<&Path>,
    input_key: &str,
) -> anyhow::Result<()> {
    let value = |config: &T| anyhow::Ok(text_at(&serde_json::to_value(config)?, input_key));
    if path.is_some() || Path::new(T::PATH).exists() {
        return Ok(());
    }
    let built_in = value(&settings::load(None, &[])?)?;
    match built_in.filter(|it| !Path::new(it).exists()) {
        Some(built_in) if value(config)?.as_ref() == Some(&built_in) => bail!(
            "no input was given, and there is no {built_in}, which {input_key} is by default; give {} or a configuration (.yml) as the first argument",
            if input_key == "scan_folder" {
                "a recording"
            } else {
                "a result"
            }
        ),
        _ => Ok(()),
    }
}

/// The text at a key in any block of a configuration.
fn text_at(config: &Value, key: &str) -> Option<String> {
    let blocks = config.as_object()?;
    let found = blocks.get(key).and_then(Value::as_str).map(str::to_owned);
    found.or_else(|| blocks.values().find_map(|block| text_at(block, key)))
}

/// The settings of a command; those of flags are the last, where the configuration has their keys.
pub fn with_flags<T: CommandConfig>(
    args: &impl Serialize,
    source: &ConfigArgs,
    input_key: &str,
) -> anyhow::Result<Vec<(String, String)>> {
    let mut flags: BTreeMap<String, Value> = serde_json::from_value(serde_json::to_value(args)?)?;
    flags.insert(input_key.to_owned(), json!(source.input().map(text_of)));
    flags.retain(|_, value| !matches!(value, Value::Null | Value::Bool(false)));
    let mut settings = source.settings.clone();
    for (key, value) in flags {
        if settings::has_key::<T>(&key)? {
            settings.push((key, yaml(&value)));
        }
    }
    Ok(settings)
}

/// A value as YAML that reads back as the same, also where a name has control characters: JSON with escapes for them.
pub fn yaml(value: &Value) -> String {
    visible(&value.to_string()).into_owned()
}

/// Parses finite numbers that are separated by commas.
pub fn numbers<const N: usize>(text: &str, help: &'static str) -> Result<[f64; N], &'static str> {
    let numbers = text.split(',').map(|number| number.trim().parse::<f64>());
    let numbers: Option<Vec<f64>> = numbers.map(Result::ok).collect();
    let finite = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
    finite
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or(help)
}

/// The command line of this process with other words instead of `--list-jobs`, for a shell.
pub fn command_of_job(words: &str) -> String {
    let given = std::env::args_os().filter(|word| word != "--list-jobs");
    let given: Vec<String> = given.map(|word| shell_word(&word)).collect();
    format!("{} {words}", given.join(" "))
}

/// A word for a shell, in one line: bytes that are no printable text as `\xNN` in `$'...'` (POSIX.1-2024, section 2.2.4).
fn shell_word(word: &OsStr) -> String {
    let plain = word.to_str().filter(|text| visible_in_line(text) == *text);
    if let Some(plain) = plain.filter(|text| !text.contains('\t')) {
        return shell_words::quote(plain).into_owned();
    }
    let escaped = word.as_encoded_bytes().iter().map(|&byte| match byte {
        b'\'' | b'\\' => format!("\\{}", char::from(byte)),
        b' '..=b'~' => char::from(byte).to_string(),
        byte => format!("\\x{byte:02x}"),
    });
    format!("$'{}'", escaped.collect::<String>())
}

/// Parses `key=value`, also of paths that are not UTF-8.
pub fn settings_parser() -> impl TypedValueParser<Value = (String, String)> {
    OsStringValueParser::new().try_map(|text| setting(&text_of(Path::new(&text))))
}

/// Splits `key=value` at the first `=`.
fn setting(text: &str) -> Result<(String, String), &'static str> {
    match text.split_once('=') {
        Some((key, value)) if !key.trim().is_empty() => {
            Ok((key.trim().to_owned(), value.to_owned()))
        }
        _ => Err("write it as key=value, such as range_image.width=1024"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn any_argument_is_a_word_of_a_shell_in_one_line() {
        use std::os::unix::ffi::OsStrExt as _;
        let names: [&[u8]; 6] = [
            b"a b",
            b"caf\xe9",
            b"a\nb'c",
            b"\x1b[31m\\x",
            b"plain",
            "\u{202e}ä".as_bytes(),
        ];
        for name in names {
            let word = shell_word(OsStr::from_bytes(name));
            assert_eq!(visible_in_line(&word), word);
            let printed = std::process::Command::new("bash")
                .arg("-c")
                .arg(format!("printf %s {word}"))
                .output()
                .unwrap();
            assert_eq!(printed.stdout, name, "{word}");
        }
    }

    #[test]
    fn a_setting_is_split_at_its_first_equals_sign() {
        assert_eq!(setting("a.b=c=d"), Ok(("a.b".into(), "c=d".into())));
        assert_eq!(setting("a="), Ok(("a".into(), String::new())));
        assert!(setting("a").is_err());
        assert!(setting("=a").is_err());
    }
}
