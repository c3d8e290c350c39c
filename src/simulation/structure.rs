//! Structures along the driven path: an outline across the path, swept along it. Tunnels, guard rails,
//! embankments, yards, hoardings and pillars are such structures.

use glam::{DVec2, Vec3};
use serde::{Deserialize, Serialize};

use super::builder::{LabelledMesh, Material, MeshBuilder};
use super::centreline::Centreline;
use super::classes;
use crate::geometry::{Pose3, Rigid3f};
use crate::validation::{InvalidValue, Validate, in_range, require};

/// Distance between the cross-sections of a piece [m].
const STEP_M: f64 = 2.0;
const REFLECTANCE: f32 = 0.5;

/// A structure along the path, in one piece or in several equal ones.
///
/// Defaults: a wall of 20 m, 2 m high, 3.5 m to the right of the path.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Structure {
    /// Station of its start on the path [m]; before the path if negative.
    pub from_m: f64,
    /// Station of its end [m].
    pub to_m: f64,
    /// Distance between the starts of its pieces [m]; 0: it is one piece.
    pub spacing_m: f64,
    /// Length of each piece if there are several [m].
    pub length_m: f64,
    /// Corners of its convex outline: offset to the left of the path, height above the road below the path [m].
    pub outline: Vec<[f64; 2]>,
}

impl Default for Structure {
    fn default() -> Self {
        Self {
            from_m: 0.0,
            to_m: 20.0,
            spacing_m: 0.0,
            length_m: 0.5,
            outline: vec![[-3.5, -0.3], [-3.5, 2.0], [-3.7, 2.0], [-3.7, -0.3]],
        }
    }
}

impl Validate for Structure {
    fn validate(&self) -> Result<(), InvalidValue> {
        /// Largest number of pieces, and corners of an outline.
        const MOST: (f64, usize) = (10_000.0, 16);
        in_range("from_m", self.from_m, -1000.0..=100_000.0)?;
        in_range("to_m", self.to_m, self.from_m..=101_000.0)?;
        in_range("spacing_m", self.spacing_m, 0.0..=100_000.0)?;
        in_range("length_m", self.length_m, 0.01..=100_000.0)?;
        require(
            self.spacing_m == 0.0 || (self.to_m - self.from_m) / self.spacing_m <= MOST.0,
            "spacing_m",
            self.spacing_m,
            format!("a structure has at most {} pieces", MOST.0),
        )?;
        in_range("outline", self.outline.len(), 3..=MOST.1)?;
        for &offset in self.outline.iter().flatten() {
            in_range("outline", offset, -500.0..=500.0)?;
        }
        Ok(())
    }
}

impl Structure {
    /// Area of its surface [m²], without the ends.
    pub fn area_m2(&self) -> f64 {
        let corners = self.outline.iter().map(|&corner| DVec2::from(corner));
        let next = corners.clone().cycle().skip(1);
        let around_m: f64 = corners.zip(next).map(|(a, b)| a.distance(b)).sum();
        let length_m: f64 = self.pieces().map(|[from_m, to_m]| to_m - from_m).sum();
        around_m * length_m
    }

    /// Adds the surface to a mesh in the world frame, in which the road has a height [m] at each position.
    pub fn add_to(
        &self,
        target: &mut LabelledMesh,
        path: &Centreline,
        road_m: &impl Fn(DVec2) -> f32,
    ) {
        let mut builder = MeshBuilder::new(target, Rigid3f::from(&Pose3::identity()));
        let Material { class, reflectance } = Material::new(classes::OTHER_STRUCTURE, REFLECTANCE);
        builder.set_material(class, reflectance);
        for [from_m, to_m] in self.pieces() {
            let steps = ((to_m - from_m) / STEP_M).ceil().max(1.0) as usize;
            let rings: Vec<Vec<Vec3>> = (0..=steps)
                .map(|step| from_m + (to_m - from_m) * step as f64 / steps as f64)
                .map(|station_m| self.corners_at(station_m, path, road_m))
                .collect();
            for pair in rings.windows(2) {
                for corner in 0..self.outline.len() {
                    let next = (corner + 1) % self.outline.len();
                    let [near, far] = [&pair[0], &pair[1]];
                    builder.quad([near[corner], near[next], far[next], far[corner]]);
                }
            }
            for end in [&rings[0], &rings[steps]] {
                for corner in 1..self.outline.len() - 1 {
                    builder.triangle([end[0], end[corner], end[corner + 1]]);
                }
            }
        }
    }

    /// Stations of the ends of each piece [m].
    fn pieces(&self) -> impl Iterator<Item = [f64; 2]> {
        let count = if self.spacing_m > 0.0 {
            ((self.to_m - self.from_m) / self.spacing_m) as usize + 1
        } else {
            1
        };
        let length_m = if self.spacing_m > 0.0 {
            self.length_m
        } else {
            self.to_m - self.from_m
        };
        (0..count).map(move |piece| {
            let from_m = self.from_m + piece as f64 * self.spacing_m;
            [from_m, from_m + length_m]
        })
    }

    fn corners_at(
        &self,
        station_m: f64,
        path: &Centreline,
        road_m: &impl Fn(DVec2) -> f32,
    ) -> Vec<Vec3> {
        let point = path.at(station_m);
        let road_m = road_m(point.position);
        let corner = |&[left_m, height_m]: &[f64; 2]| {
            let place = point.beside(left_m);
            Vec3::new(place.x as f32, place.y as f32, road_m + height_m as f32)
        };
        self.outline.iter().map(corner).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::street_config::StreetConfig;
    use super::super::{PathSegment, Street};
    use super::*;

    /// A street with nothing along it but structures.
    fn street(path: &Centreline, structures: Vec<Structure>) -> Street {
        let config = StreetConfig {
            structures,
            ..StreetConfig::bare()
        };
        Street::new(path, &config, 1)
    }

    fn vertices(street: &Street) -> Vec<Vec3> {
        let LabelledMesh { mesh, materials } = &street.surface;
        let of_structures =
            |triangle: &usize| materials[*triangle].class == classes::OTHER_STRUCTURE;
        (0..mesh.triangles.len())
            .filter(of_structures)
            .flat_map(|triangle| mesh.corners(triangle))
            .collect()
    }

    #[test]
    fn a_wall_keeps_its_distance_to_a_curved_path_and_its_height() {
        let path = Centreline::from_segments(&[PathSegment::new(80.0, 90.0, 0.0)], 0.0);
        let structure = Structure {
            from_m: 10.0,
            to_m: 70.0,
            ..Structure::default()
        };
        let area_m2 = structure.area_m2();
        assert!((area_m2 - 60.0 * 5.0).abs() < 1e-6, "{area_m2}");
        let found = vertices(&street(&path, vec![structure]));
        assert!(found.len() > 300);
        for corner in found {
            let place = DVec2::new(corner.x.into(), corner.y.into());
            let nearest_m = (0..=800)
                .map(|step| path.at(0.1 * f64::from(step)).position.distance(place))
                .fold(f64::INFINITY, f64::min);
            assert!((3.45..3.75).contains(&nearest_m), "{nearest_m}");
            assert!((-0.31..2.01).contains(&corner.z), "{}", corner.z);
        }
    }

    #[test]
    fn pieces_are_repeated_up_to_the_end_also_before_and_beyond_the_path() {
        let path = Centreline::from_segments(&[PathSegment::new(40.0, 0.0, 0.0)], 0.0);
        let posts = Structure {
            from_m: -20.0,
            to_m: 60.0,
            spacing_m: 10.0,
            length_m: 0.5,
            ..Structure::default()
        };
        let found = vertices(&street(&path, vec![posts]));
        for piece in 0..9 {
            let from_m = -20.0 + 10.0 * piece as f32;
            let is_in_piece = |v: &&Vec3| (from_m - 0.01..from_m + 0.51).contains(&v.x);
            assert!(
                found.iter().filter(is_in_piece).count() >= 24,
                "piece {piece}"
            );
        }
        assert!(
            found
                .iter()
                .all(|v| (v.x + 20.0).rem_euclid(10.0) < 0.51
                    || (v.x + 20.0).rem_euclid(10.0) > 9.99)
        );
    }

    #[test]
    fn senseless_structures_are_refused() {
        let valid = Structure::default();
        assert!(valid.validate().is_ok());
        let two = vec![[0.0, 0.0], [0.0, 1.0]];
        for (key, wrong) in [
            (
                "to_m",
                Structure {
                    to_m: -1.0,
                    ..valid.clone()
                },
            ),
            (
                "spacing_m",
                Structure {
                    spacing_m: 1e-9,
                    ..valid.clone()
                },
            ),
            (
                "outline",
                Structure {
                    outline: two,
                    ..valid.clone()
                },
            ),
            (
                "outline",
                Structure {
                    outline: vec![[f64::NAN; 2]; 4],
                    ..valid.clone()
                },
            ),
        ] {
            let error = wrong.validate().unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
    }
}
