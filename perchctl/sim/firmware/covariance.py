"""What a state estimate knows of its own errors: position, velocity and attitude, with all that
one says about another.

As in the firmware (source: `kalman_core`), but for the axes: velocity and attitude errors are the
world's here and the body's there, which is the same for a vehicle that is nearly level.
"""

from __future__ import annotations

POSITION, VELOCITY, ATTITUDE = 0, 3, 6
"""Where each begins among the nine states, x first."""

_FIRST_M, _FIRST_HEIGHT_M, _FIRST_MPS, _FIRST_RAD = 100.0, 1.0, 0.01, 0.01
"""Standard deviations after a reset (source: `stdDevInitial*`)."""
_MOST, _LEAST = 100.0, 1e-6
_NOISE_PER_S = (0.0, 0.0, 0.0, 2.5e-4, 2.5e-4, 1e-3, 1e-5, 1e-5, 1e-5)
"""(m/s)^2 and rad^2 a second: `kalman.pNAcc_xy` 0.5 m/s^2, `pNAcc_z` 1 m/s^2 and `mNGyro_*`
0.1 rad/s, each added as one of 1000 steps a second (source)."""
_STATES = range(9)


class Covariance:
    """Of nine states: SI, radians, world axes. `rows[i][j]` is symmetric."""

    def __init__(self) -> None:
        self.rows: list[list[float]] = []
        self.forget()

    def forget(self) -> None:
        """As after `kalman.resetEstimation`."""
        m2, height_m2 = min(_FIRST_M**2, _MOST), _FIRST_HEIGHT_M**2
        first = [m2, m2, height_m2] + [_FIRST_MPS**2] * 3 + [_FIRST_RAD**2] * 3
        self.rows = [[first[i] if i == j else 0.0 for j in _STATES] for i in _STATES]

    def grow(self, period_s: float, felt_mps2: tuple[float, float, float]) -> None:
        """After a prediction. `felt_mps2`: specific force in world axes; an attitude that is wrong
        sends it elsewhere."""
        x, y, z, u, v, w, a, b, c = self.rows
        t = period_s
        sx, sy, sz = felt_mps2
        sx, sy, sz = t * sx, t * sy, t * sz
        rows = self.rows = [
            [p + t * q for p, q in zip(x, u, strict=True)],
            [p + t * q for p, q in zip(y, v, strict=True)],
            [p + t * q for p, q in zip(z, w, strict=True)],
            [p + sz * q - sy * r for p, q, r in zip(u, b, c, strict=True)],
            [p + sx * q - sz * r for p, q, r in zip(v, c, a, strict=True)],
            [p + sy * q - sx * r for p, q, r in zip(w, a, b, strict=True)],
            a, b, c,
        ]  # fmt: skip
        for row in rows:
            x_, y_, z_, u_, v_, w_, a_, b_, c_ = row
            row[0], row[1], row[2] = x_ + t * u_, y_ + t * v_, z_ + t * w_
            row[3] = u_ + sz * b_ - sy * c_
            row[4] = v_ + sx * c_ - sz * a_
            row[5] = w_ + sy * a_ - sx * b_
        for i in _STATES:
            rows[i][i] = _bounded(rows[i][i] + t * _NOISE_PER_S[i])

    def measure(self, state: int, variance: float) -> list[float]:
        """One state was measured with this variance: what to add to each of the nine for every
        unit that the measurement is more than the estimate."""
        rows = self.rows
        told = rows[state]
        spread = told[state] + variance
        gains = [p / spread for p in told]
        for i in _STATES:
            gain = gains[i]
            row = rows[i] = [p - gain * q for p, q in zip(rows[i], told, strict=True)]
            row[i] = _bounded(row[i])
        return gains


def _bounded(variance: float) -> float:
    return _LEAST if variance < _LEAST else _MOST if variance > _MOST else variance
