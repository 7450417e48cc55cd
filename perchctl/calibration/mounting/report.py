"""A measured mounting against the profile's: as lines for people, a record for programs, and the
profile's keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.calibration.mounting.result import IN_95, Carried, Measured, Pivoted, measured
from perchctl.geometry import Array
from perchctl.profile import Profile

PLACE_SIGMA_M = 0.002
"""A camera's place in the body that is known worse stays as the profile has it: a ruler is
better."""
NOTABLE_TURN_DEG = 1.0
_DEG_DECIMALS, _S_DECIMALS, _M_DECIMALS = 2, 4, 5
KEYS = ("rpy_deg", "latency_s", "gear_cam_m")


@dataclass(frozen=True, eq=False)
class MountingReport:
    """What was measured of a profile's vehicle; a part that was not done is None."""

    profile: Profile
    carried: Carried | None
    pivoted: Pivoted | None

    @property
    def measured(self) -> Measured:
        return measured(self.carried, self.pivoted)

    @property
    def R_body_cam(self) -> Array:
        """The measured turn, or the profile's."""
        if self.carried is None:
            return np.asarray(self.profile.camera.mount.T_body_cam[:3, :3])
        return self.carried.R_body_cam

    @property
    def cam_body_m(self) -> Array:
        """The camera's place in the body: measured where that is known well enough."""
        known = self._known_place_m
        return np.array(self.profile.camera.mount.position_m) if known is None else known

    @property
    def _known_place_m(self) -> Array | None:
        carried = self.carried
        if carried is None or carried.cam_body_m is None or carried.cam_body_sigma_m is None:
            return None
        return carried.cam_body_m if carried.cam_body_sigma_m.max() <= PLACE_SIGMA_M else None

    @property
    def camera_label(self) -> str:
        """What of the camera was measured, its turn and its place; empty without either."""
        if self.carried is None:
            return ""
        return "camera, turn as measured" if self._known_place_m is None else "camera, as measured"

    @property
    def gear_body_m(self) -> Array:
        """The tip in body axes; the profile's where no pivot was done."""
        if self.pivoted is None:
            return np.array(self.profile.vehicle.gear_body_m)
        tip_m: Array = self.cam_body_m + self.R_body_cam @ np.array(self.pivoted.gear_cam_m)
        return tip_m

    def profile_values(self) -> dict[str, float | tuple[float, ...]]:
        """What the profile should say, by dotted key: what was measured, but for a latency that
        each flight is to measure."""
        values: dict[str, float | tuple[float, ...]] = {}
        if self.carried is not None:
            values["camera.mount.rpy_deg"] = _rounded(self.carried.rpy_deg, _DEG_DECIMALS)
            if written_latency_s(self.profile) is not None:
                latency_s = max(self.carried.latency_s, 0.0)
                values["camera.latency_s"] = round(latency_s, _S_DECIMALS)
        if self._known_place_m is not None:
            values["camera.mount.position_m"] = _rounded(self.cam_body_m, _M_DECIMALS)
        if self.pivoted is not None:
            values["vehicle.gear_body_m"] = _rounded(self.gear_body_m, _M_DECIMALS)
        return values


def written_gear_cam_m(profile: Profile) -> Array:
    """The tip in the camera's frame, by the profile."""
    T = profile.camera.mount.T_body_cam
    return np.asarray(T[:3, :3].T @ (np.array(profile.vehicle.gear_body_m) - T[:3, 3]))


def turn_between_deg(A: Array, B: Array) -> float:
    """Angle between two rotations."""
    cosine = (float(np.trace(A.T @ B)) - 1.0) / 2.0
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def mounting_lines(c: MountingReport) -> list[str]:
    """Each number, its 95 % interval, and what the profile says instead."""
    lines = []
    m, mount = c.measured, c.profile.camera.mount
    if c.carried is not None and m.rpy_deg is not None and m.rpy_sigma_deg is not None:
        off_deg = turn_between_deg(np.asarray(mount.T_body_cam[:3, :3]), c.R_body_cam)
        most_deg = IN_95 * math.sqrt(float(np.trace(c.carried.turn_cov_rad2))) * 180.0 / math.pi
        wrote = _words(mount.rpy_deg, 2)
        lines += _line(
            "turn", _words(m.rpy_deg, 2), _interval(m.rpy_sigma_deg, 2), "deg", wrote,
            f"{off_deg:.1f} deg away" if off_deg > most_deg else None,
        )  # fmt: skip
    if m.latency_s is not None and m.latency_sigma_s is not None:
        lines += _latency_lines(m.latency_s, m.latency_sigma_s, written_latency_s(c.profile))
    if m.gear_cam_m is not None and m.gear_cam_sigma_m is not None:
        lines += _gear_lines(c, m.gear_cam_m, m.gear_cam_sigma_m)
    return [*lines, *_notes(c)]


def written_latency_s(profile: Profile) -> float | None:
    """By the profile; None where each flight is to measure it."""
    latency_s: object = profile.camera.latency_s
    return float(latency_s) if isinstance(latency_s, (int, float)) else None


def _latency_lines(latency_s: float, sigma_s: float, wrote_s: float | None) -> list[str]:
    value, interval = _words((1e3 * latency_s,), 1), _interval((1e3 * sigma_s,), 1)
    if wrote_s is None:
        away, wrote = "each flight measures it, and it stays so", "measured"
    else:
        off_s = abs(latency_s - wrote_s)
        wrote = _words((1e3 * wrote_s,), 1)
        away = f"{1e3 * off_s:.1f} ms away" if off_s > IN_95 * sigma_s else ""
    return _line("latency", value, interval, "ms", wrote, away)


def _gear_lines(
    c: MountingReport, gear_cam_m: tuple[float, ...], sigma_m: tuple[float, ...]
) -> list[str]:
    wrote_m = written_gear_cam_m(c.profile)
    apart_m = np.array(gear_cam_m) - wrote_m
    far = bool((np.abs(apart_m) > IN_95 * np.array(sigma_m)).any())
    return _line(
        "gear's tip", _words(1e3 * np.array(gear_cam_m), 2),
        _interval(1e3 * np.array(sigma_m), 2), "mm in camera axes", _words(1e3 * wrote_m, 2),
        f"{1e3 * float(np.linalg.norm(apart_m)):.1f} mm away" if far else None,
    )  # fmt: skip


def _line(
    name: str, value: str, interval: str, unit: str, wrote: str, away: str | None
) -> list[str]:
    return [
        f"{name:<12}{value} +- {interval} {unit} (95 %)",
        f"{'':<12}you wrote {wrote}: {away or 'within that'}",
    ]


def _notes(c: MountingReport) -> list[str]:
    """What has to be known with the numbers."""
    if c.carried is None:
        return ["the gear's place in the body rests on the profile's camera.mount.rpy_deg"]
    place_m, sigma_m = c.carried.cam_body_m, c.carried.cam_body_sigma_m
    notes = []
    if place_m is not None and sigma_m is not None:
        used = "" if sigma_m.max() <= PLACE_SIGMA_M else "; the profile's is kept"
        notes.append(
            f"camera      at {_words(1e3 * place_m, 1)} +- {_interval(1e3 * sigma_m, 1)} mm in the "
            f"body{used}"
        )
    off_deg = turn_between_deg(np.asarray(c.profile.camera.mount.T_body_cam[:3, :3]), c.R_body_cam)
    if c.pivoted is None and off_deg > NOTABLE_TURN_DEG:
        notes.append("the gear's place in the camera changes with the turn: do the pivot as well")
    return notes


def mounting_record(c: MountingReport) -> dict[str, Any]:
    """The measured part of the object of `calibrate mount --json`; null is not measured."""
    m, mount = c.measured, c.profile.camera.mount
    return {
        "rpy_deg": _listed(m.rpy_deg),
        "latency_s": m.latency_s,
        "gear_cam_m": _listed(m.gear_cam_m),
        "sigma": {
            "rpy_deg": _listed(m.rpy_sigma_deg),
            "latency_s": m.latency_sigma_s,
            "gear_cam_m": _listed(m.gear_cam_sigma_m),
        },
        "written": {
            "rpy_deg": list(mount.rpy_deg),
            "latency_s": written_latency_s(c.profile),
            "gear_cam_m": written_gear_cam_m(c.profile).tolist(),
        },
        "profile_values": {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in c.profile_values().items()
        },
    }


def keys_text(c: MountingReport) -> str:
    """The profile's keys, as they are typed into it."""
    lines = []
    for key, value in c.profile_values().items():
        text = (
            f"[{', '.join(f'{v:g}' for v in value)}]" if isinstance(value, tuple) else f"{value:g}"
        )
        lines.append(f"{key}: {text}")
    return "\n".join(lines)


def _rounded(values: Any, decimals: int) -> tuple[float, ...]:
    return tuple(round(float(v), decimals) + 0.0 for v in values)


def _words(values: Any, decimals: int) -> str:
    return " ".join(f"{round(float(v), decimals) + 0.0:g}" for v in values)


def _interval(sigma: Any, decimals: int) -> str:
    return " ".join(f"{IN_95 * float(v):.{decimals}f}" for v in sigma)


def _listed(values: tuple[float, ...] | None) -> list[float] | None:
    return None if values is None else list(values)
