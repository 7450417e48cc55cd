"""Lengths as people write them: with their unit."""

from __future__ import annotations

import math
import re

from perchctl.errors import InvalidValue

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*([a-zA-Z]*)\s*")


def parse_length(text: str, what: str, *, bare_unit: str | None = None) -> float:
    """``150mm``, ``15cm`` or ``0.15m`` in metres.

    `what` names the value in the error; a number without a unit is taken in `bare_unit`,
    and refused where that is None. Raises InvalidValue.
    """
    match = _LENGTH.fullmatch(text)
    if match is None:
        raise InvalidValue(f"{what}: {text!r} is not a length; write 150mm, 15cm or 0.15m")
    number, unit = match.groups()
    if not unit:
        if bare_unit is None:
            raise InvalidValue(f"{what}: {text!r} has no unit; write {number}mm, or cm or m")
        unit = bare_unit
    if unit not in UNITS_M:
        raise InvalidValue(f"{what}: unit {unit!r} in {text!r} is unknown; allowed are mm, cm, m")
    value = float(number) * UNITS_M[unit]
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidValue(f"{what}: {text!r} must be more than zero")
    # What a person writes has no more than 12 digits: 0.1 cm is 0.001 m, not 0.0010000000000000002.
    return float(f"{value:.12g}")


def mm_text(length_m: float) -> str:
    """``150`` or ``149.6``: a length in millimetres, without a unit, to 1 um."""
    return f"{round(length_m * 1e3, 3):g}"
