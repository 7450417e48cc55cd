"""Fixtures that several test files here share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from perchctl.display import LivePage
from tests.helpers.live_page import Stops
from tests.helpers.recording import camera


@pytest.fixture
def stops() -> Stops:
    return Stops()


@pytest.fixture
def page(stops: Stops) -> Iterator[LivePage]:
    served = LivePage(camera(), "perchctl test", on_stop=stops)
    yield served
    served.close()
