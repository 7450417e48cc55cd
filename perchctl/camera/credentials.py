"""Names and passwords of streams' URLs: no message and no record shows them."""

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
    """The text without the names and passwords of URLs in it, and without what stands behind
    ``password=`` and its like; other text as it is. In doubt it leaves out too much."""
    if start := _URL.match(text):  # all of it is one URL, spaces in the password too
        text = start.group() + _without_name(text[start.end() :])
    else:
        text = _URL_AMID.sub(lambda found: found.group(1) + _without_name(found.group(2)), text)
    return _SECRET.sub(r"\1***", text)


def _without_name(rest: str) -> str:
    """Of a URL's part behind its scheme."""
    host, slash, path = rest.partition("/")
    if "@" in host:
        return f"{host.rpartition('@')[2]}{slash}{path}"
    before, _, after = rest.rpartition("@")
    return after if ":" in before else rest  # a slash within the password


def without_passwords(profile: Profile) -> Profile:
    """The profile as it may be shown; it opens no camera that wants a password."""
    camera = profile.camera.model_copy(update={"source": without_password(profile.camera.source)})
    described = without_password(profile.description)
    return profile.model_copy(update={"camera": camera, "description": described})


def profile_record(profile: Profile) -> dict[str, Any]:
    """Every key of the profile, as for JSON, to be kept and shown: without a password."""
    return without_passwords(profile).model_dump(mode="json")
