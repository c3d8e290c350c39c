//! Cars, vans, cyclists and pedestrians.
//!
//! Local frame of each: origin on the ground under its middle, x forward, y left, z up.

use std::f32::consts::TAU;

use glam::{DVec2, Vec3};
use rand::{Rng, RngExt as _};

use super::builder::MeshBuilder;
use super::classes;

const GLASS_REFLECTANCE: f32 = 0.06;
const RUBBER_REFLECTANCE: f32 = 0.05;

/// Shape of a road user.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Vehicle {
    /// A passenger car.
    Car(CarShape),
    /// A delivery van with a box body.
    Van {
        /// Length [m].
        length_m: f32,
        /// Height [m].
        height_m: f32,
        /// Reflectance of the paint, 0 to 1.
        reflectance: f32,
    },
    /// A person on a bicycle.
    Cyclist,
    /// A walking person.
    Pedestrian {
        /// Height [m].
        height_m: f32,
    },
}

/// Proportions of a passenger car.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarShape {
    length_m: f32,
    width_m: f32,
    height_m: f32,
    /// Position of the lower edge of the windscreen before the middle, as a share of the length.
    bonnet: f32,
    /// Position of the lower edge of the rear window behind the middle, as a share of the length.
    boot: f32,
    reflectance: f32,
}

impl Vehicle {
    /// A random van with probability `van_share`, otherwise a random car.
    pub fn random(van_share: f64, rng: &mut impl Rng) -> Self {
        if rng.random_bool(van_share) {
            return Self::Van {
                length_m: rng.random_range(4.9..6.4),
                height_m: rng.random_range(2.0..2.8),
                reflectance: [0.2, 0.7, 0.85][rng.random_range(0..3)],
            };
        }
        // Small car, hatchback, saloon, estate, high-roof car.
        let [length_m, height_m, bonnet, boot] = [
            [3.6, 1.48, 0.26, 0.48],
            [4.2, 1.45, 0.22, 0.47],
            [4.6, 1.43, 0.20, 0.30],
            [4.7, 1.47, 0.20, 0.48],
            [4.5, 1.70, 0.24, 0.48],
        ][rng.random_range(0..5)];
        let stretch = rng.random_range(0.96..1.04);
        Self::Car(CarShape {
            length_m: length_m * stretch,
            width_m: rng.random_range(1.66..1.86),
            height_m: height_m * rng.random_range(0.98..1.03),
            bonnet,
            boot,
            reflectance: [0.04, 0.08, 0.25, 0.4, 0.6, 0.8][rng.random_range(0..6)],
        })
    }

    /// A random pedestrian.
    pub fn random_pedestrian(rng: &mut impl Rng) -> Self {
        Self::Pedestrian {
            height_m: rng.random_range(1.5..1.95),
        }
    }

    /// Half of length and width [m].
    pub fn half_size_m(&self) -> DVec2 {
        let (length_m, width_m) = match *self {
            Self::Car(shape) => (shape.length_m.into(), shape.width_m.into()),
            Self::Van { length_m, .. } => (length_m.into(), 2.0),
            Self::Cyclist => (1.8, 0.6),
            Self::Pedestrian { .. } => (0.6, 0.6),
        };
        0.5 * DVec2::new(length_m, width_m)
    }

    /// SemanticKITTI class of the parked or moving vehicle.
    pub fn class(&self, is_moving: bool) -> u16 {
        match (self, is_moving) {
            (Self::Car(_), false) => classes::CAR,
            (Self::Car(_), true) => classes::MOVING_CAR,
            (Self::Van { .. }, false) => classes::TRUCK,
            (Self::Van { .. }, true) => classes::MOVING_TRUCK,
            (Self::Cyclist, _) => classes::MOVING_BICYCLIST,
            (Self::Pedestrian { .. }, _) => classes::MOVING_PERSON,
        }
    }

    /// Adds the surface. `stride_rad` is the phase of walking or pedalling.
    pub fn add_to(&self, builder: &mut MeshBuilder, is_moving: bool, stride_rad: f32) {
        let class = self.class(is_moving);
        match *self {
            Self::Car(shape) => add_car(builder, &shape, class),
            Self::Van {
                length_m,
                height_m,
                reflectance,
            } => {
                builder.set_material(class, reflectance);
                add_van(builder, length_m, height_m, class);
            }
            Self::Cyclist => add_cyclist(builder, class, stride_rad),
            Self::Pedestrian { height_m } => {
                builder.set_material(class, 0.4);
                add_person(builder, Vec3::ZERO, height_m, stride_rad.sin());
            }
        }
    }
}

fn add_car(builder: &mut MeshBuilder, shape: &CarShape, class: u16) {
    let (l, w) = (shape.length_m, 0.5 * shape.width_m);
    let waist_m = 0.62 * shape.height_m;
    let outline = [
        (-0.5 * l, 0.32),
        (-0.38 * l, 0.2),
        (0.4 * l, 0.2),
        (0.5 * l, 0.3),
        (0.49 * l, 0.42 * shape.height_m),
        (shape.bonnet * l, waist_m),
        (-shape.boot * l, waist_m + 0.02),
        (-0.5 * l, waist_m - 0.1),
    ];
    builder.set_material(class, shape.reflectance);
    builder.prism(&outline, [-w, w]);
    let (rear, front) = (-shape.boot * l, shape.bonnet * l);
    let lean_m = 0.16 * l;
    let roof = ([rear + 0.4 * lean_m, front - lean_m], [-0.75 * w, 0.75 * w]);
    let roof_m = [shape.height_m - 0.04, shape.height_m];
    let waist = ([rear, front], [-0.95 * w, 0.95 * w], waist_m);
    builder.set_material(class, GLASS_REFLECTANCE);
    builder.frustum(waist, (roof.0, roof.1, roof_m[0]));
    builder.set_material(class, shape.reflectance);
    builder.cuboid(roof.0, roof.1, roof_m);
    add_wheels(builder, class, 0.31 * l, w, 0.31);
}

fn add_van(builder: &mut MeshBuilder, length_m: f32, height_m: f32, class: u16) {
    let (l, w) = (length_m, 1.0);
    let outline = [
        (-0.5 * l, 0.35),
        (0.48 * l, 0.3),
        (0.5 * l, 0.9),
        (0.36 * l, 1.15),
        (0.24 * l, height_m),
        (-0.5 * l, height_m),
    ];
    builder.prism(&outline, [-w, w]);
    add_wheels(builder, class, 0.3 * l, w, 0.36);
}

fn add_wheels(
    builder: &mut MeshBuilder,
    class: u16,
    axle_m: f32,
    half_width_m: f32,
    radius_m: f32,
) {
    builder.set_material(class, RUBBER_REFLECTANCE);
    for x in [-axle_m, axle_m] {
        for side in [-1.0, 1.0] {
            let middle_m = side * (half_width_m - 0.09);
            add_wheel(builder, x, [middle_m - 0.1, middle_m + 0.1], radius_m);
        }
    }
}

fn add_wheel(builder: &mut MeshBuilder, x: f32, y: [f32; 2], radius_m: f32) {
    let outline: [(f32, f32); 10] = std::array::from_fn(|corner| {
        let angle = TAU * corner as f32 / 10.0;
        (x + radius_m * angle.cos(), radius_m * (1.0 + angle.sin()))
    });
    builder.prism(&outline, y);
}

/// Adds legs, trunk, neck and head; `stride` is the position of the feet, -1 to 1.
fn add_person(builder: &mut MeshBuilder, feet: Vec3, height_m: f32, stride: f32) {
    let square = |center: Vec3, half_m: f32| {
        let extent = |middle: f32| [middle - half_m, middle + half_m];
        (extent(center.x), extent(center.y), center.z)
    };
    let leg_m = 0.47 * height_m;
    for (side, swing) in [(-0.1, stride), (0.1, -stride)] {
        let foot = feet + Vec3::new(0.25 * swing, side, 0.0);
        let hip = feet + Vec3::new(0.0, side, leg_m);
        builder.frustum(square(foot, 0.07), square(hip, 0.09));
    }
    builder.cone(feet + Vec3::Z * leg_m, [0.17, 0.22], 0.36 * height_m, 8);
    for (low, radii_m, share) in [(0.83, [0.07, 0.11], 0.1), (0.93, [0.11, 0.05], 0.07)] {
        builder.cone(
            feet + Vec3::Z * low * height_m,
            radii_m,
            share * height_m,
            8,
        );
    }
}

fn add_cyclist(builder: &mut MeshBuilder, class: u16, stride_rad: f32) {
    builder.set_material(class, RUBBER_REFLECTANCE);
    for x in [-0.52, 0.52] {
        add_wheel(builder, x, [-0.02, 0.02], 0.34);
    }
    builder.set_material(class, 0.3);
    builder.cuboid([-0.5, 0.5], [-0.03, 0.03], [0.55, 0.65]);
    builder.cuboid([0.38, 0.45], [-0.28, 0.28], [0.95, 1.02]);
    builder.set_material(class, 0.45);
    let feet = Vec3::new(-0.1, 0.0, 0.25);
    add_person(builder, feet, 1.55, 0.6 * stride_rad.sin());
}
