"""Fixtures that several test files here share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from perchctl.display import LivePage
from tests.helpers.recording import camera


@pytest.fixture
def ordered() -> list[str]:
    """The orders of the page's buttons, as often as they were pressed."""
    return []


@pytest.fixture
def clock() -> list[float]:
    """The page's time, s."""
    return [50.0]


@pytest.fixture
def page(ordered: list[str], clock: list[float]) -> Iterator[LivePage]:
    served = LivePage(
        camera(),
        "perchctl test",
        lambda: ordered.append("land"),
        lambda: ordered.append("cut"),
        clock=lambda: clock[0],
    )
    yield served
    served.close()
