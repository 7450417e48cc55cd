from __future__ import annotations

import sys

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.errors import UsageError, distinct_texts, no_simulator


@pytest.mark.parametrize("missing", ["mujoco", "glfw"])
def test_a_missing_simulator_is_named_with_what_to_do(missing: str) -> None:
    error = no_simulator(missing)
    assert isinstance(error, UsageError)
    assert f"({missing} is missing)" in str(error)
    assert f"{sys.executable} -m pip install 'perchctl[sim]'" in str(error)


@given(st.floats(0.0, 100.0), st.integers(0, 10_000), st.integers(0, 3))
def test_found_and_allowed_never_look_alike(found: float, hundredths: int, decimals: int) -> None:
    limit = hundredths / 100.0
    assume(abs(found - limit) > 1e-8)
    shown, allowed = distinct_texts(found, limit, decimals)
    assert shown != allowed
    assert float(allowed) == limit
    assert (float(shown) > limit) is (found > limit)
