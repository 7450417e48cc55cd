"""A flight's sentences say what its log holds, at the times at which it was."""

from __future__ import annotations

from typing import Any

import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.story import ACTIONS, FINAL_PHASE_TEXTS, Sentence, height_text, tell_story
from perchctl.mission import Phase
from tests.helpers.log import GONE_S, PLAN
from tests.helpers.mission import note
from tests.helpers.told import START_S, SUMMARY, Change, entered, flown_s, made


def story(change: Change = lambda record: None, **more: Any) -> list[Sentence]:
    return list(tell_story(FlightAnalysis(made(change, **more))))


def only(told: list[Sentence], words: str) -> Sentence:
    found = [sentence for sentence in told if words in sentence.text]
    assert len(found) == 1, [f"{s.t_s:.2f} {s.text}" for s in told]
    return found[0]


def test_each_phase_has_its_sentence_at_its_time() -> None:
    assert {*ACTIONS, *FINAL_PHASE_TEXTS} == {phase.value for phase in Phase}
    told = story()
    steps = [s for s in told if s.grade in ("step", "good") and "motors were" not in s.text]
    begins, at_s = [], 0.0
    for _phase, duration_s, _reason in PLAN:
        begins.append(at_s)
        at_s += duration_s
    assert [s.t_s for s in steps] == pytest.approx(begins, abs=0.03)
    assert steps[2].text.startswith("Target seen, 1.02 m below the target and ")
    assert steps[4].text.endswith("off centre: it climbed")


@pytest.mark.parametrize(
    ("below_m", "text"),
    [(0.31, "31 cm below"), (0.0, "0.0 mm below"), (-0.0013, "1.3 mm above")],
)
def test_a_height_has_no_sign(below_m: float, text: str) -> None:
    assert height_text(below_m) == text


def nothing(record: dict[str, Any]) -> None:
    """The made-up flight itself: in its gap no picture comes."""


def blank_frames(record: dict[str, Any]) -> None:
    """In the gap frames come, and hold no target."""
    n = round(flown_s(record) / 0.02)
    if GONE_S[0] < flown_s(record) < GONE_S[1] and n % 2 == 0:
        record |= {"frame": n // 2, "frame_t_s": record["t_s"], "measured": False}


def backed_off(record: dict[str, Any]) -> None:
    if 9.0 <= flown_s(record) < 10.0:
        record |= {"phase": "RECOVER", "reason": "target lost during the ascent"}


def held(record: dict[str, Any]) -> None:
    """One hold, however its reason counts."""
    for_s = flown_s(record) - 7.0
    if 0.0 <= for_s < 0.8:
        record["hold"] = f"no picture for {for_s:.1f} s"


def cut(record: dict[str, Any]) -> None:
    """After the stop of a failed contact."""
    if 9.0 <= flown_s(record) < 9.1:
        record["cmd"] = "stop"
    if flown_s(record) >= 16.0:
        record["cmd"] = "emergency"


@pytest.mark.parametrize(
    ("change", "t_s", "grade", "text"),
    [
        (nothing, GONE_S[0], "warn", "No usable picture arrived for 0.5 s"),
        (blank_frames, GONE_S[0], "warn", "was lost for 0.5 s: 12 frames without it"),
        (nothing, 15.2, "step", "The motors were stopped"),
        (backed_off, 9.0, "warn", "Target lost during the ascent: it backed off"),
        (held, 7.0, "warn", "Held in place for 0.8 s: no picture for 0.8 s"),
        (cut, 9.0, "step", "The motors were stopped"),
        (cut, 16.0, "bad", "cut and locked"),
    ],
)
def test_what_happened_is_told_once_with_its_time(
    change: Change, t_s: float, grade: str, text: str
) -> None:
    found = only(story(change), text)
    assert (found.grade, found.t_s) == (grade, pytest.approx(t_s, abs=0.05))


def test_at_the_ceiling_nothing_is_lost() -> None:
    def change(record: dict[str, Any]) -> None:
        if record["phase"] in ("PERCH", "COMPLETE", "PERCHED"):
            record |= dict.fromkeys(("frame", "frame_t_s", "lx_m", "sx_m", "jx_m"))

    seen = FlightAnalysis(made(change)).target_losses
    assert [round(loss.start_s, 1) for loss in seen] == [GONE_S[0]]


def test_notes_and_what_the_simulation_did_are_told() -> None:
    events = (
        entered(3.0, Phase.SEARCH, PLAN[1][2], "approached", "the target hangs askew"),
        note(START_S + 9.0, "something happened"),
    )
    told = story(events=events)
    assert "(the simulation: the target hangs askew)" in only(told, "Hovering").text
    assert only(told, "Something happened").t_s == pytest.approx(9.0)


def test_each_harm_of_the_end_is_told() -> None:
    harm = {"locked": True, "fell": True, "touchdown_mps": 1.4, "touchdown_g": 6.0}
    told = story(summary=SUMMARY | harm)
    for words in ("locked the vehicle", "touched down hard: 1.4 m/s, 6.0 g", "The vehicle fell"):
        assert only(told, words).grade == "bad"
    assert "touched down" not in str(story(summary=SUMMARY | harm | {"touchdown_mps": 0.3}))


def test_a_log_of_the_first_version_and_one_without_a_tick() -> None:
    """The first version knew no events, and not whether the target was tracked."""
    assert "Perched" in story(lambda record: record.update(tracked=None), version=1)[-1].text
    log = made()
    log.records.clear()
    assert tell_story(FlightAnalysis(log)) == ()
