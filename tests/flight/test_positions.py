"""Positions from outside in real time: the library's own reader on loopback, its process, the
feed, cflib, and the simulated Crazyflie without a deck."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")

from perchctl.errors import ConnectionFailed, InvalidValue, TimedOut, UsageError
from perchctl.flight import FlyOptions, WallClock, check_options, session
from perchctl.flight.session import start_position_feed
from perchctl.link import CflibLink
from perchctl.positioning import FeedStatus
from perchctl.profile import LinkConfig, PositioningConfig, find_profile, load_profile
from perchctl.sim import CaptureFault, CaptureSettings, Scenario, SimProcess
from tests.helpers.mission import changed
from tests.helpers.waiting import until

CONFIG = PositioningConfig(by="mocap", body="crazyflie", connect_timeout_s=10.0)
NO_DECK = Scenario(extra={"external_position": 1.0})
TURNED = CaptureSettings(heading_rad=2.0, origin_m=(1.5, -0.8, 0.0))
"""The room's world is not the one that a vehicle without positions would begin with."""


@pytest.fixture
def sim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimProcess]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with SimProcess.start(NO_DECK, capture=TURNED) as process:
        yield process


@contextlib.contextmanager
def fed(
    sim: SimProcess, config: PositioningConfig = CONFIG
) -> Iterator[tuple[CflibLink, Callable[[float], FeedStatus]]]:
    """As a flight's session does it."""
    clock = WallClock()
    with contextlib.ExitStack() as stack:
        assert sim.capture is not None
        system, host = sim.capture
        config = config.model_copy(update={"system": system, "host": host})
        link = CflibLink(sim.uri, LinkConfig(), clock.now, positioning=config)
        try:
            link.connect()
            feed = start_position_feed(stack, link, config, clock)
            assert feed is not None
            yield link, feed.status
        finally:
            link.close()


@pytest.mark.long
def test_the_estimate_is_the_capture_s_and_follows_it(sim: SimProcess) -> None:
    with fed(sim) as (link, status):
        assert link.connection is not None
        get = link.connection.cf.param.get_value
        assert get("stabilizer.estimator") == "2"
        assert float(get("locSrv.extPosStdDev")) == pytest.approx(CONFIG.position_sigma_m)
        newest = until(link.telemetry)[-1]
        truth = sim.truth()
        x, y, z = truth["position_m"]
        c, s = math.cos(2.0), math.sin(2.0)
        there = (1.5 + c * x - s * y, -0.8 + s * x + c * y, z)
        assert math.dist(newest.position_m, there) < 0.05
        assert newest.yaw_rad == pytest.approx(truth["rpy_rad"][2] + 2.0, abs=math.radians(5.0))
        until(lambda: status(time.monotonic()).rate_hz > 60.0)

        sim.begin_fault(CaptureFault(occluded=True))
        until(lambda: "does not see the rigid body" in (status(time.monotonic()).problem or ""))
        sent = status(time.monotonic()).sent
        until(lambda: status(time.monotonic()).age_s > 0.3)
        assert status(time.monotonic()).sent == sent
        sim.end_faults()
        until(lambda: status(time.monotonic()).problem is None)
        assert status(time.monotonic()).sent > sent


@pytest.mark.long
@pytest.mark.parametrize(
    ("config", "fault", "kind", "words"),
    [
        (CONFIG.model_copy(update={"body": "cf9"}), None, TimedOut, "it sees crazyflie, wand"),
        (CONFIG, CaptureFault(gone=True), ConnectionFailed, "no frame within"),
    ],
)
def test_what_is_no_position_is_named_on_the_ground(
    sim: SimProcess,
    config: PositioningConfig,
    fault: CaptureFault | None,
    kind: type[Exception],
    words: str,
) -> None:
    if fault is not None:
        sim.begin_fault(fault)
    config = config.model_copy(update={"connect_timeout_s": 3.0})
    with pytest.raises(kind, match=words), fed(sim, config):
        pass


def options(changes: dict[str, Any], uri: str = "udp://127.0.0.1:1") -> FlyOptions:
    profile = changed({"positioning.by": "mocap"} | changes, load_profile("sim"))
    return FlyOptions(profile, find_profile("sim"), uri, "http://127.0.0.1:1/x")


def test_what_cannot_be_flown_is_refused_before_anything_is_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check_options(options({"positioning.host": "lab"}))
    check_options(options({}, uri="sim://"))
    with pytest.raises(InvalidValue, match="the computer that runs the motion-capture system"):
        check_options(options({}))
    monkeypatch.setattr(session, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'perchctl\[mocap\]'"):
        check_options(options({}, uri="sim://"))
