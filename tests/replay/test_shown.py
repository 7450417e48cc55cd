"""What the planner would be shown by another profile, from telemetry and times alone."""

from __future__ import annotations

import inspect
import math
import pkgutil
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import pytest

import perchctl.mission
from perchctl.analysis import replay, replay_lines, replay_record
from perchctl.analysis.replayer import Replay
from perchctl.analysis.sense import shown
from perchctl.mission import Turn
from perchctl.perception import history
from perchctl.profile import PositioningConfig, Profile, SafetyConfig, changed_profile
from perchctl.record import FlightLog
from perchctl.vehicle import Telemetry
from tests.replay.test_corpus import corpus


def what_if(log: FlightLog, *settings: str) -> Replay:
    return replay(log, None, changed_profile(log.flown_profile, settings))


def flown_by(log: FlightLog, *settings: str) -> FlightLog:
    """The log of a flight by another profile, which was shown what that makes of it."""
    was = log.flown_profile
    profile = changed_profile(was, settings)
    turns = [
        replace(each.turn, observation=each.observation) for each in shown(log.turns, was, profile)
    ]
    return with_turns(log, turns, profile)


def with_turns(log: FlightLog, turns: list[Turn], profile: Profile) -> FlightLog:
    other = replace(log, header=log.header | {"profile": profile.model_dump(mode="json")})
    other.__dict__["turns"] = turns
    return other


# --- telemetry -------------------------------------------------------------------------------


def moved(sample: Telemetry, *, x_m: float = 0.0, z_m: float = 0.0) -> Telemetry:
    x, y, z = sample.position_m
    return replace(sample, position_m=(x + x_m, y, z + z_m))


STEPS: dict[str, tuple[str, str, Callable[[Telemetry], Telemetry]]] = {
    "safety.jump_m": ("4", "0.25", lambda s: moved(s, x_m=0.6)),
    "safety.jump_z_m": ("4", "0.15", lambda s: moved(s, z_m=0.24)),
    "safety.jump_deg": ("179", "15", lambda s: replace(s, yaw_rad=s.yaw_rad + math.radians(30))),
    "safety.jump_mps": ("9", "1", lambda s: replace(s, velocity_mps=(2.5, 0.0, 0.0))),
}
"""Key; a value with which the step is none, and one with which it is; and the step."""


def stepped(key: str) -> FlightLog:
    """From tick 30 on the estimate is another."""
    log, step = corpus("stopped"), STEPS[key][2]
    at = next(t.number for t in log.turns if t.role == "flown") + 30
    turns = [
        turn
        if turn.number < at
        else replace(turn, taken=replace(turn.taken, samples=tuple(map(step, turn.taken.samples))))
        for turn in log.turns
    ]
    return with_turns(log, turns, log.flown_profile)


@pytest.mark.parametrize("key", STEPS)
def test_a_jump_is_judged_anew(key: str) -> None:
    """Flown with a wide threshold, replayed with a narrow one, and the other way round."""
    wide, narrow, _ = STEPS[key]
    log = stepped(key)
    for flown_with, replayed_with in ((wide, narrow), (narrow, wide)):
        other = flown_by(log, f"{key}={flown_with}")
        again = replay(other)
        assert again.shown is not None
        assert again.shown.first is None
        found = what_if(other, f"{key}={replayed_with}")
        assert found.shown is not None
        first = found.shown.first
        assert first is not None
        assert (first.tick, first.field) == (30, "jumped")
        assert (first.recorded, first.replayed) == (flown_with == narrow, flown_with == wide)
        assert found.decided[30].observation.jumped == (flown_with == wide)
        text = "\n".join(replay_lines(found))
        assert re.search(r"telemetry: \d+ turns would show the planner something else", text)
        assert "first:     tick 30 at" in text
        assert replay_record(found)["shown"]["first_difference"]["field"] == "jumped"
        if flown_with == wide:
            assert found.first is not None  # the planner's, which then holds
            assert found.first.tick == 30


def test_a_changed_constant_of_the_history_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pictures; then the replay is not the same."""
    log = flown_by(stepped("safety.jump_deg"))
    same_as_before = replay(log).shown
    assert same_as_before is not None
    assert same_as_before.first is None
    monkeypatch.setattr(history, "FASTEST_TURN_RADPS", 7.000001)
    found = replay(log)
    assert found.shown is not None
    assert found.shown.first is not None
    assert found.shown.first.field == "turned_rad"
    assert not found.same
    text = "\n".join(replay_lines(found))
    assert "telemetry: 1 turns show the planner something else" in text


# --- positions from outside --------------------------------------------------------------------


def test_another_latency_of_a_capture_makes_positions_older() -> None:
    log = corpus("external-occluded")
    found = what_if(log, "positioning={by: mocap, latency_s: 0.04, host: x}")
    later_s = 0.04 - log.flown_profile.positioning.latency_s
    assert found.shown is not None
    assert found.shown.first is not None
    assert found.shown.first.field == "position_age_s"
    for each in found.decided:
        assert each.turn.observation is not None
        was_s = each.turn.observation.position_age_s
        assert each.observation.position_age_s == pytest.approx(was_s + later_s)


# --- what cannot be judged ---------------------------------------------------------------------


def planner_s() -> str:
    """The text of what the planner is made of."""
    names = [m.name for m in pkgutil.iter_modules(perchctl.mission.__path__, "perchctl.mission.")]
    return "\n".join(inspect.getsource(import_module(name)) for name in names)


def test_each_key_is_judged_or_said() -> None:
    """A key of `safety` or `positioning` acts on the planner, or on what it is shown, or a note
    says what a replay cannot tell of it."""
    log, text = corpus("stopped"), planner_s()
    rerun = {key.removeprefix("safety.") for key in STEPS}
    keys = [("safety", key) for key in SafetyConfig.model_fields]
    keys += [("positioning", key) for key in PositioningConfig.model_fields]
    for section, key in keys:
        planned = re.search(rf"\b{section}\.{key}\b", text) is not None
        noted = said_of(log, f"{section}.{key}")
        assert planned or noted or key in rerun or key == "latency_s", key
        if key in ("hold_s", "land_s", *rerun):
            assert not noted, key


def said_of(log: FlightLog, key: str) -> bool:
    from perchctl.analysis.replayer import notes_of

    notes = notes_of(log, "", "", [key], pictures=False)
    return any(note.startswith(f"{key}: ") for note in notes)


def test_what_was_asked_before_take_off_is_said() -> None:
    found = what_if(corpus("stopped"), "safety.min_rest_v=3.9")
    assert any("before take-off only" in note for note in found.notes)
    lines = replay_lines(found)
    assert any("no command would have been another" in line for line in lines)
