"""`perchctl calibrate`: sources, refusals, files, exit codes."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from perchctl.calibration.files import load_calibration
from perchctl.calibration.guided import Moment, capture
from perchctl.calibration.lens import parameters_of
from perchctl.calibration.novelty import Capture, Signature, consider, hint, progress, signature
from perchctl.calibration.types import View
from perchctl.cli import app
from perchctl.commands.calibrate_live import captured_views, coverage_bars, page_state
from perchctl.display.page.live import LivePage
from perchctl.display.page.sketch import Sketch
from perchctl.errors import TimedOut
from perchctl.vision.types import CameraModel, Frame
from tests.helpers.boards import (
    APRILGRID,
    CHARUCO,
    CHESSBOARD,
    BoardRenderer,
    corner_view,
    draw_camera,
    draw_poses,
    render_folder,
)

pytestmark = pytest.mark.long

BOARD = CHARUCO.notation()
Rendered = tuple[Path, CameraModel]


def calibrate(*words: str) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, words)])


def refused(result: Result, code: int) -> str:
    """The one sentence of a refusal."""
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if not line.endswith("of the board")]
    assert len(lines) == 1, result.stderr
    assert not result.stdout
    return lines[0]


@pytest.fixture(scope="module")
def calibrated(rendered: Rendered, tmp_path_factory: pytest.TempPathFactory) -> Result:
    output = tmp_path_factory.mktemp("out") / "camera.yaml"
    result = calibrate(f"images:{rendered[0]}", "-b", BOARD, "-o", str(output), "--json")
    assert result.exit_code == 0, result.output
    return result


def test_pictures_become_a_file_and_a_report(calibrated: Result, rendered: Rendered) -> None:
    told = json.loads(calibrated.stdout)
    truth = rendered[1]
    camera = load_calibration(Path(told["file"]))
    assert [told["fx"], told["fy"]] == [camera.K[0, 0], camera.K[1, 1]]
    assert told["distortion"] == camera.dist.tolist()
    assert (told["model"], told["size_px"]) == ("plumb_bob", [480, 360])
    error = np.abs(parameters_of(camera) - parameters_of(truth))
    assert (error < 3.5 * np.array(list(told["std"].values()))).all()
    assert error[:2].max() < 0.5
    assert told["views_used"] == 10
    assert told["views_rejected"] == []
    assert all(e["mm95"] > 0 and e["axis_mm95"] > 0 for e in told["error_mm"])
    assert (told["error_mm"][0]["z_m"], told["error_mm"][-1]["z_m"]) == (0.05, 1.5)
    assert told["verdict"] == "fly"
    report = cv2.imread(told["report"])
    assert report is not None
    assert min(report.shape[:2]) > 800
    assert "GOOD TO FLY" in calibrated.stderr


def test_ctrl_c_in_the_drawing_leaves_the_calibration(
    rendered: Rendered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is on the disk by then; only its picture is given up."""
    output = tmp_path / "camera.yaml"

    def draw(_result: object) -> bytes:
        assert load_calibration(output).size_px == (480, 360)
        raise KeyboardInterrupt

    monkeypatch.setattr("perchctl.calibration.plot.draw_calibration", draw)
    result = calibrate(f"images:{rendered[0]}", "-b", BOARD, "-o", str(output), "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["report"] is None
    assert "the plot is not drawn" in result.stderr


def test_the_same_pictures_pass_the_check_and_another_camera_s_fail(
    calibrated: Result, rendered: Rendered, tmp_path: Path
) -> None:
    file = Path(json.loads(calibrated.stdout)["file"])
    source = f"images:{rendered[0]}"
    passed = calibrate(source, "-b", BOARD, "--check", str(file), "--json")
    assert passed.exit_code == 0
    assert json.loads(passed.stdout)["pass"] is True
    raw = yaml.safe_load(file.read_text())
    data = raw["camera_matrix"]["data"]
    data[0], data[4] = 1.01 * data[0], 1.01 * data[4]
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(yaml.safe_dump(raw))
    failed = calibrate(source, "-b", BOARD, "--check", str(wrong), "--json")
    assert failed.exit_code == 1
    told = json.loads(failed.stdout)
    assert told["pass"] is False
    assert max(e["mm"] for e in told["error_mm"]) > 5
    other = tmp_path / "other.yaml"
    other.write_text(file.read_text().replace("image_width: 480", "image_width: 481"))
    assert "calibrat" in refused(calibrate(source, "-b", BOARD, "--check", str(other)), 30)
    for key in ("image_width", "image_height"):
        del raw[key]
    other.write_text(yaml.safe_dump(raw))
    unsized = calibrate(source, "-b", BOARD, "--check", str(other))
    assert unsized.exit_code == 1
    assert "image size is missing; " in unsized.stderr


def test_an_existing_file_needs_force(rendered: Rendered, tmp_path: Path) -> None:
    output = tmp_path / "camera.yaml"
    output.write_text("mine")
    result = calibrate(f"images:{rendered[0]}", "-b", BOARD, "-o", str(output))
    assert "--force" in refused(result, 30)
    assert output.read_text() == "mine"


def test_broken_pictures_are_all_named_and_left_out_when_asked(
    rendered: Rendered, tmp_path: Path
) -> None:
    words = (f"images:{tmp_path}", "-b", BOARD, "-o", str(tmp_path / "o.yaml"))
    for path in sorted(rendered[0].iterdir())[:6]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    whole = (tmp_path / "board_00.png").read_bytes()
    (tmp_path / "board_99.png").write_bytes(b"no picture")
    (tmp_path / "board_02b.png").write_bytes(whole[: len(whole) // 2])
    sentence = refused(calibrate(*words), 30)
    assert "2 of 8 pictures cannot be used" in sentence
    assert "board_99.png cannot be read as a picture" in sentence
    assert "board_02b.png is cut off" in sentence
    assert "--skip-broken" in sentence
    assert not (tmp_path / "o.yaml").exists()
    left = calibrate(*words, "--skip-broken", "--json")
    assert left.exit_code == 0, left.output
    assert "left out board_02b.png: is cut off" in left.stderr
    told = json.loads(left.stdout)
    assert told["views_used"] == 6
    named = [picture["name"] for picture in told["pictures_without_board"]]
    assert named == ["board_02b.png", "board_99.png"]


def test_only_broken_pictures_are_refused_in_any_case(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    result = calibrate(f"images:{tmp_path}", "-o", f"{tmp_path}/o.yaml", "--skip-broken")
    assert "none of the 1 pictures can be used: a.png cannot be read" in refused(result, 30)


def test_pictures_of_two_sizes(rendered: Rendered, tmp_path: Path) -> None:
    for i, path in enumerate(sorted(rendered[0].iterdir())[:4]):
        picture = cv2.imread(str(path))
        cv2.imwrite(str(tmp_path / path.name), picture[: 300 if i == 2 else 360])
    sentence = refused(
        calibrate(f"images:{tmp_path}", "-b", BOARD, "-o", str(tmp_path / "o.yaml")), 30
    )
    assert "480x300" in sentence
    assert "480x360" in sentence


@pytest.mark.parametrize(
    ("board", "hint"),
    [
        ("charuco:8x6:25mm:18mm:DICT_5X5_100", "10x7 squares"),
        ("charuco:10x6:25mm:18mm:DICT_5X5_100", "charuco:10x7:25mm:18mm:DICT_5X5_100"),
        ("charuco:10x7:25mm:18mm:DICT_6X6_100", "DICT_5X5_100"),
        ("chessboard:9x6:25mm", "charuco"),
    ],
)
def test_the_wrong_board_says_what_was_seen(
    rendered: Rendered, tmp_path: Path, board: str, hint: str
) -> None:
    result = calibrate(f"images:{rendered[0]}", "-b", board, "-o", str(tmp_path / "o.yaml"))
    assert hint in refused(result, 30)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def april_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CameraModel]:
    camera = draw_camera(np.random.default_rng(8), (480, 360))
    folder = tmp_path_factory.mktemp("april")
    render_folder(folder, camera, APRILGRID, 8, seed=8)
    return folder, camera


def test_an_aprilgrid_by_kalibr_s_own_file(april_folder: Rendered, tmp_path: Path) -> None:
    folder, truth = april_folder
    board = tmp_path / "april_6x6.yaml"
    board.write_text(
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.022\ntagSpacing: 0.3\n"
    )
    output = tmp_path / "camera.yaml"
    result = calibrate(f"images:{folder}", "-b", str(board), "-o", str(output), "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    error = np.abs(parameters_of(load_calibration(output)) - parameters_of(truth))
    assert (error < 3.5 * np.array(list(told["std"].values()))).all()
    assert error[:2].max() < 0.7
    assert told["views_used"] == 8
    assert told["rms_px"] < 0.12
    assert yaml.safe_load(output.read_text())["board"] == APRILGRID.notation()


@pytest.mark.parametrize(
    ("board", "hint"),
    [
        ("aprilgrid:5x6:22mm:0.3", "an aprilgrid of 6 columns and 6 or more rows"),
        ("aprilgrid:7x6:22mm:0.3", "an aprilgrid of 6 columns and 6 or more rows"),
        ("aprilgrid:6x4:22mm:0.3", "larger board than aprilgrid:6x4:22mm:0.3: use --board "
         "aprilgrid:6x6:22mm:0.3"),
        (BOARD, "they show AprilTags"),
        ("chessboard:9x6:25mm", "they show AprilTags"),
    ],
)  # fmt: skip
def test_the_wrong_board_for_an_aprilgrid_says_what_was_seen(
    april_folder: Rendered, tmp_path: Path, board: str, hint: str
) -> None:
    pictures = f"{april_folder[0]}/board_0[0123].png"
    assert hint in refused(calibrate(pictures, "-b", board, "-o", f"{tmp_path}/o.yaml"), 30)


def test_an_aprilgrid_named_for_another_board_says_what_was_seen(
    rendered: Rendered, tmp_path: Path
) -> None:
    pictures = f"{rendered[0]}/board_0[0123].png"
    said = refused(calibrate(pictures, "-b", "aprilgrid", "-o", f"{tmp_path}/o.yaml"), 30)
    assert "is it a charuco board?" in said


def test_a_print_is_measured_along_both_sides(rendered: Rendered, tmp_path: Path) -> None:
    output = tmp_path / "o.yaml"
    words = (f"images:{rendered[0]}", "-b", BOARD, "-o", str(output))
    said = refused(calibrate(*words, "--measured-width", "249.5"), 2)
    assert "--measured-width and --measured-height go together" in said
    said = refused(calibrate(*words, "--measured-width", "24.9", "--measured-height", "17.4"), 30)
    assert "measure its black area, in mm" in said
    result = calibrate(*words, "--measured-width", "245.8", "--measured-height", "17.41cm")
    assert result.exit_code == 0, result.output
    assert "width: 245.8 mm, -1.68 % against 250 mm" in result.stderr
    assert "was the page scaled" in result.stderr
    assert "height: 174.1 mm, -0.51 % against 175 mm" in result.stderr
    board = yaml.safe_load(output.read_text())["board"]
    assert board == f"{BOARD}:measured=245.8x174.1mm"


@pytest.mark.parametrize("named", ["chessboard:8x6:25mm", "chessboard:11x8:25mm"])
def test_the_wrong_chessboard_says_what_was_seen(
    chessboard_folder: Path, tmp_path: Path, named: str
) -> None:
    result = calibrate(
        f"{chessboard_folder}/left0[13].jpg", "-b", named, "-o", f"{tmp_path}/o.yaml"
    )
    assert "chessboard:9x6:25mm" in refused(result, 30)


def test_no_board_at_all(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((120, 160), 90, np.uint8))
    result = calibrate(f"images:{tmp_path}", "-o", str(tmp_path / "o.yaml"))
    assert "none of 1 pictures" in refused(result, 30)


def test_two_views_only(rendered: Rendered, tmp_path: Path) -> None:
    pattern = f"{rendered[0]}/board_0[01].png"
    sentence = refused(calibrate(pattern, "-b", BOARD, "-o", str(tmp_path / "o.yaml")), 30)
    assert "only 2 pictures" in sentence
    assert "add 3" in sentence


def test_pictures_named_one_by_one_are_the_folder_s(
    calibrated: Result, rendered: Rendered, tmp_path: Path
) -> None:
    """As a shell hands over board*.png; one of them named twice is one picture."""
    words = [str(p) for p in sorted(rendered[0].iterdir())]
    result = calibrate(*words, words[3], "-b", BOARD, "-o", f"{tmp_path}/o.yaml", "--json")
    assert result.exit_code == 0, result.output
    told, folder = json.loads(result.stdout), json.loads(calibrated.stdout)
    assert {k: told[k] for k in ("fx", "views_used", "rms_px")} == {
        k: folder[k] for k in ("fx", "views_used", "rms_px")
    }


def test_many_sources_must_all_be_pictures(rendered: Rendered, tmp_path: Path) -> None:
    one, two = (f"{rendered[0]}/board_0{k}.png" for k in (0, 1))
    output = ("-o", f"{tmp_path}/o.yaml")
    assert "does not exist" in refused(calibrate(one, f"{tmp_path}/no.png", *output), 20)
    for other in (str(rendered[0]), "camera:0"):
        said = refused(calibrate(one, two, other, *output), 20 if ":" in other else 2)
        assert other in said
    said = refused(calibrate(one, two, "-b", "chessboard:9x6:25mm", *output), 30)
    assert "none of 2 pictures of" in said
    assert "and 1 more shows" in said


def test_usage() -> None:
    refused(calibrate(), 2)
    refused(calibrate("camera:0", "--convert", "x.yaml"), 2)
    refused(calibrate("images:/nowhere"), 20)
    sides = ("--measured-width", "249", "--measured-height", "174")
    assert "look for none" in refused(calibrate("--convert", "x.yaml", *sides), 2)
    assert "look for none" in refused(calibrate("images:.", "--mask", "x.png", *sides), 2)
    refused(calibrate("images:.", "-b", "chess:9x6"), 30)
    refused(calibrate("images:.", "--model", "cubic"), 30)


def test_convert(tmp_path: Path) -> None:
    kalibr = tmp_path / "camchain.yaml"
    kalibr.write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.01, 0.02, -0.01, 0.002]\n"
        "  intrinsics: [300.5, 301.5, 320.25, 240.75]\n  resolution: [640, 480]\n"
    )
    output = tmp_path / "new" / "camera.yaml"
    result = calibrate("--convert", str(kalibr), "-o", str(output), "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["fx"] == 300.5
    camera = load_calibration(output)
    assert camera.model == "fisheye"
    assert camera.dist.tolist() == [0.01, 0.02, -0.01, 0.002]
    assert "--force" in refused(calibrate("--convert", str(kalibr), "-o", str(output)), 30)


def test_a_video_s_sharp_and_different_frames(tmp_path: Path) -> None:
    camera = draw_camera(np.random.default_rng(3), (320, 240))
    rng = np.random.default_rng(7)
    renderer = BoardRenderer(camera, CHESSBOARD)
    video = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 30, (320, 240))
    for pose in draw_poses(rng, camera, CHESSBOARD, 9):
        sharp = renderer.render(pose, rng, noise=1.5)
        smeared = cv2.blur(sharp, (9, 9))
        for k in range(8):
            writer.write(cv2.cvtColor(sharp if k in (3, 4) else smeared, cv2.COLOR_GRAY2BGR))
    writer.release()
    result = calibrate(
        str(video), "-b", CHESSBOARD.notation(), "-o", f"{tmp_path}/c.yaml", "--json"
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert 7 <= told["views_used"] <= 9
    assert told["fx"] == pytest.approx(camera.K[0, 0], abs=4 * told["std"]["fx"] + 0.5)


class _Frames:
    """A live source that shows prepared pictures, one at a time."""

    live, finished, size_px = True, False, (320, 240)

    def __init__(self, images: list[np.ndarray]) -> None:  # type: ignore[type-arg]
        self._frames = [Frame(i, float(i), image) for i, image in enumerate(images)]

    def poll(self, now_s: float) -> Frame | None:
        return self._frames.pop(0) if self._frames else None

    def problem(self, now_s: float) -> str | None:
        return None if self._frames else "the camera is unplugged"

    def describe(self) -> str:
        return "test"

    def close(self) -> None:
        pass


class _Ended(_Frames):
    """A stream that is over with its last picture."""

    @property
    def finished(self) -> bool:  # type: ignore[override]
        return not self._frames


def _clock() -> Callable[[], float]:
    ticks = iter(range(10**9))
    return lambda: float(next(ticks))


def test_guided_capture_takes_still_new_sharp_views_and_ends() -> None:
    camera = draw_camera(np.random.default_rng(3), (320, 240))
    rng = np.random.default_rng(2)
    renderer = BoardRenderer(camera, CHESSBOARD)
    images = []
    for pose in draw_poses(rng, camera, CHESSBOARD, 7):
        image = renderer.render(pose, rng, noise=1.0)
        images += [image, image, image]  # comes in, is still, stays
    moments: list[Moment] = []
    views = capture(_Frames(images), CHESSBOARD, moments.append, _clock(), lambda s: None)
    assert 5 <= len(views) <= 7
    assert sum(m.shot for m in moments) == len(views)
    assert [len(m.views) for m in moments] == [m.taken for m in moments]
    shots = [m.index for m in moments if m.shot]
    assert all(i % 3 == 1 for i in shots)  # at once when still, and once each
    assert moments[0].advice == "hold still"
    assert 0 < moments[-1].covered["x"] <= 1
    with pytest.raises(TimedOut, match="only 1 views"):
        capture(_Frames(images[:3]), CHESSBOARD, moments.append, _clock(), lambda s: None)


FOLLOWED = {
    "move the board to the left rim": {"x": 0.1},
    "move the board to the right rim": {"x": 0.9},
    "move the board to the top rim": {"y": 0.1},
    "move the board to the bottom rim": {"y": 0.9},
    "come nearer": {"size": 0.95},
    "go farther away": {"size": 0.1},
    "tilt the board's right side away": {"tilt_x": 0.3},
    "tilt the board's left side away": {"tilt_x": -0.3},
    "tilt the board's lower side away": {"tilt_y": 0.3},
    "tilt the board's upper side away": {"tilt_y": -0.3},
}
"""What is to be done, and how a view shows that it was."""


def test_one_advice_at_a_time_leads_to_the_end() -> None:
    """Whoever does what is said, and nothing else, covers everything in a few views."""
    rng = np.random.default_rng(1)
    given: set[str] = set()
    for _ in range(12):
        x, y, size, tilt_x, tilt_y = rng.uniform(
            (0.1, 0.1, 0.2, -0.3, -0.3), (0.9, 0.9, 0.9, 0.3, 0.3)
        )
        shown = [Signature(x, y, size, tilt_x, tilt_y)]
        while (advice := hint(shown)) != "show the board somewhere new":
            assert advice in FOLLOWED, advice
            before = min(progress(shown).values())
            shown.append(dataclasses.replace(shown[-1], **FOLLOWED[advice]))
            given.add(advice)
            assert min(progress(shown).values()) >= before
            assert len(shown) < 12
    assert given == set(FOLLOWED)


def test_a_board_s_farther_side_is_known() -> None:
    rng = np.random.default_rng(4)
    camera = draw_camera(rng)
    for about, name in ((1, "tilt_x"), (0, "tilt_y")):
        for sign in (-1.0, 1.0):
            rvec = np.zeros(3)
            rvec[about] = 0.5 * sign * (-1.0 if about == 1 else 1.0)
            pose = np.concatenate([rvec, [-0.1, -0.1, 0.5]])
            corners = CHARUCO.corners_m() @ cv2.Rodrigues(rvec)[0].T
            assert (corners[:, 2] @ corners[:, 1 - about] > 0) == (sign > 0)
            view = corner_view(rng, camera, CHARUCO, pose, 0.0, "v")
            assert sign * getattr(signature(view, CHARUCO), name) > 0.1


def test_live_pictures_are_kept_as_they_come_also_of_a_camera_that_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = draw_camera(np.random.default_rng(3), (320, 240))
    rng = np.random.default_rng(2)
    renderer = BoardRenderer(camera, CHESSBOARD)
    images = []
    for pose in draw_poses(rng, camera, CHESSBOARD, 2):
        images += [renderer.render(pose, rng, noise=1.0)] * 2
    folder = tmp_path / "calib" / "pictures"
    for names in (["view_001.png", "view_002.png"], ["view_003.png", "view_004.png"]):
        with pytest.raises(TimedOut, match="only 2 views"):
            captured_views(_Ended(list(images)), CHESSBOARD, folder, None)
        assert f"kept 2 pictures: images:{folder} takes them again" in capsys.readouterr().err
        kept = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in names]
        assert (kept[0] == images[0]).all()
        assert (kept[1] == images[2]).all()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(TimedOut, match="only 2 views"):  # a full disk is no reason to end
        captured_views(_Ended(list(images)), CHESSBOARD, tmp_path / "file" / "p", None)
    assert capsys.readouterr().err.count("no longer kept") == 1


def test_a_live_camera_is_refused_before_anybody_has_worked_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    output = tmp_path / "calib" / "camera_64x48.yaml"
    output.parent.mkdir()
    output.write_text("mine")
    with contextlib.closing(LivePage(draw_camera(np.random.default_rng(0)), "camera")) as page:
        page.show(0, Sketch(np.zeros((48, 64), np.uint8)))
        url = page.url.replace("/?", "/stream?")
        sentence = refused(calibrate(url), 30)
        assert "camera_64x48.yaml exists already; add --force" in sentence
        assert "is a file" in refused(calibrate(url, "--keep-pictures", str(output)), 30)
    assert output.read_text() == "mine"


def test_guided_capture_refuses_blur_and_repetition_and_stops_when_covered() -> None:
    rng = np.random.default_rng(4)
    camera = draw_camera(rng)
    state = Capture()
    poses = draw_poses(rng, camera, CHARUCO, 60)
    views = [corner_view(rng, camera, CHARUCO, pose, 0.05, "v") for pose in poses]
    shown = 0
    for view in views:
        if state.finished:
            break
        state = consider(consider(state, view, CHARUCO), view, CHARUCO)
        shown += 1
    assert state.finished
    assert 15 <= len(state.taken) <= shown <= 40
    again = consider(state, state.taken[-1], CHARUCO)
    assert not again.shot
    blurred = View(*(getattr(views[-1], n) for n in ("name", "size_px", "ids", "object_m")),
                   views[-1].corners_px, 8.0)  # fmt: skip
    before = consider(Capture(), blurred, CHARUCO)
    assert "blurred" in consider(before, blurred, CHARUCO).advice


def test_the_page_s_bars_are_shares_and_no_characters() -> None:
    image = np.zeros((4, 4), np.uint8)
    covered = {"x": 0.5, "y": 0.0, "size": 1.0, "tilt": 0.25}
    state = page_state(Moment(0, image, np.empty((0, 2)), covered, 3, "hold still", False), None)
    assert state["phase"] == "hold still"
    *bars, views = state["rows"]
    assert [(name, share) for name, _, share in bars] == list(covered.items())
    assert [text for _, text, _ in bars] == ["50 %", "0 %", "100 %", "25 %"]
    assert views == ["views", "3"]


def test_bars_in_a_pipe_are_one_line_a_view(capsys: pytest.CaptureFixture[str]) -> None:
    with coverage_bars() as show:
        for taken in (0, 0, 1):
            show({"x": 0.5, "tilt": 0.0}, taken, "hold still")
    assert capsys.readouterr().err.splitlines() == [
        "perchctl: 0 views; x 50 %, tilt 0 %",
        "perchctl: 1 views; x 50 %, tilt 0 %",
    ]
