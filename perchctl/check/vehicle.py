"""The vehicle at the other end of the link: what it answers, holds and reports at rest.

`look` takes half a dozen seconds and sends nothing but questions; what it returns is judged by
`VEHICLE`, pure. `lift_finding` judges a lift by hand. `motor_rows` runs the firmware's own test of
propellers and battery, the only part of the check that turns motors: it begins only on a vehicle
that stands on the ground by fresh telemetry, because in the air the test is a motor cut
(docs/firmware.md, "Propeller test"), and nothing there ends it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from perchctl.check.row import (
    Finding,
    Row,
    Unknown,
    ask,
    by_limits,
    by_problem,
    failed,
    passed,
    skip_all,
    skipped,
    warned,
    worst,
)
from perchctl.flight import (
    battery_problem,
    forbidden_problem,
    height_problem,
    motion_problem,
    not_allowed_problem,
    tilt_deg,
    tilt_problem,
    unmeasured_problem,
    unsettled_problem,
)
from perchctl.link import (
    EXTERNAL_POSITION_TICK,
    NEEDED_PROTOCOL,
    UDEV_HELP,
    Echoes,
    HealthTest,
    ProbeLink,
    ScanResult,
    decks_found,
)
from perchctl.profile import Profile
from perchctl.vehicle import LOW_POWER, NO_BATTERY_READING_V, MeasuredBy, Telemetry

LISTEN_S = 5.0
MOVED_WARN_M = 0.05
"""At rest, while it is listened to: a flight's estimate drifts by a fifth of it."""
KALMAN = 2
RSSI = "radio.rssi"
SELF_TEST, ESTIMATOR = "system.selftestPassed", "stabilizer.estimator"
OPTIONAL = {"pm.vbat": "battery", "kalman.varPX": "estimator's variance", RSSI: "radio's strength"}
BY_FLY = "positions are sent by fly, which waits for the estimate to agree"
"""By a motion capture, or by the target."""

Wait = Callable[[float], None]


@dataclass(frozen=True)
class Vehicle:
    """What was found out about a vehicle.

    `telemetry` is the newest, with its age, None without any. While it was listened to, its
    position moved by `moved_m`; `external`: some positions came from outside.
    """

    uri: str
    protocol: int = NEEDED_PROTOCOL
    firmware: str | None = None
    missing: tuple[str, ...] = ()
    lacking: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    echoes: Echoes = field(default_factory=Echoes)
    quality: float | None = None
    telemetry: Telemetry | None = None
    age_s: float = 0.0
    samples_hz: float = 0.0
    rssi_dbm: float | None = None
    external: bool | None = None
    moved_m: float = 0.0

    @property
    def at_rest(self) -> Telemetry:
        """The newest telemetry. Raises Unknown without any."""
        if self.telemetry is None:
            raise Unknown("no telemetry")
        return self.telemetry

    @property
    def measured_by(self) -> MeasuredBy:
        return MeasuredBy(decks_found(self.parameters), self.external)

    def position_decks(self, profile: Profile) -> tuple[str, ...]:
        return self.measured_by.placed_by(profile.positioning.decks)


def look(link: ProbeLink, uri: str, listen_s: float = LISTEN_S) -> Vehicle:
    """Ask a connected vehicle, and listen to it for so long."""
    before = link.variables([EXTERNAL_POSITION_TICK]).get(EXTERNAL_POSITION_TICK)
    link.telemetry()
    echoes = link.echoes(listen_s)
    samples = link.telemetry()
    span_s = samples[-1].t_s - samples[0].t_s if len(samples) > 1 else 0.0
    values = link.variables([RSSI, EXTERNAL_POSITION_TICK])
    after, rssi = values.get(EXTERNAL_POSITION_TICK), values.get(RSSI)
    later = link.telemetry() or samples
    return Vehicle(
        uri=uri,
        protocol=link.protocol(),
        firmware=link.firmware(),
        missing=link.missing,
        lacking=tuple(what for name, what in OPTIONAL.items() if not link.has_variable(name)),
        parameters=link.parameters(),
        echoes=echoes,
        quality=link.quality,
        telemetry=later[-1] if later else None,
        age_s=link.age_s(),
        samples_hz=(len(samples) - 1) / span_s if span_s > 0.0 else 0.0,
        rssi_dbm=-rssi if rssi else None,
        moved_m=moved_m(samples),
        external=None if before is None or after is None else after != before,
    )


def moved_m(samples: Sequence[Telemetry]) -> float:
    """From the middle of the first tenth to that of the last; NaN for what is no number."""
    if not samples:
        return 0.0
    tenth = max(1, len(samples) // 10)
    ends = [
        [statistics.fmean(t.position_m[axis] for t in part) for axis in range(3)]
        for part in (samples[:tenth], samples[-tenth:])
    ]
    return math.dist(*ends)


# --- Its rows -----------------------------------------------------------------------------------


def _packets(vehicle: Vehicle, profile: Profile) -> Finding:
    """From 10 % on one lost notify has locked a vehicle that hung well."""
    echoes, quality = vehicle.echoes, vehicle.quality
    found = f"{100.0 * echoes.lost:.1f} % of {echoes.sent} lost"
    if quality is not None:
        found += f", link quality {quality:.0f} %"
    advice = "bring the radio nearer, or choose a channel away from Wi-Fi (above 80)"
    by_loss = by_limits(echoes.lost, 0.01, 0.05, found, advice)
    if quality is None:
        return by_loss
    # A radio sends again by itself: its losses show in its quality only.
    return worst(by_loss, by_limits(-quality, -90.0, -60.0, found, advice))


def _round_trip(vehicle: Vehicle, profile: Profile) -> Finding:
    p95_s = vehicle.echoes.p95_s
    if p95_s is None:
        return failed("no packet came back", "see packets")
    median_s = statistics.median_high(vehicle.echoes.round_trip_s)
    found = f"{1e3 * median_s:.1f} ms, 95 % within {1e3 * p95_s:.1f} ms"
    limit_s = profile.safety.proof_age_s
    advice = "close other programs that use the radio or the processor"
    return by_limits(p95_s, min(0.03, limit_s), limit_s, found, advice)


def _telemetry(vehicle: Vehicle, profile: Profile) -> Finding:
    if vehicle.telemetry is None:
        return failed("none comes", "see variables and packets; restart the vehicle")
    wanted_hz = 1.0 / profile.link.telemetry_period_s
    age_ms = 1e3 * vehicle.age_s
    found = f"{vehicle.samples_hz:.0f} Hz of {wanted_hz:.0f}, newest {age_ms:.0f} ms old"
    if vehicle.age_s > profile.safety.telemetry_hold_s:
        return failed(found, "see packets; restart the vehicle")
    advice = "use a radio rate of 2M, or raise link.telemetry_period_s"
    return by_limits(-vehicle.samples_hz / wanted_hz, -0.9, -0.5, found, advice)


def _radio(vehicle: Vehicle, profile: Profile) -> Finding:
    scheme, _, place = vehicle.uri.partition("://")
    if scheme != "radio":
        return skipped(f"none in {scheme}://")
    parts = place.partition("?")[0].split("/")
    rate = parts[2] if len(parts) > 2 else "2M"
    found = f"channel {parts[1] if len(parts) > 1 else '2'}, {rate}"
    if rate == "250K":
        return warned(found, "too slow for 100 samples a second: set it to 2M")
    return passed(found)


def _signal(vehicle: Vehicle, profile: Profile) -> Finding:
    if vehicle.uri.startswith(("usb://", "serial://")):
        return skipped("by cable")
    if vehicle.rssi_dbm is None:
        return skipped("the vehicle reports no strength")
    advice = "bring the radio nearer, turn its antenna upright"
    return by_limits(-vehicle.rssi_dbm, 75.0, 90.0, f"{vehicle.rssi_dbm:.0f} dBm", advice)


def _firmware(vehicle: Vehicle, profile: Profile) -> Finding:
    found = f"{vehicle.firmware or 'of unknown version'}, protocol {vehicle.protocol}"
    if vehicle.protocol >= NEEDED_PROTOCOL:
        return passed(found)
    advice = f"update it: protocol {NEEDED_PROTOCOL} or later is needed (release 2026.08)"
    return failed(found, advice)


def _variables(vehicle: Vehicle, profile: Profile) -> Finding:
    if vehicle.missing:
        found = f"not logged: {', '.join(vehicle.missing)}"
        return failed(found, "update the firmware to release 2026.08 or later")
    if vehicle.lacking:
        found = f"not logged: {', '.join(vehicle.lacking)}"
        return warned(found, "it flies without, but blind to it")
    return passed("all that are needed are logged")


def _self_test(vehicle: Vehicle, profile: Profile) -> Finding:
    result = vehicle.parameters.get(SELF_TEST)
    if result is None:
        return skipped(f"the firmware has no parameter {SELF_TEST}")
    if result == 1:
        return passed("passed at boot")
    return failed("failed at boot", "restart it level and at rest; read its console")


def _supervisor(vehicle: Vehicle, profile: Profile) -> Finding:
    t = vehicle.at_rest
    problem = forbidden_problem(t) or not_allowed_problem(t)
    return by_problem(problem, f"ready (0x{t.supervisor:04X})")


def _decks(vehicle: Vehicle, profile: Profile) -> Finding:
    decks = vehicle.measured_by.decks
    if not decks and profile.positioning.by != "deck":
        return passed("none, and none is needed")
    if not decks:
        return warned("none", "mounted ones: take them off and put them on again")
    return passed(", ".join(decks))


def _positioning(vehicle: Vehicle, profile: Profile) -> Finding:
    decks = ", ".join(vehicle.position_decks(profile))
    found = {
        "mocap": f"by {profile.positioning.label}, see its rows",
        "target": "by the target, see sight range and in view",
        "deck": f"by {decks}" if decks else "by positions from outside",
    }
    problem = unmeasured_problem(vehicle.measured_by, profile)
    return by_problem(problem, found[profile.positioning.by])


def _estimator(vehicle: Vehicle, profile: Profile) -> Finding:
    t = vehicle.at_rest
    if profile.positioning.by != "deck" and not vehicle.position_decks(profile):
        return skipped(BY_FLY)
    problem = unsettled_problem(t, profile)
    if problem is not None:
        return failed(problem.found, "is there a positioning system? wait a little")
    kind = profile.link.parameters.get(ESTIMATOR, vehicle.parameters.get(ESTIMATOR))
    if t.position_variance_m2 is None:
        return skipped("its variance is not logged")
    found = f"variance {t.position_variance_m2:.2g} m^2"
    if kind is not None and kind < KALMAN:
        advice = f"set {ESTIMATOR}: 2 under link.parameters"
        return warned(f"{ESTIMATOR} {kind:g} has no position", advice)
    if vehicle.moved_m > MOVED_WARN_M:
        found += f", but its position moved by {1e2 * vehicle.moved_m:.0f} cm at rest"
        return warned(found, "what gives the position is not steady: light, floor")
    return passed(found)


def _ground(vehicle: Vehicle, profile: Profile) -> Finding:
    t = vehicle.at_rest
    if profile.positioning.by != "deck":
        return skipped(BY_FLY)
    if not all(math.isfinite(v) for v in t.position_m):
        return failed("the position is no number", "restart the vehicle")
    return by_problem(height_problem(t, profile), f"at {t.position_m[2]:.2f} m")


def _level(vehicle: Vehicle, profile: Profile) -> Finding:
    t, limit_deg = vehicle.at_rest, profile.safety.start_tilt_deg
    found = f"roll {math.degrees(t.roll_rad):.1f}, pitch {math.degrees(t.pitch_rad):.1f} deg"
    advice = "put it on level ground; if that is level, restart it there"
    return by_limits(tilt_deg(t), min(3.0, limit_deg), limit_deg, found, advice)


def _still(vehicle: Vehicle, profile: Profile) -> Finding:
    t = vehicle.at_rest
    return by_problem(motion_problem(t), f"{t.acc_z_g:.2f} g")


def _parameters(vehicle: Vehicle, profile: Profile) -> Finding:
    """`fly` sets them; those that the firmware lacks it refuses."""
    wanted, present = profile.link.parameters, vehicle.parameters
    unknown = [name for name in wanted if name not in present]
    if unknown:
        found = f"the firmware has no {', '.join(unknown)}"
        return failed(found, "correct link.parameters in the profile")
    differing = [
        f"{name} {present[name]:g}, profile {value:g}"
        for name, value in wanted.items()
        if not math.isclose(present[name], value, rel_tol=1e-5, abs_tol=1e-9)
    ]
    if differing:
        return warned("; ".join(differing), "fly sets them before each flight")
    return passed(f"{len(wanted)} as the profile has them")


def _battery(vehicle: Vehicle, profile: Profile) -> Finding:
    t = vehicle.at_rest
    if not t.battery_v >= NO_BATTERY_READING_V:
        return skipped("no reading", "restart the vehicle")
    found = f"{t.battery_v:.2f} V at rest"
    if problem := battery_problem(t, profile):
        return failed(problem.found, problem.advice)
    if t.battery_state == LOW_POWER:
        return failed(f"{found}, but it reports low power", "charge it")
    if t.battery_v < profile.safety.min_rest_v + 0.1:
        return warned(found, "enough for a short flight: charge it")
    return passed(found)


VEHICLE: dict[str, Callable[[Vehicle, Profile], Finding]] = {
    "packets": _packets,
    "round trip": _round_trip,
    "telemetry": _telemetry,
    "radio": _radio,
    "signal": _signal,
    "firmware": _firmware,
    "variables": _variables,
    "self-test": _self_test,
    "supervisor": _supervisor,
    "decks": _decks,
    "positioning": _positioning,
    "estimator": _estimator,
    "ground": _ground,
    "level": _level,
    "still": _still,
    "parameters": _parameters,
    "battery": _battery,
}
"""The rows of a vehicle that answers, in their order."""


# --- Lifted by hand and put back, motors off -----------------------------------------------------

LIFTED = "lifted"
LIFT_S = 20.0
HOW_TO_LIFT = "lift it by 30 cm, hold it level, put it back"
LIFTED_M, FOLLOWED_M, BACK_M = 0.15, 0.08, 0.10
MOVED_G = 0.05
"""A hand that lifts shows in the accelerometer; its noise at rest is a tenth of it."""


def watch_lift(link: ProbeLink, wait: Wait, within_s: float = LIFT_S) -> list[Telemetry]:
    """What the vehicle reports until it was lifted and is back, or for so long."""
    seen: list[Telemetry] = []
    for _ in range(max(1, round(within_s / 0.1))):
        wait(0.1)
        seen.extend(link.telemetry())
        rise_m, back_m = _rise_m(seen)
        if rise_m > LIFTED_M and abs(back_m) < BACK_M / 2.0:
            break
    return seen


def _rise_m(seen: Sequence[Telemetry]) -> tuple[float, float]:
    """How high the position rose, and where it is at the end, both from where it was."""
    heights_m = [t.position_m[2] for t in seen] or [0.0]
    return max(heights_m) - heights_m[0], heights_m[-1] - heights_m[0]


def lift_finding(seen: Sequence[Telemetry]) -> Finding:
    """Whether the position followed the hand."""
    if not seen:
        return skipped("no telemetry")
    rise_m, back_m = _rise_m(seen)
    moved_g = max(abs(t.acc_z_g - 1.0) for t in seen)
    found = f"rose by {rise_m:.2f} m, then {back_m:+.2f} m"
    if rise_m < FOLLOWED_M and moved_g < MOVED_G:
        return skipped("it was not moved", HOW_TO_LIFT)
    if rise_m < FOLLOWED_M:
        advice = "the positioning does not see it: light, floor, base stations"
        return failed(f"it moved, and the position {found}", advice)
    if rise_m < LIFTED_M:
        return skipped(f"{found}: not enough to tell", HOW_TO_LIFT)
    if abs(back_m) > BACK_M:
        return warned(found, "was it put back where it was? else the position drifts")
    return passed(found)


# --- Whether a vehicle that answered is still there ---------------------------------------------

GONE = "link"
GONE_S = 1.0
"""Without telemetry for so long, one that had sent some is switched off or restarting."""


def gone(link: ProbeLink) -> str:
    """Why it is there no more, or empty.

    Silence tells, too: a radio keeps its link to a vehicle that is off, cflib to one that restarts.
    """
    if lost := link.lost():
        return f"the link was lost: {lost}"
    if link.newest() is not None and link.age_s() > GONE_S:
        return f"no telemetry came for {link.age_s():.1f} s"
    return ""


def gone_rows(link: ProbeLink) -> list[Row]:
    """One only for a vehicle that is gone: the others' rows say that they answer."""
    why = gone(link)
    advice = "look at its battery and plug, restart it"
    return [Row(GONE, *failed(f"the vehicle is gone: {why}", advice))] if why else []


# --- The firmware's own test of propellers and battery ------------------------------------------

MOTORS = ("propellers", "battery sag")
PLACES = ("front right", "back right", "back left", "front left")
RESULT_S: dict[HealthTest, float] = {"startPropTest": 15.0, "startBatTest": 3.0}
"""Brushless motors take 12 s."""
POLL_S = 0.2
STANDS_STILL_G2 = 0.01
UNEVEN_WARN, UNEVEN_FAIL = 3.0, 6.0
"""Times what the other three shake, in squares: new propellers are within 2."""
FINISHED = 1 << 7
PASS, COUNT = "health.motorPass", "health.motorTestCount"
SAG = "health.batterySag"
THRESHOLD = "health.propTestThreshold"
VARIANCES = tuple(f"health.motorVar{axis}M{motor}" for motor in (1, 2, 3, 4) for axis in "XY")
NO_RESULT = "no result came"
PENDING = "the test before gave no result, and may still run"
"""While it runs, what the vehicle reports of its state is frozen, and no proof of the ground."""


def hindrance(telemetry: Telemetry | None, age_s: float, profile: Profile) -> str:
    """Why no motor may be turned now, or empty."""
    if telemetry is None or age_s > profile.safety.proof_age_s:
        return "nothing fresh is known of the vehicle"
    problem = (
        forbidden_problem(telemetry)
        or unsettled_problem(telemetry, profile)
        or height_problem(telemetry, profile)
        or tilt_problem(telemetry, profile)
        or motion_problem(telemetry)
    )
    return "" if problem is None else problem.found


def motor_rows(
    link: ProbeLink, profile: Profile, wait: Wait, within_s: float | None = None
) -> list[Row]:
    """Both tests, one after the other, each only from the ground, and the second only after the
    first has ended. `within_s`: the time for a result, by default that of each test."""
    rows: list[Row] = []
    for name, test in zip(MOTORS, (_test_propellers, _test_battery), strict=True):
        pending = PENDING if rows and rows[0].found == NO_RESULT else ""
        if why := pending or hindrance(link.newest(), link.age_s(), profile):
            rows += skip_all([name], f"not begun: {why}")
        else:
            rows.append(ask(name, test, link, wait, within_s))
    return rows


def _test_propellers(link: ProbeLink, wait: Wait, within_s: float | None) -> Finding:
    _require_variables(link, (*VARIANCES, PASS, COUNT))
    if _run_test(link, "startPropTest", [COUNT, PASS], wait, within_s) is None:
        return _no_result()
    values = link.variables((*VARIANCES, PASS))
    if not values.keys() >= {*VARIANCES, PASS}:
        return warned("ended, but its result did not come whole", "see packets; ask again")
    pairs = zip(VARIANCES[::2], VARIANCES[1::2], strict=True)
    shake_g2 = [values[x] + values[y] for x, y in pairs]
    has_threshold = bool(link.parameters().get(THRESHOLD, 0.0))
    bits = int(values[PASS]) if has_threshold else 0b1111
    return propellers_finding(shake_g2, {m for m in range(4) if not bits & 1 << m})


def _test_battery(link: ProbeLink, wait: Wait, within_s: float | None) -> Finding:
    _require_variables(link, (SAG,))
    sag_v = _run_test(link, "startBatTest", [SAG], wait, within_s)
    if sag_v is None:
        return _no_result()
    found = f"{sag_v:.2f} V under a short load"
    if sag_v <= 0.5:
        return passed(found)
    if sag_v <= 0.7:
        return warned(found, "an old cell or a bad plug: try another battery")
    return failed(found, "exchange the battery, look at its plug")


def _require_variables(link: ProbeLink, names: Collection[str]) -> None:
    """Raises Unknown for a firmware without the test."""
    if not all(map(link.has_variable, names)):
        raise Unknown("the firmware has no such test")


def _run_test(
    link: ProbeLink, test: HealthTest, polled: list[str], wait: Wait, within_s: float | None
) -> float | None:
    """The first of the polled variables, once it has changed, and the test has finished where
    `PASS` is polled; None where that does not come in time, or the vehicle is gone before.

    Raises Unknown, with nothing begun, where the first question has no answer."""
    before = link.variables(polled[:1]).get(polled[0])
    if before is None:
        raise Unknown("not begun: no answer came", "see packets")
    limit_s = RESULT_S[test] if within_s is None else within_s
    link.start_health_test(test)
    for _ in range(max(1, round(limit_s / POLL_S))):
        wait(POLL_S)
        now = link.variables(polled)
        finished = PASS not in polled or int(now.get(PASS, 0)) & FINISHED
        if finished and now.get(polled[0], before) != before:
            return now[polled[0]]
        if gone(link):
            break
    return None


def _no_result() -> Finding:
    """The test was wanted and begun: without a result more than a question is left open."""
    return warned(NO_RESULT, "keep clear: it may begin late; see packets and battery")


def propellers_finding(shake_g2: Sequence[float], refused: Collection[int]) -> Finding:
    """Each propeller against the other three: what a good one shakes depends on the vehicle.

    `shake_g2`: how much each shook the accelerometer, x and y, g^2. `refused`: the motors that
    the firmware's own threshold refuses.
    """
    found = "shake " + ", ".join(f"M{m + 1} {v:.2g}" for m, v in enumerate(shake_g2)) + " g^2"
    still = [m for m in range(4) if not shake_g2[m] >= STANDS_STILL_G2]
    if still:
        advice = "look at its plug, its wires and what blocks it"
        return failed(f"{found}: {_named(still)} stands still", advice)
    others = [[*shake_g2[:m], *shake_g2[m + 1 :]] for m in range(4)]
    times = [shake / statistics.median(rest) for shake, rest in zip(shake_g2, others, strict=True)]
    advice = "exchange or balance the propeller, look at the motor's mount"
    uneven = [m for m in range(4) if times[m] > UNEVEN_FAIL or m in refused]
    if uneven:
        return failed(f"{found}: {_named(uneven)} is out of balance", advice)
    odd = [m for m in range(4) if times[m] > UNEVEN_WARN]
    if odd:
        return warned(f"{found}: {_named(odd)} shakes most", advice)
    slack = [m for m in range(4) if times[m] < 1.0 / UNEVEN_FAIL]
    if slack:
        return warned(f"{found}: {_named(slack)} hardly shakes", "is its propeller on?")
    return passed(found)


def _named(motors: Sequence[int]) -> str:
    return ", ".join(f"M{m + 1} ({PLACES[m]})" for m in motors)


# --- Which vehicles answer ----------------------------------------------------------------------


def answering_rows(answering: ScanResult) -> list[Row]:
    """One for the radio, one for each vehicle."""
    radio = passed("scanned: channels 0 to 125 at 250K, 1M, 2M")
    if answering.radio:
        radio = skipped(answering.radio, UDEV_HELP)
    found = [passed(f"{uri} answers") for uri in answering.uris]
    nobody = failed(
        "nothing answers",
        "switch the vehicle on; a radio's address other than E7E7E7E7E7 goes with -u",
    )
    return [Row("radio", *radio), *(Row("address", *each) for each in found or [nobody])]


def advice_for_silent(uri: str, answering: ScanResult) -> str:
    """What to do about a vehicle that does not answer, given those that do."""
    there = [each for each in answering.uris if each != uri]
    if there:
        return f"these answer: {', '.join(there)}; give one with -u, or set link.uri"
    return "switch it on, look at its address; perchctl check --scan shows what answers"
