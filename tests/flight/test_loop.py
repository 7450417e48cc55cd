"""The flight loop on a scripted vehicle and a scripted camera: whatever happens, land first."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import Interrupted, InvalidValue, NotFound, SafetyAbort, TimedOut
from perchctl.flight import loop, senses
from perchctl.flight.loop import FlightParts, fly
from perchctl.flight.rescue import rescue
from perchctl.link.mock import ScriptedLink
from perchctl.mission.landing import LEAST_ORDERS, MAX_ORDERS, PEEL_BLIND_S, own_landing
from perchctl.mission.state import Operator, Outcome, Phase
from perchctl.mission.watch import Event, FlightReport, Tick
from perchctl.pipeline import Pipeline, make_pipeline
from perchctl.positioning.feed import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import (
    CRASHED,
    DECK_FAULT,
    FLYING,
    HL_ACTIVE,
    LOCKED,
    TUMBLED,
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    StopMotors,
    Telemetry,
)
from perchctl.vision.types import CameraModel, Frame
from tests.helpers.mission import AIRBORNE, HOVER_THRUST, READY, telemetry

SIZE_PX = (64, 48)
CAMERA = CameraModel(
    SIZE_PX, np.array([[40.0, 0.0, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]]), np.zeros(5)
)
PROFILE = Profile()
SETUP = make_pipeline(PROFILE, CAMERA)
PERIOD_S = 1.0 / PROFILE.link.loop_hz
CLIMB_MPS = 0.5
SINK_MPS = 0.4


class Vehicle(ScriptedLink):
    """A scripted link that also does as it is told: takes off, lands, stops.

    `changed` alters each sample; None leaves it out. `delay_s` later it has arrived.
    """

    def __init__(
        self,
        changed: Callable[[Telemetry], Telemetry | None] = lambda sample: sample,
        delay_s: float = 0.01,
    ) -> None:
        super().__init__([])
        self._changed = changed
        self._delay_s = delay_s
        self._samples: list[Telemetry] = []
        self.z_m = 0.0
        self._goal_m: float | None = None
        self.by_itself = False
        self.motors = False
        self.by_itself = False
        self._off_s = -math.inf

    def advance_to(self, t_s: float) -> None:
        while self.now_s < t_s - 1e-9:
            self.now_s = min(self.now_s + 0.01, t_s)
            self._live(0.01)

    def telemetry(self) -> list[Telemetry]:
        due_s = self.now_s - self._delay_s + 1e-9
        arrived = [s for s in self._samples if s.t_s <= due_s]
        self._samples = [s for s in self._samples if s.t_s > due_s]
        return arrived

    def send(self, command: Command) -> None:
        super().send(command)
        match command:
            case PositionSetpoint(z_m=height):
                self._goal_m, self.motors, self.by_itself = height, True, False
            case Land(height, _):
                self._goal_m, self.motors, self.by_itself = height, True, True
            case StopMotors():
                self._stop()

    def _live(self, dt_s: float) -> None:
        if self._goal_m is not None and self.motors:
            way = self._goal_m - self.z_m
            self.z_m += max(-SINK_MPS * dt_s, min(CLIMB_MPS * dt_s, way))
            if self.by_itself and self.z_m <= 0.0 and self._goal_m <= 0.0:
                self.z_m = 0.0
                self._stop()
        in_air = self.motors or self.now_s - self._off_s < 2.0
        bits = AIRBORNE if in_air else READY
        if self.motors and self.by_itself:
            bits |= HL_ACTIVE
        sample = telemetry(
            self.now_s,
            self.z_m,
            supervisor=bits,
            thrust=HOVER_THRUST if self.motors else 0.0,
        )
        changed = self._changed(sample)
        if changed is not None:
            self._samples.append(changed)

    def _stop(self) -> None:
        if self.motors:
            self._off_s = self.now_s
        self.motors = False

    def said(self, kind: type) -> list[float]:
        """When commands of that kind were sent."""
        return [t_s for t_s, command in self.sent if isinstance(command, kind)]


class Clock:
    def __init__(self, link: ScriptedLink) -> None:
        self._link = link

    def now(self) -> float:
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        self._link.advance_to(max(t_s, self._link.now_s))


class SleepyClock(Clock):
    """A computer that is suspended once, at `at_s`, for `for_s`."""

    def __init__(self, link: ScriptedLink, at_s: float, for_s: float) -> None:
        super().__init__(link)
        self._at_s, self._for_s = at_s, for_s
        self._slept = False

    def wait_until(self, t_s: float) -> None:
        super().wait_until(t_s)
        if not self._slept and self.now() >= self._at_s:
            self._slept = True
            self._link.advance_to(self.now() + self._for_s)


def noise(number: int) -> np.ndarray:
    rng = np.random.default_rng(number)
    return rng.normal(120, 6, SIZE_PX[::-1]).clip(0, 255).astype(np.uint8)


@dataclass
class Camera:
    """Gives a frame a tick; `alter` changes it, or None gives none."""

    alter: Callable[[Frame], Frame | None] = lambda frame: frame
    live: bool = True
    frames: int | None = None
    size_px: tuple[int, int] = SIZE_PX
    count: int = 0
    told: str | None = None

    @property
    def finished(self) -> bool:
        return self.frames is not None and self.count >= self.frames

    def poll(self, now_s: float) -> Frame | None:
        if self.finished:
            return None
        self.count += 1
        return self.alter(Frame(self.count, now_s - 0.05, noise(self.count), now_s))

    def problem(self, now_s: float) -> str | None:
        return self.told

    def describe(self) -> str:
        return "the scripted camera"

    def close(self) -> None:
        return None


@dataclass
class Watcher:
    """Remembers what it saw; `on_tick` may raise, or steer."""

    on_tick: Callable[[Tick], None] = lambda tick: None
    ticks: list[Tick] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    problem: str | None = None

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)
        self.on_tick(tick)

    def event(self, event: Event) -> None:
        self.events.append(event)


@dataclass
class Rig:
    """A vehicle, a camera, a watcher and a loop around them."""

    link: Vehicle = field(default_factory=Vehicle)
    camera: Camera = field(default_factory=Camera)
    watcher: Watcher = field(default_factory=Watcher)
    clock: Clock | None = None
    profile: Profile = PROFILE
    setup: Pipeline = SETUP
    operator: Callable[[], Operator] = lambda: Operator.NONE
    positions: Callable[[float], FeedStatus] | None = None

    def parts(self) -> FlightParts:
        return FlightParts(
            self.link,
            self.camera,
            self.clock or Clock(self.link),
            self.profile,
            self.setup,
            (self.watcher,),
            self.operator,
            positions=self.positions,
        )

    def fly(self) -> FlightReport:
        return fly(self.parts())

    def rescue(self, known: Telemetry | None, **more: Any) -> None:
        landing = self.profile.planner.landing
        rescue(self.link, self.clock or Clock(self.link), landing, self.operator, known, **more)

    def refused(self, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            self.fly()
        assert not [c for _, c in self.link.sent if not isinstance(c, Idle)]


# --- Something breaks in the air -----------------------------------------------------------


class Broken(RuntimeError):
    pass


def _break(*_: Any, **__: Any) -> Any:
    raise Broken("by the test")


def _later(real: Callable[..., Any], calls: int) -> Callable[..., Any]:
    """As the real one, until the given number of calls."""
    left = [calls]

    def step(*arguments: Any) -> Any:
        left[0] -= 1
        return real(*arguments) if left[0] >= 0 else _break()

    return step


def landed_after_a_break(rig: Rig) -> None:
    with pytest.raises(Broken):
        rig.fly()
    assert rig.link.said(PositionSetpoint)
    orders_s = rig.link.said(Land)
    assert 1 <= len(orders_s) <= MAX_ORDERS
    assert orders_s[0] > rig.link.said(PositionSetpoint)[0]
    land = next(c for _, c in rig.link.sent if isinstance(c, Land))
    assert land.height_m < 0.0
    assert land.duration_s >= 1.0
    assert rig.link.z_m == 0.0  # it was waited for
    assert not rig.link.motors


AIRBORNE_TICKS = 60


def test_a_failure_in_vision_lands_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(senses, "step", _later(senses.step, AIRBORNE_TICKS))
    landed_after_a_break(Rig())


def test_a_failure_in_the_planner_lands_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop.planner, "step", _later(loop.planner.step, AIRBORNE_TICKS))
    landed_after_a_break(Rig())


def test_a_failure_of_a_watcher_lands_first() -> None:
    rig = Rig()
    rig.watcher.on_tick = lambda tick: _break() if tick.t_s > 1.2 else None
    landed_after_a_break(rig)


def test_a_failure_of_the_camera_lands_first() -> None:
    rig = Rig()
    rig.camera.alter = lambda frame: _break() if frame.t_arrival_s > 1.2 else frame
    landed_after_a_break(rig)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_even_an_exit_lands_first(error: type[BaseException]) -> None:
    def leave(tick: Tick) -> None:
        if tick.t_s > 1.2:
            raise error

    rig = Rig(watcher=Watcher(leave))
    with pytest.raises(error):
        rig.fly()
    assert rig.link.said(Land)
    assert rig.link.z_m == 0.0


def test_a_failure_on_the_ground_starts_nothing() -> None:
    rig = Rig(camera=Camera(_break))
    with pytest.raises(Broken):
        rig.fly()
    assert rig.link.sent == []


@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.1])
def test_a_failure_right_after_the_take_off_order_lands(after_s: float) -> None:
    """The order does not show in the telemetry yet, and a vehicle in high-level flight would
    hover for ever (docs/firmware.md, "When setpoints stop")."""
    rig = Rig(Vehicle(delay_s=0.15))

    def leave(tick: Tick) -> None:
        orders = rig.link.said(PositionSetpoint)
        if orders and tick.t_s >= orders[0] + after_s - 1e-9:
            raise Broken

    rig.watcher.on_tick = leave
    landed_after_a_break(rig)


def test_a_failure_while_hanging_with_the_motors_off_starts_nothing() -> None:
    """The flying bit outlives the motors by two seconds."""
    hanging = Vehicle(lambda s: replace(s, supervisor=AIRBORNE, thrust=0.0))
    hanging.advance_to(1.0)
    rig = Rig(hanging)
    rig.rescue(telemetry(1.0, 2.0, thrust=0.0))
    assert rig.link.sent == []
    assert rig.link.now_s < 2.0


def test_a_rescue_at_the_ceiling_peels_off_first() -> None:
    """The vehicle's own landing would run by its clock and end up there, motors off."""
    pressed = Vehicle()
    pressed.z_m, pressed.motors = 2.0, True
    rig = Rig(pressed)
    rig.rescue(telemetry(0.0, 2.0), held_m=2.0)
    first = rig.link.sent[0][1]
    assert isinstance(first, PositionSetpoint)
    assert first.z_m < 1.8
    assert rig.link.said(Land)[0] > rig.link.said(PositionSetpoint)[-1]
    assert rig.link.z_m == 0.0


def test_a_rescue_of_what_does_not_peel_off_lands_all_the_same() -> None:
    stuck = Vehicle(lambda s: replace(s, position_m=(0.0, 0.0, 2.0)))
    stuck.z_m, stuck.motors = 2.0, True
    rig = Rig(stuck)
    rig.rescue(telemetry(0.0, 2.0), held_m=2.0)
    assert PEEL_BLIND_S <= rig.link.said(Land)[0] < PEEL_BLIND_S + 0.2


def test_the_rescue_is_bounded() -> None:
    """A vehicle that never says it has landed is not waited for for ever."""
    rig = Rig(Vehicle(lambda s: replace(s, supervisor=AIRBORNE | HL_ACTIVE)))
    rig.rescue(telemetry(0.0))
    assert rig.link.now_s == pytest.approx(PROFILE.planner.landing.timeout_s, abs=0.2)
    assert len(rig.link.said(Land)) == LEAST_ORDERS


def test_the_rescue_orders_again_what_shows_no_effect() -> None:
    rig = Rig(Vehicle(lambda s: replace(s, supervisor=AIRBORNE, thrust=HOVER_THRUST)))
    rig.rescue(telemetry(0.0))
    assert np.diff(rig.link.said(Land)).min() > 0.3
    assert len(rig.link.said(Land)) == MAX_ORDERS


def orders(rig: Rig) -> list[Land]:
    return [command for _, command in rig.link.sent if isinstance(command, Land)]


def test_a_rescue_lands_on_the_ground_that_it_started_from() -> None:
    """On a table its own landing would else end below it, or over the floor far above."""
    aims = []
    for ground_z_m in (-1.0, 0.0, 0.75):
        rig = Rig()
        rig.rescue(telemetry(0.0, 1.5), ground_z_m=ground_z_m)
        aims.append(orders(rig)[0].height_m - ground_z_m)
    assert aims == pytest.approx([aims[0]] * 3)
    assert -1.0 < aims[0] <= 0.0


def test_a_rescue_without_positions_from_outside_aims_as_the_planner_does() -> None:
    aims = []
    for blind_s in (0.0, 2.0):
        rig = Rig()
        rig.rescue(telemetry(0.0, 1.5), blind_s=blind_s)
        aims.append(orders(rig)[0])
    expected = own_landing(PROFILE.planner.landing, 0.0, 0.0, telemetry(0.0, 1.5), 2.0)
    assert aims[1] == expected
    assert aims[1].height_m < aims[0].height_m - 0.2


def test_a_rescue_steers_by_no_number_that_is_none() -> None:
    rig = Rig(Vehicle(lambda s: replace(s, position_m=(math.nan,) * 3, supervisor=AIRBORNE)))
    rig.rescue(telemetry(0.0, 2.0), held_m=2.0)
    assert all(order.duration_s > 5.0 for order in orders(rig))
    places = [c.z_m for _, c in rig.link.sent if isinstance(c, PositionSetpoint)]
    assert places
    assert all(z_m < 2.0 for z_m in places)


def test_a_rescue_without_telemetry_still_orders_the_landing() -> None:
    rig = Rig(Vehicle(lambda s: None))
    rig.rescue(telemetry(0.0))
    assert rig.link.said(Land)


def test_ctrl_c_twice_stops_a_rescue_too() -> None:
    rig = Rig(
        Vehicle(lambda s: replace(s, supervisor=AIRBORNE | HL_ACTIVE)),
        operator=lambda: Operator.STOP if rig.link.now_s > 0.5 else Operator.NONE,
    )
    rig.rescue(telemetry(0.0))
    assert rig.link.said(EmergencyStop)[0] == pytest.approx(0.6, abs=0.11)
    assert rig.link.now_s < 1.0


# --- Refusals before take-off ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"supervisor": READY | LOCKED}, "locked"),
        ({"supervisor": READY | CRASHED}, "crash"),
        ({"supervisor": READY | TUMBLED}, "upside down"),
        ({"supervisor": READY | DECK_FAULT}, "deck"),
        ({"supervisor": READY | FLYING}, "flying already"),
        ({"supervisor": READY | 1 << 13}, "unknown bits .0x200E"),
        ({"battery_v": 3.4}, r"3\.40 V.*3\.80 V.*charge"),
    ],
    ids=["locked", "crashed", "tumbled", "deck", "flying", "unknown", "battery"],
)
def test_a_vehicle_that_may_not_fly_is_refused(changes: dict[str, Any], words: str) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.refused(SafetyAbort, words)
    assert rig.link.now_s < 0.1  # at once


@pytest.mark.parametrize(
    ("rig", "words", "limit_s"),
    [
        (lambda: Rig(Vehicle(lambda sample: None)), "telemetry", 10.0),
        (
            lambda: Rig(Vehicle(lambda sample: replace(sample, position_variance_m2=0.5))),
            r"variance 0\.5.*positioning",
            10.0,
        ),
        (lambda: Rig(Vehicle(lambda sample: replace(sample, supervisor=0x06))), "0x0006", 10.0),
        (lambda: Rig(camera=Camera(lambda frame: None)), "picture .none has come", 8.0),
        (
            lambda: Rig(camera=Camera(lambda frame: replace(frame, t_s=frame.t_s - 5.0))),
            "picture .*5.* s late",
            8.0,
        ),
    ],
    ids=["no telemetry", "unsettled estimate", "may not fly", "no picture", "old pictures"],
)
def test_what_does_not_come_in_time_is_refused(
    rig: Callable[[], Rig], words: str, limit_s: float
) -> None:
    it = rig()
    it.refused(TimedOut, words)
    assert limit_s < it.link.now_s < limit_s + 0.2


def test_an_estimate_that_settles_is_waited_for() -> None:
    rig = Rig(
        Vehicle(lambda s: replace(s, position_variance_m2=0.5 if s.t_s < 3.0 else 1e-4)),
        operator=lambda: Operator.LAND if rig.link.said(PositionSetpoint) else Operator.NONE,
    )
    rig.fly()
    assert 3.0 <= rig.link.said(PositionSetpoint)[0] < 3.2


def test_pictures_of_another_size_are_refused() -> None:
    Rig(camera=Camera(size_px=(320, 240))).refused(InvalidValue, "320x240.*64x48")


def test_a_recording_that_has_ended_is_refused() -> None:
    Rig(camera=Camera(live=False, frames=1)).refused(NotFound, "ended before take-off")


def test_ctrl_c_on_the_ground_starts_nothing() -> None:
    Rig(operator=lambda: Operator.LAND).refused(Interrupted, "nothing was started")


# --- Bad measurements ---------------------------------------------------------------------------


def test_telemetry_that_is_no_number_is_left_out() -> None:
    """Ten samples of NaN in the air: no jump, no command with NaN, the flight goes on."""
    nan = (math.nan, 0.0, 0.5)
    rig = Rig(
        Vehicle(lambda s: replace(s, position_m=nan) if 1.5 < s.t_s < 1.6 else s),
        operator=lambda: Operator.LAND if rig.link.now_s > 3.0 else Operator.NONE,
    )
    report = rig.fly()
    assert report.outcome is Outcome.OPERATOR
    assert all(math.isfinite(v) for t in rig.watcher.ticks for v in t.telemetry.position_m)
    ages = [t.telemetry_age_s for t in rig.watcher.ticks]
    assert 0.08 < max(ages) < 0.15


def test_telemetry_that_stays_away_lands() -> None:
    rig = Rig(Vehicle(lambda s: None if 1.5 < s.t_s < 4.0 else s))
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "no telemetry" in report.reason
    assert rig.link.said(Land)[0] == pytest.approx(1.5 + 1.0, abs=0.06)


def _measured(rig: Rig) -> list[Tick]:
    return [t for t in rig.watcher.ticks if t.output is not None]


def test_an_old_picture_is_no_measurement() -> None:
    """Pictures half a second late from a certain time on: none of them is used, and the
    camera counts as gone."""
    late_from_s = 2.0
    rig = Rig(
        camera=Camera(lambda f: replace(f, t_s=f.t_s - 0.5) if f.t_arrival_s > late_from_s else f)
    )
    report = rig.fly()
    assert max(t.t_s for t in _measured(rig)) <= late_from_s + 1e-9
    assert report.outcome is Outcome.SAFETY
    assert "late" in report.reason


def test_a_frozen_picture_is_no_measurement() -> None:
    """New frames with the same bytes: the receiver repeats an old picture."""
    frozen_from_s = 2.0
    still = noise(0)
    rig = Rig(
        camera=Camera(lambda f: replace(f, image=still) if f.t_arrival_s > frozen_from_s else f)
    )
    report = rig.fly()
    # The first of them is like any other picture.
    assert max(t.t_s for t in _measured(rig)) < frozen_from_s + 1.5 * PERIOD_S
    assert report.outcome is Outcome.SAFETY
    assert "stands still" in report.reason
    ages = [t.camera_age_s for t in rig.watcher.ticks]
    assert max(ages) > PROFILE.safety.camera_land_s


def test_a_camera_that_reports_a_failure_lands_with_its_words() -> None:
    rig = Rig()

    def unplug(tick: Tick) -> None:
        if tick.t_s > 2.0:
            rig.camera.told = "the plug was pulled"

    rig.watcher.on_tick = unplug
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "the plug was pulled" in report.reason


def test_a_recording_that_ends_in_flight_lands() -> None:
    rig = Rig(camera=Camera(live=False, frames=100))
    report = rig.fly()
    assert report.phase is Phase.LANDED
    assert report.outcome is Outcome.SAFETY
    assert "the scripted camera has ended" in report.reason


def test_a_lost_link_lands() -> None:
    rig = Rig()
    rig.link._dies_at_s = 2.0
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    assert "the script ended the link" in report.reason
    assert rig.link.said(Land)[0] == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("strict", [False, True])
def test_a_log_that_fails_lands_only_where_the_profile_wants_it(strict: bool) -> None:
    safety = PROFILE.safety.model_copy(update={"land_on_log_error": strict})
    rig = Rig(
        profile=PROFILE.model_copy(update={"safety": safety}),
        operator=lambda: Operator.LAND if rig.link.now_s > 3.0 else Operator.NONE,
    )
    rig.watcher.problem = "the disk is full"
    report = rig.fly()
    assert report.outcome is (Outcome.SAFETY if strict else Outcome.OPERATOR)
    assert ("the disk is full" in report.reason) is strict


# --- Time ---------------------------------------------------------------------------------------


def test_a_suspended_computer_lands_and_does_not_catch_up() -> None:
    rig = Rig()
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=30.0)
    report = rig.fly()
    assert report.outcome is Outcome.SAFETY
    times = np.array([t.t_s for t in rig.watcher.ticks])
    gap = int(np.argmax(np.diff(times)))
    assert times[gap + 1] - times[gap] > 29.0
    after = times[gap + 1 :]
    assert np.diff(after).min() > 0.5 * PERIOD_S  # no burst of stale turns
    assert rig.link.said(Land)[0] == times[gap + 1]  # at once
    first = rig.watcher.ticks[gap + 1]
    assert first.loop_late_s > 29.0
    assert not [t for t in rig.link.said(PositionSetpoint) if t > times[gap]]


def test_a_short_hiccup_is_one_late_turn() -> None:
    rig = Rig(operator=lambda: Operator.LAND if rig.link.now_s > 4.0 else Operator.NONE)
    rig.clock = SleepyClock(rig.link, at_s=2.5, for_s=0.1)
    report = rig.fly()
    assert report.outcome is Outcome.OPERATOR
    late = [t for t in rig.watcher.ticks if t.loop_late_s > 0.05]
    assert len(late) == 1
    times = [t.t_s for t in rig.watcher.ticks]
    assert np.diff(times).min() > 0.5 * PERIOD_S


def test_every_turn_is_told_once_and_phases_are_announced() -> None:
    rig = Rig(operator=lambda: Operator.LAND if rig.link.now_s > 2.0 else Operator.NONE)
    report = rig.fly()
    times = [t.t_s for t in rig.watcher.ticks]
    assert np.diff(times) == pytest.approx(PERIOD_S, abs=1e-6)
    assert tuple(rig.watcher.events) == report.history
    assert report.duration_s == pytest.approx(times[-1] - times[0])
