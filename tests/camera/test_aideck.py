"""The AI-deck's source on a deck that the test scripts, and the commands through it."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.camera import aideck as aideck_module
from perchctl.camera import open_camera
from perchctl.camera.aideck import (
    AiDeckSource,
    CpxPicture,
    aideck_address,
    decoded,
)
from perchctl.camera.network import MAX_FAILED_CONNECTIONS
from perchctl.errors import InvalidValue
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from tests.camera.test_live import resized
from tests.helpers.aideck import (
    AiDeck,
    Pause,
    aideck,
    bayer,
    console,
    header,
    jpeg,
    jpeg_packets,
    packet,
    picture,
    raw,
)
from tests.helpers.commands import run
from tests.helpers.live import Clock, begun, level, next_frame
from tests.helpers.waiting import until

CAMERA = load_calibration("example_aideck_324x244.yaml")


@pytest.fixture
def deck() -> Iterator[AiDeck]:
    with aideck() as deck:
        yield deck


@pytest.fixture
def opened() -> Iterator[Callable[..., AiDeckSource]]:
    sources: list[AiDeckSource] = []

    def make(deck: AiDeck, clock: Clock | None = None, **options: float) -> AiDeckSource:
        source = AiDeckSource(*aideck_address(deck.url), 0.06, clock or Clock())
        sources.append(begun(source, reconnect_wait_s=0.0, **options))
        return source

    yield make
    for source in sources:
        source.close()


Opened = Callable[..., AiDeckSource]


def test_a_frame_is_of_its_first_byte_and_arrives_with_its_last(
    deck: AiDeck, opened: Opened
) -> None:
    clock, come, go = Clock(), threading.Event(), threading.Event()
    whole = raw(picture(160))
    deck.scripts.put([jpeg(picture(60)), come, whole[:3000], go, whole[3000:], threading.Event()])
    source = opened(deck, clock)
    first = next_frame(source)
    assert (first.index, level(first), first.t_arrival_s) == (0, 60, 100.0)
    assert source.size_px == (324, 244)
    before, clock.t_s = source.bytes_seen, 100.1
    come.set()
    until(lambda: source.bytes_seen > before)
    clock.t_s = 100.3
    go.set()
    second = next_frame(source)
    assert (second.index, level(second), second.t_arrival_s) == (1, 160, 100.3)
    assert second.t_s == pytest.approx(100.1 - 0.06)


SMALLER = jpeg_packets(picture(80, (162, 122)))
SIZE = int.from_bytes(SMALLER[0][-4:], "little")


@pytest.mark.parametrize("fault", [
    raw(picture(80))[:50_000],
    b"\x40\x9c\x63\x05",
    header(324, 244, 500, 1) + packet(b"\xff\xd8" + bytes(498)),
    header(324, 244, SIZE, 1) + b"".join(SMALLER[1:]),
], ids=["cut", "no packet", "JPEG that is none", "JPEG of another size"])  # fmt: skip
def test_frames_go_on_after_a_fault(fault: bytes, deck: AiDeck, opened: Opened) -> None:
    """On the same connection, with no wrong picture between."""
    go, end = threading.Event(), threading.Event()
    deck.scripts.put([raw(picture(60)), go, fault + console() + raw(picture(160)), end])
    source = opened(deck)
    assert level(next_frame(source)) == 60
    go.set()
    after = next_frame(source)
    assert (level(after), after.index) == (160, 1)
    assert source.connections == 1
    end.set()


@pytest.mark.parametrize("said", [(65_000, 65_000), (325, 244), (0, 244)])
def test_a_jpeg_whose_size_bytes_are_damaged_is_not_decoded(
    said: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = b"".join(p[4:] for p in jpeg_packets(picture(80))[1:])
    assert decoded(CpxPicture(0.0, 324, 244, True, whole)) is not None
    monkeypatch.setattr(aideck_module, "grey_pixels", lambda data: pytest.fail("decoded"))
    assert decoded(CpxPicture(0.0, 324, 244, True, resized(whole, *said))) is None


def test_it_reconnects_when_the_deck_restarts_or_stalls(deck: AiDeck, opened: Opened) -> None:
    never = threading.Event()
    whole = raw(picture(80))
    deck.scripts.put([raw(picture(60)), whole[:40_000]])  # broken off
    deck.scripts.put([whole[40_000:], never])  # the rest of it, and then nothing
    deck.scripts.put([raw(picture(160)), never])
    source = opened(deck, read_timeout_s=0.2)
    assert level(next_frame(source)) == 60
    after = next_frame(source)
    assert (level(after), after.index) == (160, 1)
    assert source.connections == 3


@pytest.mark.parametrize(("sent", "words"), [
    ([b"HTTP/1.1 400 Bad Request\r\n\r\n"], "28 bytes came, and no whole picture"),
    ([], "sent nothing; switch the Crazyflie off and on"),
])  # fmt: skip
def test_reconnects_are_bounded_and_the_reason_is_given(
    sent: list[bytes], words: str, deck: AiDeck, opened: Opened
) -> None:
    for _ in range(MAX_FAILED_CONNECTIONS):
        deck.scripts.put([*sent])
    source = opened(deck)
    until(lambda: "gave no picture" in (source.problem(100.0) or ""))
    assert "in 5 attempts: " in str(source.problem(100.0))
    assert words in str(source.problem(100.0))
    assert deck.connections == MAX_FAILED_CONNECTIONS


def test_bytes_without_pictures_end_the_connection(deck: AiDeck, opened: Opened) -> None:
    """A camera that hangs, while its console goes on talking."""
    clock, said, never = Clock(), threading.Event(), threading.Event()
    deck.scripts.put([raw(picture(60)), said, console(), never])
    deck.scripts.put([raw(picture(160)), never])
    source = opened(deck, clock, read_timeout_s=1000.0)
    next_frame(source)
    clock.t_s += AiDeckSource.no_picture_s + 0.1
    said.set()
    assert level(next_frame(source)) == 160
    assert source.connections == 2


@pytest.mark.parametrize(("sent", "is_as_sent"), [
    (jpeg(picture(60)), True), (raw(picture(60)), False), (jpeg(bayer(picture(150))), False),
])  # fmt: skip
def test_a_frame_has_the_jpeg_that_it_came_as_unless_a_mosaic_was_taken_out(
    sent: bytes, is_as_sent: bool, deck: AiDeck, opened: Opened
) -> None:
    deck.forever = [sent]
    frame = next_frame(opened(deck))
    assert (frame.encoded is not None) is is_as_sent
    if frame.encoded is not None:
        as_sent = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(as_sent, frame.image)


@pytest.mark.parametrize(("spec", "address"), [
    ("aideck://192.168.4.1", ("192.168.4.1", 5000)),
    ("aideck://192.168.4.1:5000/", ("192.168.4.1", 5000)),
    ("aideck://aideck-4E4BDC.local:81", ("aideck-4e4bdc.local", 81)),
    ("aideck://[::1]:5001", ("::1", 5001)),
])  # fmt: skip
def test_an_address(spec: str, address: tuple[str, int]) -> None:
    assert aideck_address(spec) == address


@pytest.mark.parametrize("spec", [
    "aideck:", "aideck://", "aideck:192.168.4.1", "aideck://:5000", "aideck://a:b", "aideck://a:0",
    "aideck://a:70000", "aideck://a/stream", "aideck://u:p@a", "aideck://a?colour=yes",
    "aideck://a b", "aideck://a#x", "aideck://[::1",
])  # fmt: skip
def test_a_wrong_address_is_one_sentence(spec: str) -> None:
    with pytest.raises(InvalidValue, match=r"write aideck://HOST\[:5000\], as in aideck://192"):
        open_camera(spec, Clock())


# -- a command through it -------------------------------------------------------


RANGES_M = np.linspace(0.8, 0.1, 8)


def test_track_through_it(deck: AiDeck) -> None:
    """The target comes nearer and nearer."""
    scene = Renderer(Scenario(ceiling_z_m=2.2, camera_noise_sigma=4.0), CAMERA, TargetConfig())
    frames = []
    for i, z_m in enumerate(RANGES_M):
        T_world_cam = np.eye(4)
        T_world_cam[:3, 3] = (0.02, -0.03, 2.2 - z_m)
        frames.append(raw(scene.render([T_world_cam], 0.9, i)))
    for pause_s in (0.12, 0.5, 2.0):  # a computer that is busy skips some: slower, then
        deck.scripts.put([step for f in frames for step in (console(), f, Pause(pause_s))])
        said = run("track", deck.url, "--json", "--calibration", "example_aideck_324x244.yaml")
        lines = [json.loads(line) for line in said.stdout.splitlines()]
        if len(lines) >= 4:
            break
    assert len(lines) >= 4
    seen = [line["target"]["tvec_m"] for line in lines if line["stage"] != "none"]
    assert len(seen) >= len(lines) - 1
    for x_m, y_m, z_m in seen:
        assert (x_m, y_m) == pytest.approx((-0.02, 0.03), abs=0.001)
        assert min(abs(z_m / at_m - 1.0) for at_m in RANGES_M) < 0.01
