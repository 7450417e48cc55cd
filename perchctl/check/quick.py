"""The part of the check that costs no time: what `fly` asks before it connects."""

from __future__ import annotations

from perchctl.calibration import profile_camera
from perchctl.check import computer
from perchctl.check.profile import profile_rows
from perchctl.check.row import Row, Verdict
from perchctl.errors import SafetyAbort
from perchctl.flight import FlyOptions


def rows(options: FlyOptions) -> list[Row]:
    """Of the computer's disk and the profile. Opens no link and no camera."""
    return [
        computer.disk_row(options.log_dir),
        *profile_rows(options.profile, uri=options.uri, source=options.source),
    ]


def warnings_before_flight(options: FlyOptions) -> list[str]:
    """A sentence for each row that warns. Errors: SafetyAbort for the first that fails; of the
    calibration's file InvalidValue, NotFound."""
    profile_camera(options.profile.camera)
    found = rows(options)
    for row in found:
        if row.verdict is Verdict.FAIL:
            raise SafetyAbort(_sentence(row))
    return [_sentence(row) for row in found if row.verdict is Verdict.WARN]


def _sentence(row: Row) -> str:
    return f"{row.name}: {row.found}: {row.advice}"
