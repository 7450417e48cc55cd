"""From the packets of the log blocks to samples: for the radio's and for the simulated ones."""

from __future__ import annotations

from collections.abc import Mapping

from perchctl.link.telemetry import (
    ATTITUDE_BLOCK,
    BATTERY_BLOCK,
    NEEDED,
    STATE_BLOCK,
    VARIANCE_BLOCK,
    telemetry_from,
)
from perchctl.vehicle import Telemetry

BLOCKS: dict[str, dict[str, str]] = {
    "battery": BATTERY_BLOCK,
    "variance": VARIANCE_BLOCK,
    "state": STATE_BLOCK,
    "attitude": ATTITUDE_BLOCK,
}
"""In the order in which those of one time are sent, what completes a sample last."""
FAST_BLOCKS = ("state", "attitude")
"""A sample needs these; the others come ten times a second, where the firmware has them."""
SLOW_PERIOD_S = 0.1
MOST_CARRIED_S = 0.05


class Assembler:
    """Puts the newest values of all blocks together.

    A block that stops coming leaves its values behind. The attitude's block makes the sample,
    so its end is the end of the samples; what the position's block lacks in age is written
    into the sample (`Telemetry.behind_s`), since frozen numbers look like a vehicle at rest.
    """

    def __init__(self) -> None:
        self._values: dict[str, float] = {}
        self._state_s: float | None = None
        self._start = 0

    def accept(
        self, block: str, values: Mapping[str, float], t_s: float, start: int = 0
    ) -> Telemetry | None:
        """One packet of a block, its stamp on the loop's clock and the vehicle's start that it is
        from; the sample that it completes. What a vehicle told before it started anew is over."""
        if start < self._start:
            return None
        if start > self._start:
            self._start, self._state_s = start, None
        self._values.update(values)
        if block == "state":
            self._state_s = t_s
        if block != "attitude" or self._state_s is None or self.missing():
            return None
        behind_s = t_s - self._state_s
        return telemetry_from(_carried(self._values, behind_s), t_s, max(0.0, behind_s), start)

    def missing(self) -> list[str]:
        """The needed variables of which nothing has come yet."""
        return [name for name in NEEDED if name not in self._values]


def _carried(values: Mapping[str, float], ahead_s: float) -> dict[str, float]:
    """The position block carried on to the attitude block's time by its velocity."""
    carried = dict(values)
    step_s = max(-MOST_CARRIED_S, min(MOST_CARRIED_S, ahead_s))
    for axis in "xyz":
        carried[f"stateEstimate.{axis}"] += values[f"stateEstimate.v{axis}"] * step_s
    return carried
