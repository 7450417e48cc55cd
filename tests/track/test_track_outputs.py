"""`perchctl track`: its files, its sentences, its end."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from perchctl.commands import app
from perchctl.commands.interrupt import Stopper
from perchctl.commands.track import resolve, track_source
from perchctl.errors import Interrupted, InvalidValue, NotFound, UsageError
from perchctl.profile import load_profile
from perchctl.track.result import CSV_COLUMNS
from tests.helpers.disk import full_disk
from tests.helpers.recording import (
    CALIBRATION,
    VIEWS,
)
from tests.helpers.track import MOVING, track

# --- Files ----------------------------------------------------------------------------


def test_csv_and_overlay_can_be_read(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, film = tmp_path / "out.csv", tmp_path / "out.mp4"
    lines = track(video, csv=table, overlay=film)
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
    capture = cv2.VideoCapture(str(film))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    read = 0
    while (frame := capture.read()[1]) is not None:
        assert frame.shape == (480, 640, 3)
        spread = frame.astype(int).max(axis=2) - frame.astype(int).min(axis=2)
        assert (spread > 60).sum() > 100  # coloured outlines on a grey picture
        read += 1
    assert read == MOVING
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.csv", "out.mp4"]
    summary, prints = capsys.readouterr().err.strip().splitlines()
    assert re.fullmatch(rf"perchctl: {MOVING} frames in .* large 100 %, small \d+ %", summary)
    assert prints.startswith("perchctl: print good within its noise")


class PressingOut(io.StringIO):
    """Presses Ctrl-C while the third line is written."""

    def __init__(self, stopper: Stopper) -> None:
        super().__init__()
        self.stopper = stopper

    def write(self, text: str) -> int:
        written = super().write(text)
        if self.getvalue().count("\n") == 3 and not self.stopper.requested.is_set():
            self.stopper.press()
        return written


def test_ctrl_c_leaves_whole_files(video: Path, tmp_path: Path) -> None:
    stopper = Stopper()
    out = PressingOut(stopper)
    options = resolve(
        str(video), "sim", CALIBRATION, as_json=True,
        csv=tmp_path / "x.csv", overlay=tmp_path / "x.mp4",
    )  # fmt: skip
    with pytest.raises(Interrupted) as caught:
        track_source(options, out, stopper=stopper)
    assert caught.value.exit_code == 130
    assert len(out.getvalue().splitlines()) == 3
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 4
    capture = cv2.VideoCapture(str(tmp_path / "x.mp4"))
    assert sum(1 for _ in iter(lambda: capture.read()[0], False)) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.csv", "x.mp4"]


def test_a_full_disk_is_one_sentence_and_leaves_no_file(video: Path, tmp_path: Path) -> None:
    old = tmp_path / "x.csv"
    old.write_text("old")
    sentence = r"x\.csv cannot be written: .*: free some space"
    with full_disk(room=4_000), pytest.raises(InvalidValue, match=sentence):
        track(video, csv=old, overlay=tmp_path / "x.mp4", force=True)
    assert old.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.csv"]


def test_a_second_ctrl_c_does_not_wait() -> None:
    stopper = Stopper()
    stopper.press()
    with pytest.raises(KeyboardInterrupt):
        stopper.press()


# --- Bad input ------------------------------------------------------------------------


def command(*words: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["track", *words])
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["nowhere.mp4"], 20, "nowhere.mp4 does not exist"),
        (["video:nowhere.mp4"], 20, "nowhere.mp4 was not found"),
        (["images:*.nothing"], 20, "names pictures"),
        (["nonsense"], 20, "nonsense does not exist; a source is a video, picture or folder"),
        (["nonsense:1"], 30, "allowed are camera:N"),
        (["sim:"], 30, "needs a link of sim://; other sources are camera:N"),
        (["PICTURES", "--calibration", "no.yaml"], 20, "no.yaml not found"),
        (["PICTURES", "-p", "nobody"], 20, "profile 'nobody' not found"),
        (["PICTURES", "--csv", "x.txt"], 30, "must end in .csv"),
        (["PICTURES", "--overlay", "x.avi"], 30, "must end in .mp4"),
        (["PICTURES", "--csv", "/dev/null/such/x.csv"], 30, "/dev/null is a file, not a folder"),
        (["PICTURES", "--view-port", "99999"], 2, "65535"),
        (["PICTURES", "--video", "--stills"], 2, "contradict each other"),
        (["camera:0", "--video"], 2, "camera:0 gives a video anyway"),
        (["video:x.mp4", "--video"], 2, "--video is for files of pictures"),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str],
    code: int,
    expected: str,
    pictures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    got, out, err = command(*[str(pictures) if word == "PICTURES" else word for word in words])
    assert got == code
    assert out == ""
    assert expected in err
    if code != 2:
        assert len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_the_source_is_not_overwritten(video: Path) -> None:
    with pytest.raises(UsageError, match="source itself"):
        resolve(str(video), "sim", CALIBRATION, overlay=video)


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(InvalidValue, match=r"a\.png cannot be read as a picture"):
        track(tmp_path)


def test_no_pictures_at_all(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="holds no pictures"):
        track(tmp_path)


def test_the_command_prints_lines_and_a_summary(pictures: Path) -> None:
    code, out, err = command(f"images:{pictures}", "--stills", "--json")
    assert code == 0
    assert len([json.loads(line) for line in out.splitlines()]) == len(VIEWS)
    assert err.startswith(f"perchctl: {len(VIEWS)} frames in")
    assert len(err.strip().splitlines()) == 1
    code, out, err = command(str(pictures / "*.png"))
    assert code == 0
    assert len(out.splitlines()) == len(VIEWS)
    assert "target not seen" in out or "yaw" in out


def test_help_says_what_the_fields_are() -> None:
    _, out, _ = command("--help")
    text = " ".join(out.split())
    for word in ("atan2(R[1,0], R[0,0])", "corners_px", "sigma_yaw_rad", "Kalibr"):
        assert word in text


def test_a_print_error_is_named(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The profile says a small marker 4 % smaller than the one in the picture."""
    profile = load_profile("sim")
    small = profile.target.small.model_copy(update={"side_m": 0.024})
    target = profile.target.model_copy(update={"small": small})
    options = resolve(str(video), "sim", CALIBRATION, as_json=True)
    wrong = options.profile.model_copy(update={"target": target})
    track_source(dataclasses.replace(options, profile=wrong), io.StringIO())
    said = capsys.readouterr().err
    assert "print error: the small marker is 0.16" in said
    assert "make-target measured --measured-large" in said
