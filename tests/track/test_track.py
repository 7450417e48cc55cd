"""`perchctl track`: its results against the truth, the sentences that pictures deserve, its end."""

from __future__ import annotations

import json
import math
import signal
import socket
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perchctl.commands.interrupt import Stopper
from perchctl.commands.track import TrackResult, TrackSummary, poll_until_stopped, text_line
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.geometry import R_MARKER_TARGET, wrap_rad, yaw_of
from perchctl.profile import Profile, TargetConfig, load_profile
from perchctl.sighting import Tracker
from perchctl.vision import Frame, project, square_corners
from tests.helpers.commands import run
from tests.helpers.interlaced import Pass
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
from tests.helpers.target_picture import CAMERA

SCENES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "scenes"
PAL_S = 0.04
FIELDS = 10
MOVING = 24
"""Frames of the video of a moving camera."""
parse = partial(json.loads, parse_constant=pytest.fail)


@dataclass(frozen=True)
class Tracked:
    """One run: its exit code, the objects on stdout, and the sentences on stderr."""

    code: int
    lines: list[dict[str, Any]]
    stderr: str


def track(source: str | Path, *words: str | Path, calibration: Path = CALIBRATION) -> Tracked:
    """`perchctl track SOURCE --json` with these words."""
    given = ("track", source, "--json", "--calibration", calibration, *words)
    said = run(*map(str, given))
    return Tracked(said.code, [parse(line) for line in said.stdout.splitlines()], said.stderr)


def lines(source: str | Path, *words: str | Path, **options: Path) -> list[dict[str, Any]]:
    """Those of a run that ends well."""
    tracked = track(source, *words, **options)
    assert tracked.code == 0, tracked.stderr
    return tracked.lines


def write_opencv(path: Path, size_px: tuple[int, int], K: Any, dist: Any) -> Path:
    """A calibration as OpenCV's FileStorage writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", size_px[0])
    storage.write("image_height", size_px[1])
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(-1, 1))
    storage.release()
    return path


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pictures(tmp_path_factory.mktemp("track") / "pictures")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images = [picture(moving(i), i) for i in range(MOVING)]
    return write_video(tmp_path_factory.mktemp("track") / "moving.mp4", images)


SHAPES = {
    "large": {"corners_px": (4, 2), "rvec_rad": (3,), "tvec_m": (3,), "reprojection_px": ()},
    "target": {
        "rvec_rad": (3,), "tvec_m": (3,), "yaw_rad": (), "sigma_m": (3,), "sigma_yaw_rad": (),
    },
    "pose": {"position_m": (3,), "quaternion_xyzw": (4,), "covariance": (36,)},
}  # fmt: skip
SHAPES["small"] = SHAPES["large"]


def check_schema(line: dict[str, Any]) -> None:
    keys = ["frame", "t_s", "unix_s", "stage", "large", "small", "target", "pose", "note"]
    assert list(line) == keys
    assert line["unix_s"] is None  # of recordings
    seen = {"large": (1, 0), "small": (0, 1), "both": (1, 1), "none": (0, 0)}[line["stage"]]
    assert (line["large"] is not None, line["small"] is not None) == seen
    for name, shapes in SHAPES.items():
        if line[name] is not None:
            values = {key: v for key, v in line[name].items() if not key.endswith("frame_id")}
            assert {key: np.shape(value) for key, value in values.items()} == shapes
            assert all(np.isfinite(value).all() for value in values.values())
    if line["target"] is not None:
        assert min(*line["target"]["sigma_m"], line["target"]["sigma_yaw_rad"]) > 0.0


# --- the truth ------------------------------------------------------------------------


def test_stills_give_one_line_a_picture_and_the_truth(pictures: Path) -> None:
    found_lines = lines(pictures)
    assert [line["frame"] for line in found_lines] == [f"{name}.png" for name in sorted(VIEWS)]
    target = TargetConfig()
    for line in found_lines:
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
                true_px = project(square_corners(side_m), rvec, t, camera())
                assert np.abs(np.array(line[marker]["corners_px"]) - true_px).max() < limit_px


def test_a_video_is_tracked_frame_by_frame(video: Path) -> None:
    tracked = track(f"video:{video}")
    assert [line["frame"] for line in tracked.lines] == list(range(MOVING))
    for i, line in enumerate(tracked.lines):
        check_schema(line)
        assert line["t_s"] == pytest.approx(i / 30.0, abs=1e-3)
        assert np.abs(np.array(line["target"]["tvec_m"]) - true_pose(moving(i))[1]).max() < 0.01
        R = np.asarray(cv2.Rodrigues(np.array(line["target"]["rvec_rad"]))[0], dtype=np.float64)
        assert line["target"]["yaw_rad"] == pytest.approx(yaw_of(R), abs=1e-9)
    assert lines(video) == tracked.lines
    assert "interlaced" not in tracked.stderr


@pytest.mark.parametrize("jump_m", [pytest.param(0.12, marks=pytest.mark.long), 0.3])
def test_a_video_that_lacks_frames_is_followed_on(jump_m: float, tmp_path: Path) -> None:
    """At a constant rate nothing tells that the camera moved by `jump_m` between two frames."""
    approach_m = [0.75 - 0.35 * PAL_S * i for i in range(12)]
    below_m = approach_m + [approach_m[-1] - jump_m] * 18
    views = [(z, 0.02, 0.01 * math.sin(i / 5.0), 0.0, 0.02, 0.3) for i, z in enumerate(below_m)]
    images = [picture(view, i) for i, view in enumerate(views)]
    found = lines(write_video(tmp_path / "gap.mp4", images, rate_hz=1 / PAL_S))
    assert [line["stage"] for line in found] == ["both"] * len(views)
    for line, view in zip(found, views, strict=True):
        check_schema(line)
        if line["target"] is None:
            assert line["note"] != ""
            continue
        off_m = np.abs(np.array(line["target"]["tvec_m"]) - true_pose(view)[1])
        assert (off_m < 0.003 + 3.0 * np.array(line["target"]["sigma_m"])).all()
        assert off_m.max() < jump_m + 0.05
    rejected = [line for line in found if line["note"].startswith("not the tracked target: 0.")]
    assert bool(rejected) is (jump_m > 0.2)
    back = found[len(approach_m) + int(0.5 / PAL_S) :]
    assert all(line["target"] is not None and line["note"] == "" for line in back)
    assert max(line["target"]["sigma_m"][2] for line in back) < 0.01


def test_a_target_that_is_withheld_is_not_called_unseen() -> None:
    seen = tracker(live=False)
    [(frame, output, notes)] = seen.process(Frame(0, 0.0, picture(VIEWS["both"])))
    assert text_line(TrackResult(0, frame, output, None, notes)).endswith("target withheld")
    assert text_line(TrackResult(0, frame)).endswith("target not seen")


def test_each_picture_file_is_measured_alone(pictures: Path) -> None:
    """Filtered as one movement, unrelated pictures would drag each other along."""
    stills = {line["frame"]: line for line in lines(pictures)}
    for source in (f"images:{pictures}", str(pictures / "*.png")):
        assert {line["frame"]: line for line in lines(source)} == stills
    (alone,) = lines(pictures / "near.png")
    assert stills["near.png"] | {"t_s": 0.0} == alone


def test_rendered_scenes_with_exact_truth(tmp_path: Path) -> None:
    if not (SCENES / "truth.json").is_file():
        pytest.skip(f"the rendered scenes are absent ({SCENES})")
    truth = json.loads((SCENES / "truth.json").read_text())
    K, dist = truth["camera_matrix"], truth["dist_coeffs"]
    file = write_opencv(tmp_path / "camera.yml", (640, 480), K, dist)
    found_lines = {line["frame"]: line for line in lines(SCENES / "frames", calibration=file)}
    assert sorted(found_lines) == sorted(Path(f["file"]).name for f in truth["frames"])
    found = {"large": [0, 0], "small": [0, 0]}
    for entry in truth["frames"]:
        line = found_lines[Path(entry["file"]).name]
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


# --- interlaced pictures ----------------------------------------------------------------


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("fields") / "camera.yaml"
    return write_opencv(file, CAMERA.size_px, CAMERA.K, CAMERA.dist)


def recording(folder: Path, *scenes: tuple[Pass, int]) -> Path:
    images = [frame.image for scene, count in scenes for frame in scene.frames(count)]
    return write_video(folder / "flight.avi", images, rate_hz=1 / PAL_S)


def test_the_fields_of_a_video_are_tracked_one_by_one(tmp_path: Path, calibration: Path) -> None:
    scene = Pass(0.3, (0.2, 0.05, 0.0), camera_fields="bottom")
    tracked = track(recording(tmp_path, (scene, FIELDS)), calibration=calibration)
    assert [line["frame"] for line in tracked.lines[-4:]] == [8, 8, 9, 9]
    times = [line["t_s"] for line in tracked.lines[-6:]]
    assert np.diff(times) == pytest.approx(PAL_S / 2, abs=1e-3)
    assert all(line["target"] is not None for line in tracked.lines)
    # The markers go on and on, and not to and fro.
    x = [np.mean(line["small"]["corners_px"], axis=0)[0] for line in tracked.lines[-8:]]
    assert (np.diff(x) < 0).all() or (np.diff(x) > 0).all()
    assert tracked.stderr.count("interlaced") == 2  # as it begins, in the summary


def test_interlaced_stills_have_one_result_each(tmp_path: Path, calibration: Path) -> None:
    scene = Pass(0.3, (0.2, 0.05, 0.0), camera_fields="top")
    truth = {}
    for k, frame in enumerate(scene.frames(3)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), frame.image)
        truth[f"{k}.png"] = scene.target_m(frame.t_s)
    tracked = track(tmp_path, calibration=calibration)
    assert [line["frame"] for line in tracked.lines] == list(truth)
    for line in tracked.lines:
        assert np.abs(np.array(line["target"]["tvec_m"]) - truth[line["frame"]]).max() < 2e-4
    assert "interlaced" in tracked.stderr


# --- pictures that cannot be right ------------------------------------------------------


def test_a_mirrored_picture_is_named_and_can_be_turned(tmp_path: Path) -> None:
    image, turned = picture(VIEWS["both"]), tmp_path / "turned.yaml"
    turned.write_text("extends: sim\ncamera: {mirrored: true}\n")
    cv2.imwrite(str(tmp_path / "m.png"), image[:, ::-1])
    mirrored = track(tmp_path / "m.png")
    assert mirrored.lines[0]["stage"] == "none"
    assert "m.png: the picture is mirrored" in mirrored.stderr
    right = track(tmp_path / "m.png", "-p", turned)
    assert right.lines[0]["stage"] == "both"
    assert "mirrored" not in right.stderr
    cv2.imwrite(str(tmp_path / "m.png"), image)
    assert "remove camera.mirrored" in track(tmp_path / "m.png", "-p", turned).stderr


def test_pictures_that_show_nothing_are_named_and_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    shots = {
        "dark": rng.integers(0, 6, (480, 640)),
        "snow": rng.integers(0, 256, (480, 640)),
        "uniform": np.full((480, 640), 128),
    }
    for name, values in shots.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), values.astype(np.uint8))
    tracked = track(tmp_path)
    assert [line["stage"] for line in tracked.lines] == ["none"] * 3
    for words in ("dark.png: the picture is dark", "snow.png: snow", "uniform.png: a blank"):
        assert words in tracked.stderr
    assert "snow in 1" in tracked.stderr.splitlines()[-1]
    still = track(write_video(tmp_path / "still.mp4", [np.full((480, 640), 90, np.uint8)] * 20))
    assert [line["frame"] for line in still.lines] == list(range(20))
    assert still.stderr.count("the picture is frozen") == 2  # and in the summary


def tracker(profile: Profile | None = None, live: bool = True, stills: bool = False) -> Tracker:
    return Tracker(profile or load_profile("sim"), camera(), live=live, stills=stills)


def test_a_live_picture_that_repeats_is_no_frame_and_then_frozen() -> None:
    image, live = picture(VIEWS["both"]), tracker()
    [(_, first, _)] = live.process(Frame(0, 0.0, image))
    assert first is not None
    assert first.stage.value == "both"
    assert list(live.process(Frame(1, 0.03, image))) == []
    assert [seen[1:] for seen in live.process(Frame(2, 1.0, image))] == [
        (None, ["the picture is frozen"])
    ]
    noise = np.random.default_rng(1).integers(0, 256, (480, 640)).astype(np.uint8)
    [(_, output, notes)] = live.process(Frame(3, 1.1, noise))
    assert output is None
    assert "snow" in notes[0]


def test_markers_that_contradict_are_named() -> None:
    sim = load_profile("sim")
    small = sim.target.small.model_copy(update={"side_m": 0.032})
    target = sim.target.model_copy(update={"small": small})
    doubting = tracker(sim.model_copy(update={"target": target}), live=False, stills=True)
    [(*_, notes)] = doubting.process(Frame(0, 0.0, picture((0.45, 0.0, 0.0, 0.0, 0.0, 0.3))))
    assert [note.partition(":")[0] for note in notes] == ["the two markers contradict each other"]


def test_corners_without_a_pose_are_named() -> None:
    sim = load_profile("sim")
    strict = sim.pose.model_copy(update={"max_reprojection_px": 1e-6})
    seen = tracker(sim.model_copy(update={"pose": strict}), live=False)
    [(_, output, notes)] = seen.process(Frame(0, 0.0, picture(VIEWS["both"])))
    assert output.stage.value == "both"
    assert output.target is None
    assert notes == ["no pose fits the marker's corners"]


def test_a_live_source_is_waited_for_until_it_has_ended(
    capsys: pytest.CaptureFixture[str],
) -> None:
    problems = [None, "silent for 2 s", "the stream has ended"]
    polled = [None, Frame(0, 0.0, picture(VIEWS["away"])), None]
    source: Any = SimpleNamespace(
        finished=False, poll=lambda now_s: polled.pop(0), problem=lambda now_s: problems.pop(0)
    )
    assert [frame.index for frame in poll_until_stopped(source, lambda: 5.0, Stopper())] == [0]
    said = capsys.readouterr().err
    assert said == "perchctl: silent for 2 s; still waiting (Ctrl-C stops)\n"
    assert problems == []


class Lost:
    """A camera of one's own that gives three pictures, and then fails."""

    live, finished, size_px = True, False, None

    def __init__(self, clock: Any, config: Any) -> None:
        self._shown = 0

    def poll(self, now_s: float) -> Frame:
        self._shown += 1
        if self._shown > 3:
            raise OSError("unplugged")
        return Frame(self._shown, float(self._shown), picture(VIEWS["both"], self._shown))

    def problem(self, now_s: float) -> str | None:
        return None

    def describe(self) -> str:
        return "my camera"

    def close(self) -> None:
        pass


def test_a_live_source_that_is_lost_for_good_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("my_camera")
    module.Camera = Lost  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "my_camera", module)
    tracked = track("my_camera:Camera")
    assert tracked.code == ConnectionFailed.exit_code
    *seen, failure = tracked.lines
    assert [line["stage"] for line in seen] == ["both"] * 3
    epoch_s = time.time() - time.monotonic()
    assert [line["unix_s"] - line["t_s"] for line in seen] == pytest.approx([epoch_s] * 3, abs=5.0)
    assert "unplugged" in failure["error"]
    assert "3 frames in" in tracked.stderr


@pytest.mark.parametrize("number", [0, 1])
def test_a_picture_of_another_size_is_named(number: int, tmp_path: Path) -> None:
    for k in range(2):
        size = (320, 240) if k == number else (640, 480)
        cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.resize(picture(VIEWS["both"]), size))
    tracked = track(tmp_path)
    assert tracked.code == InvalidValue.exit_code
    for words in (f"{number}.png", "320x240", "640x480"):
        assert words in tracked.stderr


# --- poses for other programs ---------------------------------------------------------------


def test_each_json_object_is_sent_as_a_datagram(pictures: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10.0)
        words = ["--udp", "localhost:{1}".format(*receiver.getsockname()), "--frame-id", "cf1"]
        said = run("track", str(pictures), "--calibration", str(CALIBRATION), "--json", *words)
        assert said.code == 0, said.stderr
        received = [receiver.recv(65535).decode() for _ in VIEWS]
    assert received == said.stdout.splitlines()
    for line in map(json.loads, received):
        name = line["frame"].removesuffix(".png")
        if name == "away":
            assert line["pose"] is None
            continue
        R, t = true_pose(VIEWS[name])
        assert line["pose"]["position_m"] == pytest.approx(t, abs=0.003)
        found = Rotation.from_quat(line["pose"]["quaternion_xyzw"]).as_matrix()
        assert np.abs(found - R @ R_MARKER_TARGET).max() < 0.03
        assert (line["pose"]["frame_id"], line["pose"]["child_frame_id"]) == ("cf1", "target")


@pytest.mark.parametrize(
    "address", ["", "9870", ":9870", "localhost", "a:0", "a:65536", "a:b", "a/b:9", "u@a:9"]
)
def test_what_is_not_an_address_is_named(address: str, pictures: Path) -> None:
    said = run("track", str(pictures), "--udp", address)
    assert said.code == 30
    assert "--udp takes HOST:PORT, such as 127.0.0.1:9870" in said.complaint


@pytest.mark.parametrize("frame_id", ["", "  ", "\t", "/camera", "/", "target"])
def test_a_frame_that_tf_would_refuse_is_named(frame_id: str, pictures: Path) -> None:
    said = run("track", str(pictures), "--json", "--frame-id", frame_id)
    assert said.code == 30
    (failure,) = map(json.loads, said.stdout.splitlines())
    assert "--frame-id takes the name of a frame in your tf tree" in failure["error"]
    assert failure["error"].endswith(f"found {frame_id!r}")


def test_a_host_without_an_address_is_named(
    pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*place: Any, **kinds: Any) -> Any:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr("perchctl.commands.track.socket.getaddrinfo", fail)
    said = run("track", str(pictures), "--udp", "robot:9870")
    assert said.code == 30
    assert "--udp robot:9870: robot has no address (Name or service not known)" in said.complaint


@pytest.mark.parametrize("host", ["a..b", "a" * 64])
def test_a_text_that_is_no_host_name_is_named(host: str, pictures: Path) -> None:
    said = run("track", str(pictures), "--udp", f"{host}:9870")
    assert said.code == 30
    assert f"{host} has no address (it is not a host name)" in said.complaint


def test_an_address_out_of_reach_is_said_once_and_tracking_goes_on(pictures: Path) -> None:
    # The operating system refuses broadcasts that nobody has permitted.
    said = run(
        "track", str(pictures), "--calibration", str(CALIBRATION), "--udp", "255.255.255.255:9"
    )
    assert said.code == 0
    assert said.stderr.count("nothing can be sent to 255.255.255.255:9: ") == 1
    assert len(said.stdout.splitlines()) == len(VIEWS)


# --- the page, the end, bad input -----------------------------------------------------------


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
        (["images:*.nothing"], 20, "matches pictures"),
        (["nonsense:1"], 30, "camera:N"),
        (["."], 20, "contains no pictures"),
        (["BROKEN"], 30, "cannot be read as a picture"),
        (["PICTURES", "--calibration", "no.yaml"], 20, "no.yaml"),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str],
    code: int,
    expected: str,
    pictures: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    broken = tmp_path_factory.mktemp("broken") / "a.png"
    broken.write_bytes(b"no picture")
    places = {"PICTURES": str(pictures), "BROKEN": str(broken)}
    said = run("track", *(places.get(word, word) for word in words))
    assert (said.code, said.stdout) == (code, "")
    assert expected in said.stderr
    if said.stderr.startswith("perchctl: "):
        assert len(said.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
