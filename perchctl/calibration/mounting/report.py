"""Compare a measured mounting with the profile's: as text, as a JSON record, and as profile
keys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.calibration.board.adjust import SIGMAS_95
from perchctl.calibration.mounting.carry import RotationSolution, solve_rotation
from perchctl.calibration.mounting.pivot import PivotSolution, solve_pivot
from perchctl.calibration.mounting.recording import MountingRecording
from perchctl.geometry import Array
from perchctl.profile import Profile


@dataclass(frozen=True, eq=False)
class _Value:
    """One or three measured numbers. `written` is the value in the profile, or None. For display,
    the numbers are multiplied by `scale`, which converts them to `unit`."""

    name: str
    key: str
    unit: str
    scale: float
    decimals: int
    measured: Array
    sigma: Array
    written: Array | None

    def lines(self) -> list[str]:
        interval = self._text(SIGMAS_95 * self.sigma)
        line = f"{self.name:<12}{self._text(self.measured)} +- {interval} {self.unit} (95 %)"
        if self.written is None:
            return [
                line,
                f"{'':<12}the profile keeps `measured`: each flight measures the latency",
            ]
        apart = self.measured - self.written
        apart = (apart + 180.0) % 360.0 - 180.0 if self.unit == "deg" else apart
        within = (np.abs(apart) <= SIGMAS_95 * self.sigma).all()
        away = self.scale * np.linalg.norm(apart)
        said = "within the interval" if within else f"{away:.1f} {self.unit} off"
        return [line, f"{'':<12}the profile has {self._text(self.written)}: {said}"]

    def _text(self, values: Array) -> str:
        return " ".join(f"{v:g}" for v in _rounded(self.scale * np.ravel(values), self.decimals))


@dataclass(frozen=True, eq=False)
class MountingReport:
    """The measured camera mounting: `rotation` and `pivot`, None for a part not recorded."""

    profile: Profile
    rotation: RotationSolution | None
    pivot: PivotSolution | None

    @property
    def gear_body_m(self) -> Array:
        """The gear's tip in body axes, (3,); the profile's if no pivot was recorded."""
        if self.pivot is None:
            return np.array(self.profile.vehicle.gear_body_m)
        T = self.profile.camera.mount.T_body_cam
        R_body_cam = T[:3, :3] if self.rotation is None else self.rotation.R_body_cam
        return np.asarray(T[:3, 3] + R_body_cam @ self.pivot.gear_cam_m)

    @property
    def profile_gear_cam_m(self) -> Array:
        """The gear's tip in the camera frame, according to the profile, (3,)."""
        T = self.profile.camera.mount.T_body_cam
        return np.asarray(T[:3, :3].T @ (np.array(self.profile.vehicle.gear_body_m) - T[:3, 3]))

    def new_profile_values(self) -> dict[str, float | tuple[float, ...]]:
        """The measured values to write into the profile, by dotted key. The latency is left out if
        the profile says that it is measured in each flight."""
        values: dict[str, float | tuple[float, ...]] = {}
        if self.rotation is not None:
            values["camera.mount.rpy_deg"] = _rounded(self.rotation.rpy_deg, 2)
            if self.profile.camera.latency_s != "measured":
                values["camera.latency_s"] = round(max(self.rotation.latency_s, 0.0), 4)
        if self.pivot is not None:
            values["vehicle.gear_body_m"] = _rounded(self.gear_body_m, 5)
        return values

    def keys_text(self) -> str:
        """The new values as YAML for the profile."""
        lines = []
        for key, value in self.new_profile_values().items():
            numbers = value if isinstance(value, tuple) else (value,)
            text = ", ".join(f"{v:g}" for v in numbers)
            lines.append(f"{key}: [{text}]" if isinstance(value, tuple) else f"{key}: {text}")
        return "\n".join(lines)

    def _values(self) -> list[_Value]:
        camera, values = self.profile.camera, []
        if (rotation := self.rotation) is not None:
            angles = np.array(rotation.rpy_deg)
            sigmas = np.array(rotation.rpy_sigma_deg)
            written = np.array(camera.mount.rpy_deg)
            values.append(_Value("turn", "rpy_deg", "deg", 1.0, 2, angles, sigmas, written))
            late, sigma = np.array([rotation.latency_s, rotation.latency_sigma_s])
            known = None if camera.latency_s == "measured" else np.array(camera.latency_s)
            values.append(_Value("latency", "latency_s", "ms", 1e3, 1, late, sigma, known))
        if (pivot := self.pivot) is not None:
            tip, sigmas = pivot.gear_cam_m, pivot.gear_cam_sigma_m
            written = self.profile_gear_cam_m
            values.append(_Value("gear's tip", "gear_cam_m", "mm", 1e3, 2, tip, sigmas, written))
        return values

    def record(self) -> dict[str, Any]:
        """The JSON object that `calibrate mount` prints: measured values, sigmas, and the old and
        new values in the profile."""
        values = self._values()
        return {v.key: v.measured.tolist() for v in values} | {
            "sigma": {v.key: v.sigma.tolist() for v in values},
            "written": {v.key: v.written.tolist() for v in values if v.written is not None},
            "profile_values": self.new_profile_values(),
        }

    def lines(self) -> list[str]:
        """A line for each value, with its 95 % interval and the profile's value."""
        return [line for value in self._values() for line in value.lines()]


def _rounded(values: Any, decimals: int) -> tuple[float, ...]:
    return tuple(round(float(v), decimals) + 0.0 for v in values)


def solve_mounting(profile: Profile, recordings: Sequence[MountingRecording]) -> MountingReport:
    """Solve for the mounting from the recorded parts.

    Raises InvalidValue, with advice, if a recording is too short or inconsistent.
    """
    by_part = {recording.part: recording for recording in recordings}
    carry = by_part.get("carry")
    pivot = by_part.get("pivot")
    return MountingReport(
        profile,
        None if carry is None else solve_rotation(carry),
        None if pivot is None else solve_pivot(pivot, profile.target.size_sigma),
    )
