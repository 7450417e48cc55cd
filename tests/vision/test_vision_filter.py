from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import wrap_rad
from perchctl.profile import KalmanConfig
from perchctl.vision.filter import (
    MAX_PREDICTION_S,
    MEASURED,
    POSITION,
    RATES,
    VELOCITY,
    VX,
    VY,
    VZ,
    YAW,
    YAW_RATE,
    Measurement,
    X,
    Y,
    Z,
    foreseen,
    make_filter,
    predict_track,
    start_track,
    step_track,
    transition,
)
from perchctl.vision.types import MarkerTrack

CONFIG = KalmanConfig(noise="fixed")
SETUP = make_filter(CONFIG)
H = np.eye(8)[MEASURED]


def test_state_order_is_the_papers() -> None:
    assert tuple(range(8)) == (YAW, YAW_RATE, X, VX, Y, VY, Z, VZ)
    F = np.eye(8)
    for i in (0, 2, 4, 6):
        F[i, i + 1] = 0.04
    assert np.array_equal(transition(0.04), F)  # equation 1
    expected = np.zeros((4, 8))
    for row, i in enumerate((0, 2, 4, 6)):
        expected[row, i] = 1.0
    assert np.array_equal(H, expected)  # equation 2


def test_gains_are_the_papers_units_in_si() -> None:
    setup = make_filter(KalmanConfig(k1=0.09, k2=0.01, noise="fixed"))
    assert np.allclose(np.sqrt(np.diag(setup.R)), [math.radians(0.3), 0.003, 0.003, 0.003])
    assert np.allclose(np.sqrt(np.diag(setup.Q))[[X, VX, YAW]], [0.001, 0.001, math.radians(0.1)])
    assert np.count_nonzero(setup.R - np.diag(np.diag(setup.R))) == 0
    assert np.count_nonzero(setup.Q - np.diag(np.diag(setup.Q))) == 0


steps = st.lists(
    st.tuples(
        st.floats(0.005, 0.2),  # dt
        st.booleans(),  # seen
        st.tuples(*[st.floats(-0.5, 0.5)] * 4),
    ),
    min_size=1,
    max_size=25,
)


@given(steps=steps, k1=st.floats(0.001, 1.0), k2=st.floats(0.0001, 0.1))
@settings(max_examples=60, deadline=None)
def test_equals_a_filter_written_out_by_hand(steps, k1: float, k2: float) -> None:  # type: ignore[no-untyped-def]
    setup = make_filter(KalmanConfig(k1=k1, k2=k2, n_max=100, alpha=0.85, noise="fixed"))
    z0 = np.array([0.1, 0.2, -0.1, 0.5])
    track: MarkerTrack | None = start_track(Measurement(z0), 0.0, setup)
    x, P, t = np.zeros(8), setup.P0.copy(), 0.0
    x[[0, 2, 4, 6]] = z0
    for dt, was_seen, z in steps:
        t += dt
        track = step_track(track, Measurement(np.array(z)) if was_seen else None, t, setup)
        F = np.eye(8)
        F[[0, 2, 4, 6], [1, 3, 5, 7]] = t - (t - dt)
        if not was_seen:
            x[[1, 3, 5, 7]] *= 0.85
        x = F @ x
        P = F @ P @ F.T + setup.Q
        if was_seen:
            S = H @ P @ H.T + setup.R
            K = np.linalg.solve(S, H @ P).T
            innovation = np.array(z) - H @ x
            innovation[0] = wrap_rad(float(innovation[0]))
            x = x + K @ innovation
            P = (np.eye(8) - K @ H) @ P
        assert track is not None
        difference = track.x - x
        difference[YAW] = wrap_rad(float(difference[YAW]))
        assert np.abs(difference).max() < 1e-7
        assert np.abs(track.P - P).max() < 1e-9


@given(start=st.floats(-math.pi, math.pi), rate=st.floats(-2.0, 2.0))
@settings(max_examples=40, deadline=None)
def test_yaw_follows_across_the_wrap(start: float, rate: float) -> None:
    track = None
    for k in range(40):
        yaw = wrap_rad(start + rate * k / 30)
        track = step_track(track, Measurement(np.array([yaw, 0.0, 0.0, 0.5])), k / 30, SETUP)
    assert track is not None
    assert -math.pi < track.x[YAW] <= math.pi
    assert abs(wrap_rad(float(track.x[YAW]) - yaw)) < 0.15
    assert track.x[YAW_RATE] == pytest.approx(rate, abs=0.4)


def test_velocities_decay_and_the_track_is_dropped_after_n_max() -> None:
    track: MarkerTrack | None = MarkerTrack(0.0, np.arange(8) / 10.0, np.eye(8) * 1e-4, 0)
    assert track is not None
    rates, position = track.x[RATES].copy(), track.x[POSITION].copy()
    for n in range(1, CONFIG.n_max + 1):
        track = step_track(track, None, n / 30, SETUP)
        assert track is not None
        assert track.unseen == n
        assert np.allclose(track.x[RATES], rates * CONFIG.alpha**n)
        position = position + track.x[VELOCITY] / 30
        assert np.allclose(track.x[POSITION], position)
    assert step_track(track, None, (CONFIG.n_max + 1) / 30, SETUP) is None
    again = step_track(
        track, Measurement(np.array([0.0, 1.0, 2.0, 3.0])), (CONFIG.n_max + 1) / 30, SETUP
    )
    assert again is not None
    assert again.unseen == 0


def test_n_max_zero_does_not_coast() -> None:
    setup = make_filter(KalmanConfig(n_max=0))
    track = step_track(None, Measurement(np.zeros(4)), 0.0, setup)
    assert step_track(track, None, 0.03, setup) is None


def test_the_first_measurement_is_the_state() -> None:
    track = step_track(None, Measurement(np.array([0.3, 0.01, -0.02, 0.7])), 5.0, SETUP)
    assert track is not None
    assert np.allclose(track.x, [0.3, 0, 0.01, 0, -0.02, 0, 0.7, 0])
    assert step_track(None, None, 5.0, SETUP) is None


def test_real_time_steps_are_used() -> None:
    track = None
    for t in (0.0, 0.03, 0.07, 0.10, 0.25, 0.28, 0.31, 0.33, 0.47, 0.5, 0.55, 0.6, 0.7, 0.8):
        track = step_track(track, Measurement(np.array([0.0, 0.3 * t, 0.0, 0.5])), t, SETUP)
    assert track is not None
    assert track.x[VX] == pytest.approx(0.3, abs=0.03)
    assert track.x[X] == pytest.approx(0.24, abs=0.004)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_measurement_that_is_not_finite_counts_as_unseen(bad: float) -> None:
    start = start_track(Measurement(np.zeros(4)), 0.0, SETUP)
    track = step_track(start, Measurement(np.array([0.0, bad, 0.0, 0.5])), 0.03, SETUP)
    assert track is not None
    assert track.unseen == 1
    assert np.isfinite(track.x).all()
    assert step_track(None, Measurement(np.array([bad, 0, 0, 0])), 0.0, SETUP) is None


@pytest.mark.parametrize("t_s", [0.0, -0.5, math.nan])
def test_a_frame_that_is_not_newer_changes_nothing(t_s: float) -> None:
    start = start_track(Measurement(np.array([0.1, 0.2, 0.3, 0.4])), 0.0, SETUP)
    assert step_track(start, Measurement(np.ones(4)), t_s, SETUP) is start
    assert step_track(start, None, t_s, SETUP) is start


@pytest.mark.parametrize("t_s", [1.5, -1.5])
def test_a_long_gap_starts_afresh(t_s: float) -> None:
    start = start_track(Measurement(np.array([0.1, 0.2, 0.3, 0.4])), 0.0, SETUP)
    track = step_track(start, Measurement(np.ones(4)), t_s, SETUP)
    assert track is not None
    assert np.allclose(track.x[[YAW, X, Y, Z]], 1.0)
    assert np.array_equal(track.P, SETUP.P0)
    assert step_track(start, None, t_s, SETUP) is None


def test_the_old_track_is_not_written_to() -> None:
    start = start_track(Measurement(np.array([0.1, 0.2, 0.3, 0.4])), 0.0, SETUP)
    x, P = start.x.copy(), start.P.copy()
    step_track(start, Measurement(np.ones(4)), 0.03, SETUP)
    step_track(start, None, 0.03, SETUP)
    assert np.array_equal(start.x, x)
    assert np.array_equal(start.P, P)


WORLD = make_filter(CONFIG, in_world=True)


@given(
    velocity_mps=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    later_s=st.floats(-1.0, 30.0),
    coasting=st.booleans(),
)
def test_what_is_not_measured_drifts_at_most(
    velocity_mps: tuple[float, float, float], later_s: float, coasting: bool
) -> None:
    """A target stands still: ahead of its last frame it moves by the estimate's drift, and
    for a second at most."""
    x = np.zeros(8)
    x[VELOCITY] = velocity_mps
    track = MarkerTrack(t_s=10.0, x=x, P=np.eye(8) * 1e-4)
    if coasting:
        found = step_track(track, None, 10.0 + max(min(later_s, 0.9), 0.01), WORLD)
    else:
        found = predict_track(track, 10.0 + later_s, WORLD)
    assert found is not None
    moved_m = float(np.linalg.norm(found.x[POSITION]))
    assert moved_m <= WORLD.drift_mps * min(max(later_s, 0.01), MAX_PREDICTION_S) + 1e-12
    assert (np.diag(found.P)[POSITION] >= 1e-4 - 1e-12).all()
    if later_s <= 0.0 and not coasting:
        assert found is track


@settings(max_examples=60)
@given(
    seed=st.integers(0, 9999),
    later_s=st.floats(-0.5, 3.0),
    kind=st.sampled_from(["world", "level", "paper", "paper world"]),
)
def test_what_is_foreseen_is_what_is_predicted_and_measured(
    seed: int, later_s: float, kind: str
) -> None:
    """All of it: by the state's, the covariance's and the constant errors' measured parts."""
    config = CONFIG if kind.startswith("paper") else KalmanConfig()
    setup = make_filter(config, in_world=kind.endswith("world"))
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(8, 8))
    track = MarkerTrack(
        t_s=1.0, x=rng.normal(0.0, 0.5, 8), P=half @ half.T, bias=rng.normal(size=(8, 4))
    )
    wanted, found = (
        predict_track(track, 1.0 + later_s, setup),
        foreseen(track, 1.0 + later_s, setup),
    )
    bare = predict_track(track, 1.0 + later_s, setup, spread=False)
    assert np.array_equal(bare.x, wanted.x)
    assert bare.t_s == wanted.t_s
    assert found.R is not None
    assert found.bias is not None
    assert np.allclose(found.z, H @ wanted.x)
    assert np.allclose(found.R, H @ wanted.P @ H.T)
    assert np.allclose(found.bias, H @ wanted.bias)


def test_a_measured_velocity_is_free() -> None:
    """The limit is for prediction; the filter itself follows what it measures."""
    track = None
    for k in range(60):
        z = np.array([0.0, 0.3 * k / 30.0, 0.0, 0.0])
        track = step_track(track, Measurement(z), k / 30.0, WORLD)
    assert track is not None
    assert track.x[VX] > 0.2
