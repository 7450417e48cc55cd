"""The camera and the target in it: rows from a rehearsal on its pictures. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean, median

from perchctl.camera import MIRRORED_TEXT, VERDICT_TEXTS, mirrored_note
from perchctl.check.computer import LEAST_RATED, frame_period_s, percentile
from perchctl.check.pictures import Blur, Light, blur_of, light_of, noise_of
from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import Row, by_limits, failed, passed, skipped, warned
from perchctl.errors import PerchError
from perchctl.flight import too_near_problem
from perchctl.perception import MIRRORED_FRAMES
from perchctl.profile import Profile
from perchctl.target import Optics, TargetDesign, make_design
from perchctl.vision import BLENDED, Pipeline

RATE_WARN_HZ, RATE_FAIL_HZ = 20.0, 7.0
"""An AI-deck's program as it comes gives 8, and a simulated one perches with 7."""
SLOWER_WARN = 0.8
"""Of `camera.rate_hz`."""
LOST_WARN, LOST_FAIL = 0.2, 0.5
"""Share of pictures: a third lost is flown by; half is not."""
BAD_WARN, BAD_FAIL = 0.05, 0.5
CLIPPED_WARN = 0.3
DIM_MEAN = 40.0
NOISE_WARN, NOISE_FAIL = 15.0, 30.0
FOCUS_WARN_PX, FOCUS_FAIL_PX = 1.6, 2.5
SMEARED = 1.5
"""Times the sharpest side's blur: more on another side is movement, or a lens askew."""
SMEARED_PX = 0.6
SEEN_WARN = 0.5
BLUR_STEP_PX = 0.25
FEW_TRIALS = 8
"""Enough for two digits; the designer takes three times as many."""
_SEE = "see docs/check.md"
_AGAIN = "plug the receiver or camera in again"
_LIGHT = "more light, a longer exposure, or the lens cap off"
_ADVICE = {
    VERDICT_TEXTS["frozen"]: _AGAIN,
    VERDICT_TEXTS["snow"]: "set the receiver to the camera's channel, switch the camera on",
    VERDICT_TEXTS["uniform"]: "uncover the lens, switch the camera on",
    VERDICT_TEXTS["dark"]: _LIGHT,
}
PICTURE_NAMES = (
    "frame rate", "lost frames", "picture age", "pictures", "light", "noise", "focus", "mirrored",
    "target", "print", "ranges", "blind",
)  # fmt: skip
NAMES = ("camera", "size", *PICTURE_NAMES)


@dataclass(frozen=True)
class Optical:
    """What the pictures are like; None where it could not be measured."""

    light: Light | None = None
    noise: float | None = None
    blur: Blur | None = None


def optical_of(rehearsal: Rehearsal, pipeline: Pipeline) -> Optical:
    looked = rehearsal.looked
    return Optical(light_of(looked), noise_of(looked), blur_of(looked, pipeline))


def refused(error: PerchError, devices: list[str]) -> list[Row]:
    """The rows of a camera that gives no picture."""
    found, semicolon, advice = str(error).rpartition("; ")
    if not semicolon:
        found, advice = str(error), _SEE
    if "/dev/video" not in found and "there are" not in found:
        there = f"there are {', '.join(devices)}" if devices else "this computer has no camera"
        advice = f"{advice}; {there}"
    return [failed("camera", found, advice), *unseen("no picture comes")]


def unseen(why: str, size: Row | None = None) -> list[Row]:
    """All but the camera's own row, for a camera whose pictures cannot be looked at."""
    first = size or skipped("size", why)
    return [first, *(skipped(name, why) for name in PICTURE_NAMES)]


def opened_row(described: str, devices: list[str], remarks: Sequence[str] = ()) -> Row:
    """`remarks`: what it does not do as it was asked."""
    found = f"{described} gives pictures"
    if remarks:
        return warned("camera", f"{found}; {'; '.join(remarks)}", "see perchctl check --cameras")
    return passed("camera", f"{found}; there are {', '.join(devices)}" if devices else found)


def size_row(size_px: tuple[int, int] | None, wanted_px: tuple[int, int]) -> Row:
    if size_px is None:
        return skipped("size", "no picture comes")
    found = "{}x{} px".format(*size_px)
    if size_px == wanted_px:
        return passed("size", f"{found}, as calibrated")
    return failed(
        "size", f"{found}, calibrated at {{}}x{{}} px".format(*wanted_px),
        "set the camera to that size, or calibrate it at this one",
    )  # fmt: skip


def rows(
    rehearsal: Rehearsal, optical: Optical, design: TargetDesign, profile: Profile
) -> list[Row]:
    """After camera and size: what the pictures show. `design` is `design_of` them."""
    if not rehearsal.pictures:
        why = rehearsal.problem or "no picture came in the rehearsal"
        return [failed("frame rate", why, _AGAIN), *unseen(why)[2:]]
    return [
        _rate(rehearsal, profile),
        _lost(rehearsal, profile),
        _age(rehearsal, profile),
        _pictures(rehearsal),
        _light(optical.light),
        _noise(optical.noise),
        _focus(optical.blur),
        _mirrored(rehearsal, profile),
        _target(rehearsal),
        _print(rehearsal),
        _ranges(design, optical.blur is not None),
        _blind(design),
    ]


def _rate(rehearsal: Rehearsal, profile: Profile) -> Row:
    period_s = frame_period_s(rehearsal)
    if period_s is None:
        why = "too few pictures" if rehearsal.live else "a recording has none of its own"
        return skipped("frame rate", why)
    hz = 1.0 / period_s
    advice = "more light, a smaller picture, or a shorter cable"
    row = by_limits("frame rate", -hz, -RATE_WARN_HZ, -RATE_FAIL_HZ, f"{hz:.0f} Hz", advice)
    wanted_hz = profile.camera.rate_hz
    if row.verdict == "pass" and wanted_hz is not None and hz < SLOWER_WARN * wanted_hz:
        advice = "a shorter exposure (camera.controls), or another camera.format"
        return warned("frame rate", f"{row.found}, asked for {wanted_hz:g}", advice)
    return row


def _lost(rehearsal: Rehearsal, profile: Profile) -> Row:
    """By the gaps between pictures that arrived one after another."""
    pairs = pairwise(rehearsal.arrivals)
    gaps = [t - t0 for (i0, t0), (i, t) in pairs if i == i0 + 1]
    if rehearsal.live and rehearsal.silent_s > profile.safety.camera_hold_s:
        return failed("lost frames", f"none for the last {rehearsal.silent_s:.1f} s", _AGAIN)
    if not rehearsal.live or len(gaps) < LEAST_RATED:
        return skipped("lost frames", "too few pictures" if rehearsal.live else "a recording")
    period_s, slack = median(sorted(gaps)[: 1 + len(gaps) * 3 // 4]), 1.5
    if rehearsal.repeats:  # new ones come at the receiver's own times, near theirs
        period_s, slack = mean(gap for gap in gaps if gap < 2.2 * period_s), 1.8
    lost = sum(max(0, math.ceil(gap / period_s - slack)) for gap in gaps)
    share = lost / (lost + len(gaps) + 1)
    found = f"{100.0 * share:.0f} %, longest gap {1e3 * max(gaps):.0f} ms"
    advice = "bring the receiver nearer, turn its antenna, choose another channel"
    if max(gaps) > profile.safety.camera_hold_s:
        return failed("lost frames", found, advice)
    return by_limits("lost frames", share, LOST_WARN, LOST_FAIL, found, advice)


def _age(rehearsal: Rehearsal, profile: Profile) -> Row:
    """When it has been looked at; of its way from the sensor only the profile knows."""
    if not rehearsal.live or not rehearsal.ages_s:
        return skipped("picture age", "none was looked at" if rehearsal.live else "a recording")
    age_s, limit_s = percentile(rehearsal.ages_s, 0.95), profile.safety.max_frame_age_s
    latency_ms = 1e3 * profile.camera.start_latency_s
    found = f"95 % within {1e3 * age_s:.0f} ms, {latency_ms:.0f} of them by camera.latency_s"
    advice = "measure camera.latency_s; use a faster receiver or computer"
    return by_limits("picture age", age_s, 0.6 * limit_s, limit_s, found, advice)


def _pictures(rehearsal: Rehearsal) -> Row:
    """Frozen, snow, uniform, dark, late: what the flight takes for no measurement."""
    late = sum(t < t0 for (_, t0), (_, t) in pairwise(rehearsal.arrivals))
    if late:
        found = f"{late} of {rehearsal.pictures} came after newer ones"
        return failed("pictures", found, "use another stream or receiver: these hold pictures back")
    if not rehearsal.problems:
        if BLENDED in rehearsal.remarks:
            return warned("pictures", BLENDED, "switch the converter's deinterlacing off")
        again = rehearsal.repeats
        told = f"; {again} repetitions by the receiver are not counted" if again else ""
        return passed("pictures", f"{rehearsal.pictures} good ones{told}")
    text, count = rehearsal.problems.most_common(1)[0]
    share = sum(rehearsal.problems.values()) / rehearsal.pictures
    found = f"{count} of {rehearsal.pictures}: {text}"
    advice = "see mirrored" if text.startswith(MIRRORED_TEXT) else _ADVICE.get(text, _SEE)
    return by_limits("pictures", share, BAD_WARN, BAD_FAIL, found, advice)


def _light(light: Light | None) -> Row:
    if light is None:
        return skipped("light", "no picture was looked at")
    found = f"mean {light.mean:.0f} of 255, {100.0 * light.white:.0f} % white"
    if light.white > CLIPPED_WARN:
        return warned("light", found, "a shorter exposure, no lamp in the picture")
    if light.mean < DIM_MEAN:
        return warned("light", found, _LIGHT)
    return passed("light", found)


def _noise(sigma: float | None) -> Row:
    if sigma is None:
        return skipped("noise", "it takes two pictures")
    found = f"sigma {sigma:.1f} of 255"
    advice = "more light; for analogue video a better antenna or channel"
    return by_limits("noise", sigma, NOISE_WARN, NOISE_FAIL, found, advice)


def _focus(blur: Blur | None) -> Row:
    if blur is None:
        return skipped("focus", "measured by the target's edges, and no target was seen",
                       "put the camera under the target")  # fmt: skip
    found = f"blur sigma {blur.least_px:.1f} px"
    if blur.most_px > SMEARED * blur.least_px + SMEARED_PX:
        found += f", {blur.most_px:.1f} px on another side"
        return warned("focus", found, "hold the camera still, look at the lens's seat")
    advice = "turn the lens until perchctl track --view shows the target sharp"
    return by_limits("focus", blur.least_px, FOCUS_WARN_PX, FOCUS_FAIL_PX, found, advice)


def _mirrored(rehearsal: Rehearsal, profile: Profile) -> Row:
    if rehearsal.mirrored >= MIRRORED_FRAMES:
        found, _, advice = mirrored_note(profile.camera).partition(": ")
        return failed("mirrored", found, advice)
    if not rehearsal.found:
        return skipped("mirrored", "no target was seen to tell by")
    return passed("mirrored", "no")


def _target(rehearsal: Rehearsal) -> Row:
    if not rehearsal.found:
        return skipped("target", "not in view", "put the vehicle under it to check the rest")
    found = f"in {100 * rehearsal.found // rehearsal.pictures} % of the pictures"
    target = rehearsal.target
    if target is not None:
        away_m = math.hypot(*(float(e) for e in target.e_m))
        found += f", {away_m:.2f} m from the gear (+- {1e3 * _spread_m(rehearsal):.0f} mm)"
        if problem := too_near_problem(target):
            return failed("target", problem.found, problem.advice)
    if rehearsal.found < SEEN_WARN * rehearsal.pictures:
        return warned("target", found, "nearer, sharper, or more light: see ranges and focus")
    return passed("target", found)


def _spread_m(rehearsal: Rehearsal) -> float:
    assert rehearsal.target is not None
    return float(max(rehearsal.target.sigma_m))


def _print(rehearsal: Rehearsal) -> Row:
    verdict = rehearsal.print_verdict
    if verdict is None:
        return skipped("print", "both markers must be in view", "hold it nearer to the target")
    found, _, advice = verdict.text.partition("; ")
    return failed("print", found, advice) if verdict.wrong else passed("print", found)


def design_of(
    rehearsal: Rehearsal, optical: Optical, pipeline: Pipeline, profile: Profile
) -> TargetDesign:
    """The target's ranges with the blur and noise of these pictures, and under this ceiling
    where the target was seen from a known height."""
    usual = Optics()
    blur_px = usual.blur_px if optical.blur is None else optical.blur.least_px
    noise = usual.noise if optical.noise is None else optical.noise
    # Rounded: the ranges are by trial, which is remembered.
    optics = Optics(BLUR_STEP_PX * max(1, round(blur_px / BLUR_STEP_PX)), float(round(noise)))
    ceiling_m = None
    if rehearsal.target is not None and rehearsal.height_m is not None:
        gear_m = profile.vehicle.gear_body_m[2]
        ceiling_m = rehearsal.height_m + gear_m + float(rehearsal.target.e_m[2])
    target, model = profile.target, pipeline.camera
    return make_design(target, model, optics, profile, ceiling_m, trials=FEW_TRIALS)


def _ranges(design: TargetDesign, measured: bool) -> Row:
    r = design.ranges
    each = (("z1", r.z1_m), ("z2", r.z2_m), ("z3", r.z3_m))
    found = ", ".join(f"{n} {'never' if z is None else f'{100.0 * z:.3g} cm'}" for n, z in each)
    optics = f"blur {design.optics.blur_px:g} px, noise {design.optics.noise:g}"
    if not measured:
        return skipped("ranges", f"{found} with a guessed {optics}", "see focus")
    if design.warnings:
        return warned("ranges", f"{found} ({optics}): {design.warnings[0]}",
                      "see perchctl make-target suggest")  # fmt: skip
    return passed("ranges", f"{found} ({optics})")


def _blind(design: TargetDesign) -> Row:
    """From where on nothing is measured any more, and whether a turn of the camera helps."""
    found, *advice = design.mount.lines()
    return warned("blind", found, advice[0]) if advice else passed("blind", found)
