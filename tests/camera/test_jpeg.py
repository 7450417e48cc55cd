"""JPEGs out of a byte stream: whole ones only, whatever is damaged."""

from __future__ import annotations

import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from perchctl.camera import jpeg as module
from perchctl.camera.jpeg import JpegSplitter, decode_grey, jpeg_end_and_size
from tests.helpers.live import jpeg, part, resized

PICTURES = [
    jpeg(40),
    jpeg(90, IMWRITE_JPEG_PROGRESSIVE=1),
    jpeg(140, IMWRITE_JPEG_RST_INTERVAL=2),
    jpeg(200, (8, 8)),
]
SOI = b"\xff\xd8"
SCAN = PICTURES[0][: PICTURES[0].index(b"\xff\xda") + 20]
"""A picture up to the first bytes of its scan."""


def fed(pieces: list[bytes]) -> list[bytes]:
    splitter = JpegSplitter()
    return [picture for piece in pieces for picture, _ in splitter.feed(piece)]


def cut(stream: bytes, places: list[int]) -> list[bytes]:
    ends = [*sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[a:b] for a, b in zip([0, *ends], ends, strict=False)]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(PICTURES), max_size=6), st.data())
@example([PICTURES[3]], None)
def test_whole_pictures_come_out_however_the_bytes_arrive(
    pictures: list[bytes], data: st.DataObject | None
) -> None:
    places, headers = list(range(2000)), st.sampled_from([b"", b"Content-Length: 17\r\n", b"\xff"])
    if data is not None:
        places = data.draw(st.lists(st.integers(0, 100_000), max_size=40))
    stream = b"".join(part(p, b"" if data is None else data.draw(headers)) for p in pictures)
    assert fed(cut(stream, places)) == pictures


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
    out = fed([part(torn) * times + part(after) * (lost + 5)])
    assert torn not in out
    assert out[-5:] == [after] * 5


def test_a_tear_in_the_pixels_costs_its_own_picture_alone() -> None:
    for picture in (PICTURES[0], PICTURES[2]):
        for more in (20, 21, 200):
            torn = picture[: picture.index(b"\xff\xda") + more]
            assert fed([part(torn) + part(PICTURES[0])]) == [PICTURES[0]]
    bare = PICTURES[0]
    assert fed([bare + bare[:1], bare[1:]]) == [bare, bare], "a start that two pieces share"


@pytest.mark.parametrize("hostile", [
    SCAN + bytes(range(255)) * 500,
    b"\xff\xd8\xff" * 40_000,
    SOI + b"\xff\xe0\x00\x04\xff\xd8" * 20_000,
    b"\xff\xd8\xff\xe0\xff\xff" * 20_000,
    b"\xff\xd9" * 60_000,
], ids=["a scan", "starts", "segments of starts", "far lengths", "ends"])  # fmt: skip
def test_what_is_held_is_bounded_and_what_never_ends_is_given_up(
    hostile: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_PICTURE_BYTES", 50_000)
    splitter = JpegSplitter()
    for k in range(0, len(hostile), 1400):
        splitter.feed(hostile[k : k + 1400])
        assert len(splitter._buffer) <= 50_000 + 1400
    splitter.feed(bytes(60_000))
    assert [picture for picture, _ in splitter.feed(PICTURES[0])] == [PICTURES[0]]


@pytest.mark.parametrize("picture", PICTURES)
def test_the_size_is_the_decoder_s_also_behind_a_thumbnail(picture: bytes) -> None:
    """Cameras write a small whole JPEG within a segment in front of the picture's own."""
    image, small = decode_grey(picture), jpeg(10, (16, 24))
    assert image is not None
    inside = b"\xff\xe1" + struct.pack(">H", 2 + len(small)) + small
    for each in (picture, SOI + inside + picture[2:], SOI + b"\xff\xff" + picture[3:]):
        assert jpeg_end_and_size(each) == (len(each), (image.shape[1], image.shape[0]))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=3000))
def test_any_bytes_are_split_and_are_decoded_or_not(data: bytes) -> None:
    splitter = JpegSplitter()
    splitter.feed(SOI + data)
    assert len(splitter._buffer) <= len(data) + 2
    decode_grey(data)


def test_what_opencv_refuses_is_no_exception_and_only_a_whole_jpeg_has_an_end() -> None:
    assert decode_grey(resized(PICTURES[0], 40_000, 40_000)) is None
    assert jpeg_end_and_size(PICTURES[0][:-1]) is None
    assert jpeg_end_and_size(PICTURES[0][:-2] + PICTURES[0]) == (len(PICTURES[0]) - 2, (0, 0))
