"""The options of `perchctl make-target`, and the target that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue, UsageError
from perchctl.profile import MarkerConfig, Profile, TargetConfig, check_marker_id
from perchctl.target import mm_text, parse_length

SIDE_LIMITS_M = (0.004, 2.0)

_PROFILE = {"profile": "-p"}
_OUTPUT = {"output": "-o"}
_PAGE = {"page": "--page"}
_SHEET = _PAGE | {"tile": "--tile"}
_MAGNET = {"magnet": "--magnet"}
_MARKERS = {
    "large": "--large",
    "large_id": "--large-id",
    "large_dict": "--large-dict",
    "small": "--small",
    "small_id": "--small-id",
    "small_dict": "--small-dict",
}
_DESIGN = {
    "cam": "--cam",
    "ceiling_m": "--ceiling",
    "blur_px": "--blur",
    "noise": "--noise",
    "plot": "--plot",
    "suggest": "--suggest",
}
_OPTIONS = _PROFILE | _OUTPUT | _SHEET | _MAGNET | _MARKERS | _DESIGN
"""Options of some tasks only, by their field; --force and --json go with every task."""


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
    tile: str | None = None
    board: str | None = None
    camera: str | None = None
    cam: str | None = None
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


def check_request(request: TargetRequest) -> None:
    """Raises UsageError for tasks that exclude each other, and for an option that would
    change nothing of what the task writes."""
    tasks = _tasks(request)
    if len(tasks) > 1:
        raise UsageError(f"{tasks[0]} and {tasks[1]} are different tasks: give one of them")
    task = tasks[0] if tasks else ""
    allowed = _allowed(request, task)
    for field in fields(request):
        name = _OPTIONS.get(field.name)
        if name is None or name in allowed or getattr(request, field.name) == field.default:
            continue
        if not task:
            raise UsageError(f"{name} needs --camera with a calibration file")
        if request.suggest and name in _MARKERS.values():
            raise UsageError(f"{name} does not go with --suggest, which proposes both markers")
        if task == "--camera" and name not in _DESIGN.values():
            raise UsageError(f"{name} is for the sheet, which --camera prints with -o only")
        raise UsageError(
            f"{name} does not go with {task}, which takes {', '.join(allowed)}: leave it out"
        )


def _tasks(request: TargetRequest) -> list[str]:
    """What is asked for instead of the target's sheet, as it was named."""
    measured = request.measured_large is not None or request.measured_small is not None
    named = {
        "--board": request.board is not None,
        "--camera": request.camera is not None,
        "--measured-large and --measured-small": measured,
    }
    return [name for name, given in named.items() if given]


def _allowed(request: TargetRequest, task: str) -> tuple[str, ...]:
    if task == "--board":
        options = _OUTPUT | _SHEET
    elif task == "--camera" and request.suggest:
        options = _PROFILE | _OUTPUT | _PAGE | _MAGNET | _DESIGN
    elif task == "--camera":
        printed = _SHEET | _MAGNET if request.output is not None else {}
        options = _PROFILE | _OUTPUT | _MARKERS | _DESIGN | printed
    elif task:
        options = _PROFILE | _OUTPUT | _MARKERS
    else:
        options = _PROFILE | _OUTPUT | _SHEET | _MAGNET | _MARKERS
    return tuple(options.values())


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
                f"--{name}: {mm_text(side_m)} mm is outside of {SIDE_LIMITS_M[0] * 1e3:g} mm "
                f"to {SIDE_LIMITS_M[1]:g} m"
            )
        markers[name] = MarkerConfig(dictionary=chosen, id=number, side_m=side_m)
    if markers["small"].side_m >= markers["large"].side_m / 2:
        raise InvalidValue(
            f"the small marker ({mm_text(markers['small'].side_m)} mm) must be less than half "
            f"of the large one ({mm_text(markers['large'].side_m)} mm)"
        )
    return profile.target.model_copy(update=markers)


def check_within(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidValue(f"{name} {value:g}: allowed are {low:g} to {high:g} {unit}")
