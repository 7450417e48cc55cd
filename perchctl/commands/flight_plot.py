"""The picture of a flight beside its log."""

from __future__ import annotations

from pathlib import Path

from perchctl.commands.output import say
from perchctl.profile import Profile
from perchctl.record import path_beside, read_log


def plot_of(log_path: Path, profile: Profile) -> Path | None:
    """Draws it where the profile asks for it; one that fails is a warning, the flight is over."""
    if not profile.log.plot:
        return None
    from perchctl.analysis import plot_flight

    picture = path_beside(log_path, ".png")
    try:
        plot_flight(read_log(log_path), picture)
    except Exception as error:
        say(f"the plot could not be drawn: {error}")
        return None
    return picture
