"""The flight log: what is written comes back."""

from __future__ import annotations

import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.mission import (
    CameraFindings,
    Event,
    EventKind,
    ExternalPositionStatus,
    FlightReport,
    Outcome,
    Phase,
    RestState,
)
from perchctl.mission.phase import VehicleDiagnosis
from perchctl.mission.state import BatteryOutlook
from perchctl.record import FlightSummary, LogWatcher, path_beside, read_log
from perchctl.record.exact import to_rounded_json
from perchctl.record.fields import FIELDS, event_record, tick_record
from perchctl.record.messages import TICK_SCHEMA
from perchctl.record.write import log_path
from perchctl.vehicle import (
    EmergencyStop,
    ExternalPosition,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from perchctl.vision import CameraCalibrationErrors
from tests.helpers import log as synthetic
from tests.helpers.mission import held, state_with

KINDS = {"number": (int, float), "string": (str,), "boolean": (bool,), "array": (list,)}
STARTED = datetime(2024, 3, 1, 14, 5, 9, tzinfo=UTC)


@pytest.mark.parametrize("live", [False, True])
def test_a_flight_comes_back(tmp_path: Path, live: bool) -> None:
    """In lockstep without a thread."""
    threads = threading.active_count()
    writer = LogWatcher.open(tmp_path / "new" / "f.jsonl", synthetic.header(), live=live)
    assert threading.active_count() == threads + live
    written = list(synthetic.ticks())
    for record in written:
        writer.write(record)
    writer.event(held(1.5, "no picture"))
    writer.end(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert log.header["profile"]["name"] == "sim"
    assert log.header["seed"] == 7
    assert log.header["fields"] == FIELDS
    assert len(log.records) == len(written)
    for back, record in zip(log.records, written, strict=True):
        assert list(back) == list(FIELDS)
        assert back == to_rounded_json(record)
    assert log.events == [
        {"t_s": 1.5, "event": "hold", "phase": "ALIGN", "severity": "hold", "reason": "no picture"}
    ]
    assert log.summary is not None
    assert log.summary["miss_m"] == 0.0031
    assert (log.truncated, log.ignored_bytes) == (False, 0)
    assert (writer.problem, writer.lost_records) == (None, 0)
    assert [(p.phase, round(p.duration_s, 2)) for p in log.phases] == [
        (phase, duration_s) for phase, duration_s, _ in synthetic.PLAN
    ]


def test_names_and_no_overwriting(tmp_path: Path) -> None:
    path = log_path(tmp_path, "my profile/€", STARTED)
    assert path.name == "flight_20240301_140509_my-profile.jsonl"
    paths = []
    for _ in range(3):
        writer = LogWatcher.open(path, synthetic.header(started=STARTED))
        writer.end()
        paths.append(writer.path.name)
    assert paths == [
        "flight_20240301_140509_my-profile.jsonl",
        "flight_20240301_140509_my-profile_2.jsonl",
        "flight_20240301_140509_my-profile_3.jsonl",
    ]
    assert read_log(path).header["started_utc"] == "2024-03-01T14:05:09+00:00"


def test_every_field_is_filled_by_something() -> None:
    """No documented key that nothing writes, and none by another type than a recording names."""
    pose = synthetic.target(1.0, 1.6)
    frame = synthetic.output(3, pose, np.random.default_rng(1))
    frame.poses["joint"] = frame.poses["large"]
    frame = replace(frame, target_lock_message="not the tracked target")
    battery = BatteryOutlook(60.0, 3, 12.5, 3.9)
    state = state_with(
        phase=Phase.ALIGN, reason="steady", hold_reason="no picture", battery=battery
    )
    place = ExternalPosition((1.0, 2.0, 0.5), (1.0, 0.0, 0.0, 0.0))
    seen: set[str] = set()
    for command, name in (
        (Land(-0.05, 2.0), "land"), (PositionSetpoint(1.0, 2.0, 3.0, 0.5), "position"),
        (RawThrust(60000), "thrust"), (Idle(), "idle"), (StopMotors(), "stop"),
        (EmergencyStop(), "emergency"),
    ):  # fmt: skip
        tick = synthetic.tick(
            1.0,
            synthetic.telemetry(),
            command,
            state,
            output=frame,
            target=pose,
            consistency=CameraCalibrationErrors(
                0.01, 0.004, (0.01, 0.02, 0.03), (0.01, 0.01, 0.02)
            ),
            delay_used_s=0.005,
            outside=ExternalPositionStatus(0.012, "hidden", 7, 99.0, place),
        )
        record = tick_record(tick, (0.0, 0.0, 1.0), 0.01)
        seen |= {key for key, value in record.items() if value is not None}
        assert record["cmd"] == name
        for key, value in to_rounded_json(record).items():
            kind: Any = TICK_SCHEMA["properties"][key]  # type: ignore[index]
            assert value is None or type(value) in KINDS[kind["type"]], key
        height_m = {"land": -0.05, "position": 3.0}.get(name)
        assert (record["cmd_z_m"], record["z_m"]) == (height_m, 0.0)
        assert list(record) == list(FIELDS)
    assert not set(FIELDS) - seen


@pytest.mark.parametrize("name", ["x.jsonl", "x.jsonl.gz", "x.mcap"])
def test_the_recording_is_found_by_the_log_the_packed_log_and_itself(name: str) -> None:
    assert path_beside(f"logs.d/{name}", ".mcap") == Path("logs.d") / "x.mcap"


@pytest.mark.parametrize("uri", ["sim://", "radio://0/80/2M/E7E7E7E7E7"])
def test_only_a_real_flight_asks_to_change_a_profile(tmp_path: Path, uri: str) -> None:
    """As it ends, and as its log is read: the simulated camera is the scenario's."""
    landing = Event(
        1.0, EventKind.PHASE, "the camera seems to be rotated", Phase.LANDING, "mounting",
        diagnosis=VehicleDiagnosis.PROFILE_MAY_BE_WRONG,
    )  # fmt: skip
    found = CameraFindings(0.04, 0.003, (0.0, 0.0, 0.0), (0.3, 0.3, 0.8), ("set camera.latency_s",))
    log = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header(uri=uri))
    log.event(landing)
    ended = log.close(
        FlightReport(
            Phase.LANDED,
            Outcome.SAFETY,
            "the camera seems to be rotated",
            0,
            9.0,
            False,
            (landing,),
            found,
        )
    )
    assert ended is not None
    read = FlightSummary.from_log(read_log(log.path))
    for summary in (ended, read):
        assert ("do not change the profile" in summary.text()) is (uri == "sim://")
    assert ("set camera.latency_s" in read.text()) is (uri != "sim://")


@pytest.mark.parametrize("rest", RestState)
def test_a_rescue_is_a_note_with_its_rest(rest: RestState) -> None:
    """A reader needs no prose to tell where the vehicle is."""
    record = event_record(Event.make_rescue_note(9.0, ValueError(), rest, rest.value))
    assert (record["event"], record["rest"]) == ("note", rest.name.lower())
    assert record["reason"] == f"ValueError in flight: {rest.value}"
    assert event_record(Event(9.0, EventKind.NOTE, "a note in flight: "))["rest"] is None
