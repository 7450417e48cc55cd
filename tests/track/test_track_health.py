"""`perchctl track`: pictures that cannot be right are named; a live source is waited for."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say
from perchctl.commands.track import frames
from perchctl.profile import load_profile
from perchctl.track import Notes, Tracker, camera_pipeline
from perchctl.vision import Frame
from tests.helpers.recording import (
    VIEWS,
    camera,
    picture,
    write_video,
)
from tests.helpers.track import track


def test_a_mirrored_picture_is_named_and_can_be_turned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = picture(VIEWS["both"])
    cv2.imwrite(str(tmp_path / "m.png"), image[:, ::-1])
    (line,) = track(tmp_path, stills=True)
    said = capsys.readouterr().err
    assert line["stage"] == "none"
    assert "m.png: the picture is mirrored" in said
    assert "set camera.mirrored" in said
    profile = tmp_path / "turned.yaml"
    profile.write_text("extends: sim\ncamera: {mirrored: true}\n")
    (line,) = track(tmp_path, str(profile), stills=True)
    assert line["stage"] == "both"
    assert "is mirrored:" not in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "m.png"), image)
    track(tmp_path, str(profile), stills=True)
    assert "take camera.mirrored out" in capsys.readouterr().err


def test_pictures_that_show_nothing_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(5)
    shots = {
        "dark": rng.integers(0, 6, (480, 640)),
        "snow": rng.integers(0, 256, (480, 640)),
        "uniform": np.full((480, 640), 128),
    }
    for name, values in shots.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), values.astype(np.uint8))
    lines = track(tmp_path, stills=True)
    assert [line["stage"] for line in lines] == ["none"] * 3
    said = capsys.readouterr().err
    assert "dark.png: the picture is dark" in said
    assert "snow.png: snow" in said
    assert "uniform.png: an empty screen" in said
    assert "snow in 1" in said.splitlines()[-1]


def test_a_video_that_stands_still_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_video(tmp_path / "still.mp4", [np.full((480, 640), 90, np.uint8)] * 20)
    frozen = [line["frame"] for line in track(file)]
    said = capsys.readouterr().err
    assert frozen == list(range(20))
    assert len(re.findall("the picture stands still", said)) == 2  # as it begins, in the summary


def tracker(live: bool) -> Tracker:
    return Tracker(camera_pipeline(load_profile("sim"), camera()), live=live)


def test_a_live_picture_that_repeats_is_no_frame_and_then_frozen() -> None:
    image = picture(VIEWS["both"])
    live = tracker(live=True)
    [first] = live.results(Frame(0, 0.0, image), 0)
    assert first.stage == "both"
    assert list(live.results(Frame(1, 0.03, image), 1)) == []
    [frozen] = live.results(Frame(2, 1.0, image), 2)
    assert frozen.stage == "none"
    assert frozen.target is None
    assert live.notes == ("the picture stands still",)


def test_a_live_snow_is_no_measurement() -> None:
    live = tracker(live=True)
    noise = np.random.default_rng(1).integers(0, 256, (480, 640)).astype(np.uint8)
    [seen] = live.results(Frame(0, 0.0, noise), 0)
    assert seen.stage == "none"
    assert "snow" in live.notes[0]


def test_markers_that_contradict_are_named(tmp_path: Path) -> None:
    profile = tmp_path / "wrong.yaml"
    profile.write_text(
        "extends: sim\ntarget: {small: {dictionary: DICT_ARUCO_ORIGINAL, id: 5, side_m: 0.032}}\n"
    )
    doubting = Tracker(
        camera_pipeline(load_profile(str(profile)), camera()), live=False, stills=True
    )
    image = picture((0.45, 0.0, 0.0, 0.0, 0.0, 0.3))
    assert len(list(doubting.results(Frame(0, 0.0, image), 0))) == 1
    assert [note.partition(":")[0] for note in doubting.notes] == ["the two markers contradict"]


class Script:
    """A live source that gives its frames and is then gone."""

    live = True
    finished = False
    size_px = (640, 480)

    def __init__(self, count: int) -> None:
        self.left = count
        self.silent_first = True

    def poll(self, now_s: float) -> Frame | None:
        if self.silent_first or self.left == 0:
            return None
        self.left -= 1
        return Frame(self.left, now_s, np.zeros((480, 640), np.uint8))

    def problem(self, now_s: float) -> str | None:
        if self.left == 0:
            return "the stream has ended"
        if math.isfinite(now_s) and self.silent_first:
            self.silent_first = False
            return "silent for 2 s"
        return None

    def describe(self) -> str:
        return "http://camera"

    def close(self) -> None:
        return None


def test_a_live_source_is_waited_for_and_its_end_is_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = [f.index for f in frames(Script(3), lambda: 5.0, Stopper(), Notes(say))]
    assert seen == [2, 1, 0]
    said = capsys.readouterr().err
    assert said.startswith("perchctl: silent for 2 s; waiting")
    assert said.endswith("perchctl: the stream has ended\n")
