//! Vertices of PLY files, with numbers of any type.

use glam::Vec3;
use ply_rs::ply::{Property, PropertyAccess, PropertyAccessResult};

/// Names of the intensity, in any case.
const INTENSITY: [&str; 4] = ["intensity", "scalar_intensity", "reflectance", "remission"];

/// A row of the element `vertex`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyVertex {
    /// Properties x, y, z, in the unit of the file.
    pub position: Vec3,
    /// Properties nx, ny, nz.
    pub normal: Vec3,
    /// Properties red, green, blue, 0 to 255.
    pub color: [u8; 3],
    /// Reflectance of a measured point, in the unit of the file.
    pub intensity: f32,
}

impl PlyVertex {
    /// The number of a name.
    fn number(&mut self, name: &str) -> Option<&mut f32> {
        Some(match name {
            "x" | "X" => &mut self.position.x,
            "y" | "Y" => &mut self.position.y,
            "z" | "Z" => &mut self.position.z,
            "nx" => &mut self.normal.x,
            "ny" => &mut self.normal.y,
            "nz" => &mut self.normal.z,
            name if INTENSITY.iter().any(|n| name.eq_ignore_ascii_case(n)) => &mut self.intensity,
            _ => return None,
        })
    }

    /// Sets a number, or a color channel from 0 to 255.
    fn set(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        let channel = match name {
            "red" => 0,
            "green" => 1,
            "blue" => 2,
            _ => match self.number(name) {
                Some(number) => {
                    *number = value;
                    return PropertyAccessResult::Set;
                }
                None => return PropertyAccessResult::Ignored,
            },
        };
        self.color[channel] = value.round() as u8;
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for PlyVertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let value = match property {
            Property::Char(value) => f32::from(value),
            Property::UChar(value) => f32::from(value),
            Property::Short(value) => f32::from(value),
            Property::UShort(value) => f32::from(value),
            Property::Int(value) => value as f32,
            Property::UInt(value) => value as f32,
            Property::Float(value) => return self.set_float(name, value),
            Property::Double(value) => return self.set_float(name, value as f32),
            _ => return PropertyAccessResult::Ignored,
        };
        self.set(name, value)
    }

    fn set_float(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        let is_color = matches!(name, "red" | "green" | "blue");
        // Colors as numbers from 0 to 1, as some tools write them.
        self.set(
            name,
            if is_color {
                value.clamp(0.0, 1.0) * 255.0
            } else {
                value
            },
        )
    }
}
