"""The examples run, and find the car."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import fpmcl
import numpy as np
import pytest

EXAMPLE = Path(__file__).parent.parent / "examples/scene.py"
DATA = Path(os.environ.get("FPMCL_DATA", Path(__file__).parents[3] / "shared/data"))


def run(*arguments):
    command = [sys.executable, EXAMPLE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_without_data_the_example_says_so(tmp_path):
    assert run(tmp_path / "none") == f"skipped: {tmp_path / 'none'} does not exist\n"


class Message:
    """A message of ROS: its fields are made when they are used."""

    def __init__(self, **fields):
        vars(self).update(fields)

    def __getattr__(self, name):
        return vars(self).setdefault(name, Message())


class Node:
    """What the example uses of `rclpy.node.Node`; keeps what is published."""

    def __init__(self, _name):
        self.published = []

    def declare_parameter(self, _name, value):
        return Message(value=value)

    def create_publisher(self, *_):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, *_):
        pass


def test_the_node_of_ros_2_publishes_where_the_robot_is(folder, monkeypatch):
    pytest.importorskip("scipy")
    mounting = Message(x=1.0, y=0.0, z=1.7)
    identity = Message(x=0.0, y=0.0, z=0.0, w=1.0)
    known = Message(transform=Message(translation=mounting, rotation=identity))
    transforms = []
    modules = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.time": {"Time": Message},
        **{package: {} for package in ("geometry_msgs", "sensor_msgs", "sensor_msgs_py")},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": Message, "TransformStamped": Message},
        "sensor_msgs.msg": {"PointCloud2": Message},
        "sensor_msgs_py.point_cloud2": {"read_points": lambda cloud, **_: cloud.points},
        "tf2_ros": {
            "Buffer": lambda: SimpleNamespace(lookup_transform=lambda *_: known),
            "TransformBroadcaster": lambda _: SimpleNamespace(sendTransform=transforms.append),
            "TransformException": LookupError,
            "TransformListener": lambda *_: None,
        },
    }
    for name, members in modules.items():
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        vars(sys.modules[name]).update(members)
    sys.modules["rclpy"].time = sys.modules["rclpy.time"]
    node = runpy.run_path(str(EXAMPLE.with_name("ros2_node.py")))["Localization"](str(folder / "map.ply"))
    for frame, scan in enumerate(sorted((folder / "drive_1/velodyne").iterdir())):
        rows = np.fromfile(scan, np.float32).reshape(-1, 4)
        points = np.zeros(len(rows), [(axis, np.float32) for axis in "xyz"])
        for axis, column in zip("xyz", rows.T):
            points[axis] = column
        stamp = SimpleNamespace(sec=1, nanosec=frame * 100_000_000)
        header = SimpleNamespace(stamp=stamp, frame_id="lidar")
        node.localize(SimpleNamespace(header=header, points=points))
    assert len(node.published) == len(transforms) >= 6
    truth = fpmcl.Map.load(str(folder / "map.ply")).path
    message, transform = node.published[-1], transforms[-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
    position = message.pose.pose.position
    # The map has the poses of the lidar, 1 m ahead of the base.
    map_from_base = truth[-1] @ np.array([-1.0, 0.0, -1.7, 1.0])
    assert np.abs(map_from_base[:3] - [position.x, position.y, position.z]).max() < 0.1
    assert len(message.pose.covariance) == 36 and message.pose.covariance[0] > 0.0


def test_the_scene_is_localized_to_centimetres(tmp_path):
    pytest.importorskip("matplotlib")
    folder = DATA / "nuscenes-hdl32"
    if not folder.is_dir():
        pytest.skip(f"{folder} does not exist")
    text = run(folder, tmp_path / "scene.png")
    rows = re.findall(r"(\w+): (\d+) of 16 scans, RMSE ([\d.]+) cm", text)
    assert [row[0] for row in rows] == ["localized", "refined"]
    for _name, found, rmse_cm in rows:
        assert int(found) >= 14 and float(rmse_cm) < 4.0, text
    assert (tmp_path / "scene.png").stat().st_size > 10_000
