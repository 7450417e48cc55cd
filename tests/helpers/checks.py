"""What the tests of `perchctl check` share: quick ones, rows, options, a vehicle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from perchctl.check.vehicle import LIFTED
from perchctl.check.vehicle import VEHICLE as ANSWERING
from perchctl.flight import FlyOptions
from perchctl.profile import Profile, find_profile, load_profile
from perchctl.sim import SimProcess
from perchctl.vehicle import Telemetry
from tests.helpers.mission import READY, telemetry
from tests.helpers.waiting import until

PROFILE = load_profile("sim")
NOWHERE = "udp://127.0.0.1:9"
NO_CAMERA = "camera:97"
QUICK: dict[str, Any] = {"listen_s": 0.1, "rehearse_s": 0.2, "lift_s": 0.2}
VEHICLE = ["address", *ANSWERING, LIFTED]
AT_REST = telemetry(1.0, 0.0, thrust=0.0, supervisor=READY, battery_v=4.1)


def said(**changes: Any) -> Telemetry:
    """At rest, but for this."""
    return replace(AT_REST, **changes)


def options(uri: str, source: str = NO_CAMERA, profile: Profile = PROFILE) -> FlyOptions:
    return FlyOptions(profile, find_profile("sim"), uri, source)


def wait_for(sim: SimProcess, seconds: float) -> None:
    """Of simulated time from now. A vehicle that was just replaced has its estimator to settle,
    however long the process has run."""
    until_s = sim.truth()["t_s"] + seconds
    until(lambda: sim.truth()["t_s"] >= until_s, 20.0 + seconds)
