"""The check's rows of a profile: what is read, and was hardly meant."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from perchctl.check import Row, Verdict, profile_rows
from perchctl.places import data_folder
from perchctl.profile import DOUBTFUL, Profile, load_profile
from tests.helpers.flights import short_profile

CASES: tuple[tuple[str, Mapping[str, Any], str], ...] = (
    ("heights", {"planner.search.max_height_m": 2.95}, "safety.max_height_m (3 m)"),
    ("heights", {"safety.ground_tolerance_m": 1.0}, "one on the ground"),
    ("fence", {"safety.fence_radius_m": 0.2}, "draught"),
    (
        "battery limits",
        {"safety.min_rest_v": 3.6, "safety.min_load_v": 3.6},
        "as soon as it takes off",
    ),
    ("battery limits", {"safety.min_rest_v": 4.1, "safety.min_load_v": 3.9}, "a full battery"),
    ("battery limits", {"safety.min_rest_v": 4.5}, "no battery has this voltage"),
    ("time limits", {"planner.perching_time_s": 2.0}, "before a contact"),
    ("time limits", {"planner.search.wait_s": 30}, "before the search"),
    ("time limits", {"planner.landing.timeout_s": 15}, "the firmware lands"),
    ("time limits", {"safety.camera_hold_s": 3.0}, "safety.camera_land_s"),
    ("time limits", {"safety.telemetry_hold_s": 1.0}, "safety.telemetry_land_s"),
    ("thresholds", {"planner.align.xy_m": 0.06}, "alternate between"),
    ("thresholds", {"planner.perch.contact_z_m": 0.09}, "counts as contact"),
    ("thresholds", {"planner.ascend.speed_mps": 0.1}, "faster near the target"),
    ("thresholds", {"planner.perch.mode": "raw", "planner.perch.thrust": 30000}, "30000"),
    ("thresholds", {"safety.max_tilt_deg": 15}, "a gust"),
    ("thresholds", {"link.telemetry_period_s": 0.06}, "single lost packet"),
)
"""A row, what brings its warning about on top of `sim`, and what it says."""


def row_of(profile: Profile, name: str, **options: str) -> Row:
    (row,) = (row for row in profile_rows(profile, **options) if row.name == name)
    return row


@pytest.mark.parametrize(("name", "changes", "words"), CASES, ids=str)
def test_what_is_doubtful_is_a_warning(name: str, changes: Mapping[str, Any], words: str) -> None:
    found = profile_rows(short_profile(changes, base="sim"))
    (row,) = (row for row in found if row.verdict is not Verdict.PASS)
    assert (row.name, row.verdict) == (name, Verdict.WARN)
    assert words in row.found
    assert row.advice


def test_each_doubtful_limit_is_broken_once() -> None:
    broken = {
        limit.consequence
        for name, changes, _ in CASES
        for limit in DOUBTFUL.get(name, ())
        if not limit.holds(short_profile(changes, base="sim"))
    }
    assert broken == {limit.consequence for limits in DOUBTFUL.values() for limit in limits}


@pytest.mark.parametrize("name", ["sim", "paper", "fpv"])
def test_a_shipped_profile_is_above_doubt(name: str) -> None:
    assert {row.verdict for row in profile_rows(load_profile(name))} == {Verdict.PASS}


def test_the_example_calibration_fits_no_camera_of_one_s_own(tmp_path: Path) -> None:
    crazyflie = load_profile("crazyflie")
    row = row_of(crazyflie, "calibration file")
    assert row.verdict is Verdict.WARN
    assert "perchctl calibrate" in row.advice
    assert row_of(crazyflie, "calibration file", source="sim:").verdict is Verdict.PASS
    assert row_of(load_profile("sim"), "calibration file", source="camera:1").verdict is (
        Verdict.WARN
    )
    assert row_of(load_profile("aideck"), "calibration file").verdict is Verdict.WARN
    example = (data_folder("calib") / "example_640x480.yaml").read_text(encoding="utf-8")
    for text, verdict in ((example, Verdict.WARN), (f"{example}\n", Verdict.PASS)):
        (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
        mine = short_profile({"camera.calibration": str(tmp_path / "mine.yaml")}, base="sim")
        assert row_of(mine, "calibration file", source="camera:0").verdict is verdict


def test_a_calibration_that_is_not_there_is_a_fail() -> None:
    lost = short_profile({"camera.calibration": "/nowhere/none.yaml"}, base="sim")
    assert row_of(lost, "calibration file").verdict is Verdict.FAIL
    assert row_of(lost, "stand-off").verdict is Verdict.SKIPPED


def test_only_a_valid_uri_has_a_short_address() -> None:
    def rows(uri: str) -> list[Row]:
        by_option = profile_rows(load_profile("sim"), uri=uri)
        assert by_option == profile_rows(short_profile({"link.uri": uri}, base="sim"))
        return [row for row in by_option if row.name == "short address"]

    (row,) = rows("radio://0/80/2M/E7")
    assert (row.verdict, row.found) == (
        Verdict.WARN,
        "radio://0/80/2M/E7 means the address 00000000E7",
    )
    for uri in ("radio://0/x/2M/E7", "radio://0/80/3M/E7", "radio://0/80/2M/xyz", "radio:/"):
        assert rows(uri) == []


@pytest.mark.parametrize("rpy_deg", [(180, 0, 0), (0, -90, 0), (50, 0, 0)])
def test_a_camera_that_does_not_look_up_is_a_fail(rpy_deg: tuple[float, ...]) -> None:
    row = row_of(short_profile({"camera.mount.rpy_deg": rpy_deg}, base="sim"), "camera turn")
    assert row.verdict is Verdict.FAIL
    assert f"{max(map(abs, rpy_deg))} deg away" in row.found


def test_a_stand_off_that_the_camera_is_blind_at_is_a_fail() -> None:
    near = {"planner.ascend.standoff_m": 0.02, "planner.perch.contact_z_m": 0.01}
    profile = short_profile(
        {**near, "camera.mount.position_m": [0.1, 0, 0.025]}, base="sim"
    )  # beside the gear, and as high
    row = row_of(profile, "stand-off")
    assert row.verdict is Verdict.FAIL
    assert "20 mm" in row.found
