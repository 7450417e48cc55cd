"""Write a self-contained HTML page that reports on one flight or on several flights of a
session."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from perchctl.analysis.film import Progress, write_film
from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.plot import flight_png
from perchctl.analysis.show import utc_text
from perchctl.analysis.story import Sentence, count_text, height_text, length_text, tell_story
from perchctl.errors import InvalidValue, PerchError
from perchctl.files import write_files
from perchctl.mission import Phase
from perchctl.record import FlightLog, path_beside, read_log, recorded_pictures, wrap_log_errors
from perchctl.report_page import data_url, render_template

UNFINISHED = "unfinished"
OUTCOME_TITLES = {
    "perched": "Perched",
    "landed": "Landed",
    "aborted": "Aborted",
    "failed": "Failed",
    UNFINISHED: "Unfinished: the end of the log is missing",
}
GRADES = {"perched": "good", "landed": "warn"}


def write_report(
    log_paths: Sequence[Path],
    output: Path,
    with_film: bool = False,
    names: Mapping[Path, str] | None = None,
    progress: Progress = lambda done, total: None,
) -> Report:
    """Write the HTML report of the logs atomically, and return its content. `with_film` embeds a
    film of each flight. `names`: the vehicle names in a fleet, keyed by log. `progress` is called
    with the number done and the total, after each flight or, with films, after each image of a
    film.

    Raises NotFound and InvalidValue, as `read_log` and `write_files` do.
    """
    of = names or {}
    report = Report(
        tuple(replace(read_reported_flight(path), name=of.get(path, "")) for path in log_paths)
    )
    write_files({output: report_html(report.flights, with_film, progress).encode("utf-8")})
    return report


@dataclass(frozen=True)
class Report:
    """The flights on a report page, at least one."""

    flights: tuple[ReportedFlight, ...]

    @property
    def outcome_counts_text(self) -> str:
        """The number of flights by outcome: ``1 flight: 1 perched``, ``4 flights: 3 perched, 1
        landed``."""
        outcomes = [told.outcome for told in self.flights]
        each = ", ".join(f"{outcomes.count(name)} {name}" for name in dict.fromkeys(outcomes))
        return f"{count_text(len(outcomes), 'flight')}: {each}"

    def record(self) -> list[dict[str, Any]]:
        """The flights in JSON types."""
        return [
            {
                "log": str(told.flight.log.path),
                **({"name": told.name} if told.name else {}),
                "outcome": told.outcome,
                "miss_m": told.flight.summary.miss_m,
                "used_mah": told.flight.measures.battery_used_mah,
                "advice": list(told.advice),
            }
            for told in self.flights
        ]


@dataclass(frozen=True, eq=False)
class ReportedFlight:
    """One flight in a report. `pictures` is None if there is no recording; `picture_problem` says
    why images could not be read. `name`: the vehicle's name in a fleet."""

    flight: FlightAnalysis
    pictures: tuple[DecisionPicture, ...] | None = None
    picture_problem: str = ""
    name: str = ""

    @cached_property
    def story(self) -> tuple[Sentence, ...]:
        """The flight's events as sentences, in chronological order."""
        return tell_story(self.flight)

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences about the measured latency and mounting that the profile should contain, and
        about the vehicle's motors and balance."""
        findings, trim = self.flight.summary.findings, self.flight.trim
        camera = () if findings is None else findings.advice
        return camera if trim is None else (*camera, *trim.advice)

    @property
    def outcome(self) -> str:
        """How the flight ended; `UNFINISHED` if the log does not contain the end."""
        return UNFINISHED if self.flight.log.summary is None else self.flight.summary.outcome

    @property
    def outcome_grade(self) -> str:
        """Grade of the outcome: good, warn or bad."""
        if self.flight.summary.is_hover_completed:
            return "good"
        return GRADES.get(self.outcome, "bad")

    @property
    def title(self) -> str:
        """The vehicle's name in a fleet, the outcome and, if known, the miss distance."""
        miss_m = self.flight.summary.miss_m
        title = OUTCOME_TITLES.get(self.outcome, self.outcome)
        if self.flight.summary.is_hover_completed:
            title = "Hovered and landed"
        title = f"{self.name}: {title}" if self.name else title
        return title if miss_m is None else f"{title}, {length_text(miss_m)} off centre"

    @property
    def start_text(self) -> str:
        """When the flight began, in UTC; a simulated flight in lockstep has no start date."""
        started = self.flight.log.header.get("started_utc")
        return utc_text(started) if started else "no date"

    @property
    def log_defects(self) -> list[str]:
        """What is missing from the log, one sentence each."""
        end, log = self.flight.summary, self.flight.log
        found = []
        if not log.records:
            found.append("The log has no ticks: there is no flight to report.")
        if log.summary is None:
            found.append(
                "The log ends without its summary: the program was killed, or the disk or power "
                "failed. This report ends with the last record."
            )
        if log.ignored_bytes:
            found.append(
                f"The last {log.ignored_bytes} bytes of the log are unreadable and were ignored."
            )
        if end.lost_records:
            why = end.log_problem or "the reason is unknown"
            found.append(f"The log lacks {count_text(end.lost_records, 'record')}: {why}.")
        elif end.log_problem:
            found.append(f"The log may lack its last records: {end.log_problem}.")
        return found


# --- the page ---


def report_html(
    flights: Sequence[ReportedFlight],
    with_film: bool = False,
    progress: Progress = lambda done, total: None,
) -> str:
    """The report on at least one flight as self-contained HTML. Raises InvalidValue for invalid
    values in a log."""
    articles = []
    for number, told in enumerate(flights, start=1):
        with wrap_log_errors(told.flight.log.path):
            articles.append(
                _render(
                    "flight.html",
                    told=told,
                    flight=told.flight,
                    number=number,
                    is_session=len(flights) > 1,
                    with_film=with_film,
                    film_of=partial(film_url_and_problem, progress=progress),
                )
            )
        if not with_film:
            progress(number, len(flights))
    return _render(
        "page.html",
        flights=flights,
        articles=articles,
        counts=Report(tuple(flights)).outcome_counts_text,
    )


def _render(name: str, **values: Any) -> Markup:
    return render_template(
        "perchctl.analysis",
        name,
        phases_of=mission_phases,
        plot_of=lambda flight: data_url("image/png", flight_png(flight)),
        **values,
    )


def mission_phases(log: FlightLog) -> list[str]:
    """The phases of the mission in a log, in order: the paper's seven phases, or the phases of a
    hover."""
    seven = [phase.value for phase in tuple(Phase)[:7]]
    planner = (log.header.get("profile") or {}).get("planner") or {}
    return [*seven[:5], Phase.HOVER.value] if planner.get("hover") else seven


def film_url_and_problem(
    flight: FlightAnalysis, progress: Progress = lambda done, total: None
) -> tuple[str, str]:
    """The flight's film as a `data:` URL, and why the film or its camera images are
    missing; each may be empty. The log must have at least one tick."""
    path = flight.log.path
    is_recorded = path_beside(path, ".mcap").is_file()
    recorded = [recorded_pictures(path)] if is_recorded else []
    problem = ""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        for pictures in (*recorded, None):
            try:
                write_film(flight, pictures, film, progress=progress)
            except InvalidValue as error:
                problem = _without_folder(error, path)
                continue
            return data_url("video/mp4", film.read_bytes()), problem
    return "", problem


def _without_folder(error: PerchError, log_path: Path) -> str:
    """The error's text without folder names, because the user may share the page."""
    return str(error).replace(f"{log_path.parent}{os.sep}", "")


# --- What the camera saw at each decision of the mission, from the recording next to the log ---

DECIDED = {
    "ESTIMATE": "found",
    "ASCEND": "aligned",
    "PERCH": "settled",
    "COMPLETE": "contact",
    "HOVER": "in position",
}
WIDEST_PX = 480
"""Width to which a wider image is reduced. Larger: the report becomes a larger file."""
REPORT_JPEG_QUALITY = 80
"""JPEG quality, 0 to 100. Larger: the report becomes a larger file. Smaller: coarser images."""
LARGE_BGR, SMALL_BGR = (0xDC, 0x9B, 0x3A), (0x00, 0x9F, 0xE6)


@dataclass(frozen=True)
class DecisionPicture:
    """Last camera image before a phase change, as a JPEG with the detected markers drawn.

    The caption gives the image's time, because the image can be much older than the decision: the
    last centimetres are flown without images.
    """

    caption: str
    jpeg: bytes

    @property
    def data_url(self) -> str:
        return data_url("image/jpeg", self.jpeg)


def read_reported_flight(log_path: Path) -> ReportedFlight:
    """Read one flight from its log and from the recording next to it. If the recording cannot be
    read, the flight is returned without images.

    Raises NotFound and InvalidValue for the log, as `read_log` does.
    """
    flight = FlightAnalysis(read_log(log_path))
    if not path_beside(log_path, ".mcap").is_file():
        return ReportedFlight(flight)
    shown: list[DecisionPicture] = []
    try:
        with wrap_log_errors(log_path):
            decisions = captions_and_records(flight)
        for picture in recorded_pictures(log_path, decisions):
            caption, record = decisions[picture.number]
            shown.append(DecisionPicture(caption, _jpeg(record, picture.image)))
    except PerchError as error:
        return ReportedFlight(flight, tuple(shown), _without_folder(error, log_path))
    return ReportedFlight(flight, tuple(shown))


def captions_and_records(flight: FlightAnalysis) -> dict[int, tuple[str, dict[str, Any]]]:
    """Return the caption and the log record of the last frame before each phase change, keyed by
    frame number."""
    log = flight.log
    found = {}
    for stay in log.phases:
        until_then = log.records[log.tick_index_at(stay.start_s) :: -1]
        record = next((r for r in until_then if r.get("frame") is not None), None)
        if stay.phase in DECIDED and record is not None:
            caption = f"{DECIDED[stay.phase]}, {log.to_flight_s(float(record['t_s'])):.1f} s"
            if record.get("ez_m") is not None:
                caption += f", {height_text(float(record['ez_m']))}"
            found[int(record["frame"])] = caption, record
    return found


def _jpeg(record: dict[str, Any], image: NDArray[np.uint8]) -> bytes:
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    scale = min(1.0, WIDEST_PX / drawn.shape[1])
    drawn = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for key, colour in (("large_px", LARGE_BGR), ("small_px", SMALL_BGR)):
        if np.size(record.get(key) or ()) == 8:
            # Pixel centres have integer coordinates in the reduced image as well.
            points = (np.array(record[key], dtype=np.float64).reshape(4, 2) + 0.5) * scale - 0.5
            fixed = np.round(points * 16).astype(np.int32)
            cv2.polylines(drawn, [fixed], True, colour, 2, cv2.LINE_AA, 4)
    _, data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, REPORT_JPEG_QUALITY])
    return bytes(data)
