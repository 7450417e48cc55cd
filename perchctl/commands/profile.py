"""`perchctl profile`: a profile as it is flown, a new one of your vehicle, the schema of one."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from perchctl.calibration import load_calibration
from perchctl.camera import (
    parse_source,
    profile_record,
    without_password,
    without_passwords,
)
from perchctl.check import Row, Verdict, profile_rows
from perchctl.commands.command_line import (
    Command,
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    complete_source,
    examples,
    new_app,
    reporting,
)
from perchctl.commands.output import print_record, say, tell
from perchctl.commands.picture_edges import (
    PICTURE_EDGES,
    edges_beside,
    mount_from_edges,
    picture_edges,
)
from perchctl.errors import Interrupted, InvalidValue, PerchError, UsageError
from perchctl.files import check_output, write_files
from perchctl.link import check_uri
from perchctl.profile import (
    Profile,
    editor_schema,
    find_calibration,
    find_profile,
    first_invalid_key,
    load_profile,
    profile_text,
    profile_value,
)

app = new_app(Group)


@app.command(
    cls=Command,
    short_help="Show a profile as it is flown, every key explained.",
    epilog=examples(
        "perchctl profile -p crazyflie",
        "perchctl profile new -o my_vehicle.yaml",
        "perchctl profile schema > perchctl.schema.json",
    ),
)
@reporting
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
        print_record(record)
        return 0
    print(profile_text(without_passwords(loaded)), end="")
    _say_doubts(_doubts(loaded))
    return 0


def _doubts(profile: Profile) -> list[Row]:
    rows = profile_rows(profile)
    return [row for row in rows if row.verdict in (Verdict.WARN, Verdict.FAIL)]


def _say_doubts(rows: list[Row]) -> None:
    for row in rows:
        say(f"{row.name}: {row.found}; {row.advice}")


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl profile new -o my_vehicle.yaml",
        "perchctl profile new -u radio://0/80/2M/E7E7E7E7E7 --source camera:0",
        "perchctl profile new --ceiling 3.1 --defaults",
    ),
)
@reporting
def new(
    context: typer.Context,
    output: Annotated[Path, typer.Option("--output", "-o", help="Profile to write.")] = Path(
        "my_vehicle.yaml"
    ),
    uri: Annotated[
        str | None,
        typer.Option("--uri", "-u", help="Vehicle: radio://0/80/2M/E7E7E7E7E7, usb://0, sim://."),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Camera: camera:N, rtsp://..., http://..., aideck://HOST, sim:.",
            autocompletion=complete_source,
        ),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            "--calibration",
            help="Its file, of `perchctl calibrate`; none: not yet, the example's until then.",
        ),
    ] = None,
    latency: Annotated[
        str | None, typer.Option("--latency", help="Of the picture, exposure to arrival, ms.")
    ] = None,
    front: Annotated[
        str | None,
        typer.Option(
            "--front-at",
            help="Edge of the picture at which the vehicle's front is: top, right, bottom, left.",
        ),
    ] = None,
    left: Annotated[
        str | None, typer.Option("--left-at", help="Edge at which its left side is.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera-at", help="Lens from the centre: 'forward left up', mm."),
    ] = None,
    gear: Annotated[
        str | None, typer.Option("--gear-at", help="Tip of the magnet gear, likewise, mm.")
    ] = None,
    large: Annotated[
        str | None, typer.Option("--large", help="Large black square as printed, mm.")
    ] = None,
    small: Annotated[
        str | None, typer.Option("--small", help="Small black square as printed, mm.")
    ] = None,
    ceiling: Annotated[
        str | None, typer.Option("--ceiling", help="Height of the ceiling over the floor, m.")
    ] = None,
    fence: Annotated[
        str | None, typer.Option("--fence", help="Radius of the free space to fly in, m.")
    ] = None,
    defaults: Annotated[
        bool, typer.Option("--defaults", help="Ask nothing: defaults for what is not given.")
    ] = False,
    force: ForceOption = False,
) -> int:
    """Write a profile of your vehicle, every key commented, in a short dialogue.

    Options answer questions beforehand; with all of them, or --defaults, nothing is asked. The
    mounting is described in words: at which edge of the camera's picture a hand over the
    vehicle's front comes in, and one over its left side.
    """
    given = {question.name: context.params[question.name] for question in QUESTIONS}
    answers = {name: text for name, text in given.items() if text is not None}
    write_new_profile(output, answers, ask=None if defaults else _ask_terminal, force=force)
    return 0


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl profile schema > perchctl.schema.json",
        "perchctl profile schema | python -m json.tool",
        "perchctl profile schema | grep -A 6 latency_s",
    ),
)
@reporting
def schema() -> int:
    """Print the JSON schema of a profile's file, by which an editor completes and explains keys."""
    print(json.dumps(editor_schema(), indent=2))
    return 0


# --- A new profile: the dialogue ----------------------------------------------------------------

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
Ask = Callable[[str], str]
"""Shows a question and gives the answer; raises KeyboardInterrupt or EOFError."""
Texts = Mapping[str, str]
"""Answers as they were typed, by their question's name."""


def write_new_profile(
    output: Path, given: Texts, ask: Ask | None = None, force: bool = False
) -> None:
    """Ask what `given` leaves open, write the profile into `output`, and report what is doubtful.

    With `ask` None the open questions get their defaults. Raises InvalidValue, NotFound,
    UsageError and Interrupted; then nothing has been written.
    """
    check_output(output, (".yaml", ".yml"), force, "what a profile is")
    answers = _checked_options(given, output)
    if ask is not None and len(answers) < len(QUESTIONS):
        answers = _dialogue(answers, output, ask)
    answers = completed(answers)
    keys = profile_keys(answers, output)
    text = HEAD.format(name=shlex.quote(str(output))) + profile_text(_validated(keys, output), keys)
    write_files({output: text.encode()})
    _report(output, load_profile(str(output.absolute())), answers)


def _checked_options(given: Texts, output: Path) -> dict[str, str]:
    """The options' answers, each checked together with those before it."""
    answers: dict[str, str] = {}
    for question in QUESTIONS:
        if question.name not in given:
            continue
        text = given[question.name].strip()
        try:
            _check_answer(question, text, completed({**answers, question.name: text}), output)
        except PerchError as error:
            hint = ""
            if question.name == "left" and "front" not in answers:
                front = completed(answers)["front"]
                hint = f" (this follows from --front-at {front}, the default: give it, too)"
            raise type(error)(f"{question.option}: {error}{hint}") from None
        answers[question.name] = text
    return answers


def _check_answer(question: Question, text: str, so_far: Texts, output: Path) -> None:
    """Raises InvalidValue or NotFound where the text is no answer, or fits no other one."""
    question.check(text, so_far)
    _validated(profile_keys(completed({**so_far, question.name: text}), output), output)


def _dialogue(given: Texts, output: Path, ask: Ask) -> dict[str, str]:
    """Every question that has no answer yet, again until its answer is valid.

    Raises Interrupted (Ctrl-C) and UsageError (no more input), with the command that goes on
    from what was answered."""
    if ask is _ask_terminal and not sys.stdin.isatty():
        options = ", ".join(q.option for q in QUESTIONS if q.name not in given)
        raise UsageError(
            f"there is nobody to ask (no terminal): answer by {options}, or add --defaults for "
            f"what is not answered"
        )
    tell(
        f"A new profile: {output}\n"
        f"Enter takes what stands in brackets; Ctrl-C leaves, and nothing is written."
    )
    answers = dict(given)
    try:
        for question in QUESTIONS:
            if question.name not in given:
                answers[question.name] = _answer(question, answers, given, output, ask)
    except KeyboardInterrupt:
        raise Interrupted(f"Ctrl-C: {_resume_command(answers, output)}") from None
    except EOFError:
        raise UsageError(f"the input has ended: {_resume_command(answers, output)}") from None
    return answers


def _answer(question: Question, before: Texts, given: Texts, output: Path, ask: Ask) -> str:
    known = completed({**given, **before})
    default = question.default(known)
    while True:
        text = ask(f"{question.text}{question.hint(known)}\n  [{default}] ").strip() or default
        try:
            _check_answer(question, text, {**before, question.name: text}, output)
        except PerchError as error:
            tell(textwrap.fill(str(error), 80, initial_indent="  ", subsequent_indent="    "))
            continue
        return text


def _resume_command(answers: Texts, output: Path) -> str:
    """How to go on with a dialogue that was left."""
    if not answers:
        return "nothing was written"
    words = ["perchctl", "profile", "new"]
    for question in QUESTIONS:
        if question.name in answers:
            words += [question.option, answers[question.name]]
    return f"nothing was written; to go on from here: {shlex.join([*words, '-o', str(output)])}"


def _ask_terminal(question: str) -> str:
    # On stderr: stdout is for the result.
    print(question, end="", file=sys.stderr, flush=True)
    try:
        return input()
    except (KeyboardInterrupt, EOFError):
        print(file=sys.stderr)
        raise
    except UnicodeDecodeError:
        return "\N{REPLACEMENT CHARACTER}"


def _report(output: Path, profile: Profile, answers: Texts) -> None:
    """Say what was written, and what in it is doubtful."""
    doubts = _doubts(profile)
    if answers["calibration"] == NONE_YET:
        doubts = [row for row in doubts if row.name != "calibration file"]
        own = not profile.camera.source.startswith("sim:")
        say(
            f"calibration: none yet: wrote {_example(profile.camera.source)}, the shipped example; "
            + (
                "calibrate yours (perchctl calibrate), and name its file in camera.calibration"
                if own
                else "the simulated camera is made by it, and nothing is left to do"
            )
        )
    if profile.camera.mirrored:
        front, left = picture_edges(profile.camera.mount, mirrored=True) or ("", "")
        say(
            f"camera: with the front at its {front} and the left side at its {left} edge the "
            f"picture is mirrored: wrote camera.mirrored: true, which turns each picture right "
            f"before use; if the picture is not mirrored, answer the two again"
        )
    _say_doubts(doubts)
    shown = shlex.quote(str(output))
    print(f"wrote {output}\nlook at the plan: perchctl fly -p {shown} --dry-run")


# --- A new profile: the questions ---------------------------------------------------------------

EXAMPLE = "example_640x480.yaml"
AIDECKS_EXAMPLE = "example_aideck_324x244.yaml"
NONE_YET = "none"
SIMULATED, RADIO = "sim://", "radio://0/80/2M/E7E7E7E7E7"
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")


@dataclass(frozen=True)
class Question:
    """One question of the dialogue.

    `default`, `check` and `hint` get the answers so far. `check` returns the parsed answer and
    raises InvalidValue or NotFound. `hint` stands behind the text.
    """

    name: str
    option: str
    text: str
    default: Callable[[Texts], str]
    check: Callable[[str, Texts], Any]
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
            f"aideck://HOST"
        )
    return text


def _is_aideck(source: str) -> bool:
    return source.lower().startswith("aideck:")


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
    values, most = _numbers(text, "mm", 3), 300.0  # as the profile allows
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


def completed(texts: Texts) -> dict[str, str]:
    """All answers: those that are missing are their questions' defaults."""
    answers = dict(texts)
    for question in QUESTIONS:
        if question.name not in answers:
            answers[question.name] = question.default(answers)
    return answers


# --- A new profile: its keys --------------------------------------------------------------------

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


def profile_keys(texts: Texts, output: Path) -> dict[str, Any]:
    """The keys of the new profile by their dotted paths. Raises InvalidValue, NotFound."""
    answer = {q.name: q.check(texts[q.name], texts) for q in QUESTIONS}
    uri, source, default = texts["uri"], texts["source"], Profile()
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


def _validated(keys: Mapping[str, Any], output: Path) -> Profile:
    """The profile with these keys. Raises InvalidValue."""
    values: dict[str, Any] = {"name": output.stem}
    for path, value in keys.items():
        *sections, key = path.split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = value
    try:
        return Profile.model_validate(values)
    except ValidationError as error:
        invalid, why = first_invalid_key(error)
        raise InvalidValue(f"{invalid}: {why}" if invalid else why) from None


def _example(source: str) -> str:
    """The shipped calibration that stands in for one's own: of the size that the source has."""
    return AIDECKS_EXAMPLE if _is_aideck(source) else EXAMPLE


def _calibration_name(calibration: Path | None, output: Path, source: str) -> str:
    """The calibration as the profile at `output` names it: beside it, or by the whole path."""
    if calibration is None:
        return _example(source)
    if calibration == find_calibration(EXAMPLE).resolve():
        return EXAMPLE
    folder = output.absolute().parent.resolve()
    within = calibration.is_relative_to(folder)
    return os.path.relpath(calibration, folder) if within else str(calibration)
