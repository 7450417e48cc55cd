"""Load a profile by name or path, check it, and return it as a frozen `Profile`.

`load_profile(name)` reads the file, follows `extends`, and checks the result. Every error is an
`InvalidValue` with one sentence of the form ``file: key: what is wrong``.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from perchctl.errors import InvalidValue, NotFound, ProfileNote, distinct_texts, require_type
from perchctl.files import file_kind, kind_note
from perchctl.places import data_file, data_folder, file_names
from perchctl.plain_yaml import parse_yaml, value_text
from perchctl.profile.base import split_constant_keys
from perchctl.profile.schema import Profile, key_and_reason
from perchctl.profile.vision import MergeConfig, WeightsConfig

_NAMED_FILES = (
    ("merge", "weights_file", "weights"),
    ("camera", "calibration", "calib"),
    ("camera", "mask", None),
)
"""Section and key of each file name in a profile, and the data folder in which that name is looked
up."""


def is_profile_path(name: str) -> bool:
    """True if `name` is the path of a profile file rather than a bare name."""
    return "/" in name or name.endswith((".yaml", ".yml"))


def find_profile(name: str) -> Path:
    """Return the file of a profile that is given by path or name. Errors: NotFound, which lists the
    available names; InvalidValue for another kind of file."""
    if is_profile_path(name):
        path = Path(name).expanduser()
        if path.is_file():
            return path
        what = "is a folder" if path.is_dir() else "does not exist"
        raise NotFound(f"profile file {name} {what}; shipped profiles are {_choices()}")
    found = data_file("profiles", name)
    if found is None:
        if note := kind_note(Path(name), "a profile"):
            raise InvalidValue(f"{name} is not a profile{note}; profiles are .yaml files")
        raise NotFound(f"profile {name!r} not found; give a path, or one of {_choices()}")
    return found


def load_profile(name: str | Path | Profile, *, with_weights: bool = True) -> Profile:
    """Load the profile with the path or name `name`, resolve its `extends`, and check it. A
    `Profile` is returned unchanged.

    `with_weights`: read `merge.weights` from `merge.weights_file`. Keys that have become constants
    are dropped, with a `ProfileNote` as a warning.

    Errors: NotFound, InvalidValue.
    """
    if isinstance(name, Profile):
        return name
    require_type("profile", name, str, Path, Profile)
    path = find_profile(str(name))
    values = read_yaml(path)
    if "vehicles" in values:
        raise InvalidValue(
            f"{path} is a fleet file, not a profile: fly it with perchctl fleet fly {path}"
        )
    profile = _checked(path, values)
    return _with_weights(profile) if with_weights else profile


def _with_weights(profile: Profile) -> Profile:
    if profile.merge.weights_file is None:
        return profile
    weights = _read_weights(profile.merge.weights_file)
    merge = profile.merge.model_copy(update={"weights": weights})
    return profile.model_copy(update={"merge": merge})


def layered_profile(path: Path, base: str, *layers: dict[str, Any]) -> Profile:
    """Return the profile that a file at `path` would give if it extended `base` with the keys of
    all `layers`; later layers override earlier ones. File names in the layers are relative to the
    folder of `path`.

    Errors: NotFound, InvalidValue; both messages begin with `path`.
    """
    values: dict[str, Any] = {"extends": base}
    for layer in layers:
        values = _merged(values, _by_in_full(layer))
    return _with_weights(_checked(path, values))


def _by_in_full(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values with `positioning: mocap` expanded to a section, so that other layers can
    add to it."""
    by = values.get("positioning")
    return {**values, "positioning": {"by": by}} if isinstance(by, str) else values


def target_keys(path: Path) -> dict[str, Any]:
    """Return the keys in the section `target` of the profile at `path`, which may be incomplete.

    Errors: NotFound, InvalidValue.
    """
    target = _resolved(path, read_yaml(path), seen=()).get("target")
    if not isinstance(target, dict):
        raise InvalidValue(f"{path}: has no section target, which gives the position of the target")
    return target


def check_profile(path: Path, text: str) -> None:
    """Raise NotFound or InvalidValue if the profile could not be loaded with `text` as its
    content."""
    with warnings.catch_warnings():
        # these notes were already shown when the profile was loaded
        warnings.simplefilter("ignore", ProfileNote)
        _checked(path, _values_of(text, path))


def _checked(path: Path, own: dict[str, Any]) -> Profile:
    values = _resolved(path, own, seen=())
    values.setdefault("name", path.stem)
    try:
        return Profile.model_validate(values)
    except ValidationError as error:
        if (kind := file_kind(path)) == "a camera calibration":
            raise InvalidValue(
                f"{path} is {kind}, not a profile: name it in a profile's camera.calibration"
            ) from None
        raise InvalidValue(_one_sentence(path, error)) from None


# --- The weights file ---


def _read_weights(name: str) -> WeightsConfig:
    """Return the weights from the file named in a loaded profile, by an absolute path or by a name
    in the user's folder. Raises NotFound, InvalidValue."""
    given = Path(name)
    path = given if given.is_file() else data_file("weights", name)
    if path is None:
        raise NotFound(
            f"merge.weights_file: {name} does not exist; make it with perchctl fit-weights, "
            "or remove the key"
        )
    weights = read_yaml(path, "a weights file").get("weights")
    held = weights if isinstance(weights, dict) else {}
    missing = [axis for axis in WeightsConfig.model_fields if axis not in held]
    if missing:
        raise InvalidValue(f"{path}: weights.{missing[0]} is missing; x, y, z and yaw are needed")
    try:
        return MergeConfig.model_validate({"weights": weights}).weights
    except ValidationError as error:
        raise InvalidValue(_one_sentence(path, error)) from None


# --- The camera's calibration and mask ---


def find_calibration(name: str) -> Path:
    """The calibration file at the path `name`, or with that name in `calib/`. Raises NotFound."""
    given = Path(name).expanduser()
    if given.is_file():
        return given
    found = data_file("calib", name)
    if found is None:
        raise NotFound(
            f"calibration file {name} not found; give a path, or one of "
            + (", ".join(file_names("calib")) or f"none ({data_folder('calib')} is empty)")
        )
    return found


MOST_MASKED_SHARE = 0.75
"""Largest fraction of the image that a mask may cover. Larger: no room is left for a target."""
_WHITE = 127


def find_mask(name: str) -> Path:
    """The mask file at the path `name`. Raises NotFound."""
    path = Path(name)
    if not path.is_file():
        raise NotFound(
            f"camera.mask: {name} does not exist; make one with perchctl calibrate mask "
            f"SOURCE -o {path.name}, or remove the key"
        )
    return path


def read_mask(name: str, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask of the pixels that the vehicle covers, (height, width): True where the file
    is white. Errors: NotFound, InvalidValue."""
    path = find_mask(name)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InvalidValue(f"camera.mask: {path} cannot be read as an image")
    height, width = image.shape[:2]
    if (width, height) != size_px:
        raise InvalidValue(
            f"camera.mask: {path} is {width}x{height} px, but the calibration was made at "
            f"{size_px[0]}x{size_px[1]} px: make the mask from this camera's images"
        )
    covered = np.asarray(image > _WHITE)
    share = float(covered.mean())
    if share > MOST_MASKED_SHARE:
        covers, allowed = distinct_texts(100.0 * share, 100.0 * MOST_MASKED_SHARE, 0)
        raise InvalidValue(
            f"camera.mask: {path} covers {covers} % of the image, but at most {allowed} % is "
            "allowed: white marks the part that the vehicle covers, and black the rest"
        )
    if share == 0.0:
        raise InvalidValue(
            f"camera.mask: {path} covers nothing: white marks the part that the vehicle covers; "
            "remove the key if the vehicle covers no part of the image"
        )
    return covered


# --- Reading ---


def _choices() -> str:
    return ", ".join(file_names("profiles"))


def _resolved(path: Path, own: dict[str, Any], seen: tuple[Path, ...]) -> dict[str, Any]:
    """Return the content of the file at `path`, merged over that of the profile that it extends."""
    if path in seen:
        raise InvalidValue(f"{path}: extends: the chain of profiles refers back to itself")
    values = _without_constants(own, path)
    if not values:
        raise InvalidValue(
            f"{path}: the profile is empty: begin with a line such as extends: sim, and add "
            "the keys that differ"
        )
    for section, key, kind in _NAMED_FILES:
        _place_beside(values, path, section, key, kind)
    base_name = values.pop("extends", None)
    if base_name is None:
        return values
    if not isinstance(base_name, str):
        raise InvalidValue(f"{path}: extends: must be the name or path of a profile")
    beside = path.parent / Path(base_name).expanduser()
    by_path = beside.is_file() or is_profile_path(base_name)
    try:
        base = find_profile(str(beside.absolute()) if by_path else base_name)
    except NotFound as error:
        raise NotFound(f"{path}: extends: {error}") from None
    return _merged(_resolved(base, read_yaml(base), (*seen, path)), values)


def _without_constants(values: dict[str, Any], path: Path) -> dict[str, Any]:
    values, notes, lost = split_constant_keys(values, Profile)
    if lost:
        raise InvalidValue(f"{path}: {lost[0]}", "remove it")
    for note in notes:
        warnings.warn(f"{path}: {note}; remove it", ProfileNote, stacklevel=2)
    return values


def _place_beside(
    values: dict[str, Any], path: Path, section: str, key: str, kind: str | None
) -> None:
    """Resolve the file names in a profile relative to its own folder, independently of the profiles
    that extend it and of the working directory. A name of `kind` may also refer to a data
    folder."""
    part = values.get(section)
    name = part.get(key) if isinstance(part, dict) else None
    if not isinstance(name, str):
        return
    beside = path.resolve().parent / Path(name).expanduser()
    if beside.is_file() or not (kind and data_file(kind, name)):
        values[section] = {**part, key: str(beside)}  # type: ignore[dict-item]


def read_yaml(path: Path, expected: str = "a profile") -> dict[str, Any]:
    """Return the keys and values of a YAML file, unchecked. `expected`: what the file should be,
    for messages. Errors: NotFound, InvalidValue."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        if note := kind_note(path):
            raise InvalidValue(f"{path} is not {expected}{note}") from None
        raise InvalidValue(f"{path}: not a text file in UTF-8") from None
    except OSError as error:
        raise NotFound(f"{path}: cannot be read: {error.strerror}") from None
    return _values_of(text, path, expected)


def _values_of(text: str, path: Path, expected: str = "a profile") -> dict[str, Any]:
    try:
        values = parse_yaml(text)
    except ValueError as error:
        # In a YAML file, the faulty line is what the user needs; in any other file, its kind is.
        if note := kind_note(path, "a profile", "a fleet file", "a camera calibration"):
            raise InvalidValue(f"{path} is not {expected}{note}") from None
        raise InvalidValue(f"{path}: {error}") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise InvalidValue(f"{path}: must have keys and values, found {value_text(values)}")
    return values


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        result[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return result


def _one_sentence(path: Path, error: ValidationError) -> str:
    key, text = key_and_reason(error)
    others = len({_key_of(each["loc"]) for each in error.errors(include_url=False)}) - 1
    more = f" (and {others} more error{'s' if others > 1 else ''})" if others else ""
    return f"{path}: {key or 'profile'}: {text}{more}"


def _key_of(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """Return the place of the key with an error. The last part of `loc` may be the number of an
    item in the key's list, or the name of a type that the key allows."""
    return loc[:-1] if loc and (isinstance(loc[-1], int) or loc[-1] in ("int", "float")) else loc
