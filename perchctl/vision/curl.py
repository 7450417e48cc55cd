"""A sheet that is not flat: what its curl does to corners, and what they are worth then.

Corners that curl has moved err together, and those far from the centre err most: a joint pose of
both markers rests on the small one as far as the large one may be off.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from perchctl.geometry import Array


def lift_of(object_m: Array, curl_per_m: float) -> Array:
    """How far corners (n, 3) are out of the sheet's plane at one standard deviation of each kind
    of curl, (2n, 2) m, for x and y of each: the whole rim to one side, or two corners of it to
    one and two to the other. A sheet rolled about any axis is as much of one as of the other."""
    x, y = object_m[:, 0], object_m[:, 1]
    lift: Array = curl_per_m * np.stack([x * x + y * y, math.sqrt(2.0) * x * y], axis=1)
    return lift.repeat(2, axis=0)


def moved_by(lift: Array, rvec: Array, jacobian: Array) -> Array:
    """By how much `lift` moves the corners in the picture, (2n, 2), where a change of (rvec,
    tvec) moves them by `jacobian` (2n, 6)."""
    normal_cam = cv2.Rodrigues(rvec)[0][:, 2]
    # A corner out of the sheet's plane is where a target moved along its normal would have it.
    moved: Array = jacobian[:, 3:].dot(normal_cam)[:, None] * lift
    return moved


def weight_with(curl: Array) -> Array:
    """The inverse covariance (2n, 2n) of errors of unit spread that have `curl` (2n, k), one
    standard deviation each, among them."""
    inner = np.linalg.inv(np.eye(curl.shape[1]) + curl.T @ curl)
    weight: Array = np.eye(len(curl)) - curl @ inner @ curl.T
    return weight
