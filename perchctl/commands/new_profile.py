"""The work behind `perchctl new-profile`: a short dialogue in, a commented profile out."""

from __future__ import annotations

import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from perchctl.camera import profile_record
from perchctl.check import Verdict, profile_rows
from perchctl.commands.new_profile_answers import (
    NONE_YET,
    QUESTIONS,
    Question,
    checked,
    completed,
    example_of,
    made,
    written_for,
)
from perchctl.commands.output import print_record, say, tell
from perchctl.errors import Interrupted, PerchError, UsageError
from perchctl.files import check_output, write_files
from perchctl.profile import Profile, load_profile, picture_edges, profile_text

HEAD = """\
# A profile of perchctl, made by perchctl new-profile. Above each key stands what
# it means (unit, what is allowed). Body axes: x forward, y left, z up, from the
# vehicle's centre. A key that is not here has its default; all of them:
#   perchctl profile -p {name}
# An editor that knows YAML schemas completes keys and shows what they mean with
#   perchctl profile --schema > perchctl.schema.json
# beside this file, and here in a line of its own, behind a #:
#   yaml-language-server: $schema=perchctl.schema.json

"""
Ask = Callable[[str], str]
"""Shows a question and gives the answer; raises KeyboardInterrupt or EOFError."""


@dataclass(frozen=True)
class NewProfileRequest:
    """The command line as it was given; `answers` holds what was answered by options."""

    output: Path
    answers: Mapping[str, str] = field(default_factory=dict)
    defaults: bool = False
    force: bool = False
    as_json: bool = False


def run(request: NewProfileRequest, ask: Ask | None = None) -> int:
    """Ask what no option answers, write the profile; returns the exit code.

    `ask` takes the terminal's place. Errors: InvalidValue, NotFound, UsageError, Interrupted;
    then nothing has been written.
    """
    output = request.output
    check_output(output, (".yaml", ".yml"), request.force, "what a profile is")
    answers = _given(request)
    missing = [question for question in QUESTIONS if question.name not in answers]
    if missing and not request.defaults:
        if ask is None:
            _check_terminal(missing)
        answers = _dialogue(answers, output, ask or _ask_terminal)
    answers = completed(answers)
    profile = made(answers, output)
    text = HEAD.format(name=shlex.quote(str(output))) + profile_text(
        profile, written_for(answers["source"])
    )
    write_files({output: text.encode()})
    _report(request, load_profile(str(output.absolute())), answers)
    return 0


def _given(request: NewProfileRequest) -> dict[str, str]:
    """The options' answers, each checked behind those before it."""
    answers: dict[str, str] = {}
    for question in QUESTIONS:
        if question.name not in request.answers:
            continue
        text = request.answers[question.name].strip()
        try:
            so_far = completed({**answers, question.name: text})
            checked(so_far, question.name, request.output)
        except PerchError as error:
            hint = ""
            if question.name == "left" and "front" not in answers:
                front = completed(answers)["front"]
                hint = f" (this follows from --front-at {front}, the default: give it, too)"
            raise type(error)(f"{question.option}: {error}{hint}") from None
        answers[question.name] = text
    return answers


def _check_terminal(missing: list[Question]) -> None:
    """Raises UsageError where nobody can be asked."""
    if sys.stdin.isatty():
        return
    options = ", ".join(question.option for question in missing)
    raise UsageError(
        f"there is nobody to ask (no terminal): answer by {options}, or add --defaults for what "
        f"is not answered"
    )


def _dialogue(given: Mapping[str, str], output: Path, ask: Ask) -> dict[str, str]:
    """Every question that has no answer yet, again until its answer is one.

    Raises Interrupted (Ctrl-C) and UsageError (no more input), with the command that goes on
    from what was answered."""
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
        raise Interrupted(f"Ctrl-C: {_left(answers, output)}") from None
    except EOFError:
        raise UsageError(f"the input has ended: {_left(answers, output)}") from None
    return answers


def _answer(
    question: Question, before: Mapping[str, str], given: Mapping[str, str], output: Path, ask: Ask
) -> str:
    known = completed({**given, **before})
    default = question.default(known)
    while True:
        text = ask(f"{question.text}{question.hint(known)}\n  [{default}] ").strip() or default
        try:
            checked({**before, question.name: text}, question.name, output)
        except PerchError as error:
            tell(textwrap.fill(str(error), 80, initial_indent="  ", subsequent_indent="    "))
            continue
        return text


def _left(answers: Mapping[str, str], output: Path) -> str:
    """What a dialogue that was left comes to."""
    words = ["perchctl", "new-profile"]
    for question in QUESTIONS:
        if question.name in answers:
            words += [question.option, answers[question.name]]
    if not answers:
        return "nothing was written"
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


def _report(request: NewProfileRequest, profile: Profile, answers: Mapping[str, str]) -> None:
    """What was written, and what in it is doubtful."""
    doubts = [row for row in profile_rows(profile) if row.verdict in (Verdict.WARN, Verdict.FAIL)]
    if answers["calibration"] == NONE_YET:
        doubts = [row for row in doubts if row.name != "calibration file"]
        own = not profile.camera.source.startswith("sim:")
        say(
            f"calibration: none yet: wrote {example_of(profile.camera.source)}, the shipped "
            f"example; "
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
    for row in doubts:
        say(f"{row.name}: {row.found}; {row.advice}")
    if request.as_json:
        print_record({"file": str(request.output), "profile": profile_record(profile)})
        return
    shown = shlex.quote(str(request.output))
    print(f"wrote {request.output}\nlook at the plan: perchctl fly -p {shown} --dry-run")
