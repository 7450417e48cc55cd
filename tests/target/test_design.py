"""The designer against the renderer and the paper; its suggestions hold."""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from perchctl.errors import InvalidValue
from perchctl.profile import Profile, TargetConfig, load_profile
from perchctl.target import (
    Optics,
    check_target,
    make_design,
    suggest_target,
)
from perchctl.target.design import Ranges, TargetDesign
from perchctl.target.page import parse_page
from perchctl.target.sheets import fits
from perchctl.target.sight import SURE_PX, FieldOfView, square_outline, turned_outline
from tests.helpers.flights import short_profile
from tests.target.rig import camera_of, sized

TARGET = TargetConfig()
ROOT = Path(__file__).resolve().parents[2]


PAPER_CAMERA = camera_of(380.0)


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("sim")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark of the ranges, from beyond what may be wrong on, and quick."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    module = importlib.import_module("ranges_by_design")
    monkeypatch.setattr(module, "START", 1.2)
    return module


@pytest.fixture(scope="module")
def paper_design(profile: Profile) -> TargetDesign:
    return make_design(TARGET, PAPER_CAMERA, Optics(2.5), profile, 2.4)


@pytest.mark.long
@pytest.mark.parametrize(("focal_px", "blur_px"), [(250.0, 2.5), (380.0, 1.5)])
def test_ranges_agree_with_the_renderer(bench: ModuleType, focal_px: float, blur_px: float) -> None:
    """The other cameras and blurs: benchmarks/ranges_by_design.py."""
    for name, designed, measured in bench.measure(focal_px, blur_px, TARGET):
        assert designed == pytest.approx(measured, rel=0.15), name


def test_the_paper_s_ranges_and_where_they_differ(paper_design: TargetDesign) -> None:
    """z2 and z3 agree; a blur that explains z1 = 115 cm would be 3.5 px, not 2.5."""
    r = paper_design.ranges
    assert r.z2_m == pytest.approx(0.25, rel=0.15)
    assert r.z3_upright_m == pytest.approx(0.12, rel=0.05)
    assert r.z3_m == pytest.approx(0.17, rel=0.05), "facing across, the marker needs more room"
    assert r.z1_m is not None
    assert 1.15 < r.z1_m < 1.75


def test_z3_is_the_geometry_s() -> None:
    view = FieldOfView(PAPER_CAMERA, margin_px=0.0)
    ahead = (np.eye(3), np.zeros(3))
    assert view.nearest_m(square_outline(0.15), *ahead) == pytest.approx(
        0.15 * 380.0 / 480.0, rel=2e-3
    )
    assert view.nearest_m(turned_outline(0.15), *ahead) == pytest.approx(
        0.15 * math.sqrt(2.0) * 380.0 / 480.0, rel=2e-3
    )


def test_barrel_distortion_shows_more(profile: Profile) -> None:
    ahead = (np.eye(3), np.zeros(3))
    barrel = FieldOfView(camera_of(380.0, (-0.17, 0.04, 0.0, 0.0, 0.0))).nearest_m(
        turned_outline(0.15), *ahead
    )
    plain = FieldOfView(PAPER_CAMERA).nearest_m(turned_outline(0.15), *ahead)
    assert barrel is not None
    assert plain is not None
    assert barrel < 0.99 * plain


def test_what_is_behind_the_camera_is_never_seen() -> None:
    turn_back = np.diag([1.0, -1.0, -1.0])
    assert FieldOfView(PAPER_CAMERA).nearest_m(turned_outline(0.1), turn_back, np.zeros(3)) is None


def warnings_of(profile: Profile, ranges: Ranges, **changes: Any) -> str:
    design = make_design(
        TARGET, PAPER_CAMERA, Optics(), profile, 2.4, dataclasses.replace(ranges, **changes)
    )
    return " | ".join(design.warnings)


def test_gaps_are_named(profile: Profile, paper_design: TargetDesign) -> None:
    ranges = paper_design.ranges
    assert warnings_of(profile, ranges) == ""
    assert "gap at the search height" in warnings_of(profile, ranges, z1_m=0.9)
    assert "gap between the markers" in warnings_of(profile, ranges, z2_m=0.15)
    assert "overlap is short" in warnings_of(profile, ranges, z2_m=0.18)
    assert "never read" in warnings_of(profile, ranges, z1_m=None)
    aside = profile.model_copy(
        update={"camera": profile.camera.model_copy(
            update={"mount": profile.camera.mount.model_copy(
                update={"position_m": (0.09, 0.0, 0.0)})})}
    )  # fmt: skip
    assert "gap before contact" in warnings_of(aside, ranges)


@pytest.mark.long
@pytest.mark.parametrize(
    ("focal_px", "blur_px", "ceiling_m"), [(380.0, 2.0, 2.4), (250.0, 0.6, None)]
)
def test_what_is_suggested_covers_the_way(
    profile: Profile, focal_px: float, blur_px: float, ceiling_m: float | None
) -> None:
    found, page = suggest_target(camera_of(focal_px), Optics(blur_px), profile, 0.05, ceiling_m)
    assert page == "a4"
    assert found.warnings == ()
    assert found.ranges.z1_m is not None
    assert found.ranges.z1_m >= (1.15 if ceiling_m is None else ceiling_m - 1.3)
    check_target(found.target, 0.05)
    assert fits(found.target, parse_page("a4"))
    assert not fits(sized(1e3 * found.target.large.side_m + 5, 25.0), parse_page("a4"))


@pytest.mark.long
def test_a_larger_page_or_a_smaller_magnet_gives_other_sizes(profile: Profile) -> None:
    camera, optics = camera_of(380.0), Optics(2.0)
    found, _ = suggest_target(camera, optics, profile, 0.05, 2.4)
    assert found.target.large.side_m > profile.target.large.side_m
    larger, page = suggest_target(camera, optics, profile, 0.05, 2.4, "a3")
    assert page == "a3"
    assert larger.target.large.side_m > found.target.large.side_m
    with pytest.raises(InvalidValue, match="is not inside the magnet"):
        suggest_target(camera_of(250.0), Optics(1.5), profile, 0.008, 4.0)


def test_the_text_and_the_record_hold_the_ranges(paper_design: TargetDesign) -> None:
    record = paper_design.record()
    assert record["z1_m"] == paper_design.ranges.z1_m
    assert record["warnings"] == []
    text = paper_design.text("camera.yaml")
    assert f"z1        {100 * paper_design.ranges.z1_m:.3g} cm" in text
    assert "no gap from search" in text


def test_a_gap_on_the_ground_is_named_where_the_target_is_the_position() -> None:
    """From the search height it would be near enough."""
    ranges = Ranges(3.4, 0.5, 0.16, 0.12, 0.03, 16.6, 17.0, 380.0)
    ground = short_profile({"positioning": "target"}, base="sim")
    sure_m = 380.0 * ground.target.large.side_m / SURE_PX

    def warned(profile: Profile, ceiling_m: float) -> bool:
        design = make_design(ground.target, PAPER_CAMERA, Optics(), profile, ceiling_m, ranges)
        return any("gap on the ground" in text for text in design.warnings)

    assert not warned(ground, 2.9)
    assert warned(ground, 3.4) is (0.9 * sure_m < 3.4 - 0.005)
    assert not warned(load_profile("sim"), 3.4)
