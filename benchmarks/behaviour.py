"""Whether two checkouts of perchctl behave the same, bit for bit: for changes of the design.

    python benchmarks/behaviour.py --against DIR [-n 20] [--seed 20261129] [--decide-only LOGS]

Both checkouts fly the same seeds, with every fault of the catalogue in turn, in three settings: by
deck (profile `sim`), by the target alone (`target_only`) and by motion capture. Their logs are
compared record by record and field by field: what was observed, decided and sent, and what came of
it by the simulator's ground truth. Then both decide the flights of the replay corpus again from the
recorded observations. The first field that differs is printed for each flight.

`--decide-only LOGS` flies nothing: both decide the flights of a folder of logs again, which takes a
fraction of the time and leaves out what the planner does not decide. Each child runs on one thread
with its own `PYTHONPATH`; both run on this machine within one run, so that equal means equal.
Exit 1 if anything differs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CORPUS = ROOT / "tests" / "data" / "flights"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SETTINGS: dict[str, list[str]] = {
    "deck": ["--profile", "sim"],
    "target": ["--profile", "target_only"],
    "mocap": ["--positioning", "mocap"],
}
SEEDS_APART = 1000
"""Between the settings, so that no seed is flown twice."""
COMPARED = ("turn", "sent", "event", "tick", "summary")
"""The records of a log that are compared; the header names the computer and the day."""
IGNORED = {"log", "pictures", "folder", "cpu_s", "wall_s"}
"""Keys of records that name a file of the child's own folder, or say how long it took."""


def child(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the perchctl of `checkout`, and wait for it."""
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout)}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=checkout, text=True, capture_output=True
    )


def fly(checkout: Path, setting: str, seeds: range, folder: Path) -> None:
    """Fly the seeds of one setting with the faults of the catalogue; logs and results go into
    `folder`."""
    folder.mkdir(parents=True)
    done = child(
        checkout, "-m", "perchctl", "simulate", *SETTINGS[setting], "--faults", "all",
        "-n", str(len(seeds)), "--seed", str(seeds.start),
        "--log-dir", str(folder / "logs"), "--out", str(folder / "results.jsonl"),
    )  # fmt: skip
    if not (folder / "results.jsonl").exists():
        raise SystemExit(f"{checkout} does not fly {setting}: {done.stderr.strip()[-500:]}")


def decide(checkout: Path, log: Path) -> list[Any]:
    """What the planner of `checkout` decides from the observations of a log."""
    done = child(checkout, __file__, "--decide", str(log))
    if done.returncode:
        raise SystemExit(f"{checkout} does not decide {log.name}: {done.stderr.strip()[-500:]}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def print_decisions(log: Path) -> None:
    """The child's part of `decide`: a line of JSON for each decision."""
    from perchctl import mission
    from perchctl.record import read_log, to_exact_json

    found = read_log(log)
    profile, state = found.flown_profile, None
    if not found.has_position_variance:  # as a replay does
        profile = profile.with_({"link.unreported": ["variance", *profile.link.unreported]})
    # An older checkout has it under its former name.
    load_table = getattr(mission, "load_table", None) or mission.table_of
    table = load_table(profile.planner.rows)
    for turn in found.turns:
        if turn.observation is None or turn.role == "waiting":
            continue
        new, command = mission.step_mission(state, turn.observation, profile, table)
        decided = {
            "kind": "decision",
            "phase": new.phase.value,
            "row": new.transition_name,
            "hold": new.hold_reason,
            "attempts": new.failed_attempts,
            "command": [type(command).__name__, to_exact_json(command)],
            "outcome": None if new.outcome is None else new.outcome.value,
            # An older checkout has it under its former name.
            "reason": new.transition_reason if hasattr(new, "transition_reason") else new.reason,
        }
        print(json.dumps(decided))
        if turn.role == "flown":
            state = new


def records(log: Path) -> Iterator[Any]:
    for line in log.read_text().splitlines():
        record = json.loads(line)
        if record.get("kind") in COMPARED:
            yield record


def first_difference(one: Any, other: Any, path: str = "") -> str | None:
    """The dotted name of the first field in which two values of JSON differ, with both values."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            if key not in IGNORED and (
                found := first_difference(one.get(key), other.get(key), f"{path}.{key}")
            ):
                return found
        return None
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            if found := first_difference(a, b, f"{path}[{i}]"):
                return found
        return None
    if type(one) is type(other) and json.dumps(one) == json.dumps(other):
        return None
    return f"{path.lstrip('.')}: {json.dumps(one)[:80]} against {json.dumps(other)[:80]}"


def compared(name: str, here: Iterable[Any], there: Iterable[Any]) -> tuple[int, str | None]:
    """The number of records of a flight that were compared, and its first difference."""
    count = 0
    for count, (one, other) in enumerate(zip_longest(here, there), 1):
        if one is None or other is None:
            return count, f"{name}: one of the two has no record {count}"
        if found := first_difference(one, other):
            return count, f"{name}: record {count} ({one.get('kind', 'result')}), {found}"
    return count, None


def results(folder: Path) -> list[Any]:
    lines = map(json.loads, (folder / "results.jsonl").read_text().splitlines())
    flights = (record for record in lines if record["kind"] != "header")
    return sorted(flights, key=lambda record: str(record.get("seed")))


def fly_both(
    homes: tuple[Path, Path], options: argparse.Namespace, place: Path
) -> Iterator[tuple[str, int, str | None]]:
    settings = list(SETTINGS)
    ranges = {
        setting: range(start, start + n)
        for setting, n, start in zip(
            settings,
            options.n if len(options.n) == len(settings) else options.n[:1] * len(settings),
            range(options.seed, options.seed + len(settings) * SEEDS_APART, SEEDS_APART),
            strict=True,
        )
    }
    for setting, seeds in ranges.items():
        if not seeds:
            continue
        folders = [place / setting / which for which in ("here", "there")]
        with ThreadPoolExecutor(2) as threads:
            flown = [
                threads.submit(fly, home, setting, seeds, folder)
                for home, folder in zip(homes, folders, strict=True)
            ]
            for each in flown:
                each.result()
        here, there = folders
        count, found = compared(f"{setting}, results", results(here), results(there))
        yield f"{setting}: results of {len(seeds)} flights", count, found
        for log in sorted((here / "logs").rglob("*.jsonl")):
            other = there / "logs" / log.relative_to(here / "logs")
            if not other.exists():
                yield setting, 0, f"{setting}, {log.name}: only one of the two has this log"
                continue
            count, found = compared(f"{setting}, {log.name}", records(log), records(other))
            yield f"{setting}: {log.name}", count, found
            log.unlink()
            other.unlink()


def decide_both(
    homes: tuple[Path, Path], logs: Iterable[Path]
) -> Iterator[tuple[str, int, str | None]]:
    for log in logs:
        with ThreadPoolExecutor(2) as threads:
            here, there = threads.map(decide, homes, (log, log))
        yield (f"decided: {log.name}", *compared(log.name, here, there))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, metavar="DIR", help="the other checkout")
    parser.add_argument(
        "-n", type=int, nargs="+", default=[20], help="flights of each setting: one number or three"
    )
    parser.add_argument("--seed", type=int, default=20261129, help="of the first flight")
    parser.add_argument("--decide-only", type=Path, metavar="LOGS", help="a folder of logs")
    parser.add_argument("--decide", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.decide is not None:
        print_decisions(options.decide)
        return 0
    if options.against is None:
        parser.error("--against names the other checkout")
    if len(options.n) not in (1, len(SETTINGS)):
        parser.error(f"-n takes one number, or one for each of {', '.join(SETTINGS)}")
    homes = ROOT, options.against.resolve()
    differences, flights, count = [], 0, 0
    with tempfile.TemporaryDirectory() as place:
        if options.decide_only is not None:
            parts = [decide_both(homes, sorted(options.decide_only.rglob("*.jsonl")))]
        else:
            corpus = sorted(CORPUS.glob("*.jsonl.gz"))
            parts = [fly_both(homes, options, Path(place)), decide_both(homes, corpus)]
        for part in parts:
            for _, number, found in part:
                flights, count = flights + 1, count + number
                if found is not None:
                    differences.append(found)
                    print(found, flush=True)
    print(f"{len(differences)} differences in {flights} comparisons of {count} records")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main())
