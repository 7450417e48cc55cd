"""Whether a fault in one vehicle of a simulated fleet changes how its neighbours' flights end.

    perchctl fleet simulate -n 200 --seed N --out healthy.jsonl
    perchctl fleet simulate -n 200 --seed N --out faulty.jsonl --faults NAME,NAME
    python benchmarks/neighbours.py healthy.jsonl faulty.jsonl

The same seed gives each vehicle the same conditions in both files. A neighbour is a vehicle into
which no fault was injected; it is compared if its seed is in both files. Exit code 1: a neighbour
ended otherwise than without the fault.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from common import table


def read_fleets(path: Path) -> dict[int, dict[str, Any]]:
    """The fleets' flights in a results file, by seed."""
    records = map(json.loads, path.read_text().splitlines())
    return {each["seed"]: each for each in records if each.get("kind") == "flight"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("healthy", type=Path, help="results of the flights without a fault")
    parser.add_argument("faulty", type=Path, help="results of the flights with one")
    options = parser.parse_args()
    healthy, faulty = read_fleets(options.healthy), read_fleets(options.faulty)
    seeds = sorted(healthy.keys() & faulty.keys())
    if not seeds:
        parser.error("the two files have no seed in common")
    compared = identical = 0
    rows = []
    for seed in seeds:
        fleet = faulty[seed]
        pairs = zip(fleet["names"], healthy[seed]["vehicles"], fleet["vehicles"], strict=True)
        for name, before, after in pairs:
            if name in fleet["injected"]:
                continue
            compared += 1
            identical += before == after
            if before["outcome"] != after["outcome"]:
                rows.append((seed, fleet["fault"], name, before["outcome"], after["outcome"]))
    print(
        f"{compared} neighbours in {len(seeds)} fleets: {compared - len(rows)} ended as without "
        f"the fault, {identical} of them equal in every figure"
    )
    if rows:
        head = ("seed", "fault", "neighbour", "without the fault", "with it")
        table("neighbours that ended otherwise", head, rows)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
