"""All that a report says of one flight, worked out; `perchctl.report.page` makes HTML of it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass

from perchctl.log import FlightLog, FlightSummary, summarise_flight
from perchctl.mission import Findings
from perchctl.report.advice import Advice, advice_of
from perchctl.report.edges import LinkHealth, OutsideHealth, link_of, outside_of
from perchctl.report.energy import EnergyHistory, energy_history
from perchctl.report.findings import findings_in
from perchctl.report.pictures import Recorded, Shown, decisions_of, shown_of
from perchctl.report.sight import Sight, sight_of
from perchctl.report.story import Sentence, story_of
from perchctl.report.track import Track

UNFINISHED = "unfinished"


@dataclass(frozen=True, eq=False)
class ReportedFlight:
    """One flight. `pictures` is None where no recording was made; `picture_problem` says why some
    could not be read."""

    track: Track
    summary: FlightSummary
    story: tuple[Sentence, ...]
    sight: Sight
    link: LinkHealth
    outside: OutsideHealth | None
    energy: EnergyHistory
    findings: Findings | None
    advice: tuple[Advice, ...]
    pictures: tuple[Shown, ...] | None
    picture_problem: str = ""

    @property
    def log(self) -> FlightLog:
        return self.track.log

    @property
    def outcome(self) -> str:
        """`UNFINISHED` for a log without its end."""
        return UNFINISHED if self.log.summary is None else self.summary.outcome

    @property
    def name(self) -> str:
        """The log's, without its folder: a page that is sent on does not tell of a computer."""
        return self.log.path.name

    @property
    def profile(self) -> str:
        profile = self.log.header.get("profile")
        return str(profile.get("name", "?")) if isinstance(profile, Mapping) else "?"

    @property
    def when(self) -> str:
        """In UTC; a simulated flight in lockstep has no date."""
        started = self.log.header.get("started_utc")
        if started:
            return str(started).replace("T", " ").replace("+00:00", " UTC")
        return "simulated, without a date" if self.log.header.get("lockstep") else "not known"

    @property
    def align_s(self) -> float:
        """In ALIGN altogether, NaN where it never came to that."""
        stays = [s.end_s - s.start_s for s in self.track.steps if s.phase == "ALIGN"]
        return sum(stays) if stays else math.nan


def tell(log: FlightLog, recorded: Recorded | None = None) -> ReportedFlight:
    """Works it all out. `recorded`: the pictures beside the log, None where there are none."""
    track = Track(log)
    sight, link, outside = sight_of(track), link_of(track), outside_of(track)
    energy = energy_history(log)
    shown: tuple[Shown, ...] | None = None
    problem = ""
    if recorded is not None:
        shown, problem = shown_of(decisions_of(track), recorded)
        problem = problem.replace(f"{log.path.parent}{os.sep}", "")
    return ReportedFlight(
        track,
        summarise_flight(log),
        story_of(track),
        sight,
        link,
        outside,
        energy,
        findings_in(log),
        advice_of(track, sight, link, energy, outside),
        shown,
        problem,
    )
