"""A vehicle that does not arm itself: armed last, and disarmed whatever ends the session on the
ground; on a scripted vehicle, and on the simulated firmware in lockstep and through cflib."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.camera import FrameSource, WrappedSource, open_camera
from perchctl.errors import (
    ConnectionFailed,
    Interrupted,
    Note,
    NotFound,
    SafetyAbort,
    TimedOut,
    UsageError,
)
from perchctl.flight import FlyOptions, OperatorSwitch, fly_lockstep, fly_session
from perchctl.flight.preflight import ARMING_PAUSE_S, ARMS_WITHIN_S
from perchctl.link.crtp import encode
from perchctl.mission import OperatorRequest, Outcome, SentCommand, TickRecord
from perchctl.profile import find_calibration, load_profile
from perchctl.record import read_log
from perchctl.sim import SimProcess, draw_scenario
from perchctl.sim.airframe import CRAZYFLIE_21_BRUSHLESS
from perchctl.vehicle import (
    ARMED,
    AUTO_ARM,
    CAN_ARM,
    CAN_FLY,
    Arm,
    Command,
    EmergencyStop,
    PositionSetpoint,
    Telemetry,
)
from perchctl.vision import Frame
from tests.helpers.crtp_rig import wired
from tests.helpers.flights import SEED, SHORT
from tests.helpers.hangs import hang_in_the_camera
from tests.helpers.loop_rig import Camera, Guarded, Rig, Vehicle
from tests.helpers.waiting import until

SPIN_UP_S = 0.3
BLOCKED = replace(CRAZYFLIE_21_BRUSHLESS, spin_up_s=60.0)


# --- On the scripted loop -------------------------------------------------------------------


class Unarmed(Vehicle):
    """A vehicle that does not arm itself. `spins_up` is False for blocked propellers, `obeys` for
    a supervisor that takes no request; armed, it disarms itself after `lasts_s`."""

    def __init__(
        self, *, spins_up: bool = True, obeys: bool = True, lasts_s: float = math.inf
    ) -> None:
        super().__init__(self._with_bits)
        self._spins_up, self._obeys, self._lasts_s = spins_up, obeys, lasts_s
        self.armed_s: float | None = None

    def send(self, command: Command) -> None:
        super().send(command)
        if isinstance(command, Arm) and self._obeys and (self.armed_s is None or not command.armed):
            self.armed_s = self.now_s if command.armed else None

    def _with_bits(self, sample: Telemetry) -> Telemetry:
        armed_for_s = -1.0 if self.armed_s is None else sample.t_s - self.armed_s
        gives_up_s = self._lasts_s if self._spins_up else 2.0
        if armed_for_s > gives_up_s and not self.motors:
            self.armed_s, armed_for_s = None, -1.0
        if armed_for_s < 0.0:
            return replace(sample, supervisor=CAN_ARM)
        if armed_for_s < SPIN_UP_S or not self._spins_up:
            return replace(sample, supervisor=ARMED)
        return replace(sample, supervisor=sample.supervisor & ~AUTO_ARM)


def land_after(rig: Rig, t_s: float) -> Callable[[], OperatorRequest]:
    return lambda: OperatorRequest.LAND if rig.link.now_s > t_s else OperatorRequest.NONE


def test_it_is_armed_once_nothing_else_is_waited_for() -> None:
    """Also if that takes longer than a vehicle stays armed."""
    rig = Rig(Unarmed(), Camera(lambda frame: frame if frame.t_arrival_s > 4.0 else None))
    rig.operator = land_after(rig, 6.0)
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    (asked_s,) = rig.link.said(Arm)
    assert 4.0 < asked_s < 4.1
    assert rig.link.said(PositionSetpoint)[0] >= asked_s + SPIN_UP_S


def test_the_arming_of_an_earlier_question_does_not_matter() -> None:
    """It had been armed, and had disarmed itself by the time of the answer, half a minute later."""
    link = Unarmed()
    link.armed_s = -2.0
    link._lasts_s = 1.0
    rig = Rig(link)
    rig.operator = land_after(rig, 3.0)
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    assert len(link.said(Arm)) == 1


def test_what_somebody_else_has_armed_meanwhile_is_not_flown() -> None:
    link = Unarmed()
    link.armed_s = -0.5
    with pytest.raises(SafetyAbort, match="is armed, but not by perchctl: keep away"):
        Rig(link).fly()
    assert link.sent == []


def disturbed(
    link: Unarmed, change: Callable[[Telemetry], Telemetry], since_s: float, until_s: float
) -> Unarmed:
    """The vehicle, with its samples changed for a while."""

    def changed(sample: Telemetry) -> Telemetry:
        sample = link._with_bits(sample)
        return change(sample) if since_s < sample.t_s < until_s else sample

    link._changed = changed
    return link


def shaken(sample: Telemetry) -> Telemetry:
    return replace(sample, acc_z_g=1.3)


def tilted(sample: Telemetry) -> Telemetry:
    return replace(sample, roll_rad=sample.roll_rad + 0.5)  # alive


@pytest.mark.parametrize("lasts_s", [math.inf, 3.0], ids=["stays armed", "disarms itself"])
@pytest.mark.parametrize(("change", "words"), [(tilted, "to be level"), (shaken, "to be at rest")])
def test_a_vehicle_that_is_reached_for_once_armed_does_not_fly(
    change: Callable[[Telemetry], Telemetry], words: str, lasts_s: float
) -> None:
    """Even if it is put down again, and whether or not it has disarmed itself meanwhile."""
    link = disturbed(Unarmed(lasts_s=lasts_s), change, 0.2, 4.0)
    rig = Rig(link)
    with pytest.raises(SafetyAbort, match=rf"after arming, waited 0\.5 s for .*{words}.*disarming"):
        rig.fly()
    assert {type(command) for _, command in link.sent} == {Arm}
    assert link.said(Arm)[-1] < 0.2
    assert link.now_s == pytest.approx(0.2 + ARMING_PAUSE_S, abs=0.1)


def test_a_camera_that_falls_silent_once_it_is_armed_ends_it() -> None:
    link = Unarmed(spins_up=False)
    rig = Rig(link, Camera(lambda frame: frame if frame.t_arrival_s < 0.2 else None))
    with pytest.raises(SafetyAbort, match=r"after arming, waited .* for a good picture"):
        rig.fly()
    assert link.now_s < 1.5


def test_a_loop_that_hangs_once_it_is_armed_ends_it() -> None:
    """Nobody has watched the vehicle, whose propellers turn, for all that time."""
    link, camera = Unarmed(), Camera()
    hang_in_the_camera(link, camera, 0.1, 3.0)
    with pytest.raises(SafetyAbort, match=r"for the flight loop to keep up .a tick took 3"):
        Rig(link, camera).fly()
    assert not link.said(PositionSetpoint)


def test_a_moments_disturbance_once_it_is_armed_does_not_end_it() -> None:
    link = disturbed(Unarmed(), shaken, 0.2, 0.5)
    rig = Rig(link)
    rig.operator = land_after(rig, 3.0)
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    assert len(link.said(Arm)) == 1
    assert link.said(PositionSetpoint)[0] == pytest.approx(0.5, abs=0.1)


def test_a_word_given_in_a_slow_turn_comes_before_the_request() -> None:
    """The turn began before it, and ends with a vehicle that is ready to be armed."""
    link, camera = Unarmed(), Camera()
    hang_in_the_camera(link, camera, -1.0, 0.2)
    rig = Rig(
        link,
        camera,
        operator=lambda: OperatorRequest.LAND if link.now_s > 0.1 else OperatorRequest.NONE,
    )
    with pytest.raises(Interrupted, match="nothing was started"):
        rig.fly()
    assert link.sent == []


@pytest.mark.parametrize(
    ("link", "error", "words"),
    [
        (Unarmed(obeys=False), TimedOut, r"not be armed within 5 s \(supervisor 0x0001\): restart"),
        (Unarmed(spins_up=False), SafetyAbort, r"\(0x|supervisor 0x0001\): a propeller may be"),
    ],
    ids=["no request is taken", "its motors do not start"],
)
def test_a_vehicle_that_does_not_arm_does_not_fly(
    link: Unarmed, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        Rig(link).fly()
    assert {type(command) for _, command in link.sent} == {Arm}
    assert len(link.sent) <= 4 * ARMS_WITHIN_S + 1
    assert link.now_s < ARMS_WITHIN_S + 0.5


def test_ctrl_c_while_its_motors_start_ends_it_on_the_ground() -> None:
    rig = Rig(Unarmed())
    rig.operator = lambda: OperatorRequest.LAND if rig.link.said(Arm) else OperatorRequest.NONE
    with pytest.raises(Interrupted, match="before take-off: disarming"):
        rig.fly()
    assert not rig.link.said(PositionSetpoint)


class UnarmedAndGuarded(Guarded, Unarmed):
    """Its link asks the guard every 50 ms, also while the loop hangs."""

    def __init__(self) -> None:
        Unarmed.__init__(self)
        self.own, self._asked_s = [], 0.0


@pytest.mark.parametrize("pressed", [OperatorRequest.LAND, OperatorRequest.CUT_MOTORS])
def test_ctrl_c_disarms_while_the_loop_hangs_on_the_ground(pressed: OperatorRequest) -> None:
    link, camera = UnarmedAndGuarded(), Camera()
    hang_in_the_camera(link, camera, 0.1, 3.0)
    rig = Rig(link, camera, operator=lambda: pressed if link.now_s > 1.0 else OperatorRequest.NONE)
    with pytest.raises(Interrupted):
        rig.fly()
    assert link.said(Arm)[0] < 0.2
    disarmed_s, order = link.own[0]
    assert (order, disarmed_s) == (Arm(False), pytest.approx(1.0, abs=0.06))
    assert link.armed_s is None


@pytest.mark.parametrize(
    ("pressed", "order"),
    [(OperatorRequest.LAND, Arm(False)), (OperatorRequest.CUT_MOTORS, EmergencyStop())],
)
def test_the_word_reaches_an_armed_vehicle_whose_first_turn_of_flight_hangs(
    pressed: OperatorRequest, order: Command
) -> None:
    """Its propellers turn, and the loop has not decided anything yet."""
    link, camera = UnarmedAndGuarded(), Camera()
    poll, ready = camera.poll, list[float]()

    def hang_once_ready(now_s: float) -> Frame | None:
        frame = poll(now_s)
        if not ready and link.watchdog.__qualname__ == "Watchdog.poll":
            ready.append(now_s)
            link.advance_to(now_s + 3.0)
        return frame

    camera.poll = hang_once_ready  # type: ignore[method-assign]
    rig = Rig(link, camera)
    rig.operator = lambda: (
        pressed if ready and link.now_s > ready[0] + 1.0 else OperatorRequest.NONE
    )
    rig.fly()
    assert not link.said(PositionSetpoint)
    sent_s, sent = link.own[0]
    assert (sent, sent_s) == (order, pytest.approx(ready[0] + 1.0, abs=0.06))


def test_a_vehicle_that_arms_itself_is_asked_for_nothing() -> None:
    rig = Rig()
    rig.operator = land_after(rig, 2.0)
    rig.fly()
    assert not rig.link.said(Arm)


# --- On the simulated firmware, in lockstep ---------------------------------------------------


@pytest.mark.long
def test_a_brushless_vehicle_perches_and_ends_disarmed(tmp_path: Path) -> None:
    profile, log = load_profile(SHORT), tmp_path / "flight.jsonl"
    scenario = replace(draw_scenario(profile, SEED), airframe=CRAZYFLIE_21_BRUSHLESS, mass_kg=0.044)
    flight = fly_lockstep(profile, SEED, log, scenario=scenario)
    assert flight.report.outcome is Outcome.PERCHED
    assert flight.hanging
    sent = [(each.sender, each.command) for each in read_log(log).sent]
    assert sent[0] == ("preflight", Arm(True))
    assert sent[-1] == ("farewell", Arm(False))


# --- On the simulated firmware, in real time through cflib -----------------------------------


@dataclass
class Session:
    """One session of `fly` with a vehicle in real time. `on_arming` is called in the turn after the
    vehicle was sent its arming request."""

    sim: SimProcess
    on_arming: Callable[[Session], None] = lambda session: None
    switch: OperatorSwitch = field(default_factory=OperatorSwitch)
    problem: str | None = None
    camera_ends: bool = False
    camera_fails: bool = False
    sent_commands: list[SentCommand] = field(default_factory=list)

    def tick(self, tick: Any) -> None: ...

    def event(self, event: Any) -> None: ...

    def turn(self, turn: TickRecord) -> None:
        if self.sent_commands:
            self.on_arming(self)

    def sent(self, sent: SentCommand) -> None:
        self.sent_commands.append(sent)

    def fly(self, before_arming: Callable[[], None] = lambda: None) -> None:
        profile = load_profile(SHORT)
        options = FlyOptions(profile, Path(SHORT), self.sim.uri, self.sim.stream_url)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("perchctl.flight.session.open_camera", self.open_camera)
            fly_session(options, (self,), self.switch, before_arming=before_arming)

    def open_camera(self, *given: Any, **named: Any) -> FrameSource:
        return EndsOnWord(open_camera(*given, **named), self)

    @property
    def propellers_turn(self) -> bool:
        return max(self.sim.truth()["motors"]) > 0

    @property
    def bits(self) -> int:
        return int(self.sim.truth()["supervisor_info"])


class EndsOnWord(WrappedSource):
    """A camera that ends once the session says so."""

    def __init__(self, source: FrameSource, session: Session) -> None:
        super().__init__(source)
        self._session = session

    @property
    def finished(self) -> bool:
        return self._session.camera_ends

    def poll(self, now_s: float) -> Frame | None:
        if self._session.camera_fails:
            raise ZeroDivisionError("the camera's")
        return super().poll(now_s)


@contextmanager
def vehicle(airframe: Any = CRAZYFLIE_21_BRUSHLESS) -> Iterator[SimProcess]:
    profile = load_profile(SHORT)
    with SimProcess.start(
        replace(draw_scenario(profile, SEED), airframe=airframe),
        camera=load_calibration(find_calibration(profile.camera.calibration)),
        target=profile.target,
    ) as sim:
        until(lambda: sim.truth()["supervisor_info"] & CAN_ARM)
        yield sim


@pytest.fixture(scope="module")
def brushless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimProcess]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        with vehicle() as sim:
            yield sim


@pytest.mark.long
@pytest.mark.parametrize("error", [UsageError("not confirmed"), Interrupted("Ctrl-C")], ids=repr)
def test_nothing_turns_before_the_answer_nor_after_a_no(
    error: Exception, brushless: SimProcess
) -> None:
    session, turned = Session(brushless), list[bool]()

    def ask() -> None:
        answered_s = time.monotonic() + 1.0
        until(lambda: turned.append(session.propellers_turn) or time.monotonic() > answered_s)
        raise error

    with pytest.raises(type(error)):
        session.fly(ask)
    assert not any(turned)
    assert session.sent_commands == []
    assert not session.propellers_turn
    assert session.bits & CAN_ARM


def press(session: Session) -> None:
    session.switch.press()


def end_camera(session: Session) -> None:
    session.camera_ends = True


def fail_in_the_camera(session: Session) -> None:
    session.camera_fails = True


def spill_the_battery(session: Session) -> None:
    session.sim.set_rest_v(3.3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("happens", "error"),
    [
        (press, Interrupted),
        (end_camera, NotFound),
        (fail_in_the_camera, ZeroDivisionError),
        (spill_the_battery, SafetyAbort),
    ],
)
def test_whatever_ends_it_on_the_ground_the_propellers_stand_still(
    happens: Callable[[Session], None], error: type[Exception]
) -> None:
    with vehicle() as sim:
        session, turned = Session(sim), list[bool]()

        def on_arming(session: Session) -> None:
            if not turned:  # wait for what is to be stopped
                until(lambda: session.propellers_turn)
                turned.append(True)
            happens(session)

        session.on_arming = on_arming
        with pytest.raises(error):
            session.fly()
        assert turned == [True]
        assert not session.propellers_turn
        assert session.bits & CAN_ARM


@pytest.mark.long
def test_motors_that_do_not_start_end_it_disarmed() -> None:
    with vehicle(BLOCKED) as sim:
        session = Session(sim)
        with pytest.raises(SafetyAbort, match="a propeller may be blocked"):
            session.fly()
        assert not session.propellers_turn
        assert session.bits & CAN_ARM


@pytest.mark.long
@pytest.mark.parametrize("silent_s", [1.5, 60.0])
def test_a_lost_link_is_waited_for_and_told_of(silent_s: float) -> None:
    """What is not heard is not taken for disarmed; what is heard again is disarmed."""
    comes_back = silent_s < 5.0
    with vehicle() as sim:
        session = Session(sim)

        def lose(session: Session) -> None:
            until(lambda: session.propellers_turn)
            sim.silence_link(silent_s)
            session.switch.press()

        session.on_arming = lose
        told = nullcontext() if comes_back else pytest.warns(Note, match="may still be armed")
        with told, pytest.raises(Interrupted):
            session.fly()
        assert session.propellers_turn is not comes_back
        assert bool(session.bits & ARMED) is not comes_back


@pytest.mark.long
def test_a_vehicle_that_is_armed_already_is_left_to_whoever_armed_it(
    brushless: SimProcess,
) -> None:
    session = Session(brushless)
    with wired(brushless.uri) as another:
        another.send(encode(Arm(True))[0].encode())
        until(lambda: session.bits & CAN_FLY)
        with pytest.raises(ConnectionFailed, match="is already armed: keep away from its propel"):
            session.fly()
        assert session.bits & ARMED
        another.send(encode(Arm(False))[0].encode())
        until(lambda: session.bits & CAN_ARM)
