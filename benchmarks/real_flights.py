"""Recorded flights of real Crazyflies against their replay in the simulator.

    python benchmarks/real_flights.py DATA [-n 12] [--seed 0] [--jobs 2] [--json FILE]

DATA is a copy of NanoBench (docs/real-flights.md says where to get it): the folder itself or any
folder above its CSV files. Each flight's recorded position setpoints are flown again by a simulated
vehicle of the same apparent mass and resting voltage; everything else is drawn from the profile and
the seed, as for any simulated flight. Prints for each item the median and the 10th to 90th
percentile over the flights, of the records and of the replays, the median of replay over record
flight by flight, and whether the model's median lies within the records' range.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import math
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from common import table
from recorded_flight import (
    ITEMS,
    ROW_S,
    Recording,
    UnreadableRecord,
    measure,
    read_recordings,
)

from perchctl.geometry import Array, rotation_from_quaternion, rpy_from_rotation
from perchctl.profile import load_profile
from perchctl.sim import (
    CaptureSettings,
    Scenario,
    SimulatedVehicle,
    draw_scenario,
)
from perchctl.sim.firmware.controller import MODE_POSITION, Setpoint
from perchctl.sim.powertrain import FULL_COMMAND

REPLAY_CEILING_M = 4.0
LOG_HZ = 97.5
"""Rate at which NanoBench's vehicle logged; the rows of its files are interpolated from that."""
AFTER_S = 0.3


def in_start_frame(r: Recording, floor_z_m: float) -> Recording:
    """Move a record so that it starts at the origin, at the height `floor_z_m`, and so that the
    vehicle's own estimate of its heading starts at 0. The motion capture's heading does, too: what
    differs is how the markers are mounted."""
    before = slice(0, max(1, r.begin))
    x, y, z = r.position_m[before].mean(axis=0)
    true_rad = float(r.rpy_rad[before, 2].mean())
    estimated_rad = float(r.estimated_rpy_rad[before, 2].mean())
    yaw = true_rad if math.isnan(estimated_rad) else estimated_rad
    cos, sin = math.cos(yaw), math.sin(yaw)

    def moved(xyz: Array) -> Array:
        dx, dy = xyz[:, 0] - x, xyz[:, 1] - y
        return np.stack(
            [dx * cos + dy * sin, dy * cos - dx * sin, xyz[:, 2] - z + floor_z_m], axis=1
        )

    def turned(rpy: Array, start_rad: float) -> Array:
        return np.column_stack([rpy[:, :2], np.unwrap(rpy[:, 2]) - start_rad])

    active = np.any(r.setpoint != 0.0, axis=1, keepdims=True)
    setpoint = np.column_stack([moved(r.setpoint[:, :3]), r.setpoint[:, 3] - yaw])
    return replace(
        r,
        position_m=moved(r.position_m),
        rpy_rad=turned(r.rpy_rad, true_rad),
        estimated_rpy_rad=turned(r.estimated_rpy_rad, yaw),
        setpoint=np.where(active, setpoint, 0.0),
    )


def draw_replay(r: Recording, profile: str, seed: int) -> Scenario:
    """The seed's scenario, with what is known of the recorded flight: its mass and resting voltage,
    positions from outside, still air."""
    drawn = draw_scenario(load_profile(profile), seed)
    return replace(
        drawn,
        mass_kg=r.mass_kg(),
        battery_rest_v=r.rest_v,
        ceiling_z_m=REPLAY_CEILING_M,
        no_target=True,
        draught_mps=(0.0, 0.0, 0.0),
        drift_mps=(0.0, 0.0, 0.0),
        extra={**drawn.extra, "external_position": 1.0},
    )


def replay(r: Recording, scenario: Scenario) -> Recording:
    """Fly the setpoints of a record that is in its start's frame; return the simulated record.

    The simulated log is sampled and interpolated as NanoBench's was."""
    vehicle = SimulatedVehicle(scenario, capture=CaptureSettings(rate_hz=100.0, seed=scenario.seed))
    firmware, world, capture = vehicle.firmware, vehicle.world, vehicle.capture
    assert capture is not None
    last = min(len(r.duty), r.end + round(AFTER_S / ROW_S))
    logged_s: list[float] = []
    logged: list[list[float]] = []
    for row in range(last):
        if r.begin <= row < r.end:
            x, y, z, yaw = r.setpoint[row].tolist()
            firmware.fly_setpoint(Setpoint(MODE_POSITION, x, y, z, yaw_deg=math.degrees(yaw)))
        elif row == r.end:
            firmware.fly_setpoint(Setpoint())
        while vehicle.t_s < (row + 1) * ROW_S - 1e-6:
            frame = capture.poll(vehicle.t_s)
            if frame is not None:
                firmware.take_external(frame.bodies[capture.settings.body].position_m)
            vehicle.step()
            if vehicle.t_s >= len(logged_s) / LOG_HZ:
                logged_s.append(vehicle.t_s)
                roll, pitch, yaw = rpy_from_rotation(rotation_from_quaternion(world.quaternion))
                now = firmware.estimator.now
                logged.append([
                    world.x_m, world.y_m, world.z_m, roll, pitch, yaw,
                    math.radians(now.roll_deg), -math.radians(now.pitch_deg),
                    math.radians(now.yaw_deg),
                    *(math.radians(firmware.log_value(f"gyro.{axis}")) for axis in "xyz"),
                    *(firmware.log_value(f"acc.{axis}") for axis in "xyz"),
                    *(duty / FULL_COMMAND for duty in firmware.motors),
                    firmware.log_value("pm.vbat"),
                ])  # fmt: skip
    values = np.array(logged)
    values[:, [5, 8]] = np.unwrap(values[:, [5, 8]], axis=0)
    rows_s = ROW_S * np.arange(1, last + 1)
    rows = np.stack([np.interp(rows_s, logged_s, column) for column in values.T], axis=1)
    rows[:, 15:19] *= (np.arange(last) >= r.begin)[:, None]  # no motor half a sample too early
    return Recording(
        r.name,
        rows[:, 0:3],
        rows[:, 3:6],
        rows[:, 6:9],
        r.setpoint[:last],
        rows[:, 9:12],
        rows[:, 12:15],
        rows[:, 15:19],
        rows[:, 19],
        has_setpoints=r.has_setpoints,
    )


@dataclass(frozen=True)
class Compared:
    """One flight: the values of `ITEMS` on the record and on its replay."""

    name: str
    recorded: list[float]
    model: list[float]
    problem: str | None


def compare(flight: tuple[int, Recording], profile: str, seed: int) -> Compared:
    number, r = flight
    scenario = draw_replay(r, profile, seed + number)
    r = in_start_frame(r, SimulatedVehicle(scenario).world.z_m)
    simulated = replay(r, scenario)
    return Compared(r.name, measure(r), measure(simulated), simulated.unusable())


@dataclass(frozen=True)
class Flights:
    """What a folder holds: NanoBench's flights, neural-swarm's, and why others are left out."""

    nanobench: list[Recording]
    neural_swarm: list[Recording]
    left_out: list[str]


def find_flights(data: Path) -> Flights:
    """Read every CSV file below a folder. Copies of a file count once."""
    found, seen = Flights([], [], []), set()
    for path in sorted(data.rglob("*.csv")):
        digest = hashlib.sha256(path.read_bytes()).digest()
        if digest in seen:
            continue
        seen.add(digest)
        try:
            recordings = read_recordings(path)
        except UnreadableRecord as error:
            found.left_out.append(f"{path.stem}: {error}")
            continue
        for r in recordings:
            reason = r.unusable()
            if reason is not None:
                found.left_out.append(f"{r.name}: {reason}")
            else:
                (found.nanobench if r.has_setpoints else found.neural_swarm).append(r)
    return found


@dataclass(frozen=True)
class Row:
    """One line of the table. `within`: the model's median lies in the records' range."""

    item: str
    unit: str
    recorded: tuple[float, float, float]
    model: tuple[float, float, float]
    ratio: float
    flights: int
    within: bool


def percentiles(values: Array) -> tuple[float, float, float]:
    """The median, and the 10th and 90th percentile."""
    low, middle, high = np.percentile(values, (10.0, 50.0, 90.0)).tolist()
    return middle, low, high


def summarise(compared: list[Compared]) -> list[Row]:
    """One row for each item that at least one flight answers on both sides."""
    rows = []
    for i, item in enumerate(ITEMS):
        pairs = np.array([(c.recorded[i], c.model[i]) for c in compared])
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        if not len(pairs):
            continue
        recorded, model = percentiles(pairs[:, 0]), percentiles(pairs[:, 1])
        ratio = float(np.median(pairs[:, 1] / pairs[:, 0]))
        within = recorded[1] <= model[0] <= recorded[2]
        rows.append(Row(item.name, item.unit, recorded, model, ratio, len(pairs), within))
    return rows


def spread(values: tuple[float, float, float]) -> str:
    middle, low, high = values
    return f"{middle:.3g} ({low:.3g}..{high:.3g})"


def print_table(name: str, compared: list[Compared]) -> None:
    """Print the comparison of one source's flights; nothing without flights."""
    if not compared:
        return
    table(
        f"{name}, {len(compared)} flights: median (10 %..90 %)",
        ("item", "unit", "flights", "record", "model", "model/record", "within"),
        [
            (
                row.item,
                row.unit,
                row.flights,
                spread(row.recorded),
                spread(row.model),
                row.ratio,
                "yes" if row.within else "no",
            )
            for row in summarise(compared)
        ],
    )


def refuse(message: str) -> None:
    """End with one sentence on standard error and status 2."""
    print(f"real_flights: {message}", file=sys.stderr)
    sys.exit(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", metavar="DATA", type=Path, help="folder with NanoBench's CSV files")
    parser.add_argument("-n", type=int, help="that many flights, evenly chosen (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("-p", "--profile", default="sim", help="whose ranges the replays draw from")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write each flight's values, too")
    args = parser.parse_args()
    if not args.data.is_dir():
        refuse(f"{args.data} is no folder; docs/real-flights.md says where to get the records")
    flights = find_flights(args.data)
    if not flights.nanobench + flights.neural_swarm:
        reason = flights.left_out[0] if flights.left_out else "no file has the columns of a record"
        refuse(
            f"no flight in {args.data} can be compared ({reason});"
            " docs/real-flights.md says where to get the records"
        )
    for line in flights.left_out:
        print(f"left out: {line}")
    compared = []
    work = partial(compare, profile=args.profile, seed=args.seed)
    with contextlib.ExitStack() as stack:
        each_of: Callable[..., Iterator[Compared]] = map
        if args.jobs > 1:
            context = multiprocessing.get_context("spawn")
            executor = ProcessPoolExecutor(args.jobs, mp_context=context)
            each_of = stack.enter_context(executor).map
        for name, recordings in (
            ("NanoBench", flights.nanobench),
            ("neural-swarm, setpoints made up from the path", flights.neural_swarm),
        ):
            numbered = list(enumerate(recordings))
            if args.n is not None and args.n < len(numbered):
                chosen = np.linspace(0, len(numbered) - 1, max(1, args.n)).round().astype(int)
                numbered = [numbered[i] for i in sorted(set(chosen.tolist()))]
            pairs = []
            for number, each in enumerate(each_of(work, numbered), 1):
                problem = f": {each.problem} in the replay, not counted" if each.problem else ""
                print(f"{number}/{len(numbered)} {each.name}{problem}", flush=True)
                pairs.append(each)
            print_table(name, [each for each in pairs if each.problem is None])
            compared += pairs
    if args.json is not None:
        names = [item.name for item in ITEMS]
        content = {
            each.name: {
                "record": dict(zip(names, each.recorded, strict=True)),
                "model": dict(zip(names, each.model, strict=True)),
                "problem": each.problem,
            }
            for each in compared
        }
        args.json.write_text(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
