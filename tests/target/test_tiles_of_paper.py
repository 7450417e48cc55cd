"""A page on several sheets: together they show all of it, and each seam twice."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from perchctl.profile import load_profile
from perchctl.target import Optics, make_design
from perchctl.target.design import Ranges
from perchctl.target.page import (
    OVERLAP,
    PAGES_MM,
    UNPRINTABLE,
    Circle,
    Line,
    Page,
    Text,
    tile_page,
)
from perchctl.target.sight import SURE_PX
from perchctl.target.suggest import Suggestion
from perchctl.vision import CameraModel
from tests.helpers.flights import short_profile
from tests.target.test_design import PAPER_CAMERA

sizes = st.floats(60.0, 1500.0)


def shown_on(sheets: list[Page], size: tuple[float, float]) -> list[Circle]:
    """The circles in what a printer prints."""
    width, height = size
    assert all({page.width, page.height} == {width, height} for page in sheets)
    return [
        item
        for page in sheets
        for item in page.items
        if isinstance(item, Circle)
        and UNPRINTABLE - 1e-6 <= item.x <= page.width - UNPRINTABLE + 1e-6
        and UNPRINTABLE - 1e-6 <= item.y <= page.height - UNPRINTABLE + 1e-6
    ]


@given(sizes, sizes, st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from(["a4", "a3"]))
def test_whatever_is_on_the_page_is_on_a_sheet(
    width: float, height: float, across: float, down: float, name: str
) -> None:
    """`radius` marks the spot: it is in view of one to four sheets."""
    spot = Circle(across * width, down * height, 1.0)
    whole = Page(width, height, (spot,))
    sheets = tile_page(whole, PAGES_MM[name])
    if sheets == [whole]:
        assert min(width, height) <= min(PAGES_MM[name])
        return
    assert 1 <= len(shown_on(sheets, PAGES_MM[name])) <= 4


def test_a_page_that_fits_stays_as_it_is() -> None:
    page = Page(297.0, 210.0, ())
    assert tile_page(page, PAGES_MM["a4"]) == [page]


def test_neighbours_share_the_seam_and_its_mark() -> None:
    page = Page(500.0, 250.0, (Text(250.0, 120.0, "x"),))
    left, right = tile_page(page, PAGES_MM["a3"])
    for sheet in (left, right):
        assert len([i for i in sheet.items if isinstance(i, Line)]) == 2
    (mark, _), (same, _) = (
        [i for i in sheet.items if isinstance(i, Line)] for sheet in (left, right)
    )
    assert mark.x0 - (left.width - UNPRINTABLE) == -OVERLAP / 2
    assert same.x0 - UNPRINTABLE == OVERLAP / 2
    assert mark.x0 - same.x0 == left.width - 2 * UNPRINTABLE - OVERLAP


def test_a_target_beyond_the_named_pages_is_proposed_in_sheets() -> None:
    target = load_profile("sim").target
    assert Suggestion(target, "a3", (), ()).command().endswith("--page a3")
    command = Suggestion(target, "460x500mm", (), ()).command()
    assert command.endswith("--page 460x500mm --tile a3")


def test_a_gap_on_the_ground_is_named_where_the_target_is_the_position() -> None:
    """From the search height it would be near enough."""
    camera: CameraModel = PAPER_CAMERA
    ranges = Ranges(3.4, 0.5, 0.16, 0.12, 0.03, 16.6, 17.0, 380.0)
    ground = short_profile({"positioning": "target"}, base="sim")
    sure_m = 380.0 * ground.target.large.side_m / SURE_PX

    def warned(profile: object, ceiling_m: float) -> bool:
        design = make_design(ground.target, camera, Optics(), profile, ceiling_m, ranges)  # type: ignore[arg-type]
        return any("gap on the ground" in text for text in design.warnings)

    assert not warned(ground, 2.9)
    assert warned(ground, 3.4) is (0.9 * sure_m < 3.4 - 0.005)
    assert not warned(load_profile("sim"), 3.4)
