"""Whether address, body, camera and home of a vehicle belong together."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import CheckScope, Row, Stand, Verdict, identity, identity_rows, vehicle
from perchctl.check.rehearsal import Rehearsal
from perchctl.link.listening import ALL_LEDS, FIRMWARES_LEDS, NO_LEDS
from perchctl.positioning import BodyPose, CaptureFrame, CaptureSource
from perchctl.profile import PositioningConfig
from perchctl.sim import Scenario, SimProcess
from perchctl.vehicle import ARMED, AUTO_ARM, FLYING
from tests.helpers.checks import NOWHERE, PROFILE, options, said, wait_for
from tests.helpers.relay import Relay
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("elsewhere")

SCOPE: dict[str, Any] = {"listen_s": 0.1, "rehearse_s": 1.5, "capture_s": 0.1}
STAND = Stand(name="north", home_m=(0.0, 0.0), home_text="0.00 1.20 m")


def expecting(x_m: float, y_m: float, **more: Any) -> Any:
    return PROFILE.with_({"target.expected_xy_m": (x_m, y_m)} | more)


def rows_of(
    uri: str,
    sim: SimProcess,
    stand: Stand = STAND,
    ask: Callable[[str], bool] = lambda _: True,
    profile: Any = None,
    **scope: Any,
) -> dict[str, Row]:
    flown = options(uri, sim.stream_url, profile or expecting(0.0, 0.0))
    wanted = CheckScope(**(SCOPE | scope))
    return {row.name: row for row in identity_rows(flown, stand, wanted, ask)}


@pytest.fixture(autouse=True)
def _under_its_target(sim: SimProcess) -> None:
    sim.replace_vehicle(Scenario())
    wait_for(sim, 1.5)


def test_the_vehicle_that_blinks_is_confirmed_and_nothing_else_is_set(
    sim: SimProcess, relay: Relay
) -> None:
    asked = []

    def ask(question: str) -> bool:
        asked.append(question)
        until(lambda: len(relay.writes()) >= 3)
        return True

    rows = rows_of(relay.uri, sim, ask=ask)
    assert {row.verdict for row in rows.values()} == {Verdict.PASS}, rows
    assert [*rows] == ["address", "vehicle", "camera", "target"]
    assert len(asked) == 1
    assert asked[0].startswith("north: all LEDs of one vehicle are blinking. Is it the only one")
    assert relay.commands() == []
    values = [packet.data[2] for packet in relay.writes()]
    assert values[:3] == [ALL_LEDS, NO_LEDS, ALL_LEDS]
    assert values[-1] == FIRMWARES_LEDS
    assert len({packet.data[:2] for packet in relay.writes()}) == 1, "one parameter only"


def test_a_vehicle_that_nobody_has_seen_blink_at_its_home_fails(
    sim: SimProcess, relay: Relay
) -> None:
    rows = rows_of(relay.uri, sim, ask=lambda _: False)
    assert rows["vehicle"].verdict is Verdict.FAIL
    assert (
        rows["vehicle"].found
        == "you did not confirm that the vehicle is blinking at its home, 0.00 1.20 m"
    )
    assert rows["target"].verdict is Verdict.PASS


@pytest.mark.parametrize("bits", [ARMED, FLYING | AUTO_ARM])
def test_a_vehicle_that_may_fly_is_left_alone(
    sim: SimProcess, relay: Relay, monkeypatch: pytest.MonkeyPatch, bits: int
) -> None:
    seen = vehicle.VehicleStatus(uri=relay.uri, telemetry=said(supervisor=bits))
    monkeypatch.setattr(vehicle, "query_vehicle", lambda *_: seen)
    rows = rows_of(relay.uri, sim, ask=lambda _: pytest.fail("nobody is to go near it"))
    assert rows["vehicle"].verdict is Verdict.FAIL
    assert relay.writes() == []


def test_a_vehicle_that_does_not_answer_proves_nothing(sim: SimProcess) -> None:
    profile = expecting(0.0, 0.0, **{"link.connect_timeout_s": 0.4})
    rows = rows_of(NOWHERE, sim, profile=profile)
    assert rows["address"].verdict is Verdict.FAIL
    others = {rows[name].verdict for name in ("vehicle", "camera", "target")}
    assert others == {Verdict.SKIPPED}


def test_the_camera_of_another_vehicle_is_named(sim: SimProcess, relay: Relay) -> None:
    stand = Stand(name="north", home_m=(0.0, 0.0), home_text="home", views={"east": (0.05, 0.0)})
    rows = rows_of(relay.uri, sim, stand, profile=expecting(0.6, 0.0))
    assert rows["target"].verdict is Verdict.FAIL
    assert re.search(r"a target 0\.[56]\d m from the vehicle's own", rows["target"].found)
    assert rows["target"].found.endswith(
        "from the vehicle's own target, at the position where east's camera would see its own "
        "target; the two cameras may be swapped"
    )


@pytest.mark.parametrize(("expected_x_m", "words", "advice"), [
    (0.1, "its target is not detected, although its expected position is in the image", "its ids"),
    (5.0, "its target is not detected", "nearer to its target and correct home_m: the large"),
])  # fmt: skip
def test_a_target_that_is_not_detected_is_not_called_out_of_view(
    expected_x_m: float, words: str, advice: str
) -> None:
    flown = options("sim://", "sim:", expecting(expected_x_m, 0.0))
    scope = CheckScope(**(SCOPE | {"rehearse_s": 0.3}))
    away = replace(flown, sim_target_xy_m=(20.0, 0.0))
    *_, row = identity_rows(away, STAND, scope, lambda _: pytest.fail("it is simulated"))
    assert (row.name, row.verdict, row.found) == ("target", Verdict.FAIL, words)
    assert advice in row.advice


def test_a_target_that_some_pictures_show_in_its_place_is_the_own_one(
    sim: SimProcess, relay: Relay, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is seen at first, and then the target where it is expected."""
    seen = iter(
        [Rehearsal(True), Rehearsal(True, target_places=[(1.0, np.array([0.05, 0.0, 2.2]))])]
    )
    monkeypatch.setattr(identity, "rehearse", lambda *_: next(seen))
    stand = Stand(name="north", home_m=(0.0, 0.0), home_text="home", views={"east": (0.05, 0.0)})
    row = rows_of(relay.uri, sim, stand)["target"]
    assert (row.verdict, "0.05 m from its expected position" in row.found) == (Verdict.PASS, True)


def test_a_target_that_is_once_measured_beyond_the_limit_is_not_looked_for_again(
    sim: SimProcess, relay: Relay, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if it would then be within the limit."""
    seen = iter(
        Rehearsal(True, target_places=[(1.0, np.array([x_m, 0.0, 2.2]))]) for x_m in (0.31, 0.29)
    )
    monkeypatch.setattr(identity, "rehearse", lambda *_: next(seen))
    row = rows_of(relay.uri, sim)["target"]
    assert (row.verdict, row.found) == (
        Verdict.FAIL,
        "the camera sees a target 0.31 m from the vehicle's own target",
    )


@pytest.mark.parametrize(("covers", "verdict"), [(True, Verdict.PASS), (False, Verdict.FAIL)])
def test_a_camera_that_another_one_resembles_is_proven_by_a_covered_lens(
    sim: SimProcess, relay: Relay, covers: bool, verdict: Verdict
) -> None:
    def ask(question: str) -> bool:
        if covers and "Cover the lens" in question:
            sim.replace_vehicle(Scenario(no_target=True))
            wait_for(sim, 1.0)
        return True

    stand = Stand(name="north", home_m=(0.0, 0.0), home_text="home", lookalikes=("east",))
    row = rows_of(relay.uri, sim, stand, ask)["target"]
    assert row.verdict is verdict
    assert ("went dark" in row.found) is covers


def test_a_lens_that_is_not_covered_proves_nothing(sim: SimProcess, relay: Relay) -> None:
    stand = Stand(name="north", home_m=(0.0, 0.0), home_text="home", lookalikes=("east",))
    row = rows_of(relay.uri, sim, stand, lambda question: "blink" in question)["target"]
    assert row.verdict is Verdict.FAIL
    assert "east's camera would see its own target at the same position" in row.found


def test_a_body_at_another_home_is_named(sim: SimProcess, relay: Relay) -> None:
    def capture(_: PositioningConfig) -> CaptureSource:
        pose = BodyPose((1.2, 0.1, 0.0), (1.0, 0.0, 0.0, 0.0))
        source: Any = SimpleNamespace(
            poll=lambda now_s: CaptureFrame(now_s, {"north": pose}),
            problem=lambda now_s: None,
            close=lambda: None,
        )
        return source

    profile = expecting(0.0, 0.0, **{"positioning.by": "mocap", "positioning.body": "north"})
    for homes, end in ({"east": (1.2, 0.0)}, "at the home of east"), ({}, "from its home"):
        stand = Stand(name="north", home_m=(0.0, 0.0), home_text="home", homes=homes)
        rows = rows_of(relay.uri, sim, stand, profile=profile, open_capture=capture)
        assert rows["body"].verdict is Verdict.FAIL
        assert rows["body"].found.endswith(end)
    stand = Stand(name="north", home_m=(1.2, 0.0), home_text="home")
    rows = rows_of(relay.uri, sim, stand, profile=profile, open_capture=capture)
    assert rows["body"].verdict is Verdict.PASS
