"""A ROS 2 node: rectified stereo images in; disparity, depth and a point cloud out.

Run, after sourcing ROS 2 (with stereo_msgs and message_filters):
    python3 examples/ros2/stereoweave_node.py --ros-args -r __ns:=/stereo -p min_confidence:=0.7

Subscribes to left/image_rect_color, right/image_rect_color, left/camera_info, right/camera_info.
Publishes disparity (stereo_msgs/DisparityImage), depth (sensor_msgs/Image, 32FC1, metres, REP 118) and
points2 (sensor_msgs/PointCloud2), all in the left camera's optical frame, with its time stamp.
"""

import message_filters
import rclpy
from conversions import camera_of, depth_of, fill_cloud, fill_disparity, fill_image, known_of, rgb_of
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from stereo_msgs.msg import DisparityImage

from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.options import MatchOptions
from stereoweave.stereo import StereoPair


class StereoweaveNode(Node):
    """Match each pair that arrives while no other pair is being matched."""

    def __init__(self) -> None:
        super().__init__("stereoweave")
        self._matcher = Matcher(self.declare_parameter("model", "small").value)
        self._least_confidence = self.declare_parameter("min_confidence", 0.5).value
        self._range_px = (
            self.declare_parameter("min_disparity", 0.0).value,
            self.declare_parameter("max_disparity", 192.0).value,
        )
        self._disparity = self.create_publisher(DisparityImage, "disparity", 1)
        self._depth = self.create_publisher(Image, "depth", 1)
        self._points = self.create_publisher(PointCloud2, "points2", 1)
        topics = {
            "left/image_rect_color": Image,
            "right/image_rect_color": Image,
            "left/camera_info": CameraInfo,
            "right/camera_info": CameraInfo,
        }
        subscribers = [
            message_filters.Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
            for topic, kind in topics.items()
        ]
        # A queue of 2, so that pairs that arrive during a match are dropped and not queued up.
        self._together = message_filters.ApproximateTimeSynchronizer(subscribers, queue_size=2, slop=0.01)
        self._together.registerCallback(self._publish)

    def _publish(self, left: Image, right: Image, left_info: CameraInfo, right_info: CameraInfo) -> None:
        try:
            camera = camera_of(left_info, right_info)
            pair = StereoPair(left=rgb_of(left), right=rgb_of(right))
            estimate = match(self._matcher, pair, MatchOptions(range_px=self._range_px))
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        known = known_of(estimate, self._least_confidence)
        depth_m = depth_of(estimate, camera, known)
        disparity, depth, points = DisparityImage(), Image(), PointCloud2()
        fill_disparity(disparity, left.header, estimate, camera, known, self._range_px)
        fill_image(depth, left.header, depth_m)
        fill_cloud(points, PointField, left.header, pair.left, depth_m, camera)
        self._disparity.publish(disparity)
        self._depth.publish(depth)
        self._points.publish(points)


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = StereoweaveNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
