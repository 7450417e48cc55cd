"""The profile as a whole: every key, its unit, its default and its bounds.

Profiles are checked here and nowhere else; `perchctl.profile.load` reads them from their files.
`perchctl.profile.vision`, `perchctl.profile.mission` and `perchctl.profile.simulation` contain the
larger sections.
"""

from __future__ import annotations

import datetime
import difflib
from collections.abc import Collection, Mapping
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError, field_validator, model_validator

from perchctl.errors import InvalidValue, require_type
from perchctl.plain_yaml import clip_text
from perchctl.profile.base import Section, key, split_constant_keys
from perchctl.profile.limits import IMPOSSIBLE
from perchctl.profile.mission import PlannerConfig, SafetyConfig
from perchctl.profile.positioning import PositioningConfig
from perchctl.profile.simulation import SimulationConfig
from perchctl.profile.vision import (
    CameraConfig,
    DetectorConfig,
    KalmanConfig,
    MergeConfig,
    PoseConfig,
    TargetConfig,
    VehicleConfig,
    check_marker_id,
)

MOTOR_PARAMETERS = ("motorPowerSet.", "health.start")
"""Prefixes of the firmware parameters that spin motors on the ground, even while the vehicle is
disarmed."""


class LinkConfig(Section):
    """The profile's `link`: URI, telemetry and firmware parameters."""

    uri: str = key(
        "sim://",
        "vehicle: `sim://`, `radio://...`, `usb://0`, `udp://HOST:PORT` or `my_module:MyLink`",
    )
    connect_timeout_s: float = key(
        15.0, "total time limit for two connection attempts", gt=0, le=120
    )
    parameters: dict[str, int | float] = Field(
        default_factory=dict,
        description="firmware parameters to set and read back before the flight; none may turn "
        "motors",
    )
    telemetry_period_s: float = key(
        0.01, "period at which telemetry reports position and attitude", ge=0.01, le=0.1
    )
    unreported: tuple[Literal["battery", "variance"], ...] = key(
        (),
        "readings that this vehicle never reports and that take-off therefore does not require: "
        "`battery`, `variance`",
    )
    loop_hz: float = key(50.0, "rate of the flight loop", ge=5, le=200)

    @field_validator("parameters")
    @classmethod
    def _turn_no_motor(cls, parameters: dict[str, int | float]) -> dict[str, int | float]:
        """Reject parameters that turn motors at once, because they are set before the operator is
        asked."""
        for name in parameters:
            if name.startswith(MOTOR_PARAMETERS):
                raise ValueError(
                    f"{name} would turn motors before you confirm the flight: remove it"
                )
        return parameters


class LogConfig(Section):
    directory: str = key("perchctl-logs", "folder for logs and plots")
    plot: bool = key(True, "plot the flight after it ends")
    max_mb: float = key(
        2000.0,
        "size before compression at which the recording stops",
        gt=0,
        le=1e6,
    )


class Profile(Section):
    """One flight's resolved configuration."""

    name: str = key("unnamed", "name of the profile; default: the name of its file")
    description: str = key("", "one-sentence description of the profile")
    date: datetime.date | None = key(None, "date of the measurements, printed on the target")
    camera: CameraConfig = CameraConfig()
    vehicle: VehicleConfig = VehicleConfig()
    target: TargetConfig = TargetConfig()
    detector: DetectorConfig = DetectorConfig()
    pose: PoseConfig = PoseConfig()
    kalman: KalmanConfig = KalmanConfig()
    merge: MergeConfig = MergeConfig()
    planner: PlannerConfig = PlannerConfig()
    safety: SafetyConfig = SafetyConfig()
    link: LinkConfig = LinkConfig()
    positioning: PositioningConfig = PositioningConfig()
    simulation: SimulationConfig = SimulationConfig()
    log: LogConfig = LogConfig()

    def with_(self, changes: Mapping[str, Any]) -> Profile:
        """Return a copy with new values for some keys, checked like a profile file.

        `changes`: values by dotted key, as in ``{"camera.latency_s": 0.03}``. A new
        `positioning.by` drops the keys of the previous method. Raises InvalidValue for an unknown
        key, a section instead of a key, or a value that is not allowed or does not fit the other
        keys.
        """
        require_type("changes", changes, Mapping)
        values = self.model_dump(mode="json")
        if "positioning.by" in changes:
            values["positioning"] = self.positioning.with_method(changes["positioning.by"])
        for dotted, value in changes.items():
            require_type("a key", dotted, str)
            *sections, key = dotted.split(".")
            inner: Any = values
            for name in sections:
                if not isinstance(inner.get(name), dict):
                    what = (
                        "no section" if name in inner else f"unknown; {nearest_names(name, inner)}"
                    )
                    raise InvalidValue(f"{dotted}: {name} is {what}")
                inner = inner[name]
            if isinstance(inner.get(key), dict) and dotted != "link.parameters":
                first = next(iter(inner[key]))
                raise InvalidValue(
                    f"{dotted} is a section: set its keys one by one, such as {dotted}.{first}"
                )
            inner[key] = value
        try:
            _, notes, lost = split_constant_keys(values, Profile)
            if notes or lost:
                raise InvalidValue((notes + lost)[0], "remove it")
            return Profile.model_validate(values)
        except ValidationError as error:
            key, why = key_and_reason(error)
            raise InvalidValue(f"{key or 'profile'}: {why}") from None

    @classmethod
    def constant_key_errors(cls, values: dict[str, Any]) -> list[str]:
        """Return what is wrong with each value that differs from the constant that its key has
        become."""
        return split_constant_keys(values, cls)[2]

    @model_validator(mode="after")
    def _neighbours_can_be_printed(self) -> Profile:
        ids = self.simulation.neighbour_ids
        for name, marker, number in zip(
            ("large", "small"), (self.target.large, self.target.small), ids or (), strict=False
        ):
            try:
                check_marker_id(marker.dictionary, number)
            except ValueError as error:
                raise ValueError(f"simulation.neighbour_ids, {name}: {error}") from None
        return self

    @model_validator(mode="after")
    def _limits_fit(self) -> Profile:
        for limit in IMPOSSIBLE:
            if not limit.holds(self):
                raise ValueError(limit.violation_text(self))
        return self


# --- Errors in values ---


_MOST_OF_A_FAULT = 1000
_BOUNDS = ("less_than_equal", "greater_than_equal")


def key_and_reason(error: ValidationError, model: Any = Profile) -> tuple[str, str]:
    """Return the key of the first error (empty if it concerns several keys) and the reason.
    `model`: the model that was validated."""
    first = error.errors(include_url=False)[0]
    key = clip_text(".".join(str(part) for part in first["loc"]))
    if first["type"] == "extra_forbidden":
        above = first["loc"][:-1]
        keys = _keys_at(model, above)
        if model is Profile and not above:
            keys = ["extends", *keys]
        text = f"this key is unknown; {nearest_names(str(first['loc'][-1]), keys)}"
    elif first["type"] == "value_error":
        text = clip_text(str(first["ctx"]["error"]), _MOST_OF_A_FAULT)
    elif first["type"] == "model_type":
        found = clip_text(repr(first["input"]))
        text = f"must have keys and values, found {found}; add some, or remove it"
    else:
        found = clip_text(repr(first["input"]))
        text = f"{first['msg'][:1].lower()}{first['msg'][1:]}, found {found}"
        names = [part for part in first["loc"] if isinstance(part, str)]
        if names and names[-1].endswith("_m") and first["type"] in _BOUNDS:
            text += " (the unit is metres, not millimetres or centimetres)"
    return key, text


def nearest_names(name: str, allowed: Collection[str]) -> str:
    """Return the end of a message about an unknown name: the most similar one of `allowed`, and all
    of them."""
    close = difflib.get_close_matches(name, allowed, 1)
    return f"{f'did you mean {close[0]}? ' if close else ''}allowed here are {', '.join(allowed)}"


def _keys_at(model: Any, loc: tuple[int | str, ...]) -> list[str]:
    for part in loc:
        kind = model.model_fields[part].annotation
        # A section that may be missing is a union with None.
        model = next((each for each in get_args(kind) if each is not type(None)), kind)
    return list(model.model_fields)
