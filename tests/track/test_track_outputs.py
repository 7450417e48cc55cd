"""`perchctl track`: its files, its sentences, its end."""

from __future__ import annotations

import csv
import json
import re
import signal
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from perchctl.commands.track import TrackSummary
from perchctl.commands.track_output import CSV_COLUMNS, overlay_file
from perchctl.display import LivePage, Sketch
from perchctl.vision import CameraModel
from tests.helpers.commands import run
from tests.helpers.disk import full_disk
from tests.helpers.live_page import ask
from tests.helpers.track import MOVING, track


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_csv_and_overlay_can_be_read(video: Path, tmp_path: Path) -> None:
    table, film = tmp_path / "out.csv", tmp_path / "out.mp4"
    tracked = track(video, "--csv", table, "--overlay", film)
    lines = tracked.lines
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert CSV_COLUMNS[0] == "t_s"
    assert tuple(rows[0]) == CSV_COLUMNS
    assert [float(row["t_s"]) for row in rows] == [line["t_s"] for line in lines]
    last = lines[-1]
    assert [float(rows[-1][f"{a}_m"]) for a in "xyz"] == last["target"]["tvec_m"]
    assert float(rows[-1]["sigma_yaw_rad"]) == last["target"]["sigma_yaw_rad"]
    assert float(rows[-1]["large_tl_x_px"]) == last["large"]["corners_px"][0][0]
    assert float(rows[-1]["small_bl_y_px"]) == last["small"]["corners_px"][3][1]
    assert float(rows[-1]["small_rx_rad"]) == last["small"]["rvec_rad"][0]
    capture = cv2.VideoCapture(str(film))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    read = 0
    while (frame := capture.read()[1]) is not None:
        assert frame.shape == (480, 640, 3)
        spread = frame.astype(int).max(axis=2) - frame.astype(int).min(axis=2)
        assert (spread > 60).sum() > 100  # coloured outlines on a grey picture
        read += 1
    assert read == MOVING
    assert names(tmp_path) == ["out.csv", "out.mp4"]
    _calibration, summary, *wrote = tracked.stderr.strip().splitlines()
    assert wrote == [f"perchctl: wrote {table}", f"perchctl: wrote {film}"]
    assert re.fullmatch(rf"perchctl: {MOVING} frames in .* large 100 %, small \d+ %", summary)


def test_what_was_not_found_is_empty_in_the_table(pictures: Path, tmp_path: Path) -> None:
    said = run("track", str(pictures / "away.png"))
    assert "target not seen" in said.stdout
    assert said.complaint.startswith("1 frame in")
    track(pictures / "away.png", "--csv", tmp_path / "out.csv")
    with (tmp_path / "out.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    given = {name: value for name, value in row.items() if value}
    assert given == {"t_s": "0.0", "frame": "away.png", "stage": "none"}


def test_the_live_page_has_the_newest_numbers(
    pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = []
    tell = LivePage.set_state

    def asked(self: LivePage, *describe: Any) -> None:
        tell(self, *describe)
        states.append(json.loads(ask(self.url, "/state")[1]))

    monkeypatch.setattr(LivePage, "set_state", asked)
    tracked = track(pictures, "--view")
    assert [state["track"] for state in states] == tracked.lines
    assert [dict(state["rows"])["markers"] for state in states] == [
        line["stage"] for line in tracked.lines
    ]
    assert {state["stop"] for state in states} == {"none"}
    assert "live page: http://127.0.0.1" in tracked.stderr
    assert "failed" not in tracked.stderr


def test_ctrl_c_leaves_whole_files(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = TrackSummary.add

    def pressing(self: TrackSummary, *results: Any) -> None:
        count(self, *results)
        if self.frames == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrackSummary, "add", pressing)
    tracked = track(video, "--csv", tmp_path / "x.csv", "--overlay", tmp_path / "x.mp4")
    assert tracked.code == 130
    *lines, failure = tracked.lines
    assert (len(lines), failure["exit_code"]) == (3, 130)
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 4
    capture = cv2.VideoCapture(str(tmp_path / "x.mp4"))
    assert sum(1 for _ in iter(lambda: capture.read()[0], False)) == 3
    assert names(tmp_path) == ["x.csv", "x.mp4"]


def test_a_full_disk_is_one_sentence_and_leaves_no_file(video: Path, tmp_path: Path) -> None:
    old = tmp_path / "x.csv"
    old.write_text("old")
    with full_disk(room=4_000):
        tracked = track(video, "--csv", old, "--overlay", tmp_path / "x.mp4", "--force")
    assert tracked.code == 30
    assert "x.csv cannot be written" in tracked.stderr
    assert old.read_text() == "old"
    assert names(tmp_path) == ["x.csv"]


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["nowhere.mp4"], 20, "nowhere.mp4 does not exist"),
        (["video:nowhere.mp4"], 20, "nowhere.mp4 was not found"),
        (["images:*.nothing"], 20, "names pictures"),
        (["nonsense"], 20, "nonsense does not exist"),
        (["nonsense:1"], 30, "camera:N"),
        (["sim:"], 30, "camera:N"),
        (["."], 20, "holds no pictures"),
        (["BROKEN"], 30, "a.png cannot be read"),
        (["PICTURES", "--calibration", "no.yaml"], 20, "no.yaml"),
        (["PICTURES", "-p", "nobody"], 20, "'nobody'"),
        (["PICTURES", "--csv", "x.txt"], 30, "must end in .csv"),
        (["PICTURES", "--overlay", "x.avi"], 30, "must end in .mp4"),
        (["PICTURES", "--csv", "/dev/null/such/x.csv"], 30, "not a folder"),
        (["PICTURES", "--view-port", "99999"], 2, "65535"),
        (["VIDEO", "--overlay", "VIDEO"], 2, "source itself"),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str],
    code: int,
    expected: str,
    pictures: Path,
    video: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    broken = tmp_path_factory.mktemp("broken") / "a.png"
    broken.write_bytes(b"no picture")
    places = {"PICTURES": str(pictures), "VIDEO": str(video), "BROKEN": str(broken)}
    said = run("track", *(places.get(word, word) for word in words))
    assert (said.code, said.stdout) == (code, "")
    assert expected in said.stderr
    if said.stderr.startswith("perchctl: "):
        assert len(said.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


# --- the video ------------------------------------------------------------------------


def lens(width: int, height: int) -> CameraModel:
    return CameraModel(
        (width, height), np.array([[200.0, 0, width / 2], [0, 200.0, height / 2], [0, 0, 1]]),
        np.zeros(5),
    )  # fmt: skip


def filmed(path: Path, times: list[float], size_px: tuple[int, int] = (64, 48)) -> Path:
    """A film of grey pictures at these times, each lighter than the one before it."""
    with overlay_file(path, lens(*size_px), 25.0) as add:
        for k, t_s in enumerate(times):
            add(t_s, Sketch(np.full(size_px[::-1], 30 + 30 * k, np.uint8)))
    return path


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
    starts, lights, lasts_s = shown(filmed(tmp_path / "x.mp4", times))
    assert starts == pytest.approx(np.subtract(times, times[0]), abs=1e-4)
    assert lights == pytest.approx([30 + 30 * k for k in range(len(times))], abs=3)
    assert lasts_s == pytest.approx(times[-1] - times[0] + 1 / 25.0, abs=0.001)
    starts, _, _ = shown(filmed(tmp_path / "y.mp4", [1.0, 1.1, 1.1, 0.4, 1.2]))
    assert starts == pytest.approx([0.0, 0.1, 0.1, 0.1, 0.2], abs=1e-3)  # no picture is lost


@pytest.mark.parametrize("frames", [0, 1])
def test_it_may_be_short_and_its_index_stands_in_front(tmp_path: Path, frames: int) -> None:
    """An odd size is made even; a browser plays it while it is still being fetched."""
    path = filmed(tmp_path / "x.mp4", [0.0] * frames, (65, 49))
    assert names(tmp_path) == ["x.mp4"]
    if frames:
        with av.open(str(path)) as video:
            (frame,) = video.decode(video=0)
        assert (frame.width, frame.height) == (66, 50)
        data = path.read_bytes()
        assert 0 < data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize("room", [0, 100_000])
def test_a_full_disk_leaves_no_video(video: Path, tmp_path: Path, room: int) -> None:
    with full_disk(room):
        tracked = track(video, "--overlay", tmp_path / "x.mp4")
    assert tracked.code == 30
    assert "x.mp4 cannot be written: File too" in tracked.stderr
    assert not list(tmp_path.iterdir())
