"""The firmware's own test of propellers and battery: the only part of the check that turns motors.

Asked for first, and begun only on a vehicle that stands on the ground, by fresh telemetry: in the
air the test is a motor cut (docs/firmware.md, "Propeller test"), and nothing there ends it.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.check.gone import gone
from perchctl.check.row import Row, failed, passed, skipped, warned
from perchctl.flight import (
    forbidden_problem,
    height_problem,
    motion_problem,
    tilt_problem,
    unsettled_problem,
)
from perchctl.link import HealthTest, ProbeLink
from perchctl.profile import Profile
from perchctl.vehicle import Telemetry

NAMES = ("propellers", "battery sag")
PLACES = ("front right", "back right", "back left", "front left")
RESULT_S = {"startPropTest": 15.0, "startBatTest": 3.0}
"""Brushless motors take 12 s."""
POLL_S = 0.2
STANDS_STILL_G2 = 0.01
UNEVEN_WARN, UNEVEN_FAIL = 3.0, 6.0
"""Times what the other three shake, in squares: new propellers are within 2."""
SAG_WARN_V, SAG_FAIL_V = 0.5, 0.7
FINISHED = 1 << 7
PASS, COUNT = "health.motorPass", "health.motorTestCount"
SAG = "health.batterySag"
THRESHOLD = "health.propTestThreshold"
VARIANCES = tuple(f"health.motorVar{axis}M{motor}" for motor in (1, 2, 3, 4) for axis in "XY")
NOT_ASKED = "not asked for"
NO_TEST = "the firmware has no such test"
NO_ANSWER = "not begun: no answer came"
NO_RESULT = "no result came"
PENDING = "the test before gave no result, and may still run"
"""While it runs, what the vehicle reports of its state is frozen, and no proof of the ground."""


@dataclass(frozen=True)
class Propellers:
    """How much each shook the accelerometer, x and y, g^2; `judged` is the firmware's word on
    each where it has a threshold, None where it has none."""

    shake_g2: tuple[float, float, float, float]
    judged: tuple[bool, ...] | None = None


def unasked(why: str = NOT_ASKED) -> list[Row]:
    advice = "add --prop-test" if why == NOT_ASKED else ""
    return [skipped(name, why, advice) for name in NAMES]


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


def run(
    link: ProbeLink, profile: Profile, wait: Callable[[float], None], within_s: float | None = None
) -> list[Row]:
    """Both tests, one after the other, each only from the ground, and the second only after the
    first has ended. `within_s`: for its result."""
    rows: list[Row] = []
    pending = ""
    for name, test in zip(NAMES, (_propellers, _battery), strict=True):
        why = pending or hindrance(link.newest(), link.age_s(), profile)
        row = skipped(name, f"not begun: {why}") if why else test(link, wait, within_s)
        if row.found == NO_RESULT:
            pending = PENDING
        rows.append(row)
    return rows


def _propellers(link: ProbeLink, wait: Callable[[float], None], within_s: float | None) -> Row:
    name = NAMES[0]
    if not all(link.has_variable(v) for v in (*VARIANCES, PASS, COUNT)):
        return skipped(name, NO_TEST)
    before = link.variables([COUNT]).get(COUNT)
    if before is None:
        return skipped(name, NO_ANSWER, "see packets")

    def ended() -> bool:
        now = link.variables([PASS, COUNT])
        if PASS not in now or COUNT not in now:
            return False
        return now[COUNT] != before and bool(int(now[PASS]) & FINISHED)

    if not _done(link, "startPropTest", ended, wait, within_s):
        return _no_result(name)
    values = link.variables((*VARIANCES, PASS))
    if not values.keys() >= {*VARIANCES, PASS}:
        return warned(name, "ended, but its result did not come whole", "see packets; ask again")
    shake = [values[x] + values[y]
             for x, y in zip(VARIANCES[::2], VARIANCES[1::2], strict=True)]  # fmt: skip
    bits = int(values[PASS])
    has_threshold = bool(link.parameters().get(THRESHOLD, 0.0))
    judged = tuple(bool(bits & 1 << m) for m in range(4)) if has_threshold else None
    return propeller_row(Propellers((shake[0], shake[1], shake[2], shake[3]), judged))


def _battery(link: ProbeLink, wait: Callable[[float], None], within_s: float | None) -> Row:
    name = NAMES[1]
    if not link.has_variable(SAG):
        return skipped(name, NO_TEST)
    before = link.variables([SAG]).get(SAG)
    if before is None:
        return skipped(name, NO_ANSWER, "see packets")
    came: list[float] = []

    def ended() -> bool:
        came.extend(v for v in link.variables([SAG]).values() if v != before)
        return bool(came)

    if not _done(link, "startBatTest", ended, wait, within_s):
        return _no_result(name)
    return sag_row(came[-1])


def _no_result(name: str) -> Row:
    """It was wanted and begun: no result of it is more than a question left open."""
    return warned(name, NO_RESULT, "keep clear: it may begin late; see packets and battery")


def _done(
    link: ProbeLink,
    test: HealthTest,
    ended: Callable[[], bool],
    wait: Callable[[float], None],
    within_s: float | None,
) -> bool:
    """Whether its result came in time, and before the vehicle was gone."""
    limit_s = RESULT_S[test] if within_s is None else within_s
    link.start_health_test(test)
    for _ in range(max(1, round(limit_s / POLL_S))):
        wait(POLL_S)
        if ended():
            return True
        if gone(link):
            break
    return False


def propeller_row(seen: Propellers) -> Row:
    """Each against the other three: what a good one shakes depends on the vehicle."""
    shake = seen.shake_g2
    found = "shake " + ", ".join(f"M{m + 1} {v:.2g}" for m, v in enumerate(shake)) + " g^2"
    still = [m for m in range(4) if not shake[m] >= STANDS_STILL_G2]
    if still:
        return failed(
            "propellers", f"{found}: {_named(still)} stands still",
            "look at its plug, its wires and what blocks it",
        )  # fmt: skip
    times = [shake[m] / statistics.median(shake[:m] + shake[m + 1 :]) for m in range(4)]
    refused = [m for m in range(4) if seen.judged is not None and not seen.judged[m]]
    uneven = sorted({m for m in range(4) if times[m] > UNEVEN_FAIL} | set(refused))
    advice = "exchange or balance the propeller, look at the motor's mount"
    if uneven:
        return failed("propellers", f"{found}: {_named(uneven)} is out of balance", advice)
    odd = [m for m in range(4) if times[m] > UNEVEN_WARN]
    if odd:
        return warned("propellers", f"{found}: {_named(odd)} shakes most", advice)
    slack = [m for m in range(4) if times[m] < 1.0 / UNEVEN_FAIL]
    if slack:
        return warned("propellers", f"{found}: {_named(slack)} hardly shakes",
                      "is its propeller on?")  # fmt: skip
    return passed("propellers", found)


def sag_row(sag_v: float) -> Row:
    found = f"{sag_v:.2f} V under a short load"
    if sag_v <= SAG_WARN_V:
        return passed("battery sag", found)
    if sag_v <= SAG_FAIL_V:
        return warned("battery sag", found, "an old cell or a bad plug: try another battery")
    return failed("battery sag", found, "exchange the battery, look at its plug")


def _named(motors: list[int]) -> str:
    return ", ".join(f"M{m + 1} ({PLACES[m]})" for m in motors)
