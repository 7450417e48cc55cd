"""The mission's table as text for docs/architecture.md: a diagram of the phases, all rows.

``python -m perchctl.mission.diagram`` prints both; a test holds the page to them.
"""

from __future__ import annotations

from perchctl.mission.state import FLYING_PHASES, Phase
from perchctl.mission.table import AIR, BEFORE_CONTACT, BY_CAMERA, IN_THE_OPEN, TABLE, Row

_GROUPS: tuple[tuple[frozenset[Phase], str], ...] = (
    (AIR, "in the air"),
    (FLYING_PHASES, "before landing"),
    (BEFORE_CONTACT, "before contact"),
    (BY_CAMERA, "by camera"),
    (IN_THE_OPEN, "in the open"),
)


def diagram() -> str:
    """The undisturbed mission and its ways back, as a mermaid state diagram; the safety
    rows, which leave from every phase, are in `rows_table`."""
    lines = ["stateDiagram-v2", "    [*] --> APPROACH"]
    for row in TABLE:
        if _group(row) is not None:
            continue
        for phase in sorted(row.phases, key=_order):
            lines.append(f"    {phase.value} --> {row.to.value}: {row.name}")
    lines += [
        f"    {phase.value} --> [*]" for phase in (Phase.PERCHED, Phase.LANDED, Phase.ABORTED)
    ]
    return "\n".join(lines)


def rows_table() -> str:
    """Every row in its order, as a Markdown table."""
    lines = ["| # | row | from | to | severity |", "|---|---|---|---|---|"]
    for number, row in enumerate(TABLE, start=1):
        origin = _group(row) or ", ".join(p.value for p in sorted(row.phases, key=_order))
        severity = row.severity.name.lower().replace("_", " ")
        lines.append(f"| {number} | {row.name} | {origin} | {row.to.value} | {severity} |")
    return "\n".join(lines)


def _group(row: Row) -> str | None:
    return next((name for phases, name in _GROUPS if row.phases == phases), None)


def _order(phase: Phase) -> int:
    return list(Phase).index(phase)


if __name__ == "__main__":
    print(diagram(), rows_table(), sep="\n\n")
