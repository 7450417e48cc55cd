"""Writes the parts of README.md and docs/*.md that are drawn from the code.

    python docs/tables.py

Each part stands between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``; a test holds the pages
to what this command would write. A key's meaning is its description in the schema.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.camera import FrameSource  # noqa: E402
from perchctl.errors import EXIT_CODES  # noqa: E402
from perchctl.faults.expected_outcomes import EXPECTED_OUTCOMES  # noqa: E402
from perchctl.link import Link  # noqa: E402
from perchctl.mission import Phase, step_mission, table  # noqa: E402
from perchctl.mission.phase import (  # noqa: E402
    AIRBORNE_PHASES,
    CAMERA_GUIDED_PHASES,
    FREE_AIR_PHASES,
    PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
    PRE_CONTACT_PHASES,
    PRE_LANDING_PHASES,
)
from perchctl.mission.transition import Transition  # noqa: E402
from perchctl.perception import Perception  # noqa: E402
from perchctl.profile import Profile  # noqa: E402
from perchctl.profile.keys import Key, keys  # noqa: E402
from perchctl.record.fields import FIELDS  # noqa: E402
from perchctl.vision import step  # noqa: E402
from perchctl.vision.markers.detect import CORNER_METHODS  # noqa: E402

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
PART = re.compile(r"(<!-- begin ([\w-]+) -->\n).*?(<!-- end \2 -->)", re.DOTALL)

SEE = {  # of a key: where a page says more
    "camera.mount.rpy_deg": "[Camera mount](conventions.md#camera-mount)",
    "camera.latency_s": "[latency](cameras.md#latency)",
    "detector.refinement": "[methods](corners.md)",
    "camera.mask": "[what the vehicle covers](calibration.md#what-the-vehicle-covers)",
}


def _section(path: str) -> str:
    """Return the heading of a key: its first word."""
    return path.split(".")[0] if "." in path else ""


def profile_keys() -> str:
    """A list for each section."""
    sections: dict[str, list[str]] = {}
    for key in keys(Profile()):
        name = key.path.removeprefix(f"{_section(key.path)}.")
        meaning = key.meaning + (f" ({SEE[key.path]})" if key.path in SEE else "")
        row = f"- `{name}` ({_default_and_allowed(key)}): {meaning}"
        sections.setdefault(_section(key.path), []).append(row)
    lines: list[str] = []
    for section, rows in sections.items():
        lines += ["", f"### `{section}`" if section else "### At the top", "", *rows]
    return "\n".join(lines[1:])


def _default_and_allowed(key: Key) -> str:
    default = f"{_shown(key.default)} {key.unit if key.default not in (None, ()) else ''}".strip()
    allowed = key.allowed
    if key.default is not None:  # which shows how many
        allowed = re.sub("^([0-9] numbers|lowest, highest)?(, )?(each )?", "", allowed)
    else:  # which says that none is allowed
        allowed = allowed.removesuffix(", or none")
    if allowed in ("", "text", "true, false") or allowed.startswith("any number"):
        return default
    return f"{default}; {allowed}".replace("above ", ">").replace("below ", "<")


def _shown(value: Any) -> str:
    match value:
        case None | {} | "" | ():
            return "none"
        case bool():
            return str(value).lower()
        case tuple():
            return f"`[{', '.join(_shown(v) for v in value)}]`"
        case int() | float():
            return f"{value:g}" if isinstance(value, float) else str(value)
    return f"`{value}`"


def log_fields() -> str:
    """A line for fields in a row that have the same meaning, or that of one before them."""
    rows: list[tuple[str, list[str]]] = []
    for name, text in FIELDS.items():
        if rows and (text == rows[-1][0] or re.search(r"\bas \w+_(m|rad)$", text)):
            rows[-1][1].append(name)
        else:
            rows.append((text, [name]))
    return "\n".join(
        f"- {', '.join(f'`{name}`' for name in names)}: {text}" for text, names in rows
    )


WAY_OF_A_FRAME: tuple[tuple[str, Callable[..., Any]], ...] = (
    ("camera", FrameSource.poll),
    ("vision", step),
    ("perception", Perception.target),
    ("mission", step_mission),
    ("link", Link.send),
)
"""The calls that lead from a picture to a command, in order."""


def frame_diagram() -> str:
    """The calls that lead from a picture to a command, with what each gives."""
    lines = ["flowchart LR"]
    for number, (package, call) in enumerate(WAY_OF_A_FRAME):
        lines.append(f'    c{number}["{package}<br>{call.__qualname__}"]')
    for number, (_, call) in enumerate(WAY_OF_A_FRAME[:-1]):
        given = _mermaid_type(inspect.signature(call).return_annotation)
        lines.append(f'    c{number} -->|"{given}"| c{number + 1}')
    return "\n".join(lines)


def _mermaid_type(annotation: str) -> str:
    """The value that goes on: not None, and of a pair with a memory the second."""
    return annotation.removesuffix(" | None").rpartition(", ")[2].removesuffix("]")


def package_diagram() -> str:
    """Which package imports which, without what a longer path implies already."""
    from tests.test_architecture import LAYERS, all_imports, room_of

    packages = [
        room for rooms in LAYERS for room in rooms if (ROOT / room.replace(".", "/")).is_dir()
    ]
    needs: dict[str, set[str]] = {package: set() for package in packages}
    for found in all_imports():
        importer, imported = room_of(found.importer), room_of(found.imported)
        if importer in needs and imported in needs and importer != imported:
            needs[importer].add(imported)
    lines = ["flowchart BT"]
    for package in packages:
        implied = {far for near in needs[package] for far in _reached(needs, near)}
        for other in sorted(needs[package] - implied):
            lines.append(f"    {package.split('.')[1]} --> {other.split('.')[1]}")
    return "\n".join(lines)


def _reached(needs: dict[str, set[str]], package: str) -> set[str]:
    reached = set(needs[package])
    for near in needs[package]:
        reached |= _reached(needs, near)
    return reached


def packages() -> str:
    """What each package holds: the first sentence of its docstring."""
    rows = []
    for path in sorted((ROOT / "perchctl").iterdir()):
        source = path / "__init__.py" if path.is_dir() else path
        if path.name == "__main__.py" or source.suffix != ".py" or not source.exists():
            continue
        text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
        first = " ".join(text.split("\n\n")[0].split())
        rows.append(f"- `perchctl/{path.name}`: {first}")
    return "\n".join(rows)


def import_order() -> str:
    from tests.test_architecture import LAYERS

    names = (", ".join(f"`{room.removeprefix('perchctl.')}`" for room in rooms) for rooms in LAYERS)
    return "\n".join(f"{number}. {rooms}" for number, rooms in enumerate(names, start=1))


def exit_codes() -> str:
    return "\n".join(f"- {code}: {meaning}" for code, meaning in sorted(EXIT_CODES.items()))


def expected_outcomes() -> str:
    return "\n".join(
        f"- **{outcome.name}** ({', '.join(sorted(outcome.flags)).replace('_', ' ')}, "
        f"{outcome.within_s:g} s): {outcome.reason}"
        for outcome in EXPECTED_OUTCOMES
    )


def corner_methods() -> str:
    """A Markdown table of the methods that find corners, in the order in which they are tried."""
    rows = (
        f"| [{method.name}](#{method.name.lower().replace(' ', '-')}) | {method.docs_prerequisites}"
        f" | {method.docs_typical_time} | {method.docs_run_condition} |"
        for method in CORNER_METHODS
    )
    return "\n".join(["| method | needs | cost | used when |", "|---|---|---|---|", *rows])


_GROUPS: tuple[tuple[frozenset[Phase], str], ...] = (
    (AIRBORNE_PHASES, "in the air"),
    (PRE_LANDING_PHASES, "before landing"),
    (PRE_CONTACT_PHASES, "before contact"),
    (CAMERA_GUIDED_PHASES, "by camera"),
    (FREE_AIR_PHASES, "in the open"),
    (PHASES_IN_WHICH_MAGNET_MAY_ATTACH, "by camera, PERCH"),
    (FREE_AIR_PHASES | {Phase.LANDING}, "in the open, LANDING"),
)


FEW_PHASES = 2
"""A row of the mission's table that leaves from more phases is not in the diagram."""


def mission_diagram() -> str:
    """The undisturbed mission and its ways back, as a mermaid state diagram; rows that leave from
    many phases are in `mission_rows`."""
    lines = ["stateDiagram-v2", "    [*] --> APPROACH"]
    ways: dict[tuple[Phase, Phase], list[str]] = {}
    for row in table.TABLE:
        if _group(row) is None and len(row.phases) <= FEW_PHASES:
            for phase in sorted(row.phases, key=_order):
                ways.setdefault((phase, row.to), []).append(row.name)
    for (phase, to), names in ways.items():
        lines.append(f"    {phase.value} --> {to.value}: {', '.join(names)}")
    lines += [
        f"    {phase.value} --> [*]" for phase in (Phase.PERCHED, Phase.LANDED, Phase.ABORTED)
    ]
    return "\n".join(lines)


def mission_rows() -> str:
    """Every row in its order, as a Markdown table; those that follow each other with the same ways
    and severity share a line."""
    lines: list[tuple[list[str], str]] = []
    for row in table.TABLE:
        origin = _group(row) or ", ".join(p.value for p in sorted(row.phases, key=_order))
        severity = row.severity.name.lower().replace("_", " ")
        rest = f"{origin} | {row.to.value} | {severity} |"
        if lines and lines[-1][1] == rest:
            lines[-1][0].append(row.name)
        else:
            lines.append(([row.name], rest))
    head = ["| row | from | to | severity |", "|---|---|---|---|"]
    return "\n".join([*head, *(f"| {', '.join(names)} | {rest}" for names, rest in lines)])


def _group(row: Transition) -> str | None:
    return next((name for phases, name in _GROUPS if row.phases == phases), None)


def _order(phase: Phase) -> int:
    return list(Phase).index(phase)


PARTS: dict[str, Callable[[], str]] = {
    "frame-diagram": lambda: f"```mermaid\n{frame_diagram()}\n```",
    "package-diagram": lambda: f"```mermaid\n{package_diagram()}\n```",
    "packages": packages,
    "import-order": import_order,
    "diagram": lambda: f"```mermaid\n{mission_diagram()}\n```",
    "rows": mission_rows,
    "profile-keys": profile_keys,
    "log-fields": log_fields,
    "exit-codes": exit_codes,
    "expected-outcomes": expected_outcomes,
    "corner-methods": corner_methods,
}


def filled(page: str) -> str:
    """The page with its parts as the code has them. KeyError for a part that is none."""
    return PART.sub(lambda m: f"{m[1]}{PARTS[m[2]]()}\n{m[3]}", page)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing; exit 1 if it would")
    check = parser.parse_args().check
    changed = False
    for path in PAGES:
        old = path.read_text(encoding="utf-8")
        new = filled(old)
        if new != old:
            changed = True
            print(f"{path.relative_to(ROOT)}: {'is not as the code' if check else 'changed'}")
            if not check:
                path.write_text(new, encoding="utf-8")
    return int(check and changed)


if __name__ == "__main__":
    sys.exit(main())
