"""Rows that are there twice: they would narrow the intervals, and are no more evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.types import SOURCES, Measurements

_MIX = 0x9E3779B97F4A7C15  # odd: its powers mix all bits


def refuse_repeated(parts: Sequence[Measurements], test: Measurements | None = None) -> None:
    """Raises InvalidValue where a file, or a row, is named twice; `test` is the data that the
    fit is judged by, and must hold none of the others' rows."""
    files = [*parts, test] if test is not None else list(parts)
    why = "the same rows twice are no more evidence"
    for number, part in enumerate(files):
        if part is test:
            why = "--test judges by other data than was fitted to"
        for before in files[:number]:
            if part.sha256 == before.sha256:
                both = f"{before.name} and {part.name} hold the same data"
                same = f"{part.name} is named twice" if part.name == before.name else both
                raise InvalidValue(f"{same}: {why}; name it once")
    found = _first_again(files)
    if found is not None:
        (file, row), (old_file, old_row), count = found
        part, before = files[file], files[old_file]
        others = f" and {count - 1} more likewise" if count > 1 else ""
        raise InvalidValue(
            f"{part.name}: line {int(part.line[row])}: this row stands in line "
            f"{int(before.line[old_row])} of {before.name} too{others}: "
            f"{why}; take out what is there twice"
        )


def _first_again(
    files: Sequence[Measurements],
) -> tuple[tuple[int, int], tuple[int, int], int] | None:
    """(file, row) of the first row that was there before, where it was, and how many such
    rows there are."""
    values = np.concatenate([_values(part) for part in files])
    rows = np.arange(len(values))
    _, first, group = np.unique(_hashes(values), return_index=True, return_inverse=True)
    before = first[group]
    again = (before != rows) & (values == values[before]).all(axis=1)
    lengths = [len(part) for part in files]
    file = np.repeat(np.arange(len(files)), lengths)
    # Without times, rows of one position may well come out equal: rounded, of a camera at rest.
    timeless = np.array([float(np.ptp(part.t_s)) == 0.0 for part in files])
    position = np.concatenate([part.position for part in files])
    alike = (file == file[before]) & (position == position[before]) & timeless[file]
    again &= ~alike
    if not again.any():
        return None
    starts = np.concatenate([[0], np.cumsum(lengths)])
    row = int(np.argmax(again))
    there, old = int(file[row]), int(file[before[row]])
    return (
        (there, row - int(starts[there])),
        (old, int(before[row] - starts[old])),
        int(again.sum()),
    )


def _values(part: Measurements) -> Array:
    """Time and poses of each row, (n, 13); what was not seen is 0."""
    poses = [np.nan_to_num(getattr(part, source)) for source in SOURCES]
    return np.ascontiguousarray(np.column_stack([part.t_s, *poses]) + 0.0)


def _hashes(values: Array) -> NDArray[np.uint64]:
    factors = np.array(
        [pow(_MIX, k, 1 << 64) for k in range(1, values.shape[1] + 1)], dtype=np.uint64
    )
    bits = values.view(np.uint64)
    mixed: NDArray[np.uint64] = (bits ^ (bits >> np.uint64(29))) * factors
    sums: NDArray[np.uint64] = mixed.sum(axis=1, dtype=np.uint64)
    return sums
