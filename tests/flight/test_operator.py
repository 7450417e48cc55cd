"""The operator's switch, and the signals on it, also while the main thread hangs."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import Interrupted, UsageError
from perchctl.flight import OperatorSwitch, session
from perchctl.flight.operator import AGAIN_S, DELAY_S, HELD_S, HUNG_S, INSIST_S
from perchctl.mission import Operator
from perchctl.profile import load_profile

ROOT = Path(__file__).resolve().parents[2]


class Pressed:
    """A switch, and presses at given times."""

    def __init__(self, *times_s: float) -> None:
        self.now_s = 50.0
        self.switch = OperatorSwitch(listening=True, clock=lambda: self.now_s)
        for t_s in times_s:
            self.press(t_s)

    def press(self, t_s: float) -> None:
        self.now_s = 50.0 + t_s
        self.switch.press()

    def at(self, t_s: float) -> Operator:
        self.now_s = 50.0 + t_s
        return self.switch.read()


@pytest.mark.parametrize(("presses_s", "read_s", "order"), [
    ([], 0.0, Operator.NONE),
    ([0.0], 0.0, Operator.LAND),
    ([0.0], 100.0, Operator.LAND),
    ([0.0, AGAIN_S - 0.01], 9.0, Operator.LAND),  # too soon to count
    ([0.0, DELAY_S + 0.01], DELAY_S + 0.01, Operator.STOP),  # after a long silence, at once
])  # fmt: skip
def test_one_press_lands_for_good_and_two_stop(
    presses_s: list[float], read_s: float, order: Operator
) -> None:
    assert Pressed(*presses_s).at(read_s) is order


@given(again_s=st.floats(AGAIN_S, 60.0))
def test_a_second_press_stops_within_half_a_second(again_s: float) -> None:
    """The loop asks 50 times a second, the link's guard every 50 ms: they need the rest."""
    it = Pressed(0.0, again_s)
    assert it.at(again_s + 0.4) is Operator.STOP
    assert it.at(99.0) is Operator.STOP


def held(delay_s: float, period_s: float, for_s: float) -> list[float]:
    """When a key held down for so long presses: once, and from `delay_s` on once a period."""
    repeats = int((for_s - delay_s) / period_s) + 1 if for_s >= delay_s else 0
    return [0.0, *(delay_s + period_s * i for i in range(repeats))]


PERIODS_S = st.floats(0.005, HELD_S - 0.001)
DELAYS_S = st.floats(0.0, DELAY_S)


@given(DELAYS_S, PERIODS_S, st.floats(0.0, INSIST_S - 0.001))
def test_a_key_held_down_is_one_press(delay_s: float, period_s: float, for_s: float) -> None:
    """However long the keyboard waits before it repeats, and however fast it does."""
    it = Pressed()
    for t_s in held(delay_s, period_s, for_s):
        it.press(t_s)
        assert it.at(t_s) is Operator.LAND
    # Let go just after its first repetition it cannot be told from two presses.
    if delay_s < HELD_S or for_s >= delay_s + period_s or for_s < delay_s:
        assert it.at(60.0) is Operator.LAND
        it.press(61.0)
        assert it.at(61.0) is Operator.STOP


@given(DELAYS_S, PERIODS_S)
def test_two_seconds_of_holding_or_hammering_stop(delay_s: float, period_s: float) -> None:
    it = Pressed(*held(delay_s, period_s, INSIST_S + period_s))
    assert it.at(INSIST_S + period_s) is Operator.STOP


@given(st.lists(st.floats(0.001, 1.5), min_size=1, max_size=20), st.floats(0.01, 0.1))
def test_how_often_it_is_read_changes_nothing(silences_s: list[float], every_s: float) -> None:
    """The loop, the link's guard and a rescue all read the one switch."""
    often, once, t_s = Pressed(), Pressed(), 0.0
    for silence_s in silences_s:
        often.press(t_s)
        once.press(t_s)
        for i in range(int(silence_s / every_s)):
            often.at(t_s + every_s * i)
        t_s += silence_s
    assert often.at(t_s + HELD_S) is once.at(t_s + HELD_S)


def test_a_flight_that_hangs_after_its_stop_is_left_by_another_press() -> None:
    for presses_s in ((), (0.0,), (0.0, AGAIN_S)):
        it = Pressed(*presses_s)
        it.at(1.0)
        it.now_s = 50.0 + HUNG_S
        it.switch.interrupt()  # it may still land, or be stopped
    it = Pressed(0.0, AGAIN_S)
    assert it.at(1.0) is Operator.STOP
    it.now_s = 51.0 + HUNG_S
    with pytest.raises(Interrupted, match="the stopped flight hung"):
        it.switch.interrupt()
    it.switch.closing = True  # the link waits, bounded, for a vehicle that still flies
    it.switch.interrupt()


def test_before_the_flight_a_signal_leaves() -> None:
    with pytest.raises(Interrupted, match="nothing was started"):
        OperatorSwitch().interrupt()
    OperatorSwitch(listening=True).interrupt()


# --- signals, in a process of its own -----------------------------------------------------------

HANGING = """
import hashlib, sys, time
from perchctl.flight import operator_signals
from perchctl.commands.output import say
from perchctl.flight.operator import OperatorSwitch
from perchctl.flight.watchdog import Watchdog
from perchctl.link.sender import Sender
from perchctl.mission.state import Observation, Phase, PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import telemetry

switch = OperatorSwitch(listening=True)
dog = Watchdog(Profile(), switch.read)

def send(command):
    print(type(command).__name__, switch.read().name, flush=True)

with operator_signals(switch, say):
    sender = Sender(send, lambda: dog.poll(time.monotonic(), telemetry(time.monotonic())))
    now = time.monotonic()
    state = PlannerState(phase=Phase.ALIGN, t_s=now, hover_thrust=50000.0)
    obs = Observation(now, telemetry(now))
    dog.tick(now + float(sys.argv[1]), state, PositionSetpoint(0, 0, 1, 0), obs)
    # A call into a library that no signal interrupts; it lets the other threads run.
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1 << 25)
print("woke up", flush=True)
"""


class Hanging:
    """A flight whose main thread hangs in a library, with what its link would send."""

    def __init__(self, patience_s: float) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", HANGING, str(patience_s)],
            cwd=ROOT, env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        self.next()  # the first setpoint that is repeated: the loop hangs

    def next(self) -> list[str]:
        assert self.process.stdout is not None
        return self.process.stdout.readline().split()

    def sends(self, command: str, order: str) -> None:
        """It sends this command in the end, under this order, and lives."""
        while (said := self.next()) and said[0] != command:
            assert said[0] != "woke", "nothing was sent while it hung"
        assert said == [command, order]
        assert self.process.poll() is None

    def __enter__(self) -> Hanging:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


def test_ctrl_c_works_while_the_main_thread_hangs_in_a_library() -> None:
    with Hanging(60.0) as flight:
        flight.process.send_signal(signal.SIGINT)
        flight.sends("Land", "LAND")
        time.sleep(AGAIN_S)
        flight.process.send_signal(signal.SIGINT)
        flight.sends("EmergencyStop", "STOP")


@pytest.mark.parametrize(
    "name",
    [
        "SIGHUP",
        pytest.param("SIGTERM", marks=pytest.mark.long),
        pytest.param("SIGQUIT", marks=pytest.mark.long),
        "SIGTSTP",
    ],
)
def test_signals_that_end_or_suspend_a_program_land(name: str) -> None:
    with Hanging(60.0) as flight:
        for _ in range(2):
            flight.process.send_signal(signal.Signals[name])
        flight.sends("Land", "LAND")
        state = Path(f"/proc/{flight.process.pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        assert state != "T"
        if name == "SIGTSTP":
            assert flight.process.stderr is not None
            assert "Ctrl-Z does not suspend a flight" in flight.process.stderr.readline()


def test_a_hanging_loop_is_landed_without_the_operator() -> None:
    with Hanging(0.02) as flight:
        flight.sends("Land", "NONE")


def test_it_is_asked_once_the_vehicle_has_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a no ends has armed nothing, and is closed."""
    order: list[str] = []

    def noted(what: str) -> object:
        return lambda *_, **__: order.append(what)

    def ask() -> None:
        order.append("asked")
        raise UsageError("not confirmed: nothing was started")

    link = SimpleNamespace(connect=noted("connected"), close=noted("closed"))
    camera = SimpleNamespace(close=noted("camera closed"), live=True)
    monkeypatch.setattr(session, "CflibLink", lambda *_, **__: link)
    monkeypatch.setattr(session, "open_camera", lambda *_, **__: camera)
    monkeypatch.setattr(session, "fly", noted("flew"))
    options = session.FlyOptions(
        load_profile("crazyflie"), Path("crazyflie.yaml"), "radio://0/80/2M", "http://cam/"
    )
    with pytest.raises(UsageError, match="not confirmed"):
        session.fly_session(options, before_arming=ask)
    assert order == ["connected", "asked", "closed", "camera closed"]
