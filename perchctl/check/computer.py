"""Whether this computer keeps the loop, and has room for the log."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from perchctl.check.camera import LEAST_RATED, percentile
from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import Finding, by_limits, failed, passed, skipped, worst
from perchctl.profile import Profile


def loop_finding(rehearsal: Rehearsal | None, profile: Profile) -> Finding:
    """Judge the loop by a rehearsal: the time for a picture against that between two, and the turns
    that begin later than half a period."""
    if rehearsal is None or len(rehearsal.work_s) < LEAST_RATED:
        return skipped("no pictures to rehearse with")
    if not rehearsal.live:
        return skipped("a recording comes as fast as it is read")
    work_s = percentile(rehearsal.work_s, 0.95)
    turn_s = 1.0 / profile.link.loop_hz
    period_s = rehearsal.frame_period_s or turn_s
    late = sum(late_s > turn_s / 2.0 for late_s in rehearsal.late_s) / len(rehearsal.late_s)
    latest_s = max(rehearsal.late_s)
    found = (
        f"{1e3 * work_s:.0f} ms a picture of {1e3 * period_s:.0f}, "
        f"{100.0 * late:.0f} % of the turns late, at most {1e3 * latest_s:.0f} ms"
    )
    advice = "close other programs, use a smaller picture, or a faster computer"
    if latest_s > profile.safety.loop_late_hold_s:
        return failed(found, advice)
    return worst(
        by_limits(work_s / period_s, 0.7, 1.0, found, advice),
        by_limits(late, 0.05, 0.3, found, advice),
    )


def disk_finding(folder: Path) -> Finding:
    """Judge the free space of the disk that the log's folder is on, or will be."""
    try:
        usage = shutil.disk_usage(_existing(folder))
    except OSError as error:
        return skipped(f"not known ({error.strerror or error})")
    if not usage.total:
        return skipped(f"{_existing(folder)} is on none")
    free = usage.free
    found = f"{free / 1e9:.1f} GB free" if free >= 1e9 else f"{free / 1e6:.0f} MB free"
    advice = "free some space: a flight's log has some 5 MB a minute"
    return by_limits(-free, -500e6, -50e6, found, advice)


def log_folder_finding(folder: Path) -> Finding:
    """Judge whether logs can be written to the folder, without making it."""
    there = _existing(folder)
    advice = "name another with --log-dir, or set log.directory"
    if not os.path.isdir(there):
        return failed(f"{there} is a file", advice)
    if not os.access(there, os.W_OK | os.X_OK):
        return failed(f"no right to write in {there}", advice)
    return passed(f"{folder} can be written" + ("" if there == folder else " (new)"))


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest above it that exists."""
    whole = folder.absolute()
    return folder if folder.exists() else next(p for p in whole.parents if p.exists())
