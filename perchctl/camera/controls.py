"""`camera.controls`: exposure, white balance, gain and focus as the profile has them."""

from __future__ import annotations

from collections.abc import Mapping

from perchctl.camera.v4l2 import Call, CameraControl, controls_of, set_value, value_of
from perchctl.errors import InvalidValue

Wanted = Mapping[str, int | str]


def set_controls(call: Call, wanted: Wanted, source: str) -> None:
    """Set them, switches and menus first: an automatic one holds others fast. Read back.

    Errors: InvalidValue, a control that the driver lacks, a value that it does not take, one
    that did not stay.
    """
    controls = controls_of(call)
    values = {name: _value(controls, name, value, source) for name, value in wanted.items()}
    for name in sorted(values, key=lambda name: controls[name].kind == "integer"):
        try:
            set_value(call, controls[name], values[name])
        except OSError as error:
            raise InvalidValue(
                f"{source}: camera.controls.{name} could not be set to {values[name]} "
                f"({error.strerror}){_held(call, name)}; change it, or leave it out"
            ) from None
    strayed = strayed_controls(call, wanted, source)
    if strayed:
        raise InvalidValue(strayed[0])


def strayed_controls(call: Call, wanted: Wanted, source: str) -> list[str]:
    """A sentence for each control that reads otherwise than wanted; none is set."""
    controls = controls_of(call)
    told = []
    for name, value in wanted.items():
        try:
            number = _value(controls, name, value, source)
            reads = value_of(call, controls[name])
        except (OSError, InvalidValue) as error:
            told.append(f"{source}: camera.controls.{name} cannot be read back: {error}")
            continue
        if reads != number:
            told.append(
                f"{source}: camera.controls.{name} was set to {number} and reads "
                f"{reads}{_held(call, name)}; change it, or leave it out"
            )
    return told


def _held(call: Call, name: str) -> str:
    control = controls_of(call).get(name)
    if control is None or not control.inactive:
        return ""
    return " while an automatic control has it: fix that one in camera.controls, too"


def _value(controls: Mapping[str, CameraControl], name: str, value: int | str, source: str) -> int:
    control = controls.get(name)
    if control is None:
        has = f"it has {', '.join(controls)}" if controls else "its driver has none at all"
        raise InvalidValue(f"{source} has no control {name!r} (camera.controls); {has}")
    key = f"{source}: camera.controls.{name}"
    if not control.settable:
        raise InvalidValue(f"{key} can only be read; leave it out")
    if control.menu:
        return _entry(control, value, key)
    if isinstance(value, str):
        raise InvalidValue(f"{key}: found {value!r}; needed is {_range(control)}")
    if not control.low <= value <= control.high or (value - control.low) % max(control.step, 1):
        raise InvalidValue(f"{key}: found {value}; allowed are {_range(control)}")
    return value


def _entry(control: CameraControl, value: int | str, key: str) -> int:
    for index, text in control.menu:
        if value == index or (isinstance(value, str) and value.lower() == text.lower()):
            return index
    entries = ", ".join(f"{index} ({text})" for index, text in control.menu)
    raise InvalidValue(f"{key}: found {value!r}; allowed are {entries}")


def _range(control: CameraControl) -> str:
    if control.kind == "boolean":
        return "0 (off) or 1 (on)"
    steps = f" in steps of {control.step}" if control.step > 1 else ""
    return f"{control.low} to {control.high}{steps}"
