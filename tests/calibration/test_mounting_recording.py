"""The recording's file: what is written is read, and what is none is refused by its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perchctl.calibration import (
    AttitudeSample,
    MountingRecording,
    read_recordings,
    write_recordings,
)
from perchctl.calibration.mounting.recording import SeenPose
from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import rotation_from_rpy


def _recordings() -> tuple[MountingRecording, MountingRecording]:
    rng = np.random.default_rng(1)
    attitudes = (
        AttitudeSample(1.25, 0.1, -0.2, 3.0, rng.normal(size=3)),
        AttitudeSample(1.26, 0.1, -0.2, -3.1, np.array([0.02, 1.0, 2.0])),
    )
    root = rng.normal(size=(6, 6)) * 1e-4
    R = rotation_from_rpy(3.0, 0.4, -2.0)
    poses = (SeenPose(1.3, R, rng.normal(size=3), root @ root.T), SeenPose(1.33, R.T, np.ones(3)))
    return MountingRecording("carry", attitudes, poses, 3, "by"), MountingRecording(
        "pivot", (), poses[:1]
    )


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "new" / "mount.jsonl"
    written = _recordings()
    write_recordings(path, written)
    read = read_recordings(path)
    told = [(r.part, r.mirrored_pictures, r.seen_by) for r in read]
    assert told == [("carry", 3, "by"), ("pivot", 0, "")]
    for one, other in zip(written, read, strict=True):
        assert len(one.attitudes) == len(other.attitudes)
        assert len(one.poses) == len(other.poses)
        for a, b in zip(
            (*one.attitudes, *one.poses), (*other.attitudes, *other.poses), strict=True
        ):
            assert vars(a).keys() == vars(b).keys()
            for name, value in vars(a).items():
                if value is None:
                    assert getattr(b, name) is None
                else:
                    np.testing.assert_allclose(getattr(b, name), value, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_would_not_be_read_is_not_written(tmp_path: Path, number: float) -> None:
    """Nor does it take the place of a file that can be."""
    path, lines = _file(tmp_path)
    broken = AttitudeSample(1.25, number, -0.2, 3.0, np.zeros(3))
    with pytest.raises(InvalidValue, match=r"mount.jsonl is not written: a sample"):
        write_recordings(path, [MountingRecording("carry", (broken,), ())])
    assert path.read_text().splitlines() == lines


def _file(tmp_path: Path) -> tuple[Path, list[str]]:
    path = tmp_path / "mount.jsonl"
    write_recordings(path, _recordings())
    return path, path.read_text().splitlines()


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
def test_a_wrong_line_is_named(tmp_path: Path, line: int, found: str, put: str) -> None:
    path, lines = _file(tmp_path)
    assert found in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(found, put, 1)
    path.write_text("\n".join(lines))
    with pytest.raises(InvalidValue, match=f"line {line} is no line of a recording"):
        read_recordings(path)


def test_what_is_no_file_or_empty_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="not there"):
        read_recordings(tmp_path / "none.jsonl")
    with pytest.raises(InvalidValue, match="cannot be read"):
        read_recordings(tmp_path)
    (tmp_path / "empty").write_text("")
    with pytest.raises(InvalidValue, match="empty"):
        read_recordings(tmp_path / "empty")
    (tmp_path / "flip").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidValue, match="not text"):
        read_recordings(tmp_path / "flip")
