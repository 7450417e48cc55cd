"""perchctl as a library, by its public names only, and each example as a user runs it."""

from __future__ import annotations

import itertools
import json
import math
import signal
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import perchctl
from perchctl import (
    CaptureSource,
    Frame,
    FrameSource,
    Phase,
    Severity,
    Sighting,
    Transition,
    VehicleLink,
    VehicleState,
    fly,
    fly_lockstep,
    load_profile,
    open_camera,
    read_log,
    simulate,
    track,
)
from perchctl.errors import (
    ConnectionFailed,
    Interrupted,
    InvalidValue,
    Note,
    NotFound,
    PerchError,
    UsageError,
)
from perchctl.mission import OperatorRequest
from perchctl.perception import perception
from tests.helpers.flights import ordered
from tests.helpers.target_picture import CAMERA, pose_of, render

SIM = load_profile("sim")
MARKER_TARGET = np.diag([1.0, -1.0, -1.0])


def picture(seed: int = 0, noise: float = 2.0) -> tuple[Any, Any]:
    """A tilted view in grey, and the true ``T_cam_target``."""
    rvec, tvec = pose_of(0.05, -0.04, 0.6, math.radians(25), math.radians(6), math.radians(-4))
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = cv2.Rodrigues(rvec)[0] @ MARKER_TARGET, tvec
    return render(rvec, tvec, noise=noise, seed=seed), truth


def errors_of(seen: Sighting, truth: Any) -> Any:
    """Shifts and small turns from the truth, (6,), in the order of a covariance."""
    T = np.array(seen.T_cam_target)
    turn = cv2.Rodrigues(T[:3, :3] @ truth[:3, :3].T)[0].ravel()
    return np.concatenate([T[:3, 3] - truth[:3, 3], turn])


# --- Sightings --------------------------------------------------------


def test_a_pose_is_as_near_to_the_truth_as_its_covariance_says() -> None:
    truth, chi2 = picture()[1], []
    for seen in track((picture(seed)[0] for seed in range(8)), SIM, CAMERA):
        error, cov = errors_of(seen, truth), np.array(seen.covariance)
        assert np.allclose(cov, cov.T)
        chi2.append(error @ np.linalg.solve(cov, error))
        assert np.linalg.norm(error[:3]) < 0.003
        assert seen.markers["large"].corners_px.shape == (4, 2)
        assert 0.0 < seen.markers["small"].sigma_px < 1.0
    assert 0.5 < np.mean(chi2) < 15.0  # of six degrees of freedom


def test_the_covariance_holds_the_print_s_scale_and_the_example_s_calibration_is_named() -> None:
    unsure = SIM.with_({"target.size_sigma": 0.05})
    (seen,) = track([picture()[0]], unsure, CAMERA)
    assert seen.T_cam_target is not None
    assert seen.covariance is not None
    z_m = seen.T_cam_target[2, 3]
    assert seen.covariance[2, 2] ** 0.5 == pytest.approx(0.05 * z_m, rel=0.1)
    with pytest.warns(Note, match="example calibration"):
        track([], SIM)


def test_with_an_attitude_the_pose_is_also_in_the_level_frame() -> None:
    image, truth = picture()
    # At the profile's mounting of zero the camera's axes are the body's: it leans as was drawn.
    attitude = VehicleState(0.0, math.radians(6), math.radians(-4), 1.0)
    T_level_body = np.eye(4)
    T_level_body[:3, :3] = attitude.R_level_body
    level = T_level_body @ SIM.camera.mount.T_body_cam @ truth
    seen = next(track([image], SIM, CAMERA, attitude=lambda t_s: attitude))
    assert seen.T_level_target == pytest.approx(level, abs=0.01)


def test_colour_streams_frames_and_pictures_of_nothing() -> None:
    image, _ = picture()
    (grey,) = track([image], SIM, CAMERA)
    (colour,) = track([cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)], SIM, CAMERA)
    assert np.array_equal(grey.T_cam_target, colour.T_cam_target)  # type: ignore[arg-type]
    stream = list(track([image] * 3, SIM, CAMERA, rate_hz=50.0))
    assert [s.t_s for s in stream] == [0.0, 0.02, 0.04]
    assert [s.index for s in track([Frame(7, 1.0, image)], SIM, CAMERA)] == [7]
    (seen,) = track([np.full_like(image, 120)], SIM, CAMERA)
    assert (seen.T_cam_target, seen.covariance, seen.markers) == (None, None, {})


def test_a_picture_has_no_pose_of_another_one() -> None:
    image, _ = picture()
    blank = np.full_like(image, 120)
    frames = [Frame(0, 0.0, image), Frame(1, 0.0, blank)]
    assert [s.T_cam_target is None for s in track(frames, SIM, CAMERA, rate_hz=30.0)] == [0, 1]


class Camera:
    """A live camera of a user's, with a few pictures."""

    live, finished, size_px = True, False, (640, 480)
    opened: list[Camera]
    is_mute = False

    def __init__(self, clock: Any = time.monotonic, config: Any = None) -> None:
        self.pictures = [picture(seed)[0][:, ::-1] for seed in range(2)]
        self.clock, self.closed, self.count = clock, False, 0
        Camera.opened = [*getattr(Camera, "opened", ()), self]

    def poll(self, now_s: float) -> Frame | None:
        self.count += 1
        if not self.pictures:
            return None
        return Frame(self.count, self.clock(), np.ascontiguousarray(self.pictures.pop(0)))

    def problem(self, now_s: float) -> str | None:
        return None if self.pictures or self.is_mute else "the cable is out"

    def describe(self) -> str:
        return "my camera"

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("by", ["name", "object", "open_camera"])
def test_a_live_camera_is_mirrored_closed_and_said_to_be_lost(
    by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("perchctl.sighting.FRAME_TIMEOUT_S", 0.0)
    mirrored = SIM.with_({"camera.mirrored": True})
    source: Any = f"{__name__}:Camera"
    if by == "object":
        source = Camera()
    elif by == "open_camera":
        source = open_camera(source, config=mirrored.camera)
    found = []
    with pytest.raises(ConnectionFailed, match="the cable is out"):
        found.extend(seen.T_cam_target is not None for seen in track(source, mirrored, CAMERA))
    assert found == [True, True]
    assert Camera.opened[-1].closed == (by == "name")
    mute = Camera()
    mute.is_mute = True
    with pytest.raises(ConnectionFailed, match="my camera: no frame for 0 s"):
        list(track(mute, mirrored, CAMERA))
    given_up = track(f"{__name__}:Camera", mirrored, CAMERA)
    next(given_up)
    given_up.close()  # type: ignore[attr-defined]
    assert Camera.opened[-1].closed


@pytest.mark.parametrize(("image", "words"), [
    (None, "None: cv2.imread"),
    (np.zeros((480, 640)), "uint8.*found float64 of shape"),
    (np.zeros((480, 640, 2), np.uint8), r"found uint8 of shape \(480, 640, 2\)"),
    (np.zeros((0, 640), np.uint8), r"found uint8 of shape \(0, 640\)|640x0"),
    (np.zeros((240, 320), np.uint8), "320x240 px.*640x480"),
    ([[1, 2]], "found list"),
    ("far.png", "found str"),
])  # fmt: skip
def test_what_is_no_picture_is_refused_in_one_sentence(image: Any, words: str) -> None:
    with pytest.raises(InvalidValue, match=words):
        next(track([image], SIM, CAMERA))
    pipeline = perchctl.make_pipeline(SIM, CAMERA)
    with pytest.raises(InvalidValue, match=words):
        perchctl.step(perchctl.PipelineState(), Frame(0, 0.0, image), None, pipeline)


def test_a_source_that_is_none_is_refused(tmp_path: Path) -> None:
    for source in (3, picture()[0], "sim:", tmp_path / "absent.mp4"):
        with pytest.raises(PerchError):
            next(track(source, SIM, CAMERA))  # type: ignore[arg-type]


@pytest.mark.parametrize(("call", "words"), [
    (lambda: track([], 3), "profile must be str or Path or Profile, found int"),
    (lambda: track([], SIM, {}), "calibration must be CameraModel or Path or str, found dict"),
    (lambda: track([], SIM, CAMERA, rate_hz=0.0), "rate_hz must be positive, found 0.0"),
    (lambda: next(track([picture()[0]], SIM, CAMERA, attitude=(0, 0))), "attitude must be"),
    (lambda: next(
        track([picture()[0]], SIM, CAMERA, attitude=VehicleState(0.0, math.nan, 0.0, 0.0))),
     "attitude at 0.0 s is not finite"),
    (lambda: SIM.with_(3), "changes must be Mapping, found int"),
    (lambda: SIM.with_({3: 1}), "a key must be str, found int"),
    (lambda: simulate(SIM, ["a"]), "a seed, or jobs, must be int, found str"),
    (lambda: simulate(SIM, [-1]), "seeds must be at least 0"),
    (lambda: simulate(SIM, [0], 0), "jobs at least 1"),
    (lambda: fly(SIM, 3), "uri must be str, found int"),
    (lambda: fly(SIM, seed=1.5), "seed must be int, found float"),
    (lambda: fly_lockstep(SIM, rows=3), "row 3 must be a Transition"),
])  # fmt: skip
def test_a_wrong_type_is_named_in_one_sentence(call: Any, words: str) -> None:
    with pytest.raises(InvalidValue, match=words):
        call()


# --- The examples, each as a user runs it -----------------------------

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SHORT = str(Path(__file__).with_name("helpers") / "short.yaml")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder as the current one; the examples are found, and have ports of their own."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.chdir(tmp_path)
    for name in ("own_camera", "own_positioning"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            monkeypatch.setattr(import_module(name), "ADDRESS", free.getsockname())
    return tmp_path


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_has_its_line_on_the_page(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 80
    page = (EXAMPLES.parent / "docs" / "python.md").read_text()
    assert f"(../examples/{path.name})" in page


def test_poses_of_a_folder_become_a_table(here: Path) -> None:
    from poses_to_csv import write_poses

    image, truth = picture()
    for name, shown in (("1.png", image), ("2.png", np.full_like(image, 120))):
        cv2.imwrite(str(here / name), shown)
    (here / "camera.yaml").write_text(
        f"image_width: 640\nimage_height: 480\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {CAMERA.K.ravel().tolist()}}}\n"
        f"distortion_model: plumb_bob\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: {CAMERA.dist.tolist()}}}\n"
    )
    assert write_poses("*.png", "camera.yaml", here / "poses.csv") == 1
    lines = (here / "poses.csv").read_text().splitlines()
    assert float(lines[1].split(",")[3]) == pytest.approx(truth[2, 3], abs=0.003)
    assert lines[2].startswith("2.png,,,")
    with pytest.raises(NotFound, match="nothing"):
        open_camera("images:nothing")


@pytest.mark.long
def test_a_row_of_your_own_waits_for_a_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    import own_row

    monkeypatch.setattr(own_row, "WAIT_S", 3.0)
    assert own_row.main(SHORT) == "LANDED: nobody has put the switch on; motors off"

    class Switch:
        off_for = 100  # questions

        def exists(self) -> bool:
            self.off_for -= 1
            return self.off_for < 0

    monkeypatch.setattr(own_row, "WAIT_S", 30.0)
    monkeypatch.setattr(own_row, "SWITCH", Switch())
    stop = ordered({Phase.ASCEND: OperatorRequest.CUT_MOTORS})
    fly_lockstep(load_profile(SHORT), rows=own_row.ROWS, log="waits.jsonl", **stop)
    events = [(each["phase"], each["reason"]) for each in read_log("waits.jsonl").events]
    assert events.count(("ALIGN", "the switch is off")) == 1
    assert "ASCEND" in [phase for phase, _ in events]  # once it is on


def test_an_error_of_a_row_of_your_own_is_in_the_log(here: Path) -> None:
    late = lambda tick: 0 / (tick.t_s < 3.0)  # noqa: E731
    row = Transition("mine", {Phase.APPROACH}, late, Phase.LANDING, "", Severity.LAND)
    with pytest.raises(InvalidValue, match="your own row 'mine' raised ZeroDivisionError"):
        fly_lockstep(load_profile(SHORT), rows=[row], log="fails.jsonl")
    summary = read_log("fails.jsonl").summary
    assert (summary.outcome, "ZeroDivisionError" in summary.reason) == ("failed", True)


@pytest.mark.long
def test_a_study_flies_on_any_executor(here: Path) -> None:
    from parameter_study import plot, study

    (here / "perch.on").touch()
    (here / "own.yaml").write_text(f"extends: {SHORT}\nplanner: {{rows: 'own_row:ROWS'}}\n")
    with ThreadPoolExecutor(2) as executor:
        flights = study("own.yaml", (0.06,), (3,), executor=executor)
    assert list(flights.outcome) == ["perched"]
    plot(flights, "study.png")
    assert (here / "study.png").stat().st_size > 1000


class Darker:
    """A camera around another one."""

    def __init__(self, inner: FrameSource) -> None:
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def poll(self, now_s: float) -> Frame | None:
        frame = self.inner.poll(now_s)
        return frame and Frame(frame.index, frame.t_s, frame.image // 2, frame.t_arrival_s)


def test_a_lockstep_flight_takes_rows_a_camera_and_a_perception() -> None:
    looked: list[int] = []

    def estimator(state: Any, frame: Frame, attitude: Any, pipeline: Any) -> Any:
        looked.append(int(frame.image.max()))
        return perchctl.step(state, frame, attitude, pipeline)

    row = Transition(
        name="looked",
        phases={Phase.APPROACH},
        when=lambda tick: bool(looked),
        to=Phase.LANDING,
        reason="a picture was looked at",
        severity=Severity.LAND,
    )
    flight = fly_lockstep(load_profile(SHORT), rows=[row], camera=Darker, perception=estimator)
    assert flight.report.reason == "a picture was looked at; motors off"
    assert 50 < max(looked) < 128


def test_a_watcher_that_raises_ends_no_simulated_flight() -> None:
    class Breaks:
        problem = None

        def tick(self, tick: Any) -> None:
            raise ZeroDivisionError("of a user's")

        def event(self, event: Any) -> None:
            return

    row = Transition(
        name="soon",
        phases={Phase.APPROACH},
        when=lambda tick: bool(tick.telemetry.position_m[2] > 0.1),
        to=Phase.LANDING,
        reason="high enough",
        severity=Severity.LAND,
    )
    with pytest.warns(Note, match="Breaks raised ZeroDivisionError: of a user's"):
        flight = fly_lockstep(load_profile(SHORT), rows=[row], watchers=(Breaks(),))
    assert flight.report.reason == "high enough; motors off"
    calls = itertools.count()

    def fails(*arguments: Any) -> Any:
        if next(calls) > 50:
            raise RuntimeError("by the camera")
        return perception.step(*arguments)

    with (
        pytest.raises(RuntimeError, match="by the camera"),
        pytest.warns(Note, match="Breaks raised ZeroDivisionError: of a user's"),
    ):
        fly_lockstep(load_profile(SHORT), watchers=(Breaks(),), perception=fails)


def fly_toy(here: Path, on_tick: Any, should_stop: Any, **more: Any) -> Any:
    """Fly `own_link` and `own_camera` in real time."""
    profile, how = load_profile(SHORT), {"on_tick": on_tick, "should_stop": should_stop}
    how |= {"record": False, "log_dir": here, **more}
    with pytest.warns(Note, match="shipped example"):
        return fly(profile, "own_link:Toy", "own_camera:UdpCamera", **how)


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture comes to `own_camera` before each poll."""
    camera = import_module("own_camera")
    image, poll = picture()[0], camera.UdpCamera.poll
    noisy = itertools.cycle(
        [cv2.imencode(".jpg", image + np.uint8(number))[1].tobytes() for number in range(3)]
    )

    def polled(self: Any, now_s: float) -> Frame | None:
        send_datagram(next(noisy), camera.ADDRESS[1])
        frame: Frame | None = poll(self, now_s)
        return frame

    monkeypatch.setattr(camera.UdpCamera, "poll", polled)


def send_datagram(data: bytes, port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data, ("127.0.0.1", port))


@pytest.mark.usefixtures("pictures")
def test_a_link_and_a_camera_of_your_own_fly_in_real_time(here: Path) -> None:
    """Without a radio: a toy that takes off, and lands when it is asked to."""
    heights_m, events = [0.0], list[Any]()
    flight = fly_toy(
        here,
        lambda tick: heights_m.append(tick.telemetry.position_m[2]),
        lambda: heights_m[-1] > 0.15,
        on_event=events.append,
    )
    assert [each.phase for each in events] == [Phase.APPROACH, Phase.LANDING, Phase.LANDED]
    assert flight.report.outcome.value == "operator"
    log = read_log(flight.log)
    assert log.summary.attempts == 0
    assert log.to_pandas().z_m.max() == log.column("z_m").max()
    assert log.column("z_m").max() == pytest.approx(max(heights_m), abs=1e-3)


@pytest.mark.usefixtures("pictures")
@pytest.mark.parametrize("by", [pytest.param("row", marks=pytest.mark.long), "Ctrl-C"])
def test_a_row_of_your_own_and_ctrl_c_land_in_real_time(by: str, here: Path) -> None:
    def press(tick: Any) -> None:
        if by == "Ctrl-C" and tick.state.phase is Phase.APPROACH and is_high(tick):
            signal.raise_signal(signal.SIGINT)

    row = Transition(
        name="high-enough",
        phases={Phase.APPROACH},
        when=lambda tick: by == "row" and is_high(tick),
        to=Phase.LANDING,
        reason="high enough",
        severity=Severity.LAND,
    )
    flight = fly_toy(here, press, lambda: False, rows=[row])
    outcome = flight.report.outcome.value
    assert outcome == ("safety abort" if by == "row" else "operator")
    assert ("high enough" in flight.report.reason) == (by == "row")


@pytest.mark.long
@pytest.mark.usefixtures("pictures")
def test_a_log_that_is_incomplete_is_told(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights_m, lost = [0.0], property(lambda log: "the disk is full")
    monkeypatch.setattr("perchctl.record.LogWatcher.loss_reason", lost)
    with pytest.warns(Note, match="log is incomplete: the disk is full"):
        fly_toy(
            here,
            lambda tick: heights_m.append(tick.telemetry.position_m[2]),
            lambda: heights_m[-1] > 0.1,
        )


def is_high(tick: Any) -> bool:
    return bool(tick.telemetry.position_m[2] > 0.1)


@pytest.mark.usefixtures("pictures")
@pytest.mark.parametrize("failing", ["on_tick", pytest.param("on_event", marks=pytest.mark.long)])
def test_a_callback_that_raises_is_left_out_and_the_flight_goes_on(
    here: Path, failing: str
) -> None:
    calls, ticks, events = list[Any](), list[Any](), list[Any]()

    def fails(what: Any) -> None:
        calls.append(what)
        raise ZeroDivisionError("of a user's")

    how: dict[str, Any] = {"on_tick": ticks.append, "on_event": events.append} | {failing: fails}
    asked = itertools.count()

    def should_stop() -> bool:
        """For some ticks in the air it goes on without the callback that raised."""
        return bool(calls and (ticks or events) and next(asked) > 10)

    with pytest.warns(Note, match=rf"{failing} raised ZeroDivisionError: of a user's \(test_lib"):
        flight = fly_toy(here, should_stop=should_stop, **how)
    assert len(calls) == 1
    assert flight.report.outcome.value == "operator"
    (said,) = [each["reason"] for each in read_log(flight.log).events if each["event"] == "note"]
    assert f"{failing} raised ZeroDivisionError" in said
    assert "the flight continues" in said
    assert events[-1].phase is Phase.LANDED if failing == "on_tick" else ticks[-1].state.phase


@pytest.mark.usefixtures("pictures")
def test_a_callback_that_raised_is_named_if_the_flight_fails(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks, real = list[Any](), perception.step

    def fails(event: Any) -> None:
        raise ZeroDivisionError("of a user's")

    def step(*arguments: Any) -> Any:
        if ticks and is_high(ticks[-1]):
            raise RuntimeError("by the camera")
        return real(*arguments)

    monkeypatch.setattr(perception, "step", step)
    with (
        pytest.raises(RuntimeError, match="by the camera"),
        pytest.warns(Note, match="on_event raised ZeroDivisionError: of a user's"),
    ):
        fly_toy(here, ticks.append, lambda: False, on_event=fails)


@pytest.mark.usefixtures("pictures")
def test_should_stop_that_raises_lands(here: Path) -> None:
    """It may have meant yes."""
    ticks, events = list[Any](), list[Any]()

    def fails() -> bool:
        if ticks and is_high(ticks[-1]):
            raise ZeroDivisionError("of a user's")
        return False

    with pytest.warns(Note, match="should_stop raised ZeroDivisionError: of a user's"):
        flight = fly_toy(here, ticks.append, fails, on_event=events.append)
    assert flight.report.outcome.value == "operator"
    assert any("should_stop raised" in each.reason for each in events)


@pytest.mark.usefixtures("pictures")
def test_an_exit_of_a_callback_lands_the_vehicle_first(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import own_link

    toys: list[Any] = []
    made = own_link.Toy
    monkeypatch.setattr(own_link, "Toy", lambda *given: toys.append(made(*given)) or toys[-1])

    def leaves(tick: Any) -> None:
        if is_high(tick):
            sys.exit("the user's program ends")

    with pytest.raises(Interrupted, match="nothing was started"):
        fly_toy(here, leaves, lambda: True)
    with pytest.raises(SystemExit, match="the user's program ends"):
        fly_toy(here, leaves, lambda: False)
    (log,) = here.glob("*.jsonl")  # only of the flight that began
    assert read_log(log).summary.outcome == "failed"
    assert toys[1]._place[2] < 0.02
    assert not toys[1]._flies
    monkeypatch.setattr(sys.modules["own_camera"].UdpCamera, "live", False)
    with pytest.raises(UsageError, match="not a live camera"):
        fly_toy(here, leaves, lambda: False)


def test_the_examples_are_what_the_protocols_say() -> None:
    from own_link import Toy
    from own_positioning import UdpPoses

    link: VehicleLink = Toy(lambda: 5.0, SIM.link)
    assert link.decks() == ("bcFlow2",)
    source: CaptureSource = UdpPoses(lambda: 5.0, SIM.positioning)
    assert source.poll(5.0) is None
    pose = {"body": "cf", "position_m": [1, 2, 0], "quaternion": [1, 0, 0, 0]}
    send_datagram(json.dumps(pose).encode(), sys.modules["own_positioning"].ADDRESS[1])
    frame = source.poll(5.1)
    assert frame is not None
    assert frame.bodies["cf"].position_m == (1, 2, 0)
    assert source.problem(6.0) == "no pose for 0.9 s"
    source.close()


def test_an_own_link_is_refused_where_it_cannot_fly() -> None:
    with pytest.raises(NotFound, match=r"link\.uri: no module named absent"):
        fly(SIM, "absent:Toy", "camera:0")
    with pytest.raises(UsageError, match="your own link"):
        fly(SIM.with_({"positioning.by": "target"}), "own_link:Toy", "camera:0")


BROKEN = "class Half:\n    def __init__(self, *given): pass\n    live = True\n"


@pytest.mark.parametrize(("text", "module", "words"), [
    ("absent_module:Camera", "", "camera source.*is unknown; allowed are.*my_module:MyCamera"),
    ("mine:Camra", "class Camera: pass", "module mine has no Camra: did you mean Camera"),
    ("mine:Camera", "1 / 0", "importing mine raised ZeroDivisionError"),
    ("mine:Camera", "import absent_module", "importing mine raised ModuleNotFoundError"),
    ("mine.sub:Camera", "", "no module named mine.sub|importing mine.sub raised"),
    ("mine:Half", BROKEN, "mine:Half lacks close, describe, finished, poll, problem, size_px"),
    ("mine:Camera", "class Camera: pass", r"mine:Camera\(clock, CameraConfig\) raised TypeError"),
])  # fmt: skip
def test_what_cannot_be_used_is_named_in_one_sentence(
    text: str, module: str, words: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    (here / "mine.py").write_text(module)
    with pytest.raises(PerchError, match=words):
        next(track(text, SIM, CAMERA))


@pytest.mark.parametrize("found", [
    {"big": np.zeros((4, 2))}, {"large": np.zeros((3, 2))}, {"large": (np.zeros((4, 2)), 0.0)},
])  # fmt: skip
def test_what_cannot_be_corners_is_refused(found: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import own_detector

    image, truth = picture()
    own = SIM.with_({"detector.own": "own_detector:corners"})
    (seen,) = track([image], own, CAMERA)
    assert seen.markers["large"].sigma_px == own_detector.SIGMA_PX
    assert np.abs(errors_of(seen, truth)[:3]).max() < 0.01
    monkeypatch.setattr(own_detector, "corners", lambda image: found)
    with pytest.raises(InvalidValue, match=r"corners of large and small, each \(4, 2\)"):
        next(track([image], own, CAMERA))
