"""What the fit of the merge weights works on: rows of poses, with their truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import UsageError
from perchctl.geometry import Array

AXES = ("x", "y", "z", "yaw")
YAW = 3
UNITS = ("m", "m", "m", "rad")
SOURCES = ("large", "small", "actual")

PAPER_WEIGHTS = (0.275, 0.306, 0.728, 0.469)
"""w_x, w_y, w_z, w_psi of the paper, section III-B."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Poses of the target (x, y, z in m, yaw in rad), one row a frame, n rows.

    Attributes:
        name: the file (or files) they come from, for messages.
        sha256: of the file's bytes, hexadecimal.
        position: number of the place where the row was taken, (n,).
        t_s: (n,).
        large, small: (n, 4), NaN where the marker was not seen.
        actual: (n, 4), the truth.
        joint: (n, 4), both markers solved together; NaN where it is missing. None where
            the data do not hold it.
        line: the row's line in its file, (n,).
        notes: sentences about the data that are no faults.
    """

    name: str
    sha256: str
    position: NDArray[np.int64]
    t_s: Array
    large: Array
    small: Array
    actual: Array
    joint: Array | None
    line: NDArray[np.int64]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)


def wrap(angle_rad: Any) -> Any:
    """The same angles in (-pi, pi], any shape."""
    return -((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def joined(parts: list[Measurements]) -> Measurements:
    """Several files as one; positions of different files stay different."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        raise UsageError("no data: name a CSV file or a flight log, or --collect one")
    offset, positions = 0, []
    for part in parts:
        positions.append(part.position - int(part.position.min(initial=0)) + offset)
        offset = int(positions[-1].max(initial=offset)) + 1

    def all_of(key: str) -> Any:
        return np.concatenate([getattr(part, key) for part in parts])

    joints = [
        np.full_like(part.large, np.nan) if part.joint is None else part.joint for part in parts
    ]
    return Measurements(
        name=", ".join(part.name for part in parts),
        sha256=",".join(part.sha256 for part in parts),
        position=np.concatenate(positions),
        t_s=all_of("t_s"),
        large=all_of("large"),
        small=all_of("small"),
        actual=all_of("actual"),
        joint=None if all(part.joint is None for part in parts) else np.concatenate(joints),
        line=all_of("line"),
        notes=tuple(note for part in parts for note in part.notes),
    )
