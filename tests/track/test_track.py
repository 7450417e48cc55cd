"""`perchctl track`: its lines against the truth, its files, its sentences, its end."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from perchctl.calibration.files import SizeMissing, load_calibration
from perchctl.cli import app
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say
from perchctl.commands.track import TrackRequest, frames, resolve
from perchctl.commands.track import track as track_source
from perchctl.errors import Interrupted, InvalidValue, NotFound, UsageError
from perchctl.geometry import wrap_rad, yaw_of
from perchctl.profile import TargetConfig, load_profile
from perchctl.track.result import CSV_COLUMNS
from perchctl.track.tracker import Notes, Tracker, camera_pipeline
from perchctl.vision.camera_model import project
from perchctl.vision.pose import square
from perchctl.vision.types import Frame
from tests.helpers.disk import full_disk
from tests.helpers.recording import (
    CALIBRATION,
    STAGE_OF,
    VIEWS,
    camera,
    moving,
    picture,
    true_pose,
    write_pictures,
    write_video,
)

SCENES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "scenes"
MOVING = 24


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pictures(tmp_path_factory.mktemp("track") / "pictures")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images = [picture(moving(i), i) for i in range(MOVING)]
    return write_video(tmp_path_factory.mktemp("track") / "moving.mp4", images)


def track(source: str | Path, profile: str = "sim", **options: Any) -> list[dict[str, Any]]:
    """The JSON lines of one run."""
    out = io.StringIO()
    options.setdefault("calibration", CALIBRATION)
    request = TrackRequest(str(source), profile, as_json=True, **options)
    track_source(resolve(request), out)
    return [json.loads(line, parse_constant=pytest.fail) for line in out.getvalue().splitlines()]


# --- JSON ---------------------------------------------------------------------------


def check_vector(values: Any, length: int) -> None:
    assert isinstance(values, list)
    assert len(values) == length
    assert all(isinstance(v, float) for v in values)


def check_schema(line: dict[str, Any]) -> None:
    assert list(line) == ["frame", "t_s", "stage", "large", "small", "target"]
    assert line["stage"] in ("large", "both", "small", "none")
    seen = {"large": (1, 0), "small": (0, 1), "both": (1, 1), "none": (0, 0)}[line["stage"]]
    assert (line["large"] is not None, line["small"] is not None) == seen
    for name in ("large", "small"):
        if line[name] is None:
            continue
        assert list(line[name]) == ["corners_px", "rvec_rad", "tvec_m", "reprojection_px"]
        assert len(line[name]["corners_px"]) == 4
        for corner in line[name]["corners_px"]:
            check_vector(corner, 2)
        check_vector(line[name]["rvec_rad"], 3)
        check_vector(line[name]["tvec_m"], 3)
        assert 0.0 <= line[name]["reprojection_px"] < 3.0
    if line["target"] is not None:
        keys = ["rvec_rad", "tvec_m", "yaw_rad", "sigma_m", "sigma_yaw_rad"]
        assert list(line["target"]) == keys
        for key in ("rvec_rad", "tvec_m", "sigma_m"):
            check_vector(line["target"][key], 3)
        assert min(line["target"]["sigma_m"]) > 0.0
        assert line["target"]["sigma_yaw_rad"] > 0.0


def test_stills_give_one_line_a_picture_and_the_truth(pictures: Path) -> None:
    lines = track(pictures, stills=True)
    assert [line["frame"] for line in lines] == [f"{name}.png" for name in sorted(VIEWS)]
    target = TargetConfig()
    for line in lines:
        check_schema(line)
        name = line["frame"].removesuffix(".png")
        assert line["stage"] == STAGE_OF[name]
        if name == "away":
            assert line["target"] is None
            continue
        R, t = true_pose(VIEWS[name])
        rvec = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()
        found = line["target"]
        limit_m, limit_px = (0.003, 0.5) if name == "far" else (0.0005, 0.3)
        assert np.abs(np.array(found["tvec_m"]) - t).max() < limit_m
        R_found = np.asarray(cv2.Rodrigues(np.array(found["rvec_rad"]))[0], dtype=np.float64)
        assert found["yaw_rad"] == pytest.approx(yaw_of(R_found), abs=1e-9)
        assert abs(wrap_rad(found["yaw_rad"] - yaw_of(R))) < math.radians(0.2)
        for marker, side_m in (("large", target.large.side_m), ("small", target.small.side_m)):
            if line[marker] is not None:
                true_px = project(square(side_m), rvec, t, camera())
                assert np.abs(np.array(line[marker]["corners_px"]) - true_px).max() < limit_px


def test_with_both_in_sight_the_target_is_the_joint_pose(pictures: Path) -> None:
    (line,) = track(pictures / "both.png", stills=True)
    alone = [line[name]["tvec_m"] for name in ("large", "small")]
    assert line["target"]["tvec_m"] not in alone


def test_with_the_papers_weights_the_target_lies_between_the_markers(pictures: Path) -> None:
    (line,) = track(pictures / "both.png", "paper", stills=True)
    large, small, merged = (np.array(line[name]["tvec_m"]) for name in ("large", "small", "target"))
    weights = load_profile("paper").merge.weights
    w = np.array([weights.x, weights.y, weights.z])
    assert merged == pytest.approx(w * large + (1.0 - w) * small, abs=1e-9)


def test_stills_do_not_know_of_one_another(pictures: Path) -> None:
    whole = {line["frame"]: line for line in track(pictures, stills=True)}
    (alone,) = track(pictures / "near.png", stills=True)
    assert whole["near.png"] | {"t_s": 0.0} == alone


def test_a_video_is_tracked_frame_by_frame(video: Path) -> None:
    lines = track(f"video:{video}")
    assert [line["frame"] for line in lines] == list(range(MOVING))
    for i, line in enumerate(lines):
        check_schema(line)
        assert line["t_s"] == pytest.approx(i / 30.0, abs=1e-3)
        assert np.abs(np.array(line["target"]["tvec_m"]) - true_pose(moving(i))[1]).max() < 0.01
        R = np.asarray(cv2.Rodrigues(np.array(line["target"]["rvec_rad"]))[0], dtype=np.float64)
        assert line["target"]["yaw_rad"] == pytest.approx(yaw_of(R), abs=1e-9)
    assert track(video) == lines


def test_the_filter_bridges_a_lost_frame(tmp_path: Path) -> None:
    images = [picture(moving(i), i) for i in range(8)]
    images[5] = picture(VIEWS["away"])
    for i, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    lost = track(tmp_path, video=True)[5]
    assert lost["stage"] == "none"
    assert lost["large"] is None
    assert np.abs(np.array(lost["target"]["tvec_m"]) - true_pose(moving(5))[1]).max() < 0.02
    assert track(tmp_path)[5]["target"] is None


def test_files_of_pictures_are_stills_unless_the_user_says_otherwise(
    pictures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Filtered as one movement at 30 Hz, unrelated pictures drag each other along."""
    both, far = (true_pose(VIEWS[name])[1] for name in ("both", "far"))
    for source in (str(pictures), f"images:{pictures}", str(pictures / "*.png")):
        away, first, second, _ = track(source)
        assert away["target"] is None
        assert np.abs(np.array(first["target"]["tvec_m"]) - both).max() < 0.0005
        assert np.abs(np.array(second["target"]["tvec_m"]) - far).max() < 0.003
    assert "jumps" not in capsys.readouterr().err
    lines = track(pictures, video=True)
    assert np.abs(np.array(lines[2]["target"]["tvec_m"]) - far).max() > 0.05
    assert [line["t_s"] for line in lines] == pytest.approx([k / 30.0 for k in range(len(VIEWS))])
    said = capsys.readouterr().err
    assert "far.png: the target jumps from one picture to the next" in said
    assert "jumps from one picture to the next in 2" in said.splitlines()[-1]


def test_one_movement_is_no_jump(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track(video)
    assert "jumps" not in capsys.readouterr().err


def test_rendered_scenes_with_exact_truth(tmp_path: Path) -> None:
    if not (SCENES / "truth.json").is_file():
        pytest.skip(f"the rendered scenes are absent ({SCENES})")
    truth = json.loads((SCENES / "truth.json").read_text())
    values = [v for row in truth["camera_matrix"] for v in row]
    file = write_ros(tmp_path, values, truth["dist_coeffs"])
    lines = {
        line["frame"]: line for line in track(SCENES / "frames", stills=True, calibration=file)
    }
    assert sorted(lines) == sorted(Path(f["file"]).name for f in truth["frames"])
    found = {"large": [0, 0], "small": [0, 0]}
    for entry in truth["frames"]:
        line = lines[Path(entry["file"]).name]
        check_schema(line)
        if not entry["target_present"]:
            assert line["stage"] == "none", entry["file"]
            continue
        for name in found:
            if entry[f"{name}_in_view"] and entry["category"] != "occluded":
                found[name][0] += line[name] is not None
                found[name][1] += 1
        if entry["category"] in ("clean", "table1", "table2"):
            error_m = np.array(line["target"]["tvec_m"]) - entry["tvec"]
            assert np.abs(error_m).max() < (0.0005 if entry["tvec"][2] < 0.25 else 0.006)
    assert found["large"][0] >= 0.9 * found["large"][1]
    assert found["small"][0] >= 0.85 * found["small"][1]


# --- Calibration ----------------------------------------------------------------------


def write_ros(folder: Path, K: list[float], dist: list[float]) -> Path:
    path = folder / "ros.yaml"
    path.write_text(
        f"image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(dist)}, data: {dist}}}\n"
    )
    return path


KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.17, 0.04, 0.0004, -0.0007]
  distortion_model: radtan
  intrinsics: [380.0, 380.6, 321.5, 238.2]
  resolution: [640, 480]
  rostopic: /camera/image_raw
"""


@pytest.mark.parametrize("suffix", [".yaml", ".xml"])
def test_the_three_forms_are_one_camera(tmp_path: Path, pictures: Path, suffix: str) -> None:
    dist = [-0.17, 0.04, 0.0004, -0.0007, 0.0]
    K = [380.0, 0.0, 321.5, 0.0, 380.6, 238.2, 0.0, 0.0, 1.0]
    ros, kalibr, opencv = write_ros(tmp_path, K, dist), tmp_path / "k.yaml", tmp_path / f"o{suffix}"
    kalibr.write_text(KALIBR)
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(5, 1))
    storage.release()
    first, *others = (
        track(pictures / "near.png", stills=True, calibration=file)
        for file in (ros, opencv, kalibr)
    )
    assert first[0]["target"] is not None
    for other in others:
        got = np.array(other[0]["target"]["tvec_m"])
        assert got == pytest.approx(np.array(first[0]["target"]["tvec_m"]), abs=1e-9)


def test_kalibrs_equidistant_lens_is_the_fisheye(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    model = load_calibration(path)
    assert model.model == "fisheye"
    assert model.size_px == (640, 480)
    assert model.K[1] == pytest.approx([0.0, 380.6, 238.2])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("radtan", "fov", "'fov' is not supported"),
        ("pinhole", "omni", "'omni' is not supported"),
        ("intrinsics: [380.0, 380.6, 321.5, 238.2]", "intrinsics: [380.0, 1.0]", "fu, fv, pu, pv"),
        ("  resolution: [640, 480]\n", "", "key resolution is missing"),
        ("resolution: [640, 480]", "resolution: 640", "not a number"),
        ("intrinsics: [380.0,", "intrinsics: [wide,", "not a number"),
        ("rostopic: /camera/image_raw\n", "x: 1\ncam1: {}\n", "holds 2 cameras"),
        (KALIBR, "cam0: 3\n", "cam0 must hold keys"),
        ("-0.0007]", "-0.0007, 0.0, 0.0]", "found 6"),
    ],
)
def test_other_camchains_are_refused(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in KALIBR
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.replace(old, new))
    with pytest.raises(InvalidValue, match=expected):
        load_calibration(path)


def test_the_opencv_fisheye_flag_is_heeded(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[380.0, 0, 320], [0, 380.0, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.zeros((4, 1)))
    storage.release()
    assert load_calibration(path).model == "fisheye"


def test_a_missing_size_is_taken_from_the_first_picture_with_a_warning(
    tmp_path: Path, pictures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dist = [-0.17, 0.04, 0.0004, -0.0007, 0.0]
    K = [380.0, 0.0, 321.5, 0.0, 380.6, 238.2, 0.0, 0.0, 1.0]
    whole = write_ros(tmp_path, K, dist)
    known = track(pictures / "near.png", stills=True, calibration=whole)
    assert "image size" not in capsys.readouterr().err
    ros, opencv = tmp_path / "without.yaml", tmp_path / "opencv.yml"
    ros.write_text(whole.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(5, 1))
    storage.release()
    for file in (ros, opencv):
        with pytest.raises(SizeMissing, match="image size is missing: add image_width"):
            load_calibration(file)
        assert track(pictures / "near.png", stills=True, calibration=file) == known
        told = capsys.readouterr().err
        assert "the image size is missing; 640x480 px is taken from the first picture" in told


def test_a_missing_size_is_refused_where_the_centre_is_outside_of_the_picture(
    tmp_path: Path,
) -> None:
    ros = write_ros(tmp_path, [760.0, 0.0, 643.0, 0.0, 761.0, 476.0, 0.0, 0.0, 1.0], [0.0] * 5)
    ros.write_text(ros.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    with pytest.raises(InvalidValue, match="does not fit a 640x480 picture"):
        load_calibration(ros, (640, 480))


def test_another_size_is_refused_before_anything_is_tracked(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = cv2.resize(picture(VIEWS["both"]), (320, 240))
    cv2.imwrite(str(tmp_path / "0.png"), half)
    with pytest.raises(InvalidValue, match=r"0\.png.*320x240.*640x480"):
        track(tmp_path, csv=tmp_path / "x.csv", overlay=tmp_path / "x.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["0.png"]
    assert capsys.readouterr().out == ""


def test_one_picture_of_another_size_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture(VIEWS["both"]))
    cv2.imwrite(str(tmp_path / "b.png"), np.full((100, 200), 90, np.uint8))
    with pytest.raises(InvalidValue, match=r"b\.png.*200x100.*640x480"):
        track(tmp_path, csv=tmp_path / "x.csv")
    assert not list(tmp_path.glob("*.csv")) + list(tmp_path.glob(".*"))


# --- Health ---------------------------------------------------------------------------


def test_a_mirrored_picture_is_named_and_can_be_turned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = picture(VIEWS["both"])
    cv2.imwrite(str(tmp_path / "m.png"), image[:, ::-1])
    (line,) = track(tmp_path, stills=True)
    said = capsys.readouterr().err
    assert line["stage"] == "none"
    assert "m.png: the picture is mirrored" in said
    profile = tmp_path / "turned.yaml"
    profile.write_text("extends: sim\ncamera: {mirrored: true}\n")
    (line,) = track(tmp_path, str(profile), stills=True)
    assert line["stage"] == "both"
    assert "is mirrored:" not in capsys.readouterr().err


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
    assert "http://camera delivers no frame; waiting" in said
    assert said.endswith("perchctl: the stream has ended\n")


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
        TrackRequest(
            str(video), "sim", CALIBRATION, as_json=True,
            csv=tmp_path / "x.csv", overlay=tmp_path / "x.mp4",
        )
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
        resolve(TrackRequest(str(video), "sim", CALIBRATION, overlay=video))


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
    options = resolve(TrackRequest(str(video), "sim", CALIBRATION, as_json=True))
    wrong = options.profile.model_copy(update={"target": target})
    track_source(dataclasses.replace(options, profile=wrong), io.StringIO())
    said = capsys.readouterr().err
    assert "print error: the small marker is 0.16" in said
    assert "make-target --measured-large" in said
