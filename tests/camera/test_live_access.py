"""Motion-JPEG behind certificates, redirects, names and passwords."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from perchctl.camera import open_camera
from perchctl.camera.network import MjpegSource
from perchctl.camera.source import LiveSource
from perchctl.errors import NotFound
from tests.camera.test_live import Server, jpeg, part, stream
from tests.helpers.live import WAIT_S, Clock, begun, level, next_frame
from tests.helpers.waiting import until

PEM = Path(__file__).parents[1] / "helpers" / "loopback.pem"  # for 127.0.0.1 and 100 years
BASIC = ['Basic realm="camera"']
DIGEST = [*BASIC, 'Digest realm="camera", nonce="n1", qop="auth,auth-int"']


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


@pytest.fixture
def other() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def with_name(server: Server, who: str = "me:secret@", scheme: str = "http") -> str:
    return server.url.replace("http://", f"{scheme}://{who}")


def refused(url: str, sentence: str) -> None:
    """Told at once, and without the password."""
    with pytest.raises(NotFound, match=sentence) as caught:
        open_camera(url, Clock(), timeout_s=WAIT_S)
    assert "secret" not in str(caught.value)


def test_a_certificate_that_nobody_vouches_for(
    server: Server, opened: list[LiveSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    server.encrypt(PEM)
    url = with_name(server, scheme="https")
    refused(url, r"is not trusted \(self.signed.*SSL_CERT_FILE")
    monkeypatch.setenv("SSL_CERT_FILE", str(PEM))
    server.scripts.put([part(jpeg(60)), threading.Event()])
    assert level(next_frame(begun(MjpegSource(url, 0.0, Clock()), opened))) == 60


@pytest.mark.parametrize("challenges", [BASIC, DIGEST])
def test_name_and_password_are_sent_as_they_are_asked_for(
    challenges: list[str], server: Server, opened: list[LiveSource]
) -> None:
    server.challenges = challenges
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = begun(MjpegSource(with_name(server, "me:p%40ss@"), 0.0, Clock()), opened)
    assert level(next_frame(source)) == 60
    first, second = server.authorization
    assert first is None, "not before they are asked for"
    assert second is not None
    if challenges is BASIC:
        assert second == "Basic bWU6cEBzcw=="
    else:
        assert second.startswith('Digest username="me", realm="camera"')
        assert "p@ss" not in second
    assert "p%40ss" not in source.describe()


def test_each_connection_answers_its_own_challenge(
    server: Server, opened: list[LiveSource]
) -> None:
    server.challenges = DIGEST
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(100)), threading.Event()])
    source = begun(MjpegSource(with_name(server), 0.0, Clock()), opened, reconnect_wait_s=0.05)
    until(lambda: len(server.authorization) == 2)
    server.challenges = ['Digest realm="camera", nonce="n2", stale=true, qop="auth"']
    server.nonce = "n2"
    until(lambda: source._count == 2)
    assert 'nonce="n2"' in str(server.authorization[-1])


@pytest.mark.parametrize(("challenges", "who", "sentence"), [
    (DIGEST, "", "it wants a name and a password, as in http://NAME:PASSWORD@HOST/PATH"),
    (DIGEST, "me:secret@", "check the name and the password in the URL"),
    (["Negotiate"], "me:secret@", "basic and digest"),
])  # fmt: skip
def test_who_may_not_see_it_is_told_at_once(
    server: Server, challenges: list[str], who: str, sentence: str
) -> None:
    server.challenges, server.nonce = challenges, "none of mine"
    refused(with_name(server, who), f"401.*{sentence}")
    assert len(server.authorization) <= 2, "cameras lock out who tries again and again"


def test_it_follows_a_redirect(server: Server, opened: list[LiveSource]) -> None:
    server.redirect_first = "/elsewhere.mjpg?x=1"
    server.scripts.put([])
    server.scripts.put([part(jpeg(60)), threading.Event()])
    assert level(next_frame(stream(server, Clock(), opened))) == 60
    assert server.paths == ["/stream.mjpg", "/elsewhere.mjpg?x=1"]


def test_a_redirect_from_https_to_http_is_not_followed(
    server: Server, other: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.encrypt(PEM)
    monkeypatch.setenv("SSL_CERT_FILE", str(PEM))
    server.redirect_first = other.url
    refused(with_name(server, scheme="https"), f"https.*{other.url}.*encrypted")
    assert other.paths == [], "nobody can answer there in the camera's place"


def test_a_redirect_to_another_protocol_is_not_followed(server: Server) -> None:
    server.redirect_first = "rtsp://127.0.0.1/live"
    refused(server.url, r"rtsp://127\.0\.0\.1/live")


def test_name_and_password_do_not_go_to_another_host(server: Server, other: Server) -> None:
    other.challenges = BASIC
    server.redirect_first = other.url
    refused(with_name(server), "401")
    assert other.authorization == [None]
