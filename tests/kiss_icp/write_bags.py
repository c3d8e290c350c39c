"""Four scans in a bag of ROS 1 and in two of ROS 2, as SQLite and MCAP, by the package rosbags: write_bags.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

TOPIC, TYPE = "/points", "sensor_msgs/msg/PointCloud2"
START_NS, PERIOD_NS = 1_600_000_000_000_000_000, 100_000_000
FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]
POINTS = np.dtype([("position", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4"), ("unused", "<u4")])


def cloud(store, scan, stamp_ns):
    """A sweep of 16 beams and 200 columns, clockwise."""
    types = store.types
    column, ring = np.divmod(np.arange(3200), 16)
    azimuth_rad = -2 * np.pi * column / 200
    range_m = 10.0 + 0.5 * scan + 0.1 * ring
    points = np.zeros(3200, POINTS)
    points["position"] = np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad), 0.2 * ring - 2.0], axis=1)
    points["ring"], points["time"] = ring, 0.1 * column / 200
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    numbered = {"seq": scan} if "seq" in types["std_msgs/msg/Header"].__annotations__ else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **numbered)
    field = types["sensor_msgs/msg/PointField"]
    return types[TYPE](
        header=header, height=1, width=len(points), is_bigendian=False, is_dense=True,
        fields=[field(name=name, offset=offset, datatype=datatype, count=1) for name, offset, datatype in FIELDS],
        point_step=POINTS.itemsize, row_step=points.nbytes, data=np.frombuffer(points.tobytes(), np.uint8),
    )


def write(writer, store, serialize):
    with writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for scan in range(4):
            stamp_ns = START_NS + PERIOD_NS * scan
            writer.write(connection, stamp_ns, serialize(cloud(store, scan, stamp_ns), TYPE))


folder = Path(sys.argv[1])
ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
write(Writer1(folder / "ros1.bag"), ros1, ros1.serialize_ros1)
for name, storage in [("sqlite", StoragePlugin.SQLITE3), ("mcap", StoragePlugin.MCAP)]:
    write(Writer2(folder / name, version=9, storage_plugin=storage), ros2, ros2.serialize_cdr)
