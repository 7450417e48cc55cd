"""From recordings of the two parts to the mounting, or to one sentence on what to add."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.mounting import carry, pivot
from perchctl.calibration.mounting.felt import Turned, felt, sum_up, turned_at
from perchctl.calibration.mounting.place import camera_place
from perchctl.calibration.mounting.recording import (
    AttitudeSample,
    MountingPart,
    MountingRecording,
    SeenPose,
)
from perchctl.calibration.mounting.result import Carried, Pivoted
from perchctl.calibration.mounting.turns import nearest_turn, rotation_matrices, rotation_vectors
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rpy_from_rotation

LATENCIES_S = np.arange(-0.2, 1.0, 0.02)
"""Also such as cannot be: a clock that is wrong is to be named, not hidden at the grid's end."""
MOST_TURN_SIGMA_DEG = 0.5
MOST_LATENCY_SIGMA_S = 0.01
MOST_TIP_SIGMA_M = 1e-3
MOST_MISFIT_RAD = math.radians(3.0)
MOST_LEFT_OUT = 0.4
COUNTS_LITTLE = 0.2
SLIPPED_M, SLIP_EXPLAINS = 4e-4, 0.1
"""Of the misfit; of a tip that stays where it is a jump explains 4 % at most."""
MIRRORED = (
    "the picture is mirrored: switch that off in the camera, or change camera.mirrored in the "
    "profile"
)
_AGAIN: dict[MountingPart, str] = {
    "carry": "turn the vehicle by hand in view of the target for 30 s, about all axes",
    "pivot": "keep the tip on its point and tilt the vehicle around it to all sides for 20 s",
}


def solve_carry(recording: MountingRecording) -> Carried:
    """The camera's turn in the body and its latency.

    Raises InvalidValue: too little motion, a mirrored picture, or vehicle and camera do not
    agree; with what to do.
    """
    check(recording, "carry")
    turned, seen = felt(recording.attitudes), _carry_poses(recording)
    start = first_guess(sum_up(turned, np.zeros(3), np.zeros(3)), seen.t_s, seen.R_cam_target)
    if start is None:
        raise InvalidValue(f"the target was not seen twice within half a second: {_AGAIN['carry']}")
    solved = carry.solve(turned, seen, start.R_body_cam, start.latency_s)
    _check_carry(solved)
    state = solved.state
    sigma = np.sqrt(np.diagonal(solved.cov))
    way_m = np.array([p.position_cam_target_m for p in _in_order(recording)])
    place_m, place_sigma_m = camera_place(turned, way_m, solved)
    rpy = np.stack([rpy_from_rotation(R) for R in solved.body.R_world_body])
    return Carried(
        R_body_cam=state.R_body_cam,
        rpy_deg=_degrees(rpy_from_rotation(state.R_body_cam)),
        rpy_sigma_deg=_rpy_sigma_deg(state.R_body_cam, solved.cov[carry.TURN, carry.TURN]),
        turn_cov_rad2=solved.cov[carry.TURN, carry.TURN],
        latency_s=state.latency_s,
        latency_sigma_s=float(sigma[carry.LATENCY]),
        jitter_s=solved.jitter_s,
        target_rpy_deg=_degrees(rpy_from_rotation(state.R_world_target)),
        target_rpy_sigma_deg=_rpy_sigma_deg(
            state.R_world_target, solved.cov[carry.TARGET, carry.TARGET]
        ),
        gyro_bias_radps=state.bias_radps,
        attitude_bias_rad=state.off_rad,
        cam_body_m=place_m,
        cam_body_sigma_m=place_sigma_m,
        t_s=seen.t_s,
        residual_rad=solved.misfit,
        counted=solved.counted,
        body_rpy_rad=np.unwrap(rpy, axis=0),
        poses=len(seen.t_s),
    )


def solve_pivot(recording: MountingRecording, size_sigma: float = 0.005) -> Pivoted:
    """The gear's tip in the camera's frame.

    Args:
        size_sigma: by which share the printed sizes may be off (`target.size_sigma`): all
            distances are, with them.

    Raises InvalidValue: too few or too equal tilts, a tip that slipped, a mirrored picture.
    """
    check(recording, "pivot")
    poses = _in_order(recording)
    seen = pivot.Seen(
        t_s=np.array([p.t_s for p in poses]),
        R_cam_target=np.array([p.rotation_cam_target for p in poses]),
        p_cam_target_m=np.array([p.position_cam_target_m for p in poses]),
        cov=np.array([_covariance(p) for p in poses]),
    )
    solved = pivot.solve(seen)
    _check_pivot(seen, solved)
    cov = solved.cov_m2 + size_sigma**2 * np.outer(solved.tip_m, solved.tip_m)
    return Pivoted(
        gear_cam_m=_three(solved.tip_m),
        gear_cam_sigma_m=_three(np.sqrt(np.diagonal(cov))),
        covariance_m2=cov,
        point_target_m=solved.point_m,
        t_s=seen.t_s,
        residual_m=pivot.in_target(seen, solved),
        counted=solved.counted,
        tilt_rad=tilts_rad(poses),
    )


def check(recording: MountingRecording, part: MountingPart) -> None:
    """Raises InvalidValue where a solve would be in vain."""
    if recording.part != part:
        raise InvalidValue(f"this is a recording of the {recording.part}, not of the {part}")
    if recording.mirrored_pictures > max(5, len(recording.poses)):
        raise InvalidValue(MIRRORED)
    if part == "carry" and recording.attitudes and recording.poses:
        times_s = [a.t_s for a in recording.attitudes]
        begin_s, end_s = min(times_s), max(times_s) + LATENCIES_S[-1]
        together = [begin_s <= p.t_s <= end_s for p in recording.poses]
        if sum(together) < 0.5 * len(together):
            raise InvalidValue(
                f"only {sum(together)} of {len(together)} pictures fall into the time of the "
                f"telemetry: both must be on one clock; record anew"
            )
    if lacking := missing(recording):
        raise InvalidValue(f"the {part} lacks motion: {'; '.join(lacking)}")


def _check_carry(solved: carry.Solved) -> None:
    """Whether vehicle and camera agree, and well enough."""
    used = solved.counted > 0.0
    size = np.linalg.norm(solved.misfit[used], axis=1)
    left_out = float((solved.counted[used] < COUNTS_LITTLE).mean())
    if np.median(size) > MOST_MISFIT_RAD or left_out > MOST_LEFT_OUT:
        raise InvalidValue(
            f"the turns that the vehicle felt and those that the camera saw differ by "
            f"{math.degrees(np.median(size)):.1f} deg ({100 * left_out:.0f} % of the pictures do "
            f"not fit at all): target and camera must not move in the room or on the vehicle; "
            f"then {_AGAIN['carry']}"
        )
    sigma = np.sqrt(np.diagonal(solved.cov))
    turn_deg, latency_s = math.degrees(sigma[carry.TURN].max()), float(sigma[carry.LATENCY])
    if not turn_deg <= MOST_TURN_SIGMA_DEG:
        raise InvalidValue(
            f"the camera's turn is known to {turn_deg:.1f} deg only (at most "
            f"{MOST_TURN_SIGMA_DEG:g} is accepted): {_AGAIN['carry']}, and farther to each side"
        )
    if not latency_s <= MOST_LATENCY_SIGMA_S:
        raise InvalidValue(
            f"the latency is known to {1e3 * latency_s:.0f} ms only (at most "
            f"{1e3 * MOST_LATENCY_SIGMA_S:g} is accepted): turn faster to and fro"
        )
    if solved.state.latency_s < -2.0 * latency_s:
        raise InvalidValue(
            f"the pictures are stamped {-1e3 * solved.state.latency_s:.0f} ms before they can have "
            f"been taken: camera and telemetry must be on one clock"
        )


def _check_pivot(seen: pivot.Seen, solved: pivot.Solved) -> None:
    jump = pivot.slip(seen, solved)
    if jump.moved_m > SLIPPED_M and jump.explains > SLIP_EXPLAINS:
        raise InvalidValue(
            f"the tip slipped by {1e3 * jump.moved_m:.1f} mm {jump.t_s - seen.t_s[0]:.0f} s after "
            f"the beginning: {_AGAIN['pivot']}; a dent or a ring of tape holds it"
        )
    left_out = float((solved.counted < COUNTS_LITTLE).mean())
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(solved.cov_m2)[-1]))
    if left_out > MOST_LEFT_OUT or not sigma_m <= MOST_TIP_SIGMA_M:
        raise InvalidValue(
            f"the tip is known to {1e3 * sigma_m:.1f} mm only, at most "
            f"{1e3 * MOST_TIP_SIGMA_M:g} is accepted, and {100 * left_out:.0f} % of the pictures "
            f"do not fit: {_AGAIN['pivot']}"
        )


def _in_order(recording: MountingRecording) -> list[SeenPose]:
    return sorted(recording.poses, key=lambda p: p.t_s)


def _carry_poses(recording: MountingRecording) -> carry.Seen:
    poses = _in_order(recording)
    return carry.Seen(
        t_s=np.array([p.t_s for p in poses]),
        R_cam_target=np.array([p.rotation_cam_target for p in poses]),
        cov_rad2=np.array([_covariance(p)[:3, :3] for p in poses]) + np.eye(3) * carry.FLOOR_RAD**2,
    )


def _covariance(pose: SeenPose) -> Array:
    """A pose's own, or what a pose of its distance usually has."""
    if pose.covariance is not None:
        return pose.covariance
    far_m = float(np.linalg.norm(pose.position_cam_target_m))
    sigma = [carry.BARE_SIGMA_RAD] * 3 + [pivot.BARE_SHARE * far_m] * 3
    return np.diag(np.square(sigma))


def _rpy_sigma_deg(R: Array, cov_rad2: Array) -> tuple[float, float, float]:
    """Of the angles of R, from that of a small turn on its left."""
    step = 1e-6
    here = np.array(rpy_from_rotation(R))
    J = np.stack(
        [
            np.array(rpy_from_rotation(rotation_matrices(step * axis) @ R)) - here
            for axis in np.eye(3)
        ],
        axis=1,
    )
    J = (J + np.pi) % (2.0 * np.pi) - np.pi
    return _degrees(np.sqrt(np.diagonal(J @ cov_rad2 @ J.T)) / step)


def _degrees(angles_rad: Array | tuple[float, float, float]) -> tuple[float, float, float]:
    return _three(np.degrees(angles_rad))


def _three(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


# --- Whether there was enough motion, and which is missing: while recording and before a solve ---


CARRY_S, PIVOT_S = 20.0, 12.0
LEAST_POSES = {"carry": 150, "pivot": 100}
LEAST_ATTITUDES = 500
ROLL_PITCH_DEG, YAW_DEG = 30.0, 90.0
"""From one side to the other, while the target is seen."""
LEAST_RATE_DPS = 15.0
TILT_DEG = 25.0
_MOST_LATE_S = 1.0


def missing(recording: MountingRecording) -> tuple[str, ...]:
    """Which motion is still lacking, in a few words each; nothing: it is enough."""
    lacking = _lacking_carry(recording) if recording.part == "carry" else _lacking_pivot(recording)
    return tuple(lacking)


def _lacking_carry(recording: MountingRecording) -> list[str]:
    attitudes, poses = recording.attitudes, recording.poses
    if len(attitudes) < 2 or len(poses) < 2:
        return ["bring the target into view"] if len(attitudes) >= 2 else ["wait for the vehicle"]
    lacking = []
    rpy = seen_rpy_deg(attitudes, poses)
    for name, axis, least, how in (
        ("roll", 0, ROLL_PITCH_DEG, "tip it from side to side"),
        ("pitch", 1, ROLL_PITCH_DEG, "tip it forwards and back"),
        ("yaw", 2, YAW_DEG, "turn it about the vertical"),
    ):
        span = extent(rpy[:, axis])
        if span < least:
            lacking.append(f"{name}: {how} ({span:.0f} of {least:.0f} deg)")
    rate_dps = math.degrees(
        math.sqrt(float(np.mean([a.gyro_radps @ a.gyro_radps for a in attitudes])))
    )
    if rate_dps < LEAST_RATE_DPS:
        lacking.append(f"faster: {rate_dps:.0f} of {LEAST_RATE_DPS:.0f} deg/s")
    lacking += _length(recording, CARRY_S)
    if len(attitudes) < LEAST_ATTITUDES and not lacking:
        lacking.append(f"telemetry: {len(attitudes)} of {LEAST_ATTITUDES} samples")
    return lacking


def _lacking_pivot(recording: MountingRecording) -> list[str]:
    if len(recording.poses) < 2:
        return ["bring the target into view"]
    lacking = []
    least, most = tilt_extents_deg(tilts_rad(recording.poses))
    if most < TILT_DEG:
        lacking.append(f"tilt: around the tip, to all sides ({most:.0f} of {TILT_DEG:.0f} deg)")
    elif least < TILT_DEG:
        lacking.append(
            f"tilt: also at right angles to the tilts so far ({least:.0f} of {TILT_DEG:.0f} deg)"
        )
    return lacking + _length(recording, PIVOT_S)


def _length(recording: MountingRecording, least_s: float) -> list[str]:
    t_s = [p.t_s for p in recording.poses]
    # Time in which the target is seen.
    seen_s = float(np.minimum(np.diff(np.sort(t_s)), 0.2).sum())
    if seen_s < least_s:
        return [f"longer: {seen_s:.0f} of {least_s:.0f} s in view"]
    if len(t_s) < LEAST_POSES[recording.part]:
        return [f"more pictures: {len(t_s)} of {LEAST_POSES[recording.part]}"]
    return []


def extent(values: Array) -> float:
    """From one side to the other, without the outermost hundredths."""
    return float(np.ptp(np.percentile(values, (2.0, 98.0)))) if len(values) else 0.0


def seen_rpy_deg(attitudes: Sequence[AttitudeSample], poses: Sequence[SeenPose]) -> Array:
    """The vehicle's attitude at each picture (n, 3), latency left out of account; heading
    unwrapped."""
    t_s = np.array([a.t_s for a in attitudes])
    rpy = np.unwrap([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in attitudes], axis=0)
    at_s = np.array([p.t_s for p in poses])
    at_s = at_s[(at_s >= t_s[0]) & (at_s <= t_s[-1] + _MOST_LATE_S)]
    rpy_deg: Array = np.degrees(np.stack([np.interp(at_s, t_s, angle) for angle in rpy.T], axis=1))
    return rpy_deg


def tilts_rad(poses: Sequence[SeenPose]) -> Array:
    """Of the camera to the target's x and y, (n, 2): its view in the target's axes."""
    view = np.array([p.rotation_cam_target[2] for p in poses])
    return np.asarray(np.arctan2(view[:, :2], view[:, 2:]))


def tilt_extents_deg(tilts: Array) -> tuple[float, float]:
    """The least and the most extent of tilts (n, 2) over all directions."""
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    along = np.degrees(tilts) @ np.stack([np.cos(angles), np.sin(angles)])
    extents = [extent(column) for column in along.T]
    return min(extents), max(extents)


# --- Turn of the camera and latency from nothing -------------------------------------------------
# No start is needed, whatever the camera's turn.
# Between two pictures the camera turns by the same rotation as the body, seen in its own axes:
# ``v_body = R_body_cam v_cam`` for the rotation vectors. For each latency of a grid the R_body_cam
# that fits best follows in closed form; the latency with the least misfit wins.


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
