"""The live page over HTTP: picture, numbers, and what STOP accepts."""

from __future__ import annotations

import http.client
import io
import json
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest

from perchctl.commands.fly import live_page
from perchctl.commands.track import TrackRequest, resolve, track
from perchctl.display.page.flight import FlightPage
from perchctl.display.page.live import LivePage
from perchctl.display.page.server import MAX_STREAMS, TOKEN_HEADER, is_loopback
from perchctl.display.page.sketch import Sketch
from perchctl.errors import InvalidValue
from perchctl.flight.operator import AGAIN_S, HELD_S, OperatorSwitch
from perchctl.flight.session import FlyOptions
from perchctl.mission.state import Operator, Phase, PlannerState
from perchctl.mission.watch import Tick
from perchctl.profile import load_profile
from perchctl.vehicle import Idle
from perchctl.vision.types import Detection, Detections, Frame, MarkerPose, PipelineOutput, Stage
from tests.helpers.log import telemetry
from tests.helpers.mission import note
from tests.helpers.recording import CALIBRATION, VIEWS, camera, picture, write_pictures

CORNERS = np.array([[200.0, 150.0], [400.0, 150.0], [400.0, 350.0], [200.0, 350.0]])


class Stops:
    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> None:
        self.count += 1


@pytest.fixture
def stops() -> Stops:
    return Stops()


@pytest.fixture
def page(stops: Stops) -> Iterator[LivePage]:
    served = LivePage(camera(), "perchctl test", on_stop=stops)
    yield served
    served.close()


def ask(
    url: str, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers; `_` in a header's name stands for `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(url).port or 0, timeout=5.0)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, headers=named)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def token_of(url: str) -> str:
    return parse_qs(urlsplit(url).query)["token"][0]


def stop(url: str, token: str, **headers: str) -> int:
    return ask(url, "/stop", "POST", **{TOKEN_HEADER: token}, **headers)[0]


# --- What it shows -------------------------------------------------------------------------


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


def test_the_picture_without_distortion_comes_once_the_lens_is_known(page: LivePage) -> None:
    image = np.zeros((48, 64), np.uint8)
    image[:, 40:] = 200
    page.show(0, Sketch(image))
    assert json.loads(ask(page.url, "/state")[1])["flat"] is False
    assert page.jpeg_after(0, flat=True) is None
    columns, rows = np.meshgrid(np.arange(64.0), np.arange(48.0))
    places = np.stack([columns + 20, rows], axis=2).astype(np.float32)  # 20 px to the left
    page.show(1, Sketch(image, flat_places_px=places))
    assert json.loads(ask(page.url, "/state")[1])["flat"] is True
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port or 0, timeout=5.0)
    try:
        connection.request("GET", "/flat")
        flat = read_part(connection.getresponse())
    finally:
        connection.close()
    assert flat[:, 24:40].mean() == pytest.approx(200.0, abs=5.0)
    assert flat[:, :16].mean() < 5.0
    drawn = page.jpeg_after(0)
    assert drawn is not None
    plain = cv2.imdecode(np.frombuffer(drawn[1], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert plain is not None
    assert plain[:, :36].mean() < 5.0


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


# --- Who may do what -----------------------------------------------------------------------


def test_stop_needs_the_token(page: LivePage, stops: Stops) -> None:
    assert stop(page.url, "") == 403
    assert stop(page.url, "wrong") == 403
    assert stop(page.url, "w\xf6rng") == 403
    assert ask(page.url, f"/stop?token={page.token}", "POST")[0] == 403  # a form can send that
    assert ask(page.url, "/stop", "GET", **{TOKEN_HEADER: page.token})[0] == 404
    assert stops.count == 0
    assert stop(page.url, token_of(page.url)) == 200
    assert stops.count == 1
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "requested"


def test_stop_again_changes_nothing(page: LivePage, stops: Stops) -> None:
    assert [stop(page.url, page.token) for _ in range(3)] == [200, 200, 200]
    assert stops.count == 1


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
@pytest.mark.parametrize("path", ["/", "/state", "/stream"])
def test_a_foreign_host_is_refused(page: LivePage, host: str, path: str) -> None:
    status, body, _ = ask(page.url, path, Host=host)
    assert status == 403
    assert page.token.encode() not in body


def test_stop_refuses_a_foreign_host_and_origin(page: LivePage, stops: Stops) -> None:
    assert stop(page.url, page.token, Host="evil.example") == 403
    assert stop(page.url, page.token, Origin="http://evil.example") == 403
    assert stop(page.url, page.token, Origin="null") == 403
    assert stops.count == 0
    assert stop(page.url, page.token, Origin="http://localhost:9", Host="localhost:9") == 200


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1:80", True),
        ("localhost", True),
        ("LOCALHOST:8080", True),
        ("[::1]:80", True),
        ("user@127.0.0.1", True),
        ("127.0.0.1@evil.example", False),
        ("127.0.0.2", False),
        ("[", False),
        (None, False),
    ],
)
def test_the_names_of_this_machine(host: str | None, local: bool) -> None:
    assert is_loopback(host) is local


def test_it_listens_on_loopback_only(page: LivePage) -> None:
    assert page._server.server_address[0] == "127.0.0.1"


def test_without_stop_there_is_none() -> None:
    page = LivePage(camera(), "t")
    try:
        assert json.loads(ask(page.url, "/state")[1])["stop"] == "none"
        assert stop(page.url, page.token) == 403
    finally:
        page.close()


# --- fly --view ------------------------------------------------------------------------------


def tick(t_s: float, output: PipelineOutput | None = None) -> Tick:
    state = PlannerState(phase=Phase.ALIGN, entered_s=1.0, reason="pose is steady")
    return Tick(t_s, telemetry(t_s, 0.6), output, None, state, Idle(), 0.0, 0.01, 0.012)


def seen_in(frame: Frame) -> PipelineOutput:
    large = Detection("large", CORNERS, 0.1, True)
    pose = MarkerPose(
        "large", frame.t_s, np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 0.3]),
        np.zeros(3), 0.0, np.ones(3), 1.0, 0.1,
    )  # fmt: skip
    detections = Detections(frame.index, frame.t_s, large=large)
    return PipelineOutput(detections, {"large": pose}, None, Stage.LARGE)


class OneFrame:
    live = True
    finished = False
    size_px = (640, 480)

    def __init__(self, frame: Frame) -> None:
        self.frame: Frame | None = frame

    def poll(self, now_s: float) -> Frame | None:
        frame, self.frame = self.frame, None
        return frame

    def problem(self, now_s: float) -> str | None:
        return "silent"

    def describe(self) -> str:
        return "one frame"

    def close(self) -> None:
        self.frame = None


OPTIONS = FlyOptions(load_profile("sim"), Path("sim.yaml"), "sim://", "sim:")


def test_stop_is_one_ctrl_c_and_never_two(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = [100.0]
    switch = OperatorSwitch(listening=True, clock=lambda: now_s[0])
    with live_page(OPTIONS, 0, switch) as flight:
        assert flight is not None
        assert flight.page.url in capsys.readouterr().err
        assert switch.read() is Operator.NONE
        assert stop(flight.page.url, "guess") == 403
        assert switch.read() is Operator.NONE
        for _ in range(2):
            assert stop(flight.page.url, flight.page.token) == 200
            assert switch.read() is Operator.LAND
        switch.press()
        assert switch.read() is Operator.LAND  # the first Ctrl-C repeats STOP
        now_s[0] += AGAIN_S
        switch.press()
        now_s[0] += HELD_S
        assert switch.read() is Operator.STOP


def test_without_view_no_page_is_opened(capsys: pytest.CaptureFixture[str]) -> None:
    with live_page(OPTIONS, None, OperatorSwitch()) as flight:
        assert flight is None
    assert capsys.readouterr().err == ""


def test_a_flight_is_shown_with_phase_battery_and_picture(page: LivePage) -> None:
    flight = FlightPage(page, 0.15)
    frame = Frame(7, 1.0, np.full((480, 640), 90, np.uint8))
    source = flight.watched(OneFrame(frame))
    assert json.loads(ask(page.url, "/state")[1])["phase"] == "WAITING"
    assert source.poll(1.0) is frame
    assert source.poll(1.1) is None
    assert source.problem(1.1) == "silent"
    assert page.jpeg_after(0) is not None  # before the first tick too
    flight.tick(tick(2.5, seen_in(frame)))
    state = json.loads(ask(page.url, "/state")[1])
    assert state["phase"] == "ALIGN"
    assert state["battery"] == "3.88 V"
    assert ["phase", "ALIGN  1.5 s"] in state["rows"]
    newest = page.jpeg_after(1)
    assert newest is not None
    decoded = cv2.imdecode(np.frombuffer(newest[1], np.uint8), cv2.IMREAD_COLOR)
    drawn = np.asarray(decoded).astype(int)
    assert np.abs(drawn[150, 250:350] - 90).max() > 50
    assert flight.problem is None


@pytest.mark.parametrize("phase", [Phase.PERCHED, Phase.LANDED, Phase.ABORTED])
def test_a_flight_that_is_over_asks_for_no_landing(page: LivePage, phase: Phase) -> None:
    flight = FlightPage(page, 0.15)
    assert stop(page.url, page.token) == 200
    flight.tick(tick(2.0))
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "requested"
    last = tick(3.0)
    flight.tick(replace(last, state=replace(last.state, phase=phase)))
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "over"


def test_the_page_has_a_word_for_each_state_of_stop(page: LivePage) -> None:
    html = ask(page.url)[1].decode()
    table = html.partition("const STOP = {")[2].partition("};")[0]
    names = re.findall(r"^  (\w+): \[", table, re.MULTILINE)
    assert names == ["ready", "requested", "over", "gone"]


def test_a_page_that_fails_is_no_reason_to_land(page: LivePage) -> None:
    flight = FlightPage(page, 0.15)
    flight.watched(OneFrame(Frame(0, 0.0, np.zeros((480, 640), np.uint8)))).poll(0.0)
    flight.tick(None)  # type: ignore[arg-type]
    flight.event(note(0.0, "something"))
    assert flight.problem is None
    flight.tick(tick(1.0, "no output"))  # type: ignore[arg-type]
    json.loads(ask(page.url, "/state")[1])
    assert page.problem is not None


# --- track --view ----------------------------------------------------------------------------


class Looking(io.StringIO):
    """Reads the page from inside the loop, once the second line has been written."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        super().__init__()
        self.capsys = capsys
        self.printed = ""
        self.state: dict[str, Any] = {}
        self.lines = 0

    def write(self, text: str) -> int:
        self.lines += text.count("\n")
        if self.lines == 3 and not self.state:
            self.printed = self.capsys.readouterr().err
            url = self.printed.split("live page: ")[1].split()[0]
            self.state = json.loads(ask(url, "/state")[1])
        return super().write(text)


@pytest.mark.long
def test_track_serves_its_numbers_while_it_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = write_pictures(tmp_path / "pictures")
    out = Looking(capsys)
    request = TrackRequest(
        str(pictures), calibration=CALIBRATION, stills=True, view=True, as_json=True
    )
    track(resolve(request), out)
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert len(lines) == len(VIEWS)
    assert out.state["track"] == lines[1]  # the newest when the third line was written
    assert out.state["stop"] == "none"
    assert dict(out.state["rows"])["markers"] == lines[1]["stage"]
    assert "the live page failed" not in capsys.readouterr().err
    assert not [t for t in threading.enumerate() if t.name == "view"]


def test_an_axis_behind_the_camera_is_left_out() -> None:
    from perchctl.display.page.sketch import draw

    image = picture(VIEWS["away"])
    pose = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.2]), 0.075)
    wild = (("large", np.full((4, 2), 1e9)), ("small", np.full((4, 2), np.nan)))
    drawn = draw(Sketch(image, wild, pose), camera())
    assert (drawn == image[..., None]).all()
