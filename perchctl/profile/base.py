"""Common parts of all sections of a profile."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Vector3 = tuple[float, float, float]

FARTHEST_ON_BODY_M = 0.3
"""Largest distance of any part of a vehicle from its centre on one axis, m. No vehicle of 42 g is
larger."""
_OnBody = Annotated[float, Field(ge=-FARTHEST_ON_BODY_M, le=FARTHEST_ON_BODY_M)]
BodyVector3 = tuple[_OnBody, _OnBody, _OnBody]


def key(default: Any, meaning: str, **constraints: Any) -> Any:
    """The pydantic `Field` for a profile key, with the description that users read. If the default
    is ``...``, the key is required."""
    return Field(default, description=meaning, **constraints)


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """Return the pair. Raises ValueError unless the lowest value comes first."""
    if pair[0] > pair[1]:
        raise ValueError(f"the lower bound {pair[0]} is above the upper bound {pair[1]}")
    return pair


Number = TypeVar("Number")
Ordered = Annotated[
    tuple[Number, Number], AfterValidator(_ordered), Field(json_schema_extra={"ordered": True})
]
"""A pair of numbers, the lower one first."""
Range = Ordered[float]


class Section(BaseModel):
    """Keys and values of a section of a YAML file: frozen, and without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_switch_for_a_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Reject YAML's yes, no, on and off as numbers, because pydantic would read them as 1 and
        0."""
        kind = cls.model_fields[info.field_name or ""].annotation
        if _takes_numbers(kind) and _holds_switch(value):
            raise ValueError(
                "found true or false (YAML reads yes, no, on and off in the same way); write a "
                "number"
            )
        return value


def _takes_numbers(kind: Any) -> bool:
    return kind in (int, float) or any(map(_takes_numbers, get_args(kind)))


def _holds_switch(value: Any, levels: int = 2) -> bool:
    """`levels`: how many lists or mappings deep to look; no key has numbers any deeper. By its
    aliases, a YAML value can contain itself."""
    if isinstance(value, (dict, list)):
        inner = value.values() if isinstance(value, dict) else value
        return levels > 0 and any(_holds_switch(each, levels - 1) for each in inner)
    return isinstance(value, bool)


# --- Units ---

UNITS = {
    "acc_g": "g",
    "deg": "deg",
    "dps": "deg/s",
    "g": "g",
    "hz": "Hz",
    "kg": "kg",
    "m": "m",
    "mah": "mAh",
    "m2": "m^2",
    "mb": "MB",
    "mps": "m/s",
    "mps2": "m/s^2",
    "n": "N",
    "ohm": "ohm",
    "per_m": "1/m",
    "per_s": "1/s",
    "px": "px",
    "rad": "rad",
    "radps": "rad/s",
    "radps2": "rad/s^2",
    "s": "s",
    "v": "V",
}
"""The last word of a key's name, and the unit that it stands for."""
UNITS_OF = {
    "k1": "cm^2, deg^2",
    "k2": "cm^2, deg^2",
    "camera_noise_sigma": "grey levels",
}


def key_unit(path: str) -> str:
    """The unit given by the suffix of a key's name; empty if there is no such suffix."""
    name = path.rpartition(".")[2]
    endings = (name.split("_", n)[-1] for n in range(1, name.count("_") + 1))
    return UNITS_OF.get(name) or next((UNITS[e] for e in endings if e in UNITS), "")


# --- Keys that have become constants of their section ---


def split_constant_keys(
    values: dict[str, Any], model: type[BaseModel], path: str = ""
) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return a profile's values without the keys that have become constants (class variables of
    `model` or of its nested models), a note for each such key that has the constant's value, and an
    error for each such key that has another value. `path` is the prefix of the keys in these
    texts."""
    result, notes, lost = dict(values), list[str](), list[str]()
    for key, value in values.items():
        kind = model.model_fields[key].annotation if key in model.model_fields else None
        if key in model.__class_vars__:
            del result[key]
            constant = getattr(model, key)
            now = f"{path}{key} is no longer a key: it is {constant} for every profile"
            if value == (list(constant) if isinstance(constant, tuple) else constant):
                notes.append(now)
            else:
                lost.append(f"{now}, but {value} here")
        elif isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, BaseModel):
            result[key], more, gone = split_constant_keys(value, kind, f"{path}{key}.")
            notes, lost = notes + more, lost + gone
    return result, notes, lost
