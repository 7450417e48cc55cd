"""Name and password of a stream's URL: shown nowhere, sent as the server asks for them."""

from __future__ import annotations

import base64
import contextlib
import re
from collections.abc import Sequence
from typing import Any
from urllib.error import URLError
from urllib.parse import SplitResult, unquote
from urllib.request import (
    HTTPDigestAuthHandler,
    HTTPPasswordMgrWithDefaultRealm,
    Request,
    parse_http_list,
    parse_keqv_list,
)

from perchctl.profile import Profile

_START = r"(?:[a-z][a-z0-9+.-]*://|(?:https?|rtsps?):/?)"
_URL = re.compile(_START, re.IGNORECASE)
_URL_AMID = re.compile(rf"({_START})(\S*)", re.IGNORECASE)
_SECRET = re.compile(
    r"""((?:password|passwd|pwd|pass|user-pw)=)(?:"[^"]*"|'[^']*'|[^&#\s]*)""", re.IGNORECASE
)
_DIGEST = re.compile(r"\bDigest\s+(.*)", re.IGNORECASE)


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
    """Return every key of the profile, for JSON that is kept and shown, without a password: it
    opens no camera that wants one."""
    record = profile.model_dump(mode="json")
    record["camera"]["source"] = without_password(profile.camera.source)
    return record | {"description": without_password(profile.description)}


def authorization(asked: Sequence[str], request: Request, url: SplitResult) -> str | None:
    """Return the Authorization header for a request, by the name and password of `url`.

    `asked`: the server's WWW-Authenticate headers. A digest goes before basic, which would show
    the password. None where the URL has no name, or nothing of it can be answered: of digests the
    standard library knows MD5.
    """
    if url.username is None:
        return None
    name, password = unquote(url.username), unquote(url.password or "")
    passwords = HTTPPasswordMgrWithDefaultRealm()
    passwords.add_password(None, request.full_url, name, password)
    digests = [found[1] for header in asked if (found := _DIGEST.search(header))]
    for digest in digests:
        with contextlib.suppress(ValueError, URLError):  # an algorithm that is not known
            challenge = parse_keqv_list(parse_http_list(digest))
            answer = HTTPDigestAuthHandler(passwords).get_authorization(request, challenge)
            if answer:
                return f"Digest {answer}"
    if digests or not any("basic" in header.lower() for header in asked):
        return None
    return "Basic " + base64.b64encode(f"{name}:{password}".encode()).decode("ascii")
