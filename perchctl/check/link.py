"""The vehicle at the other end of the link: what it answers, holds and reports at rest.

`look` takes half a dozen seconds and sends nothing but questions; `rows` judges, pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from perchctl.check import sight
from perchctl.check.row import Row, by_limits, failed, passed, skipped, warned, worse
from perchctl.flight import (
    Problem,
    battery_problem,
    forbidden_problem,
    height_problem,
    motion_problem,
    not_allowed_problem,
    tilt_deg,
    unmeasured_problem,
    unsettled_problem,
)
from perchctl.link import EXTERNAL_POSITION_TICK, NEEDED_PROTOCOL, Echoes, ProbeLink, decks_found
from perchctl.profile import Profile
from perchctl.vehicle import LOW_POWER, NO_BATTERY_READING_V, MeasuredBy, Telemetry

LISTEN_S = 5.0
LOST_WARN, LOST_FAIL = 0.01, 0.05
"""Share of packets; from 10 % on one lost notify has locked a vehicle that hung well."""
TRIP_WARN_S = 0.03
QUALITY_WARN, QUALITY_FAIL = 90.0, 60.0
RSSI_WARN_DBM, RSSI_FAIL_DBM = -75.0, -90.0
RATE_WARN, RATE_FAIL = 0.9, 0.5
"""Share of the telemetry's wanted rate."""
SPARE_V = 0.1
LEVEL_WARN_DEG = 3.0
KALMAN = 2
MOVED_WARN_M = 0.05
"""At rest, while it is listened to: a flight's estimate drifts by a fifth of it."""
RSSI = "radio.rssi"
SELF_TEST, ESTIMATOR = "system.selftestPassed", "stabilizer.estimator"
OPTIONAL = {"pm.vbat": "battery", "kalman.varPX": "estimator's variance", RSSI: "radio's strength"}


@dataclass(frozen=True)
class Vehicle:
    """What was found out about it. `telemetry` is the newest, with its age, None without any;
    while it was listened to, its position went by `moved_m`; `external`: some came from outside."""

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
    def measured_by(self) -> MeasuredBy:
        return MeasuredBy(decks_found(self.parameters), self.external)


NAMES = (
    "packets", "round trip", "telemetry", "radio", "signal", "firmware", "variables", "self-test",
    "supervisor", "decks", "positioning", "estimator", "ground", "level", "still", "parameters",
    "battery",
)  # fmt: skip
"""The rows of a vehicle that answers, in their order."""


def look(link: ProbeLink, uri: str, listen_s: float = LISTEN_S) -> Vehicle:
    """Ask a connected vehicle, and listen to it for so long."""
    before = link.variables([EXTERNAL_POSITION_TICK]).get(EXTERNAL_POSITION_TICK)
    link.telemetry()
    echoes = link.echoes(listen_s)
    samples = link.telemetry()
    span_s = samples[-1].t_s - samples[0].t_s if len(samples) > 1 else 0.0
    values = link.variables([RSSI, EXTERNAL_POSITION_TICK])
    after = values.get(EXTERNAL_POSITION_TICK)
    rssi = values.get(RSSI)
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
        moved_m=_moved_m(samples),
        external=None if before is None or after is None else after != before,
    )


def _moved_m(samples: list[Telemetry]) -> float:
    """From the middle of the first tenth to that of the last; NaN for what is no number."""
    if not samples:
        return 0.0
    tenth = max(1, len(samples) // 10)
    ends = [
        [sum(t.position_m[axis] for t in part) / tenth for axis in range(3)]
        for part in (samples[:tenth], samples[-tenth:])
    ]
    return math.dist(*ends)


def rows(vehicle: Vehicle, profile: Profile) -> list[Row]:
    return [
        _packets(vehicle),
        _round_trip(vehicle, profile),
        _telemetry(vehicle, profile),
        _radio(vehicle),
        _signal(vehicle),
        _firmware(vehicle),
        _variables(vehicle),
        _self_test(vehicle),
        *_at_rest(vehicle, profile),
    ]


def _packets(vehicle: Vehicle) -> Row:
    echoes = vehicle.echoes
    found = f"{100.0 * echoes.lost:.1f} % of {echoes.sent} lost"
    if vehicle.quality is not None:
        found += f", link quality {vehicle.quality:.0f} %"
    advice = "bring the radio nearer, or choose a channel away from Wi-Fi (above 80)"
    by_loss = by_limits("packets", echoes.lost, LOST_WARN, LOST_FAIL, found, advice)
    if vehicle.quality is None:
        return by_loss
    # A radio sends again by itself: its losses show in its quality only.
    by_quality = by_limits(
        "packets", -vehicle.quality, -QUALITY_WARN, -QUALITY_FAIL, found, advice
    )  # fmt: skip
    return worse(by_quality, by_loss)


def _round_trip(vehicle: Vehicle, profile: Profile) -> Row:
    p95_s = vehicle.echoes.p95_s
    if p95_s is None:
        return failed("round trip", "no packet came back", "see packets")
    median_s = sorted(vehicle.echoes.round_trip_s)[len(vehicle.echoes.round_trip_s) // 2]
    found = f"{1e3 * median_s:.1f} ms, 95 % within {1e3 * p95_s:.1f} ms"
    limit_s = profile.safety.proof_age_s
    advice = "close other programs that use the radio or the processor"
    return by_limits("round trip", p95_s, min(TRIP_WARN_S, limit_s), limit_s, found, advice)


def _telemetry(vehicle: Vehicle, profile: Profile) -> Row:
    if vehicle.telemetry is None:
        return failed("telemetry", "none comes", "see variables and packets; restart the vehicle")
    wanted_hz = 1.0 / profile.link.telemetry_period_s
    found = f"{vehicle.samples_hz:.0f} Hz of {wanted_hz:.0f}, newest {1e3 * vehicle.age_s:.0f} ms"
    if vehicle.age_s > profile.safety.telemetry_hold_s:
        return failed("telemetry", f"{found} old", "see packets; restart the vehicle")
    share = vehicle.samples_hz / wanted_hz
    advice = "use a radio rate of 2M, or raise link.telemetry_period_s"
    return by_limits("telemetry", -share, -RATE_WARN, -RATE_FAIL, f"{found} old", advice)


def _radio(vehicle: Vehicle) -> Row:
    scheme, _, place = vehicle.uri.partition("://")
    if scheme != "radio":
        return skipped("radio", f"none in {scheme}://")
    parts = place.partition("?")[0].split("/")
    rate = parts[2] if len(parts) > 2 else "2M"
    found = f"channel {parts[1] if len(parts) > 1 else '2'}, {rate}"
    if rate == "250K":
        return warned("radio", found, "too slow for 100 samples a second: set it to 2M")
    return passed("radio", found)


def _signal(vehicle: Vehicle) -> Row:
    if vehicle.uri.startswith(("usb://", "serial://")):
        return skipped("signal", "by cable")
    if vehicle.rssi_dbm is None:
        return skipped("signal", "the vehicle reports no strength")
    found = f"{vehicle.rssi_dbm:.0f} dBm"
    return by_limits(
        "signal", -vehicle.rssi_dbm, -RSSI_WARN_DBM, -RSSI_FAIL_DBM, found,
        "bring the radio nearer, turn its antenna upright",
    )  # fmt: skip


def _firmware(vehicle: Vehicle) -> Row:
    version = vehicle.firmware or "of unknown version"
    found = f"{version}, protocol {vehicle.protocol}"
    if vehicle.protocol >= NEEDED_PROTOCOL:
        return passed("firmware", found)
    advice = f"update it: protocol {NEEDED_PROTOCOL} or later is needed (release 2026.08)"
    return failed("firmware", found, advice)


def _variables(vehicle: Vehicle) -> Row:
    if vehicle.missing:
        found = f"not logged: {', '.join(vehicle.missing)}"
        return failed("variables", found, "update the firmware to release 2026.08 or later")
    if vehicle.lacking:
        found = f"not logged: {', '.join(vehicle.lacking)}"
        return warned("variables", found, "it flies without, but blind to it")
    return passed("variables", "all that are needed are logged")


def _self_test(vehicle: Vehicle) -> Row:
    result = vehicle.parameters.get(SELF_TEST)
    if result is None:
        return skipped("self-test", f"the firmware has no parameter {SELF_TEST}")
    if result == 1:
        return passed("self-test", "passed at boot")
    return failed("self-test", "failed at boot", "restart it level and at rest; read its console")


def _at_rest(vehicle: Vehicle, profile: Profile) -> list[Row]:
    """What needs telemetry, and around it what belongs there."""
    t = vehicle.telemetry
    around = _decks(vehicle, profile), _positioning(vehicle, profile)
    told = _parameters(vehicle, profile)
    if t is None:
        names = ("supervisor", "estimator", "ground", "level", "still", "battery")
        none = {name: skipped(name, "no telemetry") for name in names}
        return [none["supervisor"], *around, none["estimator"], none["ground"], none["level"],
                none["still"], told, none["battery"]]  # fmt: skip
    return [
        _supervisor(t),
        *around,
        _estimator(vehicle, t, profile),
        _ground(t, profile),
        _level(t, profile),
        _by("still", motion_problem(t), f"{t.acc_z_g:.2f} g"),
        told,
        _battery(t, profile),
    ]


def _by(name: str, problem: Problem | None, found: str) -> Row:
    """A criterion that `fly` asks, too."""
    if problem is None:
        return passed(name, found)
    return failed(name, problem.found, problem.advice)


def _supervisor(t: Telemetry) -> Row:
    problem = forbidden_problem(t) or not_allowed_problem(t)
    return _by("supervisor", problem, f"ready (0x{t.supervisor:04X})")


def _decks(vehicle: Vehicle, profile: Profile) -> Row:
    decks = vehicle.measured_by.decks
    if not decks and profile.positioning.by != "deck":
        return passed("decks", "none, and none is needed")
    if not decks:
        return warned("decks", "none", "mounted ones: take them off and put them on again")
    return passed("decks", ", ".join(decks))


def _position_decks(vehicle: Vehicle, profile: Profile) -> tuple[str, ...]:
    return vehicle.measured_by.placed_by(profile.positioning.decks)


def _positioning(vehicle: Vehicle, profile: Profile) -> Row:
    by = vehicle.measured_by
    problem = unmeasured_problem(by, profile)
    if problem is not None:
        return failed("positioning", problem.found, problem.advice)
    if profile.positioning.by == "mocap":
        return passed("positioning", f"by {profile.positioning.label}, see its rows")
    if profile.positioning.by == "target":
        return passed("positioning", f"by the target, see {' and '.join(sight.NAMES)}")
    decks = _position_decks(vehicle, profile)
    return passed("positioning", f"by {', '.join(decks)}" if decks else "by positions from outside")


BY_FLY = "positions are sent by fly, which waits for the estimate to agree"
"""By a motion capture, or by the target."""


def _estimator(vehicle: Vehicle, t: Telemetry, profile: Profile) -> Row:
    if profile.positioning.by != "deck" and not _position_decks(vehicle, profile):
        return skipped("estimator", BY_FLY)
    problem = unsettled_problem(t, profile)
    if problem is not None:
        return failed("estimator", problem.found, "is there a positioning system? wait a little")
    kind = profile.link.parameters.get(ESTIMATOR, vehicle.parameters.get(ESTIMATOR))
    if t.position_variance_m2 is None:
        return skipped("estimator", "its variance is not logged")
    found = f"variance {t.position_variance_m2:.2g} m^2"
    if kind is not None and kind < KALMAN:
        advice = f"set {ESTIMATOR}: 2 under link.parameters"
        return warned("estimator", f"{ESTIMATOR} {kind:g} has no position", advice)
    if vehicle.moved_m > MOVED_WARN_M:
        found += f", but its position moved by {1e2 * vehicle.moved_m:.0f} cm at rest"
        return warned("estimator", found, "what gives the position is not steady: light, floor")
    return passed("estimator", found)


def _ground(t: Telemetry, profile: Profile) -> Row:
    if profile.positioning.by != "deck":
        return skipped("ground", BY_FLY)
    if not all(math.isfinite(v) for v in t.position_m):
        return failed("ground", "the position is no number", "restart the vehicle")
    return _by("ground", height_problem(t, profile), f"at {t.position_m[2]:.2f} m")


def _level(t: Telemetry, profile: Profile) -> Row:
    found_deg = tilt_deg(t)
    roll_deg, pitch_deg = math.degrees(t.roll_rad), math.degrees(t.pitch_rad)
    found = f"roll {roll_deg:.1f}, pitch {pitch_deg:.1f} deg"
    advice = "put it on level ground; if that is level, restart it there"
    limit_deg = profile.safety.start_tilt_deg
    return by_limits("level", found_deg, min(LEVEL_WARN_DEG, limit_deg), limit_deg, found, advice)


def _parameters(vehicle: Vehicle, profile: Profile) -> Row:
    """`fly` sets them; those that the firmware lacks it refuses."""
    wanted = profile.link.parameters
    unknown = [name for name in wanted if name not in vehicle.parameters]
    if unknown:
        found = f"the firmware has no {', '.join(unknown)}"
        return failed("parameters", found, "correct link.parameters in the profile")
    differing = [
        f"{name} {vehicle.parameters[name]:g}, profile {value:g}"
        for name, value in wanted.items()
        if not math.isclose(vehicle.parameters[name], value, rel_tol=1e-5, abs_tol=1e-9)
    ]
    if differing:
        return warned("parameters", "; ".join(differing), "fly sets them before each flight")
    return passed("parameters", f"{len(wanted)} as the profile has them")


def _battery(t: Telemetry, profile: Profile) -> Row:
    if not t.battery_v >= NO_BATTERY_READING_V:
        return skipped("battery", "no reading", "restart the vehicle")
    if problem := battery_problem(t, profile):
        return failed("battery", problem.found, problem.advice)
    found = f"{t.battery_v:.2f} V at rest"
    if t.battery_state == LOW_POWER:
        return failed("battery", f"{found}, but it reports low power", "charge it")
    if t.battery_v < profile.safety.min_rest_v + SPARE_V:
        return warned("battery", found, "enough for a short flight: charge it")
    return passed("battery", found)
