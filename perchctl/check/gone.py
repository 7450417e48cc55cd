"""Whether a vehicle that answered is still there."""

from __future__ import annotations

from collections.abc import Iterator

from perchctl.check.row import Row, failed
from perchctl.link import ProbeLink

NAME = "link"
GONE_S = 1.0
"""Without telemetry for so long, one that had sent some is switched off or restarting."""


def gone(link: ProbeLink) -> str:
    """Why it is there no more, or empty.

    Silence tells, too: a radio keeps its link to a vehicle that is off, cflib to one that restarts.
    """
    if lost := link.lost():
        return f"the link was lost: {lost}"
    if link.newest() is not None and link.age_s() > GONE_S:
        return f"no telemetry came for {link.age_s():.1f} s"
    return ""


def rows(link: ProbeLink) -> Iterator[Row]:
    """Only of one that is gone: the others' rows say that they answer."""
    if why := gone(link):
        yield failed(
            NAME, f"the vehicle is gone: {why}", "look at its battery and plug, restart it"
        )
