"""Recorded sources, the spec's parser, and errors that name what was found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.camera import (
    FrameSource,
    Recording,
    open_camera,
    parse_source,
    profile_record,
    without_password,
)
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig, Profile
from perchctl.vision import Frame


def clock() -> float:
    return 0.0


def drain(source: FrameSource) -> list[Frame]:
    frames = []
    while not source.finished:
        frame = source.poll(0.0)
        assert frame is not None, "a recording has a frame until it is finished"
        frames.append(frame)
    assert source.poll(0.0) is None
    return frames


def write_images(folder: Path, count: int, suffix: str = ".png") -> None:
    for k in range(count):
        cv2.imwrite(str(folder / f"shot_{k}{suffix}"), np.full((24, 32), 10 * k, np.uint8))


def test_images_come_all_and_in_natural_order(tmp_path: Path) -> None:
    write_images(tmp_path, 12)
    (tmp_path / "notes.txt").write_text("no picture")
    source = open_camera(f"images:{tmp_path}", clock, latency_s=0.07)
    assert isinstance(source, Recording)
    assert (source.rate_hz, source.count) == (30.0, 12)
    assert source.size_px == (32, 24)
    assert not source.live
    frames = drain(source)
    assert [int(f.image[0, 0]) for f in frames] == [10 * k for k in range(12)]
    assert [f.index for f in frames] == list(range(12))
    assert frames[3].t_s == pytest.approx(0.1)
    assert frames[3].t_arrival_s == pytest.approx(0.17)
    assert source.problem(1e6) is None


@pytest.mark.parametrize(("given_s", "counts_s"), [(None, 0.05), (0.0, 0.0), (0.2, 0.2)])
def test_the_profile_s_latency_counts_unless_another_is_given(
    tmp_path: Path, given_s: float | None, counts_s: float
) -> None:
    write_images(tmp_path, 1)
    config = CameraConfig(latency_s=0.05)
    frame = open_camera(f"images:{tmp_path}", clock, config, latency_s=given_s).poll(0.0)
    assert frame is not None
    assert frame.t_arrival_s - frame.t_s == pytest.approx(counts_s)


@pytest.mark.parametrize("mirrored", [False, True])
def test_each_source_that_is_opened_by_a_profile_is_turned_right(
    mirrored: bool, tmp_path: Path
) -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    cv2.imwrite(f"{tmp_path}/a.png", image)
    frame = open_camera(f"images:{tmp_path}", clock, CameraConfig(mirrored=mirrored)).poll(0.0)
    assert frame is not None
    np.testing.assert_array_equal(frame.image, image[:, ::-1] if mirrored else image)


def test_images_by_pattern_and_single_and_those_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="neither a folder nor a pattern"):
        open_camera(f"images:{tmp_path}/nowhere", clock)
    with pytest.raises(NotFound, match="holds no pictures"):
        open_camera(f"images:{tmp_path}", clock)
    write_images(tmp_path, 12)
    assert len(drain(open_camera(f"images:{tmp_path}/shot_1*.png", clock))) == 3
    assert len(drain(open_camera(f"images:{tmp_path}/shot_5.png", clock))) == 1
    (tmp_path / "shot_1.png").write_bytes(b"not a picture")
    with pytest.raises(InvalidValue, match=r"shot_1\.png"):
        drain(open_camera(f"images:{tmp_path}", clock))


def write_video(path: Path, count: int, rate_hz: float) -> None:
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, (64, 48)
    )
    for k in range(count):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()


def test_a_video_gives_every_frame_with_its_time(tmp_path: Path) -> None:
    write_video(tmp_path / "flight.avi", 20, 25.0)
    source = open_camera(f"video:{tmp_path}/flight.avi", clock)
    assert isinstance(source, Recording)
    assert (source.rate_hz, source.count) == (25.0, 20)
    assert source.size_px == (64, 48)
    frames = drain(source)
    assert len(frames) == 20
    assert all(f.image.shape == (48, 64) for f in frames)
    assert all(abs(int(f.image[20, 30]) - 10 * k) <= 3 for k, f in enumerate(frames))
    assert [f.t_s - frames[0].t_s for f in frames] == pytest.approx([k / 25 for k in range(20)])
    source.close()
    assert source.finished


def spec_of(text: str) -> str:
    return parse_source(text).spec


def test_a_bare_path_becomes_a_source(tmp_path: Path) -> None:
    write_images(tmp_path, 1)
    video, picture = tmp_path / "flight.avi", tmp_path / "shot_0.png"
    video.write_bytes(b"")
    assert spec_of(str(tmp_path)) == f"images:{tmp_path}"
    assert spec_of(f"{tmp_path}/*.png") == f"images:{tmp_path}/*.png"
    assert spec_of(str(picture)) == f"images:{picture}"
    assert spec_of(str(video)) == f"video:{video}"
    for spec in ("camera:0", "http://host/stream"):
        assert spec_of(spec) == spec
    assert spec_of("RTSP://Host/s") == "rtsp://Host/s"
    for path in ("none.mp4", "none"):
        with pytest.raises(NotFound, match=f"^{path} does not exist"):
            spec_of(path)


@pytest.mark.parametrize("text", [
    "rtsp:admin:secret@cam", "http:/admin:secret@cam/x", "rtsp:///admin:secret@cam/s",
    "rtsp://admin:12/secret@cam/s", "RTSP://admin:12/34secret@cam/s", "Http:admin:secret@cam",
    "http://cam/x?user=admin&password=secret", "http://cam/x?PWD=secret&y=1",
    "http://cam/x?loginpass=secret", "rtsp://admin:se cret@cam/s", "video:rtsp://a:secret@cam",
    "--source=rtsp://admin:secret@cam/s", "a vehicle with its camera at rtsp://admin:secret@cam",
])  # fmt: skip
def test_no_form_of_a_password_is_shown(text: str) -> None:
    shown = without_password(text)
    assert "cret" not in shown
    assert "cam" in shown
    words = "a vehicle with its camera at"
    assert (words in shown) == (words in text)


@pytest.mark.parametrize("text", [
    "sim:", "camera:0", "images:/a@b/*.png", "radio://0/80/2M/E7E7E7E7E7", "http://host:81/a",
    "udp://127.0.0.1:19850", "aideck://192.168.4.1:5000", "-p", "",
])  # fmt: skip
def test_what_has_no_password_is_shown_as_it_is(text: str) -> None:
    assert without_password(text) == text


def test_no_message_and_no_record_shows_a_password(tmp_path: Path) -> None:
    at = "://me:secret@h/"
    for spec in (f"ftp{at}", f"video:rtsp{at}s", f"images:http{at}*",
                 "http:me:secret@host", "RTSP:/me:secret@host"):  # fmt: skip
        with pytest.raises((InvalidValue, NotFound)) as caught:
            open_camera(spec, clock)
        assert "secret" not in str(caught.value)
    with pytest.raises(InvalidValue) as missing:
        spec_of("me:secret/http:x:secret@host.mp4")
    assert "x:secret" not in str(missing.value)
    profile = Profile.model_validate({
        "description": "at http://me:secret@h/s", "camera": {"source": "RTSP://me:secret@h/s"},
    })  # fmt: skip
    assert "secret" not in str(profile_record(profile))


@pytest.mark.parametrize(("spec", "words"), [
    *((spec, r"allowed are camera:N, .*video:FILE, images:DIR.*aideck") for spec in (
        "rtmp://host/live", "webcam:0", "ftp://x", "video:", "images:", "sim:",
    )),
    *((url, r"no host or no port .*(rtsp|http|aideck)://192.* 1 to 65535") for url in (
        "rtsp://me:sec/ret@host", "http://:80", "rtsp:host", "rtsp://lab:99999", "rtsp://lab:0",
        "http://lab:abc", "http://me:sec:ret@lab:abc", "http://", "aideck:", "aideck://[::1",
    )),
])  # fmt: skip
def test_what_names_no_source_says_what_is_allowed(spec: str, words: str) -> None:
    with pytest.raises(InvalidValue, match=words) as refused:
        open_camera(spec, clock)
    assert "sec" not in str(refused.value)


def test_videos_that_are_none(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenCV's own warning would stand beside the sentence."""
    with pytest.raises(NotFound, match=r"flight\.avi was not found"):
        open_camera(f"video:{tmp_path}/flight.avi", clock)
    (tmp_path / "flight.avi").write_bytes(b"no video at all")
    with pytest.raises(InvalidValue, match="no readable frame"):
        open_camera(f"video:{tmp_path}/flight.avi", clock)
    assert capfd.readouterr().err == ""


def test_a_picture_that_is_cut_off_is_named_before_a_decoder_speaks_of_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    image = np.random.default_rng(0).integers(0, 255, (90, 120), np.uint8)
    jpeg, png = (cv2.imencode(suffix, image)[1].tobytes() for suffix in (".jpg", ".png"))
    small = cv2.imencode(".jpg", image[:9, :9])[1].tobytes()
    inside = b"\xff\xe1" + (len(small) + 2).to_bytes(2) + small  # as cameras have previews
    for name, data in {"a.jpg": jpeg, "b.png": png, "c.jpg": jpeg[:2] + inside + jpeg[2:]}.items():
        path = tmp_path / name
        path.write_bytes(data + b"more behind it")
        assert open_camera(f"images:{path}", clock).size_px == (120, 90)
        for kept in (len(data) // 2, len(data) - 6 if name == "b.png" else len(data) - 1, 300):
            path.write_bytes(data[:kept])
            with pytest.raises(InvalidValue, match=rf"{name} .*is cut off.*remove or replace it"):
                open_camera(f"images:{path}", clock)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("data", [b"", b"no picture", b"\xff\xd8", b"\xff\xd8no"])
def test_what_is_no_picture_is_named(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    with pytest.raises(InvalidValue, match=r"a\.jpg .*(cannot be read|is cut off)"):
        open_camera(f"images:{path}", clock)
