"""Load a fleet file and check it; the result is a frozen `Fleet`.

Every error is one sentence of the form ``file: vehicle NAME: key: what is wrong``. Nothing is
connected or opened.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator

from perchctl.camera import parse_source
from perchctl.corridor import Point
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.files import kind_note
from perchctl.fleet.assignment import assign_nearest
from perchctl.fleet.fleet import MOST_VEHICLES, Fleet, FleetVehicle, Frame
from perchctl.fleet.radio import choose_dongles
from perchctl.link import check_uri, is_own_uri
from perchctl.places import data_file, file_names
from perchctl.plain_yaml import clip_text, value_text
from perchctl.profile import (
    Profile,
    Section,
    key,
    key_and_reason,
    layered_profile,
    nearest_names,
    read_yaml,
    target_keys,
)

EXAMPLE_FLEET = "four"
"""The fleet in the package that is used if none is named."""
FARTHEST_M = 50.0
"""Largest distance of a home or target from the room's origin, m. A number beyond this limit is
probably in millimetres."""
_Length = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
_ORDER = r"one-at-a-time|together|[1-9][0-9]? at a time"
_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}"
_PROFILE_KEYS = tuple(name for name in Profile.model_fields if name not in ("name", "description"))
_SECTIONS = tuple(name for name in _PROFILE_KEYS if name != "date")
_ALSO_TEXT = ("target", "positioning")
"""Sections whose value may be text instead: a file's name, or the positioning method."""


class _Common(Section):
    """Keys that a vehicle may get from `defaults` in addition to those of the profile."""

    profile: str | None = key(None, "profile, by name or path")
    uri: str | None = key(None, "URI of the vehicle")
    source: str | None = key(None, "camera source")
    heading_deg: float | None = key(None, "heading of the vehicle at home, from the room's x axis")
    frame: Frame | None = key(None, "axes of the state estimate: `room` or `home`")


class _Vehicle(_Common):
    name: str = key(..., "name of the vehicle")
    home_m: tuple[_Length, _Length] = key(..., "position before take-off: x, y")
    target_m: tuple[_Length, _Length] | None = key(None, "position of the vehicle's target: x, y")
    body: str | None = key(
        None, "name of the vehicle's rigid body in the motion-capture system", min_length=1
    )

    @field_validator("name", mode="before")
    @classmethod
    def _fit_for_a_file(cls, name: Any) -> Any:
        if isinstance(name, str) and re.fullmatch(_NAME, name):
            return name
        quotes = "" if isinstance(name, str) else "; put a number in quotes"
        raise ValueError(
            f"found {value_text(name)}; allowed are at most 32 letters, digits, -, _ and ., of "
            f"which the first is a letter or digit{quotes}"
        )


class _File(Section):
    name: str | None = key(None, "name of the fleet")
    defaults: dict[str, Any] = Field(default_factory=dict)
    order: str = key("one-at-a-time", "how many vehicles fly at a time")
    on_failure: Literal["continue", "land-all"] = key(
        "continue", "what the other vehicles do if one fails"
    )
    assign: Literal["fixed", "nearest"] = key("fixed", "whether the targets are interchangeable")
    separation_m: float | None = key(
        None, "minimum distance between two corridors in use at the same time", ge=0.2, le=10
    )
    vehicles: list[dict[str, Any]] = key(
        ..., "the vehicles, each with a name and home_m", min_length=1, max_length=MOST_VEHICLES
    )

    @field_validator("order", mode="before")
    @classmethod
    def _number_or_word(cls, order: Any) -> Any:
        is_number = isinstance(order, int) and not isinstance(order, bool)
        text = f"{order} at a time" if is_number else order
        if isinstance(text, str) and re.fullmatch(_ORDER, text):
            return text
        raise ValueError(
            f"found {value_text(order)}; allowed are one-at-a-time, together, or a number from 1 "
            f"to 99, as in 2 at a time"
        )


def find_fleet(name: str) -> Path:
    """Return the file of a fleet that is given by path or name. Raises NotFound, which lists the
    available names."""
    path = Path(name).expanduser()
    if path.is_file():
        return path
    found = data_file("fleets", name) if "/" not in name else None
    if found is None:
        what = "is a folder" if path.is_dir() else "does not exist"
        names = ", ".join(f"'{each}'" for each in file_names("fleets"))
        raise NotFound(f"fleet file {name} {what}; give a path, or one of these names: {names}")
    return found


def load_fleet(name: str | Path = EXAMPLE_FLEET) -> Fleet:
    """Return the checked fleet with the path or name `name`, each vehicle with its profile and
    target.

    Errors: NotFound, InvalidValue.
    """
    path = find_fleet(str(name))
    values = read_yaml(path, "a fleet file")
    if "vehicles" not in values:
        raise InvalidValue(
            f"{path}: has no vehicles, so it is not a fleet file: list them under vehicles, each "
            f"with name, uri, home_m and target_m{kind_note(path)}"
        )
    keys: _File = _validated(path, _File, values)
    defaults = _split(f"{path}: defaults", _Common, keys.defaults)
    common: _Common = _validated(f"{path}: defaults", _Common, defaults[0])
    vehicles = [
        _vehicle(path, number, entry, common, defaults[1])
        for number, entry in enumerate(keys.vehicles, start=1)
    ]
    _refuse_shared(path, vehicles)
    fleet = Fleet(
        name=keys.name or path.stem,
        vehicles=tuple(choose_dongles(vehicles)),
        order=keys.order,
        on_failure=keys.on_failure,
        assign=keys.assign,
        separation_m=keys.separation_m,
        path=path,
    )
    return assign_nearest(fleet) if fleet.assign == "nearest" else fleet


# --- One vehicle ---


def _vehicle(
    path: Path, number: int, entry: dict[str, Any], common: _Common, shared: dict[str, Any]
) -> FleetVehicle:
    name = entry.get("name")
    where = f"{path}: vehicle {clip_text(name) if isinstance(name, str) and name else number}"
    own_values, sections = _split(where, _Vehicle, entry)
    own: _Vehicle = _validated(where, _Vehicle, own_values)
    defaults = [*_layers(path, f"{path}: defaults", common, shared)]
    layers = [*defaults, *_layers(path, where, own, sections)]
    if own.body is not None:
        layers.append({"positioning": {"body": own.body}})
    if own.target_m is not None:
        layers.append({"target": {"expected_xy_m": list(own.target_m)}})
    layers.append({"name": own.name})
    profile_name = own.profile or common.profile or "sim"
    try:
        profile = layered_profile(path, profile_name, *layers)
    except PerchError as error:
        reason = str(error).removeprefix(f"{path}: ").replace("extends: ", "profile: ", 1)
        if own.profile is None and _fails_alike(path, profile_name, defaults, error):
            where = f"{path}: defaults"
        raise type(error)(f"{where}: {reason}") from None
    profile = _with_own_body(profile, own.name)
    vehicle = FleetVehicle(
        name=own.name,
        profile=profile,
        home_m=own.home_m,
        target_m=own.target_m or own.home_m,
        heading_deg=next((h for h in (own.heading_deg, common.heading_deg) if h is not None), 0.0),
        frame=own.frame or common.frame or default_frame(profile),
    )
    _check(path, where, vehicle, own, common)
    return vehicle.with_target(_target_place(where, vehicle, own.target_m))


def _fails_alike(
    path: Path, profile_name: str, defaults: Sequence[dict[str, Any]], error: PerchError
) -> bool:
    """True if the keys under `defaults` alone, without those of a vehicle, give the same error."""
    try:
        layered_profile(path, profile_name, *defaults)
    except PerchError as alone:
        return str(alone) == str(error)
    return False


def default_frame(profile: Profile) -> Frame:
    """Return the frame of a vehicle for which the fleet file does not specify one. Motion capture
    measures in room axes. A deck may be a Lighthouse but, since a profile does not say which deck
    it is, it counts as a Flow deck, whose drift needs more room."""
    return "room" if profile.positioning.source.is_mocap else "home"


def _layers(
    path: Path, where: str, keys: _Common, sections: dict[str, Any]
) -> Iterable[dict[str, Any]]:
    """Return the profile's keys from `defaults` and from a vehicle; later ones override earlier
    ones."""
    sections = dict(sections)
    if isinstance(file := sections.get("target"), str):
        target_path = path.parent / Path(file).expanduser()
        try:
            sections["target"] = target_keys(target_path)
        except PerchError as error:
            raise type(error)(f"{where}: target: {error}") from None
    yield sections
    if keys.uri is not None:
        yield {"link": {"uri": keys.uri}}
    if keys.source is not None:
        yield {"camera": {"source": keys.source}}


def _with_own_body(profile: Profile, name: str) -> Profile:
    """With motion capture, use the vehicle's name for a rigid body without a name."""
    positioning = profile.positioning
    if not positioning.source.is_mocap or "body" in positioning.model_fields_set:
        return profile
    return profile.model_copy(update={"positioning": positioning.model_copy(update={"body": name})})


def _check(path: Path, where: str, vehicle: FleetVehicle, own: _Vehicle, common: _Common) -> None:
    """Raise InvalidValue for a frame, a URI or a camera source with which the vehicle could not
    fly."""

    def at(name: str) -> str:
        """The place in the file at which the vehicle got this key."""
        is_common = getattr(own, name) is None and getattr(common, name) is not None
        return f"{path}: defaults" if is_common else where

    positioning, uri = vehicle.profile.positioning, vehicle.uri
    only = default_frame(vehicle.profile)
    if vehicle.frame != only and not positioning.source.is_deck:
        axes = (
            "the room's axes"
            if only == "room"
            else "axes with their origin at its position before take-off"
        )
        place = at("frame")
        whose = "its" if place == where else f"{vehicle.name}'s"
        raise InvalidValue(
            f"{place}: frame: is {vehicle.frame}, but with positioning by {positioning.label} "
            f"{whose} estimate uses {axes}: write {only}, or leave it out"
        )
    try:
        key = "uri"
        if not is_own_uri(uri):
            # A dongle is added later to a URI that has none, as written by cfcli.
            check_uri(uri.replace("radio:///", "radio://0/", 1))
        key = "source"
        source = parse_source(vehicle.source)
    except PerchError as error:
        raise type(error)(f"{at(key)}: {error}") from None
    if not vehicle.simulated and (source.scheme == "sim" or not source.live):
        raise InvalidValue(
            f"{at('source')}: camera source {source} is not a live camera, but {uri} is a real "
            f"vehicle: name its camera, as in source: camera:0"
        )


def _target_place(where: str, vehicle: FleetVehicle, target_m: Point | None) -> Point:
    """Return the position of the vehicle's target in the room. Raises InvalidValue if neither the
    file nor the profile contains the position."""
    if target_m is not None:
        return target_m
    expected_m = vehicle.profile.target.expected_xy_m
    if expected_m is None:
        raise InvalidValue(
            f"{where}: the position of its target is missing: set target_m, or set target to a "
            f"file that contains target.expected_xy_m"
        )
    return vehicle.to_room(expected_m)


# --- Resources that two vehicles must not share ---


def _refuse_shared(path: Path, vehicles: Sequence[FleetVehicle]) -> None:
    kinds: tuple[tuple[Callable[[FleetVehicle], str | None], str], ...] = (
        (lambda v: v.name.lower(), "share the name {0}: give each vehicle its own name"),
        (
            _address,
            "share the address of {uris}: give each vehicle its own address, in Bitcraze's client "
            "and in its uri",
        ),
        (_camera, "share the camera {0}: give each vehicle its own source"),
        (_body, "share the motion-capture body {0}: give each vehicle its own body"),
    )
    for read, words in kinds:
        seen: dict[str, tuple[int, FleetVehicle]] = {}
        for number, vehicle in enumerate(vehicles, start=1):
            value = read(vehicle)
            if value is None:
                continue
            if value in seen:
                first, other = seen[value]
                same = other.name.lower() == vehicle.name.lower()
                who = f"{first} and {number}" if same else f"{other.name} and {vehicle.name}"
                uris = " and ".join(dict.fromkeys((other.uri, vehicle.uri)))
                raise InvalidValue(f"{path}: vehicles {who} {words.format(value, uris=uris)}")
            seen[value] = number, vehicle


def _address(vehicle: FleetVehicle) -> str | None:
    """The address that two vehicles must not share; None for a simulated vehicle, because each
    flight starts its own simulator."""
    return None if vehicle.simulated else vehicle.address


def _camera(vehicle: FleetVehicle) -> str | None:
    """The camera that two vehicles must not share; None for a source that is not a device (the
    simulated camera, and recordings)."""
    source = parse_source(vehicle.source)
    return source.device if source.live and source.scheme != "sim" else None


def _body(vehicle: FleetVehicle) -> str | None:
    positioning = vehicle.profile.positioning
    return positioning.body if positioning.source.is_mocap else None


# --- Keys ---


def _split(
    where: str, model: type[Section], values: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split `values` into the keys of `model` and those of the profile. Raises InvalidValue for any
    other key."""
    own = {name: value for name, value in values.items() if name in model.model_fields}
    sections = {name: value for name, value in values.items() if name in _PROFILE_KEYS}
    for name in values:
        if name not in own and name not in sections:
            allowed = (*model.model_fields, *_PROFILE_KEYS)
            raise InvalidValue(
                f"{where}: {clip_text(str(name))}: this key is unknown; "
                f"{nearest_names(str(name), allowed)}"
            )
    for name, value in sections.items():
        # A section with the same name in another layer would silently replace this one.
        is_text = name in _ALSO_TEXT and isinstance(value, str)
        if name in _SECTIONS and not is_text and not isinstance(value, dict):
            raise InvalidValue(
                f"{where}: {name}: must have keys and values, found {value_text(value)}; "
                f"add some, or remove the section"
            )
    return own, sections


def _validated(where: object, model: type[Section], values: dict[str, Any]) -> Any:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        key, reason = key_and_reason(error, model)
        if reason == "is missing; add it":
            reason = f"is missing; {_NEEDED.get(key, 'add it')}"
        raise InvalidValue(f"{where}: {key or 'fleet'}: {reason}") from None


_NEEDED = {
    "name": "give each vehicle a name",
    "home_m": "measure the vehicle's position before take-off, x and y in metres",
}
