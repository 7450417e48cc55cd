"""A rate's interval against the binomial law that it stands for."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.flight import rate_record, rate_text
from perchctl.flight.results import rate_interval


def _at_most(k: int, n: int, p: float) -> float:
    """The chance of at most k of n."""
    return sum(math.comb(n, i) * p**i * (1.0 - p) ** (n - i) for i in range(k + 1))


@given(st.integers(0, 60), st.integers(1, 60), st.sampled_from([0.5, 0.9, 0.95, 0.99]))
def test_beyond_a_bound_what_was_seen_has_half_of_the_rest(k: int, n: int, level: float) -> None:
    k = min(k, n)
    low, high = rate_interval(k, n, level)
    assert 0.0 <= low <= k / n <= high <= 1.0
    side = 0.5 * (1.0 - level)
    if k:
        assert 1.0 - _at_most(k - 1, n, low) == pytest.approx(side, abs=1e-9)
    if k < n:
        assert _at_most(k, n, high) == pytest.approx(side, abs=1e-9)
    mirrored = rate_interval(n - k, n, level)
    assert mirrored == pytest.approx((1.0 - high, 1.0 - low), abs=1e-12)


def test_words() -> None:
    assert rate_text(100, 100) == "100 of 100 (>= 96.4 %)"
    assert rate_text(0, 100) == "0 of 100 (<= 3.6 %)"
    assert rate_text(97, 100) == "97 of 100 (91.5 to 99.4 %)"
    assert rate_text(0, 0) == "0 of 0"


def test_a_record() -> None:
    assert rate_record(0, 0) == {}
    assert rate_record(100, 100) == {"rate": 1.0, "interval": [0.963783, 1.0]}


def test_what_is_no_rate_is_refused() -> None:
    for k, n, level in ((3, 2, 0.95), (-1, 2, 0.95), (1, 2, 1.0)):
        with pytest.raises(ValueError, match=r"is no rate|a level is between"):
            rate_interval(k, n, level)
    assert rate_interval(0, 0) == (0.0, 1.0)
