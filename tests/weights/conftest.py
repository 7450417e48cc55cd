"""Fixtures that several test files here share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.weights_data import independent, write


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write(independent(1), tmp_path / "session.csv")
