"""The estimator's start where positions come from outside."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import ConnectionFailed, PerchError, TimedOut
from perchctl.geometry import rot_z
from perchctl.link import external_position
from perchctl.link.external_position import (
    AGREE_WITHIN_S,
    RESET_PARAMETER,
    RESETS,
    StandingFeed,
    settle_estimator,
)
from perchctl.positioning import FeedStatus, VehiclePose
from perchctl.profile import PositioningConfig
from perchctl.vehicle import FLYING, Telemetry
from tests.helpers.mission import READY, telemetry

CONFIG = PositioningConfig(by="mocap", host="lab", body="cf", connect_timeout_s=2.0)
INITIAL = tuple(f"kalman.initial{part}" for part in ("X", "Y", "Z", "Yaw"))
ON_GROUND = telemetry(0.0, 0.0, thrust=0.0, supervisor=READY)


@dataclass
class Bench:
    """A vehicle on the ground, its parameters, a capture that sees it, and their one clock.

    `deaf`: so many resets are lost on their way. Positions draw the estimate's place, and never
    its heading. `at_reset` is done as soon as a reset is ordered.
    """

    place_m: tuple[float, float, float] = (1.2, -0.7, 0.03)
    telemetry: Telemetry = ON_GROUND
    deaf: int = 0
    status_problem: str | None = None
    now_s: float = 50.0
    silent_after_s: float = math.inf
    carried_mps: float = 0.0
    at_reset: Callable[[], None] = lambda: None
    values: dict[str, float] = field(default_factory=dict)
    orders: list[tuple[str, float]] = field(default_factory=list)
    feed: StandingFeed | None = None

    def clock(self) -> float:
        return self.now_s

    def set_parameters(
        self, cf: Any, uri: str, parameters: Mapping[str, float], read_back: bool = True
    ) -> None:
        self.orders += parameters.items()
        self.values.update(parameters)
        if parameters.get(RESET_PARAMETER) == 1:
            self.at_reset()
            self.deaf -= 1
            if self.deaf < 0:
                x, y, z, yaw = (self.values[name] for name in INITIAL)
                self.telemetry = replace(self.telemetry, position_m=(x, y, z), yaw_rad=yaw)

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s
        x, y, z = self.place_m
        self.place_m = (x + self.carried_mps * duration_s, y, z)
        self.telemetry = replace(self.telemetry, position_m=self.place_m)

    def newest(self) -> Telemetry:
        return replace(self.telemetry, t_s=min(self.now_s, self.silent_after_s))

    def status(self, now_s: float) -> FeedStatus:
        return FeedStatus(0.01, self.status_problem, 0 if self.status_problem else 9)

    def sent_pose(self) -> VehiclePose:
        return VehiclePose(self.now_s, np.array(self.place_m), rot_z(2.0))

    def settle(self) -> None:
        feed: Any = self.feed or self
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(external_position, "set_parameters", self.set_parameters)
            wait = self.wait if self.feed is None else self.feed.wait
            settle_estimator(None, "udp://x", CONFIG, feed, self.newest, self.clock, wait)

    def refused(self, kind: type[PerchError]) -> str:
        """The one sentence by which it is refused, within the bound."""
        start_s = self.now_s
        with pytest.raises(kind) as caught:
            self.settle()
        bound_s = CONFIG.connect_timeout_s + RESETS * (AGREE_WITHIN_S + 0.5)
        assert self.now_s - start_s < bound_s
        assert "\n" not in str(caught.value)
        return str(caught.value)


@pytest.mark.parametrize("deaf", [0, 2])
def test_the_filter_starts_where_the_capture_sees_the_vehicle(deaf: int) -> None:
    """A reset that is lost is ordered again."""
    bench = Bench(deaf=deaf)
    bench.settle()
    assert [bench.values[name] for name in INITIAL] == pytest.approx([1.2, -0.7, 0.03, 2.0])
    assert bench.orders.count((RESET_PARAMETER, 1)) == 1 + deaf
    assert bench.orders[-2:] == [(RESET_PARAMETER, 1), (RESET_PARAMETER, 0)]
    assert bench.now_s < 51.0 or deaf


@pytest.mark.parametrize("bench", [Bench(deaf=99), Bench(carried_mps=0.3)])
def test_what_does_not_agree_or_is_carried_is_not_flown_by(bench: Bench) -> None:
    words = r"to x [-\d.]+, y -0\.70, z 0\.03 m, where motion capture at vicon:lab .* in metres"
    assert re.search(words, bench.refused(TimedOut))


@pytest.mark.parametrize(("bench", "kind", "words"), [
    (Bench(telemetry=replace(ON_GROUND, supervisor=READY | FLYING)), ConnectionFailed, "flying"),
    (Bench(silent_after_s=49.0), ConnectionFailed, "flying"),  # it stood on the ground then
    (Bench(status_problem="it does not see 'cf'"), TimedOut, "within 2 s: it does not see 'cf'"),
])  # fmt: skip
def test_nothing_is_set_where_the_vehicle_may_fly_or_its_body_is_hidden(
    bench: Bench, kind: type[PerchError], words: str
) -> None:
    assert words in bench.refused(kind)
    assert bench.orders == []


def test_a_vehicle_that_takes_off_in_between_is_not_reset_again() -> None:
    bench = Bench(deaf=99)

    def lift() -> None:
        bench.telemetry = replace(bench.telemetry, supervisor=READY | FLYING)

    bench.at_reset = lift
    assert "may be flying" in bench.refused(ConnectionFailed)
    assert bench.orders.count((RESET_PARAMETER, 1)) == 1


def test_agreement_counts_over_fresh_telemetry_only() -> None:
    bench = Bench()

    def fall_silent() -> None:
        bench.silent_after_s = bench.now_s

    bench.at_reset = fall_silent
    bench.refused(PerchError)


@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_what_stands_is_sent_as_often_as_the_profile_has_it(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float
) -> None:
    bench, sent_s = Bench(place_m=(0.0, 0.0, 0.03)), list[float]()
    monkeypatch.setattr(external_position, "time", SimpleNamespace(sleep=bench.wait))
    bench.feed = StandingFeed(lambda place: sent_s.append(bench.now_s), 0.03, rate_hz, bench.clock)
    bench.settle()
    assert np.diff(sent_s) == pytest.approx(1.0 / rate_hz)
    assert len(sent_s) > 0.5 * rate_hz
