"""Fly one flight in lockstep with a fault, and judge it by the simulator's ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.calibration import profile_camera
from perchctl.campaign import fly_measured, seed_log_path
from perchctl.errors import PerchError
from perchctl.faults import effects as e
from perchctl.faults.catalogue import BY_NAME, FROM_THE_START, Case, draw_case
from perchctl.faults.edges import (
    FaultRig,
    FaultyCamera,
    FaultyClock,
    FaultyRadio,
    PlantedError,
    ProgramKilled,
)
from perchctl.faults.expected_outcomes import EXPECTED_OUTCOMES, unexpected_flags
from perchctl.faults.oracle import (
    REFUSAL_CLAIMS,
    Oracle,
    Sample,
    last_transition,
    report_claims,
    rescue_claims,
)
from perchctl.faults.results import FaultResult
from perchctl.faults.truth import (
    DescentBound,
    FactsRecorder,
    PositionBound,
    UndetectedDrift,
    WatchedVehicle,
    true_sample,
)
from perchctl.flight import (
    FlightParts,
    OperatorSwitch,
    fly,
    lockstep_feed,
    lockstep_source,
)
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link import MockLink, Packet, Port, Radio
from perchctl.mission import Event, FlightReport, Phase, Tick, Watcher
from perchctl.profile import Profile
from perchctl.record import LogWatcher, to_exact_json
from perchctl.sim import Scenario, SimulatedVehicle, draw_capture
from perchctl.vision import make_pipeline

AFTER_PROGRAM_END_S = 6.0
"""Time for which the vehicle is watched after the program has ended, s. Smaller: a later fall is
missed."""
AFTER_IN_THE_AIR_S = 10.0
"""Time for which a vehicle is watched if it is still in the air when the program ends, s."""
LONGEST_FLIGHT_S = 240.0
END_OF = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}
PROBE = Packet(Port.LINK, 0, b"")
"""A packet without effect that probes the radio: it arrives whenever any other packet would
arrive."""


class FaultyFlight:
    """One flight with a fault, and the oracle that judges it. `fly` may be called only once.

    It is also a `Watcher` of the loop; `problem` is the error that the log's disk reports, or None.

    Args:
        on_sample: called with the vehicle's time every `e.SAMPLE_S` of the flight, after the oracle
            has been updated. In a fleet, the flights wait for each other in this function.
        others: (name, position m) of each other rigid body that the motion-capture system tracks;
            None: as drawn from the seed.
        climb_withheld: as in `FlightParts`.
    """

    def __init__(
        self,
        profile: Profile,
        case: Case,
        scenario: Scenario,
        log: LogWatcher | None = None,
        *,
        on_sample: Callable[[float], None] = lambda t_s: None,
        others: tuple[tuple[str, tuple[float, float, float]], ...] | None = None,
        climb_withheld: Callable[[], str | None] = lambda: None,
    ) -> None:
        profile = e.apply_to_profile(profile, case.effects)
        self._profile, self._case, self._log = profile, case, log
        self._scenario = scenario = _scenario_of(case, scenario)
        self.problem: str | None = None
        camera = profile_camera(profile.camera)
        capture = draw_capture(profile, scenario.seed)
        if capture is not None and others is not None:
            capture = replace(capture, others=others)
        self._on_sample = on_sample
        self._newest_tick: Tick | None = None
        self._end: str | None = None
        self._vehicle = vehicle = WatchedVehicle(scenario, camera, profile.target, capture)
        self._radio = radio = FaultyRadio(Radio(scenario.radio_bursts()))
        radio.receive = vehicle.receive
        self._link = MockLink(vehicle, profile.link.telemetry_period_s, radio)
        source = FaultyCamera(lockstep_source(vehicle, profile), scenario.seed)
        self._clock = clock = FaultyClock(self._link, radio, LONGEST_FLIGHT_S)
        self._switch = OperatorSwitch(listening=True, clock=clock.now)
        self._edges = edges = FaultRig(
            vehicle, radio, source, clock, self._press, self._switch.land, self
        )
        self._injector = e.Injector(edges, case.effects, case.phase, case.moment_s)
        self._injectors = [self._injector]
        if case.landed_from is not None:
            lands = (partial(e.operator, presses_s=(0.0,), hang_up=True),)
            self._injectors.append(e.Injector(edges, lands, case.landed_from, case.landed_after_s))
        watchers: tuple[Watcher, ...] = ()
        if log is not None:
            log.truth = self._for_log
            watchers = (log,)
        pipeline = make_pipeline(profile, camera)
        self._parts = FlightParts(
            self._link,
            source,
            clock,
            profile,
            pipeline,
            watchers,
            self._switch.read,
            positions=lockstep_feed(self._link, profile),
            remarks=tuple if log is None else log.remarks,
            judges=(self,),
            climb_withheld=climb_withheld,
            simulated=True,
        )
        safety, radius_m = profile.safety, profile.planner.perch.contact_xy_m
        self._oracle = Oracle(safety.max_height_m, safety.max_tilt_deg, radius_m)
        self._place_bound = PositionBound(scenario, profile)
        by_target = profile.positioning.source.is_target
        self._drift = UndetectedDrift(case.effects, scenario, by_target=by_target)
        self._descent_bound = DescentBound(case.effects, profile)
        self._facts = FactsRecorder(vehicle, profile, case.effects)
        self._touched = False  # contact with the ceiling since the fault began
        self._crashed = False  # an exception that no fault raised has ended the program

    def fly(self) -> FaultResult:
        """Fly to the end, wait until the vehicle is at rest, and return the oracle's result."""
        self._vehicle.on_sample = self._each
        self._link.connect()
        if self._case.fault.phases == FROM_THE_START:
            self._injector.begin(self._vehicle.t_s)
        try:
            end, reason, report = self._mission()
            self._link.close()
        except ProgramKilled:
            end, reason, report = "gone", "", None
        self._end = end
        self._vehicle.camera = None
        end_s = self._link.now_s
        self._oracle.note_program_end(end_s, crashed=self._crashed, endless=self._clock.endless)
        self._vehicle.advance_to(end_s + AFTER_PROGRAM_END_S)
        if self._oracle.is_airborne:
            self._vehicle.advance_to(end_s + AFTER_IN_THE_AIR_S)
        return self._result(end, reason, report, end_s)

    @property
    def vehicle(self) -> SimulatedVehicle:
        """The simulated vehicle, with its true state."""
        return self._vehicle

    @property
    def end(self) -> str | None:
        """How the program ended (one of `ENDS`), even if its vehicle is still being observed; None
        while it runs."""
        return self._end

    @property
    def newest_tick(self) -> Tick | None:
        """The newest tick of the loop; None before the mission."""
        return self._newest_tick

    def land(self) -> None:
        """Command a landing, as the operator would."""
        self._switch.land()

    def begin_fault(self) -> None:
        """Begin the case's effects now, unless they have already begun."""
        if self._injector.begin_s is None:
            self._injector.begin(self._vehicle.t_s)

    def tick(self, tick: Tick) -> None:
        self._newest_tick = tick
        for injector in self._injectors:
            injector.tick(tick)

    def event(self, event: Event) -> None:
        """Pass the claims made by a rescue event to the oracle."""
        self._oracle.add_claims(rescue_claims(event), event.t_s)

    def _mission(self) -> tuple[str, str, FlightReport | None]:
        try:
            report = fly(self._parts)
        except PlantedError as error:
            return "failed", str(error), None
        except Exception as error:
            if isinstance(error, PerchError) and self._injector.flown is None:
                self._oracle.add_claims(REFUSAL_CLAIMS, self._link.now_s)
                return "refused", str(error), None
            self._crashed = True
            return "failed", f"{type(error).__name__}: {error}", None
        self._vehicle.camera = None  # the program no longer reads the camera
        self._oracle.add_claims(report_claims(report), self._link.now_s)
        return END_OF[report.phase], report.reason, report

    def _press(self) -> None:
        self._oracle.note_ctrl_c(self._link.now_s)
        self._switch.press()

    def _each(self, t_s: float) -> None:
        for injector in self._injectors:
            injector.begin_due(t_s)
        self._edges.call_due(t_s)
        self._facts.begin_s = self._injector.begin_s
        sample = self._sample(t_s)
        self._oracle.update(sample)
        self._facts.update(sample)
        landing = self._injector.flown is Phase.LANDING
        if landing and sample.on_floor and not sample.motors_on:
            # render no images while waiting, because that would take most of the computing time
            self._vehicle.camera = None
        self._on_sample(t_s)

    def _sample(self, t_s: float) -> Sample:
        sample, world = true_sample(self._vehicle), self._vehicle.world
        begin_s, phase = self._injector.begin_s, self._injector.flown
        place = (sample.x_m, sample.y_m)
        if not self._scenario.no_target:
            self._place_bound.add_target(world.magnet.target_xy_m)
        self._place_bound.note_phase(phase, place)
        astray_m = self._place_bound.astray_m(place)
        if begin_s is not None:
            self._descent_bound.begin(begin_s, phase)
            astray_m -= self._drift.update_drift_m(t_s - begin_s, phase)
            self._touched = self._touched or sample.hanging or world.push_n_and_on_floor()[0] > 0.0
        uplink = not self._is_suspended(t_s) and self._radio.uplink_arrives(PROBE, t_s)
        overdue = self._descent_bound.is_overdue(
            t_s,
            sample.height_m,
            sample.vz_mps,
            touching=self._touched,
            uplink=uplink,
            lands=self._vehicle.firmware.planner.active,
        )
        wrong = begin_s is not None and self._facts.has_effect(e.log_reads)
        heard = not wrong and all(self._is_heard(block, t_s) for block in MockLink.FAST_BLOCKS)
        return sample._replace(
            astray_m=astray_m, descent_overdue=overdue, uplink=uplink, telemetry_ok=heard
        )

    def _is_suspended(self, t_s: float) -> bool:
        begin_s = self._injector.begin_s
        return begin_s is not None and any(
            effect.func is e.suspended and t_s < begin_s + effect.keywords["for_s"]
            for effect in self._case.effects
        )

    def _is_heard(self, block: str, t_s: float) -> bool:
        delay_s = self._radio.downlink_delay_s(block, t_s)
        return delay_s is not None and delay_s <= self._profile.safety.proof_age_s

    def _result(
        self, end: str, reason: str, report: FlightReport | None, end_s: float
    ) -> FaultResult:
        case, oracle, facts = self._case, self._oracle, self._facts
        facts.killed_s, facts.stop_s = self._clock.killed_s, oracle.stop_s
        hanging = oracle.newest is not None and oracle.newest.hanging
        perched = report is not None and report.phase is Phase.PERCHED and hanging
        result = FaultResult(
            seed=self._scenario.seed,
            fault=case.fault.name,
            phase=case.phase.value,
            moment_s=case.moment_s,
            begin_s=facts.begin_s,
            parameters=_parameters(case),
            outcome=end,
            reason=reason,
            flags=oracle.flags,
            counted=unexpected_flags(oracle.flags, facts),
            time_s=end_s,
            miss_m=self._vehicle.world.gear_miss_m() if perched else None,
            drop_m=oracle.drop_m,
            way=() if report is None else tuple(x.phase.value for x in report.history if x.phase),
            row="" if report is None else last_transition(report),
            expected=tuple(x.name for x in EXPECTED_OUTCOMES if x.cause(facts) is not None),
            astray_m=oracle.astray_m,
        )
        if self._log is not None:
            self._log.close(report, result.miss_m, "fell" in result.flags)
            result = replace(result, log=self._log.path, log_problem=self._log.loss_reason)
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
    """Fly a case to its end, and judge the flight by the true state. `log`: file for the flight
    log, if any. Errors: NotFound, InvalidValue (calibration, log)."""
    flown_by = e.apply_to_profile(profile, case.effects)
    watcher = (
        None
        if log is None
        else LogWatcher.open_lockstep(log, flown_by, scenario.seed, record, case.text)
    )
    return FaultyFlight(profile, case, scenario, watcher).fly()


def fly_fault_in_folder(
    profile: Profile, faults: tuple[str, ...], log_dir: Path | None, record: bool, seed: int
) -> FaultResult:
    """Fly the scenario of `seed` with a fault that is drawn with the seed from the names `faults`.
    The log is written to `log_dir`, if given."""
    log = None if log_dir is None else seed_log_path(seed, log_dir)

    def fly_drawn(scenario: Scenario) -> FaultResult:
        case = draw_case(seed, scenario, [BY_NAME[name] for name in faults])
        return fly_with_fault(profile, case, scenario, log, record)

    return fly_measured(profile, seed, fly_drawn)


def _scenario_of(case: Case, scenario: Scenario) -> Scenario:
    if case.first_hold_ratio is not None:
        hold_n = case.first_hold_ratio * scenario.mass_kg * GRAVITY_MPS2
        scenario = replace(scenario, first_contact_force_n=hold_n)
    return e.apply_to_scenario(scenario, case.effects)


def _parameters(case: Case) -> dict[str, Any]:
    found = {effect.func.__name__: to_exact_json(effect.keywords) for effect in case.effects}
    if case.landed_from is not None:
        found["landed_from"] = case.landed_from.value
        found["landed_after_s"] = case.landed_after_s
    if case.first_hold_ratio is not None:
        found["first_hold"] = case.first_hold_ratio
    return found
