//! Valid files of recordings, of arbitrary values.

use std::fmt::Write as _;

use arbtest::arbitrary::{Result, Unstructured};
use nalgebra::{Quaternion, UnitQuaternion};

use super::mutation::EXTREMES;

/// Whether something happens that happens `times` in 256; never when the randomness is used up.
pub fn rarely(u: &mut Unstructured, times: u8) -> Result<bool> {
    Ok(u.arbitrary::<u8>()? > u8::MAX - times)
}

/// A number: mostly of a few metres, sometimes extreme, sometimes of any bits.
pub fn number(u: &mut Unstructured) -> Result<f64> {
    Ok(match u.arbitrary::<u8>()? {
        255 => f64::from_bits(u.arbitrary()?),
        254 => f64::from(f32::from_bits(u.arbitrary()?)),
        253 => u.choose(EXTREMES)?.parse().unwrap_or(0.0),
        _ => f64::from(u.arbitrary::<i32>()? % 100_000) / 1000.0,
    })
}

/// Float32 x, y, z and intensity of up to 64 points.
pub fn scan(u: &mut Unstructured) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    for _ in 0..4 * u.int_in_range(0..=64)? {
        bytes.extend((number(u)? as f32).to_le_bytes());
    }
    Ok(bytes)
}

/// Classes and instances of up to 64 points.
pub fn labels(u: &mut Unstructured) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    for _ in 0..u.int_in_range(0..=64)? {
        bytes.extend(u.arbitrary::<u32>()?.to_le_bytes());
    }
    Ok(bytes)
}

/// A rotation, of any quaternion that has one.
fn rotation(u: &mut Unstructured) -> Result<UnitQuaternion<f64>> {
    let mut component = || Ok(f64::from(u.arbitrary::<i16>()?) / 1000.0);
    let quaternion = Quaternion::new(
        component()? + 1e-3,
        component()?,
        component()?,
        component()?,
    );
    Ok(UnitQuaternion::from_quaternion(quaternion))
}

/// A row-major 3x4 matrix.
fn pose_row(u: &mut Unstructured) -> Result<String> {
    let rotation = rotation(u)?.to_rotation_matrix();
    let mut row = String::new();
    for axis in 0..3 {
        let [a, b, c] = [0, 1, 2].map(|column| rotation[(axis, column)]);
        let _ = write!(row, "{a} {b} {c} {} ", number(u)?);
    }
    Ok(row)
}

/// Up to 20 rows, with an occasional comment.
fn rows(
    u: &mut Unstructured,
    mut row: impl FnMut(&mut Unstructured, usize) -> Result<String>,
) -> Result<Vec<u8>> {
    let mut text = String::new();
    for index in 0..u.int_in_range(0..=20)? {
        if rarely(u, 2)? {
            text += "# a comment\n\n";
        }
        text += row(u, index)?.trim_end();
        text.push('\n');
    }
    Ok(text.into_bytes())
}

/// `poses.txt`.
pub fn poses(u: &mut Unstructured) -> Result<Vec<u8>> {
    rows(u, |u, _| pose_row(u))
}

/// A trajectory in TUM's format.
pub fn tum(u: &mut Unstructured) -> Result<Vec<u8>> {
    rows(u, |u, index| {
        let q = rotation(u)?.coords;
        let time_s = index as f64 + number(u)?;
        let [x, y, z] = [number(u)?, number(u)?, number(u)?];
        Ok(format!(
            "{time_s} {x} {y} {z} {} {} {} {}",
            q.x, q.y, q.z, q.w
        ))
    })
}

/// `times.txt`.
pub fn times(u: &mut Unstructured) -> Result<Vec<u8>> {
    rows(u, |u, index| {
        let jitter_s = if rarely(u, 2)? { number(u)? } else { 0.0 };
        Ok(format!("{}", 0.1 * index as f64 + jitter_s))
    })
}

/// `calib.txt`.
pub fn calibration(u: &mut Unstructured) -> Result<Vec<u8>> {
    let mut text = String::new();
    for key in ["P0", "P1", "Tr"] {
        let _ = writeln!(text, "{key}: {}", pose_row(u)?);
    }
    Ok(text.into_bytes())
}

/// First characters of the line before each file of [`recording`].
pub const FILE_MARK: &str = "== ";

/// The files of a recording in one text, each after a line with its path.
pub fn recording(u: &mut Unstructured) -> Result<Vec<u8>> {
    const OTHER_NAMES: &[&str] = &[
        "velodyne/a.bin",
        "velodyne/._000000.bin",
        "velodyne/000000 (copy).bin",
        "velodyne/0.bin",
        "velodyne/00.bin",
        "velodyne/+1.bin",
        "velodyne/99999999999999999999.bin",
        "velodyne/18446744073709551615.bin",
        "velodyne/notes.txt",
        "velodyne/sub/7.bin",
        "velodyne/.hidden/8.bin",
        "velodyne/-1.bin",
        "velodyne/.bin",
        "velodyne/１.bin",
    ];
    let mut text = Vec::new();
    let mut add = |name: &str, content: &[u8]| {
        text.extend(format!("{FILE_MARK}{name}\n").bytes());
        text.extend(content);
    };
    let frames = u.int_in_range(1..=6)?;
    for frame in 0..frames {
        let first = if rarely(u, 8)? { "a" } else { "" };
        add(&format!("velodyne/{first}{frame:06}.bin"), &[b' '; 32]);
    }
    if rarely(u, 64)? {
        add(u.choose(OTHER_NAMES)?, &[]);
    }
    let mut poses = String::new();
    let mut times = String::new();
    for frame in 0..frames {
        let _ = writeln!(poses, "{}", pose_row(u)?);
        let _ = writeln!(times, "{}", 0.1 * f64::from(frame));
    }
    add("poses.txt", poses.as_bytes());
    if u.arbitrary()? {
        add("times.txt", times.as_bytes());
    }
    add("calib.txt", &calibration(u)?);
    Ok(text)
}
