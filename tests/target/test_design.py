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
from perchctl.target import make_design, suggest_target
from perchctl.target.design import TargetDesign
from perchctl.target.reading import check_target
from perchctl.target.sheets import fits
from perchctl.target.sight import SURE_PX, FieldOfView, square_outline, turned_outline
from tests.helpers.flights import short_profile
from tests.target.rig import camera_of, sized

TARGET = TargetConfig()
ROOT = Path(__file__).resolve().parents[2]
PAPER_CAMERA = camera_of(380.0)
AHEAD = (np.eye(3), np.zeros(3))


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
    return make_design(TARGET, PAPER_CAMERA, 2.5, profile, 2.4)


@pytest.mark.long
@pytest.mark.parametrize(("focal_px", "blur_px"), [(250.0, 2.5), (380.0, 1.5)])
def test_ranges_agree_with_the_renderer(bench: ModuleType, focal_px: float, blur_px: float) -> None:
    """The other cameras and blurs: benchmarks/ranges_by_design.py."""
    for name, designed, measured in bench.measure(focal_px, blur_px, TARGET):
        assert designed == pytest.approx(measured, rel=0.15), name


def test_the_paper_s_ranges_and_where_they_differ(paper_design: TargetDesign) -> None:
    """z2 and z3 agree; a blur that explains z1 = 115 cm would be 3.5 px, not 2.5."""
    design = paper_design
    assert design.z2_m == pytest.approx(0.25, rel=0.15)
    assert design.z3_upright_m == pytest.approx(0.12, rel=0.05)
    assert design.z3_m == pytest.approx(0.17, rel=0.05), "facing across, it needs more room"
    assert design.z1_m is not None
    assert 1.15 < design.z1_m < 1.75
    assert f"z1        {100 * design.z1_m:.3g} cm" in design.text("camera.yaml")
    assert design.record()["warnings"] == []


def test_z3_is_the_geometry_s() -> None:
    view = FieldOfView(PAPER_CAMERA, margin_px=0.0)
    upright, turned = square_outline(0.15), turned_outline(0.15)
    nearest_m = 0.15 * 380.0 / 480.0
    assert view.nearest_m(upright, *AHEAD) == pytest.approx(nearest_m, rel=2e-3)
    assert view.nearest_m(turned, *AHEAD) == pytest.approx(math.sqrt(2.0) * nearest_m, rel=2e-3)
    barrel = FieldOfView(camera_of(380.0, (-0.17, 0.04, 0.0, 0.0, 0.0)), margin_px=0.0)
    shown = barrel.nearest_m(turned, *AHEAD)
    assert shown is not None
    assert shown < 0.99 * math.sqrt(2.0) * nearest_m, "barrel distortion shows more"
    behind = np.diag([1.0, -1.0, -1.0])
    assert view.nearest_m(turned, behind, np.zeros(3)) is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"z1_m": 0.9}, "gap at the start"),
        ({"z2_m": 0.15}, "gap between the markers"),
        ({"z1_m": None}, "never read"),
        ({"small_nearest_m": 0.2}, "gap before contact"),
        ({"small_nearest_m": None}, "gap before contact"),
    ],
)
def test_gaps_are_named(paper_design: TargetDesign, changes: dict[str, Any], said: str) -> None:
    warnings = dataclasses.replace(paper_design, **changes).warnings
    assert len(warnings) == bool(said)
    assert said in "".join(warnings)


def test_a_gap_on_the_ground_is_named_where_the_target_is_the_position(
    paper_design: TargetDesign,
) -> None:
    """From the search height it would be near enough."""
    ground = short_profile({"positioning": "target"}, base="sim")
    sure_m = 380.0 * 0.150 / SURE_PX
    for ceiling_m, gap in ((0.9 * sure_m, False), (1.1 * sure_m, True)):
        design = make_design(TARGET, PAPER_CAMERA, 0.6, ground, ceiling_m)
        assert any("gap at the start" in text for text in design.warnings) is gap


@pytest.mark.long
@pytest.mark.parametrize(
    ("focal_px", "blur_px", "ceiling_m"), [(380.0, 2.0, 2.4), (250.0, 0.6, None)]
)
def test_what_is_suggested_covers_the_way(
    profile: Profile, focal_px: float, blur_px: float, ceiling_m: float | None
) -> None:
    found, page = suggest_target(camera_of(focal_px), blur_px, profile, 0.05, ceiling_m)
    assert page == "a4"
    assert found.warnings == ()
    assert found.z1_m is not None
    assert found.z1_m >= (1.15 if ceiling_m is None else ceiling_m - 1.3)
    check_target(found.target, 0.05)
    assert fits(found.target, "a4")
    assert not fits(sized(1e3 * found.target.large.side_m + 5, 25.0), "a4")


@pytest.mark.long
def test_a_larger_page_or_a_smaller_magnet_gives_other_sizes(profile: Profile) -> None:
    camera, blur_px = camera_of(380.0), 2.0
    found, _ = suggest_target(camera, blur_px, profile, 0.05, 2.4)
    assert found.target.large.side_m > profile.target.large.side_m
    larger, page = suggest_target(camera, blur_px, profile, 0.05, 2.4, "a3")
    assert page == "a3"
    assert larger.target.large.side_m > found.target.large.side_m
    with pytest.raises(InvalidValue, match="is not inside the magnet"):
        suggest_target(camera_of(250.0), 1.5, profile, 0.008, 4.0)
