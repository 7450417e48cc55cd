"""The work behind `perchctl log replay`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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


def run(
    file: Path | None,
    settings: Sequence[str] = (),
    profile: str | None = None,
    pictures: bool = True,
    output: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> int:
    """Replay and say what came of it; returns the exit code. Errors: NotFound, InvalidValue,
    UsageError."""
    path = log_file(file, None, None)
    if output is not None:
        check_output(output, FORMATS, force, DRAWN_IN)
    with opened(path) as log:
        wanted = _changed(log, profile, settings)
        check_readable(log)
    found = replay(log, _recorded(path) if pictures else None, wanted)
    if wanted is not None and not found.changed:
        say("nothing was changed: that is what was flown")
    gates = changed_gates(found) if found.changed else []
    changes = pose_changes(found) if found.changed else []
    if output is not None:
        from perchctl.replay import plot_replay

        plot_replay(found, output)
    if as_json:
        plot = None if output is None else str(output)
        print_record(replay_record(found, gates, changes) | {"plot": plot})
    else:
        for note in found.notes:
            say(note)
        print("\n".join(replay_lines(found, gates, changes)))
        if output is not None:
            print(f"plot:      {output}")
    return 0 if found.same else ReplayDiffers.exit_code


def _changed(log: FlightLog, profile: str | None, settings: Sequence[str]) -> Profile | None:
    """What it is to be replayed by; None: as it was flown."""
    if profile is None and not settings:
        return None
    base = flown_profile(log.header) if profile is None else load_profile(profile)
    return changed_profile(base, settings)


def _recorded(log: Path) -> Iterator[Picture] | None:
    """The pictures of the recording that lies beside the log; None without one."""
    recording = recording_path(log)
    return recorded_pictures(recording) if recording.is_file() else None
