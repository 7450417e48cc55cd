"""Check rows about the connected vehicle: radio, firmware, decks, and telemetry at rest."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from perchctl.check.row import (
    Finding,
    Row,
    Unanswerable,
    failed,
    limits_finding,
    passed,
    problem_finding,
    skipped,
    warned,
    worst_finding,
)
from perchctl.errors import ConnectionFailed, Problem
from perchctl.flight import GroundCriteria
from perchctl.link import ProbeLink
from perchctl.profile import Profile
from perchctl.vehicle import (
    AIRFRAMES,
    DISARM_IT,
    LOW_POWER,
    POSITION_DECKS,
    Telemetry,
    is_armed_by_request,
    is_battery_reading,
)

LISTEN_S = 5.0
MOVED_WARN_M = 0.05
"""Motion of the estimate at rest above which the check warns, m: five times the drift in a normal
flight."""
KALMAN = 2
SELF_TEST, ESTIMATOR = "system.selftestPassed", "stabilizer.estimator"
BY_FLY = "perchctl fly sends the positions, and waits until the estimate agrees with them"
"""Finding for a vehicle that gets its positions from motion capture or from the target."""
ARMED_BY_FLY = "perchctl fly arms it after you confirm"
UNREPORTED = "this vehicle does not report this value (see link.unreported)"

Wait = Callable[[float], None]

LINK_ADVICE = {
    "radio": "move the radio closer, or choose a channel above 80",
    "usb": "use another cable or USB port",
    "udp": "check the network between this computer and the vehicle",
    "sim": "close other programs: the simulated vehicle runs on this computer",
}
"""Advice if packets are lost or slow, keyed by the scheme of the vehicle's URI."""
ADDRESS_ADVICE = {
    "radio": "switch the vehicle on; perchctl check --scan lists the vehicles that answer",
    "usb": "plug the vehicle in and switch it on; perchctl check --scan lists the vehicles that "
    "answer",
    "udp": "switch the vehicle on, and check its address; perchctl check --scan lists the "
    "vehicles that answer",
    "sim": "start it again",
}


def unanswered_row(error: ConnectionFailed, uri: str) -> Row:
    """The row for a vehicle that does not answer."""
    scheme = uri.partition("://")[0]
    advice = ADDRESS_ADVICE[scheme]
    if error.advice and scheme != "sim":
        advice = error.advice
    return Row("address", *failed(error.found, advice))


BUSY_ADVICE = "close other programs, or use a faster computer"
WAKE_PERIOD_S = 0.005
BUSY_SHARE = 0.5
"""This computer is a possible cause of slow packets if its own lateness is more than this share of
their delay."""


@dataclass(frozen=True)
class VehicleStatus:
    """State of a vehicle, as found by the check.

    `device_type`: the vehicle type reported by the firmware; None if it does not answer.
    `missing_variables`: log variables that the firmware lacks. `round_trips_s`: round-trip times of
    test packets, infinite if lost. `wake_delays_s`: how late a sleeping thread on this computer
    woke up during these tests. `telemetry`: newest sample, `age_s` old. `displacement_m`: drift at
    rest. `samples`: all samples received, oldest first.
    """

    uri: str
    device_type: str | None = AIRFRAMES[1]
    protocol: int = ProbeLink.NEEDED_PROTOCOL
    missing_variables: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    round_trips_s: Sequence[float] = ()
    wake_delays_s: Sequence[float] = ()
    link_quality: float | None = None
    telemetry: Telemetry | None = None
    age_s: float = 0.0
    samples_hz: float = 0.0
    decks: tuple[str, ...] = ()
    displacement_m: float = 0.0
    samples: Sequence[Telemetry] = ()

    @property
    def link_scheme(self) -> str:
        return self.uri.partition("://")[0]

    @property
    def known_telemetry(self) -> Telemetry:
        """Return the newest telemetry. Raises Unanswerable if there is none."""
        if self.telemetry is None:
            raise Unanswerable("no telemetry")
        return self.telemetry

    @property
    def is_armed(self) -> bool:
        """True if the vehicle is armed and does not arm itself: its propellers may turn."""
        return self.telemetry is not None and is_armed_by_request(self.telemetry.supervisor)

    def position_decks(self, profile: Profile) -> tuple[str, ...]:
        known = (*POSITION_DECKS, *profile.positioning.decks)
        return tuple(deck for deck in self.decks if deck in known)


def query_vehicle(link: ProbeLink, uri: str, listen_s: float = LISTEN_S) -> VehicleStatus:
    """Query a connected vehicle, and collect its telemetry for `listen_s` seconds."""
    link.telemetry()
    with wake_delays() as delays_s:
        echoes = link.round_trips_s(listen_s)
    samples = link.telemetry()
    span_s = samples[-1].t_s - samples[0].t_s if len(samples) > 1 else 0.0
    later = link.telemetry() or samples
    return VehicleStatus(
        uri=uri,
        device_type=link.device_type(),
        protocol=link.protocol_version(),
        missing_variables=link.missing,
        parameters=link.parameters(),
        round_trips_s=echoes,
        wake_delays_s=delays_s,
        link_quality=link.quality,
        telemetry=later[-1] if later else None,
        age_s=link.position_age_s(),
        samples_hz=(len(samples) - 1) / span_s if span_s > 0.0 else 0.0,
        displacement_m=math.dist(samples[0].position_m, later[-1].position_m) if samples else 0.0,
        samples=samples,
        decks=link.decks(),
    )


@contextlib.contextmanager
def wake_delays() -> Iterator[list[float]]:
    """While the block runs, measure how late this computer wakes up a sleeping thread, s."""
    delays_s: list[float] = []
    ended = threading.Event()

    def sleep() -> None:
        while not ended.is_set():
            due_s = time.monotonic() + WAKE_PERIOD_S
            time.sleep(WAKE_PERIOD_S)
            delays_s.append(max(0.0, time.monotonic() - due_s))

    sleeper = threading.Thread(target=sleep, daemon=True)
    sleeper.start()
    try:
        yield delays_s
    finally:
        ended.set()
        sleeper.join()


# --- The rows ---


def _packets(vehicle: VehicleStatus, profile: Profile) -> Finding:
    """Check the echo packets and, for a radio, the link quality. If this computer itself was late,
    a slow packet is not blamed on the link."""
    sent, quality = len(vehicle.round_trips_s), vehicle.link_quality
    back_s = sorted(filter(math.isfinite, vehicle.round_trips_s))
    advice = LINK_ADVICE.get(vehicle.link_scheme, BUSY_ADVICE)
    if not back_s:
        return failed("no packet came back", f"restart the vehicle; {advice}")
    lost, p95_s = 1.0 - len(back_s) / sent, _quantile_95(back_s)
    found = f"{100.0 * lost:.1f} % of {sent} lost, 95 % returned within {1e3 * p95_s:.1f} ms"
    if quality is not None:
        found += f", link quality {quality:.0f} %"
    busy_s = _quantile_95(sorted(vehicle.wake_delays_s))
    limit_s = profile.safety.proof_age_s
    slow_s, slow_advice = min(0.03, limit_s), advice
    if p95_s > slow_s and busy_s > BUSY_SHARE * p95_s:
        found += f", and this computer was late by {1e3 * busy_s:.0f} ms"
        slow_advice = BUSY_ADVICE
    return worst_finding(
        limits_finding(lost, 0.01, 0.05, found, advice),
        limits_finding(p95_s, slow_s, limit_s, found, slow_advice),
        # A radio repeats lost packets automatically, so losses show only in the link quality.
        limits_finding(-100.0 if quality is None else -quality, -90.0, -60.0, found, advice),
    )


def _quantile_95(ordered_s: Sequence[float]) -> float:
    return ordered_s[int(0.95 * (len(ordered_s) - 1))] if ordered_s else 0.0


def _telemetry(vehicle: VehicleStatus, profile: Profile) -> Finding:
    if vehicle.telemetry is None:
        return failed(
            "no telemetry arrives", "see the rows packets and firmware, then restart the vehicle"
        )
    wanted_hz = 1.0 / profile.link.telemetry_period_s
    age_ms = 1e3 * vehicle.age_s
    found = f"{vehicle.samples_hz:.0f} Hz of {wanted_hz:.0f}, newest {age_ms:.0f} ms old"
    if vehicle.age_s > profile.safety.telemetry_hold_s:
        return failed(found, "see the row packets above, then restart the vehicle")
    advice = "see the row packets above, or raise link.telemetry_period_s"
    if vehicle.link_scheme == "radio":
        advice = "use a radio rate of 2M, or raise link.telemetry_period_s"
    return limits_finding(-vehicle.samples_hz / wanted_hz, -0.9, -0.5, found, advice)


def _firmware(vehicle: VehicleStatus, profile: Profile) -> Finding:
    found, needed = f"protocol {vehicle.protocol}", ProbeLink.NEEDED_PROTOCOL
    if vehicle.protocol < needed:
        advice = f"update the firmware: protocol {needed} or later is needed (release 2026.08)"
        return failed(found, advice)
    if vehicle.missing_variables:
        found = f"{found}, which lacks log variables {', '.join(vehicle.missing_variables)}"
        return failed(found, "update the firmware to release 2026.08 or later")
    if vehicle.parameters.get(SELF_TEST) == 0:
        found = f"{found}, its self-test failed at boot"
        return failed(
            found, "restart the vehicle while it is level and at rest, and read its console"
        )
    return passed(found)


def _airframe(vehicle: VehicleStatus, profile: Profile) -> Finding:
    if vehicle.device_type is None:
        return failed("the vehicle does not report its airframe", "update its firmware")
    if vehicle.device_type in AIRFRAMES:
        return passed(vehicle.device_type)
    return failed(vehicle.device_type, f"fly a {', '.join(AIRFRAMES[:-1])} or {AIRFRAMES[-1]}")


def _supervisor(vehicle: VehicleStatus, profile: Profile) -> Finding:
    t = vehicle.known_telemetry
    criteria, bits = GroundCriteria(t, profile), f"0x{t.supervisor:04X}"
    if vehicle.is_armed:
        return failed(f"the vehicle is armed, and its propellers may turn ({bits})", DISARM_IT)
    return problem_finding(
        criteria.supervisor_fault or criteria.supervisor_not_ready,
        f"ready, {ARMED_BY_FLY} ({bits})" if criteria.waits_for_arming else f"ready ({bits})",
    )


def _positioning(vehicle: VehicleStatus, profile: Profile) -> Finding:
    decks = ", ".join(vehicle.position_decks(profile))
    found = {
        "mocap": f"by {profile.positioning.label}; see the rows capture and body",
        "target": "by the target, see the row in view",
        "deck": f"by {decks}",
    }
    problem = GroundCriteria.no_position_source(vehicle.decks, profile)
    return problem_finding(problem, found[profile.positioning.by])


def _estimator(vehicle: VehicleStatus, profile: Profile) -> Finding:
    t = vehicle.known_telemetry
    judged = profile
    if not profile.positioning.source.is_deck:
        if not vehicle.position_decks(profile):
            return skipped(BY_FLY)
        judged = profile.with_({"positioning.by": "deck"})  # only perchctl fly sends positions
    criteria = GroundCriteria(t, judged, vehicle.decks)
    problem = criteria.estimate_unsettled
    if problem is not None:
        return failed(problem.found, f"wait a moment, then check again; {problem.advice}")
    set_by_fly = profile.link.parameters | ProbeLink.estimator_parameters(profile.positioning)
    kind = set_by_fly.get(ESTIMATOR, vehicle.parameters.get(ESTIMATOR))
    found = f"variance {', '.join(each.text for each in criteria.variances)}"
    if problem := criteria.moving_estimate(vehicle.samples, judged):
        return failed(f"{found}, but {problem.found}", problem.advice)
    if kind is not None and kind < KALMAN:
        advice = f"set {ESTIMATOR}: 2 under link.parameters"
        return warned(f"{ESTIMATOR} {kind:g} does not estimate the position", advice)
    if vehicle.displacement_m > MOVED_WARN_M:
        found += f", but its position moved by {1e2 * vehicle.displacement_m:.0f} cm at rest"
        return warned(
            found, "keep the vehicle still; if it was still, check the light and the floor"
        )
    if all(each.value is None for each in criteria.variances):
        return skipped(UNREPORTED)
    return passed(found)


def _ground(vehicle: VehicleStatus, profile: Profile) -> Finding:
    t = vehicle.known_telemetry
    if not profile.positioning.source.is_deck:
        return skipped(BY_FLY)
    if not all(math.isfinite(v) for v in t.position_m):
        return failed("the estimated position is not finite", "restart the vehicle")
    return problem_finding(GroundCriteria(t, profile).off_ground, f"at {t.position_m[2]:.2f} m")


def _level(vehicle: VehicleStatus, profile: Profile) -> Finding:
    t, limit_deg = vehicle.known_telemetry, profile.safety.start_tilt_deg
    criteria = GroundCriteria(t, profile)
    found = f"roll {math.degrees(t.roll_rad):.1f}, pitch {math.degrees(t.pitch_rad):.1f} deg"
    advice = "put the vehicle on level ground; if it is level already, restart it there"
    return worst_finding(
        limits_finding(criteria.tilt_deg, 3.0, limit_deg, found, advice),
        problem_finding(criteria.not_still, found),
    )


def _battery(vehicle: VehicleStatus, profile: Profile) -> Finding:
    t = vehicle.known_telemetry
    criteria = GroundCriteria(t, profile)
    battery = criteria.battery_too_low or criteria.battery_too_high or criteria.battery_unknown
    if problem := battery:
        return failed(problem.found, problem.advice)
    if not is_battery_reading(t.battery_v):
        return skipped(UNREPORTED)
    found = f"{t.battery_v:.2f} V at rest"
    if t.battery_state == LOW_POWER:
        return failed(f"{found}, but it reports low power", "charge the battery")
    if t.battery_v < profile.safety.min_rest_v + 0.1:
        return warned(found, "enough only for a short flight: charge the battery")
    return passed(found)


VEHICLE: dict[str, Callable[[VehicleStatus, Profile], Finding]] = {
    "packets": _packets,
    "telemetry": _telemetry,
    "airframe": _airframe,
    "firmware": _firmware,
    "supervisor": _supervisor,
    "positioning": _positioning,
    "estimator": _estimator,
    "ground": _ground,
    "level": _level,
    "battery": _battery,
}
"""The rows for a vehicle that answers, in order."""


# --- Lifted by hand and put back, motors off ---

LIFTED = "lifted"
LIFT_S = 20.0
COUNTDOWN_STEP_S = 5.0
"""Time between two announcements of the time that is left, s."""
HOW_TO_LIFT = "lift the vehicle by 30 cm, hold it level, and put it back"
LIFT_CHECK_M = 0.15
"""Rise of the estimate above which a lift is evaluated, m. Larger: a short lift is skipped."""
FOLLOWED_M = 0.08
"""Rise below which the estimate has not followed the lift, m. Larger: after a short lift, the
positioning seems not to work. Smaller: a drifting estimate seems to have followed the lift."""
BACK_M = 0.10
"""Difference between first and last height above which the position may be drifting, m. Larger: a
drift passes."""
MOVED_G = 0.05
"""Deviation of the accelerometer from 1 g that shows a lift by hand; the noise at rest is a tenth
of this."""


def counting_down(
    duration_s: float,
    announce: Callable[[str], None],
    clock: Callable[[], float],
    wait: Wait,
) -> Wait:
    """Return `wait`, extended to announce every `COUNTDOWN_STEP_S` how much is left of
    `duration_s`."""
    began_s = clock()
    next_left_s = duration_s - COUNTDOWN_STEP_S

    def wait_and_count(seconds: float) -> None:
        nonlocal next_left_s
        wait(seconds)
        if next_left_s > 0.0 and began_s + duration_s - clock() <= next_left_s:
            announce(f"{next_left_s:g} s left")
            next_left_s -= COUNTDOWN_STEP_S

    return wait_and_count


def record_lift(link: ProbeLink, wait: Wait, duration_s: float = LIFT_S) -> list[Telemetry]:
    """Return the vehicle's telemetry over `duration_s`, while the user lifts it by hand."""
    seen: list[Telemetry] = []
    for _ in range(max(1, round(duration_s / 0.1))):
        wait(0.1)
        seen.extend(link.telemetry())
    return seen


def lift_finding(samples: Sequence[Telemetry]) -> Finding:
    """Check that the estimated position followed the lift by hand."""
    if not samples:
        return skipped("no telemetry")
    heights_m = [t.position_m[2] for t in samples]
    rise_m, back_m = max(heights_m) - heights_m[0], heights_m[-1] - heights_m[0]
    moved_g = max(abs(t.acc_z_g - 1.0) for t in samples)
    found = f"rose by {rise_m:.2f} m, and ended {back_m:+.2f} m from its initial height"
    if rise_m < FOLLOWED_M and moved_g < MOVED_G:
        return skipped("the vehicle was not moved", HOW_TO_LIFT)
    if rise_m < FOLLOWED_M:
        advice = (
            "the position estimate does not follow the vehicle: check the light, the floor and the "
            "base stations"
        )
        return failed(f"the vehicle moved, but its position estimate only {found}", advice)
    if rise_m < LIFT_CHECK_M:
        return skipped(f"{found}: not enough to judge", HOW_TO_LIFT)
    if abs(back_m) > BACK_M:
        return warned(
            found, "if the vehicle was put back at the same place, its position estimate drifts"
        )
    return passed(found)


# --- Scan for vehicles ---


def radio_scan_rows(uris: Sequence[str], radio_problem: Problem | None) -> list[Row]:
    """Return a row for the radio and one for each vehicle that answers, from the result of
    `find_uris_and_problem`."""
    radio = passed("scanned channels 0 to 125 at 250K, 1M and 2M")
    if radio_problem is not None:
        radio = skipped(radio_problem.found, radio_problem.advice)
    found = [passed(f"{uri} answers") for uri in uris]
    nobody = failed(
        "no vehicle answers",
        "switch the vehicle on; if its radio address is not E7E7E7E7E7, name its URI with -u",
    )
    return [Row("radio", *radio), *(Row("address", *each) for each in found or [nobody])]
