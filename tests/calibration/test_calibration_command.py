"""`perchctl calibrate` from pictures: refusals, files, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import Result

from perchctl.calibration import load_calibration
from perchctl.calibration.board.adjust import lens_parameters
from perchctl.target import Board
from perchctl.vision import CameraModel
from tests.helpers.boards import CHARUCO, draw_camera, render_folder
from tests.helpers.calibrating import calibrate, refused
from tests.helpers.gear import SIZE_PX, write_turned_about
from tests.helpers.report_page import Page

pytestmark = pytest.mark.long


BOARD = CHARUCO.notation()


Rendered = tuple[Path, CameraModel]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    """A folder of ten pictures of a ChArUco board, and the camera that took them."""
    camera = draw_camera(np.random.default_rng(5), (480, 360))
    folder = tmp_path_factory.mktemp("board")
    render_folder(folder, camera, CHARUCO, 10, seed=5)
    return folder, camera


@pytest.fixture(scope="module")
def calibrated(rendered: Rendered, tmp_path_factory: pytest.TempPathFactory) -> Result:
    output = tmp_path_factory.mktemp("out") / "camera.yaml"
    result = calibrate(f"images:{rendered[0]}", "-b", BOARD, "-o", str(output), "--json")
    assert result.exit_code == 0, result.output
    return result


def test_pictures_become_a_file(calibrated: Result, rendered: Rendered) -> None:
    told = json.loads(calibrated.stdout)
    truth = rendered[1]
    camera = load_calibration(Path(told["file"]))
    assert [told["fx"], told["fy"]] == [camera.K[0, 0], camera.K[1, 1]]
    assert (told["model"], told["size_px"]) == ("plumb_bob", [480, 360])
    error = np.abs(lens_parameters(camera) - lens_parameters(truth))
    assert (error < 3.5 * np.array(list(told["std"].values()))).all()
    assert error[:2].max() < 0.5
    assert told["views_used"] == 10
    assert told["views_rejected"] == []
    assert all(0 < e["axis_mm95"] <= e["mm95"] for e in told["error_mm"])
    assert told["verdict"] == "fly"
    assert "GOOD TO FLY" in calibrated.stderr
    report = Path(told["file"]).with_suffix(".html")
    assert told["report"] == str(report)
    assert "GOOD TO FLY" in Page(report.read_text()).words


def test_new_pictures_pass_the_check_and_another_camera_s_fail(
    calibrated: Result, rendered: Rendered, tmp_path: Path
) -> None:
    file = Path(json.loads(calibrated.stdout)["file"])
    render_folder(tmp_path / "new", rendered[1], CHARUCO, 10, seed=6)
    source = f"images:{tmp_path / 'new'}"
    passed = calibrate("check", str(file), source, "-b", BOARD, "--json")
    assert passed.exit_code == 0
    assert json.loads(passed.stdout)["pass"] is True
    raw = yaml.safe_load(file.read_text())
    data = raw["camera_matrix"]["data"]
    data[0], data[4] = 1.01 * data[0], 1.01 * data[4]
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(yaml.safe_dump(raw))
    failed = calibrate("check", str(wrong), source, "-b", BOARD, "--json")
    assert failed.exit_code == 1
    told = json.loads(failed.stdout)
    assert told["pass"] is False
    assert max(e["mm"] for e in told["error_mm"]) > 5
    other = tmp_path / "other.yaml"
    other.write_text(file.read_text().replace("image_width: 480", "image_width: 481"))
    assert "calibrat" in refused(calibrate("check", str(other), source, "-b", BOARD), 30)
    for key in ("image_width", "image_height"):
        del raw[key]
    other.write_text(yaml.safe_dump(raw))
    assert "image size is missing" in refused(calibrate("check", str(other), source), 30)


def test_a_calibration_is_not_judged_by_its_own_pictures(
    calibrated: Result, rendered: Rendered, tmp_path: Path
) -> None:
    """Under whatever name; the board is the calibration's if none is named."""
    file = Path(json.loads(calibrated.stdout)["file"])
    for i, path in enumerate(sorted(rendered[0].iterdir())):
        cv2.imwrite(f"{tmp_path}/copy_{i}.png", np.asarray(cv2.imread(str(path), 0)))
    said = calibrate("check", file, f"images:{tmp_path}")
    assert said.exit_code == 30
    assert f"the board is {BOARD} (from the calibration)" in said.stderr
    assert "10 of 10 views are from images that the calibration was made from" in said.stderr
    render_folder(tmp_path, rendered[1], CHARUCO, 8, seed=6)
    passed = calibrate("check", file, f"images:{tmp_path}")
    assert passed.exit_code == 0, passed.output
    assert "left out copy_3.png: the calibration was made from this image" in passed.stderr


def test_a_board_in_the_older_layout_is_calibrated_and_stored(tmp_path: Path) -> None:
    board = Board.parse("charuco:8x6:30mm:22mm:DICT_4X4_50:legacy")
    camera = draw_camera(np.random.default_rng(5), (480, 360))
    render_folder(tmp_path / "board", camera, board, 6, seed=5)
    named = board.notation().removesuffix(":legacy")
    file = tmp_path / "camera.yaml"
    result = calibrate(f"images:{tmp_path / 'board'}", "-b", named, "-o", file)
    assert result.exit_code == 0, result.output
    assert "the board has the layout used before OpenCV 4.6" in result.stderr
    assert yaml.safe_load(file.read_text())["board"] == board.notation()
    error = np.abs(lens_parameters(load_calibration(file)) - lens_parameters(camera))
    assert error[:4].max() < 2.0
    own = calibrate("check", file, f"images:{tmp_path / 'board'}")
    assert f"the board is {board.notation()} (from the calibration)" in own.stderr
    assert "6 of 6 views" in own.stderr


def test_broken_pictures_are_left_out_and_named(rendered: Rendered, tmp_path: Path) -> None:
    words = (f"images:{tmp_path}", "-b", BOARD, "-o", str(tmp_path / "o.yaml"))
    whole = (rendered[0] / "board_00.png").read_bytes()
    (tmp_path / "board_99.png").write_bytes(b"no picture")
    unread = "board_99.png: cannot be read as a picture"
    refused(calibrate(*words), 30, "none of 1 images", unread)
    for path in sorted(rendered[0].iterdir())[:6]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "board_02b.png").write_bytes(whole[: len(whole) // 2])
    left = calibrate(*words, "--json")
    assert left.exit_code == 0, left.output
    assert "left out board_02b.png: is truncated" in left.stderr
    told = json.loads(left.stdout)
    assert told["views_used"] == 6
    named = [picture["name"] for picture in told["pictures_without_board"]]
    assert named == ["board_02b.png", "board_99.png"]


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["images:{board}", "-o", "mine.yaml"], 30, ["mine.yaml already exists", "--force"]),
        (["images:{board}", "-o", "reported.yaml"], 30, ["reported.html already exists"]),
        (["{board}/board_0[01].png"], 30, ["only 2 images", "add 3"]),
        (["images:sizes"], 30, ["3 of 4 images are 480x360", "board_02.png is 480x300 px"]),
        (["{one}", "-b", "chessboard:9x6:25mm"], 30, ["none of 1 images"]),
    ],
)
def test_pictures_that_will_not_do_are_refused(
    rendered: Rendered,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    code: int,
    expected: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text("mine")
    Path("reported.html").write_text("mine")
    Path("sizes").mkdir()
    files = sorted(rendered[0].iterdir())
    for i, path in enumerate(files[:4] if "images:sizes" in words else []):
        picture = cv2.imread(str(path))
        cv2.imwrite(f"sizes/{path.name}", picture[: 300 if i == 2 else 360])
    places = {"board": rendered[0], "one": files[0]}
    given = ["-b", BOARD, "-o", "o.yaml", *(word.format(**places) for word in words)]
    refused(calibrate(*given), code, *(part.format(**places) for part in expected))
    assert Path("mine.yaml").read_text() == Path("reported.html").read_text() == "mine"
    assert not Path("reported.yaml").exists()
    assert not Path("o.yaml").exists()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([], 2),
        (["images:/nowhere"], 20),
        (["images:.", "-b", "chess:9x6"], 30),
        (["images:.", "--view"], 2),
        (["images:.", "--size", "640x480"], 2),
        (["check", "no.yaml", "images:."], 20),
        (["convert", "no.yaml"], 20),
        (["mask", "images:turned", "-o", "gear.jpg"], 30),
        (["mask", "images:nothing"], 20),
    ],
)
def test_wrong_usage_writes_nothing(
    words: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = calibrate(*words)
    assert result.exit_code == code, result.output
    assert not result.stdout
    assert not list(tmp_path.iterdir())


def test_convert(tmp_path: Path) -> None:
    kalibr = tmp_path / "camchain.yaml"
    kalibr.write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.01, 0.02, -0.01, 0.002]\n"
        "  intrinsics: [300.5, 301.5, 320.25, 240.75]\n  resolution: [640, 480]\n"
    )
    output = tmp_path / "camera.yaml"
    assert calibrate("convert", kalibr, "-o", output).exit_code == 0
    camera = load_calibration(output)
    assert camera.model == "fisheye"
    assert camera.dist.tolist() == [0.01, 0.02, -0.01, 0.002]
    refused(calibrate("convert", kalibr, "-o", output), 30, "--force")


def test_a_mask(tmp_path: Path) -> None:
    write_turned_about(tmp_path / "turned")
    words = ("mask", f"images:{tmp_path / 'turned'}", "-o", tmp_path / "gear.png")
    result = calibrate(*words)
    assert result.exit_code == 0, result.output
    image = cv2.imread(str(tmp_path / "gear.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert set(np.unique(image)) == {0, 255}
    assert image.shape == SIZE_PX[::-1]
    assert f"covers {100 * (image > 0).mean():.1f} %" in result.stderr
    refused(calibrate(*words), 30, "--force")
