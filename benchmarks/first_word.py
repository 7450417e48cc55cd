"""Time until the first byte of each command on a terminal: of its help, of an error, and of its
work; and the CPU time until then, which depends less on what else the machine does. Each command
runs in a process of its own, one after the other."""

from __future__ import annotations

import argparse
import gzip
import math
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.commands.command_line import COMMANDS  # noqa: E402

RUNS = 5
LIMIT_S = 0.5
WAIT_S = 60.0
CALIBRATION = str(ROOT / "calib/example_640x480.yaml")
FLIGHT = ROOT / "tests/data/flights/perched.jsonl.gz"
LOG = "flight.jsonl"
ERRORS = (
    "fly -p smi",
    "fly --bogus",
    "check -p smi",
    "simulate -p smi",
    "simulate --resume",
    "track none.png",
    "calibrate images:none",
    "log show none.jsonl",
    "fleet check none.yaml",
    "make-target -p smi",
    "profile -p smi",
    "fit-weights none.csv",
)
WORK = (
    "fly",
    "fly --dry-run",
    "hover",
    "hover --dry-run",
    "check",
    "check --cameras",
    "check --scan",
    "simulate -n 1",
    "simulate compare sim paper -n 1",
    "simulate sweep planner.align.xy_m=0.02,0.04 -n 1",
    "simulate --faults list",
    "fleet check",
    "fleet fly",
    "fleet simulate -n 1",
    f"fleet convert {ROOT / 'fleets/four.yaml'}",
    "track images:.",
    "calibrate images:.",
    f"calibrate check {CALIBRATION} images:.",
    f"calibrate convert {CALIBRATION} --force",
    "calibrate mask images:.",
    "calibrate mount -p crazyflie",
    f"log show {LOG}",
    f"log plot {LOG} -o plot.png --force",
    f"log compare {LOG} {LOG}",
    f"log export {LOG} -o log.csv --force",
    f"log replay {LOG}",
    f"log report {LOG} -o log.html --force",
    f"log film {LOG} -o log.mp4 --force",
    "make-target --force",
    "make-target board chessboard:9x6:25mm --force",
    "make-target design",
    "make-target measured -p mine.yaml --measured-large 149.6",
    "profile",
    "profile new --defaults --force",
    "profile schema",
    "fit-weights data.csv",
    "fit-weights collect session.csv --truth sim",
)


@dataclass(frozen=True)
class FirstWord:
    """`took_s` passed, `cpu_s` of them on a processor, until the command began to print `line`."""

    took_s: float
    cpu_s: float
    line: str


def run(words: Sequence[str], folder: str) -> FirstWord:
    """Run a command until it prints, and then end it."""
    ours, theirs = os.openpty()
    start_s = time.monotonic()
    with subprocess.Popen(
        [sys.executable, "-m", "perchctl", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "80"},
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
    ) as process:
        ready, _, _ = select.select([ours], [], [], WAIT_S)
        took_s = time.monotonic() - start_s if ready else math.inf
        text = os.read(ours, 200).decode(errors="replace") if ready else ""
        process.kill()
        _, _, used = os.wait4(process.pid, 0)
        process.returncode = 0
    os.close(ours)
    os.close(theirs)
    return FirstWord(took_s, used.ru_utime + used.ru_stime, text.partition("\r")[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one run of each, for a first look")
    parser.add_argument("words", nargs="*", help="only commands that begin with these words")
    given = parser.parse_args()
    helps = ["--help", *(f"{name} --help" for name in COMMANDS)]
    medians_s = []
    print(f"{'median':>8}{'worst':>8}{'CPU':>8}")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, LOG).write_bytes(gzip.decompress(FLIGHT.read_bytes()))
        for title, lines in (("help", helps), ("error", ERRORS), ("work", WORK)):
            print(title)
            for line in lines:
                words = line.split()
                if words[: len(given.words)] != given.words:
                    continue
                runs = [run(words, folder) for _ in range(1 if given.quick else RUNS)]
                times_s = [each.took_s for each in runs]
                medians_s.append(median(times_s))
                cpu_s = median(each.cpu_s for each in runs)
                print(
                    f"{medians_s[-1]:6.2f} s{max(times_s):6.2f} s{cpu_s:6.2f} s  "
                    f"{line.replace(f'{ROOT}/', '')}: {runs[0].line[:50]}"
                )
    late = sum(median_s >= LIMIT_S for median_s in medians_s)
    print(f"{late} of {len(medians_s)} medians are at or over {LIMIT_S:g} s")


if __name__ == "__main__":
    main()
