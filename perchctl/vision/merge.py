"""Merging the two markers into the one pose of the target (paper, section II-A.2)."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array, circular_mean
from perchctl.profile import MergeConfig, WeightsConfig
from perchctl.vision.types import MarkerPose, Stage


def stage_of(large: bool, small: bool) -> Stage:
    """The stage by what is there."""
    if large:
        return Stage.BOTH if small else Stage.LARGE
    return Stage.SMALL if small else Stage.NONE


def stage_by_range(z_m: float, config: MergeConfig) -> Stage:
    """Equations 4, 6 and 11, with the distance from the camera to the target's plane;
    beyond z1 the large marker is all that could be seen."""
    if z_m > config.z2_m:
        return Stage.LARGE
    return Stage.BOTH if z_m > config.z3_m else Stage.SMALL


def choose_stage(large: bool, small: bool, z_m: float | None, config: MergeConfig) -> Stage:
    """What to merge: all that is there, or (`merge.stages: range`) what the distance
    asks for, as far as it is there."""
    there = stage_of(large, small)
    if config.stages == "seen" or there is not Stage.BOTH or z_m is None:
        return there
    return stage_by_range(z_m, config)


def weight_matrix(weights: WeightsConfig) -> Array:
    """W of equation 9, (4, 8), for the vector of equation 7."""
    W = np.zeros((4, 8))
    for row, w in enumerate((weights.x, weights.y, weights.z, weights.yaw)):
        W[row, 2 * row : 2 * row + 2] = w, 1.0 - w
    return W


def merge_pair(large: Array, small: Array, weights: WeightsConfig) -> Array:
    """Equation 8 for (x, y, z, yaw) of both markers, each (4,); yaw on the circle."""
    W = weight_matrix(weights)
    merged = W @ np.stack([large, small], axis=1).ravel()
    merged[3] = circular_mean(W[3, 6:8], np.array([large[3], small[3]]))
    return np.asarray(merged)


def merge_variance(large: Array, small: Array, weights: WeightsConfig) -> Array:
    """Variances (4,) of `merge_pair` for markers with independent errors."""
    W = weight_matrix(weights)
    return np.asarray(W**2 @ np.stack([large, small], axis=1).ravel())


def disagree(large: MarkerPose, small: MarkerPose, limit_m: float) -> bool:
    """Whether the markers contradict: farther apart than the limit and than four
    standard deviations, in any axis (a far small marker is merely vague). What is
    wrong with the print moves both alike, and excuses no gap."""
    gap = np.abs(large.e_m - small.e_m)
    variance = [np.maximum(p.sigma_m**2 - (p.print_m**2).sum(axis=1), 0.0) for p in (large, small)]
    vague = 4.0 * np.sqrt(variance[0] + variance[1])
    return bool((gap > np.maximum(limit_m, vague)).any())


def better_conditioned(large: MarkerPose, small: MarkerPose) -> MarkerPose:
    """The better-conditioned of the two, by the spread of its position."""
    spread_large, spread_small = (float(np.linalg.norm(p.sigma_m)) for p in (large, small))
    return small if spread_small < spread_large else large
