from __future__ import annotations

import sys

import pytest

from perchctl.errors import UsageError, no_simulator


@pytest.mark.parametrize("missing", ["mujoco", "glfw"])
def test_a_missing_simulator_is_named_with_what_to_do(missing: str) -> None:
    error = no_simulator(missing)
    assert isinstance(error, UsageError)
    assert f"({missing} is missing)" in str(error)
    assert f"{sys.executable} -m pip install 'perchctl[sim]'" in str(error)
