"""`perchctl profile`: show a resolved profile, create one for your vehicle, or print the schema."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import analysis
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import check as checks
from perchctl import link as links
from perchctl import profile as profiles
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    command,
    new_app,
)
from perchctl.commands.output import NO, ask, print_lines, print_result, say, say_on_terminal
from perchctl.errors import InvalidValue, PerchError, UsageError
from perchctl.extensions import is_extension
from perchctl.files import check_output, write_files
from perchctl.wrapping import wrap_line

if TYPE_CHECKING:
    from perchctl.geometry import Array

app = new_app(Group)


@command(
    app,
    "perchctl profile -p crazyflie",
    "perchctl profile new -o my_vehicle.yaml",
    "perchctl profile schema > perchctl.schema.json",
    short_help="Show a resolved profile with every key explained.",
)
def show(profile: ProfileOption = "sim", as_json: JsonOption = False) -> int:
    """Show a resolved profile with every key explained, or create one for your vehicle (new).

    perchctl prints the value, unit, bounds and meaning of each key, and warns about implausible
    values.
    """
    say_on_terminal(f"reading profile {profile}")
    loaded = profiles.load_profile(profile)
    if as_json:
        record = {
            "profile_file": str(profiles.find_profile(profile)),
            "profile": cameras.profile_record(loaded),
            "check": [dataclasses.asdict(row) for row in checks.profile_rows(loaded)],
        }
        print_result(record)
        return 0
    print(
        profiles.profile_text(profiles.Profile.model_validate(cameras.profile_record(loaded))),
        end="",
    )
    _say_doubts(loaded)
    return 0


def _say_doubts(profile: profiles.Profile) -> None:
    for row in checks.profile_rows(profile):
        if row.verdict in (checks.Verdict.WARN, checks.Verdict.FAIL):
            say(f"{row.name}: {row.found}; {row.advice}")


# --- A new profile ---

EXAMPLE_CALIBRATION = "example_640x480.yaml"
SIMULATED = "sim://"
QUESTIONS: dict[str, str] = {
    "link.uri": "radio://0/80/2M/E7E7E7E7E7",
    "positioning.by": "deck",
    "camera.source": "camera:0",
    "camera.calibration": EXAMPLE_CALIBRATION,
    "camera.latency_s": "0.08",
    "front": "top",
    "left": "",
    "camera.mount.position_m": "[0.03, 0, 0.01]",
    "vehicle.gear_body_m": "[0, 0, 0.03]",
    "target.large.side_m": "0.15",
    "target.small.side_m": "0.025",
    "ceiling": "2.4",
    "safety.fence_radius_m": "1.5",
}
"""The questions in order, with their defaults: keys of the profile, the two image edges, and the
ceiling. Some defaults depend on earlier answers (`default_answer`)."""
WORDS: dict[str, str] = {
    "link.uri": "The vehicle's URI: radio://0/80/2M/E7E7E7E7E7, usb://0, sim://",
    "positioning.by": "The source of the vehicle's position: deck (Flow, Lighthouse or Loco), "
    "mocap (motion capture), or target (the printed target alone)",
    "camera.source": "The camera: camera:N (a receiver at /dev/videoN), http://..., rtsp://..., "
    "aideck://HOST",
    "camera.calibration": "The camera's calibration file, from perchctl calibrate",
    "camera.latency_s": "Latency of the image, from exposure to arrival (often 60 to 100 ms), "
    "or measured, to have each flight measure it",
    "front": "Move a hand over the front of the vehicle. At which edge of the image does it "
    "appear: top, right, bottom or left?",
    "left": "Move a hand over the left side of the vehicle. At which edge of the image does "
    "it appear? (In a mirrored image, it appears at the opposite edge.)",
    "camera.mount.position_m": "Position of the lens, from the vehicle's centre: forward, left, up",
    "vehicle.gear_body_m": "Position of the magnet gear's tip: forward, left, up",
    "target.large.side_m": "Side of the target's large black square as printed",
    "target.small.side_m": "Side of the small black square",
    "ceiling": "Height of the ceiling above the floor",
    "safety.fence_radius_m": "Radius of the free space around the take-off point",
}
MEASURES: dict[str, tuple[str, float]] = {
    "camera.latency_s": ("ms", 1e-3),
    "camera.mount.position_m": ("mm", 1e-3),
    "vehicle.gear_body_m": ("mm", 1e-3),
    "target.large.side_m": ("mm", 1e-3),
    "target.small.side_m": ("mm", 1e-3),
    "ceiling": ("m", 1.0),
    "safety.fence_radius_m": ("m", 1.0),
}
"""The unit in which users answer, and the factor that converts an answer to the key's unit."""
EDGES_AND_CEILING = ("front", "left", "ceiling")
"""Questions that are not keys of the profile."""
BACK = "back"
_TERMINAL_COLUMNS = 80
_NAME_COLUMNS = 25
CEILING_M = (1.0, 10.0)
OVER_THE_CEILING_M = 0.4
"""Distance of the height limit above the ceiling, so that a drifting estimate does not end a
flight."""
FAR_SIGHT_M, NEAR_SIGHT_M, LOW_SEARCH_M = 1.1, 0.5, 1.3
"""The search climbs to `FAR_SIGHT_M` below the ceiling, or to a height of `LOW_SEARCH_M` if that is
higher, but no closer to the ceiling than `NEAR_SIGHT_M`."""
SHOWN_KEYS = (
    "target.large.dictionary",
    "target.large.id",
    "target.small.dictionary",
    "target.small.id",
    "planner.attempts",
    "safety.min_rest_v",
    "safety.min_load_v",
)
"""Keys that are written even with their default values, because they are changed most often."""
HEAD = """\
# A perchctl profile, created by perchctl profile new. The comment above each key
# gives its meaning (unit, allowed values). Body axes: x forward, y left, z up, from
# the vehicle's centre. Keys that are not listed keep their defaults. List all keys:
#   perchctl profile -p {name}

"""

Answers = dict[str, str]
"""The text of each answer, keyed by question or by another key of the profile."""


@command(
    app,
    "perchctl profile new -o my_vehicle.yaml",
    "perchctl profile new --set link.uri=usb://0 --set camera.source=camera:0",
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
            metavar="KEY=VALUE",
            help="Answer a question in advance: any profile key, front or left (an image edge), "
            "or ceiling (m). Repeatable.",
        ),
    ] = None,
    defaults: Annotated[
        bool, typer.Option("--defaults", help="Ask no questions, and use the default answers.")
    ] = False,
    force: ForceOption = False,
) -> None:
    """Create a commented profile for your vehicle in a short dialogue.

    With --defaults, or with --set for every question, perchctl asks no questions. You describe the
    camera's mounting in words: hold a hand over the vehicle's front, then over its left side, and
    say at which edge of the image it appears.
    """
    check_output(output, (".yaml", ".yml"), force, "a profile")
    say_on_terminal("reading the shipped profiles")
    incomplete = [setting for setting in settings or () if "=" not in setting]
    profiles.apply_settings(profiles.Profile(), incomplete)  # raises InvalidValue unless empty
    given = dict(setting.partition("=")[::2] for setting in settings or ())
    profile_and_keys(given, output.stem)  # before the first question
    answers = dict(given)
    for name in [name for name in QUESTIONS if name not in given] if defaults else []:
        answers[name] = default_answer(name, answers)
    if not QUESTIONS.keys() <= answers.keys():
        print_lines(f"A new profile: {output}")
        print_lines(f"Press Enter to accept the value in brackets, or type {BACK} to return.")
        answers = ask_questions(given)
    profile, keys = profile_and_keys(answers, output.stem)
    profile = _with_near_calibration(profile, output)
    shown = shlex.quote(str(output))
    write_files({output: (HEAD.format(name=shown) + profiles.profile_text(profile, keys)).encode()})
    if profile.camera.mirrored:
        say(
            f"camera: with the front at its {answers['front']} and the left side at its "
            f"{answers['left']} edge, the image is mirrored: wrote camera.mirrored: true, "
            "which flips each image before use; if it is not mirrored, answer both "
            "questions again"
        )
    _say_doubts(profiles.load_profile(str(output.absolute())))
    if profile.positioning.source.is_mocap and not profile.positioning.host:
        say(
            "positioning: add system, host and body of your motion capture to the section "
            f"positioning in {output}; docs/positioning.md shows them"
        )
    print(f"wrote {output}\ncheck the plan: perchctl fly -p {shown} --dry-run")


def _with_near_calibration(profile: profiles.Profile, output: Path) -> profiles.Profile:
    """Return the profile with a relative path to the calibration if the calibration file is in the
    folder of `output` or below it, so that both can be moved together."""
    path, folder = Path(profile.camera.calibration), output.absolute().parent.resolve()
    if not (path.is_absolute() and path.is_relative_to(folder)):
        return profile
    return profile.with_({"camera.calibration": str(path.relative_to(folder))})


def default_answer(name: str, answers: Answers) -> str:
    """Return the default answer to a question, given the answers to earlier questions."""
    uri, source = answers.get("link.uri", ""), answers.get("camera.source", "")
    if name == "camera.source" and uri.startswith(SIMULATED):
        return "sim:"
    if name == "camera.calibration" and _is_aideck(source):
        return profiles.load_profile("aideck").camera.calibration
    made = sorted(Path("calib").glob("camera_*.yaml"), key=lambda path: path.stat().st_mtime)
    if name == "camera.calibration" and made and not source.startswith("sim:"):
        return str(made[-1])
    if name == "camera.latency_s" and answers.get("positioning.by") == "target":
        return "measured"  # the position loop depends on it
    if name == "left":
        return left_edges(answers["front"])[0]
    if name == "target.small.side_m":
        # an invalid side of the large marker is rejected later
        with contextlib.suppress(ValueError):
            return f"{max(0.004, float(answers['target.large.side_m']) / 6.0):.4g}"
    return QUESTIONS[name]


def ask_questions(given: Answers) -> Answers:
    """Ask the questions not answered in `given`, each until its answer is valid, then ask the user
    to confirm all answers; return them. Raises UsageError at the end of the input."""
    names = [name for name in QUESTIONS if name not in given]
    before: list[Answers] = [given]
    while True:
        answers, number = before[-1], len(before)
        if number > len(names):
            print_lines(answers_text(answers))
            question, default = f"Write it? Press Enter to write it, or type no or {BACK}:", ""
        else:
            name = names[number - 1]
            default = default_answer(name, answers)
            words = wrap_line(f"{number} of {len(names)}: {WORDS[name]}", _TERMINAL_COLUMNS, 0)
            question = f"{words}\n  [{_shown(name, default)}]"
        try:
            typed = _typed(question)
            if typed.lower() == BACK:
                before = before[: max(1, number - 1)]
            elif number > len(names):
                if typed.lower() in ("", "y", "yes"):
                    return answers
                if typed.lower() in NO:
                    raise UsageError("not confirmed: nothing was written")
                print_lines(f"  found {typed!r}; press Enter, or type no or {BACK}")
            else:
                answered = {**answers, name: _read(name, typed) if typed else default}
                profile_and_keys(answered, "new", option="")
                before.append(answered)
        except (PerchError, UnicodeDecodeError) as error:
            if isinstance(error, UsageError):
                raise
            print_lines(wrap_line(f"  {error}", _TERMINAL_COLUMNS, 2))


def _typed(question: str) -> str:
    try:
        return ask(question).strip()
    except EOFError:
        raise UsageError(
            "the input ended before all questions were answered, so nothing was written: "
            "answer with --set, or add --defaults to use the default answers"
        ) from None


def _read(name: str, typed: str) -> str:
    """Convert typed input, with or without a unit, to the text of a key's value. Raises
    InvalidValue."""
    if name not in MEASURES:
        return typed
    unit, size = MEASURES[name]
    words = re.sub(rf"(?<=[\d.])\s*{unit}(?![a-zA-Z])", " ", typed).replace(",", " ").split()
    if (name, typed) == ("camera.latency_s", "measured"):
        return typed
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InvalidValue(f"found {typed!r}; enter numbers in {unit}") from None
    if size < 1.0 and any(numbers) and all(abs(number) < 1.0 for number in numbers):
        raise InvalidValue(f"found {typed!r}, which is too small: enter numbers in {unit}")
    if size < 1.0:
        low, high = (bound / size for bound in profiles.key_bounds(name))
        if not all(low <= number <= high for number in numbers):
            more = ", or the word measured" if name == "camera.latency_s" else ""
            raise InvalidValue(f"found {typed!r}; allowed are {low:g} to {high:g} {unit}{more}")
    values = [f"{number * size:.12g}" for number in numbers]
    return values[0] if len(values) == 1 else f"[{', '.join(values)}]"


def _shown(name: str, value: str) -> str:
    """Return a key's value as a user would type it."""
    if name not in MEASURES:
        return value
    unit, size = MEASURES[name]
    try:
        numbers = [float(part) / size for part in value.strip("[]").split(",")]
    except ValueError:  # a word, or a number with its unit, as given with --set
        return value
    return f"{' '.join(f'{number:.4g}' for number in numbers)} {unit}"


def answers_text(answers: Answers) -> str:
    """Return the profile's values that the answers set, for confirmation."""
    profile, _ = profile_and_keys(answers, "new")
    mirrored = "mirrored" if profile.camera.mirrored else "not mirrored"
    turn = profile.camera.mount.rpy_deg[2]
    rows = [(name, _shown(name, answers[name])) for name in QUESTIONS if name in answers]
    rows.append(("picture", f"{mirrored}, turned by {turn:g} deg about the vertical axis"))
    return "\n".join(
        wrap_line(f"  {name:<{_NAME_COLUMNS}}{text}", _TERMINAL_COLUMNS, 2 + _NAME_COLUMNS)
        for name, text in rows
    )


def profile_and_keys(
    answers: Answers, name: str, option: str = "--set"
) -> tuple[profiles.Profile, set[str]]:
    """Return the profile that these answers describe, with defaults for unanswered questions, and
    the keys to write to its file. Raises NotFound, InvalidValue, UsageError; each message names the
    key and, if the answers come from the command line, the `option`."""
    texts = {key: text for key, text in answers.items() if key not in EDGES_AND_CEILING}
    if "target.large.side_m" in texts and "target.small.side_m" not in texts:
        texts["target.small.side_m"] = default_answer("target.small.side_m", answers)
    if (calibration := texts.get("camera.calibration")) is not None:
        path = Path(calibration).expanduser()
        texts["camera.calibration"] = str(path.resolve()) if path.is_file() else calibration
        calibrations.load_calibration(profiles.find_calibration(texts["camera.calibration"]))
    if (uri := texts.get("link.uri")) is not None and not (
        links.is_own_uri(uri) and is_extension(uri)
    ):
        links.check_uri(uri)
    if "camera.source" in texts:
        cameras.parse_source(texts["camera.source"])
    if texts.get("camera.source") == "camera:":
        raise InvalidValue("camera.source: found camera:; write camera:N or camera:NAME")
    source = texts.get("camera.source", "")
    derived = {"name": name, **_mount_keys(answers), **_height_keys(answers)}
    if source:
        uri = texts.get("link.uri", SIMULATED)
        derived["description"] = (
            f"a vehicle at {uri}, its camera at {cameras.without_password(source)}"
        )
        derived["camera.readout_s"] = 0.0 if source.startswith("sim:") else None
        derived["link.parameters"] = {"stabilizer.estimator": 2}
    # An AI-deck sends few images, and sends them late, so it needs other values for several keys,
    # not only another calibration.
    base = profiles.load_profile("aideck") if _is_aideck(source) else profiles.Profile()
    shipped = analysis.profile_differences(
        *(p.model_dump(mode="json") for p in (profiles.Profile(), base))
    )
    settings = {key: json.dumps(value) for key, value in derived.items()}
    for key, text in texts.items():
        is_text = isinstance(profiles.profile_value(profiles.Profile(), key), str)
        settings[key] = json.dumps(text) if is_text else text
    profile = profiles.apply_settings(
        base, [f"{key}={text}" for key, text in settings.items()], option
    )
    return profile, {*settings, *shipped, *SHOWN_KEYS} - {"name"}


def _mount_keys(answers: Answers) -> dict[str, Any]:
    """Return the camera's rotation, given the image edges at which the hands appeared. Raises
    InvalidValue."""
    front, left = answers.get("front"), answers.get("left")
    if front is None:
        return {}
    if front not in PICTURE_EDGES:
        raise InvalidValue(f"front: found {front!r}; allowed are {', '.join(PICTURE_EDGES)}")
    left = left or left_edges(front)[0]
    if left not in left_edges(front):
        raise InvalidValue(f"left: found {left!r}; allowed are {', '.join(left_edges(front))}")
    turn_deg, mirrored = yaw_deg_and_mirrored(front, left)
    return {"camera.mount.rpy_deg": (0.0, 0.0, turn_deg), "camera.mirrored": mirrored}


def _height_keys(answers: Answers) -> dict[str, Any]:
    """Return the heights and times that depend on the ceiling. Raises InvalidValue."""
    if "ceiling" not in answers:
        return {}
    try:
        ceiling_m = float(answers["ceiling"].removesuffix("m"))
    except ValueError:
        ceiling_m = math.nan
    low_m, high_m = CEILING_M
    if not low_m <= ceiling_m <= high_m:
        raise InvalidValue(
            f"ceiling: found {answers['ceiling']!r}; allowed are {low_m:g} to {high_m:g} m"
        )
    default = profiles.Profile().planner
    low_search_m = min(LOW_SEARCH_M, ceiling_m - NEAR_SIGHT_M)
    search_m = round(max(low_search_m, ceiling_m - FAR_SIGHT_M), 2)
    most_m = round(ceiling_m + OVER_THE_CEILING_M, 2)
    landing = default.landing
    down_s = most_m / landing.speed_mps * landing.timeout_s / landing.setpoint_time_s
    return {
        "planner.takeoff_height_m": min(0.5, search_m),
        "planner.search.max_height_m": search_m,
        "planner.landing.timeout_s": max(landing.timeout_s, 5.0 * (math.floor(down_s / 5.0) + 1)),
        "safety.max_height_m": most_m,
    }


def _is_aideck(source: str) -> bool:
    return source.lower().startswith("aideck:")


@command(
    app,
    "perchctl profile schema > perchctl.schema.json",
    "perchctl profile schema | python -m json.tool",
    "perchctl profile schema | grep -A 6 latency_s",
)
def schema() -> None:
    """Print the JSON schema of profiles, so that your editor can complete and explain keys."""
    say_on_terminal("listing the keys of a profile")
    print(json.dumps(profiles.json_schema(), indent=2))


# --- The camera's rotation, asked in words: which edge of its image is at the vehicle's front? ---
# Users see the image and the vehicle, but no axes. A hand over the vehicle's front appears at one
# edge of the image, a hand over its left side at another. The two edges determine the camera's
# rotation about its viewing direction and whether the image is mirrored (docs/conventions.md,
# "Camera mount").


PICTURE_EDGES: dict[str, tuple[int, int]] = {
    "top": (0, -1),
    "right": (1, 0),
    "bottom": (0, 1),
    "left": (-1, 0),
}
"""Direction of each edge in the image, x right and y down."""
UPRIGHT = math.cos(math.radians(30.0))


def left_edges(front: str) -> tuple[str, str]:
    """Return the two image edges that can be at the vehicle's left side (in an unmirrored and in a
    mirrored image) if the edge `front` is at the vehicle's front."""
    x, y = PICTURE_EDGES[front]
    plain = next(edge for edge, place in PICTURE_EDGES.items() if place == (-y, x))
    mirrored = next(edge for edge, place in PICTURE_EDGES.items() if place == (y, -x))
    return plain, mirrored


def yaw_deg_and_mirrored(front: str, left: str) -> tuple[float, bool]:
    """Return the yaw in `camera.mount.rpy_deg` of a camera that looks up, and whether its image
    is mirrored. `left` is one of `left_edges(front)`."""
    x, y = PICTURE_EDGES[front]
    mirrored = left == left_edges(front)[1]
    if mirrored:
        x = -x  # a mirrored image is flipped before it is used
    # The front is at the angle a in the image (x right, y down), seen from below, so the yaw is -a.
    turn_deg = -math.degrees(math.atan2(y, x))
    return (180.0 if turn_deg == -180.0 else turn_deg + 0.0), mirrored


def front_left_edges(mount: profiles.Mounting, mirrored: bool) -> tuple[str, str] | None:
    """Return the edges of the raw image at the vehicle's front and left side; None for a camera
    that does not look up, or whose yaw is near an odd multiple of 45 deg."""
    R_cam_body = mount.T_body_cam[:3, :3].T
    if R_cam_body[2, 2] < UPRIGHT:
        return None
    front, left = (_edge(R_cam_body[:2, axis], mirrored) for axis in (0, 1))
    return None if front is None or left is None else (front, left)


def _edge(direction: Array, mirrored: bool) -> str | None:
    x, y = (-direction[0] if mirrored else direction[0]), direction[1]
    return next(
        (e for e, place in PICTURE_EDGES.items() if x * place[0] + y * place[1] >= UPRIGHT), None
    )
