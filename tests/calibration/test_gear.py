"""`perchctl calibrate --mask`: the vehicle's own gear, learned from pictures that move."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from perchctl.calibration import learn_gear
from perchctl.commands import app
from perchctl.errors import InvalidValue
from tests.helpers.gear import SIZE_PX, legs, turned_about, write_turned_about


def calibrate(*words: str) -> Result:
    return CliRunner().invoke(app, ["calibrate", *words])


def test_what_stays_the_same_is_the_gear() -> None:
    gear = learn_gear(turned_about())
    assert gear.pictures == 24
    inner = cv2.erode(legs().astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outer = cv2.dilate(legs().astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert gear.covered[inner].all()
    assert not gear.covered[~outer].any()
    assert gear.share == pytest.approx(float(legs().mean()), rel=0.8)


def test_what_does_not_reach_the_edge_is_no_gear() -> None:
    spot = legs()
    spot[100:130, 200:230] = True
    assert not learn_gear(turned_about(covered=spot)).covered[110:120, 210:220].any()


@pytest.mark.parametrize(
    ("pictures", "told"),
    [
        (turned_about(5), "5 pictures are too few"),
        (turned_about(contrast=2.0), "hardly change"),
        (turned_about(covered=np.zeros(SIZE_PX[::-1], np.bool_)), "covers nothing"),
        ([*turned_about(3), np.zeros((10, 10), np.uint8)], "belongs to one size"),
    ],
)
def test_pictures_that_do_not_show_it_are_refused(
    pictures: list[np.ndarray[tuple[int, int], np.dtype[np.uint8]]], told: str
) -> None:
    with pytest.raises(InvalidValue, match=told):
        learn_gear(pictures)


def test_the_command_writes_a_mask(tmp_path: Path) -> None:
    write_turned_about(tmp_path / "turned")
    file = tmp_path / "gear.png"
    result = calibrate(f"images:{tmp_path / 'turned'}", "--mask", str(file), "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert set(np.unique(image)) == {0, 255}
    assert image.shape == SIZE_PX[::-1]
    assert told["file"] == str(file)
    assert told["size_px"] == list(SIZE_PX)
    assert told["covered"] == pytest.approx(float((image > 0).mean()), abs=1e-3)
    again = calibrate(f"images:{tmp_path / 'turned'}", "--mask", str(file))
    assert again.exit_code == InvalidValue.exit_code
    assert "--force" in again.stderr
    files = [str(path) for path in (tmp_path / "turned").iterdir()]
    assert calibrate(*files, "--mask", str(file), "--force").exit_code == 0
    assert (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == image).all()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["images:turned", "--mask", "gear.jpg"], 30),
        (["images:turned", "--mask", "gear.png", "--check", "camera.yaml"], 2),
        (["images:turned", "--mask", "gear.png", "-o", "x.yaml"], 2),
        (["--mask", "gear.png", "--convert", "x.yaml"], 2),
        (["--mask", "gear.png"], 2),
        (["images:nothing", "--mask", "gear.png"], 20),
    ],
)
def test_wrong_ways_to_ask_for_a_mask_are_one_sentence(
    words: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_turned_about(tmp_path / "turned")
    result = calibrate(*words)
    assert result.exit_code == code, result.output
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "gear.png").exists()
