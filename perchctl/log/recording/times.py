"""The loop's clock on the wall's, in which a recording tells its times."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

NS = 1_000_000_000


@dataclass(frozen=True)
class Epoch:
    """`started_ns` of the wall's clock, since 1970, is `t0_s` of the loop's.

    A flight in lockstep has no wall clock: its recording begins in 1970, at 0.
    """

    started_ns: int
    t0_s: float

    def ns(self, t_s: float) -> int:
        """Nanoseconds since 1970; what was before that is at 0, which MCAP begins at."""
        return max(0, self.started_ns + round((t_s - self.t0_s) * NS))


def epoch_of(header: Mapping[str, Any], first_s: float) -> Epoch:
    """By a log's header; `first_s` is the loop's time of the first record, which counts as the
    start where the header does not say more."""
    t0_s = header.get("t0_s")
    if not isinstance(t0_s, (int, float)) or not math.isfinite(t0_s):
        t0_s = first_s
    return Epoch(_started_ns(header.get("started_utc")), float(t0_s))


def _started_ns(text: Any) -> int:
    try:
        started = datetime.fromisoformat(str(text))
    except ValueError:
        return 0
    aware = started if started.tzinfo else started.replace(tzinfo=UTC)
    since = aware - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * NS + since.microseconds * 1000
