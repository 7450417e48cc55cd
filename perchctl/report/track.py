"""A flight's ticks by time, and the places where something changed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log import FlightLog, PhaseSpan

SAME_S = 1e-3


@dataclass(frozen=True)
class Step:
    """A phase that was entered; times from the flight's first tick, `end_s` that of the next."""

    phase: str
    start_s: float
    end_s: float
    reason: str
    row: str = ""
    severity: str = ""
    simulated: str = ""


@dataclass(frozen=True, eq=False)
class Track:
    """A log with what the report asks of it again and again. Times start at 0."""

    log: FlightLog

    @cached_property
    def t_s(self) -> Array:
        return self.log.since(self.log.column("t_s"))

    @cached_property
    def motion(self) -> Motion:
        return motion_of(self.log)

    @property
    def end_s(self) -> float:
        return float(self.t_s[-1]) if self.t_s.size else 0.0

    def index_at(self, t_s: float) -> int:
        """The newest tick at that time."""
        return max(0, int(np.searchsorted(self.t_s, t_s + SAME_S / 2, side="right")) - 1)

    def at(self, t_s: float, key: str) -> float:
        """A field then, NaN where it is missing."""
        if not self.log.records:
            return math.nan
        value = self.log.records[self.index_at(t_s)].get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return math.nan
        return float(value)

    def height_m(self, t_s: float) -> float:
        """Above the place of the first tick."""
        return self.at(t_s, "z_m") - self.at(0.0, "z_m")

    def within(self, start_s: float, end_s: float) -> slice:
        """The ticks from one time to another."""
        first, last = np.searchsorted(self.t_s, (start_s - SAME_S / 2, end_s + SAME_S / 2))
        return slice(int(first), int(last))

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """The phases as they were entered, with the rows that led there where events tell."""
        events = [e for e in self.log.events if e.get("event") == "phase"]
        steps = [self._step(span, events) for span in self.log.phases]
        told = {round(step.start_s, 2) for step in steps}
        for event in events:  # an end that no tick followed
            start_s = self.log.since(float(event["t_s"]))
            if steps and start_s > steps[-1].end_s - SAME_S and round(start_s, 2) not in told:
                span = PhaseSpan(
                    str(event.get("phase") or ""),
                    float(event["t_s"]),
                    float(event["t_s"]),
                    str(event.get("reason") or ""),
                )
                steps.append(self._step(span, [event]))
        return tuple(steps)

    def _step(self, span: PhaseSpan, events: list[dict[str, Any]]) -> Step:
        event = next(
            (
                e
                for e in events
                if e.get("phase") == span.phase and abs(float(e["t_s"]) - span.start_s) < SAME_S
            ),
            {},
        )
        return Step(
            span.phase,
            self.log.since(span.start_s),
            self.log.since(span.end_s),
            span.reason or str(event.get("reason") or ""),
            str(event.get("row") or ""),
            str(event.get("severity") or ""),
            str(event.get("simulated") or ""),
        )

    def runs(self, key: str) -> Iterator[tuple[float, float, str]]:
        """Stretches over which a text stayed the same, without those that have none."""
        began_s, text = 0.0, ""
        for t_s, record in zip(self.t_s, self.log.records, strict=True):
            now = str(record.get(key) or "")
            if now == text:
                continue
            if text:
                yield began_s, float(t_s), text
            began_s, text = float(t_s), now
        if text:
            yield began_s, self.end_s, text


# --- How fast the target moved through the picture, read off a log: what blurs a marker --------
# The blur is a path's length in the exposure, not the lens's own. It is known where the exposure
# is: in a simulation, or where `camera.controls` set it.


LOOKS_UP_DEG = 20.0
"""A camera that is tilted more has another geometry than this one."""
NEAREST_M = 0.05
SMOOTHED_S = 0.06
"""Over it a rate is taken, since a telemetry sample may stand for several turns."""
UVC_UNIT_S = 1e-4
EXPOSURES = ("exposure_time_absolute", "exposure_absolute")


@dataclass(frozen=True, eq=False)
class Motion:
    """Over the ticks, (n,), NaN where it is unknown.

    Attributes:
        speed_mps: of the vehicle by its own estimate.
        flow_pxps: of the target's centre through the picture.
        exposure_s: None where nobody knows it.
    """

    speed_mps: Array
    flow_pxps: Array
    exposure_s: float | None

    @cached_property
    def blur_px(self) -> Array:
        exposure_s = math.nan if self.exposure_s is None else self.exposure_s
        return self.flow_pxps * exposure_s


def motion_of(log: FlightLog) -> Motion:
    """Of every tick of the flight."""
    velocity = np.stack([log.column(f"v{axis}_mps") for axis in "xyz"], axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    focal_px = focal_px_of(log)
    if focal_px is None or len(log.records) < 2:
        return Motion(speed, np.full(speed.shape, np.nan), exposure_s_of(log.header))
    return Motion(speed, focal_px * _angular_rate(log, velocity), exposure_s_of(log.header))


def exposure_s_of(header: Mapping[str, Any]) -> float | None:
    """The time for which a picture was exposed, as far as the log says it."""
    profile = _section(header, "profile")
    if str(header.get("uri", "")).startswith("sim://"):
        return _number(_section(profile, "simulation").get("camera_exposure_s"))
    controls = _section(_section(profile, "camera"), "controls")
    for name in EXPOSURES:
        units = _number(controls.get(name))
        if units is not None:
            return units * UVC_UNIT_S
    return None


def focal_px_of(log: FlightLog) -> float | None:
    """The camera's focal length: from the size of the markers where the poses place them."""
    target = _section(_section(log.header, "profile"), "target")
    up_m = _to_camera(log.header)[2]
    found = []
    for record in log.records:
        distance_m = next(
            (record[f"{s}z_m"] for s in "jls" if record.get(f"{s}z_m") is not None), None
        )
        side_m = _number(_section(target, "large").get("side_m"))
        corners = record.get("large_px")
        if distance_m is None or side_m is None or not corners or len(corners) != 8:
            continue
        points = np.array(corners, dtype=np.float64).reshape(4, 2)
        area_px2 = abs(_area(points))
        found.append(math.sqrt(area_px2) * (distance_m + up_m) / side_m)
    return float(np.median(found)) if found else None


def _area(points: Array) -> float:
    x, y = points.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def _angular_rate(log: FlightLog, velocity_mps: Array) -> Array:
    """Of the target's direction in the camera, 1/s in the picture's plane."""
    t_s = log.column("t_s")
    yaw = np.unwrap(_filled(log.column("yaw_rad")))
    turns = np.stack(
        [
            _rate(t_s, _filled(log.column("roll_rad"))),
            _rate(t_s, _filled(log.column("pitch_rad"))),
            _rate(t_s, yaw),
        ],
        axis=1,
    )
    x, y, up_m = _to_camera(log.header)
    place = np.stack([log.column(f"e{axis}_m") for axis in "xyz"], axis=1)
    place = place + np.array([x, y, up_m])
    cos, sin = np.cos(yaw), np.sin(yaw)
    level = np.stack(
        [
            cos * velocity_mps[:, 0] + sin * velocity_mps[:, 1],
            cos * velocity_mps[:, 1] - sin * velocity_mps[:, 0],
            velocity_mps[:, 2],
        ],
        axis=1,
    )
    moves = -level - np.cross(turns, place)
    z = np.where(place[:, 2] > NEAREST_M, place[:, 2], np.nan)
    flow = moves[:, :2] / z[:, None] - place[:, :2] * (moves[:, 2] / z**2)[:, None]
    rate: Array = np.linalg.norm(flow, axis=1)
    return rate


def _to_camera(header: Mapping[str, Any]) -> tuple[float, float, float]:
    """From a place relative to the gear to one relative to the camera, m; NaN where the camera
    does not look up."""
    profile = _section(header, "profile")
    mount = _section(_section(profile, "camera"), "mount")
    gear = _section(profile, "vehicle").get("gear_body_m") or (0.0, 0.0, 0.0)
    at = mount.get("position_m") or (0.0, 0.0, 0.0)
    roll, pitch, _ = mount.get("rpy_deg") or (0.0, 0.0, 0.0)
    if max(abs(roll), abs(pitch)) > LOOKS_UP_DEG:
        return (math.nan, math.nan, math.nan)
    x, y, z = (float(g) - float(c) for g, c in zip(gear, at, strict=True))
    return x, y, z


def _rate(t_s: Array, angle_rad: Array) -> Array:
    """Central differences over `SMOOTHED_S`."""
    after = np.minimum(np.searchsorted(t_s, t_s + SMOOTHED_S / 2), t_s.size - 1)
    before = np.maximum(np.searchsorted(t_s, t_s - SMOOTHED_S / 2, side="right") - 1, 0)
    spent = t_s[after] - t_s[before]
    return np.where(spent > 0, (angle_rad[after] - angle_rad[before]) / np.maximum(spent, 1e-9), 0)


def _filled(values: Array) -> Array:
    return np.nan_to_num(values, nan=0.0)


def _section(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = values.get(name)
    return section if isinstance(section, Mapping) else {}


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None
