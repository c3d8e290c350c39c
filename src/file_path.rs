//! Paths in texts: any name that a file system has is written in configurations and JSON, and reads back as the same bytes.
//!
//! Names on Unix are bytes. One that is no part of a character of UTF-8 has the character U+F700 plus the byte in a text, as
//! in other programs that map names to Unicode (Cygwin's user guide, "Forbidden characters in filenames"); so have the bytes
//! of characters that texts do not hold, and of those of this range itself.

use std::borrow::Cow;
use std::ops::Deref;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A path of a configuration or a report.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FilePath(PathBuf);

/// First character of the bytes, plus 0x80.
const FIRST: u32 = 0xf780;
const LAST: u32 = 0xf7ff;

impl FilePath {
    /// The path of a text.
    pub fn of_text(text: &str) -> Self {
        let byte_of = |c: char| {
            (FIRST..=LAST)
                .contains(&u32::from(c))
                .then_some(u32::from(c) as u8)
        };
        if !text.chars().any(|c| byte_of(c).is_some()) {
            return Self(PathBuf::from(text));
        }
        let mut bytes = Vec::with_capacity(text.len());
        for c in text.chars() {
            match byte_of(c) {
                Some(byte) => bytes.push(byte),
                None => bytes.extend(c.encode_utf8(&mut [0; 4]).bytes()),
            }
        }
        Self(of_bytes(bytes))
    }

    /// The path.
    pub fn as_path(&self) -> &Path {
        self
    }

    /// The text of the path.
    pub fn text(&self) -> Cow<'_, str> {
        text_of(&self.0)
    }
}

/// The text of a path.
pub fn text_of(path: &Path) -> Cow<'_, str> {
    // In YAML and Unicode, U+FFFE and U+FFFF are no characters.
    let is_kept =
        |c: char| !(FIRST..=LAST).contains(&u32::from(c)) && !matches!(c, '\u{fffe}' | '\u{ffff}');
    if let Some(text) = path.to_str()
        && text.chars().all(is_kept)
    {
        return Cow::Borrowed(text);
    }
    let bytes = path.as_os_str().as_encoded_bytes();
    let mut text = String::with_capacity(bytes.len());
    let escape = |byte: &u8| char::from_u32(FIRST - 0x80 + u32::from(*byte));
    for chunk in bytes.utf8_chunks() {
        for c in chunk.valid().chars() {
            if is_kept(c) {
                text.push(c);
            } else {
                text.extend(
                    c.encode_utf8(&mut [0; 4])
                        .as_bytes()
                        .iter()
                        .filter_map(escape),
                );
            }
        }
        text.extend(chunk.invalid().iter().filter_map(escape));
    }
    Cow::Owned(text)
}

#[cfg(unix)]
fn of_bytes(bytes: Vec<u8>) -> PathBuf {
    use std::os::unix::ffi::OsStringExt as _;
    std::ffi::OsString::from_vec(bytes).into()
}

#[cfg(not(unix))]
fn of_bytes(bytes: Vec<u8>) -> PathBuf {
    String::from_utf8_lossy(&bytes).into_owned().into()
}

impl Deref for FilePath {
    type Target = Path;

    fn deref(&self) -> &Path {
        &self.0
    }
}

impl AsRef<Path> for FilePath {
    fn as_ref(&self) -> &Path {
        &self.0
    }
}

impl From<PathBuf> for FilePath {
    fn from(path: PathBuf) -> Self {
        Self(path)
    }
}

impl From<&Path> for FilePath {
    fn from(path: &Path) -> Self {
        Self(path.to_owned())
    }
}

impl From<&str> for FilePath {
    fn from(path: &str) -> Self {
        Self(path.into())
    }
}

impl From<FilePath> for PathBuf {
    fn from(path: FilePath) -> Self {
        path.0
    }
}

impl Serialize for FilePath {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.text())
    }
}

impl<'de> Deserialize<'de> for FilePath {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Ok(Self::of_text(&Cow::<str>::deserialize(deserializer)?))
    }
}

#[cfg(feature = "configuration")]
impl schemars::JsonSchema for FilePath {
    fn schema_name() -> Cow<'static, str> {
        PathBuf::schema_name()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        PathBuf::json_schema(generator)
    }

    fn inline_schema() -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_their_own_paths() {
        for text in ["drive_1", "a/ä \u{1b}\n", ""] {
            assert_eq!(&*FilePath::of_text(text), Path::new(text));
            assert_eq!(text_of(Path::new(text)), text);
        }
    }

    #[cfg(unix)]
    #[test]
    fn any_bytes_have_a_text_of_their_own_that_reads_back() {
        let names: [&[u8]; 5] = [
            b"drive\xff",
            b"\xc3\xa4\xc3",
            // U+F7FF, which means a byte, and U+FFFE.
            b"\xef\x9f\xbf",
            b"\xef\xbf\xbe",
            b"\xed\xa0\x80",
        ];
        let mut texts: Vec<String> = Vec::new();
        for name in names {
            let path = of_bytes(name.to_vec());
            let text = text_of(&path).into_owned();
            assert!(!text.contains(['\u{fffd}', '\u{fffe}']), "{text:?}");
            assert_eq!(FilePath::of_text(&text).0, path);
            let json = serde_json::to_string(&FilePath(path.clone())).unwrap();
            assert_eq!(serde_json::from_str::<FilePath>(&json).unwrap().0, path);
            texts.push(text);
        }
        assert_eq!(texts[0], "drive\u{f7ff}");
        assert_eq!(texts[1], "ä\u{f7c3}");
        texts.sort();
        texts.dedup();
        assert_eq!(texts.len(), names.len());
    }
}
