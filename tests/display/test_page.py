"""The live page over HTTP: picture and numbers."""

from __future__ import annotations

import http.client
import json
import socket
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from perchctl.display import LivePage, Sketch
from perchctl.display.live import MAX_STREAMS
from perchctl.errors import InvalidValue
from tests.helpers.live_page import CORNERS, ask
from tests.helpers.recording import camera


def test_the_page_needs_nothing_from_elsewhere(page: LivePage) -> None:
    status, body, headers = ask(page.url)
    html = body.decode()
    assert status == 200
    assert "http://" not in html
    assert "https://" not in html
    assert "{{nonce}}" not in html
    assert 'name="viewport"' in html
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert page.token not in html  # it is in the address only
    assert page.opened.is_set()


def test_the_state_is_the_newest(page: LivePage) -> None:
    page.tell(lambda: {"rows": [["a", "1"]], "note": ""})
    page.tell(lambda: {"rows": [["a", "2"]], "note": "mirrored"})
    state = json.loads(ask(page.url, "/state")[1])
    assert state["rows"] == [["a", "2"]]
    assert state["note"] == "mirrored"
    assert state["title"] == "perchctl test"
    assert state["stop"] == "ready"
    assert state["rate_hz"] == 0.0


def test_the_frame_rate_counts_frames_and_falls_to_zero() -> None:
    times = iter([10.0, 10.1, 10.2, 10.3])
    now = [10.3]
    page = LivePage(camera(), "t", clock=lambda: next(times, now[0]))
    try:
        for index in range(4):
            page.show(index, Sketch(np.zeros((4, 4), np.uint8)))
            if index == 2:
                before = page._number
        page.show(3, Sketch(np.zeros((4, 4), np.uint8)))  # the same frame, drawn into
        assert page._number == before + 2
        assert page.rate_hz() == pytest.approx(10.0)
        now[0] = 12.0
        assert page.rate_hz() == 0.0
    finally:
        page.close()


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
    page.show(0, Sketch(grey, (("large", CORNERS),), pose, ("stage both",)))
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port or 0, timeout=5.0)
    try:
        connection.request("GET", "/stream")
        answer = connection.getresponse()
        assert answer.getheader("Content-Type", "").startswith("multipart/x-mixed-replace")
        drawn = read_part(answer).astype(int)
        assert drawn.shape == (480, 640, 3)
        assert np.abs(drawn[150, 250:350] - 90).max() > 50  # the outline's upper side
        assert np.abs(drawn[100, 250:350] - 90).max() < 10
        assert grey.min() == grey.max() == 90  # the loop's picture is left alone
        page.show(1, Sketch(np.full((480, 640), 200, np.uint8)))
        assert read_part(answer).mean() == pytest.approx(200.0, abs=2.0)
    finally:
        connection.close()


def test_too_many_readers_are_sent_away(page: LivePage) -> None:
    page.show(0, Sketch(np.zeros((48, 64), np.uint8)))
    port = urlsplit(page.url).port or 0
    readers = [
        http.client.HTTPConnection("127.0.0.1", port, timeout=5.0) for _ in range(MAX_STREAMS)
    ]
    try:
        for reader in readers:
            reader.request("GET", "/stream")
        answers = [reader.getresponse() for reader in readers]  # a dropped one would hang up
        assert {answer.status for answer in answers} == {200}
        assert ask(page.url, "/stream")[0] == 503
        assert ask(page.url, "/state")[0] == 200
    finally:
        for reader in readers:
            reader.close()


def test_what_fails_is_remembered_and_not_raised(page: LivePage) -> None:
    def broken() -> dict[str, Any]:
        raise RuntimeError("no words")

    page.tell(broken)
    assert json.loads(ask(page.url, "/state")[1])["page_problem"] == "RuntimeError: no words"
    page.show(0, Sketch(np.zeros((2, 2, 2), np.uint8)))  # cannot be drawn
    assert b"image/jpeg" not in ask(page.url, "/stream")[1]
    assert page.problem is not None
    assert ask(page.url)[0] == 200


def test_a_port_in_use_is_refused_in_one_sentence() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InvalidValue, match=f"port {port} .*--view-port"):
            LivePage(camera(), "t", port)


def test_closing_ends_a_waiting_stream() -> None:
    page = LivePage(camera(), "t")
    page.show(0, Sketch(np.zeros((48, 64), np.uint8)))
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port or 0, timeout=5.0)
    connection.request("GET", "/stream")
    answer = connection.getresponse()
    read_part(answer)
    page.close()
    while answer.read1(4096):
        pass
    connection.close()
