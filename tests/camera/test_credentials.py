"""Digest and basic authentication, by the examples of RFC 2617 and RFC 7616."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import pytest

from perchctl.camera.credentials import Challenge, Credentials, answer, challenge_of

CNONCE = "f2/wE4q74E6zIJEtWaHKaf5wv/H5QzzpXusqGemxURZJ"


def test_the_example_of_rfc_2617() -> None:
    challenge = challenge_of([
        'Digest realm="testrealm@host.com", qop="auth,auth-int", '
        'nonce="dcd98b7102dd2f0e8b11d0f600bfb0c093", opaque="5ccc069c403ebaf9f0171e9517f40e41"'
    ])  # fmt: skip
    assert challenge is not None
    who = Credentials("Mufasa", "Circle Of Life")
    text = answer(challenge, who, "GET", "/dir/index.html", "0a4f113b")
    assert 'response="6629fae49393a05397450978507c4ef1"' in text
    assert "qop=auth, nc=00000001" in text
    assert 'opaque="5ccc069c403ebaf9f0171e9517f40e41"' in text
    assert "Circle" not in text + repr(who)


@pytest.mark.parametrize(("algorithm", "response"), [
    ("MD5", "8ca523f5e9506fed4657c9700eebdbec"),
    ("SHA-256", "753927fa0e85d155564e2e272a28d1802ca10daf4496794697cf8db5856cb6c1"),
])  # fmt: skip
def test_the_examples_of_rfc_7616(algorithm: str, response: str) -> None:
    challenge = Challenge(
        True, "http-auth@example.org", "7ypf/xlj9XXwfDPEoM4URrv/xwf94BcCAzFZH4GiTo0v",
        "FQhe/qaU925kfnzjCev0ciny7QMkPqMAFRtzCUYo5tdS", algorithm, "auth, auth-int",
    )  # fmt: skip
    who = Credentials("Mufasa", "Circle of Life")
    text = answer(challenge, who, "GET", "/dir/index.html", CNONCE)
    assert f'response="{response}"' in text
    assert f"algorithm={algorithm}" in text


@pytest.mark.parametrize(("algorithm", "hashed"), [
    ("MD5-sess", hashlib.md5), ("SHA-256-sess", hashlib.sha256),
])  # fmt: skip
def test_a_session_s_digest_goes_before_the_password_in_clear(
    algorithm: str, hashed: Callable[[bytes], Any]
) -> None:
    """RFC 7616, 3.4.2: the nonces belong to the first of the hashed texts."""

    def h(text: str) -> str:
        return str(hashed(text.encode()).hexdigest())

    challenge = challenge_of([
        'Basic realm="r"', f'Digest realm="r", nonce="n", algorithm={algorithm}, qop="auth"'
    ])  # fmt: skip
    assert challenge is not None
    text = answer(challenge, Credentials("name", "secret"), "GET", "/a", "c")
    expected = h(f"{h(h('name:r:secret') + ':n:c')}:n:00000001:c:auth:{h('GET:/a')}")
    assert text.startswith("Digest ")
    assert f'response="{expected}"' in text
    assert f"algorithm={algorithm}" in text


def test_the_strongest_that_is_known_is_taken() -> None:
    both = 'Basic realm="a", Digest realm="b", nonce="n", algorithm=MD5'
    better = 'Digest realm="c", nonce="n", algorithm=SHA-256, qop="auth"'
    first, second = challenge_of([both]), challenge_of([both, better])
    assert first is not None
    assert (first.digest, first.realm) == (True, "b")
    assert second is not None
    assert second.realm == "c"
    for unknown in ("Negotiate", 'Digest nonce="n", algorithm=SHA-512-256',
                    'Digest nonce="n", qop="auth-int"', "", "\xff="):  # fmt: skip
        assert challenge_of([unknown]) is None


def test_the_old_digest_has_no_counter() -> None:
    challenge = challenge_of(['Digest realm="r", nonce="n"'])
    assert challenge is not None
    text = answer(challenge, Credentials('a"b', "c"), "GET", "/")
    assert "nc=" not in text
    assert 'username="a\\"b"' in text
