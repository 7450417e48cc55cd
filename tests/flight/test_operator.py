"""The operator's switch, and the signals on it, also while the main thread hangs."""

from __future__ import annotations

import itertools
import os
import select
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import ConnectionFailed, Interrupted, UsageError
from perchctl.flight import OperatorSwitch, cut_key, operator_signals, session
from perchctl.flight.operator import (
    FASTER_THAN_A_HAND_S,
    KEY_JITTER_S,
    LONGEST_DELAY_S,
    SAME_PRESS_S,
    STOP_HANG_S,
)
from perchctl.mission import OperatorRequest
from perchctl.profile import load_profile
from tests.helpers.waiting import until

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

    def at(self, t_s: float) -> OperatorRequest:
        self.now_s = 50.0 + t_s
        return self.switch.read()


ANSWER_S = 0.25
"""From a second press to the order at most: the loop asks 50 times a second, the link's guard every
50 ms, and 0.3 s together are what a person feels as at once."""


@pytest.mark.parametrize(("presses_s", "read_s", "order"), [
    ([], 0.0, OperatorRequest.NONE),
    ([0.0], 0.0, OperatorRequest.LAND),
    ([0.0], 100.0, OperatorRequest.LAND),
    ([0.0, SAME_PRESS_S - 0.01], 9.0, OperatorRequest.LAND),  # too soon to count
    ([0.0, 0.2, 0.3], 0.3, OperatorRequest.CUT_MOTORS),  # but three do
    # no keyboard waits so long
    ([0.0, LONGEST_DELAY_S], LONGEST_DELAY_S, OperatorRequest.CUT_MOTORS),
    ([0.0, 0.5, 0.53, 0.56], 9.0, OperatorRequest.LAND),  # held for half a second
    ([0.0, 0.2, 0.22, 0.24], 9.0, OperatorRequest.LAND),  # by a keyboard that is set to be fast
    ([0.0, 0.4, 0.55, 0.7], 9.0, OperatorRequest.CUT_MOTORS),  # a key or a hand: nobody can tell
    ([0.0, 0.4, 0.49, 0.58, 0.67], 9.0, OperatorRequest.LAND),
    ([0.0, 0.24, 0.46], 0.46, OperatorRequest.CUT_MOTORS),  # a key's first gap is longer
    ([0.0, 0.4, 0.6, 0.7], 0.7, OperatorRequest.CUT_MOTORS),  # and the others are alike
])  # fmt: skip
def test_the_table_of_presses(
    presses_s: list[float], read_s: float, order: OperatorRequest
) -> None:
    assert Pressed(*presses_s).at(read_s) is order


@given(again_s=st.floats(SAME_PRESS_S, 60.0))
def test_a_second_press_stops_within_a_quarter_of_a_second(again_s: float) -> None:
    it = Pressed(0.0, again_s)
    assert it.at(again_s + ANSWER_S) is OperatorRequest.CUT_MOTORS
    assert it.at(99.0) is OperatorRequest.CUT_MOTORS


# --- a hand, or a key that is held: by the times of the presses alone ----------------------------


@st.composite
def hands(draw: st.DrawFn) -> list[float]:
    """When a hand presses that hammers 3 to 10 times a second, each gap up to a fifth off."""
    gap_s = 1.0 / draw(st.floats(3.0, 10.0))
    off = draw(st.lists(st.floats(0.8, 1.2), min_size=2, max_size=30))
    return [0.0, *itertools.accumulate(gap_s * each for each in off)]


@st.composite
def keys(
    draw: st.DrawFn, fastest_s: float = 0.03, slowest_s: float = 0.2, jitter_s: float = KEY_JITTER_S
) -> list[float]:
    """When a key presses that is held down for 1.5 s: at once, after a delay, and then evenly, but
    each time up to `jitter_s` late."""
    period_s = draw(st.floats(fastest_s, slowest_s))
    delay_s = draw(st.floats(max(0.25, 1.5 * period_s), 0.99))
    count = int((1.5 - delay_s) / period_s) + 1
    late_s = draw(st.lists(st.floats(0.0, jitter_s), min_size=count + 1, max_size=count + 1))
    due_s = [0.0, *(delay_s + period_s * k for k in range(count))]
    return sorted(d + late for d, late in zip(due_s, late_s, strict=True))


@given(hands())
def test_a_hand_that_hammers_stops_at_its_third_press_or_soon_after(presses_s: list[float]) -> None:
    """What might still be a key is waited for: until it lets go, or for a second."""
    second_s = next((t for t in presses_s if t >= LONGEST_DELAY_S), 99.0)
    assert Pressed(*presses_s).at(presses_s[-1] + ANSWER_S) is OperatorRequest.CUT_MOTORS
    heard = [t for t in presses_s if t <= second_s]
    assert (
        Pressed(*heard).at(heard[-1] + (0.0 if second_s < 99.0 else ANSWER_S))
        is OperatorRequest.CUT_MOTORS
    )


@given(st.floats(3.0, 10.0), st.floats(0.98, 1.02))
def test_presses_that_are_alike_stop_at_the_third(rate_hz: float, off: float) -> None:
    """Three within a second, none of them a key's: its first gap is longer."""
    gap_s = 1.0 / rate_hz
    assert Pressed(0.0, gap_s, gap_s * (1.0 + off)).at(gap_s * 2.1) is OperatorRequest.CUT_MOTORS


@given(keys())
def test_a_key_that_is_held_lands_for_a_second_and_then_stops(presses_s: list[float]) -> None:
    it = Pressed()
    for t_s, next_s in itertools.pairwise(presses_s):
        it.press(t_s)
        over = t_s - presses_s[0] >= LONGEST_DELAY_S - 1e-9
        assert it.at(t_s) is (OperatorRequest.CUT_MOTORS if over else OperatorRequest.LAND)
        assert it.at(next_s) is (OperatorRequest.CUT_MOTORS if over else OperatorRequest.LAND)
    assert it.at(2.0) is OperatorRequest.CUT_MOTORS


@given(st.floats(0.25, 1.0, exclude_max=True), st.floats(0.03, 0.2), st.floats(0.0, 0.99))
def test_each_keyboard_between_the_slowest_and_the_fastest_lands(
    delay_s: float, period_s: float, for_s: float
) -> None:
    """Also where the delay is hardly longer than the repeats, if these come on time."""
    count = int((1.0 - delay_s) / period_s)
    it = Pressed(0.0, *(t for k in range(count) if (t := delay_s + period_s * k) <= for_s))
    assert it.at(for_s) is OperatorRequest.LAND


@given(keys(slowest_s=FASTER_THAN_A_HAND_S - KEY_JITTER_S), st.integers(3, 50))
def test_a_key_let_go_is_one_press(presses_s: list[float], count: int) -> None:
    """No hand repeats so fast. After one repeat it cannot be told from two presses."""
    heard = [t for t in presses_s[:count] if t - presses_s[0] < LONGEST_DELAY_S - 1e-9]
    it = Pressed(*heard)
    assert len(heard) < 3 or it.at(60.0) is OperatorRequest.LAND
    it.press(61.0)
    assert it.at(61.0) is OperatorRequest.CUT_MOTORS


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
    assert often.at(t_s + ANSWER_S) is once.at(t_s + ANSWER_S)


@given(st.lists(st.floats(0.001, 1.5), min_size=1, max_size=20))
def test_an_order_never_falls(silences_s: list[float]) -> None:
    it, t_s, before = Pressed(), 0.0, OperatorRequest.NONE
    for silence_s in silences_s:
        it.press(t_s)
        for read_s in (t_s, t_s + 0.5 * silence_s):
            now = it.at(read_s)
            assert now >= before
            before = now
        t_s += silence_s


@pytest.mark.parametrize(("count", "after_s", "order"), [
    (1, 0.3, OperatorRequest.LAND),  # until no third has come
    (2, 0.3, OperatorRequest.CUT_MOTORS),  # three within a second
    (3, 0.09, OperatorRequest.LAND),  # faster than a hand, from 0.5 s on
    (3, 0.45, OperatorRequest.CUT_MOTORS),
])  # fmt: skip
def test_presses_that_are_heard_late_and_together(
    count: int, after_s: float, order: OperatorRequest
) -> None:
    """Several signals arrive as one while no thread gets a turn; when each came is unknown."""
    it = Pressed(0.0) if order is OperatorRequest.CUT_MOTORS or count == 1 else Pressed(-0.5, 0.0)
    it.now_s = 50.0 + after_s
    it.switch.press(count)
    assert it.switch.read() is order


def test_signals_that_are_read_together_are_all_presses() -> None:
    switch = OperatorSwitch(listening=True)
    with operator_signals(switch, print):
        wakeup = signal.set_wakeup_fd(-1)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
        os.write(wakeup, bytes([signal.SIGINT] * 3))
        until(lambda: switch.read() is OperatorRequest.CUT_MOTORS)


@given(st.lists(st.sampled_from(["land", "read"]), max_size=50))
def test_landing_is_never_a_stop_and_cutting_is_one_at_once(acts: list[str]) -> None:
    it = Pressed()
    for act in acts:
        getattr(it.switch, act)()
        assert it.at(0.0) <= OperatorRequest.LAND
    it.switch.cut()
    assert it.at(0.0) is OperatorRequest.CUT_MOTORS


def test_a_flight_that_hangs_after_its_stop_is_left_by_another_press() -> None:
    for presses_s in ((), (0.0,), (0.0, SAME_PRESS_S)):
        it = Pressed(*presses_s)
        it.at(1.0)
        it.now_s = 50.0 + STOP_HANG_S
        it.switch.interrupt()  # it may still land, or be stopped
    it = Pressed(0.0, SAME_PRESS_S)
    assert it.at(1.0) is OperatorRequest.CUT_MOTORS
    it.now_s = 51.0 + STOP_HANG_S
    with pytest.raises(Interrupted, match="the flight did not end after the motors were cut"):
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
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Phase
from perchctl.mission.state import PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import state_with, telemetry

switch = OperatorSwitch(listening=True)
dog = Watchdog(Profile(), switch.read)

def send(command):
    print(type(command).__name__, switch.read().name, flush=True)

with operator_signals(switch, say):
    sender = Sender(send, lambda: dog.poll(time.monotonic(), telemetry(time.monotonic())))
    now = time.monotonic()
    state = state_with(phase=Phase.ALIGN, t_s=now, hover_thrust=50000.0)
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
        time.sleep(SAME_PRESS_S)
        flight.process.send_signal(signal.SIGINT)
        flight.sends("EmergencyStop", "CUT_MOTORS")


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
            assert "Ctrl-Z cannot suspend a flight" in flight.process.stderr.readline()


def test_a_hanging_loop_is_landed_without_the_operator() -> None:
    with Hanging(0.02) as flight:
        flight.sends("Land", "NONE")


# --- the key, on a terminal of its own -----------------------------------------------------------

KEYS = """
import fcntl, os, signal, subprocess, sys, termios, time
from perchctl.commands.output import say
from perchctl.flight import OperatorSwitch, cut_key, operator_signals

fcntl.ioctl(0, termios.TIOCSCTTY, 0)
switch = OperatorSwitch(listening=True)
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
print("asks", flush=True)
sys.stdin.readline()
if "background" in sys.argv:
    other = subprocess.Popen(["sleep", "60"], process_group=0)
    os.tcsetpgrp(0, other.pid)
with operator_signals(switch, say), cut_key(switch, 0) as has_key:
    print("listens" if has_key else "does not listen", switch.read().name, flush=True)
    while has_key:
        time.sleep(0.01)
        if "raises" in sys.argv and switch.read().name == "LAND":
            raise SystemExit(9)
        leaves = "leaves" in sys.argv and switch.read().name == "LAND"
        if leaves or switch.read().name == "CUT_MOTORS":
            break
print(switch.read().name, flush=True)
if "background" in sys.argv:
    other.kill()
"""


class KeyTerminal:
    """A process that listens to the keys of a terminal of its own, whose other end is ours."""

    def __init__(self, *words: str) -> None:
        self.ours, theirs = os.openpty()
        self.before = termios.tcgetattr(self.ours)
        self.process = subprocess.Popen(
            [sys.executable, "-c", KEYS, *words], cwd=ROOT, start_new_session=True,
            env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
            stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        os.close(theirs)
        assert self.next() == "asks"
        self.type("yes \n ")  # the last space is of nobody's question
        self.echo = self.read()

    def type(self, keys: str) -> None:
        os.write(self.ours, keys.encode())

    def next(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def read(self) -> str:
        """What the terminal shows."""
        ready, _, _ = select.select([self.ours], [], [], 0.2)
        return os.read(self.ours, 1000).decode() if ready else ""

    def __enter__(self) -> KeyTerminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self.ours)


def test_the_space_bar_cuts_the_motors_and_no_other_key_does() -> None:
    """No key is shown, and what was typed before, an answer or a stale key, is not heard."""
    with KeyTerminal() as it:
        assert it.echo == "yes \r\n "
        assert it.next() == "listens NONE"
        it.type("abc\r\x1b[A")
        assert it.read() == ""
        assert termios.tcgetattr(it.ours) != it.before
        it.type("x ")
        assert it.next() == "CUT_MOTORS"
        assert it.process.wait(10.0) == 0
        assert termios.tcgetattr(it.ours) == it.before


@pytest.mark.parametrize(
    ("key", "how"),
    [
        ("\x03", "leaves"),
        pytest.param("\x03", "raises", marks=pytest.mark.long),
        ("\x1a", "leaves"),
        pytest.param("\x1a", "raises", marks=pytest.mark.long),
        pytest.param("SIGTERM", "leaves", marks=pytest.mark.long),
        ("SIGTERM", "raises"),
    ],
)
def test_however_it_ends_the_terminal_is_as_before(how: str, key: str) -> None:
    """Ctrl-C and Ctrl-Z are signals as ever: they land, and do not suspend the program."""
    with KeyTerminal(how) as it:
        assert it.next() == "listens NONE"
        if key == "SIGTERM":
            it.process.send_signal(signal.SIGTERM)
        else:
            it.type(key)
        assert it.process.wait(10.0) == (9 if how == "raises" else 0)
        assert how == "raises" or it.next() == "LAND"
        assert termios.tcgetattr(it.ours) == it.before


def test_a_terminal_that_is_closed_ends_the_listening() -> None:
    with KeyTerminal("leaves") as it:
        assert it.next() == "listens NONE"
        os.close(it.ours)
        it.ours = os.dup(0)
        assert it.next() == "LAND"  # by SIGHUP
        assert it.process.wait(10.0) == 0


def test_a_terminal_that_others_use_is_left_alone() -> None:
    with KeyTerminal("background") as it:
        assert it.next() == "does not listen NONE"
        assert it.process.wait(10.0) == 0
        assert termios.tcgetattr(it.ours) == it.before


def test_without_a_terminal_there_is_no_key() -> None:
    reader, writer = os.pipe()
    try:
        for number in (reader, -1):
            with cut_key(OperatorSwitch(), number) as has_key:
                assert not has_key
    finally:
        os.close(reader)
        os.close(writer)


def test_a_flight_behind_a_radio_hub_names_its_vehicle_by_its_own_uri(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    uri, key = "radio://0/80/2M/E7E7E7E701", "0123456789abcdef"
    monkeypatch.setattr(session, "open_camera", lambda *_, **__: SimpleNamespace(close=int, live=1))
    options = session.FlyOptions(
        load_profile("crazyflie"),
        Path("crazyflie.yaml"),
        uri,
        "http://cam/",
        link_uri=f"hub://127.0.0.1:1/80/2M/E7E7E7E701?key={key}",
    )
    with pytest.raises(ConnectionFailed, match=uri) as refused:
        session.fly_session(options)
    assert "hub://" not in str(refused.value)
    assert key not in str(refused.value)


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
