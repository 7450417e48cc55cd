"""`--positioning`, its words and limits, and what the plan says of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.testing import CliRunner, Result

from perchctl.commands import app
from perchctl.commands.fly import with_positioning
from perchctl.profile import PositioningConfig, Profile
from perchctl.profile.positioning import MOST_CAPTURE_LATENCY_S

REAL = ("-u", "udp://127.0.0.1:1", "--source", "http://127.0.0.1:1/x", "--yes")


def fly(*words: str) -> Result:
    result = CliRunner().invoke(app, ["fly", *words])
    assert "Traceback" not in result.output
    return result


@pytest.mark.parametrize(("section", "words"), [
    *((text, "found 'Lighthouse'; allowed are deck, mocap, target; write deck")
      for text in ("Lighthouse", "{by: Lighthouse}")),
    ("{host: lab}", "by is deck: write by: mocap"), ("{by: deck, host: lab}", "but positioning.by"),
    *((f"{{by: mocap, host: '{host}'}}", f"found '{host}'")
      for host in ("http://lab", "lab:0", "lab:x", "lab/1", "a b")),
])  # fmt: skip
def test_a_section_that_cannot_be_meant_is_refused(
    tmp_path: Path, section: str, words: str
) -> None:
    profile = tmp_path / "lab.yaml"
    profile.write_text(f"extends: sim\npositioning: {section}\n", encoding="utf-8")
    done = fly("-p", str(profile), "--dry-run")
    assert done.exit_code == 30
    assert words in done.stderr


@pytest.mark.parametrize(("words", "by", "said"), [
    (("--positioning", "mocap"), "mocap", "motion capture in the simulated room, body 'crazyflie'"),
    (("-p", "LAB", "--positioning", "deck"), "deck", "the vehicle's own deck"),
    (("-p", "target_only"), "target", "the target, seen by the camera"),
])  # fmt: skip
def test_the_option_wins_over_the_profile_and_the_plan_says_so(
    words: tuple[str, ...], by: str, said: str, tmp_path: Path
) -> None:
    """And the record can be read again."""
    pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")
    profile = tmp_path / "lab.yaml"
    profile.write_text("extends: sim\npositioning: {by: mocap, host: lab}\n", encoding="utf-8")
    words = tuple(str(profile) if word == "LAB" else word for word in words)
    done = fly(*words, "--dry-run", "--json")
    assert done.exit_code == 0, done.output
    assert Profile.model_validate(json.loads(done.stdout)["profile"]).positioning.by == by
    assert f"positioning  {said}" in fly(*words, "--dry-run").stdout


def test_the_name_of_a_deck_leads_to_deck() -> None:
    done = fly("--positioning", "lighthouse")
    assert done.exit_code == 30
    assert "allowed are deck, mocap, target; write deck" in done.stderr
    assert "write deck" not in fly("--positioning", "gps").stderr


def test_the_target_brings_its_own_limits_and_leaves_none_behind() -> None:
    """Its places come late and with gaps; a capture's, or a deck's, flight keeps its own."""
    own = PositioningConfig.model_validate({"by": "target"})
    deck, mocap = Profile(), Profile.model_validate({"positioning": {"by": "mocap", "host": "lab"}})
    for profile in (deck, mocap):
        assert with_positioning(profile, "target").positioning == own
    back = with_positioning(with_positioning(deck, "target"), "mocap").positioning
    assert back == PositioningConfig.model_validate({"by": "mocap"})
    assert with_positioning(mocap, "mocap").positioning == mocap.positioning
    named = Profile.model_validate({"positioning": {"by": "deck", "body": "cf2"}})  # for the option
    assert with_positioning(named, "mocap").positioning.body == "cf2"


@pytest.mark.parametrize(("words", "complaints"), [
    (("gps", "--dry-run"), ("'gps' is unknown; allowed are deck, mocap, target",)),
    (("mocap", *REAL), ("positioning.host", "vicon, optitrack, qualisys or vrpn", "body")),
])  # fmt: skip
def test_other_words_and_a_capture_without_a_computer_are_refused(
    words: tuple[str, ...], complaints: tuple[str, ...]
) -> None:
    done = fly("--positioning", *words)
    assert done.exit_code == 30
    assert all(each in done.stderr for each in complaints)


@pytest.mark.parametrize("late", [
    {"rate_hz": 10.0, "latency_s": MOST_CAPTURE_LATENCY_S}, {"hold_s": 0.03},
])  # fmt: skip
def test_a_hold_that_each_perfect_frame_would_reach_is_refused(late: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="a position is stale before the next one arrives"):
        PositioningConfig(by="mocap", host="lab", **late)
    PositioningConfig(by="mocap", host="lab", **{**late, "hold_s": 0.4})
    with pytest.raises(ValidationError, match="less than or equal to"):
        PositioningConfig(by="mocap", host="lab", latency_s=MOST_CAPTURE_LATENCY_S + 0.01)
