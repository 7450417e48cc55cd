"""The work behind `perchctl log replay`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.log_file import log_file, opened
from perchctl.commands.log_plot import DRAWN_IN, FORMATS
from perchctl.commands.output import print_record, say
from perchctl.errors import ReplayDiffers
from perchctl.files import check_output
from perchctl.log import FlightLog, flown_profile, recorded_pictures, recording_path
from perchctl.profile import Profile, changed_profile, load_profile
from perchctl.replay import (
    Picture,
    changed_gates,
    check_readable,
    pose_changes,
    replay,
    replay_lines,
    replay_record,
)


@dataclass(frozen=True)
class ReplayRequest:
    """The command line as it was given; None is not given."""

    file: Path | None = None
    settings: tuple[str, ...] = ()
    profile: str | None = None
    pictures: bool = True
    output: Path | None = None
    force: bool = False
    as_json: bool = False


def run(request: ReplayRequest) -> int:
    """Replay and say what came of it; returns the exit code. Errors: NotFound, InvalidValue,
    UsageError."""
    path = log_file(request.file, None, None)
    if request.output is not None:
        check_output(request.output, FORMATS, request.force, DRAWN_IN)
    with opened(path) as log:
        wanted = _profile(request, log)
        check_readable(log)
    found = replay(log, _pictures(request, path), wanted)
    if wanted is not None and not found.changed:
        say("nothing was changed: that is what was flown")
    gates = changed_gates(found) if found.changed else []
    changes = pose_changes(found) if found.changed else []
    if request.output is not None:
        from perchctl.replay import plot_replay

        plot_replay(found, request.output)
    if request.as_json:
        plot = None if request.output is None else str(request.output)
        print_record(replay_record(found, gates, changes) | {"plot": plot})
    else:
        for note in found.notes:
            say(note)
        print("\n".join(replay_lines(found, gates, changes)))
        if request.output is not None:
            print(f"plot:      {request.output}")
    return 0 if found.same else ReplayDiffers.exit_code


def _profile(request: ReplayRequest, log: FlightLog) -> Profile | None:
    """What it is to be replayed by; None: as it was flown."""
    if request.profile is None and not request.settings:
        return None
    base = flown_profile(log.header) if request.profile is None else load_profile(request.profile)
    return changed_profile(base, request.settings)


def _pictures(request: ReplayRequest, log: Path) -> Iterator[Picture] | None:
    """Those of the recording that lies beside the log; None without one."""
    recording = recording_path(log)
    return recorded_pictures(recording) if request.pictures and recording.is_file() else None
