"""`perchctl track`: its files, its sentences, its end."""

from __future__ import annotations

import csv
import json
import re
import signal
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands.track import TrackSummary
from perchctl.commands.track_output import CSV_COLUMNS
from perchctl.display import LivePage
from tests.helpers.commands import run
from tests.helpers.disk import full_disk
from tests.helpers.live_page import ask
from tests.helpers.track import MOVING, track


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_table_can_be_read(video: Path, tmp_path: Path) -> None:
    table = tmp_path / "out.csv"
    tracked = track(video, "--csv", table)
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
    assert names(tmp_path) == ["out.csv"]
    _calibration, summary, *wrote = tracked.stderr.strip().splitlines()
    assert wrote == [f"perchctl: wrote {table}"]
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
    tracked = track(video, "--csv", tmp_path / "x.csv")
    assert tracked.code == 130
    *lines, failure = tracked.lines
    assert (len(lines), failure["exit_code"]) == (3, 130)
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 4
    assert names(tmp_path) == ["x.csv"]


def test_a_full_disk_is_one_sentence_and_leaves_no_file(video: Path, tmp_path: Path) -> None:
    old = tmp_path / "x.csv"
    old.write_text("old")
    with full_disk(room=2_000):
        tracked = track(video, "--csv", old, "--force")
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
        (["PICTURES", "--csv", "/dev/null/such/x.csv"], 30, "not a folder"),
        (["PICTURES", "--view-port", "99999"], 2, "65535"),
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
