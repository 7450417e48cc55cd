"""All that a report says of one flight, worked out; `perchctl.report.write` makes HTML of it."""

from __future__ import annotations

import base64
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import PerchError
from perchctl.log import FlightLog, FlightSummary, summarise_flight
from perchctl.mission import Findings
from perchctl.report.advice import Advice, advice_of, findings_in
from perchctl.report.edges import LinkHealth, OutsideHealth, link_of, outside_of
from perchctl.report.energy import EnergyHistory, energy_history
from perchctl.report.losses import losses_of
from perchctl.report.sight import Sight, sight_of
from perchctl.report.story import Sentence, story_of
from perchctl.report.track import Track
from perchctl.report.words import length

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


# --- What the camera saw when the mission decided: out of the recording beside the log ---------


Recorded = Callable[[Collection[int]], Iterable[tuple[int, float, NDArray[np.uint8]]]]
"""Gives the frames of some numbers: number, time, and the picture as the pipeline had it. Raises
PerchError where the recording cannot be read."""

DECIDED = {"ESTIMATE": "found", "ASCEND": "aligned", "PERCH": "settled", "COMPLETE": "contact"}
OLD_S = 0.2
"""An older picture shows another moment, and its caption says which."""
MOST = 16
"""Of a flight with many attempts the first and the last ones."""
WIDEST_PX, JPEG_QUALITY = 480, 80
LARGE_BGR, SMALL_BGR = (0xDC, 0x9B, 0x3A), (0x00, 0x9F, 0xE6)


@dataclass(frozen=True)
class Decision:
    """A moment worth a picture; `frame`: the number of the newest frame then, which the loop
    had at `seen_s`."""

    t_s: float
    name: str
    frame: int
    record: dict[str, Any]
    seen_s: float

    @property
    def caption(self) -> str:
        text = f"{self.name}, {self.t_s:.1f} s"
        if self.t_s - self.seen_s > OLD_S:  # the last centimetres are flown without a picture
            text += f"; the picture is from {self.seen_s:.1f} s"
        up_m = self.record.get("ez_m")
        return text if up_m is None else f"{text}, {length(float(up_m))} below"


@dataclass(frozen=True)
class Shown:
    """A decision with its picture as a JPEG, the markers drawn as they were found."""

    decision: Decision
    jpeg: bytes

    @property
    def address(self) -> str:
        return "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode("ascii")


def decisions_of(track: Track) -> tuple[Decision, ...]:
    """In order: where the mission went on because of what was seen, and where sight was lost."""
    moments = [(s.start_s, DECIDED[s.phase]) for s in track.steps if s.phase in DECIDED]
    for loss in losses_of(track):
        moments.append((loss.start_s + min(loss.duration_s, 0.5), "lost"))
    found = []
    for t_s, name in sorted(moments):
        record = _frame_before(track, t_s)
        if record is not None:
            seen_s = track.log.since(float(record["t_s"]))
            found.append(Decision(t_s, name, int(record["frame"]), record, seen_s))
    if len(found) > MOST:
        found = found[: MOST // 2] + found[-MOST // 2 :]
    return tuple(found)


def _frame_before(track: Track, t_s: float) -> dict[str, Any] | None:
    for record in track.log.records[track.index_at(t_s) :: -1]:
        if record.get("frame") is not None:
            return record
    return None


def shown_of(decisions: Iterable[Decision], recorded: Recorded) -> tuple[tuple[Shown, ...], str]:
    """Those whose picture is in the recording, and why others could not be read, or nothing."""
    wanted: dict[int, list[Decision]] = {}
    for decision in decisions:
        wanted.setdefault(decision.frame, []).append(decision)
    found: list[Shown] = []
    problem = ""
    try:
        for number, _t_s, image in recorded(wanted.keys()) if wanted else ():
            for decision in wanted.pop(number, ()):
                found.append(Shown(decision, _jpeg(decision, image)))
            if not wanted:
                break
    except PerchError as error:
        problem = str(error)
    return tuple(sorted(found, key=lambda shown: shown.decision.t_s)), problem


def _jpeg(decision: Decision, image: NDArray[np.uint8]) -> bytes:
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    scale = min(1.0, WIDEST_PX / drawn.shape[1])
    if scale < 1.0:
        drawn = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for key, colour in (("large_px", LARGE_BGR), ("small_px", SMALL_BGR)):
        corners = decision.record.get(key)
        if corners and len(corners) == 8:
            # A pixel's centre is a whole number; shrunk, too.
            points = (np.array(corners, dtype=np.float64).reshape(4, 2) + 0.5) * scale - 0.5
            fixed = np.round(points * 16).astype(np.int32)
            cv2.polylines(drawn, [fixed], True, colour, 2, cv2.LINE_AA, 4)
    _, data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)
