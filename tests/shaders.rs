//! The shaders are valid and in sync with the Rust code; no graphics adapter is needed.
#![cfg(feature = "gpu")]

use std::fs;
use std::path::{Path, PathBuf};

use wgpu::naga;
use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src/rendering/gpu")
}

/// Name and source of every shader, sorted by name.
fn shaders() -> Vec<(String, String)> {
    let mut shaders: Vec<(String, String)> = fs::read_dir(folder())
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| name.ends_with(".wgsl"))
        .map(|name| {
            let text = fs::read_to_string(folder().join(&name)).unwrap_or_default();
            (name, text)
        })
        .collect();
    shaders.sort();
    shaders
}

/// Source of a shader after the shaders that its comments prepend to it.
fn composed(text: &str, shaders: &[(String, String)]) -> String {
    let needed = shaders
        .iter()
        .filter(|(name, _)| text.contains(&format!("`{name}` is prepended to this text")));
    needed
        .map(|(_, text)| text.as_str())
        .chain([text])
        .collect()
}

#[test]
fn every_shader_is_valid() {
    let shaders = shaders();
    assert!(shaders.len() >= 4, "{shaders:?}");
    for (name, text) in &shaders {
        let source = composed(text, &shaders);
        let module = naga::front::wgsl::parse_str(&source)
            .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
        Validator::new(ValidationFlags::all(), Capabilities::empty())
            .validate(&module)
            .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
    }
}

#[test]
fn every_shader_and_its_rust_twin_name_each_other() {
    for (name, text) in shaders() {
        let twin = "Keep in sync with `layout.rs`";
        assert!(text.contains(twin), "{name} does not contain: {twin}");
    }
    let layout = fs::read_to_string(folder().join("layout.rs")).unwrap();
    for (name, _) in shaders() {
        assert!(
            layout.contains(&format!("`{name}`")),
            "layout.rs does not name {name}"
        );
    }
}

#[test]
fn every_shader_is_used() {
    let rust = fs::read_to_string(folder().join("shaders.rs")).unwrap();
    for (name, _) in shaders() {
        assert!(
            rust.contains(&format!("include_str!(\"{name}\")")),
            "{name}"
        );
    }
}
