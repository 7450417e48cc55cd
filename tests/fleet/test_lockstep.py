"""Who flies when in a simulated fleet, and what befalls it: with flights that a test makes up, and
in whole flights that run with the long tests."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import ConnectionFailed, InvalidValue, UsageError
from perchctl.faults import COMMON_CAUSES, FAULTS, HEALTHY, Case, FaultResult, FaultyFlight
from perchctl.faults.effects import FOR_EVER, external_positions
from perchctl.fleet import (
    FleetPlan,
    FleetResult,
    fleet_summary,
    fleet_table,
    fly_fleet,
    lockstep,
    make_plan,
    plan_sha256,
    select_fleet_faults,
)
from perchctl.fleet.dispatch import HUNG_S
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.fleet.lockstep import (
    TICK_S,
    FleetFlight,
    Trouble,
    draw_trouble,
    swapped_cases,
)
from perchctl.fleet.messages import Stage as Flying
from perchctl.fleet.messages import Status
from perchctl.fleet.results import refused_vehicle
from perchctl.fleet.room import Room, body_name, place_fleet
from perchctl.record import from_exact_json, to_exact_json
from perchctl.sim.capture import CaptureSettings, SimCapture
from tests.fleet.rig import fleet
from tests.fleet.test_room import flying
from tests.helpers.commands import run
from tests.helpers.flights import SHORT, short_profile

SAMPLE_S = 0.01


@dataclass
class Script:
    """What a made-up flight does: it ends after `lasts_s`, its estimate has it at `lies_m`, in its
    own axes, and it tells the parent that it flies at `flies_m`."""

    lasts_s: float = 0.1
    outcome: str = "perched"
    lies_m: tuple[float, float] = (0.0, 0.0)
    flies_m: tuple[float, float] | None = None


@dataclass
class Stage:
    """The scripts of the flights, by vehicle, and what happened, in order."""

    scripts: dict[str, Script] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    others: dict[str, Any] = field(default_factory=dict)
    withheld: dict[str, list[str | None]] = field(default_factory=dict)  # by vehicle, each tick


class FakeFlight:
    """A `FaultyFlight` by script."""

    def __init__(
        self,
        stage: Stage,
        name: str,
        case: Case,
        on_sample: Callable[[float], None],
        climb_withheld: Callable[[], str | None],
    ) -> None:
        self._stage, self.name, self._case, self._on_sample = stage, name, case, on_sample
        self._climb_withheld = climb_withheld
        self._script = stage.scripts.get(name, Script())
        self.newest_tick: Any = None
        self.vehicle = flying(0.0, 0.0, 1.0)
        place = dict(zip(("stateEstimate.x", "stateEstimate.y"), self._script.lies_m, strict=True))
        self.vehicle.firmware.log_value = place.__getitem__
        self.end: str | None = None
        self._lands = False

    def fly(self) -> FaultResult:
        self._stage.log.append(f"{self.name} starts")
        for step in range(1, round(self._script.lasts_s / SAMPLE_S) + 1):
            self.sample(step * SAMPLE_S)
            self.newest_tick = SimpleNamespace(t_s=step * SAMPLE_S, flies_m=self._script.flies_m)
            self._stage.withheld.setdefault(self.name, []).append(self._climb_withheld())
            if self._lands:
                break
        self.end = "landed" if self._lands else self._script.outcome
        self._stage.log.append(f"{self.name} {self.end}")
        self.sample(self._script.lasts_s + 1.0)  # it is still watched
        made = refused_vehicle("")
        return replace(made, outcome=self.end, fault=self._case.fault.name, reason="as scripted")

    def sample(self, t_s: float) -> None:
        self._on_sample(t_s)

    def land(self) -> None:
        self._lands = True

    def begin_fault(self) -> None:
        self._stage.log.append(f"{self.name} meets {self._case.fault.name}")


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    made = Stage()

    def flight(profile: Any, case: Case, _scenario: Any, *, others: Any, **hooks: Any) -> Any:
        made.others[profile.name] = others
        return FakeFlight(made, profile.name, case, **hooks)

    def status(tick: Any) -> Status:
        return Status(stage=Flying.FLYING, telemetry_age_s=0.0, place_m=tick.flies_m)

    monkeypatch.setattr(lockstep, "FaultyFlight", flight)
    monkeypatch.setattr(lockstep, "flight_status", status)
    return made


def fly(planned: Fleet, trouble: Trouble | None = None, *, are_exact: bool = True) -> FleetResult:
    """The fleet's flight; `are_exact`: each vehicle starts exactly where the file says."""
    plan = make_plan(planned)
    placed = [
        replace(
            each,
            true=replace(vehicle, frame="home") if are_exact else each.true,
            profile=each.profile.model_copy(update={"name": each.name}),
        )
        for each, vehicle in zip(place_fleet(plan.fleet, 1), plan.fleet.vehicles, strict=True)
    ]
    return FleetFlight(plan, placed, trouble or Trouble(cases={})).fly(1)


def row(count: int, apart_m: float = 3.0, **settings: Any) -> Fleet:
    """Vehicles in a row, each below its own target, without conflicts."""
    places = [(apart_m * n, 0.0) for n in range(count)]
    return fleet([(place, place) for place in places], **settings)


def outcomes(result: FleetResult) -> list[str]:
    return [vehicle.outcome for vehicle in result.vehicles]


def test_a_group_starts_together_and_the_next_when_all_of_it_have_ended(stage: Stage) -> None:
    stage.scripts = {"v0": Script(0.3), "v1": Script(0.1)}
    result = fly(row(3, order="2 at a time"))
    assert stage.log == [
        "v0 starts", "v1 starts", "v1 perched", "v0 perched", "v2 starts", "v2 perched",
    ]  # fmt: skip
    assert outcomes(result) == ["perched"] * 3
    assert result.outcome == "perched"
    assert result.least_distance_m == pytest.approx(3.0, abs=0.1)


def test_no_flight_is_more_than_a_tick_ahead_of_another(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = dict.fromkeys(("v0", "v1", "v2"), 0.0)
    furthest_s: list[float] = []
    wait = FakeFlight.sample

    def note(flight: FakeFlight, t_s: float) -> None:
        clocks[flight.name] = t_s
        furthest_s.append(max(clocks.values()) - min(clocks.values()))
        wait(flight, t_s)

    monkeypatch.setattr(FakeFlight, "sample", note)
    stage.scripts = {name: Script(0.3) for name in clocks}
    result = fly(row(3, order="together"))
    assert max(furthest_s[:-3]) <= TICK_S + 1e-9, "but for the wait after the end"
    assert result.time_s == pytest.approx(1.3, abs=2 * TICK_S)


CROSSING = [((0.0, 0.0), (1.0, 0.0)), ((0.5, -1.0), (0.5, -1.5)), ((5.0, 0.0), (5.0, 0.0))]
"""v0 and v1 may not fly together: their corridors are 0.3 m apart."""


@pytest.mark.parametrize(
    ("script", "second", "words"),
    [
        (Script(), "perched", ""),
        (Script(outcome="landed"), "perched", ""),  # at its home, as planned
        (
            Script(outcome="landed", lies_m=(0.6, 0.0)),
            "refused",
            "v0 is on the floor 0.60 m from its home",
        ),
        (
            Script(outcome="landed", lies_m=(0.5, -0.5)),
            "refused",
            "v0 is on the floor 0.15 m from this vehicle's cor",
        ),
        (
            Script(outcome="gone", lies_m=(math.nan, 0.0)),
            "refused",
            "the position of v0 is unknown",
        ),
        (
            Script(outcome="landed", lies_m=(0.5, -1.2)),
            "refused",
            "v0 is on the floor 0.35 m inside this vehicle's",
        ),
    ],
)
def test_who_lies_away_from_its_home_may_block_others(
    stage: Stage, script: Script, second: str, words: str
) -> None:
    stage.scripts = {"v0": script}
    result = fly(fleet(CROSSING))
    third = "refused" if math.isnan(script.lies_m[0]) else "perched"
    assert outcomes(result)[1:] == [second, third], "whose corridor is far away"
    assert words in result.vehicles[1].reason
    assert ("v1 starts" in stage.log) is (second == "perched")


def test_who_measures_in_the_room_s_axes_is_known_to_lie_where_it_does(stage: Stage) -> None:
    """Though it did not start exactly where the file says."""
    stage.scripts = {"v0": Script(outcome="landed", lies_m=(0.0, 0.6))}
    planned = fleet(CROSSING)
    placed = place_fleet(planned, 1)[0]
    away_m = math.dist(placed.true.to_room((0.0, 0.6)), planned.vehicles[0].home_m)
    assert f"{away_m:.2f}" != "0.60"
    result = fly(planned, are_exact=False)
    assert f"v0 is on the floor {away_m:.2f} m from its home" in result.vehicles[1].reason


def test_who_is_near_a_climb_or_may_be_keeps_it_waiting(stage: Stage) -> None:
    """As the parent of a real fleet decides: v0 strays below v1's target, is out of sight once its
    program has been killed, and is no obstacle once it must be down."""
    near_m = (1.5, 0.0)
    stage.scripts = {"v0": Script(0.2, "gone", flies_m=near_m), "v1": Script(11.0, flies_m=near_m)}
    fly(row(2, 1.5, order="together"))
    close = "v0 is too close to this vehicle's climb path"
    unknown = "the distance of v0 from this vehicle's climb path is unknown"
    told = [why for why, _ in groupby(stage.withheld["v1"])]
    assert told == [close, unknown, None]
    lost_s = SAMPLE_S * stage.withheld["v1"].count(unknown)
    assert lost_s == pytest.approx(HUNG_S, abs=2 * TICK_S)
    assert set(stage.withheld["v0"]) == {None}


def test_land_all_lands_who_flies_and_starts_nobody_else(stage: Stage) -> None:
    stage.scripts = {"v0": Script(0.1, "aborted"), "v1": Script(9.0)}
    result = fly(row(3, order="2 at a time", on_failure="land-all"))
    assert outcomes(result) == ["aborted", "landed", "refused"]
    assert result.vehicles[2].reason == "v0 has failed, and on_failure is land-all"
    assert result.outcome == "aborted"
    stage.log.clear()
    result = fly(row(3, order="2 at a time"))
    assert outcomes(result) == ["aborted", "perched", "perched"]


def test_land_all_starts_nobody_after_a_group_that_was_refused_as_a_whole(stage: Stage) -> None:
    plan = make_plan(row(3, on_failure="land-all"))
    drawn = draw_trouble(plan, place_fleet(plan.fleet, 1), ["dongle-dies"], 3)
    only = {"v1": drawn.cases["v1"]}
    result = fly(plan.fleet, replace(drawn, cases=only, group=0, at_s=0.05))
    assert outcomes(result) == ["perched", "refused", "refused"]
    assert result.vehicles[2].reason == "v1 has failed, and on_failure is land-all"
    assert stage.log == ["v0 starts", "v0 perched"]


def test_a_common_cause_befalls_all_that_fly_and_outlasts_them(stage: Stage) -> None:
    plan = make_plan(row(3, order="2 at a time"))
    drawn = draw_trouble(plan, place_fleet(plan.fleet, 1), ["dongle-dies"], 3)
    assert set(drawn.cases) == {"v0", "v1", "v2"}
    stage.scripts = {f"v{n}": Script(0.3) for n in range(3)}
    result = fly(plan.fleet, replace(drawn, group=0, at_s=0.1))
    assert [line for line in stage.log if "meets" in line] == [
        "v0 meets dongle-dies", "v1 meets dongle-dies",
    ]  # fmt: skip
    assert outcomes(result) == ["perched", "perched", "refused"]
    assert result.vehicles[2].reason.startswith("dongle-dies: the links of all")
    stage.log.clear()
    stall = draw_trouble(plan, place_fleet(plan.fleet, 1), ["stall"], 3)
    assert outcomes(fly(plan.fleet, replace(stall, group=0, at_s=0.1)))[2] == "perched"


@pytest.mark.parametrize(("group", "at_s"), [(0, 20.0), (2, 0.1)])
def test_a_cause_that_has_not_begun_keeps_no_vehicle_on_the_floor(
    stage: Stage, group: int, at_s: float
) -> None:
    """Neither one whose group has ended before its moment, nor one that befalls a later group."""
    plan = make_plan(row(3))
    drawn = draw_trouble(plan, place_fleet(plan.fleet, 1), ["dongle-dies"], 3)
    result = fly(plan.fleet, replace(drawn, group=group, at_s=at_s))
    assert outcomes(result) == ["perched"] * 3
    assert [line for line in stage.log if "meets" in line] == []


def swapped_with(trouble: Trouble, name: str) -> str:
    (effect,) = trouble.cases[name].effects
    other: str = effect.keywords["swapped_with"]
    return other


def test_two_bodies_swap_and_a_fault_befalls_one_vehicle() -> None:
    plan = make_plan(row(4, order="together"))
    placed = place_fleet(plan.fleet, 1)
    for seed in range(8):
        swap = draw_trouble(plan, placed, ["bodies-swap"], seed)
        first, second = swap.cases
        assert [swapped_with(swap, name) for name in (first, second)] == [
            f"body of {second}", f"body of {first}",
        ]  # fmt: skip
        one = draw_trouble(plan, placed, ["kick", "gust"], seed)
        assert len(one.cases) == 1
        assert one.at_s is None
        (name, case), again = *one.cases.items(), draw_trouble(plan, placed, ["kick", "gust"], seed)
        assert (again.name, again.cases[name].moment_s) == (one.name, case.moment_s)
    met = {next(iter(draw_trouble(plan, placed, ["kick"], seed).cases)) for seed in range(30)}
    assert met == {"v0", "v1", "v2", "v3"}
    assert draw_trouble(plan, placed, (), 1).cases == {}


def test_a_vehicle_alone_keeps_the_other_body_of_its_capture(stage: Stage) -> None:
    """Its name can be taken by no vehicle, but by the wand, as in a single flight."""
    fly(row(1))
    assert stage.others == {"v0": None}
    fly(row(2))
    assert [name for name, _ in stage.others["v0"]] == ["body of v1"]
    room = Room(place_fleet(row(1), 1))
    vehicle = flying(0.0, 0.0, 1.0)
    vehicle.capture = SimCapture(CaptureSettings())
    before_m = list(vehicle.capture.others_m)
    room.bodies["v0"].follow(vehicle)
    room.update()
    assert vehicle.capture.others_m == before_m != []


def test_two_vehicles_whose_bodies_swap_get_each_other_s_position() -> None:
    """Also if the fleet has others, and not only one of the two is deceived."""
    plan = make_plan(row(4, order="together"))
    placed = place_fleet(plan.fleet, 1)
    case = next(iter(draw_trouble(plan, placed, ["bodies-swap"], 0).cases.values()))
    room = Room(placed)
    pair = swapped_cases(case, "v1", "v3")
    exact = CaptureSettings(position_noise_m=0.0)
    for name, own_case in pair.items():
        vehicle = flying(0.1, 0.2, 1.0)
        vehicle.world.t_s, vehicle.world.quaternion = 1.0, (1.0, 0.0, 0.0, 0.0)
        vehicle.capture = SimCapture(replace(exact, others=room.others_of(name)))
        room.bodies[name].follow(vehicle)
        (effect,) = own_case.effects
        effect(SimpleNamespace(vehicle=vehicle), 0.0)
    room.update()
    for name, other in (("v1", "v3"), ("v3", "v1")):
        body = room.bodies[name]
        assert body.vehicle is not None
        capture = body.vehicle.capture
        assert capture is not None
        capture.advance(body.vehicle.world)
        body.vehicle.world.t_s = 1.1
        capture.advance(body.vehicle.world)
        seen = capture.take()[0].bodies
        theirs_m = body.in_own_axes(room.bodies[other].place_m)
        assert seen["crazyflie"].position_m == pytest.approx(theirs_m)
        assert seen[body_name(other)].position_m == pytest.approx((0.1, 0.2, 1.0))
        for third in {"v0", "v1", "v2", "v3"} - {name, other}:
            where_m = body.in_own_axes(room.bodies[third].place_m)
            assert seen[body_name(third)].position_m == pytest.approx(where_m)


def test_whom_nothing_measures_is_refused(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others fly on."""
    working = lockstep.FaultyFlight

    def flight(profile: Any, *parts: Any, **named: Any) -> Any:
        if profile.name == "v0":
            raise ConnectionFailed("no position within 1 s")
        return working(profile, *parts, **named)

    monkeypatch.setattr(lockstep, "FaultyFlight", flight)
    result = fly(row(2, order="together"))
    assert outcomes(result) == ["refused", "perched"]
    assert result.vehicles[0].reason == "no position within 1 s"


def test_an_error_of_a_flight_ends_the_fleet_and_all_its_threads(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> Any:
        raise UsageError("no simulator")

    stage.scripts = {"v0": Script(9.0)}
    working = lockstep.FaultyFlight

    def flight(profile: Any, *parts: Any, **named: Any) -> Any:
        return (broken if profile.name == "v1" else working)(profile, *parts, **named)

    monkeypatch.setattr(lockstep, "FaultyFlight", flight)
    with pytest.raises(UsageError, match="no simulator"):
        fly(row(2, order="together"))
    assert not [each for each in threading.enumerate() if each.name.startswith("flight of")]


# --- what is printed ---


def made(**changes: Any) -> FleetResult:
    vehicle = replace(refused_vehicle(""), outcome="perched")
    values: dict[str, Any] = {
        "seed": 5, "outcome": "perched", "fault": "none", "names": ("a", "b"),
        "vehicles": (vehicle, vehicle), "collisions": 0, "collided": (), "least_distance_m": 1.5,
        "least_distance_in_air_m": None, "separation_m": 0.4, "time_s": 40.0,
    }  # fmt: skip
    return FleetResult(**{**values, **changes})


def test_figures_count_fleets_and_vehicles() -> None:
    landed = replace(made().vehicles[0], outcome="landed", flags={"fell": 1.0}, counted=("fell",))
    hit = made(
        seed=6, fault="kick", outcome="landed", vehicles=(landed, made().vehicles[0]),
        collisions=1, collided=(("a", "b"),), least_distance_m=0.1, least_distance_in_air_m=0.2,
    )  # fmt: skip
    figures = fleet_summary([made(), hit])
    wanted = {
        "fleets": 2, "vehicles": 4, "perched": 3, "landed": 1, "collisions": 1, "fell": 1,
        "least_distance_m": 0.1, "least_distance_in_air_m": 0.2, "worst_seeds": [6],
    }  # fmt: skip
    assert wanted.items() <= figures.items()
    text = fleet_table([made(), hit])
    assert "a, b" in text
    assert "collided" in text
    assert "0.10 m between two vehicles, flying" in text
    assert "fell                  1: fell" in text
    assert "with a flag           1 vehicle; excused by physics or the firmware: 0" in text
    assert json.loads(json.dumps(fleet_summary([]))) == fleet_summary([])


def test_each_injected_fault_is_named_with_its_vehicle() -> None:
    began, not_begun = (replace(made().vehicles[0], begin_s=s) for s in (3.0, None))
    result = made(vehicles=(began, not_begun), injected={"a": "stall, at once", "b": "kick"})
    named = fleet_summary([result])["injected"]
    assert named == [
        {"seed": 5, "vehicle": "a", "fault": "stall, at once", "begin_s": 3.0},
        {"seed": 5, "vehicle": "b", "fault": "kick", "begin_s": None},
    ]
    lines = fleet_table([result]).splitlines()
    assert "seed 5, a: stall, at once" in lines
    assert "seed 5, b: kick; did not begin" in lines
    assert "injected faults" not in fleet_table([result] * 11)


@pytest.mark.parametrize("fault", ["kick", "dongle-dies"])
def test_a_result_says_what_was_injected(stage: Stage, fault: str) -> None:
    plan = make_plan(row(2))
    trouble = draw_trouble(plan, place_fleet(plan.fleet, 1), [fault], 3)
    injected = fly(plan.fleet, trouble).injected
    assert injected.keys() == trouble.cases.keys()
    moment = "began" if fault == "kick" else f"{trouble.at_s:.1f} s after group "
    for text in injected.values():
        assert text.startswith(f"{fault}, ")
        assert moment in text


def test_a_result_is_written_and_read_back() -> None:
    data = json.loads(json.dumps(to_exact_json(made())))
    assert from_exact_json(FleetResult, data) == made()


def test_a_vehicle_that_is_turned_is_another_plan() -> None:
    """Also below its target, where its profile is the same; a campaign is not resumed with it."""
    planned = row(2)
    first, second = planned.vehicles
    turned = replace(planned, vehicles=(first, replace(second, heading_deg=90.0)))
    assert turned.vehicles[1].profile == second.profile
    assert plan_sha256(make_plan(turned)) != plan_sha256(make_plan(planned))
    assert plan_sha256(make_plan(row(2))) == plan_sha256(make_plan(planned))


def test_faults_are_chosen_by_name() -> None:
    names = [each.name for each in (*FAULTS, *(cause.fault for cause in COMMON_CAUSES))]
    assert sorted(select_fleet_faults("all")) == sorted(set(names))
    assert select_fleet_faults("kick, stall") == ("kick", "stall")
    assert HEALTHY.fault.name not in select_fleet_faults("all")
    with pytest.raises(InvalidValue, match=r"'dongle-dis' is unknown; did you mean dongle-dies\? "):
        select_fleet_faults("dongle-dis")
    done = run("fleet", "simulate", "--faults", "none")
    assert done.code == 30
    assert done.complaint.startswith("fault 'none' is unknown")
    assert "bodies-swap" in run("fleet", "simulate", "--faults", "list").stdout


def test_a_fleet_that_cannot_fly_is_refused_before_any_flight(tmp_path: Path) -> None:
    path = tmp_path / "clash.yaml"
    path.write_text(
        "vehicles:\n  - {name: a, home_m: [0, 0], target_m: [0, 0]}\n"
        "  - {name: b, home_m: [0.1, 0], target_m: [0.1, 0]}\n"
    )
    done = run("fleet", "simulate", str(path))
    assert (done.code, done.stdout) == (30, "")
    assert str(path) in done.stderr


# --- whole flights ---

SEED = 7
CAUSE_S = 5.0
"""Into the first group's flight: all are in the air."""


@cache
def short_plan() -> FleetPlan:
    """Three vehicles on short flights, turned by other angles: two at a time."""
    profile = short_profile()
    places = [((0.0, 0.0), 0.0), ((2.5, 0.0), 90.0), ((0.0, 2.5), -45.0)]
    vehicles = [
        FleetVehicle(
            name=f"v{n}", profile=profile, home_m=home_m, target_m=home_m, heading_deg=deg
        ).with_target((home_m[0] + 0.05, home_m[1]))
        for n, (home_m, deg) in enumerate(places)
    ]
    return make_plan(Fleet(name="short", vehicles=tuple(vehicles), order="2 at a time"))


def lasting(trouble: Trouble) -> Trouble:
    """A common cause that befalls both vehicles of the first group in the air; a loss of positions
    is for good."""
    case = next(iter(trouble.cases.values()))
    (effect,) = case.effects
    if effect.func is external_positions:
        case = replace(case, effects=(partial(effect, for_s=FOR_EVER),))
    cases = dict.fromkeys(("v0", "v1", "v2"), case)
    if trouble.name == "bodies-swap":
        cases = swapped_cases(case, "v0", "v1")
    return replace(trouble, cases=cases, group=0, at_s=CAUSE_S)


@cache
def flown(*faults: str) -> FleetResult:
    plan = short_plan()
    placed = place_fleet(plan.fleet, SEED)
    trouble = draw_trouble(plan, placed, faults, SEED)
    if trouble.at_s is not None:
        trouble = lasting(trouble)
    return FleetFlight(plan, placed, trouble).fly(SEED)


@pytest.mark.long
def test_vehicles_perch_as_if_each_were_alone_and_the_same_each_time() -> None:
    """No jet reaches the next one: to the last bit, the flight of each is the one without the
    others."""
    result = flown()
    assert outcomes(result) == ["perched"] * 3
    assert result.collisions == 0
    assert result.least_distance_in_air_m is not None
    assert result.least_distance_in_air_m > result.separation_m
    placed = place_fleet(short_plan().fleet, SEED)[1]
    alone = FaultyFlight(placed.profile, HEALTHY, placed.scenario).fly()
    assert replace(result.vehicles[1], seed=0) == replace(alone, seed=0)
    again = fly_fleet(short_plan(), (), SEED)
    assert replace(again, cpu_s=0.0) == result


@pytest.mark.long
@pytest.mark.parametrize("fault", ["killed", "kick", "hung"])
def test_a_fault_in_one_vehicle_changes_nothing_for_its_neighbours(fault: str) -> None:
    pairs = list(zip(flown().vehicles, flown(fault).vehicles, strict=True))
    assert sum(theirs.fault == fault for _, theirs in pairs) == 1
    for ours, theirs in pairs:
        if theirs.fault != fault:
            assert theirs == ours


@pytest.mark.long
@pytest.mark.parametrize(
    ("cause", "ends"),
    [
        ("capture-silent", ["landed", "landed", "refused"]),
        ("bodies-swap", ["landed", "landed", "refused"]),  # nobody knows the second one's place
        ("stall", ["landed", "landed", "perched"]),
        ("dongle-dies", ["aborted", "aborted", "refused"]),  # unseen, as the firmware cuts them
        ("parent-dies", ["landed", "landed", "refused"]),
    ],
)
def test_no_common_cause_makes_vehicles_meet(cause: str, ends: list[str]) -> None:
    result = flown(cause)
    assert [vehicle.counted for vehicle in result.vehicles] == [()] * 3
    assert outcomes(result) == ends
    assert result.collisions == 0
    assert [vehicle.begin_s for vehicle in result.vehicles[:2]] == pytest.approx([CAUSE_S] * 2)


@pytest.mark.long
def test_the_command_flies_writes_and_resumes(tmp_path: Path) -> None:
    path, out = tmp_path / "short.yaml", tmp_path / "flown.jsonl"
    path.write_text(
        f"defaults: {{profile: {SHORT}}}\n"
        "vehicles:\n  - {name: a, home_m: [0, 0], target_m: [0, 0]}\n"
    )
    words = ("fleet", "simulate", str(path), "--json", "--out", str(out))
    figures = json.loads(run(*words, "-n", "1").stdout)
    assert (figures["fleets"], figures["vehicles"], figures["perched"]) == (1, 1, 1)
    assert figures["least_distance_m"] is None
    again = json.loads(run(*words, "-n", "1", "--resume").stdout)
    assert again == figures
    assert len(out.read_text().splitlines()) == 2
    path.write_text(path.read_text().replace("[0, 0]}", "[0.1, 0]}"))
    other = run(*words, "-n", "1", "--resume")
    assert other.code == 30
    assert "made with a different" in other.stderr
