//! Small bags of scans, odometry and transforms.

use arbtest::arbitrary::{Result, Unstructured};

use super::files::{number, rarely};
use crate::bag_writers::{
    Cloud, Kind, Recorded, db3, livox, mcap, mcap_compressed, odometry, point_cloud2, ros1,
    transforms,
};

/// Data types of fields with their sizes.
const TYPES: &[(u8, usize)] = &[(7, 4), (8, 8), (2, 1), (4, 2), (6, 4), (0, 4)];

const NAMES: &[&str] = &["intensity", "ring", "time", "t", "timestamp", "X", ""];

/// An `.mcap` with an index or without, with or without compressed chunks.
pub fn mcap_file(u: &mut Unstructured) -> Result<Vec<u8>> {
    let kind = kind(u)?;
    let encoding = if kind == Kind::Ros1 { "ros1" } else { "cdr" };
    let options = mcap::WriteOptions::new().compression(None);
    let options = options.chunk_size(Some(300)).use_chunks(u.arbitrary()?);
    let file = mcap(options, encoding, &recording(u, kind)?);
    Ok(match *u.choose(&["", "", "zstd", "lz4"])? {
        "" => file,
        compression => mcap_compressed(&file, compression),
    })
}

/// A `.bag` with chunks in any compression.
pub fn ros1_file(u: &mut Unstructured) -> Result<Vec<u8>> {
    let compression = *u.choose(&["none", "lz4", "bz2"])?;
    Ok(ros1(compression, &recording(u, Kind::Ros1)?))
}

/// A `.db3`.
pub fn database(u: &mut Unstructured) -> Result<Vec<u8>> {
    let kind = *u.choose(&[Kind::CdrLittle, Kind::CdrBig])?;
    let messages = recording(u, kind)?;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.db3");
    db3(&path, &messages);
    Ok(std::fs::read(path).unwrap())
}

/// A message of ROS 2.
#[cfg(feature = "ros2")]
pub fn message(u: &mut Unstructured) -> Result<Vec<u8>> {
    let kind = *u.choose(&[Kind::CdrLittle, Kind::CdrBig])?;
    if u.ratio(1, 4)? {
        let variances = [u.arbitrary()?, u.arbitrary()?, u.arbitrary()?];
        return Ok(crate::bag_writers::proposal(
            kind,
            1 << 29,
            "map",
            &pose(u)?,
            variances,
        ));
    }
    Ok(recording(u, kind)?.swap_remove(0).data)
}

fn kind(u: &mut Unstructured) -> Result<Kind> {
    Ok(*u.choose(&[Kind::CdrLittle, Kind::CdrBig, Kind::Ros1])?)
}

fn recording(u: &mut Unstructured, kind: Kind) -> Result<Vec<Recorded>> {
    let mut messages = Vec::new();
    for _ in 0..u.int_in_range(1..=5)? {
        let time_ns = u64::from(u.arbitrary::<u32>()?) << 29;
        let (topic, message_type, data) = match u.arbitrary::<u8>()? % 4 {
            0 | 1 => (
                "/points",
                "sensor_msgs/msg/PointCloud2",
                point_cloud2(kind, time_ns, "lidar", &cloud(u)?),
            ),
            2 if u.arbitrary()? => {
                let times: Vec<u32> = (0..6).map(|i| i * 20_000_000).collect();
                let points = times
                    .iter()
                    .map(|&time_ns| (time_ns, [1.0, 2.0, 3.0], 4, 5));
                (
                    "/livox",
                    "livox_ros_driver2/msg/CustomMsg",
                    livox(kind, time_ns, &points.collect::<Vec<_>>()),
                )
            }
            2 => (
                "/tf_static",
                "tf2_msgs/msg/TFMessage",
                transforms(kind, &[("a", "b", pose(u)?), ("b", "lidar", pose(u)?)]),
            ),
            _ => (
                "/odom",
                "nav_msgs/msg/Odometry",
                odometry(kind, time_ns, "odom", "a", &pose(u)?),
            ),
        };
        messages.push(Recorded {
            topic,
            message_type,
            time_ns,
            data,
        });
    }
    Ok(messages)
}

fn pose(u: &mut Unstructured) -> Result<[f64; 7]> {
    let quaternion = if rarely(u, 8)? {
        [0.0; 4]
    } else {
        [0.6, 0.0, 0.0, 0.8]
    };
    let [i, j, k, w] = quaternion;
    Ok([number(u)?, number(u)?, number(u)?, i, j, k, w])
}

/// Up to 8 points with coordinates and any other fields.
fn cloud(u: &mut Unstructured) -> Result<Cloud> {
    let mut names = vec!["x", "y", "z"];
    for _ in 0..u.int_in_range(0..=3)? {
        names.push(u.choose(NAMES)?);
    }
    let mut fields = Vec::new();
    let mut step = 0;
    for name in names {
        let (datatype, size) = if rarely(u, 32)? {
            *u.choose(TYPES)?
        } else {
            TYPES[0]
        };
        fields.push((name, step as u32, datatype));
        step += size;
    }
    let width = u.int_in_range(0..=8)?;
    let mut data = Vec::new();
    for _ in 0..width {
        let start = data.len();
        for _ in 0..step / 4 {
            data.extend((number(u)? as f32).to_le_bytes());
        }
        data.resize(start + step, 0);
    }
    Ok(Cloud {
        fields,
        width,
        height: 1,
        point_step: step as u32,
        row_step: width * step as u32,
        is_big_endian: rarely(u, 64)?,
        data,
    })
}
