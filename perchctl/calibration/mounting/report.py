"""A measured mounting against the profile's: as lines for people, a record for programs, and the
profile's keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration.mounting.carry import CarrySolution
from perchctl.calibration.mounting.pivot import PivotSolution
from perchctl.calibration.mounting.robust import SIGMAS_95
from perchctl.geometry import Array
from perchctl.profile import Profile

NOTABLE_TURN_DEG = 1.0
_DEG_DECIMALS, _S_DECIMALS, _M_DECIMALS = 2, 4, 5


@dataclass(frozen=True, eq=False)
class MountingReport:
    """What was measured of a profile's vehicle; a part that was not done is None."""

    profile: Profile
    carried: CarrySolution | None
    pivoted: PivotSolution | None

    @property
    def gear_body_m(self) -> Array:
        """The tip in body axes; the profile's where no pivot was done."""
        if self.pivoted is None:
            return np.array(self.profile.vehicle.gear_body_m)
        T = self.profile.camera.mount.T_body_cam
        R_body_cam = T[:3, :3] if self.carried is None else self.carried.R_body_cam
        return np.asarray(T[:3, 3] + R_body_cam @ self.pivoted.gear_cam_m)

    @property
    def written_latency_s(self) -> float | None:
        """Latency by the profile; None where each flight is to measure it."""
        latency_s: object = self.profile.camera.latency_s
        return float(latency_s) if isinstance(latency_s, (int, float)) else None

    @property
    def written_gear_cam_m(self) -> Array:
        """The tip in the camera's frame, by the profile, (3,)."""
        T = self.profile.camera.mount.T_body_cam
        return np.asarray(T[:3, :3].T @ (np.array(self.profile.vehicle.gear_body_m) - T[:3, 3]))

    def profile_values(self) -> dict[str, float | tuple[float, ...]]:
        """Return the values to write into the profile, by dotted key: what was measured, but for a
        latency that each flight is to measure."""
        values: dict[str, float | tuple[float, ...]] = {}
        if self.carried is not None:
            values["camera.mount.rpy_deg"] = _rounded(self.carried.rpy_deg, _DEG_DECIMALS)
            if self.written_latency_s is not None:
                latency_s = max(self.carried.latency_s, 0.0)
                values["camera.latency_s"] = round(latency_s, _S_DECIMALS)
        if self.pivoted is not None:
            values["vehicle.gear_body_m"] = _rounded(self.gear_body_m, _M_DECIMALS)
        return values

    def keys_text(self) -> str:
        """Return the profile's keys, as they are typed into it."""
        lines = []
        for key, value in self.profile_values().items():
            numbers = value if isinstance(value, tuple) else (value,)
            text = ", ".join(f"{v:g}" for v in numbers)
            lines.append(f"{key}: [{text}]" if isinstance(value, tuple) else f"{key}: {text}")
        return "\n".join(lines)

    def record(self) -> dict[str, Any]:
        """Return the measured part of the object of `calibrate mount --json`; null is not
        measured."""
        measured: dict[str, Any] = dict.fromkeys(("rpy_deg", "latency_s", "gear_cam_m"))
        sigma = measured.copy()
        if (carried := self.carried) is not None:
            measured |= {"rpy_deg": list(carried.rpy_deg), "latency_s": carried.latency_s}
            sigma |= {
                "rpy_deg": list(carried.rpy_sigma_deg),
                "latency_s": carried.latency_sigma_s,
            }
        if (pivoted := self.pivoted) is not None:
            measured["gear_cam_m"] = pivoted.gear_cam_m.tolist()
            sigma["gear_cam_m"] = pivoted.gear_cam_sigma_m.tolist()
        written = {
            "rpy_deg": list(self.profile.camera.mount.rpy_deg),
            "latency_s": self.written_latency_s,
            "gear_cam_m": self.written_gear_cam_m.tolist(),
        }
        values = {key: np.asarray(v).tolist() for key, v in self.profile_values().items()}
        return measured | {"sigma": sigma, "written": written, "profile_values": values}

    def lines(self) -> list[str]:
        """Return each number, its 95 % interval, and what the profile says instead."""
        lines = []
        if (carried := self.carried) is not None:
            written = self.profile.camera.mount
            turned = Rotation.from_matrix(written.T_body_cam[:3, :3].T @ carried.R_body_cam)
            off_deg = math.degrees(turned.magnitude())
            most_deg = math.degrees(SIGMAS_95 * math.sqrt(float(np.trace(carried.turn_cov_rad2))))
            away = f"{off_deg:.1f} deg away" if off_deg > most_deg else ""
            angles = (carried.rpy_deg, carried.rpy_sigma_deg)
            lines += _value_lines("turn", *angles, 2, "deg", written.rpy_deg, away)
            late_ms, sigma_ms = 1e3 * carried.latency_s, 1e3 * carried.latency_sigma_s
            if self.written_latency_s is None:
                written_ms: tuple[float, ...] = ()
                away = "each flight measures it, and it stays so"
            else:
                written_ms = (1e3 * self.written_latency_s,)
                off_ms = abs(late_ms - written_ms[0])
                away = f"{off_ms:.1f} ms away" if off_ms > SIGMAS_95 * sigma_ms else ""
            lines += _value_lines("latency", (late_ms,), (sigma_ms,), 1, "ms", written_ms, away)
            if self.pivoted is None and off_deg > NOTABLE_TURN_DEG:
                lines.append(
                    "the gear's place in the camera changes with the turn: do the pivot as well"
                )
        if (pivoted := self.pivoted) is not None:
            tip_mm, sigma_mm = 1e3 * pivoted.gear_cam_m, 1e3 * pivoted.gear_cam_sigma_m
            written_mm = 1e3 * self.written_gear_cam_m
            apart_mm = tip_mm - written_mm
            far = (np.abs(apart_mm) > SIGMAS_95 * sigma_mm).any()
            away = f"{np.linalg.norm(apart_mm):.1f} mm away" if far else ""
            tip = ("gear's tip", tip_mm, sigma_mm, 2, "mm in camera axes", written_mm, away)
            lines += _value_lines(*tip)
        if self.carried is None:
            lines.append("the gear's place in the body rests on the profile's camera.mount.rpy_deg")
        return lines


def _value_lines(
    name: str, values: Any, sigmas: Any, decimals: int, unit: str, written: Any, away: str
) -> list[str]:
    """Return the two lines of a value; `written` is what the profile says, empty where it has no
    number."""
    found = " ".join(f"{v:g}" for v in _rounded(values, decimals))
    interval = " ".join(f"{SIGMAS_95 * float(sigma):.{decimals}f}" for sigma in sigmas)
    before = " ".join(f"{v:g}" for v in _rounded(written, decimals)) or "measured"
    return [
        f"{name:<12}{found} +- {interval} {unit} (95 %)",
        f"{'':<12}you wrote {before}: {away or 'within that'}",
    ]


def _rounded(values: Any, decimals: int) -> tuple[float, ...]:
    return tuple(round(float(v), decimals) + 0.0 for v in values)
