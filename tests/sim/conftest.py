"""One simulated vehicle and one cflib connection, shared by the tests of the link."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.helpers.crtp_rig import Client, Pilot

if TYPE_CHECKING:
    from perchctl.sim import SimProcess

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")


@pytest.fixture(scope="session")
def toc_cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    """cflib's table cache, so that only the first connection downloads the tables."""
    return str(tmp_path_factory.mktemp("toc"))


@pytest.fixture(scope="session")
def shared_pilot(toc_cache: str) -> Iterator[object]:
    from perchctl.sim import SimProcess

    with SimProcess.start(pace="stepped") as sim:
        pilot = Pilot(sim, toc_cache)
        assert pilot.connect()
        pilot.start_log()
        yield pilot
        pilot.close()


@pytest.fixture
def pilot(shared_pilot: object) -> object:
    """The connection with a new 42 g vehicle, ready on the floor."""
    return shared_pilot.fresh()  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def sim() -> Iterator[SimProcess]:
    from perchctl.sim import SimProcess

    with SimProcess.start(pace="stepped") as process:
        process.advance(1.0)
        yield process


@pytest.fixture(scope="module")
def client(sim: SimProcess, toc_cache: str) -> Iterator[Client]:
    """A connection of its own, whose log blocks these tests may spoil."""
    connection = Client(sim.uri, toc_cache)
    assert connection.connect()
    yield connection
    connection.close()
