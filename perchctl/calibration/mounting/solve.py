"""From recordings of the two parts to the mounting, or to one sentence on what to add."""

from __future__ import annotations

import math

import numpy as np

from perchctl.calibration.mounting import carry, pivot
from perchctl.calibration.mounting.felt import felt, sum_up
from perchctl.calibration.mounting.motion import missing, tilts_rad
from perchctl.calibration.mounting.place import camera_place
from perchctl.calibration.mounting.recording import MountingPart, MountingRecording, SeenPose
from perchctl.calibration.mounting.result import Carried, Measured, Pivoted, measured
from perchctl.calibration.mounting.start import LATENCIES_S, first_guess
from perchctl.calibration.mounting.turns import rotation_matrices
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rpy_from_rotation

__all__ = ["Carried", "Measured", "Pivoted", "measured", "missing", "solve_carry", "solve_pivot"]

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
