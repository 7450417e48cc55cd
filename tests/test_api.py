"""The public names: few, documented, and loaded only when they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import perchctl


@pytest.mark.parametrize("name", [n for n in perchctl.__all__ if not n.startswith("_")])
def test_a_public_name_is_there_and_says_what_it_is(name: str) -> None:
    thing = getattr(perchctl, name)
    assert thing.__doc__
    assert name in dir(perchctl)


def test_the_package_itself_loads_nothing_heavy() -> None:
    code = "import sys, perchctl; print([m for m in ('numpy', 'cv2', 'cflib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
