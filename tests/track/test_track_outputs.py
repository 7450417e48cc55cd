"""`perchctl track`: its files, its sentences, its end."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands.track import TrackSummary
from perchctl.display import LivePage
from tests.helpers.commands import run
from tests.helpers.live_page import ask
from tests.helpers.track import track


def test_what_was_not_found_is_said(pictures: Path) -> None:
    said = run("track", str(pictures / "away.png"))
    assert "target not seen" in said.stdout
    assert said.complaint.startswith("1 frame in")


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


def test_ctrl_c_leaves_whole_lines(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = TrackSummary.add

    def pressing(self: TrackSummary, *results: Any) -> None:
        count(self, *results)
        if self.frames == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrackSummary, "add", pressing)
    tracked = track(video)
    assert tracked.code == 130
    *lines, failure = tracked.lines
    assert (len(lines), failure["exit_code"]) == (3, 130)


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
