"""Live sources: the device behind a stand-in, Motion-JPEG from a local server."""

from __future__ import annotations

import queue
import ssl
import struct
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from perchctl.camera import network, open_camera
from perchctl.camera.device import (
    LOST_AFTER_FAILURES,
    Asked,
    DeviceSource,
    open_capture,
)
from perchctl.camera.network import MAX_FAILED_CONNECTIONS, MjpegSource, StreamSource
from perchctl.camera.source import SILENT_AFTER_S, LiveSource
from perchctl.errors import NotFound, TimedOut
from perchctl.profile import CameraConfig
from tests.helpers.live import WAIT_S, Clock, begun, level, next_frame
from tests.helpers.waiting import until


def jpeg(level: int, size: tuple[int, int] = (48, 64), **options: int) -> bytes:
    rng = np.random.default_rng(level)
    image = np.clip(rng.normal(level, 4.0, size), 0, 255).astype(np.uint8)
    flags = [x for pair in options.items() for x in (getattr(cv2, pair[0]), pair[1])]
    return bytes(cv2.imencode(".jpg", image, flags)[1].tobytes())


def resized(picture: bytes, width: int, height: int) -> bytes:
    """The JPEG with another size in its header."""
    at = max(picture.find(b"\xff\xc0"), picture.find(b"\xff\xc2"))
    return picture[: at + 5] + struct.pack(">HH", height, width) + picture[at + 9 :]


def part(picture: bytes, headers: bytes = b"Content-Type: image/jpeg\r\n") -> bytes:
    return b"--frame\r\n" + headers + b"\r\n" + picture + b"\r\n"


# -- a server whose every byte the test chooses --------------------------------

Script = list[bytes | threading.Event]


class Server:
    """Serves one script a connection: bytes to send, events to wait for, then the end."""

    def __init__(self) -> None:
        self.scripts: queue.Queue[Script] = queue.Queue()
        self.status = 200
        self.redirect_first = ""
        self.paths: list[str] = []
        self.authorization: list[str | None] = []
        self.challenges: list[str] = []
        self.refusal = 401
        self.nonce = "n1"
        outer = self

        class Handler(BaseHTTPRequestHandler):
            extra: ClassVar[dict[str, str]] = {
                "Content-Type": "multipart/x-mixed-replace; boundary=frame"
            }

            def do_GET(self) -> None:
                outer.paths.append(self.path)
                given = self.headers["Authorization"]
                outer.authorization.append(given)
                if (outer.challenges or outer.refusal == 403) and not (
                    given and (given.startswith("Basic") or f'nonce="{outer.nonce}"' in given)
                ):
                    self.send_response(outer.refusal)
                    for challenge in outer.challenges:
                        self.send_header("WWW-Authenticate", challenge)
                    self.end_headers()
                    return
                try:
                    script = outer.scripts.get_nowait()
                except queue.Empty:
                    script = []
                if outer.redirect_first and len(outer.paths) == 1:
                    self.send_response(302)
                    self.send_header("Location", outer.redirect_first)
                else:
                    self.send_response(outer.status)
                for name, value in self.extra.items():
                    self.send_header(name, value)
                self.end_headers()
                for step in script:
                    if isinstance(step, threading.Event):
                        step.wait(WAIT_S)
                    else:
                        try:
                            self.wfile.write(step)
                        except OSError:
                            return

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/stream.mjpg"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        )
        self._thread.start()

    def encrypt(self, pem: Path) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(pem)
        self._server.socket = context.wrap_socket(self._server.socket, server_side=True)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(WAIT_S)


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def stream(server: Server, clock: Clock, opened: list[LiveSource], **options: float) -> MjpegSource:
    source = MjpegSource(server.url, 0.07, clock)
    return begun(source, opened, reconnect_wait_s=0.0, **options)


def test_frames_are_stamped_at_arrival_less_the_latency(
    server: Server, opened: list[LiveSource]
) -> None:
    clock, go = Clock(), threading.Event()
    server.scripts.put([part(jpeg(60)), go, part(jpeg(160)), threading.Event()])
    source = stream(server, clock, opened)
    first = next_frame(source)
    assert (first.index, level(first)) == (0, 60)
    assert first.t_arrival_s == 100.0
    assert first.t_s == pytest.approx(99.93)
    assert source.size_px == (64, 48)
    assert source.poll(0.0) is None, "each frame once"
    clock.t_s = 101.0
    go.set()
    second = next_frame(source)
    assert (second.index, level(second), second.t_arrival_s) == (1, 160, 101.0)


def test_a_frame_has_the_jpeg_that_it_came_as(server: Server, opened: list[LiveSource]) -> None:
    picture = jpeg(90)
    server.scripts.put([part(picture), threading.Event()])
    frame = next_frame(stream(server, Clock(), opened))
    assert frame.encoded == picture
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(decoded, frame.image)


def test_the_newest_frame_wins(server: Server, opened: list[LiveSource]) -> None:
    server.scripts.put([part(jpeg(60)), part(jpeg(100)), part(jpeg(160)), threading.Event()])
    source = stream(server, Clock(), opened)
    seen = []

    def last_came() -> bool:
        frame = source.poll(0.0)
        if frame is not None:
            seen.append(level(frame))
        return 160 in seen

    until(last_came)
    assert seen == sorted(seen)
    assert source.poll(0.0) is None


def test_a_truncated_picture_is_skipped(server: Server, opened: list[LiveSource]) -> None:
    torn = jpeg(60)[:300]
    whole = part(jpeg(160))
    server.scripts.put([part(torn), whole, whole, threading.Event()])
    source = stream(server, Clock(), opened)
    assert level(next_frame(source)) == 160
    until(lambda: source.damaged >= 1)


@pytest.mark.parametrize("size", [(40_000, 40_000), (32_000, 32_000), (0, 64)])
def test_damaged_size_bytes_cost_their_own_picture_alone(
    size: tuple[int, int], server: Server, opened: list[LiveSource]
) -> None:
    go = threading.Event()
    server.scripts.put([part(resized(jpeg(60), *size)), go, part(jpeg(160)), threading.Event()])
    source = stream(server, Clock(), opened)
    until(lambda: source.damaged == 1)
    go.set()
    assert level(next_frame(source)) == 160
    assert source.connections == 1
    assert source.problem(100.0) is None


def test_a_picture_above_the_largest_size_is_not_decoded_and_the_problem_says_so(
    server: Server, opened: list[LiveSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[bytes] = []
    monkeypatch.setattr(network, "grey_pixels", tried.append)
    server.scripts.put([part(resized(jpeg(60), 4097, 4096)), threading.Event()])
    source = stream(server, Clock(), opened)
    until(lambda: source.damaged == 1)
    assert tried == []
    assert "4097x4096 px" in str(source.problem(102.0))


class Broken(StreamSource):
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


@pytest.mark.parametrize("error", [KeyError("x"), cv2.error("no"), MemoryError(), RuntimeError()])
def test_an_unforeseen_error_in_a_stream_is_followed_by_another_connection(
    error: Exception, opened: list[LiveSource]
) -> None:
    opened.append(source := Broken(error, MAX_FAILED_CONNECTIONS - 1))
    next_frame(source)
    assert source.problem(100.0) is None
    opened.append(source := Broken(error, MAX_FAILED_CONNECTIONS))
    until(lambda: source.problem(100.0) is not None)
    assert type(error).__name__ in str(source.problem(100.0))


@pytest.mark.parametrize("error", [TypeError("of http://me:secret@camera/x"), None])
def test_a_thread_that_ends_is_the_camera_s_problem(
    error: Exception | None, opened: list[LiveSource]
) -> None:
    class Ending(LiveSource):
        def grab(self) -> None:
            if error is not None:
                raise error

    source = Ending("camera:7", 0.0, Clock())
    opened.append(source)
    source._start(source.grab)
    assert not source.wait_first(WAIT_S)
    problem = str(source.problem(100.0))
    assert problem.startswith("camera:7")
    assert "thread" in problem
    assert ("TypeError" in problem) == (error is not None)
    assert "secret" not in problem


def test_it_reconnects_when_the_stream_ends(server: Server, opened: list[LiveSource]) -> None:
    clock = Clock()
    gate = threading.Event()
    server.scripts.put([part(jpeg(60)), gate])
    server.scripts.put([part(jpeg(160)), threading.Event()])
    source = stream(server, clock, opened)
    assert level(next_frame(source)) == 60
    gate.set()
    frame = next_frame(source)
    assert (level(frame), frame.index) == (160, 1)
    assert source.connections == 2
    assert source.problem(clock.t_s) is None


def test_reconnects_are_bounded(server: Server, opened: list[LiveSource]) -> None:
    server.scripts.put([part(jpeg(60))])
    source = stream(server, Clock(), opened)
    until(lambda: "gave no picture" in (source.problem(100.0) or ""))
    assert source.connections == 1 + MAX_FAILED_CONNECTIONS
    assert "5 attempts: the stream ended" in str(source.problem(100.0))


def test_a_server_of_one_picture_a_connection_is_kept_though_they_are_equal(
    server: Server, opened: list[LiveSource]
) -> None:
    for _ in range(2 * MAX_FAILED_CONNECTIONS):
        server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = stream(server, Clock(), opened)
    until(lambda: source._arrived == 1 + 2 * MAX_FAILED_CONNECTIONS)
    assert source.problem(100.0) is None


def test_silence_is_a_problem_and_ends_with_the_next_frame(
    server: Server, opened: list[LiveSource]
) -> None:
    clock, go = Clock(), threading.Event()
    server.scripts.put([part(jpeg(60)), go, part(jpeg(160)), threading.Event()])
    source = stream(server, clock, opened)
    next_frame(source)
    assert source.problem(100.0 + SILENT_AFTER_S) is None
    clock.t_s = 102.5
    assert "no frame for 2.5 s" in str(source.problem(clock.t_s))
    go.set()
    next_frame(source)
    assert source.problem(clock.t_s) is None


def test_a_path_the_server_does_not_have_is_not_found(server: Server) -> None:
    server.status = 404
    with pytest.raises(NotFound, match="404"):
        open_camera(server.url, Clock(), timeout_s=WAIT_S)
    assert len(server.paths) == 1


def test_nobody_listens(server: Server, opened: list[LiveSource]) -> None:
    url = server.url
    server.close()
    source = begun(MjpegSource(url, 0.0, Clock()), opened, reconnect_wait_s=0.0)
    assert not source.wait_first(WAIT_S)
    assert "connection refused" in str(source.problem(100.0))


def test_closing_waits_no_longer_than_a_read(server: Server) -> None:
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = begun(MjpegSource(server.url, 0.0, Clock()))
    next_frame(source)
    source.close()
    assert source._thread is not None
    assert not source._thread.is_alive()


def test_no_first_frame_in_time(server: Server) -> None:
    quiet = threading.Event()
    server.scripts.put([b"--frame\r\n", quiet])
    with pytest.raises(TimedOut, match=r"no first frame within 0\.05 s"):
        open_camera(server.url, Clock(), CameraConfig(start_timeout_s=0.05))
    quiet.set()


# -- the device -----------------------------------------------------------------


class Capture:
    """Stands for cv2.VideoCapture; gives queued pictures, fails at None and at the end, and
    raises a queued error."""

    def __init__(self) -> None:
        self.pictures: queue.Queue[np.ndarray[Any, Any] | Exception | None] = queue.Queue()
        self.unplugged = False
        self.released = threading.Event()
        self.reads = 0

    def read(self) -> tuple[bool, Any]:
        self.reads += 1
        if self.unplugged:
            return False, None
        try:
            image = self.pictures.get(timeout=0.01)
        except queue.Empty:
            return False, None
        if isinstance(image, Exception):
            raise image
        return image is not None, image

    def release(self) -> None:
        self.released.set()


def test_a_device_delivers_grey_frames_and_is_released(opened: list[LiveSource]) -> None:
    capture = Capture()
    for value in (60, 160):
        capture.pictures.put(np.full((48, 64, 3), value, np.uint8))
    source = DeviceSource(2, 0.05, Asked((64, 48)), Clock(), lambda n, asked: capture)
    opened.append(source)
    assert source.wait_first(WAIT_S)
    seen = [next_frame(source)]
    if level(seen[0]) == 60:
        seen.append(next_frame(source))
    assert level(seen[-1]) == 160
    assert seen[-1].image.shape == (48, 64)
    assert seen[-1].t_s == pytest.approx(99.95)
    assert source.describe() == "camera:2 (64x48 px)"
    source.close()
    assert capture.released.wait(WAIT_S)


def grey(value: int) -> np.ndarray[Any, Any]:
    return np.full((48, 64), value, np.uint8)


def test_a_device_s_damaged_picture_is_dropped(opened: list[LiveSource]) -> None:
    capture = Capture()
    for each in (grey(60), cv2.error("damaged"), grey(160)):
        capture.pictures.put(each)
    source = DeviceSource(0, 0.0, Asked(), Clock(), lambda n, asked: capture, retry_s=0.0)
    opened.append(source)
    until(lambda: source._count == 2)
    assert not capture.released.is_set()
    assert source.problem(100.0) is None


def test_a_device_that_never_gives_a_picture_fails(opened: list[LiveSource]) -> None:
    capture = Capture()
    capture.unplugged = True
    source = DeviceSource(0, 0.0, Asked(), Clock(), lambda n, asked: capture, retry_s=0.0)
    opened.append(source)
    assert not source.wait_first(WAIT_S)
    assert "stopped delivering" in str(source.problem(float("-inf")))
    assert capture.reads == LOST_AFTER_FAILURES
    assert capture.released.wait(WAIT_S)


class Bus:
    """Where a camera is plugged in and out; `opened` counts the attempts to open one."""

    def __init__(self, capture: Capture) -> None:
        self.capture: Capture | None = capture
        self.numbers: list[int] = []

    def open(self, number: int, asked: Asked) -> Capture:
        self.numbers.append(number)
        if self.capture is None:
            raise NotFound(f"camera:{number} was not found; no /dev/video* exists")
        return self.capture


def test_a_device_that_comes_back_is_opened_again(opened: list[LiveSource]) -> None:
    first, clock = Capture(), Clock()
    first.pictures.put(grey(60))
    bus = Bus(first)
    source = DeviceSource(0, 0.0, Asked(), clock, bus.open, retry_s=0.0, reopen_every_s=0.001)
    opened.append(source)
    assert level(next_frame(source)) == 60
    bus.capture, first.unplugged = None, True
    until(lambda: len(bus.numbers) > 3)
    assert first.released.is_set()
    clock.t_s = 102.0
    assert "camera:0 was not found" in str(source.problem(102.0))
    assert source.problem(float("-inf")) is None, "it is not the end"
    again = Capture()
    again.pictures.put(grey(160))
    bus.capture = again
    frame = next_frame(source)
    assert (level(frame), frame.index, frame.t_arrival_s) == (160, 1, 102.0)
    assert source.problem(102.0) is None
    assert not again.released.is_set()


def test_attempts_to_open_a_lost_device_are_bounded_in_rate(opened: list[LiveSource]) -> None:
    capture = Capture()
    capture.pictures.put(grey(60))
    bus = Bus(capture)
    source = DeviceSource(0, 0.0, Asked(), Clock(), bus.open, retry_s=0.0, reopen_every_s=0.1)
    opened.append(source)
    assert source.wait_first(WAIT_S)
    bus.capture, capture.unplugged = None, True
    until(lambda: len(bus.numbers) == 2)
    began_s = time.monotonic()
    until(lambda: len(bus.numbers) == 6)
    assert time.monotonic() - began_s > 0.35


def test_a_device_that_flaps_is_never_given_up(opened: list[LiveSource]) -> None:
    captures = []

    def one_picture(number: int, asked: Asked) -> Capture:
        captures.append(Capture())
        captures[-1].pictures.put(grey(len(captures)))
        return captures[-1]

    source = DeviceSource(0, 0.0, Asked(), Clock(), one_picture, retry_s=0.0, reopen_every_s=0.0)
    opened.append(source)
    until(lambda: len(captures) > 3)
    until(lambda: source._count > 3)
    assert all(each.released.is_set() for each in captures[:-2])


def test_a_missing_device_says_what_there_is() -> None:
    assert not Path("/dev/video97").exists()
    with pytest.raises(NotFound, match=r"camera:97 was not found; (there are|no /dev/video)"):
        open_capture(97, Asked())
