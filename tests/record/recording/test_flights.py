"""Whole flights with their recordings: what is recorded is what was seen, and a disk that fills up
in flight changes nothing of the flight."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from mcap.reader import make_reader

from perchctl.calibration import profile_camera
from perchctl.campaign.flights import fly_seed
from perchctl.flight import lockstep
from perchctl.geometry import R_MARKER_TARGET, invert_T, make_T
from perchctl.profile import load_profile
from perchctl.record import read_log, recorded_pictures
from perchctl.vision import Frame, project, square_corners
from tests.helpers import recorded
from tests.helpers.commands import run
from tests.helpers.flights import SEED, SHORT


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Frame]]:
    """The log of a short flight with its recording, and the frames that its loop was given."""
    path = tmp_path_factory.mktemp("flown") / "flight.jsonl"
    given: list[Frame] = []
    real = lockstep.LockstepSource.poll

    def poll(self: Any, now_s: float) -> Frame | None:
        frame = real(self, now_s)
        if frame is not None:
            given.append(frame)
        return frame

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lockstep.LockstepSource, "poll", poll)
        result = fly_seed(load_profile(SHORT), SEED, path, record=True)
    assert result.outcome == "perched"
    return path, given


@pytest.mark.long
def test_every_frame_of_a_flight_is_there_to_the_bit(flown: tuple[Path, list[Frame]]) -> None:
    path, given = flown
    new = [frame for frame in given if not frame.repeated]
    found = list(recorded_pictures(path))
    assert [(p.number, p.t_s) for p in found] == [(f.index, f.t_s) for f in new]
    assert all(np.array_equal(p.image, f.image) for p, f in zip(found, new, strict=True))
    summary = read_log(path).summary
    assert summary is not None
    assert summary["recording"] == "flight.mcap"
    assert summary["pictures"] == len(new)


@pytest.mark.long
def test_the_target_of_the_transforms_lies_on_that_of_the_pictures(
    flown: tuple[Path, list[Frame]],
) -> None:
    """World to body, body to camera, world to target, and the calibration, against the corners
    that were found: a frame turned about any axis would be off by the marker's side."""
    path, _ = flown
    profile = load_profile(SHORT)
    camera = profile_camera(profile.camera)
    records = read_log(path).records
    said = recorded.messages(path.with_suffix(".mcap"))["/tf"]
    errors = []
    for record, message in zip(records, said, strict=True):
        if record["large_px"] is None or record["phase"] not in ("ALIGN", "ASCEND"):
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
    assert np.median(errors) < 0.05  # the picture is 60 ms older than the tick


@pytest.mark.long
def test_a_disk_that_fills_up_ends_the_recording_and_not_the_flight(
    flown: tuple[Path, list[Frame]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same flight, tick by tick, with one note more."""
    real, room = os.write, 6_000_000

    def write(fd: int, data: Any) -> int:
        if os.fstat(fd).st_size + len(data) > room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    path = tmp_path / "flight.jsonl"
    result = fly_seed(load_profile(SHORT), SEED, path, record=True)
    assert (result.outcome, result.log_problem) == ("perched", None)
    whole, here = read_log(flown[0]), read_log(path)
    assert here.records == whole.records
    notes = [event["reason"] for event in here.events if event not in whole.events]
    (note,) = notes
    assert "the recording has ended (No space left on device)" in note
    assert here.summary is not None
    assert 0 < here.summary["pictures"] == len(list(recorded_pictures(path)))
    assert here.summary["pictures_missing"] > 0
    with path.with_suffix(".mcap").open("rb") as stream:
        list(make_reader(stream, validate_crcs=True).iter_messages())


def test_simulate_records_beside_a_log_only(tmp_path: Path) -> None:
    said = run("simulate", "-n", "1", "--record")
    assert said.code == 2
    assert "--log-dir" in said.complaint


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
