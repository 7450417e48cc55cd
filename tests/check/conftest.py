"""One simulated vehicle with its camera, and a wire to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

if TYPE_CHECKING:
    from perchctl.sim import SimProcess
    from tests.helpers.relay import Relay


@pytest.fixture
def elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Logs and the table cache stay out of the user's folders."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLIB_URI", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(scope="module")
def sim() -> Iterator[SimProcess]:
    from perchctl.calibration import profile_camera
    from perchctl.sim import SimProcess
    from tests.helpers.checks import PROFILE

    with SimProcess.start(camera=profile_camera(PROFILE.camera)) as process:
        yield process


@pytest.fixture
def relay(sim: SimProcess) -> Iterator[Relay]:
    from tests.helpers.relay import Relay

    with closing(Relay(sim.uri)) as wire:
        yield wire
