"""A film of a fleet puts the flights together on one clock and into one room."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from perchctl.analysis import write_fleet_film
from perchctl.analysis.film import film_period, write_pictures
from perchctl.analysis.fleet_film import COLOURS
from perchctl.fleet import read_fleet_folder
from perchctl.record import read_log
from tests.helpers import log as synthetic
from tests.helpers.commands import run

WIDTH_PX = 320


def plan(name: str, **more: Any) -> dict[str, Any]:
    place = {"home_m": [1.0, 2.0], "target_m": [1.2, 2.0], "radius_m": 0.5, "heading_deg": 90.0}
    return {"name": name, "uri": "radio://0/80/2M/E7E7E7E701", "frame": "home"} | place | more


def end(name: str, **more: Any) -> dict[str, Any]:
    how = {"hangs": True, "outcome": "perched", "miss_m": 0.002, "reason": "hanging still"}
    return {"name": name, "log": f"flight_{name}.jsonl", "ended_s": 60.0, "pace": None} | how | more


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a fleet's flight: north, and later east, whose time ran at half pace."""
    for name in ("north", "east"):
        synthetic.write(tmp_path / f"flight_{name}.jsonl", summary=synthetic.SUMMARY)
    record = {
        "vehicles": [end("north"), end("east", ended_s=90.0, pace={"ratio": 0.5})],
        "plan": {"vehicles": [plan("north"), plan("east", frame="room")]},
    }
    (tmp_path / "fleet.json").write_text(json.dumps(record), encoding="utf-8")
    return tmp_path


def test_each_flight_has_its_time_and_place(folder: Path) -> None:
    found = read_fleet_folder(folder)
    assert found is not None
    north, east = found.filmed()
    log = read_log(folder / "flight_north.jsonl")
    assert (north.end_s, east.end_s) == pytest.approx((60.0, 90.0))
    assert north.begin_s == pytest.approx(60.0 - log.end_s)
    assert east.begin_s == pytest.approx(90.0 - 2.0 * log.end_s)
    assert north.index_at(0.0) == 0
    assert east.index_at(90.0) == len(log.records) - 1
    x_m, y_m = log.column("x_m"), log.column("y_m")
    assert np.allclose(east.path_m(), np.column_stack([x_m, y_m]))
    assert np.allclose(north.path_m(), np.column_stack([1.0 - y_m, 2.0 + x_m])), "turned by 90 deg"


def test_the_command_makes_one_film_of_all(folder: Path) -> None:
    words = ("log", "film", str(folder), "--rate", "1", "--width", str(WIDTH_PX))
    done = run(*words)
    assert done.code == 0, done.stderr
    path = folder / "fleet.mp4"
    assert done.stdout.split() == ["film:", str(path)]
    with av.open(str(path)) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    north, east = read_fleet_folder(folder).filmed()  # type: ignore[union-attr]
    begin_s, end_s = min(north.begin_s, east.begin_s), max(north.end_s, east.end_s)
    assert len(pictures) == pytest.approx(end_s - begin_s + 2.0, abs=1.5)
    assert pictures[0].shape == (WIDTH_PX * 9 // 16, WIDTH_PX, 3)
    assert run(*words).code == 30, "it exists"


def test_a_film_of_a_fleet_tells_how_far_it_is(folder: Path) -> None:
    filmed = read_fleet_folder(folder).filmed()  # type: ignore[union-attr]
    done: list[tuple[int, int | None]] = []
    path = folder / "film.mp4"
    count = write_fleet_film(filmed, path, 0.5, WIDTH_PX, lambda *now: done.append(now))
    assert done == [(number, count) for number in range(1, count + 1)]


def test_a_folder_that_cannot_be_filmed_is_refused_in_a_sentence(folder: Path) -> None:
    path = folder / "fleet.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    for vehicles in ([], [{"name": "north"}], [plan("north", home_m=[1.0])], None):
        path.write_text(json.dumps(record | {"plan": {"vehicles": vehicles}}), encoding="utf-8")
        refused = run("log", "film", str(folder))
        assert refused.code == 30
        assert refused.complaint.startswith("fleet.json does not record where each vehicle flew")
    path.write_text(json.dumps({"vehicles": [end("west", log=None)]}), encoding="utf-8")
    refused = run("log", "film", str(folder))
    assert (refused.code, "has left a log" in refused.complaint) == (20, True)


def test_a_gif_keeps_the_colour_of_each_vehicle(tmp_path: Path) -> None:
    """The third one's was that of the first."""
    shown = np.array([[[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in COLOURS]], np.uint8)
    write_pictures(iter([shown.repeat(8, 0).repeat(8, 1)]), tmp_path / "film.gif", film_period(6.0))
    with Image.open(tmp_path / "film.gif") as image:
        kept = np.asarray(image.convert("RGB"))[4, 4::8]
    np.testing.assert_allclose(kept, shown[0], atol=4)  # the palette is that of these colours
