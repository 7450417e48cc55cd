"""A flight's sentences say what its log holds, at the times at which it was."""

from __future__ import annotations

from typing import Any

import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.story import Sentence, story_of
from perchctl.mission import Phase
from tests.helpers.log import GONE_S, PLAN
from tests.helpers.mission import note
from tests.helpers.told import START_S, Change, entered, flown_s, made

FRAME_KEYS = ("large_px", "small_px", *(f"{s}{k}" for s in "lsj" for k in
              ("x_m", "y_m", "z_m", "yaw_rad", "_rms_px")))  # fmt: skip


def story(change: Change = lambda record: None, **more: Any) -> list[Sentence]:
    return list(story_of(FlightAnalysis(made(change, **more))))


def only(told: list[Sentence], words: str) -> Sentence:
    found = [sentence for sentence in told if words in sentence.text]
    assert len(found) == 1, [f"{s.t_s:.2f} {s.text}" for s in told]
    return found[0]


def blank_frames(record: dict[str, Any]) -> None:
    """In the gap frames come, and hold no target."""
    n = round(flown_s(record) / 0.02)
    if GONE_S[0] < flown_s(record) < GONE_S[1] and n % 2 == 0:
        record |= {"frame": n // 2, "frame_t_s": record["t_s"], "measured": False}


def test_each_phase_has_its_sentence_at_its_time() -> None:
    told = story()
    steps = [s for s in told if s.grade in ("step", "good") and "motors were" not in s.text]
    begins, at_s = [], 0.0
    for _phase, duration_s, _reason in PLAN:
        begins.append(at_s)
        at_s += duration_s
    assert [s.t_s for s in steps] == pytest.approx(begins, abs=0.03)
    assert "Found the target 1.02 m above" in steps[2].text
    assert "after 4.0 s" in only(told, "Aligned").text
    assert only(told, "motors were stopped").t_s == pytest.approx(15.2, abs=0.03)


def test_a_loss_says_when_how_long_and_how_many_frames() -> None:
    lost = only(story(blank_frames), "was lost")
    assert lost.t_s == pytest.approx(GONE_S[0], abs=0.05)
    assert "lost for 0.5 s: 12 frames without it, at 0.0 m/s" in lost.text
    assert lost.grade == "warn"


def test_without_frames_it_was_the_pictures_that_did_not_come() -> None:
    assert only(story(), "No picture").text.startswith("No picture that could be used came")


def test_backing_off_says_by_how_much() -> None:
    def change(record: dict[str, Any]) -> None:
        blank_frames(record)
        if 5.2 <= flown_s(record) < 6.0:
            record |= {"phase": "RECOVER", "reason": "target lost in ascent"}
            record["z_m"] = 1.3 - min(0.1, 0.2 * (flown_s(record) - 5.2))
        if flown_s(record) >= 6.0 and record["phase"] == "ALIGN":
            record |= {"phase": "ESTIMATE", "reason": "steady again, trying once more"}

    told = story(change)
    assert "Target lost in ascent: backed off 10 cm" in only(told, "Target lost").text


def test_how_far_it_backed_off_counts_from_the_first_known_height() -> None:
    def change(record: dict[str, Any]) -> None:
        if 9.0 <= flown_s(record) < 10.0:
            record |= {"phase": "RECOVER", "reason": "target lost in ascent"}
            record["z_m"] = 1.5 - 0.2 * (flown_s(record) - 9.0)
            if flown_s(record) < 9.05:
                record["z_m"] = None

    assert "backed off 18 cm" in only(story(change), "Target lost").text


def test_a_cut_after_a_failed_contact_s_stop_is_told() -> None:
    def change(record: dict[str, Any]) -> None:
        if 9.0 <= flown_s(record) < 9.1:
            record["cmd"] = "stop"
        if flown_s(record) >= 16.0:
            record["cmd"] = "emergency"

    told = story(change)
    assert only(told, "motors were stopped").t_s == pytest.approx(9.0, abs=0.03)
    cut = only(told, "cut and locked")
    assert (cut.grade, cut.t_s) == ("bad", pytest.approx(16.0, abs=0.03))


def test_at_the_ceiling_nothing_is_lost() -> None:
    def change(record: dict[str, Any]) -> None:
        if record["phase"] in ("PERCH", "COMPLETE", "PERCHED"):
            for key in (*FRAME_KEYS, "frame", "frame_t_s"):
                record[key] = None

    seen = FlightAnalysis(made(change)).losses
    assert [round(loss.start_s, 1) for loss in seen] == [GONE_S[0]]


def test_a_hold_is_one_sentence_however_its_reason_counts() -> None:
    def change(record: dict[str, Any]) -> None:
        for_s = flown_s(record) - 7.0
        if 0.0 <= for_s < 0.8:
            record["hold"] = f"no picture for {for_s:.1f} s"

    held = only(story(change), "Held")
    assert held.t_s == pytest.approx(7.0, abs=0.03)
    assert held.text == "Held in place for 0.8 s: no picture for 0.8 s"


def test_notes_and_what_the_simulation_did_are_told() -> None:
    events = (
        entered(3.0, Phase.SEARCH, PLAN[1][2], "approached", "the target hangs askew"),
        note(START_S + 9.0, "something happened"),
    )
    told = story(events=events)
    assert "(the simulation: the target hangs askew)" in only(told, "hovered").text
    assert only(told, "Something happened").t_s == pytest.approx(9.0)


def test_a_killed_flight_has_no_end() -> None:
    def change(record: dict[str, Any]) -> None:
        if record["phase"] in ("COMPLETE", "PERCHED"):
            record["phase"] = "PERCH"

    last = story(change, summary=None)[-1]
    assert last.grade == "bad"
    assert "The log ends here, in PERCH at 1.87 m" in last.text
    assert "not known" in last.text


def test_a_log_of_the_first_version_is_told() -> None:
    """It knew no events, and not whether the target was tracked."""

    def change(record: dict[str, Any]) -> None:
        record["tracked"] = None

    assert "Perched" in story(change, version=1)[-1].text


def test_a_log_without_a_tick_has_no_story() -> None:
    log = made()
    log.records.clear()
    assert story_of(FlightAnalysis(log)) == ()
