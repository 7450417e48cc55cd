"""Deinterlace the frames of analogue cameras: detect, separate and order their fields. Pure.

An interlaced frame consists of two fields, exposed half a frame period apart. Each field has every
second row. Motion between the fields shows as combing: a row differs from its neighbours. Only
strong differences count, so a small target in a noisy image is enough. The order of the fields
follows from successive frames: the later field of a frame is more similar to the earlier field of
the next one.
"""

from __future__ import annotations

import math
from statistics import mean, median

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.values import replace
from perchctl.vision.types import Frame, InterlacingState

GreyImage = NDArray[np.uint8]

# Minimum ratio of the energy of strong row differences between the two fields to that within the
# fields. Fields displaced by one pixel exceed this ratio.
_MIN_INTER_TO_INTRA_FIELD_ENERGY_RATIO_IF_COMBED = 1.4
# Number of rows per group. All rows of a group, except the outer two at each end, are compared with
# their neighbours.
_ROWS_PER_GROUP_IN_COMBING_CHECK = 8
# A pixel counts if its difference exceeds this multiple of the mean difference within the fields.
_MIN_ROW_DIFFERENCE_TO_MEAN_RATIO_FOR_COMBING_ENERGY = 5.0
_MIN_ROW_DIFFERENCE_FOR_COMBING_ENERGY_GREY = 8.0
# Energy per pixel of strong row differences that noise alone may cause.
_COMBING_NOISE_ENERGY_PER_PIXEL_GREY2 = 0.25
_COMBING_CHECK_INTERVAL_FRAMES = 3
# The position error of a horizontal edge in an interpolated field is the first value times exp(-k
# s^2), where s is the standard deviation of the blur, px, and k the second value.
_INTERPOLATED_EDGE_SIGMA_WITHOUT_BLUR_PX, _INTERPOLATED_EDGE_SIGMA_DECAY_PER_SQUARED_BLUR = (
    0.8,
    2.45,
)
# cubic interpolation at the midpoint
_MISSING_ROW_CUBIC_INTERPOLATION_TAPS = np.array([-1.0, 9.0, 9.0, -1.0], np.float32) / 16.0

_NTSC_AND_PAL_FRAME_PERIODS_S = (1 / 30, 1 / 25)
_FRAME_PERIOD_RANGE_ROUNDED_TO_NTSC_OR_PAL_S = (0.029, 0.045)
_VALID_FRAME_PERIOD_RANGE_S = (0.004, 0.1)
_MAX_STORED_FRAME_PERIODS = 25
_MIN_PERIOD_TO_MEDIAN_RATIO_TO_COUNT_AS_LOST_FRAME = 1.8
# After a longer gap, s, the previous frame says nothing about the field order.
_MAX_FRAME_GAP_TO_VOTE_ON_FIELD_ORDER_S = 0.25
# The votes decide the field order if their sum exceeds this value. Each vote is at most 1, so the
# decision takes at least two frames.
_MIN_VOTE_SUM_TO_DECIDE_FIELD_ORDER = 1.0
# The sum is limited to this value so that a change of the field order is detected soon.
_FIELD_ORDER_VOTE_SUM_CLAMP_MAGNITUDE = 3.0
# A sum above this value reverses an earlier decision.
_MIN_OPPOSITE_VOTE_SUM_TO_REVERSE_FIELD_ORDER = 1.0


def is_combed(image: GreyImage) -> bool:
    """True if the image (h, w) shows interlacing artefacts (combing): its rows differ more from the
    rows of the other field than from those of their own field."""
    groups, width = len(image) // _ROWS_PER_GROUP_IN_COMBING_CHECK, image.shape[1]
    if groups == 0:
        return False
    # Each group of rows is flattened, so the next image row begins `width` elements further on. It
    # is enough to check every third group.
    flat = np.ascontiguousarray(image[: groups * _ROWS_PER_GROUP_IN_COMBING_CHECK]).reshape(
        groups, _ROWS_PER_GROUP_IN_COMBING_CHECK * width
    )[::3]
    above2, above, row, below, below2 = (
        flat[:, k * width : (k + _ROWS_PER_GROUP_IN_COMBING_CHECK - 4) * width] for k in range(5)
    )
    # Compute in place to keep the frame in the processor's cache for the next steps.
    other = cv2.addWeighted(above, 0.5, below, 0.5, 0.0)
    own = cv2.addWeighted(above2, 0.5, below2, 0.5, 0.0)
    cv2.absdiff(row, other, other)
    cv2.absdiff(row, own, own)
    least = max(
        _MIN_ROW_DIFFERENCE_TO_MEAN_RATIO_FOR_COMBING_ENERGY * cv2.mean(own)[0],
        _MIN_ROW_DIFFERENCE_FOR_COMBING_ENERGY_GREY,
    )
    energy = [
        cv2.norm(cv2.threshold(each, least, 0, cv2.THRESH_TOZERO, each)[1], cv2.NORM_L2SQR)
        for each in (other, own)
    ]
    return (
        energy[0] / (energy[1] + _COMBING_NOISE_ENERGY_PER_PIXEL_GREY2 * row.size)
        > _MIN_INTER_TO_INTRA_FIELD_ENERGY_RATIO_IF_COMBED
    )


def deinterlace_image(image: GreyImage) -> tuple[GreyImage, ...]:
    """Return the top and the bottom field, each interpolated to the full size (h, w), if the image
    (h, w) is combed; otherwise return the image alone."""
    if not is_combed(image):
        return (image,)
    return interpolate_field(image, 0), interpolate_field(image, 1)


def interpolate_field(image: GreyImage, first_row: int) -> GreyImage:
    """Return the top field (`first_row` 0: rows 0, 2, ...) or the bottom field (`first_row` 1: rows
    1, 3, ...) of an interlaced image (h, w) at full height. The rows of the other field are
    replaced by a cubic interpolation between the field's own rows."""
    own = image[first_row::2]
    # Row k of the interpolation is between rows k and k + 1 of the field.
    between = cv2.filter2D(
        own,
        -1,
        _MISSING_ROW_CUBIC_INTERPOLATION_TAPS[:, None],
        anchor=(0, 1),
        borderType=cv2.BORDER_REPLICATE,
    )
    result = image.copy()
    if first_row == 0:
        result[1::2] = between[: len(result[1::2])]
    else:
        result[2::2] = between[: len(result[2::2])]
        result[0] = own[0]
    return result


def interpolated_field_edge_sigma_px(blur_sigma_px: float) -> float:
    """Return the standard deviation of the position of a nearly horizontal edge, px, in an
    interpolated field. It is due to aliasing, because a field only has every second row, and
    becomes smaller as the blur grows. `blur_sigma_px` is the standard deviation of the edge's blur,
    px."""
    return _INTERPOLATED_EDGE_SIGMA_WITHOUT_BLUR_PX * math.exp(
        -_INTERPOLATED_EDGE_SIGMA_DECAY_PER_SQUARED_BLUR * blur_sigma_px * blur_sigma_px
    )


def classify_interlacing(frame: Frame) -> Frame:
    """Return the frame with its `picture_kind`: ``woven`` if its odd and even rows were exposed at
    different times (interlaced), or ``whole`` if all rows were exposed together. A kind that is
    already known does not change."""
    if frame.picture_kind is not None:
        return frame
    return replace(frame, picture_kind="woven" if is_combed(frame.image) else "whole")


def interpolate_fields(frame: Frame) -> tuple[Frame, Frame]:
    """Return the top and the bottom field of a woven (interlaced) frame, each interpolated to full
    height. Both have the time of the frame."""
    return (
        replace(
            frame, image=interpolate_field(frame.image, 0), picture_kind="top", source_jpeg=None
        ),
        replace(
            frame, image=interpolate_field(frame.image, 1), picture_kind="bottom", source_jpeg=None
        ),
    )


def deinterlace_frame(
    state: InterlacingState, frame: Frame
) -> tuple[InterlacingState, tuple[Frame, ...]]:
    """Return the new state and the images to process, in time order: the two fields of a woven
    frame if the order of the fields is known, otherwise the frame itself. The fields' times are a
    quarter of the frame period before and after the frame's time.

    The order of the fields follows from successive woven frames: the later field of a frame is more
    similar to the earlier field of the next one. To save time, only every third frame is checked
    for combing until one is found to be interlaced; the others count as whole frames.
    """
    skip = (
        frame.picture_kind is None
        and state.picture_kind == "whole"
        and state.frames_since_combing_check + 1 < _COMBING_CHECK_INTERVAL_FRAMES
    )
    frame = replace(frame, picture_kind="whole") if skip else classify_interlacing(frame)
    skipped = state.frames_since_combing_check + 1 if skip else 0
    # Once a stream has been interlaced, it is treated as interlaced from then on.
    picture_kind = state.picture_kind if state.picture_kind == "woven" else frame.picture_kind
    frame_periods_s = _update_frame_periods_s(state, frame)
    if frame.picture_kind == "whole":
        new = InterlacingState(
            picture_kind,
            skipped,
            state.top_field_first_vote_sum,
            state.is_top_field_first,
            frame_periods_s,
            frame.t_s,
        )
        return new, (frame,)
    state = _vote_on_field_order(
        replace(
            state,
            picture_kind=picture_kind,
            frames_since_combing_check=skipped,
            recent_frame_periods_s=frame_periods_s,
        ),
        frame,
    )
    if frame.picture_kind != "woven" or state.is_top_field_first is None:
        return state, (frame,)
    top, bottom = interpolate_fields(frame)
    early, late = (top, bottom) if state.is_top_field_first else (bottom, top)
    apart_s = _estimate_frame_period_s(state.recent_frame_periods_s) / 2.0
    return state, (
        replace(early, t_s=frame.t_s - apart_s / 2.0),
        replace(late, t_s=frame.t_s + apart_s / 2.0),
    )


def _estimate_frame_period_s(frame_periods_s: tuple[float, ...]) -> float:
    if not frame_periods_s:
        return _NTSC_AND_PAL_FRAME_PERIODS_S[1]
    middle_s = median(frame_periods_s)
    # The receiver's own rate makes the periods vary: at 60 Hz, the frames of a 25 Hz camera arrive
    # 33 and 50 ms apart.
    period_s = mean(
        p
        for p in frame_periods_s
        if p < _MIN_PERIOD_TO_MEDIAN_RATIO_TO_COUNT_AS_LOST_FRAME * middle_s
    )
    if (
        _FRAME_PERIOD_RANGE_ROUNDED_TO_NTSC_OR_PAL_S[0]
        < period_s
        < _FRAME_PERIOD_RANGE_ROUNDED_TO_NTSC_OR_PAL_S[1]
    ):
        return min(_NTSC_AND_PAL_FRAME_PERIODS_S, key=lambda p: abs(p - period_s))
    return period_s


def _update_frame_periods_s(state: InterlacingState, frame: Frame) -> tuple[float, ...]:
    if state.last_frame_t_s is not None:
        gap_s = frame.t_s - state.last_frame_t_s
        if _VALID_FRAME_PERIOD_RANGE_S[0] < gap_s < _VALID_FRAME_PERIOD_RANGE_S[1]:
            return (*state.recent_frame_periods_s[1 - _MAX_STORED_FRAME_PERIODS :], gap_s)
    return state.recent_frame_periods_s


def _vote_on_field_order(state: InterlacingState, frame: Frame) -> InterlacingState:
    before, top_field_first_vote_sum, is_top_field_first = (
        state.previous_image,
        state.top_field_first_vote_sum,
        state.is_top_field_first,
    )
    near = (
        state.last_frame_t_s is not None
        and 0.0 < frame.t_s - state.last_frame_t_s < _MAX_FRAME_GAP_TO_VOTE_ON_FIELD_ORDER_S
    )
    if near and before is not None and before.shape == frame.image.shape:
        rows = (len(before) - 2) // 2 * 2
        tops = [image[0:rows:2] for image in (before, frame.image)]
        bottoms = [image[1 : rows + 1 : 2] for image in (before, frame.image)]
        low = cv2.addWeighted(bottoms[0][:-1], 0.5, bottoms[0][1:], 0.5, 0.0)
        bottom_to_top = cv2.norm(low, tops[1][1:], cv2.NORM_L2SQR)
        high = cv2.addWeighted(tops[0][:-1], 0.5, tops[0][1:], 0.5, 0.0)
        top_to_bottom = cv2.norm(high, bottoms[1][:-1], cv2.NORM_L2SQR)
        vote = (top_to_bottom - bottom_to_top) / max(top_to_bottom + bottom_to_top, 1.0)
        top_field_first_vote_sum = min(
            max(top_field_first_vote_sum + vote, -_FIELD_ORDER_VOTE_SUM_CLAMP_MAGNITUDE),
            _FIELD_ORDER_VOTE_SUM_CLAMP_MAGNITUDE,
        )
    if (
        is_top_field_first is None
        and abs(top_field_first_vote_sum) > _MIN_VOTE_SUM_TO_DECIDE_FIELD_ORDER
    ):
        is_top_field_first = top_field_first_vote_sum > 0.0
    elif (
        is_top_field_first is not None
        and (top_field_first_vote_sum if not is_top_field_first else -top_field_first_vote_sum)
        > _MIN_OPPOSITE_VOTE_SUM_TO_REVERSE_FIELD_ORDER
    ):
        is_top_field_first = not is_top_field_first
    return replace(
        state,
        last_frame_t_s=frame.t_s,
        top_field_first_vote_sum=top_field_first_vote_sum,
        is_top_field_first=is_top_field_first,
        previous_image=frame.image,
    )
