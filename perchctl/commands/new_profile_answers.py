"""The questions of `perchctl new-profile`: what each takes for an answer, and the profile that
the answers make."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from perchctl.calibration import load_calibration
from perchctl.camera import parse_source, without_password
from perchctl.errors import InvalidValue
from perchctl.link import check_uri
from perchctl.profile import (
    FARTHEST_ON_BODY_M,
    OVERDUE_SHARE,
    PICTURE_EDGES,
    Profile,
    edges_beside,
    find_calibration,
    first_invalid_key,
    load_profile,
    mount_from_edges,
)

EXAMPLE = "example_640x480.yaml"
AIDECKS_EXAMPLE = "example_aideck_324x244.yaml"
NONE_YET = "none"
SIMULATED, RADIO = "sim://", "radio://0/80/2M/E7E7E7E7E7"
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")

Texts = Mapping[str, str]
"""Answers as they were given, by their question's name."""


@dataclass(frozen=True)
class Question:
    """`default`, `check` and `hint` are given the answers so far; `check` raises InvalidValue.
    `hint` stands behind the text."""

    name: str
    option: str
    text: str
    default: Callable[[Texts], str]
    check: Callable[[str, Texts], object]
    hint: Callable[[Texts], str] = lambda _: ""


def _simulated(answers: Texts) -> bool:
    return answers["uri"].startswith(SIMULATED)


def _source(text: str, answers: Texts) -> str:
    source = parse_source(text)
    if source.scheme == "camera" and re.fullmatch(r"\W*(-\d*)?", source.place):
        raise InvalidValue(f"{text!r} names no camera; write camera:N or camera:NAME")
    if not _simulated(answers) and (source.scheme == "sim" or not source.live):
        raise InvalidValue(
            f"{source} is no camera that flies with {answers['uri']}; allowed are "
            f"camera:N, camera:NAME, http://HOST:PORT/PATH, rtsp://HOST/PATH, "
            f"aideck://HOST, gst:PIPELINE"
        )
    return text


def _calibration(text: str, _answers: Texts) -> Path | None:
    """The file; None for none yet."""
    if text == NONE_YET:
        return None
    path = find_calibration(text)
    load_calibration(path)
    return path.resolve()


def _edge(text: str, _answers: Texts) -> str:
    return _one_of(text, tuple(PICTURE_EDGES))


def _edge_beside(text: str, answers: Texts) -> str:
    return _one_of(text, edges_beside(_edge(answers["front"], answers)))


def _one_of(text: str, choices: tuple[str, ...]) -> str:
    fits = [choice for choice in choices if text and choice.startswith(text.lower())]
    if len(fits) != 1:
        raise InvalidValue(f"found {text!r}; allowed are {', '.join(choices)}")
    return fits[0]


def _numbers(text: str, unit: str, count: int = 1) -> tuple[float, ...]:
    """That many numbers, with spaces or commas between, and the unit or none behind each."""
    words = re.sub(rf"(?<=[\d.])\s*{unit}(?![a-zA-Z])", " ", text).replace(",", " ").split()
    if len(words) != count or not all(map(_NUMBER.fullmatch, words)):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise InvalidValue(f"found {text!r}; needed is {wanted}, in {unit}")
    return tuple(float(word) for word in words)


def _within(text: str, unit: str, low: float, high: float) -> float:
    (value,) = _numbers(text, unit)
    if not low <= value <= high:
        raise InvalidValue(f"found {value:g} {unit}; allowed are {low:g} to {high:g} {unit}")
    return value


def _latency(text: str, _answers: Texts) -> float:
    value = _within(text, "ms", 0, 390)
    if 0 < value < 1:
        raise InvalidValue(
            f"found {text!r}: this looks like seconds; the question is in ms "
            f"({value:g} s are {value * 1e3:g} ms)"
        )
    return value


def _place(text: str, _answers: Texts) -> tuple[float, ...]:
    """Metres from millimetres."""
    values, most = _numbers(text, "mm", 3), FARTHEST_ON_BODY_M * 1e3
    if any(values) and all(abs(value) < 1 for value in values):
        meant = " ".join(f"{value * 1e3:g}" for value in values)
        raise InvalidValue(
            f"found {text!r}: these look like metres; the question is in mm (then {meant})"
        )
    far = [value for value in values if abs(value) > most]
    if far:
        raise InvalidValue(f"found {far[0]:g} mm; allowed are {-most:g} to {most:g} mm on an axis")
    return tuple(_thousandth(value) for value in values)


def _thousandth(value: float) -> float:
    """0.0249 of 24.9, not 0.024899999999999999."""
    return float(f"{value / 1e3:.12g}")


QUESTIONS: tuple[Question, ...] = (
    Question(
        "uri", "--uri", "The vehicle's URI: radio://0/80/2M/E7E7E7E7E7, usb://0, sim://, ...",
        lambda answers: SIMULATED if answers.get("source") == "sim:" else RADIO,
        lambda text, _: check_uri(text),
    ),
    Question(
        "source", "--source", "The camera: camera:N (a receiver at /dev/videoN), http://..., aideck://HOST",
        lambda answers: "sim:" if _simulated(answers) else "camera:0", _source,
    ),
    Question(
        "calibration", "--calibration",
        "Its calibration file, of `perchctl calibrate` (none: not yet)",
        lambda answers: EXAMPLE if _simulated(answers) else NONE_YET, _calibration,
    ),
    Question(
        "latency", "--latency",
        "How late the picture is, from exposure to arrival, ms (60 to 100 are usual)",
        lambda _: "80", _latency,
    ),
    Question(
        "front", "--front-at",
        "Hold a hand over the front of the vehicle. At which edge of the picture\n"
        "does it come in: top, right, bottom or left?",
        lambda _: "top", _edge,
    ),
    Question(
        "left", "--left-at", "And a hand over its left side?",
        lambda answers: edges_beside(_edge(answers["front"], answers))[0], _edge_beside,
        lambda answers: " ({}, or {} if the camera mirrors its picture)".format(
            *edges_beside(_edge(answers["front"], answers))
        ),
    ),
    Question(
        "camera", "--camera-at",
        "Where is the lens, from the vehicle's centre: forward, left, up, mm?",
        lambda _: "30 0 10", _place,
    ),
    Question(
        "gear", "--gear-at", "Where is the tip of the magnet gear, likewise, mm?",
        lambda _: "0 0 30", _place,
    ),
    Question(
        "large", "--large", "Side of the target's large black square as printed, mm",
        lambda _: "150", lambda text, _: _within(text, "mm", 20, 2000),
    ),
    Question(
        "small", "--small", "Side of the small one, mm",
        lambda answers: f"{max(4.0, _numbers(answers['large'], 'mm')[0] / 6.0):.4g}",
        lambda text, _: _within(text, "mm", 4, 1000),
    ),
    Question(
        "ceiling", "--ceiling", "Height of the ceiling over the floor, m",
        lambda _: "2.4", lambda text, _: _within(text, "m", 1, 10),
    ),
    Question(
        "fence", "--fence", "Free space around the place of take-off, its radius, m",
        lambda _: "1.5", lambda text, _: _within(text, "m", 0.3, 20),
    ),
)  # fmt: skip

WRITTEN = frozenset({
    "description", "camera.source", "camera.calibration", "camera.latency_s",
    "camera.mount.position_m", "camera.mount.rpy_deg", "camera.mirrored", "camera.readout_s",
    "vehicle.gear_body_m",
    "target.large.dictionary", "target.large.id", "target.large.side_m",
    "target.small.dictionary", "target.small.id", "target.small.side_m",
    "planner.takeoff_height_m", "planner.search.max_height_m", "planner.landing.timeout_s",
    "planner.attempts",
    "safety.min_rest_v", "safety.min_load_v", "safety.max_height_m", "safety.fence_radius_m",
    "link.uri", "link.parameters",
})  # fmt: skip
"""The keys of the new file."""
OF_AN_AIDECK = frozenset({
    "kalman.drift_mps2", "kalman.n_max", "planner.ascend.settle_xy_m", "planner.ascend.fresh_s",
    "safety.max_frame_age_s",
})  # fmt: skip
"""What its few and late pictures need besides: as the shipped profile has it."""
OVER_THE_CEILING_M = 0.4
"""So far above it the height limit is: an estimate that drifts must not end a flight there."""
FAR_SIGHT_M, NEAR_SIGHT_M, LOW_SEARCH_M = 1.1, 0.5, 1.3
"""The search goes up to where the ceiling is that near, or to `LOW_SEARCH_M` where that is
higher and there is room."""


def checked(texts: Texts, upto: str, output: Path) -> None:
    """Whether that answer is one, and fits those before it. Raises InvalidValue, NotFound."""
    question = next(question for question in QUESTIONS if question.name == upto)
    question.check(texts[upto], texts)
    made(completed(texts), output)


def completed(texts: Texts) -> dict[str, str]:
    """All answers: those that are missing are their questions' defaults."""
    answers = dict(texts)
    for question in QUESTIONS:
        if question.name not in answers:
            answers[question.name] = question.default(answers)
    return answers


def made(texts: Texts, output: Path) -> Profile:
    """The profile of all answers, as it is to be written into `output`.

    Raises InvalidValue, NotFound."""
    answer = {q.name: q.check(texts[q.name], texts) for q in QUESTIONS}
    uri, mounted = texts["uri"], mount_from_edges(str(answer["front"]), str(answer["left"]))
    heights = _heights(_number(answer["ceiling"]))
    shown = without_password(texts["source"])
    values: dict[str, Any] = {
        "name": output.stem,
        "description": f"a vehicle at {uri}, with its camera at {shown}",
        "camera": {
            "source": answer["source"],
            "calibration": _named(answer["calibration"], output, texts["source"]),
            "latency_s": _thousandth(_number(answer["latency"])),
            "mount": {"position_m": answer["camera"], "rpy_deg": (0.0, 0.0, mounted[0])},
            "mirrored": mounted[1],
            "readout_s": 0.0 if texts["source"].startswith("sim:") else None,
        },
        "vehicle": {"gear_body_m": answer["gear"]},
        "target": _target(_number(answer["large"]), _number(answer["small"])),
        "planner": heights["planner"],
        "safety": heights["safety"] | {"fence_radius_m": answer["fence"]},
        "link": {"uri": uri, "parameters": {"stabilizer.estimator": 2}},
    }
    if texts["source"].lower().startswith("aideck:"):
        shipped = load_profile("aideck")
        values["kalman"] = shipped.kalman
        values["planner"]["ascend"] = shipped.planner.ascend
        values["safety"]["max_frame_age_s"] = shipped.safety.max_frame_age_s
    try:
        return Profile.model_validate(values)
    except ValidationError as error:
        key, said = first_invalid_key(error)
        raise InvalidValue(f"{key}: {said}" if key else said) from None


def _number(value: object) -> float:
    assert isinstance(value, float)
    return value


def _target(large_mm: float, small_mm: float) -> dict[str, Any]:
    target = Profile().target
    return {
        "large": target.large.model_dump() | {"side_m": _thousandth(large_mm)},
        "small": target.small.model_dump() | {"side_m": _thousandth(small_mm)},
    }


def _heights(ceiling_m: float) -> dict[str, dict[str, Any]]:
    """What the ceiling's height sets."""
    low_m = min(LOW_SEARCH_M, ceiling_m - NEAR_SIGHT_M)
    search_m = round(max(low_m, ceiling_m - FAR_SIGHT_M), 2)
    most_m = round(ceiling_m + OVER_THE_CEILING_M, 2)
    landing = Profile().planner.landing
    down_s = most_m / landing.speed_mps / OVERDUE_SHARE
    return {
        "planner": {
            "takeoff_height_m": min(0.5, search_m),
            "search": {"max_height_m": search_m},
            "landing": {"timeout_s": max(landing.timeout_s, 5.0 * (math.floor(down_s / 5.0) + 1))},
        },
        "safety": {"max_height_m": most_m},
    }


def written_for(source: str) -> frozenset[str]:
    """The keys of the new file of a vehicle with that camera."""
    return WRITTEN | OF_AN_AIDECK if source.lower().startswith("aideck:") else WRITTEN


def example_of(source: str) -> str:
    """The shipped calibration that stands in for one's own: of the size that the source has."""
    return AIDECKS_EXAMPLE if source.lower().startswith("aideck:") else EXAMPLE


def _named(calibration: object, output: Path, source: str) -> str:
    """The calibration as the profile at `output` names it: beside it, or by the whole path."""
    if not isinstance(calibration, Path):
        return example_of(source)
    if calibration == find_calibration(EXAMPLE).resolve():
        return EXAMPLE
    folder = output.absolute().parent.resolve()
    within = calibration.is_relative_to(folder)
    return os.path.relpath(calibration, folder) if within else str(calibration)
