"""Name and password of a stream's URL: shown nowhere, sent as the server asks for them."""

from __future__ import annotations

import base64
import hashlib
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import SplitResult, unquote

from perchctl.profile import Profile

_START = r"(?:[a-z][a-z0-9+.-]*://|(?:https?|rtsps?):/?)"
_URL = re.compile(_START, re.IGNORECASE)
_URL_AMID = re.compile(rf"({_START})(\S*)", re.IGNORECASE)
_SECRET = re.compile(
    r"""((?:password|passwd|pwd|pass|user-pw)=)(?:"[^"]*"|'[^']*'|[^&#\s]*)""", re.IGNORECASE
)
_HASHES = {"MD5": hashlib.md5, "SHA-256": hashlib.sha256}
_PART = re.compile(r'(\w+)\s*=\s*(?:"((?:[^"\\]|\\.)*)"|([^\s,]+))')
_SCHEMES = re.compile(r"(?:^|,)\s*(Basic|Digest)\b", re.IGNORECASE)


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


def without_passwords(profile: Profile) -> Profile:
    """Return the profile as it may be shown; it opens no camera that wants a password."""
    camera = profile.camera.model_copy(update={"source": without_password(profile.camera.source)})
    described = without_password(profile.description)
    return profile.model_copy(update={"camera": camera, "description": described})


def profile_record(profile: Profile) -> dict[str, Any]:
    """Return every key of the profile, for JSON that is kept and shown, without a password."""
    return without_passwords(profile).model_dump(mode="json")


@dataclass(frozen=True)
class Credentials:
    """Name and password of a URL."""

    name: str = ""
    password: str = ""

    def __repr__(self) -> str:
        return "Credentials(...)"


def credentials_of(parts: SplitResult) -> Credentials | None:
    """Return a URL's name and password; None where it has no name."""
    if parts.username is None:
        return None
    return Credentials(unquote(parts.username), unquote(parts.password or ""))


@dataclass(frozen=True)
class Challenge:
    """What the server asks for (RFC 7616 and 7617)."""

    digest: bool
    realm: str = ""
    nonce: str = ""
    opaque: str = ""
    algorithm: str = ""
    qop: str = ""


def challenge_of(headers: Sequence[str]) -> Challenge | None:
    """Return the best challenge of the WWW-Authenticate headers: digest before basic, as it does
    not show the password. None where none can be answered."""
    found: list[Challenge] = []
    for header in headers:
        starts = list(_SCHEMES.finditer(header))
        for k, start in enumerate(starts, start=1):
            end = starts[k].start() if k < len(starts) else len(header)
            values = _values(header[start.end() : end])
            if start.group(1).lower() == "basic":
                found.append(Challenge(False, values.get("realm", "")))
                continue
            names = ("realm", "nonce", "opaque", "algorithm", "qop")
            each = Challenge(True, *[values.get(name, "") for name in names])
            if _hash_name(each) in _HASHES and _qop(each) is not None:
                found.append(each)
    return max(found, key=lambda c: (c.digest, _hash_name(c) == "SHA-256"), default=None)


def _values(text: str) -> dict[str, str]:
    return {
        key.lower(): re.sub(r"\\(.)", r"\1", quoted) if quoted or not plain else plain
        for key, quoted, plain in _PART.findall(text)
    }


def _hash_name(challenge: Challenge) -> str:
    return (challenge.algorithm or "MD5").upper().removesuffix("-SESS")


def _qop(challenge: Challenge) -> str | None:
    """Return ``auth``, an empty string for the old way, or None if only other ways are offered."""
    offered = [word.strip().lower() for word in challenge.qop.split(",") if word.strip()]
    return "" if not offered else "auth" if "auth" in offered else None


def answer(
    challenge: Challenge, who: Credentials, method: str, path: str, cnonce: str | None = None
) -> str:
    """Return the Authorization header for one request with a fresh nonce.

    `cnonce` is drawn; given, it makes the answer the same each time.
    """
    if not challenge.digest:
        secret = f"{who.name}:{who.password}".encode()
        return "Basic " + base64.b64encode(secret).decode("ascii")
    hashed, qop = _HASHES[_hash_name(challenge)], _qop(challenge)
    cnonce = cnonce or secrets.token_hex(8)

    def h(*words: str) -> str:
        return hashed(":".join(words).encode()).hexdigest()

    first = h(who.name, challenge.realm, who.password)
    if challenge.algorithm.upper().endswith("-SESS"):
        first = h(first, challenge.nonce, cnonce)
    count = "00000001"
    middle = (challenge.nonce, count, cnonce, qop) if qop else (challenge.nonce,)
    values = {
        "username": who.name, "realm": challenge.realm, "nonce": challenge.nonce, "uri": path,
        "response": h(first, *middle, h(method, path)),
    }  # fmt: skip
    if challenge.opaque:
        values["opaque"] = challenge.opaque
    if qop:
        values["cnonce"] = cnonce
    parts = [f'{key}="{_escaped(value)}"' for key, value in values.items()]
    if challenge.algorithm:
        parts.append(f"algorithm={challenge.algorithm}")
    if qop:
        parts += [f"qop={qop}", f"nc={count}"]
    return "Digest " + ", ".join(parts)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')
