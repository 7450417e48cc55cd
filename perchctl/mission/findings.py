"""What a flight showed of the camera's latency and mounting, and what to change for the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.profile import USED_LATENCY_S, CameraConfig
from perchctl.values import replace
from perchctl.vision import Consistency

SURE = 1.96
"""Standard deviations on both sides of a 95 % interval."""
LATENCY_GATE_S = 0.02
"""30 ms make an alignment swing by centimetres."""
TURN_GATE_DEG = 2.0
"""35 mm beside at 1 m, more than the cone of an ascent forgives."""


@dataclass(frozen=True)
class Findings:
    """Each with one standard deviation; `advice` in sentences, empty where the profile fits.

    `turn_deg`: the camera's turn from what the profile says, about body x, y and z.
    """

    latency_s: float
    latency_sigma_s: float
    turn_deg: tuple[float, float, float]
    turn_sigma_deg: tuple[float, float, float]
    advice: tuple[str, ...] = ()


def flight_findings(seen: Consistency, camera: CameraConfig) -> Findings:
    """The flight's findings against the profile that was flown."""
    x, y, z = (math.degrees(turn) for turn in seen.turn_rad)
    sx, sy, sz = (math.degrees(sigma) for sigma in seen.turn_sigma_rad)
    found = Findings(
        latency_s=camera.start_latency_s + seen.delay_s,
        latency_sigma_s=seen.delay_sigma_s,
        turn_deg=(x, y, z),
        turn_sigma_deg=(sx, sy, sz),
    )
    advice = [*_about_latency(found, camera), *_about_turn(found)]
    return replace(found, advice=tuple(advice))


def _about_latency(found: Findings, camera: CameraConfig) -> list[str]:
    least_s, most_s = USED_LATENCY_S
    measured = isinstance(camera.latency_s, str)
    used_s = min(max(found.latency_s, least_s), most_s) if measured else camera.start_latency_s
    off_s = found.latency_s - used_s
    if not _is_worth_saying(off_s, LATENCY_GATE_S, found.latency_sigma_s):
        return []
    if measured:
        return [
            f"latency {latency_text(found)}, and {least_s * 1e3:.0f} to {most_s * 1e3:.0f} are "
            f"used with camera.latency_s: measured: find what delays the pictures"
        ]
    to_set = f"{max(0.0, found.latency_s):.3f}"
    return [
        f"latency {latency_text(found)}, profile says {used_s * 1e3:.0f}: set "
        f"camera.latency_s to {to_set}"
    ]


def _about_turn(found: Findings) -> list[str]:
    off = [
        f"{turn:.1f} +- {SURE * sigma:.1f} deg about {axis}"
        for axis, turn, sigma in zip("xyz", found.turn_deg, found.turn_sigma_deg, strict=True)
        if _is_worth_saying(turn, TURN_GATE_DEG, sigma)
    ]
    if not off:
        return []
    return [
        f"the camera is turned by {', '.join(off)} from what the profile says: measure it with "
        f"`perchctl calibrate mount`"
    ]


def _is_worth_saying(off: float, gate: float, sigma: float) -> bool:
    """True if it is beyond the gate, and its 95 % interval is narrower than it is itself."""
    return abs(off) > max(gate, 2.0 * SURE * sigma)


def latency_text(found: Findings) -> str:
    """``92 +- 6 ms``, the 95 % interval."""
    return f"{found.latency_s * 1e3:.0f} +- {SURE * found.latency_sigma_s * 1e3:.0f} ms"


def turn_text(found: Findings) -> str:
    """``0.2 +- 0.6, -0.1 +- 0.6, 0.4 +- 1.8 deg``, about x, y and z."""
    each = zip(found.turn_deg, found.turn_sigma_deg, strict=True)
    return ", ".join(f"{turn:.1f} +- {SURE * sigma:.1f}" for turn, sigma in each) + " deg"
