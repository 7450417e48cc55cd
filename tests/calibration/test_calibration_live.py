"""`perchctl calibrate` from videos and live cameras: which views are kept, what is advised."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import (
    FoundViews,
    GuidedFrame,
    calibrate_camera,
    capture_views,
    check_calibration,
)
from perchctl.calibration.board.capture import (
    GuidedCapture,
    covered_shares,
    next_advice,
    view_signature,
)
from perchctl.camera import Grey
from perchctl.commands.progress import guidance_display, page_state
from perchctl.display import LivePage, Sketch
from perchctl.errors import InvalidValue, TimedOut
from perchctl.target import Board
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
from tests.helpers.gear import Pictures

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


def _frames(images: list[Grey]) -> Pictures:
    """A live source that shows prepared pictures, one at a time, and ends."""
    source = Pictures(images)
    source.live, source.size_px = True, (320, 240)
    return source


@pytest.fixture(scope="module")
def shown() -> list[Grey]:
    """A board in seven places, each of which comes in, is still, and stays."""
    camera = draw_camera(np.random.default_rng(3), (320, 240))
    rng, renderer = np.random.default_rng(2), BoardRenderer(camera, CHESSBOARD)
    poses = draw_poses(rng, camera, CHESSBOARD, 7)
    return [image for pose in poses for image in [renderer.render(pose, rng, noise=1.0)] * 3]


def test_guided_capture_takes_still_new_sharp_views_and_ends(shown: list[Grey]) -> None:
    moments: list[GuidedFrame] = []
    views = capture_views(_frames(shown), CHESSBOARD, moments.append).views
    assert 5 <= len(views) <= 7
    shots = [m.index for m in moments if m.taken]
    assert len(shots) == len(views)
    assert all(i % 3 == 1 for i in shots)  # at once when still, and once each
    assert moments[0].advice == "hold still"
    assert moments[-1].rows[-1] == ("views", str(len(views)), None)
    assert len({m.status_line for m in moments}) == len(views) + 1  # a pipe gets one line a view
    gone = _frames(shown[:3])
    gone.trouble = "camera:0 is unplugged"
    with pytest.raises(TimedOut, match="unplugged; only 1 views"):
        capture_views(gone, CHESSBOARD, moments.append, itertools.count().__next__, lambda s: None)


FOLLOWED = {
    "move the board to the left edge": (0, 0.1),
    "move the board to the right edge": (0, 0.9),
    "move the board to the top edge": (1, 0.1),
    "move the board to the bottom edge": (1, 0.9),
    "move closer": (2, 0.95),
    "move farther away": (2, 0.1),
    "tilt the board's right side away": (3, 0.3),
    "tilt the board's left side away": (3, -0.3),
    "tilt the board's bottom side away": (4, 0.3),
    "tilt the board's top side away": (4, -0.3),
}
"""What is to be done, and how a view's signature shows that it was."""


def test_one_advice_at_a_time_leads_to_the_end() -> None:
    """Whoever does what is said, and nothing else, covers everything in a few views."""
    rng = np.random.default_rng(1)
    given: set[str] = set()
    for _ in range(12):
        shown = [rng.uniform((0.1, 0.1, 0.2, -0.3, -0.3), (0.9, 0.9, 0.9, 0.3, 0.3))]
        while (advice := next_advice(shown)) != "move the board to a new place":
            before = min(covered_shares(shown).values())
            part, value = FOLLOWED[advice]
            shown.append(np.where(np.arange(5) == part, value, shown[-1]))
            given.add(advice)
            assert min(covered_shares(shown).values()) >= before
            assert len(shown) < 12
    assert given == set(FOLLOWED)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bars_show_where_views_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the terminal, in 80 columns, and on the page: the same bars, filled where views are."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    camera, rng = draw_camera(np.random.default_rng(3)), np.random.default_rng(4)
    capture, terminal = GuidedCapture(CHARUCO), Terminal()
    frame = Frame(0, 0.0, np.zeros((480, 640), np.uint8))
    for x_m in (-0.3, 0.02):  # of 0.72 m that are seen in that distance, never to the right
        pose = np.array([0.0, 0.0, 0.0, x_m, -0.1, 0.6])
        view = corner_view(rng, camera, CHARUCO, pose, 0.0, "v")
        capture.update(view)
        assert capture.update(view)
    with guidance_display(None, terminal) as show:
        show(capture.guided_frame(frame, view, True))
    lines = re.sub(r"\x1b\[[^a-zA-Z]*[a-zA-Z]", "", terminal.getvalue()).splitlines()
    assert max(map(len, lines)) < 80
    bars = {line[:11].strip(): line for line in lines}
    assert set(bars) >= {"position x", "position y", "size", "skew"}
    left, filled, right = re.fullmatch(  # type: ignore[union-attr]
        r"position x (\.+)(#+)(\.+) +\d+ %", bars["position x"].strip()
    ).groups()
    assert len(left + filled + right) == 30
    assert len(right) > len(left)
    assert len(filled) > 8
    assert bars["position y"].count("#") == 1  # both views have the same height
    (bar,) = [row[2] for row in page_state(capture.guided_frame(frame, view, True))["rows"][:1]]
    assert bar["start"] == pytest.approx(len(left) / 30, abs=0.02)
    assert bar["end"] == pytest.approx(1.0 - len(right) / 30, abs=0.02)
    assert not bar["is_enough"]


def test_a_board_s_farther_side_is_known() -> None:
    rng = np.random.default_rng(4)
    camera = draw_camera(rng)
    for about, part in ((1, 3), (0, 4)):
        for sign in (-1.0, 1.0):
            rvec = np.zeros(3)
            rvec[about] = 0.5 * sign * (-1.0 if about == 1 else 1.0)
            pose = np.concatenate([rvec, [-0.1, -0.1, 0.5]])
            corners = CHARUCO.corners_m() @ cv2.Rodrigues(rvec)[0].T
            assert (corners[:, 2] @ corners[:, 1 - about] > 0) == (sign > 0)
            view = corner_view(rng, camera, CHARUCO, pose, 0.0, "v")
            assert sign * view_signature(view, CHARUCO)[part] > 0.1


def captured(live: bool) -> FoundViews:
    """Frames of a board: two of nothing, six that move, two still, three that stay, two blurred."""
    rng = np.random.default_rng(4)
    camera, capture = draw_camera(rng), GuidedCapture(CHARUCO, live)
    poses = draw_poses(rng, camera, CHARUCO, 8)
    views = [corner_view(rng, camera, CHARUCO, pose, 0.05, "v") for pose in poses]
    still, other = views[6:]
    blurred = dataclasses.replace(other, blur_px=8.0)
    for seen in ("no board", "no board", *views[:6], still, still, still, still, still, blurred):
        capture.update(seen)
    capture.update(blurred)
    capture.count_repeated()
    return FoundViews(tuple(capture.taken), frames=capture.counts)


def test_what_became_of_each_frame_is_counted() -> None:
    frames = captured(live=False).frames
    assert frames is not None
    assert (frames.taken, frames.without_board, frames.repeated) == (1, 2, 1)
    # The first still frame and the first blurred one moved, too.
    assert (frames.moved, frames.alike, frames.blurred) == (8, 3, 1)
    assert frames.text == (
        "13 of 15 frames show the board: 1 taken, 8 moved by more than 1.5 px since "
        "the previous frame, 1 too blurred, 3 similar to a view already taken"
    )


@pytest.mark.parametrize(
    ("live", "advised"),
    [
        (True, "hold the board still for a moment at each position"),
        (False, "record again .*images:"),
    ],
)
def test_too_few_views_of_a_film_are_not_said_to_be_too_few_boards(
    live: bool, advised: str
) -> None:
    found = captured(live)
    said = rf"only 1 usable views, .* \(13 of 15 frames show the board: .*\): {advised}"
    with pytest.raises(InvalidValue, match=said):
        calibrate_camera(found, CHARUCO.notation())
    said = rf"1 usable views \(13 of 15 frames .*\), but a check needs at least 3: {advised}"
    with pytest.raises(InvalidValue, match=said):
        check_calibration(draw_camera(np.random.default_rng(4)), found)
    assert found.frames is not None
    # Where frames are left out as like others, the board has to be shown elsewhere.
    found = dataclasses.replace(found, frames=dataclasses.replace(found.frames, alike=20))
    with pytest.raises(InvalidValue, match="show the board tilted by 20 to 45 deg"):
        calibrate_camera(found, CHARUCO.notation())


def test_a_recording_is_not_told_what_to_do() -> None:
    rng = np.random.default_rng(4)
    camera, capture = draw_camera(rng), GuidedCapture(CHARUCO, live=False)
    view = corner_view(rng, camera, CHARUCO, draw_poses(rng, camera, CHARUCO, 1)[0], 0.05, "v")
    said = [capture.advice]
    for seen in (view, dataclasses.replace(view, blur_px=8.0), view, view):
        capture.update(seen)
        said.append(capture.advice)
    assert said == [
        "no board found yet",
        "moved since the previous frame",
        "too blurred",
        "taken, 1 views",
        "similar to a view already taken",
    ]


def test_a_film_of_another_board_is_named() -> None:
    camera = draw_camera(np.random.default_rng(3), (320, 240))
    rng, renderer = np.random.default_rng(2), BoardRenderer(camera, CHESSBOARD)
    image = renderer.render(draw_poses(rng, camera, CHESSBOARD, 1)[0], rng, noise=1.0)
    source = Pictures([image] * 2)
    squares = Board.parse("chessboard:10x7:25mm")
    found = capture_views(source, squares, lambda guided: None)
    assert not found.views
    assert found.other_board.startswith("a chessboard of 9x6 inner corners, which are 10x7 squares")
    assert found.frames is not None
    assert (found.frames.live, found.frames.without_board) == (False, 2)


def test_a_live_camera_is_refused_before_anybody_has_worked_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    output = tmp_path / "calib" / "camera_64x48.yaml"
    output.parent.mkdir()
    output.write_text("mine")
    with contextlib.closing(LivePage(draw_camera(np.random.default_rng(0)), "camera")) as page:
        page.show(Sketch(np.zeros((48, 64), np.uint8)))
        url = page.url.replace("/?", "/stream?")
        sentence = refused(calibrate(url), 30)
        assert "camera_64x48.yaml already exists; add --force" in sentence
    assert output.read_text() == "mine"


def test_guided_capture_refuses_blur_and_repetition_and_stops_when_covered() -> None:
    rng = np.random.default_rng(4)
    camera, capture = draw_camera(rng), GuidedCapture(CHARUCO)
    for pose in draw_poses(rng, camera, CHARUCO, 40):
        view = corner_view(rng, camera, CHARUCO, pose, 0.05, "v")
        capture.update(view)
        capture.update(view)
        if capture.is_finished:
            break
    assert capture.is_finished
    assert len(capture.taken) >= 15
    assert not capture.update(capture.taken[-1])
    fresh, blurred = GuidedCapture(CHARUCO), dataclasses.replace(view, blur_px=8.0)
    assert not fresh.update(blurred)
    assert not fresh.update(blurred)
    assert "blurred" in fresh.advice
