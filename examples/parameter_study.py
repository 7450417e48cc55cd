"""A parameter study: how late may pictures be? Misses over seeds, as a table and a plot.

Needs the extra [sim] and pandas: python parameter_study.py
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor

import pandas as pd

from perchctl import load_profile, simulate

KEY = "simulation.camera_latency_s"
LATENCIES_S = (0.04, 0.08, 0.12)


def study(
    profile: str = "sim",
    latencies_s: Sequence[float] = LATENCIES_S,
    seeds: Iterable[int] = range(20),
    jobs: int = 1,
    executor: Executor | None = None,
) -> pd.DataFrame:
    """Return one line a flight: latency, seed, how it ended, and its miss in mm."""
    base, lines = load_profile(profile), []
    for latency_s in latencies_s:
        varied = base.with_({KEY: [latency_s, latency_s]})
        for flight in simulate(varied, seeds, jobs, executor):
            miss_mm = None if flight.miss_m is None else 1e3 * flight.miss_m
            lines.append((latency_s, flight.seed, flight.outcome, miss_mm))
    return pd.DataFrame(lines, columns=["latency_s", "seed", "outcome", "miss_mm"])


def plot(flights: pd.DataFrame, picture: str) -> None:
    """Draw the miss of each perched flight over its latency."""
    axes = flights.plot.scatter(x="latency_s", y="miss_mm", title="Miss by latency")
    axes.figure.savefig(picture)


if __name__ == "__main__":
    flights = study(jobs=4)
    perched = flights.assign(perched=flights.outcome == "perched")
    print(perched.groupby("latency_s")[["perched", "miss_mm"]].mean())
    plot(flights, "study.png")
