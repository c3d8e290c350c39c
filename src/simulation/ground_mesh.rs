//! The ground as triangles: the squares of the grid, cut exactly along the kerb, the back of the
//! pavement and the line between road and bays. A vertical face closes the step at the kerb.

use glam::{DVec2, Vec3};

use super::builder::{Paint, PaintedMesh};
use super::classes;
use super::ground::{Ground, Node, Surface};

/// A corner of a piece of ground.
type Corner = (DVec2, Node);

const ROAD: Paint = Paint {
    class: classes::ROAD,
    reflectance: 0.22,
};
const PARKING: Paint = Paint {
    class: classes::PARKING,
    reflectance: 0.28,
};
const SIDEWALK: Paint = Paint {
    class: classes::SIDEWALK,
    reflectance: 0.35,
};
const TERRAIN: Paint = Paint {
    class: classes::TERRAIN,
    reflectance: 0.45,
};

/// Triangles of all ground within reach of the carriageway.
pub fn ground_mesh(ground: &Ground) -> PaintedMesh {
    let mut target = PaintedMesh::default();
    let (columns, rows) = ground.cells();
    for row in 0..rows {
        for column in 0..columns {
            let [a, b] = [ground.node(column, row), ground.node(column + 1, row)];
            let [c, d] = [
                ground.node(column + 1, row + 1),
                ground.node(column, row + 1),
            ];
            let farthest_m = [a, b, c, d].iter().fold(0.0, |m, n| n.1.kerb_m.max(m));
            if f64::from(farthest_m) < ground.config.reach_m {
                add_triangle(ground, [a, b, c], &mut target);
                add_triangle(ground, [a, c, d], &mut target);
            }
        }
    }
    target
}

fn add_triangle(ground: &Ground, corners: [Corner; 3], target: &mut PaintedMesh) {
    let kerb = split(&corners, |node| node.kerb_m);
    let road = split(&kerb.below, |node| node.road_m);
    let width_m = ground.config.sidewalk_width_m as f32;
    let pavement = split(&kerb.above, |node| node.kerb_m - width_m);
    let mut fan = |outline: &[Corner], surface: Surface, paint: Paint| {
        let at = |corner: &Corner| point(ground, corner, surface);
        for pair in outline.windows(2).skip(1) {
            target.push([at(&outline[0]), at(&pair[0]), at(&pair[1])], paint);
        }
    };
    fan(&road.below, Surface::Carriageway, ROAD);
    fan(&road.above, Surface::Carriageway, PARKING);
    fan(&pavement.below, Surface::Sidewalk, SIDEWALK);
    fan(&pavement.above, Surface::Terrain, TERRAIN);
    if let Some([a, b]) = kerb.cut {
        // The cut runs with the carriageway on its left, towards which the face looks.
        let low = [a, b].map(|corner| point(ground, &corner, Surface::Carriageway));
        let high = [a, b].map(|corner| point(ground, &corner, Surface::Sidewalk));
        target.push([low[1], low[0], high[0]], SIDEWALK);
        target.push([low[1], high[0], high[1]], SIDEWALK);
    }
}

fn point(ground: &Ground, (position, node): &Corner, surface: Surface) -> Vec3 {
    let height_m = ground.surface_height_m(node, surface);
    Vec3::new(position.x as f32, position.y as f32, height_m)
}

/// A convex outline cut in two where a value changes its sign.
struct Split {
    below: Vec<Corner>,
    above: Vec<Corner>,
    /// Ends of the cut, `below` on its left.
    cut: Option<[Corner; 2]>,
}

fn split(outline: &[Corner], value: impl Fn(&Node) -> f32) -> Split {
    let mut parts = Split {
        below: Vec::with_capacity(outline.len() + 1),
        above: Vec::with_capacity(outline.len() + 1),
        cut: None,
    };
    let (mut leaves_below, mut enters_below) = (None, None);
    for (index, corner) in outline.iter().enumerate() {
        let next = &outline[(index + 1) % outline.len()];
        let (here, there) = (value(&corner.1), value(&next.1));
        if here < 0.0 {
            parts.below.push(*corner);
        } else {
            parts.above.push(*corner);
        }
        if (here < 0.0) != (there < 0.0) {
            let t = here / (here - there);
            let crossing = (
                corner.0.lerp(next.0, f64::from(t)),
                corner.1.lerp(next.1, t),
            );
            parts.below.push(crossing);
            parts.above.push(crossing);
            if here < 0.0 {
                leaves_below = Some(crossing);
            } else {
                enters_below = Some(crossing);
            }
        }
    }
    // Walking around `below` counter-clockwise, its border leaves along the cut.
    parts.cut = leaves_below.zip(enters_below).map(|(a, b)| [a, b]);
    parts
}

#[cfg(test)]
mod tests {
    use super::super::ground::{GroundConfig, Paving};
    use super::super::path::{Path, PathSegment};
    use super::*;

    fn street() -> Ground {
        let segments =
            [(40.0, 0.0), (20.0, 60.0), (40.0, 0.0)].map(|(length_m, turn_deg)| PathSegment {
                length_m,
                turn_deg,
                grade_percent: 5.0,
            });
        let path = Path::from_segments(&segments, 0.0);
        let road = Paving::Road {
            path: path.clone(),
            half_width_m: 3.5,
        };
        let bays = Paving::Bays {
            path: path.shifted(-4.5),
            half_width_m: 1.1,
        };
        Ground::new(&[path], &[road, bays], &GroundConfig::default(), 1)
    }

    #[test]
    fn every_piece_of_ground_has_the_class_of_its_place() {
        let ground = street();
        let mesh = ground_mesh(&ground);
        let mut seen = std::collections::BTreeSet::new();
        for triangle in 0..mesh.mesh.triangles.len() {
            let normal = mesh.mesh.scaled_normal(triangle);
            if normal.z.abs() < 0.5 * normal.length() || normal.length() < 1e-3 {
                continue; // The face of the kerb, or a sliver.
            }
            assert!(normal.z > 0.0, "ground looks up");
            let [a, b, c] = mesh.mesh.corners(triangle);
            let middle = (a + b + c) / 3.0;
            let node = ground.at(DVec2::new(middle.x.into(), middle.y.into()));
            // Within the width of a cell of a border the field is not linear.
            let class = mesh.paints[triangle].class;
            seen.insert(class);
            let expected = match ground.surface_of(node.kerb_m) {
                Surface::Carriageway if node.road_m < 0.0 => classes::ROAD,
                Surface::Carriageway => classes::PARKING,
                Surface::Sidewalk => classes::SIDEWALK,
                Surface::Terrain => classes::TERRAIN,
            };
            let width_m = ground.config.sidewalk_width_m as f32;
            let border_m = [node.kerb_m, node.road_m, node.kerb_m - width_m]
                .map(f32::abs)
                .into_iter()
                .fold(f32::INFINITY, f32::min);
            assert!(class == expected || border_m < 0.15, "{class} {expected}");
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
    fn the_ground_has_no_gap_at_the_kerb_and_its_face_looks_at_the_road() {
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
