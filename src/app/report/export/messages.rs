//! Messages with the schemas of Foxglove, of logs and of its server.

use anyhow::Result;
use foxglove::messages::{
    Color, FrameTransform, KeyValuePair, Log, ModelPrimitive, Odometry, PackedElementField, Point3,
    PointCloud, Pose, PosesInFrame, Quaternion, SceneEntity, SceneUpdate, Timestamp, Vector3, log,
    packed_element_field,
};
use nalgebra::Matrix3;

use super::glb::Model;
use crate::app::report::plotting::color::Rgb;
use crate::app::report::plotting::muted;
use crate::evaluation::ParticleRow;
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose3_from_pose2};
use crate::lidar::Scan;

/// Frames of reference.
pub const MAP: &str = "map";
const LIDAR: &str = "lidar";

/// The pose of the lidar as a transform.
pub fn transform(map_from_lidar: &Pose3, stamp: u64) -> FrameTransform {
    let pose = pose(map_from_lidar);
    FrameTransform {
        timestamp: timestamp(stamp),
        parent_frame_id: MAP.to_owned(),
        child_frame_id: LIDAR.to_owned(),
        translation: pose.position,
        rotation: pose.orientation,
    }
}

/// A pose with its covariance in the plane and the state.
pub fn odometry(
    map_from_lidar: &Pose3,
    covariance: Option<Matrix3<f64>>,
    state: Option<&str>,
    stamp: u64,
) -> Odometry {
    let in_state = |state: &str| KeyValuePair {
        key: "state".to_owned(),
        value: state.to_owned(),
    };
    Odometry {
        timestamp: timestamp(stamp),
        frame_id: MAP.to_owned(),
        body_frame_id: LIDAR.to_owned(),
        pose: Some(pose(map_from_lidar)),
        pose_covariance: in_space(covariance),
        velocity_covariance: vec![0.0; 36],
        metadata: state.into_iter().map(in_state).collect(),
        ..Odometry::default()
    }
}

/// A change of the state; a warning where the pose must not be used.
pub fn state_change(message: String, is_believed: bool, stamp: u64) -> Log {
    let levels = [log::Level::Warning, log::Level::Info];
    Log {
        timestamp: timestamp(stamp),
        level: levels[usize::from(is_believed)].into(),
        message,
        name: "fpmcl".to_owned(),
        ..Log::default()
    }
}

/// The mesh of a map as a glTF model, in colours on which scan and particles are seen.
pub fn map_scene(mesh: &TriangleMesh, stamp: u64) -> Result<SceneUpdate> {
    let mut model = Model::default();
    model.add_mesh(MAP, &muted(mesh));
    let mut data = Vec::new();
    model.write(&mut data)?;
    let one = Vector3 {
        x: 1.0,
        y: 1.0,
        z: 1.0,
    };
    Ok(SceneUpdate {
        entities: vec![SceneEntity {
            models: vec![ModelPrimitive {
                pose: Some(pose(&Pose3::identity())),
                scale: Some(one),
                media_type: "model/gltf-binary".to_owned(),
                data: data.into(),
                ..ModelPrimitive::default()
            }],
            ..entity("mesh", stamp)
        }],
        ..SceneUpdate::default()
    })
}

/// Poses of particles at a height [m].
pub fn particles(particles: &[ParticleRow], height_m: f64, stamp: u64) -> PosesInFrame {
    let poses = particles.iter();
    let poses = poses.map(|&[x, y, heading, _]| {
        let [x, y, heading] = [x, y, heading].map(f64::from);
        let planar = Pose2::new([x, y].into(), heading);
        pose(&pose3_from_pose2(&planar, height_m))
    });
    PosesInFrame {
        timestamp: timestamp(stamp),
        frame_id: MAP.to_owned(),
        poses: poses.collect(),
    }
}

/// A scan as x, y, z in the map and intensity, of 32 bits each.
pub fn cloud(scan: &Scan, map_from_lidar: &Pose3, stamp: u64) -> PointCloud {
    let mut data: Vec<f32> = Vec::with_capacity(4 * scan.len());
    for (k, point) in scan.points.iter().enumerate() {
        let point = map_from_lidar * nalgebra::Point3::from(point.as_dvec3().to_array());
        data.extend(point.coords.iter().map(|&coordinate| coordinate as f32));
        data.push(scan.intensities.get(k).copied().unwrap_or(0.0));
    }
    let names = ["x", "y", "z", "intensity"].into_iter().zip(0..);
    let fields = names.map(|(name, k)| PackedElementField {
        name: name.to_owned(),
        offset: 4 * k,
        r#type: packed_element_field::NumericType::Float32.into(),
    });
    PointCloud {
        timestamp: timestamp(stamp),
        frame_id: MAP.to_owned(),
        pose: Some(pose(&Pose3::identity())),
        point_stride: 16,
        fields: fields.collect(),
        data: bytemuck::cast_slice::<f32, u8>(&data).to_vec().into(),
    }
}

/// The covariance of a pose in space, row-major; zero where nothing is estimated.
fn in_space(planar: Option<Matrix3<f64>>) -> Vec<f64> {
    /// Rows of x, y and heading.
    const ROWS: [usize; 3] = [0, 1, 5];
    let mut covariance = vec![0.0; 36];
    for (i, row) in ROWS.into_iter().enumerate() {
        for (j, column) in ROWS.into_iter().enumerate() {
            covariance[6 * row + column] = planar.map_or(0.0, |planar| planar[(i, j)]);
        }
    }
    covariance
}

/// An empty entity of the map.
pub fn entity(name: &str, stamp: u64) -> SceneEntity {
    SceneEntity {
        timestamp: timestamp(stamp),
        frame_id: MAP.to_owned(),
        id: name.to_owned(),
        ..SceneEntity::default()
    }
}

/// A pose.
pub fn pose(pose: &Pose3) -> Pose {
    let [x, y, z] = pose.translation.vector.into();
    let position = Some(Vector3 { x, y, z });
    let [x, y, z, w] = pose.rotation.coords.into();
    let orientation = Some(Quaternion { x, y, z, w });
    Pose {
        position,
        orientation,
    }
}

/// The position of a pose.
pub fn point(pose: &Pose3) -> Point3 {
    let [x, y, z] = pose.translation.vector.into();
    Point3 { x, y, z }
}

/// A colour.
pub fn opaque(color: Rgb) -> Color {
    let [r, g, b] = color.map(|channel| f64::from(channel) / 255.0);
    Color { r, g, b, a: 1.0 }
}

/// A time [s] in nanoseconds; times before zero, of recordings without a date, are zero.
pub fn nanoseconds(time_s: f64) -> u64 {
    (1e9 * time_s.max(0.0)).round() as u64
}

/// A time.
pub fn timestamp(nanoseconds: u64) -> Option<Timestamp> {
    Some(Timestamp::new(
        (nanoseconds / 1_000_000_000) as u32,
        (nanoseconds % 1_000_000_000) as u32,
    ))
}
