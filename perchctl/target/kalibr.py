"""Kalibr's own description of a board (``target_type: aprilgrid``) in perchctl's notation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import parse_yaml

KEYS = {
    "aprilgrid": ("tagCols", "tagRows", "tagSize", "tagSpacing"),
    "checkerboard": ("targetCols", "targetRows", "colSpacingMeters", "rowSpacingMeters"),
}


def kalibr_notation(path: Path) -> str:
    """``aprilgrid:6x6:88mm:0.3`` from the file that is given to Kalibr as --target; a
    checkerboard counts inner corners in both.

    Raises NotFound, InvalidValue.
    """
    try:
        raw: Any = parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise NotFound(f"board file {path} does not exist") from None
    except UnicodeDecodeError:
        raise InvalidValue(f"{path}: cannot be read as a board: not a text file") from None
    except (OSError, ValueError) as error:
        raise InvalidValue(f"{path}: cannot be read as a board: {error}") from None
    kind = raw.get("target_type") if isinstance(raw, dict) else None
    if not isinstance(kind, str) or kind not in KEYS:
        raise InvalidValue(
            f"{path}: is no board of Kalibr's that is known here: target_type must be "
            f"{' or '.join(KEYS)}, found {_shown(kind)}"
        )
    columns, rows, across, more = (_number(path, raw, key) for key in KEYS[kind])
    counts = f"{_whole(path, kind, columns)}x{_whole(path, kind, rows)}"
    if kind == "aprilgrid":
        return f"{kind}:{counts}:{1e3 * across:.9g}mm:{more:g}"
    if across != more:
        raise InvalidValue(
            f"{path}: colSpacingMeters {across:g} and rowSpacingMeters {more:g} differ: squares "
            f"of a chessboard are square; a print that is not is given by its measured sides"
        )
    return f"chessboard:{counts}:{1e3 * across:.9g}mm"


def _number(path: Path, raw: dict[str, Any], key: str) -> float:
    value = raw.get(key)
    if value is None:
        raise InvalidValue(f"{path}: key {key} is missing")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InvalidValue(f"{path}: {key}: {_shown(value)} is not a number")
    return float(value)


def _whole(path: Path, kind: str, value: float) -> int:
    if not value.is_integer():
        raise InvalidValue(f"{path}: {value:g} columns or rows of a {kind} are not whole")
    return int(value)


def _shown(value: Any) -> str:
    """A value of the file, kept to a sentence's length."""
    if value is None:
        return "nothing"
    text = repr(value) if isinstance(value, (str, int, float)) else type(value).__name__
    return text if len(text) <= 40 else f"{text[:40]}..."
