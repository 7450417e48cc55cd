"""JPEGs out of a byte stream: whole ones only, whatever is damaged."""

from __future__ import annotations

import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from perchctl.camera import jpeg as module
from perchctl.camera.jpeg import (
    Damaged,
    JpegSplitter,
    grey_pixels,
    jpeg_end,
    size_in,
)
from tests.camera.test_live import jpeg, part, resized

PICTURES = [
    jpeg(40),
    jpeg(90, IMWRITE_JPEG_PROGRESSIVE=1),
    jpeg(140, IMWRITE_JPEG_RST_INTERVAL=2),
    jpeg(200, (8, 8)),
]
SOI = b"\xff\xd8"
SCAN = PICTURES[0][: PICTURES[0].index(b"\xff\xda") + 20]
"""A picture up to the first bytes of its scan."""


def fed(pieces: list[bytes]) -> tuple[list[bytes], int]:
    splitter = JpegSplitter()
    out = [picture for piece in pieces for picture in splitter.feed(piece)]
    return out, splitter.damaged


def cut(stream: bytes, places: list[int]) -> list[bytes]:
    ends = [*sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[a:b] for a, b in zip([0, *ends], ends, strict=False)]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(PICTURES), max_size=6), st.data())
def test_whole_pictures_come_out_however_the_bytes_arrive(
    pictures: list[bytes], data: st.DataObject
) -> None:
    headers = st.sampled_from([b"", b"Content-Length: 17\r\n", b"\xff\xd8 nonsense\r\n", b"\xff"])
    stream = b"".join(part(p, data.draw(headers)) for p in pictures)
    places = data.draw(st.lists(st.integers(0, 100_000), max_size=40))
    assert fed(cut(stream, places)) == (pictures, 0)


FILLINGS = [b"", b"\xff", SOI, b"\xff\xd8\xff", b"\xff\xd9", b"\xff\xda\x00\x02", b"\xff\xe0\xff",
            b"\xff\xff\xff", b"\xff\x00", b"\xff\xd8\xff\xe0\x00\x04\xff\xd8"]  # fmt: skip


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.lists(st.sampled_from(PICTURES), min_size=1, max_size=4),
    st.lists(
        st.tuples(
            st.integers(0, 20_000), st.integers(0, 300), st.sampled_from(FILLINGS) | st.binary()
        ),
        max_size=4,
    ),
    st.lists(st.integers(0, 20_000), max_size=60),
)
@example([PICTURES[3]], [], list(range(2000)))
def test_the_pieces_make_no_difference_whatever_is_damaged(
    pictures: list[bytes], damages: list[tuple[int, int, bytes]], places: list[int]
) -> None:
    stream = b"".join(part(p) for p in pictures)
    for at, length, filling in damages:
        at %= len(stream)
        stream = stream[:at] + filling + stream[at + length :]
    assert fed(cut(stream, places)) == fed([stream])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.sampled_from(PICTURES), st.floats(0.05, 0.99), st.integers(1, 3))
def test_pictures_come_again_behind_truncated_ones(
    picture: bytes, share: float, times: int
) -> None:
    torn = picture[: max(int(len(picture) * share), 4)]
    after = jpeg(120)
    # A tear within a segment's length points up to 64 kB ahead. Three of them in a row may, and
    # each time the picture in which the search goes on is lost, too.
    lost = times * (65_537 // len(part(after)) + 2)
    out, _ = fed([part(torn) * times + part(after) * (lost + 5)])
    assert torn not in out
    assert out[-5:] == [after] * 5


def test_a_tear_in_the_pixels_costs_its_own_picture_alone() -> None:
    for picture in (PICTURES[0], PICTURES[2]):
        for more in (20, 21, 200):
            torn = picture[: picture.index(b"\xff\xda") + more]
            assert fed([part(torn) + part(PICTURES[0])]) == ([PICTURES[0]], 1)


HOSTILE = {
    "a scan": SCAN + bytes(range(255)) * 500,
    "stuffing": SCAN + b"\xff\x00" * 60_000,
    "starts": b"\xff\xd8\xff" * 40_000,
    "segments of starts": SOI + b"\xff\xe0\x00\x04\xff\xd8" * 20_000,
    "far lengths": b"\xff\xd8\xff\xe0\xff\xff" * 20_000,
    "fill bytes": SOI + b"\xff" * 120_000,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_held_is_bounded_and_what_never_ends_is_given_up(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_PICTURE_BYTES", 50_000)
    splitter, stream = JpegSplitter(), HOSTILE[name]
    for k in range(0, len(stream), 1400):
        splitter.feed(stream[k : k + 1400])
        assert len(splitter._buffer) <= 50_000 + 1400
    if name == "a scan":
        assert splitter.damaged == 1
        assert splitter.feed(PICTURES[0]) == [PICTURES[0]]


# -- what size it says ---------------------------------------------------------------


def with_thumbnail(picture: bytes) -> bytes:
    """As cameras write it: a small whole JPEG within a segment in front of the picture's own."""
    small = jpeg(10, (16, 24))
    return SOI + b"\xff\xe1" + struct.pack(">H", 2 + len(small)) + small + picture[2:]


@pytest.mark.parametrize("picture", PICTURES)
def test_the_size_is_the_decoder_s(picture: bytes) -> None:
    image = grey_pixels(picture)
    assert image is not None
    for each in (picture, with_thumbnail(picture), SOI + b"\xff\xff" + picture[3:]):
        assert size_in(each) == (image.shape[1], image.shape[0])
        assert jpeg_end(each) == len(each)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.sampled_from(PICTURES),
    st.lists(st.tuples(st.integers(2, 600), st.integers(0, 255)), min_size=1, max_size=3),
)
def test_no_damage_makes_a_picture_larger_than_it_says(
    picture: bytes, damages: list[tuple[int, int]]
) -> None:
    data = bytearray(picture)
    for at, value in damages:
        data[at % len(data)] = value
    size_px = size_in(data)
    if size_px is None or size_px[0] * size_px[1] > 1 << 22:
        return  # refused without decoding
    image = grey_pixels(bytes(data))
    assert image is None or sorted(image.shape) == sorted(size_px)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=3000))
def test_any_bytes_are_split_have_a_size_or_none_and_are_decoded_or_not(data: bytes) -> None:
    splitter = JpegSplitter()
    splitter.feed(data)
    assert len(splitter._buffer) <= len(data)
    size_in(SOI + data)
    grey_pixels(data)


def test_what_opencv_refuses_is_no_exception_and_only_a_whole_jpeg_has_an_end() -> None:
    assert grey_pixels(resized(PICTURES[0], 40_000, 40_000)) is None
    assert jpeg_end(PICTURES[0][:-1]) is None
    with pytest.raises(Damaged):
        jpeg_end(PICTURES[0][:-2] + PICTURES[0])
