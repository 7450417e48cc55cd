"""Fleets in real time: who perches, whether the computer keeps up, and how fast a stop arrives.

    python benchmarks/fleet.py [-n 3] [--seed 11] [--fleet FLEET.yaml] [--stop 0]
    python benchmarks/fleet.py -n 0 --stop 3
    python benchmarks/fleet.py -n 0 --recorded 4 [--log FLIGHT.jsonl]

First whole flights of `perchctl fleet fly`, by default of the four shipped simulated vehicles. For
each flight: the time it took, simulated time over wall time, and the computing time of everything
together, with simulators and parent. For each vehicle: the gaps between two setpoints on the wall
clock (p50, p99, largest), and the computing time of its process without its simulator.

Then, with `--stop N`, each case N times: the time from a key (or from the death of the parent) to
the packet that lands or stops the last vehicle. Two vehicles fly together, each behind a wire
between cflib and its simulator that notes the packets; these simulators do not wait for the loops.

With `--recorded N`, N loops fly a recorded flight instead, without simulators
(benchmarks/recorded_loops.py): the gaps between setpoints, and what each part costs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from interrupts import CTRL_C, SPACE, TerminalFlight, Wire, started_vehicle  # noqa: E402
from recorded_loops import fly_recorded  # noqa: E402

FLIGHT_TIMEOUT_S = 400.0
SOON_S = 3.0
"""Until the flight is left to end: within it all packets have passed."""
LANDED_TIMEOUT_S = 60.0
TRIES = 4
"""On a busy computer a vehicle may land by itself before the key; then another seed is flown."""


# --- whole flights ---


def fly(words: list[str], seed: int) -> bool:
    """Fly once and print; True if all hang."""
    with tempfile.TemporaryDirectory() as folder:
        before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        command = [sys.executable, "-m", "perchctl", "fleet", "fly", *words, "--json"]
        command += ["--seed", str(seed), "--log-dir", folder]
        done = subprocess.run(command, capture_output=True, check=False, timeout=FLIGHT_TIMEOUT_S)
        wall_s = time.monotonic() - began_s
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    record = json.loads(done.stdout)
    if "vehicles" not in record:
        print(f"seed {seed}: {record['error']}", flush=True)
        return False
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    ratio = "-" if record["ratio"] is None else f"{record['ratio']:.2f}"
    count = len(record["vehicles"])
    print(
        f"seed {seed}: {record['hanging']} of {count} hang, exit {record['exit_code']}, "
        f"{wall_s:.0f} s, ratio {ratio}, {cpu_s / wall_s:.2f} cores, "
        f"load {os.getloadavg()[0]:.1f}",
        flush=True,
    )
    for vehicle in record["vehicles"]:
        pace, miss_m = vehicle["pace"], vehicle["miss_m"]
        miss = "" if miss_m is None else f"{1e3 * miss_m:.1f} mm"
        gaps = (
            ""
            if pace is None
            else f"gaps {1e3 * pace['gap_p50_s']:4.0f} {1e3 * pace['gap_p99_s']:4.0f} "
            f"{1e3 * pace['gap_max_s']:4.0f} ms   {pace['cores']:.2f} core   "
            f"ratio {pace['ratio']:.2f}"
        )
        print(f"  {vehicle['name']:<10} {vehicle['outcome']:<8} {miss:>8}   {gaps}")
        if vehicle["exit_code"]:
            print(f"    {vehicle['reason']}", flush=True)
    return bool(record["hanging"] == count)


# --- from a key to the last packet ---


@dataclass
class Flying:
    """Two vehicles in the air, their wires, and the terminal of their fleet."""

    flight: TerminalFlight
    wires: dict[str, Wire]
    children: dict[str, int]

    @property
    def parent(self) -> int:
        return self.flight.process.pid

    def press(self, *keys: tuple[float, str]) -> float:
        """Press keys at their times, s; return when the last was pressed."""
        begun_s = pressed_s = time.monotonic()
        for at_s, key in keys:
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            pressed_s = time.monotonic()
            self.flight.press(key)
        return pressed_s

    def kill(self, pid: int, name: signal.Signals) -> float:
        at_s = time.monotonic()
        os.kill(pid, name)
        return at_s


def busy_screen(flying: Flying) -> float:
    """Ctrl-C on a terminal that has stood still for two seconds."""
    flying.flight.paused.set()
    time.sleep(2.0)
    return flying.press((0.0, CTRL_C))


def hung_child(flying: Flying) -> float:
    os.kill(flying.children["north"], signal.SIGSTOP)
    time.sleep(0.5)
    return flying.press((0.0, CTRL_C))


BOTH, EAST, NORTH = ("north", "east"), ("east",), ("north",)
CASES: dict[str, tuple[str, tuple[str, ...], Callable[[Flying], float]]] = {
    "Ctrl-C lands all": ("lands", BOTH, lambda f: f.press((0.0, CTRL_C))),
    "Ctrl-C again, 1.5 s later, cuts all": (
        "stops",
        BOTH,
        lambda f: f.press((0.0, CTRL_C), (1.5, CTRL_C)),
    ),
    "space bar cuts all": ("stops", BOTH, lambda f: f.press((0.0, SPACE))),
    "key 1 lands north": ("lands", NORTH, lambda f: f.press((0.0, "1"))),
    "Ctrl-C, north's process is stopped": ("lands", EAST, hung_child),
    "Ctrl-C, the terminal stands still": ("lands", BOTH, busy_screen),
    "the parent is killed": ("lands", BOTH, lambda f: f.kill(f.parent, signal.SIGKILL)),
    "the parent is stopped": ("lands", BOTH, lambda f: f.kill(f.parent, signal.SIGSTOP)),
}

FLEET = """\
name: wired
defaults: {{profile: sim}}
order: together
vehicles:
  - {{name: north, home_m: [0, 0], target_m: [0.2, 0.1], uri: "{north.uri}", source: "{north_s}"}}
  - {{name: east, home_m: [2.6, 0], target_m: [2.8, 0.1], uri: "{east.uri}", source: "{east_s}"}}
"""


def key_to_packet_ms(case: str, seed: int) -> tuple[float, int | None] | None:
    """From the deciding key to the last vehicle's packet, ms, and the exit code. None if a vehicle
    has landed before the key."""
    what, who, act = CASES[case]
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        north, north_s = stack.enter_context(started_vehicle(seed, (0.2, 0.1)))
        east, east_s = stack.enter_context(started_vehicle(seed + 1, (0.2, 0.1)))
        path = Path(folder) / "wired.yaml"
        path.write_text(FLEET.format(north=north, north_s=north_s, east=east, east_s=east_s))
        flight = TerminalFlight("fleet", "fly", str(path), "--yes", "--log-dir", folder)
        stack.callback(flight.process.kill)
        for name in BOTH:
            flight.wait_for(rf"{name}: (ESTIMATE|ALIGN|LANDING|aborted|landed)")
        if "LANDING" in flight.shown:
            flight.press(CTRL_C)
            flight.process.wait(LANDED_TIMEOUT_S)
            return None
        children = dict(zip(BOTH, children_of(flight.process.pid), strict=True))
        flying = Flying(flight, {"north": north, "east": east}, children)
        at_s = act(flying)

        time.sleep(SOON_S)
        flight.paused.clear()
        if case.startswith("key"):  # the other one flies on
            flying.press((0.0, CTRL_C))
        with contextlib.suppress(OSError):
            os.kill(flight.process.pid, signal.SIGCONT)
        code = flight.process.wait(120.0)
        wait_for_end(list(children.values()))
        logs = {name: next(Path(folder).glob(f"*/*_{name}.jsonl")) for name in BOTH}
        landing_s = {name: landed_s(log) for name, log in logs.items()}
        if case.startswith("key") and landing_s["east"] < at_s + SOON_S:
            raise SystemExit(f"{case}: it has landed the other one")
        passed_s = [
            flying.wires[name].stopped_s or math.inf
            if what == "stops"
            else flying.wires[name].ordered_after_s(landing_s[name])
            for name in who
        ]
    return 1e3 * (max(passed_s) - at_s), code


def landed_s(log: Path) -> float:
    """When the flight of this log decided to land, on `time.monotonic`; inf if it did not."""
    for line in log.read_text().splitlines():
        if '"LANDING"' in line and (record := json.loads(line))["kind"] == "event":
            return float(record["t_s"])
    return math.inf


def children_of(parent: int) -> list[int]:
    """The processes of the vehicles, in the order in which they were started."""
    listed = Path(f"/proc/{parent}/task")
    pids = {
        int(pid) for task in listed.iterdir() for pid in (task / "children").read_text().split()
    }
    return sorted(pids)


def wait_for_end(pids: list[int]) -> None:
    """Wait until orphans have landed and ended; end those that do not."""
    end_s = time.monotonic() + LANDED_TIMEOUT_S
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < end_s:
        time.sleep(0.1)
    for pid in pids:
        if Path(f"/proc/{pid}").exists():
            print(f"  process {pid} has not ended within {LANDED_TIMEOUT_S:.0f} s")
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=3, help="whole flights")
    parser.add_argument("--seed", type=int, default=11, help="of the first flight")
    parser.add_argument("--fleet", help="fleet file instead of the shipped one")
    parser.add_argument("--stop", type=int, default=0, help="repetitions of each way to stop")
    parser.add_argument("--recorded", type=int, default=0, help="loops that fly a recorded flight")
    parser.add_argument("--log", type=Path, help="that flight; without one, it is recorded first")
    parser.add_argument("--case", help="only cases with this text in their name")
    given = parser.parse_args()
    words = [] if given.fleet is None else [given.fleet]
    perched = sum(fly(words, given.seed + number) for number in range(given.n))
    if given.n:
        print(f"{perched} of {given.n} flights with all hanging", flush=True)
    if given.recorded:
        fly_recorded(given.recorded, given.log, given.seed)
    if given.stop:
        print(f"{'from key to last packet':<40} {'median':>9} {'most':>9}  exit", flush=True)
    for case in CASES if given.stop else ():
        if given.case and given.case not in case:
            continue
        found: list[tuple[float, int | None]] = []
        for number in range(TRIES * given.stop):
            if len(found) < given.stop and (
                each := key_to_packet_ms(case, given.seed + 2 * number)
            ):
                found.append(each)
        if not found:
            print(f"{case:<40} no flight got so far")
            continue
        times_ms, codes = [ms for ms, _ in found], sorted({str(code) for _, code in found})
        print(
            f"{case:<40} {statistics.median(times_ms):>6.0f} ms {max(times_ms):>6.0f} ms  "
            f"{', '.join(codes)}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
