"""The simulated vehicle's process: start, paces, video, and what happens without a parent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.places import data_file
from perchctl.sim import Scenario, SimProcess
from tests.helpers.crtp_rig import pictures_of
from tests.helpers.waiting import until


def alive(pid: int) -> bool:
    """A process that still runs; one that only waits to be collected does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rsplit(")", 1)[1].split()[0] != "Z"


def test_stepped_time_passes_only_by_advance_and_no_ctrl_c_reaches_the_vehicle() -> None:
    """Neither SIGINT itself nor one to the terminal's process group ends it."""
    with SimProcess.start(pace="stepped") as sim:
        assert sim.stream_url == ""
        assert os.getsid(sim.pid) != os.getsid(0)
        os.kill(sim.pid, signal.SIGINT)
        assert sim.truth()["t_s"] == sim.truth()["t_s"] == 0.0
        assert sim.advance(0.5) == sim.truth()["t_s"] == pytest.approx(0.5)
        assert alive(sim.pid)
        with pytest.raises(InvalidValue, match="no_such_request"):
            sim.no_such_request()


def test_a_child_that_ends_or_does_not_come_up_is_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim = SimProcess.start(pace="stepped")
    sim.stop()
    sim.stop()
    assert not alive(sim.pid)
    with pytest.raises(ConnectionFailed, match="ended"):
        sim.truth()
    sim = SimProcess.start(pace="stepped")
    os.kill(sim.pid, signal.SIGKILL)
    with pytest.raises(ConnectionFailed, match="has ended"):
        sim.advance(0.1)
    with pytest.raises(ConnectionFailed, match="No such file"):
        SimProcess.start(truth_file=tmp_path / "none" / "truth")
    monkeypatch.setattr("multiprocessing.spawn._python_exe", b"/bin/false")
    with pytest.raises(ConnectionFailed):
        SimProcess.start(pace="stepped")


@pytest.mark.long
def test_the_vehicles_picture_is_streamed_and_real_time_never_runs_ahead() -> None:
    path = data_file("calib", "example_640x480")
    assert path is not None
    camera, before_s = load_calibration(path), time.monotonic()
    with SimProcess.start(Scenario(seed=1), camera=camera) as sim:
        first, _, later = pictures_of(sim.stream_url, 3)
        assert first.shape[::-1] == camera.size_px
        assert first.std() > 3.0
        assert not np.array_equal(first, later)  # noise, motion
        assert sim.truth()["t_s"] <= time.monotonic() - before_s
        now_s = sim.truth()["t_s"]
        until(lambda: sim.truth()["t_s"] > now_s + 0.1)
    with SimProcess.start(Scenario(seed=1), "stepped", camera=camera) as sim:
        sim.advance(0.3)
        first, again = (pictures_of(sim.stream_url, 1)[0] for _ in range(2))
        assert np.array_equal(first, again)


_PARENT = """
import sys
from perchctl.sim import SimProcess
if __name__ == "__main__":
    started = [SimProcess.start(pace=pace) for pace in ("realtime", "stepped")]
    print("mujoco" in sys.modules, *(sim.pid for sim in started), flush=True)
    sys.stdin.readline()
"""


@pytest.mark.long
def test_it_ends_when_its_parent_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        loaded, *pids = map(json.loads, parent.stdout.readline().lower().split())
        assert not loaded  # the physics, which are the vehicle's
        assert all(map(alive, pids))
        parent.kill()
    until(lambda: not any(map(alive, pids)))
