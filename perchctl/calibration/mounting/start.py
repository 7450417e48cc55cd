"""Turn of the camera and latency from nothing: no start is needed, whatever the camera's turn.

Between two pictures the camera turns by the same rotation as the body, seen in its own axes:
``v_body = R_body_cam v_cam`` for the rotation vectors. For each latency of a grid the R_body_cam
that fits best follows in closed form; the latency with the least misfit wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.mounting.felt import Turned, turned_at
from perchctl.calibration.mounting.turns import nearest_turn, rotation_vectors
from perchctl.geometry import Array

LATENCIES_S = np.arange(-0.2, 1.0, 0.02)
"""Also such as cannot be: a clock that is wrong is to be named, not hidden at the grid's end."""
_SPAN_S = (0.2, 0.5)
_MOST_PAIRS = 400
_ROUNDS = 3
_SCALE_RAD = 0.02  # of a misfit that counts half


@dataclass(frozen=True, eq=False)
class Start:
    """misfit (m,): of each latency of the grid, 0 to 1."""

    R_body_cam: Array
    latency_s: float
    misfit: Array


def first_guess(turned: Turned, t_s: Array, R_cam_target: Array) -> Start | None:
    """From poses at t_s (n,), (n, 3, 3); None without pairs of pictures some tenths apart."""
    first, second = _pairs(t_s)
    if len(first) < 3:
        return None
    seen = rotation_vectors(R_cam_target[first] @ R_cam_target[second].transpose(0, 2, 1))
    guesses = []
    for latency_s in LATENCIES_S:
        a = turned_at(turned, t_s[first] - latency_s).R_world_body
        b = turned_at(turned, t_s[second] - latency_s).R_world_body
        guesses.append(_fit(rotation_vectors(a.transpose(0, 2, 1) @ b), seen))
    misfit = np.array([m for _, m in guesses])
    best = int(np.argmin(misfit))
    return Start(guesses[best][0], float(LATENCIES_S[best]), misfit)


def _pairs(t_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Each picture and the first one that is `_SPAN_S` later."""
    second = np.searchsorted(t_s, t_s + _SPAN_S[0])
    first = np.flatnonzero(second < len(t_s))
    second = second[first]
    near = t_s[second] - t_s[first] <= _SPAN_S[1]
    first, second = first[near], second[near]
    thinned = slice(None, None, 1 + len(first) // _MOST_PAIRS)
    return first[thinned], second[thinned]


def _fit(body: Array, seen: Array) -> tuple[Array, float]:
    """R with body = R seen, by least squares in which what fits badly counts less."""
    weight = np.ones(len(body))
    R = np.eye(3)
    for _ in range(_ROUNDS):
        R = nearest_turn((weight[:, None] * body).T @ seen)
        miss = ((body - seen @ R.T) ** 2).sum(axis=1) / _SCALE_RAD**2
        weight = 1.0 / (1.0 + miss)
    return R, float((miss * weight).mean())
