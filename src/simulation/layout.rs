//! Layout of the street before anything has a shape: roads, parking bays, the square, and the
//! occupied ground.

use std::ops::Range;

use glam::DVec2;
use rand::{Rng, RngExt as _};

use super::centreline::Centreline;
use super::street_config::StreetConfig;

/// Width of a parking bay [m].
pub const BAY_WIDTH_M: f64 = 2.2;

/// Length by which the street extends beyond both ends of the driven path [m].
pub const EXTENSION_M: f64 = 40.0;

/// A paved strip of constant width: a road, or a row of parking bays.
#[derive(Clone, Debug)]
pub struct Strip {
    /// Its centreline.
    pub centreline: Centreline,
    /// From the centreline to the edge [m].
    pub half_width_m: f64,
}

/// Positions of everything that is paved.
#[derive(Clone, Debug)]
pub struct StreetLayout {
    /// The main road first, then the side streets.
    pub roads: Vec<Strip>,
    /// Rows of parking bays next to the main road.
    pub bays: Vec<Strip>,
    /// The open square, its longer side along the main road.
    pub square: Option<Footprint>,
}

impl StreetLayout {
    /// Lays out a street whose right lane has a centreline.
    pub fn new(lane: &Centreline, config: &StreetConfig, rng: &mut impl Rng) -> Self {
        let half_width_m = config.lane_width_m + 0.4;
        let main = Strip {
            centreline: lane.shifted(0.5 * config.lane_width_m),
            half_width_m,
        };
        let length_m = main.centreline.length_m();
        let mut roads = vec![main];
        let mut junctions_m = Vec::new();
        let mut station_m = config.side_street_spacing_m * rng.random_range(0.5..0.9);
        while station_m < length_m - 20.0 {
            roads.push(side_street(&roads[0].centreline, station_m, rng));
            junctions_m.push(station_m);
            station_m += config.side_street_spacing_m * rng.random_range(0.6..1.4);
        }
        let square = config.has_square.then(|| {
            let half_m = DVec2::new(rng.random_range(14.0..19.0), rng.random_range(9.0..13.0));
            let point = roads[0]
                .centreline
                .at(length_m * rng.random_range(0.55..0.65));
            let side = random_side(rng);
            Footprint {
                center: point.beside(side * (half_width_m + half_m.y - 0.5)),
                forward: point.forward,
                half_m,
            }
        });
        let bays = [-1.0, 1.0]
            .into_iter()
            .flat_map(|side| bay_rows(&roads[0], side, &junctions_m, rng))
            .collect();
        Self {
            roads,
            bays,
            square,
        }
    }
}

/// Left (+1) or right (-1) with equal probability.
pub fn random_side(rng: &mut impl Rng) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

fn side_street(main: &Centreline, station_m: f64, rng: &mut impl Rng) -> Strip {
    let point = main.at(station_m);
    let turn_rad = random_side(rng) * rng.random_range(65.0..115.0_f64).to_radians();
    let direction = DVec2::from_angle(turn_rad).rotate(point.forward);
    let end = point.position + rng.random_range(38.0..60.0) * direction;
    Strip {
        centreline: Centreline::straight(point.position, end),
        half_width_m: rng.random_range(2.5..3.3),
    }
}

fn bay_rows(road: &Strip, side: f64, junctions_m: &[f64], rng: &mut impl Rng) -> Vec<Strip> {
    let lateral_m = side * (road.half_width_m + 0.5 * BAY_WIDTH_M - 0.02);
    let mut rows = Vec::new();
    let mut from_m = rng.random_range(5.0..15.0);
    while from_m < road.centreline.length_m() - 12.0 {
        let to_m = from_m + rng.random_range(9.0..32.0);
        let is_clear = junctions_m
            .iter()
            .all(|&junction_m| junction_m < from_m - 12.0 || junction_m > to_m + 12.0);
        if is_clear && to_m < road.centreline.length_m() {
            rows.push(Strip {
                centreline: road.centreline.section(from_m, to_m, lateral_m),
                half_width_m: 0.5 * BAY_WIDTH_M,
            });
        }
        from_m = to_m + rng.random_range(4.0..18.0);
    }
    rows
}

/// An oriented rectangle in the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Centre [m].
    pub center: DVec2,
    /// Unit direction of its length.
    pub forward: DVec2,
    /// Half of its length and width [m].
    pub half_m: DVec2,
}

impl Footprint {
    /// The corners and the midpoints of the sides.
    pub fn outline(&self) -> [DVec2; 8] {
        const ALONG: [f64; 8] = [-1.0, 0.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0];
        const ACROSS: [f64; 8] = [-1.0, -1.0, -1.0, 0.0, 1.0, 1.0, 1.0, 0.0];
        let along = self.half_m.x * self.forward;
        let across = self.half_m.y * self.forward.perp();
        std::array::from_fn(|point| self.center + ALONG[point] * along + ACROSS[point] * across)
    }

    /// Whether two rectangles overlap, by the separating axis theorem.
    pub fn overlaps(&self, other: &Self) -> bool {
        let axes = [self, other].map(|it| [it.forward, it.forward.perp()]);
        axes.as_flattened().iter().all(|axis| {
            let radius_m = |footprint: &Self| {
                footprint.half_m.x * footprint.forward.dot(*axis).abs()
                    + footprint.half_m.y * footprint.forward.perp().dot(*axis).abs()
            };
            (other.center - self.center).dot(*axis).abs() < radius_m(self) + radius_m(other)
        })
    }
}

/// The occupied parts of the ground.
#[derive(Clone, Debug, Default)]
pub struct Occupancy(Vec<Footprint>);

impl Occupancy {
    /// Number of occupied rectangles.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Makes those of a range of numbers free again.
    pub fn release(&mut self, numbers: Range<usize>) {
        self.0.drain(numbers);
    }

    /// Occupies a rectangle if it is free; returns whether it was.
    pub fn claim(&mut self, footprint: Footprint) -> bool {
        let is_free = !self.0.iter().any(|occupied| occupied.overlaps(&footprint));
        if is_free {
            self.0.push(footprint);
        }
        is_free
    }

    /// Occupies a square with edges of twice `half_m` if it is free; returns whether it was.
    pub fn claim_around(&mut self, center: DVec2, half_m: f64) -> bool {
        self.claim(Footprint {
            center,
            forward: DVec2::X,
            half_m: DVec2::splat(half_m),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_overlap_where_they_share_ground() {
        let at = |x: f64, y: f64, angle: f64| Footprint {
            center: DVec2::new(x, y),
            forward: DVec2::from_angle(angle),
            half_m: DVec2::new(2.0, 1.0),
        };
        assert!(at(0.0, 0.0, 0.0).overlaps(&at(3.9, 0.0, 0.0)));
        assert!(!at(0.0, 0.0, 0.0).overlaps(&at(4.1, 0.0, 0.0)));
        // Their bounding boxes overlap, they do not.
        assert!(!at(0.0, 0.0, 0.785).overlaps(&at(2.0, -2.0, 0.785)));
        assert!(at(0.0, 0.0, 0.785).overlaps(&at(2.0, 2.0, 0.785)));
    }

    #[test]
    fn an_occupied_place_is_not_free() {
        let mut occupancy = Occupancy::default();
        assert!(occupancy.claim_around(DVec2::ZERO, 1.0));
        assert!(!occupancy.claim_around(DVec2::ONE, 0.5));
        assert!(occupancy.claim_around(DVec2::splat(2.0), 0.5));
    }
}
