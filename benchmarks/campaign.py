"""How fast simulated flights are, and where their time goes.

    python benchmarks/campaign.py [--seeds 16] [--against DIR]

Each seed is flown by one process, then the seeds by two at a time; of each flight the simulated
seconds a second of CPU time and of wall time. A further flight tells the share of each part.
`--against` has another checkout's code fly the same seeds in turns with this one's: on a computer
that does other things, too, only figures of one run can be compared. Exit 1 where `--least` is
given and the median of one process, by CPU time, is below.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from common import ROOT, table

WORKER = Path(__file__).with_name("campaign_worker.py")
HERE, THERE = "this code", "--against"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TURN_SEEDS = 4

Flight = dict[str, Any]


class Worker:
    """A process that flies with a checkout's code; a core."""

    def __init__(self, checkout: Path, profile: str) -> None:
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout)}
        self._child = subprocess.Popen(
            [sys.executable, str(WORKER), profile],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=checkout,
        )
        hello = self._heard()
        if Path(hello["home"]) != checkout.resolve():
            raise SystemExit(f"{checkout} has no perchctl: {hello['home']} would fly instead")
        self.start_s = float(hello["start_s"])

    def fly(self, seed: int, parts: bool = False) -> Flight:
        assert self._child.stdin is not None
        print(json.dumps({"seed": seed, "parts": parts}), file=self._child.stdin, flush=True)
        return self._heard()

    def close(self) -> None:
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._child.wait()

    def _heard(self) -> Flight:
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        if not line:
            raise SystemExit(f"the flying process ended with {self._child.wait()}")
        heard: Flight = json.loads(line)
        return heard


def factors(flights: Sequence[Flight], by: str) -> list[float]:
    return [f["simulated_s"] / f[by] for f in flights]


def one_at_a_time(workers: dict[str, Worker], seeds: range) -> dict[str, list[Flight]]:
    """In turns."""
    flights: dict[str, list[Flight]] = {name: [] for name in workers}
    for worker in workers.values():
        worker.fly(seeds[0])  # what a first flight loads and keeps
    for seed in seeds:
        for name, worker in workers.items():
            flights[name].append(worker.fly(seed))
    return flights


def two_at_a_time(
    workers: dict[str, tuple[Worker, Worker]], seeds: range
) -> dict[str, list[Flight]]:
    """Every other seed each, at the same time; in turns after every few, so that all meet the
    same computer."""
    flights: dict[str, list[Flight]] = {name: [] for name in workers}
    for _, second in workers.values():
        second.fly(seeds[0])
    with ThreadPoolExecutor(2) as threads:
        for first in range(0, len(seeds), TURN_SEEDS):
            some = seeds[first : first + TURN_SEEDS]
            for name, both in workers.items():
                halves = [
                    threads.submit(lambda w, own: [w.fly(seed) for seed in own], worker, own)
                    for worker, own in zip(both, (some[::2], some[1::2]), strict=True)
                ]
                flights[name] += [flight for half in halves for flight in half.result()]
    return flights


def row(name: str, processes: int, flights: Sequence[Flight]) -> tuple[object, ...]:
    cpu, wall = factors(flights, "cpu_s"), factors(flights, "wall_s")
    return (
        name, processes, statistics.median(cpu), min(cpu), max(cpu), statistics.median(wall),
        statistics.median(f["cpu_s"] for f in flights),
    )  # fmt: skip


def show_times_as_fast(flights: dict[str, list[Flight]], processes: int) -> None:
    """Each seed beside itself: what the computer did meanwhile changes that least."""
    if THERE not in flights:
        return
    cpu_s = {name: {f["seed"]: f["cpu_s"] for f in flown} for name, flown in flights.items()}
    times = [cpu_s[THERE][seed] / cpu_s[HERE][seed] for seed in cpu_s[HERE]]
    print(
        f"  {processes} at a time, {HERE} is {statistics.median(times):.2f} times as fast as "
        f"{THERE}, seed by seed ({min(times):.2f} to {max(times):.2f})"
    )


def show_outcomes(flights: dict[str, list[Flight]]) -> None:
    rows = []
    for name, flown in flights.items():
        misses = [1e3 * f["miss_m"] for f in flown if f["miss_m"] is not None]
        kinds = ", ".join(f"{n} {kind}" for kind, n in Counter(f["outcome"] for f in flown).items())
        middle, most = (statistics.median(misses), max(misses)) if misses else (float("nan"),) * 2
        rows.append((name, kinds, middle, most, statistics.median(f["time_s"] for f in flown)))
    table("outcomes", ("", "flights", "miss mm, median", "most", "flown s"), rows)
    if THERE in flights:
        told = ("outcome", "miss_m", "time_s")
        pairs = zip(flights[HERE], flights[THERE], strict=True)
        other = [a["seed"] for a, b in pairs if any(a[key] != b[key] for key in told)]
        print(f"  the same to the last bit but for seeds {other}" if other else "  all the same")


def show_parts(workers: dict[str, Worker], seeds: Sequence[int]) -> None:
    """Shares of the CPU time, with its milliseconds a flight."""
    names = list(workers)
    spent: dict[str, Counter[str]] = {name: Counter() for name in names}
    for seed in seeds:
        for name in names:
            spent[name].update(workers[name].fly(seed, parts=True)["parts_s"])
    rows = []
    for part in spent[HERE]:
        cells: list[object] = [part]
        for name in names:
            whole = spent[name].total()
            cells += [f"{100.0 * spent[name][part] / whole:.1f} %"]
            cells.append(round(1e3 * spent[name][part] / len(seeds)))
        rows.append(cells)
    head = [cell for name in names for cell in (name, "ms")]
    table(f"CPU time by part, seeds {[*seeds]}", ("", *head), rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profile", default="sim")
    parser.add_argument("--seeds", type=int, default=16, help="0 to this less one")
    parser.add_argument("--against", type=Path, metavar="DIR", help="another checkout")
    parser.add_argument("--least", type=float, default=0.0, help="factor by CPU time")
    options = parser.parse_args()
    seeds = range(max(2, options.seeds))
    homes = {HERE: ROOT}
    if options.against is not None:
        homes[THERE] = options.against.resolve()
    workers = {name: Worker(home, options.profile) for name, home in homes.items()}
    flights = one_at_a_time(workers, seeds)
    rows = [row(name, 1, flown) for name, flown in flights.items()]
    pairs = {name: (workers[name], Worker(home, options.profile)) for name, home in homes.items()}
    paired = two_at_a_time(pairs, seeds)
    rows += [row(name, 2, flown) for name, flown in paired.items()]
    for _, second in pairs.values():
        second.close()
    head = ("", "processes", "x real time by CPU", "least", "most", "by wall", "CPU s a flight")
    table(f"seeds 0 to {seeds[-1]}, medians, a core", head, rows)
    show_times_as_fast(flights, 1)
    show_times_as_fast(paired, 2)
    starts = ", ".join(f"{name} {worker.start_s:.1f} s" for name, worker in workers.items())
    print(f"  start of a process: {starts}")
    show_outcomes(flights)
    show_parts(workers, seeds[1:3] if len(seeds) > 2 else seeds)
    for worker in workers.values():
        worker.close()
    return int(statistics.median(factors(flights[HERE], "cpu_s")) < options.least)


if __name__ == "__main__":
    sys.exit(main())
