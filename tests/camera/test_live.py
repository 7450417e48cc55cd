"""Motion-JPEG from a local server, and what all streams share."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.camera import network, open_camera
from perchctl.camera.jpeg import decode_grey
from perchctl.camera.network import MjpegSource
from perchctl.camera.source import SILENT_AFTER_S, LiveSource
from perchctl.errors import NotFound, TimedOut
from perchctl.profile import CameraConfig
from tests.helpers.live import WAIT_S, Clock, begun, jpeg, level, next_frame, part, resized
from tests.helpers.mjpeg import MjpegServer
from tests.helpers.orientation import turned_picture
from tests.helpers.waiting import until


@pytest.fixture
def server(opened: list[LiveSource]) -> Iterator[MjpegServer]:
    """It ends before the sources that read from it."""
    server = MjpegServer()
    yield server
    server.close()


NO_PIXELS = b"\xff\xd8\xff\xc0\x00\x11\x08\x00\x30\x00\x40\x01" + bytes(9) + b"\xff\xd9"
"""A JPEG of 64x48 px whose structure is whole."""


def stream(
    server: MjpegServer, clock: Clock, opened: list[LiveSource], **options: float
) -> MjpegSource:
    source = MjpegSource(server.url, 0.07, clock)
    return begun(source, opened, reconnect_wait_s=0.0, **options)


def test_the_newest_frame_is_stamped_at_arrival_less_the_latency_and_given_once(
    server: MjpegServer, opened: list[LiveSource]
) -> None:
    clock, go, picture = Clock(), threading.Event(), jpeg(60)
    newer = [part(jpeg(100)) + part(jpeg(160)), threading.Event()]
    server.scripts.put([part(picture), go, *newer])
    source = stream(server, clock, opened)
    first = next_frame(source)
    assert (first.index, level(first), first.t_arrival_s) == (0, 60, 100.0)
    assert first.t_s == pytest.approx(99.93)
    assert first.source_jpeg == picture
    as_sent = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(as_sent, first.image)
    assert source.size_px == (64, 48)
    assert source.poll(0.0) is None, "each frame once"
    assert source.problem(100.0 + SILENT_AFTER_S) is None
    clock.t_s = 102.5
    assert "no frame for 2.5 s" in str(source.problem(clock.t_s))
    go.set()
    second = next_frame(source)
    while level(second) != 160:
        second = next_frame(source)
    assert second.t_arrival_s == 102.5
    assert source.poll(0.0) is None
    assert source.problem(clock.t_s) is None


def test_a_stream_s_pictures_stay_on_the_sensor_s_grid(
    server: MjpegServer, opened: list[LiveSource]
) -> None:
    upright = np.full((48, 64), 90, np.uint8)
    server.scripts.put([part(turned_picture(upright, "JPEG", 6)), threading.Event()])
    source = stream(server, Clock(), opened)
    assert next_frame(source).image.shape == upright.shape
    assert source.size_px == (64, 48)


@pytest.mark.parametrize("bad", [
    jpeg(60)[:300], *(resized(jpeg(60), *px) for px in ((40_000, 40_000), (4097, 4096), (0, 64))),
])  # fmt: skip
def test_a_picture_that_is_cut_or_of_no_size_or_above_the_largest_is_not_decoded(
    bad: bytes, server: MjpegServer, opened: list[LiveSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does it cost the connection."""
    whole, tried = jpeg(160), list[bytes]()

    def decode(data: bytes) -> Any:
        tried.append(data)
        return decode_grey(data)

    monkeypatch.setattr(network, "decode_grey", decode)
    server.scripts.put([part(bad), part(whole), threading.Event()])
    source = stream(server, Clock(), opened)
    assert level(next_frame(source)) == 160
    assert (tried, source.connections) == ([whole], 1)


class Broken(LiveSource):
    """Its connection raises what nobody has foreseen."""

    def __init__(self, error: Exception, attempts: int) -> None:
        super().__init__("http://me:secret@camera/x", 0.0, Clock())
        self.errors = [error] * attempts
        begun(self, reconnect_wait_s=0.0)

    def _connection(self) -> str:
        if self.errors:
            raise self.errors.pop()
        self._put(np.full((48, 64), 60, np.uint8))
        self._stop.wait(WAIT_S)
        return "closed"


@pytest.mark.parametrize("error", [KeyError("x"), cv2.error("no"), MemoryError()])
def test_an_unforeseen_error_in_a_stream_is_followed_by_another_connection(
    error: Exception, opened: list[LiveSource]
) -> None:
    opened.append(source := Broken(error, 4))
    next_frame(source)
    assert source.problem(100.0) is None
    opened.append(source := Broken(error, 5))
    until(lambda: source.problem(100.0) is not None)
    words = f"in 5 attempts: {type(error).__name__}: {error}".removesuffix(": ")
    assert str(source.problem(100.0)).endswith(words)
    assert "secret" not in str(source.problem(100.0))


def test_it_reconnects_when_the_stream_ends_and_gives_up_after_five_in_vain(
    server: MjpegServer, opened: list[LiveSource]
) -> None:
    gate = threading.Event()
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(160)), gate])
    source = stream(server, Clock(), opened)
    until(lambda: source._slot.count == 2)
    frame = next_frame(source)
    assert (level(frame), frame.index, source.connections) == (160, 1, 2)
    assert source.problem(100.0) is None
    gate.set()
    until(lambda: source.problem(100.0) is not None)
    assert source.connections == 2 + source.max_failures
    assert (
        "delivered no picture in 5 attempts: connected, but the stream ended without a "
        "picture" in str(source.problem(100.0))
    )


HTML = b"<html>the camera's page</html>"


@pytest.mark.parametrize(("script", "words"), [
    ([threading.Event()], "connected, but it sends no data: close other programs"),
    ([HTML, threading.Event()], "the server sends no content type, but no complete JPEG: check"),
    pytest.param([part(jpeg(60)[:300]), threading.Event()],
                 "the server sends no content type, but no complete JPEG", marks=pytest.mark.long),
    pytest.param([part(resized(jpeg(60), 5000, 4000)), threading.Event()],
                 "pictures arrive but are dropped (1 so far): the picture size is 5000x4000 px",
                 marks=pytest.mark.long),
    ([part(NO_PIXELS), threading.Event()], "pictures arrive but are dropped (1 so far): the "
     "JPEG cannot be decoded"),
])  # fmt: skip
def test_a_stream_without_a_picture_says_what_came(
    script: list[bytes | threading.Event], words: str, server: MjpegServer
) -> None:
    for _ in range(20):
        server.scripts.put(script)
    with pytest.raises(TimedOut) as refused:
        open_camera(server.url, Clock(), timeout_s=0.4)
    assert f"no first frame within 0.4 s: {words}" in str(refused.value)
    assert "receiver" not in str(refused.value)


def test_nobody_listens(server: MjpegServer) -> None:
    server.close()
    with pytest.raises(TimedOut, match="connection refused: check that the address is right"):
        open_camera(server.url, Clock(), timeout_s=0.4)


def test_no_first_frame_in_time(server: MjpegServer) -> None:
    quiet = threading.Event()
    server.scripts.put([b"--frame\r\n", quiet])
    with pytest.raises(TimedOut, match=r"no first frame within 0\.05 s"):
        open_camera(server.url, Clock(), CameraConfig(start_timeout_s=0.05))
    quiet.set()


# -- redirects, names and passwords ----------------------------------------------------

DIGEST = 'Digest realm="camera", nonce="n1", qop="auth"'
BASIC = 'Basic realm="camera"'
UNKNOWN = DIGEST.replace("n1", "n2") + ", algorithm=SHA-256"


@pytest.mark.parametrize(("challenges", "answered"), [
    ([BASIC], "Basic bWU6cEBzcw=="),
    ([BASIC, DIGEST], 'Digest username="me", realm="camera"'),
    ([f"{UNKNOWN}, {DIGEST}", UNKNOWN], 'Digest username="me", realm="camera"'),
])  # fmt: skip
def test_name_and_password_are_sent_once_they_are_asked_for(
    challenges: list[str], answered: str, server: MjpegServer, opened: list[LiveSource]
) -> None:
    server.challenges = challenges
    server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(100)), threading.Event()])
    url = server.url.replace("http://", "http://me:p%40ss@")
    source = begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.0)
    until(lambda: source._slot.count == 2)
    assert [str(given)[: len(answered)] for given in server.authorization] == ["None", answered] * 2
    assert "p%40ss" not in source.describe()


def test_a_redirect_to_another_address_gets_no_password(
    server: MjpegServer, opened: list[LiveSource]
) -> None:
    with closing(MjpegServer()) as other:
        server.challenges, server.redirect = [BASIC], other.url
        other.challenges = [BASIC]
        with pytest.raises(NotFound, match="401"):
            open_camera(server.url.replace("//", "//me:secret@"), Clock(), timeout_s=WAIT_S)
        assert server.authorization[0] is None
        assert str(server.authorization[1]).startswith("Basic")
        assert set(other.authorization) == {None}


@pytest.mark.parametrize(("changes", "who", "words"), [
    ({"status": 404}, "", "404"),
    ({"status": 403}, "me:wrong@", "403"),
    ({"challenges": [DIGEST]}, "", "401 .*as in http://NAME:PASSWORD"),
    ({"challenges": [DIGEST]}, "me:wrong@", "401 .*as in http://NAME:PASSWORD"),
    ({"challenges": [BASIC, UNKNOWN]}, "me:wrong@", "401 .*as in http://NAME:PASSWORD"),
])  # fmt: skip
def test_what_trying_again_would_not_mend_is_said_at_once(
    changes: dict[str, Any], who: str, words: str, server: MjpegServer
) -> None:
    server.nonce = "none of mine"
    for name, value in changes.items():
        setattr(server, name, value)
    with pytest.raises(NotFound, match=words) as caught:
        open_camera(server.url.replace("http://", f"http://{who}"), Clock(), timeout_s=WAIT_S)
    assert "wrong" not in str(caught.value)
