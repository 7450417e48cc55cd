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
from tests.camera.test_live import Server, jpeg, part
from tests.helpers.live import WAIT_S, Clock, begun, level, next_frame
from tests.helpers.waiting import until


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def test_a_certificate_that_nobody_vouches_for(
    server: Server, opened: list[LiveSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    pem = Path(__file__).parents[1] / "helpers" / "loopback.pem"  # for 127.0.0.1 and 100 years
    server.encrypt(pem)
    url = server.url.replace("http://", "https://me:secret@")
    with pytest.raises(NotFound, match=r"is not trusted \(self.signed.*SSL_CERT_FILE") as caught:
        open_camera(url, Clock(), timeout_s=WAIT_S)
    assert "secret" not in str(caught.value)
    monkeypatch.setenv("SSL_CERT_FILE", str(pem))
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = begun(MjpegSource(url, 0.0, Clock()), opened)
    assert level(next_frame(source)) == 60


DIGEST = ['Basic realm="camera"', 'Digest realm="camera", nonce="n1", qop="auth,auth-int"']


@pytest.mark.parametrize(("refusal", "challenges", "answered"), [
    (401, ['Basic realm="camera"'], "Basic bWU6cEBzcw=="),
    (403, [], "Basic bWU6cEBzcw=="),
    (401, DIGEST, 'Digest username="me", realm="camera"'),
])  # fmt: skip
def test_name_and_password_are_sent_once_they_are_asked_for_digest_first(
    refusal: int, challenges: list[str], answered: str, server: Server, opened: list[LiveSource]
) -> None:
    server.refusal, server.challenges = refusal, challenges
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(100)), threading.Event()])
    url = server.url.replace("http://", "http://me:p%40ss@")
    source = begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.0)
    until(lambda: source._count == 2)
    assert [str(given)[: len(answered)] for given in server.authorization] == ["None", answered] * 2
    assert "p%40ss" not in source.describe()


@pytest.mark.parametrize("who", ["", "me:wrong@"])
def test_one_that_forbids_it_for_good_is_told_at_once(server: Server, who: str) -> None:
    server.status = 403
    with pytest.raises(NotFound, match="403"):
        open_camera(server.url.replace("http://", f"http://{who}"), Clock(), timeout_s=WAIT_S)
    assert len(server.authorization) == (2 if who else 1)


@pytest.mark.parametrize(("challenges", "who", "sentence"), [
    (DIGEST, "", "it wants a name and a password, as in http://NAME:PASSWORD@HOST/PATH"),
    (DIGEST, "me:wrong@", "check the name and the password in the URL"),
    (["Negotiate"], "me:secret@", "asks for no basic or digest authentication"),
])  # fmt: skip
def test_who_may_not_see_it_is_told_at_once(
    server: Server, challenges: list[str], who: str, sentence: str
) -> None:
    server.challenges, server.nonce = challenges, "none of mine"
    url = server.url.replace("http://", f"http://{who}")
    with pytest.raises(NotFound, match=f"401.*{sentence}") as caught:
        open_camera(url, Clock(), timeout_s=WAIT_S)
    assert "wrong" not in str(caught.value)
    assert len(server.authorization) <= 3


@pytest.mark.parametrize("location", [
    "/elsewhere.mjpg", "http://me:secret@127.0.0.1:1/x", "rtsp://127.0.0.1/live",
])  # fmt: skip
def test_a_redirect_is_named_and_not_followed(location: str, server: Server) -> None:
    """Nobody else can ask for the name and password in the camera's place."""
    server.redirect_first = location
    url = server.url.replace("http://", "http://me:secret@")
    with pytest.raises(NotFound, match=r"redirects to .*name that address") as said:
        open_camera(url, Clock(), timeout_s=WAIT_S)
    assert len(server.paths) == 1
    assert location.rpartition("/")[2] in str(said.value)
    assert "secret" not in str(said.value)
