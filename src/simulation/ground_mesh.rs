//! Triangulation of the ground: the cells of the grid, clipped exactly at the kerb, the back of the
//! sidewalk and the line between road and bays. A vertical face closes the step at the kerb.

use glam::{DVec2, Vec3};

use super::builder::{LabelledMesh, Material};
use super::classes;
use super::ground::{GroundField, GroundSample, GroundZone};

/// A vertex of a polygon on the ground.
type GroundVertex = (DVec2, GroundSample);

const ROAD: Material = Material::new(classes::ROAD, 0.22);
const PARKING: Material = Material::new(classes::PARKING, 0.28);
const SIDEWALK: Material = Material::new(classes::SIDEWALK, 0.35);
const TERRAIN: Material = Material::new(classes::TERRAIN, 0.45);

/// Triangles of all ground within reach of the carriageway.
pub fn ground_mesh(ground: &GroundField) -> LabelledMesh {
    let mut target = LabelledMesh::default();
    let (columns, rows) = ground.cells();
    for row in 0..rows {
        for column in 0..columns {
            let [a, b, c, d] = [(0, 0), (1, 0), (1, 1), (0, 1)]
                .map(|(right, up)| ground.node(column + right, row + up));
            let farthest_m = [a, b, c, d].iter().fold(0.0, |m, n| n.1.kerb_m.max(m));
            if f64::from(farthest_m) < ground.config.reach_m {
                add_triangle(ground, [a, b, c], &mut target);
                add_triangle(ground, [a, c, d], &mut target);
            }
        }
    }
    target
}

fn add_triangle(ground: &GroundField, corners: [GroundVertex; 3], target: &mut LabelledMesh) {
    let sidewalk_m = ground.config.sidewalk_width_m as f32;
    let kerb = clip(&corners, |sample| sample.kerb_m);
    let road = clip(&kerb.negative, |sample| sample.road_m);
    let sidewalk = clip(&kerb.positive, |sample| sample.kerb_m - sidewalk_m);
    let point = |(position, sample): &GroundVertex, zone: GroundZone| {
        let height_m = ground.zone_height_m(sample, zone);
        Vec3::new(position.x as f32, position.y as f32, height_m)
    };
    let mut fan = |polygon: &[GroundVertex], zone: GroundZone, material: Material| {
        for pair in polygon.windows(2).skip(1) {
            let corners = [&polygon[0], &pair[0], &pair[1]];
            target.push(corners.map(|vertex| point(vertex, zone)), material);
        }
    };
    fan(&road.negative, GroundZone::Carriageway, ROAD);
    fan(&road.positive, GroundZone::Carriageway, PARKING);
    fan(&sidewalk.negative, GroundZone::Sidewalk, SIDEWALK);
    fan(&sidewalk.positive, GroundZone::Terrain, TERRAIN);
    if let Some(cut) = kerb.cut {
        // The cut runs with the carriageway on its left, which the face is towards.
        let low = cut.map(|vertex| point(&vertex, GroundZone::Carriageway));
        let high = cut.map(|vertex| point(&vertex, GroundZone::Sidewalk));
        target.push([low[1], low[0], high[0]], SIDEWALK);
        target.push([low[1], high[0], high[1]], SIDEWALK);
    }
}

/// A convex polygon clipped where a value changes its sign.
#[derive(Default)]
struct ClippedPolygon {
    negative: Vec<GroundVertex>,
    positive: Vec<GroundVertex>,
    /// Ends of the cut, `negative` on its left.
    cut: Option<[GroundVertex; 2]>,
}

fn clip(polygon: &[GroundVertex], value: impl Fn(&GroundSample) -> f32) -> ClippedPolygon {
    let mut parts = ClippedPolygon::default();
    let (mut leaves_negative, mut enters_negative) = (None, None);
    for (index, vertex) in polygon.iter().enumerate() {
        let next = &polygon[(index + 1) % polygon.len()];
        let (here, there) = (value(&vertex.1), value(&next.1));
        if here < 0.0 {
            parts.negative.push(*vertex);
        } else {
            parts.positive.push(*vertex);
        }
        if (here < 0.0) != (there < 0.0) {
            let t = here / (here - there);
            let position = vertex.0.lerp(next.0, f64::from(t));
            let crossing = (position, vertex.1.lerp(next.1, t));
            parts.negative.push(crossing);
            parts.positive.push(crossing);
            if here < 0.0 {
                leaves_negative = Some(crossing);
            } else {
                enters_negative = Some(crossing);
            }
        }
    }
    // Counter-clockwise around `negative`, its boundary leaves along the cut.
    parts.cut = leaves_negative.zip(enters_negative).map(|(a, b)| [a, b]);
    parts
}

#[cfg(test)]
mod tests {
    use super::super::centreline::{Centreline, PathSegment};
    use super::super::layout::{StreetLayout, Strip};
    use super::super::street_config::CrossSectionConfig;
    use super::*;

    fn street() -> GroundField {
        let segments = [(40.0, 0.0), (20.0, 60.0), (40.0, 0.0)]
            .map(|(length_m, turn_deg)| PathSegment::new(length_m, turn_deg, 5.0));
        let centreline = Centreline::from_segments(&segments, 0.0);
        let strip = |lateral_m, half_width_m| Strip {
            centreline: centreline.shifted(lateral_m),
            half_width_m,
        };
        let layout = StreetLayout {
            roads: vec![strip(0.0, 3.5)],
            bays: vec![strip(-4.5, 1.1)],
            square: None,
        };
        GroundField::new(&centreline, &layout, &CrossSectionConfig::default(), 1)
    }

    #[test]
    fn every_triangle_of_the_ground_has_the_class_of_its_zone() {
        let ground = street();
        let mesh = ground_mesh(&ground);
        let mut seen = std::collections::BTreeSet::new();
        for triangle in 0..mesh.mesh.triangles.len() {
            let normal = mesh.mesh.scaled_normal(triangle);
            if normal.z.abs() < 0.5 * normal.length() || normal.length() < 1e-3 {
                continue; // The face of the kerb, or a sliver.
            }
            assert!(normal.z > 0.0, "the ground faces up");
            let [a, b, c] = mesh.mesh.corners(triangle);
            let middle = (a + b + c) / 3.0;
            let sample = ground.at(DVec2::new(middle.x.into(), middle.y.into()));
            // Within the width of a cell of a boundary the field is not linear.
            let class = mesh.materials[triangle].class;
            seen.insert(class);
            let expected = match ground.zone_of(sample.kerb_m) {
                GroundZone::Carriageway if sample.road_m < 0.0 => classes::ROAD,
                GroundZone::Carriageway => classes::PARKING,
                GroundZone::Sidewalk => classes::SIDEWALK,
                GroundZone::Terrain => classes::TERRAIN,
            };
            let width_m = ground.config.sidewalk_width_m as f32;
            let boundary_m = [sample.kerb_m, sample.road_m, sample.kerb_m - width_m]
                .map(f32::abs)
                .into_iter()
                .fold(f32::INFINITY, f32::min);
            assert!(class == expected || boundary_m < 0.15, "{class} {expected}");
        }
        assert_eq!(
            seen.into_iter().collect::<Vec<_>>(),
            [
                classes::ROAD,
                classes::PARKING,
                classes::SIDEWALK,
                classes::TERRAIN
            ]
        );
    }

    #[test]
    fn the_ground_has_no_gap_at_the_kerb_whose_face_is_towards_the_road() {
        let ground = street();
        let mesh = ground_mesh(&ground).mesh;
        let mut kerb_area = 0.0;
        for triangle in 0..mesh.triangles.len() {
            let normal = mesh.scaled_normal(triangle);
            if normal.length() < 1e-4 || normal.z.abs() > 0.3 * normal.length() {
                continue;
            }
            kerb_area += 0.5 * normal.length();
            let [a, b, c] = mesh.corners(triangle);
            let middle = (a + b + c) / 3.0 + 0.3 * normal.normalize();
            let ahead = DVec2::new(middle.x.into(), middle.y.into());
            assert!(ground.kerb_distance_m(ahead) < 0.0);
            let height_m = a.max(b).max(c).z - a.min(b).min(c).z;
            assert!(height_m > 0.1 && height_m < 0.25, "{height_m}");
        }
        // Both sides of about 100 m, 12 cm high, and around the ends.
        assert!(kerb_area > 24.0 && kerb_area < 32.0, "{kerb_area}");
    }
}
