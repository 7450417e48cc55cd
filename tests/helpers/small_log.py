"""What the tests of the flight log share."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from perchctl.record.write import FlightLogWriter
from tests.helpers import log as synthetic
from tests.helpers.mission import note


def small_log(path: Path, ticks: int = 5) -> Path:
    writer = FlightLogWriter.open(path, synthetic.header())
    for i in range(ticks):
        writer.write({"t_s": 0.02 * i, "phase": "SEARCH", "z_m": 0.1 * i})
        writer.event(note(0.02 * i, f"event {i}"))
    writer.close(synthetic.SUMMARY)
    assert writer.problem is None
    return writer.path


def run_python(code: str, path: Path) -> subprocess.CompletedProcess[str]:
    """Run the code in a process of its own, with the path as its argument."""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", code, str(path)]
    return subprocess.run(command, cwd=root, check=False, capture_output=True, text=True)
