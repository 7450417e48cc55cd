"""Fixtures that several test files here share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from perchctl.display import LivePage
from tests.helpers.recording import camera


@pytest.fixture
def stops() -> list[str]:
    """One entry for each time that STOP has been pressed."""
    return []


@pytest.fixture
def clock() -> list[float]:
    """The page's time, s."""
    return [50.0]


@pytest.fixture
def page(stops: list[str], clock: list[float]) -> Iterator[LivePage]:
    served = LivePage(
        camera(), "perchctl test", on_stop=lambda: stops.append("STOP"), clock=lambda: clock[0]
    )
    yield served
    served.close()
