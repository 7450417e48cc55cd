"""Flights by a motion capture in real time: its client library, a loopback server that speaks
OptiTrack's protocol, the real cflib, and the simulated Crazyflie without a deck.

    python benchmarks/mocap.py [--seeds 20] [-p sim] [--seed 0]

Starts `perchctl fly --positioning mocap` once a seed and prints how each ended, how far from the
target's centre, how many positions a second arrived and how old they were. Expected: all perched,
exit code 0; on a busy computer the flights only take longer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from perchctl.record import read_log

TIMEOUT_S = 300.0


@dataclass(frozen=True)
class Flown:
    outcome: str
    reason: str
    miss_m: float | None
    age_s: float  # the largest of a position


def fly(profile: str, seed: int, folder: Path) -> Flown:
    command = [
        sys.executable, "-m", "perchctl", "fly", "-p", profile, "--positioning", "mocap",
        "--seed", str(seed), "--yes", "--json", "--log-dir", str(folder),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    if not done.stdout.strip():
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return Flown("refused", lines[-1], None, float("nan"))
    said = json.loads(done.stdout)
    if "log" not in said:  # before the take-off
        return Flown("refused", said.get("error") or said.get("reason", ""), None, float("nan"))
    ages = read_log(Path(said["log"])).column("pos_age_s")
    return Flown(said["outcome"], said["reason"], said["miss_m"], float(ages.max()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("-p", "--profile", default="sim")
    options = parser.parse_args()
    perched, misses = 0, []
    print(f"{'seed':>4}  {'ended':<16} {'miss':>8} {'oldest':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.seed, options.seed + options.seeds):
            it = fly(options.profile, seed, Path(folder))
            perched += it.outcome == "perched"
            miss = ""
            if it.outcome == "perched" and it.miss_m is not None:
                misses.append(1e3 * it.miss_m)
                miss = f"{1e3 * it.miss_m:.1f} mm"
            why = "" if it.outcome == "perched" else f"  {it.reason}"
            print(
                f"{seed:>4}  {it.outcome:<16} {miss:>8} {1e3 * it.age_s:>5.0f} ms{why}", flush=True
            )
    told = f"perched {perched} of {options.seeds}"
    if misses:
        told += f", miss {statistics.median(misses):.1f} mm median, {max(misses):.1f} mm largest"
    print(told)
    return 0 if perched == options.seeds else 1


if __name__ == "__main__":
    sys.exit(main())
