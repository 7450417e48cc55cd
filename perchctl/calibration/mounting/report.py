"""A measured mounting against the profile's: as lines for people, a record for programs, and the
profile's keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration.mounting.carry import Carried
from perchctl.calibration.mounting.pivot import Pivoted
from perchctl.calibration.mounting.robust import IN_95
from perchctl.geometry import Array
from perchctl.profile import Profile

PLACE_SIGMA_M = 0.002
"""A camera's place in the body that is known worse stays as the profile has it: a ruler is
better."""
NOTABLE_TURN_DEG = 1.0
_DEG_DECIMALS, _S_DECIMALS, _M_DECIMALS = 2, 4, 5


@dataclass(frozen=True, eq=False)
class MountingReport:
    """What was measured of a profile's vehicle; a part that was not done is None."""

    profile: Profile
    carried: Carried | None
    pivoted: Pivoted | None

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
        tip_m: Array = self.cam_body_m + self.R_body_cam @ self.pivoted.gear_cam_m
        return tip_m

    @property
    def written_latency_s(self) -> float | None:
        """By the profile; None where each flight is to measure it."""
        latency_s: object = self.profile.camera.latency_s
        return float(latency_s) if isinstance(latency_s, (int, float)) else None

    @property
    def written_gear_cam_m(self) -> Array:
        """The tip in the camera's frame, by the profile, (3,)."""
        T = self.profile.camera.mount.T_body_cam
        return np.asarray(T[:3, :3].T @ (np.array(self.profile.vehicle.gear_body_m) - T[:3, 3]))

    @property
    def turn_from_written_deg(self) -> float:
        """Angle between the measured turn of the camera and the profile's."""
        written = self.profile.camera.mount.T_body_cam[:3, :3]
        return math.degrees(Rotation.from_matrix(written.T @ self.R_body_cam).magnitude())

    def profile_values(self) -> dict[str, float | tuple[float, ...]]:
        """What the profile should say, by dotted key: what was measured, but for a latency that
        each flight is to measure."""
        values: dict[str, float | tuple[float, ...]] = {}
        if self.carried is not None:
            values["camera.mount.rpy_deg"] = _rounded(self.carried.rpy_deg, _DEG_DECIMALS)
            if self.written_latency_s is not None:
                latency_s = max(self.carried.latency_s, 0.0)
                values["camera.latency_s"] = round(latency_s, _S_DECIMALS)
        if self._known_place_m is not None:
            values["camera.mount.position_m"] = _rounded(self.cam_body_m, _M_DECIMALS)
        if self.pivoted is not None:
            values["vehicle.gear_body_m"] = _rounded(self.gear_body_m, _M_DECIMALS)
        return values

    def keys_text(self) -> str:
        """The profile's keys, as they are typed into it."""
        lines = []
        for key, value in self.profile_values().items():
            numbers = value if isinstance(value, tuple) else (value,)
            text = ", ".join(f"{v:g}" for v in numbers)
            lines.append(f"{key}: [{text}]" if isinstance(value, tuple) else f"{key}: {text}")
        return "\n".join(lines)

    def record(self) -> dict[str, Any]:
        """The measured part of the object of `calibrate mount --json`; null is not measured."""
        carried, pivoted = self.carried, self.pivoted
        return {
            "rpy_deg": None if carried is None else list(carried.rpy_deg),
            "latency_s": None if carried is None else carried.latency_s,
            "gear_cam_m": None if pivoted is None else pivoted.gear_cam_m.tolist(),
            "sigma": {
                "rpy_deg": None if carried is None else list(carried.rpy_sigma_deg),
                "latency_s": None if carried is None else carried.latency_sigma_s,
                "gear_cam_m": None if pivoted is None else pivoted.gear_cam_sigma_m.tolist(),
            },
            "written": {
                "rpy_deg": list(self.profile.camera.mount.rpy_deg),
                "latency_s": self.written_latency_s,
                "gear_cam_m": self.written_gear_cam_m.tolist(),
            },
            "profile_values": {
                key: list(value) if isinstance(value, tuple) else value
                for key, value in self.profile_values().items()
            },
        }

    def lines(self) -> list[str]:
        """Each number, its 95 % interval, and what the profile says instead."""
        lines = [] if self.carried is None else self._carried_lines(self.carried)
        if self.pivoted is not None:
            tip_m, sigma_m = self.pivoted.gear_cam_m, self.pivoted.gear_cam_sigma_m
            apart_m = tip_m - self.written_gear_cam_m
            far = bool((np.abs(apart_m) > IN_95 * sigma_m).any())
            lines += _value_lines(
                "gear's tip", _words(1e3 * tip_m, 2), _interval(1e3 * sigma_m, 2),
                "mm in camera axes", _words(1e3 * self.written_gear_cam_m, 2),
                f"{1e3 * float(np.linalg.norm(apart_m)):.1f} mm away" if far else "",
            )  # fmt: skip
        return [*lines, *self._notes()]

    def _carried_lines(self, carried: Carried) -> list[str]:
        most_deg = math.degrees(IN_95 * math.sqrt(float(np.trace(carried.turn_cov_rad2))))
        off_deg = self.turn_from_written_deg
        written = _words(self.profile.camera.mount.rpy_deg, 2)
        away = f"{off_deg:.1f} deg away" if off_deg > most_deg else ""
        turn, interval = _words(carried.rpy_deg, 2), _interval(carried.rpy_sigma_deg, 2)
        lines = _value_lines("turn", turn, interval, "deg", written, away)
        latency_s, sigma_s, written_s = (
            carried.latency_s, carried.latency_sigma_s, self.written_latency_s
        )  # fmt: skip
        if written_s is None:
            away, written = "each flight measures it, and it stays so", "measured"
        else:
            off_s = abs(latency_s - written_s)
            written = _words((1e3 * written_s,), 1)
            away = f"{1e3 * off_s:.1f} ms away" if off_s > IN_95 * sigma_s else ""
        late, interval = _words((1e3 * latency_s,), 1), _interval((1e3 * sigma_s,), 1)
        return lines + _value_lines("latency", late, interval, "ms", written, away)

    def _notes(self) -> list[str]:
        """What has to be known with the numbers."""
        if self.carried is None:
            return ["the gear's place in the body rests on the profile's camera.mount.rpy_deg"]
        place_m, sigma_m = self.carried.cam_body_m, self.carried.cam_body_sigma_m
        notes = []
        if place_m is not None and sigma_m is not None:
            used = "" if self._known_place_m is not None else "; the profile's is kept"
            notes.append(
                f"camera      at {_words(1e3 * place_m, 1)} +- {_interval(1e3 * sigma_m, 1)} mm "
                f"in the body{used}"
            )
        if self.pivoted is None and self.turn_from_written_deg > NOTABLE_TURN_DEG:
            notes.append(
                "the gear's place in the camera changes with the turn: do the pivot as well"
            )
        return notes


def _value_lines(
    name: str, value: str, interval: str, unit: str, written: str, away: str
) -> list[str]:
    return [
        f"{name:<12}{value} +- {interval} {unit} (95 %)",
        f"{'':<12}you wrote {written}: {away or 'within that'}",
    ]


def _rounded(values: Any, decimals: int) -> tuple[float, ...]:
    return tuple(round(float(v), decimals) + 0.0 for v in values)


def _words(values: Any, decimals: int) -> str:
    return " ".join(f"{v:g}" for v in _rounded(values, decimals))


def _interval(sigma: Any, decimals: int) -> str:
    return " ".join(f"{IN_95 * float(v):.{decimals}f}" for v in sigma)
