"""Live sources: the device behind a stand-in, Motion-JPEG from a local server."""

from __future__ import annotations

import queue
import ssl
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.camera.device import LOST_AFTER_FAILURES, Asked, DeviceSource, open_capture
from perchctl.camera.mirror import UnmirroredSource
from perchctl.camera.mjpeg import MAX_PICTURE_BYTES, JpegSplitter, MjpegSource
from perchctl.camera.open import open_source
from perchctl.camera.source import SILENT_AFTER_S, LiveSource
from perchctl.camera.stream import MAX_FAILED_CONNECTIONS
from perchctl.errors import NotFound, TimedOut
from tests.helpers.live import WAIT_S, Clock, level, next_frame, wait_for


def jpeg(level: int, size: tuple[int, int] = (48, 64), **options: int) -> bytes:
    rng = np.random.default_rng(level)
    image = np.clip(rng.normal(level, 4.0, size), 0, 255).astype(np.uint8)
    flags = [x for pair in options.items() for x in (getattr(cv2, pair[0]), pair[1])]
    return bytes(cv2.imencode(".jpg", image, flags)[1].tobytes())


# -- the splitter ------------------------------------------------------------

PICTURES = [
    jpeg(40),
    jpeg(90, IMWRITE_JPEG_PROGRESSIVE=1),
    jpeg(140, IMWRITE_JPEG_RST_INTERVAL=2),
    jpeg(200, (8, 8)),
]


def part(picture: bytes, headers: bytes = b"Content-Type: image/jpeg\r\n") -> bytes:
    return b"--frame\r\n" + headers + b"\r\n" + picture + b"\r\n"


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(PICTURES), max_size=6), st.data())
def test_whole_pictures_come_out_however_the_bytes_arrive(
    pictures: list[bytes], data: st.DataObject
) -> None:
    headers = st.sampled_from([b"", b"Content-Length: 17\r\n", b"\xff\xd8 nonsense\r\n", b"\xff"])
    stream = b"".join(part(p, data.draw(headers)) for p in pictures)
    splitter, out = JpegSplitter(), []
    while stream:
        n = data.draw(st.integers(1, max(len(stream), 1)))
        out += splitter.feed(stream[:n])
        stream = stream[n:]
    assert out == pictures


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.sampled_from(PICTURES), st.floats(0.05, 0.99), st.integers(1, 3))
def test_after_truncated_pictures_the_next_whole_one_comes(
    picture: bytes, share: float, times: int
) -> None:
    torn = picture[: max(int(len(picture) * share), 4)]
    after = jpeg(120)
    count = 70_000 // len(after)  # a tear within a segment's length may point 64 kB ahead
    splitter = JpegSplitter()
    out = splitter.feed(part(torn) * times + part(after) * count)
    # The torn end may by chance fit into what follows and cost that picture.
    assert out[-(count - 1) :] == [after] * (count - 1)
    assert torn not in out


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.binary(max_size=3000))
def test_noise_neither_raises_nor_piles_up(noise: bytes) -> None:
    splitter = JpegSplitter()
    splitter.feed(noise)
    assert len(splitter._buffer) <= len(noise)


def test_a_picture_that_never_ends_is_given_up() -> None:
    splitter = JpegSplitter()
    head = PICTURES[0][: PICTURES[0].index(b"\xff\xda") + 20]
    splitter.feed(head + b"\x11" * (MAX_PICTURE_BYTES + 1))
    assert splitter.damaged == 1
    assert len(splitter._buffer) < 100
    assert splitter.feed(PICTURES[0]) == [PICTURES[0]]


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
    source = MjpegSource(server.url, 0.07, clock, reconnect_wait_s=0.0, **options)
    opened.append(source)
    return source


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


def test_a_picture_that_was_turned_right_is_none_of_its_jpeg(
    server: Server, opened: list[LiveSource]
) -> None:
    server.scripts.put([part(jpeg(90)), threading.Event()])
    frame = next_frame(UnmirroredSource(stream(server, Clock(), opened)))
    assert frame.encoded is None


def test_the_newest_frame_wins(server: Server, opened: list[LiveSource]) -> None:
    server.scripts.put([part(jpeg(60)), part(jpeg(100)), part(jpeg(160)), threading.Event()])
    source = stream(server, Clock(), opened)
    seen = []

    def last_came() -> bool:
        frame = source.poll(0.0)
        if frame is not None:
            seen.append(level(frame))
        return 160 in seen

    wait_for(last_came)
    assert seen == sorted(seen)
    assert source.poll(0.0) is None


def test_a_truncated_picture_is_skipped(server: Server, opened: list[LiveSource]) -> None:
    torn = jpeg(60)[:300]
    whole = part(jpeg(160))
    server.scripts.put([part(torn), whole, whole, threading.Event()])
    source = stream(server, Clock(), opened)
    assert level(next_frame(source)) == 160
    wait_for(lambda: source.damaged >= 1)


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


def test_it_reconnects_when_the_stream_stalls(server: Server, opened: list[LiveSource]) -> None:
    never = threading.Event()
    server.scripts.put([part(jpeg(60)), never])
    server.scripts.put([part(jpeg(160)), never])
    source = stream(server, Clock(), opened, read_timeout_s=0.1)
    wait_for(lambda: source.connections >= 2)
    wait_for(lambda: source.size_px is not None)
    never.set()


def test_reconnects_are_bounded(server: Server, opened: list[LiveSource]) -> None:
    server.scripts.put([part(jpeg(60))])
    source = stream(server, Clock(), opened)
    wait_for(lambda: "gave no picture" in (source.problem(100.0) or ""))
    assert source.connections == 1 + MAX_FAILED_CONNECTIONS
    assert "5 attempts: the stream ended" in str(source.problem(100.0))


def test_a_server_of_one_picture_a_connection_is_kept_though_they_are_equal(
    server: Server, opened: list[LiveSource]
) -> None:
    for _ in range(2 * MAX_FAILED_CONNECTIONS):
        server.scripts.put([part(jpeg(60))])
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = stream(server, Clock(), opened)
    wait_for(lambda: source._arrived == 1 + 2 * MAX_FAILED_CONNECTIONS)
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
        open_source(server.url, 0.0, None, Clock(), timeout_s=WAIT_S)
    assert len(server.paths) == 1


def test_nobody_listens(server: Server, opened: list[LiveSource]) -> None:
    url = server.url
    server.close()
    source = MjpegSource(url, 0.0, Clock(), reconnect_wait_s=0.0)
    opened.append(source)
    assert not source.wait_first(WAIT_S)
    assert "connection refused" in str(source.problem(100.0))


def test_closing_does_not_wait_for_a_stalled_stream(server: Server) -> None:
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = MjpegSource(server.url, 0.0, Clock(), read_timeout_s=1000.0)
    next_frame(source)
    source.close()
    assert source._thread is not None
    assert not source._thread.is_alive()


def test_no_first_frame_in_time(server: Server) -> None:
    quiet = threading.Event()
    server.scripts.put([b"--frame\r\n", quiet])
    with pytest.raises(TimedOut, match=r"no first frame within 0\.05 s"):
        open_source(server.url, 0.0, None, Clock(), timeout_s=0.05)
    quiet.set()


def test_open_source_waits_for_the_first_frame(server: Server) -> None:
    server.scripts.put([part(jpeg(60)), threading.Event()])
    source = open_source(server.url, 0.0, None, Clock(), timeout_s=WAIT_S)
    assert source.live
    assert source.size_px == (64, 48)
    assert source.describe() == f"{server.url} (64x48 px)"
    source.close()


# -- the device -----------------------------------------------------------------


class Capture:
    """Stands for cv2.VideoCapture; gives queued pictures, fails at None and at the end."""

    def __init__(self) -> None:
        self.pictures: queue.Queue[np.ndarray[Any, Any] | None] = queue.Queue()
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


def test_an_unplugged_device_is_a_problem(opened: list[LiveSource]) -> None:
    capture = Capture()
    capture.pictures.put(np.full((48, 64), 50, np.uint8))
    source = DeviceSource(0, 0.0, Asked(), Clock(), lambda n, asked: capture, retry_s=0.0)
    opened.append(source)
    assert source.wait_first(WAIT_S)
    capture.unplugged = True
    wait_for(lambda: "unplugged" in (source.problem(100.0) or ""))
    assert capture.reads >= LOST_AFTER_FAILURES
    assert capture.released.wait(WAIT_S)


def test_a_missing_device_says_what_there_is() -> None:
    assert not Path("/dev/video97").exists()
    with pytest.raises(NotFound, match=r"camera:97 was not found; (there are|no /dev/video)"):
        open_capture(97, Asked())
