"""Where the place is known without a picture, and the first sign that it is not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.calibration import profile_camera
from perchctl.flight import FlightInputs
from perchctl.flight.inputs import SUPPORTED_FOR_S, TargetPositioning, is_supported
from perchctl.geometry import Place
from perchctl.perception import History, add_samples
from perchctl.profile import SafetyConfig
from perchctl.vehicle import ExternalPosition, Telemetry
from perchctl.vision import MarkerPose, make_pipeline
from tests.helpers.mission import target_at, telemetry
from tests.helpers.sights import TARGET_ONLY

TARGET = Place(np.array([0.0, 0.0, 2.0]), 0.0)
PIPELINE = make_pipeline(TARGET_ONLY, profile_camera(TARGET_ONLY.camera))
SAMPLE_S = 0.01


def history(samples: list[Telemetry]) -> History:
    return add_samples(History(), samples, SafetyConfig())


def at_rest(lasts_s: float = 0.5, **changes: object) -> list[Telemetry]:
    n = round(lasts_s / SAMPLE_S)
    return [telemetry(1.0 + SAMPLE_S * i, 1.97, **changes) for i in range(n)]


def hung() -> tuple[TargetPositioning, list[ExternalPosition]]:
    sent: list[ExternalPosition] = []

    def send(place: ExternalPosition) -> bool:
        sent.append(place)
        return True

    sights = TargetPositioning(send, PIPELINE, TARGET_ONLY)
    sights.feed.target = TARGET
    return sights, sent


@pytest.mark.parametrize("touches", [True, False])
def test_what_hangs_is_told_where_and_what_flies_nothing(touches: bool) -> None:
    sights, sent = hung()
    samples = at_rest()
    sights.begin_tick(history(samples), samples[-1].t_s, in_contact=touches)
    assert [p.position_m for p in sent] == [sights.feed.contact_position(0.0)] * touches
    assert not touches or sights.feed.status(samples[-1].t_s).age_s == 0.0


@given(felt_g=st.floats(-0.5, 0.7))
def test_the_first_sample_of_a_fall_ends_it(felt_g: float) -> None:
    """One that falls must not be told that it hangs: its estimate would say so, too."""
    sights, sent = hung()
    samples = at_rest()
    samples.append(replace(samples[-1], t_s=samples[-1].t_s + SAMPLE_S, acc_z_g=felt_g))
    sights.begin_tick(history(samples), samples[-1].t_s, in_contact=True)
    assert not sent


def test_a_slow_slip_ends_it_within_a_tenth_of_a_second() -> None:
    """On nine tenths of its weight no single sample tells."""
    samples = at_rest()
    for _ in range(round(SUPPORTED_FOR_S / SAMPLE_S) - 1):
        samples.append(replace(samples[-1], t_s=samples[-1].t_s + SAMPLE_S, acc_z_g=0.9))
    assert not is_supported(history(samples), samples[-1].t_s)


def test_sinking_at_a_steady_speed_is_no_hanging() -> None:
    samples = at_rest(velocity_mps=(0.0, 0.0, -0.2))
    assert not is_supported(history(samples), samples[-1].t_s)


@pytest.mark.parametrize("frozen", [False, True])
def test_an_attitude_that_stands_still_places_nobody(frozen: bool) -> None:
    """A sight that is turned by it would lead the vehicle astray."""
    sights, sent = hung()
    pose = MarkerPose(
        source="large", t_s=1.45, rvec_rad=np.zeros(3), tvec_m=np.array([0.0, 0.0, 1.0]),
        e_m=np.array([0.0, 0.0, 1.0]), e_yaw_rad=0.0, sigma_m=np.full(3, 1e-3), sigma_yaw_rad=1e-3,
        rms_reprojection_px=0.1,
    )  # fmt: skip
    samples = [
        telemetry(1.0 + SAMPLE_S * i, 1.0, **({"roll_rad": 0.1} if frozen and i else {}))
        for i in range(50)
    ]
    sights.add_pose(pose, history(samples), 1.5)
    assert bool(sent) is not frozen


@pytest.mark.parametrize("age_s", [0.15, 2.0])
def test_old_samples_prove_nothing(age_s: float) -> None:
    samples = at_rest()
    assert is_supported(history(samples), samples[-1].t_s)
    assert not is_supported(history(samples), samples[-1].t_s + age_s)
    assert not is_supported(History(), 1.0)


@pytest.mark.parametrize("sends", [True, False])
def test_without_sights_to_send_the_target_is_where_it_is_seen(
    monkeypatch: pytest.MonkeyPatch, sends: bool
) -> None:
    """The estimate runs away by then: by it what hangs would be seen far below its target."""
    nobody: Any = None
    inputs = FlightInputs(nobody, nobody, PIPELINE, TARGET_ONLY)
    assert inputs.target_positioning is not None
    inputs.target_positioning.feed.target = TARGET
    drifted = [replace(sample, position_m=(0.0, 0.0, 1.2)) for sample in at_rest()]
    inputs.perception.history, inputs.sends_sights = history(drifted), sends
    now_s = inputs.last_good_frame_s = drifted[-1].t_s
    seen = target_at(now_s, (0.0, 0.0, 2.0), (0.0, 0.0, 1.95))
    monkeypatch.setattr("perchctl.perception.perception.estimate", lambda *_, **__: seen)
    target = inputs.target(now_s)
    assert target is not None
    assert bool(abs(target.e_m[2] - seen.e_m[2]) > 0.5) is sends
