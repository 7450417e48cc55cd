"""When a campaign has flown enough: its success rate is known well enough."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

from perchctl.flight.rates import rate_interval
from perchctl.flight.results import FlightResult


class StopRule:
    """Judges flights in the order of their seeds, whichever ends first: the same seeds count
    however many fly at a time.

    `width`: of the whole 95 % interval of the success rate, from its lower to its upper end; what
    perched and was neither locked nor fell is a success. `counted`: the seeds that count, as
    far as they are flown; `met`: the interval of these is narrower than `width`.
    """

    def __init__(self, seeds: Iterable[int], width: float) -> None:
        self._coming = list(seeds)[::-1]
        self._width = width
        self._ahead: dict[int, FlightResult] = {}
        self._good = 0
        self.counted: list[FlightResult] = []

    @property
    def interval(self) -> tuple[float, float]:
        return rate_interval(self._good, len(self.counted))

    @property
    def met(self) -> bool:
        low, high = self.interval
        return high - low < self._width

    def expected(self) -> int:
        """Flights in all, if the rate stays what it is: at most the seeds that there are."""
        flown, most = len(self.counted), len(self.counted) + len(self._coming)
        if self.met or not flown:
            return flown if self.met else most

        def wide(n: int) -> bool:
            low, high = rate_interval(round(self._good * n / flown), n)
            return high - low >= self._width

        return flown + 1 + bisect_left(range(flown + 1, most), True, key=lambda n: not wide(n))

    def note(self, result: FlightResult) -> bool:
        """Takes a flight; returns whether enough are flown. What comes then does not count."""
        self._ahead[result.seed] = result
        while not self.met and self._coming and self._coming[-1] in self._ahead:
            next_one = self._ahead.pop(self._coming.pop())
            self._good += not next_one.is_bad
            self.counted.append(next_one)
        return self.met
