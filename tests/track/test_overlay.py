"""The video of `perchctl track --overlay`: browsers play it, at the times of the frames."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from perchctl.display import Sketch
from perchctl.errors import InvalidValue
from perchctl.track.outputs import OverlayFile
from perchctl.vision import CameraModel
from tests.helpers.disk import full_disk

RNG = np.random.default_rng(3)


def lens(width: int, height: int) -> CameraModel:
    return CameraModel(
        (width, height), np.array([[200.0, 0, width / 2], [0, 200.0, height / 2], [0, 0, 1]]),
        np.zeros(5),
    )  # fmt: skip


def grey(value: int, width: int = 64, height: int = 48) -> Sketch:
    return Sketch(np.full((height, width), value, np.uint8))


def shown(path: Path) -> tuple[list[float], list[float], float]:
    """When each picture is shown and how light it is, and how long all of it takes."""
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.duration is not None
        assert stream.time_base is not None
        frames = [(f.time, float(f.to_ndarray(format="gray").mean())) for f in video.decode(stream)]
        lasts_s = float(stream.duration * stream.time_base)
    return [t for t, _ in frames if t is not None], [light for _, light in frames], lasts_s


def test_each_picture_is_shown_at_its_own_time(tmp_path: Path) -> None:
    """A camera's times are irregular, and its clock begins anywhere."""
    times = [7203.4, 7203.433, 7203.5, 7204.9, 7204.91, 7217.0]
    film = OverlayFile(tmp_path / "x.mp4", lens(64, 48), 25.0)
    for k, t_s in enumerate(times):
        film.add(t_s, grey(30 + 30 * k))
    film.close(keep=True)
    starts, lights, lasts_s = shown(tmp_path / "x.mp4")
    assert starts == pytest.approx(np.subtract(times, times[0]), abs=1e-4)
    assert lights == pytest.approx([30 + 30 * k for k in range(len(times))], abs=3)
    assert lasts_s == pytest.approx(times[-1] - times[0] + 1 / 25.0, abs=0.001)


def test_a_time_that_does_not_rise_loses_no_picture(tmp_path: Path) -> None:
    film = OverlayFile(tmp_path / "x.mp4", lens(64, 48), 30.0)
    for t_s in (1.0, 1.1, 1.1, 0.4, 1.2):
        film.add(t_s, grey(90))
    film.close(keep=True)
    starts, _, _ = shown(tmp_path / "x.mp4")
    assert starts == pytest.approx([0.0, 0.1, 0.1, 0.1, 0.2], abs=1e-3)


def test_an_odd_size_is_made_even(tmp_path: Path) -> None:
    film = OverlayFile(tmp_path / "x.mp4", lens(65, 49), 30.0)
    film.add(0.0, grey(90, 65, 49))
    film.close(keep=True)
    with av.open(str(tmp_path / "x.mp4")) as video:
        (frame,) = video.decode(video=0)
    assert (frame.width, frame.height) == (66, 50)


def test_its_index_stands_in_front(tmp_path: Path) -> None:
    """A browser plays it while it is still being fetched."""
    film = OverlayFile(tmp_path / "x.mp4", lens(64, 48), 30.0)
    film.add(0.0, grey(90))
    film.close(keep=True)
    data = (tmp_path / "x.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize("frames", [0, 1])
def test_it_may_be_short(tmp_path: Path, frames: int) -> None:
    film = OverlayFile(tmp_path / "x.mp4", lens(64, 48), 30.0)
    for k in range(frames):
        film.add(0.1 * k, grey(90))
    film.close(keep=True)
    assert [p.name for p in tmp_path.iterdir()] == ["x.mp4"]


@pytest.mark.parametrize("room", [0, 40, 100_000])
def test_a_full_disk_is_one_sentence_and_leaves_no_file(tmp_path: Path, room: int) -> None:
    noise = [Sketch(RNG.integers(0, 255, (480, 640)).astype(np.uint8)) for _ in range(4)]

    def write() -> None:
        film = OverlayFile(tmp_path / "x.mp4", lens(640, 480), 30.0)
        try:
            for k, sketch in enumerate(noise):
                film.add(k / 30.0, sketch)
            film.close(keep=True)
        finally:
            film.close(keep=False)

    with full_disk(room), pytest.raises(InvalidValue, match=r"x\.mp4 cannot be written: File too"):
        write()
    assert not list(tmp_path.iterdir())
