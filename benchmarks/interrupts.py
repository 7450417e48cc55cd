"""Ctrl-C in each phase of a simulated flight through the real cflib, in real time.

    python benchmarks/interrupts.py [--seed 2]

Starts `perchctl fly` once a phase, waits until its panel-less output names the phase,
interrupts it, and prints exit code, last phase, and whether the supervisor locked.
Expected of every row: exit 130, landed (or hanging with the motors off), not locked.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from perchctl.mission.state import SEVEN_PHASES
from perchctl.record import read_log
from perchctl.vehicle import LOCKED

TIMEOUT_S = 120.0


def interrupt_in(phase: str, seed: int, folder: Path) -> tuple[int, str, bool]:
    """Exit code, last phase and lock of a flight interrupted when it enters `phase`."""
    flight = subprocess.Popen(
        [sys.executable, "-m", "perchctl", "fly", "--seed", str(seed), "--log-dir", str(folder)],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert flight.stderr is not None
    for line in flight.stderr:
        if f"] {phase}:" in line:
            flight.send_signal(signal.SIGINT)
            break
    flight.stderr.read()
    code = flight.wait(TIMEOUT_S)
    log = read_log(max(folder.glob("*.jsonl"), key=lambda path: path.stat().st_mtime))
    last = log.records[-1]
    return code, str(last["phase"]), bool(int(last["supervisor"]) & LOCKED)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=2)
    options = parser.parse_args()
    good = True
    print(f"{'Ctrl-C in':<10} {'exit':>4}  {'ended':<8} locked")
    with tempfile.TemporaryDirectory() as folder:
        for phase in SEVEN_PHASES:
            code, ended, locked = interrupt_in(phase.value, options.seed, Path(folder))
            good = good and code == 130 and ended in ("LANDED", "PERCHED") and not locked
            print(f"{phase.value:<10} {code:>4}  {ended:<8} {locked}", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
