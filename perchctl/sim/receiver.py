"""What a video receiver makes of the pictures that reach it: it repeats, and blanks, them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from perchctl.sim.scenario import Scenario
from perchctl.sim.surfaces import Picture

STREAM = 412
BLUE_GREY, BLUE_NOISE = 41.0, 0.6
"""A blue screen, in grey, as it comes out of a converter."""
_BLANKS, _TICKS = 1, 2  # streams of random numbers


class Later:
    """A picture that is made when it is first looked at: most of a simulated camera's time would
    go into those that nobody takes. What it shows must not hang on when that is."""

    def __init__(self, make: Callable[[], Picture]) -> None:
        self._make: Callable[[], Picture] | None = make
        self._made: Picture | None = None

    def __call__(self) -> Picture:
        if self._make is not None:
            self._made, self._make = self._make(), None
        assert self._made is not None
        return self._made


@dataclass(frozen=True, eq=False)
class DeliveredFrame:
    """A frame that has arrived; `t_exposure_s` is the middle of its exposure: between the
    two fields of an interlaced one."""

    t_arrival_s: float
    t_exposure_s: float
    picture: Later
    index: int  # of the exposure: gaps are lost frames

    @property
    def image(self) -> Picture:
        return self.picture()


class Receiver:
    """Gives out its newest picture at `camera_receiver_hz`, each time with its own noise; one
    that has no rate of its own hands on what comes."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._newest: DeliveredFrame | None = None
        rng = np.random.default_rng([scenario.seed, STREAM])
        self._first_s = float(rng.random()) / (scenario.camera_receiver_hz or 1.0)
        self._given = 0

    def develop(self) -> None:
        """As `SimCamera.develop`."""
        if self._newest is not None:
            self._newest.picture()

    def given_out(self, arrived: list[DeliveredFrame], t_s: float) -> list[DeliveredFrame]:
        """Until `t_s`, of what has arrived since the last call, oldest first."""
        rate_hz = self._scenario.camera_receiver_hz
        if rate_hz is None:
            return arrived
        return list(self._ticks(arrived, t_s, rate_hz))

    def _ticks(
        self, arrived: list[DeliveredFrame], t_s: float, rate_hz: float
    ) -> Iterator[DeliveredFrame]:
        waiting = list(arrived)
        last = math.floor((t_s - self._first_s) * rate_hz)
        while self._given <= last:
            at_s = self._first_s + self._given / rate_hz
            while waiting and waiting[0].t_arrival_s <= at_s:
                self._newest = waiting.pop(0)
            if self._newest is not None:
                yield replace(self._newest, t_arrival_s=at_s, picture=self._noisy(self._newest))
            self._given += 1
        if waiting:
            self._newest = waiting[-1]

    def _noisy(self, frame: DeliveredFrame) -> Later:
        sigma, number = self._scenario.camera_receiver_noise, self._given
        if not sigma:
            return frame.picture
        seed = [self._scenario.seed, STREAM, _TICKS, number]
        return Later(lambda: _noisy(frame.image, sigma, np.random.default_rng(seed)))


def blanked(scenario: Scenario, index: int, picture: Later) -> Later:
    """The picture, or the blue screen in its place."""
    if not scenario.camera_blank_rate:
        return picture
    rng = np.random.default_rng([scenario.seed, STREAM, _BLANKS, index])
    if float(rng.random()) >= scenario.camera_blank_rate:
        return picture
    return Later(lambda: _noisy(np.full_like(picture(), BLUE_GREY), BLUE_NOISE, rng))


def _noisy(image: Picture, sigma: float, rng: np.random.Generator) -> Picture:
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + sigma * noise), 0, 255).astype(np.uint8)
