"""The process of a vehicle as its parent holds it: with small programs in its place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from perchctl.fleet import VehicleProcess, children, flight_options, load_fleet, make_plan
from perchctl.fleet.messages import Result, Stage, Status, VehicleOutcome, find_fault
from tests.helpers.waiting import until

PROGRAM = """
import os, pickle, sys, time
from perchctl.children import connect_to_parent
channel = connect_to_parent()
from perchctl.fleet.messages import *
ready = pickle.dumps(Status(stage=Stage.READY))
"""

Start = Callable[[str], VehicleProcess]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts a process that runs this after it has connected."""
    started: list[VehicleProcess] = []
    options = flight_options(make_plan(load_fleet()), tmp_path, 0, None)["north"]

    def run(code: str) -> VehicleProcess:
        monkeypatch.setattr(children, "VEHICLE_PROGRAM", PROGRAM + code)
        started.append(VehicleProcess("north", options))
        return started[-1]

    yield run
    for each in started:
        each.kill()
        each.close()


def test_what_cannot_be_used_is_told_and_the_next_message_is_heard(start: Start) -> None:
    child = start("channel.send_bytes(b'no pickle'); channel.send_bytes(ready); time.sleep(60)\n")
    until(lambda: child.newest()[0])
    assert (child.fault() or "").startswith(
        "its process sent an unreadable message (UnpicklingError"
    )
    assert child.newest()[0] == Status(stage=Stage.READY)
    assert child.end_of_process() is None


def test_a_status_with_wrong_parts_is_not_shown(start: Start) -> None:
    child = start("channel.send(Status(stage='flying')); time.sleep(60)\n")
    assert until(child.fault) == "its process sent Status with fields of the wrong type"
    assert child.newest()[0] is None


def test_one_that_runs_without_a_line_has_not_ended(start: Start) -> None:
    """It lands its vehicle; ended at once, it would drop it."""
    child = start("channel.send_bytes(ready); channel.close(); time.sleep(60)\n")
    until(lambda: not child._reader.is_alive())
    assert child.newest()[0] is not None
    assert child.end_of_process() is None
    child.kill()
    assert until(child.end_of_process) == "its process has ended unexpectedly (signal 9)"


def test_one_that_is_gone_says_how(start: Start) -> None:
    child = start("print('out of luck', flush=True); os._exit(3)\n")
    expected = "its process has ended unexpectedly (exit 3): out of luck"
    assert until(child.end_of_process) == expected


GOOD = Result(exit_code=0, outcome=VehicleOutcome.PERCHED, reason="hanging still")
BAD: Any = "landed"


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        (1, "int instead of its status"),
        ("READY", "str instead of its status"),
        (Status(stage=BAD), "Status with fields of the wrong type"),
        (Status(loop_age_s=BAD), "Status with fields of the wrong type"),
        (Status(place_m=BAD), "Status with fields of the wrong type"),
        (Status(picture_port=BAD), "Status with fields of the wrong type"),
        (Status(place_m=(1.0, 2.0), picture_port=40000), None),
        (Result(exit_code=0, outcome=BAD, reason=""), "Result with fields of the wrong type"),
        (
            Result(exit_code=BAD, outcome=VehicleOutcome.LANDED, reason=""),
            "Result with fields of the wrong type",
        ),
        (GOOD, None),
    ],
)
def test_a_message_is_used_only_if_its_parts_are_of_their_types(
    message: object, fault: str | None
) -> None:
    assert find_fault(message) == fault
