"""Flies the flights of the regression corpus and keeps what a replay needs of their logs.

    python tests/data/flights/make.py [NAME ...]

Each file holds a log's header, turns, what was sent in the loop's place, events and summary,
packed; the ticks, which say the same as the turns, but rounded, are left out. They were flown by
the planner of their day: `tests/replay/test_corpus.py` demands that today's decides the same from
the same observations. Where it is meant to decide otherwise, see docs/replay.md, "The corpus".
"""

from __future__ import annotations

import gzip
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2]))

import cv2  # noqa: E402
import pytest  # noqa: E402

from perchctl.faults.flight import fly_fault_seed  # noqa: E402
from perchctl.flight import lockstep  # noqa: E402
from perchctl.flight.lockstep import fly_lockstep  # noqa: E402
from perchctl.flight.loop import FlightParts  # noqa: E402
from perchctl.mission.state import Operator, Phase  # noqa: E402
from perchctl.mission.watch import FlightReport  # noqa: E402
from tests.helpers.flights import short_profile  # noqa: E402
from tests.helpers.hangs import hang_in_the_camera, hang_in_the_planner  # noqa: E402

KINDS = (b"header", b"turn", b"sent", b"event", b"summary")
KEPT = tuple(b'{"kind":"' + kind + b'"' for kind in KINDS)


SMALL = {"link.telemetry_period_s": 0.02, "link.loop_hz": 25}
"""Half the turns, and half the samples."""


def _fly(log: Path, changes: Mapping[str, Any] | None = None, **more: Any) -> None:
    fly_lockstep(short_profile({**SMALL, **(changes or {})}), 3, log, **more)


def _fault(log: Path, fault: str, seed: int) -> None:
    fly_fault_seed(short_profile(SMALL), seed, (fault,), log)


def _hung_within(log: Path) -> None:
    """Once in the camera, once in the planner: between turns a fault's loop hangs by itself."""
    real = lockstep.fly
    with pytest.MonkeyPatch.context() as patch:

        def fly(parts: FlightParts) -> FlightReport:
            hang_in_the_camera(parts.link, parts.source, at_s=1.5)
            hang_in_the_planner(parts.link, patch, at_s=3.0)
            return real(parts)

        patch.setattr(lockstep, "fly", fly)
        _fly(log, operator_at={Phase.ALIGN: Operator.STOP})


FLIGHTS: dict[str, Callable[[Path], None]] = {
    "perched": _fly,
    "searched-out": partial(_fly, changes={"simulation.no_target": True}),
    "slipped": partial(_fly, changes={"simulation.first_contact_fails": 1.0}),
    "stopped": partial(_fly, operator_at={Phase.ALIGN: Operator.STOP}),
    "link-silent": partial(_fault, fault="link-silent", seed=2),
    "hung-within": _hung_within,
    "hung": partial(_fault, fault="hung", seed=2),
    "external-occluded": partial(_fault, fault="external-occluded", seed=6),
}
"""Perched; landed without a target; a contact that fails; cut by the operator; hung within two
turns; and faults of the link, of the loop and of positions from outside."""


def made(name: str) -> Path:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / f"{name}.jsonl"
        FLIGHTS[name](log)
        lines = [line for line in log.read_bytes().splitlines(True) if line.startswith(KEPT)]
    path = HERE / f"{name}.jsonl.gz"
    path.write_bytes(gzip.compress(b"".join(lines), compresslevel=9, mtime=0))
    return path


def main() -> None:
    cv2.setNumThreads(1)
    for name in sys.argv[1:] or FLIGHTS:
        if name not in FLIGHTS:
            sys.exit(f"{name} is none of {', '.join(FLIGHTS)}")
        path = made(name)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
