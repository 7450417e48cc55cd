"""From logs to a page on the disk."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path

import perchctl
from perchctl.files import write_files
from perchctl.log import log_values, path_beside, read_log, recorded_pictures, recording_path
from perchctl.report import sections
from perchctl.report.markup import Markup, table, tag
from perchctl.report.plot import trend
from perchctl.report.told import ReportedFlight, tell

REPORT_SUFFIXES = (".html", ".htm")
SESSION_NAME = "session.html"


def report_path_of(log_path: Path) -> Path:
    """Where a flight's report stands: beside its log, by its name."""
    return path_beside(log_path, REPORT_SUFFIXES[0])


def session_path_of(log_paths: Sequence[Path]) -> Path:
    """Where the report of several stands: beside the first log."""
    return log_paths[0].with_name(SESSION_NAME)


def told_of(log_path: Path) -> ReportedFlight:
    """One flight, with what was recorded beside its log. A recording that cannot be read costs
    the pictures only.

    Raises NotFound and InvalidValue for the log, as `read_log`.
    """
    log, recording = read_log(log_path), recording_path(log_path)
    with log_values(log_path):
        if not recording.is_file():
            return tell(log)
        return tell(log, lambda numbers: recorded_pictures(recording, exact=False, numbers=numbers))


def write_report(log_paths: Sequence[Path], output: Path) -> tuple[ReportedFlight, ...]:
    """Writes the page, whole or not at all; returns what it tells.

    Raises NotFound and InvalidValue, as `read_log` and `write_files`.
    """
    flights = tuple(told_of(path) for path in log_paths)
    write_files({output: page_of(flights).encode("utf-8")})
    return flights


# --- The whole page: one flight, or a session of several with a table and trends before them ---


POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""No script, nothing from elsewhere: the browser holds the page to it."""
SESSION = "flights"
PARTS: tuple[tuple[str, Callable[[ReportedFlight], Markup | None]], ...] = (
    ("What happened", sections.story),
    ("What to change", sections.advice),
    ("Phases", sections.phases),
    ("What it saw when it decided", sections.pictures),
    ("Plots", sections.plots),
    ("Vision", sections.vision),
    ("Link", sections.link),
    ("Positions from outside", sections.outside),
    ("Battery", sections.battery),
    ("Timing", sections.timing),
)


def page_of(flights: Sequence[ReportedFlight]) -> str:
    """HTML that needs nothing else. `flights` has at least one. Raises InvalidValue for a value
    that no flight writes."""
    several = len(flights) > 1
    title = f"{len(flights)} flights" if several else flights[0].name
    parts = [tag("h1", flight_counts_text(flights) if several else "A flight with perchctl")]
    back = SESSION if several else ""
    each = [_flight(told, number, back) for number, told in enumerate(flights, start=1)]
    if several:
        parts.append(_session(flights))
    parts += each
    parts.append(tag("footer", f"perchctl {perchctl.__version__}"))
    style = files("perchctl.report").joinpath("page.css").read_text(encoding="utf-8")
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("title", f"perchctl: {title}"),
        tag("style", Markup(style)),
    ]
    html = tag("html", [tag("head", head), tag("body", tag("main", parts))], lang="en")
    return f"<!doctype html>\n{html}\n"


def _flight(told: ReportedFlight, number: int, back: str) -> Markup:
    with log_values(told.log.path):
        parts = [sections.headline(told, back)]
        for title, make in PARTS:
            made = make(told)
            if made is not None:
                parts.append(tag("section", [tag("h3", title), made]))
    return _own_ids(tag("article", parts, id=f"flight-{number}"), f"f{number}-")


def _own_ids(markup: Markup, prefix: str) -> Markup:
    """The figures' names are this flight's: another's may be the same."""
    own = re.sub(r'(<(?:path|clipPath|g|rect) id=")', rf"\g<1>{prefix}", markup)
    return Markup(re.sub(r'(<use href="#|url\(#)', rf"\g<1>{prefix}", own))


def _session(flights: Sequence[ReportedFlight]) -> Markup:
    rows = [
        (
            tag("a", str(number), href=f"#flight-{number}"),
            tag("a", told.name, href=f"#flight-{number}"),
            tag("span", told.outcome, class_=sections.GRADES.get(told.outcome, "bad")),
            _mm(told.summary.miss_m),
            f"{told.summary.duration_s:.1f} s",
            str(told.summary.attempts),
            f"{told.align_s:.1f} s" if math.isfinite(told.align_s) else "-",
            f"{told.energy.lowest_v:.2f} V" if math.isfinite(told.energy.lowest_v) else "-",
            f"{told.energy.used_mah:.0f} mAh",
            told.profile,
        )
        for number, told in enumerate(flights, start=1)
    ]
    head = ("", "log", "outcome", "miss", "time", "attempts", "aligning", "lowest", "used",
            "profile")  # fmt: skip
    names = [told.name for told in flights]
    trends = [
        trend("miss [mm]", [1e3 * _known(t.summary.miss_m) for t in flights], names),
        trend("aligning [s]", [t.align_s for t in flights], names),
        trend("lowest battery [V]", [t.energy.lowest_v for t in flights], names),
        trend("used [mAh]", [t.energy.used_mah for t in flights], names),
    ]
    figures = [tag("figure", figure) for figure in trends if figure is not None]
    parts = [
        table(head, rows, numbers_from=3),
        tag("div", figures, class_="plots"),
    ]
    return _own_ids(tag("section", parts, id=SESSION), "session-")


def flight_counts_text(flights: Sequence[ReportedFlight]) -> str:
    """``4 flights: 3 perched, 1 landed``."""
    outcomes = [told.outcome for told in flights]
    each = ", ".join(f"{outcomes.count(name)} {name}" for name in dict.fromkeys(outcomes))
    return f"{len(flights)} flights: {each}"


def _mm(miss_m: float | None) -> str:
    return "-" if miss_m is None else f"{miss_m * 1e3:.1f} mm"


def _known(value: float | None) -> float:
    return math.nan if value is None else value
