"""A radio that loses packets by bursts: nothing passes for a while, then everything does.

Gilbert's model of a channel with two states, in continuous time: both last as long as an
exponential distribution says. So a share of the time is lost, in pieces of a given mean length,
whatever the packets' rate; both directions suffer together, as from a Wi-Fi nearby or a body in
the way.
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.sim.scenario import Scenario

_STREAM = 14
CONNECTED_S = 4.0
"""Before that nothing is lost: what is sent until the take-off is repeated until it is answered."""


class Bursts:
    """`lost` is asked with times that never go back; same seed, same bursts.

    Args:
        share: of the time that is lost, 0 to below 1.
        mean_s: a burst's mean length.
        from_s: before that nothing is lost.

    `newest`: begin and end of the last burst that has begun; None before the first.
    """

    def __init__(self, seed: int, share: float, mean_s: float, from_s: float = CONNECTED_S) -> None:
        self._rng = np.random.default_rng([seed, _STREAM])
        self._bad_s = mean_s
        self._good_s = mean_s * (1.0 - share) / share if share > 0.0 else math.inf
        self._bad = False
        self.newest: tuple[float, float] | None = None
        self._until_s = math.inf
        if share > 0.0:
            self._until_s = from_s + float(self._rng.exponential(self._good_s))

    def lost(self, t_s: float) -> bool:
        """True if a packet sent at that time is lost."""
        while t_s >= self._until_s:
            self._bad = not self._bad
            began_s = self._until_s
            mean_s = self._bad_s if self._bad else self._good_s
            self._until_s += float(self._rng.exponential(mean_s))
            if self._bad:
                self.newest = (began_s, self._until_s)
        return self._bad


def radio_bursts(scenario: Scenario) -> Bursts | None:
    """The bursts of a flight; None where its radio loses nothing."""
    if not scenario.radio_loss:
        return None
    return Bursts(scenario.seed, scenario.radio_loss, scenario.radio_burst_s)
