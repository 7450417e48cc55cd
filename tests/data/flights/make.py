"""Flies the flights of the regression corpus and keeps what a replay needs of their logs.

    python tests/data/flights/make.py [--decide] [NAME ...]

Each file holds a log's header, turns, what was sent in the loop's place, events and summary,
packed; the ticks, which say the same rounded, are left out. `seen.mcap` holds the pictures of one
of them. With ``--decide`` the logs keep what was observed, and their format, and get what today's
planner decides from it. They were flown by the planner of their day:
`tests/replay/test_corpus.py` demands that today's decides the same from the same observations, and
`test_seen.py` that today's pipeline sees the same in the pictures. Where it is meant to decide
otherwise: CONTRIBUTING.md, "Change the planner".
"""

from __future__ import annotations

import gzip
import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2]))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from perchctl.faults import fly_fault_in_folder  # noqa: E402
from perchctl.flight import (  # noqa: E402
    FlightParts,
    fly_lockstep,
    lockstep,
)
from perchctl.mission import (  # noqa: E402
    FlightReport,
    OperatorRequest,
    Phase,
)
from perchctl.profile import Profile  # noqa: E402
from perchctl.record import LogWatcher  # noqa: E402
from perchctl.record.recorded import recorded_frames  # noqa: E402
from perchctl.record.recorder import Recorder  # noqa: E402
from perchctl.record.write import recording_path  # noqa: E402
from perchctl.vision import Frame  # noqa: E402
from tests.helpers.decided import decided_here  # noqa: E402
from tests.helpers.flights import ordered, short_profile  # noqa: E402
from tests.helpers.hangs import hang_in_the_camera, hang_in_the_planner  # noqa: E402

KINDS = (b"header", b"turn", b"sent", b"event", b"summary")
KEPT = tuple(b'{"kind":"' + kind + b'"' for kind in KINDS)


PICTURES = 37
"""So many are kept: from the first before take-off until only the small marker is in view."""
SMALL = {"link.telemetry_period_s": 0.02, "link.loop_hz": 25}
"""Half the turns, and half the samples."""


def _fly(
    log: Path,
    changes: Mapping[str, Any] | None = None,
    operator_at: Mapping[Phase, OperatorRequest] | None = None,
) -> None:
    profile = short_profile({**SMALL, **(changes or {})})
    fly_lockstep(profile, 3, log, **ordered(operator_at or {}))


def _seen(log: Path) -> None:
    """With its pictures, which are few and small."""
    changes = {
        "camera.calibration": "example_aideck_324x244.yaml",
        "planner.takeoff_height_m": 0.8,
        "simulation.camera_rate_hz": 4,
        "simulation.camera_noise_sigma": [0.4, 0.4],
    }
    profile = short_profile(SMALL | changes)
    watcher = LogWatcher.open_lockstep(log, profile, 4, record=True)
    flight = fly_lockstep(profile, 4, watcher, **ordered({Phase.PERCH: OperatorRequest.CUT_MOTORS}))
    watcher.close(flight.report, flight.perched_miss_m, flight.fell)


def _fault(log: Path, fault: str, seed: int) -> None:
    flown = fly_fault_in_folder(short_profile(SMALL), (fault,), log.parent, False, seed)
    assert flown.log is not None
    flown.log.rename(log)


def _hung_within(log: Path) -> None:
    """Once in the camera, once in the planner: between turns a fault's loop hangs by itself."""
    real = lockstep.fly
    with pytest.MonkeyPatch.context() as patch:

        def fly(parts: FlightParts) -> FlightReport:
            hang_in_the_camera(parts.link, parts.source, at_s=1.5)
            hang_in_the_planner(parts.link, patch, at_s=3.0)
            return real(parts)

        patch.setattr(lockstep, "fly", fly)
        _fly(log, operator_at={Phase.ALIGN: OperatorRequest.CUT_MOTORS})


FLIGHTS: dict[str, Callable[[Path], None]] = {
    "perched": _fly,
    "searched-out": partial(_fly, changes={"simulation.no_target": True}),
    "slipped": partial(_fly, changes={"simulation.first_contact_fails": 1.0}),
    "hovered": partial(_fly, changes={"planner.hover": {"below_m": 0.6, "duration_s": 1.0}}),
    "seen": _seen,
    "stopped": partial(_fly, operator_at={Phase.ALIGN: OperatorRequest.CUT_MOTORS}),
    "link-silent": partial(_fault, fault="link-silent", seed=2),
    "hung-within": _hung_within,
    "hung": partial(_fault, fault="hung", seed=2),
    "external-occluded": partial(_fault, fault="external-occluded", seed=6),
}
"""Perched; landed without a target; a contact that fails; hovered and landed; cut by the operator;
hung within two turns; and faults of the link, of the loop and of positions from outside."""


def made(name: str) -> Path:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / f"{name}.jsonl"
        FLIGHTS[name](log)
        lines = [line for line in log.read_bytes().splitlines(True) if line.startswith(KEPT)]
        if recording_path(log).is_file():
            lines = lines[: _end_of(lines)]
            _keep_pictures(recording_path(log), HERE / f"{name}.mcap")
    path = HERE / f"{name}.jsonl.gz"
    path.write_bytes(gzip.compress(b"".join(lines), compresslevel=9, mtime=0))
    return path


def _end_of(lines: list[bytes]) -> int:
    """Where the turn begins that took one more picture."""
    taken = 0
    for k, line in enumerate(lines):
        record = json.loads(line)
        taken += record["kind"] == "turn" and record["taken"].get("frame") is not None
        if taken > PICTURES:
            return k
    return len(lines)


def _packed(data: bytes) -> bytes:
    """The same pixels in fewer bytes: noise is best left to Huffman alone."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    how = [
        cv2.IMWRITE_PNG_COMPRESSION, 9,
        cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    ]  # fmt: skip
    return cv2.imencode(".png", image, how)[1].tobytes()


def _keep_pictures(recording: Path, path: Path) -> None:
    """Of a recording, what a replay takes from it."""
    path.unlink(missing_ok=True)
    kept, image = Recorder.open(path, {"t0_s": 0.0}, Profile()), np.zeros((1, 1), np.uint8)
    for about, picture in islice(recorded_frames(recording), PICTURES):
        data = None if picture is None else _packed(picture.data)
        number, t_s, arrival_s = about["number"], about["t_s"], about["t_arrival_s"]
        kept.write_frame(
            Frame(number, t_s, image, arrival_s, is_repeated=data is None, source_jpeg=data)
        )
    kept.close()


def decided(name: str) -> Path:
    """The log as it was recorded, with today's decisions."""
    path = HERE / f"{name}.jsonl.gz"
    header = gzip.decompress(path.read_bytes()).splitlines(True)[0]
    lines = (header, *decided_here(name)[1:])
    path.write_bytes(gzip.compress(b"".join(lines), compresslevel=9, mtime=0))
    return path


def main() -> None:
    cv2.setNumThreads(1)
    words = sys.argv[1:]
    make = decided if "--decide" in words else made
    for name in [word for word in words if word != "--decide"] or FLIGHTS:
        if name not in FLIGHTS:
            sys.exit(f"{name} is none of {', '.join(FLIGHTS)}")
        path = make(name)
        for file in (path, recording_path(path)):
            if file.is_file():
                print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
