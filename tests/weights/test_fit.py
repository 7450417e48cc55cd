"""The arithmetic: known optima, LMS against the closed form, the circle, the robust rule."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.weights import fit
from tests.helpers.weights_data import BEST, independent, known, measured


def fitted(data: object) -> np.ndarray:
    errors = fit.errors_of(data)  # type: ignore[arg-type]
    return fit.closed_form(fit.sums_of(errors).sum(axis=1))


def test_the_closed_form_finds_the_known_weights() -> None:
    for seed in range(5):
        assert np.abs(fitted(known(seed)) - BEST).max() < 0.005


def test_it_is_the_regression_that_numpy_finds() -> None:
    data = independent(3)
    errors = fit.errors_of(data)
    for k in range(4):
        d = errors.large[:, k] - errors.small[:, k]
        design = np.column_stack([d, np.ones_like(d)])
        slope = np.linalg.lstsq(design, -errors.small[:, k], rcond=None)[0][0]
        assert fitted(data)[k] == pytest.approx(slope, abs=1e-9)


def test_independent_errors_are_weighted_by_inverse_variance() -> None:
    sums = fit.sums_of(fit.errors_of(independent(1, positions=50, per=400))).sum(axis=1)
    assert np.abs(fit.inverse_variance(sums) - [0.8, 0.5, 0.2, 0.2]).max() < 0.01
    assert np.abs(fit.closed_form(sums) - fit.inverse_variance(sums)).max() < 0.01


@settings(max_examples=25, deadline=None)
@given(
    start=st.floats(0.0, 1.0),
    seed=st.integers(0, 50),
    best=st.floats(0.05, 0.95),
    shuffled=st.booleans(),
)
def test_lms_ends_at_the_closed_form_from_any_start(
    start: float, seed: int, best: float, shuffled: bool
) -> None:
    for data in (known(seed, np.full(4, best)), independent(seed)):
        errors = fit.errors_of(data)
        closed = fit.closed_form(fit.sums_of(errors).sum(axis=1))
        run = fit.lms(errors, fit.LmsOptions(start=start, shuffled=shuffled))
        assert np.abs(run.weights - closed).max() < 0.01


def test_the_pieces_are_the_plain_recursion() -> None:
    rng = np.random.default_rng(2)
    p, q = rng.uniform(0.0, 0.1, (1000, 4)), rng.normal(0.0, 0.1, (1000, 4))
    w = np.full(4, 0.3)
    for row in range(len(p)):
        w = (1.0 - p[row]) * w - q[row]
    assert np.abs(fit._composed(np.full(4, 0.3), p, q)[-1] - w).max() < 1e-12


def test_the_normalised_form_and_a_constant_step_come_close_too() -> None:
    errors = fit.errors_of(independent(4))
    closed = fit.closed_form(fit.sums_of(errors).sum(axis=1))
    for options in (fit.LmsOptions(normalised=True), fit.LmsOptions(step=0.001)):
        assert np.abs(fit.lms(errors, options).weights - closed).max() < 0.03


def test_a_step_too_large_is_caught_and_explained() -> None:
    errors = fit.errors_of(independent(4))
    with pytest.raises(InvalidValue, match=r"LMS diverges in \w+ within .* --step 5 is too large"):
        fit.lms(errors, fit.LmsOptions(step=5.0))


@pytest.mark.parametrize("options", [{"step": 0.0}, {"step": math.nan}, {"passes": 0}])
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    errors = fit.errors_of(independent(4))
    with pytest.raises(InvalidValue, match="--"):
        fit.lms(errors, fit.LmsOptions(**options))  # type: ignore[arg-type]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 100), turn=st.floats(-math.pi, math.pi))
def test_turned_data_give_the_same_weights(seed: int, turn: float) -> None:
    plain, turned = known(seed), known(seed, turn_rad=turn)
    assert np.abs(fitted(plain) - fitted(turned)).max() < 1e-8


def test_data_astride_the_seam_give_the_weights_of_data_turned_by_90_degrees() -> None:
    data = independent(6)
    rng = np.random.default_rng(1)
    data.actual[:, 3] = np.where(data.position % 2 == 0, math.pi - 1e-3, -math.pi + 1e-3)
    a, b = rng.normal(0, 0.02, len(data)), rng.normal(0, 0.03, len(data))
    errors_a, errors_b = np.zeros((len(data), 4)), np.zeros((len(data), 4))
    errors_a[:, 3], errors_b[:, 3] = a, b
    errors_a[:, :3] = rng.normal(0, 1e-3, (len(data), 3))
    here = measured(data.position, data.actual, errors_a, errors_b)
    there = measured(data.position, data.actual, errors_a, errors_b, math.pi / 2)
    astride = np.abs(here.large[:, 3] - here.actual[:, 3]) > math.pi
    assert astride.sum() > 100  # the plain difference would be a turn off
    assert np.abs(fitted(here) - fitted(there)).max() < 1e-9
    assert fitted(here)[3] == pytest.approx(0.03**2 / (0.02**2 + 0.03**2), abs=0.05)


def test_outliers_are_left_out_and_counted() -> None:
    clean, spoilt = independent(7), independent(7)
    spoilt.large[::97, 2] += 0.05
    assert fit.errors_of(clean).outliers.sum() == 0
    errors = fit.errors_of(spoilt)
    assert errors.outliers.tolist() == [0, 0, len(spoilt.large[::97]), 0]
    assert abs(fitted(spoilt)[2] - fitted(clean)[2]) < 0.01


def test_a_constant_offset_is_reported_and_moves_no_weight() -> None:
    plain, offset = independent(8), independent(8)
    offset.large[:, :3] += [0.004, -0.002, 0.01]
    sums = fit.sums_of(fit.errors_of(offset))
    assert np.abs(fitted(plain) - fitted(offset)).max() < 1e-6
    mean, half = fit.biases(sums)["large"]
    assert np.abs(mean[:3] - [0.004, -0.002, 0.01]).max() < 3e-4
    assert (np.abs(mean[:3] - [0.004, -0.002, 0.01]) < 2 * half[:3]).all()


def test_a_mistyped_truth_is_named() -> None:
    data = independent(9)
    data.actual[data.position == 4, 0] += 0.02
    errors = fit.errors_of(data)
    found = fit.odd_positions(errors, fit.sums_of(errors))
    assert [(number, axis) for number, axis, _ in found] == [(4, "x")]


def test_evidence_holds_whole_positions_out() -> None:
    errors = fit.errors_of(independent(10, positions=12))
    sums = fit.sums_of(errors)
    fits, _ = fit.fit_all(errors, sums, fit.LmsOptions())
    keep = errors.positions[0]
    data = independent(10, positions=12)
    rest = measured(
        data.position[data.position != keep],
        data.actual[data.position != keep],
        (data.large - data.actual)[data.position != keep],
        (data.small - data.actual)[data.position != keep],
    )
    without = fit.closed_form(fit.sums_of(fit.errors_of(rest)).sum(axis=1))
    assert np.abs(fits["closed_form"].folds[0] - without).max() < 1e-9
    found = fit.evidence(errors, sums, {name: each.folds for name, each in fits.items()})
    assert found.better.tolist()[0] == 0  # x: the large marker is twice as good
    assert found.better.tolist()[2:] == [1, 1]
    assert all(p.all() for p in found.proven.values())
    over = found.methods["closed_form"].against(found.methods["paper"])
    assert ((over.gain_low < over.gain) & (over.gain < over.gain_high)).all()


def test_a_useless_marker_leaves_nothing_to_prove() -> None:
    errors = fit.errors_of(independent(11, small=(0.5, 0.5, 0.5, 0.5)))
    sums = fit.sums_of(errors)
    fits, _ = fit.fit_all(errors, sums, fit.LmsOptions())
    found = fit.evidence(errors, sums, {name: each.folds for name, each in fits.items()})
    assert not found.proven["closed_form"].any()


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    inside = 0
    for seed in range(60):
        errors = fit.errors_of(independent(seed, per=30))
        sums = fit.sums_of(errors)
        folds = fit.closed_form(fit.held_out(sums))
        spread = np.sqrt(0.9 * ((folds - folds.mean(axis=0)) ** 2).sum(axis=0))
        away = np.abs(fit.closed_form(sums.sum(axis=1)) - [0.8, 0.5, 0.2, 0.2])
        inside += int((away < fit.t_quantile(9) * spread).sum())
    assert 0.88 < inside / 240 < 0.995
