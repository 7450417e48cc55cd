"""Figures as people read them."""

from __future__ import annotations

import math


def length(metres: float) -> str:
    """``1.7 mm``, ``8.4 cm``, ``31 cm``, ``1.83 m``."""
    size = abs(metres)
    if not math.isfinite(size):
        return "unknown"
    if size < 0.02:
        return f"{metres * 1e3:.1f} mm"
    if size < 0.095:
        return f"{metres * 1e2:.1f} cm"
    if size < 0.995:
        return f"{metres * 1e2:.0f} cm"
    return f"{metres:.2f} m"


def milliseconds(seconds: float) -> str:
    """``12 ms``; a tenth below ten, ``1.4 s`` from a second on."""
    if not math.isfinite(seconds):
        return "unknown"
    ms = seconds * 1e3
    if abs(ms) >= 1000:
        return f"{seconds:.1f} s"
    return f"{ms:.1f} ms" if abs(ms) < 9.95 else f"{ms:.0f} ms"


def share(part: float) -> str:
    """``93 %``; near both ends with a decimal, so that not all is not told as all."""
    if not math.isfinite(part):
        return "unknown"
    percent = 100.0 * part
    fine = 0.0 < percent < 1.0 or 99.0 < percent < 100.0
    return f"{percent:.1f} %" if fine else f"{percent:.0f} %"


def count(number: int, noun: str) -> str:
    """``1 frame``, ``14 frames``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def times(number: int) -> str:
    """``once``, ``3 times``."""
    return "once" if number == 1 else f"{number} times"
