"""The processes of a campaign: Ctrl-C is the parent's alone, and ends them at once."""

from __future__ import annotations

import multiprocessing
import signal
import time

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands.simulate_request import exit_code, flying, noting
from perchctl.flight.campaign import fly_all, job_processes

AT_ONCE_S = 5.0


def sleeps(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def interrupts_are_blocked(_seed: int) -> bool:
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_what_is_flown_never_sees_ctrl_c() -> None:
    with job_processes(1) as executor:
        assert fly_all(interrupts_are_blocked, [0, 1], executor) == [True, True]
    assert not interrupts_are_blocked(0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_flights_where_they_are(number: signal.Signals) -> None:
    """What was flown by then is there; a second signal on the way out does nothing."""
    results: list[float] = []
    moved: list[float] = []

    def note(result: float) -> None:
        noting(results, moved.append)(result)
        signal.raise_signal(number)
        signal.raise_signal(number)

    with flying(3, 2) as executor:
        fly_all(sleeps, [0.0, 60.0, 60.0], executor, note)  # type: ignore[arg-type]
        pytest.fail("it went on")
    began_s = time.monotonic()
    assert results == moved == [0.0]
    assert multiprocessing.active_children() == []
    assert time.monotonic() - began_s < AT_ONCE_S


def test_one_flight_is_flown_here() -> None:
    with flying(1, 4) as executor:
        assert executor is None
        assert fly_all(float, [3], executor) == [3.0]


def test_the_exit_says_whether_all_were_flown(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(7, 7) == 0
    assert capsys.readouterr().err == ""
    assert exit_code(3, 7) == 130
    assert "3 of 7 flights" in capsys.readouterr().err
