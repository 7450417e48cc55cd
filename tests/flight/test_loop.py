"""The flight loop: what it refuses before take-off, and that it lands first, whatever is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import Interrupted, InvalidValue, NotFound, PerchError, SafetyAbort, TimedOut
from perchctl.flight import fly
from perchctl.flight.preflight import GroundTurn, still_waiting_for
from perchctl.mission import EventKind, FlightReport, OperatorRequest, Outcome, Tick
from perchctl.perception import perception
from perchctl.vehicle import (
    CRASHED,
    DECK_FAULT,
    FLYING,
    LOCKED,
    TUMBLED,
    Land,
    PositionSetpoint,
    Telemetry,
)
from perchctl.vision.types import Detections
from tests.helpers.hangs import hang_in_the_camera
from tests.helpers.loop_rig import (
    PROFILE,
    Camera,
    Guarded,
    Rig,
    SleepyClock,
    Vehicle,
    noise,
)
from tests.helpers.mission import READY, changed, target_at, telemetry

PERIOD_S = 1.0 / PROFILE.link.loop_hz
BAD_S = 2.0
"""From then on something is wrong."""


def landed_for(rig: Rig, words: str) -> FlightReport:
    """The report of a flight that safety ended, and which says so."""
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert words in report.reason
    return report


def land_after(rig: Rig, t_s: float) -> Callable[[], OperatorRequest]:
    return lambda: OperatorRequest.LAND if rig.link.now_s > t_s else OperatorRequest.NONE


# --- Bad measurements ---------------------------------------------------------------------------


def test_telemetry_that_is_no_number_is_left_out() -> None:
    """Ten samples of NaN in the air: no jump, no command with NaN, the flight goes on."""
    nan = (math.nan, 0.0, 0.5)
    rig = Rig(Vehicle(lambda s: replace(s, position_m=nan) if 1.5 < s.t_s < 1.6 else s))
    rig.operator = land_after(rig, 3.0)
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    assert all(math.isfinite(v) for t in rig.watcher.ticks for v in t.telemetry.position_m)
    assert 0.08 < max(t.telemetry_age_s for t in rig.watcher.ticks) < 0.15


def test_telemetry_that_stays_away_lands() -> None:
    rig = Rig(Vehicle(lambda s: None if 1.5 < s.t_s < 4.0 else s))
    landed_for(rig, "the newest telemetry is 1.0 s old")
    assert rig.link.said(Land)[0] == pytest.approx(1.5 + 1.0, abs=0.06)


STILL, SMALL = noise(0), noise(0)[:24, :32]


@pytest.mark.parametrize(("bad", "words"), [
    (lambda f: replace(f, t_s=f.t_s - 0.5), "old"),
    (lambda f: replace(f, image=STILL), "is frozen"),  # the receiver repeats an old picture
    (lambda f: replace(f, image=SMALL + f.index % 7), "32x24 px, but the calibration was made at"),
], ids=["late", "frozen", "of another size"])  # fmt: skip
def test_a_bad_picture_is_no_measurement(bad: Callable[..., Any], words: str) -> None:
    """Nothing is raised in the air: the camera counts as gone, is named, and landed for."""
    rig = Rig(camera=Camera(lambda f: bad(f) if f.t_arrival_s > BAD_S else f))
    landed_for(rig, words)
    # The first repeated one is like any other picture.
    measured = [t.t_s for t in rig.watcher.ticks if t.output is not None]
    assert max(measured) < BAD_S + 1.5 * PERIOD_S * (words == "is frozen") + 1e-9
    assert max(t.last_good_frame_age_s for t in rig.watcher.ticks) > PROFILE.safety.camera_land_s


def test_a_camera_that_reports_a_failure_lands_with_its_words() -> None:
    rig = Rig()

    def unplug(tick: Tick) -> None:
        if tick.t_s > BAD_S:
            rig.camera.told = "the plug was pulled"

    rig.watcher.on_tick = unplug
    landed_for(rig, "the plug was pulled")


def test_a_lost_link_lands() -> None:
    rig = Rig()
    rig.link.dies_at_s = BAD_S
    landed_for(rig, "the script ended the link")
    assert rig.link.said(Land)[0] == pytest.approx(BAD_S, abs=0.05)


@pytest.mark.parametrize("strict", [False, True])
def test_a_log_that_fails_is_said_once_and_landed_for_where_the_profile_wants_it(
    strict: bool,
) -> None:
    rig = Rig(profile=changed({"safety.land_on_log_error": strict}))
    rig.operator = land_after(rig, 3.0)

    def fill_up(tick: Tick) -> None:
        rig.watcher.problem = "the disk is full"

    rig.watcher.on_tick = fill_up
    report = rig.fly()
    assert report.outcome is (Outcome.SAFETY if strict else Outcome.ENDED_BY_OPERATOR)
    assert ("the disk is full" in report.reason) is strict
    said = [e for e in rig.watcher.events if "incomplete" in e.reason]
    assert [e.kind for e in said] == [EventKind.NOTE]
    assert "the disk is full" in said[0].reason


@pytest.mark.parametrize("is_set", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_mirrored_picture_is_named(monkeypatch: pytest.MonkeyPatch, is_set: bool) -> None:
    real = perception.step

    def mirrored(*arguments: Any) -> Any:
        state, output = real(*arguments)
        seen = Detections(
            output.detections.frame_index, output.detections.t_s, is_mirrored_marker_seen=True
        )
        return state, replace(output, detections=seen)

    monkeypatch.setattr(perception, "step", mirrored)
    report = Rig(profile=changed({"camera.mirrored": is_set})).fly()
    assert report.outcome is Outcome.TARGET_NOT_FOUND
    assert "the picture is mirrored" in report.reason
    assert ("remove camera.mirrored" if is_set else "set camera.mirrored") in report.reason


# --- Time ---------------------------------------------------------------------------------------


def test_a_suspended_computer_lands_and_does_not_catch_up() -> None:
    rig = Rig()
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=30.0)
    assert rig.fly().outcome is Outcome.SAFETY
    times = np.array([t.t_s for t in rig.watcher.ticks])
    gap = int(np.argmax(np.diff(times)))
    assert times[gap + 1] - times[gap] > 29.0
    assert np.diff(times[gap + 1 :]).min() > 0.5 * PERIOD_S  # no burst of stale turns
    assert rig.link.said(Land)[0] == times[gap + 1]  # at once
    assert rig.watcher.ticks[gap + 1].tick_start_delay_s > 29.0
    assert not [t for t in rig.link.said(PositionSetpoint) if t > times[gap]]


# --- Before take-off: refused at once, or waited for ----------------------------------------------


HANGS = (0.0, 0.0, 2.1)


AT_ONCE: list[tuple[dict[str, Any], str]] = [
    ({"supervisor": READY | LOCKED}, "locked"),
    ({"supervisor": READY | CRASHED}, "crash"),
    ({"supervisor": READY | TUMBLED}, "upside down"),
    ({"supervisor": READY | DECK_FAULT}, "deck"),
    ({"supervisor": READY | FLYING}, "already flying"),
    ({"supervisor": READY | 1 << 13}, "unknown bits .0x200E"),
    ({"battery_v": 3.4}, r"3\.40 V.*3\.80 V.*charge"),
    ({"battery_v": 6.05}, r"voltage is 6\.05 V, but a single cell has at most 4\.40 V"),
    ({"position_m": HANGS}, r"at 2\.10 m.*hanging.*take it down.*safety\.ground_z_m"),
    ({"position_m": (0.0, 0.0, -0.3)}, r"at -0\.30 m"),
]
IN_TIME: list[tuple[dict[str, Any], str]] = [
    (
        {"velocity_variance_m2ps2": 0.5},
        r"settle.*velocity's variance is 0\.50 \(m/s\)\^2, but at most",
    ),
    ({"height_variance_m2": math.nan}, "settle"),
    ({"variance_behind_s": 3.0}, r"settle .the variances are 3\.0 s old"),
    ({"battery_v": math.nan}, r"no battery voltage: .*link\.unreported: \[battery\]"),
    ({"behind_s": math.nan}, "waited 10 s for telemetry"),
    ({"supervisor": 0x06}, "0x0006"),
    ({"roll_rad": 0.3}, "be level .tilted by 17 deg, but at most 10"),
    ({"acc_z_g": 0.7}, r"be at rest .*0\.70 g"),
]
IN_TIME_LIKEWISE: list[tuple[dict[str, Any], str]] = [
    ({"velocity_variance_m2ps2": math.nan}, r"settle.*check the positioning system"),
    ({"height_variance_m2": 1.0}, r"settle.*height's variance is 1\.00 m\^2, but at most 0\.01"),
    ({"velocity_variance_m2ps2": 0.5, "position_m": HANGS}, "settle"),  # it is no height
    (
        {"velocity_variance_m2ps2": None},
        r"settle .the vehicle reports no variance for its velocity",
    ),
    ({"height_variance_m2": None}, r"no variance for its height: .*link\.unreported: \[variance\]"),
    ({"variance_behind_s": math.nan}, "the variances are nan s old"),
    ({"battery_v": 0.0}, "no battery voltage"),
    ({"battery_behind_s": 3.0}, r"the battery voltage is 3\.0 s old"),
    ({"battery_behind_s": math.inf}, r"the battery voltage is inf s old"),
    ({"pitch_rad": -0.2}, "tilted by 11 deg"),
    ({"acc_z_g": 1.2}, r"1\.20 g"),
]
NO_PICTURE = Camera(lambda frame: None)


@pytest.mark.parametrize(("changes", "words", "waits"), [
    *((*each, False) for each in AT_ONCE), *((*each, True) for each in IN_TIME),
    *(pytest.param(*each, True, marks=pytest.mark.long) for each in IN_TIME_LIKEWISE),
])  # fmt: skip
def test_a_vehicle_that_may_not_fly_or_is_not_ready_in_time_is_refused(
    changes: dict[str, Any], words: str, waits: bool
) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.refused(TimedOut if waits else SafetyAbort, words)
    limit_s = PROFILE.safety.estimator_wait_s if waits else 0.0
    assert rig.link.now_s == pytest.approx(limit_s, abs=0.2 if waits else 0.1)


@pytest.mark.parametrize(("unreported", "changes"), [
    ("battery", {"battery_v": math.nan, "battery_behind_s": math.inf}),
    ("variance", {"velocity_variance_m2ps2": None, "height_variance_m2": None,
                  "position_variance_m2": None, "variance_behind_s": math.inf}),
])  # fmt: skip
def test_a_profile_may_say_what_its_vehicle_never_reports(
    unreported: str, changes: dict[str, Any]
) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.profile = changed({"link.unreported": (unreported,)})
    rig.operator = land_after(rig, 3.0)
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    assert not any(tick.state.hold_reason for tick in rig.watcher.ticks)


@pytest.mark.parametrize("changes", [{"battery_v": 3.4}, {"velocity_variance_m2ps2": 0.5}])
def test_what_is_reported_all_the_same_still_counts(changes: dict[str, float]) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.profile = changed({"link.unreported": ("battery", "variance")})
    rig.refused(PerchError, "the resting battery voltage is|velocity's variance is")


@pytest.mark.parametrize(
    ("vehicle", "camera", "error", "words", "limit_s"),
    [
        (Vehicle(lambda sample: None), Camera(), TimedOut, "telemetry", 10.0),
        (Vehicle(), NO_PICTURE, TimedOut, "picture .none has arrived", 8.0),
        pytest.param(
            Vehicle(),
            Camera(lambda f: replace(f, t_s=f.t_s - 5.0)),
            TimedOut,
            "5.* s old",
            8.0,
            marks=pytest.mark.long,
        ),
        (
            Vehicle(),
            Camera(lambda f: replace(f, t_s=f.t_s + 0.2)),
            TimedOut,
            "is in the future",
            8.0,
        ),
        pytest.param(
            Vehicle(),
            Camera(lambda f: replace(f, t_s=math.nan)),
            TimedOut,
            "nan s, is in the future",
            8.0,
            marks=pytest.mark.long,
        ),
        # Against the ceiling the camera is dark.
        (
            Vehicle(lambda s: replace(s, position_m=HANGS)),
            NO_PICTURE,
            SafetyAbort,
            "is hanging",
            0.0,
        ),
        (Vehicle(), Camera(size_px=(320, 240)), InvalidValue, "320x240.*64x48", 0.0),
        (Vehicle(), Camera(live=False, frames=1), NotFound, "ended before take-off", 0.0),
    ],
)
def test_what_does_not_come_is_refused(
    vehicle: Vehicle, camera: Camera, error: type[PerchError], words: str, limit_s: float
) -> None:
    Rig(vehicle, camera).refused(error, words)
    assert limit_s <= vehicle.now_s < limit_s + 0.2


# --- What was good once: all of it has to be good at the moment of the take-off -------------------

READY_S = 3.0
"""Until then the supervisor does not allow flight."""


def is_late(changes: Callable[[Telemetry], Telemetry] = lambda s: s) -> Vehicle:
    return Vehicle(lambda s: changes(s) if s.t_s >= READY_S else replace(s, supervisor=0x06))


def once(bad: Callable[[Any], Any]) -> Camera:
    """Good for a second, and then as `bad` has it."""
    return Camera(lambda frame: frame if frame.t_arrival_s < 1.0 else bad(frame))


@pytest.mark.parametrize(("camera", "words"), [
    (once(lambda f: None), r"a good picture .none for 8\.0 s"),
    (once(lambda f: replace(f, image=STILL)), "a good picture .*is frozen"),
    pytest.param(once(lambda f: replace(f, image=SMALL)), "a good picture .*32x24 px",
                 marks=pytest.mark.long),
    pytest.param(once(lambda f: replace(f, t_s=f.t_s - 5.0)), r"a good picture .*5\.\d s old",
                 marks=pytest.mark.long),
], ids=["silent", "frozen", "of another size", "late"])  # fmt: skip
def test_a_camera_that_was_good_once_is_not_flown_with(camera: Camera, words: str) -> None:
    rig = Rig(is_late(), camera)
    rig.refused(TimedOut, words)
    assert rig.link.now_s == pytest.approx(1.0 + PROFILE.camera.start_timeout_s, abs=0.3)


def test_a_camera_that_fell_silent_is_refused_by_its_own_words() -> None:
    rig = Rig(is_late(), once(lambda f: None))
    rig.camera.told = None

    def poll(frame: Any) -> Any:
        rig.camera.told = "the plug was pulled" if frame.t_arrival_s > 1.0 else None
        return None if rig.camera.told else frame

    rig.camera.alter = poll
    rig.refused(TimedOut, "a good picture .the plug was pulled")


def first_setpoint_s(rig: Rig) -> float:
    rig.operator = lambda: (
        OperatorRequest.LAND if rig.link.said(PositionSetpoint) else OperatorRequest.NONE
    )
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    return rig.link.said(PositionSetpoint)[0]


def test_begin_turn_is_called_in_every_turn_from_the_first_one_on() -> None:
    """Your `should_stop` is asked while the vehicle is not ready yet, too."""
    rig = Rig(is_late())
    rig.operator = lambda: (
        OperatorRequest.LAND if rig.link.said(PositionSetpoint) else OperatorRequest.NONE
    )
    called_s: list[float] = []
    fly(replace(rig.parts(), begin_turn=lambda: called_s.append(rig.link.now_s)))
    period_s = 1.0 / PROFILE.link.loop_hz
    assert called_s[0] < period_s
    assert sum(t_s < READY_S for t_s in called_s) >= 0.9 * READY_S / period_s


def test_a_camera_that_comes_back_is_flown_with() -> None:
    gone = Camera(lambda f: None if 1.0 < f.t_arrival_s < 6.0 else f)
    assert first_setpoint_s(Rig(is_late(), gone)) == pytest.approx(6.0, abs=0.1)
    short = Camera(lambda f: None if READY_S - 0.3 < f.t_arrival_s < READY_S + 2.0 else f)
    assert first_setpoint_s(Rig(is_late(), short)) == pytest.approx(READY_S, abs=0.1)


def test_a_single_bad_picture_is_not_the_one_to_take_off_by() -> None:
    bad = Camera(lambda f: replace(f, image=SMALL) if f.t_arrival_s < 0.05 else f)
    assert first_setpoint_s(Rig(camera=bad)) == pytest.approx(0.06, abs=0.03)
    at = Camera(lambda f: replace(f, image=SMALL) if 0 <= f.t_arrival_s - READY_S < 0.05 else f)
    assert first_setpoint_s(Rig(is_late(), at)) == pytest.approx(READY_S + 0.06, abs=0.03)


def test_what_the_rest_was_good_for_is_asked_again() -> None:
    """Battery, variances, and a position that stands still while the accelerometer does not."""
    for changes, words in (
        ({"battery_behind_s": 2.0}, "battery voltage is 2.0 s old"),
        ({"variance_behind_s": 2.0}, "variances are 2.0 s old"),
    ):
        rig = Rig(is_late(lambda s, c=changes: replace(s, **c)))  # type: ignore[misc]
        rig.refused(TimedOut, words)
    frozen: dict[str, Any] = {"position_m": (0.0, 0.0, 0.0), "velocity_mps": (0.0, 0.0, 0.0)}
    rig = Rig(Vehicle(lambda s: replace(s, **frozen) if s.t_s > -1.0 else s))
    rig.refused(TimedOut, r"telemetry .the newest is 1\d\.\d s old")


def test_a_camera_that_is_good_at_wrong_times_is_waited_for_no_longer_than_all() -> None:
    turn = GroundTurn(
        PROFILE, 0.0, [telemetry(0.1 * k, 0.0, supervisor=READY) for k in range(21)],
        picture_problem="snow", unseen_s=0.1,
    )  # fmt: skip
    assert still_waiting_for(replace(turn, waited_s=15.0)) == "a good picture (snow)"
    with pytest.raises(TimedOut, match=r"a good picture \(snow\)"):
        still_waiting_for(replace(turn, waited_s=20.0))


def test_a_link_that_has_a_problem_is_not_flown_with() -> None:
    rig = Rig(is_late())
    rig.link.dies_at_s = 2.0
    rig.refused(TimedOut, r"the link .the script ended the link")


def test_a_turn_that_hung_is_not_taken_off_by() -> None:
    rig = Rig(Guarded())
    hang_in_the_camera(rig.link, rig.camera, -1.0, 1.0)
    assert first_setpoint_s(rig) == pytest.approx(1.0, abs=0.1)
    rig = Rig(Guarded())
    poll = rig.camera.poll

    def slow(now_s: float) -> Any:
        frame = poll(now_s)
        rig.link.advance_to(now_s + 0.4)
        return frame

    rig.camera.poll = slow  # type: ignore[method-assign]
    rig.refused(TimedOut, r"the flight loop to keep up .a tick took 0\.4 s")


def test_a_mirrored_picture_on_the_ground_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perception.Perception, "is_mirrored", True)
    Rig().refused(SafetyAbort, "the picture is mirrored: .*camera.mirrored")


def test_a_log_that_fails_on_the_ground_is_no_flight_where_it_would_be_landed_for() -> None:
    rig = Rig(profile=changed({"safety.land_on_log_error": True}))
    rig.watcher.problem = "the disk is full"
    rig.refused(SafetyAbort, "flight log: the disk is full")


def test_ctrl_c_on_the_ground_starts_nothing() -> None:
    Rig(operator=lambda: OperatorRequest.LAND).refused(Interrupted, "nothing was started")


def waits(z_m: float = 0.0, waited_s: float = 0.0, age_s: float = 0.0, target: Any = None,
          **safety: float) -> str:  # fmt: skip
    profile = PROFILE.model_copy(update={"safety": PROFILE.safety.model_copy(update=safety)})
    at_rest = [telemetry(0.1 * k, z_m, thrust=0.0, supervisor=READY) for k in range(21)]
    turn = GroundTurn(profile, waited_s, at_rest, telemetry_age_s=age_s, target=target)
    return still_waiting_for(turn)


@pytest.mark.parametrize(
    ("age_s", "is_old"), [(0.02, False), (0.2, False), (0.5, True), (5.0, True), (math.nan, True)]
)
def test_old_telemetry_is_waited_for(age_s: float, is_old: bool) -> None:
    """It may have stopped while the camera was waited for: nothing is taken over on it."""
    assert ("old" in waits(age_s=age_s)) is is_old
    if is_old:
        with pytest.raises(TimedOut, match="old"):
            waits(waited_s=PROFILE.safety.estimator_wait_s + 0.1, age_s=age_s)


@pytest.mark.parametrize(("away_m", "tracked", "flies"), [
    (0.2, True, False), (0.2, False, True), (1.5, True, True),
])  # fmt: skip
def test_a_target_within_reach_is_refused(away_m: float, tracked: bool, flies: bool) -> None:
    gear_m = PROFILE.vehicle.gear_body_m[2]
    target = target_at(1.0, (0.0, 0.0, gear_m + away_m), (0.0, 0.0, 0.0), tracked=tracked)
    if flies:
        assert waits(target=target) == ""
        return
    with pytest.raises(SafetyAbort, match=r"target is only 0\.20 m away.*take it down"):
        waits(target=target)
