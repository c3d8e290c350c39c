"""A node of ROS 2 that localizes clouds in a map: python ros2_node.py MAP.ply [--ros-args -r points:=/velodyne_points].

It needs rclpy of ROS 2 and its messages. `fpmcl live --ros2` does the same and more without ROS; this is a start for a node of
one's own: subscribe, step, publish.
"""

import sys

import fpmcl
import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from sensor_msgs_py.point_cloud2 import read_points
from tf2_ros import TransformBroadcaster


class Localization(Node):
    """Publishes the pose of each cloud, and the transform from the map to it while it is tracked."""

    def __init__(self, map_file):
        super().__init__("fpmcl_localization")
        self.localizer = fpmcl.Localizer(fpmcl.Map.load(map_file, cache=True))
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.transforms = TransformBroadcaster(self)
        self.create_subscription(PointCloud2, "points", self.localize, qos_profile_sensor_data)

    def localize(self, cloud):
        points = read_points(cloud, field_names=["x", "y", "z"], skip_nans=True)
        points = np.stack([points[axis] for axis in ["x", "y", "z"]], axis=1).astype(np.float32)
        stamp = cloud.header.stamp
        try:
            estimate = self.localizer.step(points, time=stamp.sec + 1e-9 * stamp.nanosec)
        except fpmcl.Error as error:
            self.get_logger().warning(f"a cloud is left out: {error}")
            return
        if estimate.state != "tracking":
            self.get_logger().info(f"{estimate.state}: {estimate.places} places", throttle_duration_sec=1.0)
            return
        transform = TransformStamped()
        transform.header.stamp, transform.header.frame_id = stamp, "map"
        transform.child_frame_id = cloud.header.frame_id
        position = estimate.map_from_lidar[:3, 3]
        (transform.transform.translation.x, transform.transform.translation.y, transform.transform.translation.z) = position
        rotation = transform.transform.rotation
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion(estimate.map_from_lidar[:3, :3])
        self.transforms.sendTransform(transform)

        message = PoseWithCovarianceStamped(header=transform.header)
        message.pose.pose.orientation = rotation
        (message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z) = position
        # Rows and columns of x, y and heading.
        covariance = np.zeros((6, 6))
        covariance[np.ix_([0, 1, 5], [0, 1, 5])] = estimate.covariance
        message.pose.covariance = covariance.ravel().tolist()
        self.poses.publish(message)


def quaternion(rotation):
    """x, y, z, w of a rotation."""
    w = 0.5 * np.sqrt(max(0.0, 1.0 + np.trace(rotation)))
    if w < 1e-6:
        # Half a turn: the axis is the column that the rotation leaves largest.
        axis = (rotation + np.eye(3))[:, np.argmax(np.diag(rotation))]
        return *(axis / np.linalg.norm(axis)), 0.0
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return *(axis / (4.0 * w)), w


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Localization(sys.argv[1]))
