"""The faults that can be laid into a simulated flight: docs/faults.md, row by row.

A fault is one entry of `FAULTS`: its name, its rows on that page, what happens, the phases in which
it begins, how its effects are drawn, the README's promise that holds for it, and the outcomes that
are expected of it. `draw_case` is one seed's fault: which, in which phase, when in it, with what
parameters. A seed gives the same flight for ever: draws stay in their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from perchctl.errors import UsageError
from perchctl.faults import effects as e
from perchctl.faults import expected_outcomes as expected
from perchctl.faults.expected_outcomes import ExpectedOutcome
from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import Phase
from perchctl.sim import Scenario

T = TypeVar("T")
P = Phase
STREAM = 510
LONGEST_S, EVER_SHARE = 30.0, 0.25
"""Most losses last for up to `LONGEST_S`, a part of them for ever."""


class Draw:
    """The random numbers of one case, drawn for one scenario."""

    def __init__(self, rng: np.random.Generator, scenario: Scenario) -> None:
        self._rng = rng
        self.mass_kg = scenario.mass_kg

    def between(self, low: float, high: float) -> float:
        """Draw a number uniformly from a range."""
        return round(float(self._rng.uniform(low, high)), 4)

    def log_between(self, low: float, high: float) -> float:
        """Draw a number log-uniformly from a range."""
        return round(float(math.exp(self._rng.uniform(math.log(low), math.log(high)))), 4)

    def lasting_s(self, low: float = 0.1) -> float:
        """Draw a duration log-uniformly from `low` to `LONGEST_S`; one in four lasts for ever."""
        for_s = self.log_between(low, LONGEST_S)
        return e.FOR_EVER if self.chance(EVER_SHARE) else for_s

    def chance(self, share: float) -> bool:
        """Return True in that share of all draws."""
        return bool(self._rng.uniform() < share)

    def sign(self) -> float:
        """Return 1 or -1 with equal chances."""
        return 1.0 if self.chance(0.5) else -1.0

    def one_of(self, choices: tuple[T, ...]) -> T:
        """Return one of several choices with equal chances."""
        return choices[int(self._rng.integers(len(choices)))]

    def direction(self) -> tuple[float, float]:
        """Return a horizontal unit vector of random direction."""
        angle = float(self._rng.uniform(-math.pi, math.pi))
        return math.cos(angle), math.sin(angle)

    def packet_lost(self, order: str) -> e.PacketLost:
        """Return the loss of one packet of an order, or of two."""
        return e.PacketLost(order, 1 if self.chance(0.6) else 2)


DrawEffects = Callable[[Draw], e.Effect | tuple[e.Effect, ...]]


def _together(*parts: DrawEffects) -> DrawEffects:
    """Draw several faults that begin at the same moment."""
    return lambda draw: tuple(effect for part in parts for effect in _effects(part(draw)))


def _effects(drawn: e.Effect | tuple[e.Effect, ...]) -> tuple[e.Effect, ...]:
    return drawn if isinstance(drawn, tuple) else (drawn,)


# --- Draws that several faults share, or that are more than one line ---------------------------


def _silence(*, up: bool, down: bool) -> DrawEffects:
    return lambda draw: e.Silence(draw.lasting_s(), up, down)


def _lost(order: str, *presses_s: float) -> DrawEffects:
    """Draw the loss of an order's packets, with the operator's presses that cause the order."""
    operator = (e.Operator(presses_s),) if presses_s else ()
    return lambda draw: (draw.packet_lost(order), *operator)


def _packet_twice(draw: Draw) -> tuple[e.Effect, ...]:
    order = draw.one_of(("setpoint", "land", "notify", "stop"))
    presses = (e.Operator((0.0,)),) if order in ("land", "notify") else ()
    return (e.PacketTwice(order), *presses)


def _block_dead(name: str) -> DrawEffects:
    return lambda draw: e.BlockDead(name, draw.lasting_s())


def _camera(kind: str) -> DrawEffects:
    return lambda draw: e.CameraFault(kind, draw.lasting_s())


def _external(how: str) -> DrawEffects:
    return lambda draw: e.ExternalPositions(how, draw.lasting_s())


def _external_ends(draw: Draw) -> e.Effect:
    how = "frozen" if draw.chance(0.5) else "silent"
    return e.ExternalPositions(how, draw.lasting_s())


def _external_occluded(draw: Draw) -> e.Effect:
    """Draw an occlusion of 0.3 s, as when somebody walks by, or a longer one."""
    for_s = 0.3 if draw.chance(0.5) else draw.lasting_s(0.5)
    return e.ExternalPositions("occluded", for_s)


def _external_late(draw: Draw) -> e.Effect:
    late_s = draw.log_between(0.05, 0.15)
    return e.ExternalPositions("late", draw.lasting_s(1.0), late_s)


def _frozen(*names: str) -> DrawEffects:
    """Draw a freeze of log variables: their packets still arrive, their values do not change."""
    return lambda draw: e.LogReads(names, None, draw.lasting_s())


STATE_NAMES = tuple(f"stateEstimate.{axis}" for axis in ("x", "y", "z", "vx", "vy", "vz"))


def _jump_xy(draw: Draw) -> e.Effect:
    x, y = draw.direction()
    step_m = draw.log_between(0.1, 2.0)
    return e.EstimateError(step_m=(x * step_m, y * step_m, 0.0), for_s=draw.lasting_s())


def _jump_z(draw: Draw) -> e.Effect:
    step_m = draw.sign() * draw.log_between(0.1, 1.0)
    return e.EstimateError(step_m=(0.0, 0.0, step_m), for_s=draw.lasting_s())


def _jump_yaw(draw: Draw) -> e.Effect:
    turn_deg = draw.sign() * draw.log_between(10.0, 180.0)
    return e.EstimateError(turn_deg=turn_deg, for_s=draw.lasting_s())


def _drift(draw: Draw) -> e.Effect:
    x, y = draw.direction()
    speed_mps = draw.log_between(0.03, 0.3)
    z = draw.between(-0.2, 0.2)
    drift_mps = (x * speed_mps, y * speed_mps, z * speed_mps)
    return e.EstimateError(drift_mps=drift_mps, for_s=draw.lasting_s(2.0))


def _reading_low(draw: Draw) -> e.Effect:
    if draw.chance(0.5):
        return e.LogReads(("pm.vbat",), draw.between(2.6, 3.1), draw.lasting_s())
    return e.LogReads(("pm.state",), 3.0, draw.lasting_s())


def _kick(draw: Draw) -> e.Effect:
    """Draw a blow of 40 ms that changes the speed by up to 1 m/s, mostly sideways."""
    x, y = draw.direction()
    z = draw.between(-0.5, 0.5)
    force_n = draw.mass_kg * draw.between(0.2, 1.0) / 0.04
    return e.Push((x * force_n, y * force_n, z * force_n), 0.04)


def _gust(draw: Draw) -> e.Effect:
    """Draw a gust of 0.5 to 1 s with up to a fifth of the weight, mostly sideways."""
    x, y = draw.direction()
    z = draw.between(-0.3, 0.3)
    force_n = draw.mass_kg * GRAVITY_MPS2 * draw.between(0.05, 0.2)
    for_s = draw.between(0.5, 1.0)
    return e.Push((x * force_n, y * force_n, z * force_n), for_s)


def _unusual_ceiling(draw: Draw) -> e.Effect:
    low_m, high_m = (1.1, 1.6) if draw.chance(0.5) else (2.7, 3.4)
    return e.Room(ceiling_z_m=draw.between(low_m, high_m))


def _target_moves(draw: Draw) -> e.Effect:
    x, y = draw.direction()
    return e.TargetMoves((0.3 * x, 0.3 * y))


def _second_target(draw: Draw) -> e.Effect:
    x, y = draw.direction()
    away_m = draw.between(0.35, 1.2)
    return e.Room(second_target_m=(x * away_m, y * away_m))


def _presses_every(period_s: float, for_s: float) -> e.Operator:
    return e.Operator(tuple(round(float(t), 3) for t in np.arange(0.0, for_s, period_s)))


def _weak_magnet(draw: Draw) -> e.Effect:
    return e.MagnetHolds(draw.between(0.2, 1.1))


def _pressed_once(_draw: Draw) -> e.Effect:
    return e.Operator((0.0,))


def _hung(draw: Draw) -> e.Effect:
    return e.Hung(draw.lasting_s(0.3))


def _hung_and_packet_lost(draw: Draw) -> tuple[e.Effect, ...]:
    """Draw a stuck loop, with the loss of the first packets that the watchdog sends."""
    order = draw.one_of(("raw", "stop", "land"))
    return (_hung(draw), draw.packet_lost(order))


# --- The faults --------------------------------------------------------------------------------


AIR = (
    P.APPROACH, P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.COMPLETE, P.RECOVER,
    P.LANDING,
)  # fmt: skip
BY_CAMERA = (P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.RECOVER)
BEFORE_LANDING = AIR[:-1]
STOPPING = (P.COMPLETE, P.LANDING)
FROM_THE_START = (P.APPROACH,)
AT_CONTACT = (P.PERCH,)

USUAL_S: dict[Phase, float] = {
    P.APPROACH: 2.5,
    P.SEARCH: 1.5,
    P.ESTIMATE: 0.4,
    P.ALIGN: 2.0,
    P.ASCEND: 9.0,
    P.PERCH: 1.0,
    P.COMPLETE: 5.2,
    P.RECOVER: 1.5,
    P.LANDING: 5.0,
}
"""The usual duration of each phase; a fault begins somewhere within it."""
LANDED_FROM = (P.SEARCH, P.ALIGN, P.ASCEND, P.PERCH, P.COMPLETE)


@dataclass(frozen=True)
class Fault:
    """One entry of the catalogue. `rows` are its rows in docs/faults.md; `promise` is the key of
    the promise that holds for it (`perchctl.faults.promises`)."""

    name: str
    rows: tuple[int, ...]
    what: str
    phases: tuple[Phase, ...]
    promise: str
    draw: DrawEffects
    expected_outcomes: tuple[ExpectedOutcome, ...] = ()


FAULTS: tuple[Fault, ...] = (
    # --- the link -----------------------------------------------------------------
    Fault("downlink-silent", (13, 14), "no telemetry for 0.1 s to ever",
          AIR, "telemetry", _silence(up=False, down=True)),
    Fault("uplink-silent", (13, 14), "no command arrives for 0.1 s to ever",
          AIR, "link", _silence(up=True, down=False), (expected.CUT,)),
    Fault("link-silent", (13, 14), "both ways silent for 0.1 s to ever",
          AIR, "link", _silence(up=True, down=True), (expected.CUT,)),
    Fault("landing-lost", (14,),
          "the operator lands; one or two packets of the landing order are lost",
          BEFORE_LANDING, "packet", _lost("land", 0.0)),
    Fault("notify-lost", (14,), "the operator lands; one or two notify packets are lost",
          AIR, "packet", _lost("notify", 0.0)),
    Fault("stop-lost", (14, 42), "one or two stop packets are lost",
          STOPPING, "packet", _lost("stop")),
    Fault("stop-notify-lost", (14, 42), "one or two notify packets after a stop are lost",
          STOPPING, "packet", _lost("notify")),
    Fault("emergency-stop-lost", (14, 16),
          "the operator stops; one or two packets of the stop are lost",
          AIR, "stop", _lost("emergency-stop", 0.0, 0.8), (expected.OPERATOR_STOPS,)),
    Fault("packet-twice", (14,), "a setpoint, landing order, notify or stop arrives twice",
          AIR, "packet", _packet_twice),
    Fault("state-block-dead", (12, 14), "position and velocity come no more, the attitude does",
          AIR, "telemetry", _block_dead("state")),
    Fault("attitude-block-dead", (12, 14), "attitude, thrust and supervisor come no more",
          AIR, "telemetry", _block_dead("attitude")),
    Fault("battery-block-dead", (7,), "the battery's block comes no more",
          AIR, "battery", _block_dead("battery")),
    Fault("variance-block-dead", (8,), "the variance's block comes no more",
          AIR, "estimate", _block_dead("variance")),
    Fault("telemetry-delayed", (12,), "telemetry 50 ms to 2 s late",
          AIR, "telemetry",
          lambda draw: e.TelemetryDelayed(draw.log_between(0.05, 2.0), draw.lasting_s(0.5))),
    # --- the camera ---------------------------------------------------------------
    Fault("camera-silent", (21,), "no picture for 0.1 s to ever",
          AIR, "camera", _camera("silent")),
    Fault("camera-frozen", (22,), "the same picture again and again",
          AIR, "camera", _camera("frozen")),
    Fault("camera-snow", (23,), "a receiver's snow",
          AIR, "camera", _camera("snow")),
    Fault("camera-dark", (27,), "a nearly black picture",
          AIR, "camera", _camera("dark")),
    Fault("camera-lossy", (25,), "20 % of the pictures lost",
          AIR, "camera", _camera("lossy")),
    Fault("target-covered", (27, 31, 32, 33), "something hides the target",
          AIR, "camera", _camera("covered")),
    Fault("camera-late", (24,), "pictures 50 to 600 ms late that look fresh",
          AIR, "camera",
          lambda draw: e.CameraFault("late", draw.lasting_s(1.0), draw.log_between(0.05, 0.6))),
    Fault("camera-out-of-order", (24, 35), "pictures in pairs, the newer one first",
          AIR, "camera", _camera("out-of-order")),
    Fault("camera-mirrored", (26,), "mirrored pictures from the start",
          FROM_THE_START, "mirrored", lambda draw: e.CameraFault("mirrored", e.FOR_EVER)),
    # --- the state estimate ---------------------------------------------------------
    Fault("estimate-jumps", (9,), "steps sideways by 0.1 to 2 m",
          AIR, "estimate", _jump_xy),
    Fault("height-jumps", (9,), "steps in height by 0.1 to 1 m",
          AIR, "estimate", _jump_z),
    Fault("heading-jumps", (9, 34), "turns by 10 to 180 deg",
          AIR, "heading", _jump_yaw),
    Fault("estimate-drifts", (9,), "slides by 3 to 30 cm/s",
          AIR, "estimate", _drift),
    Fault("estimate-nan", (35,), "position and velocity are logged as NaN",
          AIR, "estimate", lambda draw: e.LogReads(STATE_NAMES, math.nan, draw.lasting_s(0.02))),
    Fault("external-position", (10,), "positions from outside freeze or end",
          AIR, "positions", _external_ends),
    Fault("external-occluded", (10,), "the rigid body is hidden for 0.3 s to ever",
          AIR, "positions", _external_occluded),
    Fault("external-swapped", (11,), "another rigid body takes its name",
          AIR, "positions", _external("swapped")),
    Fault("external-scaled", (11,), "positions come in millimetres",
          AIR, "positions", _external("millimetres")),
    Fault("external-late", (10,), "positions come 50 to 150 ms later than they say",
          AIR, "positions", _external_late),
    # --- power and motors -----------------------------------------------------------
    Fault("battery-sags", (6,), "loses 0.2 to 0.6 V at 10 to 100 mV/s",
          AIR, "battery",
          lambda draw: e.BatterySags(draw.log_between(0.01, 0.1), draw.between(0.2, 0.6)),
          (expected.SAGS_TOO_FAST,)),
    Fault("battery-reading-frozen", (7,), "its reading stands still",
          AIR, "battery", _frozen("pm.vbat")),
    Fault("battery-low", (6,), "its reading is low",
          AIR, "battery", _reading_low),
    Fault("motor-weak", (37,), "one motor gives 15 % less",
          AIR, "pushed", lambda draw: e.MotorWeak(draw.one_of((1, 2, 3, 4)), 0.85),
          (expected.NO_LIFT,)),
    # --- what pushes ------------------------------------------------------------------
    Fault("kick", (37,), "a blow that changes the speed by 0.2 to 1 m/s",
          AIR, "pushed", _kick, (expected.KNOCKED_OFF,)),
    Fault("gust", (37,), "5 to 20 % of the weight, for 0.5 to 1 s",
          AIR, "pushed", _gust),
    # --- the magnet -------------------------------------------------------------------
    Fault("no-magnet", (38,), "nothing holds",
          AT_CONTACT, "magnet", lambda draw: e.MagnetHolds(0.0)),
    Fault("weak-magnet", (39,), "carries 0.2 to 1.1 of the weight",
          AT_CONTACT, "magnet", _weak_magnet, (expected.TOO_LOW,)),
    Fault("magnet-lets-go", (39, 40), "lets go 1 to 25 s after the contact",
          AT_CONTACT, "magnet",
          lambda draw: e.MagnetLetsGo(draw.log_between(1.0, 25.0)),
          (expected.LETS_GO_LATER, expected.TOO_LOW)),
    # --- the room and the target ------------------------------------------------------
    Fault("ceiling-beside-its-plane", (38, 40),
          "the target lies 2 to 20 cm above or below what the gear meets",
          FROM_THE_START, "beside",
          lambda draw: e.Room(target_above_ceiling_m=draw.sign() * draw.log_between(0.02, 0.2))),
    Fault("ceiling-unusual", (36, 38), "at 1.1 to 1.6 m or at 2.7 to 3.4 m",
          FROM_THE_START, "ceiling", _unusual_ceiling),
    Fault("bare-ceiling", (43,), "no target",
          FROM_THE_START, "ceiling", lambda draw: e.Room(no_target=True)),
    Fault("low-bare-ceiling", (37, 43), "no target, at 0.35 to 1.3 m",
          FROM_THE_START, "ceiling",
          lambda draw: e.Room(ceiling_z_m=draw.between(0.35, 1.3), no_target=True)),
    Fault("target-moves", (28,), "by 0.3 m",
          (P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER), "moved", _target_moves),
    Fault("second-target", (28,), "the same sheet 0.35 to 1.2 m away",
          FROM_THE_START, "moved", _second_target),
    Fault("camera-turned", (26,), "mounted 90, 180 or -90 deg from what the profile says",
          FROM_THE_START, "turned",
          lambda draw: e.Room(mount_turned_deg=draw.one_of((90.0, 180.0, -90.0)))),
    # --- the operator -----------------------------------------------------------------
    Fault("operator-once", (16,), "Ctrl-C",
          AIR, "operator", _pressed_once),
    Fault("operator-twice", (16,), "Ctrl-C, and again 0.6 to 10 s later",
          AIR, "stop",
          lambda draw: e.Operator((0.0, draw.log_between(0.6, 10.0))), (expected.OPERATOR_STOPS,)),
    Fault("operator-held", (16,), "Ctrl-C held for 0.1 to 1.8 s: it repeats every 30 ms",
          AIR, "operator", lambda draw: _presses_every(0.03, draw.log_between(0.1, 1.8))),
    Fault("hang-up", (16,), "the terminal is closed",
          AIR, "operator", lambda draw: e.Operator((0.0,), hang_up=True)),
    # --- the program ------------------------------------------------------------------
    Fault("killed", (15,), "killed at once",
          AIR, "killed", lambda draw: e.Killed(), (expected.CUT, expected.LEFT_LANDING)),
    Fault("suspended", (17,), "suspended for 0.3 to 5 s",
          AIR, "killed", lambda draw: e.Suspended(draw.log_between(0.3, 5.0)), (expected.CUT,)),
    Fault("hung", (18, 19, 20), "the loop is stuck for 0.3 s to ever",
          AIR, "telemetry", _hung),
    Fault("slow", (20,), "turns take 0.1 to 0.4 s",
          AIR, "telemetry", lambda draw: e.Slow(draw.between(0.1, 0.4), draw.lasting_s(0.5))),
    Fault("disk-full", (44,), "the log cannot be written",
          AIR, "disk", lambda draw: e.DiskFull(draw.lasting_s())),
    # --- readings that stand still, though their packets come -------------------------
    Fault("position-frozen", (12,), "position and velocity are logged as they were",
          AIR, "telemetry", _frozen(*STATE_NAMES)),
    Fault("attitude-frozen", (12,), "roll, pitch and yaw are logged as they were",
          AIR, "telemetry",
          _frozen("stateEstimate.roll", "stateEstimate.pitch", "stateEstimate.yaw")),
    Fault("acceleration-frozen", (12,), "the acceleration is logged as it was",
          AIR, "telemetry", _frozen("acc.x", "acc.y", "acc.z")),
    Fault("thrust-frozen", (12,), "the thrust is logged as it was",
          AIR, "telemetry", _frozen("stabilizer.thrust")),
    Fault("supervisor-frozen", (12,), "the supervisor's word is logged as it was",
          AIR, "telemetry", _frozen("supervisor.info")),
    # --- what nothing announces --------------------------------------------------------
    Fault("thrust-changed", (37,), "hovering takes up to 8 % more or less thrust",
          AIR, "pushed", lambda draw: e.ThrustChanged(round(1.0 / draw.between(0.92, 1.08), 4))),
    Fault("external-mirrored", (11,), "positions come mirrored",
          AIR, "positions", _external("mirrored")),
    Fault("exception", (18,), "an unforeseen exception ends the loop",
          AIR, "exception", lambda draw: e.Raises()),
    Fault("operator-hammers", (16,), "Ctrl-C every 80 to 250 ms, for 2.5 to 4 s",
          AIR, "stop",
          lambda draw: _presses_every(draw.between(0.08, 0.25), draw.between(2.5, 4.0)),
          (expected.OPERATOR_STOPS,)),
    # --- two at once ------------------------------------------------------------------
    Fault("covered-and-kick", (27, 37), "a blow, and the target is hidden from then on",
          BY_CAMERA, "camera", _together(_camera("covered"), _kick)),
    Fault("covered-and-gust", (27, 37), "a gust, and the target is hidden from then on",
          BY_CAMERA, "camera", _together(_camera("covered"), _gust)),
    Fault("covered-and-operator", (16, 27), "Ctrl-C, and the target is hidden from then on",
          BY_CAMERA, "operator", _together(_camera("covered"), _pressed_once)),
    Fault("weak-magnet-uplink", (14, 39),
          "the magnet carries 0.2 to 1.1 of the weight, and no command arrives for a time",
          (P.PERCH, P.COMPLETE), "link",
          _together(_weak_magnet, _silence(up=True, down=False)), (expected.TOO_LOW, expected.CUT)),
    Fault("hung-and-packet-lost", (14, 20),
          "the loop is stuck, and one or two packets of what is sent in its place are lost",
          AIR, "telemetry",
          _hung_and_packet_lost),
    # --- what comes at once, and stays --------------------------------------------------
    Fault("latency-falls", (24,), "pictures come 100 to 200 ms sooner than before",
          AIR, "camera", lambda draw: e.CameraFault("sooner", e.FOR_EVER, draw.between(0.1, 0.2))),
    Fault("brown-out", (6, 13), "the voltage breaks down, and the vehicle starts again",
          AIR, "link", lambda draw: e.Reboots(draw.between(0.5, 1.5)), (expected.BROWN_OUT,)),
    Fault("deck-silent", (10,), "the positions of the vehicle's own deck end for 0.3 s to ever",
          AIR, "positions",
          lambda draw: e.DeckSilent(draw.lasting_s(0.3), draw.sign() * draw.between(0.03, 0.08))),
)  # fmt: skip

BY_NAME = {fault.name: fault for fault in FAULTS}


@dataclass(frozen=True)
class Case:
    """One fault of one flight. To reach LANDING, the operator lands `landed_after_s` into the
    phase `landed_from`. To reach RECOVER, the first contact holds only the part `first_hold` of
    the weight."""

    fault: Fault
    phase: Phase
    moment_s: float
    effects: tuple[e.Effect, ...]
    landed_from: Phase | None = None
    landed_after_s: float = 0.0
    first_hold: float | None = None


def select_faults(names: str) -> tuple[Fault, ...]:
    """Return the faults named by `all` or by names between commas. Errors: UsageError."""
    if names == "all":
        return FAULTS
    found = []
    for name in (part.strip() for part in names.split(",")):
        if name not in BY_NAME:
            raise UsageError(
                f"fault {name!r} is unknown; `--faults list` shows the {len(FAULTS)} there are"
            )
        found.append(BY_NAME[name])
    return tuple(found)


def draw_case(seed: int, scenario: Scenario, faults: Sequence[Fault] = FAULTS) -> Case:
    """Return the case of a seed, drawn from a selection; equal arguments give equal cases."""
    rng = np.random.default_rng([seed, STREAM])
    fault = faults[int(rng.integers(len(faults)))]
    phase = fault.phases[int(rng.integers(len(fault.phases)))]
    return case_of(fault, phase, rng, scenario)


def case_of(fault: Fault, phase: Phase, rng: np.random.Generator, scenario: Scenario) -> Case:
    """Return a case of the given fault and phase with everything else drawn."""
    draw = Draw(rng, scenario)
    moment_s = draw.between(0.0, USUAL_S[phase])
    effects = _effects(fault.draw(draw))
    landed_from, after_s, first_hold = None, 0.0, None
    if phase is Phase.LANDING:
        landed_from = draw.one_of(LANDED_FROM)
        after_s = draw.between(0.0, USUAL_S[landed_from])
    if phase is Phase.RECOVER:
        first_hold = draw.between(0.0, 0.6)
    return Case(fault, phase, moment_s, effects, landed_from, after_s, first_hold)
