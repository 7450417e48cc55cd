"""The merge weights' claims, measured.

    python benchmarks/weights.py [--positions 10] [--rows 1000000] [-p sim]

1. The paper's experiment in the simulator (seed 0), judged on as many other positions
   (seed 1): by how much the fitted weights beat the paper's and each single marker.
2. A CSV of a million rows through `perchctl fit-weights`: seconds and peak memory. Expected:
   at most 10 s and 1 GB.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from perchctl.weights.data import NEEDED

MOST_S, MOST_BYTES = 10.0, 1e9


def command(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "perchctl", "fit-weights", *words],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def experiment(profile: str, positions: int, folder: Path) -> None:
    fitted, other = folder / "fitted.csv", folder / "other.csv"
    words = ("-p", profile, "--truth", "sim", "--positions", str(positions))
    command("collect", str(other), *words, "--seed", "1")
    command("collect", str(fitted), *words, "--seed", "0")
    print(command(str(fitted), "--test", str(other)))


def write_rows(path: Path, rows: int) -> None:
    """Ten positions; one row in a hundred without the small marker."""
    rng = np.random.default_rng(5)
    position = np.repeat(np.arange(1, 11), rows // 10)
    rows = len(position)
    spans = [0.05, 0.05, 0.05, 3.1]
    actual = (rng.uniform(-1, 1, (10, 4)) * spans + [0, 0, 0.2, 0])[position - 1]
    large = actual + rng.normal(size=(rows, 4)) * [1e-3, 1e-3, 2e-3, 0.02]
    small = actual + rng.normal(size=(rows, 4)) * [2e-3, 1e-3, 1e-3, 0.01]
    unseen = rng.random(rows) < 0.01
    four = "%.7f,%.7f,%.7f,%.7f"
    with path.open("w", encoding="utf-8") as stream:
        stream.write(",".join(NEEDED) + "\n")
        for i in range(rows):
            cells = ",,," if unseen[i] else four % tuple(small[i])
            stream.write(
                f"{position[i]},{i / 30:.4f},{four % tuple(large[i])},{cells},"
                f"{four % tuple(actual[i])}\n"
            )


def million(rows: int, folder: Path) -> bool:
    path = folder / "rows.csv"
    write_rows(path, rows)
    began_s = time.perf_counter()
    found = json.loads(command(str(path), "--json"))
    took_s = time.perf_counter() - began_s
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    away = max(abs(found["lms"][axis] - found["closed_form"][axis]) for axis in found["lms"])
    print(
        f"{rows} rows ({path.stat().st_size / 1e6:.0f} MB): {took_s:.1f} s, {peak / 1e6:.0f} MB, "
        f"LMS {away:.5f} from the closed form"
    )
    return took_s <= MOST_S and peak <= MOST_BYTES


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--positions", type=int, default=10)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("-p", "--profile", default="sim")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        experiment(options.profile, options.positions, Path(name))
        return 0 if million(options.rows, Path(name)) else 1


if __name__ == "__main__":
    raise SystemExit(main())
