"""Profiles: found, merged, checked, and refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.calibration.files import load_calibration
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.profile.places import listing


@pytest.mark.parametrize("name", ["sim", "paper", "crazyflie"])
def test_shipped_profiles_load(name: str) -> None:
    assert load_profile(name).name == name


def test_the_shipped_profiles_are_all_listed() -> None:
    assert {"sim", "paper", "crazyflie"} <= set(listing("profiles"))


def test_paper_constants() -> None:
    """Sections II-A and III-B of the paper."""
    paper = load_profile("paper")
    assert (paper.target.large.dictionary, paper.target.large.id) == ("DICT_4X4_1000", 997)
    assert (paper.target.small.dictionary, paper.target.small.id) == ("DICT_ARUCO_ORIGINAL", 5)
    assert (paper.target.large.side_m, paper.target.small.side_m) == (0.150, 0.025)
    assert (paper.kalman.alpha, paper.kalman.n_max) == (0.85, 8)
    weights = paper.merge.weights
    assert (weights.x, weights.y, weights.z, weights.yaw) == (0.275, 0.306, 0.728, 0.469)
    assert (paper.merge.z1_m, paper.merge.z2_m, paper.merge.z3_m) == (1.15, 0.25, 0.12)
    assert paper.merge.method == "weights"
    assert paper.planner.recover.descend_m == 0.10
    assert load_calibration(find_calibration(paper.camera.calibration)).size_px == (640, 480)


def _refusal(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InvalidValue) as caught:
        load_profile(str(path))
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("planer: {}", ["planer", "unknown", "planner"]),
        ("kalman: {alfa: 0.85}", ["kalman.alfa", "unknown", "alpha"]),
        ("target: {large: {dictionary: DICT_4X4_100, id: 997, side_m: 0.15}}",
         ["target.large", "997", "0..99", "DICT_4X4_1000"]),
        ("target: {large: {dictionary: DICT_4X4_1000, id: 1000, side_m: 0.15}}",
         ["0..999"]),
        ("target: {large: {dictionary: DICT_9X9, id: 1, side_m: 0.15}}",
         ["DICT_9X9", "unknown", "DICT_4X4_1000"]),
        ("target: {large: {dictionary: DICT_4X4_1000, id: 997, side_m: 150}}",
         ["target.large.side_m", "150", "millimetres"]),
        ("kalman: {alpha: high}", ["kalman.alpha", "'high'"]),
        ("kalman: {alpha: .nan}", ["kalman.alpha", "finite"]),
        ("simulation: {ceiling_z_m: [2.6, 1.8]}", ["simulation.ceiling_z_m", "2.6", "1.8"]),
        ("planner: {search: {max_height_m: 9}}", ["planner.search.max_height_m"]),
        ("- a list", ["keys and values"]),
        ("kalman: {alpha: 0.85", ["line", "YAML"]),
    ],
)  # fmt: skip
def test_faults_are_one_sentence(tmp_path: Path, text: str, expected: list[str]) -> None:
    message = _refusal(tmp_path, text)
    for word in expected:
        assert word in message


def test_missing_profile_names_the_choices(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="sim"):
        load_profile("smi")
    with pytest.raises(NotFound, match="does not exist"):
        load_profile(str(tmp_path / "none.yaml"))


def test_extends_takes_the_rest_from_another_profile(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: paper\nkalman: {n_max: 5}\n")
    mine, paper = load_profile(str(path)), load_profile("paper")
    assert mine.kalman.n_max == 5
    assert mine.kalman.alpha == paper.kalman.alpha
    assert mine.merge == paper.merge
    assert mine.name == "mine"


def test_extends_in_a_circle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("extends: b.yaml\n")
    (tmp_path / "b.yaml").write_text("extends: a.yaml\n")
    with pytest.raises(InvalidValue, match="comes back"):
        load_profile(str(tmp_path / "a.yaml"))


def test_a_profile_round_trips_through_its_own_dump() -> None:
    profile = load_profile("sim")
    assert Profile.model_validate(profile.model_dump(mode="json")) == profile


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("image_width: 640\n", "image_height"),
        ("nothing\n", "camera_info"),
        ("image_width: 640\nimage_height: 480\ncamera_matrix: {data: [1, 2]}\n"
         "distortion_coefficients: {data: [0, 0, 0, 0, 0]}\n", "9 numbers"),
        ("image_width: 320\nimage_height: 240\n"
         "camera_matrix: {data: [380, 0, 640, 0, 380, 120, 0, 0, 1]}\n"
         "distortion_coefficients: {data: [0, 0, 0, 0, 0]}\n", "320x240"),
    ],
)  # fmt: skip
def test_bad_calibrations_are_refused(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(InvalidValue, match=expected):
        load_calibration(path)
