"""The printed page: true to size, centred, the same bytes for the same target."""

from __future__ import annotations

import datetime
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pypdfium2  # type: ignore[import-untyped]
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from perchctl.calibration.board.detect import BoardView, find_board
from perchctl.commands import app
from perchctl.errors import InvalidValue
from perchctl.profile import TargetConfig, load_profile
from perchctl.target import Board, board_pdf, target_pdf
from perchctl.target.reading import ArucoReader
from perchctl.target.sheets import parse_page
from tests.target.rig import sized

DPI = 600
PX_PER_MM = DPI / 25.4
TARGET = TargetConfig()
MAGNET_M = 0.05
TOLERANCE_MM = 0.05
PAGES = ("a4", "letter", "220x240mm")


def page_picture(pdf: bytes, page: int, dpi: int = DPI) -> NDArray[np.uint8]:
    document = pypdfium2.PdfDocument(pdf)
    try:
        bitmap = document[page].render(scale=dpi / 72.0, grayscale=True)
        return np.array(bitmap.to_numpy(), np.uint8).reshape(bitmap.height, bitmap.width)
    finally:
        document.close()


def black_runs_mm(line: NDArray[np.uint8]) -> list[tuple[float, float]]:
    """Start and end of every dark run of a row or column, mm, from the grey at its ends."""
    dark = line < 128
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int)))
    ink = 1.0 - line.astype(float) / 255.0
    runs = []
    for start, stop in edges.reshape(-1, 2):
        before = ink[start - 1] if start > 0 else 0.0
        after = ink[stop] if stop < len(line) else 0.0
        low = start + (1.0 - ink[start]) - before
        high = stop - (1.0 - ink[stop - 1]) + after
        runs.append((low * 25.4 / DPI, high * 25.4 / DPI))
    return runs


def refined(picture: NDArray[np.uint8], corners: NDArray[np.float32]) -> NDArray[np.float64]:
    """Each side as a line through its grey edge, intersected; (4, 2) mm on the page."""
    lines = []
    for a, b in itertools.pairwise([*corners, corners[0]]):
        level = abs(b[0] - a[0]) > abs(b[1] - a[1])
        along, across = (0, 1) if level else (1, 0)
        at = np.linspace(a[along], b[along], 21)[2:-2]
        places = []
        for position in at:
            line = picture[:, round(position)] if level else picture[round(position)]
            ends = np.array(black_runs_mm(line)).ravel()
            places.append(ends[np.abs(ends - (a[across] + 0.5) / PX_PER_MM).argmin()])
        lines.append(float(np.median(places)))
        assert np.ptp(places) < 0.02, "straight and parallel to the paper"
    top, right, bottom, left = lines
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


@pytest.mark.parametrize(
    "page", [PAGES[0], *(pytest.param(page, marks=pytest.mark.long) for page in PAGES[1:])]
)
def test_the_pdf_at_600_dpi_is_read_and_true_to_size(page: str) -> None:
    """So are the rulers, the line itself and half a tick at each end; and the back's cross and
    circle lie over the front's centre, the middle of the paper."""
    width, height = parse_page(page)
    pdf = target_pdf(TARGET, page, MAGNET_M)
    front, back = page_picture(pdf, 0), page_picture(pdf, 1)
    assert front.shape == pytest.approx((height * PX_PER_MM, width * PX_PER_MM), abs=1.0)
    centre = np.array([width, height]) / 2.0
    found = ArucoReader(TARGET).read(front)
    assert set(found) == {"large", "small"}
    for name, side_mm in (("large", 150.0), ("small", 25.0)):
        rough = found[name]  # type: ignore[index]
        assert rough[0, 0] < rough[1, 0], "upright: the first corner is at the top left"
        assert rough[0, 1] < rough[3, 1]
        corners = refined(front, rough)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        assert np.abs(sides - side_mm).max() < TOLERANCE_MM
        assert np.abs(corners.mean(axis=0) - centre).max() < TOLERANCE_MM
    for lines in (front, front.T):
        runs = (
            black_runs_mm(np.ascontiguousarray(line)) for line in lines[:: round(0.1 * PX_PER_MM)]
        )
        lengths = [stop - start for found_runs in runs for start, stop in found_runs]
        assert any(abs(length - 100.2) < TOLERANCE_MM for length in lengths)
    off_px = round(15.0 * PX_PER_MM)
    lines = back[back.shape[0] // 2 - off_px], back[:, back.shape[1] // 2 - off_px]
    for line, middle in zip(lines, centre, strict=True):
        marks = sorted(sum(run) / 2.0 - middle for run in black_runs_mm(line))
        near = [mark for mark in marks if abs(mark) < 28.0]
        assert near == pytest.approx([-20.0, 0.0, 20.0], abs=0.05)


def test_the_same_bytes_for_the_same_target() -> None:
    date = datetime.date(2026, 3, 1)
    first, second = (target_pdf(TARGET, "a4", MAGNET_M, "mine", date) for _ in range(2))
    assert first == second
    assert first != target_pdf(TARGET, "a4", MAGNET_M, "mine", datetime.date(2026, 3, 2))
    assert b"D:20260301" in first
    assert b"/PrintScaling /None" in first


Box = tuple[float, float, float, float]
"""Left, bottom, right, top in mm, y up."""


def drawn(pdf: bytes, page: int) -> Iterator[tuple[str, Box]]:
    """What a page holds: the text (empty for lines and areas), and where."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        text_page = document[page].get_textpage()
        for thing in document[page].get_objects():
            bounds = thing.get_bounds()
            is_text = thing.type == pypdfium2.raw.FPDF_PAGEOBJ_TEXT
            text = text_page.get_text_bounded(*bounds) if is_text else ""
            left, low, right, top = (v * 25.4 / 72.0 for v in bounds)
            yield text, (left, low, right, top)
    finally:
        document.close()


def test_the_captions_say_what_is_printed_and_which_side_it_is() -> None:
    pdf = target_pdf(TARGET, "a4", MAGNET_M, "profile mine", datetime.date(2026, 3, 1))
    front, back = (" ".join(text for text, _ in drawn(pdf, page)) for page in (0, 1))
    for part in ("150 mm DICT_4X4_1000 id 997", "25 mm DICT_ARUCO_ORIGINAL id 5", "profile mine",
                 "2026-03-01", "up", "faces the floor", "x axis points right, y down"):  # fmt: skip
        assert part in front
    assert "faces the ceiling. Its x axis points left, y down" in back


LAYOUTS = [
    (150.0, 25.0, "a4"), (150.0, 25.0, "220x240mm"), (60.0, 10.0, "160x220mm"), (200.0, 30.0, "a3"),
    (355.0, 35.0, "442x478mm"),
]  # fmt: skip


@pytest.mark.parametrize(("large", "small", "page"), LAYOUTS)
@pytest.mark.parametrize("side", [0, 1])
def test_nothing_overlaps_all_is_printable_and_half_a_cell_stays_white(
    large: float, small: float, page: str, side: int
) -> None:
    width, height = parse_page(page)
    boxes = list(drawn(target_pdf(sized(large, small), page, min(MAGNET_M, large / 1e3)), side))
    texts = [box for text, box in boxes if text]
    marks = [box for text, box in boxes if not text]

    def apart(a: Box, b: Box) -> bool:
        return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]

    assert len(texts) >= 3
    for text in texts:
        assert all(apart(text, other) for other in [*marks, *texts] if other is not text), text
    for left, low, right, top in [*texts, *marks]:
        assert min(left, low, width - right, height - top) >= 4.0
    if side == 0:
        x, y, reach = width / 2.0, height / 2.0, large / 2.0 + large / 12.0
        white = (x - reach, y - reach, x + reach, y + reach)
        inside = [box for box in [*texts, *marks] if not apart(box, white)]
        assert len(inside) == 1, "the drawing alone"


@pytest.mark.parametrize(
    ("large", "page"),
    [(150.0, "150x150mm"), (150.0, "196x297mm"), (150.0, "20x300mm"), (300.0, "a4")],
)
def test_a_page_too_small_is_refused_with_the_one_that_fits(large: float, page: str) -> None:
    """196 mm leave less than half a cell of white around 150 mm and inside of the rulers."""
    with pytest.raises(InvalidValue) as refused:
        target_pdf(sized(large, 25.0), page, MAGNET_M)
    named = re.search(r"use --page (\S+)", str(refused.value))
    assert named is not None
    assert target_pdf(sized(large, 25.0), named[1], MAGNET_M)


@pytest.mark.parametrize(
    "notation",
    [
        "charuco:10x7:25mm:18mm:DICT_5X5_100",
        "charuco:8x6:30mm:22mm:DICT_4X4_50",
        "charuco:8x6:30mm:22mm:DICT_4X4_50:legacy",
        "chessboard:9x6:25mm",
    ],
)
def test_a_printed_board_is_found_and_true_to_size(notation: str) -> None:
    board = Board.parse(notation)
    picture = page_picture(board_pdf(board, "a4"), 0, 200)
    assert picture.shape[1] > picture.shape[0], "turned, as it fits"
    view = find_board(picture, board)
    assert isinstance(view, BoardView)
    columns, rows = board.corner_count
    assert len(view) == columns * rows
    assert view.legacy == board.legacy
    corners, expected = view.corners_px * 25.4 / 200, view.corners_m[:, :2] * 1e3
    if corners[0, 0] > corners[-1, 0]:  # a chessboard found from its other end
        corners = corners[::-1]
    shift = np.median(corners - expected, axis=0)
    assert np.abs(corners - expected - shift).max() < TOLERANCE_MM
    large = Board.parse("charuco:10x7:30mm:22mm:DICT_5X5_100")
    with pytest.raises(InvalidValue, match="use --page a3"):
        board_pdf(large, "a4")
    assert board_pdf(large, "a3")


# --- the command: files, profiles, refusals ------------------------------------------------------

CAMERA = "example_640x480.yaml"


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def call(*words: str, code: int = 0) -> tuple[str, str]:
    """stdout and stderr of the command, whose exit code must be this."""
    done = CliRunner().invoke(app, ["make-target", *words])
    assert done.exit_code == code, (done.stdout, done.stderr)
    return done.stdout, done.stderr


def files() -> set[str]:
    return {path.name for path in Path().iterdir()}


def test_the_plain_call_writes_the_pdf_alone_and_twice_the_same() -> None:
    out, _ = call()
    assert "wrote target.pdf" in out
    first = Path("target.pdf").read_bytes()
    call("-o", "target.pdf", "--force")
    assert files() == {"target.pdf"}
    assert Path("target.pdf").read_bytes() == first


def test_a_design_says_what_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr("perchctl.commands.make_target.say_on_terminal", told.append)

    def stop(*_: object) -> None:
        raise InvalidValue("here it takes long")

    monkeypatch.setattr("perchctl.target.make_design", stop)
    call("design", "--blur", "2.0", code=InvalidValue.exit_code)
    assert told[1:] == ["finding the smallest markers that are readable at a blur of 2 px"]


@pytest.mark.long
def test_a_design_writes_nothing() -> None:
    out, _ = call("design", CAMERA, "--ceiling", "2.4", "--blur", "2.0")
    assert "z1" in out
    assert "mounting  never blind" in out
    assert "from 1.3 m above the floor, its highest point" in out
    assert files() == set()


@pytest.mark.long
def test_a_target_that_is_the_position_source_is_designed_from_the_ground() -> None:
    out, _ = call("design", CAMERA, "-p", "target_only", "--ceiling", "2.0")
    assert "200 cm    to the target from the ground" in out


REFUSALS = [
    (["--magnet", "20"], 30, "has no unit; write 20mm"),
    (["--magnet", "20mm"], 30, "exceeds the magnet"),
    (["--page", "150x150mm"], 30, "use --page a4"),
    (["--page", "a9"], 30, "allowed are a4, letter, a3"),
    (["--page", "9x9m"], 30, "too large: at most 5000 mm per side"),
    (["-o", "target.txt"], 30, "must end in .pdf"),
    (["-o", "/dev/null/target.pdf"], 30, "/dev/null is a file, not a folder"),
    (["-p", "nothing"], 20, "profile 'nothing' not found"),
    (["board", "chessboard:9x6"], 30, "COLUMNSxROWS:SQUARE"),
    (["board", "chessboard:9x6:25mm:measured=249x174mm"], 2, "leave out :measured="),
    (["board", "chessboard:9x6:25mm", "-o", "board.txt"], 30, "must end in .pdf"),
    (["design", "nothing.yaml"], 20, "not found"),
    (["design", "--blur", "-1"], 30, "--blur: found"),
    (["design", "--ceiling", "nan"], 30, "--ceiling: found"),
    (["measured", "-p", "m.yaml"], 2, "no size is given"),
    (["measured", "--measured-large", "149.6", "-p", "crazyflie"], 30, "is shipped with perchctl"),
    (["measured", "--measured-large", "149.6", "-p", "m.yaml"], 20, "m.yaml does not exist"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "code", "said"), REFUSALS)
def test_a_refusal_is_one_sentence_and_leaves_nothing(
    words: list[str], code: int, said: str
) -> None:
    _, err = call(*words, code=code)
    assert said in err
    assert err.count("\n") == 1 or err.startswith("Usage")
    assert files() == set()


MEASURED = ("--measured-large", "149.6", "--measured-small", "24.9mm")


PROFILES = {
    "known": "extends: sim\ntarget:\n  size_sigma: 0.01  # keep\n",
    "no side": "extends: crazyflie  # keep\ntarget:\n    large:\n        id: 16\n"
    "    small: {id: 6}\n",
}
"""Further layouts: tests/profile/test_edit.py."""


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_is_changed_in_place_and_its_old_text_kept(name: str) -> None:
    path = Path("mine.yaml")
    path.write_text(PROFILES[name])
    before = load_profile("./mine.yaml")
    words = ("measured", "-p", "mine.yaml", *MEASURED)
    assert "mine.yaml.bak" in call(*words)[0]
    after = load_profile("./mine.yaml")
    assert (after.target.large.side_m, after.target.small.side_m) == (0.1496, 0.0249)
    assert after.target.size_sigma == 0.001
    assert after.target.large.id == before.target.large.id
    assert after.model_copy(update={"target": before.target}) == before
    assert "keep" in path.read_text()
    assert files() == {"mine.yaml", "mine.yaml.bak"}
    assert Path("mine.yaml.bak").read_text() == PROFILES[name]


def test_a_scaled_page_and_a_marker_that_was_not_measured_are_noticed() -> None:
    Path("m.yaml").write_text("extends: crazyflie\n")
    for size, said in (("0.1496", "measure the black area, in mm"), ("150in", "unit 'in'")):
        _, err = call("measured", "--measured-large", size, "-p", "m.yaml", code=30)
        assert said in err
        assert Path("m.yaml").read_text() == "extends: crazyflie\n"
    out, _ = call("measured", "-p", "m.yaml", "--measured-small", "25.1")
    assert "measure both markers" in out
    assert load_profile("./m.yaml").target.size_sigma == 0.005
    words = ("--measured-large", "145.5", "--measured-small", "24.25")
    out, _ = call("measured", "-p", "m.yaml", *words)
    assert "the page may have been scaled" in out
    assert "small relative to large: " in out
