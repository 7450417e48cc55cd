"""A steady force from the side, as of wind: how far the vehicle goes, and what it says of it.

    python benchmarks/wind.py [-n 4] [--seed 0] [--jobs 2]

For the target alone and for a deck; the force begins with the flight, in the ascent or with the
press, and in some groups something hides the target for good a while later. Prints for each group
the ends, how far the vehicle went between the fault (or the force) and the floor, how fast it was
sideways just before the floor, and, where it perched, the reported and the true distance from the
target's centre.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from common import table

from perchctl import read_log
from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.edges import FaultRig
from perchctl.faults.effects import camera_fault, push
from perchctl.faults.flight import fly_with_fault
from perchctl.mission import Phase
from perchctl.profile import load_profile
from perchctl.sim import draw_scenario

FOR_EVER_S = 1e6
FLOOR_M = 0.05


@dataclass(frozen=True)
class Group:
    """Flights of one kind: `force_n` acts from `moment_s` into `phase` on, from the flight's start
    without a phase; `covered_s` later something hides the target for good."""

    profile: str
    force_n: float
    phase: Phase | None
    covered_s: float | None = None
    moment_s: float = 0.2

    @property
    def name(self) -> str:
        since = "start" if self.phase is None else self.phase.name.lower()
        covered = "" if self.covered_s is None else f", covered {self.covered_s:g} s later"
        return f"{self.profile}: {self.force_n:g} N from {since}{covered}"


GROUPS = (
    Group("target_only", 0.015, Phase.ASCEND),
    Group("target_only", 0.018, None, 6.0),
    Group("target_only", 0.018, Phase.ASCEND, 3.0),
    Group("target_only", 0.05, None, 6.0),
    Group("target_only", 0.05, Phase.ASCEND),
    Group("target_only", 0.006, Phase.PERCH),
    Group("target_only", 0.008, Phase.PERCH),
    Group("target_only", 0.015, Phase.PERCH),
    Group("sim", 0.018, Phase.ALIGN),
    Group("sim", 0.05, Phase.ALIGN),
    Group("sim", 0.05, Phase.ASCEND),
)


@dataclass(frozen=True)
class Flown:
    outcome: str
    reason: str
    aside_m: float
    floor_mps: float
    miss_m: float | None
    flags: tuple[str, ...]


def fly(group: Group, seed: int) -> Flown:
    cv2.setNumThreads(1)
    profile = load_profile(group.profile)
    scenario = draw_scenario(profile, seed)
    angle_rad = float(np.random.default_rng([seed, 5]).uniform(-math.pi, math.pi))
    force_n = (group.force_n * math.cos(angle_rad), group.force_n * math.sin(angle_rad), 0.0)
    effects = [partial(push, force_n=force_n, for_s=FOR_EVER_S)]
    if group.covered_s is not None:
        effects.append(partial(cover, after_s=group.covered_s))
    case = Case(BY_NAME["gust"], group.phase or Phase.APPROACH, group.moment_s, tuple(effects))
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "flight.jsonl"
        result = fly_with_fault(profile, case, replace(scenario), log)
        flight = read_log(log)
    begin_s = result.begin_s or 0.0
    t_s = flight.column("t_s")
    x, y, z = (flight.column(f"true_{axis}_m") for axis in "xyz")
    after = (t_s >= begin_s + (group.covered_s or 0.0)) & (z > FLOOR_M)
    aside_m = floor_mps = math.nan
    if after.any():
        x, y, z, t_s = x[after], y[after], z[after], t_s[after]
        aside_m = float(np.hypot(x - x[0], y - y[0]).max())
        last = t_s >= t_s[-1] - 0.3
        if last.sum() > 2:
            floor_mps = float(np.hypot(np.ptp(x[last]), np.ptp(y[last])) / np.ptp(t_s[last]))
    return Flown(
        result.outcome, result.reason, aside_m, floor_mps, result.miss_m, tuple(result.flags)
    )


def cover(rig: FaultRig, t_s: float, after_s: float) -> None:
    """Hide the target for good, `after_s` later."""
    at_s = t_s + after_s
    rig.call_at(at_s, lambda: camera_fault(rig, at_s, kind="covered", for_s=FOR_EVER_S))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=int, default=4, help="flights of each group")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="groups whose name has this in it")
    args = parser.parse_args()
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.jobs, mp_context=context) as executor:
        for group in GROUPS:
            if args.only not in group.name:
                continue
            flown = list(executor.map(partial(fly, group), range(args.seed, args.seed + args.n)))
            ends = Counter(f.outcome for f in flown)
            misses = " ".join("-" if f.miss_m is None else f"{1e3 * f.miss_m:.1f}" for f in flown)
            rows.append(
                (
                    group.name,
                    " ".join(f"{n} {end}" for end, n in ends.items()),
                    " ".join(f"{f.aside_m:.2f}" for f in flown),
                    " ".join(f"{f.floor_mps:.2f}" for f in flown),
                    misses,
                )
            )
            print(*rows[-1], *(f"\n    {f.reason} {f.flags}" for f in flown), flush=True)
    table(
        "steady force from the side",
        ("group", "ends", "aside m", "at the floor m/s", "miss mm"),
        rows,
    )


if __name__ == "__main__":
    main()
