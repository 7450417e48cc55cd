"""`perchctl profile`: a profile as it is flown, a new one of your vehicle, the schema of one."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from perchctl.calibration import load_calibration
from perchctl.camera import (
    parse_source,
    profile_record,
    without_password,
    without_passwords,
)
from perchctl.check import Verdict, profile_rows
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    command,
    new_app,
)
from perchctl.commands.output import print_lines, print_result, say
from perchctl.commands.picture_edges import (
    PICTURE_EDGES,
    edges_beside,
    mount_from_edges,
)
from perchctl.errors import InvalidValue, PerchError, UsageError
from perchctl.files import check_output, write_files
from perchctl.link import check_uri
from perchctl.profile import (
    Profile,
    changed_profile,
    editor_schema,
    find_calibration,
    find_profile,
    load_profile,
    profile_text,
    profile_value,
)

app = new_app(Group)


@command(
    app,
    "perchctl profile -p crazyflie",
    "perchctl profile new -o my_vehicle.yaml",
    "perchctl profile schema > perchctl.schema.json",
    short_help="Show a profile as it is flown, every key explained.",
)
def show(profile: ProfileOption = "sim", as_json: JsonOption = False) -> int:
    """Show a profile as it is flown, every key explained, or write one of your vehicle (new).

    Prints every key with its value, unit, bounds and meaning, and warns about what is implausible.
    """
    loaded = load_profile(profile)
    if as_json:
        record = {
            "profile_file": str(find_profile(profile)),
            "profile": profile_record(loaded),
            "check": [dataclasses.asdict(row) for row in profile_rows(loaded)],
        }
        print_result(record)
        return 0
    print(profile_text(without_passwords(loaded)), end="")
    _say_doubts(loaded)
    return 0


def _say_doubts(profile: Profile) -> None:
    """Print what of the profile was hardly meant."""
    for row in profile_rows(profile):
        if row.verdict in (Verdict.WARN, Verdict.FAIL):
            say(f"{row.name}: {row.found}; {row.advice}")


# --- A new profile: the questions ---------------------------------------------------------------

EXAMPLE = "example_640x480.yaml"
AIDECKS_EXAMPLE = "example_aideck_324x244.yaml"
NONE_YET = "none"
SIMULATED, RADIO = "sim://", "radio://0/80/2M/E7E7E7E7E7"
MOST_MM = 300.0
"""How far from the vehicle's centre the profile allows a camera or a gear on each axis."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")

Answers = Mapping[str, Any]
"""Parsed answers by their question's name."""


@dataclass(frozen=True)
class Question:
    """One question of the dialogue; each function gets the answers to those before it.

    `default` gives the text that Enter stands for, `parse` the answer, or raises InvalidValue or
    NotFound.
    """

    name: str
    text: str
    default: Callable[[Answers], str]
    parse: Callable[[str, Answers], Any]


def collect_answers(
    given: Mapping[str, str], open_question: Callable[[Question, Answers], Any]
) -> dict[str, Any]:
    """Return the answers to all questions: those that are `given`, or else by `open_question`.

    Raises InvalidValue and NotFound, each with the question's name.
    """
    answers: dict[str, Any] = {}
    for question in QUESTIONS:
        if question.name not in given:
            answers[question.name] = open_question(question, answers)
            continue
        try:
            answers[question.name] = question.parse(given[question.name].strip(), answers)
        except PerchError as error:
            raise type(error)(f"--set {question.name}: {error}") from None
    return answers


def _by_default(question: Question, answers: Answers) -> Any:
    return question.parse(question.default(answers), answers)


def _ask_person(question: Question, answers: Answers) -> Any:
    """Return what somebody types, asked for again until it is valid. Raises UsageError if the
    input has ended."""
    default = question.default(answers)
    while True:
        # On stderr: stdout is for the result.
        text = f"{question.text}\n  [{default}] "
        print(text, end="", file=sys.stderr, flush=True)
        try:
            return question.parse(input().strip() or default, answers)
        except EOFError:
            raise UsageError(
                "there is nobody to ask, and nothing was written: answer by --set, or "
                "add --defaults for what is not answered"
            ) from None
        except (PerchError, UnicodeDecodeError) as error:
            print_lines(f"  {error}")


def _uri(text: str, _answers: Answers) -> str:
    check_uri(text)
    return text


def _source(text: str, answers: Answers) -> str:
    source = parse_source(text)
    if source.scheme == "camera" and re.fullmatch(r"\W*(-\d*)?", source.place):
        raise InvalidValue(f"{text!r} names no camera; write camera:N or camera:NAME")
    if answers["uri"].startswith(SIMULATED) or (source.scheme != "sim" and source.live):
        return text
    raise InvalidValue(
        f"{source} is no camera that flies with {answers['uri']}; allowed are camera:N, "
        f"camera:NAME, http://HOST:PORT/PATH, rtsp://HOST/PATH, aideck://HOST"
    )


def _is_aideck(source: str) -> bool:
    return source.lower().startswith("aideck:")


def _calibration(text: str, _answers: Answers) -> Path | None:
    """Return the file; None for none yet."""
    if text == NONE_YET:
        return None
    path = find_calibration(text)
    load_calibration(path)
    return path.resolve()


def _one_of(text: str, choices: tuple[str, ...]) -> str:
    if text not in choices:
        raise InvalidValue(f"found {text!r}; allowed are {', '.join(choices)}")
    return text


def _numbers(text: str, unit: str, low: float, high: float, count: int = 1) -> tuple[float, ...]:
    """Return that many numbers within the limits, with spaces or commas between, and the unit or
    none behind each."""
    words = re.sub(rf"(?<=[\d.])\s*{unit}(?![a-zA-Z])", " ", text).replace(",", " ").split()
    if len(words) != count or not all(map(_NUMBER.fullmatch, words)):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise InvalidValue(f"found {text!r}; needed is {wanted}, in {unit}")
    values = tuple(float(word) for word in words)
    for value in values:
        if not low <= value <= high:
            raise InvalidValue(f"found {value:g} {unit}; allowed are {low:g} to {high:g} {unit}")
    return values


def _within(text: str, unit: str, low: float, high: float) -> float:
    return _numbers(text, unit, low, high)[0]


def _place(text: str, _answers: Answers) -> tuple[float, ...]:
    """Return metres from three numbers in millimetres."""
    values = _numbers(text, "mm", -MOST_MM, MOST_MM, 3)
    if any(values) and all(abs(value) < 1 for value in values):
        raise InvalidValue(f"found {text!r}: these look like metres; the question is in mm")
    return tuple(_thousandth(value) for value in values)


def _small(text: str, answers: Answers) -> float:
    side_mm = _within(text, "mm", 4, 1000)
    if side_mm >= answers["large"] / 2:
        raise InvalidValue(f"found {side_mm:g} mm; allowed is less than half of the large square")
    return side_mm


def _thousandth(value: float) -> float:
    """Return 0.0249 for 24.9, not 0.024899999999999999."""
    return float(f"{value / 1e3:.12g}")


QUESTIONS: tuple[Question, ...] = (
    Question(
        "uri", "The vehicle's URI: radio://0/80/2M/E7E7E7E7E7, usb://0, sim://, ...",
        lambda _: RADIO, _uri,
    ),
    Question(
        "source", "The camera: camera:N (a receiver at /dev/videoN), http://..., aideck://HOST",
        lambda answers: "sim:" if answers["uri"].startswith(SIMULATED) else "camera:0", _source,
    ),
    Question(
        "calibration", "Its calibration file, of `perchctl calibrate` (none: not yet)",
        lambda answers: EXAMPLE if answers["source"] == "sim:" else NONE_YET, _calibration,
    ),
    Question(
        "latency", "How late the picture is, from exposure to arrival, ms (60 to 100 are usual)",
        lambda _: "80", lambda text, _: _within(text, "ms", 1, 390),
    ),
    Question(
        "front", "Hold a hand over the front of the vehicle. At which edge of the picture\n"
        "does it come in: top, right, bottom or left?",
        lambda _: "top", lambda text, _: _one_of(text, tuple(PICTURE_EDGES)),
    ),
    Question(
        "left", "And a hand over its left side (a camera that mirrors has it at the other edge)?",
        lambda answers: edges_beside(answers["front"])[0],
        lambda text, answers: _one_of(text, edges_beside(answers["front"])),
    ),
    Question(
        "camera", "Where is the lens, from the vehicle's centre: forward, left, up, mm?",
        lambda _: "30 0 10", _place,
    ),
    Question(
        "gear", "Where is the tip of the magnet gear, likewise, mm?",
        lambda _: "0 0 30", _place,
    ),
    Question(
        "large", "Side of the target's large black square as printed, mm",
        lambda _: "150", lambda text, _: _within(text, "mm", 20, 2000),
    ),
    Question(
        "small", "Side of the small one, mm",
        lambda answers: f"{max(4.0, answers['large'] / 6.0):.4g}", _small,
    ),
    Question(
        "ceiling", "Height of the ceiling over the floor, m",
        lambda _: "2.4", lambda text, _: _within(text, "m", 1, 10),
    ),
    Question(
        "fence", "Free space around the place of take-off, its radius, m",
        lambda _: "1.5", lambda text, _: _within(text, "m", 0.3, 20),
    ),
)  # fmt: skip


@command(
    app,
    "perchctl profile new -o my_vehicle.yaml",
    "perchctl profile new --set uri=usb://0 --set source=camera:0",
    "perchctl profile new --set ceiling=3.1 --defaults",
)
def new(
    output: Annotated[Path, typer.Option("--output", "-o", help="Profile to write.")] = Path(
        "my_vehicle.yaml"
    ),
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=ANSWER",
            help=f"Answer a question beforehand: {', '.join(q.name for q in QUESTIONS)}.",
        ),
    ] = None,
    defaults: Annotated[
        bool, typer.Option("--defaults", help="Ask nothing: defaults for what is not given.")
    ] = False,
    force: ForceOption = False,
) -> None:
    """Write a profile of your vehicle, every key commented, in a short dialogue.

    With --set for every question, or --defaults, nothing is asked. The mounting is described in
    words: at which edge of the camera's picture a hand over the vehicle's front comes in, and one
    over its left side.
    """
    check_output(output, (".yaml", ".yml"), force, "what a profile is")
    given = dict(setting.partition("=")[::2] for setting in settings or ())
    unknown = given.keys() - {question.name for question in QUESTIONS}
    if unknown:
        raise UsageError(f"--set {unknown.pop()}: there is no such question; --help lists them")
    if given.get("source") == "sim:":  # no other vehicle flies by those pictures
        given.setdefault("uri", SIMULATED)
    answers = collect_answers(
        given, _by_default
    )  # all options are checked before anything is asked
    if not defaults and len(given) < len(QUESTIONS):
        print_lines(f"A new profile: {output}. Enter takes what stands in brackets.")
        answers = collect_answers(given, _ask_person)
    write_new_profile(output, answers)


# --- A new profile: its keys --------------------------------------------------------------------

HEAD = """\
# A profile of perchctl, made by perchctl profile new. Above each key stands what
# it means (unit, what is allowed). Body axes: x forward, y left, z up, from the
# vehicle's centre. A key that is not here has its default; all of them:
#   perchctl profile -p {name}
# An editor that knows YAML schemas completes keys and shows what they mean with
#   perchctl profile schema > perchctl.schema.json
# beside this file, and here in a line of its own, behind a #:
#   yaml-language-server: $schema=perchctl.schema.json

"""
AIDECK_KEYS = (
    "kalman.drift_mps2",
    "kalman.n_max",
    "planner.ascend.settle_xy_m",
    "planner.ascend.fresh_s",
    "safety.max_frame_age_s",
)
"""What an AI-deck's few and late pictures need besides: as the shipped profile has it."""
OVER_THE_CEILING_M = 0.4
"""The height limit is so far above the ceiling: an estimate that drifts must not end a flight."""
FAR_SIGHT_M, NEAR_SIGHT_M, LOW_SEARCH_M = 1.1, 0.5, 1.3
"""The search goes up to where the ceiling is that near, or to `LOW_SEARCH_M` where that is
higher and there is room."""


def write_new_profile(output: Path, answers: Answers) -> None:
    """Write the profile into `output`, and report what is doubtful. Raises InvalidValue."""
    keys = profile_keys(answers, output)
    shown = shlex.quote(str(output))
    settings = [
        f"{key}={json.dumps(value)}" for key, value in {"name": output.stem, **keys}.items()
    ]
    profile = changed_profile(Profile(), settings, str(output))
    text = HEAD.format(name=shown) + profile_text(profile, keys)
    write_files({output: text.encode()})
    if keys["camera.mirrored"]:
        say(
            f"camera: with the front at its {answers['front']} and the left side at its "
            f"{answers['left']} edge the picture is mirrored: wrote camera.mirrored: true, which "
            f"turns each picture right before use; if it is not mirrored, answer the two again"
        )
    _say_doubts(load_profile(str(output.absolute())))
    print(f"wrote {output}\nlook at the plan: perchctl fly -p {shown} --dry-run")


def profile_keys(answer: Answers, output: Path) -> dict[str, Any]:
    """Return the keys of the new profile by their dotted paths."""
    uri, source, default = answer["uri"], answer["source"], Profile()
    turn_deg, mirrored = mount_from_edges(answer["front"], answer["left"])
    ceiling_m = answer["ceiling"]
    low_m = min(LOW_SEARCH_M, ceiling_m - NEAR_SIGHT_M)
    search_m = round(max(low_m, ceiling_m - FAR_SIGHT_M), 2)
    most_m = round(ceiling_m + OVER_THE_CEILING_M, 2)
    landing = default.planner.landing
    down_s = most_m / landing.speed_mps * landing.timeout_s / landing.overdue_s
    keys = {
        "description": f"a vehicle at {uri}, with its camera at {without_password(source)}",
        "camera.source": source,
        "camera.calibration": _calibration_name(answer["calibration"], output, source),
        "camera.latency_s": _thousandth(answer["latency"]),
        "camera.mount.position_m": answer["camera"],
        "camera.mount.rpy_deg": (0.0, 0.0, turn_deg),
        "camera.mirrored": mirrored,
        "camera.readout_s": 0.0 if source.startswith("sim:") else None,
        "vehicle.gear_body_m": answer["gear"],
        "target.large.dictionary": default.target.large.dictionary,
        "target.large.id": default.target.large.id,
        "target.large.side_m": _thousandth(answer["large"]),
        "target.small.dictionary": default.target.small.dictionary,
        "target.small.id": default.target.small.id,
        "target.small.side_m": _thousandth(answer["small"]),
        "planner.takeoff_height_m": min(0.5, search_m),
        "planner.search.max_height_m": search_m,
        "planner.landing.timeout_s": max(landing.timeout_s, 5.0 * (math.floor(down_s / 5.0) + 1)),
        "planner.attempts": default.planner.attempts,
        "safety.min_rest_v": default.safety.min_rest_v,
        "safety.min_load_v": default.safety.min_load_v,
        "safety.max_height_m": most_m,
        "safety.fence_radius_m": answer["fence"],
        "link.uri": uri,
        "link.parameters": {"stabilizer.estimator": 2},
    }
    if _is_aideck(source):
        shipped = load_profile("aideck")
        keys |= {path: profile_value(shipped, path) for path in AIDECK_KEYS}
    return keys


def _calibration_name(calibration: Path | None, output: Path, source: str) -> str:
    """Return the calibration as the profile at `output` names it: beside it, or by the whole
    path."""
    if calibration is None:
        return AIDECKS_EXAMPLE if _is_aideck(source) else EXAMPLE
    if calibration == find_calibration(EXAMPLE).resolve():
        return EXAMPLE
    folder = output.absolute().parent.resolve()
    within = calibration.is_relative_to(folder)
    return os.path.relpath(calibration, folder) if within else str(calibration)


@command(
    app,
    "perchctl profile schema > perchctl.schema.json",
    "perchctl profile schema | python -m json.tool",
    "perchctl profile schema | grep -A 6 latency_s",
)
def schema() -> None:
    """Print the JSON schema of a profile's file, by which an editor completes and explains keys."""
    print(json.dumps(editor_schema(), indent=2))
