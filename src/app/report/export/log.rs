//! MCAP log of a run with the message schemas of Foxglove, which its viewer and others open.
//!
//! | topic | schema | content |
//! |---|---|---|
//! | `/tf` | `foxglove.FrameTransform` | `map` to `lidar`, the best pose of each frame |
//! | `/estimate`, `/refined` | `foxglove.Odometry` | pose with covariance of x, y and heading; the state is in its metadata |
//! | `/truth` | `foxglove.PoseInFrame` | true pose |
//! | `/particles` | `foxglove.PosesInFrame` | poses of the particles, at the height of the estimate |
//! | `/scan` | `foxglove.PointCloud` | scan, motion-compensated, in the map frame |
//! | `/map` | `foxglove.SceneUpdate` | the mesh as a glTF model |
//! | `/paths` | `foxglove.SceneUpdate` | whole trajectories as lines |
//! | `/state` | `foxglove.Log` | each change of the state |
//! | `/numbers` | `fpmcl.Frame` (JSON) | state, standard deviations, agreement and errors, to plot |
//!
//! Times before zero, of recordings without a date, are shifted to zero.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use anyhow::{Context as _, Result};
use foxglove::messages::{
    Color, FrameTransform, LinePrimitive, Log, ModelPrimitive, Odometry, PackedElementField,
    PointCloud, Pose, PoseInFrame, PosesInFrame, Quaternion, SceneEntity, SceneUpdate, Vector3,
    line_primitive, log, packed_element_field,
};
use foxglove::messages::{KeyValuePair, Point3, Timestamp};
use foxglove::{Encode, Schema};
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use nalgebra::Matrix3;
use serde_json::{Value, json};

use super::glb::Model;
use crate::app::report::plotting::color::{MCL, REFINED, Rgb, TRUTH};
use crate::app::report::results::{LocalizationResults, stretches};
use crate::evaluation::trust::Axes;
use crate::evaluation::{ParticleRow, planar_errors};
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose2_from_pose3, pose3_from_pose2};
use crate::lidar::{Motion, Scan};
use crate::localization::State;
use crate::recording::{Frame, RecordingError};

/// Frames of reference.
const MAP: &str = "map";
const LIDAR: &str = "lidar";

/// A run to write.
pub struct RunLog<'a> {
    /// Results with estimates.
    pub results: &'a LocalizationResults,
    /// Frames of the results with their scans; `None` for a log without scans.
    pub frames: Option<&'a [Frame]>,
    /// Map; `None` for a log without it.
    pub mesh: Option<&'a TriangleMesh>,
    /// Largest number of points per scan: of larger ones, points at even distances in the file.
    pub max_points: usize,
}

/// Writes a log; `written` is called after each frame, and its error ends the log.
pub fn write_mcap(
    run: &RunLog,
    writer: impl Write + Seek,
    mut written: impl FnMut() -> Result<()>,
) -> Result<()> {
    let results = run.results;
    let poses = Trajectories::of(results)?;
    let mut log = LogWriter::new(writer)?;
    let assumed = || {
        results
            .frames
            .iter()
            .map(|&frame| frame as f64 / 10.0)
            .collect()
    };
    let times_s: Vec<f64> = results.times_s.clone().unwrap_or_else(assumed);
    let first_s = times_s.iter().copied().reduce(f64::min).unwrap_or(0.0);
    let shift_s = (-first_s).max(0.0);
    let nanoseconds = |time_s: &f64| ((time_s + shift_s) * 1e9).round() as u64;
    let stamps: Vec<u64> = times_s.iter().map(nanoseconds).collect();
    if let Some(&first) = stamps.first() {
        log.send("/paths", first, &poses.scene(results, first))?;
        if let Some(mesh) = run.mesh {
            log.send("/map", first, &map_scene(mesh, first)?)?;
        }
    }
    for (row, &stamp) in stamps.iter().enumerate() {
        poses.send(&mut log, results, row, stamp)?;
        if !results.particles.is_empty() {
            let height_m = poses.best()[row].translation.z;
            let particles = particles(&results.particles.frame(row)?, height_m, stamp);
            log.send("/particles", stamp, &particles)?;
        }
        if let Some(frames) = run.frames {
            let motion = Motion::along(poses.best(), &times_s, row);
            let cloud = run.cloud(&frames[row], motion, &poses.best()[row], stamp)?;
            log.send("/scan", stamp, &cloud)?;
        }
        written()?;
    }
    log.writer.finish().context("cannot finish the log")?;
    Ok(())
}

impl RunLog<'_> {
    /// The points of a scan in the map frame.
    fn cloud(
        &self,
        frame: &Frame,
        motion: Option<Motion>,
        map_from_lidar: &Pose3,
        stamp: u64,
    ) -> Result<PointCloud, RecordingError> {
        let mut scan = frame.read()?;
        if let Some(motion) = motion {
            motion.deskew(&mut scan);
        }
        scan.drop_not_finite();
        let scan = scan.every(scan.len().div_ceil(self.max_points.max(1)).max(1));
        Ok(cloud(&scan, map_from_lidar, stamp))
    }
}

/// Trajectories of a run in space, where they are known.
struct Trajectories {
    estimates: Vec<Pose3>,
    refined: Option<Vec<Pose3>>,
    truth: Option<Vec<Pose3>>,
}

impl Trajectories {
    fn of(results: &LocalizationResults) -> Result<Self> {
        let raised = |in_space: &Option<Vec<Pose3>>, planar: &Option<Vec<Pose2>>| {
            let planar = planar.as_ref().map(|poses| poses.iter());
            let raised = planar.map(|poses| poses.map(|pose| pose3_from_pose2(pose, 0.0)));
            in_space.clone().or(raised.map(Iterator::collect))
        };
        let estimates = raised(&results.estimates_in_space, &results.estimates);
        Ok(Self {
            estimates: estimates.context("the result holds no estimates; run localize again")?,
            refined: raised(&results.refined_in_space, &results.refined),
            truth: raised(&results.ground_truth_in_space, &results.ground_truth),
        })
    }

    /// The refined poses, else the estimates.
    fn best(&self) -> &[Pose3] {
        self.refined.as_ref().unwrap_or(&self.estimates)
    }

    /// Sends the poses, the state and the numbers of a frame.
    fn send<W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        results: &LocalizationResults,
        row: usize,
        stamp: u64,
    ) -> Result<()> {
        let best = pose(&self.best()[row]);
        let transform = FrameTransform {
            timestamp: timestamp(stamp),
            parent_frame_id: MAP.to_owned(),
            child_frame_id: LIDAR.to_owned(),
            translation: best.position,
            rotation: best.orientation,
        };
        log.send("/tf", stamp, &transform)?;
        let state = |row: usize| Some(State::from_number(results.states.as_ref()?[row])?.word());
        let in_state = |state: &str| KeyValuePair {
            key: "state".to_owned(),
            value: state.to_owned(),
        };
        let of_refined = |row: usize| {
            let states = results
                .refined_states
                .as_ref()
                .or(results.states.as_ref())?;
            Some(State::from_number(states[row])?.word())
        };
        let odometry = |poses: &[Pose3],
                        covariances: &Option<Vec<Matrix3<f64>>>,
                        state: Option<&str>| Odometry {
            timestamp: timestamp(stamp),
            frame_id: MAP.to_owned(),
            body_frame_id: LIDAR.to_owned(),
            pose: Some(pose(&poses[row])),
            pose_covariance: in_space(covariances.as_ref().map(|all| all[row])),
            velocity_covariance: vec![0.0; 36],
            metadata: state.into_iter().map(in_state).collect(),
            ..Odometry::default()
        };
        let estimate = odometry(&self.estimates, &results.covariances, state(row));
        log.send("/estimate", stamp, &estimate)?;
        if let Some(refined) = &self.refined {
            let refined = odometry(refined, &results.refined_covariances, of_refined(row));
            log.send("/refined", stamp, &refined)?;
        }
        if let Some(truth) = &self.truth {
            let truth = PoseInFrame {
                timestamp: timestamp(stamp),
                frame_id: MAP.to_owned(),
                pose: Some(pose(&truth[row])),
            };
            log.send("/truth", stamp, &truth)?;
        }
        if let Some(now) = state(row)
            && (row == 0 || state(row - 1) != Some(now))
        {
            let is_tracking = now == State::Tracking.word();
            let levels = [log::Level::Warning, log::Level::Info];
            let change = Log {
                timestamp: timestamp(stamp),
                level: levels[usize::from(is_tracking)].into(),
                message: format!("frame {}: {now}", results.frames[row]),
                name: "fpmcl".to_owned(),
                ..Log::default()
            };
            log.send("/state", stamp, &change)?;
        }
        log.send_json("/numbers", stamp, &self.numbers(results, row, state(row)))
    }

    fn numbers(&self, results: &LocalizationResults, row: usize, state: Option<&str>) -> Value {
        let errors = |poses: &[Pose3]| {
            let [pose, truth] = [&poses[row], &self.truth.as_ref()?[row]].map(pose2_from_pose3);
            planar_errors(&[pose], &[truth]).first().copied()
        };
        let best = pose2_from_pose3(&self.best()[row]);
        let covariance = results.best_covariances().map(|all| all[row]);
        let axes = covariance.map(|covariance| Axes::new(&covariance, &best));
        let [error, refined_error] = [Some(&self.estimates), self.refined.as_ref()]
            .map(|poses| poses.and_then(|poses| errors(poses)));
        let agreement = results.agreements.as_ref().map(|all| all[row]);
        json!({
            "frame": results.frames[row],
            "state": state,
            "particles": (!results.particles.is_empty()).then(|| results.particles.count(row)),
            "agreement": agreement.filter(|&share| share >= 0.0),
            "places": results.places.as_ref().map(|all| all[row] as u64),
            "sigma_long_m": axes.map(|axes| axes.long_m),
            "sigma_short_m": axes.map(|axes| axes.short_m),
            "sigma_heading_deg": covariance.map(|it| it[(2, 2)].max(0.0).sqrt().to_degrees()),
            "position_error_m": error.map(|error| error.distance_m()),
            "heading_error_deg": error.map(|error| error.turn_rad.to_degrees()),
            "refined_position_error_m": refined_error.map(|error| error.distance_m()),
            "refined_heading_error_deg": refined_error.map(|error| error.turn_rad.to_degrees()),
            "time_ms": results.runtimes_s.as_ref().map(|all| 1e3 * all[row]),
        })
    }

    /// The trajectories as lines, with gaps where they are not trusted.
    fn scene(&self, results: &LocalizationResults, stamp: u64) -> SceneUpdate {
        let line = |color: Rgb, poses: &[Pose3]| LinePrimitive {
            r#type: line_primitive::Type::LineStrip.into(),
            thickness: 3.0,
            scale_invariant: true,
            points: poses.iter().map(point).collect(),
            color: Some(opaque(color)),
            ..LinePrimitive::default()
        };
        let estimate = results.trajectory_in_space().unwrap_or(&self.estimates);
        let all = vec![true; results.len()];
        let lines = [
            ("truth", TRUTH, self.truth.as_ref(), all),
            ("estimate", MCL, Some(estimate), results.trusted()),
            (
                "refined",
                REFINED,
                self.refined.as_ref(),
                results.refined_trusted(),
            ),
        ];
        let entities = lines
            .into_iter()
            .filter_map(|(name, color, poses, trusted)| {
                let poses = poses?;
                let stretches = stretches(&trusted);
                Some(SceneEntity {
                    lines: stretches.map(|rows| line(color, &poses[rows])).collect(),
                    ..entity(name, stamp)
                })
            });
        SceneUpdate {
            entities: entities.collect(),
            ..SceneUpdate::default()
        }
    }
}

/// Channels by topic, made when they are first used.
struct LogWriter<W: Write + Seek> {
    writer: Writer<W>,
    channels: BTreeMap<&'static str, u16>,
    sequence: u32,
}

impl<W: Write + Seek> LogWriter<W> {
    fn new(writer: W) -> Result<Self> {
        let options = WriteOptions::new()
            .compression(None)
            .library(concat!("fpmcl ", env!("CARGO_PKG_VERSION")));
        Ok(Self {
            writer: options.create(writer)?,
            channels: BTreeMap::new(),
            sequence: 0,
        })
    }

    fn send<M: Encode>(&mut self, topic: &'static str, stamp: u64, message: &M) -> Result<()>
    where
        M::Error: Send + Sync + 'static,
    {
        let schema = M::get_schema().context("the message has no schema")?;
        let mut data = Vec::with_capacity(message.encoded_len().unwrap_or(0));
        message.encode(&mut data)?;
        self.write(topic, stamp, &schema, &M::get_message_encoding(), &data)
    }

    fn send_json(&mut self, topic: &'static str, stamp: u64, message: &Value) -> Result<()> {
        const SCHEMA: &str = include_str!("frame.schema.json");
        let schema = Schema::new("fpmcl.Frame", "jsonschema", SCHEMA.as_bytes());
        self.write(topic, stamp, &schema, "json", &serde_json::to_vec(message)?)
    }

    fn write(
        &mut self,
        topic: &'static str,
        stamp: u64,
        schema: &Schema,
        encoding: &str,
        data: &[u8],
    ) -> Result<()> {
        let channel_id = match self.channels.get(topic) {
            Some(&channel) => channel,
            None => {
                let writer = &mut self.writer;
                let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data)?;
                let channel = writer.add_channel(schema, topic, encoding, &BTreeMap::new())?;
                self.channels.insert(topic, channel);
                channel
            }
        };
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time: stamp,
            publish_time: stamp,
        };
        self.sequence += 1;
        Ok(self.writer.write_to_known_channel(&header, data)?)
    }
}

fn map_scene(mesh: &TriangleMesh, stamp: u64) -> Result<SceneUpdate> {
    let mut model = Model::default();
    model.add_mesh(MAP, mesh);
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

fn particles(particles: &[ParticleRow], height_m: f64, stamp: u64) -> PosesInFrame {
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
fn cloud(scan: &Scan, map_from_lidar: &Pose3, stamp: u64) -> PointCloud {
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

fn entity(name: &str, stamp: u64) -> SceneEntity {
    SceneEntity {
        timestamp: timestamp(stamp),
        frame_id: MAP.to_owned(),
        id: name.to_owned(),
        ..SceneEntity::default()
    }
}

fn pose(pose: &Pose3) -> Pose {
    let [x, y, z] = pose.translation.vector.into();
    let position = Some(Vector3 { x, y, z });
    let [x, y, z, w] = pose.rotation.coords.into();
    let orientation = Some(Quaternion { x, y, z, w });
    Pose {
        position,
        orientation,
    }
}

fn point(pose: &Pose3) -> Point3 {
    let [x, y, z] = pose.translation.vector.into();
    Point3 { x, y, z }
}

fn opaque(color: Rgb) -> Color {
    let [r, g, b] = color.map(|channel| f64::from(channel) / 255.0);
    Color { r, g, b, a: 1.0 }
}

fn timestamp(nanoseconds: u64) -> Option<Timestamp> {
    Some(Timestamp::new(
        (nanoseconds / 1_000_000_000) as u32,
        (nanoseconds % 1_000_000_000) as u32,
    ))
}
