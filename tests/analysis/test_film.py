"""A film of a flight shows what its log and its recording hold."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.analysis import FlightAnalysis, write_film, write_report
from perchctl.analysis.film import LAST_PICTURE_S, side_path_and_target_height
from perchctl.errors import InvalidValue
from perchctl.flight import fly_lockstep
from perchctl.record import LogWatcher, read_log, recorded_pictures
from tests.helpers.commands import run
from tests.helpers.flights import SEED, short_profile

pytestmark = pytest.mark.long

WIDTH_PX = 320


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a flight with its recording."""
    path = tmp_path_factory.mktemp("film") / "flight.jsonl"
    profile = short_profile()
    log = LogWatcher.open_lockstep(path, profile, SEED, record=True)
    flight = fly_lockstep(profile, SEED, log)
    log.close(flight.report, flight.perched_miss_m, flight.fell)
    return path


def pictures_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def test_it_lasts_as_long_as_the_flight_and_shows_the_recorded_pictures(
    flown: Path, tmp_path: Path
) -> None:
    flight = FlightAnalysis(read_log(flown))
    films = []
    for name, recorded in (("with", recorded_pictures(flown)), ("without", None)):
        path = tmp_path / f"{name}.mp4"
        count = write_film(flight, recorded, path, 2.0, WIDTH_PX)
        films.append(pictures_of(path))
        assert (
            len(films[-1])
            == count
            == pytest.approx(2.0 * (flight.log.end_s + LAST_PICTURE_S), abs=2)
        )
        assert films[-1][0].shape == (WIDTH_PX * 9 // 16, WIDTH_PX, 3)
    middle = len(films[0]) // 2
    left = np.s_[30:100, 60:160]  # where the camera's picture is, and else white paper
    seen, paper = (film[middle][left].mean() for film in films)
    assert 30.0 < seen < paper - 10.0
    assert paper > 200.0, "no place is kept for pictures that there are none of"
    # What stands still does not change.
    corner = np.s_[120:, :10]
    assert np.abs(films[0][0][corner].astype(int) - films[0][-1][corner]).max() < 50


def test_film_and_report_tell_how_far_they_are(flown: Path, tmp_path: Path) -> None:
    done: list[tuple[int, int | None]] = []
    film, flight = tmp_path / "film.mp4", FlightAnalysis(read_log(flown))
    count = write_film(flight, None, film, 1.0, WIDTH_PX, lambda *now: done.append(now))
    assert done == [(number, count) for number in range(1, count + 1)]
    done.clear()
    write_report([flown, flown], tmp_path / "a.html", progress=lambda *now: done.append(now))
    assert done == [(1, 2), (2, 2)]
    done.clear()
    write_report([flown], tmp_path / "b.html", True, progress=lambda *now: done.append(now))
    assert done[-1][0] == done[-1][1] == len(done) > 100


def test_the_gear_of_a_vehicle_that_hangs_is_at_the_target(flown: Path) -> None:
    log = read_log(flown)
    place_m, target_z_m = side_path_and_target_height(FlightAnalysis(log))
    gear_m = log.flown_profile.vehicle.gear_body_m[2]
    assert place_m[-1] == pytest.approx((0.0, target_z_m - gear_m), abs=0.03)
    assert place_m[0, 1] == pytest.approx(0.0, abs=0.05)


def test_the_command_makes_a_gif_at_the_flight_s_pace(flown: Path, tmp_path: Path) -> None:
    """A GIF counts in hundredths of a second."""
    out = tmp_path / "flight.gif"
    words = ("log", "film", str(flown), "--rate", "6", "--width", str(WIDTH_PX), "-o")
    assert run(*words, str(out)).code == 0
    lasts_ms = 0.0
    with Image.open(out) as image:
        assert image.size == (WIDTH_PX, WIDTH_PX * 9 // 16)
        for number in range(image.n_frames):
            image.seek(number)
            lasts_ms += image.info["duration"]
    flown_s = read_log(flown).end_s
    assert lasts_ms == pytest.approx(1000.0 * (flown_s + LAST_PICTURE_S), abs=200.0)
    assert run(*words, str(tmp_path / "flight.avi")).code == InvalidValue.exit_code
    assert run(*words, str(out)).code == InvalidValue.exit_code  # it exists


def test_a_bad_recording_costs_the_report_s_film_its_pictures_only(
    flown: Path, tmp_path: Path
) -> None:
    log, page = tmp_path / "flight.jsonl", tmp_path / "page.html"
    log.write_bytes(flown.read_bytes())
    (tmp_path / "flight.mcap").write_bytes(b"no recording")
    assert run("log", "report", str(log), "-o", str(page), "--film").code == 0
    (video,) = re.findall(r'<video controls src="data:video/mp4;base64,([^"]+)"', page.read_text())
    (tmp_path / "film.mp4").write_bytes(base64.b64decode(video))
    assert len(pictures_of(tmp_path / "film.mp4")) > 100
    film = page.read_text().partition("<h3>Film</h3>")[2].partition("</section>")[0]
    assert "flight.mcap" in film.partition("</figure>")[2]
    assert str(tmp_path) not in film
