//! The path and the sensor of the mapping drive, and the frame of the map, stored with the map.
//!
//! In the PLY file they are comments, which all mesh readers skip: the sensor and the place on the Earth as JSON, in lines that belong
//! together, one for the frame, and one per pose, each a translation [m] and a unit quaternion with all digits, so that reading gives the
//! same bits. No line is as long as 1024 bytes, which RPly, the reader of Open3D and others, cannot read.
//!
//! ```text
//! comment fpmcl sensor           {"range_image":{"height":64, ...
//! comment fpmcl sensor           "has_rows":true, ...
//! comment fpmcl world_from_map   tx ty tz qx qy qz qw
//! comment fpmcl georeference     {"latitude_deg":49.011, ...
//! comment fpmcl map_from_lidar   tx ty tz qx qy qz qw
//! ```

use glam::DVec3;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use crate::geometry::{FARTHEST_M, Pose3};
use crate::georeference::Georeference;
use crate::sensor::Sensor;
use crate::validation::Validate as _;

const WORLD: &str = "fpmcl world_from_map";
const SENSOR: &str = "fpmcl sensor ";
const GEOREFERENCE: &str = "fpmcl georeference ";
const POSE: &str = "fpmcl map_from_lidar";

/// Poses of the scans that a map was built from, and the pose of the map in the world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MappingPath {
    /// `p_world = world_from_map * p_map`, where the world is the frame in which the poses of the
    /// mapping drive were given; the identity where they were given in the map frame.
    pub world_from_map: Pose3,
    /// Poses of the key scans, `p_map = map_from_lidar * p_lidar`; empty for a mesh from elsewhere.
    pub map_from_lidar: Vec<Pose3>,
    /// Sensor of these scans; `None` for a mesh from elsewhere.
    pub sensor: Option<Sensor>,
    /// Place of the map on the Earth, where it is known.
    pub georeference: Option<Georeference>,
}

/// A comment of a map that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the comment `{0}` is not a pose of 7 finite numbers on Earth; build the map again")]
pub struct BadPathComment(String);

impl MappingPath {
    /// Whether the triangles of the map have fronts: surfaces that are built of scans face the sensor.
    pub(crate) fn has_fronts(&self) -> bool {
        self.sensor.is_some()
    }

    /// Returns the comments of the PLY file.
    pub(crate) fn to_comments(&self) -> Vec<String> {
        let line = |key: &str, pose: &Pose3| {
            let (t, q) = (pose.translation, pose.rotation);
            let (x, y, z) = (t.x, t.y, t.z);
            format!("{key} {x} {y} {z} {} {} {} {}", q.i, q.j, q.k, q.w)
        };
        let sensor = self.sensor.iter().flat_map(serde_json::to_string);
        let georeference = self.georeference.iter().flat_map(serde_json::to_string);
        let poses = self.map_from_lidar.iter().map(|pose| line(POSE, pose));
        sensor
            .flat_map(|json| lines(SENSOR, &json))
            .chain(std::iter::once(line(WORLD, &self.world_from_map)))
            .chain(georeference.flat_map(|json| lines(GEOREFERENCE, &json)))
            .chain(poses)
            .collect()
    }

    /// The path of a map to which a newer drive is added.
    #[must_use]
    pub(crate) fn extended_by(&self, map_from_lidar: &[Pose3]) -> Self {
        let mut path = self.clone();
        path.map_from_lidar.extend(map_from_lidar);
        path
    }

    /// Frame of a mesh without a mapping drive that was moved by an origin [m]; `None` if it was not moved.
    pub(crate) fn at_origin(origin: DVec3) -> Option<Self> {
        (origin != DVec3::ZERO).then(|| Self {
            world_from_map: Pose3::translation(origin.x, origin.y, origin.z),
            ..Self::default()
        })
    }

    /// Reads the comments of a PLY file; `None` where they hold neither path nor frame.
    pub(crate) fn from_comments<'a>(
        comments: impl IntoIterator<Item = &'a str>,
    ) -> Result<Option<Self>, BadPathComment> {
        let mut path: Option<Self> = None;
        let [mut of_sensor, mut of_earth] = [String::new(), String::new()];
        for comment in comments {
            if let Some(numbers) = comment.strip_prefix(WORLD) {
                path.get_or_insert_default().world_from_map = pose(numbers, comment)?;
            } else if let Some(numbers) = comment.strip_prefix(POSE) {
                let path = path.get_or_insert_default();
                path.map_from_lidar.push(pose(numbers, comment)?);
            } else if let Some(json) = comment.strip_prefix(GEOREFERENCE) {
                of_earth.push_str(json);
            } else if let Some(json) = comment.strip_prefix(SENSOR) {
                of_sensor.push_str(json);
            }
        }
        if !of_earth.is_empty() {
            path.get_or_insert_default().georeference = georeference(&of_earth);
        }
        if !of_sensor.is_empty() {
            let sensor = serde_json::from_str(&of_sensor);
            let sensor = sensor.inspect_err(|error| {
                tracing::warn!("the sensor of the map is not read: {error}");
            });
            path.get_or_insert_default().sensor = sensor.ok();
        }
        Ok(path)
    }
}

/// Comments with the parts of a JSON text, which end after commas.
fn lines(key: &str, json: &str) -> Vec<String> {
    /// Length of a part, if its last item ends there [bytes].
    const PART: usize = 500;
    let mut parts: Vec<String> = Vec::new();
    for item in json.split_inclusive(',') {
        match parts.last_mut() {
            Some(part) if part.len() <= PART => part.push_str(item),
            _ => parts.push(format!("{key}{item}")),
        }
    }
    parts
}

/// The place of a map on the Earth; `None`, with a warning, where it cannot be read.
fn georeference(json: &str) -> Option<Georeference> {
    let read: Result<Georeference, _> = serde_json::from_str(json);
    let problem = match read {
        Ok(read) => match read.validate() {
            Ok(()) => return Some(read),
            Err(error) => error.to_string(),
        },
        Err(error) => error.to_string(),
    };
    tracing::warn!("the georeference of the map is not read: {problem}");
    None
}

fn pose(numbers: &str, comment: &str) -> Result<Pose3, BadPathComment> {
    let bad = || BadPathComment(comment.to_owned());
    let numbers: Vec<f64> = numbers
        .split_whitespace()
        .map(|number| {
            number
                .parse()
                .ok()
                .filter(|number: &f64| number.is_finite())
        })
        .collect::<Option<_>>()
        .ok_or_else(bad)?;
    let &[x, y, z, i, j, k, w] = numbers.as_slice() else {
        return Err(bad());
    };
    let quaternion = Quaternion::new(w, i, j, k);
    let is_on_earth = [x, y, z].iter().all(|m| m.abs() <= FARTHEST_M);
    if !is_on_earth || (quaternion.norm() - 1.0).abs() > 1e-6 {
        return Err(bad());
    }
    // The same bits again: the quaternion is not normalized.
    let rotation = UnitQuaternion::new_unchecked(quaternion);
    Ok(Pose3::from_parts(Translation3::new(x, y, z), rotation))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::georeference::{HeightReference, UtmZone};

    fn path() -> MappingPath {
        let pose = |i: i32| {
            let s = f64::from(i);
            Pose3::new(
                Vector3::new(s / 3.0, 1e6 * s, -s),
                Vector3::new(0.1 * s, 0.2, -s),
            )
        };
        MappingPath {
            world_from_map: pose(7),
            map_from_lidar: (0..5).map(pose).collect(),
            sensor: Some(Sensor::vlp16()),
            georeference: Some(georeferenced()),
        }
    }

    fn georeferenced() -> Georeference {
        Georeference {
            latitude_deg: 49.0 + 1.0 / 3.0,
            longitude_deg: -8.4,
            height_m: 110.1,
            height_above: HeightReference::MeanSeaLevel,
            roll_deg: 0.1,
            pitch_deg: -0.2,
            yaw_deg: 100.0 / 3.0,
            utm: UtmZone {
                number: 29,
                is_south: false,
            },
            horizontal_m: 0.3,
            vertical_m: 0.7,
            heading_deg: 0.05,
        }
    }

    #[test]
    fn a_georeference_that_is_not_on_the_earth_is_left_out() {
        let json = |georeference: &Georeference| {
            let json = serde_json::to_string(georeference).unwrap();
            let line = format!("{GEOREFERENCE}{json}");
            MappingPath::from_comments([line.as_str()])
                .unwrap()
                .unwrap()
                .georeference
        };
        assert_eq!(json(&georeferenced()), Some(georeferenced()));
        let beyond_the_pole = Georeference {
            latitude_deg: 91.0,
            ..georeferenced()
        };
        assert_eq!(json(&beyond_the_pole), None);
        let mut zone = georeferenced();
        zone.utm.number = 61;
        assert_eq!(json(&zone), None);
    }

    #[test]
    fn reading_what_was_written_gives_the_same_bits() {
        let comments = path().to_comments();
        let others = ["made by hand", "fpmcl"];
        let lines = comments.iter().map(String::as_str).chain(others);
        assert_eq!(MappingPath::from_comments(lines).unwrap(), Some(path()));
    }

    #[test]
    fn no_comment_is_too_long_for_other_readers_and_parts_belong_together() {
        let mut path = path();
        let sensor = path.sensor.as_mut().unwrap();
        let elevations = (0..128).map(|beam| 1.0 / (beam as f32 + 0.3));
        sensor.range_image.height = 128;
        sensor.range_image.elevations = Some(elevations.collect());
        let comments = path.to_comments();
        assert!(comments.iter().all(|it| it.len() < 1000), "{comments:?}");
        let parts = comments.iter().filter(|it| it.starts_with(SENSOR));
        assert!(parts.count() > 2);
        let lines = comments.iter().map(String::as_str);
        assert_eq!(
            MappingPath::from_comments(lines).unwrap().as_ref(),
            Some(&path)
        );
        // One line, as it was before.
        let joined = serde_json::to_string(&path.sensor).unwrap();
        let line = format!("{SENSOR}{joined}");
        let read = MappingPath::from_comments([line.as_str()]).unwrap();
        assert_eq!(read.unwrap().sensor, path.sensor);
    }

    #[test]
    fn a_file_without_poses_has_no_path() {
        assert_eq!(MappingPath::from_comments(["a comment"]), Ok(None));
    }

    #[test]
    fn a_damaged_comment_is_an_error_that_quotes_it() {
        for numbers in [
            "1 2 3",
            "1 2 3 0 0 0 x",
            "1 2 3 0 0 0 nan",
            "1 2 3 0 0 0 2",
            "1e9 2 3 0 0 0 1",
        ] {
            let line = format!("{POSE} {numbers}");
            let error = MappingPath::from_comments([line.as_str()]).unwrap_err();
            assert!(error.to_string().contains(&line), "{error}");
        }
    }
}
