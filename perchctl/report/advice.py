"""What to change for the next flight: each sentence with the figure that it rests on, and none
where the log shows nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from perchctl.geometry import Array
from perchctl.log import FlightLog, shows_target, summarise_flight
from perchctl.mission import Findings, flight_findings
from perchctl.profile import CameraConfig
from perchctl.report.edges import LinkHealth, OutsideHealth
from perchctl.report.energy import EnergyHistory
from perchctl.report.sight import Sight, part_of
from perchctl.report.track import Track
from perchctl.report.words import count, length, milliseconds, share, times
from perchctl.vision import Consistency

SWING_M, LEAST_SWINGS = 0.03, 4
"""Farther than that to both sides of the target, one after the other."""
WAITED_S = 4.0
LEAST_PAIRS, SCALE_OFF = 20, 0.03
RMS_PX = 1.0
UNSEEN_SHARE, LEAST_UNSEEN, BLURRED_PX = 0.1, 10, 2.5
IN_VIEW = 0.5
"""Aside by less than half of the height: a camera that looks up has the target in view."""
GAP_S = 0.3
SPARE_V, WORN_SAG_V, WORN_HUNGER, LEAST_USED = 0.15, 0.95, 1.8, 0.15
APART_M = 0.05


@dataclass(frozen=True)
class Advice:
    """`about`: one word; `evidence`: the figures, in a sentence without its end."""

    about: str
    text: str
    evidence: str


def advice_of(
    track: Track,
    sight: Sight,
    link: LinkHealth,
    energy: EnergyHistory,
    outside: OutsideHealth | None,
) -> tuple[Advice, ...]:
    """In the order in which to heed it."""
    found = [
        *_latency_and_mounting(track),
        *_computer(track),  # what it delays looks like a video that fails
        *_print(track, sight),
        *_light(track, sight),
        *_video(track, sight),
        *_gains(track),
        *_settling(track),
        *_link(track, link),
        *_battery(track, energy),
        *_outside(outside),
    ]
    return tuple(found)


def _latency_and_mounting(track: Track) -> Iterator[Advice]:
    found = findings_in(track.log)
    if found is None:
        return
    for sentence in found.advice:
        about = "latency" if sentence.startswith("latency") else "mounting"
        yield Advice(about, sentence, "fitted to the whole flight, with its 95 % interval")


def _print(track: Track, sight: Sight) -> Iterator[Advice]:
    large, small = track.log.column("lz_m"), track.log.column("sz_m")
    ratio = large / np.where(small > 0.05, small, np.nan) - 1.0
    known = ratio[np.isfinite(ratio)]
    if known.size >= LEAST_PAIRS and abs(off := float(np.median(known))) > SCALE_OFF:
        farther = "farther away" if off > 0 else "nearer"
        yield Advice(
            "print",
            "measure both markers on the sheet, and write their sides into target.large.side_m "
            "and target.small.side_m",
            f"the large marker seems {share(abs(off))} {farther} than the small one, median of "
            f"{known.size} frames with both",
        )
    if sight.whole.rms_px > RMS_PX:
        yield Advice(
            "print",
            "look whether the sheet is flat, and check the camera's calibration",
            f"the corners miss the pose by {sight.whole.rms_px:.1f} px, median over "
            f"{count(sight.whole.with_target, 'frame')}",
        )


def _light(track: Track, sight: Sight) -> Iterator[Advice]:
    unseen, frames = _unseen_in_view(track)
    if len(unseen) < LEAST_UNSEEN or len(unseen) < UNSEEN_SHARE * frames:
        return
    blur = track.motion.blur_px[unseen]
    told = f"{len(unseen)} of {frames} frames did not show the target, though it was in view"
    blurred = int(np.count_nonzero(blur > BLURRED_PX))
    if blurred > len(unseen) / 2:
        yield Advice(
            "light",
            "more light and a shorter exposure (camera.controls), or a slower flight",
            f"{told}; {blurred} of them were blurred by more than {BLURRED_PX:g} px",
        )
    elif np.isfinite(blur).any():
        yield Advice(
            "light",
            "look for what darkens, dazzles or hides the target: it was not the motion",
            f"{told}; their median blur was {part_of(blur, 50):.1f} px",
        )
    else:
        flow = part_of(track.motion.flow_pxps[unseen], 50)
        moved = f"; it moved at {flow:.0f} px/s" if math.isfinite(flow) else ""
        yield Advice("light", "more light, so that the exposure can be shorter", f"{told}{moved}")


def _unseen_in_view(track: Track) -> tuple[list[int], int]:
    """Ticks whose frame lacks a target that was overhead; and all frames with it overhead."""
    overhead = np.hypot(track.log.column("ex_m"), track.log.column("ey_m")) < (
        IN_VIEW * track.log.column("ez_m")
    )
    unseen, frames = [], 0
    for i, record in enumerate(track.log.records):
        leads = record.get("phase") in ("ESTIMATE", "ALIGN", "ASCEND")
        if record.get("frame_t_s") is None or not leads or not overhead[i]:
            continue
        frames += 1
        if not shows_target(record):
            unseen.append(i)
    return unseen, frames


def _video(track: Track, sight: Sight) -> Iterator[Advice]:
    long = [b - a for a, b in sight.gaps_s if b - a > GAP_S]
    if long:
        yield Advice(
            "video",
            "look at the video's way: channel, antennas, receiver, cable",
            f"{times(len(long))} no picture came for more than {GAP_S:g} s, at most "
            f"{max(long):.1f} s",
        )


def _gains(track: Track) -> Iterator[Advice]:
    planner = _section(_section(track.log.header, "profile"), "planner")
    for phase, key in (("ALIGN", "align"), ("ASCEND", "ascend")):
        swings, widest_m, over_s = _swings(track, phase)
        if swings < LEAST_SWINGS:
            continue
        speed = _section(planner, key).get("speed_mps")
        integral = planner.get("integral_per_s")
        text = f"lower planner.{key}.speed_mps"
        text += f" (flown with {speed})" if speed is not None else ""
        text += ", or planner.integral_per_s"
        text += f" ({integral})" if integral is not None else ""
        if any(a.about == "latency" for a in _latency_and_mounting(track)):
            text = f"put the latency right first; if it still swings, {text}"
        yield Advice(
            "gains",
            text,
            f"in {phase} it swung {swings} times across the target, by up to {length(widest_m)} "
            f"in {over_s:.1f} s",
        )


def _swings(track: Track, phase: str) -> tuple[int, float, float]:
    """The most changes of side in one stay, how wide, in how long."""
    best = (0, 0.0, 0.0)
    for step in track.steps:
        if step.phase != phase:
            continue
        stay = track.within(step.start_s, step.end_s)
        for axis in "xy":
            e_m = track.log.column(f"e{axis}_m")[stay]
            swings, widest_m = swings_of(e_m)
            best = max(best, (swings, widest_m, step.end_s - step.start_s))
    return best


def swings_of(e_m: Array) -> tuple[int, float]:
    """How often an error went from beyond `SWING_M` on one side to beyond it on the other, and
    how far it went after the first time."""
    sides = np.sign(e_m[np.abs(e_m) > SWING_M])
    changes = int(np.count_nonzero(np.diff(sides)))
    if not changes:
        return 0, 0.0
    beyond = np.abs(e_m[np.abs(e_m) > SWING_M])
    return changes, float(beyond[int(np.flatnonzero(np.diff(sides))[0]) + 1 :].max())


def _settling(track: Track) -> Iterator[Advice]:
    planner = _section(_section(track.log.header, "profile"), "planner")
    ascend = _section(planner, "ascend")
    limits = [_number(ascend.get(k)) for k in ("standoff_m", "settle_z_m", "settle_xy_m")]
    standoff_m, settle_z_m, settle_xy_m = limits
    if standoff_m is None or settle_z_m is None or settle_xy_m is None:
        return
    near = (track.log.column("ez_m") <= standoff_m + settle_z_m) & np.array(
        [r.get("phase") == "ASCEND" for r in track.log.records], dtype=bool
    )
    spent_s = float(np.diff(track.t_s, append=track.end_s)[near].sum())
    if spent_s < WAITED_S:
        return
    aside = np.hypot(track.log.column("ex_m"), track.log.column("ey_m"))[near]
    yield Advice(
        "gains",
        "look for a draught or a weak position estimate; where the target forgives more, "
        "planner.ascend.settle_xy_m can be larger",
        f"it waited {spent_s:.1f} s at the stand-off, and was within "
        f"{length(settle_xy_m)} of the axis for {share(float(np.mean(aside <= settle_xy_m)))} "
        f"of that time (median {length(part_of(aside, 50))})",
    )


def _link(track: Track, link: LinkHealth) -> Iterator[Advice]:
    safety = _section(_section(track.log.header, "profile"), "safety")
    hold_s = _number(safety.get("telemetry_hold_s")) or GAP_S
    long = [gap for gap in link.old if gap[2] > hold_s]
    if long:
        yield Advice(
            "link",
            "another radio channel, or an antenna with a free view",
            f"telemetry was older than {milliseconds(hold_s)} {times(len(long))}, at "
            f"most {milliseconds(max(gap[2] for gap in long))}",
        )


def _computer(track: Track) -> Iterator[Advice]:
    loop = _section(_section(track.log.header, "profile"), "link")
    period_s = 1.0 / (_number(loop.get("loop_hz")) or 50.0)
    late = track.log.column("late_s")
    most_s = part_of(late, 99)
    if most_s > period_s / 2:
        yield Advice(
            "computer",
            "close other programs on the computer, or lower the camera's resolution",
            f"1 turn in 100 began {milliseconds(most_s)} late or more, of a period of "
            f"{milliseconds(period_s)}",
        )


def _battery(track: Track, energy: EnergyHistory) -> Iterator[Advice]:
    safety = _section(_section(track.log.header, "profile"), "safety")
    least_v = _number(safety.get("min_load_v"))
    if least_v is not None and energy.lowest_v < least_v + SPARE_V:
        yield Advice(
            "battery",
            "start with a full battery",
            f"it came down to {energy.lowest_v:.2f} V, and at {least_v:.2f} V a flight is ended",
        )
    fit = energy.fit
    told = energy.used_mah > LEAST_USED * energy.battery_mah  # or how fast it empties is a guess
    if fit is not None and (fit.sag_v > WORN_SAG_V or (told and fit.hunger > WORN_HUNGER)):
        yield Advice(
            "battery",
            "take another battery: this one is worn, or its contacts are",
            f"it falls by {fit.sag_v:.2f} V under full thrust, and empties {fit.hunger:.1f} times "
            f"as fast as one of {energy.battery_mah:.0f} mAh should",
        )


def _outside(outside: OutsideHealth | None) -> Iterator[Advice]:
    if outside is None:
        return
    if outside.stops:
        longest = max(outside.stops, key=lambda stop: stop[1] - stop[0])
        yield Advice(
            "positioning",
            "look where the markers are hidden from the cameras",
            f"{times(len(outside.stops))} no position was sent, at most for "
            f"{longest[1] - longest[0]:.1f} s: {longest[2]}",
        )
    if outside.apart_most_m > APART_M:
        yield Advice(
            "positioning",
            "compare both by hand (`perchctl check --lift`)",
            f"the vehicle's estimate was {length(outside.apart_most_m)} from the positions from "
            f"outside in 1 turn of 20",
        )


def _section(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = values.get(name)
    return section if isinstance(section, Mapping) else {}


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None


# --- Latency and mounting as a flight showed them, also where its log has no end ---------------


WORKED_OUT = (
    "delay_s",
    "delay_sigma_s",
    *(f"turn_{axis}{part}_rad" for axis in "xyz" for part in ("", "_sigma")),
)


def findings_in(log: FlightLog) -> Findings | None:
    """The summary's; else what the last ticks had worked out. None where neither is there."""
    if log.summary is not None:
        return summarise_flight(log).findings
    newest = next(
        (r for r in reversed(log.records) if all(r.get(k) is not None for k in WORKED_OUT)), None
    )
    profile = log.header.get("profile")
    if newest is None or not isinstance(profile, dict):
        return None
    try:
        camera = CameraConfig.model_validate(profile.get("camera"))
    except ValidationError:  # of an older perchctl
        return None
    seen = Consistency(
        delay_s=newest["delay_s"],
        delay_sigma_s=newest["delay_sigma_s"],
        turn_rad=tuple(newest[f"turn_{axis}_rad"] for axis in "xyz"),
        turn_sigma_rad=tuple(newest[f"turn_{axis}_sigma_rad"] for axis in "xyz"),
    )
    return flight_findings(seen, camera)
