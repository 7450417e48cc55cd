"""The rows of a target that is the positioning system: what `fly` refuses fails here."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.check import Row, Verdict, profile_rows
from perchctl.check.camera import IN_VIEW, picture_rows
from perchctl.check.rehearsal import Rehearsal, rehearsal_telemetry
from perchctl.check.row import evaluate_rows
from perchctl.check.vehicle import BY_FLY, VEHICLE, VehicleStatus
from perchctl.profile import Profile, load_profile
from perchctl.vehicle import Telemetry
from perchctl.vision import CameraModel
from tests.helpers.checks import AT_REST, PROFILE
from tests.helpers.flights import short_profile
from tests.helpers.mission import target_at

TARGET = short_profile({"positioning": "target"}, base="sim")
CAMERA = CameraModel(
    (640, 480), np.array([[380.0, 0.0, 319.5], [0.0, 380.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5)
)


def rehearsed(x: float = 0.1, y: float = 0.0, z: float = 2.0, **changes: Any) -> Rehearsal:
    """Under a target that is there from where the vehicle stands."""
    target = target_at(1.0, (x, y, z), (0.0, 0.0, 0.0))
    made = Rehearsal(live=True, pictures=60, target_pictures=60, target=target)
    return replace(made, **changes)


def wandering(mps: float) -> list[Any]:
    """Three seconds of a target that moves; its first sight is off."""
    times = [0.05 * k for k in range(60)]
    return [(t_s, np.array((mps * t_s + 0.5 * (t_s == 0.0), 0.0, 2.0))) for t_s in times]


def rows_of(done: Rehearsal, profile: Profile = TARGET) -> dict[str, Row]:
    found = picture_rows(done, profile, CAMERA)
    return {row.name: row for row in found if row.name == IN_VIEW}


def test_under_the_target_it_passes() -> None:
    rows = rows_of(rehearsed())
    assert list(rows) == [IN_VIEW]
    assert {row.verdict for row in rows.values()} == {Verdict.PASS}


@pytest.mark.parametrize(("verdict", "words", "advice", "done"), [
    ("fail", "not detected, so perchctl fly would refuse to take off",
     "at most 3.2 m above the camera", rehearsed(target_pictures=0, target=None)),
    ("fail", "the vehicle would not see it", "forward", rehearsed(1.3)),
    ("warn", "no longer in view at the end", "lost frames", rehearsed(target=None)),
    ("fail", "shows a motion of 0.12 m, but the vehicle is at rest", "keep the target still",
     rehearsed(target_places=wandering(0.05))),
    ("pass", "in view now, and", "", rehearsed(target_places=wandering(0.01))),
    ("skipped", "no picture arrived", "", rehearsed(pictures=0)),
])  # fmt: skip
def test_a_sight_makes_its_row(verdict: str, words: str, advice: str, done: Rehearsal) -> None:
    row = rows_of(done)["in view"]
    assert (row.verdict, words in row.found, advice in row.advice) == (verdict, True, True), row


def test_a_latency_that_is_written_down_is_doubted() -> None:
    rows = {row.name: row for row in profile_rows(TARGET)}
    assert rows["latency"].verdict is Verdict.WARN
    assert "camera.latency_s: measured" in rows["latency"].advice
    shipped = profile_rows(load_profile("target_only"))
    assert {row.verdict for row in shipped} == {Verdict.PASS}


def test_decks_and_an_estimate_are_not_asked_for() -> None:
    """Its estimate runs away while nothing is sent, and says nothing against it."""
    away = replace(AT_REST, position_m=(3.0, -2.0, 9.0), velocity_variance_m2ps2=50.0)
    vehicle = VehicleStatus("radio://0/80/2M", telemetry=away)
    rows = {row.name: row for row in evaluate_rows(VEHICLE, vehicle, TARGET)}
    assert rows["positioning"].found == "by the target, see the row in view"
    assert rows["estimator"].verdict is rows["ground"].verdict is Verdict.SKIPPED
    assert rows["estimator"].found == BY_FLY


def runaway() -> list[Telemetry]:
    """Of a vehicle at rest whose estimate has left."""
    return [replace(AT_REST, position_m=(3.0, -2.0, 9.0), velocity_mps=(1.0, 2.0, 3.0))]


def test_pictures_are_rehearsed_on_a_vehicle_that_stands() -> None:
    (sample,) = rehearsal_telemetry(runaway, TARGET).telemetry()
    assert sample.position_m == (0.0, 0.0, TARGET.safety.ground_z_m)
    assert sample.velocity_mps == (0.0, 0.0, 0.0)
    assert sample.acc_z_g == AT_REST.acc_z_g
    (sample,) = rehearsal_telemetry(runaway, PROFILE).telemetry()
    assert sample.position_m == (3.0, -2.0, 9.0)
