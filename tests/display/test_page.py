"""The live page over HTTP: picture and numbers, who may ask, and what its buttons accept."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from perchctl.display import LivePage, Sketch
from perchctl.display.live import draw_sketch
from perchctl.display.serve import TOKEN_HEADER
from tests.helpers.live_page import CORNERS, ask, press
from tests.helpers.recording import camera

BUTTONS = ("land", "cut")


def test_the_page_needs_nothing_from_elsewhere(page: LivePage) -> None:
    status, body, headers = ask(page.url)
    html = body.decode()
    assert (status, page._server.server_address[0]) == (200, "127.0.0.1")
    for foreign in ("http://", "https://", "{{nonce}}", page.token):  # which is in the address only
        assert foreign not in html
    assert "default-src 'none'" in headers["Content-Security-Policy"]


@contextmanager
def streaming(page: LivePage) -> Iterator[http.client.HTTPResponse]:
    """The page's multipart answer."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port or 0, timeout=5.0)
    try:
        connection.request("GET", "/stream")
        yield connection.getresponse()
    finally:
        connection.close()


def read_part(stream: http.client.HTTPResponse) -> np.ndarray[Any, Any]:
    """The next picture of a multipart answer."""
    while not (line := stream.readline()).startswith(b"Content-Length"):
        assert line, "the stream ended"
    length = int(line.partition(b":")[2])
    assert stream.readline() == b"\r\n"
    return np.asarray(cv2.imdecode(np.frombuffer(stream.read(length), np.uint8), cv2.IMREAD_COLOR))


def test_the_stream_gives_the_drawn_picture(page: LivePage) -> None:
    grey = np.full((480, 640), 90, np.uint8)
    pose = (np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 0.5]), 0.075)
    page.show(Sketch(grey, (("large", CORNERS),), pose))
    with streaming(page) as answer:
        assert answer.getheader("Content-Type", "").startswith("multipart/x-mixed-replace")
        drawn = read_part(answer).astype(int)
        assert drawn.shape == (480, 640, 3)
        assert np.abs(drawn[150, 250:350] - 90).max() > 50  # the outline's upper side
        assert np.abs(drawn[100, 250:350] - 90).max() < 10
        assert grey.min() == grey.max() == 90  # the loop's picture is left alone
        page.show(Sketch(np.full((480, 640), 200, np.uint8)))
        assert read_part(answer).mean() == pytest.approx(200.0, abs=2.0)
        page.close()  # ends a stream that waits
        while answer.read1(4096):
            pass


def test_an_axis_behind_the_camera_and_a_wild_corner_are_left_out() -> None:
    image = np.full((480, 640), 110, np.uint8)
    pose = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.2]), 0.075)
    wild = (("large", np.full((4, 2), 1e9)), ("small", np.full((4, 2), np.nan)))
    assert (draw_sketch(Sketch(image, wild, pose), camera()) == 110).all()


def test_a_page_without_a_flight_has_no_buttons() -> None:
    page = LivePage(camera(), "t")
    try:
        assert json.loads(ask(page.url, "/state")[1])["orders"] == "none"
        assert [press(page.url, page.token, name) for name in BUTTONS] == [403, 403]
    finally:
        page.close()


def test_what_fails_is_remembered_and_not_raised(page: LivePage) -> None:
    def broken() -> dict[str, Any]:
        raise RuntimeError("no words")

    page.set_state(broken)
    assert json.loads(ask(page.url, "/state")[1])["page_problem"] == "RuntimeError: no words"
    page.show(Sketch(np.zeros((2, 2, 2), np.uint8)))  # cannot be drawn
    assert b"image/jpeg" not in ask(page.url, "/stream")[1]
    assert page.problem is not None
    assert ask(page.url)[0] == 200


# --- who may do what --------------------------------------------------------------------


def test_a_button_needs_the_token(page: LivePage, ordered: list[str]) -> None:
    for button in BUTTONS:
        for token in ("", "wrong", "w\xf6rng"):
            assert press(page.url, token, button) == 403
        # A form can send that.
        assert ask(page.url, f"/{button}?token={page.token}", "POST")[0] == 403
        assert ask(page.url, f"/{button}", "GET", **{TOKEN_HEADER: page.token})[0] == 404
    assert press(page.url, page.token, "stop") == 404
    assert ordered == []
    for button in BUTTONS:
        assert press(page.url, page.url.partition("token=")[2], button) == 200
        assert ordered.pop() == button
        assert json.loads(ask(page.url, "/state")[1])["orders"] == button
    assert press(page.url, page.token) == 200  # after the cut landing changes nothing
    assert json.loads(ask(page.url, "/state")[1])["orders"] == "cut"


def test_an_order_that_fails_is_not_shown_as_given() -> None:
    page = LivePage(camera(), "t", lambda: None, lambda: 1 / 0)  # type: ignore[arg-type]
    try:
        with pytest.raises(http.client.RemoteDisconnected):
            press(page.url, page.token, "cut")
        assert json.loads(ask(page.url, "/state")[1])["orders"] == "ready"
        assert page.problem == "ZeroDivisionError: division by zero"
    finally:
        page.close()


@pytest.mark.parametrize(
    "host", ["127.0.0.1.evil.example", "127.0.0.1@evil.example", "127.0.0.2", "[", ""]
)
def test_a_foreign_host_is_refused(page: LivePage, host: str) -> None:
    for path in ("/", "/state", "/stream"):
        status, body, _ = ask(page.url, path, Host=host)
        assert status == 403
        assert page.token.encode() not in body


@pytest.mark.parametrize("button", BUTTONS)
def test_a_button_refuses_a_foreign_host_and_origin(
    page: LivePage, ordered: list[str], button: str
) -> None:
    url, token = page.url, page.token
    assert press(url, token, button, Host="evil.example") == 403
    assert press(url, token, button, Origin="http://evil.example") == 403
    assert press(url, token, button, Origin="null") == 403
    assert ordered == []
    assert press(url, token, button, Origin="http://localhost:9", Host="localhost:9") == 200
