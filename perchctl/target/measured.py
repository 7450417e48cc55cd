"""Sizes as measured on the print, written where a flight takes them from: the profile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from perchctl.errors import InvalidValue, PerchError
from perchctl.files import PartFile, cannot_be_written
from perchctl.profile import MarkerConfig, Profile, TargetConfig, load_profile
from perchctl.target.lengths import mm_text

MAX_SCALE_ERROR = 0.1
"""A print off by more than this was not measured in the unit that was meant."""
MEASURED_SIGMA = 0.001
"""What measured sizes may be off by, relative: 0.15 mm of a large marker."""
NOTABLE_SCALE_ERROR = 0.01
"""Printers err by some 0.3 %; from here on a viewer has scaled the page."""
_UNMEASURED_SIGMA = TargetConfig().size_sigma


@dataclass(frozen=True)
class Measured:
    """The target with its measured sizes, and what follows for the print."""

    target: TargetConfig
    notes: tuple[str, ...]


def measured_target(
    nominal: TargetConfig, large_m: float | None, small_m: float | None
) -> Measured:
    """The target with these sides. Both together make its sizes count as measured.

    Raises InvalidValue for a size that cannot be this marker's.
    """
    notes, sides, scales = [], {}, {}
    for name, side_m in (("large", large_m), ("small", small_m)):
        marker: MarkerConfig = getattr(nominal, name)
        if side_m is None:
            continue
        off = side_m / marker.side_m - 1.0
        if abs(off) > MAX_SCALE_ERROR:
            raise InvalidValue(
                f"--measured-{name}: {mm_text(side_m)} mm is {100 * off:+.0f} % off the "
                f"{mm_text(marker.side_m)} mm of the profile: measure the black square, in mm"
            )
        sides[name], scales[name] = side_m, off
        notes.append(
            f"{name}: {mm_text(side_m)} mm, {100 * off:+.2f} % against {mm_text(marker.side_m)} mm"
        )
        if abs(off) > NOTABLE_SCALE_ERROR:
            notes.append(f"{name}: more than 1 % off: was the page scaled when it was printed?")
    if len(scales) == 2:
        between = scales["small"] - scales["large"]
        notes.append(f"small against large: {100 * between:+.2f} %")
    large, small = (
        marker.model_copy(update={"side_m": sides.get(name, marker.side_m)})
        for name, marker in _markers(nominal)
    )
    if small.side_m >= large.side_m / 2:
        raise InvalidValue(
            f"the small marker ({mm_text(small.side_m)} mm) must be less than half of the "
            f"large one ({mm_text(large.side_m)} mm): measure both black squares"
        )
    size_sigma = min(nominal.size_sigma, MEASURED_SIGMA) if len(sides) == 2 else nominal.size_sigma
    if size_sigma > MEASURED_SIGMA:
        notes.append("measure both markers: distances claim less until both sizes are known")
    target = nominal.model_copy(update={"large": large, "small": small, "size_sigma": size_sigma})
    return Measured(target, tuple(notes))


def new_profile_text(base: str, target: TargetConfig) -> str:
    """A small profile that extends `base` and holds the target."""
    lines = [f"extends: {_scalar(base)}", "", "target:", "  # sides of the black squares, measured"]
    lines += [f"  {name}: {_flow(marker)}" for name, marker in _markers(target)]
    if target.size_sigma != _UNMEASURED_SIGMA:
        lines.append(f"  size_sigma: {target.size_sigma:g}")
    return "\n".join(lines) + "\n"


def updated_profile_text(path: Path, text: str, target: TargetConfig) -> str:
    """The same text with the sides replaced (or added); comments and order stay.

    Raises InvalidValue where the file is no mapping.
    """
    for name, marker in reversed(_markers(target)):
        text = _with_side(path, text, name, marker)
    return text if target.size_sigma == _UNMEASURED_SIGMA else _with_sigma(text, target)


def write_profile(path: Path, text: str, expected: Profile) -> None:
    """Write it, once it has been read back as this very profile (but for its name).

    Raises InvalidValue: the text is another profile, or cannot be written.
    """
    try:
        file = PartFile(path)
        try:
            file.write(text.encode("utf-8"))
            if not _reads_as(file.part, expected):
                raise InvalidValue(
                    f"{path}: the sizes could not be put into this file: edit target by hand"
                )
            file.keep()
        finally:
            file.drop()
    except OSError as error:
        raise cannot_be_written(path, error) from None


def _reads_as(path: Path, expected: Profile) -> bool:
    try:
        read = load_profile(str(path.absolute()))
    except PerchError:
        return False
    return read.model_copy(update={"name": expected.name}) == expected


def _markers(target: TargetConfig) -> list[tuple[str, MarkerConfig]]:
    return [("large", target.large), ("small", target.small)]


def _with_side(path: Path, text: str, name: str, marker: MarkerConfig) -> str:
    try:
        root: Any = yaml.compose(text)
    except yaml.YAMLError:
        raise InvalidValue(f"{path}: not YAML, so it cannot be changed") from None
    if not isinstance(root, yaml.MappingNode):
        raise InvalidValue(f"{path}: must hold keys and values")
    section = _child(root, "target")
    if section is None:
        end = "" if text.endswith("\n") else "\n"
        if root.flow_style:
            return _inserted(text, root, f"target: {{{name}: {_flow(marker)}}}")
        return f"{text}{end}\ntarget:\n  {name}: {_flow(marker)}\n"
    if not isinstance(section, yaml.MappingNode):
        raise InvalidValue(f"{path}: target: must hold keys and values")
    node = _child(section, name)
    if node is None:
        return _inserted(text, section, f"{name}: {_flow(marker)}")
    if not isinstance(node, yaml.MappingNode):
        raise InvalidValue(f"{path}: target.{name}: must hold keys and values")
    side = _child(node, "side_m")
    if side is None:
        return _inserted(text, node, f"side_m: {marker.side_m:g}")
    return text[: side.start_mark.index] + f"{marker.side_m:g}" + text[side.end_mark.index :]


def _with_sigma(text: str, target: TargetConfig) -> str:
    """`text` has a section of the target's."""
    root: Any = yaml.compose(text)
    section = _child(root, "target")
    node = _child(section, "size_sigma")
    if node is None:
        return _inserted(text, section, f"size_sigma: {target.size_sigma:g}")
    start, end = node.start_mark.index, node.end_mark.index
    return f"{text[:start]}{target.size_sigma:g}{text[end:]}"


def _child(node: yaml.MappingNode, key: str) -> Any:
    for name, value in node.value:
        if name.value == key:
            return value
    return None


def _inserted(text: str, node: yaml.MappingNode, entry: str) -> str:
    """The text with an entry at the beginning of a mapping."""
    at = node.start_mark.index
    if node.flow_style:
        separator = ", " if node.value else ""
        return f"{text[: at + 1]}{entry}{separator}{text[at + 1 :]}"
    return f"{text[:at]}{entry}\n{' ' * node.start_mark.column}{text[at:]}"


def _flow(marker: MarkerConfig) -> str:
    return f"{{dictionary: {marker.dictionary}, id: {marker.id}, side_m: {marker.side_m:g}}}"


def _scalar(text: str) -> str:
    return yaml.safe_dump(text, width=1000).splitlines()[0]
