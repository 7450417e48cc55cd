"""The rows of a motion capture at rest, from a scripted one; each fault alone makes its row."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from perchctl.check import Row, Verdict, capture
from perchctl.errors import ConnectionFailed
from perchctl.geometry import quaternion_from_rotation, rotation_from_rpy
from perchctl.positioning import BodyPose, CaptureFrame
from perchctl.profile import PositioningConfig, Profile
from perchctl.vehicle import Telemetry
from tests.helpers.mission import READY, telemetry

CONFIG = PositioningConfig(by="mocap", host="lab", body="cf2")
PROFILE = Profile().model_copy(update={"positioning": CONFIG})
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
Changed = Callable[[float, BodyPose], dict[str, BodyPose] | None]


class Scripted:
    """A `CaptureSource`, and the clock that it is asked by. `changed` gives a frame's bodies,
    None for no frame."""

    def __init__(
        self,
        changed: Changed = lambda t_s, pose: {"cf2": pose},
        hz: float = 100.0,
        complaint: str | None = None,
    ) -> None:
        self.now_s, self._changed, self._hz = 0.0, changed, hz
        self._next_s, self._rng, self._complaint = 0.0, np.random.default_rng(1), complaint

    def clock(self) -> float:
        return self.now_s

    def wait(self, for_s: float) -> None:
        self.now_s += for_s

    def poll(self, now_s: float) -> CaptureFrame | None:
        if now_s < self._next_s:
            return None
        self._next_s += 1.0 / self._hz
        place = np.array([0.3, -0.2, 0.02]) + self._rng.normal(0.0, 0.001, 3)
        R = rotation_from_rpy(*self._rng.normal(0.0, 0.004, 3))
        bodies = self._changed(now_s, BodyPose(tuple(place), quaternion_from_rotation(R)))
        return None if bodies is None else CaptureFrame(now_s, bodies)

    def problem(self, now_s: float) -> str | None:
        return self._complaint

    def close(self) -> None:
        return None


def rows_of(it: Scripted, sample: Telemetry | None = None) -> dict[str, Row]:
    rest = telemetry(0.0, 0.02, thrust=0.0, supervisor=READY) if sample is None else sample

    def heard() -> list[Telemetry]:
        return [replace(rest, t_s=it.now_s)]

    seen = capture.collect_samples(heard, it, it.clock, it.wait)
    found = capture.mocap_rows_at_rest(seen, PROFILE)
    assert [row.name for row in found] == ["capture", *capture.BODY_ROWS]
    return {row.name: row for row in found}


def test_a_good_capture_passes_all() -> None:
    rows = rows_of(Scripted())
    assert {row.verdict for row in rows.values()} == {Verdict.PASS}
    assert "seen in 100 % of the frames, 100 Hz" in rows["body"].found
    assert rows["body"].found.endswith("noise 1.0 mm")
    assert rows["body place"].found == "x 0.30, y -0.20, z 0.02 m"


def moved(pose: BodyPose, scale: float = 1.0, **changes: object) -> dict[str, BodyPose]:
    place = tuple(scale * v for v in pose.position_m)
    return {"cf2": replace(pose, **({"position_m": place} | changes))}  # type: ignore[arg-type]


STILL = BodyPose((0.3, -0.2, 0.02), (1.0, 0.0, 0.0, 0.0))


def y_up(t_s: float, pose: BodyPose) -> dict[str, BodyPose]:
    """Its body's axes are the vehicle's: `up` shows in its attitude."""
    place = tuple(float(v) for v in Y_UP @ np.array(pose.position_m))
    return {"cf2": BodyPose(place, quaternion_from_rotation(Y_UP))}


def hidden_at_times(t_s: float, pose: BodyPose) -> dict[str, BodyPose]:
    return {} if t_s % 1.0 < 0.4 else {"cf2": pose}


FAULTS: list[tuple[str, Scripted, str, str]] = [
    ("capture", Scripted(lambda t_s, pose: None, complaint="silent for 2 s"), "fail", "silent"),
    ("body", Scripted(lambda t_s, pose: {"wand": pose, "cf3": pose}), "fail", "sees cf3, wand"),
    ("body", Scripted(lambda t_s, pose: {}), "fail", "it sees none"),
    ("body", Scripted(hidden_at_times), "fail", "seen in 60 %"),
    ("body", Scripted(lambda t_s, p: {} if round(t_s * 100.0) % 2 else {"cf2": p}), "fail",
     "seen in 50 %"),
    ("body", Scripted(hz=40.0), "warn", "40 Hz"),
    ("body", Scripted(hz=10.0), "fail", "10 Hz"),
    ("body", Scripted(hidden_at_times), "fail", "gap 41"),
    ("body", Scripted(lambda t_s, p: {"cf2": STILL}), "fail", "frozen"),
    ("body", Scripted(lambda t_s, p: moved(p, 8.0)), "warn", "7.9 mm"),
    ("body", Scripted(lambda t_s, p: moved(p, 1000.0)), "fail", " mm"),
    ("body place", Scripted(lambda t_s, p: moved(p, 1000.0)), "fail", "to be in millimetres"),
    ("body place", Scripted(y_up), "fail", "swapped axes: up is y"),
    ("body place", Scripted(lambda t_s, p: moved(p, position_m=(0.0, 0.0, 1.4))), "fail", "1.40"),
    ("body place", Scripted(lambda t_s, p: moved(p, position_m=(0.05 * t_s, 0.0, 0.02))), "fail",
     "shows a motion of 0.15 m, but the vehicle is at rest"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "it", "verdict", "words"), FAULTS)
def test_a_fault_makes_its_row(name: str, it: Scripted, verdict: str, words: str) -> None:
    row = rows_of(it)[name]
    assert row.verdict == verdict, row
    assert words in row.found
    assert row.advice


def test_a_body_that_was_carried_to_its_place_is_no_other_one() -> None:
    it = Scripted(lambda t_s, pose: moved(pose, position_m=(min(0.1 * t_s, 0.2), 0.0, 0.02)))
    rest = telemetry(0.0, 0.02, thrust=0.0, supervisor=READY)

    def heard() -> list[Telemetry]:
        return [replace(rest, t_s=it.now_s, acc_z_g=1.3 if it.now_s < 2.0 else 1.0)]

    seen = capture.collect_samples(heard, it, it.clock, it.wait)
    assert capture.mocap_rows_at_rest(seen, PROFILE)[-1].verdict is Verdict.PASS


def test_a_tilted_vehicle_is_not_judged() -> None:
    tilted = telemetry(0.0, 0.02, roll_rad=math.radians(25.0))
    assert rows_of(Scripted(y_up), tilted)["body place"].verdict is Verdict.SKIPPED


def test_without_a_vehicle_no_place_is_compared() -> None:
    it = Scripted()
    seen = capture.collect_samples(list, it, it.clock, it.wait)
    *_, place = capture.mocap_rows_at_rest(seen, PROFILE)
    assert (place.verdict, "no telemetry" in place.found) == (Verdict.SKIPPED, True)


def test_one_that_does_not_open_skips_the_rest() -> None:
    rows = capture.failed_capture_rows(ConnectionFailed("no vicon:lab: no frame"), CONFIG)
    assert [row.name for row in rows] == ["capture", *capture.BODY_ROWS]
    assert rows[0].verdict is Verdict.FAIL
    assert "positioning.host" in rows[0].advice
    assert {row.verdict for row in rows[1:]} == {Verdict.SKIPPED}
    late, *_ = capture.failed_capture_rows(ConnectionFailed("it is late", "use a cable"), CONFIG)
    assert (late.found, late.advice) == ("it is late", "use a cable")
