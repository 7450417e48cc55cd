"""Slips: a magnet that carries 0.2 to 1.0 of the weight, at 42 g, under ceilings over 1.8 m.

    python benchmarks/weak_magnet.py [-n 100] [--jobs 2]

Two attempts a flight. Prints the deepest drop until caught by what the magnet carries, in the
simulator's truth, and how many fell, were locked, or were reported as perched.
Exit code 1 where one fell or dropped deeper than `perchctl.faults.oracle.drop_limit_m`.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from perchctl.faults import FaultResult
from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.effects import magnet_holds
from perchctl.faults.flight import fly_with_fault
from perchctl.faults.oracle import drop_limit_m
from perchctl.mission import Phase
from perchctl.profile import load_profile
from perchctl.sim import draw_scenario

MASS_KG, LOWEST_CEILING_M, ATTEMPTS, STREAM = 0.042, 1.85, 2, 77


def carried(seed: int) -> float:
    """The part of the weight that the seed's magnet carries."""
    return float(np.random.default_rng([seed, STREAM]).uniform(0.2, 1.0))


def fly(seed: int) -> FaultResult:
    cv2.setNumThreads(1)  # a job is one core
    profile = load_profile("sim")
    planner = profile.planner.model_copy(update={"attempts": ATTEMPTS})
    profile = profile.model_copy(update={"planner": planner})
    scenario = draw_scenario(profile, seed)
    scenario = replace(
        scenario,
        mass_kg=MASS_KG,
        ceiling_z_m=max(LOWEST_CEILING_M, scenario.ceiling_z_m),
        first_contact_force_n=None,
    )
    held = partial(magnet_holds, of_weight=carried(seed))
    case = Case(BY_NAME["weak-magnet"], Phase.PERCH, 0.0, (held,))
    return fly_with_fault(profile, case, scenario)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", "--flights", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    seeds = range(options.flights)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as executor:
        flown = list(zip(map(carried, seeds), executor.map(fly, seeds), strict=True))
    for low, high in ((0.2, 0.3), (0.3, 0.75), (0.75, 1.0)):
        drops_m = [r.drop_m for part, r in flown if low <= part < high]
        if drops_m:
            print(
                f"carries {low:g} to {high:g} of the weight: {len(drops_m)} flights, drop until "
                f"caught median {np.median(drops_m):.2f} m, largest {max(drops_m):.2f} m "
                f"(limit {drop_limit_m(high):g} m)"
            )
    bad = [(part, r) for part, r in flown if r.flags]
    ends = Counter(r.outcome for _, r in flown)
    print(f"{dict(ends)}; with a flag: {len(bad)}")
    for part, r in bad:
        print(f"  seed {r.seed}, carries {part:.2f}: {dict(r.flags)}, {r.reason}")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
