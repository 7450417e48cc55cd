"""A profile with some of its keys changed, each named by its dotted path."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic import ValidationError

from perchctl.errors import InvalidValue, UsageError
from perchctl.profile.load import first_invalid_key
from perchctl.profile.plain_yaml import clip_text, parse_yaml
from perchctl.profile.schema import Profile
from perchctl.profile.simulation import in_world


def changed_profile(profile: Profile, settings: Iterable[str], option: str = "--set") -> Profile:
    """With each ``key=value``, such as ``planner.align.xy_m=0.03``; the value as in a profile's
    file. `option` is where they were given. Errors: UsageError (of another form), InvalidValue."""
    settings = sorted(settings, key=_is_world, reverse=True)  # keys win over a world, whatever
    values = profile.model_dump(mode="json")
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise UsageError(
                f"{option} {clip_text(setting)} must be KEY=VALUE with a key of the profile, as in "
                f"{option} planner.align.xy_m=0.03"
            )
        try:
            _put(values, key.strip(), parse_yaml(text))
            if _is_world(setting):
                world = in_world(profile.simulation, str(parse_yaml(text)))
                values["simulation"] = world.model_dump(mode="json")
        except ValidationError as error:
            raise InvalidValue(
                f"{option} {clip_text(setting)}: {first_invalid_key(error)[1]}"
            ) from None
        except ValueError as error:
            raise InvalidValue(f"{option} {clip_text(setting)}: {error}") from None
    try:
        return Profile.model_validate(values)
    except ValidationError as error:
        key, text = first_invalid_key(error)
        raise InvalidValue(f"{option}: {key or 'profile'}: {text}") from None


def _is_world(setting: str) -> bool:
    return setting.partition("=")[0].strip() == "simulation.set"


def profile_value(profile: Profile, dotted: str) -> Any:
    """What the profile has at that key, in JSON's types; None where it has none."""
    value: Any = profile.model_dump(mode="json")
    for name in dotted.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _put(values: dict[str, Any], dotted: str, value: Any) -> None:
    """The key has to be there; below a mapping that a profile may fill, such as
    `link.parameters`, any key is. What is unknown there, the schema says."""
    *sections, key = dotted.split(".")
    for section in sections:
        inner = values.get(section)
        if not isinstance(inner, dict):
            what = "unknown" if section not in values else "no section"
            raise ValueError(f"{section} is {what}; allowed here are {', '.join(values)}")
        values = inner
    values[key] = value
