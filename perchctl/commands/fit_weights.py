"""The work behind `perchctl fit-weights`: read, fit, prove, report, write."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from perchctl.commands.progress import count_bar
from perchctl.errors import InvalidValue, NotFound, PerchError, UsageError
from perchctl.files import same_file, write_files
from perchctl.profile import Profile, find_profile, find_weights, load_profile
from perchctl.profile.places import data_folder, user_config_folder
from perchctl.weights.check import check
from perchctl.weights.evidence import FITTED, evidence, fit_all, on_other_data
from perchctl.weights.files import write_weights
from perchctl.weights.fit import biases, check_determined, errors_of, odd_positions, sums_of
from perchctl.weights.lms import LmsOptions
from perchctl.weights.report import Result, as_object, file_content, text
from perchctl.weights.table import chunks_of, read_csv
from perchctl.weights.types import AXES, Measurements, joined


@dataclass(frozen=True)
class FitOptions:
    """What the command line asked for, after collecting."""

    profile: Profile
    profile_path: Path
    data: tuple[Path, ...]
    lms: LmsOptions
    method: str = "closed_form"
    test: Path | None = None
    out: Path | None = None
    plot: Path | None = None
    as_json: bool = False
    anyway: bool = False


def resolve(
    data: list[Path],
    profile_name: str,
    *,
    method: str,
    step: float | None,
    passes: int | None,
    order: str,
    start: float,
    test: Path | None,
    out: Path | None,
    plot: Path | None,
    as_json: bool,
    anyway: bool,
) -> FitOptions:
    """The command line on top of the profile. Errors: NotFound, InvalidValue."""
    if method not in FITTED:
        raise InvalidValue(f"--method {method!r} is unknown; allowed are {', '.join(FITTED)}")
    if order not in ("shuffled", "recorded"):
        raise InvalidValue(f"--order {order!r} is unknown; allowed are shuffled and recorded")
    if plot is not None and plot.suffix.lower() != ".png":
        raise InvalidValue(f"--plot {plot} must end in .png")
    for target in (out, plot):
        if target is not None and any(same_file(target, source) for source in data):
            raise UsageError(f"{target} is the data itself; write the result to another file")
    return FitOptions(
        # The weights file may not be there yet: this command makes it.
        profile=load_profile(profile_name, with_weights=False),
        profile_path=find_profile(profile_name),
        data=tuple(data),
        lms=LmsOptions(step, passes, "shuffled" if order == "shuffled" else "recorded", start),
        method=method,
        test=test,
        out=out,
        plot=plot,
        as_json=as_json,
        anyway=anyway,
    )


def run(options: FitOptions) -> None:
    """Fit, print, draw, write. Errors: NotFound, InvalidValue, PerchError when weights
    that are not recommended were to be written."""
    result = fit(options)
    if options.plot is not None:
        from perchctl.weights.plot import draw_weights

        write_files({options.plot: draw_weights(result)})
    if options.as_json:
        print(json.dumps(as_object(result), allow_nan=False))
    else:
        print(text(result))
    if options.plot is not None:
        _say(f"plot: {options.plot}")
    _write(options, result)


def fit(options: FitOptions) -> Result:
    """Read all data and fit. Errors: NotFound, InvalidValue."""
    with ExitStack() as stack:
        total = sum(chunks_of(path) for path in options.data)
        advance = stack.enter_context(count_bar("reading [MB]", total))
        data = joined([_read(path, advance) for path in options.data])
    errors = errors_of(data)
    sums = sums_of(errors)
    check_determined(errors, sums)
    with count_bar("fitting", None) as advance:
        fits, runs = fit_all(errors, sums, options.lms, advance)
    proof = evidence(errors, sums, fits)
    other = None
    if options.test is not None:
        other_errors = errors_of(_read(options.test, lambda: None))
        other = on_other_data(other_errors, fits)
    notes = list(data.notes)
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
        notes=tuple(notes),
        sha256=data.sha256,
    )


def _read(path: Path, advance: Callable[[], None]) -> Measurements:
    if path.suffix.lower() == ".jsonl":
        from perchctl.weights.flight_logs import read_flight_log

        data = read_flight_log(path)
    else:
        data = read_csv(path, advance)
    check(data)
    return data


def _write(options: FitOptions, result: Result) -> None:
    target = options.out or _named_by(options)
    if target is None:
        if any(result.proven):
            _say("no file written: name one with -o, or in the profile (merge.weights_file)")
        return
    if not any(result.proven) and not options.anyway:
        sentence = (
            f"{target} not written: on no axis do the weights beat the better single marker beyond "
            f"the interval; take more positions, or write them all the same with --anyway"
        )
        if options.out is not None:
            raise PerchError(sentence)
        _say(sentence)
        return
    date = datetime.now(UTC).isoformat(timespec="seconds")
    content = file_content(result, date)
    if options.anyway:
        content["weights"] = dict(content["fitted"])
        content["axes"] = dict.fromkeys(AXES, "merged")
    aside = write_weights(target, content)
    kept = "" if aside is None else f" (the old one is kept as {aside.name})"
    _say(f"weights: {target}{kept}")
    if options.profile.merge.method != "weights":
        _say(
            f"profile {options.profile.name} merges by {options.profile.merge.method}: these "
            f"weights fly with merge.method: weights and merge.weights_file: {target.name}"
        )


def _named_by(options: FitOptions) -> Path | None:
    """Where the profile's weights file is, or shall be."""
    name = options.profile.merge.weights_file
    if name is None:
        return None
    try:
        return find_weights(name, options.profile_path)
    except NotFound:
        given = Path(name).expanduser()
        if given.is_absolute():
            return given
        folder = options.profile_path.resolve().parent
        if folder == data_folder("profiles").resolve():
            folder = user_config_folder() / "weights"
        return folder / name


def _say(sentence: str) -> None:
    print(f"perchctl: {sentence}", file=sys.stderr)
