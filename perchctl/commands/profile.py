"""The work behind `perchctl profile`: a profile in full, or the schema of one."""

from __future__ import annotations

import dataclasses
import json

from perchctl.camera import profile_record, without_passwords
from perchctl.check import Verdict, profile_rows
from perchctl.commands.output import print_record, say
from perchctl.errors import UsageError
from perchctl.profile import editor_schema, find_profile, load_profile, profile_text

DEFAULT_PROFILE = "sim"


def run(named: str | None, schema: bool, as_json: bool) -> int:
    """Print, and say what is doubtful; returns the exit code. Errors: NotFound, InvalidValue,
    UsageError."""
    if schema:
        if named is not None:
            raise UsageError(
                f"--schema is of every profile: -p {named} does not apply; leave it out"
            )
        print(json.dumps(editor_schema(), indent=2))
        return 0
    name = named or DEFAULT_PROFILE
    profile = load_profile(name)
    found = profile_rows(profile)
    if as_json:
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
