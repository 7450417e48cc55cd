"""The energy gate on weak batteries: whether an ascent that it lets begin has enough, and what
becomes of the same flights without it; and whether it ever refuses a good battery.

    python benchmarks/energy.py [-n 20] [--good 40] [--without 10] [--jobs 2]

So many simulated flights of each kind of weak battery: low charge (3.80 to 3.88 V at rest), high
resistance, old (40 to 80 % of its charge). In half of the flights the first contact fails, so
that there is a second attempt to be paid for. An ascent is lost when `battery-low` lands it
between its begin and the contact. Exit code 1 where more than 1 in 50 of those that the gate let
begin is, or where a good battery is refused.
"""

from __future__ import annotations

import argparse
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from perchctl.flight import fly_lockstep
from perchctl.mission import Event, EventKind, Phase, Tick
from perchctl.profile import Profile, load_profile
from perchctl.sim import Scenario, draw_scenario

WEAK = ("low charge", "high resistance", "old")
GOOD = "good"
MOST_LOST, STREAM = 1 / 50, 78
RATE_HZ = 12.0
"""Of the pictures: it is about the battery, and they cost most of the time."""
UP = (Phase.ASCEND, Phase.PERCH)


@dataclass(frozen=True)
class Job:
    kind: str
    seed: int
    gate: bool


@dataclass(frozen=True)
class Flown:
    """`lost` in an ascent by `battery-low`; `refused` at which attempt, 0: never; `lowest_v` in
    an ascent or a press."""

    job: Job
    end: str
    row: str
    begun: int
    lost: int
    refused: int
    reason: str
    fell: bool
    lowest_v: float


class Watch:
    problem: str | None = None

    def __init__(self) -> None:
        self.phase = Phase.APPROACH
        self.begun = self.lost = self.refused = 0
        self.row = ""
        self.lowest_v = 9.9

    def event(self, event: Event) -> None:
        if event.kind is not EventKind.PHASE or event.phase is None:
            return
        self.begun += event.phase is Phase.ASCEND
        self.lost += event.transition_name == "battery-low" and self.phase in UP
        if event.transition_name == "too-little-left":
            self.refused = self.begun + 1
        if event.phase is Phase.LANDING:
            self.row = event.transition_name
        self.phase = event.phase

    def tick(self, tick: Tick) -> None:
        if tick.state.phase in UP:
            self.lowest_v = min(self.lowest_v, tick.telemetry.battery_v)


def battery(kind: str, seed: int) -> dict[str, float]:
    """The seed's battery of that kind, as fields of the scenario."""
    rng = np.random.default_rng([seed, STREAM])
    rest, ohm, slow, charge, knee = {
        "low charge": ((3.8, 3.88), (0.13, 0.16), (0.0, 0.02), (0.9, 1.0), (0.07, 0.13)),
        "high resistance": ((3.9, 4.2), (0.16, 0.21), (0.0, 0.04), (0.8, 1.0), (0.07, 0.13)),
        "old": ((3.85, 4.15), (0.15, 0.19), (0.0, 0.05), (0.4, 0.8), (0.07, 0.15)),
    }[kind]
    names = ("battery_rest_v", "cell_resistance_ohm", "cell_slow_ohm", "cell_charge", "cell_knee")
    drawn = [float(rng.uniform(*bounds)) for bounds in (rest, ohm, slow, charge, knee)]
    return dict(zip(names, drawn, strict=True))


def flight_of(job: Job) -> tuple[Profile, Scenario]:
    profile = load_profile("sim")
    safety = profile.safety.model_copy(update={"energy_gate": job.gate})
    simulation = profile.simulation.model_copy(
        update={"camera_rate_hz": RATE_HZ}
        | ({} if job.kind == GOOD else {"first_contact_fails": 0.5})
    )
    profile = profile.model_copy(update={"safety": safety, "simulation": simulation})
    scenario = draw_scenario(profile, job.seed)
    return profile, scenario if job.kind == GOOD else replace(
        scenario, **battery(job.kind, job.seed)
    )


def fly(job: Job) -> Flown:
    cv2.setNumThreads(1)  # a job is one core
    profile, scenario = flight_of(job)
    watch = Watch()
    flight = fly_lockstep(profile, scenario=scenario, watchers=(watch,))
    return Flown(
        job, flight.report.phase.value.lower(), watch.row, watch.begun, watch.lost, watch.refused,
        flight.report.reason, flight.fell, watch.lowest_v,
    )  # fmt: skip


def told(title: str, flown: list[Flown]) -> None:
    if not flown:
        return
    ends = {end: sum(f.end == end for f in flown) for end in ("perched", "landed", "aborted")}
    print(
        f"{title}: {len(flown)} flights, "
        + ", ".join(f"{count} {end}" for end, count in ends.items() if count)
        + f"; {sum(f.begun for f in flown)} ascents begun, {sum(f.lost for f in flown)} lost by "
        f"battery-low; refused before the first {sum(f.refused == 1 for f in flown)}, before a "
        f"further one {sum(f.refused > 1 for f in flown)}; fell {sum(f.fell for f in flown)}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", "--flights", type=int, default=20, help="of each weak kind")
    parser.add_argument("--good", type=int, default=40, help="flights with a good battery")
    parser.add_argument("--without", type=int, default=10, help="of each weak kind, no gate")
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    first = options.seed
    jobs = [
        Job(kind, seed, gate)
        for gate, count in ((True, options.flights), (False, options.without))
        for seed in range(first, first + count)
        for kind in WEAK
    ]
    jobs += [Job(GOOD, seed, True) for seed in range(first, first + options.good)]
    context = multiprocessing.get_context("spawn")
    flown = []
    with ProcessPoolExecutor(options.jobs, mp_context=context) as executor:
        for each in executor.map(fly, jobs):
            flown.append(each)
            if each.lost or each.fell or (each.refused and each.job.kind == GOOD):
                print(f"  {each.job}: {each.end}, lowest {each.lowest_v:.2f} V, {each.reason}")
    for gate in (True, False):
        for kind in (*WEAK, GOOD):
            of_kind = [f for f in flown if f.job.gate is gate and f.job.kind == kind]
            told(f"{kind}, {'with' if gate else 'without'} the gate", of_kind)
    gated = [f for f in flown if f.job.gate and f.job.kind != GOOD]
    told("all weak ones, with the gate", gated)
    plain = {(f.job.kind, f.job.seed): f for f in flown if not f.job.gate}
    pairs = [(f, plain[f.job.kind, f.job.seed]) for f in gated if (f.job.kind, f.job.seed) in plain]
    needless = sum(bool(f.refused) and not p.lost and p.end == "perched" for f, p in pairs)
    refused = sum(bool(f.refused) for f, _ in pairs)
    print(
        f"of {refused} refused ones that were flown without the gate too, {needless} perched there"
    )
    begun, lost = sum(f.begun for f in gated), sum(f.lost for f in gated)
    good_refused = sum(bool(f.refused) for f in flown if f.job.kind == GOOD)
    return 1 if lost > MOST_LOST * begun or good_refused else 0


if __name__ == "__main__":
    raise SystemExit(main())
