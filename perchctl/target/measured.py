"""Sizes as measured on the print, for the profile that flies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target.drawing import mm_text

MAX_SCALE_ERROR = 0.1
"""A print off by more than this was not measured in the unit that was meant."""
MEASURED_SIGMA = 0.001
"""What measured sizes may be off by, relative: 0.15 mm of a large marker."""
NOTABLE_SCALE_ERROR = 0.01
"""Printers err by some 0.3 %; from here on a viewer has scaled the page."""


@dataclass(frozen=True)
class Measured:
    """The target with its measured sizes, and what follows for the print."""

    target: TargetConfig
    notes: tuple[str, ...]


def measured_target(nominal: TargetConfig, sides_m: Mapping[str, float]) -> Measured:
    """The target with the sides of ``large`` and ``small``, as far as they were measured. Both
    together make its sizes count as measured.

    Raises InvalidValue for a size that cannot be this marker's.
    """
    notes, scales = [], {}
    target = nominal
    for name, side_m in sides_m.items():
        marker: MarkerConfig = getattr(nominal, name)
        off = scales[name] = side_m / marker.side_m - 1.0
        if abs(off) > MAX_SCALE_ERROR:
            raise InvalidValue(
                f"--measured-{name}: {mm_text(side_m)} mm is {100 * off:+.0f} % off the "
                f"{mm_text(marker.side_m)} mm of the profile: measure the black square, in mm"
            )
        notes.append(
            f"{name}: {mm_text(side_m)} mm, {100 * off:+.2f} % against {mm_text(marker.side_m)} mm"
        )
        if abs(off) > NOTABLE_SCALE_ERROR:
            notes.append(f"{name}: more than 1 % off: was the page scaled when it was printed?")
        target = target.model_copy(update={name: marker.model_copy(update={"side_m": side_m})})
    if len(scales) == 2:
        between = scales["small"] - scales["large"]
        notes.append(f"small against large: {100 * between:+.2f} %")
        sigma = min(nominal.size_sigma, MEASURED_SIGMA)
        target = target.model_copy(update={"size_sigma": sigma})
    if target.small.side_m >= target.large.side_m / 2:
        raise InvalidValue(
            f"the small marker ({mm_text(target.small.side_m)} mm) must be less than half of the "
            f"large one ({mm_text(target.large.side_m)} mm): measure both black squares"
        )
    if target.size_sigma > MEASURED_SIGMA:
        notes.append("measure both markers: distances claim less until both sizes are known")
    return Measured(target, tuple(notes))
