"""The processes of a campaign: Ctrl-C is the parent's alone, and ends them at once; a lost one is
told; and one that flies on does not grow."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import resource
import signal
import socket
import statistics
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import defer_interrupts, flight_processes, fly_all
from perchctl.campaign.flights import fly_seed
from perchctl.commands.simulate import CAMPAIGN_SAME_PRESS_S, stop_handler
from perchctl.errors import InvalidValue, PerchError
from perchctl.profile import Profile
from tests.helpers.ended import ended
from tests.helpers.flights import SEED, short_profile
from tests.helpers.jobs import campaign
from tests.helpers.seeds import (
    Ended,
    ends_at_once,
    ends_first_only,
    fails_later,
    is_killed_later,
    lacks_a_module,
)

pytestmark = pytest.mark.long

AT_ONCE_S = 20.0
"""Beside the time for which the flights would go on; on a busy machine, too."""


class Reported:
    """What a campaign said, and why not all were flown."""

    def __init__(self) -> None:
        self.flights: list[Ended] = []
        self.problem: PerchError | None = None

    def __call__(self, flights: list[Ended], problem: PerchError | None) -> None:
        self.flights, self.problem = flights, problem


def test_what_is_flown_never_sees_a_signal(capsys: pytest.CaptureFixture[str]) -> None:
    reported = Reported()
    assert campaign(ends_at_once, 2, reported) == 0
    assert [(flight.seed, flight.deaf) for flight in reported.flights] == [(0, True), (1, True)]
    assert reported.flights[0].pid != os.getpid()
    assert reported.problem is None
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert capsys.readouterr().err == ""


def test_a_signal_waits_for_what_must_not_be_left_halfway() -> None:
    done: list[str] = []

    def load() -> None:
        with defer_interrupts():
            signal.raise_signal(signal.SIGINT)
            done.append("loaded")

    with pytest.raises(KeyboardInterrupt):
        load()
    assert done == ["loaded"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_flights_where_they_are(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was flown by then is reported; a key that is held down is one press."""
    reported = Reported()
    pressed_s: list[float] = []

    def press(_result: Ended) -> None:
        pressed_s.append(time.monotonic())
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)

    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600.0,))
    other.start()  # as a simulated vehicle is, whose flight goes on
    others = set(multiprocessing.active_children())
    assert campaign(ends_first_only, 6, reported, press, jobs=2) == 130
    assert time.monotonic() - pressed_s[0] < AT_ONCE_S
    assert [flight.seed for flight in reported.flights] == [0]
    assert set(multiprocessing.active_children()) == others
    other.kill()
    other.join()
    assert capsys.readouterr().err == "perchctl: stopped: 1 of 6 flights were flown\n"


def test_a_signal_that_another_thread_takes_waits_too() -> None:
    """A library's own: its mask is its own, and Python's handler runs in the main thread."""
    done: list[bytes] = []
    over = threading.Event()
    other = threading.Thread(target=over.wait, daemon=True)
    taken, tell = socket.socketpair()
    tell.setblocking(False)
    taken.settimeout(AT_ONCE_S)

    def load() -> None:
        with defer_interrupts():
            signal.pthread_kill(other.ident or 0, signal.SIGINT)
            done.append(taken.recv(1))
            done.append(b"loaded")

    before = signal.set_wakeup_fd(tell.fileno())
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            load()
    finally:
        signal.set_wakeup_fd(before)
        over.set()
        taken.close()
        tell.close()
    assert done == [bytes([signal.SIGINT]), b"loaded"]


def test_a_second_press_ends_the_program_at_once() -> None:
    now_s = [0.0]
    left: list[int] = []
    press = stop_handler(lambda: now_s[0], left.append)
    with pytest.raises(KeyboardInterrupt):
        press(signal.SIGINT, None)
    now_s[0] = 0.5 * CAMPAIGN_SAME_PRESS_S
    press(signal.SIGINT, None)
    assert left == []
    now_s[0] = CAMPAIGN_SAME_PRESS_S
    press(signal.SIGINT, None)
    assert left == [130]


@pytest.mark.parametrize(
    ("fly", "words"),
    [
        (fails_later, "unexpected ZeroDivisionError in the flight with seed 1: no such luck"),
        (is_killed_later, "was killed; "),
    ],
)
def test_a_flight_that_fails_loses_none_of_the_others(
    fly: Callable[[int], Ended], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    reported = Reported()
    assert campaign(fly, 3, reported) == 1
    assert [flight.seed for flight in reported.flights] == [0]
    assert reported.problem is not None
    said = capsys.readouterr().err
    assert words in said
    assert said.endswith("; 1 of 3 flights were flown\n")


def test_a_worker_that_lacks_a_module_is_no_fault_of_the_program() -> None:
    with (
        flight_processes(1) as pool,
        pytest.raises(InvalidValue, match=r"cannot load.*'mujoco'.*install"),
    ):
        fly_all(lacks_a_module, [0], pool)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_program_that_is_ended_leaves_nothing_behind(number: signal.Signals) -> None:
    """No process that flies on, and, where it could, no warning of semaphores; a terminal
    sends its signals to the children, too."""
    it = ended(number, AT_ONCE_S)
    assert it.child
    if number == signal.SIGTERM:
        assert it.code == 130
        assert it.out == "report 1 stopped: 1 of 6 flights were flown\n"
        assert it.err.endswith("perchctl: stopped: 1 of 6 flights were flown\n")


# --- memory -------------------------------------------------------------------------------------

FULL, FLIGHTS = 10, 18
"""The caches of pictures, of up to eight entries, are full after the first; all."""
MOST_GROWTH = 0.02
"""From then on, of what the process holds by then: 4 MB, or half a megabyte a flight. A leak of one
flight's pictures, samples or turns is more."""
STATM = Path("/proc/self/statm")


def held_mb(profile: Profile, seed: int) -> float:
    """By this process after a flight, without what its allocator has been given back."""
    fly_seed(profile, seed)
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # the GNU C library's
    if trim is not None:
        trim(0)
    return int(STATM.read_text().split()[1]) * resource.getpagesize() * 1e-6


@pytest.mark.skipif(not STATM.exists(), reason="only Linux tells what is held now")
def test_a_process_that_flies_on_does_not_grow() -> None:
    """By more than caches. How much it holds is the libraries' and the computer's."""
    profile = short_profile({"planner.perching_time_s": 0.3})
    with flight_processes(1) as pool:
        held = fly_all(partial(held_mb, profile), range(SEED, SEED + FLIGHTS), pool)
    full, end = (statistics.median(each) for each in (held[FULL - 3 : FULL], held[-3:]))
    assert end - full < MOST_GROWTH * full, held
