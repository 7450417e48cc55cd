"""One lockstep flight with a fault, judged by the truth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from perchctl.calibration import profile_camera
from perchctl.campaign import fly_measured, seed_log_path
from perchctl.errors import PerchError
from perchctl.faults import effects as e
from perchctl.faults.bounds import DescentBound, PlaceBound, UnfeltDrift
from perchctl.faults.catalogue import BY_NAME, FROM_THE_START, Case, draw_case
from perchctl.faults.claims import REFUSAL_CLAIMS, claims_of, claims_of_rescue, last_row
from perchctl.faults.edges import (
    FaultyCamera,
    FaultyClock,
    FaultyRadio,
    PlantedError,
    ProgramKilled,
)
from perchctl.faults.expected_outcomes import unexpected
from perchctl.faults.inject import Disk, Edges, Injector, changed_scenario
from perchctl.faults.oracle import Limits, Oracle, Sample
from perchctl.faults.results import End, FaultResult
from perchctl.faults.truth import FactsRecorder, WatchedVehicle, sample_of
from perchctl.flight import (
    FlightParts,
    OperatorSwitch,
    feed_lockstep,
    fly,
    lockstep_source,
)
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link import MockLink, Packet, Port, Radio
from perchctl.mission import Event, FlightReport, Phase, Tick, Watcher
from perchctl.profile import Profile
from perchctl.record import LogWatcher, to_exact
from perchctl.sim import Scenario, draw_capture
from perchctl.vision import make_pipeline

AFTER_S, AFTER_IN_THE_AIR_S = 6.0, 10.0
END_OF: dict[Phase, End] = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}
LONGEST_FLIGHT_S = 240.0
PROBE = Packet(Port.LINK, 0, b"")
"""A packet without effect, which arrives whenever any packet would."""


@dataclass
class _Ended:
    """The end of the program under test. `report` is None if it was killed or raised; `crashed`
    is True after an exception that no fault planted."""

    end: End
    report: FlightReport | None = None
    error: str = ""
    crashed: bool = False


class FaultyFlight:
    """One flight with a fault and its judge, ready for a single call of `fly`."""

    problem: str | None = None

    def __init__(
        self, profile: Profile, case: Case, scenario: Scenario, log: LogWatcher | None = None
    ) -> None:
        profile, sooner_s = _flown_by(profile, case), _sooner_s(case.effects)
        self._profile, self._case, self._log = profile, case, log
        self._scenario = scenario = _scenario_of(case, scenario)
        camera = profile_camera(profile.camera)
        capture = draw_capture(profile, scenario.seed)
        self._vehicle = vehicle = WatchedVehicle(scenario, camera, profile.target, capture)
        self._radio = radio = FaultyRadio(Radio(scenario.radio_bursts()))
        radio.serves(vehicle.receive)
        self._link = MockLink(vehicle, profile.link.telemetry_period_s, radio)
        source = FaultyCamera(lockstep_source(vehicle, profile), scenario.seed)
        source.late_s = sooner_s
        self._clock = FaultyClock(self._link, radio, LONGEST_FLIGHT_S)
        self._switch = OperatorSwitch(listening=True, clock=self._clock.now)
        disk = Disk()
        edges = Edges(vehicle, radio, source, self._clock, self._press, self._switch.land, disk)
        self._injector = Injector(edges, case.effects, case.phase, case.moment_s)
        self._injector.on_begin = self._note_beginning
        self._injectors = [self._injector]
        if case.landed_from is not None:
            lands: tuple[e.Effect, ...] = (e.Operator((0.0,), hang_up=True),)
            self._injectors.append(Injector(edges, lands, case.landed_from, case.landed_after_s))
        watchers: tuple[Watcher, ...] = (*self._injectors, disk, self)
        if log is not None:
            log.truth = self._for_log
            watchers = (*watchers, log)
        pipeline = make_pipeline(profile, camera)
        seen = source if log is None else log.watched(source)
        self._parts = FlightParts(
            self._link, seen, self._clock, profile, pipeline, watchers, self._switch.read,
            positions=feed_lockstep(self._link, profile),
            remarks=tuple if log is None else log.remarks,
        )  # fmt: skip
        safety, radius_m = profile.safety, profile.planner.perch.contact_xy_m
        self._oracle = Oracle(Limits(safety.max_height_m, safety.max_tilt_deg, radius_m))
        self._place_bound = PlaceBound(scenario, profile)
        self._drift = UnfeltDrift(
            case.effects, scenario, by_target=profile.positioning.by == "target"
        )
        self._descent_bound = DescentBound(case.effects, profile)
        self._recorder = FactsRecorder(vehicle, profile, case.effects)
        self._touched = False  # the ceiling, since the fault began

    def fly(self) -> FaultResult:
        began_s = time.perf_counter()
        self._vehicle.each = self._each
        ended = self._program()
        self._vehicle.camera = None
        end_s = self._link.now_s
        self._oracle.ended(end_s, crashed=ended.crashed, endless=self._clock.endless)
        self._vehicle.advance_to(end_s + AFTER_S)
        if self._oracle.in_the_air:
            self._vehicle.advance_to(end_s + AFTER_IN_THE_AIR_S)
        return self._result(ended, end_s, time.perf_counter() - began_s)

    def tick(self, tick: Tick) -> None:
        return None

    def event(self, event: Event) -> None:
        """Give the claims of a rescue's note to the oracle."""
        self._oracle.claims(claims_of_rescue(event), event.t_s)

    def _program(self) -> _Ended:
        """Run the program under test: connect, fly, close, whatever happens."""
        self._link.connect()
        if self._case.fault.phases is FROM_THE_START:
            self._injector.begin_now()
        try:
            ended = self._mission()
            self._link.close()
        except ProgramKilled:
            return _Ended("gone")
        return ended

    def _mission(self) -> _Ended:
        try:
            report = fly(self._parts)
        except PlantedError as error:
            return _Ended("failed", error=str(error))
        except Exception as error:
            if isinstance(error, PerchError) and self._injector.flown is None:
                self._oracle.claims(REFUSAL_CLAIMS, self._link.now_s)
                return _Ended("refused", error=str(error))
            return _Ended("failed", error=f"{type(error).__name__}: {error}", crashed=True)
        self._vehicle.camera = None  # nobody looks any more
        self._oracle.claims(claims_of(report), self._link.now_s)
        return _Ended(END_OF[report.phase], report)

    def _press(self) -> None:
        self._oracle.pressed(self._link.now_s)
        self._switch.press()

    def _each(self, t_s: float) -> None:
        for injector in self._injectors:
            injector.each(t_s)
        sample = self._sample(t_s)
        self._oracle.see(sample)
        self._recorder.see(sample, begun=self._injector.begin_s is not None)
        landing = self._injector.flown is Phase.LANDING
        if landing and sample.floor and not sample.motors_on:
            self._vehicle.camera = None  # most of the time would go into pictures of the wait

    def _sample(self, t_s: float) -> Sample:
        """Return the true state of the vehicle, with its distance from where it should be."""
        sample, world = sample_of(self._vehicle), self._vehicle.world
        begin_s, phase = self._injector.begin_s, self._injector.flown
        place = (sample.x_m, sample.y_m)
        if not self._scenario.no_target:
            self._place_bound.target_at(world.magnet.target_xy_m)
        self._place_bound.enter(phase, place)
        astray_m = self._place_bound.astray_m(place)
        if begin_s is not None:
            astray_m -= self._drift.after_m(t_s - begin_s, phase)
            self._touched = self._touched or sample.hanging or world.contacts()[0] > 0.0
        uplink = not self._is_suspended(t_s) and self._radio.uplink_arrives(PROBE, t_s)
        overdue = self._descent_bound.is_overdue(
            t_s,
            sample.height_m,
            sample.vz_mps,
            touching=self._touched,
            uplink=uplink,
            lands=self._vehicle.firmware.planner.active,
        )
        heard = all(self._is_heard(block, t_s) for block in MockLink.FAST_BLOCKS)
        return sample._replace(astray_m=astray_m, overdue=overdue, uplink=uplink, heard=heard)

    def _is_heard(self, block: str, t_s: float) -> bool:
        if self._injector.begin_s is not None and any(
            isinstance(effect, e.LogReads) for effect in self._case.effects
        ):
            return False
        delay_s = self._radio.downlink_delay_s(block, t_s)
        return delay_s is not None and delay_s <= self._profile.safety.proof_age_s

    def _is_suspended(self, t_s: float) -> bool:
        begin_s = self._injector.begin_s
        return begin_s is not None and any(
            isinstance(effect, e.Suspended) and begin_s <= t_s < begin_s + effect.for_s
            for effect in self._case.effects
        )

    def _note_beginning(self) -> None:
        self._descent_bound.begin(self._vehicle.t_s, self._injector.flown)

    def _result(self, ended: _Ended, end_s: float, wall_s: float) -> FaultResult:
        case, report = self._case, ended.report
        facts = self._recorder.complete(
            begin_s=self._injector.begin_s,
            killed_s=self._clock.killed_s,
            stop_s=self._oracle.stop_s,
        )
        listed = case.fault.expected_outcomes
        expected = [outcome for outcome in listed if outcome.cause(facts) is not None]
        hanging = self._oracle.newest is not None and self._oracle.newest.hanging
        perched = report is not None and report.phase is Phase.PERCHED and hanging
        result = FaultResult(
            seed=self._scenario.seed,
            fault=case.fault.name,
            phase=case.phase.value,
            moment_s=case.moment_s,
            begin_s=self._injector.begin_s,
            parameters=_parameters(case),
            end=ended.end,
            cause="" if report is None else report.outcome.value,
            reason=ended.error if report is None else report.reason,
            counted=unexpected(self._oracle.verdict.flags, listed, facts),
            unavoidable="; ".join(outcome.reason for outcome in expected) or None,
            time_s=end_s,
            miss_m=self._vehicle.world.gear_miss_m() if perched else None,
            wall_s=wall_s,
            way=() if report is None else tuple(x.phase.value for x in report.history if x.phase),
            row="" if report is None else last_row(report),
            expected=tuple(outcome.name for outcome in expected),
            **vars(self._oracle.verdict),
        )
        if self._log is not None:
            self._log.close(report, result.miss_m, "fell" in result.flags)
            result = replace(result, log=self._log.path, log_problem=self._log.problem)
        return result

    def _for_log(self) -> tuple[tuple[float, float, float], float]:
        world = self._vehicle.world
        return (world.x_m, world.y_m, world.z_m), world.gear_miss_m()


def fly_with_fault(
    profile: Profile,
    case: Case,
    scenario: Scenario,
    log: Path | None = None,
    record: bool = False,
) -> FaultResult:
    """Fly a case to its end and judge it by the truth. Errors: NotFound, InvalidValue
    (calibration, log)."""
    flown_by = _flown_by(profile, case)
    watcher = None if log is None else LogWatcher.lockstep(log, flown_by, scenario.seed, record)
    return FaultyFlight(profile, case, scenario, watcher).fly()


def fly_fault_seed(
    profile: Profile,
    seed: int,
    faults: tuple[str, ...],
    log: Path | None = None,
    record: bool = False,
) -> FaultResult:
    """Fly the seed's scenario with the seed's fault, drawn from those named."""

    def fly_drawn(scenario: Scenario) -> FaultResult:
        case = draw_case(seed, scenario, [BY_NAME[name] for name in faults])
        return fly_with_fault(profile, case, scenario, log, record)

    return fly_measured(profile, seed, fly_drawn)


def fly_fault_in_folder(
    profile: Profile, faults: tuple[str, ...], log_dir: Path | None, record: bool, seed: int
) -> FaultResult:
    """Fly a seed as `fly_fault_seed` does, with its log in a folder if one is given."""
    log = None if log_dir is None else seed_log_path(seed, log_dir)
    return fly_fault_seed(profile, seed, faults, log, record)


def _scenario_of(case: Case, scenario: Scenario) -> Scenario:
    if case.first_hold is not None:
        hold_n = case.first_hold * scenario.mass_kg * GRAVITY_MPS2
        scenario = replace(scenario, first_contact_force_n=hold_n)
    return changed_scenario(scenario, case.effects)


def _sooner_s(effects: Sequence[e.Effect]) -> float:
    """Return the time by which the pictures will come sooner than the profile expects."""
    found = [f.late_s for f in effects if isinstance(f, e.CameraFault) and f.kind == "sooner"]
    return max(found, default=0.0)


def _flown_by(profile: Profile, case: Case) -> Profile:
    """Return the profile with the positioning and the camera latency that the case needs."""
    if any(isinstance(effect, e.ExternalPositions) for effect in case.effects):
        profile = _positioned_by("mocap", profile)
    if any(isinstance(effect, e.DeckSilent) for effect in case.effects):
        profile = _positioned_by("deck", profile)
    more_s = _sooner_s(case.effects)
    if more_s == 0.0:
        return profile
    latency_s = profile.camera.start_latency_s + more_s
    camera = profile.camera.model_copy(update={"latency_s": latency_s})
    return profile.model_copy(update={"camera": camera})


def _positioned_by(by: str, profile: Profile) -> Profile:
    config = profile.positioning.model_copy(update={"by": by})
    return profile.model_copy(update={"positioning": config})


def _parameters(case: Case) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for effect in case.effects:
        found[type(effect).__name__] = to_exact(asdict(effect))
    if case.landed_from is not None:
        found["landed_from"] = case.landed_from.value
        found["landed_after_s"] = case.landed_after_s
    if case.first_hold is not None:
        found["first_hold"] = case.first_hold
    return found
