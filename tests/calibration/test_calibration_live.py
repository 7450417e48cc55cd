"""`perchctl calibrate` from videos and live cameras: which views are kept, what is advised."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import GuidedFrame, capture_views
from perchctl.calibration.board.capture import (
    Capture,
    Signature,
    covered_shares,
    next_advice,
    signature,
    update_capture,
)
from perchctl.camera import Grey
from perchctl.commands.progress import guide, page_state
from perchctl.display import LivePage, Sketch
from perchctl.errors import TimedOut
from perchctl.vision import Frame
from tests.helpers.boards import (
    CHARUCO,
    CHESSBOARD,
    BoardRenderer,
    corner_view,
    draw_camera,
    draw_poses,
)
from tests.helpers.calibrating import calibrate, refused

pytestmark = pytest.mark.long


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

    live, size_px = True, (320, 240)

    def __init__(self, images: list[Grey], ends: bool = False) -> None:
        self._frames = [Frame(i, float(i), image) for i, image in enumerate(images)]
        self._ends = ends

    @property
    def finished(self) -> bool:
        return self._ends and not self._frames

    def poll(self, now_s: float) -> Frame | None:
        return self._frames.pop(0) if self._frames else None

    def problem(self, now_s: float) -> str | None:
        return None if self._frames else "the camera is unplugged"

    def describe(self) -> str:
        return "test"

    def close(self) -> None:
        pass


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
    moments: list[GuidedFrame] = []
    views = capture_views(_Frames(images), CHESSBOARD, moments.append, _clock(), lambda s: None)
    assert 5 <= len(views) <= 7
    assert sum(m.taken for m in moments) == len(views)
    shots = [m.index for m in moments if m.taken]
    assert all(i % 3 == 1 for i in shots)  # at once when still, and once each
    assert moments[0].advice == "hold still"
    assert moments[-1].rows[-1] == ("views", str(len(views)), None)
    assert len({m.line for m in moments}) == len(views) + 1  # a pipe gets one line a view
    with pytest.raises(TimedOut, match="only 1 views"):
        capture_views(_Frames(images[:3]), CHESSBOARD, moments.append, _clock(), lambda s: None)


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
        while (advice := next_advice(shown)) != "show the board somewhere new":
            assert advice in FOLLOWED, advice
            before = min(covered_shares(shown).values())
            shown.append(dataclasses.replace(shown[-1], **FOLLOWED[advice]))
            given.add(advice)
            assert min(covered_shares(shown).values()) >= before
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
    assert output.read_text() == "mine"


def test_guided_capture_refuses_blur_and_repetition_and_stops_when_covered() -> None:
    rng = np.random.default_rng(4)
    camera = draw_camera(rng)
    state = Capture()
    for pose in draw_poses(rng, camera, CHARUCO, 40):
        view = corner_view(rng, camera, CHARUCO, pose, 0.05, "v")
        state = update_capture(update_capture(state, view, CHARUCO), view, CHARUCO)
        if state.finished:
            break
    assert state.finished
    assert len(state.taken) >= 15
    assert not update_capture(state, state.taken[-1], CHARUCO).shot
    blurred = dataclasses.replace(view, blur_px=8.0)
    before = update_capture(Capture(), blurred, CHARUCO)
    assert "blurred" in update_capture(before, blurred, CHARUCO).advice


def test_a_pipe_gets_a_line_whenever_it_changes_and_the_page_its_shares() -> None:
    out = io.StringIO()
    rows = (("x", "50 %", 0.5), ("views", "3", None))
    moment = GuidedFrame(0, np.zeros((4, 4), np.uint8), (), rows, "hold still", "")
    with guide(None, out) as show:
        for line in ("a", "a", "b"):
            show(dataclasses.replace(moment, line=line))
    assert out.getvalue().splitlines() == ["perchctl: a", "perchctl: b"]
    state = {"rows": [["x", "50 %", 0.5], ["views", "3"]], "phase": "hold still"}
    assert page_state(moment) == state
