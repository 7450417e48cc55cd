"""When the camera, the estimate or the target jumps: no claim is false for long, and the target is
soon tracked again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, make_T, rot_z, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.vision import MARKERS, Pipeline, PipelineState, VehicleState
from perchctl.vision.pipeline import step_from_detections
from perchctl.vision.tracks import MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S
from tests.helpers.seen import seen_from

Build = Callable[..., Pipeline]
TARGET_M = np.array([0.1, -0.05, 2.0])
BEFORE_S, AFTER_S = 0.6, 0.8
NEAREST_M = 0.1
FALSE_SIGMAS, FALSE_M = 6.0, 0.003
"""An error beyond both is a false claim."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera that approaches the target at `speed_mps` and stops as something jumps by `jump_m`:
    the camera (`jumps` is ``camera``), the state estimate, or the target, for good or for one
    frame (``frame``)."""

    jumps: str
    jump_m: Array
    hz: float
    range_m: float
    speed_mps: float
    markers: tuple[str, ...]
    sigma_px: float
    silent_s: float = 0.0  # without frames, before the jump


@dataclass(frozen=True, eq=False)
class Claim:
    """A frame's error and spread, each (3,), `after_s` the jump; both None without a target."""

    after_s: float
    measured: bool
    off_m: Array | None = None
    sigma_m: Array | None = None

    @property
    def is_false(self) -> bool:
        if self.off_m is None or self.sigma_m is None:
            return False
        off_m = np.abs(self.off_m)
        return bool(((off_m > FALSE_SIGMAS * self.sigma_m) & (off_m > FALSE_M)).any())


ASIDE_M = st.floats(-0.2, 0.2)  # farther aside a marker leaves the picture
JUMPS_M = st.tuples(ASIDE_M, ASIDE_M, st.floats(-0.5, 0.5))


@st.composite
def scenes(
    draw: st.DrawFn, jumps: str, jumps_m: st.SearchStrategy[tuple[float, ...]] = JUMPS_M
) -> Scene:
    markers = MARKERS[: draw(st.sampled_from([1, 2]))]
    return Scene(
        jumps=jumps,
        jump_m=np.array(draw(jumps_m)),
        hz=draw(st.sampled_from([10.0, 15.0, 25.0, 30.0, 60.0])),
        range_m=draw(st.floats(0.3, 0.5 if len(markers) == 2 else 1.2)),
        speed_mps=draw(st.floats(0.0, 0.5)),
        markers=markers,
        sigma_px=draw(st.sampled_from([0.05, 0.1, 0.3])),
    )


def claims(setup: Pipeline, scene: Scene, in_flight: bool) -> list[Claim]:
    """What the pipeline tells from the jump on; nothing if a marker leaves the picture."""
    state, rng, told = PipelineState(), np.random.default_rng(7), []
    before = round(BEFORE_S * scene.hz)
    for k in range(before + round(AFTER_S * scene.hz)):
        t_s = k / scene.hz
        after_s = t_s - before / scene.hz
        if after_s >= 0.0:
            t_s += scene.silent_s
        sway = 0.02 * np.array([np.sin(2.0 * t_s), np.cos(3.0 * t_s), 0.0])
        below_m = scene.range_m - scene.speed_mps * min(after_s, 0.0)
        camera_m, target_m = TARGET_M + sway - [0.0, 0.0, below_m], TARGET_M
        shown_m, estimate_m = TARGET_M, np.zeros(3)
        if after_s >= 0.0:
            if scene.jumps == "camera":
                camera_m = camera_m + scene.jump_m
            elif scene.jumps == "estimate":
                estimate_m = scene.jump_m
            elif scene.jumps == "target":
                target_m = shown_m = TARGET_M + scene.jump_m
            elif k == before:
                shown_m = TARGET_M + scene.jump_m
        roll, yaw = 0.02 * np.sin(2.0 * t_s), 0.1 * np.sin(t_s)
        T = make_T(rotation_from_rpy(roll, 0.0, yaw), camera_m)
        x, y, z = camera_m + estimate_m
        attitude = VehicleState(t_s, roll, 0.0, yaw, (x, y, z)) if in_flight else None
        seen = seen_from(T, shown_m, t_s, rng, markers=scene.markers, sigma_px=scene.sigma_px)
        if len(seen.markers) < len(scene.markers) or shown_m[2] - camera_m[2] < NEAREST_M:
            return []
        state, output = step_from_detections(state, seen, attitude, setup)
        if k < before:
            continue
        found = output.target
        if found is None:
            told.append(Claim(after_s, measured=False))
            continue
        e_m = (rot_z(-yaw) if in_flight else T[:3, :3].T) @ (target_m - camera_m)
        told.append(
            Claim(after_s, found.is_measured_in_newest_frame, found.e_m - e_m, found.sigma_m)
        )
    return told


def longest_false_s(told: list[Claim], hz: float) -> float:
    """The duration of the longest run of false claims."""
    longest = run = 0
    for claim in told:
        run = run + 1 if claim.is_false else 0
        longest = max(longest, run)
    return longest / hz


def lost(hz: float, range_m: float, *jump_m: float) -> Scene:
    """Frames lost at a speed of 0.3 m/s."""
    return Scene("camera", np.array(jump_m), hz, range_m, 0.3, ("large",), 0.1)


def wrong(hz: float, range_m: float, *jump_m: float) -> Scene:
    """One wrong frame of an approach at 0.4 m/s."""
    return Scene("frame", np.array(jump_m), hz, range_m, 0.4, ("large",), 0.1)


@settings(max_examples=10, deadline=None)
@given(scene=scenes("camera"))
# Jumps that the gate just lets pass.
@example(scene=lost(25.0, 0.6, 0.11, 0.0, 0.0))
@example(scene=lost(25.0, 0.6, 0.0, 0.0, 0.105))
@example(scene=lost(30.0, 1.0, 0.0, 0.125, 0.0))
@example(scene=lost(60.0, 0.6, 0.09, 0.0, 0.0))
def test_lost_frames_leave_no_false_claim_and_the_target_is_back_within_half_a_second(
    build: Build, scene: Scene
) -> None:
    """Of a recording at a constant rate, where lost frames are a jump of the camera."""
    told = claims(build(), scene, in_flight=False)
    assume(told)
    assert not any(claim.is_false for claim in told)
    assert all(claim.measured for claim in told if claim.after_s >= 0.5 - 1e-6)
    # No prediction runs away: it coasts, ever more slowly, at the speed before the jump.
    most_m = np.linalg.norm(scene.jump_m) + 6.0 * scene.speed_mps / scene.hz + 0.02
    assert all(np.linalg.norm(c.off_m) < most_m for c in told if c.off_m is not None)


@settings(max_examples=10, deadline=None)
@given(scene=scenes("frame"), in_flight=st.booleans())
# At 10 Hz a wrong pose that the gate just lets pass looks like a movement.
@example(scene=wrong(10.0, 1.0, -0.024, -0.07, -0.07), in_flight=False)
@example(scene=wrong(10.0, 0.9, 0.05, -0.05, 0.1), in_flight=False)
def test_one_wrong_frame_drags_no_track_away(build: Build, scene: Scene, in_flight: bool) -> None:
    told = claims(build(), scene, in_flight)
    assume(told)
    assert longest_false_s(told[0 if in_flight else 1 :], scene.hz) <= (0.1 if in_flight else 0.0)
    assert all(claim.measured for claim in told[1:])
    assert all(np.linalg.norm(c.off_m) < 0.02 for c in told[1:] if c.off_m is not None)


@pytest.mark.parametrize(("hz", "away_m"), [(10.0, 0.3), (15.0, 0.22), (25.0, 0.18)])
def test_no_vaguer_track_excuses_a_jump(build: Build, hz: float, away_m: float) -> None:
    """The track before its last pose, predicted for longer, has a wider gate."""
    jump_m = away_m * np.array([0.5, 0.866, 0.0])
    told = claims(build(), Scene("target", jump_m, hz, 1.0, 0.4, ("large",), 0.1), in_flight=False)
    assert not any(
        claim.measured
        for claim in told
        if claim.after_s < MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S
    )


@settings(max_examples=10, deadline=None)
@given(scene=scenes("estimate", st.tuples(*[st.floats(-1.0, 1.0)] * 3)))
def test_an_estimate_that_jumps_leaves_the_target_where_the_picture_has_it(
    build: Build, scene: Scene
) -> None:
    told = claims(build(), scene, in_flight=True)
    assume(told)
    assert all(claim.measured for claim in told)
    assert longest_false_s(told, scene.hz) <= 0.1


@settings(max_examples=10, deadline=None)
@given(scene=scenes("target"))
def test_a_target_that_moves_in_flight_is_nowhere_with_confidence(
    build: Build, scene: Scene
) -> None:
    """Whether it moved or another one is seen takes `MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S` to
    decide."""
    told = claims(build(), scene, in_flight=True)
    assume(told)
    assert longest_false_s(told, scene.hz) <= 0.1


@settings(max_examples=8, deadline=None)
@given(scene=scenes("camera"), silent_s=st.floats(0.1, 0.9))
def test_a_camera_that_skips_in_flight_has_the_target_at_once(
    build: Build, scene: Scene, silent_s: float
) -> None:
    """Its frames bear the time of their arrival, and the vehicle knows how far it flew."""
    skipping = Scene(**{**vars(scene), "silent_s": silent_s})
    told = claims(build(), skipping, in_flight=True)
    assume(told)
    assert all(claim.measured for claim in told)
    assert not any(claim.is_false for claim in told)


@pytest.mark.parametrize(
    "jump_m",
    [
        pytest.param((0.0, 0.0, 0.03), marks=pytest.mark.long),
        (0.06, 0.0, 0.09),
        pytest.param((0.1, 0.05, -0.2), marks=pytest.mark.long),
    ],
)
def test_the_spread_after_lost_frames_is_true(
    build: Build, jump_m: tuple[float, float, float]
) -> None:
    """The mean squared error in units of the claimed spread, once the target is tracked again."""
    target = TargetConfig(size_sigma=0.0, curl_per_m=0.0)  # of a print that is as it should be
    setup, squared = build(target=target), []
    for hz in (10.0, 25.0, 60.0):
        for sigma_px in (0.05, 0.1, 0.3):
            scene = Scene("camera", np.array(jump_m), hz, 0.45, 0.3, MARKERS, sigma_px)
            told = claims(setup, scene, in_flight=False)
            again = [
                claim
                for claim in told
                if claim.after_s > MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S + 2.0 / hz
            ]
            squared += [((c.off_m / c.sigma_m) ** 2).mean() for c in again if c.measured]
    assert len(squared) > 100
    assert 0.5 < np.mean(squared) < 2.0
