"""A ROS 2 node that publishes the target's pose from `perchctl track --udp`.

It needs ROS 2 (Humble or later) with rclpy, geometry_msgs and tf2_ros, but not perchctl:

    python3 ros2_pose.py --ros-args -p host:=127.0.0.1 -p port:=9870

For each picture with an accepted pose, it publishes a PoseWithCovarianceStamped on ``target_pose``
and the transform to ``target``, both from the frame that `perchctl track --frame-id` names. The
stamp is the time of exposure; for a recording, it is the time at which the pose arrives.
"""

import json
import socket
import sys
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import TransformBroadcaster

TIMEOUT_S = 0.1  # without poses, the node serves its parameters and Ctrl-C at this interval


class TargetPose(Node):
    def __init__(self, receiver: socket.socket) -> None:
        super().__init__("perchctl_target")
        host = self.declare_parameter("host", "127.0.0.1").value
        port = self.declare_parameter("port", 9870).value
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "target_pose", 10)
        self._transforms = TransformBroadcaster(self)
        self._receiver, self._note = receiver, ""
        try:
            receiver.bind((host, port))
        except (OSError, OverflowError) as error:  # OverflowError: a port above 65535
            sys.exit(
                f"ros2_pose: cannot receive on {host}:{port}: {error}; choose another port with "
                "--ros-args -p port:=PORT here and --udp HOST:PORT in perchctl track"
            )
        receiver.settimeout(TIMEOUT_S)

    def receive(self) -> None:
        """Wait for a datagram, at most `TIMEOUT_S`, and publish it."""
        try:
            record = json.loads(self._receiver.recv(65535))
            pose, unix_s, note = record["pose"], record["unix_s"], str(record["note"])
            if pose is not None:
                self._publish(pose, unix_s)
        except TimeoutError:
            return
        except Exception:  # a foreign datagram may contain anything
            note = "ignoring datagrams that are not from perchctl track --udp"
        if note not in ("", self._note):
            self.get_logger().warning(note)
        self._note = note

    def _publish(self, pose: dict[str, Any], unix_s: float | None) -> None:
        now = self.get_clock().now()
        stamp = (now if unix_s is None else Time(nanoseconds=round(unix_s * 1e9))).to_msg()
        message, transform = PoseWithCovarianceStamped(), TransformStamped()
        for header in (message.header, transform.header):
            header.stamp, header.frame_id = stamp, pose["frame_id"]
        transform.child_frame_id = pose["child_frame_id"]
        for place in (message.pose.pose.position, transform.transform.translation):
            place.x, place.y, place.z = pose["position_m"]
        for rotation in (message.pose.pose.orientation, transform.transform.rotation):
            rotation.x, rotation.y, rotation.z, rotation.w = pose["quaternion_xyzw"]
        message.pose.covariance = pose["covariance"]
        self._poses.publish(message)
        self._transforms.sendTransform(transform)


def main() -> None:
    rclpy.init()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
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
