"""Whether a frame can be a measurement at all: frozen, snow, uniform, dark, or the same once more.

Pure: `assess_frame` is ``(state, frame) -> (state, verdict)``. A frame judged bad
gives no measurement; the detector need not search it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.vision import Frame

Kind = Literal["ok", "repeated", "frozen", "snow", "uniform", "dark"]

VERDICT_TEXTS: dict[Kind, str] = {
    "ok": "the picture is usable",
    "repeated": "the same picture as before",
    "frozen": "the picture stands still",
    "snow": "snow: the receiver has no signal",
    "uniform": "an empty screen: the receiver has no signal, or the lens is covered",
    "dark": "the picture is dark",
}


# Grey levels are of 0..255.
FROZEN_AFTER_S = 0.4
"""Time without a change after which repeated is frozen."""
UNIFORM_SIGMA = 1.5
"""Spread below which a picture shows nothing; a blank video screen has below 1, the noise of a
camera alone more than 2."""
DARK_LEVEL = 30.0
"""Mean plus two spreads below which a picture is dark."""
SNOW_SIGMA, SNOW_ROUGHNESS, SNOW_GRAIN = 35.0, 0.7, 0.3
"""Snow has a spread above the first, and lines two rows apart that are as unlike as if unrelated
(1 = unrelated); columns less so, because a receiver's bandwidth smooths along lines."""


@dataclass(frozen=True, eq=False)
class HealthState:
    """Memory of the last picture; `HealthState()` is a fresh start."""

    picture: NDArray[np.uint8] | None = None
    changed_at_s: float = 0.0
    repeats: int = 0


@dataclass(frozen=True)
class HealthVerdict:
    """`repeats`: times in a row that this same picture came again;
    `unchanged_s`: how long ago the picture last changed."""

    kind: Kind
    repeats: int = 0
    unchanged_s: float = 0.0

    @property
    def usable(self) -> bool:
        return self.kind == "ok"

    @property
    def text(self) -> str:
        return VERDICT_TEXTS[self.kind]


def assess_frame(
    state: HealthState, frame: Frame, live: bool = True
) -> tuple[HealthState, HealthVerdict]:
    """Judge one frame.

    A camera's noise makes each live picture differ from the last, so equal bytes
    mean that the receiver or the stream repeats an old one; so does what the source
    has found to be one (`Frame.repeated`), which is never frozen for that alone. In
    recordings (`live` false) equal pictures are taken as they are.
    """
    image = frame.image
    if live and state.picture is not None and same_bytes(state.picture, image):
        state = HealthState(state.picture, state.changed_at_s, state.repeats + 1)
        unchanged_s = frame.t_s - state.changed_at_s
        frozen = unchanged_s >= FROZEN_AFTER_S
        return state, HealthVerdict("frozen" if frozen else "repeated", state.repeats, unchanged_s)
    if live and frame.repeated:
        repeats = state.repeats + 1
        return HealthState(image, state.changed_at_s, repeats), HealthVerdict("repeated", repeats)
    return HealthState(image, frame.t_s, 0), HealthVerdict(content(image))


def content(image: NDArray[np.uint8]) -> Kind:
    """What the picture shows, from every eighth line (and the second after it)."""
    height = image.shape[0]
    first = image[: max(height - 2, 1) : 8]
    mean, sigma = (float(each[0, 0]) for each in cv2.meanStdDev(first))
    if mean + 2.0 * sigma < DARK_LEVEL:
        return "dark"
    if sigma < UNIFORM_SIGMA:
        return "uniform"
    if sigma > SNOW_SIGMA and height > 2:
        below = image[2::8][: len(first)]
        unrelated = 2.0 * sigma**2  # mean square difference of unrelated pixels
        roughness = _mean_square(below, first) / unrelated
        grain = _mean_square(first[:, 2:], first[:, :-2]) / unrelated
        if roughness > SNOW_ROUGHNESS and grain > SNOW_GRAIN:
            return "snow"
    return "ok"


def _mean_square(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Of the pixels' differences."""
    return float(cv2.norm(one, other, cv2.NORM_L2SQR)) / one.size


# --- Pictures that a receiver gives out again because no new one has come ----------------------
# A receiver of 25 pictures a second in a stream of 60 gives each out two or three times. A second
# time is no second measurement, and its time is the first one's.
#
# Most repeat byte for byte. One that was converted to analogue and back in between has the
# converter's own noise on it, and is told by that: the sensor's noise, which differs from picture
# to picture, is the same in both. What two pictures differ by, where they differ least, is then
# far below the noise that each has along its columns. A picture at rest on a rough ceiling can
# look so, too, as can one that wobbles where it turns back, and one of which a codec has left
# nothing but the outlines: it only counts in a stream that shows both kinds by turns, the
# repetitions all equally alike and nothing between the two, and no more than four times in a row.
# A wobble whose period is a whole number of pictures does all of that. What it cannot do is turn
# back so often: a repetition counts only where there are more of them a second than any vehicle's
# wobble has turns, as of 25 or 30 in 60 or 25 in 50. Slower ones, as of 25 in 30, count as new
# pictures, late by one place: that costs less than a picture that is thrown away.
# So nothing but equal bytes can starve a flight of its pictures. Only a camera of this computer has
# a converter before it: pictures that come over a network repeat by their bytes or not at all.


Grey = NDArray[np.uint8]

MOST_AGAIN = 4
"""15 pictures a second in a stream of 60 come three times again."""
_WINDOW = 24
_ALIKE, _UNLIKE = 0.6, 0.8
_SPREAD = 1.5  # among repetitions: the converter's noise is the same in each
_LEAST_OF_EACH = 4
WOBBLE_HZ = 10.0
"""No vehicle swings faster by as much as a picture shows; it turns back twice a period."""
_CALM = 0.7  # of the pixels: what moved, and edges, are no noise
_LEAST_NOISE = 1.0
_STEP = 32  # rows


@dataclass(frozen=True, eq=False)
class RepeatState:
    """`last`: the newest picture that was new. `ratios`: how unlike the newest few were to the
    one before, in units of their own noise; None where there was no noise to tell by. `times_s`:
    of their arrival."""

    last: Grey | None = None
    ratios: tuple[float | None, ...] = ()
    times_s: tuple[float, ...] = ()
    again: int = 0


def repeated(
    state: RepeatState, image: Grey, t_s: float, by_noise: bool = True
) -> tuple[RepeatState, bool]:
    """Whether the picture is the one before once more. Grey, (h, w); `t_s`: when it arrived.
    `by_noise`: also where a converter has put its own noise on it; else by equal bytes alone."""
    last = state.last
    if last is None or last.shape != image.shape:
        return RepeatState(image), False
    if same_bytes(last, image):
        return state, True
    if not by_noise:
        return RepeatState(image), False
    ratios = (*state.ratios[1 - _WINDOW :], _unlike(last, image))
    times_s = (*state.times_s[1 - _WINDOW :], t_s)
    again = state.again + 1
    if (
        _alike(ratios[-1])
        and again <= MOST_AGAIN
        and _by_turns(ratios)
        and _alike_hz(ratios, times_s) > 2.0 * WOBBLE_HZ
    ):
        return RepeatState(last, ratios, times_s, again), True
    return RepeatState(image, ratios, times_s), False


def same_bytes(one: Grey, other: Grey) -> bool:
    """Whether both are one picture to the last bit. A row that differs tells at once."""
    middle = len(one) // 2
    return (
        one.shape == other.shape
        and np.array_equal(one[middle], other[middle])
        and np.array_equal(one, other)
    )


def _alike_hz(ratios: tuple[float | None, ...], times_s: tuple[float, ...]) -> float:
    """How many a second. What came in a heap, behind a computer that was busy, was not taken in
    one: the slower of both, the usual step between two and the mean one, is the stream's."""
    steps_s = sorted(b - a for a, b in pairwise(times_s))
    step_s = max(steps_s[len(steps_s) // 2], (times_s[-1] - times_s[0]) / len(steps_s), 1e-6)
    return sum(map(_alike, ratios)) / len(ratios) / step_s


def _alike(ratio: float | None) -> bool:
    return ratio is not None and ratio < _ALIKE


def _by_turns(ratios: tuple[float | None, ...]) -> bool:
    alike = [_alike(ratio) for ratio in ratios]
    same = [ratio for ratio in ratios if ratio is not None and ratio < _ALIKE]
    new = [ratio for ratio in ratios if ratio is not None and ratio >= _ALIKE]
    if not len(same) >= _LEAST_OF_EACH <= len(new):
        return False
    longest = max(len(list(run)) for kind, run in groupby(alike) if kind)
    apart = min(new) > _UNLIKE and max(same) < _SPREAD * min(same)
    return apart and longest <= MOST_AGAIN


def _unlike(last: Grey, image: Grey) -> float | None:
    """The noise between the pictures over that between rows two apart (of one field)."""
    rows = image[: len(image) - 2 : _STEP]
    below = image[2::_STEP][: len(rows)]
    own = _calm(rows, below)
    return _calm(rows, last[: len(image) - 2 : _STEP]) / own if own >= _LEAST_NOISE else None


def _calm(one: Grey, other: Grey) -> float:
    """Mean difference where it is small, grey levels."""
    counts = cv2.calcHist([cv2.absdiff(one, other)], [0], None, [256], [0.0, 256.0])
    left: float = max(1, int(_CALM * one.size))
    most = left
    total = 0.0
    for level, count in enumerate(counts.ravel().tolist()):
        if count >= left:
            return (total + level * left) / most
        total += level * count
        left -= count
    return total / most
