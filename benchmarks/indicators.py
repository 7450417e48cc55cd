"""How simple the planner is, in figures: for this checkout, or for another one beside it.

    python benchmarks/indicators.py [--against DIR]

- fields of the largest state: of the dataclasses under `perchctl/mission` that are the planner's
  memory, what it believes or what it observes
- functions and files in a tick of PERCH: of perchctl's own, called by `step_mission` while the
  recorded flight `perched` of the corpus presses
- contexts made in it: how often a `Context` was built
- `positioning.by` outside `perchctl/profile`, and names that stand for it
- constant names with several values: module-level names in capitals that are bound to different
  numbers in different modules
- row names used as strings: names of the table's rows that are compared with, or looked up

None of them is a limit. Each should fall because the design is simpler.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import os
import pkgutil
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LOG = ROOT / "tests" / "data" / "flights" / "perched.jsonl.gz"
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]+")
BY = re.compile(r"positioning\.by\b|\bby_sight\b")


def sources(root: Path) -> Iterator[tuple[Path, str]]:
    for path in sorted((root / "perchctl").rglob("*.py")):
        yield path, path.read_text(encoding="utf-8")


def largest_state() -> tuple[str, int]:
    """The dataclass of the mission with the most fields, of those that are made anew each tick."""
    mission = import_module("perchctl.mission")
    found = {}
    for module in pkgutil.walk_packages(mission.__path__, "perchctl.mission."):
        for name, kind in vars(import_module(module.name)).items():
            of_the_mission = getattr(kind, "__module__", "").startswith("perchctl.mission")
            if of_the_mission and isinstance(kind, type) and dataclasses.is_dataclass(kind):
                found[name] = len(dataclasses.fields(kind))
    name = max(found, key=lambda each: found[each])
    return name, found[name]


def press() -> tuple[int, int, int, int]:
    """Functions, files, calls and contexts of the tick in the middle of the recorded press."""
    from perchctl import mission
    from perchctl.record import read_log

    log = read_log(LOG)
    profile, state, ticks = log.flown_profile, None, []
    profile = profile.with_({"link.unreported": ["variance", *profile.link.unreported]})
    # An older checkout has it under its former name.
    load_table = getattr(mission, "load_table", None) or mission.table_of
    table = load_table(profile.planner.rows)
    for turn in log.turns:
        if turn.observation is None or turn.role != "flown":
            continue
        if state is not None and state.phase.value == "PERCH":
            ticks.append((state, turn.observation))
        state, _ = mission.step_mission(state, turn.observation, profile, table)
    state, obs = ticks[len(ticks) // 2]
    functions, files, calls, contexts = set(), set(), 0, 0

    def seen(frame: FrameType, event: str, _: Any) -> None:
        nonlocal calls, contexts
        name = frame.f_code.co_filename
        if event != "call" or f"{os.sep}perchctl{os.sep}" not in name:
            return
        calls += 1
        functions.add((name, frame.f_code.co_qualname))
        files.add(name)
        contexts += frame.f_code.co_qualname == "Context.__init__"

    sys.setprofile(seen)
    mission.step_mission(state, obs, profile, table)
    sys.setprofile(None)
    return len(functions), len(files), calls, contexts


def constants_with_several_values(root: Path) -> int:
    values = defaultdict(set)
    for _, source in sources(root):
        for node in ast.parse(source).body:
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    for name, value in _bound(target, node.value):
                        values[name].add(ast.unparse(value))
    return sum(len(each) > 1 for each in values.values())


def _bound(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, other in zip(target.elts, value.elts, strict=False):
            yield from _bound(one, other)
    elif isinstance(target, ast.Name) and CONSTANT.fullmatch(target.id):
        inner = value.operand if isinstance(value, ast.UnaryOp) else value
        if isinstance(inner, ast.Constant) and isinstance(inner.value, (int, float)):
            yield target.id, value


def row_names_as_strings(root: Path) -> int:
    """String literals that are compared, or members of a set, and name a row of the table."""
    from perchctl.mission.table import TABLE

    names = {row.name for row in TABLE}
    count = 0
    for _, source in sources(root):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, (ast.Compare, ast.Set, ast.MatchValue)):
                parts = [part for part in ast.walk(node) if isinstance(part, ast.Constant)]
                compares_rows = "row" in ast.unparse(node) or isinstance(node, ast.Set)
                count += sum(part.value in names for part in parts) if compares_rows else 0
    return count


def measure(root: Path) -> dict[str, Any]:
    name, fields = largest_state()
    functions, files, calls, contexts = press()
    outside = [
        source for path, source in sources(root) if "profile" not in path.relative_to(root).parts
    ]
    return {
        "fields of the largest state": f"{fields} ({name})",
        "functions in a tick of PERCH": functions,
        "files in it": files,
        "calls in it": calls,
        "contexts made in it": contexts,
        "uses of positioning.by": sum(len(BY.findall(source)) for source in outside),
        "constant names with several values": constants_with_several_values(root),
        "row names used as strings": row_names_as_strings(root),
    }


def asked(root: Path) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, __file__, "--measure", str(root)],
        env=os.environ | {"PYTHONPATH": str(root)},
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--against", type=Path, metavar="DIR", help="another checkout")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        print(json.dumps(measure(options.measure)))
        return
    columns = [asked(ROOT)]
    if options.against is not None:
        columns.append(asked(options.against.resolve()))
    for name in columns[0]:
        print(f"{name:<36}", *(f"{found[name]!s:>28}" for found in columns))


if __name__ == "__main__":
    main()
