"""The AI-deck's source on a deck that the test scripts, and a command through it."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import closing

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.camera import open_camera
from perchctl.camera.aideck import STALLED_S, AiDeckSource, MosaicFilter, has_mosaic, remove_mosaic
from perchctl.camera.source import LiveSource
from perchctl.errors import TimedOut
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from tests.helpers.aideck import (
    AiDeck,
    Pause,
    bayer,
    chunks,
    console,
    header,
    jpeg,
    jpeg_packets,
    packet,
    picture,
    raw,
    raw_packets,
)
from tests.helpers.commands import run
from tests.helpers.live import Clock, begun, level, next_frame
from tests.helpers.waiting import until

CAMERA = load_calibration("example_aideck_324x244.yaml")
NEVER = threading.Event()


@pytest.fixture
def deck(opened: list[LiveSource]) -> Iterator[AiDeck]:
    with closing(AiDeck()) as deck:
        yield deck


@pytest.fixture
def read(deck: AiDeck, opened: list[LiveSource]) -> Callable[..., AiDeckSource]:
    """Opens the deck's source."""

    def make(clock: Clock | None = None, **options: float) -> AiDeckSource:
        source = AiDeckSource(deck.url, 0.06, clock or Clock())
        return begun(source, opened, reconnect_wait_s=0.0, **options)

    return make


Read = Callable[..., AiDeckSource]


@pytest.mark.parametrize("size_px", [(324, 244), (162, 122), (160, 102)])
def test_raw_and_jpeg_pictures_of_each_size(
    size_px: tuple[int, int], deck: AiDeck, read: Read
) -> None:
    """The last one fills its chunks to the byte: the streamer then sends an empty packet."""
    image, go = picture(120, size_px), threading.Event()
    deck.scripts.put([console(), raw(image), console(), go, jpeg(image), NEVER])
    source = read()
    first = next_frame(source)
    assert first.source_jpeg is None
    assert (first.image == image).all()
    go.set()
    second = next_frame(source)
    assert second.source_jpeg is not None
    as_sent = cv2.imdecode(np.frombuffer(second.source_jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(as_sent, second.image)
    assert np.abs(second.image.astype(float) - image).mean() < 4.0


def test_a_frame_is_of_its_first_byte_and_arrives_with_its_last(deck: AiDeck, read: Read) -> None:
    clock, come, go = Clock(), threading.Event(), threading.Event()
    whole = raw(picture(160))
    deck.scripts.put([jpeg(picture(60)), come, whole[:3000], go, whole[3000:], NEVER])
    source = read(clock)
    first = next_frame(source)
    assert (first.index, level(first), first.t_arrival_s) == (0, 60, 100.0)
    assert source.size_px == (324, 244)
    clock.t_s = 100.1
    come.set()
    until(lambda: source._picture is not None)
    clock.t_s = 100.3
    go.set()
    second = next_frame(source)
    assert (second.index, level(second), second.t_arrival_s) == (1, 160, 100.3)
    # The packet's first bytes may have been waited for since before 100.1.
    assert second.t_s == pytest.approx(100.1 - 0.06)


def test_a_picture_that_stalls_is_dropped(deck: AiDeck, read: Read) -> None:
    """Its end would be taken for its time of arrival by the flight's guards."""
    clock, go = Clock(), threading.Event()
    whole = raw(picture(60))
    deck.scripts.put([whole[:3000], go, whole[3000:], raw(picture(160)), NEVER])
    source = read(clock)
    until(lambda: source._picture is not None)
    clock.t_s += STALLED_S + 0.1
    go.set()
    assert level(next_frame(source)) == 160


SMALLER = jpeg_packets(picture(80, (162, 122)))
SIZE = int.from_bytes(SMALLER[0][-4:], "little")
WHOLE = raw_packets(picture(80))
WHOLE_JPEG = cv2.imencode(".jpg", picture(80))[1].tobytes()


@pytest.mark.parametrize("fault", [
    b"".join(WHOLE[:20] + WHOLE[21:]),  # a chunk lost
    b"".join(WHOLE[1:]),
    b"".join(WHOLE[:-1]) + packet(bytes(1020)),  # too long
    WHOLE[0] * 2,
    WHOLE[0] + console("x" * 1000) * 100,
    jpeg(picture(80))[:-2] + b"\0\0",  # a JPEG without its end
    header(324, 244, SIZE, 1) + b"".join(SMALLER[1:]),  # a JPEG of another size
    header(324, 244, 0xFFFFFFFF, 0) + b"".join(WHOLE[1:]),
    header(324, 244, 324 * 244, 7) + b"".join(WHOLE[1:]),  # an unknown format
    header(65000, 65000, 500, 1) + packet(bytes(500)),
])  # fmt: skip
def test_a_fault_costs_its_own_picture_and_no_connection(
    fault: bytes, deck: AiDeck, read: Read
) -> None:
    go = threading.Event()
    deck.scripts.put([raw(picture(60)), go, fault + console() + raw(picture(160)), NEVER])
    source = read()
    assert level(next_frame(source)) == 60
    go.set()
    after = next_frame(source)
    assert (level(after), after.index) == (160, 1)
    assert source.connections == 1


@pytest.mark.parametrize("end", [
    [b"".join(WHOLE[:20])], [raw(picture(80))[:40_000], NEVER], [b"\x40\x9c\x63\x05", NEVER],
], ids=["broken off", "stalls", "no packet"])  # fmt: skip
def test_it_connects_anew(end: list[bytes | threading.Event], deck: AiDeck, read: Read) -> None:
    deck.scripts.put([raw(picture(60)), *end])
    deck.scripts.put([b"".join(WHOLE[20:]), raw(picture(160)), NEVER])
    source = read(read_timeout_s=0.2)
    until(lambda: source._slot.count >= 2)
    after = next_frame(source)
    assert (level(after), after.index) == (160, 1), "the rest of the broken one is no picture"
    assert source.connections >= 2


# --- What it says when no picture comes -------------------------------------------------------

OFF_AND_ON = "switch the Crazyflie off and on again"
TRUNCATED = header(324, 244, len(WHOLE_JPEG) - 2, 1) + b"".join(chunks(WHOLE_JPEG[:-2]))
DAMAGED = header(324, 244, 500, 1) + packet(b"\xff\xd8\xff\xe0" + bytes(496))
NEVER_WHOLE = [
    ([NEVER], f"connected, but it sends no data: {OFF_AND_ON}"),
    ([], f"connected, but the stream ended without a picture: {OFF_AND_ON}"),
    ([b"HTTP/1.1 200 OK\r\n", NEVER], "format of Bitcraze's wifi-img-streamer: check"),
    ([TRUNCATED * 3, NEVER], "pictures arrive but are dropped (3 so far)"),
]  # fmt: skip
NEVER_WHOLE_LIKEWISE = [
    ([console(), NEVER], "data arrives, but no picture: check that the deck runs wifi"),
    ([TRUNCATED, NEVER], "pictures arrive but are dropped (1 so far): the JPEG is incomplete"),
    ([DAMAGED, NEVER], "pictures arrive but are dropped (1 so far): the JPEG is damaged"),
    ([header(324, 244, SIZE, 1) + b"".join(SMALLER[1:]), NEVER], "is 162x122 px, but the header"),
    ([b"".join(WHOLE[:-1]) + packet(bytes(1020)), NEVER], "the header announces 79056"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("script", "words"),
    [
        *NEVER_WHOLE,
        *(pytest.param(*each, marks=pytest.mark.long) for each in NEVER_WHOLE_LIKEWISE),
    ],
)
def test_a_deck_without_a_whole_picture_is_not_called_a_receiver(
    script: list[bytes | threading.Event], words: str, deck: AiDeck
) -> None:
    """It says what came, and advises what helps a deck; nothing else is known."""
    for _ in range(20):
        deck.scripts.put(script)
    with pytest.raises(TimedOut) as refused:
        open_camera(deck.url, Clock(), timeout_s=0.5)
    text = str(refused.value)
    assert words in text
    assert text.startswith(f"{deck.url}: no first frame within 0.5 s: ") or "5 attempts" in text
    assert "receiver" not in text


def test_a_deck_that_is_not_there_is_not_told_to_be_switched(deck: AiDeck) -> None:
    deck.close()
    with pytest.raises(
        TimedOut, match="connection refused: check that this computer is on the deck's Wi-Fi"
    ):
        open_camera(deck.url, Clock(), timeout_s=0.3)


@pytest.mark.parametrize("padding", [b"\0", bytes(2), bytes(700), b"\xff\xd9"])
def test_what_stands_behind_a_jpeg_s_end_is_padding(
    padding: bytes, deck: AiDeck, read: Read
) -> None:
    data = WHOLE_JPEG + padding
    deck.scripts.put([header(324, 244, len(data), 1) + b"".join(chunks(data)), NEVER])
    frame = next_frame(read())
    assert level(frame) == 80
    assert frame.source_jpeg == WHOLE_JPEG


def test_pictures_that_are_dropped_in_flight_are_named(deck: AiDeck, read: Read) -> None:
    clock, go = Clock(), threading.Event()
    deck.scripts.put([raw(picture(60)), go, TRUNCATED * 2, NEVER])
    source = read(clock)
    assert level(next_frame(source)) == 60
    clock.t_s += 1.5
    assert source.problem(clock.t_s) == f"{deck.url} has delivered no frame for 1.5 s"
    go.set()
    until(lambda: "are dropped (2 so far)" in (source.problem(clock.t_s) or ""))


# --- A colour camera ----------------------------------------------------------------------


def test_a_mosaic_is_known_from_grey_and_goes_whatever_its_order() -> None:
    scene = np.asarray(cv2.GaussianBlur(picture(130), (0, 0), 3.0), np.uint8)
    for image in (scene, bayer(scene, (1.0, 1.0, 1.0))):
        assert not has_mosaic(image)
    for gains in ((0.55, 1.0, 0.7), (0.9, 1.0, 0.95)):
        assert has_mosaic(bayer(scene, gains))
    flat = np.full((40, 60), 150, np.uint8)
    for flip in (flat, flat[::-1], flat[:, ::-1]):
        smooth = remove_mosaic(np.ascontiguousarray(bayer(flip)))
        assert int(smooth.max()) - int(smooth.min()) <= 1


def test_a_colour_camera_is_found_once_and_stays_one(deck: AiDeck, read: Read) -> None:
    mosaic, plain = bayer(picture(150)), picture(150)
    found = MosaicFilter()
    for _ in range(3):
        assert (found(mosaic) == remove_mosaic(mosaic)).all()
    assert (found(plain) == remove_mosaic(plain)).all(), "a scene that hides it changes nothing"
    assert (MosaicFilter()(plain) == plain).all()
    deck.forever = [jpeg(mosaic)]
    assert next_frame(read()).source_jpeg is None, "it is not the JPEG that came any more"


# --- A command through it -----------------------------------------------------------------


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
        *lines, end = [json.loads(line) for line in said.stdout.splitlines()]
        assert said.code == 10  # the script is over, and the deck hangs up
        assert "error" in end
        if len(lines) >= 4:
            break
    assert len(lines) >= 4
    seen = [line["target"]["tvec_m"] for line in lines if line["target"]]
    assert len(seen) >= len(lines) - 1
    for x_m, y_m, z_m in seen:
        assert (x_m, y_m) == pytest.approx((-0.02, 0.03), abs=0.001)
        assert min(abs(z_m / at_m - 1.0) for at_m in RANGES_M) < 0.01
