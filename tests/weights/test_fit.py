"""The arithmetic: known optima, LMS against the closed form, the circle, the robust rule."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.weights import fit
from perchctl.weights.data import Measurements
from tests.helpers.weights_data import BEST, independent, known, measured


def fitted(data: Measurements) -> np.ndarray:
    return fit.closed_form_weights(fit.marker_errors(data).sums.sum(axis=1))


def test_the_closed_form_finds_the_known_weights() -> None:
    for seed in range(5):
        assert np.abs(fitted(known(seed)) - BEST).max() < 0.005


def test_it_is_the_regression_that_numpy_finds() -> None:
    data = independent(3)
    errors = fit.marker_errors(data)
    for k in range(4):
        d = errors.large[:, k] - errors.small[:, k]
        design = np.column_stack([d, np.ones_like(d)])
        slope = np.linalg.lstsq(design, -errors.small[:, k], rcond=None)[0][0]
        assert fitted(data)[k] == pytest.approx(slope, abs=1e-9)


@settings(max_examples=8, deadline=None)
@given(start=st.floats(0.0, 1.0), seed=st.integers(0, 50), best=st.floats(0.05, 0.95))
def test_lms_ends_at_the_closed_form_from_any_start(start: float, seed: int, best: float) -> None:
    for data in (known(seed, np.full(4, best)), independent(seed)):
        weights, _ = fit.lms_weights(fit.marker_errors(data), start)
        assert np.abs(weights - fitted(data)).max() < 0.01


def test_lms_without_a_position_is_lms_of_the_others() -> None:
    data = independent(10, positions=5)
    rest = data.position != 1
    errors = (data.large - data.actual)[rest], (data.small - data.actual)[rest]
    others = measured(data.position[rest], data.actual[rest], *errors)
    held_out = fit.lms_weights(fit.marker_errors(data))[1][0]
    assert np.abs(held_out - fitted(others)).max() < 0.003
    assert np.abs(held_out - fitted(data)).max() > 0.006


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 100), turn=st.floats(-math.pi, math.pi))
def test_turned_data_give_the_same_weights(seed: int, turn: float) -> None:
    plain, turned = known(seed), known(seed, turn_rad=turn)
    assert np.abs(fitted(plain) - fitted(turned)).max() < 1e-8


def test_data_astride_the_seam_give_the_weights_of_data_turned_by_90_degrees() -> None:
    data = independent(6)
    rng = np.random.default_rng(1)
    data.actual[:, 3] = np.where(data.position % 2 == 0, math.pi - 1e-3, -math.pi + 1e-3)
    errors_a = rng.normal(0, [1e-3, 1e-3, 1e-3, 0.02], (len(data), 4))
    errors_b = rng.normal(0, [0, 0, 0, 0.03], (len(data), 4))
    here = measured(data.position, data.actual, errors_a, errors_b)
    there = measured(data.position, data.actual, errors_a, errors_b, math.pi / 2)
    astride = np.abs(here.large[:, 3] - here.actual[:, 3]) > math.pi
    assert astride.sum() > 100  # the plain difference would be a turn off
    assert np.abs(fitted(here) - fitted(there)).max() < 1e-9
    assert fitted(here)[3] == pytest.approx(0.03**2 / (0.02**2 + 0.03**2), abs=0.05)


def test_outliers_are_left_out_and_counted() -> None:
    clean, spoilt = independent(7), independent(7)
    spoilt.large[::97, 2] += 0.05
    assert fit.marker_errors(clean).is_inlier.all()
    out = ~fit.marker_errors(spoilt).is_inlier
    assert out.sum(axis=0).tolist() == [0, 0, len(spoilt.large[::97]), 0]
    assert abs(fitted(spoilt)[2] - fitted(clean)[2]) < 0.01


def test_a_constant_offset_moves_no_weight() -> None:
    plain, offset = independent(8), independent(8)
    offset.large[:, :3] += [0.004, -0.002, 0.01]
    assert np.abs(fitted(plain) - fitted(offset)).max() < 1e-6


def judged(errors: fit.MarkerErrors) -> tuple[dict[str, fit.FittedWeights], fit.Evidence]:
    fits = fit.fit_by_each_method(errors)
    return fits, fit.evaluate_weights(
        errors, {name: each.fold_weights for name, each in fits.items()}
    )


def test_evidence_holds_whole_positions_out() -> None:
    data = independent(10, positions=12)
    errors = fit.marker_errors(data)
    fits, found = judged(errors)
    rest = data.position != errors.positions[0]
    apart = (data.large - data.actual)[rest], (data.small - data.actual)[rest]
    others = measured(data.position[rest], data.actual[rest], *apart)
    assert np.abs(fits["closed_form"].fold_weights[0] - fitted(others)).max() < 1e-9
    assert found.better_marker.tolist()[0] == 0  # x: the large marker is twice as good
    assert found.better_marker.tolist()[2:] == [1, 1]
    assert all(found.is_proven_better(name).all() for name in fit.FITTED)
    gain, half = found.rms_gain("closed_form", found.squares["paper"])
    assert (np.abs(gain) + half > 0.0).all()


def test_a_useless_marker_leaves_nothing_to_prove() -> None:
    _, found = judged(fit.marker_errors(independent(11, small=(0.5, 0.5, 0.5, 0.5))))
    assert not found.is_proven_better("closed_form").any()


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    """Of the weights, and of the RMS error, whose truth is known: 0.8 of the variance."""
    inside = []
    for seed in range(40):
        errors = fit.marker_errors(independent(seed, per=30))
        fits, found = judged(errors)
        closed = fits["closed_form"]
        inside += (np.abs(closed.raw_weights - [0.8, 0.5, 0.2, 0.2]) < closed.half_width).tolist()
        rms, half = found.rms("large")
        inside += (np.abs(rms - [1e-3, 1e-3, 2e-3, 0.02]) < half).tolist()
    assert 0.88 < np.mean(inside) < 0.995
