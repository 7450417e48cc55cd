"""What options offer to a shell at Tab."""

from __future__ import annotations


def complete_log(incomplete: str) -> list[str]:
    from perchctl.commands.complete import logs

    return logs(incomplete)


def complete_positioning(incomplete: str) -> list[str]:
    from perchctl.commands.complete import positionings

    return positionings(incomplete)


def complete_profile(incomplete: str) -> list[str]:
    from perchctl.commands.complete import profiles

    return profiles(incomplete)


def complete_source(incomplete: str) -> list[str]:
    from perchctl.commands.complete import sources

    return sources(incomplete)
