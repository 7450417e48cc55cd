"""The conditions of a simulated flight, each with its keys of the profile's `simulation`: what a
seed drew of it, what is nominal, and everything between the two."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import GRAVITY_MPS2, invert_T
from perchctl.profile import Profile, SimulationConfig, key_unit
from perchctl.sim import Scenario, draw_points, draw_scenario

NO_CONDITION = frozenset(
    {"set", "camera_burst_start_s", "first_contact_share", "draught_towards_deg",
     "target_tilt_towards_deg", "lamp_aside_m", "lamp_z_m", "bare_floor_aside_m", "gust_every_s",
     "capture_hole_every_s", "flow_reach_m", "radio_burst_s"}
)  # fmt: skip
"""Of the section's keys: what only stands for values of the others, or says when, where to or how
much of something that another key says whether there is."""
Told = Callable[[Profile, Scenario], str]


@dataclass(frozen=True)
class ScenarioCondition:
    """`keys`: of `simulation`. `told`: what it is, in words; None: the keys and their values.
    `gradual`: there is less and more of it, beside being there and not."""

    name: str
    keys: tuple[str, ...]
    told: Told | None = None
    gradual: bool = True


def _mounting(profile: Profile, drawn: Scenario) -> str:
    off = invert_T(profile.camera.mount.T_body_cam) @ np.array(drawn.T_body_cam_true)
    cosine = 0.5 * (float(np.trace(off[:3, :3])) - 1.0)
    turn_deg = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    return f"{turn_deg:.2f} deg and {1e3 * np.linalg.norm(off[:3, 3]):.1f} mm"


def _contact(_profile: Profile, drawn: Scenario) -> str:
    if drawn.first_contact_force_n is None:
        return "holds"
    part = drawn.first_contact_force_n / (drawn.mass_kg * GRAVITY_MPS2)
    return f"holds {100 * part:.0f} % of the weight"


def _frames(drawn: Scenario) -> str:
    if drawn.camera_burst is None or not drawn.camera_burst[1]:
        return "none"
    return f"{drawn.camera_burst[1]} at {drawn.camera_burst[0]:.1f} s"


CONDITIONS = (
    ScenarioCondition("mass", ("mass_kg",), lambda _, s: f"{1e3 * s.mass_kg:.1f} g"),
    ScenarioCondition(
        "battery", ("battery_rest_v",), lambda _, s: f"{s.battery_rest_v:.2f} V at rest"
    ),
    ScenarioCondition(
        "start",
        ("start_offset_m", "target_xy_m"),
        lambda _, s: f"{math.hypot(*s.target_xy_m):.2f} m aside",
    ),
    ScenarioCondition(
        "heading", ("target_yaw_deg",), lambda _, s: f"{math.degrees(s.target_yaw_rad):.0f} deg"
    ),
    ScenarioCondition("ceiling", ("ceiling_z_m",), lambda _, s: f"at {s.ceiling_z_m:.2f} m"),
    ScenarioCondition(
        "latency", ("camera_latency_s",), lambda _, s: f"{1e3 * s.camera_latency_s:.0f} ms"
    ),
    ScenarioCondition(
        "jitter", ("camera_jitter_s",), lambda _, s: f"{1e3 * s.camera_jitter_s:.0f} ms"
    ),
    ScenarioCondition("frame rate", ("camera_rate_hz",), lambda _, s: f"{s.camera_rate_hz:.0f} Hz"),
    ScenarioCondition(
        "lost frames", ("camera_drop_rate",), lambda _, s: f"{100 * s.camera_drop_rate:.0f} %"
    ),
    ScenarioCondition("frames lost in one go", ("camera_burst_frames",), lambda _, s: _frames(s)),
    ScenarioCondition(
        "noise", ("camera_noise_sigma",), lambda _, s: f"{s.camera_noise_sigma:.1f} of 255"
    ),
    ScenarioCondition(
        "mounting error",
        ("mount_error_deg", "mount_error_m", "mount_error_rpy_deg", "mount_error_xyz_m"),
        _mounting,
    ),
    ScenarioCondition(
        "tilt bias",
        ("estimate_tilt_bias_deg", "estimate_tilt_bias_xy_deg"),
        lambda _, s: _tilt(s),
    ),
    ScenarioCondition(
        "drift",
        ("drift_mps", "drift_xyz_mps"),
        lambda _, s: f"{1e3 * float(np.linalg.norm(s.drift_mps)):.0f} mm/s",
    ),
    ScenarioCondition(
        "draught", ("draught_mps",), lambda _, s: f"{math.hypot(*s.draught_mps):.2f} m/s"
    ),
    ScenarioCondition("first contact", ("first_contact_fails",), _contact, gradual=False),
    ScenarioCondition("magnet", ("magnet_force_n",), lambda _, s: f"{s.magnet_force_n:.2f} N"),
    ScenarioCondition("target", ("no_target",), lambda _, s: "none" if s.no_target else "there"),
    ScenarioCondition("interlacing", ("camera_fields", "camera_blended")),
    ScenarioCondition("receiver", ("camera_receiver_hz", "camera_receiver_noise"), gradual=False),
    ScenarioCondition("neighbours", ("neighbours", "neighbour_ids"), gradual=False),
)
"""With words of their own, or of several keys; each other key is a condition by itself."""


def _tilt(drawn: Scenario) -> str:
    return f"{math.degrees(math.hypot(*drawn.estimate_tilt_bias_rad)):.2f} deg"


def _of_the_section() -> tuple[ScenarioCondition, ...]:
    known = {key for condition in CONDITIONS for key in condition.keys}
    others = (key for key in SimulationConfig.model_fields if key not in known | NO_CONDITION)
    return (*CONDITIONS, *(ScenarioCondition(key, (key,)) for key in others))


@dataclass(frozen=True)
class ScenarioConditions:
    """Of one seed of a profile; `off` are those in which it is not nominal."""

    profile: Profile
    seed: int
    nominal: Mapping[str, Any]
    drawn: Mapping[str, Any]
    off: tuple[ScenarioCondition, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(condition.name for condition in self.off)

    @property
    def gradual(self) -> tuple[str, ...]:
        """Those that can be weakened."""
        return tuple(
            condition.name
            for condition in self.off
            if condition.gradual
            and any(
                _between(self.nominal[key], self.drawn[key], 0.5)
                not in (self.nominal[key], self.drawn[key])
                for key in condition.keys
            )
        )

    def values(self, levels: Mapping[str, float]) -> dict[str, Any]:
        """All keys of `simulation`, with each condition at its level: 0 nominal, 1 as drawn."""
        values = dict(self.nominal)
        for condition in self.off:
            level = levels[condition.name]
            for key in condition.keys:
                values[key] = _between(self.nominal[key], self.drawn[key], level)
        return values

    def toned(self, levels: Mapping[str, float]) -> Profile:
        """The profile with the conditions at these levels. Of its own seed."""
        plain = self.profile.simulation.model_dump() | self.values(levels)
        simulation = SimulationConfig.model_validate(plain)
        return self.profile.model_copy(update={"simulation": simulation})

    def told(self, condition: ScenarioCondition, levels: Mapping[str, float]) -> str:
        """What it is at these levels, in words."""
        profile = self.toned(levels)
        if condition.told is not None:
            return condition.told(profile, draw_scenario(profile, self.seed))
        values = profile.simulation.model_dump()
        return ", ".join(f"{key} {_plain(key, values[key])}" for key in condition.keys)


def scenario_conditions(profile: Profile, seed: int) -> ScenarioConditions:
    """Of what that seed draws."""
    drawn = profile.simulation.model_dump() | draw_points(profile, seed)
    nominal = _nominal(profile)
    off = tuple(
        condition
        for condition in _of_the_section()
        if any(drawn[key] != nominal[key] for key in condition.keys)
    )
    return ScenarioConditions(profile, seed, nominal, drawn, off)


def _nominal(profile: Profile) -> dict[str, Any]:
    """A flight without anything against it: under the target, in still air, with a full battery,
    and with a camera as the profile says it is. Of what is left, the defaults, in their middle."""
    latency_s = profile.camera.start_latency_s
    burst = None if profile.simulation.camera_burst_frames is None else (0, 0)
    calm = {
        "start_offset_m": 0.0,
        "battery_rest_v": (SimulationConfig().battery_rest_v[1],) * 2,
        "camera_latency_s": (latency_s, latency_s),
        "camera_jitter_s": 0.0,
        "camera_drop_rate": 0.0,
        "camera_burst_frames": burst,
        "camera_noise_sigma": (SimulationConfig().camera_noise_sigma[0],) * 2,
        "mount_error_deg": 0.0,
        "mount_error_m": 0.0,
        "estimate_tilt_bias_deg": 0.0,
        "drift_mps": 0.0,
        "draught_mps": (0.0, 0.0),
        "first_contact_fails": 0.0,
    }
    defaults = {
        key: _middle(value)
        for key, value in SimulationConfig().model_dump().items()
        if key not in NO_CONDITION
    }
    return defaults | calm


def _middle(value: Any) -> Any:
    if isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, float) for v in value):
        return (0.5 * (value[0] + value[1]),) * 2
    return value


def _between(nominal: Any, drawn: Any, level: float) -> Any:
    """Numbers one by one; what has no numbers is there or not."""
    if level in (0.0, 1.0):
        return drawn if level else nominal
    if isinstance(drawn, tuple) and isinstance(nominal, tuple) and len(drawn) == len(nominal):
        return tuple(_between(a, b, level) for a, b in zip(nominal, drawn, strict=True))
    if not (_is_number(drawn) and _is_number(nominal)):
        return drawn
    value = nominal + level * (drawn - nominal)
    return round(value) if isinstance(drawn, int) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _plain(key: str, value: Any) -> str:
    if isinstance(value, tuple) and len(set(value)) == 1:
        value = value[0]
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"{text} {key_unit(key)}".strip()
