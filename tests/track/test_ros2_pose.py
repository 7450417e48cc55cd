"""The ROS 2 node of the examples: its messages hold to ROS's definitions, and how it ends."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perchctl.commands.track import TrackResult, track_record
from perchctl.geometry import R_MARKER_TARGET, Array
from perchctl.profile import load_profile
from perchctl.sighting import Tracker
from perchctl.vision import Frame
from tests.helpers.flights import ROOT
from tests.helpers.recording import VIEWS, picture
from tests.helpers.ros2 import NOW_NS, Message, Ros2
from tests.helpers.target_picture import CAMERA, pose_of, render

PRINT_SIGMA = 0.02
"""Of the print's scale, so large that it shows in each covariance."""
PROFILE = load_profile("sim").with_({"target.size_sigma": PRINT_SIGMA, "target.curl_per_m": 0.0})


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "examples"))
        yield patch


@pytest.fixture(scope="module")
def port() -> int:
    """A free one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.fixture(scope="module")
def node(patch: pytest.MonkeyPatch, port: int) -> tuple[Ros2, ModuleType]:
    """ROS without ROS, and the node's module in it."""
    ros = Ros2(patch, port=port)
    module = import_module("ros2_pose")
    patch.delitem(sys.modules, "ros2_pose")
    return ros, module


def test_without_ros_it_is_one_sentence() -> None:
    blocked = "import sys; sys.modules['rclpy'] = None; import ros2_pose"
    done = subprocess.run(
        [sys.executable, "-c", blocked], cwd=ROOT / "examples", capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.startswith("no rclpy: source the setup.bash of ROS 2 first")
    assert len(done.stderr.splitlines()) == 1


def published(
    node: tuple[Ros2, ModuleType], port: int, *records: dict[str, Any] | bytes
) -> tuple[list[Message], list[Message]]:
    """The poses and transforms for these datagrams, one for each turn of the node's loop."""
    ros, module = node
    ros.topics.clear(), ros.transforms.clear(), ros.warnings.clear()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for record in records:
            data = record if isinstance(record, bytes) else json.dumps(record).encode()
            ros.steps.append(lambda data=data: sender.sendto(data, ("127.0.0.1", port)))
        module.main()
    assert not ros.is_running
    return ros.topics["target_pose"], ros.transforms


def values(message: Message) -> list[float]:
    """Of a vector or quaternion, in ROS's order."""
    return list(vars(message).values())


# --- The laws of a message -----------------------------------------------------------------


def spread_of(rvec: Array, tvec: Array, cov: Array, R_base_cam: Array) -> Array:
    """The covariance (6, 6) that ROS defines, by small changes: shifts, and turns about the fixed
    axes of the frame in which the pose is."""
    h = 1e-4
    R, columns = Rotation.from_rotvec(rvec), []
    for part in np.linalg.cholesky(cov).T:
        turned = Rotation.from_rotvec(rvec + h * part[:3])
        turn = (turned * R.inv()).as_rotvec()
        columns.append(np.concatenate([R_base_cam @ part[3:], R_base_cam @ turn / h]))
    columns.append(np.concatenate([PRINT_SIGMA * R_base_cam @ tvec, np.zeros(3)]))
    return np.sum([np.outer(each, each) for each in columns], axis=0)


ANGLES = st.tuples(st.floats(-math.pi, math.pi), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
PLACES = st.tuples(st.floats(-0.15, 0.15), st.floats(-0.1, 0.1), st.floats(0.4, 0.9))


@settings(max_examples=20)  # each renders a picture
@given(angles=ANGLES, place_m=PLACES, seed=st.integers(0, 99))
def test_a_message_has_ros_s_order_axes_and_covariance(
    angles: tuple[float, float, float],
    place_m: tuple[float, float, float],
    seed: int,
    node: tuple[Ros2, ModuleType],
    port: int,
) -> None:
    rvec, tvec = pose_of(*place_m, *angles)
    tracker = Tracker(PROFILE, CAMERA, live=False, stills=True)
    image = render(rvec, tvec, noise=2.0, seed=seed)
    [(frame, output, notes)] = tracker.process(Frame(0, 0.0, image))
    assert output is not None
    seen = tracker.make_sighting(frame, output, notes)
    record = track_record(TrackResult(0, frame, output, None, notes, seen), "cam_1", 1.5e9 + 0.125)
    (message,), (transform,) = published(node, port, record)

    solved, R_true = output.poses["joint"], np.asarray(cv2.Rodrigues(rvec)[0]) @ R_MARKER_TARGET
    assert solved.rvec_tvec_cov is not None
    position_m = np.array(values(message.pose.pose.position))
    R = Rotation.from_quat(values(message.pose.pose.orientation))  # scalar last, as in ROS
    assert np.linalg.norm(position_m - tvec) < 0.02 * np.linalg.norm(tvec)
    assert (R * Rotation.from_matrix(R_true).inv()).magnitude() < math.radians(3.0)
    assert position_m == pytest.approx(solved.tvec_m, abs=1e-12)

    covariance = np.reshape(message.pose.covariance, (6, 6))
    for about_x in (0.0, 1.1):  # in the camera's frame, and as tf2 turns it into another one
        Q = Rotation.from_euler("xyz", [about_x, 0.4 * about_x, -2.0 * about_x]).as_matrix()
        both = np.kron(np.eye(2), Q)
        expected = spread_of(solved.rvec_rad, solved.tvec_m, solved.rvec_tvec_cov, Q)
        sigmas = np.sqrt(expected.diagonal())
        off = (both @ covariance @ both.T - expected) / np.outer(sigmas, sigmas)
        assert np.abs(off).max() < 1e-3

    for header in (message.header, transform.header):
        assert (header.frame_id, header.stamp.sec) == ("cam_1", 1_500_000_000)
        assert header.stamp.nanosec == pytest.approx(125_000_000, abs=1000)  # a float's digits
    assert transform.child_frame_id == "target"
    assert values(transform.transform.translation) == values(message.pose.pose.position)
    assert values(transform.transform.rotation) == values(message.pose.pose.orientation)


# --- The node ------------------------------------------------------------------------------


def record_of(note: str = "", **changes: Any) -> dict[str, Any]:
    image = picture(VIEWS["both"])
    tracker = Tracker(PROFILE, CAMERA, live=False, stills=True)
    [(frame, output, notes)] = tracker.process(Frame(0, 0.0, image))
    seen = tracker.make_sighting(frame, output, notes)
    record = track_record(TrackResult(0, frame, output, None, [note], seen), "cam")
    return {**record, **changes}


def test_the_node_warns_once_of_a_note_and_stamps_recordings_itself(
    node: tuple[Ros2, ModuleType], port: int
) -> None:
    records = [record_of("snow", pose=None), record_of("snow"), record_of(), record_of("snow")]
    poses, transforms = published(node, port, *records)
    assert node[0].warnings == ["snow", "snow"]
    assert (len(poses), len(transforms)) == (3, 3)
    assert values(poses[0].header.stamp) == [NOW_NS // 10**9, NOW_NS % 10**9]


def test_the_node_ends_with_ros_or_by_ctrl_c_and_waits_for_poses(
    node: tuple[Ros2, ModuleType], port: int, patch: pytest.MonkeyPatch
) -> None:
    ros, module = node
    ros.steps = [lambda: None] * 2  # nothing arrives
    assert published(node, port) == ([], [])
    for error in (KeyboardInterrupt(), module.executors.ExternalShutdownException()):
        patch.setattr(ros, "error", error)
        published(node, port)
    patch.setattr(ros, "error", None)


def test_a_foreign_datagram_is_reported_once_and_does_not_end_the_node(
    node: tuple[Ros2, ModuleType], port: int
) -> None:
    mine = record_of()
    foreign: list[dict[str, Any] | bytes] = [
        b"hello",
        b"\xff\xfe\x00",
        b"",
        b"7",
        b"[" * 5000,
        {},
        {"note": "", "pose": None},
        {**mine, "pose": {}},
        {**mine, "pose": {**mine["pose"], "position_m": [1.0, 2.0]}},
        {**mine, "pose": {**mine["pose"], "frame_id": 7}},
        {**mine, "unix_s": math.inf},
    ]
    poses, transforms = published(node, port, *foreign, mine)
    assert (len(poses), len(transforms)) == (1, 1)
    (warning,) = node[0].warnings
    assert "not from perchctl track --udp" in warning
