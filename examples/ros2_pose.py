"""A ROS 2 node that publishes the target's pose from `perchctl track --udp`.

It needs ROS 2 (Humble or later) with rclpy, geometry_msgs and tf2_ros, but not perchctl:

    python3 ros2_pose.py --ros-args -p host:=127.0.0.1 -p port:=9870

For each picture with an accepted pose, it publishes a PoseWithCovarianceStamped on ``target_pose``
and the transform to ``target``, both from the frame that `perchctl track --frame-id` names. The
stamp is the time of exposure; for a recording, it is the time at which the pose arrives.
"""

import json
import socket
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import TransformBroadcaster


class TargetPose(Node):
    def __init__(self, receiver: socket.socket) -> None:
        super().__init__("perchctl_target")
        host = self.declare_parameter("host", "127.0.0.1").value
        port = self.declare_parameter("port", 9870).value
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "target_pose", 10)
        self._transforms = TransformBroadcaster(self)
        self._receiver, self._note = receiver, ""
        receiver.bind((host, port))
        receiver.settimeout(0.1)  # s; without poses, the node serves Ctrl-C at this interval

    def receive(self) -> None:
        """Wait for a datagram for a short time, and publish its pose."""
        try:
            record = json.loads(self._receiver.recv(65535))
            pose, unix_s, note = record["pose"], record["unix_s"], str(record["note"])
            messages = None if pose is None else self._messages(pose, unix_s)
        except TimeoutError:
            return
        except Exception:  # a foreign datagram may contain anything
            messages, note = None, "ignoring datagrams that are not from perchctl track --udp"
        if note not in ("", self._note):
            self.get_logger().warning(note)
        self._note = note
        if messages is not None:
            self._poses.publish(messages[0])
            self._transforms.sendTransform(messages[1])

    def _messages(self, pose: dict[str, Any], unix_s: float | None) -> tuple[Any, Any]:
        time = self.get_clock().now() if unix_s is None else Time(nanoseconds=round(unix_s * 1e9))
        message, transform = PoseWithCovarianceStamped(), TransformStamped()
        message.header.stamp, message.header.frame_id = time.to_msg(), pose["frame_id"]
        transform.header, transform.child_frame_id = message.header, pose["child_frame_id"]
        for place in (message.pose.pose.position, transform.transform.translation):
            place.x, place.y, place.z = pose["position_m"]
        for rotation in (message.pose.pose.orientation, transform.transform.rotation):
            rotation.x, rotation.y, rotation.z, rotation.w = pose["quaternion_xyzw"]
        message.pose.covariance = pose["covariance"]
        return message, transform


def main() -> None:
    rclpy.init()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        try:
            node = TargetPose(receiver)
            while rclpy.ok():
                node.receive()
                rclpy.spin_once(node, timeout_sec=0.0)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()
