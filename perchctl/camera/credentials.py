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
    """Return the text without the names and passwords of its URLs, and without what stands behind
    ``password=`` and its like; other text as it is. In doubt it leaves out too much."""
    if start := _URL.match(text):  # all of it is one URL, spaces in the password too
        text = start.group() + _without_name(text[start.end() :])
    else:
        text = _URL_AMID.sub(lambda found: found.group(1) + _without_name(found.group(2)), text)
    return _SECRET.sub(r"\1***", text)


def _without_name(rest: str) -> str:
    """Remove name and password from a URL's part behind its scheme."""
    host, slash, path = rest.partition("/")
    if "@" in host:
        return f"{host.rpartition('@')[2]}{slash}{path}"
    before, _, after = rest.rpartition("@")
    return after if ":" in before else rest  # a slash within the password


def profile_record(profile: Profile) -> dict[str, Any]:
    """Return all keys of the profile for JSON, without a password: it opens no camera with one."""
    record = profile.model_dump(mode="json")
    record["camera"]["source"] = without_password(profile.camera.source)
    return record | {"description": without_password(profile.description)}
