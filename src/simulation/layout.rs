//! What is where, before anything has a shape: roads, bays, the square, and the places taken.

use glam::DVec2;
use rand::{Rng, RngExt as _};

use super::ground::Paving;
use super::path::{Path, PathPoint};
use super::street::StreetConfig;

/// Width of a parking bay [m].
pub const BAY_WIDTH_M: f64 = 2.2;

/// A road with houses on both sides.
#[derive(Clone, Debug)]
pub struct Road {
    /// Its middle.
    pub path: Path,
    /// From the middle to the kerb [m].
    pub half_width_m: f64,
}

/// A row of parking bays beside the main road.
#[derive(Clone, Debug)]
pub struct BayRow {
    /// The middle of the row.
    pub path: Path,
}

/// The plan of the street.
#[derive(Clone, Debug)]
pub struct Layout {
    /// The main road first, then the side streets.
    pub roads: Vec<Road>,
    /// Rows of bays.
    pub bays: Vec<BayRow>,
    /// Frame of the open square: its middle and the direction of its long side; half sizes.
    pub square: Option<(PathPoint, DVec2)>,
}

impl Layout {
    /// Plans a street along the line that is driven.
    pub fn new(line: &Path, config: &StreetConfig, rng: &mut impl Rng) -> Self {
        let half_width_m = config.lane_width_m + 0.4;
        let main = Road {
            path: line.shifted(0.5 * config.lane_width_m),
            half_width_m,
        };
        let length_m = main.path.length_m();
        let mut roads = vec![main];
        let mut mouths_m = Vec::new();
        let mut station_m = config.side_street_spacing_m * rng.random_range(0.5..0.9);
        while station_m < length_m - 20.0 {
            roads.push(side_street(&roads[0].path, station_m, rng));
            mouths_m.push(station_m);
            station_m += config.side_street_spacing_m * rng.random_range(0.6..1.4);
        }
        let square = config.has_square.then(|| {
            let half_size_m = DVec2::new(rng.random_range(14.0..19.0), rng.random_range(9.0..13.0));
            let mut point = roads[0].path.at(length_m * rng.random_range(0.55..0.65));
            let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            point.position = point.beside(side * (half_width_m + half_size_m.y - 0.5));
            (point, half_size_m)
        });
        let bays = [-1.0, 1.0]
            .into_iter()
            .flat_map(|side| bay_rows(&roads[0], side, &mouths_m, rng))
            .collect();
        Self {
            roads,
            bays,
            square,
        }
    }

    /// The shapes that the carriageway consists of.
    pub fn pavings(&self) -> Vec<Paving> {
        let roads = self.roads.iter().map(|road| Paving::Road {
            path: road.path.clone(),
            half_width_m: road.half_width_m,
        });
        let bays = self.bays.iter().map(|row| Paving::Bays {
            path: row.path.clone(),
            half_width_m: 0.5 * BAY_WIDTH_M,
        });
        let square = self
            .square
            .iter()
            .map(|(point, half_size_m)| Paving::Square {
                center: point.position,
                forward: point.forward,
                half_size_m: *half_size_m,
            });
        roads.chain(bays).chain(square).collect()
    }
}

fn side_street(main: &Path, station_m: f64, rng: &mut impl Rng) -> Road {
    let point = main.at(station_m);
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let turn_rad = side * rng.random_range(65.0..115.0_f64).to_radians();
    let direction = DVec2::from_angle(turn_rad).rotate(point.forward);
    let end = point.position + rng.random_range(38.0..60.0) * direction;
    Road {
        path: Path::straight(point.position, end),
        half_width_m: rng.random_range(2.5..3.3),
    }
}

fn bay_rows(road: &Road, side: f64, mouths_m: &[f64], rng: &mut impl Rng) -> Vec<BayRow> {
    let lateral_m = side * (road.half_width_m + 0.5 * BAY_WIDTH_M - 0.02);
    let mut rows = Vec::new();
    let mut from_m = rng.random_range(5.0..15.0);
    while from_m < road.path.length_m() - 12.0 {
        let to_m = from_m + rng.random_range(9.0..32.0);
        let is_clear = mouths_m
            .iter()
            .all(|&mouth_m| mouth_m < from_m - 12.0 || mouth_m > to_m + 12.0);
        if is_clear && to_m < road.path.length_m() {
            rows.push(BayRow {
                path: road.path.section(from_m, to_m, lateral_m),
            });
        }
        from_m = to_m + rng.random_range(4.0..18.0);
    }
    rows
}

/// A rectangle in the plane that something stands on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Middle [m].
    pub center: DVec2,
    /// Unit direction of its length.
    pub forward: DVec2,
    /// Half of its length and width [m].
    pub half_m: DVec2,
}

impl Footprint {
    /// The corners, and the middles of the sides.
    pub fn border(&self) -> impl Iterator<Item = DVec2> {
        let (along, across) = (
            self.half_m.x * self.forward,
            self.half_m.y * self.forward.perp(),
        );
        let center = self.center;
        [
            (-1.0, -1.0),
            (0.0, -1.0),
            (1.0, -1.0),
            (1.0, 0.0),
            (1.0, 1.0),
            (0.0, 1.0),
            (-1.0, 1.0),
            (-1.0, 0.0),
        ]
        .into_iter()
        .map(move |(u, v)| center + u * along + v * across)
    }

    /// Whether two rectangles overlap, by the separating axis theorem.
    pub fn overlaps(&self, other: &Self) -> bool {
        let axes = [
            self.forward,
            self.forward.perp(),
            other.forward,
            other.forward.perp(),
        ];
        axes.into_iter().all(|axis| {
            let radius_m = |footprint: &Self| {
                footprint.half_m.x * footprint.forward.dot(axis).abs()
                    + footprint.half_m.y * footprint.forward.perp().dot(axis).abs()
            };
            (other.center - self.center).dot(axis).abs() < radius_m(self) + radius_m(other)
        })
    }
}

/// The places that are taken.
#[derive(Clone, Debug, Default)]
pub struct Occupancy(Vec<Footprint>);

impl Occupancy {
    /// Takes a place unless something stands there.
    pub fn claim(&mut self, footprint: Footprint) -> bool {
        let is_free = !self.0.iter().any(|taken| taken.overlaps(&footprint));
        if is_free {
            self.0.push(footprint);
        }
        is_free
    }

    /// Takes a square place of `half_m` around a point unless something stands there.
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
    fn a_place_is_given_once() {
        let mut occupancy = Occupancy::default();
        assert!(occupancy.claim_around(DVec2::ZERO, 1.0));
        assert!(!occupancy.claim_around(DVec2::ONE, 0.5));
        assert!(occupancy.claim_around(DVec2::splat(2.0), 0.5));
    }
}
