"""The sections of one flight's report as HTML, one function each; None leaves one out."""

from __future__ import annotations

import math

from perchctl.mission import latency_text, turn_text
from perchctl.report.edges import timings_of
from perchctl.report.markup import Markup, pairs, table, tag, text
from perchctl.report.plot import battery_plot, flight_plots, histogram
from perchctl.report.sight import Seen, part_of
from perchctl.report.story import PAPERS
from perchctl.report.told import UNFINISHED, ReportedFlight
from perchctl.report.words import count, kept_together, length, milliseconds, share

WORDS = {
    "perched": "Perched",
    "landed": "Landed",
    "aborted": "Broken off",
    "failed": "Failed",
    UNFINISHED: "Unfinished: the log has no end",
}
GRADES = {"perched": "good", "landed": "warn"}


def headline(told: ReportedFlight, back: str = "") -> Markup:
    """How it ended, and what one asks first; with a way back to the place `back`."""
    flight = told.summary
    title = WORDS.get(told.outcome, told.outcome)
    if flight.miss_m is not None:
        title += f", {length(flight.miss_m)} beside"
    facts = [
        ("why", flight.reason + (f" ({flight.cause})" if _adds(flight.cause, told) else "")),
        ("duration", f"{flight.duration_s:.1f} s"),
        ("failed attempts" if told.log.summary is None else "attempts", str(flight.attempts)),
        ("vehicle", str(told.log.header.get("uri") or "?")),
        ("camera", str(told.log.header.get("source") or "?")),
        ("profile", told.profile),
        ("when", told.when),
        ("perchctl", str(told.log.header.get("perchctl") or "?")),
    ]  # fmt: skip
    if flight.miss_m is not None:
        facts.insert(1, ("miss", f"{flight.miss_m * 1e3:.1f} mm, true (simulated)"))
    if flight.contact is not None:
        facts.insert(1, ("contact", flight.contact.text))
    if told.log.header.get("seed") is not None:
        facts.append(("seed", str(told.log.header["seed"])))
    return tag(
        "header",
        [
            tag("h2", title, class_=GRADES.get(told.outcome, "bad")),
            tag("p", [told.name, *_way(back)], class_="file"),
            *(tag("p", fault, class_="note") for fault in _faults(told)),
            tag("div", pairs(facts), class_="facts"),
        ],
    )


def _way(back: str) -> list[str]:
    return [" · ", tag("a", "all flights", href=f"#{back}")] if back else []


def _adds(cause: str, told: ReportedFlight) -> bool:
    return bool(cause) and cause != told.summary.outcome


def _faults(told: ReportedFlight) -> list[str]:
    """What the log lacks."""
    flight, log, found = told.summary, told.log, []
    if not log.records:
        found.append("The log holds no turn of a flight: there is nothing to tell.")
    if log.summary is None:
        found.append(
            "The log ends without its summary: the program was killed, or lost its disk or its "
            "power. What is told here ends with its last record."
        )
    if log.ignored_bytes:
        found.append(f"Its last {log.ignored_bytes} bytes could not be read and are left out.")
    if flight.lost_records:
        lost = count(flight.lost_records, "record")
        found.append(f"The log lacks {lost}: {flight.log_problem or 'no reason is known'}.")
    elif flight.log_problem:
        found.append(f"The log may lack its last records: {flight.log_problem}.")
    return found


def story(told: ReportedFlight) -> Markup | None:
    rows = [
        tag("li", [tag("time", f"{s.t_s:.1f} s"), tag("span", _prose(s.text))], class_=s.grade)
        for s in told.story
    ]
    return tag("ol", rows, class_="story") if rows else None


def advice(told: ReportedFlight) -> Markup | None:
    parts = []
    if told.advice:
        rows = [
            tag(
                "li",
                [
                    tag("b", a.about),
                    ": ",
                    _prose(a.text.removeprefix(f"{a.about} ")),
                    " ",
                    tag("small", _prose(_upper(a.evidence))),
                ],
            )
            for a in told.advice
        ]
        parts.append(tag("ul", rows, class_="advice"))
    elif told.log.records:
        parts.append(tag("p", "Nothing in this log asks for a change."))
    if told.findings is not None:
        parts.append(
            pairs(
                [
                    ("latency", f"{latency_text(told.findings)} (95 %)"),
                    ("camera's turn about x, y, z", f"{turn_text(told.findings)} (95 %)"),
                ]
            )
        )
    return Markup("".join(parts)) if parts else None


def phases(told: ReportedFlight) -> Markup | None:
    """The strip over time, and under it the paper's seven."""
    steps = told.track.steps
    if not steps:
        return None
    strip, spent, stays = [], dict.fromkeys(PAPERS, 0.0), dict.fromkeys(PAPERS, 0)
    for step in steps:
        stay_s = step.end_s - step.start_s
        if step.phase in spent:
            spent[step.phase] += stay_s
            stays[step.phase] += 1
        if stay_s > 0:
            strip.append(
                tag(
                    "span",
                    tag("span", step.phase),
                    class_=f"p {step.phase.lower()}",
                    style=f"flex-grow:{stay_s:.2f}",
                    title=f"{step.phase}, {step.start_s:.1f} to {step.end_s:.1f} s: {step.reason}",
                )
            )
    chips = [
        tag(
            "li",
            [
                tag("i", "", class_=f"p {name.lower()}"),
                f"{name} ",
                tag("small", _spent(stays[name], s)),
            ],
            class_=None if stays[name] else "never",
        )
        for name, s in spent.items()
    ]
    for name in ("RECOVER", "LANDING"):
        within = [s for s in steps if s.phase == name]
        if within:
            s = sum(step.end_s - step.start_s for step in within)
            mark = tag("i", "", class_=f"p {name.lower()}")
            chips.append(tag("li", [mark, f"{name} ", tag("small", _spent(len(within), s))]))
    return Markup(tag("div", strip, class_="strip") + tag("ul", chips, class_="chips"))


def _spent(stays: int, duration_s: float) -> str:
    if not stays:
        return "not reached"
    return f"{duration_s:.1f} s" + (f" in {stays} stays" if stays > 1 else "")


def pictures(told: ReportedFlight) -> Markup | None:
    if not told.log.records:
        return None
    if told.pictures is None:
        return tag("p", "There are no pictures: no recording was made beside this log.")
    lost = [tag("p", f"{told.picture_problem}.", class_="note")] if told.picture_problem else []
    if not told.pictures:
        return text(lost or [tag("p", "The recording holds no picture of a decision.")])
    shown = tag(
        "div",
        [
            tag(
                "figure",
                [
                    tag("img", src=shown.address, alt=shown.decision.caption),
                    tag("figcaption", kept_together(shown.decision.caption)),
                ],
            )
            for shown in told.pictures
        ],
        class_="pictures",
    )
    return text([*lost, shown])


def plots(told: ReportedFlight) -> Markup | None:
    drawn = [
        tag("figure", [tag("figcaption", title), figure])
        for title, figure in flight_plots(told.track)
    ]
    return tag("div", drawn, class_="plots") if drawn else None


def vision(told: ReportedFlight) -> Markup | None:
    sight = told.sight
    if not sight.whole.frames:
        return tag("p", "No frame reached the pipeline.") if told.log.records else None
    head = ("phase", "frames", "with target", "rate", "age", "95 % below", "misfit", "blur")
    rows = [_seen(seen) for seen in (*sight.phases, sight.whole)]
    gaps = [b - a for a, b in sight.gaps_s]
    told_gaps = f"{len(gaps)}, at most {max(gaps):.1f} s" if gaps else "none"
    exposure = (
        "exposure not known, and so no blur"
        if sight.exposure_s is None
        else f"by the motion in {milliseconds(sight.exposure_s)} of exposure: median, 95 % below"
    )
    facts = [("gaps without a picture", told_gaps), ("blur", exposure)]
    if sight.whole.strangers:
        facts.append(("not taken for the target", count(sight.whole.strangers, "frame")))
    return Markup(table(head, rows) + pairs(facts))


def _seen(seen: Seen) -> tuple[str, ...]:
    blur = f"{_px(seen.blur_px)}, {_px(seen.blur_most_px)} px"
    return (
        seen.phase,
        str(seen.frames),
        share(seen.share),
        f"{seen.rate_hz:.1f} /s" if math.isfinite(seen.rate_hz) else "-",
        milliseconds(seen.age_s),
        milliseconds(seen.age_most_s),
        f"{seen.rms_px:.2f} px" if math.isfinite(seen.rms_px) else "-",
        blur if math.isfinite(seen.blur_px) else "-",
    )


def _px(value: float) -> str:
    return f"{value:.1f}"


def link(told: ReportedFlight) -> Markup | None:
    health = told.link
    if not told.log.records:
        return None
    facts = [
        ("turns of the loop", f"{health.turns_hz:.1f} /s"),
        ("of them with new telemetry", f"{health.fresh_hz:.1f} /s"),
        ("samples of telemetry", f"{health.samples_hz:.1f} /s" if math.isfinite(health.samples_hz)
         else "the log does not hold them"),
        ("telemetry's age", f"{milliseconds(health.age_s)}, 99 % below "
         f"{milliseconds(health.age_most_s)}, at most {milliseconds(health.age_worst_s)}"),
        ("older than 100 ms", _stretches(health.old)),
        ("setpoints", f"{health.setpoints_hz:.1f} /s" if math.isfinite(health.setpoints_hz)
         else "none"),
        ("turns by command", ", ".join(f"{kind} {n}" for kind, n in health.sent) or "none"),
    ]  # fmt: skip
    return pairs(facts)


def _stretches(old: tuple[tuple[float, float, float], ...]) -> str:
    if not old:
        return "never"
    first = ", ".join(
        f"at {start:.1f} s up to {milliseconds(worst)}" for start, _, worst in old[:4]
    )
    return first if len(old) <= 4 else f"{first}, and {len(old) - 4} more"


def outside(told: ReportedFlight) -> Markup | None:
    health = told.outside
    if health is None:
        return None
    facts = [
        ("sent", f"{health.sent}, {health.rate_hz:.0f} /s"),
        ("age when sent", f"{milliseconds(health.age_s)}, 99 % below "
         f"{milliseconds(health.age_most_s)}"),
        ("from the vehicle's own estimate", f"{length(health.apart_m)}, 95 % below "
         f"{length(health.apart_most_m)}"),
        ("none sent", "; ".join(f"at {a:.1f} s for {b - a:.1f} s: {why}"
         for a, b, why in health.stops[:6]) or "never"),
    ]  # fmt: skip
    return pairs(facts)


def battery(told: ReportedFlight) -> Markup | None:
    energy = told.energy
    if not math.isfinite(energy.lowest_v):
        return tag("p", "The log holds no reading of the battery.") if told.log.records else None
    facts = [
        ("voltage", f"{energy.start_v:.2f} V at the start, {energy.end_v:.2f} V at the end, "
         f"{energy.lowest_v:.2f} V at its lowest"),
        ("used", f"about {energy.used_mah:.0f} mAh by the count of the thrust, for a battery of "
         f"{energy.battery_mah:.0f} mAh" + (" (assumed)" if energy.assumed else "")),
    ]  # fmt: skip
    if energy.fit is not None:
        facts.append(("sag", f"{energy.fit.sag_v:.2f} V under full thrust, fitted"))
    if energy.left is not None:
        facts.append(("left at the end", f"about {share(energy.left)} of its charge"))
    rows = [
        (
            p.phase,
            f"{p.duration_s:.1f} s",
            f"{p.used_mah:.1f} mAh",
            f"{p.mean_thrust / 655.35:.0f} %",
            f"{p.lowest_v:.2f} V" if math.isfinite(p.lowest_v) else "-",
        )
        for p in energy.phases
        if p.duration_s > 0
    ]
    spent = table(("phase", "time", "used", "mean thrust", "lowest"), rows)
    figure = battery_plot(told.track, energy.rest_v)
    shown = tag("figure", figure) if figure is not None else ""
    return Markup(pairs(facts) + tag("div", [tag("div", spent), shown], class_="plots"))


def timing(told: ReportedFlight) -> Markup | None:
    if not told.log.records:
        return None
    timings = timings_of(told.track)
    rows = [
        (name, milliseconds(part_of(v, 50)), milliseconds(part_of(v, 99)),
         milliseconds(part_of(v, 100)))
        for name, v in timings.items()
    ]  # fmt: skip
    figure = histogram(timings)
    if figure is None:
        why = "its time is simulated" if told.log.header.get("lockstep") else "the log says so"
        return tag("p", f"Each turn began at its time: {why}.")
    parts = [tag("div", table(("", "median", "99 %", "most"), rows)), tag("figure", figure)]
    return tag("div", parts, class_="plots")


def _prose(sentence: str) -> str:
    """With its end, and each figure beside its unit."""
    return kept_together(f"{sentence}.")


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
