"""The work behind `perchctl profile`: a profile in full, or the schema of one."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from perchctl.camera import profile_record, without_passwords
from perchctl.check import Verdict, profile_rows
from perchctl.commands.output import print_record, say
from perchctl.errors import UsageError
from perchctl.profile import editor_schema, find_profile, load_profile, profile_text

DEFAULT_PROFILE = "sim"


@dataclass(frozen=True)
class ProfileRequest:
    """The command line as it was given; None is not given."""

    profile: str | None = None
    schema: bool = False
    as_json: bool = False


def run(request: ProfileRequest) -> int:
    """Print, and say what is doubtful; returns the exit code. Errors: NotFound, InvalidValue,
    UsageError."""
    if request.schema:
        if request.profile is not None:
            raise UsageError(
                f"--schema is of every profile: -p {request.profile} does not apply; leave it out"
            )
        print(json.dumps(editor_schema(), indent=2))
        return 0
    name = request.profile or DEFAULT_PROFILE
    profile = load_profile(name)
    found = profile_rows(profile)
    if request.as_json:
        record = {
            "profile_file": str(find_profile(name)),
            "profile": profile_record(profile),
            "check": [dataclasses.asdict(row) for row in found],
        }
        print_record(record)
        return 0
    print(profile_text(without_passwords(profile)), end="")
    for row in found:
        if row.verdict in (Verdict.WARN, Verdict.FAIL):
            say(f"{row.name}: {row.found}; {row.advice}")
    return 0
