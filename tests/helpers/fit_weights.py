"""What the tests of `perchctl fit-weights` share."""

from __future__ import annotations

import math
from collections.abc import Callable

from typer.testing import CliRunner, Result

from perchctl.commands import app
from perchctl.weights.data import NEEDED


def run(*words: object, stdin: str | None = None) -> Result:
    result = CliRunner().invoke(app, ["fit-weights", *map(str, words)], input=stdin)
    assert "Traceback" not in result.output
    return result


Edit = Callable[[list[list[str]]], None]


def _scaled(source: str, factor: float, positions: tuple[str, ...] | None = None) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        columns = [k for k, name in enumerate(rows[0]) if name[:5] == source and name[-2:] == "_m"]
        for row in rows[1:]:
            for k in columns:
                if positions is None or row[0] in positions:
                    row[k] = str(float(row[k]) * factor)

    return edit


def _cell(line: int, column: str, text: str) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        rows[line - 1][NEEDED.index(column)] = text

    return edit


def _column(column: str, text: Callable[[list[str]], str]) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[NEEDED.index(column)] = text(row)

    return edit


def _all(*edits: Edit) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        for each in edits:
            each(rows)

    return edit


def _unseen(marker: str) -> Edit:
    return _all(*(_column(name, lambda row: "") for name in NEEDED if name.startswith(marker)))


def _missing(rows: list[list[str]]) -> None:
    rows[0][NEEDED.index("small_z_m")] = "other"


def _shorter(rows: list[list[str]]) -> None:
    rows[5].pop()


BAD: dict[str, tuple[Edit, str]] = {
    "missing column": (_missing, "line 1: column small_z_m is missing"),
    "centimetres": (_scaled("actua", 100.0), "line 2: actual_x_m looks like centimetres"),
    "one position in centimetres": (_scaled("actua", 100, ("7",)), "line 122: actual_"),
    "millimetres": (_scaled("small", 1000.0), "line 2: small_x_m looks like millimetres"),
    "all in centimetres": (
        _all(*(_scaled(s, 100.0) for s in ("large", "small", "actua"))),
        "line 2: all positions look like centimetres",
    ),
    "degrees": (
        _column("actual_yaw_rad", lambda r: str(math.degrees(float(r[13])))),
        "like degrees",
    ),
    "one position": (_column("position", lambda r: "1"), "line 2: all rows with both"),
    "never seen": (_unseen("small"), "lines 2 to 201: the small marker is never seen"),
    "nan": (_cell(100, "large_x_m", "NaN"), "line 100: large_x_m: NaN is not a measurement"),
    "infinite": (_cell(9, "large_x_m", "1e999"), "line 9: large_x_m: 1e999 is not"),
    "a word": (_cell(100, "large_x_m", "abc"), "line 100: large_x_m: 'abc' is not a number"),
    "half a pose": (_cell(50, "small_y_m", ""), "line 50: small_y_m: the cell is empty"),
    "no truth": (_cell(51, "actual_z_m", ""), "line 51: actual_z_m: the cell is empty"),
    "constant": (_column("large_z_m", lambda r: "0.2"), "line 2: large_z_m is 0.2 in every row"),
    "a copied column": (_column("large_z_m", lambda r: r[8]), "same z in every row"),
    "a short line": (_shorter, "line 6: 13 cells where the header has 14"),
    "position": (_cell(8, "position", "1.5"), "line 8: position: must be a whole number"),
}
