"""Whether this computer keeps the loop, and has room for the log."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import Row, by_limits, failed, passed, skipped, worse
from perchctl.profile import Profile

WORK_WARN, WORK_FAIL = 0.7, 1.0
"""95 of 100 pictures take at most so much of the time between two."""
LATE_SHARE_WARN, LATE_SHARE_FAIL = 0.05, 0.3
"""Of the turns that begin later than half a period."""
LEAST_RATED = 10
LEAST_FREE_BYTES, FEW_FREE_BYTES = 50_000_000, 500_000_000
"""A flight's log has some 5 MB a minute."""


def loop_row(rehearsal: Rehearsal | None, profile: Profile) -> Row:
    """Of the rehearsal: the time for a picture against that between two, and late turns."""
    if rehearsal is None or len(rehearsal.work_s) < LEAST_RATED:
        return skipped("loop", "no pictures to rehearse with")
    if not rehearsal.live:
        return skipped("loop", "a recording comes as fast as it is read")
    work_s = percentile(rehearsal.work_s, 0.95)
    period_s = frame_period_s(rehearsal) or 1.0 / profile.link.loop_hz
    half_s = 0.5 / profile.link.loop_hz
    late = sum(late_s > half_s for late_s in rehearsal.late_s) / len(rehearsal.late_s)
    latest_s = max(rehearsal.late_s)
    found = (
        f"{1e3 * work_s:.0f} ms a picture of {1e3 * period_s:.0f}, "
        f"{100.0 * late:.0f} % of the turns late, at most {1e3 * latest_s:.0f} ms"
    )
    advice = "close other programs, use a smaller picture, or a faster computer"
    if latest_s > profile.safety.loop_late_hold_s:
        return failed("loop", found, advice)
    by_work = by_limits("loop", work_s / period_s, WORK_WARN, WORK_FAIL, found, advice)
    by_late = by_limits("loop", late, LATE_SHARE_WARN, LATE_SHARE_FAIL, found, advice)
    return worse(by_work, by_late)


def frame_period_s(rehearsal: Rehearsal) -> float | None:
    """Between two pictures; None of too few, or of a recording."""
    arrivals = rehearsal.arrivals
    if not rehearsal.live or len(arrivals) < 2:
        return None
    (first, begin_s), (last, end_s) = arrivals[0], arrivals[-1]
    return (end_s - begin_s) / (last - first) if last > first else None


def percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def disk_row(folder: Path) -> Row:
    """Of the disk that the log's folder is on, or will be."""
    try:
        usage = shutil.disk_usage(_there(folder))
    except OSError as error:
        return skipped("disk", f"not told ({error.strerror or error})")
    if not usage.total:
        return skipped("disk", f"{_there(folder)} is on none")
    free = usage.free
    found = f"{free / 1e9:.1f} GB free" if free >= 1e9 else f"{free / 1e6:.0f} MB free"
    advice = "free some space: a flight's log has some 5 MB a minute"
    return by_limits("disk", -free, -FEW_FREE_BYTES, -LEAST_FREE_BYTES, found, advice)


def log_folder_row(folder: Path) -> Row:
    """Nothing is made there."""
    there = _there(folder)
    advice = "name another with --log-dir, or set log.directory"
    if not os.path.isdir(there):
        return failed("log folder", f"{there} is a file", advice)
    if not os.access(there, os.W_OK | os.X_OK):
        return failed("log folder", f"no right to write in {there}", advice)
    return passed("log folder", f"{folder} can be written" + ("" if there == folder else " (new)"))


def _there(folder: Path) -> Path:
    """The folder, or the nearest above it that exists."""
    whole = folder.absolute()
    return folder if folder.exists() else next(p for p in whole.parents if p.exists())
