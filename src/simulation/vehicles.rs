//! Cars, vans, cyclists and people.
//!
//! The frame of each: origin on the ground under its middle, x forward, y left, z up.

use glam::Vec3;
use rand::{Rng, RngExt as _};

use super::builder::Builder;
use super::classes;

const GLASS_REFLECTANCE: f32 = 0.06;
const RUBBER_REFLECTANCE: f32 = 0.05;

/// What a thing on the street looks like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Vehicle {
    /// A passenger car.
    Car(CarShape),
    /// A delivery van with a box.
    Van {
        /// Length and height [m].
        length_m: f32,
        height_m: f32,
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

/// The proportions of a passenger car.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarShape {
    length_m: f32,
    width_m: f32,
    height_m: f32,
    /// Where the windscreen meets the bonnet, and where the rear window ends, as shares of the
    /// length in front of and behind the middle.
    bonnet: f32,
    boot: f32,
    reflectance: f32,
}

impl Vehicle {
    /// A passenger car: small, hatchback, saloon, estate or tall.
    pub fn random_car(rng: &mut impl Rng) -> Self {
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

    /// A delivery van.
    pub fn random_van(rng: &mut impl Rng) -> Self {
        Self::Van {
            length_m: rng.random_range(4.9..6.4),
            height_m: rng.random_range(2.0..2.8),
            reflectance: [0.2, 0.7, 0.85][rng.random_range(0..3)],
        }
    }

    /// A pedestrian.
    pub fn random_pedestrian(rng: &mut impl Rng) -> Self {
        Self::Pedestrian {
            height_m: rng.random_range(1.5..1.95),
        }
    }

    /// Half of length and width [m].
    pub fn half_size_m(&self) -> [f64; 2] {
        match self {
            Self::Car(shape) => [
                0.5 * f64::from(shape.length_m),
                0.5 * f64::from(shape.width_m),
            ],
            Self::Van { length_m, .. } => [0.5 * f64::from(*length_m), 1.0],
            Self::Cyclist => [0.9, 0.3],
            Self::Pedestrian { .. } => [0.3, 0.3],
        }
    }

    /// Its class while it stands or moves.
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

    /// Adds its surface. `stride` is the phase of walking or pedalling [rad].
    pub fn add_to(&self, builder: &mut Builder, is_moving: bool, stride: f32) {
        let class = self.class(is_moving);
        match self {
            Self::Car(shape) => add_car(builder, shape, class),
            Self::Van {
                length_m,
                height_m,
                reflectance,
            } => add_van(builder, *length_m, *height_m, class, *reflectance),
            Self::Cyclist => add_cyclist(builder, class, stride),
            Self::Pedestrian { height_m } => {
                builder.paint(class, 0.4);
                add_person(builder, Vec3::ZERO, *height_m, stride.sin());
            }
        }
    }
}

fn add_car(builder: &mut Builder, shape: &CarShape, class: u16) {
    let (l, w) = (shape.length_m, 0.5 * shape.width_m);
    let waist_m = 0.62 * shape.height_m;
    builder.paint(class, shape.reflectance);
    builder.prism(
        &[
            (-0.5 * l, 0.32),
            (-0.38 * l, 0.2),
            (0.4 * l, 0.2),
            (0.5 * l, 0.3),
            (0.49 * l, 0.42 * shape.height_m),
            (shape.bonnet * l, waist_m),
            (-shape.boot * l, waist_m + 0.02),
            (-0.5 * l, waist_m - 0.1),
        ],
        -w,
        w,
    );
    let (rear, front) = (-shape.boot * l, shape.bonnet * l);
    let lean_m = 0.16 * l;
    builder.paint(class, GLASS_REFLECTANCE);
    builder.frustum(
        [
            Vec3::new(rear, -0.95 * w, waist_m),
            Vec3::new(front, 0.95 * w, waist_m),
        ],
        [
            Vec3::new(rear + 0.4 * lean_m, -0.75 * w, shape.height_m - 0.04),
            Vec3::new(front - lean_m, 0.75 * w, shape.height_m - 0.04),
        ],
    );
    builder.paint(class, shape.reflectance);
    builder.cuboid(
        Vec3::new(rear + 0.4 * lean_m, -0.75 * w, shape.height_m - 0.04),
        Vec3::new(front - lean_m, 0.75 * w, shape.height_m),
    );
    add_wheels(builder, class, 0.31 * l, w, 0.31);
}

fn add_van(builder: &mut Builder, length_m: f32, height_m: f32, class: u16, reflectance: f32) {
    let (l, w) = (length_m, 1.0);
    builder.paint(class, reflectance);
    builder.prism(
        &[
            (-0.5 * l, 0.35),
            (0.48 * l, 0.3),
            (0.5 * l, 0.9),
            (0.36 * l, 1.15),
            (0.24 * l, height_m),
            (-0.5 * l, height_m),
        ],
        -w,
        w,
    );
    add_wheels(builder, class, 0.3 * l, w, 0.36);
}

fn add_wheels(builder: &mut Builder, class: u16, axle_m: f32, half_width_m: f32, radius_m: f32) {
    builder.paint(class, RUBBER_REFLECTANCE);
    for x in [-axle_m, axle_m] {
        for side in [-1.0, 1.0] {
            let middle_m = side * (half_width_m - 0.09);
            add_wheel(builder, x, [middle_m - 0.1, middle_m + 0.1], radius_m);
        }
    }
}

fn add_wheel(builder: &mut Builder, x: f32, [y_min, y_max]: [f32; 2], radius_m: f32) {
    let outline: Vec<(f32, f32)> = (0..10)
        .map(|corner| {
            let angle = std::f32::consts::TAU * corner as f32 / 10.0;
            (x + radius_m * angle.cos(), radius_m * (1.0 + angle.sin()))
        })
        .collect();
    builder.prism(&outline, y_min, y_max);
}

fn add_person(builder: &mut Builder, feet: Vec3, height_m: f32, stride: f32) {
    let leg_m = 0.47 * height_m;
    for (side, swing) in [(-0.1, stride), (0.1, -stride)] {
        let foot = feet + Vec3::new(0.25 * swing, side, 0.0);
        let hip = feet + Vec3::new(0.0, side, leg_m);
        builder.frustum(
            [
                foot - Vec3::splat(0.07) * (Vec3::X + Vec3::Y),
                foot + Vec3::splat(0.07) * (Vec3::X + Vec3::Y),
            ],
            [
                hip - Vec3::splat(0.09) * (Vec3::X + Vec3::Y),
                hip + Vec3::splat(0.09) * (Vec3::X + Vec3::Y),
            ],
        );
    }
    builder.cylinder(feet + Vec3::Z * leg_m, [0.17, 0.22], 0.36 * height_m, 8);
    builder.cylinder(
        feet + Vec3::Z * 0.83 * height_m,
        [0.07, 0.11],
        0.1 * height_m,
        8,
    );
    builder.cylinder(
        feet + Vec3::Z * 0.93 * height_m,
        [0.11, 0.05],
        0.07 * height_m,
        8,
    );
}

fn add_cyclist(builder: &mut Builder, class: u16, stride: f32) {
    builder.paint(class, RUBBER_REFLECTANCE);
    for x in [-0.52, 0.52] {
        add_wheel(builder, x, [-0.02, 0.02], 0.34);
    }
    builder.paint(class, 0.3);
    builder.cuboid(Vec3::new(-0.5, -0.03, 0.55), Vec3::new(0.5, 0.03, 0.65));
    builder.cuboid(Vec3::new(0.38, -0.28, 0.95), Vec3::new(0.45, 0.28, 1.02));
    builder.paint(class, 0.45);
    add_person(
        builder,
        Vec3::new(-0.1, 0.0, 0.25),
        1.55,
        0.6 * stride.sin(),
    );
}
