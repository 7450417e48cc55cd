"""The profile as a whole: every key, its unit, its default and its bounds.

Profiles are checked here and nowhere else; `perchctl.profile.load` reads them from their files.
`perchctl.profile.vision`, `perchctl.profile.mission` and `perchctl.profile.simulation` contain the
larger sections.
"""

from __future__ import annotations

import datetime
from collections.abc import Collection, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo

from perchctl.errors import InvalidValue, did_you_mean, require_type
from perchctl.plain_yaml import clip_text, value_text
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
_LIMITS = {
    "greater_than": ("gt", "above"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "below"),
    "less_than_equal": ("le", "at most"),
}
_KINDS = {
    "string": "text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "date": "a date, as in 2026-01-31",
    "finite": "a finite number",
}
"""Words for the value that a key takes, by the first word of pydantic's type of error."""


def key_and_reason(error: ValidationError, model: Any = Profile) -> tuple[str, str]:
    """Return the key of the first error (empty if it concerns several keys), and the reason in
    plain words: what was found, and what is allowed. All messages about values in YAML files are
    made here. `model`: the model that was validated."""
    first = error.errors(include_url=False)[0]
    loc, kind, context = first["loc"], first["type"], first.get("ctx", {})
    found = f"found {value_text(first['input'])}"
    key = clip_text(".".join(str(part) for part in loc))
    above = clip_text(".".join(str(part) for part in loc[:-1]))
    in_list = bool(loc) and isinstance(loc[-1], int)
    if kind == "extra_forbidden":
        keys = _keys_at(model, loc[:-1])
        if model is Profile and not loc[:-1]:
            keys = ["extends", *keys]
        return key, f"this key is unknown; {nearest_names(str(loc[-1]), keys)}"
    if kind == "invalid_key" or loc[-1:] == ("[key]",):
        *places, _ = loc[:-1] if loc[-1] == "[key]" else loc
        is_entry = bool(places) and isinstance(places[-1], int)
        number = f", number {int(places.pop()) + 1}" if is_entry else ""
        section = clip_text(".".join(str(part) for part in places)) + number
        note = " (YAML reads yes, no, on and off as true or false)"
        why = note if isinstance(first["input"], bool) else ""
        shown = value_text(first["input"])
        return section, f"found the key {shown}, but keys must be text{why}: put it in quotes"
    if kind == "value_error":
        return key, clip_text(str(context["error"]), _MOST_OF_A_FAULT)
    if kind == "missing" and in_list:
        return above, f"{_list_text(model, loc[:-1])}, {found}"
    if kind == "missing":
        return key, "is missing; add it"
    if kind in ("model_type", "dict_type"):
        key = f"{above}, number {int(loc[-1]) + 1}" if in_list else key
        return key, f"must have keys and values, {found}; add some, or remove it"
    if kind in ("tuple_type", "list_type"):
        return key, f"{_list_text(model, loc)}, {found}"
    if kind == "too_short":
        return key, f"must have at least {_count(context['min_length'], 'entry')}, {found}"
    if kind == "too_long" and context["field_type"] == "Tuple":
        return key, f"{_list_text(model, loc)}, {found}"
    if kind == "too_long":
        most = _count(context["max_length"], "entry")
        return key, f"must have at most {most}, found {len(first['input'])}"
    if kind == "literal_error":
        return key, f"must be {context['expected'].replace(chr(39), '')}, {found}"
    if kind in _LIMITS:
        limit, words = _LIMITS[kind]
        names = [part for part in loc if isinstance(part, str)]
        is_length = bool(names) and names[-1].endswith("_m") and kind.endswith("_equal")
        unit = " (the unit is metres, not millimetres or centimetres)" if is_length else ""
        return key, f"must be {words} {context[limit]:g}, {found}{unit}"
    if kind == "string_pattern_mismatch":
        return key, f"{found}; allowed here: {_description(model, loc)}"
    if kind == "string_too_short":
        return key, "must not be empty"
    # In a union such as `int | float`, the last part of `loc` is the name of one of its types.
    if len(loc) > 1 and loc[-1] in ("int", "float"):
        key, kind = above, "float_type"
    words = _KINDS.get(kind.partition("_")[0], "another value")
    is_unquoted = words == "text" and isinstance(first["input"], int | float)
    return key, f"must be {words}, {found}{': put it in quotes' if is_unquoted else ''}"


def _count(number: int, what: str) -> str:
    return f"{number} {what if number == 1 else what[:-1] + 'ies'}"


def _list_text(model: Any, loc: tuple[int | str, ...]) -> str:
    """Say what the list at `loc` must contain."""
    names = [part for part in loc if isinstance(part, str)]
    kind = _field_at(model, names).annotation
    for _ in range(len(loc) - len(names)):
        kind = get_args(_present(kind))[0]
    kinds = get_args(_present(kind))
    meaning = _description(model, loc)
    if get_origin(_present(kind)) is not tuple or ... in kinds:
        return f"must be a list ({meaning})"
    return f"must be {len(kinds)} numbers in brackets ({meaning})"


def _description(model: Any, loc: tuple[int | str, ...]) -> str:
    names = [part for part in loc if isinstance(part, str)]
    return (_field_at(model, names).description or "see docs/profiles.md").replace("`", "")


def nearest_names(name: str, allowed: Collection[str]) -> str:
    """Return the end of a message about an unknown name: the most similar one of `allowed`, and all
    of them."""
    return f"{did_you_mean(name, allowed)}allowed here are {', '.join(allowed)}"


def _field_at(model: Any, names: Sequence[str]) -> FieldInfo:
    *above, last = names
    for name in above:
        model = _present(model.model_fields[name].annotation)
    field: FieldInfo = model.model_fields[last]
    return field


def _present(kind: Any) -> Any:
    """Return the type of a value that is present: a value that may be missing has a union with
    None. Constraints are left out."""
    if get_origin(kind) in (Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not type(None))
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _keys_at(model: Any, loc: tuple[int | str, ...]) -> list[str]:
    for part in loc:
        model = _present(model.model_fields[part].annotation)
    return list(model.model_fields)
