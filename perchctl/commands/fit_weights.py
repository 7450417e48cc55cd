"""The work behind `perchctl fit-weights`: collect, read, fit, verify, report, write."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from perchctl.commands.fit_weights_request import CollectRequest, FitRequest
from perchctl.commands.output import print_record, say
from perchctl.commands.progress import count_bar
from perchctl.errors import Interrupted, InvalidValue, NotFound, PerchError, UsageError
from perchctl.files import check_output, same_file, write_files
from perchctl.places import data_folder, user_config_folder
from perchctl.profile import Profile, find_weights, load_profile
from perchctl.weights import (
    FITTED,
    LmsOptions,
    Result,
    fit_weights,
    report_text,
    weights_record,
    write_weights,
)

__all__ = ["CollectRequest", "FitRequest", "run"]


@dataclass(frozen=True)
class FitOptions:
    """The command line on top of the profile, checked."""

    profile: Profile
    data: tuple[Path, ...]
    lms: LmsOptions
    method: str = "closed_form"
    test: Path | None = None
    output: Path | None = None
    plot: Path | None = None
    as_json: bool = False
    anyway: bool = False
    force: bool = False


def run(request: FitRequest) -> int:
    """Collect, fit, print, draw, write; returns the exit code.

    Errors: NotFound, InvalidValue, UsageError; those of collecting. What goes wrong once the
    weights are known is said beside them.
    """
    options = resolve(request)
    session = request.collecting.session
    if session is not None:
        from perchctl.commands.fit_weights_collect import collect

        collect(request.collecting, session)
    result = fit_weights(options.data, options.lms, options.method, options.test, count_bar)
    if not options.as_json:
        print(report_text(result), flush=True)
    plot, file, problem = None, None, None
    try:
        plot = _draw(options, result)
        file = _write(options, result)
    except (PerchError, KeyboardInterrupt) as error:
        problem = error if isinstance(error, PerchError) else Interrupted("Ctrl-C: nothing written")
        say(str(problem))
    code = 0 if problem is None else problem.exit_code
    if options.as_json:
        paths = {"weights_file": file and str(file), "plot": plot and str(plot)}
        failure = {} if problem is None else {"error": str(problem), "exit_code": code}
        print_record(weights_record(result) | paths | failure)
    return code


def resolve(request: FitRequest) -> FitOptions:
    """What can be refused before any work. Errors: NotFound, InvalidValue, UsageError."""
    session = request.collecting.session
    data = request.data if session is None else (*request.data, session)
    if request.method not in FITTED:
        allowed = ", ".join(FITTED)
        raise InvalidValue(f"--method {request.method!r} is unknown; allowed are {allowed}")
    if request.order not in ("shuffled", "recorded"):
        raise InvalidValue(
            f"--order {request.order!r} is unknown; allowed are shuffled and recorded"
        )
    twice = [path for k, path in enumerate(data) if any(same_file(path, o) for o in data[:k])]
    if twice:
        raise InvalidValue(
            f"{twice[0]} is named twice: the same rows twice are no more evidence; name it once"
        )
    for target, suffixes in ((request.output, (".yaml", ".yml")), (request.plot, (".png",))):
        if target is None:
            continue
        if any(same_file(target, source) for source in data):
            raise UsageError(f"{target} is the data itself; write the result to another file")
        check_output(target, suffixes, request.force)
    return FitOptions(
        # The weights file may not be there yet: this command makes it.
        profile=load_profile(request.profile, with_weights=False),
        data=data,
        lms=LmsOptions(
            request.step,
            request.passes,
            "shuffled" if request.order == "shuffled" else "recorded",
            request.start,
        ),
        method=request.method,
        test=request.test,
        output=request.output,
        plot=request.plot,
        as_json=request.as_json,
        anyway=request.anyway,
        force=request.force,
    )


def _draw(options: FitOptions, result: Result) -> Path | None:
    if options.plot is None:
        return None
    from perchctl.weights import draw_weights  # matplotlib takes a second to load

    write_files({options.plot: draw_weights(result)})
    say(f"plot: {options.plot}")
    return options.plot


def _write(options: FitOptions, result: Result) -> Path | None:
    """The weights file, where one is written. Raises PerchError where `-o` names one, and the
    weights are not recommended."""
    target = options.output or _named_by(options)
    recommended = any(result.proven)
    if target is None:
        say(
            "no file written: name one with -o, or in the profile (merge.weights_file)"
            if recommended
            else "no file written: the weights are not recommended"
        )
        return None
    if target.exists() and not options.force:
        say(f"{target} exists already and stays as it is; add --force to replace it")
        return None
    if not recommended and not options.anyway:
        sentence = (
            f"{target} not written: on no axis do the weights beat the better single marker beyond "
            f"the interval; take more positions, or write them all the same with --anyway"
        )
        if options.output is not None:
            raise PerchError(sentence)
        say(sentence)
        return None
    date = datetime.now(UTC).isoformat(timespec="seconds")
    write_weights(target, result, date, anyway=options.anyway)
    say(f"weights: {target}")
    if options.profile.merge.method != "weights":
        say(
            f"profile {options.profile.name} merges by {options.profile.merge.method}: these "
            f"weights fly with merge.method: weights and merge.weights_file: {target.name}"
        )
    return target


def _named_by(options: FitOptions) -> Path | None:
    """Where the profile's weights file is, or shall be."""
    name = options.profile.merge.weights_file
    if name is None:
        return None
    try:
        return find_weights(name)
    except NotFound:
        missing = Path(name)
        if missing.parent == data_folder("profiles").resolve():
            return user_config_folder() / "weights" / missing.name
        return missing
