//! Vertices of PLY files, with numbers of any type.

use glam::{DVec3, Vec3};
use ply_rs::ply::{Property, PropertyAccess, PropertyAccessResult};

/// A row of the element `vertex`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyVertex {
    /// Properties x, y, z, in the unit of the file.
    pub position: DVec3,
    /// Properties nx, ny, nz.
    pub normal: Vec3,
    /// Properties red, green, blue, 0 to 255.
    pub color: [u8; 3],
}

impl PlyVertex {
    /// Sets a number, or a color channel from 0 to 255.
    fn set(&mut self, name: &str, value: f64) -> PropertyAccessResult {
        match name {
            "x" | "X" => self.position.x = value,
            "y" | "Y" => self.position.y = value,
            "z" | "Z" => self.position.z = value,
            "nx" => self.normal.x = value as f32,
            "ny" => self.normal.y = value as f32,
            "nz" => self.normal.z = value as f32,
            "red" => self.color[0] = value.round() as u8,
            "green" => self.color[1] = value.round() as u8,
            "blue" => self.color[2] = value.round() as u8,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for PlyVertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let value = match property {
            Property::Char(value) => f64::from(value),
            Property::UChar(value) => f64::from(value),
            Property::Short(value) => f64::from(value),
            Property::UShort(value) => f64::from(value),
            Property::Int(value) => f64::from(value),
            Property::UInt(value) => f64::from(value),
            Property::Float(value) => return self.set_float(name, value),
            Property::Double(value) => shade(name, value),
            _ => return PropertyAccessResult::Ignored,
        };
        self.set(name, value)
    }

    fn set_float(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        self.set(name, shade(name, f64::from(value)))
    }
}

/// A color as a number from 0 to 1, as some tools write it, from 0 to 255; others as they are.
fn shade(name: &str, value: f64) -> f64 {
    match name {
        "red" | "green" | "blue" => value.clamp(0.0, 1.0) * 255.0,
        _ => value,
    }
}
