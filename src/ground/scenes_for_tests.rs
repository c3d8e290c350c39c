//! Scans of synthetic worlds for tests: what a spinning sensor measures of ground, boxes and walls.

use glam::Vec3;

/// Distance along a unit direction to a surface, infinite where there is none.
pub(super) type Surface = Box<dyn Fn(Vec3) -> f32>;

/// A sensor with beams at even elevations.
pub(super) struct Sensor {
    pub(super) beams: usize,
    pub(super) lowest_deg: f32,
    pub(super) highest_deg: f32,
    pub(super) height_m: f32,
}

impl Sensor {
    pub(super) const SIXTY_FOUR: Self = Self {
        beams: 64,
        lowest_deg: -24.8,
        highest_deg: 2.0,
        height_m: 1.73,
    };
    pub(super) const THIRTY_TWO: Self = Self {
        beams: 32,
        lowest_deg: -30.0,
        highest_deg: 10.0,
        height_m: 1.9,
    };

    /// The returns of one revolution, and the index of the surface of each.
    pub(super) fn scan(&self, surfaces: &[Surface]) -> (Vec<Vec3>, Vec<usize>) {
        const COLUMNS: usize = 1000;
        let (mut points, mut hits) = (Vec::new(), Vec::new());
        for beam in 0..self.beams {
            let share = beam as f32 / (self.beams - 1) as f32;
            let elevation_deg = self.highest_deg + share * (self.lowest_deg - self.highest_deg);
            let (sin_e, cos_e) = elevation_deg.to_radians().sin_cos();
            for column in 0..COLUMNS {
                let (sin, cos) = (column as f32 / COLUMNS as f32 * std::f32::consts::TAU).sin_cos();
                let direction = Vec3::new(cos_e * cos, cos_e * sin, sin_e);
                let ranges = surfaces.iter().map(|surface| surface(direction));
                let mut nearest = (f32::INFINITY, 0);
                for (number, range_m) in ranges.enumerate() {
                    if range_m < nearest.0 {
                        nearest = (range_m, number);
                    }
                }
                if nearest.0 < 80.0 {
                    points.push(direction * (nearest.0 + noise_m(points.len())));
                    hits.push(nearest.1);
                }
            }
        }
        (points, hits)
    }

    /// Ground whose height above the ground below the sensor is a function of x and y.
    pub(super) fn ground(&self, height: impl Fn(f32, f32) -> f32 + 'static) -> Surface {
        let sensor_m = self.height_m;
        Box::new(move |direction| {
            let below = |range_m: f32| {
                let p = direction * range_m;
                p.z + sensor_m - height(p.x, p.y)
            };
            // The first crossing from above: steps that grow with range, then bisection.
            let (mut near, mut far) = (0.0, 0.5);
            while below(far) > 0.0 {
                near = far;
                far = far * 1.01 + 0.02;
                if far > 90.0 {
                    return f32::INFINITY;
                }
            }
            for _ in 0..20 {
                let middle = 0.5 * (near + far);
                if below(middle) > 0.0 {
                    near = middle;
                } else {
                    far = middle;
                }
            }
            far
        })
    }
}

/// An axis-aligned box between two corners in the lidar frame.
pub(super) fn cuboid(min: Vec3, max: Vec3) -> Surface {
    Box::new(move |direction| {
        let (a, b) = (min / direction, max / direction);
        let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
        if enter > 0.0 && enter <= leave {
            enter
        } else {
            f32::INFINITY
        }
    })
}

/// About 1.5 cm of repeatable noise on the n-th range.
fn noise_m(n: usize) -> f32 {
    let mut hash = n as u32;
    for _ in 0..2 {
        hash = (hash ^ (hash >> 16)).wrapping_mul(0x45d9_f3b5);
    }
    ((hash >> 8) as f32 / (1 << 24) as f32 - 0.5) * 0.05
}
