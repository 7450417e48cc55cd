"""The live page of a flight and of `track --view`."""

from __future__ import annotations

import io
import json
import re
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.commands.fly import live_page
from perchctl.commands.track import resolve, track_source
from perchctl.display import FlightPage, LivePage, Sketch
from perchctl.flight import FlyOptions, OperatorSwitch
from perchctl.flight.operator import AGAIN_S, HELD_S
from perchctl.mission import Operator, Phase, PlannerState, Tick
from perchctl.profile import load_profile
from perchctl.vehicle import Idle
from perchctl.vision import Detection, Detections, Frame, MarkerPose, PipelineOutput, Stage
from tests.helpers.live_page import CORNERS, ask, stop
from tests.helpers.log import telemetry
from tests.helpers.mission import note
from tests.helpers.recording import CALIBRATION, VIEWS, camera, picture, write_pictures

# --- fly --view ------------------------------------------------------------------------------


def tick(t_s: float, output: PipelineOutput | None = None) -> Tick:
    state = PlannerState(phase=Phase.ALIGN, entered_s=1.0, reason="pose is steady")
    return Tick(t_s, telemetry(t_s, 0.6), output, None, state, Idle(), 0.0, 0.01, 0.012)


def seen_in(frame: Frame) -> PipelineOutput:
    large = Detection("large", CORNERS, 0.1, True)
    pose = MarkerPose(
        "large", frame.t_s, np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 0.3]),
        np.zeros(3), 0.0, np.ones(3), 1.0, 0.1,
    )  # fmt: skip
    detections = Detections(frame.index, frame.t_s, large=large)
    return PipelineOutput(detections, {"large": pose}, None, Stage.LARGE)


class OneFrame:
    live = True
    finished = False
    size_px = (640, 480)

    def __init__(self, frame: Frame) -> None:
        self.frame: Frame | None = frame

    def poll(self, now_s: float) -> Frame | None:
        frame, self.frame = self.frame, None
        return frame

    def problem(self, now_s: float) -> str | None:
        return "silent"

    def describe(self) -> str:
        return "one frame"

    def close(self) -> None:
        self.frame = None


OPTIONS = FlyOptions(load_profile("sim"), Path("sim.yaml"), "sim://", "sim:")


def test_stop_is_one_ctrl_c_and_never_two(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = [100.0]
    switch = OperatorSwitch(listening=True, clock=lambda: now_s[0])
    with live_page(OPTIONS, 0, switch) as flight:
        assert flight is not None
        assert flight.page.url in capsys.readouterr().err
        assert switch.read() is Operator.NONE
        assert stop(flight.page.url, "guess") == 403
        assert switch.read() is Operator.NONE
        for _ in range(2):
            assert stop(flight.page.url, flight.page.token) == 200
            assert switch.read() is Operator.LAND
        switch.press()
        assert switch.read() is Operator.LAND  # the first Ctrl-C repeats STOP
        now_s[0] += AGAIN_S
        switch.press()
        now_s[0] += HELD_S
        assert switch.read() is Operator.STOP


def test_without_view_no_page_is_opened(capsys: pytest.CaptureFixture[str]) -> None:
    with live_page(OPTIONS, None, OperatorSwitch()) as flight:
        assert flight is None
    assert capsys.readouterr().err == ""


def test_a_flight_is_shown_with_phase_battery_and_picture(page: LivePage) -> None:
    flight = FlightPage(page, 0.15)
    frame = Frame(7, 1.0, np.full((480, 640), 90, np.uint8))
    source = flight.watched(OneFrame(frame))
    assert json.loads(ask(page.url, "/state")[1])["phase"] == "WAITING"
    assert source.poll(1.0) is frame
    assert source.poll(1.1) is None
    assert source.problem(1.1) == "silent"
    assert page.jpeg_after(0) is not None  # before the first tick too
    flight.tick(tick(2.5, seen_in(frame)))
    state = json.loads(ask(page.url, "/state")[1])
    assert state["phase"] == "ALIGN"
    assert state["battery"] == "3.88 V"
    assert ["phase", "ALIGN  1.5 s"] in state["rows"]
    newest = page.jpeg_after(1)
    assert newest is not None
    decoded = cv2.imdecode(np.frombuffer(newest[1], np.uint8), cv2.IMREAD_COLOR)
    drawn = np.asarray(decoded).astype(int)
    assert np.abs(drawn[150, 250:350] - 90).max() > 50
    assert flight.problem is None


@pytest.mark.parametrize("phase", [Phase.PERCHED, Phase.LANDED, Phase.ABORTED])
def test_a_flight_that_is_over_asks_for_no_landing(page: LivePage, phase: Phase) -> None:
    flight = FlightPage(page, 0.15)
    assert stop(page.url, page.token) == 200
    flight.tick(tick(2.0))
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "requested"
    last = tick(3.0)
    flight.tick(replace(last, state=replace(last.state, phase=phase)))
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "over"


def test_the_page_has_a_word_for_each_state_of_stop(page: LivePage) -> None:
    html = ask(page.url)[1].decode()
    table = html.partition("const STOP = {")[2].partition("};")[0]
    names = re.findall(r"^  (\w+): \[", table, re.MULTILINE)
    assert names == ["ready", "requested", "over", "gone"]


def test_a_page_that_fails_is_no_reason_to_land(page: LivePage) -> None:
    flight = FlightPage(page, 0.15)
    flight.watched(OneFrame(Frame(0, 0.0, np.zeros((480, 640), np.uint8)))).poll(0.0)
    flight.tick(None)  # type: ignore[arg-type]
    flight.event(note(0.0, "something"))
    assert flight.problem is None
    flight.tick(tick(1.0, "no output"))  # type: ignore[arg-type]
    json.loads(ask(page.url, "/state")[1])
    assert page.problem is not None


# --- track --view ----------------------------------------------------------------------------


class Looking(io.StringIO):
    """Reads the page from inside the loop, once the second line has been written."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        super().__init__()
        self.capsys = capsys
        self.printed = ""
        self.state: dict[str, Any] = {}
        self.lines = 0

    def write(self, text: str) -> int:
        self.lines += text.count("\n")
        if self.lines == 3 and not self.state:
            self.printed = self.capsys.readouterr().err
            url = self.printed.split("live page: ")[1].split()[0]
            self.state = json.loads(ask(url, "/state")[1])
        return super().write(text)


@pytest.mark.long
def test_track_serves_its_numbers_while_it_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = write_pictures(tmp_path / "pictures")
    out = Looking(capsys)
    options = resolve(str(pictures), calibration=CALIBRATION, stills=True, as_json=True, port=0)
    track_source(options, out)
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert len(lines) == len(VIEWS)
    assert out.state["track"] == lines[1]  # the newest when the third line was written
    assert out.state["stop"] == "none"
    assert dict(out.state["rows"])["markers"] == lines[1]["stage"]
    assert "the live page failed" not in capsys.readouterr().err
    assert not [t for t in threading.enumerate() if t.name == "view"]


def test_an_axis_behind_the_camera_is_left_out() -> None:
    from perchctl.display import draw_sketch

    image = picture(VIEWS["away"])
    pose = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.2]), 0.075)
    wild = (("large", np.full((4, 2), 1e9)), ("small", np.full((4, 2), np.nan)))
    drawn = draw_sketch(Sketch(image, wild, pose), camera())
    assert (drawn == image[..., None]).all()
