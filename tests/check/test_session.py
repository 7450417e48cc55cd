"""The check as a whole: what goes out on the wire, one that does not answer, who else does."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import CheckScope, Verdict, camera, check, session, vehicle
from perchctl.commands.check import exit_code
from perchctl.errors import Problem, UsageError, broken_motion_capture
from perchctl.link.crtp import encode
from perchctl.profile import PositioningConfig, Profile
from perchctl.sim import Scenario, SimProcess
from perchctl.sim.airframe import CRAZYFLIE_21_BRUSHLESS
from perchctl.vehicle import CAN_ARM, CAN_FLY, Arm
from tests.helpers.checks import NOWHERE, QUICK, VEHICLE, options, wait_for
from tests.helpers.crtp_rig import wired
from tests.helpers.flights import short_profile
from tests.helpers.relay import Relay
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("elsewhere")


# --- A motion capture whose library does not load -----------------------------------------


def test_a_library_that_does_not_load_ends_the_check_as_it_ends_a_flight() -> None:
    """It is the computer that lacks something: exit 2 with what to type, and no failed row."""
    pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")

    def broken(config: PositioningConfig) -> Any:
        raise broken_motion_capture("libvrpn.so.7: cannot open")

    profile = short_profile({"positioning.by": "mocap", "positioning.host": "lab"})
    wanted = CheckScope(**QUICK, open_capture=broken)
    with pytest.raises(UsageError, match="cannot be loaded: libvrpn") as refused:
        next(check(options(NOWHERE, profile=profile), wanted))
    assert refused.value.exit_code == 2


def test_a_link_of_your_own_is_not_asked_by_cflib(tmp_path: Path) -> None:
    (tmp_path / "my_link.py").write_text("Link = object\n")
    with pytest.raises(UsageError, match="not through your own link my_link:Link"):
        next(check(options("my_link:Link"), CheckScope(**QUICK)))


# --- What goes out ----------------------------------------------------------------------


def test_nothing_arms_flies_or_turns(sim: SimProcess, relay: Relay) -> None:
    """The whole check, from the first packet to the last, through the wire."""
    wait_for(sim, 1.5)
    rows = list(check(options(relay.uri, sim.stream_url), CheckScope(with_lift=True, **QUICK)))
    by_name = {row.name: row for row in rows}
    assert by_name["address"].verdict is Verdict.PASS
    assert [row.name for row in rows][: len(VEHICLE)] == VEHICLE
    others = {*camera.PICTURES, "camera", "size", "loop", "log folder", "stand-off"}
    assert others <= set(by_name)
    assert len(relay.up) > 100
    assert relay.commands() == []
    assert relay.writes() == []


# --- A vehicle that does not answer, and who else does ----------------------------------


def nobody(**profile: Any) -> Profile:
    return Profile.model_validate({"link": {"connect_timeout_s": 0.4}} | profile)


def test_a_vehicle_that_does_not_answer_leaves_its_rows_skipped() -> None:
    rows = list(check(options(NOWHERE, profile=nobody()), CheckScope(**QUICK)))
    assert [row.name for row in rows][: len(VEHICLE)] == VEHICLE
    assert rows[0].verdict is Verdict.FAIL
    assert "--scan" in rows[0].advice
    assert "switch the vehicle on" not in rows[0].found
    assert {row.verdict for row in rows[1 : len(VEHICLE)]} == {Verdict.SKIPPED}
    assert exit_code(rows) == 10


def test_pictures_of_another_size_fail_their_row(
    sim: SimProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.full((240, 320), 99, np.uint8))
    monkeypatch.setattr(session, "start_simulated_vehicle", lambda *_: nullcontext(sim))
    simulated = options("sim://", f"images:{tmp_path}")
    rows = {row.name: row for row in check(simulated, CheckScope(**QUICK))}
    assert rows["size"].verdict is Verdict.FAIL
    assert rows["lifted"].advice.startswith("add --lift")
    assert rows["loop"].verdict is rows["target"].verdict is Verdict.SKIPPED


@pytest.mark.long
def test_nobody_is_asked_to_lift_a_vehicle_that_is_armed() -> None:
    asked: list[str] = []
    wanted = CheckScope(with_lift=True, **QUICK, announce=asked.append)
    with SimProcess.start(Scenario(airframe=CRAZYFLIE_21_BRUSHLESS)) as brushless:
        until(lambda: brushless.truth()["supervisor_info"] & CAN_ARM)
        with wired(brushless.uri) as another:
            another.send(encode(Arm(True))[0].encode())
            until(lambda: brushless.truth()["supervisor_info"] & CAN_FLY)
            rows = {row.name: row for row in check(options(brushless.uri), wanted)}
        assert brushless.truth()["supervisor_info"] & CAN_FLY  # check commands nothing
    assert rows["supervisor"].verdict is Verdict.FAIL
    assert "is armed, and its propellers may turn" in rows["supervisor"].found
    assert (rows["lifted"].verdict, rows["lifted"].found) == (Verdict.SKIPPED, "it is armed")
    assert not any("lift the vehicle" in text for text in asked)


@pytest.mark.long
def test_a_link_that_is_lost_on_the_way_is_told() -> None:
    with SimProcess.start() as passing:

        def tell(text: str) -> None:
            if text.startswith("listening"):
                passing.stop()

        wanted = CheckScope(**(QUICK | {"listen_s": 0.5}), announce=tell)
        rows = {row.name: row for row in check(options(passing.uri), wanted)}
    assert rows["packets"].verdict is Verdict.FAIL


def test_a_scan_names_what_answers_and_why_no_radio_was_asked() -> None:
    radio, found = vehicle.radio_scan_rows([NOWHERE], Problem("no Crazyradio", "udev rules"))
    assert (radio.verdict, radio.advice) == (Verdict.SKIPPED, "udev rules")
    assert (found.verdict, found.found) == (Verdict.PASS, f"{NOWHERE} answers")
    radio, nobody = vehicle.radio_scan_rows([], None)
    assert (radio.verdict, nobody.verdict) == (Verdict.PASS, Verdict.FAIL)
