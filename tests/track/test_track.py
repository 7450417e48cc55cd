"""`perchctl track`: its lines against the truth."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.geometry import wrap_rad, yaw_of
from perchctl.profile import TargetConfig, load_profile
from perchctl.vision import project, square_corners
from tests.helpers.recording import (
    STAGE_OF,
    VIEWS,
    camera,
    moving,
    picture,
    true_pose,
)
from tests.helpers.track import MOVING, track, write_ros

SCENES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "scenes"


def check_vector(values: Any, length: int) -> None:
    assert isinstance(values, list)
    assert len(values) == length
    assert all(isinstance(v, float) for v in values)


def check_schema(line: dict[str, Any]) -> None:
    assert list(line) == ["frame", "t_s", "stage", "large", "small", "target"]
    assert line["stage"] in ("large", "both", "small", "none")
    seen = {"large": (1, 0), "small": (0, 1), "both": (1, 1), "none": (0, 0)}[line["stage"]]
    assert (line["large"] is not None, line["small"] is not None) == seen
    for name in ("large", "small"):
        if line[name] is None:
            continue
        assert list(line[name]) == ["corners_px", "rvec_rad", "tvec_m", "reprojection_px"]
        assert len(line[name]["corners_px"]) == 4
        for corner in line[name]["corners_px"]:
            check_vector(corner, 2)
        check_vector(line[name]["rvec_rad"], 3)
        check_vector(line[name]["tvec_m"], 3)
        assert 0.0 <= line[name]["reprojection_px"] < 3.0
    if line["target"] is not None:
        keys = ["rvec_rad", "tvec_m", "yaw_rad", "sigma_m", "sigma_yaw_rad"]
        assert list(line["target"]) == keys
        for key in ("rvec_rad", "tvec_m", "sigma_m"):
            check_vector(line["target"][key], 3)
        assert min(line["target"]["sigma_m"]) > 0.0
        assert line["target"]["sigma_yaw_rad"] > 0.0


def test_stills_give_one_line_a_picture_and_the_truth(pictures: Path) -> None:
    lines = track(pictures, stills=True)
    assert [line["frame"] for line in lines] == [f"{name}.png" for name in sorted(VIEWS)]
    target = TargetConfig()
    for line in lines:
        check_schema(line)
        name = line["frame"].removesuffix(".png")
        assert line["stage"] == STAGE_OF[name]
        if name == "away":
            assert line["target"] is None
            continue
        R, t = true_pose(VIEWS[name])
        rvec = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()
        found = line["target"]
        limit_m, limit_px = (0.003, 0.5) if name == "far" else (0.0005, 0.3)
        assert np.abs(np.array(found["tvec_m"]) - t).max() < limit_m
        R_found = np.asarray(cv2.Rodrigues(np.array(found["rvec_rad"]))[0], dtype=np.float64)
        assert found["yaw_rad"] == pytest.approx(yaw_of(R_found), abs=1e-9)
        assert abs(wrap_rad(found["yaw_rad"] - yaw_of(R))) < math.radians(0.2)
        for marker, side_m in (("large", target.large.side_m), ("small", target.small.side_m)):
            if line[marker] is not None:
                true_px = project(square_corners(side_m), rvec, t, camera())
                assert np.abs(np.array(line[marker]["corners_px"]) - true_px).max() < limit_px


def test_with_both_in_sight_the_target_is_the_joint_pose(pictures: Path) -> None:
    (line,) = track(pictures / "both.png", stills=True)
    alone = [line[name]["tvec_m"] for name in ("large", "small")]
    assert line["target"]["tvec_m"] not in alone


def test_with_the_papers_weights_the_target_lies_between_the_markers(pictures: Path) -> None:
    (line,) = track(pictures / "both.png", "paper", stills=True)
    large, small, merged = (np.array(line[name]["tvec_m"]) for name in ("large", "small", "target"))
    weights = load_profile("paper").merge.weights
    w = np.array([weights.x, weights.y, weights.z])
    assert merged == pytest.approx(w * large + (1.0 - w) * small, abs=1e-9)


def test_stills_do_not_know_of_one_another(pictures: Path) -> None:
    whole = {line["frame"]: line for line in track(pictures, stills=True)}
    (alone,) = track(pictures / "near.png", stills=True)
    assert whole["near.png"] | {"t_s": 0.0} == alone


def test_a_video_is_tracked_frame_by_frame(video: Path) -> None:
    lines = track(f"video:{video}")
    assert [line["frame"] for line in lines] == list(range(MOVING))
    for i, line in enumerate(lines):
        check_schema(line)
        assert line["t_s"] == pytest.approx(i / 30.0, abs=1e-3)
        assert np.abs(np.array(line["target"]["tvec_m"]) - true_pose(moving(i))[1]).max() < 0.01
        R = np.asarray(cv2.Rodrigues(np.array(line["target"]["rvec_rad"]))[0], dtype=np.float64)
        assert line["target"]["yaw_rad"] == pytest.approx(yaw_of(R), abs=1e-9)
    assert track(video) == lines


def test_the_filter_bridges_a_lost_frame(tmp_path: Path) -> None:
    images = [picture(moving(i), i) for i in range(8)]
    images[5] = picture(VIEWS["away"])
    for i, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    lost = track(tmp_path, video=True)[5]
    assert lost["stage"] == "none"
    assert lost["large"] is None
    assert np.abs(np.array(lost["target"]["tvec_m"]) - true_pose(moving(5))[1]).max() < 0.02
    assert track(tmp_path)[5]["target"] is None


def test_files_of_pictures_are_stills_unless_the_user_says_otherwise(
    pictures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Filtered as one movement at 30 Hz, unrelated pictures drag each other along."""
    both, far = (true_pose(VIEWS[name])[1] for name in ("both", "far"))
    for source in (str(pictures), f"images:{pictures}", str(pictures / "*.png")):
        away, first, second, _ = track(source)
        assert away["target"] is None
        assert np.abs(np.array(first["target"]["tvec_m"]) - both).max() < 0.0005
        assert np.abs(np.array(second["target"]["tvec_m"]) - far).max() < 0.003
    assert "jumps" not in capsys.readouterr().err
    lines = track(pictures, video=True)
    assert np.abs(np.array(lines[2]["target"]["tvec_m"]) - far).max() > 0.05
    assert [line["t_s"] for line in lines] == pytest.approx([k / 30.0 for k in range(len(VIEWS))])
    said = capsys.readouterr().err
    assert "far.png: the target jumps from one picture to the next" in said
    assert "jumps from one picture to the next in 2" in said.splitlines()[-1]


def test_one_movement_is_no_jump(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track(video)
    assert "jumps" not in capsys.readouterr().err


def test_rendered_scenes_with_exact_truth(tmp_path: Path) -> None:
    if not (SCENES / "truth.json").is_file():
        pytest.skip(f"the rendered scenes are absent ({SCENES})")
    truth = json.loads((SCENES / "truth.json").read_text())
    values = [v for row in truth["camera_matrix"] for v in row]
    file = write_ros(tmp_path, values, truth["dist_coeffs"])
    lines = {
        line["frame"]: line for line in track(SCENES / "frames", stills=True, calibration=file)
    }
    assert sorted(lines) == sorted(Path(f["file"]).name for f in truth["frames"])
    found = {"large": [0, 0], "small": [0, 0]}
    for entry in truth["frames"]:
        line = lines[Path(entry["file"]).name]
        check_schema(line)
        if not entry["target_present"]:
            assert line["stage"] == "none", entry["file"]
            continue
        for name in found:
            if entry[f"{name}_in_view"] and entry["category"] != "occluded":
                found[name][0] += line[name] is not None
                found[name][1] += 1
        if entry["category"] in ("clean", "table1", "table2"):
            error_m = np.array(line["target"]["tvec_m"]) - entry["tvec"]
            assert np.abs(error_m).max() < (0.0005 if entry["tvec"][2] < 0.25 else 0.006)
    assert found["large"][0] >= 0.9 * found["large"][1]
    assert found["small"][0] >= 0.85 * found["small"][1]
