//! The map and a path in perspective, seen obliquely from above, with light and shadows by the own ray
//! caster.
//!
//! The camera is as near as it can be while it sees all of the path and some of the map around it. A
//! point at (r, u, f) along its axes right, up, forward is seen at
//!
//! ```text
//! x = (r - r_eye) / (f - f_eye) / tan_x    y = (u - u_eye) / (f - f_eye) / tan_y    in [-1, 1]
//! ```
//!
//! so that the farthest forward eye that has all points within |x| ≤ 1 and |y| ≤ 1 follows from the largest
//! and smallest r ± tan_x f and u ± tan_y f alone. Surfaces that face away from the camera are left out: a
//! LiDAR sees the fronts of houses along a street, and behind the nearer ones is the street. So are the
//! ceilings of a map that is oriented; [`relief`] cuts them away in any.

use std::f32::consts::TAU;
use std::path::Path;

use anyhow::{Result, ensure};
use rayon::prelude::*;

use super::bitmap::Bitmap;
use super::color::{INK, Rgb, WHITE, blend};
use super::map_image::interpolated;
use super::relief;
use super::sheet::{
    self, HPos, Point, Rect, Sheet, TICK, VPos, bold, save_png, stroke, text_style,
};
use super::view::{LegendEntry, Mark, legend};
use crate::geometry::{Aabb, Pose3, TriangleMesh, Vec3};
use crate::raycasting::{Hit, RAYS, Reach, Scene};

/// Size of the picture [px].
const WIDTH: u32 = 1400;
const HEIGHT: u32 = 800;

/// Height of the legend [px].
const HEADER: u32 = 50;

/// Rays per pixel along x and along y.
const SAMPLES: u32 = 2;

/// Angle of the view below the horizon [rad].
const PITCH_RAD: f32 = 0.7;

/// Tangent of half the angle of view along x.
const TAN_X: f32 = 0.42;

/// Directions of view that are compared.
const AZIMUTHS: usize = 24;

/// What is seen at least around each pose, and around the middle of the path [m].
const AROUND_POSE_M: f32 = 8.0;
const AROUND_MIDDLE_M: f32 = 40.0;

/// Height of the path above the ground as it is drawn [m].
const ABOVE_GROUND_M: f32 = 0.3;

/// A map and a path on it, seen obliquely from above.
#[derive(Clone, Copy, Debug)]
pub struct ObliqueView<'a> {
    /// Map in the colors of [`relief::relief`].
    pub mesh: &'a TriangleMesh,
    /// Name of the path.
    pub name: &'a str,
    /// Color of the path.
    pub color: Rgb,
    /// Poses of the sensor in the map.
    pub path: &'a [Pose3],
}

impl ObliqueView<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let scene = Scene::new(self.mesh);
        let path: Vec<Vec3> = (self.path.iter())
            .map(|pose| on_ground(&scene, pose))
            .filter(|point| point.is_finite())
            .collect();
        ensure!(
            !path.is_empty(),
            "there is nothing to draw: the path is empty"
        );
        let seen = surroundings(&path, &self.mesh.bounds());
        let is_one_sided = ground_faces_up(self.mesh);
        let camera = best_camera(&scene, &seen, &path, is_one_sided);
        let front = Front::of(self.mesh, &camera, is_one_sided);
        let image = front.render(&camera);
        let rect = Rect {
            left: 0.0,
            top: f64::from(HEADER),
            right: f64::from(WIDTH),
            bottom: f64::from(HEIGHT),
        };
        let line = LegendEntry::new(self.name, self.color, Mark::Line);
        let keys = relief::KEYS.map(|(name, color)| LegendEntry::new(name, color, Mark::Area));
        let entries: Vec<LegendEntry> = std::iter::once(line).chain(keys).collect();
        sheet::draw((WIDTH, HEIGHT), |sheet| {
            let at = |share: f64, pixels: u32| ((share * f64::from(pixels)) as u32).min(pixels - 1);
            sheet.pixels(&rect, |x, y| {
                Some(image.pixel(at(x, image.width), at(y, image.height)))
            })?;
            legend(sheet, &entries, (30.0, 28.0), rect.right)?;
            self.draw_path(sheet, &rect, &front, &camera, &path)
        })
    }

    /// Draws the path, pale and dashed where a surface hides it.
    fn draw_path(
        &self,
        sheet: &Sheet,
        rect: &Rect,
        front: &Front,
        camera: &Camera,
        path: &[Vec3],
    ) -> Result<()> {
        let points = dense(path, 0.002 * camera.farthest_m(path));
        let is_hidden = front.hides(camera, &points);
        let pale = blend(self.color, WHITE, 0.45);
        let places: Vec<Option<Point>> = (points.iter())
            .map(|&point| camera.place(point, rect))
            .collect();
        let runs: Vec<(bool, Vec<Point>)> = runs(&places, &is_hidden);
        for (_, run) in runs.iter().filter(|(hidden, _)| *hidden) {
            sheet.dashes(run, rect, stroke(pale, 3.5), (7.0, 5.0))?;
        }
        for (color, width) in [(WHITE, 8.0), (self.color, 5.0)] {
            for (_, run) in runs.iter().filter(|(hidden, _)| !hidden) {
                sheet.polyline(run, rect, stroke(color, width))?;
            }
        }
        for (place, label, side, aside) in [
            (places.first(), "start", HPos::Right, -12.0),
            (places.last(), "end", HPos::Left, 12.0),
        ] {
            if let Some(&Some(place)) = place
                && places.len() > 1
            {
                sheet.dot(place, 9.0, WHITE, 1.0)?;
                sheet.dot(place, 7.0, INK, 1.0)?;
                let style = bold(text_style(TICK, side, VPos::Bottom));
                sheet.text(label, (place.0 + aside, place.1 - 6.0), &style)?;
            }
        }
        Ok(())
    }
}

/// Perspective camera.
#[derive(Clone, Copy, Debug)]
struct Camera {
    eye: Vec3,
    right: Vec3,
    up: Vec3,
    forward: Vec3,
}

impl Camera {
    /// Tangent of half the angle of view along y.
    const TAN_Y: f32 = TAN_X * (HEIGHT - HEADER) as f32 / WIDTH as f32;

    /// The nearest camera in a direction of view that sees all points.
    fn framing(azimuth_rad: f32, points: &[Vec3]) -> Self {
        let (sin, cos) = azimuth_rad.sin_cos();
        let (down, ahead) = PITCH_RAD.sin_cos();
        let forward = Vec3::new(ahead * cos, ahead * sin, -down);
        let right = Vec3::new(sin, -cos, 0.0);
        let up = right.cross(forward);
        // Extent across the view, sheared so that the edges of the view are upright, and how far
        // forward the eye can be.
        let fit = |axis: Vec3, tan: f32| {
            let largest = |sign: f32| {
                let sheared = points
                    .iter()
                    .map(|p| sign * p.dot(axis) - tan * p.dot(forward));
                sheared.fold(f32::NEG_INFINITY, f32::max)
            };
            let (high, low) = (largest(1.0), largest(-1.0));
            (0.5 * (high - low), -0.5 * (high + low) / tan)
        };
        let (across, ahead_x) = fit(right, TAN_X);
        let (upward, ahead_y) = fit(up, Self::TAN_Y);
        Self {
            eye: across * right + upward * up + ahead_x.min(ahead_y) * forward,
            right,
            up,
            forward,
        }
    }

    /// Where a point is seen, from -1 to 1 to the right and upwards; `None` behind the camera.
    fn project(&self, point: Vec3) -> Option<[f32; 2]> {
        let ray = point - self.eye;
        let ahead_m = ray.dot(self.forward);
        (ahead_m > 0.0).then(|| {
            [
                ray.dot(self.right) / (ahead_m * TAN_X),
                ray.dot(self.up) / (ahead_m * Self::TAN_Y),
            ]
        })
    }

    /// Unit direction in which a place of the picture is seen; the inverse of [`project`](Self::project).
    fn direction(&self, [x, y]: [f32; 2]) -> Vec3 {
        (self.forward + x * TAN_X * self.right + y * Self::TAN_Y * self.up).normalize()
    }

    /// Place of a point on the sheet.
    fn place(&self, point: Vec3, rect: &Rect) -> Option<Point> {
        let [x, y] = self.project(point)?.map(f64::from);
        Some((
            rect.left + 0.5 * (1.0 + x) * rect.width(),
            rect.top + 0.5 * (1.0 - y) * rect.height(),
        ))
    }

    /// Distance to the farthest of some points [m].
    fn farthest_m(&self, points: &[Vec3]) -> f32 {
        let distances_m = points.iter().map(|point| point.distance(self.eye));
        distances_m.fold(0.0, f32::max)
    }

    /// Direction to the light: from behind the camera, a little from the left.
    fn light(&self) -> Vec3 {
        let ahead = Vec3::new(self.forward.x, self.forward.y, 0.0).normalize_or(Vec3::X);
        (-0.5 * self.right - 0.7 * ahead + 1.1 * Vec3::Z).normalize()
    }
}

/// The camera that sees most of the path, and it large.
fn best_camera(scene: &Scene, seen: &[Vec3], path: &[Vec3], is_one_sided: bool) -> Camera {
    const POINTS: usize = 150;
    let some: Vec<Vec3> = path
        .iter()
        .copied()
        .step_by(path.len().div_ceil(POINTS))
        .collect();
    let score = |camera: &Camera| {
        let visible = some.iter().filter(|&&point| {
            let ray = point - camera.eye;
            let direction = ray.normalize();
            let mut is_visible = true;
            let until_m = ray.length() - ABOVE_GROUND_M;
            scene.for_each_hit(camera.eye, direction, until_m, |hit| {
                let normal = scene.normal(&hit);
                is_visible &= is_one_sided && normal.is_some_and(|it| it.dot(direction) > 0.0);
            });
            is_visible
        });
        visible.count() as f32 / camera.farthest_m(seen)
    };
    let cameras: Vec<(f32, Camera)> = (0..AZIMUTHS)
        .into_par_iter()
        .map(|k| Camera::framing(TAU * k as f32 / AZIMUTHS as f32, seen))
        .map(|camera| (score(&camera), camera))
        .collect();
    let best = cameras.iter().max_by(|a, b| a.0.total_cmp(&b.0));
    best.map_or_else(|| Camera::framing(0.0, seen), |&(_, camera)| camera)
}

/// Whether surfaces have an outer side: all ground faces up.
fn ground_faces_up(mesh: &TriangleMesh) -> bool {
    const MOST: f32 = 0.95;
    let is_ground = |triangle: &usize| {
        let vertices = mesh.triangles[*triangle];
        vertices
            .iter()
            .all(|&vertex| mesh.colors[vertex as usize] == relief::GROUND)
    };
    let ground = (0..mesh.triangles.len()).filter(is_ground);
    let areas = ground.map(|triangle| mesh.scaled_normal(triangle).z);
    let (up, all) = areas.fold((0.0, 0.0), |(up, all), area| {
        (up + area.max(0.0), all + area.abs())
    });
    up > MOST * all
}

/// The surfaces of a map that face a camera, or all where surfaces have two sides.
struct Front {
    mesh: TriangleMesh,
    scene: Scene,
}

impl Front {
    fn of(mesh: &TriangleMesh, camera: &Camera, is_one_sided: bool) -> Self {
        let mut front = mesh.clone();
        front.retain_triangles(|triangle, _| {
            let [corner, ..] = mesh.corners(triangle);
            !is_one_sided || mesh.scaled_normal(triangle).dot(corner - camera.eye) < 0.0
        });
        front.compute_normals();
        Self {
            scene: Scene::new(&front),
            mesh: front,
        }
    }

    /// Colors of the picture, [`SAMPLES`] per pixel along each axis; white without a surface.
    fn render(&self, camera: &Camera) -> Bitmap {
        /// Samples of a packet along x and along y.
        const BLOCK: [usize; 2] = [RAYS / 2, 2];
        let (width, height) = (SAMPLES * WIDTH, SAMPLES * (HEIGHT - HEADER));
        let columns = width as usize;
        let at = |pixel: usize, pixels: u32| 2.0 * (pixel as f32 + 0.5) / pixels as f32 - 1.0;
        let mut image = Bitmap::from_fn(width, height, |_, _| WHITE);
        let rows = image.pixels.par_chunks_mut(columns * BLOCK[1]);
        rows.enumerate().for_each(|(number, pixels)| {
            // Packets of neighbouring samples.
            let places: Vec<(usize, usize)> = (0..pixels.len())
                .map(|sample| {
                    let (block, place) = (sample / RAYS, sample % RAYS);
                    (block * BLOCK[0] + place % BLOCK[0], place / BLOCK[0])
                })
                .collect();
            let directions: Vec<Vec3> = (places.iter())
                .map(|&(column, row)| {
                    let row = number * BLOCK[1] + row;
                    camera.direction([at(column, width), -at(row, height)])
                })
                .collect();
            let colors = self.colors(camera, &directions);
            for ((column, row), color) in places.into_iter().zip(colors) {
                pixels[row * columns + column] = color;
            }
        });
        image
    }

    /// Colors in directions of view.
    fn colors(&self, camera: &Camera, directions: &[Vec3]) -> Vec<Rgb> {
        let mut hits = vec![Hit::MISS; directions.len()];
        self.scene.cast(camera.eye, directions, &mut hits);
        let surfaces: Vec<Option<Surface>> = (hits.iter().zip(directions))
            .map(|(hit, &direction)| self.surface(camera.eye, direction, hit))
            .collect();
        let to_light = camera.light();
        let is_lit = self.is_lit(&surfaces, to_light);
        let colors = surfaces.into_iter().zip(is_lit).map(|(surface, is_lit)| {
            surface.map_or(WHITE, |surface| surface.shaded(to_light, is_lit))
        });
        colors.collect()
    }

    /// The surface at a hit; `None` for a miss.
    fn surface(&self, eye: Vec3, direction: Vec3, hit: &Hit) -> Option<Surface> {
        let face = self.scene.normal(hit)?;
        let triangle = hit.triangle as usize;
        let point = eye + hit.range_m * direction;
        let [a, b, c] = self.mesh.corners(triangle);
        let weight = |from: Vec3, to: Vec3| (to - from).cross(point - from).dot(face).max(0.0);
        let weights = [weight(b, c), weight(c, a), weight(a, b)];
        let sum = weights.iter().sum::<f32>().max(f32::MIN_POSITIVE);
        let weights = weights.map(|weight| weight / sum);
        let vertices = self.mesh.triangles[triangle].map(|vertex| vertex as usize);
        let normals = vertices.map(|vertex| self.mesh.normals[vertex]);
        let colors = vertices.map(|vertex| self.mesh.colors[vertex]);
        let normal = |axis: usize| interpolated(normals.map(|normal| normal[axis]), weights);
        let normal = Vec3::from_array([0, 1, 2].map(normal)).normalize_or(face);
        Some(Surface {
            point,
            // Of both sides of a surface, the one that is seen.
            normal: if face.dot(direction) > 0.0 {
                -normal
            } else {
                normal
            },
            color: std::array::from_fn(|channel| {
                interpolated(colors.map(|color| f32::from(color[channel])), weights).round() as u8
            }),
        })
    }

    /// Whether the light reaches each surface.
    fn is_lit(&self, surfaces: &[Option<Surface>], to_light: Vec3) -> Vec<bool> {
        /// Length of the longest shadow, and distance of its begin from the surface [m].
        const LONGEST_M: f32 = 60.0;
        const BEGIN_M: f32 = 0.05;
        let any = Reach {
            enough_m: LONGEST_M,
            ..Reach::until(LONGEST_M)
        };
        let mut is_lit = Vec::with_capacity(surfaces.len());
        for surfaces in surfaces.chunks(RAYS) {
            let Some(known) = surfaces.iter().flatten().next() else {
                is_lit.extend(surfaces.iter().map(|_| true));
                continue;
            };
            let origins = std::array::from_fn(|ray| {
                let surface = surfaces.get(ray).and_then(Option::as_ref).unwrap_or(known);
                (surface.point + BEGIN_M * (surface.normal + to_light)).as_dvec3()
            });
            let mut ranges_m = [[f32::INFINITY; RAYS]];
            let directions = [[to_light; RAYS]];
            (self.scene).cast_bundles(&origins, &directions, &[any], &mut ranges_m);
            is_lit.extend(
                ranges_m[0][..surfaces.len()]
                    .iter()
                    .map(|range| range.is_infinite()),
            );
        }
        is_lit
    }

    /// Whether a surface is between the camera and each point.
    fn hides(&self, camera: &Camera, points: &[Vec3]) -> Vec<bool> {
        let rays: Vec<Vec3> = points.iter().map(|&point| point - camera.eye).collect();
        let directions: Vec<Vec3> = rays.iter().map(|ray| ray.normalize()).collect();
        let reaches: Vec<Reach> = (rays.iter())
            .map(|ray| Reach::until(ray.length() - ABOVE_GROUND_M))
            .collect();
        let mut hits = vec![Hit::MISS; points.len()];
        let eye = camera.eye.as_dvec3();
        self.scene
            .cast_packets(eye, &directions, &reaches, &mut hits);
        hits.iter().map(|hit| *hit != Hit::MISS).collect()
    }
}

/// A surface that a ray hits.
struct Surface {
    point: Vec3,
    normal: Vec3,
    color: Rgb,
}

impl Surface {
    fn shaded(&self, to_light: Vec3, is_lit: bool) -> Rgb {
        let sky = 0.48 + 0.1 * f64::from(self.normal.z);
        let sun = if is_lit {
            0.5 * f64::from(self.normal.dot(to_light).max(0.0))
        } else {
            0.0
        };
        blend([0, 0, 0], self.color, (sky + sun).min(1.0))
    }
}

/// The point of the ground below a sensor, a little above it.
fn on_ground(scene: &Scene, map_from_lidar: &Pose3) -> Vec3 {
    /// Height of a sensor above the ground: the largest, and the one assumed without ground [m].
    const HIGHEST_M: f32 = 5.0;
    const USUAL_M: f32 = 1.7;
    let t = map_from_lidar.translation.vector;
    let sensor = Vec3::new(t.x as f32, t.y as f32, t.z as f32);
    let mut hits = [Hit::MISS];
    scene.cast_until(sensor, &[Vec3::NEG_Z], HIGHEST_M, &mut hits);
    let [Hit { range_m, .. }] = hits;
    let below_m = if range_m.is_finite() {
        range_m
    } else {
        USUAL_M
    };
    sensor - (below_m - ABOVE_GROUND_M) * Vec3::Z
}

/// Points that the camera must see: around each pose and around the middle of the path, inside the map.
fn surroundings(path: &[Vec3], map: &Aabb) -> Vec<Vec3> {
    let bounds = Aabb::from_points(path.iter().copied());
    let circle = |center: Vec3, radius_m: f32| {
        (0..8).map(move |k| {
            let (sin, cos) = (TAU * k as f32 / 8.0).sin_cos();
            center + radius_m * Vec3::new(cos, sin, 0.0)
        })
    };
    let poses = path.iter().flat_map(|&point| circle(point, AROUND_POSE_M));
    let points = poses.chain(circle(bounds.center(), AROUND_MIDDLE_M));
    let inside = |point: Vec3| Vec3 {
        z: point.z,
        ..point.clamp(map.min.min(bounds.min), map.max.max(bounds.max))
    };
    points.map(inside).collect()
}

/// A line through points with further ones, at most `step_m` apart.
fn dense(points: &[Vec3], step_m: f32) -> Vec<Vec3> {
    let Some(&first) = points.first() else {
        return Vec::new();
    };
    let mut dense = vec![first];
    for pair in points.windows(2) {
        let steps = (pair[0].distance(pair[1]) / step_m).ceil().max(1.0);
        dense.extend((1..=steps as u32).map(|k| pair[0].lerp(pair[1], k as f32 / steps)));
    }
    dense
}

/// Parts of a line that are hidden or visible throughout; each begins where the one before ends.
fn runs(places: &[Option<Point>], is_hidden: &[bool]) -> Vec<(bool, Vec<Point>)> {
    let mut runs: Vec<(bool, Vec<Point>)> = Vec::new();
    for (place, &hidden) in places.iter().zip(is_hidden) {
        let Some(place) = *place else { continue };
        match runs.last_mut() {
            Some((last, run)) if *last == hidden => run.push(place),
            Some((_, run)) => {
                let before = run.last().copied();
                runs.push((hidden, before.into_iter().chain([place]).collect()));
            }
            None => runs.push((hidden, vec![place])),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corners(size_m: f32) -> Vec<Vec3> {
        [(0.0, 0.0), (1.0, 0.0), (1.0, 0.4), (0.0, 0.4)]
            .map(|(x, y)| size_m * Vec3::new(x, y, 0.1 * x))
            .to_vec()
    }

    /// Ground of 40 m by 40 m and a wall of 6 m along y at x = 5, seen from both sides.
    fn ground_and_wall() -> TriangleMesh {
        let quad = |corners: [[f32; 3]; 4], color: Rgb| TriangleMesh {
            vertices: corners.map(Vec3::from_array).to_vec(),
            colors: vec![color; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        };
        let ground = [
            [-20.0, -20.0, 0.0],
            [20.0, -20.0, 0.0],
            [20.0, 20.0, 0.0],
            [-20.0, 20.0, 0.0],
        ];
        let wall = [
            [5.0, -9.0, 0.0],
            [5.0, 9.0, 0.0],
            [5.0, 9.0, 6.0],
            [5.0, -9.0, 6.0],
        ];
        let mut mesh = quad(ground, relief::GROUND);
        mesh.append(&quad(wall, [90, 110, 130]));
        mesh.append(&quad(
            [3, 2, 1, 0].map(|corner| wall[corner]),
            [90, 110, 130],
        ));
        mesh
    }

    #[test]
    fn what_is_ahead_is_in_the_center_and_a_direction_leads_to_its_place() {
        for azimuth_rad in [0.0, 1.0, 4.0] {
            let camera = Camera::framing(azimuth_rad, &corners(50.0));
            let [x, y] = camera.project(camera.eye + 30.0 * camera.forward).unwrap();
            assert!(x.abs() < 1e-5 && y.abs() < 1e-5);
            for place in [[0.0, 0.0], [0.9, -0.3], [-1.0, 1.0]] {
                let point = camera.eye + 25.0 * camera.direction(place);
                let [x, y] = camera.project(point).unwrap();
                assert!((x - place[0]).abs() < 1e-4 && (y - place[1]).abs() < 1e-4);
            }
            assert_eq!(camera.project(camera.eye - camera.forward), None);
        }
    }

    #[test]
    fn up_is_up_and_the_camera_looks_down_at_its_pitch() {
        let camera = Camera::framing(0.7, &corners(50.0));
        let [_, low] = camera.project(Vec3::ZERO).unwrap();
        let [_, high] = camera.project(3.0 * Vec3::Z).unwrap();
        assert!(high > low);
        assert!((camera.forward.z + PITCH_RAD.sin()).abs() < 1e-6);
        let [left, _] = camera
            .project(camera.eye + 10.0 * camera.forward - camera.right)
            .unwrap();
        assert!(left < 0.0);
    }

    #[test]
    fn all_points_are_seen_and_some_at_the_edge() {
        for (azimuth_rad, size_m) in [(0.0, 50.0), (2.0, 2000.0), (5.0, 3.0)] {
            let points = corners(size_m);
            let camera = Camera::framing(azimuth_rad, &points);
            let places: Vec<[f32; 2]> = points
                .iter()
                .map(|&it| camera.project(it).unwrap())
                .collect();
            let farthest = places
                .as_flattened()
                .iter()
                .fold(0.0, |far: f32, it| far.max(it.abs()));
            assert!((farthest - 1.0).abs() < 1e-3, "{places:?}");
        }
    }

    #[test]
    fn a_path_behind_a_wall_is_hidden_and_one_before_it_is_not() {
        let mesh = ground_and_wall();
        // Looks along x from the side of negative x.
        let camera = Camera::framing(
            0.0,
            &[Vec3::new(-10.0, -10.0, 0.0), Vec3::new(19.0, 10.0, 0.0)],
        );
        let front = Front::of(&mesh, &camera, ground_faces_up(&mesh));
        let points = [4.0, 6.0, 18.0].map(|x| Vec3::new(x, 0.0, ABOVE_GROUND_M));
        assert_eq!(front.hides(&camera, &points), [false, true, false]);
    }

    #[test]
    fn the_back_of_a_wall_hides_nothing_if_surfaces_have_an_outer_side() {
        let mut mesh = ground_and_wall();
        // Only the side that faces positive x.
        mesh.retain_triangles(|triangle, _| triangle < 4);
        let camera = Camera::framing(
            0.0,
            &[Vec3::new(-10.0, -10.0, 0.0), Vec3::new(19.0, 10.0, 0.0)],
        );
        let point = [Vec3::new(6.0, 0.0, ABOVE_GROUND_M)];
        assert!(ground_faces_up(&mesh));
        assert_eq!(
            Front::of(&mesh, &camera, true).hides(&camera, &point),
            [false]
        );
        assert_eq!(
            Front::of(&mesh, &camera, false).hides(&camera, &point),
            [true]
        );
        for triangle in &mut mesh.triangles[..2] {
            triangle.swap(0, 1);
        }
        assert!(!ground_faces_up(&mesh));
    }

    #[test]
    fn the_wall_throws_a_shadow_away_from_the_light() {
        let mesh = ground_and_wall();
        let camera = Camera::framing(0.0, &corners(30.0));
        let front = Front::of(&mesh, &camera, false);
        let ground = |x: f32| {
            let point = Vec3::new(x, 0.0, 0.0);
            Some(Surface {
                point,
                normal: Vec3::Z,
                color: relief::GROUND,
            })
        };
        let to_light = Vec3::new(-1.0, 0.0, 1.0).normalize();
        let is_lit = front.is_lit(&[ground(0.0), None, ground(7.0), ground(12.0)], to_light);
        assert_eq!([is_lit[0], is_lit[2], is_lit[3]], [true, false, true]);
    }

    #[test]
    fn both_sides_of_a_surface_look_the_same() {
        let mesh = ground_and_wall();
        let mut turned = mesh.clone();
        for triangle in &mut turned.triangles {
            triangle.swap(0, 1);
        }
        let camera = Camera::framing(0.5, &corners(20.0));
        let directions = [[-0.4, -0.6], [0.0, 0.0], [0.3, 0.2]].map(|at| camera.direction(at));
        let colors = |mesh| Front::of(mesh, &camera, false).colors(&camera, &directions);
        assert!(colors(&mesh).iter().all(|color| *color != WHITE));
        let (colors, of_turned) = (colors(&mesh), colors(&turned));
        for (color, turned) in colors.as_flattened().iter().zip(of_turned.as_flattened()) {
            assert!(color.abs_diff(*turned) <= 1, "{colors:?} {of_turned:?}");
        }
    }

    #[test]
    fn the_path_lies_on_the_ground_below_the_sensor() {
        let scene = Scene::new(&ground_and_wall());
        let above = on_ground(&scene, &Pose3::translation(1.0, 2.0, 1.4));
        assert!(above.distance(Vec3::new(1.0, 2.0, ABOVE_GROUND_M)) < 1e-4);
        let outside = on_ground(&scene, &Pose3::translation(99.0, 0.0, 1.7));
        assert!((outside.z - ABOVE_GROUND_M).abs() < 1e-4);
    }

    #[test]
    fn a_line_is_cut_where_it_becomes_hidden_without_a_gap() {
        let line = dense(&[Vec3::ZERO, Vec3::X, 3.0 * Vec3::X], 0.5);
        assert_eq!(line.len(), 7);
        let places: Vec<Option<Point>> =
            line.iter().map(|it| Some((f64::from(it.x), 0.0))).collect();
        let runs = runs(&places, &[false, false, true, true, true, false, false]);
        let ends: Vec<(bool, f64, f64)> = (runs.iter())
            .map(|(hidden, run)| (*hidden, run[0].0, run[run.len() - 1].0))
            .collect();
        assert_eq!(
            ends,
            [(false, 0.0, 0.5), (true, 0.5, 2.0), (false, 2.0, 3.0)]
        );
    }
}
