"""Rates as what is known of them: k of n, and the interval that the true rate is in."""

from __future__ import annotations

from scipy.special import betaincinv

LEVEL = 0.95


def rate_interval(k: int, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Where the true rate is after `k` of `n`: the exact interval of Clopper and Pearson (1934),
    which holds it in at least `level` of all campaigns; half of the rest is on either side.
    Nothing seen is (0, 1). Raises ValueError where `k` of `n` cannot be."""
    if not 0 <= k <= n:
        raise ValueError(f"{k} of {n} is no rate")
    if not 0.0 < level < 1.0:
        raise ValueError(f"a level is between 0 and 1, found {level}")
    side = 0.5 * (1.0 - level)
    low = float(betaincinv(k, n - k + 1, side)) if k else 0.0
    high = float(betaincinv(k + 1, n - k, 1.0 - side)) if k < n else 1.0
    return low, high


def rate_text(k: int, n: int, level: float = LEVEL) -> str:
    """``97 of 100 (91.5 to 99.4 %)``, ``100 of 100 (>= 96.4 %)``, ``0 of 100 (<= 3.6 %)``."""
    if n == 0:
        return "0 of 0"
    low, high = (100.0 * bound for bound in rate_interval(k, n, level))
    if k == n:
        return f"{k} of {n} (>= {low:.1f} %)"
    if k == 0:
        return f"{k} of {n} (<= {high:.1f} %)"
    return f"{k} of {n} ({low:.1f} to {high:.1f} %)"


def rate_record(k: int, n: int, level: float = LEVEL) -> dict[str, float | list[float]]:
    """For JSON: `rate` and its `interval`; empty where nothing was seen."""
    if n == 0:
        return {}
    return {"rate": round(k / n, 6), "interval": [round(b, 6) for b in rate_interval(k, n, level)]}
