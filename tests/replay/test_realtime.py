"""A flight in real time, through cflib and the simulated firmware's own process, replayed.

Whether it perches is another test's: of a computer that is too slow the landing is replayed.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.analysis import replay
from perchctl.calibration import load_calibration
from perchctl.profile import find_calibration, load_profile
from perchctl.record import read_log, recorded_pictures
from perchctl.sim import SimProcess, draw_scenario
from tests.helpers.flights import ROOT, SEED, SHORT

FLIGHT_LIMIT_S = 120.0


def flown(folder: Path) -> Path:
    """The log of `perchctl fly --record`, towards a vehicle that is no sim://."""
    profile = load_profile(SHORT)
    with SimProcess.start(
        draw_scenario(profile, SEED),
        camera=load_calibration(find_calibration(profile.camera.calibration)),
        target=profile.target,
    ) as sim:
        words = ["-p", SHORT, "--uri", sim.uri, "--source", sim.stream_url, "--yes", "--record"]
        done = subprocess.run(
            [sys.executable, "-m", "perchctl", "fly", *words, "--log-dir", str(folder)],
            env={k: v for k, v in os.environ.items() if k != "CFLIB_URI"}
            | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=FLIGHT_LIMIT_S,
        )
    logs = list(folder.glob("flight_*.jsonl"))
    assert len(logs) == 1, done.stderr
    return logs[0]


@pytest.mark.campaign
def test_a_flight_in_real_time_replays(tmp_path: Path) -> None:
    """Late turns, a camera's jitter, samples in bursts: the commands and the poses are the same,
    to the bit."""
    path = flown(tmp_path)
    log = read_log(path)
    found = replay(log, recorded_pictures(path))
    assert found.seen is not None
    assert (found.differences, found.seen.differences, found.seen.end_reason) == ([], [], "")
    assert found.ticks > 100
    assert found.seen.frames > 50
