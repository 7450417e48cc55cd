"""A flight decided again: what differs is named, what is lost is said, what if is told."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import perchctl
from perchctl.analysis import replay
from perchctl.analysis.decide import Comparison
from perchctl.analysis.replayer import CAUTION, Replay, changed_keys
from perchctl.errors import EXIT_CODES, InvalidValue, ReplayDiffers
from perchctl.mission import TickRecord, setpoints, step_mission
from perchctl.profile import Profile, apply_settings
from perchctl.record import FlightLog, LogWatcher, json_line, read_log
from perchctl.record.header import make_header
from perchctl.vehicle import Idle, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.commands import run
from tests.helpers.decided import decided_here
from tests.helpers.hangs import plan_by

Logs = Callable[[str], FlightLog]


def lines_of(name: str = "perched") -> list[bytes]:
    return list(decided_here(name))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Logs:
    """Flights of the corpus, by name, with this process's decisions: what differs is the test's."""
    folder = tmp_path_factory.mktemp("decided")
    return cache(lambda name: read_log(log_of(folder, lines_of(name), f"{name}.jsonl")))


def log_of(folder: Path, lines: list[bytes], name: str = "f.jsonl") -> Path:
    path = folder / name
    path.write_bytes(b"".join(lines))
    return path


def altered(line: bytes, **changes: Any) -> bytes:
    return json_line(json.loads(line) | changes)


def with_turns(log: FlightLog, turns: list[TickRecord]) -> FlightLog:
    changed = replace(log)
    changed.__dict__["turns"] = turns
    return changed


# --- the same planner, and another ---------------------------------------------------------


def test_a_changed_constant_is_named_by_tick_and_field(
    logs: Logs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the last bit: 0.25 s and the next number above it. That much may be tolerated."""
    log = logs("perched")
    assert replay(log).is_identical
    monkeypatch.setattr(setpoints, "CLIMB_RATE_TO_SETPOINT_DAMPING_GAIN_S", 0.25000000000000006)
    found = replay(log)
    first = found.differences[0]
    assert first.field == "command.z_m"
    assert first.recorded != first.replayed
    assert first.recorded == pytest.approx(first.replayed, abs=1e-12)
    at = next(each for each in found.decisions if each.difference is not None)
    assert (first.tick, first.t_s) == (at.tick, log.to_flight_s(at.turn.t_s))
    assert len(found.differences) <= found.ticks
    (said,) = [line for line in found.lines() if "command.z_m was" in line]
    assert repr(first.replayed) in said
    assert replay(log, tolerances={"z_m": 1e-12}).is_identical
    assert not replay(log, tolerances={"z_m": 0.0, "x_m": 1e-12}).is_identical


def test_a_changed_word_of_the_planner_is_named_by_tick_and_field(
    logs: Logs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And passes a log of version 3, which does not hold it, as the replay says."""
    step = step_mission

    def says_otherwise(state: Any, obs: Any, profile: Any, table: Any) -> Any:
        new, command = step(state, obs, profile, table)
        entry = replace(new.entry, reason=new.transition_reason.replace("hovering", "hanging"))
        return replace(new, entry=entry), command

    log, old = logs("hung"), logs("perched")
    at = [turn for turn in log.turns if turn.role == "flown"]
    first = next(k for k, turn in enumerate(at) if "hovering" in (turn.reason or ""))
    plan_by(monkeypatch, says_otherwise)
    said = replay(log).differences[0]
    assert (said.tick, said.field) == (first, "reason")
    assert "hanging" in said.replayed
    assert old.header["version"] == 3
    found = replay(old)
    assert found.is_identical
    assert {"outcome", "reason", "error"} <= {*found.uncompared}
    assert "reason" not in replay(log).uncompared


@pytest.mark.parametrize(
    ("one", "other", "name"),
    [
        (PositionSetpoint(0.0, 1.0, 2.0, 0.0), PositionSetpoint(-0.0, 1.0, 2.0, 0.0), "c.x_m"),
        (RawThrust(1), RawThrust(2), "c.thrust"),
        (Idle(), StopMotors(), "c"),
        ((1.0, 2.0), (1.0, 2.5), "c[1]"),
        ({"a": 1.0}, {"a": 1.0, "b": 2.0}, "c.b"),
        (1, 1.0, "c"),
        (None, Idle(), "c"),
    ],
)
def test_the_first_field_is_named(one: Any, other: Any, name: str) -> None:
    found = Comparison().difference("c", one, other)
    assert found is not None
    assert found[0] == name
    assert json.dumps(found[1]) != json.dumps(found[2])
    assert Comparison().difference("c", one, one) is None
    assert Comparison().difference("c", float("nan"), float("nan")) is None


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("transition_name", "row", "fence"),
        ("is_holding_position", "held", True),
        ("failed_attempts", "attempts", 9),
    ],
)
def test_each_part_of_a_decision_is_compared(
    logs: Logs, name: str, field: str, value: object
) -> None:
    turns = list(logs("stopped").turns)
    at = next(turn.number for turn in turns if turn.role == "flown") + 20
    turns[at] = replace(turns[at], **{name: value})
    first = replay(with_turns(logs("stopped"), turns)).differences[0]
    assert (first.tick, first.field, first.recorded) == (20, field, value)


# --- what a log holds ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cut.jsonl", "cut.jsonl.gz"])
def test_of_a_killed_flight_what_is_there_is_replayed(tmp_path: Path, name: str) -> None:
    """Packed, too."""
    lines, path = lines_of(), tmp_path / name
    plain = b"".join(lines[:300]) + lines[300][:200]
    packed = gzip.compress(b"".join(lines), mtime=0)
    path.write_bytes(packed[:70_000] if name.endswith(".gz") else plain)
    found = replay(read_log(path))
    assert found.is_identical
    assert found.ticks > 100
    assert any("ends during the flight" in note for note in found.notes)


def test_a_turn_that_was_not_sent_is_no_tick(logs: Logs) -> None:
    turns = list(logs("stopped").turns)
    at = len(turns) - 20
    turn = replace(turns[at], role="redone", failed_attempts=9)
    rest = [replace(t, number=t.number + 1) for t in turns[at:]]
    found = replay(with_turns(logs("stopped"), [*turns[:at], turn, *rest]))
    assert [each.field for each in found.differences] == ["attempts"]
    assert found.ticks == replay(logs("stopped")).ticks


def test_a_lost_record_ends_the_replay_and_another_version_is_said(tmp_path: Path) -> None:
    """What the planner remembered of a lost turn is not known."""
    lines = lines_of()
    found = replay(read_log(log_of(tmp_path, [*lines[:200], *lines[205:]])))
    assert found.is_identical
    assert found.ticks < 200
    assert any("is missing from the log" in note for note in found.notes)
    lines[0] = altered(lines[0], perchctl="0.0.9")
    other = replay(read_log(log_of(tmp_path, lines[:100])))
    assert any(
        f"0.0.9 flew this flight, but this is version {perchctl.__version__}" in n
        for n in other.notes
    )


@pytest.mark.parametrize("version", [2, 5])
def test_a_log_without_whole_turns_cannot_be_replayed(tmp_path: Path, version: int) -> None:
    """It is of before, or of a flight that never began."""
    header = altered(lines_of()[0], version=version, perchctl="0.1.0")
    log = read_log(log_of(tmp_path, [header]))
    assert log.turns == []
    with pytest.raises(InvalidValue, match=rf"perchctl 0\.1\.0 wrote it in log version {version}"):
        replay(log)


def test_the_header_s_profile_and_mask_are_the_flown_ones_to_the_bit(tmp_path: Path) -> None:
    """A rounded threshold would be another flight's; the mask's file may be gone."""
    covered = np.zeros((480, 640), np.uint8)
    covered[400:, 5:123] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), covered)
    profile = Profile.model_validate(
        {"name": "x", "kalman": {"n_max": 7}, "safety": {"jump_m": 0.1 + 0.2},
         "camera": {"source": "rtsp://me:secret@10.0.0.2/a", "latency_s": 1 / 14,
                    "mask": str(tmp_path / "mask.png")}}
    )  # fmt: skip
    writer = LogWatcher.open(tmp_path / "f.jsonl", make_header(profile, uri="", source=""))
    writer.end()
    (tmp_path / "mask.png").unlink()
    log = read_log(writer.path)
    assert changed_keys(profile, log.flown_profile) == ("camera.source",)
    assert log.flown_profile.safety.jump_m == 0.1 + 0.2
    assert b"secret" not in writer.path.read_bytes()
    camera = log.flown_camera
    assert camera is not None
    mask = log.flown_mask(camera)
    assert mask is not None
    assert np.array_equal(mask, covered > 0)
    log.header["mask"] = "AAAA"
    with pytest.raises(InvalidValue, match="no valid mask"):
        log.flown_mask(camera)


# --- what if -------------------------------------------------------------------------------


def what_if(log: FlightLog, setting: str) -> Replay:
    return replay(log, None, apply_settings(log.flown_profile, [setting]))


def test_what_if_names_the_first_tick_that_would_differ(logs: Logs) -> None:
    log = logs("perched")
    dwell_s = log.flown_profile.planner.ascend.settle_dwell_s
    found = what_if(log, f"planner.ascend.settle_dwell_s={dwell_s + 0.2}")
    assert found.changed_keys == ("planner.ascend.settle_dwell_s",)
    first = found.differences[0]
    assert (first.field, first.recorded, first.replayed) == ("phase", "PERCH", "ASCEND")
    assert CAUTION in found.notes
    record = found.record()
    assert record["changed"] == ["planner.ascend.settle_dwell_s"]
    assert record["first_difference"]["field"] == "phase"
    json.dumps(record, allow_nan=False)


@pytest.mark.parametrize(
    "setting", ["planner.align.xy_m", "planner.align.xy=3", "planner.align.xy_m=["]
)
def test_a_setting_that_is_none(setting: str) -> None:
    with pytest.raises(InvalidValue, match="--set"):
        apply_settings(Profile(), [setting])


# --- the command ---------------------------------------------------------------------------


def test_the_command_says_so_and_leaves_with_0(tmp_path: Path) -> None:
    """A recording that is broken is a note, as is what was set as it was flown."""
    path = log_of(tmp_path, lines_of()[:150])
    path.with_suffix(".mcap").write_bytes(b"no recording")
    said = run("log", "replay", str(path), "--set", "planner.takeoff_height_m=0.6")
    assert said.code == 0
    assert "all with the same commands" in said.stdout
    assert "pictures:  replayed up to frame 0 of" in said.stdout
    for word in ("f.mcap", "ends during the flight", "no key differs"):
        assert word in said.stderr
    record = json.loads(run("log", "replay", str(path), "--no-pictures", "--json").stdout)
    assert (record["differences"], record["first_difference"], record["changed"]) == (0, None, [])
    assert record["pictures"] is None
    assert record["ticks"] > 50


def test_the_command_leaves_with_its_own_code_where_something_differs(tmp_path: Path) -> None:
    path = log_of(tmp_path, lines_of())
    said = run("log", "replay", str(path), "--set", "planner.ascend.settle_dwell_s=0.6")
    assert said.code == ReplayDiffers.exit_code == 61
    assert 61 in EXIT_CODES
    assert 'phase was "PERCH", the replay has "ASCEND"' in said.stdout
    assert "vehicle would have moved differently" in said.stderr


def test_a_fault_of_the_planner_is_not_the_file_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is a difference by itself, and the end: what came after it cannot be decided."""

    def fails(*_: Any) -> Any:
        raise ValueError("by the test")

    path = log_of(tmp_path, lines_of()[:120])
    plan_by(monkeypatch, fails)
    said = run("log", "replay", str(path), "--json")
    found = json.loads(said.stdout)
    assert said.code == 61
    assert found["first_difference"]["field"] == "error"
    assert found["first_difference"]["replayed"] == "ValueError"
    assert (found["ticks"], found["differences"]) == (1, 1)
    monkeypatch.setattr("perchctl.analysis.plot_flight", fails)
    assert "unexpected ValueError: by the test" in run("log", "plot", str(path)).complaint


def test_a_damaged_turn_is_the_file_s(tmp_path: Path) -> None:
    lines = lines_of()[:120]
    at = next(k for k, line in enumerate(lines) if b'"role":"flown"' in line)
    lines[at] = altered(lines[at], attempts="many")
    said = run("log", "replay", str(log_of(tmp_path, lines)))
    assert said.code == 30
    assert "cannot be read" in said.complaint
