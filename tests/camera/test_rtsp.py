"""RTSP from a server on loopback: arrival, faults, reconnecting, passwords."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import av
import av.error
import numpy as np
import pytest

from perchctl.camera import open_camera
from perchctl.camera.jpeg import MOST_STREAM_PX
from perchctl.camera.network import DELAY_WINDOW_S, RtspSource, TransferDelay
from perchctl.camera.source import LiveSource
from perchctl.errors import EXIT_CODES, NotFound
from tests.helpers.live import WAIT_S, Clock, begun, level, next_frame
from tests.helpers.rtsp import RtspServer, Step
from tests.helpers.waiting import until


@pytest.fixture
def server() -> Iterator[RtspServer]:
    server = RtspServer()
    yield server
    server.close()


def started(server: RtspServer, opened: list[LiveSource], who: str = "") -> RtspSource:
    times_s = {"connect_timeout_s": 2.0, "read_timeout_s": 0.3, "reconnect_wait_s": 0.0}
    return begun(RtspSource(server.url(who), 0.07, Clock()), opened, **times_s)


def seconds(count: int, *levels: int) -> list[Step]:
    """Pictures of 25 a second whose levels take turns."""
    return [(k / 25, levels[k % len(levels)]) for k in range(count)]


def test_pictures_come_and_the_newest_wins(server: RtspServer, opened: list[LiveSource]) -> None:
    never = threading.Event()
    server.scripts.put([*seconds(20, 60, 100), (0.8, 160), never])
    source = started(server, opened)
    seen = []

    def last_came() -> bool:
        frame = source.poll(0.0)
        if frame is not None:
            seen.append(frame)
        return bool(seen) and level(seen[-1]) == 160

    until(last_came)
    assert seen[-1].image.shape == (48, 64)
    assert seen[-1].t_arrival_s == 100.0
    assert seen[-1].t_s == pytest.approx(99.93, abs=1e-6) or seen[-1].t_s < 99.93
    assert source.describe() == f"{server.url()} (64x48 px)"
    never.set()


@pytest.mark.parametrize("cut", [True, False])
def test_it_connects_anew_where_the_stream_is_cut_or_stalls(
    server: RtspServer, opened: list[LiveSource], cut: bool
) -> None:
    never = threading.Event()
    server.scripts.put([*seconds(20, 60, 80), *([] if cut else [never])])
    server.scripts.put([*seconds(20, 160, 180), never])
    source = started(server, opened)
    until(lambda: server.plays == 2)
    frame = next_frame(source)
    while level(frame) < 150:
        frame = next_frame(source)
    never.set()


@pytest.mark.parametrize("error", [av.error.InvalidDataError(-1, "damaged"), ValueError("no size")])
def test_a_packet_that_cannot_be_decoded_costs_no_connection(
    error: Exception, opened: list[LiveSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On an open stream of PyAV's whose packets give pictures of these levels, or raise."""
    context = SimpleNamespace(options={})

    def decode(step: int | Exception) -> list[SimpleNamespace]:
        if isinstance(step, Exception):
            raise step
        image = np.full((48, 64), step, np.uint8)
        return [SimpleNamespace(to_ndarray=lambda format: image, time=None)]

    def demux(_: object) -> Iterator[SimpleNamespace]:
        yield from (SimpleNamespace(decode=partial(decode, step)) for step in (60, error, 160))
        threading.Event().wait(0.05)

    streams = SimpleNamespace(video=[SimpleNamespace(thread_type="", codec_context=context)])
    stream = nullcontext(SimpleNamespace(streams=streams, demux=demux))
    monkeypatch.setattr(av, "open", lambda *_, **__: stream)
    source = begun(RtspSource("rtsp://camera/x", 0.0, Clock()), opened, reconnect_wait_s=WAIT_S)
    until(lambda: source._slot.count == 2)
    assert source.connections == 1
    assert int(context.options["max_pixels"]) == MOST_STREAM_PX


def test_name_and_password_are_answered_by_digest_and_not_shown(
    server: RtspServer, opened: list[LiveSource]
) -> None:
    never = threading.Event()
    server.who = ("me", "se:cret")
    server.scripts.put([*seconds(20, 60, 80), never])
    source = started(server, opened, "me:se%3Acret@")
    next_frame(source)
    assert "DESCRIBE Digest" in server.asked
    assert "cret" not in source.describe()
    never.set()


@pytest.mark.parametrize(("who", "path", "sentence"), [
    ("me:hushhush@", "/live", "(401); write the user name and password as in rtsp://NAME:PASSWORD@HOST/PATH"),
    ("me:secret@", "/nowhere", "404"),
])  # fmt: skip
def test_what_trying_again_would_not_mend_is_told_at_once(
    server: RtspServer, who: str, path: str, sentence: str
) -> None:
    server.who = ("me", "secret")
    url = server.url(who).replace("/live", path)
    with pytest.raises(NotFound) as caught:
        open_camera(url, Clock(), timeout_s=WAIT_S)
    assert sentence in str(caught.value)
    assert "hush" not in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(("host", "words"), [
    ("", "delivered no picture in 5 attempts: Connection refused"),
    ("a..b", "the host cannot be reached, or its name cannot be resolved"),
])  # fmt: skip
def test_nobody_listens(server: RtspServer, host: str, words: str) -> None:
    server.close()
    url = server.url("me:secret@")
    with pytest.raises(NotFound, match=words) as caught:
        open_camera(url.replace("127.0.0.1", host or "127.0.0.1"), Clock(), timeout_s=WAIT_S)
    assert "secret" not in str(caught.value)
    assert "camera cannot be opened" in EXIT_CODES[caught.value.exit_code]


def test_a_stream_without_a_picture_says_so(server: RtspServer, opened: list[LiveSource]) -> None:
    never = threading.Event()
    for _ in range(9):
        server.scripts.put([never])
    times_s = {"connect_timeout_s": 0.2, "read_timeout_s": 0.2}
    source = begun(RtspSource(server.url(), 0.0, Clock()), opened, **times_s)
    until(lambda: "first frame within 1 s: connected, but" in str(source.no_first_frame(1.0)))
    assert "close other programs that use it" in str(source.no_first_frame(1.0))
    assert "no image from the camera" in EXIT_CODES[source.no_first_frame(1.0).exit_code]
    never.set()


def test_what_piled_up_is_known_to_be_old() -> None:
    waiting = TransferDelay()
    for k in range(50):
        assert waiting.extra_delay_s(k / 25, 100.0 + k / 25) == pytest.approx(0.0, abs=1e-9)
    heap = [waiting.extra_delay_s(k / 25, 102.4) for k in range(50, 60)]
    assert heap == pytest.approx([2.4 - k / 25 for k in range(50, 60)], abs=0.02)
    assert waiting.extra_delay_s(60 / 25, 102.41) == pytest.approx(0.01, abs=0.01)
    assert waiting.extra_delay_s(None, 103.0) == 0.0


@pytest.mark.parametrize(("slow", "for_s", "most_s"), [
    (1e-4, 600, 1e-4 * DELAY_WINDOW_S + 1e-6), (0.02, 60, 0.05),
])  # fmt: skip
def test_a_clock_of_the_camera_that_runs_slow_or_is_set_back_makes_nothing_old(
    slow: float, for_s: int, most_s: float
) -> None:
    waiting = TransferDelay()
    assert (
        max(waiting.extra_delay_s(k / 25 * (1 - slow), k / 25) for k in range(25 * for_s)) <= most_s
    )
    # Nor one that is set back.
    waiting, times_s = TransferDelay(), (50.0, 50.04, 3.0, 3.04)
    waits_s = [waiting.extra_delay_s(t_s, 100.0 + k / 25) for k, t_s in enumerate(times_s)]
    assert waits_s == pytest.approx([0.0] * 4, abs=1e-9)
