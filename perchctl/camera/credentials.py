"""Name and password of a stream's URL: shown nowhere."""

from __future__ import annotations

import re
from typing import Any

from perchctl.profile import Profile

_START = r"(?:[a-z][a-z0-9+.-]*://|(?:https?|rtsps?):/?)"
_URL = re.compile(_START, re.IGNORECASE)
_URL_AMID = re.compile(rf"({_START})(\S*)", re.IGNORECASE)
_SECRET = re.compile(
    r"""((?:password|passwd|pwd|pass|user-pw)=)(?:"[^"]*"|'[^']*'|[^&#\s]*)""", re.IGNORECASE
)


def without_password(text: str) -> str:
    """The text without user names and passwords in URLs, and without the values of
    ``password=`` and similar keys. In doubt too much is removed."""
    if start := _URL.match(text):  # all of it is one URL, spaces in the password too
        text = start.group() + _without_name(text[start.end() :])
    else:
        text = _URL_AMID.sub(lambda found: found.group(1) + _without_name(found.group(2)), text)
    return _SECRET.sub(r"\1***", text)


def _without_name(rest: str) -> str:
    host, slash, path = rest.partition("/")
    if "@" in host:
        return f"{host.rpartition('@')[2]}{slash}{path}"
    before, _, after = rest.rpartition("@")
    return after if ":" in before else rest  # a slash within the password


def profile_record(profile: Profile) -> dict[str, Any]:
    """All keys of the profile for JSON, with passwords removed: a profile read back from it
    cannot open a camera that needs one."""
    record = profile.model_dump(mode="json")
    record["camera"]["source"] = without_password(profile.camera.source)
    return record | {"description": without_password(profile.description)}
