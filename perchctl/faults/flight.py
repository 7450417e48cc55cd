"""One lockstep flight with a fault, judged by the truth."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from perchctl.calibration.files import camera_of
from perchctl.errors import PerchError
from perchctl.faults.camera import FaultyCamera
from perchctl.faults.catalogue import FROM_THE_START, Case, draw_case
from perchctl.faults.effects import Effect, ExternalPositions
from perchctl.faults.effects import Operator as Presses
from perchctl.faults.excuses import LEAST_LIFT, Facts
from perchctl.faults.inject import Disk, Edges, Injector, changed_scenario
from perchctl.faults.oracle import Claim, Limits, Oracle
from perchctl.faults.program import FaultyClock, ProgramKilled
from perchctl.faults.radio import FaultyRadio
from perchctl.faults.result import End, FaultResult
from perchctl.faults.truth import WatchedVehicle, sample_of
from perchctl.flight.lockstep import LockstepSource
from perchctl.flight.lockstep_positions import by_mocap, feed_lockstep
from perchctl.flight.loop import FlightParts, fly
from perchctl.flight.memory import give_back_memory, peak_memory_mb
from perchctl.flight.operator import OperatorSwitch
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link.bursty import radio_of
from perchctl.link.mock import MockLink
from perchctl.log.exact import to_exact
from perchctl.log.watch import LogWatcher
from perchctl.mission.state import Outcome, Phase
from perchctl.mission.watch import FlightReport, Watcher
from perchctl.pipeline import make_pipeline
from perchctl.profile import Profile
from perchctl.sim.draw import draw_capture, draw_scenario
from perchctl.sim.powertrain import most_thrust_n
from perchctl.sim.scenario import Scenario
from perchctl.sim.thrust_curve import MOTOR_FORCE_N

AFTER_S, AFTER_IN_THE_AIR_S = 6.0, 10.0
LONGEST_FLIGHT_S = 240.0


@dataclass
class _Ended:
    """How the program ended; `report` is None when it was killed or raised."""

    report: FlightReport | None = None
    error: str = ""
    gone: bool = False
    report_s: float | None = None


class FaultyFlight:
    """One flight, assembled; `fly` once."""

    def __init__(
        self, profile: Profile, case: Case, scenario: Scenario, log: LogWatcher | None = None
    ) -> None:
        if any(isinstance(effect, ExternalPositions) for effect in case.effects):
            profile = by_mocap(profile)
        self._profile, self._case, self._log = profile, case, log
        self._scenario = scenario = _scenario_of(case, scenario)
        camera = camera_of(profile.camera)
        capture = draw_capture(profile, scenario.seed)
        self._vehicle = vehicle = WatchedVehicle(scenario, camera, profile.target, capture)
        radio = FaultyRadio(radio_of(scenario))
        radio.serves(vehicle.firmware)
        self._link = MockLink(vehicle, profile.link.telemetry_period_s, radio)
        assert vehicle.camera is not None
        inner = LockstepSource(vehicle.camera, profile.camera.start_latency_s)
        source = FaultyCamera(inner, scenario.seed)
        self._clock = FaultyClock(self._link, lambda: _cut(radio), LONGEST_FLIGHT_S)
        switch, disk = OperatorSwitch(listening=True, clock=self._clock.now), Disk()
        edges = Edges(vehicle, radio, source, self._clock, switch.press, switch.land, disk)
        self._injector = Injector(edges, case.effects, case.phase, case.moment_s)
        self._injector.on_begin = self._note_beginning
        self._injectors = [self._injector]
        if case.landed_from is not None:
            lands: tuple[Effect, ...] = (Presses((0.0,), hang_up=True),)
            self._injectors.append(Injector(edges, lands, case.landed_from, case.landed_after_s))
        watchers: tuple[Watcher, ...] = (*self._injectors, disk)
        if log is not None:
            log.truth = self._for_log
            watchers = (*watchers, log)
        pipeline = make_pipeline(profile, camera)
        seen = source if log is None else log.watched(source)
        self._parts = FlightParts(
            self._link, seen, self._clock, profile, pipeline, watchers, switch.read,
            positions=feed_lockstep(self._link, profile),
            remarks=tuple if log is None else log.remarks,
        )  # fmt: skip
        safety = profile.safety
        self._oracle = Oracle(Limits(safety.fence_radius_m, safety.max_height_m))
        self._own_landing = False
        self._weak_s: float | None = None
        self._low_s: float | None = None
        self._low_m = 0.0
        self._hung_m: float | None = None
        self._let_go_s: float | None = None

    def fly(self) -> FaultResult:
        began_s = time.perf_counter()
        self._vehicle.each = self._each
        ended = self._program()
        self._vehicle.camera = None
        end_s = self._link.now_s
        self._oracle.ended(end_s)
        self._vehicle.advance_to(end_s + AFTER_S)
        if self._oracle.in_the_air:
            self._vehicle.advance_to(end_s + AFTER_IN_THE_AIR_S)
        return self._result(ended, end_s, time.perf_counter() - began_s)

    def _program(self) -> _Ended:
        """The program's life: connect, fly, close, whatever happens."""
        self._link.connect()
        if self._case.fault.phases is FROM_THE_START:
            self._injector.begin_now()
        try:
            ended = self._mission()
            self._link.close()
        except ProgramKilled:
            return _Ended(gone=True)
        return ended

    def _mission(self) -> _Ended:
        try:
            report = fly(self._parts)
        except PerchError as error:
            return _Ended(error=str(error))
        except Exception as error:
            return _Ended(error=f"unforeseen {type(error).__name__}: {error}")
        self._vehicle.camera = None  # nobody looks any more
        self._oracle.claims(claim_of(report), self._link.now_s)
        return _Ended(report, report_s=self._link.now_s)

    def _each(self, t_s: float) -> None:
        for injector in self._injectors:
            injector.each(t_s)
        sample = sample_of(self._vehicle, self._injector.drifted_m)
        self._oracle.see(sample)
        if sample.hanging:
            self._hung_m = sample.height_m
        landing = self._injector.flown is Phase.LANDING
        if landing and sample.floor and not sample.motors_on:
            self._vehicle.camera = None  # most of the time would go into pictures of the wait
        world = self._vehicle.world
        if world.magnet.let_go and self._let_go_s is None:
            self._let_go_s = t_s
        if self._injector.begin_s is not None:
            weakest = min(world.powertrain.strength or (1.0,))
            lift_n = min(4.0 * MOTOR_FORCE_N, weakest * most_thrust_n(world.battery_rest_v))
            weight_n = self._scenario.mass_kg * GRAVITY_MPS2
            if self._weak_s is None and lift_n < LEAST_LIFT * weight_n:
                self._weak_s = t_s
            if self._low_s is None and world.battery_v < self._profile.safety.min_load_v:
                self._low_s, self._low_m = t_s, sample.height_m

    def _note_beginning(self) -> None:
        self._own_landing = self._vehicle.firmware.planner.active

    def _result(self, ended: _Ended, end_s: float, wall_s: float) -> FaultResult:
        case, report = self._case, ended.report
        verdict = self._oracle.verdict()
        facts = Facts(
            effects=case.effects,
            begin_s=self._injector.begin_s,
            report_s=ended.report_s,
            let_go_s=self._let_go_s,
            own_landing=self._own_landing,
            weak_s=self._weak_s,
            low_s=self._low_s,
            low_m=self._low_m,
            hung_m=self._hung_m,
        )
        excuses = [excuse for excuse in case.fault.excuses if excuse.when(facts)]
        excused = {flag for excuse in excuses for flag in excuse.expected}
        hanging = self._oracle.newest is not None and self._oracle.newest.hanging
        perched = report is not None and report.phase is Phase.PERCHED and hanging
        result = FaultResult(
            seed=self._scenario.seed,
            fault=case.fault.name,
            phase=case.phase.value,
            moment_s=case.moment_s,
            begin_s=self._injector.begin_s,
            parameters=_parameters(case),
            end=_end_of(ended),
            cause="" if report is None else report.outcome.value,
            reason=ended.error if report is None else report.reason,
            flags=verdict.flags,
            counted=tuple(flag for flag in verdict.flags if flag not in excused),
            unavoidable="; ".join(excuse.reason for excuse in excuses) or None,
            time_s=end_s,
            miss_m=self._vehicle.world.gear_miss_m() if perched else None,
            drop_m=verdict.drop_m,
            slip_ratio=verdict.slip_ratio,
            wall_s=wall_s,
            way=() if report is None else tuple(e.phase.value for e in report.history if e.phase),
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
    """Fly a case to its end and judge it. Errors: NotFound, InvalidValue (calibration, log)."""
    watcher = None if log is None else LogWatcher.lockstep(log, profile, scenario.seed, record)
    return FaultyFlight(profile, case, scenario, watcher).fly()


def fly_fault_seed(
    profile: Profile,
    seed: int,
    faults: tuple[str, ...],
    log: Path | None = None,
    record: bool = False,
) -> FaultResult:
    """The seed's scenario with the seed's fault out of those named."""
    from perchctl.faults.catalogue import BY_NAME

    cv2.setNumThreads(1)  # a job is one core
    cpu_began_s = time.process_time()
    scenario = draw_scenario(profile, seed)
    case = draw_case(seed, scenario, [BY_NAME[name] for name in faults])
    result = fly_with_fault(profile, case, scenario, log, record)
    cpu_s = time.process_time() - cpu_began_s
    give_back_memory()
    return replace(result, cpu_s=cpu_s, peak_memory_mb=peak_memory_mb(), scenario=scenario)


def claim_of(report: FlightReport) -> Claim:
    """What a report says about where the vehicle is."""
    if report.phase is Phase.PERCHED:
        return "perched"
    if report.phase is Phase.LANDED:
        return "landed"
    return "cut" if report.outcome is Outcome.EMERGENCY else "none"


def _scenario_of(case: Case, scenario: Scenario) -> Scenario:
    if case.first_hold is not None:
        hold_n = case.first_hold * scenario.mass_kg * GRAVITY_MPS2
        scenario = replace(scenario, first_contact_force_n=hold_n)
    return changed_scenario(scenario, case.effects)


def _end_of(ended: _Ended) -> End:
    if ended.gone:
        return "gone"
    if ended.report is None:
        return "refused"
    match ended.report.phase:
        case Phase.PERCHED:
            return "perched"
        case Phase.LANDED:
            return "landed"
    return "aborted"


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


def _cut(radio: FaultyRadio) -> None:
    radio.cut = True
