"""The parts of ROS 2 that a node of `examples/` uses, without ROS: each message has the fields of
geometry_msgs, and refuses other names and types, as rclpy's messages do."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

NOW_NS = 1_700_000_000_250_000_000
"""What the node's clock says."""


class Message:
    """A message; what a field is first set to is what it takes."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __setattr__(self, name: str, value: Any) -> None:
        held = self.__dict__[name]
        assert type(value) is type(held), (name, value)
        if isinstance(held, list):
            assert len(value) == len(held)
            assert {type(part) for part in value} == {float}
        self.__dict__[name] = value


def _vector() -> Message:
    return Message(x=0.0, y=0.0, z=0.0)


def _quaternion() -> Message:
    return Message(x=0.0, y=0.0, z=0.0, w=1.0)


def _stamp(nanoseconds: int = 0) -> Message:
    sec, nanosec = divmod(nanoseconds, 10**9)
    return Message(sec=sec, nanosec=nanosec)


def _header() -> Message:
    return Message(stamp=_stamp(), frame_id="")


def _pose() -> Message:
    pose = Message(position=_vector(), orientation=_quaternion())
    return Message(header=_header(), pose=Message(pose=pose, covariance=[0.0] * 36))


def _transform() -> Message:
    moved = Message(translation=_vector(), rotation=_quaternion())
    return Message(header=_header(), child_frame_id="", transform=moved)


class Ros2:
    """What a node published and logged.

    Attributes:
        parameters: of the command line.
        steps: what happens before each pass of the node's loop; then ROS ends, or with `error` it
            is raised.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> None:
        self.parameters = parameters
        self.steps: list[Callable[[], Any]] = []
        self.error: BaseException | None = None
        self.topics: dict[str, list[Message]] = {}
        self.transforms: list[Message] = []
        self.warnings: list[str] = []
        self.is_running = False
        ros = self

        class Node:
            def __init__(self, name: str) -> None:
                assert ros.is_running

            def declare_parameter(self, name: str, default: Any) -> Any:
                return SimpleNamespace(value=ros.parameters.get(name, default))

            def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
                assert kind is _pose
                published = ros.topics.setdefault(topic, [])
                return SimpleNamespace(publish=published.append)

            def get_clock(self) -> Any:
                return SimpleNamespace(now=lambda: Time(nanoseconds=NOW_NS))

            def get_logger(self) -> Any:
                return SimpleNamespace(warning=ros.warnings.append)

        class Time:
            def __init__(self, *, nanoseconds: int) -> None:
                self.to_msg = lambda: _stamp(nanoseconds)

        modules: dict[str, dict[str, Any]] = {
            "rclpy": {
                "init": lambda: setattr(ros, "is_running", True),
                "ok": self._is_ok,
                "spin_once": lambda node, timeout_sec: None,
                "try_shutdown": lambda: setattr(ros, "is_running", False),
            },
            "rclpy.executors": {"ExternalShutdownException": type("Shutdown", (Exception,), {})},
            "rclpy.node": {"Node": Node},
            "rclpy.time": {"Time": Time},
            "geometry_msgs": {},
            "geometry_msgs.msg": {
                "PoseWithCovarianceStamped": _pose,
                "TransformStamped": _transform,
            },
            "tf2_ros": {
                "TransformBroadcaster": lambda node: SimpleNamespace(
                    sendTransform=self.transforms.append
                )
            },
        }
        for name, members in modules.items():
            module = ModuleType(name)
            vars(module).update(members)
            monkeypatch.setitem(sys.modules, name, module)

    def _is_ok(self) -> bool:
        if self.steps:
            self.steps.pop(0)()
            return True
        if self.error is not None:
            raise self.error
        return False
