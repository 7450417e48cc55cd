"""The work behind `perchctl fit-weights`: collect, read, fit, verify, report, write."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from perchctl.commands.fit_weights_request import CollectRequest, FitRequest
from perchctl.commands.output import print_record, say
from perchctl.commands.progress import count_bar
from perchctl.errors import Interrupted, InvalidValue, NotFound, PerchError, UsageError
from perchctl.files import check_output, same_file, write_files
from perchctl.profile import Profile, find_weights, load_profile
from perchctl.profile.places import data_folder, user_config_folder
from perchctl.weights.check import check
from perchctl.weights.evidence import FITTED, Fitted, evidence, fit_all, on_other_data
from perchctl.weights.files import write_weights
from perchctl.weights.fit import (
    Errors,
    Sums,
    biases,
    check_determined,
    errors_of,
    odd_positions,
    sums_of,
)
from perchctl.weights.lms import LmsOptions
from perchctl.weights.repeated import refuse_repeated
from perchctl.weights.report import report_text
from perchctl.weights.result import Result, file_content, weights_record
from perchctl.weights.table import chunks_of, read_csv
from perchctl.weights.types import AXES, Measurements, joined

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
    result = fit(options)
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


def fit(options: FitOptions) -> Result:
    """Read all data and fit. Errors: NotFound, InvalidValue."""
    with ExitStack() as stack:
        total = sum(chunks_of(path) for path in options.data)
        advance = stack.enter_context(count_bar("reading [MB]", total))
        parts = [_read(path, advance) for path in options.data]
    tested = None if options.test is None else _read(options.test, lambda: None)
    data = joined(parts)
    refuse_repeated(parts, tested)
    errors = errors_of(data)
    sums = sums_of(errors)
    check_determined(errors, sums)
    with count_bar("fitting", None) as advance:
        fits, runs = fit_all(errors, sums, options.lms, advance)
    proof = evidence(errors, sums, fits)
    other = None if tested is None else on_other_data(errors_of(tested), fits)
    return Result(
        errors=errors,
        sums=sums,
        bias=biases(sums),
        fits=fits,
        runs=runs,
        evidence=proof,
        other=other,
        other_name=str(options.test) if options.test is not None else "",
        chosen=options.method,
        notes=(*data.notes, *_notes(errors, sums, fits)),
        sha256=data.sha256,
    )


def _notes(errors: Errors, sums: Sums, fits: Mapping[str, Fitted]) -> list[str]:
    """Sentences on clipped weights, odd positions, and too few of them."""
    notes = []
    for name, found in fits.items():
        outside = [
            f"{axis} {w:.3f}"
            for axis, w in zip(AXES, found.raw, strict=True)
            if not 0.0 <= w <= 1.0
        ]
        if outside:
            notes.append(f"{name}: clipped to 0 .. 1: {', '.join(outside)}")
    for number, axis, off in odd_positions(errors, sums):
        size = f"{np.degrees(off):.1f} deg" if axis == "yaw" else f"{off * 1e3:.1f} mm"
        notes.append(
            f"position {number}: both markers are off by {size} in {axis} more than elsewhere; "
            f"was its actual pose taken down wrongly?"
        )
    if len(errors.positions) < 5:
        notes.append(
            f"{len(errors.positions)} positions are few: intervals are wide (10 are usual)"
        )
    return notes


def _read(path: Path, advance: Callable[[], None]) -> Measurements:
    if path.suffix.lower() == ".jsonl":
        from perchctl.weights.flight_logs import read_flight_log

        data = read_flight_log(path)
    else:
        data = read_csv(path, advance)
    check(data)
    return data


def _draw(options: FitOptions, result: Result) -> Path | None:
    if options.plot is None:
        return None
    from perchctl.weights.plot import draw_weights

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
    content = file_content(result, date)
    if options.anyway:
        content["weights"] = dict(content["fitted"])
        content["axes"] = dict.fromkeys(AXES, "merged")
    write_weights(target, content)
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
