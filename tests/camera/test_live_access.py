"""Motion-JPEG behind certificates, redirects, names and passwords."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from perchctl.camera import open_camera
from perchctl.camera.network import MjpegSource, redirected
from perchctl.camera.source import LiveSource
from perchctl.errors import NotFound
from tests.camera.test_live import Server, jpeg, part, stream
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


def test_it_follows_a_redirect(server: Server, opened: list[LiveSource]) -> None:
    server.redirect_first = "/elsewhere.mjpg?x=1"
    server.scripts.put([])
    server.scripts.put([part(jpeg(60)), threading.Event()])
    assert level(next_frame(stream(server, Clock(), opened))) == 60
    assert server.paths == ["/stream.mjpg", "/elsewhere.mjpg?x=1"]


def test_user_and_password_of_the_url_are_sent(server: Server, opened: list[LiveSource]) -> None:
    server.scripts.put([part(jpeg(60)), threading.Event()])
    url = server.url.replace("http://", "http://me:p%40ss@")
    server.challenges = ['Basic realm="camera"']
    source = begun(MjpegSource(url, 0.0, Clock()), opened)
    next_frame(source)
    assert server.authorization == [None, "Basic bWU6cEBzcw=="], "once it is asked for"
    assert "p%40ss" not in source.describe()


DIGEST = ['Basic realm="camera"', 'Digest realm="camera", nonce="n1", qop="auth,auth-int"']


def test_digest_is_preferred_and_kept_for_the_next_connection(
    server: Server, opened: list[LiveSource]
) -> None:
    server.challenges = DIGEST
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(100)), threading.Event()])
    url = server.url.replace("http://", "http://me:secret@")
    begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.0)
    until(lambda: len(server.authorization) == 3)
    assert server.authorization[0] is None
    kept = [str(each) for each in server.authorization[1:]]
    assert all(each.startswith('Digest username="me", realm="camera"') for each in kept)
    assert [each[-len("nc=00000001") :] for each in kept] == ["nc=00000001", "nc=00000002"]
    assert all("secret" not in each for each in kept)


def test_a_nonce_that_is_too_old_is_changed(server: Server, opened: list[LiveSource]) -> None:
    server.challenges = DIGEST
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(100)), threading.Event()])
    url = server.url.replace("http://", "http://me:secret@")
    source = begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.05)
    until(lambda: len(server.authorization) == 2)
    server.challenges = ['Digest realm="camera", nonce="n2", stale=true, qop="auth"']
    server.nonce = "n2"
    until(lambda: source._count == 2)
    assert 'nonce="n2"' in str(server.authorization[-1])


def test_a_camera_that_forbids_the_nameless_without_asking_gets_the_name(
    server: Server, opened: list[LiveSource]
) -> None:
    server.refusal = 403
    server.scripts.put([part(jpeg(60)), threading.Event()])
    url = server.url.replace("http://", "http://me:p%40ss@")
    source = begun(MjpegSource(url, 0.0, Clock()), opened)
    assert level(next_frame(source)) == 60
    assert server.authorization == [None, "Basic bWU6cEBzcw=="]


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


WHO = "me:secret@"


@pytest.mark.parametrize(
    ("before", "location", "kept"),
    [
        ("http://me:secret@cam/a", "/b", True),
        ("http://me:secret@cam/a", "http://cam/b", True),
        ("http://me:secret@cam/a", "https://cam/b", True),
        ("https://me:secret@cam/a", "/b", True),
        ("https://me:secret@cam/a", "//cam/b", True),
        ("https://me:secret@cam/a", "http://cam/b", False),
        ("https://me:secret@cam:8443/a", "http://cam:8443/b", False),
        ("https://me:secret@cam/a", "ftp://cam/b", False),
        ("http://me:secret@cam/a", "rtsp://cam/b", False),
        ("http://me:secret@cam/a", "http://other/b", False),
        ("http://me:secret@cam/a", "http://cam:81/b", False),
        ("https://me:secret@cam/a", "https://cam.other/b", False),
    ],
)
def test_name_and_password_go_to_the_same_host_and_never_unencrypted_behind_https(
    before: str, location: str, kept: bool
) -> None:
    assert (WHO in redirected(before, location)) == kept


def test_a_redirect_from_https_to_http_is_not_followed(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    pem = Path(__file__).parents[1] / "helpers" / "loopback.pem"
    server.encrypt(pem)
    monkeypatch.setenv("SSL_CERT_FILE", str(pem))
    plain = Server()
    try:
        plain.challenges = ['Basic realm="camera"']
        server.redirect_first = plain.url
        url = server.url.replace("http://", f"https://{WHO}")
        with pytest.raises(NotFound, match=r"https.*encrypted") as caught:
            open_camera(url, Clock(), timeout_s=WAIT_S)
        assert plain.paths == [], "nobody can answer there in the camera's place"
        assert plain.url in str(caught.value)
        assert "secret" not in str(caught.value)
    finally:
        plain.close()


def test_a_redirect_to_another_protocol_is_not_followed(server: Server) -> None:
    server.redirect_first = "rtsp://127.0.0.1/live"
    with pytest.raises(NotFound, match=r"rtsp://127\.0\.0\.1/live"):
        open_camera(server.url, Clock(), timeout_s=WAIT_S)


def test_name_and_password_do_not_go_to_another_host(
    server: Server, opened: list[LiveSource]
) -> None:
    other = Server()
    try:
        other.challenges = ['Basic realm="camera"']
        server.redirect_first = other.url
        url = server.url.replace("http://", "http://me:secret@")
        source = begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.0)
        until(lambda: source.problem(100.0) is not None)
        assert other.authorization == [None]
        assert "401" in str(source.problem(100.0))
    finally:
        other.close()
