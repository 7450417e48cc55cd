"""A measured mounting against the profile's: as lines for people, a record for programs, and the
profile's keys."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration.board.adjust import SIGMAS_95
from perchctl.calibration.mounting.carry import CarrySolution, solve_carry
from perchctl.calibration.mounting.pivot import PivotSolution, solve_pivot
from perchctl.calibration.mounting.recording import MountingRecording
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import Profile

NOTABLE_TURN_DEG = 1.0


@dataclass(frozen=True, eq=False)
class _Value:
    """One measured number or three, their sigmas, and what the profile says, empty where it says
    no number."""

    name: str
    key: str
    unit: str
    measured: Array
    sigma: Array
    written: Array
    decimals: int

    def lines(self) -> list[str]:
        """Return the value with its 95 % interval, and what the profile says instead."""
        interval = " ".join(f"{SIGMAS_95 * sigma:.{self.decimals}f}" for sigma in self.sigma)
        lines = [f"{self.name:<12}{self._text(self.measured)} +- {interval} {self.unit} (95 %)"]
        if not len(self.written):
            return [*lines, f"{'':<12}you wrote measured: each flight measures it, and it stays so"]
        apart = self.measured - self.written
        apart = (apart + 180.0) % 360.0 - 180.0 if self.unit == "deg" else apart
        within = (np.abs(apart) <= SIGMAS_95 * self.sigma).all()
        away = "within that" if within else f"{np.linalg.norm(apart):.1f} {self.unit} away"
        return [*lines, f"{'':<12}you wrote {self._text(self.written)}: {away}"]

    def _text(self, values: Array) -> str:
        return " ".join(f"{v:g}" for v in _rounded(values, self.decimals))


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
    def written_gear_cam_m(self) -> Array:
        """The tip in the camera's frame, by the profile, (3,)."""
        T = self.profile.camera.mount.T_body_cam
        return np.asarray(T[:3, :3].T @ (np.array(self.profile.vehicle.gear_body_m) - T[:3, 3]))

    def profile_values(self) -> dict[str, float | tuple[float, ...]]:
        """Return the values to write into the profile, by dotted key: what was measured, but for a
        latency that each flight is to measure."""
        values: dict[str, float | tuple[float, ...]] = {}
        if self.carried is not None:
            values["camera.mount.rpy_deg"] = _rounded(self.carried.rpy_deg, 2)
            if self.profile.camera.latency_s != "measured":
                values["camera.latency_s"] = round(max(self.carried.latency_s, 0.0), 4)
        if self.pivoted is not None:
            values["vehicle.gear_body_m"] = _rounded(self.gear_body_m, 5)
        return values

    def keys_text(self) -> str:
        """Return the profile's keys, as they are typed into it."""
        lines = []
        for key, value in self.profile_values().items():
            numbers = value if isinstance(value, tuple) else (value,)
            text = ", ".join(f"{v:g}" for v in numbers)
            lines.append(f"{key}: [{text}]" if isinstance(value, tuple) else f"{key}: {text}")
        return "\n".join(lines)

    def _values(self) -> list[_Value]:
        """Return what was measured, in the units of the lines."""
        camera, values = self.profile.camera, []
        if (carried := self.carried) is not None:
            angles = np.array(carried.rpy_deg)
            sigmas = np.array(carried.rpy_sigma_deg)
            written = np.array(camera.mount.rpy_deg)
            values.append(_Value("turn", "rpy_deg", "deg", angles, sigmas, written, 2))
            late, sigma = 1e3 * np.array([[carried.latency_s], [carried.latency_sigma_s]])
            known = np.array([] if camera.latency_s == "measured" else [1e3 * camera.latency_s])
            values.append(_Value("latency", "latency_s", "ms", late, sigma, known, 1))
        if (pivoted := self.pivoted) is not None:
            tip = 1e3 * pivoted.gear_cam_m
            sigma = 1e3 * pivoted.gear_cam_sigma_m
            known = 1e3 * self.written_gear_cam_m
            values.append(_Value("gear's tip", "gear_cam_m", "mm", tip, sigma, known, 2))
        return values

    def record(self) -> dict[str, Any]:
        """Return the measured part of the object of `calibrate mount --json`; null is not
        measured."""
        found: dict[str, dict[str, Any]] = {
            group: dict.fromkeys(("rpy_deg", "latency_s", "gear_cam_m"))
            for group in ("measured", "sigma", "written")
        }
        for value in self._values():
            unit = 1.0 if value.unit == "deg" else 1e-3
            for group, record in found.items():
                numbers = (unit * getattr(value, group)).tolist()
                single = value.key == "latency_s"
                record[value.key] = (*numbers, None)[0] if single else numbers
        values = {key: np.asarray(v).tolist() for key, v in self.profile_values().items()}
        return found.pop("measured") | found | {"profile_values": values}

    def lines(self) -> list[str]:
        """Return each number, its 95 % interval, and what the profile says instead."""
        lines = [line for value in self._values() for line in value.lines()]
        if self.carried is None:
            lines.append("the gear's place in the body rests on the profile's camera.mount.rpy_deg")
        elif self.pivoted is None:
            R = self.profile.camera.mount.T_body_cam[:3, :3]
            turned = Rotation.from_matrix(R.T @ self.carried.R_body_cam)
            if math.degrees(turned.magnitude()) > NOTABLE_TURN_DEG:
                lines.append(
                    "the gear's place in the camera changes with the turn: do the pivot as well"
                )
        return lines


def _rounded(values: Any, decimals: int) -> tuple[float, ...]:
    return tuple(round(float(v), decimals) + 0.0 for v in values)


def solve_mounting(profile: Profile, recordings: Sequence[MountingRecording]) -> MountingReport:
    """Return the measured mounting, of each part there is.

    Raises InvalidValue: a recording is too little or contradicts itself, with what to do.
    """
    by_part = {recording.part: recording for recording in recordings}
    carry = by_part.get("carry")
    pivot = by_part.get("pivot")
    carried, pivoted = None, None
    try:
        carried = None if carry is None else solve_carry(carry)
        if pivot is not None:
            pivoted = solve_pivot(pivot, profile.target.size_sigma)
    except InvalidValue as error:
        if len(by_part) < 2:
            raise
        other = "pivot" if carried is None else "carry"
        raise InvalidValue(f"{error} (--part {other} takes the {other} alone)") from None
    return MountingReport(profile, carried, pivoted)
