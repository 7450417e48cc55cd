"""A rolling shutter's corners, brought to one moment, against a known truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from perchctl.geometry import Array, yaw_of
from perchctl.profile import Profile
from perchctl.vision import (
    Detection,
    Detections,
    FieldState,
    PipelineState,
    make_pipeline,
    pictures,
    step,
)
from perchctl.vision.merge import UNKNOWN_READOUT_S, seen_at_once
from tests.helpers.interlaced import Pass
from tests.helpers.target_picture import CAMERA

READOUT_S = 0.02
CORNERS = np.array([[100.0, 50.0], [200.0, 50.0], [200.0, 400.0], [100.0, 400.0]])


def moving(corners: Array, velocity_px_s: tuple[float, float]) -> Detections:
    flow = np.tile(velocity_px_s, (4, 1))
    return Detections(
        1, 0.0, large=Detection("large", corners, 0.05, True),
        velocity_px_s=flow[0], flow_px_s={"large": flow},
    )  # fmt: skip


@pytest.mark.parametrize("velocity_px_s", [(300.0, 0.0), (0.0, 300.0), (-200.0, -400.0)])
def test_corners_go_back_to_the_middle_rows_moment(velocity_px_s: tuple[float, float]) -> None:
    """Corners that move evenly, each seen when the shutter's row meets it."""
    v = np.array(velocity_px_s)

    def seen(frame_s: float) -> Array:
        # Row y is exposed at frame_s + (y / 479 - 1/2) R, and the corner is at its y then.
        slope = READOUT_S / 479.0
        t_s = (frame_s + (CORNERS[:, 1] / 479.0 - 0.5) * READOUT_S) / (1.0 - v[1] * slope)
        return np.asarray(CORNERS + v * t_s[:, None])

    now, before = seen(0.0), seen(-0.04)
    flow = (now - before) / 0.04
    found = Detections(1, 0.0, large=Detection("large", now, 0.05, True), flow_px_s={"large": flow})
    (back,) = seen_at_once(found, READOUT_S, 480)
    assert np.abs(now - CORNERS).max() > 1.0
    assert back.corners_px == pytest.approx(CORNERS, abs=1e-6)


def test_without_motion_or_a_rolling_shutter_nothing_moves() -> None:
    still = Detections(0, 0.0, small=Detection("small", CORNERS, 0.05, True))
    for readout_s in (0.0, READOUT_S, None):
        assert seen_at_once(still, readout_s, 480) == [still.small]
    fast = moving(CORNERS, (300.0, 0.0))
    assert seen_at_once(fast, 0.0, 480) == [fast.large]


def test_an_unknown_shutter_is_an_error_of_all_corners_together() -> None:
    (seen,) = seen_at_once(moving(CORNERS, (300.0, 0.0)), None, 480)
    assert np.array_equal(seen.corners_px, CORNERS)
    assert seen.common_px is not None
    assert seen.common_px[0] == pytest.approx((-300.0 * UNKNOWN_READOUT_S * (0.5 - 50 / 479), 0.0))
    assert (seen.common_px[2] > 0.0)[0]


def measured(scene: Pass, readout_s: float | None) -> tuple[Array, float]:
    """RMS of x, y, z (mm) and yaw (deg) once motion is known, and the mean normalised squared
    error a degree of freedom."""
    values: dict[str, Any] = {
        "camera": {"mount": {"position_m": [0, 0, 0]}, "readout_s": readout_s},
        "vehicle": {"gear_body_m": [0, 0, 0]},
        "target": {"size_sigma": 0.0, "curl_per_m": 0.0},
    }
    setup = make_pipeline(Profile.model_validate(values), CAMERA)
    state, fields, errors, nees = PipelineState(), FieldState(), [], []
    for k, frame in enumerate(scene.frames(12)):
        fields, parts = pictures(fields, frame, setup)
        for part in parts:
            state, output = step(state, part, None, setup)
            if k < 4:
                continue
            pose = output.poses["joint"]
            R = scene.T_world_cam(part.t_s)[:3, :3].T
            error = np.array(
                [*(pose.tvec_m - scene.target_m(part.t_s)), pose.e_yaw_rad - yaw_of(R)]
            )
            assert pose.cov is not None
            nees.append(error @ np.linalg.solve(pose.cov, error) / 4.0)
            errors.append([*(1000.0 * error[:3]), np.degrees(error[3])])
    return np.sqrt(np.mean(np.square(errors), axis=0)), float(np.mean(nees))


ALONG = {"velocity_mps": (0.2, 0.1, 0.05), "turn_radps": 0.5}
ACROSS = {"velocity_mps": (0.0, 0.2, 0.0), "turn_radps": 0.0}


@pytest.mark.parametrize("motion", [ALONG, ACROSS])
def test_a_known_shutter_does_no_harm(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    known, nees = measured(scene, READOUT_S)
    taken_for_global, _ = measured(scene, 0.0)
    assert (known < [0.06, 0.06, 0.1, 0.04]).all()
    assert nees < 3.0
    # What it would have been: stretched along the columns, or sheared along the rows.
    assert taken_for_global[2] > 1.0 or taken_for_global[3] > 0.2


@pytest.mark.parametrize("motion", [ALONG, ACROSS])
def test_an_unknown_shutter_makes_modest(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    assert measured(scene, None)[1] < 1.5
    assert measured(scene, 0.0)[1] > 2.0


def test_fields_have_a_shutter_each() -> None:
    scene = Pass(0.3, **ACROSS, camera_readout_s=READOUT_S, camera_fields="top")
    known, _ = measured(scene, READOUT_S)
    assert (known < [0.06, 0.06, 0.12, 0.04]).all()
