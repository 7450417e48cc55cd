"""An AI-deck's pictures out of its bytes: whole ones only, whatever breaks between them."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.camera.aideck import (
    STALLED_S,
    CpxPicture,
    CpxSplitter,
    MosaicFilter,
    has_mosaic,
    without_mosaic,
)
from tests.helpers.aideck import (
    APP,
    CHUNK_BYTES,
    Picture,
    bayer,
    console,
    header,
    jpeg,
    jpeg_packets,
    packet,
    picture,
    raw,
    raw_packets,
)

SMALL = (60, 44)  # three chunks
A, B, C, D = (picture(level, SMALL) for level in (40, 90, 140, 190))


def split(stream: bytes, at: list[int] | None = None) -> list[CpxPicture]:
    splitter, out, last = CpxSplitter(), [], 0
    for place in [*(at or []), len(stream)]:
        out += splitter.feed(stream[last:place], 0.0)
        last = place
    return out


def grey(got: CpxPicture) -> Picture:
    pixels = np.frombuffer(got.data, np.uint8)
    if not got.is_jpeg:
        return pixels.reshape(got.height, got.width)
    return np.asarray(cv2.imdecode(pixels, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("size_px", [(324, 244), (162, 122), (324, 324), (160, 102)])
def test_raw_and_jpeg_pictures_of_each_size(size_px: tuple[int, int]) -> None:
    """The last one fills its chunks to the byte: the streamer then sends an empty packet."""
    image = picture(120, size_px)
    first, second = split(raw(image) + console() + jpeg(image))
    assert (first.width, first.height, first.is_jpeg) == (*size_px, False)
    assert (grey(first) == image).all()
    assert second.is_jpeg
    assert np.abs(grey(second).astype(float) - image).mean() < 4.0


STREAM = b"".join([console(), raw(A), console(), jpeg(B), raw(C), console("x" * 300), jpeg(D)])
WHOLE = split(STREAM)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, len(STREAM)), max_size=40))
def test_any_split_of_the_stream_gives_the_same_pictures(places: list[int]) -> None:
    assert split(STREAM, sorted(places)) == WHOLE
    assert len(WHOLE) == 4


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.sets(st.integers(0, 14), max_size=3), st.sampled_from([raw_packets, jpeg_packets]))
def test_lost_packets_cost_their_own_pictures_alone(
    lost: set[int], form: Callable[[Picture], list[bytes]]
) -> None:
    sent = [form(image) for image in (A, B, C)]
    numbers = itertools.count()
    kept = [[p for p in packets if next(numbers) not in lost] for packets in sent]
    right = [split(b"".join(packets))[0] for packets in sent]
    whole = [r for r, k, s in zip(right, kept, sent, strict=True) if b"".join(k) == b"".join(s)]
    assert split(b"".join(itertools.chain(*kept, form(D)))) == [*whole, *split(b"".join(form(D)))]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.sampled_from(["cut", "insert", "change"]),
    st.floats(0.0, 1.0),
    st.integers(1, 3000),
    st.binary(min_size=1, max_size=64),
    st.sampled_from([raw, jpeg]),
)
def test_after_any_damage_the_next_picture_but_one_is_right(
    how: str, where: float, length: int, filling: bytes, form: Callable[[Picture], bytes]
) -> None:
    spoilt = console() + form(A) + console()
    at = int(where * len(spoilt))
    middle = {"cut": b"", "insert": filling + spoilt[at:], "change": filling}[how]
    rest = {"cut": spoilt[at + length :], "insert": b"", "change": spoilt[at + len(filling) :]}[how]
    out = split(spoilt[:at] + middle + rest + form(B) + form(C) + form(D))
    right = split(form(B) + form(C) + form(D))
    assert out[-2:] == right[1:], "the last two, right behind one another"
    assert len(out) <= 4


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.binary(max_size=4000))
def test_noise_neither_raises_nor_piles_up(noise: bytes) -> None:
    splitter = CpxSplitter()
    assert splitter.feed(noise * 8, 0.0) == []
    assert len(splitter._buffer) < 100


def without(packets: list[bytes], index: int) -> bytes:
    return b"".join(p for i, p in enumerate(packets) if i != index)


def wrong_length(by: int) -> bytes:
    first, second, *rest = raw_packets(B)
    length = int.from_bytes(second[:2], "little") + by
    return first + length.to_bytes(2, "little") + second[2:] + b"".join(rest)


FAULTS: dict[str, bytes] = {
    "cut in the middle": raw(B)[: len(raw(B)) // 2],
    "a chunk lost": without(raw_packets(B), 1),
    "the header lost": without(raw_packets(B), 0),
    "a JPEG's end lost": without(jpeg_packets(B), len(jpeg_packets(B)) - 1),
    "a JPEG whose end is not one": jpeg(B)[:-2] + b"\0\0",
    "a length too large": wrong_length(+5),
    "a length beyond any packet": wrong_length(+40000),
    "a size of nonsense": header(*SMALL, 0xFFFFFFFF, 0) + b"".join(raw_packets(B)[1:]),
    "a size of zero": header(*SMALL, 0, 1) + b"".join(jpeg_packets(B)[1:]),
    "an unknown format": header(*SMALL, B.size, 7) + b"".join(raw_packets(B)[1:]),
    "garbage": bytes(range(256)) * 9,
    "a header twice": raw_packets(B)[0] * 2,
    "a header and a half": raw_packets(B)[0] + raw_packets(B)[0][:7],
    "a version that is none": raw_packets(B)[0] + packet(b"abc", APP | 0x40),
    "more than its size": header(*SMALL, B.size, 0) + packet(bytes(B.size + 8)[:CHUNK_BYTES]) * 3,
    "a console that never ends": raw_packets(B)[0] + console("x" * 1000) * 100,
    "empty packets": raw_packets(B)[0] + packet(b"") * 20_000,
    "a smaller picture behind a torn one": b"".join(jpeg_packets(picture(100))[:4]),
    "a lost chunk, and the next header with it": without(raw_packets(B), 1)
    + b"".join(raw_packets(D)[1:]),
}


@pytest.mark.parametrize("form", [raw, jpeg])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_costs_its_own_picture_only(fault: str, form: Callable[[Picture], bytes]) -> None:
    splitter = CpxSplitter()
    out = splitter.feed(form(A) + FAULTS[fault] + form(C) + form(D), 0.0)
    assert out == split(form(A) + form(C) + form(D))
    assert len(splitter._buffer) < 100


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("bad", [
    b"HTTP/1.1 400 Bad Request", packet(b"abc", APP | 0x40), b"\x40\x9c\x63\x05",
])  # fmt: skip
def test_what_is_no_packet_costs_only_the_picture_that_it_is_in(bad: bytes, at_once: bool) -> None:
    """Whole pictures of the same read are kept; a time is that of the picture's own first byte."""
    splitter = CpxSplitter()
    start, *rest = raw_packets(B)
    parts = [raw(A), bad, raw(B), start, bad, b"".join(rest), raw(C)]
    times_s = [0.0] * 7 if at_once else [0.1 * i for i in range(7)]
    out = splitter.feed(b"".join(parts), 0.0) if at_once else [
        p for part, t_s in zip(parts, times_s, strict=True) for p in splitter.feed(part, t_s)
    ]  # fmt: skip
    assert [p.data for p in out] == [p.data for p in split(raw(A) + raw(B) + raw(C))]
    assert [p.began_s for p in out] == [times_s[i] for i in (0, 2, 6)]
    assert (splitter.pictures, splitter.damaged) == (3, 1)


def test_a_picture_that_a_wrong_length_swallowed_is_found_again_with_its_own_time() -> None:
    splitter = CpxSplitter()
    assert splitter.feed(raw(B)[: len(raw(B)) // 2], 10.0) == []
    assert splitter.feed(raw(C)[:500], 10.4) == []
    (got,) = splitter.feed(raw(C)[500:], 10.6)
    assert (got.began_s, got.data) == (10.4, C.tobytes())
    assert splitter.damaged == 1


def test_what_is_held_is_bounded_by_the_time_of_a_picture() -> None:
    splitter = CpxSplitter()
    splitter.feed(raw_packets(B)[0], 0.0)
    for i in range(200):
        splitter.feed(console("x" * 1000), 0.011 * i)
    assert len(splitter._buffer) < 100
    assert splitter.damaged == 1


def test_a_picture_has_the_time_of_its_first_byte_and_one_that_stalls_is_dropped() -> None:
    """Its end would be taken for its time of arrival by the flight's guards."""
    splitter = CpxSplitter()
    torn, whole = b"".join(raw_packets(A)[:2]), raw(B)
    splitter.feed(torn + whole[:3], 10.4)
    splitter.feed(whole[3:500], 10.5)
    assert splitter.feed(whole[500:-1], 10.6) == []
    (got,) = splitter.feed(whole[-1:] + whole[:1500], 10.9)
    assert got.began_s == 10.4
    assert splitter.feed(whole[1500:], 10.91 + STALLED_S) == []
    assert splitter.damaged == 2
    assert len(splitter.feed(raw(B), 11.0 + STALLED_S)) == 1


def test_a_mosaic_is_known_from_grey() -> None:
    scene = cv2.GaussianBlur(picture(130), (0, 0), 3.0)
    for image in (scene, bayer(scene, (1.0, 1.0, 1.0))):
        assert not has_mosaic(np.asarray(image, np.uint8))
    for gains in ((0.55, 1.0, 0.7), (0.9, 1.0, 0.95)):
        assert has_mosaic(bayer(np.asarray(scene, np.uint8), gains))


def test_the_mosaic_goes_whatever_its_order() -> None:
    flat = np.full((40, 60), 150, np.uint8)
    for flip in (flat, flat[::-1], flat[:, ::-1]):
        smooth = without_mosaic(np.ascontiguousarray(bayer(flip)))
        assert int(smooth.max()) - int(smooth.min()) <= 1


def test_a_colour_camera_is_found_once_and_stays_one() -> None:
    mosaic, plain = bayer(picture(150)), picture(150)
    found = MosaicFilter()
    for _ in range(3):
        assert (found(mosaic) == without_mosaic(mosaic)).all()
    assert (found(plain) == without_mosaic(plain)).all(), "a scene that hides it changes nothing"
    assert (MosaicFilter()(plain) == plain).all()
