"""Dead reckoning against a Kalman filter: how wrong each is after seconds without a position.

    perchctl simulate -p target_only --faults all -n 40 --log-dir LOGS
    python benchmarks/reckoning.py LOGS [--most 40]

The planner decides the flights of LOGS again. Twice a second, while the position is known, both
estimators are left with accelerometer and attitude alone, and after 0.5 to 3 s their velocity and
way are compared with the simulator's ground truth. A moment counts until a blow, a silence or the
floor. Given are the RMS errors, and for the difference of both the 95 % interval by drawing whole
flights anew: below 0 the filter is better.

The filter is the error-state filter that the design asks for, as far as the planner could use it.
The attitude's error is an acceleration in the world, so that with the accelerometer's error it is
one bias b, and each axis has a filter of its own, with the state (p, v, b):

    p += v dt + (dv - b dt) dt / 2,   v += dv - b dt
    Q = diag(0, QA^2 dt, QB^2 dt)
    z = v + n, n = RV^2 / dt: the estimate's velocity while it is believed
    z = p(t - latency) + n: each picture's unfiltered pose, at the time of its exposure
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import table

from perchctl.geometry import Array
from perchctl.mission import PlannerState, UnfilteredPose, step_mission
from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.reckoning import DeadReckoningState, advance_dead_reckoning
from perchctl.record import FlightLog, read_log

HORIZONS_S = (0.5, 1.0, 2.0, 3.0)
BEGINS_EVERY_S = 0.5
LEAST_HEIGHT_M, FLOOR_M = 0.2, 0.1
DRAWN = 300
QUANTITIES = ("velocity, sideways, m/s", "velocity, up, m/s", "way, sideways, m")

# Sideways and up: what each minimises on flights other than those that it is judged by.
QA_MPS_PER_SQRT_S = (0.05, 0.05, 0.05)
QB_MPS2_PER_SQRT_S = (0.05, 0.05, 0.005)
RV_MPS_SQRT_S = (0.08, 0.08, 0.05)
POSE_SIGMA_M = 0.004
TILT_SIGMA_RAD = 0.01
MOST_SIGMAS = 5.0
KEPT = 60
"""Ticks of the past for delayed poses: 1.2 s."""
REJECTED = 15
"""So many poses in a row that do not fit, and the position begins anew."""


class Axis:
    """The filter of one axis."""

    def __init__(self, axis: int) -> None:
        self.qa, self.qb = QA_MPS_PER_SQRT_S[axis], QB_MPS2_PER_SQRT_S[axis]
        self.rv = RV_MPS_SQRT_S[axis]
        self.x = np.zeros(3)
        self.P = np.diag([100.0, 1.0, 0.25])
        self.rejected = 0

    def copy(self, axis: int) -> Axis:
        new = Axis(axis)
        new.x, new.P = self.x.copy(), self.P.copy()
        return new

    def predict(self, dv_mps: float, dt_s: float) -> None:
        p, v, b = self.x
        gained = dv_mps - b * dt_s
        self.x = np.array([p + v * dt_s + 0.5 * gained * dt_s, v + gained, b])
        F = np.array([[1.0, dt_s, -0.5 * dt_s * dt_s], [0.0, 1.0, -dt_s], [0.0, 0.0, 1.0]])
        Q = np.diag([0.0, self.qa**2 * dt_s, self.qb**2 * dt_s])
        self.P = F @ self.P @ F.T + Q

    def update(self, part: int, z: float, variance: float, most_sigmas: float) -> bool:
        """Take in a measurement of one part of the state; False if it does not fit."""
        innovation, S = z - self.x[part], self.P[part, part] + variance
        if innovation**2 > most_sigmas**2 * S:
            return False
        gain = self.P[:, part] / S
        self.x = self.x + gain * innovation
        self.P = self.P - np.outer(gain, self.P[part])
        return True


class Filter:
    """The three axes, and their past positions for poses that arrive late."""

    def __init__(self) -> None:
        self.axes = [Axis(i) for i in range(3)]
        self.past: list[tuple[float, Array, float]] = []  # time, position, heading

    @property
    def position_m(self) -> Array:
        return np.array([axis.x[0] for axis in self.axes])

    def predict(self, dv_mps: Array, dt_s: float) -> None:
        for axis, gained in zip(self.axes, dv_mps, strict=True):
            axis.predict(float(gained), dt_s)

    def begin(self, velocity_mps: tuple[float, float, float]) -> None:
        """After a silence only the estimate knows the velocity."""
        for axis, v in zip(self.axes, velocity_mps, strict=True):
            axis.x[1] = v
            axis.P[1, 1] += 0.25

    def remember(self, t_s: float, yaw_rad: float) -> None:
        self.past = [*self.past[1 - KEPT :], (t_s, self.position_m, yaw_rad)]

    def add_velocity(self, b: Belief, dt_s: float) -> None:
        for i, axis in enumerate(self.axes):
            pushed = (
                b.is_target_position_source
                and not b.is_estimated_velocity_being_corrected
                and i < 2
            )
            if not pushed:
                v = b.telemetry.velocity_mps[i]
                axis.update(1, v, axis.rv**2 / dt_s, 2.0 * MOST_SIGMAS)

    def add_pose(self, pose: UnfilteredPose) -> None:
        then = next((p for p in reversed(self.past) if p[0] <= pose.t_s + 0.011), None)
        if then is None or then[0] < pose.t_s - 0.05:
            return
        _, was_m, yaw_rad = then
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        ex, ey, ez = (float(e) for e in pose.gear_to_target_level_m)
        seen_m = -np.array([cos * ex - sin * ey, sin * ex + cos * ey, ez])
        before_m = self.position_m
        sigma_m = math.hypot(POSE_SIGMA_M, TILT_SIGMA_RAD * abs(ez))
        for i, axis in enumerate(self.axes):
            z = seen_m[i] + before_m[i] - was_m[i]
            variance = (sigma_m if i < 2 else 2.0 * POSE_SIGMA_M) ** 2
            axis.rejected = 0 if axis.update(0, z, variance, MOST_SIGMAS) else axis.rejected + 1
            if axis.rejected > REJECTED:
                axis.x[0], axis.rejected = z, 0
                axis.P += np.diag([1.0, 0.3, 0.0])
        moved_m = self.position_m - before_m
        self.past = [(t_s, at_m + moved_m, yaw) for t_s, at_m, yaw in self.past]


@dataclass(frozen=True)
class Moment:
    """A tick with both estimators' states."""

    belief: Belief
    axes: tuple[Axis, ...]


class Truth:
    """The simulator's position of the body by time."""

    def __init__(self, log: FlightLog) -> None:
        known = [r for r in log.records if r.get("true_x_m") is not None]
        self.t_s = np.array([r["t_s"] for r in known])
        self.at_m = np.array([[r[f"true_{axis}_m"] for axis in "xyz"] for r in known])

    def position_m(self, t_s: float) -> Array:
        return np.array([np.interp(t_s, self.t_s, column) for column in self.at_m.T])

    def velocity_mps(self, t_s: float) -> Array:
        return (self.position_m(t_s + 0.03) - self.position_m(t_s - 0.03)) / 0.06


def moments(log: FlightLog) -> Iterator[Moment]:
    """Decide the flight again, with the filter beside it."""
    state: PlannerState | None = None
    filter_, before = Filter(), None
    for turn in log.turns:
        if turn.role != "flown" or turn.observation is None:
            continue
        state, _ = step_mission(state, turn.observation, log.flown_profile)
        b, imu = state.belief, turn.observation.imu
        dt_s = 0.0 if before is None else imu.t_s - before.t_s
        if before is None or imu.last_telemetry_gap_ended_at_s > before.t_s:
            filter_.begin(b.telemetry.velocity_mps)
        if before is not None and 0.0 < dt_s < 0.3:
            filter_.predict(
                np.subtract(
                    imu.velocity_since_first_sample_world_mps,
                    before.velocity_since_first_sample_world_mps,
                ),
                dt_s,
            )
        before = imu if before is None or dt_s > 0.0 else before
        filter_.remember(b.telemetry.t_s, b.telemetry.yaw_rad)
        if (
            b.is_position_valid
            and b.dead_reckoning_began_at_s is None
            and b.first_estimate_jump_at_s is None
            and dt_s > 0.0
        ):
            filter_.add_velocity(b, dt_s)
        pose = next(
            (
                turn.unfiltered_pose_by_marker[n]
                for n in ("joint", "large", "small")
                if n in turn.unfiltered_pose_by_marker
            ),
            None,
        )
        if pose is not None and b.camera_imu_mismatch.camera_latency_error_s == 0.0:
            filter_.add_pose(pose)
        yield Moment(b, tuple(axis.copy(i) for i, axis in enumerate(filter_.axes)))


def errors(log: FlightLog) -> Iterator[tuple[float, list[tuple[float, float]]]]:
    """For each blind time: its length, and by quantity the errors of reckoning and filter."""
    truth, flown = Truth(log), list(moments(log))
    last_s = -math.inf
    for k, moment in enumerate(flown):
        b = moment.belief
        known = (
            b.is_position_valid
            and b.dead_reckoning_began_at_s is None
            and b.dead_reckoning.imu_at_last_update is not None
        )
        if not known or b.height_m < LEAST_HEIGHT_M or b.obs.t_s - last_s < BEGINS_EVERY_S:
            continue
        last_s = b.obs.t_s
        yield from _blind(b, moment.axes, flown[k + 1 :], truth)


def _blind(
    b: Belief, axes: tuple[Axis, ...], later: list[Moment], truth: Truth
) -> Iterator[tuple[float, list[tuple[float, float]]]]:
    begin_s, imu = b.obs.t_s, b.imu
    old: DeadReckoningState = b.dead_reckoning
    new = [axis.copy(i) for i, axis in enumerate(axes)]
    for axis in new:
        axis.x[0] = 0.0
    left = list(HORIZONS_S)
    for moment in later:
        now = moment.belief
        dt_s = now.imu.t_s - imu.t_s
        if dt_s <= 0.0:
            continue
        struck = (
            now.imu.last_telemetry_gap_ended_at_s > imu.t_s
            or now.imu.last_impact_or_bounce_at_s > imu.t_s
        )
        if struck or now.height_m < FLOOR_M or not left:
            return
        gained = np.subtract(
            now.imu.velocity_since_first_sample_world_mps, imu.velocity_since_first_sample_world_mps
        )
        old = advance_dead_reckoning(old, now.imu, now.telemetry, is_estimate_trusted=False)
        for axis, dv in zip(new, gained, strict=True):
            axis.predict(float(dv), dt_s)
        imu = now.imu
        if now.obs.t_s - begin_s >= left[0]:
            v = truth.velocity_mps(now.obs.t_s)
            way_m = truth.position_m(now.obs.t_s) - truth.position_m(begin_s)
            old_way_m = np.subtract(
                b.dead_reckoning.gear_to_target_world_xy_m, old.gear_to_target_world_xy_m
            )
            found = np.array([axis.x for axis in new])
            yield (
                left.pop(0),
                [
                    (
                        float(np.linalg.norm(np.subtract(old.velocity_world_mps[:2], v[:2]))),
                        float(np.linalg.norm(found[:2, 1] - v[:2])),
                    ),
                    (abs(old.velocity_world_mps[2] - v[2]), abs(float(found[2, 1] - v[2]))),
                    (
                        float(np.linalg.norm(old_way_m - way_m[:2])),
                        float(np.linalg.norm(found[:2, 0] - way_m[:2])),
                    ),
                ],
            )


def rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("logs", type=Path, help="folder of simulated flights' logs")
    parser.add_argument("--most", type=int, default=40, help="flights that are read")
    given = parser.parse_args()
    # By horizon and flight: (blind times, quantities, old and new).
    found: dict[float, list[Array]] = {each: [] for each in HORIZONS_S}
    paths = sorted(given.logs.glob("*.jsonl*"))[: given.most]
    for path in paths:
        log = read_log(path)
        if not any(record.get("true_x_m") is not None for record in log.records):
            continue
        by_time: dict[float, list[list[tuple[float, float]]]] = {}
        for horizon_s, each in errors(log):
            by_time.setdefault(horizon_s, []).append(each)
        for horizon_s, all_ in by_time.items():
            found[horizon_s].append(np.array(all_))
    rng = np.random.default_rng(0)
    rows = []
    for horizon_s, flights in found.items():
        if not flights:
            raise SystemExit(f"{given.logs} holds no simulated flight's log")
        whole = rms(np.concatenate(flights))
        drawn = [
            rms(np.concatenate([flights[i] for i in rng.integers(len(flights), size=len(flights))]))
            for _ in range(DRAWN)
        ]
        differences = np.array([each[:, 1] - each[:, 0] for each in drawn])
        low, high = np.percentile(differences, [2.5, 97.5], axis=0)
        for k, quantity in enumerate(QUANTITIES):
            rows.append(
                [
                    f"{horizon_s:g} s",
                    quantity,
                    f"{sum(map(len, flights))}",
                    f"{whole[k, 0]:.3f}",
                    f"{whole[k, 1]:.3f}",
                    f"{low[k]:+.3f} to {high[k]:+.3f}",
                ]
            )
    title = "RMS errors without a position"
    table(
        title, ["blind for", "error of", "times", "reckoning", "filter", "difference, 95 %"], rows
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
