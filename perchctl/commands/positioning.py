"""`--positioning`: what measures the position, on top of the profile."""

from __future__ import annotations

from typing import get_args

from perchctl.errors import InvalidValue
from perchctl.profile import PositioningConfig, Profile

POSITIONINGS: tuple[str, ...] = get_args(PositioningConfig.model_fields["by"].annotation)


def positioned(profile: Profile, by: str | None) -> Profile:
    """`by` None: as the profile has it. Errors: InvalidValue."""
    if by is None:
        return profile
    if by not in POSITIONINGS:
        raise InvalidValue(
            f"--positioning {by!r} is unknown; allowed are {', '.join(POSITIONINGS)}"
        )
    config = PositioningConfig(
        by="deck", decks=profile.positioning.decks
    )  # a capture's keys would be of no use, and puzzle
    if by == profile.positioning.by:
        config = profile.positioning
    elif "target" in (by, profile.positioning.by):  # whose limits are its own
        config = PositioningConfig.model_validate({"by": by, "decks": config.decks})
    elif by != "deck":
        config = profile.positioning.model_copy(update={"by": by})
    return profile.model_copy(update={"positioning": config})
