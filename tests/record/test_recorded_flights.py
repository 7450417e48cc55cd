"""Whole flights with their recordings: what is recorded is what was seen, and a disk that fills up
in flight changes nothing of the flight."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import profile_camera
from perchctl.campaign.flights import fly_seed
from perchctl.geometry import R_MARKER_TARGET, invert_T, make_T
from perchctl.profile import load_profile
from perchctl.record import read_log
from perchctl.vision import project, square_corners
from tests.helpers import recorded
from tests.helpers.commands import run
from tests.helpers.flights import SEED, SHORT


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a short flight with its recording."""
    path = tmp_path_factory.mktemp("flown") / "flight.jsonl"
    assert fly_seed(load_profile(SHORT), SEED, path, record=True).outcome == "perched"
    return path


@pytest.mark.long
def test_the_target_of_the_transforms_lies_on_that_of_the_pictures(flown: Path) -> None:
    """World to body, body to camera, world to target, and the calibration, against the corners
    that were found: a frame turned about any axis would be off by the marker's side."""
    profile = load_profile(SHORT)
    camera = profile_camera(profile.camera)
    records = read_log(flown).records
    said = recorded.messages(flown.with_suffix(".mcap"))["/tf"]
    errors = []
    for record, message in zip(records, said, strict=True):
        if record["large_px"] is None or record["phase"] not in ("ALIGN", "ASCEND"):
            continue
        # The picture is 60 ms older than the tick: while the vehicle climbs, its target lies lower.
        if math.hypot(*(record[key] for key in ("vx_mps", "vy_mps", "vz_mps"))) > 0.1:
            continue
        T = recorded.transforms(message)
        T_cam_target = invert_T(T["world body"] @ T["body camera"]) @ T["world target"]
        T_cam_marker = T_cam_target @ make_T(R_MARKER_TARGET, (0.0, 0.0, 0.0))
        rvec = np.asarray(cv2.Rodrigues(T_cam_marker[:3, :3])[0], dtype=float).ravel()
        side_m = profile.target.large.side_m
        drawn = project(square_corners(side_m), rvec, T_cam_marker[:3, 3], camera)
        found = np.reshape(record["large_px"], (4, 2))
        side_px = np.linalg.norm(found[1] - found[0])
        errors.append(float(np.abs(drawn - found).max() / side_px))
    assert len(errors) > 10
    assert np.median(errors) < 0.05


@pytest.mark.parametrize(
    ("arguments", "recorded"),
    [
        ((), False),
        (("--record",), True),
        (("-u", "usb://0", "--source", "camera:0"), True),
        (("-u", "usb://0", "--source", "camera:0", "--no-record"), False),
    ],
)
def test_real_vehicles_are_recorded_by_default(arguments: tuple[str, ...], recorded: bool) -> None:
    said = run("fly", "-p", SHORT, "--dry-run", *arguments)
    assert said.code == 0
    assert (", with pictures" in said.stdout) is recorded
