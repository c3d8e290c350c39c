//! The filter at a crossing of two roads on two levels.

use glam::Vec3;
use nalgebra::Vector2;
use rand::{SeedableRng, rngs::StdRng};

use super::ParticleFilter;
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose2_from_pose3};
use crate::lidar::{LidarModel, RangeImage};
use crate::localization::initialization::{StartSpread, around, from_panoramas};
use crate::localization::places::PlacesConfig;
use crate::localization::{LocalizerConfig, Odometry, ParticleSet, State};
use crate::map::{
    GroundMap, GroundPatch, Map, MappingPath, PanoramaConfig, PanoramaRequest, SearchRegion,
    SensorAttitude, TileConfig, TileGrid,
};
use crate::rendering::CpuRenderer;

/// Height of the deck over the road below [m].
const DECK_M: f64 = 6.0;
/// Distance of the lower ends of the ramps from the middle of the bridge [m].
const FOOT_M: f64 = 60.0;
/// Distance of their upper ends from it [m].
const HEAD_M: f64 = 10.0;

/// A road along y on the ground, and one along x that crosses it on a bridge.
struct Crossing {
    map: Map,
}

/// Height of the upper road [m].
fn upper_m(x: f64) -> f64 {
    (DECK_M * (FOOT_M - x.abs()) / (FOOT_M - HEAD_M)).clamp(0.0, DECK_M)
}

fn quad(mesh: &mut TriangleMesh, corners: [Vec3; 4]) {
    mesh.append(&TriangleMesh {
        vertices: corners.to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..TriangleMesh::default()
    });
}

/// The four walls of a house.
fn walls(mesh: &mut TriangleMesh, low: Vec3, high: Vec3) {
    let corners = [
        (low.x, low.y),
        (high.x, low.y),
        (high.x, high.y),
        (low.x, high.y),
    ];
    for (k, (x0, y0)) in corners.into_iter().enumerate() {
        let (x1, y1) = corners[(k + 1) % 4];
        quad(
            mesh,
            [
                Vec3::new(x0, y0, low.z),
                Vec3::new(x1, y1, low.z),
                Vec3::new(x1, y1, high.z),
                Vec3::new(x0, y0, high.z),
            ],
        );
    }
}

impl Crossing {
    fn new() -> Self {
        let mut mesh = TriangleMesh::default();
        // The ramps are embankments: there is no ground below them, but there is below the deck.
        let (foot, head) = (FOOT_M as f32, HEAD_M as f32);
        for (x0, x1, y0, y1) in [
            (-90.0, 90.0, -90.0, -4.0),
            (-90.0, 90.0, 4.0, 90.0),
            (-90.0, -foot, -4.0, 4.0),
            (-head, head, -4.0, 4.0),
            (foot, 90.0, -4.0, 4.0),
        ] {
            let corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)];
            quad(&mut mesh, corners.map(|(x, y)| Vec3::new(x, y, 0.0)));
        }
        let heads = [-FOOT_M, -HEAD_M, HEAD_M, FOOT_M];
        for pair in heads.windows(2) {
            let at = |x: f64, y: f32| Vec3::new(x as f32, y, upper_m(x) as f32);
            let [x0, x1] = [pair[0], pair[1]];
            quad(
                &mut mesh,
                [at(x0, -4.0), at(x1, -4.0), at(x1, 4.0), at(x0, 4.0)],
            );
        }
        let of_ground = mesh.triangles.len();
        // Houses in the four corners and parapets, all of different sizes.
        let mut state = 7_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        for (x_side, y_side) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            for along_x in [true, false] {
                let mut along = 14.0;
                while along < 75.0 {
                    let (length, setback) = (4.0 + 7.0 * random(), 8.0 + 4.0 * random());
                    let (x0, y0) = if along_x {
                        (along, setback)
                    } else {
                        (setback, along)
                    };
                    let (x1, y1) = if along_x {
                        (along + length, setback + 3.0)
                    } else {
                        (setback + 3.0, along + length)
                    };
                    let (a, b) = (
                        Vec3::new(x_side * x0, y_side * y0, 0.0),
                        Vec3::new(x_side * x1, y_side * y1, 9.0 + 8.0 * random()),
                    );
                    walls(&mut mesh, a.min(b), a.max(b));
                    along += length + 1.0 + 5.0 * random();
                }
            }
        }
        let path = MappingPath {
            world_from_map: Pose3::identity(),
            map_from_lidar: upper_drive().into_iter().chain(lower_drive()).collect(),
            ..MappingPath::default()
        };
        let tiles = TileGrid::around(&path.map_from_lidar, &TileConfig::default());
        let renderer = CpuRenderer::new(std::slice::from_ref(&mesh));
        let ground = GroundMap::from_mesh(&mesh, |triangle| triangle < of_ground, 0.5);
        Self {
            map: Map::from_parts(mesh, path, tiles, ground, std::sync::Arc::new(renderer)),
        }
    }

    fn scan(&self, map_from_lidar: &Pose3) -> RangeImage {
        let model = LidarModel {
            height: 32,
            width: 360,
            ..LidarModel::default()
        };
        let images = self
            .map
            .renderer
            .render(&[*map_from_lidar], &model)
            .unwrap();
        RangeImage::from_ranges(images.into_iter().next().unwrap(), &model)
    }
}

/// Poses of the sensor on the upper road, tilted with it.
fn upper_drive() -> Vec<Pose3> {
    let pose = |frame: i32| {
        let x = -70.0 + 1.5 * f64::from(frame);
        let slope = (upper_m(x + 0.5) - upper_m(x - 0.5)).atan();
        let normal = nalgebra::Vector3::new(-slope.sin(), 0.0, slope.cos());
        let patch = GroundPatch {
            height_m: upper_m(x),
            normal,
        };
        patch.lift(
            &Pose2::new(Vector2::new(x, 0.5), 0.02),
            &SensorAttitude::default(),
        )
    };
    (0..90).map(pose).collect()
}

/// Poses of the sensor on the lower road.
fn lower_drive() -> Vec<Pose3> {
    let patch = GroundPatch {
        height_m: 0.0,
        normal: nalgebra::Vector3::z(),
    };
    let pose = |frame: i32| {
        let place = Vector2::new(-0.6, -50.0 + 1.5 * f64::from(frame));
        patch.lift(&Pose2::new(place, 1.55), &SensorAttitude::default())
    };
    (0..65).map(pose).collect()
}

/// Runs the filter, which must track the truth in space from the tenth frame on.
fn follow(crossing: &Crossing, mut filter: ParticleFilter, truth: &[Pose3], rng: &mut StdRng) {
    let mut before = pose2_from_pose3(&truth[0]);
    for (frame, truth) in truth.iter().enumerate() {
        let increment = before.inverse() * pose2_from_pose3(truth);
        before = pose2_from_pose3(truth);
        let odometry = Odometry::Increment(increment);
        let scan = crossing.scan(truth);
        let found = filter
            .step(odometry, &scan, &SensorAttitude::default(), rng)
            .unwrap();
        let off = found.map_from_lidar.translation.vector - truth.translation.vector;
        assert!(
            frame < 10 || (off.xy().norm() < 0.1 && off.z.abs() < 0.2),
            "frame {frame} at {}: off by {off}",
            truth.translation.vector
        );
        assert!(
            frame < 10 || found.state == State::Tracking,
            "frame {frame}"
        );
    }
}

#[test]
fn cars_on_both_levels_and_on_the_ramp_keep_their_level() {
    let crossing = Crossing::new();
    for (seed, truth) in [(1, upper_drive()), (2, lower_drive())] {
        let mut rng = StdRng::seed_from_u64(seed);
        let level_m = Some(truth[0].translation.z - SensorAttitude::default().height_m);
        let pose = pose2_from_pose3(&truth[0]);
        let start = around(&pose, level_m, 500, &StartSpread::default(), &mut rng);
        let start = ParticleSet::uniform(start);
        let filter = ParticleFilter::new(
            LocalizerConfig::of_test(500),
            crossing.map.clone(),
            None,
            start,
        )
        .unwrap();
        follow(&crossing, filter, &truth, &mut rng);
    }
}

#[test]
fn a_start_anywhere_finds_its_level() {
    let crossing = Crossing::new();
    let request = PanoramaRequest {
        region: SearchRegion::Road,
        lidar: LidarModel::default(),
        sensor_height_m: SensorAttitude::default().height_m,
        config: PanoramaConfig::default(),
    };
    let index = crossing.map.panoramas(&request).unwrap();
    // On the deck and below it.
    for (seed, truth) in [(3, &upper_drive()[44..]), (4, &lower_drive()[31..])] {
        let mut rng = StdRng::seed_from_u64(seed);
        let scan = crossing.scan(&truth[0]);
        let start = from_panoramas(
            &index,
            &scan,
            &SensorAttitude::default(),
            500,
            &PlacesConfig::default(),
            &mut rng,
        )
        .unwrap();
        let filter = ParticleFilter::new(
            LocalizerConfig::of_test(500),
            crossing.map.clone(),
            None,
            ParticleSet::uniform(start),
        )
        .unwrap();
        follow(&crossing, filter, truth, &mut rng);
    }
}

#[test]
fn particles_on_the_wrong_level_find_the_other_one_in_the_first_scan() {
    let crossing = Crossing::new();
    // On the deck and below it.
    for (seed, truth, wrong_m) in [(3, upper_drive()[44], 0.0), (4, lower_drive()[33], DECK_M)] {
        let mut rng = StdRng::seed_from_u64(seed);
        let (pose, scan) = (pose2_from_pose3(&truth), crossing.scan(&truth));
        let start = around(&pose, Some(wrong_m), 500, &StartSpread::default(), &mut rng);
        let (config, map) = (LocalizerConfig::of_test(500), crossing.map.clone());
        let filter = ParticleFilter::new(config, map, None, ParticleSet::uniform(start));
        let mut filter = filter.unwrap().searching_anywhere();
        let attitude = SensorAttitude::default();
        let found = filter.step(Odometry::Unknown, &scan, &attitude, &mut rng);
        let off = found.unwrap().map_from_lidar.translation.vector - truth.translation.vector;
        assert!(off.norm() < 0.2, "{off}");
    }
}
