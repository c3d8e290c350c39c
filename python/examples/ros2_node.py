"""A node of ROS 2 that localizes clouds in a map: python ros2_node.py MAP.ply [--ros-args -r points:=/velodyne_points].

A start for a node of one's own, with rclpy, tf2_ros and SciPy; `fpmcl live --ros2` does the same and more without ROS. The robot is the
parameter `base_frame`. Where somebody publishes it in `odom`, publish `odom` in `map` instead: map_from_base @ inv(odom_from_base).
"""

import sys

import fpmcl
import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from sensor_msgs_py.point_cloud2 import read_points
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener


class Localization(Node):
    """Publishes the pose of the robot at each cloud, and the transform from the map to it, while it is tracked."""

    def __init__(self, map_file):
        super().__init__("fpmcl_localization")
        self.base_frame = self.declare_parameter("base_frame", "base_link").value
        self.localizer = fpmcl.Localizer(fpmcl.Map.load(map_file, cache=True), real_time=True)
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.transforms, self.known = TransformBroadcaster(self), Buffer()
        self.listener = TransformListener(self.known, self)
        self.create_subscription(PointCloud2, "points", self.localize, qos_profile_sensor_data)

    def localize(self, cloud):
        points = read_points(cloud, field_names=["x", "y", "z"], skip_nans=True)
        points = np.stack([points[axis] for axis in ["x", "y", "z"]], axis=1).astype(np.float32)
        stamp = cloud.header.stamp
        try:
            estimate = self.localizer.step(points, time=stamp.sec + 1e-9 * stamp.nanosec)
            mounting = self.known.lookup_transform(self.base_frame, cloud.header.frame_id, rclpy.time.Time()).transform
        except (fpmcl.Error, TransformException) as error:
            self.get_logger().warning(f"a cloud has no pose: {error}", throttle_duration_sec=1.0)
            return
        if estimate.state != "tracking":
            self.get_logger().info(f"{estimate.state}: {estimate.places} places", throttle_duration_sec=1.0)
            return
        map_from_base = estimate.map_from_lidar @ np.linalg.inv(matrix(mounting))
        transform = TransformStamped(child_frame_id=self.base_frame)
        transform.header.stamp, transform.header.frame_id = stamp, "map"
        t, q = transform.transform.translation, transform.transform.rotation
        t.x, t.y, t.z = map_from_base[:3, 3].tolist()
        q.x, q.y, q.z, q.w = Rotation.from_matrix(map_from_base[:3, :3]).as_quat().tolist()
        self.transforms.sendTransform(transform)
        message = PoseWithCovarianceStamped(header=transform.header)
        position, message.pose.pose.orientation = message.pose.pose.position, q
        position.x, position.y, position.z = t.x, t.y, t.z
        covariance = -np.eye(6)  # Of the lidar: x, y, heading; -1 is not known.
        covariance[np.ix_([0, 1, 5], [0, 1, 5])] = estimate.covariance
        message.pose.covariance = covariance.ravel().tolist()
        self.poses.publish(message)


def matrix(transform):
    """A transform as a matrix, (4, 4)."""
    t, q = transform.translation, transform.rotation
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    return np.vstack([np.column_stack([rotation, [t.x, t.y, t.z]]), [0, 0, 0, 1]])


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Localization(sys.argv[1]))
