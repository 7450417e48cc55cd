"""A profile written as a file with comments, the schema for editors, and the picture in words."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from perchctl.commands.profile import (
    PICTURE_EDGES,
    front_left_edges,
    left_edges,
    yaw_deg_and_mirrored,
)
from perchctl.profile import Mounting, Profile, json_schema, load_profile, profile_text
from perchctl.profile.keys import keys
from tests.helpers.flights import short_profile

HOSTILE = "a: b # c, 'd' \"e\" [f] {g} \\ \N{GREEK SMALL LETTER MU}\nnext: line"


def uncommented(text: str) -> list[str]:
    """Keys with a value of their own and no comment on the line above."""
    lines = text.splitlines()
    return [
        line
        for above, line in itertools.pairwise(["", *lines])
        if line.strip() and not line.lstrip().startswith("#")
        and not line.endswith(":") and not above.lstrip().startswith("#")
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["sim", "paper", "crazyflie", "fpv", "aideck", "rough", "extreme"])
def test_a_written_profile_is_read_as_it_was(name: str, tmp_path: Path) -> None:
    profile = load_profile(name)
    text = profile_text(profile)
    (tmp_path / "again.yaml").write_text(text, encoding="utf-8")
    assert load_profile(str(tmp_path / "again.yaml")) == profile
    assert uncommented(text) == []
    assert max(len(line) for line in text.splitlines() if line.lstrip().startswith("#")) <= 80


def test_a_hostile_text_stays_a_text(tmp_path: Path) -> None:
    profile = short_profile({"description": HOSTILE, "link.parameters": {"a.b": 1e-7}}, base="sim")
    (tmp_path / "again.yaml").write_text(profile_text(profile), encoding="utf-8")
    assert load_profile(str(tmp_path / "again.yaml")) == profile


def test_the_schema_holds_each_key_with_meaning_and_unit() -> None:
    schema = json_schema()
    assert "extends" in schema["properties"]
    for key in keys(Profile()):
        section = schema
        *names, last = key.path.split(".")
        for name in names:
            reference = section["properties"][name]["$ref"]
            section = schema["$defs"][reference.removeprefix("#/$defs/")]
        said = section["properties"][last]["description"]
        assert said == key.meaning + (f" ({key.unit})" if key.unit else "")
        assert section["additionalProperties"] is False
        assert "required" not in section


PLACES = {"front": (1.0, 0.0, 0.0), "left": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize("front", PICTURE_EDGES)
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_hand_over_the_vehicle_comes_in_where_it_was_said(front: str, mirrored: bool) -> None:
    """A point above the vehicle's front, or its left side, is seen at that edge."""
    left = left_edges(front)[int(mirrored)]
    turn_deg, found_mirrored = yaw_deg_and_mirrored(front, left)
    assert found_mirrored is mirrored
    mount = Mounting(position_m=(0, 0, 0), rpy_deg=(0, 0, turn_deg))
    for side, edge in (("front", front), ("left", left)):
        above = np.add(PLACES[side], (0, 0, 1))
        x, y, z = mount.T_body_cam[:3, :3].T @ above
        seen = (-x if mirrored else x, y)  # in the picture as the camera gives it
        assert z > 0
        np.testing.assert_allclose(seen, PICTURE_EDGES[edge], atol=1e-12)
    assert front_left_edges(mount, mirrored) == (front, left)
