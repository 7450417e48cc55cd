"""The options of `perchctl make-target`, and the target that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue, UsageError
from perchctl.profile import MarkerConfig, Profile, TargetConfig
from perchctl.profile.dictionaries import check_marker_id
from perchctl.target.lengths import millimetres, parse_length

SIDE_LIMITS_M = (0.004, 2.0)


@dataclass(frozen=True)
class TargetRequest:
    """The command line as it was given; None is not given. Sizes are still text."""

    profile: str | None = None
    output: Path | None = None
    page: str = "a4"
    large: str | None = None
    large_id: int | None = None
    large_dict: str | None = None
    small: str | None = None
    small_id: int | None = None
    small_dict: str | None = None
    magnet: str = "50mm"
    png_dpi: int | None = None
    svg: bool = False
    board: str | None = None
    camera: str | None = None
    ceiling_m: float | None = None
    blur_px: float = 1.0
    noise: float = 5.0
    plot: Path | None = None
    suggest: bool = False
    measured_large: str | None = None
    measured_small: str | None = None
    force: bool = False
    as_json: bool = False

    @property
    def magnet_m(self) -> float:
        """Diameter of the magnet. Raises InvalidValue."""
        return parse_length(self.magnet, "--magnet")


@dataclass(frozen=True)
class TargetOutcome:
    """What a task gives: files still to be written, and what stdout gets, in both forms."""

    files: dict[Path, bytes]
    lines: list[str]
    record: dict[str, Any]


def requested_target(request: TargetRequest, profile: Profile) -> TargetConfig:
    """The profile's target with the options on top."""
    markers = {}
    for name, side, marker_id, dictionary in (
        ("large", request.large, request.large_id, request.large_dict),
        ("small", request.small, request.small_id, request.small_dict),
    ):
        old: MarkerConfig = getattr(profile.target, name)
        if dictionary is not None and marker_id is None:
            raise UsageError(f"--{name}-dict needs --{name}-id: ids belong to their dictionary")
        chosen = dictionary or old.dictionary
        number = old.id if marker_id is None else marker_id
        try:
            check_marker_id(chosen, number)
        except ValueError as error:
            raise InvalidValue(f"--{name}-id, --{name}-dict: {error}") from None
        side_m = old.side_m if side is None else parse_length(side, f"--{name}")
        if not SIDE_LIMITS_M[0] <= side_m <= SIDE_LIMITS_M[1]:
            raise InvalidValue(
                f"--{name}: {millimetres(side_m)} mm is outside of {SIDE_LIMITS_M[0] * 1e3:g} mm "
                f"to {SIDE_LIMITS_M[1]:g} m"
            )
        markers[name] = MarkerConfig(dictionary=chosen, id=number, side_m=side_m)
    if markers["small"].side_m >= markers["large"].side_m / 2:
        raise InvalidValue(
            f"the small marker ({millimetres(markers['small'].side_m)} mm) must be less than half "
            f"of the large one ({millimetres(markers['large'].side_m)} mm)"
        )
    return profile.target.model_copy(update=markers)


def check_within(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidValue(f"{name} {value:g}: allowed are {low:g} to {high:g} {unit}")
