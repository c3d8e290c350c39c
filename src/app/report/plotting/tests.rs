//! Every picture of a synthetic run has its size, is not blank, and shows its colors.
//!
//! With `FPMCL_PICTURES=folder` the pictures are kept in that folder.

use std::path::{Path, PathBuf};

use nalgebra::Vector2;
use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use rand_distr::{Distribution as _, StandardNormal};

use super::color::{Colormap, MCL, MISSING, REFINED, Rgb, TRUTH};
use super::*;
use crate::evaluation::{RangeMclRules, planar_errors};
use crate::geometry::{Pose2, Pose3, TriangleMesh, Vec3, pose2_from_pose3};
use crate::lidar::{LidarModel, RangeImage};

/// Folder of the pictures: the one requested, or a temporary one.
struct Gallery {
    folder: PathBuf,
    _temporary: Option<tempfile::TempDir>,
}

impl Gallery {
    fn open() -> Self {
        match std::env::var_os("FPMCL_PICTURES") {
            Some(folder) => Self {
                folder: folder.into(),
                _temporary: None,
            },
            None => {
                let temporary = tempfile::tempdir().unwrap();
                Self {
                    folder: temporary.path().to_owned(),
                    _temporary: Some(temporary),
                }
            }
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }
}

/// Expects a large picture that is not blank and has each color in a least number of pixels.
fn assert_picture(path: &Path, colors: &[(Rgb, usize)]) -> Bitmap {
    let image = Bitmap::read_png(path).unwrap();
    assert!(image.width >= 1200 && image.height >= 400);
    let white = image
        .pixels
        .iter()
        .filter(|pixel| **pixel == [255; 3])
        .count();
    assert!(white < image.pixels.len() * 99 / 100, "blank");
    for (color, at_least) in colors {
        let found = image.pixels.iter().filter(|pixel| *pixel == color).count();
        assert!(found >= *at_least, "{color:?}: {found}");
    }
    image
}

/// A street that bends, at 0.8 m a frame.
fn street(frames: usize) -> Vec<Pose2> {
    let mut pose = Pose2::identity();
    (0..frames)
        .map(|k| {
            let here = pose;
            let turn = if (80..130).contains(&(k % 200)) {
                0.03
            } else {
                0.001
            };
            pose *= Pose2::new(Vector2::new(0.8, 0.0), turn);
            here
        })
        .collect()
}

/// Estimates with noise, and for some frames at the beginning far away.
fn noisy(truth: &[Pose2], noise_m: f64, lost: usize) -> Vec<Pose2> {
    let mut rng = StdRng::seed_from_u64(5);
    let mut slow = Vector2::zeros();
    (truth.iter().enumerate())
        .map(|(k, pose)| {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            slow = 0.9 * slow + 0.4 * noise_m * Vector2::new(normal(), normal());
            let far = if k < lost { 12.0 - k as f64 } else { 0.0 };
            let offset = slow + Vector2::new(far, 0.3 * far);
            pose * Pose2::new(offset, 0.03 * noise_m * normal() + 0.05 * far)
        })
        .collect()
}

/// Houses along the street on a hilly ground, colored as build-map colors them.
fn town(truth: &[Pose2]) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let mut rng = StdRng::seed_from_u64(3);
    let mut quad = |corners: [Vec3; 4], color: Rgb| {
        mesh.append(&TriangleMesh {
            vertices: corners.to_vec(),
            colors: vec![color; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        });
    };
    for pair in truth.windows(3).step_by(2) {
        let at = |pose: &Pose2, left: f64, z: f64| {
            let p = pose * nalgebra::Point2::new(0.0, left);
            let hill = 0.5 * (0.1 * p.x).sin() + 0.3 * (0.13 * p.y).cos();
            Vec3::new(p.x as f32, p.y as f32, (z + hill - 1.7) as f32)
        };
        let (a, b) = (&pair[0], &pair[2]);
        for lane in -7..7 {
            let (low, high) = (f64::from(lane), f64::from(lane) + 1.0);
            quad(
                [
                    at(a, low, 0.0),
                    at(b, low, 0.0),
                    at(b, high, 0.0),
                    at(a, high, 0.0),
                ],
                [255, 0, 0],
            );
        }
        for side in [-1.0, 1.0] {
            if rng.random_bool(0.75) {
                let (near, far) = (side * 7.0, side * (8.5 + rng.random_range(0.0..2.0)));
                quad(
                    [
                        at(a, near, 6.0),
                        at(b, near, 6.0),
                        at(b, far, 8.0),
                        at(a, far, 8.0),
                    ],
                    [0, 0, 255],
                );
                quad(
                    [
                        at(a, near, 0.0),
                        at(b, near, 0.0),
                        at(b, near, 6.0),
                        at(a, near, 6.0),
                    ],
                    [0, 0, 255],
                );
            }
        }
    }
    mesh
}

fn cloud(around: &Pose2, spread_m: f64, count: usize) -> Vec<[f32; 4]> {
    let mut rng = StdRng::seed_from_u64(9);
    (0..count)
        .map(|_| {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let (dx, dy, turn) = (spread_m * normal(), spread_m * normal(), 0.1 * normal());
            let weight = (-0.5 * (dx * dx + dy * dy) / (spread_m * spread_m)).exp();
            let t = around.translation;
            let heading = around.rotation.angle() + turn;
            [
                (t.x + dx) as f32,
                (t.y + dy) as f32,
                heading as f32,
                weight as f32,
            ]
        })
        .collect()
}

#[test]
fn the_path_is_drawn_over_the_truth_and_over_the_map() {
    let gallery = Gallery::open();
    let truth = street(400);
    let (mcl, refined) = (noisy(&truth, 0.5, 8), noisy(&truth, 0.1, 0));
    let paths = [("MCL", MCL, &*mcl), ("refined", REFINED, &*refined)];
    let map = MapImage::of_colors(&town(&truth), 2000);
    let plot = PathPlot {
        title: "Path against ground truth",
        ground_truth: Some(&truth),
        paths: &paths,
        numbers: None,
        map: Some(&map),
    };
    plot.save(&gallery.path("path_on_map.png")).unwrap();
    let colors = [(REFINED, 300), (TRUTH, 300), (MCL, 50)];
    assert_picture(&gallery.path("path_on_map.png"), &colors);

    // The last one is colored by its error.
    let path = gallery.path("path_colored.png");
    let errors = planar_errors(&refined, &truth);
    let errors_cm: Vec<f64> = errors.iter().map(|it| 100.0 * it.distance_m()).collect();
    PathPlot {
        numbers: Some(("position error, refined [cm]", &errors_cm)),
        ..plot
    }
    .save(&path)
    .unwrap();
    let colors = [(MCL, 50), (TRUTH, 300), (Colormap::Viridis.at(1.0), 10)];
    assert_picture(&path, &colors);

    // A short straight drive: thirty metres by two.
    let path = gallery.path("path_short.png");
    let short = PathPlot {
        ground_truth: Some(&truth[..36]),
        paths: &[
            ("MCL", MCL, &mcl[..36]),
            ("refined", REFINED, &refined[..36]),
        ],
        map: None,
        ..plot
    };
    short.save(&path).unwrap();
    assert_picture(&path, &[(MCL, 300), (TRUTH, 300)]);
}

#[test]
fn the_run_of_range_mcl_on_kitti_07_is_drawn() {
    let Some((truth, results)) = crate::app::report::results::kitti_07_tests::kitti_07() else {
        return;
    };
    let gallery = Gallery::open();
    let estimates = results
        .estimates_or_particle_means(&RangeMclRules::default())
        .unwrap();
    let path = gallery.path("path_kitti07.png");
    PathPlot {
        title: "KITTI 07, range-mcl against ground truth",
        ground_truth: Some(&truth),
        paths: &[("MCL", MCL, &estimates)],
        numbers: None,
        map: None,
    }
    .save(&path)
    .unwrap();
    assert_picture(&path, &[(MCL, 1000), (TRUTH, 1000)]);

    let frames = (0..truth.len()).map(|frame| frame as f64);
    let errors = frames.zip(planar_errors(&estimates, &truth));
    let path = gallery.path("errors_kitti07.png");
    let title = "KITTI 07, error of range-mcl";
    let chart = error_chart(title, "frame", [("MCL", MCL, errors)]);
    chart.save(&path).unwrap();
    assert_picture(&path, &[(MCL, 1000)]);
}

#[test]
fn errors_are_drawn_for_both_trajectories() {
    let gallery = Gallery::open();
    let truth = street(400);
    let errors = |estimates: Vec<Pose2>| {
        let times = (0..400).map(|k| 0.1 * f64::from(k));
        times.zip(planar_errors(&estimates, &truth))
    };
    let path = gallery.path("errors.png");
    let trajectories = [
        ("MCL", MCL, errors(noisy(&truth, 0.5, 6))),
        ("refined", REFINED, errors(noisy(&truth, 0.1, 0))),
    ];
    let chart = error_chart("Error over time", "time from the start [s]", trajectories);
    chart.save(&path).unwrap();
    assert_picture(&path, &[(MCL, 1000), (REFINED, 1000)]);
}

#[test]
fn particles_are_drawn_on_the_map_spread_and_concentrated() {
    let gallery = Gallery::open();
    let truth = street(300);
    let map = MapImage::of_colors(&town(&truth), 2500);
    for (name, spread_m, count) in [
        ("spread", 18.0, 10_000),
        ("start", 3.0, 1000),
        ("tracking", 0.4, 100),
    ] {
        let here = truth[150];
        let particles = cloud(&(here * Pose2::translation(0.5, 0.3)), spread_m, count);
        let path = gallery.path(&format!("particles_{name}.png"));
        LocalizationPicture {
            title: &format!("frame 150, {name}"),
            map: Some(&map),
            particles: &particles,
            color_name: "weight / largest",
            estimate: Some(here * Pose2::new(Vector2::new(0.5, 0.3), 0.1)),
            ground_truth: Some(here),
            driven: &truth[..=150],
            window: None,
        }
        .save(&path)
        .unwrap();
        assert_picture(&path, &[(MCL, 100), (TRUTH, 100)]);
    }
}

/// Three rooms in a row with doors between them, 1.3 m below the sensor, in one color; all surfaces have
/// two sides.
fn rooms() -> (TriangleMesh, Vec<Pose3>) {
    let mut mesh = TriangleMesh::default();
    let mut quad = |corners: [[f32; 3]; 4]| {
        for corners in [corners, [3, 2, 1, 0].map(|corner| corners[corner])] {
            mesh.append(&TriangleMesh {
                vertices: corners.map(Vec3::from_array).to_vec(),
                triangles: vec![[0, 1, 2], [0, 2, 3]],
                ..TriangleMesh::default()
            });
        }
    };
    let (low, high) = (-1.3, 1.3);
    for z in [low, high] {
        quad([
            [0.0, -3.0, z],
            [18.0, -3.0, z],
            [18.0, 3.0, z],
            [0.0, 3.0, z],
        ]);
    }
    let mut wall = |a: [f32; 2], b: [f32; 2], low: f32| {
        let [[ax, ay], [bx, by]] = [a, b];
        quad([[ax, ay, low], [bx, by, low], [bx, by, high], [ax, ay, high]]);
    };
    for y in [-3.0, 3.0] {
        wall([0.0, y], [18.0, y], low);
    }
    for x in [0.0, 6.0, 12.0, 18.0] {
        wall([x, -3.0], [x, -0.5], low);
        wall([x, 0.5], [x, 3.0], low);
        wall([x, -0.5], [x, 0.5], 0.8);
    }
    let path = (2..33).map(|k| 0.5 * f64::from(k));
    let path = path.map(|x| Pose3::translation(x, 0.8 * (1.05 * x).sin(), 0.0));
    (mesh, path.collect())
}

#[test]
fn indoors_the_floor_is_visible_from_above() {
    let gallery = Gallery::open();
    let (rooms, path) = rooms();
    let planar: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
    let map = gallery.path("rooms_map.png");
    MapPlot {
        title: "Rooms",
        mesh: &rooms,
        path: Some(("path", &planar)),
        keys: &[],
        numbers: None,
    }
    .save(&map)
    .unwrap();
    // Level surfaces are in the color of what has none, walls are darker.
    assert_picture(&map, &[(TRUTH, 300), (MISSING, 100_000)]);
}

#[test]
fn frames_become_an_animation_of_one_size() {
    let gallery = Gallery::open();
    let truth = street(120);
    let map = MapImage::of_colors(&town(&truth), 1500);
    let pictures: Vec<PathBuf> = (0..120)
        .step_by(30)
        .map(|k| {
            let path = gallery.path(&format!("frame_{k:06}.png"));
            let t = truth[k].translation;
            LocalizationPicture {
                title: &format!("frame {k}"),
                map: Some(&map),
                particles: &cloud(&truth[k], 3.0 / (1.0 + k as f64 / 30.0), 300),
                color_name: "weight / largest",
                estimate: Some(truth[k] * Pose2::translation(0.3, 0.2)),
                ground_truth: Some(truth[k]),
                driven: &truth[..=k],
                window: Some(([t.x, t.y], 60.0)),
            }
            .save(&path)
            .unwrap();
            path
        })
        .collect();
    let path = gallery.path("localization.gif");
    save_animation(&path, &pictures).unwrap();
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let decoder = options.read_info(std::fs::File::open(&path).unwrap());
    let frames: Vec<gif::Frame> = decoder.unwrap().into_iter().map(Result::unwrap).collect();
    assert_eq!(frames.len(), 4);
    assert!(frames.iter().all(|frame| frame.width == 1200));
    assert_ne!(frames[0].buffer, frames[3].buffer);

    let missing = [gallery.path("no_such.png")];
    let error = save_animation(&path, &missing).unwrap_err();
    assert!(format!("{error:#}").contains("no_such.png"), "{error:#}");
}

#[test]
fn range_images_show_missing_pixels_and_differences() {
    let gallery = Gallery::open();
    let model = LidarModel::default();
    let mut rng = StdRng::seed_from_u64(1);
    let range_at = |index: usize, car: bool| {
        let direction = model.direction_of(index);
        let azimuth = direction.y.atan2(direction.x);
        let ground = if direction.z < 0.0 {
            -1.73 / direction.z
        } else {
            f32::INFINITY
        };
        let wall = 7.0 / direction.y.abs().max(1e-3);
        let front = if car && (azimuth - 0.2).abs() < 0.15 && direction.z < 0.02 {
            8.0
        } else {
            f32::INFINITY
        };
        let range = ground.min(wall).min(front);
        if range < model.max_range {
            range
        } else {
            f32::INFINITY
        }
    };
    let rendered: Vec<f32> = (0..model.len())
        .map(|index| range_at(index, false))
        .collect();
    let points: Vec<Vec3> = (0..model.len())
        .filter_map(|index| {
            let range = range_at(index, true) + rng.random_range(-0.1..0.1);
            let point = model.direction_of(index) * range;
            (!rng.random_bool(0.05)).then_some(point)
        })
        .collect();
    let path = gallery.path("range_images.png");
    let strip = RangeImageStrip {
        title: "Frame 12: range images",
        observed: &RangeImage::project(&points, &model),
        rendered: &rendered,
    };
    strip.save(&path).unwrap();
    assert_picture(
        &path,
        &[(MISSING, 2000), (Colormap::Diverging.at(0.0), 100)],
    );
}

#[test]
fn the_map_is_drawn_in_its_colors_and_by_a_number() {
    let gallery = Gallery::open();
    let truth = street(300);
    let mesh = town(&truth);
    let path = gallery.path("map.png");
    MapPlot {
        title: "Map from above",
        mesh: &mesh,
        path: Some(("mapping trajectory", &truth)),
        keys: &[("ground", [255, 0, 0]), ("rest", [0, 0, 255])],
        numbers: None,
    }
    .save(&path)
    .unwrap();
    let image = assert_picture(&path, &[(TRUTH, 300)]);
    let reddish = image
        .pixels
        .iter()
        .filter(|p| p[0] > 120 && p[1] < 90 && p[2] < 90)
        .count();
    let bluish = image
        .pixels
        .iter()
        .filter(|p| p[2] > 100 && p[0] < 90 && p[1] < 90)
        .count();
    assert!(reddish > 10_000 && bluish > 1000, "{reddish} {bluish}");

    let residual = |vertex: &Vec3| {
        if vertex.x > 120.0 {
            f32::NAN
        } else {
            0.05 * (0.2 * vertex.y).sin()
        }
    };
    let values: Vec<f32> = mesh.vertices.iter().map(residual).collect();
    let path = gallery.path("map_residual.png");
    MapPlot {
        title: "Residual of the map",
        mesh: &mesh,
        path: None,
        keys: &[],
        numbers: Some(VertexNumbers {
            values: &values,
            name: "residual [m]",
            limit: 0.05,
        }),
    }
    .save(&path)
    .unwrap();
    assert_picture(&path, &[]);

    let nothing = MapPlot {
        title: "",
        mesh: &TriangleMesh::default(),
        path: None,
        keys: &[],
        numbers: None,
    };
    let error = nothing.save(&path).unwrap_err();
    assert!(
        format!("{error:#}").contains("the mesh has no triangles"),
        "{error:#}"
    );
}

#[test]
fn line_charts_are_drawn() {
    let gallery = Gallery::open();
    let peak = |width: f64| {
        (-40..=40)
            .map(move |k| 0.05 * f64::from(k))
            .map(move |x| (x, (-0.5 * (x / width).powi(2)).exp()))
    };
    let path = gallery.path("peaks.png");
    LineChart {
        title: "Likelihood around the true pose".to_owned(),
        x_name: "offset along [m]".to_owned(),
        panels: vec![Panel {
            y_name: "likelihood / peak".to_owned(),
            series: vec![
                Series::line("ours", REFINED, peak(0.1)),
                Series {
                    mark: Mark::Dashes,
                    ..Series::line("range-mcl", MCL, peak(1.2))
                },
                Series {
                    mark: Mark::Dots,
                    ..Series::line("measured", color::SERIES[2], peak(0.3).step_by(4))
                },
            ],
            ..Panel::default()
        }],
        marks: vec![(0.0, "truth".to_owned())],
        ..LineChart::default()
    }
    .save(&path)
    .unwrap();
    assert_picture(&path, &[(MCL, 300), (REFINED, 300)]);
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let gallery = Gallery::open();
    let file = gallery.path("a_file");
    std::fs::create_dir_all(&gallery.folder).unwrap();
    std::fs::write(&file, "").unwrap();
    let truth = street(10);
    let plot = PathPlot {
        title: "",
        ground_truth: Some(&truth),
        paths: &[],
        numbers: None,
        map: None,
    };
    let error = plot.save(&file.join("path.png")).unwrap_err();
    assert!(format!("{error:#}").contains("path.png"), "{error:#}");
    let error = PathPlot {
        ground_truth: None,
        ..plot
    }
    .save(&file)
    .unwrap_err();
    assert!(
        format!("{error:#}").contains("nothing to draw"),
        "{error:#}"
    );
}
