"""Whole flights with faults: some in every run, each fault in each phase as a campaign, by decks,
by motion capture and by the target alone."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

import cv2
from typer.testing import CliRunner

from perchctl.commands import app
from perchctl.commands.fly import positioning_methods, with_positioning
from perchctl.errors import InvalidValue, SafetyAbort
from perchctl.faults import FAULTS, FaultResult, fault_summary, fault_table
from perchctl.faults import flight as faulty
from perchctl.faults.catalogue import BY_NAME, Fault, draw_case, draw_fault_case
from perchctl.faults.edges import PlantedError
from perchctl.faults.effects import FOR_EVER, deck_silent
from perchctl.faults.flight import fly_with_fault
from perchctl.faults.oracle import FLAGS, NOT_KNOWN, UNCONFIRMED
from perchctl.faults.results import ENDS, worst_first
from perchctl.flight import loop
from perchctl.mission import Phase
from perchctl.mission.planner import step_mission
from perchctl.profile import Profile, load_profile
from perchctl.record import from_exact_json, to_exact_json
from perchctl.sim import draw_scenario
from tests.helpers.flights import SEED, SHORT

CELLS = [(fault.name, phase) for fault in FAULTS for phase in fault.phases]
GUARD = {
    (fault.name, fault.phases[(i + turn) % len(fault.phases)], by)
    for i, fault in enumerate(FAULTS)
    for turn, by in enumerate(positioning_methods())
}
"""Each fault once with each positioning, the phases by turns."""


# What docs/faults.md promises: no flag counts, and the flight perches or lands, but for these.
MAY_ABORT = {
    "uplink-silent", "link-silent", "weak-magnet-uplink", "brown-out", "ceiling-beside-its-plane",
    "emergency-stop-lost", "operator-twice", "operator-hammers", "killed", "suspended",
}  # fmt: skip
OTHER_ENDS = {"killed": "gone", "suspended": "gone", "exception": "failed"}
MAY_BE_UNSEEN = {
    "downlink-silent", "state-block-dead", "attitude-block-dead", "variance-block-dead",
    "telemetry-delayed", "hung", "slow", "hung-and-packet-lost", "position-frozen",
    "attitude-frozen", "acceleration-frozen", "thrust-frozen", "supervisor-frozen",
    "estimate-jumps", "height-jumps", "estimate-drifts", "estimate-nan", "external-position",
    "external-occluded", "external-swapped", "external-scaled", "external-late",
    "external-mirrored", "deck-silent",
}  # fmt: skip
"""What is wrong with the estimate may end in an unconfirmed landing, or held off the target."""
NAMED = {"camera-mirrored": "camera.mirrored", "camera-turned": "camera.mount"}
"""A flight that does not perch says why."""


def keeps_promise(r: FaultResult) -> bool:
    if r.counted:
        return False
    if r.outcome == "refused" or (
        r.fault in MAY_BE_UNSEEN and r.row in (UNCONFIRMED, "held-elsewhere")
    ):
        return True
    if r.outcome != "perched" and NAMED.get(r.fault, "") not in r.reason:
        return False
    if r.expected or (r.outcome == "aborted" and r.fault in MAY_ABORT):
        return True
    return r.outcome in ("perched", "landed", OTHER_ENDS.get(r.fault))


@cache
def profile(by: str = "deck") -> Profile:
    return with_positioning(load_profile(SHORT), by)


def flown(
    name: str, phase: Phase, log: Path | None = None, draw: int = 0, by: str = "deck"
) -> FaultResult:
    cv2.setNumThreads(1)
    scenario = draw_scenario(profile(by), SEED)
    rng = np.random.default_rng([draw, [f.name for f in FAULTS].index(name)])
    return fly_with_fault(
        profile(by), draw_fault_case(BY_NAME[name], phase, rng, scenario), scenario, log
    )


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("name", "phase", "by"),
    [
        pytest.param(
            n, p, by, id=f"{n}-{p.value}-{by}", marks=[pytest.mark.guard] * ((n, p, by) in GUARD)
        )
        for by in positioning_methods()
        for n, p in CELLS
    ],
)
def test_nothing_goes_wrong(name: str, phase: Phase, by: str) -> None:
    result = flown(name, phase, by=by)
    assert result.counted == (), result
    # By the target alone it may not know at the end whether it hangs or stands, and says so.
    not_known = by == "target" and result.row == NOT_KNOWN
    assert not_known or keeps_promise(result), result


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("sim", 21211562),  # a drifting height: a landing of its own ended in the air
        ("target_only", 21201418),  # the firmware turned by the jump, on motors at their limit
        ("sim", 2612010094),  # a contact proven late: pressed for 4.2 s
        ("target_only", 2612011472),  # a descent on a hover thrust that was 15 % too small
        ("target_only", 2612021064),  # the notify after the last stop was lost: locked
        ("target_only", 2612021214),  # restarted on the magnet, and reported to be on the floor
        ("target_only", 2612011437),  # without the state block: sank at 0.94 m/s in full view
    ],
)
def test_nothing_goes_wrong_any_more_in_a_seed_of_a_campaign(name: str, seed: int) -> None:
    flown_profile = load_profile(name)
    scenario = draw_scenario(flown_profile, seed)
    result = fly_with_fault(flown_profile, draw_case(seed, scenario), scenario)
    assert result.counted == (), result


@pytest.mark.parametrize(
    ("name", "changes", "kept"),
    [
        ("operator-once", {}, True),
        ("operator-once", {"outcome": "aborted"}, False),
        ("operator-once", {"counted": ("fell",)}, False),
        ("operator-once", {"outcome": "aborted", "row": UNCONFIRMED}, False),
        ("downlink-silent", {"outcome": "aborted", "row": UNCONFIRMED}, True),
        ("killed", {"outcome": "gone"}, True),
        ("camera-turned", {"reason": "turn camera.mount by 90 deg"}, True),
        ("camera-turned", {"reason": "target not found"}, False),
    ],
)
def test_a_broken_promise_is_seen(name: str, changes: dict[str, Any], kept: bool) -> None:
    assert keeps_promise(made(1, name, Phase.ALIGN, **changes)) is kept


def test_exceptions_are_of_faults_that_there_are() -> None:
    assert MAY_ABORT | MAY_BE_UNSEEN | {*OTHER_ENDS} | {*NAMED} <= {*BY_NAME}


class HeightWatched(faulty.FaultyFlight):
    """Notes how far the vehicle rises from the fault's beginning on, and when it is landed."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.begin_m: float | None = None
        self.rise_m, self.landed_for_s = 0.0, math.inf

    def _each(self, t_s: float) -> None:
        super()._each(t_s)
        begin_s, z_m = self._injector.begin_s, self._vehicle.world.z_m
        if begin_s is None:
            return
        self.begin_m = z_m if self.begin_m is None else self.begin_m
        self.rise_m = max(self.rise_m, z_m - self.begin_m)
        if self._injector.flown is Phase.LANDING:
            self.landed_for_s = min(self.landed_for_s, t_s - begin_s)


def deck_lost(phase: Phase, for_s: float, acc_z_mps2: float) -> tuple[HeightWatched, FaultResult]:
    cv2.setNumThreads(1)
    scenario = draw_scenario(profile(), SEED)
    case = draw_fault_case(BY_NAME["deck-silent"], phase, np.random.default_rng(1), scenario)
    case = replace(
        case, effects=(partial(deck_silent, for_s=for_s, acc_z_mps2=acc_z_mps2),), moment_s=0.2
    )
    flight = HeightWatched(profile(), case, scenario)
    return flight, flight.fly()


@pytest.mark.parametrize(
    ("phase", "acc_z_mps2"),
    [
        (Phase.ALIGN, 0.08),
        *(
            pytest.param(phase, acc_z_mps2, marks=pytest.mark.long)
            for phase in (Phase.SEARCH, Phase.ALIGN, Phase.RECOVER)
            for acc_z_mps2 in (-0.08, 0.08)
            if (phase, acc_z_mps2) != (Phase.ALIGN, 0.08)
        ),
    ],
)
def test_it_does_not_climb_with_an_estimate_that_nothing_corrects(
    phase: Phase, acc_z_mps2: float
) -> None:
    """Where a deck's positions end it was landed 5.6 s later, from a metre higher up."""
    flight, result = deck_lost(phase, FOR_EVER, acc_z_mps2)
    assert (result.outcome, result.counted) == ("landed", ()), result
    assert flight.landed_for_s < 1.0
    assert flight.rise_m < 0.15


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[FaultResult, Path]:
    """Killed while it aligns, in the air: nothing can be done about that."""
    log = tmp_path_factory.mktemp("killed") / "flight.jsonl"
    return flown("killed", Phase.ALIGN, log), log


def test_a_killed_program_is_cut_and_excused(killed: tuple[FaultResult, Path]) -> None:
    result, _ = killed
    assert (result.outcome, result.phase, result.miss_m) == ("gone", "ALIGN", None)
    assert set(result.flags) == {"fell", "locked_needlessly"}
    assert result.counted == ()
    assert result.begin_s is not None
    assert result.flags["fell"] == pytest.approx(result.begin_s + 2.0, abs=0.3)
    assert result.expected == ("cut by the firmware",)


def test_the_log_ends_where_the_program_did(killed: tuple[FaultResult, Path]) -> None:
    result, log = killed
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    assert lines[0]["fault"].startswith("killed, ")
    assert "s after ALIGN began: perchctl is killed (killed)" in lines[0]["fault"]
    ticks = [line["t_s"] for line in lines if line["kind"] == "tick"]
    assert ticks[-1] == pytest.approx(result.time_s, abs=0.05)


@pytest.mark.parametrize(("name", "astray_m"), [("bare-ceiling", 2.0), ("kick", 0.0)])
def test_only_a_target_that_hangs_there_is_one_to_fly_to(name: str, astray_m: float) -> None:
    """By the true room: a bare ceiling has none where one was drawn."""
    scenario = replace(draw_scenario(profile(), SEED), target_xy_m=(2.0, 0.0))
    case = draw_fault_case(BY_NAME[name], Phase.APPROACH, np.random.default_rng(0), scenario)
    flight = faulty.FaultyFlight(profile(), case, scenario)
    flight._sample(0.0)
    flight._place_bound.note_phase(Phase.SEARCH, (0.0, 0.0))
    assert flight._place_bound.astray_m((2.0, 0.0)) == pytest.approx(astray_m, abs=0.1)


@pytest.mark.parametrize(
    ("name", "heard"), [("kick", True), ("state-block-dead", False), ("thrust-frozen", False)]
)
def test_what_telemetry_does_not_tell_is_not_heard(name: str, heard: bool) -> None:
    scenario = draw_scenario(profile(), SEED)
    case = draw_fault_case(BY_NAME[name], Phase.APPROACH, np.random.default_rng(0), scenario)
    flight = faulty.FaultyFlight(profile(), case, scenario)
    assert flight._sample(0.0).telemetry_ok
    flight._injector.begin(0.0)
    assert flight._sample(0.02).telemetry_ok is heard


def test_a_refusal_says_that_nothing_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(parts: Any) -> Any:
        raise SafetyAbort("the resting battery voltage is 3.7 V")

    monkeypatch.setattr(faulty, "fly", refusing)
    scenario = draw_scenario(profile(), SEED)
    case = draw_fault_case(BY_NAME["kick"], Phase.APPROACH, np.random.default_rng(0), scenario)
    flight = faulty.FaultyFlight(profile(), case, scenario)
    standing = flight._sample(0.0)
    assert flight._mission()[0] == "refused"
    for k in range(100):
        flight._oracle.update(standing._replace(t_s=0.01 * k, motors_on=True))
    assert flight._oracle.flags == {"lied": pytest.approx(0.5)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("error", "counted"), [(ValueError("a figure"), ("crashed",)), (PlantedError("of a fault"), ())]
)
def test_an_exception_that_no_fault_planted_is_counted(
    error: Exception, counted: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The vehicle is landed all the same."""
    step = step_mission

    def raising(state: Any, *rest: Any) -> Any:
        if state is not None and state.phase is Phase.SEARCH:
            raise error
        return step(state, *rest)

    monkeypatch.setattr(loop, "step_mission", raising)
    result = flown("disk-full", Phase.ALIGN)
    assert (result.outcome, result.counted) == ("failed", counted)
    assert str(error) in result.reason


@pytest.mark.long
def test_a_flight_that_does_not_end_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faulty, "LONGEST_FLIGHT_S", 5.0)
    result = flown("disk-full", Phase.ALIGN)
    assert result.outcome == "gone"
    assert "endless" in result.counted
    assert result.flags["endless"] == pytest.approx(5.0, abs=0.1)


# --- figures, table, picture ----------------------------------------------------------


def made(seed: int, name: str, phase: Phase, **changes: Any) -> FaultResult:
    plain: dict[str, Any] = {
        "seed": seed, "fault": name, "phase": phase.value, "moment_s": 0.5, "begin_s": 4.0,
        "parameters": {}, "outcome": "landed", "reason": "", "flags": {}, "counted": (),
        "time_s": 20.0, "miss_m": None, "drop_m": 0.0,
    }  # fmt: skip
    return FaultResult(**(plain | changes))


RESULTS = [
    made(1, "killed", Phase.ALIGN, outcome="gone", flags={"fell": 6.0},
         expected=("cut by the firmware",)),
    made(2, "kick", Phase.ALIGN, outcome="perched"),
    made(3, "kick", Phase.ALIGN, flags={"lied": 9.0, "fell": 8.0}, counted=("lied", "fell")),
    made(4, "weak-magnet", Phase.PERCH, flags={"pressed": 9.0}, counted=("pressed",), row="landed"),
    made(5, "magnet-lets-go", Phase.PERCH, outcome="aborted", row=NOT_KNOWN,
         expected=("let go after the flight",)),
]  # fmt: skip


def test_figures() -> None:
    figures = fault_summary(RESULTS)
    told = {key: figures[key] for key in ("flights", *ENDS, *FLAGS, "unavoidable") if figures[key]}
    assert told == {
        "flights": 5, "perched": 1, "landed": 2, "aborted": 1, "gone": 1, "fell": 1, "pressed": 1,
        "lied": 1, "unavoidable": 1,
    }  # fmt: skip
    assert figures["worst_seeds"] == [r.seed for r in worst_first(RESULTS)] == [3, 4]
    assert figures["expected_outcomes"] == {"cut by the firmware": 1, "let go after the flight": 1}
    rates = [figures[key]["rate"] for key in ("wrong", "not_known", "unconfirmed")]
    assert rates == [0.4, 0.2, 0.0]
    json.dumps(figures)


def test_the_table_fits_the_terminal() -> None:
    every = [made(i, name, phase) for i, (name, phase) in enumerate(CELLS)]
    assert max(map(len, fault_table(every).splitlines())) <= 80
    shown = fault_table(RESULTS)
    for row in (
        r"^kick +2 +1 +0$", r"^killed +1 +0 +1$", r"^1 of 5 .* not known: ",
        r"^ +1 +let go after the flight: ",
    ):  # fmt: skip
        assert re.search(row, shown, re.MULTILINE), row


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_result_comes_back_from_its_record(fault: Fault) -> None:
    scenario = draw_scenario(profile(), SEED)
    for seed in range(4):
        parameters = faulty._parameters(draw_case(seed, scenario, [fault]))
        result = replace(RESULTS[2], parameters=parameters)
        record = json.loads(json.dumps(to_exact_json(result), allow_nan=False))
        assert from_exact_json(FaultResult, record) == result


# --- the command ----------------------------------------------------------------------


def simulate(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["simulate", "-p", SHORT, *arguments])


def test_the_command_lists_and_refuses() -> None:
    listed = simulate("--faults", "list")
    assert listed.exit_code == 0
    assert all(f"{fault.name} " in listed.stdout for fault in FAULTS)
    assert max(map(len, listed.stdout.splitlines())) <= 80
    told = json.loads(simulate("--faults", "list", "--json").stdout)
    assert told["faults"] == {fault.name: fault.description for fault in FAULTS}
    refused = simulate("--faults", "hanged")
    assert refused.exit_code == InvalidValue.exit_code
    assert "--faults list" in refused.stderr
