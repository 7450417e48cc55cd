"""The fit from data files: all that it found out, as one value, one JSON record, and the weights
file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import ValidationError

from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.geometry import Array, rotation_from_rpy
from perchctl.log import FlightLog, read_log
from perchctl.profile import Profile
from perchctl.sim import Scenario, draw_scenario
from perchctl.weights.check import check
from perchctl.weights.evidence import (
    FITTED,
    SINGLE,
    Evidence,
    Fitted,
    evidence,
    fit_all,
    on_other_data,
)
from perchctl.weights.fit import (
    Bias,
    Errors,
    Sums,
    biases,
    check_determined,
    errors_of,
    odd_positions,
    sums_of,
)
from perchctl.weights.lms import LmsOptions, LmsRun
from perchctl.weights.table import chunks_of, read_csv
from perchctl.weights.types import AXES, PAPER_WEIGHTS, SOURCES, UNITS, Measurements, joined, wrap

FORMAT = "perchctl-merge-weights"
_HEAD = """\
# Merge weights of the large marker (the small one's are 1 - w), fitted by perchctl
# fit-weights. Named by a profile: merge: {method: weights, weights_file: THIS_FILE}
"""
Bar = Callable[[str, int | None], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class Result:
    """All that a fit found out. `chosen` names the method whose weights are offered."""

    errors: Errors
    sums: Sums
    bias: dict[str, Bias]
    fits: dict[str, Fitted]
    runs: dict[str, LmsRun]
    evidence: Evidence
    other: Evidence | None
    other_name: str
    chosen: str
    notes: tuple[str, ...]
    sha256: str

    @property
    def proven(self) -> list[bool]:
        return [bool(p) for p in self.evidence.proven[self.chosen]]

    @property
    def recommended(self) -> Array:
        """The weights to fly with: the fitted ones where they are proven to beat the
        better single marker, elsewhere that marker alone, (4,)."""
        alone = np.where(self.evidence.better == 0, 1.0, 0.0)
        return np.where(self.proven, self.fits[self.chosen].weights, alone)


def fit_weights(
    paths: Sequence[Path], lms: LmsOptions, chosen: str, test: Path | None, bar: Bar
) -> Result:
    """Read all data and fit the weights to it by each method; `chosen` is the one that is
    offered, `test` other data to judge it by. `bar` shows progress. Errors: NotFound,
    InvalidValue."""
    with bar("reading [MB]", sum(chunks_of(path) for path in paths)) as advance:
        parts = [_read(path, advance) for path in paths]
    tested = None if test is None else _read(test, lambda: None)
    data = joined(parts)
    refuse_repeated(parts, tested)
    errors = errors_of(data)
    sums = sums_of(errors)
    check_determined(errors, sums)
    with bar("fitting", None) as advance:
        fits, runs = fit_all(errors, sums, lms, advance)
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
        other_name=str(test) if test is not None else "",
        chosen=chosen,
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
    logged = path.suffix.lower() == ".jsonl"
    data = read_flight_log(path) if logged else read_csv(path, advance)
    check(data)
    return data


def by_axis(values: Array) -> dict[str, float | None]:
    return {
        axis: float(value) if math.isfinite(value) else None
        for axis, value in zip(AXES, values, strict=True)
    }


def weights_record(result: Result) -> dict[str, Any]:
    """The one object of `--json`. Lengths in m, angles in rad."""
    found: dict[str, Any] = {name: by_axis(result.fits[name].weights) for name in FITTED}
    found["paper"] = dict(zip(AXES, PAPER_WEIGHTS, strict=True))
    found["method"] = result.chosen
    found["recommended"] = by_axis(result.recommended) if any(result.proven) else None
    found["proven"] = dict(zip(AXES, result.proven, strict=True))
    found["better_single"] = {
        axis: SINGLE[int(i)] for axis, i in zip(AXES, result.evidence.better, strict=True)
    }
    found["intervals"] = {
        name: {axis: [lo, hi] for (axis, lo), hi in zip(
            by_axis(result.fits[name].low).items(), by_axis(result.fits[name].high).values(),
            strict=True,
        )}
        for name in FITTED
    }  # fmt: skip
    found["errors"] = _errors_record(result.evidence)
    if result.other is not None:
        found["test"] = {"file": result.other_name, "errors": _errors_record(result.other)}
    found["bias"] = {name: by_axis(bias.mean) for name, bias in result.bias.items()}
    found["bias_half_width"] = {
        name: by_axis(bias.half_width) for name, bias in result.bias.items()
    }
    found["outliers"] = {axis: int(k) for axis, k in zip(AXES, result.errors.outliers, strict=True)}
    found["lms_run"] = {
        "passes": result.runs["lms"].passes,
        "rows": int(result.runs["lms"].rows[-1]),
        "moved_in_second_half": by_axis(result.runs["lms"].moved),
    }
    found["data"] = {
        "file": result.errors.name,
        "sha256": result.sha256,
        "rows": len(result.errors),
        "positions": len(result.errors.positions),
    }
    found["notes"] = list(result.notes)
    return found


def _errors_record(evidence: Evidence) -> dict[str, Any]:
    """By method its RMS, (x, y, z, yaw), the interval, and the gain over the better
    single marker with its interval."""
    return {
        name: {
            **by_axis(method.rms),
            "low": by_axis(method.low),
            "high": by_axis(method.high),
            "gain": by_axis(method.gain),
            "gain_low": by_axis(method.gain_low),
            "gain_high": by_axis(method.gain_high),
        }
        for name, method in evidence.methods.items()
    }


def write_weights(path: Path, result: Result, date: str, *, anyway: bool) -> None:
    """Write the weights file: those that are recommended, or, `anyway`, all that were fitted.
    Errors: InvalidValue when it cannot be written; the old one then stays."""
    content = _file_content(result, date)
    if anyway:
        content["weights"] = dict(content["fitted"])
        content["axes"] = dict.fromkeys(AXES, "merged")
    text = _HEAD + yaml.safe_dump({"format": FORMAT, **content}, sort_keys=False)
    write_files({path: text.encode("utf-8")})


def _file_content(result: Result, date: str) -> dict[str, Any]:
    """What a weights file holds. Errors in m and rad, on positions not fitted to."""
    rounded = {axis: round(float(w), 6) for axis, w in by_axis(result.recommended).items() if w
               is not None}  # fmt: skip
    fitted = result.fits[result.chosen]
    return {
        "date": date,
        "method": result.chosen,
        "weights": rounded,
        "axes": {
            axis: "merged" if proven else f"{SINGLE[int(better)]} alone"
            for axis, proven, better in zip(
                AXES, result.proven, result.evidence.better, strict=True
            )
        },
        "fitted": {axis: round(float(w), 6) for axis, w in zip(AXES, fitted.weights, strict=True)},
        "data": {
            "file": result.errors.name,
            "sha256": result.sha256,
            "rows": len(result.errors),
            "positions": len(result.errors.positions),
        },
        "errors": {
            name: {
                f"{axis}_{unit}": float(f"{value:.6g}")
                for axis, unit, value in zip(AXES, UNITS, method.rms, strict=True)
            }
            for name, method in result.evidence.methods.items()
        },
    }


# --- Rows that are there twice: they would narrow the intervals, and are no more evidence ------


_MIX = 0x9E3779B97F4A7C15  # odd: its powers mix all bits


def refuse_repeated(parts: Sequence[Measurements], test: Measurements | None = None) -> None:
    """Raises InvalidValue where a file, or a row, is named twice; `test` is the data that the
    fit is judged by, and must hold none of the others' rows."""
    files = [*parts, test] if test is not None else list(parts)
    why = "the same rows twice are no more evidence"
    for number, part in enumerate(files):
        if part is test:
            why = "--test judges by other data than was fitted to"
        for before in files[:number]:
            if part.sha256 == before.sha256:
                both = f"{before.name} and {part.name} hold the same data"
                same = f"{part.name} is named twice" if part.name == before.name else both
                raise InvalidValue(f"{same}: {why}; name it once")
    found = _first_again(files)
    if found is not None:
        (file, row), (old_file, old_row), count = found
        part, before = files[file], files[old_file]
        others = f" and {count - 1} more likewise" if count > 1 else ""
        raise InvalidValue(
            f"{part.name}: line {int(part.line[row])}: this row stands in line "
            f"{int(before.line[old_row])} of {before.name} too{others}: "
            f"{why}; take out what is there twice"
        )


def _first_again(
    files: Sequence[Measurements],
) -> tuple[tuple[int, int], tuple[int, int], int] | None:
    """(file, row) of the first row that was there before, where it was, and how many such
    rows there are."""
    values = np.concatenate([_values(part) for part in files])
    rows = np.arange(len(values))
    _, first, group = np.unique(_hashes(values), return_index=True, return_inverse=True)
    before = first[group]
    again = (before != rows) & (values == values[before]).all(axis=1)
    lengths = [len(part) for part in files]
    file = np.repeat(np.arange(len(files)), lengths)
    # Without times, rows of one position may well come out equal: rounded, of a camera at rest.
    timeless = np.array([float(np.ptp(part.t_s)) == 0.0 for part in files])
    position = np.concatenate([part.position for part in files])
    alike = (file == file[before]) & (position == position[before]) & timeless[file]
    again &= ~alike
    if not again.any():
        return None
    starts = np.concatenate([[0], np.cumsum(lengths)])
    row = int(np.argmax(again))
    there, old = int(file[row]), int(file[before[row]])
    return (
        (there, row - int(starts[there])),
        (old, int(before[row] - starts[old])),
        int(again.sum()),
    )


def _values(part: Measurements) -> Array:
    """Time and poses of each row, (n, 13); what was not seen is 0."""
    poses = [np.nan_to_num(getattr(part, source)) for source in SOURCES]
    return np.ascontiguousarray(np.column_stack([part.t_s, *poses]) + 0.0)


def _hashes(values: Array) -> NDArray[np.uint64]:
    factors = np.array(
        [pow(_MIX, k, 1 << 64) for k in range(1, values.shape[1] + 1)], dtype=np.uint64
    )
    bits = values.view(np.uint64)
    mixed: NDArray[np.uint64] = (bits ^ (bits >> np.uint64(29))) * factors
    sums: NDArray[np.uint64] = mixed.sum(axis=1, dtype=np.uint64)
    return sums


# --- Flight logs with truth as data: the simulator's, flown in lockstep ------------------------
# Such a log holds the true position of the body; the target's true place follows from the
# profile and seed in its header. Each stretch of `STRETCH_S` with both markers in sight
# counts as one position. The heading's truth is the vehicle's own estimate, which does not
# drift in the simulator; roll and pitch are the estimate's too.


STRETCH_S = 1.0
LEAST_ROWS = 5
"""A stretch with fewer frames of both markers is too little evidence."""


def read_flight_log(path: Path) -> Measurements:
    """The frames with both markers. Errors: NotFound, InvalidValue (no log, no truth)."""
    log = read_log(path)
    scenario, later_s = _truth_of(log)
    # With `camera.latency_s: measured` the flight has taken some of it off already.
    ahead_s = later_s + np.nan_to_num(log.column("delay_used_s"))
    t_s = log.column("t_s")
    frame_s = log.column("frame_t_s")
    poses = {name: _poses(log, name[0]) for name in ("large", "small", "joint")}
    both = np.isfinite(poses["large"]).all(axis=1) & np.isfinite(poses["small"]).all(axis=1)
    actual = _actual(log, scenario, t_s, frame_s + ahead_s)
    rows = np.flatnonzero(both & np.isfinite(actual).all(axis=1))
    if not len(rows) and np.isfinite(poses["joint"]).any():
        raise InvalidValue(
            f"{path}: line 1: both markers were only solved jointly in this flight; fly it with "
            f"pose.each_marker: true (or merge.method: weights) in the profile"
        )
    if not len(rows):
        raise InvalidValue(
            f"{path}: lines 2 to {len(log.records) + 1}: no tick with the truth holds both markers"
        )
    position = np.floor((frame_s[rows] - frame_s[rows][0]) / STRETCH_S).astype(np.int64)
    numbers, counts = np.unique(position, return_counts=True)
    kept = np.isin(position, numbers[counts >= LEAST_ROWS])
    rows, position = rows[kept], position[kept]
    if not len(rows):
        raise InvalidValue(
            f"{path}: line 2: no stretch of {STRETCH_S:g} s holds {LEAST_ROWS} frames with both "
            f"markers"
        )
    joint = poses["joint"][rows]
    return Measurements(
        name=str(path),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        position=position,
        t_s=frame_s[rows],
        large=poses["large"][rows],
        small=poses["small"][rows],
        actual=actual[rows],
        joint=None if np.isnan(joint).all() else joint,
        line=rows.astype(np.int64) + 2,
        notes=(f"{path}: heading and tilt of the truth are the vehicle's own estimate",),
    )


def _truth_of(log: FlightLog) -> tuple[Scenario, float]:
    """The scenario that was flown, and how much later than logged the frames were taken."""
    if not np.isfinite(log.column("true_x_m")).any():
        raise InvalidValue(
            f"{log.path}: line 2: no truth in this log (true_x_m is missing): only logs of "
            f"lockstep flights hold it (perchctl simulate --only SEED --log-dir DIR); --collect a "
            f"session of a real vehicle"
        )
    header: dict[str, Any] = log.header
    try:
        profile = Profile.model_validate(header["profile"])
        scenario = draw_scenario(profile, int(header["seed"]))
    except (KeyError, TypeError, ValueError, ValidationError):
        raise InvalidValue(
            f"{log.path}: line 1: the profile and seed of the header do not give the scenario"
        ) from None
    return scenario, profile.camera.start_latency_s - scenario.camera_latency_s


def _poses(log: FlightLog, short: str) -> Array:
    return np.stack(
        [log.column(f"{short}{axis}_{unit}") for axis, unit in zip(AXES, UNITS, strict=True)],
        axis=1,
    )


def _actual(log: FlightLog, scenario: Scenario, t_s: Array, at_s: Array) -> Array:
    """The target relative to the gear in the level frame at the frames' times, (n, 4)."""
    known = np.isfinite(log.column("true_x_m")) & np.isfinite(log.column("roll_rad"))
    when = np.where(np.isfinite(at_s), at_s, t_s)

    def at_frame(key: str) -> Array:
        values = log.column(key)[known]
        if key == "yaw_rad":
            values = np.unwrap(values)
        return np.interp(when, t_s[known], values, left=math.nan, right=math.nan)

    body = np.stack([at_frame(f"true_{axis}_m") for axis in "xyz"], axis=1)
    roll, pitch, yaw = (at_frame(key) for key in ("roll_rad", "pitch_rad", "yaw_rad"))
    target = np.array([*scenario.target_xy_m, scenario.ceiling_z_m])
    gear = np.asarray(scenario.gear_body_m)
    actual = np.full((len(t_s), 4), math.nan)
    for row in np.flatnonzero(np.isfinite(at_s) & np.isfinite(body).all(axis=1)):
        c, s = math.cos(yaw[row]), math.sin(yaw[row])
        x, y, z = target - body[row]
        level = np.array([c * x + s * y, -s * x + c * y, z])
        tilt = rotation_from_rpy(float(roll[row]), float(pitch[row]), 0.0)
        actual[row, :3] = level - tilt @ gear
        actual[row, 3] = wrap(scenario.target_yaw_rad - yaw[row])
    return actual
