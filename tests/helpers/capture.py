"""The 24 ways to name the axes of a right-handed world, and what a capture says in each."""

from __future__ import annotations

import itertools

import numpy as np

from perchctl.geometry import Array


def _turns() -> list[Array]:
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            for row, (axis, sign) in enumerate(zip(order, signs, strict=True)):
                turn[row, axis] = sign
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


TURNS = _turns()
"""Each (3, 3): true world to the capture's. 24; four of them have z up."""
UPRIGHT = [turn for turn in TURNS if turn[2, 2] == 1.0]


def named_up(turn: Array) -> str:
    """The capture's axis that is up."""
    i = int(np.argmax(np.abs(turn[:, 2])))
    return f"{'-' if turn[i, 2] < 0 else ''}{'xyz'[i]}"
