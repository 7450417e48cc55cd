"""Flights in real time: the command line in a process of its own, cflib itself, and the
simulated Crazyflie behind `udp://`.

What the machine's load can spoil is tried once more; nothing passes without flying.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.waiting import until

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.mission.phase import PUBLISHED_METHOD_PHASES
from perchctl.profile import find_calibration, load_profile
from perchctl.record import FlightLog, read_log
from perchctl.sim import SimProcess, draw_scenario
from perchctl.vehicle import FLYING, LOCKED
from tests.helpers.flights import ROOT, SEED, SHORT

FLIGHT_LIMIT_S = 60.0
SLOW_FLIGHT_LIMIT_S = 300.0
"""Of sim://, whose clock waits for a busy computer."""
LATE_S = 0.25
"""A loop, telemetry or vehicle that is later than this was starved of the processor."""


def started(folder: Path, *arguments: str, **how: Any) -> subprocess.Popen[str]:
    """`perchctl fly`, with its output in pipes unless told otherwise."""
    clean = {k: v for k, v in os.environ.items() if k != "CFLIB_URI"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    words = [sys.executable, "-m", "perchctl", "fly", *arguments, "--log-dir", str(folder)]
    return subprocess.Popen(words, env=clean | {"PYTHONPATH": str(ROOT)}, **(pipes | how))


@contextmanager
def bounded(process: subprocess.Popen[str], limit_s: float = FLIGHT_LIMIT_S) -> Iterator[None]:
    """Kills the process after that time, or at the end."""
    guard = threading.Timer(limit_s, process.kill)
    guard.start()
    try:
        yield
    finally:
        guard.cancel()
        process.kill()


def flown(folder: Path, *arguments: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a flight from start to end."""
    process = started(folder, *arguments)
    with bounded(process, SLOW_FLIGHT_LIMIT_S):
        out, err = process.communicate()
    return process.returncode, out, err


def the_log(folder: Path) -> Path:
    (path,) = folder.glob("flight_*.jsonl")
    return path


# --- A whole flight ----------------------------------------------------------------------


@pytest.mark.long
def test_fly_perches_in_real_time_through_cflib(tmp_path: Path) -> None:
    """On pipes: one plain line a phase, one JSON object, a log and its picture."""
    code, out, err = flown(tmp_path, "-p", SHORT, "--seed", str(SEED), "--json")
    path, log = the_log(tmp_path), read_log(the_log(tmp_path))
    assert code == 0, err
    assert "PERCHED: hanging still" in err
    miss = re.search(r"^miss: +(\d+\.\d) mm off centre, according", err, re.MULTILINE)
    assert miss is not None
    assert float(miss[1]) < 20.0

    assert "\x1b" not in err + out
    assert {p.value for p in PUBLISHED_METHOD_PHASES} <= {span.phase for span in log.phases}

    said = json.loads(out)
    assert (said["outcome"], said["exit_code"], said["locked"]) == ("perched", 0, False)
    assert said["miss_m"] < 0.020
    assert said["log"] == str(path)

    assert not log.truncated
    assert log.summary is not None
    assert log.summary["outcome"] == "perched"
    assert (log.header["uri"], log.header["seed"]) == ("sim://", SEED)
    assert log.column("battery_v")[-1] > 3.0
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


# --- Interrupted flights -------------------------------------------------------------------


@dataclass
class Vehicle:
    """A simulated vehicle that the test owns, as a real one to `fly`."""

    sim: SimProcess
    truth_file: Path

    def __post_init__(self) -> None:
        self._began_s = time.monotonic() - self.sim.truth()["t_s"]

    def fly(self, folder: Path, **how: Any) -> subprocess.Popen[str]:
        where = ("--uri", self.sim.uri, "--source", self.sim.stream_url)
        return started(folder, "-p", SHORT, *where, "--yes", start_new_session=True, **how)

    def is_late(self) -> bool:
        return bool(time.monotonic() - self._began_s - self.sim.truth()["t_s"] > LATE_S)

    def past(self) -> list[dict[str, Any]]:
        lines = self.truth_file.read_text().splitlines()
        return [json.loads(line) for line in lines[:-1]]


@contextmanager
def vehicle(folder: Path) -> Iterator[Vehicle]:
    profile = load_profile(SHORT)
    truth_file = folder / "truth.jsonl"
    with SimProcess.start(
        draw_scenario(profile, SEED),
        camera=load_calibration(find_calibration(profile.camera.calibration)),
        target=profile.target,
        truth_file=truth_file,
    ) as sim:
        yield Vehicle(sim, truth_file)


@contextmanager
def flying_until(phase: str, own: Vehicle, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """`fly` up to that phase."""
    process = own.fly(folder)
    with bounded(process), process:
        assert process.stderr is not None
        seen = []
        for line in process.stderr:
            seen.append(line)
            if f"] {phase}:" in line:
                break
        else:
            raise AssertionError("".join(seen))
        yield process
        process.kill()


def assert_landed_by_the_operator(truth: dict[str, Any], log: FlightLog) -> None:
    assert truth["floor_contact"]
    assert truth["position_m"][2] < 0.05
    assert max(truth["motors"]) == 0
    assert not truth["supervisor_info"] & (LOCKED | FLYING)
    assert log.summary is not None
    assert (log.summary["outcome"], log.summary["cause"]) == ("landed", "operator")


@pytest.mark.long
def test_ctrl_c_in_flight_lands(tmp_path: Path) -> None:
    for attempt in ("first", "second"):
        folder = tmp_path / attempt
        folder.mkdir()
        with vehicle(folder) as own, flying_until("ALIGN", own, folder) as process:
            assert own.sim.truth()["position_m"][2] > 0.3
            process.send_signal(signal.SIGINT)
            output, rest = process.communicate(timeout=FLIGHT_LIMIT_S)
            truth, log, late = own.sim.truth(), read_log(the_log(folder)), own.is_late()
        late |= max(log.column("late_s").max(), log.column("tel_age_s").max()) > LATE_S
        if process.returncode == 130 or not late:
            break
    assert process.returncode == 130, output + rest
    assert "LANDED: the operator asked to land; motors off" in output + rest
    assert "Traceback" not in output + rest
    assert_landed_by_the_operator(truth, log)


@pytest.mark.long
def test_kill_9_in_flight_leaves_a_log_and_a_vehicle_that_ends_by_itself(tmp_path: Path) -> None:
    """Firmware facts, "When setpoints stop": levelled 0.5 s after the last packet, cut and
    locked 2.0 s after it."""
    with vehicle(tmp_path) as own, flying_until("ALIGN", own, tmp_path) as process:
        assert own.sim.truth()["supervisor_info"] & FLYING
        # What is said at once is written by a thread of its own, a moment later.
        until(lambda: any(s.phase == "ALIGN" for s in read_log(the_log(tmp_path)).phases), 2.0)
        before_s = own.sim.truth()["t_s"]
        process.kill()
        process.wait(FLIGHT_LIMIT_S)
        killed_s = time.monotonic()
        after_s = own.sim.truth()["t_s"]
        until(lambda: own.sim.truth()["supervisor_info"] & LOCKED, 30.0)
        end = own.sim.truth()
        # Its file is behind a little.
        until(lambda: own.sim.truth()["t_s"] > end["t_s"] + 0.1, 5.0)
        past = own.past()

    log = read_log(the_log(tmp_path))
    assert log.truncated
    assert log.summary is None
    assert {"APPROACH", "SEARCH", "ESTIMATE", "ALIGN"} <= {span.phase for span in log.phases}
    assert log.records[-1]["cmd"] == "position"
    assert 0.0 <= killed_s - log.records[-1]["t_s"] < 1.0  # the same monotonic clock

    assert max(end["motors"]) == 0
    cut_s = next(t["t_s"] for t in past if t["t_s"] > after_s and max(t["motors"]) == 0)
    locked_s = next(t["t_s"] for t in past if t["supervisor_info"] & LOCKED)
    # The last packet is at most a loop and a little older than the kill.
    assert cut_s > before_s + 1.8
    assert cut_s < after_s + 2.2
    assert locked_s == pytest.approx(cut_s, abs=0.1)
    held = [t["position_m"][2] for t in past if after_s < t["t_s"] < before_s + 1.7]
    assert min(held) > 0.2  # until then it hovers
