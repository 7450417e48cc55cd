"""The recording's file: what is written is read, and what is none is refused by its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perchctl.calibration import AttitudeSample, MountingRecording
from perchctl.calibration.mounting.recording import SeenPose
from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import rotation_from_rpy


@pytest.fixture
def recordings() -> list[MountingRecording]:
    rng = np.random.default_rng(1)
    attitudes = [
        AttitudeSample(1.25, 0.1, -0.2, 3.0, rng.normal(size=3)),
        AttitudeSample(1.26, 0.1, -0.2, -3.1, np.array([0.02, 1.0, 2.0])),
    ]
    root, R = rng.normal(size=(6, 6)) * 1e-4, rotation_from_rpy(3.0, 0.4, -2.0)
    poses = [SeenPose(t_s, R, rng.normal(size=3), root @ root.T) for t_s in (1.3, 1.33)]
    return [
        MountingRecording("carry", attitudes, poses, 3, "by"),
        MountingRecording("pivot", [], poses[:1]),
    ]


@pytest.fixture
def path(tmp_path: Path, recordings: list[MountingRecording]) -> Path:
    MountingRecording.write(tmp_path / "mount.jsonl", recordings)
    return tmp_path / "mount.jsonl"


def test_what_is_written_is_read(path: Path, recordings: list[MountingRecording]) -> None:
    read = MountingRecording.read(path)
    told = [(r.part, r.mirrored_pictures, r.seen_by) for r in read]
    assert told == [("carry", 3, "by"), ("pivot", 0, "")]
    for one, other in zip(recordings, read, strict=True):
        pairs = zip((*one.attitudes, *one.poses), (*other.attitudes, *other.poses), strict=True)
        for a, b in pairs:
            for name, value in vars(a).items():
                np.testing.assert_allclose(getattr(b, name), value, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_would_not_be_read_is_not_written(path: Path, number: float) -> None:
    """Nor does it take the place of a file that can be."""
    before = path.read_text()
    broken = AttitudeSample(1.25, number, -0.2, 3.0, np.zeros(3))
    with pytest.raises(InvalidValue, match=r"mount.jsonl is not written: a sample"):
        MountingRecording.write(path, [MountingRecording("carry", [broken])])
    assert path.read_text() == before


@pytest.mark.parametrize(
    ("line", "found", "put"),
    [
        (1, '"carry"', '"walk"'),
        (1, '"format":1', '"format":7'),
        (1, '"part"', '"port"'),
        (2, '"gyro_radps"', '"gyro"'),
        (3, "0.02", "NaN"),
        (4, '"rotation_cam_target":[[', '"rotation_cam_target":[[2.5,'),
        (4, '"rotation_cam_target":[[-0', '"rotation_cam_target":[[-9'),
        (4, "{", ""),
        (5, '"t_s":1.33', '"t_s":[]'),
    ],
)
def test_a_wrong_line_is_named(path: Path, line: int, found: str, put: str) -> None:
    lines = path.read_text().splitlines()
    assert found in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(found, put, 1)
    path.write_text("\n".join(lines))
    with pytest.raises(InvalidValue, match=f"line {line} is no line of a recording"):
        MountingRecording.read(path)


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("none.jsonl", NotFound, "not there"),
        (".", InvalidValue, "cannot be read"),
        ("empty", InvalidValue, "empty"),
        ("flip", InvalidValue, "not text"),
    ],
)
def test_what_is_no_file_or_empty_is_refused(
    tmp_path: Path, name: str, error: type[Exception], said: str
) -> None:
    (tmp_path / "empty").write_text("")
    (tmp_path / "flip").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(error, match=said):
        MountingRecording.read(tmp_path / name)
