"""CPU time of a flight in real time, per second of flight: loop, vision, link and log.

    python benchmarks/loop_cpu.py [--against DIR] [-n 5] [--profile target_only]

Each flight runs in a process of its own on the simulated vehicle, which is another process and is
not counted; counted is all else from the first tick to the last, with cflib, the stream's decoding
and the log. `--against` has another checkout's code fly in turns with this one's: on a computer
that does other things, too, only figures of one run can be compared.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CHILD = """
import resource, sys, time
from perchctl import fly

def main():
    moments = []
    def note(tick):
        used = resource.getrusage(resource.RUSAGE_SELF)
        moments[1:] = [(time.monotonic(), used.ru_utime + used.ru_stime)]
    fly(sys.argv[1], "sim://", "sim:", on_tick=note, log_dir=sys.argv[2], seed=int(sys.argv[3]))
    (first_s, first_cpu_s), (last_s, last_cpu_s) = moments
    print((last_cpu_s - first_cpu_s) / (last_s - first_s))

if __name__ == "__main__":
    main()
"""


def cores(checkout: Path, profile: str, seed: int) -> float:
    """Seconds of CPU time per second of one flight with the code of `checkout`."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "flight.py"
        script.write_text(CHILD, encoding="utf-8")
        command = [sys.executable, str(script), profile, folder, str(seed)]
        done = subprocess.run(command, env=environment, cwd=folder, text=True, capture_output=True)
    if done.returncode:
        raise SystemExit(f"{checkout}: {done.stderr.strip().splitlines()[-1]}")
    return float(done.stdout.split()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout, flown in turns")
    parser.add_argument("-n", type=int, default=5, help="flights of each checkout")
    parser.add_argument("--profile", default="target_only")
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    given = parser.parse_args()
    checkouts = {"this code": ROOT}
    if given.against is not None:
        checkouts["--against"] = given.against.resolve()
    found: dict[str, list[float]] = {name: [] for name in checkouts}
    for seed in range(given.seed, given.seed + given.n):
        for name, checkout in checkouts.items():
            found[name].append(cores(checkout, given.profile, seed))
        print(f"seed {seed}:", ", ".join(f"{name} {all_[-1]:.3f}" for name, all_ in found.items()))
    for name, values in found.items():
        print(
            f"{name}: {statistics.median(values):.3f} core in the median, "
            f"{min(values):.3f} to {max(values):.3f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
