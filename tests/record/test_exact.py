"""Values as JSON: exact, what comes back is what was written, to the bit; rounded, one line."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.mission import (
    ExternalPositionStatus,
    FrameRecord,
    Observation,
    OperatorRequest,
    Outcome,
    Phase,
    SentCommand,
    TickInputs,
    TickRecord,
    UnfilteredPose,
)
from perchctl.record import from_exact_json, read_log, to_exact_json
from perchctl.record.exact import decode_line, encode_line, exact_fields, to_rounded_json
from perchctl.record.header import turn_fields
from perchctl.record.keys import CLASS_KEYS, FIELD_KEYS
from perchctl.record.read import parse_exact, parse_turn
from perchctl.record.write import sent_line, turn_line
from perchctl.vehicle import (
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
)
from perchctl.vision import CameraModel
from tests.helpers import log as synthetic

CORPUS = Path(__file__).parents[1] / "data" / "flights"
floats = st.floats(width=64)
vectors = st.tuples(floats, floats, floats)


def bits(value: Any) -> Any:
    """Of everything in it; what a comparison of floats would overlook as well."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, [bits(v) for v in value.ravel().tolist()])
    if isinstance(value, float):
        return "nan" if math.isnan(value) else np.float64(value).tobytes()
    if isinstance(value, dict):
        return {key: bits(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [bits(v) for v in value]
    if hasattr(value, "__dataclass_fields__"):
        return (type(value), [bits(getattr(value, f.name)) for f in fields(value)])
    return (type(value), value)


def comes_back(kind: Any, value: Any) -> bool:
    text = json.dumps(to_exact_json(value), allow_nan=False)
    return bool(bits(from_exact_json(kind, json.loads(text))) == bits(value))


@given(vectors, vectors, st.none() | vectors, floats, st.sampled_from(OperatorRequest))
def test_an_observation_comes_back(
    place: Any, e_m: Any, world_m: Any, number: float, operator: OperatorRequest
) -> None:
    telemetry = Telemetry(
        number, place, place, number, -0.0, 5e-324, 1e308, 0.1 + 0.2, math.inf, 542,
        position_variance_m2=None,
    )  # fmt: skip
    target = replace(
        synthetic.target(1.0, 1.0), e_m=np.array(e_m), sigma_yaw_rad=number,
        last_measured_at_s=-math.inf, world_m=None if world_m is None else np.array(world_m),
        small_marker_last_measured_at_s=math.nan,
    )  # fmt: skip
    obs = Observation(
        number, telemetry, target, True, math.inf,
        camera_problem="no picture \u2028 for 1 s", operator_request=operator,
        external_position_age_s=number,
    )  # fmt: skip
    assert comes_back(Observation, obs)
    assert comes_back(Observation, Observation(0.0, telemetry))


@dataclass(frozen=True)
class Since:
    since: dict[Phase, float]
    outcome: Outcome | None = Outcome.SAFETY


@pytest.mark.parametrize(
    "value",
    [
        Since({Phase.ALIGN: 0.1 + 0.2, Phase.LANDING: -0.0}),
        Since({}, None),
        *(
            CameraModel((640, 480), np.eye(3), array)
            for array in (
                np.zeros((0, 2)),
                np.float64(3.0) * np.ones((2, 3)),
                np.arange(3, dtype=np.uint8),
                np.array([0.1, math.inf], dtype=np.float32),
                np.array([True, False]),
                np.zeros(0),
            )
        ),
        RawThrust(np.float32(0.1)),  # type: ignore[arg-type]
    ],
    ids=repr,
)
def test_enums_as_keys_and_arrays_and_numbers_of_any_type_come_back(value: Any) -> None:
    """A float32 that became a float would be multiplied otherwise."""
    assert comes_back(type(value), value)


def whole_turn() -> TickRecord:
    sample = synthetic.telemetry(1.0, 0.3)
    frame = FrameRecord(3, 0.9, 0.95, "woven", True, 12)
    return TickRecord(
        number=7,
        role="redone",
        began_s=1.0,
        t_s=1.3,
        inputs=TickInputs(
            (replace(sample, t_s=0.9), sample), is_detection_requested=False, frame=frame
        ),
        unfiltered_pose_by_marker={"joint": UnfilteredPose(0.9, np.ones(3), 0.1)},
        observation=Observation(1.3, sample, synthetic.target(1.0, 1.0)),
        command=Land(0.0, 2.0),
        phase=Phase.LANDING,
        transition_name="fence",
        is_holding_position=True,
        failed_attempts=2,
        external_positions=ExternalPositionStatus(0.1, None, 3, 99.0, None),
        outcome=Outcome.SAFETY,
        reason="beyond the fence",
        planner_exception_name="KeyError",
    )


def test_a_turn_is_one_line_and_comes_back() -> None:
    turn = whole_turn()
    line = turn_line(turn)
    assert line.count(b"\n") == 1
    assert line.count(b"position_m") == 2  # the newest sample stands there once
    assert bits(parse_turn(decode_line(line))) == bits(turn)
    # A sample that was left out as nonsense is the newest of its turn all the same.
    assert turn.observation is not None
    older = replace(turn.observation, telemetry=turn.inputs.samples[0])
    turn = replace(turn, observation=older)
    assert bits(parse_turn(decode_line(turn_line(turn)))) == bits(turn)


@pytest.mark.parametrize(
    "command",
    [Idle(), PositionSetpoint(0.1, -0.0, 1e-300, math.pi), RawThrust(48000), StopMotors(),
     Land(-0.05, 2.5), EmergencyStop()],
)  # fmt: skip
def test_a_command_of_each_kind_comes_back(command: Any) -> None:
    """In a turn, and sent in the loop's place. Three kinds have no field at all."""
    assert comes_back(
        TickRecord,
        TickRecord(
            number=0, role="flown", began_s=0.0, t_s=0.0, inputs=TickInputs(), command=command
        ),
    )
    line = sent_line(sent := SentCommand(0.1 + 0.2, "watchdog", command))
    assert bits(parse_exact(SentCommand, decode_line(line))) == bits(sent)
    with pytest.raises(InvalidValue, match="sent at soon s cannot be read"):
        parse_exact(SentCommand, decode_line(line) | {"t_s": "soon"})


@pytest.mark.parametrize(
    ("changes", "why"),
    [({"phase": "CIRCLE"}, "phase: 'CIRCLE' is not a valid Phase"), ({"speed": 1}, "speed: "),
     ({"t_s": "soon"}, "t_s: 'soon'"), ({"t_s": True}, "t_s: float is needed"),
     ({"command": ["Jump", {}]}, "command: 'Jump'"), ({"command": 3}, "command: "),
     ({"poses": {"joint": {"t_s": 0.0, "e_m": [0.0, "x"], "e_yaw_rad": 0.0}}}, "poses: e_m: "),
     ({"observation": {}}, "observation: "), ({"role": "flying"}, "role: "),
     ({"t_s": {"dtype": "u1", "shape": [1], "data": [300]}}, "t_s: Python integer 300"),
     ({"taken": {"samples": 3}}, "taken: samples: "), ({"taken": "none"}, "taken: ")],
)  # fmt: skip
def test_what_is_no_turn_is_one_sentence(changes: dict[str, Any], why: str) -> None:
    record = decode_line(turn_line(whole_turn())) | changes
    with pytest.raises(InvalidValue, match=r"turn at .* s cannot be read") as caught:
        parse_turn(record)
    assert why in str(caught.value)


def test_a_turn_of_an_earlier_version_comes_back() -> None:
    """A field that is missing has its default; one that is no more is passed over."""
    record = decode_line(turn_line(whole_turn())) | {"timing": {"planner_s": 0.001}}
    del record["attempts"]
    assert parse_turn(record).failed_attempts == 0
    del record["began_s"]
    with pytest.raises(InvalidValue, match="began_s"):
        parse_turn(record)


def test_a_log_keeps_its_keys_whatever_the_program_calls_a_field() -> None:
    """A log of an earlier version has no other keys, and each entry of the tables is for a field
    that exists."""
    now = turn_fields()
    for owner, keys in read_log(CORPUS / "hovered.jsonl.gz").header["turn_fields"].items():
        assert set(keys) <= set(now[owner])
    written: dict[str, set[str]] = {}
    for each in exact_fields(TickRecord) + exact_fields(SentCommand):
        written.setdefault(each.owner, set()).add(each.name)
    for kind, keys in FIELD_KEYS.items():
        assert set(keys.values()) <= written[CLASS_KEYS.get(kind, kind)]
    assert set(CLASS_KEYS.values()) <= written.keys()


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([object()])])
def test_what_has_no_exact_form_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be stored exactly"):
        to_exact_json([value])


# --- rounded, one line a record ---------------------------------------------------------


def test_plain_values() -> None:
    values = {
        "np": np.float32(0.5), "int": np.int64(3), "bool": np.bool_(True), "none": None,
        "nan": [math.nan, math.inf, -math.inf], "vector": np.array([1.23456789, -0.0]).tolist(),
        "enum": Phase.ALIGN, "path": Path("a/b"), "text": "°€\ud800",
    }  # fmt: skip
    line = encode_line(values)
    assert "-0.0" not in line.decode()
    assert decode_line(line) == {
        "np": 0.5, "int": 3, "bool": True, "nan": [None] * 3, "vector": [1.234568, 0.0],
        "enum": "ALIGN", "path": "a/b", "text": "°€\ud800",
    }  # fmt: skip


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(max_size=8), json_values))
def test_encoding_is_one_line_and_stable(record: dict[str, Any]) -> None:
    line = encode_line(record)
    assert line.count(b"\n") == 1
    back = decode_line(line)
    assert back == {k: v for k, v in to_rounded_json(record).items() if v is not None}
    assert encode_line(back) == line
