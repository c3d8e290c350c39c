//! The map as it is drawn: muted colors by height above the ground, and no ceilings above the path.
//!
//! ```text
//! ground     triangles with more red than blue; without any, level ones on the lowest surface around
//! floor      per cell the lowest ground; cells without ground have that of the nearest cell with
//! ceiling    cells with a level surface more than 0.6 m above the sensor and another one below it,
//!            connected with a cell of the path
//! ```
//!
//! In cells with a ceiling and beside them, everything more than 0.6 m above the sensor is cut away: the
//! walls of rooms and tunnels remain up to that height. Roofs and crowns beside the path stay.

use std::collections::VecDeque;

use nalgebra::Point2;

use super::color::{Rgb, blend};
use crate::geometry::{Grid2, Pose2, Pose3, TriangleMesh, Vec3, pose3_from_pose2};

/// Edge of a cell [m], more where the map would have more than [`MAX_CELLS`] along an edge.
const CELL_M: f64 = 0.5;
const MAX_CELLS: f64 = 1500.0;

/// What is higher above the sensor is cut away below a ceiling [m].
const HEADROOM_M: f32 = 0.6;

/// Cells of a ceiling are connected across gaps of this radius, such as walls [cells].
const GAP_CELLS: i64 = 2;

/// Largest distance of a ceiling from the path [m].
const REACH_M: f64 = 40.0;

/// Cosine of the steepest slope of a level surface.
const LEVEL_COSINE: f32 = 0.85;

/// Without ground colors, level surfaces that are at most this much above the lowest are ground [m].
const STEP_M: f32 = 0.3;

/// Height of the sensor above the floor where it is not known [m].
const SENSOR_M: f64 = 1.73;

/// Color of the ground.
pub const GROUND: Rgb = [224, 217, 206];

/// Colors of heights above the ground [m].
const HEIGHTS: [(f32, Rgb); 5] = [
    (0.0, [190, 201, 178]),
    (1.5, [155, 181, 160]),
    (4.0, [116, 151, 150]),
    (8.0, [92, 119, 137]),
    (15.0, [84, 88, 119]),
];

/// Legend of the colors.
pub const KEYS: [(&str, Rgb); 5] = [
    ("ground", GROUND),
    ("1.5 m above it", HEIGHTS[1].1),
    ("4 m", HEIGHTS[2].1),
    ("8 m", HEIGHTS[3].1),
    ("15 m and more", HEIGHTS[4].1),
];

/// Returns a copy of a map in muted colors, without what is above a path of the sensor.
pub fn relief(mesh: &TriangleMesh, path: &[Pose3]) -> TriangleMesh {
    let Some(floor) = Floor::of(mesh) else {
        return mesh.clone();
    };
    let is_cut = floor.below_ceilings(mesh, path);
    let mut relief = TriangleMesh {
        colors: floor.colors(mesh),
        ..mesh.clone()
    };
    relief.retain_triangles(|triangle, _| !is_cut[triangle]);
    relief
}

/// A planar path at the height of the sensor above the floor of a map.
pub fn lifted(mesh: &TriangleMesh, path: &[Pose2]) -> Vec<Pose3> {
    let floor = Floor::of(mesh);
    let height_m = |pose: &Pose2| {
        let t = pose.translation;
        let cell = floor.as_ref()?.cell_at(t.x, t.y)?;
        Some(f64::from(floor.as_ref()?.heights_m[cell]))
    };
    let lift = |pose| pose3_from_pose2(pose, height_m(pose).unwrap_or(0.0) + SENSOR_M);
    path.iter().map(lift).collect()
}

/// Color of a height above the ground [m].
fn color(above_m: f32) -> Rgb {
    let next = HEIGHTS.iter().position(|&(height_m, _)| above_m < height_m);
    match next {
        Some(0) => HEIGHTS[0].1,
        Some(next) => {
            let ((low_m, low), (high_m, high)) = (HEIGHTS[next - 1], HEIGHTS[next]);
            blend(low, high, f64::from((above_m - low_m) / (high_m - low_m)))
        }
        None => HEIGHTS[HEIGHTS.len() - 1].1,
    }
}

/// The ground of a map and its height everywhere.
struct Floor {
    grid: Grid2,
    /// Height of the ground, row by row [m].
    heights_m: Vec<f32>,
    /// Per triangle.
    is_ground: Vec<bool>,
}

impl Floor {
    /// `None` for a map without triangles.
    fn of(mesh: &TriangleMesh) -> Option<Self> {
        let bounds = mesh.bounds();
        if bounds.is_empty() || mesh.triangles.is_empty() {
            return None;
        }
        let cell_m = CELL_M.max(f64::from(bounds.size().truncate().max_element()) / MAX_CELLS);
        let corner = |corner: Vec3, farther_m: f64| {
            Point2::new(
                f64::from(corner.x) + farther_m,
                f64::from(corner.y) + farther_m,
            )
        };
        // A cell more, because the farthest edge of a grid belongs to no cell.
        let grid = Grid2::covering(corner(bounds.min, 0.0), corner(bounds.max, cell_m), cell_m);
        let mut floor = Self {
            grid,
            heights_m: Vec::new(),
            is_ground: (0..mesh.triangles.len())
                .map(|triangle| has_ground_color(mesh, triangle))
                .collect(),
        };
        if floor.is_ground.contains(&true) {
            floor.heights_m = floor.lowest_m(mesh, |triangle| floor.is_ground[triangle]);
            return Some(floor);
        }
        floor.heights_m = floor.lowest_m(mesh, |triangle| is_level(mesh, triangle));
        floor.is_ground = (0..mesh.triangles.len())
            .map(|triangle| {
                let middle = centroid(mesh, triangle);
                is_level(mesh, triangle) && floor.above_m(middle) < STEP_M
            })
            .collect();
        Some(floor)
    }

    /// Index of the cell of a position; `None` outside.
    fn cell_at(&self, x: f64, y: f64) -> Option<usize> {
        let (column, row) = self.grid.cell_at(x, y)?;
        Some(row * self.grid.columns + column)
    }

    /// Cells around a cell, with it.
    fn around(&self, cell: usize, radius: i64) -> impl Iterator<Item = usize> + use<> {
        let (columns, rows) = (self.grid.columns as i64, self.grid.rows as i64);
        let (column, row) = (cell as i64 % columns, cell as i64 / columns);
        let below = (row - radius).max(0)..(row + radius + 1).min(rows);
        below.flat_map(move |row| {
            let beside = (column - radius).max(0)..(column + radius + 1).min(columns);
            beside.map(move |column| (row * columns + column) as usize)
        })
    }

    /// Height of a point above the ground [m].
    fn above_m(&self, point: Vec3) -> f32 {
        let cell = self.cell_at(f64::from(point.x), f64::from(point.y));
        cell.map_or(0.0, |cell| point.z - self.heights_m[cell])
    }

    /// Lowest height of the selected triangles per cell; cells without have that of the nearest with.
    fn lowest_m(&self, mesh: &TriangleMesh, is_selected: impl Fn(usize) -> bool) -> Vec<f32> {
        let mut lowest_m = vec![f32::INFINITY; self.grid.len()];
        for triangle in (0..mesh.triangles.len()).filter(|&triangle| is_selected(triangle)) {
            self.for_each_sample(mesh, triangle, |cell, height_m| {
                lowest_m[cell] = lowest_m[cell].min(height_m);
            });
        }
        let known = (0..lowest_m.len()).filter(|&cell| lowest_m[cell].is_finite());
        let mut front: VecDeque<usize> = known.collect();
        while let Some(cell) = front.pop_front() {
            for next in self.around(cell, 1) {
                if lowest_m[next] == f32::INFINITY {
                    lowest_m[next] = lowest_m[cell];
                    front.push_back(next);
                }
            }
        }
        lowest_m
    }

    /// Visits cells of a triangle with its height there, at points less than a cell apart.
    fn for_each_sample(
        &self,
        mesh: &TriangleMesh,
        triangle: usize,
        mut visit: impl FnMut(usize, f32),
    ) {
        let [a, b, c] = mesh.corners(triangle);
        let longest_m = (b - a).abs().max((c - a).abs()).truncate().max_element();
        let steps = (longest_m / self.grid.cell_m as f32).ceil().max(1.0) as u32 + 1;
        for i in 0..=steps {
            for j in 0..=steps - i {
                let (v, w) = (i as f32 / steps as f32, j as f32 / steps as f32);
                let point = a + v * (b - a) + w * (c - a);
                if let Some(cell) = self.cell_at(f64::from(point.x), f64::from(point.y)) {
                    visit(cell, point.z);
                }
            }
        }
    }

    /// Color per vertex.
    fn colors(&self, mesh: &TriangleMesh) -> Vec<Rgb> {
        let vertices = mesh.vertices.iter();
        let mut colors: Vec<Rgb> = vertices
            .map(|&vertex| color(self.above_m(vertex)))
            .collect();
        for (triangle, _) in self.is_ground.iter().enumerate().filter(|(_, is)| **is) {
            for vertex in mesh.triangles[triangle] {
                colors[vertex as usize] = GROUND;
            }
        }
        colors
    }

    /// Whether each triangle is below a ceiling over the path and more than the headroom above it.
    fn below_ceilings(&self, mesh: &TriangleMesh, path: &[Pose3]) -> Vec<bool> {
        let limits_m = self.limits_m(mesh, path);
        let is_cut = |triangle: usize| {
            let middle = centroid(mesh, triangle);
            let cell = self.cell_at(f64::from(middle.x), f64::from(middle.y));
            cell.is_some_and(|cell| middle.z > limits_m[cell])
        };
        (0..mesh.triangles.len()).map(is_cut).collect()
    }

    /// Height per cell above which surfaces are cut away; infinite where they are not.
    fn limits_m(&self, mesh: &TriangleMesh, path: &[Pose3]) -> Vec<f32> {
        let (nearest_m, front) = self.levels_of(path);
        let mut has_low = vec![false; self.grid.len()];
        let mut has_high = vec![false; self.grid.len()];
        for triangle in 0..mesh.triangles.len() {
            let level = is_level(mesh, triangle);
            self.for_each_sample(mesh, triangle, |cell, height_m| {
                let limit_m = nearest_m[cell] + HEADROOM_M;
                has_low[cell] |= height_m < limit_m;
                has_high[cell] |= level && height_m > limit_m;
            });
        }
        let is_ceiling = |cell: usize| has_low[cell] && has_high[cell];
        let mut limits_m = vec![f32::INFINITY; self.grid.len()];
        let mut is_reached = vec![false; self.grid.len()];
        let mut front: VecDeque<usize> = front.into_iter().filter(|&it| is_ceiling(it)).collect();
        while let Some(cell) = front.pop_front() {
            for next in self.around(cell, GAP_CELLS) {
                limits_m[next] = nearest_m[next] + HEADROOM_M;
                if is_ceiling(next) && !is_reached[next] {
                    is_reached[next] = true;
                    front.push_back(next);
                }
            }
        }
        limits_m
    }

    /// Height of the sensor at the nearest pose of a path per cell, infinite beyond the reach, and the
    /// cells of the path.
    fn levels_of(&self, path: &[Pose3]) -> (Vec<f32>, Vec<usize>) {
        let mut levels_m = vec![f32::INFINITY; self.grid.len()];
        let mut cells = Vec::new();
        for t in path.iter().map(|pose| pose.translation) {
            if let Some(cell) = self.cell_at(t.x, t.y) {
                let level_m = t.z as f32;
                // Of storeys above each other the path on the upper one is visible.
                levels_m[cell] = match levels_m[cell] {
                    known_m if known_m.is_finite() => known_m.max(level_m),
                    _ => level_m,
                };
                cells.push(cell);
            }
        }
        let mut front = cells.clone();
        for _ in 0..(REACH_M / self.grid.cell_m) as usize {
            let mut next_front = Vec::new();
            for cell in front {
                for next in self.around(cell, 1) {
                    if levels_m[next] == f32::INFINITY {
                        levels_m[next] = levels_m[cell];
                        next_front.push(next);
                    }
                }
            }
            front = next_front;
        }
        (levels_m, cells)
    }
}

/// Whether the colors of a triangle are those of ground: more red than blue, without green.
fn has_ground_color(mesh: &TriangleMesh, triangle: usize) -> bool {
    let color = |vertex: &u32| mesh.colors.get(*vertex as usize);
    let is_red = |[red, green, blue]: &Rgb| red > blue && *green == 0;
    let mut vertices = mesh.triangles[triangle].iter();
    vertices.all(|vertex| color(vertex).is_some_and(is_red))
}

fn is_level(mesh: &TriangleMesh, triangle: usize) -> bool {
    let normal = mesh.scaled_normal(triangle);
    normal.z.abs() > LEVEL_COSINE * normal.length()
}

fn centroid(mesh: &TriangleMesh, triangle: usize) -> Vec3 {
    mesh.corners(triangle).iter().sum::<Vec3>() / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLOOR: Rgb = [255, 0, 0];
    const REST: Rgb = [0, 0, 255];

    /// A level rectangle in cells of a metre.
    fn level(x: (i32, i32), y: (i32, i32), z: f32, color: Rgb) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for column in x.0..x.1 {
            for row in y.0..y.1 {
                let corner =
                    |dx: i32, dy: i32| Vec3::new((column + dx) as f32, (row + dy) as f32, z);
                mesh.append(&TriangleMesh {
                    vertices: vec![corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)],
                    colors: vec![color; 4],
                    triangles: vec![[0, 1, 2], [0, 2, 3]],
                    ..TriangleMesh::default()
                });
            }
        }
        mesh
    }

    /// A corridor of 20 m with a room beside it behind a wall, a floor at 0 m and a ceiling at 2.5 m.
    fn corridor() -> TriangleMesh {
        let mut mesh = level((0, 20), (0, 12), 0.0, FLOOR);
        mesh.append(&level((0, 20), (0, 3), 2.5, REST));
        mesh.append(&level((0, 20), (4, 8), 2.5, REST));
        mesh
    }

    /// Along the corridor, 1.3 m above the floor.
    fn walk() -> Vec<Pose3> {
        (1..19)
            .map(|x| Pose3::translation(f64::from(x), 1.5, 1.3))
            .collect()
    }

    fn has_height(mesh: &TriangleMesh, x: f32, y: f32, z: f32) -> bool {
        mesh.vertices
            .iter()
            .any(|it| it.distance(Vec3::new(x, y, z)) < 0.8)
    }

    #[test]
    fn ceilings_over_the_path_and_over_rooms_beside_it_are_cut_away() {
        let relief = relief(&corridor(), &walk());
        assert!(relief.vertices.iter().all(|vertex| vertex.z < 0.1));
        assert_eq!(
            relief.triangles.len(),
            level((0, 20), (0, 12), 0.0, FLOOR).triangles.len()
        );
    }

    #[test]
    fn roofs_beside_the_path_stay_and_so_does_everything_without_a_path() {
        let mut town = level((0, 40), (0, 12), 0.0, FLOOR);
        // A bridge over the path, and a roof 4 m beside it.
        town.append(&level((5, 9), (0, 6), 6.0, REST));
        town.append(&level((15, 25), (6, 12), 6.0, REST));
        let relief = super::relief(&town, &walk());
        assert!(!has_height(&relief, 7.0, 2.0, 6.0), "the bridge is cut");
        assert!(has_height(&relief, 20.0, 9.0, 6.0), "the roof stays");
        let whole = super::relief(&corridor(), &[]);
        assert_eq!(whole.triangles.len(), corridor().triangles.len());
    }

    #[test]
    fn a_bridge_below_the_path_stays() {
        let mut town = level((0, 20), (0, 12), 0.0, FLOOR);
        town.append(&level((0, 20), (0, 4), 6.0, FLOOR));
        let over: Vec<Pose3> = walk()
            .into_iter()
            .map(|pose| Pose3::translation(0.0, 0.0, 6.0) * pose)
            .collect();
        assert_eq!(relief(&town, &over).triangles.len(), town.triangles.len());
    }

    #[test]
    fn ground_has_its_color_and_the_rest_that_of_its_height_above_it() {
        let mut slope = level((0, 20), (0, 4), 0.0, FLOOR);
        slope.append(&level((4, 6), (1, 3), 1.5, REST));
        slope.append(&level((14, 16), (1, 3), 4.0, REST));
        for vertex in &mut slope.vertices {
            vertex.z += 0.1 * vertex.x;
        }
        let relief = relief(&slope, &[]);
        let color_at = |x: f32, above_m: f32| {
            let place = Vec3::new(x, 2.0, 0.1 * x + above_m);
            let nearest = (0..relief.vertices.len()).min_by(|&a, &b| {
                let [a, b] = [a, b].map(|vertex| relief.vertices[vertex].distance(place));
                a.total_cmp(&b)
            });
            relief.colors[nearest.unwrap()]
        };
        assert_eq!(color_at(10.0, 0.0), GROUND);
        let is_near = |a: Rgb, b: Rgb| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 2);
        assert!(
            is_near(color_at(5.0, 1.5), HEIGHTS[1].1),
            "{:?}",
            color_at(5.0, 1.5)
        );
        assert!(
            is_near(color_at(15.0, 4.0), HEIGHTS[2].1),
            "{:?}",
            color_at(15.0, 4.0)
        );
    }

    #[test]
    fn without_ground_colors_the_lowest_level_surfaces_are_the_ground() {
        let mut gray = corridor();
        gray.colors.clear();
        let relief = relief(&gray, &[]);
        for (vertex, &color) in relief.vertices.iter().zip(&relief.colors) {
            assert_eq!(color == GROUND, vertex.z == 0.0, "{vertex}");
        }
    }

    #[test]
    fn higher_is_darker() {
        let light = |height_m: f32| color(height_m).iter().map(|it| u32::from(*it)).sum::<u32>();
        let lights: Vec<u32> = (-1..20).map(|height_m| light(height_m as f32)).collect();
        assert!(
            lights.windows(2).all(|pair| pair[1] <= pair[0]),
            "{lights:?}"
        );
        assert_eq!(color(8.0), HEIGHTS[3].1);
    }

    #[test]
    fn a_planar_path_is_lifted_above_the_floor() {
        let lifted = lifted(
            &corridor(),
            &[Pose2::translation(3.0, 1.0), Pose2::translation(-9.0, 0.0)],
        );
        let heights_m: Vec<f64> = lifted.iter().map(|pose| pose.translation.z).collect();
        assert_eq!(heights_m, [SENSOR_M; 2]);
    }
}
