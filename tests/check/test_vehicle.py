"""Each fault that the simulated Crazyflie can have makes its row fail or warn: by the real cflib
over UDP, and each alone. Nothing is armed, flown or turned without a yes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import Row, Verdict
from perchctl.check.row import evaluate_rows
from perchctl.check.vehicle import (
    BUSY_ADVICE,
    VEHICLE,
    VehicleStatus,
    query_vehicle,
    wake_delays,
)
from perchctl.link import ProbeLink
from perchctl.profile import LinkConfig, Profile
from perchctl.sim import Scenario, SimProcess
from perchctl.vehicle import (
    ARMED,
    AUTO_ARM,
    CAN_ARM,
    CAN_FLY,
    CRASHED,
    DECK_FAULT,
    FLYING,
    HL_FINISHED,
    LOCKED,
    LOW_POWER,
    TUMBLED,
    Telemetry,
)
from tests.helpers.checks import AT_REST, PROFILE, said, wait_for
from tests.helpers.mission import BY_TARGET, MOCAP, READY
from tests.helpers.waiting import until

pytestmark = pytest.mark.long

LISTEN_S = 0.4
BAD = Scenario(
    battery_rest_v=3.5,
    parameters={
        "system.selftestPassed": 0,
        "stabilizer.stop": 1,  # locked from the start
        "stabilizer.estimator": 1,
        "kalman.initialZ": 0.4,
    },
    estimate_tilt_bias_rad=(0.0, 0.35),
    extra={"external_position": 1.0},  # no deck; and nobody sends positions
)
OLD = {"protocol_version": 11, "missing_log_variables": ("acc.z",)}


def rows_of(vehicle: VehicleStatus, profile: Profile = PROFILE) -> dict[str, Row]:
    return {row.name: row for row in evaluate_rows(VEHICLE, vehicle, profile)}


def looked_at(sim: SimProcess, silent_s: float = 0.0) -> dict[str, Row]:
    """`silent_s`: for so long, of its echoes, the link carries nothing."""
    probe = ProbeLink(sim.uri, LinkConfig(connect_timeout_s=30.0), time.monotonic)
    probe.connect()
    try:
        seen = query_vehicle(probe, sim.uri, LISTEN_S)
        if silent_s:
            sim.silence_link(silent_s)
            seen = replace(seen, round_trips_s=probe.round_trips_s(LISTEN_S))
    finally:
        probe.close()
    return rows_of(seen)


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, dict[str, Row]]]:
    """The rows of a good vehicle, of one with a dozen faults, and of one behind a bad link."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        with SimProcess.start() as sim:
            wait_for(sim, 1.2)  # the estimator settles
            found["good"] = looked_at(sim)
            found["lossy"] = looked_at(sim, 0.2)
            sim.replace_vehicle(BAD)
            sim.set_pose((0.0, 0.0, 0.6), hold=True)
            found["bad"] = looked_at(sim)
        with SimProcess.start(link=OLD) as sim:
            found["old"] = looked_at(sim)
        yield found


FAULTS = [
    ("packets", "lossy", "fail", "% of 20 lost"),
    ("firmware", "bad", "fail", "failed at boot"),
    ("supervisor", "bad", "fail", "locked (supervisor 0x"),
    ("positioning", "bad", "fail", "no positioning deck"),
    ("ground", "bad", "fail", "places the vehicle at 0."),
    ("level", "bad", "fail", "pitch 20"),
    ("battery", "bad", "fail", "voltage is 3.5"),
    ("firmware", "old", "fail", "protocol 11"),
    ("telemetry", "old", "fail", "no telemetry arrives"),
]


@pytest.mark.parametrize(("name", "which", "verdict", "words"), FAULTS)
def test_a_fault_of_the_simulated_crazyflie_makes_its_row(
    name: str, which: str, verdict: str, words: str, vehicles: dict[str, dict[str, Row]]
) -> None:
    row = vehicles[which][name]
    if name != "packets":  # how fast they come back is the computer's
        assert vehicles["good"][name].verdict is Verdict.PASS
    assert row.verdict == verdict
    assert words in row.found
    assert row.advice


def test_a_good_vehicle_fails_nothing(vehicles: dict[str, dict[str, Row]]) -> None:
    rows = vehicles["good"].values()
    # How fast packets come back is the computer's, not the vehicle's.
    timed = ("packets", "telemetry")
    bad = [r for r in rows if r.verdict in ("fail", "warn") and r.name not in timed]
    assert bad == []
    assert "protocol 12" in vehicles["good"]["firmware"].found


def test_without_telemetry_nothing_that_hangs_on_it_passes(
    vehicles: dict[str, dict[str, Row]],
) -> None:
    for name in ("supervisor", "estimator", "ground", "level", "battery"):
        assert vehicles["old"][name].verdict is Verdict.SKIPPED


# --- Each fault alone -------------------------------------------------------------------

GOOD = VehicleStatus(
    uri="radio://0/80/2M/E7E7E7E7E7",
    parameters={"system.selftestPassed": 1, "stabilizer.estimator": 2},
    round_trips_s=[0.004] * 100,
    link_quality=99.0,
    telemetry=AT_REST,
    age_s=0.01,
    samples_hz=100.0,
    decks=("bcFlow2",),
)  # fmt: skip


TWO_CELLS_V = (4.5, 6.05, 8.38)  # down to the protection of each cell; empty; full


def running_away(mps: float) -> list[Telemetry]:
    """Five seconds in which the estimate leaves while the accelerometer reads 1 g."""
    times = (0.01 * k for k in range(501))
    return [said(t_s=t_s, position_m=(mps * t_s, 0.0, 0.0)) for t_s in times]


ALONE: list[tuple[str, str, dict[str, Any]]] = [
    ("packets", "warn", {"round_trips_s": [0.004] * 97 + [math.inf] * 3}),
    ("packets", "fail", {"round_trips_s": [0.004] * 80 + [math.inf] * 20}),
    ("packets", "warn", {"link_quality": 80.0}),
    ("packets", "fail", {"link_quality": 40.0}),
    ("packets", "fail", {"round_trips_s": [math.inf] * 100}),
    ("telemetry", "fail", {"samples_hz": 40.0}),
    ("telemetry", "fail", {"age_s": 0.5}),
    ("airframe", "fail", {"device_type": "Crazyflie Bolt"}),
    ("airframe", "fail", {"device_type": None}),
    ("firmware", "fail", {"protocol": 11}),
    ("firmware", "fail", {"missing_variables": ("stateEstimate.x",)}),
    ("firmware", "fail", {"parameters": {**GOOD.parameters, "system.selftestPassed": 0}}),
    *(
        ("supervisor", "fail", {"telemetry": said(supervisor=bits)})
        for bits in (
            READY | LOCKED, READY | CRASHED, READY | TUMBLED, READY | DECK_FAULT, READY | FLYING,
            READY | 1 << 12, READY & ~CAN_FLY, READY & ~AUTO_ARM, ARMED,
        )
    ),
    ("positioning", "fail", {"decks": ("bcBuzzer",)}),
    ("estimator", "fail", {"telemetry": said(velocity_variance_m2ps2=0.5)}),
    ("estimator", "fail", {"telemetry": said(velocity_variance_m2ps2=math.nan)}),
    ("estimator", "fail", {"telemetry": said(height_variance_m2=1.0)}),
    ("estimator", "fail", {"telemetry": said(velocity_variance_m2ps2=None)}),
    ("estimator", "fail", {"telemetry": said(height_variance_m2=None)}),
    ("estimator", "fail", {"telemetry": said(variance_behind_s=3.0)}),
    ("estimator", "warn", {"displacement_m": 0.2}),
    *(("estimator", "fail", {"samples": running_away(mps)}) for mps in (0.05, 0.3, 1.0)),
    ("ground", "fail", {"telemetry": said(position_m=(0.0, 0.0, 2.1))}),
    ("ground", "fail", {"telemetry": said(position_m=(math.nan, 0.0, 0.0))}),
    ("level", "warn", {"telemetry": said(roll_rad=math.radians(5.0))}),
    ("level", "fail", {"telemetry": said(pitch_rad=math.radians(-20.0))}),
    ("level", "fail", {"telemetry": said(pitch_rad=math.nan)}),
    ("battery", "fail", {"telemetry": said(battery_v=3.5)}),
    *(("battery", "fail", {"telemetry": said(battery_v=volts)}) for volts in TWO_CELLS_V),
    ("battery", "warn", {"telemetry": said(battery_v=3.85)}),
    ("battery", "fail", {"telemetry": said(battery_state=LOW_POWER)}),
    ("battery", "fail", {"telemetry": said(battery_v=math.nan)}),
    ("battery", "fail", {"telemetry": said(battery_v=0.0)}),
    ("battery", "fail", {"telemetry": said(battery_behind_s=3.0)}),
]  # fmt: skip


@pytest.mark.parametrize(("uri", "words"), [
    ("radio://0/80/2M/E7E7E7E7E7", "move the radio closer"), ("usb://0", "cable"),
    ("udp://10.0.0.7:2390", "network"), ("sim://", "simulated vehicle runs on this computer"),
])  # fmt: skip
def test_the_advice_fits_the_kind_of_link(uri: str, words: str) -> None:
    """No radio is brought nearer where there is none."""
    good = replace(GOOD, uri=uri, link_quality=None)
    for bad_s in ([0.004] * 80 + [math.inf] * 20, [math.inf] * 100, [0.2] * 100):
        (row,) = (
            r for n, r in rows_of(replace(good, round_trips_s=bad_s)).items() if n == "packets"
        )
        assert row.verdict is Verdict.FAIL
        assert words in row.advice
        assert ("radio" in row.advice) == uri.startswith("radio")


def test_a_busy_computer_is_named_where_it_explains_the_late_packets() -> None:
    late = replace(GOOD, round_trips_s=[0.09] * 100, wake_delays_s=[0.001] * 50)
    assert "computer" not in rows_of(late)["packets"].found
    row = rows_of(replace(late, wake_delays_s=[0.001] * 90 + [0.06] * 10))["packets"]
    assert row.verdict is Verdict.WARN or row.verdict is Verdict.FAIL
    assert row.found.endswith("this computer was late by 60 ms")
    assert row.advice == BUSY_ADVICE
    # What is lost is not lost by being late.
    lost = replace(late, round_trips_s=[0.004] * 80 + [math.inf] * 20, wake_delays_s=[0.06] * 50)
    assert "move the radio closer" in rows_of(lost)["packets"].advice


def test_how_late_this_computer_wakes_is_measured() -> None:
    with wake_delays() as delays_s:
        until(lambda: len(delays_s) > 3)
    assert min(delays_s) >= 0.0


@pytest.mark.parametrize(("name", "verdict", "changes"), ALONE)
def test_a_fault_alone_makes_its_row_and_no_other(
    name: str, verdict: str, changes: dict[str, Any]
) -> None:
    assert {row.verdict for row in rows_of(GOOD).values()} == {Verdict.PASS}
    after = rows_of(replace(GOOD, **changes))
    assert after[name].verdict == verdict
    others = {n for n, row in after.items() if row.verdict in ("warn", "fail")} - {name}
    assert others == set()


@pytest.mark.parametrize("volts", [3.95, 4.2, 4.35])
def test_a_healthy_brushless_fails_nothing(volts: float) -> None:
    """At rest it waits for the arming that `fly` sends."""
    at_rest = said(supervisor=CAN_ARM | HL_FINISHED, battery_v=volts)
    vehicle = replace(GOOD, telemetry=at_rest, device_type="Crazyflie 2.1 Brushless")
    rows = rows_of(vehicle)
    assert {row.verdict for row in rows.values()} == {Verdict.PASS}
    assert rows["supervisor"].found == "ready, perchctl fly arms it after you confirm (0x0201)"
    assert rows["airframe"].found == "Crazyflie 2.1 Brushless"


def test_a_deck_of_one_s_own_places_the_vehicle_where_the_profile_names_it() -> None:
    profile = Profile.model_validate({"positioning": {"decks": ["labUwb"]}})
    vehicle = replace(GOOD, decks=("labUwb",))
    assert rows_of(vehicle, profile)["positioning"].found == "by labUwb"


def test_an_old_profile_s_limit_is_the_flight_s() -> None:
    """One home for each criterion: what `check` allows, `fly` takes off with."""
    strict = Profile.model_validate({"safety": {"min_rest_v": 4.1}})
    vehicle = replace(GOOD, telemetry=said(battery_v=4.0))
    assert rows_of(vehicle, strict)["battery"].verdict is Verdict.FAIL


@pytest.mark.parametrize(("decks", "verdict"), [
    (("bcFlow2",), "pass"),
    (("bcFlow2", "bcLighthouse4"), "fail"),
    (("bcLoco",), "fail"),
])  # fmt: skip
def test_the_position_s_variance_counts_where_a_deck_measures_it(
    decks: tuple[str, ...], verdict: str
) -> None:
    """A Flow deck measures the speed over ground: the place level with it is never measured."""
    status = replace(GOOD, decks=decks, telemetry=said(position_variance_m2=100.0))
    row = rows_of(status)["estimator"]
    assert row.verdict == verdict
    assert ("the position's variance is 100" in row.found) is (verdict == "fail")


@pytest.mark.parametrize("profile", [MOCAP, BY_TARGET], ids=["mocap", "target"])
def test_until_fly_sends_positions_a_flow_deck_measures_the_height_alone(profile: Profile) -> None:
    status = replace(GOOD, telemetry=said(position_variance_m2=100.0))
    assert rows_of(status, profile)["estimator"].verdict is Verdict.PASS
    away = replace(status, samples=running_away(0.05))
    assert rows_of(away, profile)["estimator"].verdict is Verdict.FAIL


def test_what_the_profile_says_is_never_reported_is_skipped() -> None:
    profile = Profile.model_validate({"link": {"unreported": ["battery", "variance"]}})
    silent = said(
        battery_v=math.nan, velocity_variance_m2ps2=None, height_variance_m2=None,
        battery_behind_s=math.inf, variance_behind_s=math.inf,
    )  # fmt: skip
    rows = rows_of(replace(GOOD, telemetry=silent), profile)
    for name in ("estimator", "battery"):
        assert (rows[name].verdict, "link.unreported" in rows[name].found) == ("skipped", True)
