"""Recorded sources, the spec's parser, and errors that name what was found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.camera import (
    FrameSource,
    RecordedSource,
    open_camera,
    parse_source,
    profile_record,
    without_password,
)
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig, Profile
from perchctl.vision import Frame
from tests.helpers.live import Clock

CLOCK = Clock()


def drain(source: FrameSource) -> list[Frame]:
    frames = []
    while not source.finished:
        frame = source.poll(0.0)
        assert frame is not None, "a recording has a frame until it is finished"
        frames.append(frame)
    assert source.poll(0.0) is None
    return frames


def write_images(folder: Path, count: int) -> None:
    for k in range(count):
        cv2.imwrite(f"{folder}/shot_{k}.png", np.full((24, 32), 10 * k, np.uint8))


def test_images_come_all_and_in_natural_order(tmp_path: Path) -> None:
    write_images(tmp_path, 12)
    (tmp_path / "notes.txt").write_text("no picture")
    source = open_camera(f"images:{tmp_path}", CLOCK, latency_s=0.07)
    assert isinstance(source, RecordedSource)
    assert (source.rate_hz, source.count) == (30.0, 12)
    assert source.size_px == (32, 24)
    assert not source.live
    frames = drain(source)
    assert [int(f.image[0, 0]) for f in frames] == [10 * k for k in range(12)]
    assert [f.index for f in frames] == list(range(12))
    assert frames[3].t_s == pytest.approx(0.1)
    assert frames[3].t_arrival_s == pytest.approx(0.17)
    assert source.problem(1e6) is None


@pytest.mark.parametrize(
    ("given_s", "counts_s", "mirrored"), [(None, 0.05, True), (0.0, 0.0, False), (0.2, 0.2, False)]
)
def test_the_profile_turns_pictures_and_gives_the_latency_unless_another_is_given(
    tmp_path: Path, given_s: float | None, counts_s: float, mirrored: bool
) -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    cv2.imwrite(f"{tmp_path}/a.png", image)
    config = CameraConfig(latency_s=0.05, mirrored=mirrored)
    frame = open_camera(f"images:{tmp_path}", CLOCK, config, latency_s=given_s).poll(0.0)
    assert frame is not None
    assert frame.t_arrival_s - frame.t_s == pytest.approx(counts_s)
    np.testing.assert_array_equal(frame.image, image[:, ::-1] if mirrored else image)


def test_images_by_pattern_and_single_and_those_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="neither a folder nor a pattern"):
        open_camera(f"images:{tmp_path}/nowhere", CLOCK)
    with pytest.raises(NotFound, match="contains no pictures"):
        open_camera(f"images:{tmp_path}", CLOCK)
    write_images(tmp_path, 12)
    assert len(drain(open_camera(f"images:{tmp_path}/shot_1*.png", CLOCK))) == 3
    assert len(drain(open_camera(f"images:{tmp_path}/shot_5.png", CLOCK))) == 1
    for data in (b"not a picture", b"", b"\xff\xd8", b"\xff\xd8no"):
        (tmp_path / "shot_1.png").write_bytes(data)
        with pytest.raises(InvalidValue, match=r"shot_1\.png .*(cannot be read|is truncated)"):
            drain(open_camera(f"images:{tmp_path}", CLOCK))


def test_a_video_gives_every_frame_with_its_time(tmp_path: Path) -> None:
    path, mjpg = f"{tmp_path}/flight.avi", cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, mjpg, 25.0, (64, 48))
    for k in range(20):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()
    source = open_camera(f"video:{path}", CLOCK)
    assert isinstance(source, RecordedSource)
    assert (source.rate_hz, source.count) == (25.0, 20)
    assert source.size_px == (64, 48)
    frames = drain(source)
    assert len(frames) == 20
    assert all(f.image.shape == (48, 64) for f in frames)
    assert all(abs(int(f.image[20, 30]) - 10 * k) <= 3 for k, f in enumerate(frames))
    assert [f.t_s - frames[0].t_s for f in frames] == pytest.approx([k / 25 for k in range(20)])
    source.close()
    assert source.finished


def test_a_bare_path_becomes_a_source(tmp_path: Path) -> None:
    write_images(tmp_path, 1)
    video, picture = tmp_path / "flight.avi", tmp_path / "shot_0.png"
    video.write_bytes(b"")
    for text, spec in {
        str(tmp_path): f"images:{tmp_path}", f"{tmp_path}/*.png": f"images:{tmp_path}/*.png",
        str(picture): f"images:{picture}", str(video): f"video:{video}",
        "camera:0": "camera:0", "RTSP://Host/s": "rtsp://Host/s",
    }.items():  # fmt: skip
        assert parse_source(text).spec == spec
    for path in ("none.mp4", "none"):
        with pytest.raises(NotFound, match=f"^{path} does not exist"):
            parse_source(path)


@pytest.mark.parametrize("text", [
    "rtsp:admin:secret@cam", "http:/admin:secret@cam/x", "rtsp:///admin:secret@cam/s",
    "rtsp://admin:12/secret@cam/s", "RTSP://admin:12/34secret@cam/s", "Http:admin:secret@cam",
    "http://cam/x?user=admin&password=secret", "http://cam/x?PWD=secret&y=1",
    "http://cam/x?loginpass=secret", "rtsp://admin:se cret@cam/s", "video:rtsp://a:secret@cam",
    "--source=rtsp://admin:secret@cam/s", "a vehicle with its camera at rtsp://admin:secret@cam",
    "sim:", "camera:0", "images:/a@b/*.png", "radio://0/80/2M/E7E7E7E7E7", "http://host:81/a",
    "udp://127.0.0.1:19850", "aideck://192.168.4.1:5000", "-p", "",
])  # fmt: skip
def test_no_form_of_a_password_is_shown_and_what_has_none_is_shown_as_it_is(text: str) -> None:
    shown = without_password(text)
    assert "cret" not in shown
    if "cret" not in text:
        assert shown == text
    else:
        assert "cam" in shown
        assert shown.startswith("a vehicle with its camera at") == text.startswith("a vehicle")


def test_no_message_and_no_record_shows_a_password(tmp_path: Path) -> None:
    at = "://me:secret@h/"
    for spec in (f"ftp{at}", f"video:rtsp{at}s", f"images:http{at}*",
                 "http:me:secret@host", "RTSP:/me:secret@host"):  # fmt: skip
        with pytest.raises((InvalidValue, NotFound)) as caught:
            open_camera(spec, CLOCK)
        assert "secret" not in str(caught.value)
    with pytest.raises(InvalidValue) as missing:
        parse_source("me:secret/http:x:secret@host.mp4")
    assert "x:secret" not in str(missing.value)
    profile = Profile.model_validate({
        "description": "at http://me:secret@h/s", "camera": {"source": "RTSP://me:secret@h/s"},
    })  # fmt: skip
    assert "secret" not in str(profile_record(profile))


@pytest.mark.parametrize(("spec", "words"), [
    *((spec, r"allowed are camera:N, .*video:FILE, images:DIR.*aideck") for spec in (
        "rtmp://host/live", "webcam:0", "ftp://x", "video:", "images:", "sim:",
    )),
    *((url, r"no valid host and port.*(rtsp|http|aideck)://192.* 1 to 65535") for url in (
        "rtsp://me:sec/ret@host", "http://:80", "rtsp:host", "rtsp://lab:99999", "rtsp://lab:0",
        "http://lab:abc", "http://me:sec:ret@lab:abc", "http://", "aideck:", "aideck://[::1",
    )),
])  # fmt: skip
def test_what_names_no_source_says_what_is_allowed(spec: str, words: str) -> None:
    with pytest.raises(InvalidValue, match=words) as refused:
        open_camera(spec, CLOCK)
    assert "sec" not in str(refused.value)


def test_videos_that_are_none(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenCV's own warning would stand beside the sentence."""
    with pytest.raises(NotFound, match=r"flight\.avi was not found"):
        open_camera(f"video:{tmp_path}/flight.avi", CLOCK)
    (tmp_path / "flight.avi").write_bytes(b"no video at all")
    with pytest.raises(InvalidValue, match="no readable frame"):
        open_camera(f"video:{tmp_path}/flight.avi", CLOCK)
    assert capfd.readouterr().err == ""


MCAP = b"\x89MCAP0\r\n\x01"


@pytest.mark.parametrize(
    ("name", "head", "sentence"),
    [
        (
            "flight.mcap",
            MCAP + b"\x12" + bytes(11) + b"\x0a\0\0\0perchctl 1",
            "(it is a recording); write the images of a perchctl recording to a folder first",
        ),
        (
            "bag_0.mcap",
            MCAP + b"\x15" + bytes(7) + b"\x04\0\0\0ros2",
            "(it is a ROS bag); export its images to a folder, or play the bag",
        ),
        ("lab.bag", b"#ROSBAG V2.0\n", "(it is a ROS bag); export its images"),
        (
            "bag_0.db3",
            b"SQLite format 3\0",
            "(it is an SQLite database, as in a ROS bag); export its images",
        ),
    ],
)
def test_the_jpegs_in_a_recording_or_bag_are_not_played_as_a_video(
    name: str, head: bytes, sentence: str, tmp_path: Path
) -> None:
    """FFmpeg would find them, but neither their times nor all of their ends."""
    image = np.random.default_rng(0).integers(0, 255, (90, 120), np.uint8)
    path, jpeg = tmp_path / name, cv2.imencode(".jpg", image)[1].tobytes()
    for number, before in enumerate((b"", head)):
        path.write_bytes(before + b"".join(bytes(50) + jpeg for _ in range(30)))
        if not number:
            assert len(drain(open_camera(f"video:{path}", CLOCK))) > 1
            continue
        for scheme in ("video:", "images:", ""):
            with pytest.raises(InvalidValue) as refused:
                open_camera(f"{scheme}{path}", CLOCK)
            assert f"{name} is neither a picture nor a video {sentence}" in str(refused.value)


def test_the_folder_of_a_bag_is_no_folder_of_pictures(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 9\n")
    for scheme in ("video:", "images:", ""):
        with pytest.raises(InvalidValue, match=r"is a ROS bag.*; export its images to a folder"):
            open_camera(f"{scheme}{tmp_path}", CLOCK)
    write_images(tmp_path, 2)
    assert len(drain(open_camera(str(tmp_path), CLOCK))) == 2


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
        assert open_camera(f"images:{path}", CLOCK).size_px == (120, 90)
        for kept in (len(data) // 2, len(data) - 6 if name == "b.png" else len(data) - 1, 300):
            path.write_bytes(data[:kept])
            with pytest.raises(InvalidValue, match=rf"{name} .*is truncated.*remove or replace it"):
                open_camera(f"images:{path}", CLOCK)
    assert capfd.readouterr().err == ""
