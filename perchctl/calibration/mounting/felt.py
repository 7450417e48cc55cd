"""How the vehicle turned, as its gyroscope felt it: rates summed up over the whole recording.

The sum drifts by the sensor's constant error and by its noise's random walk only, some hundredths
of a degree in half a minute. The attitude that the vehicle itself estimates rests on its
accelerometers, whose constant error looks just like a camera that is tilted in the body: it says
where down is, not how the camera is turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.calibration.mounting.recording import AttitudeSample
from perchctl.calibration.mounting.turns import nearest_turn, rotation_matrices, turns_from_rpy
from perchctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Felt:
    """Samples as arrays: t_s (n,), estimate (n, 3, 3) R_world_body, gyro_radps (n, 3), and
    position_m (n, 3) with sigma (n,), NaN where none was given."""

    t_s: Array
    estimate: Array
    gyro_radps: Array
    position_m: Array
    position_sigma_m: Array


def felt(samples: Sequence[AttitudeSample]) -> Felt:
    """In the order of time, each time once."""
    ordered = sorted(samples, key=lambda a: a.t_s)
    t_s = np.array([a.t_s for a in ordered])
    kept = np.concatenate([[True], np.diff(t_s) > 0.0]) if len(t_s) else np.zeros(0, bool)
    nowhere = np.full(3, np.nan)
    rpy = np.array([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in ordered]).reshape(-1, 3)
    trusted = [a.position_m is not None and a.position_sigma_m is not None for a in ordered]
    place = [a.position_m if ok else nowhere for a, ok in zip(ordered, trusted, strict=True)]
    sigma = [a.position_sigma_m if ok else np.nan for a, ok in zip(ordered, trusted, strict=True)]
    return Felt(
        t_s=t_s[kept],
        estimate=turns_from_rpy(rpy)[kept],
        gyro_radps=np.array([a.gyro_radps for a in ordered]).reshape(-1, 3)[kept],
        position_m=np.array(place, dtype=np.float64).reshape(-1, 3)[kept],
        position_sigma_m=np.array(sigma, dtype=np.float64)[kept],
    )


@dataclass(frozen=True, eq=False)
class Turned:
    """The summed-up turn R_world_body (n, 3, 3) at t_s (n,), with the rates (n, 3) it rests on.

    `of_bias` and `of_scale` (n, 3, 3): by how much a change of the gyroscope's constant error
    (rad/s) and of its scale (a share) turn the body, in world axes.
    """

    t_s: Array
    R_world_body: Array
    rate_radps: Array
    of_bias: Array
    of_scale: Array


def sum_up(felt: Felt, bias_radps: Array, scale: Array) -> Turned:
    """With the gyroscope's errors taken off: rate = (gyro - bias) (1 + scale).

    Between two samples the rate goes straight from one to the other, to fourth order (Magnus).
    Where it begins in the world is chosen to agree with the estimate on the whole.
    """
    unbiased = felt.gyro_radps - bias_radps
    rate = unbiased * (1.0 + scale)
    dt = np.diff(felt.t_s)[:, None]
    before, after = rate[:-1], rate[1:]
    steps = rotation_matrices(0.5 * dt * (before + after) + dt**2 / 12.0 * np.cross(before, after))
    R = products(np.concatenate([np.eye(3)[None], steps]))
    R = nearest_turn(np.einsum("nij,nkj->ik", felt.estimate, R)) @ R
    return Turned(
        t_s=felt.t_s,
        R_world_body=R,
        rate_radps=rate,
        of_bias=_sum(-R * (1.0 + scale), dt),
        of_scale=_sum(R * unbiased[:, None, :], dt),
    )


def products(steps: Array) -> Array:
    """``steps[0] @ ... @ steps[k]`` for each k, (n, 3, 3), in about 2 sqrt(n) operations."""
    n = len(steps)
    size = int(np.ceil(np.sqrt(n)))
    padded = np.concatenate([steps, np.broadcast_to(np.eye(3), (size * size - n, 3, 3))])
    rows = padded.reshape(size, size, 3, 3)
    for k in range(1, size):
        rows[:, k] = rows[:, k - 1] @ rows[:, k]
    for k in range(1, size):
        rows[k] = rows[k - 1, -1] @ rows[k]
    return rows.reshape(-1, 3, 3)[:n]


def _sum(values: Array, dt: Array) -> Array:
    """Integral (n, 3, 3) from the first on, by trapezia."""
    steps = 0.5 * dt[:, :, None] * (values[1:] + values[:-1])
    return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def turned_at(turned: Turned, t_s: Array) -> Turned:
    """At other times (m,), which are held within the recording's."""
    grid = turned.t_s
    t_s = np.clip(t_s, grid[0], grid[-1])
    k = np.clip(np.searchsorted(grid, t_s, side="right") - 1, 0, len(grid) - 2)
    step = grid[k + 1] - grid[k]
    into = (t_s - grid[k])[:, None]
    share = into / step[:, None]
    change = turned.rate_radps[k + 1] - turned.rate_radps[k]
    way = into * (turned.rate_radps[k] + 0.5 * share * change)

    def between(values: Array) -> Array:
        return np.asarray(values[k] + share[..., None] * (values[k + 1] - values[k]))

    return Turned(
        t_s=t_s,
        R_world_body=turned.R_world_body[k] @ rotation_matrices(way),
        rate_radps=turned.rate_radps[k] + share * change,
        of_bias=between(turned.of_bias),
        of_scale=between(turned.of_scale),
    )
