"""Pictures seen again: the loop's own senses, fed by what a flight took in."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.analysis import replay
from perchctl.analysis.replayer import Replay
from perchctl.analysis.sense import Picture
from perchctl.errors import InvalidValue
from perchctl.flight import fly
from perchctl.mission import OperatorRequest, Phase, Tick
from perchctl.perception import perception
from perchctl.profile import apply_settings
from perchctl.record import FlightLog, LogWatcher, read_log
from perchctl.record.header import make_header
from perchctl.vision import Frame, Pipeline, PipelineState
from tests.helpers.hangs import hang_in_the_camera, hang_in_the_planner
from tests.helpers.loop_rig import PROFILE, Camera, Rig, SleepyClock, Vehicle


@dataclass
class Kept:
    """The pictures of a flight, as a recording has them: without the repeated ones."""

    pictures: list[Picture] = field(default_factory=list)

    def keep(self, frame: Frame) -> Frame:
        if frame.index % 7 == 0:  # a receiver that gives one out again, with noise or without
            index, _, image = self.pictures[-1]
            again = image.copy()
            again[0, 0] ^= np.uint8(frame.index % 2)
            return replace(frame, index=index, image=again, is_repeated=True)
        self.pictures.append((frame.index, frame.t_s, frame.image))
        return frame


def flown(folder: Path, rig: Rig) -> tuple[FlightLog, list[Picture]]:
    """A flight on a scripted vehicle, ended by the operator while it approaches."""
    kept, pressed = Kept(), [OperatorRequest.NONE]
    rig.camera.alter = kept.keep
    rig.operator = lambda: pressed[0]

    def press(tick: Tick) -> None:
        if tick.t_s > 0.3 and tick.state.phase is Phase.APPROACH:
            pressed[0] = OperatorRequest.LAND

    rig.watcher.on_tick = press
    header = make_header(PROFILE, uri="sim://", source="sim:", lockstep=True)
    log = LogWatcher.open(folder / "f.jsonl", header)
    parts = rig.parts()
    report = fly(replace(parts, watchers=(*parts.watchers, log)))
    log.close(report)
    return read_log(log.path), kept.pictures


def seen_again(log: FlightLog, pictures: list[Picture]) -> Replay:
    """By the pipeline of the rig: its camera is smaller than the profile's."""
    return replay(log, pictures, pipeline=Rig().setup)


def begun(log: FlightLog) -> FlightLog:
    """Of a flight that was killed soon."""
    return replace(log, turn_records=log.turn_records[:50])


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlightLog, list[Picture]]:
    return flown(tmp_path_factory.mktemp("flight"), Rig())


def test_what_was_seen_is_seen_again(flight: tuple[FlightLog, list[Picture]]) -> None:
    log, pictures = flight
    found = seen_again(log, pictures)
    assert found.seen is not None
    assert (found.differences, found.seen.differences, found.seen.end_reason) == ([], [], "")
    assert found.is_identical
    assert len(found.seen.turns) == len(log.turns)
    assert found.ticks == len(log.records)
    assert any(turn.role == "waiting" for turn in log.turns)


def test_turns_that_hung_are_replayed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Suspended between two turns; in the camera, where more telemetry comes meanwhile; and in
    the planner, whose decision is then not sent, and made anew."""
    link = Vehicle()
    rig = Rig(link=link, clock=SleepyClock(link, 0.4, 0.2))
    hang_in_the_camera(link, rig.camera, at_s=0.7)
    hang_in_the_planner(link, monkeypatch, at_s=1.6)
    log, pictures = flown(tmp_path, rig)
    assert any(turn.inputs.late_samples for turn in log.turns)
    redone = [turn for turn in log.turns if turn.role == "redone"]
    assert redone
    found = seen_again(log, pictures)
    assert found.is_identical
    assert found.ticks == len(log.records) == len(found.decisions) - len(redone)
    assert found.seen is not None
    assert not found.seen.end_reason


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlightLog, list[Picture]]:
    """A flight whose camera ends on the way."""
    return flown(tmp_path_factory.mktemp("ended"), Rig(camera=Camera(frames=40)))


def test_a_source_that_ends_does_so_again(ended: tuple[FlightLog, list[Picture]]) -> None:
    """By its own name, which the planner was shown."""
    log, pictures = ended
    observed = [turn.observation for turn in log.turns if turn.observation is not None]
    assert observed[-1].camera_problem == "the scripted camera has ended"
    assert seen_again(log, pictures).is_identical


@pytest.mark.parametrize("told", ["the picture is dark", "another camera has ended"])
def test_another_problem_of_a_source_that_has_ended_is_a_difference(
    ended: tuple[FlightLog, list[Picture]], told: str
) -> None:
    """Its name is taken from the log, and nothing else of its problem."""
    log, pictures = ended
    turns = list(log.turns)
    obs = turns[-1].observation
    assert obs is not None
    turns[-1] = replace(turns[-1], observation=replace(obs, camera_problem=told))
    other = replace(log)
    other.__dict__["turns"] = turns
    found = seen_again(other, pictures)
    assert found.seen is not None
    (differs,) = found.seen.differences
    assert differs.field == "camera_problem"


def test_with_another_latency_the_pictures_are_of_another_time(
    flight: tuple[FlightLog, list[Picture]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are still found, by the recorded time."""
    log, given_s = begun(flight[0]), []
    inside = perception.deinterlace

    def looked_at(state: PipelineState, frame: Frame, pipeline: Pipeline) -> Any:
        given_s.append(frame.t_s)
        return inside(state, frame, pipeline)

    monkeypatch.setattr(perception, "deinterlace", looked_at)
    seen_again(log, flight[1])
    as_flown_s = given_s.copy()
    given_s.clear()
    latency_s = PROFILE.camera.start_latency_s + 0.02
    found = replay(
        log, flight[1], apply_settings(PROFILE, [f"camera.latency_s={latency_s}"]), Rig().setup
    )
    assert found.seen is not None
    assert not found.seen.end_reason
    assert given_s == pytest.approx([t_s - 0.02 for t_s in as_flown_s])
    assert given_s


def altered(pictures: list[Picture]) -> list[Picture]:
    index, t_s, image = pictures[20]
    other = image.copy()
    other[3, 4] ^= 1
    return [*pictures[:20], (index, t_s, other), *pictures[21:]]


def damaged(pictures: list[Picture]) -> Iterator[Picture]:
    yield from pictures
    raise InvalidValue("the recording is torn")


@pytest.mark.parametrize(
    ("change", "frames", "same", "why"),
    [
        (altered, 20, False, "differs from the one that the flight used"),
        (lambda pictures: [*pictures[:20], *pictures[21:]], 20, True, "was not recorded"),
        (lambda pictures: pictures[:20], 20, True, "was not recorded"),
        (lambda pictures: [], 0, True, "was not recorded"),
        (lambda pictures: damaged(pictures[:20]), 20, True, "the recording is torn"),
    ],
)
def test_what_is_wrong_with_the_pictures_ends_them_and_not_the_planner_s_replay(
    flight: tuple[FlightLog, list[Picture]],
    change: Callable[[list[Picture]], Any],
    frames: int,
    same: bool,
    why: str,
) -> None:
    """From there on the pipeline would remember another flight; what came before counts."""
    log, pictures = begun(flight[0]), flight[1]
    found = replay(log, change(pictures), pipeline=Rig().setup)
    assert found.seen is not None
    assert why in found.seen.end_reason
    assert found.seen.end_reason in found.notes
    assert (found.differences, found.seen.differences, found.is_identical) == ([], [], same)
    assert abs(found.seen.frames - frames) <= 5  # a repeated one is a frame, and no picture
    assert len(found.seen.turns) < len(log.turns) == 50
    assert found.ticks > 20  # the planner needs no picture
    line, record = found.lines()[-1], found.record()["pictures"]
    assert f"up to frame {found.seen.frames} of {found.seen.frames_flown}" in line
    assert ("bit-identical poses" in line) is (frames > 0)
    assert why in record["ended"]


def older(log: FlightLog, path: str, known: dict[str, list[str]] | None) -> FlightLog:
    """As one would have it that does not know a field of the observation yet; `known`: the names
    that its header has."""
    *owners, name = path.split(".")
    records = copy.deepcopy(log.turn_records)
    for record in records:
        part = record.get("observation")
        for owner in owners:
            part = part and part.get(owner)
        if part:
            part.pop(name, None)
    return replace(log, turn_records=records, header=log.header | {"turn_fields": known})


@pytest.mark.parametrize(
    ("path", "owner", "says_so"),
    [
        ("imu.steady_aside_s", "ImuMotion", True),
        # It is always written, and is not there.
        pytest.param("imu.steady_aside_s", "ImuMotion", False, marks=pytest.mark.long),
        ("imu", "Observation", False),
        # Left out while there is none.
        pytest.param("camera_problem", "Observation", True, marks=pytest.mark.long),
    ],
)
def test_a_field_that_the_log_does_not_hold_is_not_compared_and_named(
    ended: tuple[FlightLog, list[Picture]], path: str, owner: str, says_so: bool
) -> None:
    log, pictures = ended
    all_known = log.header["turn_fields"]
    known = {**all_known, owner: [n for n in all_known[owner] if n != path.split(".")[-1]]}
    found = seen_again(older(log, path, known if says_so else None), pictures)
    assert found.seen is not None
    assert not found.seen.differences
    assert found.uncompared == [path] or {n.split(".")[0] for n in found.uncompared} == {path}
    assert found.record()["not_compared"] == found.uncompared
    assert any(path in note and "not compared" in note for note in found.notes)
    lost = seen_again(older(log, path, all_known), pictures)
    assert lost.seen is not None
    assert lost.seen.differences[0].field.startswith(path)
    assert lost.uncompared == []


def test_a_field_that_may_have_been_none_is_compared(
    ended: tuple[FlightLog, list[Picture]],
) -> None:
    """In a log that does not say which fields it knows: the camera may have had no problem."""
    log, pictures = ended
    found = seen_again(older(log, "camera_problem", None), pictures)
    assert found.seen is not None
    assert found.seen.differences[0].field == "camera_problem"


def test_a_pose_that_differs_is_named(flight: tuple[FlightLog, list[Picture]]) -> None:
    log, pictures = begun(flight[0]), flight[1]
    turns = list(log.turns)
    at = next(k for k, turn in enumerate(turns) if turn.role == "flown") + 10
    obs = turns[at].observation
    assert obs is not None
    turns[at] = replace(
        turns[at], observation=replace(obs, last_good_frame_age_s=obs.last_good_frame_age_s + 1e-15)
    )
    other = replace(log)
    other.__dict__["turns"] = turns
    found = seen_again(other, pictures)
    assert found.seen is not None
    (differs,) = found.seen.differences
    assert (differs.tick, differs.field) == (10, "camera_age_s")
    assert not found.is_identical
