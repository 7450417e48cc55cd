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

try:
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from rclpy import executors, node, time
    from tf2_ros import TransformBroadcaster
except ModuleNotFoundError as error:
    raise SystemExit(f"no {error.name}: source the setup.bash of ROS 2 first") from None


class TargetPose(node.Node):
    def __init__(self, receiver: socket.socket) -> None:
        super().__init__("perchctl_target")
        self._poses = self.create_publisher(PoseWithCovarianceStamped, "target_pose", 10)
        self._transforms = TransformBroadcaster(self)
        self._receiver, self._note = receiver, ""
        address = ("host", "127.0.0.1"), ("port", 9870)
        receiver.bind(tuple(self.declare_parameter(*default).value for default in address))
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
        t = self.get_clock().now() if unix_s is None else time.Time(nanoseconds=round(unix_s * 1e9))
        message, transform = PoseWithCovarianceStamped(), TransformStamped()
        message.header.stamp, message.header.frame_id = t.to_msg(), pose["frame_id"]
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
            publisher = TargetPose(receiver)
            while rclpy.ok():
                publisher.receive()
                rclpy.spin_once(publisher, timeout_sec=0.0)
        except (KeyboardInterrupt, executors.ExternalShutdownException):
            pass
        finally:
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()
