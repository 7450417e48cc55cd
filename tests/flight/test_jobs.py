"""The processes of a campaign: Ctrl-C is the parent's alone, and ends them at once."""

from __future__ import annotations

import multiprocessing
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands.simulate_request import AGAIN_S, SimulateRequest, stop_once, tell_logs
from perchctl.errors import PerchError
from tests.helpers.flights import ROOT
from tests.helpers.jobs import (
    Ended,
    campaign,
    ends_at_once,
    ends_first_only,
    fails_later,
    is_killed_later,
)

AT_ONCE_S = 3.0


def test_what_is_flown_never_sees_a_signal(capsys: pytest.CaptureFixture[str]) -> None:
    reported: list[Ended] = []
    assert campaign(ends_at_once, SimulateRequest(flights=2), reported.extend) == 0
    assert [(flight.seed, flight.deaf) for flight in reported] == [(0, True), (1, True)]
    assert reported[0].pid != os.getpid()
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_flights_where_they_are(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was flown by then is reported; a key that is held down is one press."""
    reported: list[Ended] = []
    pressed_s: list[float] = []

    def press(_result: Ended) -> None:
        pressed_s.append(time.monotonic())
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)

    request = SimulateRequest(flights=6, jobs=2)
    assert campaign(ends_first_only, request, reported.extend, press) == 130
    assert time.monotonic() - pressed_s[0] < AT_ONCE_S
    assert [flight.seed for flight in reported] == [0]
    assert multiprocessing.active_children() == []
    assert "1 of 6 flights" in capsys.readouterr().err


def test_a_second_press_ends_the_program_at_once() -> None:
    now_s, left = [0.0], []
    press = stop_once(lambda: now_s[0], left.append)
    with pytest.raises(KeyboardInterrupt):
        press(signal.SIGINT, None)
    now_s[0] = 0.5 * AGAIN_S
    press(signal.SIGINT, None)
    assert left == []
    now_s[0] = AGAIN_S
    press(signal.SIGINT, None)
    assert left == [130]


@pytest.mark.parametrize("fly", [fails_later, is_killed_later])
def test_a_flight_that_fails_loses_none_of_the_others(
    fly: object, capsys: pytest.CaptureFixture[str]
) -> None:
    reported: list[Ended] = []
    with pytest.raises((ZeroDivisionError, PerchError)) as raised:
        campaign(fly, SimulateRequest(flights=3), reported.extend)  # type: ignore[arg-type]
    if fly is fails_later:
        assert raised.value.__notes__ == ["in the flight of seed 1"]
    else:
        assert "ended from outside" in str(raised.value)
    assert [flight.seed for flight in reported] == [0]
    assert "1 of 3 flights" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_program_that_is_ended_leaves_nothing_behind(number: signal.Signals) -> None:
    """No process that flies on, and, where it could, no warning of semaphores; a terminal
    sends its signals to the children, too."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.helpers.jobs"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as program:
        assert program.stdout is not None
        child = os.pidfd_open(int(program.stdout.readline()))
        if number == signal.SIGKILL:
            program.kill()
        else:
            os.killpg(program.pid, number)
        ended, _, _ = select.select([child], [], [], AT_ONCE_S)
        os.close(child)
        out, err = program.communicate(timeout=AT_ONCE_S)
    assert ended
    if number == signal.SIGTERM:
        assert program.returncode == 130
        assert out.split() == ["report", "1"]
        assert err == "perchctl: stopped: 1 of 6 flights were flown\n"


def test_logs_that_lack_something_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tell_logs([Ended(0), Ended(1, log_problem="no space left")], tmp_path)
    assert capsys.readouterr().err.splitlines() == [
        f"perchctl: the flights' logs are in {tmp_path}",
        "perchctl: 1 of 2 logs are incomplete: no space left",
    ]
