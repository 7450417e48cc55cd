"""Sources that end with their test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from perchctl.camera.source import LiveSource


@pytest.fixture
def opened() -> Iterator[list[LiveSource]]:
    sources: list[LiveSource] = []
    yield sources
    for source in sources:
        source.close()
