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


def count(number: int, noun: str) -> str:
    """``1 frame``, ``14 frames``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
