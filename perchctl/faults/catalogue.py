"""The catalogue of faults that can be injected into a simulated flight.

A seed must give the same flight in every version, so new random draws are only added after the
existing ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from perchctl.errors import InvalidValue, did_you_mean
from perchctl.faults import effects as e
from perchctl.geometry import GRAVITY_MPS2, rot_z
from perchctl.mission import Phase
from perchctl.sim import Neighbour, Scenario

P = Phase
FAULT_STREAM = 510
LONGEST_LOSS_S = 30.0
"""Longest duration of a temporary loss, s; the shortest is 0.1 s. Larger: fewer losses end before
the vehicle has to land."""
EVER_SHARE = 0.25
"""Fraction of losses that are permanent. Larger: fewer losses end during the flight."""


# --- Draws ---


class DrawInputs(NamedTuple):
    """Inputs of a random draw: the random generator, and the flight's scenario."""

    rng: np.random.Generator
    scenario: Scenario


Draw = Callable[[DrawInputs], Any]
"""Draws one value."""


def uniform(low: float, high: float) -> Draw:
    """Draw a number uniformly from a range."""
    return lambda source: round(float(source.rng.uniform(low, high)), 4)


def log_uniform(low: float, high: float) -> Draw:
    """Draw a number log-uniformly from a range."""
    logs = math.log(low), math.log(high)
    return lambda source: round(float(math.exp(source.rng.uniform(*logs))), 4)


def draw_bool(source: DrawInputs, probability: float) -> bool:
    """Draw True with the given probability, else False."""
    return bool(source.rng.uniform() < probability)


def duration_s(low: float = 0.1) -> Draw:
    """Draw a duration log-uniformly from `low` to `LONGEST_LOSS_S`; one in four draws is
    permanent."""

    def draw(source: DrawInputs) -> float:
        for_s: float = log_uniform(low, LONGEST_LOSS_S)(source)
        return e.FOR_EVER if draw_bool(source, EVER_SHARE) else for_s

    return draw


def either(probability: float, first: Any, second: Any) -> Draw:
    """Draw `first` with the given probability, else `second`; each is a value or a Draw."""
    return lambda source: _value(first if draw_bool(source, probability) else second, source)


def random_sign(size: Draw) -> Draw:
    """Draw a number from `size`, and give it a random sign."""
    return lambda source: (1.0 if draw_bool(source, 0.5) else -1.0) * size(source)


def one_of(*choices: Any) -> Draw:
    """Draw one of several choices with equal probability."""
    return lambda source: choices[int(source.rng.integers(len(choices)))]


def draw_direction(source: DrawInputs) -> tuple[float, float]:
    """Draw a horizontal unit vector in a random direction."""
    angle = float(source.rng.uniform(-math.pi, math.pi))
    return math.cos(angle), math.sin(angle)


def key_press_times(period: float | Draw, duration: Draw) -> Draw:
    """Draw the times, s, of key presses every `period` s for `duration` s."""

    def draw(source: DrawInputs) -> tuple[float, ...]:
        period_s, for_s = _value(period, source), duration(source)
        return tuple(round(float(t), 3) for t in np.arange(0.0, for_s, period_s))

    return draw


def held_key_times(delay: Draw, period_s: float, held: Draw) -> Draw:
    """Draw the times, s, at which a key that is held down causes a press: at once, then every
    `period_s` from `delay` until `held`, at least three times in all."""

    def draw(source: DrawInputs) -> tuple[float, ...]:
        delay_s, for_s = delay(source), held(source)
        repeats_s = np.arange(delay_s, max(for_s, delay_s + 2.5 * period_s), period_s)
        return (0.0, *(round(float(t), 3) for t in repeats_s))

    return draw


def _value(value: Any, source: DrawInputs) -> Any:
    if isinstance(value, tuple):
        return tuple(_value(part, source) for part in value)
    return value(source) if callable(value) else value


def effect(act: Callable[..., object], **values: Any) -> Draw:
    """Draw an effect: the function `act` with the keyword arguments `values`, each of which is
    drawn if it is a Draw."""
    return lambda source: partial(act, **{name: _value(v, source) for name, v in values.items()})


def _jump_xy(source: DrawInputs) -> e.Axes:
    x, y = draw_direction(source)
    step_m = log_uniform(0.1, 2.0)(source)
    return x * step_m, y * step_m, 0.0


def _drift(source: DrawInputs) -> e.Axes:
    x, y = draw_direction(source)
    speed_mps = log_uniform(0.03, 0.3)(source)
    return x * speed_mps, y * speed_mps, uniform(-0.2, 0.2)(source) * speed_mps


def _blow(source: DrawInputs) -> e.Axes:
    """Draw the force of a 40 ms blow that changes the vehicle's speed by up to 1 m/s."""
    x, y = draw_direction(source)
    z = uniform(-0.5, 0.5)(source)
    force_n = source.scenario.mass_kg * uniform(0.2, 1.0)(source) / 0.04
    return x * force_n, y * force_n, z * force_n


def _gust(source: DrawInputs) -> e.Axes:
    x, y = draw_direction(source)
    z = uniform(-0.3, 0.3)(source)
    force_n = source.scenario.mass_kg * GRAVITY_MPS2 * uniform(0.05, 0.2)(source)
    return x * force_n, y * force_n, z * force_n


def _a_step_aside(source: DrawInputs) -> tuple[float, float]:
    x, y = draw_direction(source)
    return 0.3 * x, 0.3 * y


def _beside(source: DrawInputs) -> tuple[Neighbour, ...]:
    x, y = draw_direction(source)
    away_m = uniform(0.35, 1.2)(source)
    return (*source.scenario.neighbours, Neighbour((x * away_m, y * away_m)))


def _turned_camera(source: DrawInputs) -> tuple[tuple[float, ...], ...]:
    turn = rot_z(math.radians(one_of(90.0, 180.0, -90.0)(source)))
    rows = [list(row) for row in source.scenario.T_body_cam_true]
    for row in rows[:3]:
        row[:3] = [float(sum(row[k] * turn[k, j] for k in range(3))) for j in range(3)]
    return tuple(map(tuple, rows))


def _one_weak_motor(source: DrawInputs) -> tuple[float, ...]:
    weak = one_of(1, 2, 3, 4)(source)
    return tuple(0.85 if motor == weak else 1.0 for motor in (1, 2, 3, 4))


def _another_thrust(source: DrawInputs) -> tuple[float, ...]:
    return (round(1.0 / uniform(0.92, 1.08)(source), 4),) * 4


def _packet_twice(source: DrawInputs) -> tuple[e.Effect, ...]:
    order = one_of("setpoint", "land", "notify", "stop")(source)
    twice = partial(e.packet_twice, order=order)
    return (twice, ONCE(source)) if order in ("land", "notify") else (twice,)


def _hung_and_packet_lost(source: DrawInputs) -> tuple[e.Effect, ...]:
    order = one_of("raw", "stop", "land")(source)
    return HUNG(source), packet_loss(order)(source)


def packet_loss(order: str) -> Draw:
    """Draw the loss of the next one or two packets of the kind `order`."""
    return effect(e.packet_lost, order=order, count=either(0.6, 1, 2))


def camera_effect(kind: str) -> Draw:
    return effect(e.camera_fault, kind=kind, for_s=duration_s())


def mocap_effect(how: str | Draw) -> Draw:
    return effect(e.external_positions, how=how, for_s=duration_s())


def radio_effect(**values: Any) -> Draw:
    return effect(e.radio_loss, for_s=duration_s(), **values)


def frozen_logs(*names: str) -> Draw:
    """Draw a freeze of the log variables `names`: packets still arrive, but the values do not
    change."""
    return effect(e.log_reads, names=names, value=None, for_s=duration_s())


ONCE = effect(e.operator, presses_s=(0.0,))
HUNG = effect(e.hung, for_s=duration_s(0.3))
KICK = effect(e.push, force_n=_blow, for_s=0.04)
GUST = effect(e.push, force_n=_gust, for_s=uniform(0.5, 1.0))
COVERED = camera_effect("covered")
WEAK_MAGNET = effect(e.magnet_holds, of_weight=uniform(0.2, 1.1))
NO_UPLINK = radio_effect(up=True)
LOW_VOLTAGE = effect(e.log_reads, names=("pm.vbat",), value=uniform(2.6, 3.1), for_s=duration_s())
LOW_STATE = effect(e.log_reads, names=("pm.state",), value=3.0, for_s=duration_s())
STATE = tuple(f"stateEstimate.{axis}" for axis in ("x", "y", "z", "vx", "vy", "vz"))


# --- The faults ---


# The phases in which a campaign's faults begin. HOVER is in none of these sets: a campaign flies
# perches, and its seeds must continue to draw the same faults. Tests inject faults into a hover
# directly.
AIR = (
    P.APPROACH,
    P.SEARCH,
    P.ESTIMATE,
    P.ALIGN,
    P.ASCEND,
    P.PERCH,
    P.COMPLETE,
    P.RECOVER,
    P.LANDING,
)
BEFORE_LANDING = AIR[:-1]
CAMERA_GUIDED = (P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.RECOVER)
TARGET_SEEN = (P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER)
STOPPING = (P.COMPLETE, P.LANDING)
FROM_THE_START = (P.APPROACH,)
AT_CONTACT = (P.PERCH,)
USUAL_S = {
    P.APPROACH: 2.5,
    P.SEARCH: 1.5,
    P.ESTIMATE: 0.4,
    P.ALIGN: 2.0,
    P.ASCEND: 9.0,
    P.PERCH: 1.0,
    P.COMPLETE: 5.2,
    P.RECOVER: 1.5,
    P.HOVER: 20.0,
    P.LANDING: 5.0,
}
"""The usual duration of each phase; a fault begins somewhere within it."""
LANDED_FROM = (P.SEARCH, P.ALIGN, P.ASCEND, P.PERCH, P.COMPLETE)


@dataclass(frozen=True)
class Fault:
    """A fault in the catalogue: `draw` draws its effects; it may begin in any of `phases`."""

    name: str
    description: str
    draw: Draw | tuple[Draw, ...]
    phases: tuple[Phase, ...] = AIR


FAULTS: tuple[Fault, ...] = (
    # The link.
    Fault("downlink-silent", "no telemetry", radio_effect(down="all")),
    Fault("uplink-silent", "no command reaches the vehicle", NO_UPLINK),
    Fault("link-silent", "no packet in either direction", radio_effect(up=True, down="all")),
    Fault(
        "landing-lost",
        "the operator requests a landing, but 1 or 2 landing commands are lost",
        (packet_loss("land"), ONCE),
        BEFORE_LANDING,
    ),
    Fault(
        "notify-lost",
        "the operator requests a landing, but 1 or 2 notify packets are lost",
        (packet_loss("notify"), ONCE),
    ),
    Fault("stop-lost", "1 or 2 stop packets are lost", packet_loss("stop"), STOPPING),
    Fault(
        "stop-notify-lost",
        "1 or 2 notify packets after a stop are lost",
        packet_loss("notify"),
        STOPPING,
    ),
    Fault(
        "emergency-stop-lost",
        "the operator cuts the motors, but 1 or 2 stop commands are lost",
        (packet_loss("emergency-stop"), effect(e.operator, presses_s=(0.0, 0.8))),
    ),
    Fault("packet-twice", "a packet arrives twice", _packet_twice),
    Fault("state-block-dead", "no position or velocity", radio_effect(down="state")),
    Fault(
        "attitude-block-dead",
        "no attitude, thrust or supervisor state",
        radio_effect(down="attitude"),
    ),
    Fault("battery-block-dead", "no battery voltage", radio_effect(down="battery")),
    Fault("variance-block-dead", "no variance", radio_effect(down="variance")),
    Fault(
        "telemetry-delayed",
        "telemetry 50 ms to 2 s late",
        effect(e.radio_loss, down="all", delay_s=log_uniform(0.05, 2.0), for_s=duration_s(0.5)),
    ),
    # The camera.
    Fault("camera-silent", "no picture", camera_effect("silent")),
    Fault("camera-frozen", "the same picture over and over", camera_effect("frozen")),
    Fault("camera-snow", "a receiver's snow", camera_effect("snow")),
    Fault("camera-dark", "a nearly black picture", camera_effect("dark")),
    Fault("camera-lossy", "20 % of the pictures lost", camera_effect("lossy")),
    Fault("target-covered", "the target is hidden", COVERED),
    Fault(
        "camera-late",
        "pictures arrive 50 to 600 ms late but look fresh",
        effect(e.camera_fault, kind="late", for_s=duration_s(1.0), late_s=log_uniform(0.05, 0.6)),
    ),
    Fault(
        "camera-out-of-order",
        "pictures arrive in pairs, the newer one first",
        camera_effect("out-of-order"),
    ),
    Fault(
        "camera-mirrored",
        "mirrored pictures from the start",
        effect(e.camera_fault, kind="mirrored", for_s=e.FOR_EVER),
        FROM_THE_START,
    ),
    # The state estimate.
    Fault(
        "estimate-jumps",
        "position steps sideways by 0.1 to 2 m",
        effect(e.estimate_error, step_m=_jump_xy, for_s=duration_s()),
    ),
    Fault(
        "height-jumps",
        "height steps by 0.1 to 1 m",
        effect(
            e.estimate_error,
            step_m=(0.0, 0.0, random_sign(log_uniform(0.1, 1.0))),
            for_s=duration_s(),
        ),
    ),
    Fault(
        "heading-jumps",
        "heading steps by 10 to 180 deg",
        effect(
            e.estimate_error,
            turn_deg=random_sign(log_uniform(10.0, 180.0)),
            for_s=duration_s(),
        ),
    ),
    Fault(
        "estimate-drifts",
        "position drifts at 3 to 30 cm/s",
        effect(e.estimate_error, drift_mps=_drift, for_s=duration_s(2.0)),
    ),
    Fault(
        "estimate-nan",
        "position and velocity are NaN",
        effect(e.log_reads, names=STATE, value=math.nan, for_s=duration_s(0.02)),
    ),
    Fault(
        "external-position",
        "positions freeze or stop",
        mocap_effect(either(0.5, "frozen", "silent")),
    ),
    Fault(
        "external-occluded",
        "the rigid body is hidden",
        effect(e.external_positions, how="occluded", for_s=either(0.5, 0.3, duration_s(0.5))),
    ),
    Fault(
        "external-swapped",
        "the vehicle's rigid body swaps names with another",
        mocap_effect("swapped"),
    ),
    Fault("external-scaled", "positions in millimetres", mocap_effect("millimetres")),
    Fault(
        "external-late",
        "positions with 50 to 150 ms of unreported delay",
        effect(
            e.external_positions, how="late", late_s=log_uniform(0.05, 0.15), for_s=duration_s(1.0)
        ),
    ),
    # Power and motors.
    Fault(
        "battery-sags",
        "voltage falls by 0.2 to 0.6 V at 10 to 100 mV/s",
        effect(e.battery_sags, rate_vps=log_uniform(0.01, 0.1), by_v=uniform(0.2, 0.6)),
    ),
    Fault("battery-reading-frozen", "the voltage reading is frozen", frozen_logs("pm.vbat")),
    Fault("battery-low", "the battery reads low", either(0.5, LOW_VOLTAGE, LOW_STATE)),
    Fault(
        "motor-weak", "one motor has 15 % less thrust", effect(e.thrust_changed, to=_one_weak_motor)
    ),
    # External forces.
    Fault("kick", "a blow that changes the speed by 0.2 to 1 m/s", KICK),
    Fault("gust", "a gust of 5 to 20 % of the weight, for 0.5 to 1 s", GUST),
    # The magnet.
    Fault(
        "no-magnet",
        "the magnet does not hold the vehicle",
        effect(e.magnet_holds, of_weight=0.0),
        AT_CONTACT,
    ),
    Fault("weak-magnet", "the magnet carries 0.2 to 1.1 times the weight", WEAK_MAGNET, AT_CONTACT),
    Fault(
        "magnet-lets-go",
        "the magnet lets go 1 to 25 s after contact",
        effect(e.magnet_lets_go, after_s=log_uniform(1.0, 25.0)),
        AT_CONTACT,
    ),
    # The room and the target.
    Fault(
        "ceiling-beside-its-plane",
        "the target is 2 to 20 cm above or below the ceiling",
        effect(e.room, target_above_ceiling_m=random_sign(log_uniform(0.02, 0.2))),
        FROM_THE_START,
    ),
    Fault(
        "ceiling-unusual",
        "ceiling at 1.1 to 1.6 m or at 2.7 to 3.4 m",
        effect(e.room, ceiling_z_m=either(0.5, uniform(1.1, 1.6), uniform(2.7, 3.4))),
        FROM_THE_START,
    ),
    Fault("bare-ceiling", "no target", effect(e.room, no_target=True), FROM_THE_START),
    Fault(
        "low-bare-ceiling",
        "no target, ceiling at 0.35 to 1.3 m",
        effect(e.room, ceiling_z_m=uniform(0.35, 1.3), no_target=True),
        FROM_THE_START,
    ),
    Fault(
        "target-moves",
        "the target moves by 0.3 m",
        effect(e.target_moves, by_m=_a_step_aside),
        TARGET_SEEN,
    ),
    Fault(
        "second-target",
        "a second target 0.35 to 1.2 m away",
        effect(e.room, neighbours=_beside),
        FROM_THE_START,
    ),
    Fault(
        "camera-turned",
        "camera mounted 90, 180 or -90 deg off",
        effect(e.room, T_body_cam_true=_turned_camera),
        FROM_THE_START,
    ),
    # The operator.
    Fault("operator-once", "Ctrl-C", ONCE),
    Fault(
        "operator-twice",
        "Ctrl-C, and again 0.3 to 10 s later",
        effect(e.operator, presses_s=(0.0, log_uniform(0.3, 10.0))),
    ),
    Fault(
        "operator-held",
        "Ctrl-C held for up to 0.95 s: it repeats every 30 ms after 0.25 to 0.66 s",
        effect(e.operator, presses_s=held_key_times(uniform(0.25, 0.66), 0.03, uniform(0.3, 0.95))),
    ),
    Fault("hang-up", "the terminal is closed", effect(e.operator, presses_s=(0.0,), hang_up=True)),
    # The program.
    Fault("killed", "perchctl is killed", effect(e.killed)),
    Fault(
        "suspended",
        "perchctl is suspended for 0.3 to 5 s",
        effect(e.suspended, for_s=log_uniform(0.3, 5.0)),
    ),
    Fault("hung", "the loop hangs", HUNG),
    Fault(
        "slow",
        "ticks take 0.1 to 0.4 s",
        effect(e.slow, tick_s=uniform(0.1, 0.4), for_s=duration_s(0.5)),
    ),
    Fault("disk-full", "the log cannot be written", effect(e.disk_full, for_s=duration_s())),
    # Frozen readings.
    Fault("position-frozen", "position and velocity are frozen", frozen_logs(*STATE)),
    Fault(
        "attitude-frozen",
        "roll, pitch and yaw are frozen",
        frozen_logs("stateEstimate.roll", "stateEstimate.pitch", "stateEstimate.yaw"),
    ),
    Fault(
        "acceleration-frozen",
        "the acceleration is frozen",
        frozen_logs("acc.x", "acc.y", "acc.z"),
    ),
    Fault("thrust-frozen", "the thrust is frozen", frozen_logs("stabilizer.thrust")),
    Fault("supervisor-frozen", "the supervisor's state is frozen", frozen_logs("supervisor.info")),
    # Undetectable faults.
    Fault(
        "thrust-changed",
        "hover thrust up to 8 % higher or lower",
        effect(e.thrust_changed, to=_another_thrust),
    ),
    Fault("external-mirrored", "positions are mirrored", mocap_effect("mirrored")),
    Fault("exception", "an exception ends the loop", effect(e.raises)),
    Fault(
        "operator-hammers",
        "Ctrl-C every 100 to 330 ms, for 1 to 4 s",
        effect(e.operator, presses_s=key_press_times(uniform(0.1, 0.33), uniform(1.0, 4.0))),
    ),
    # Two at once.
    Fault("covered-and-kick", "a blow; the target is hidden", (COVERED, KICK), CAMERA_GUIDED),
    Fault("covered-and-gust", "a gust; the target is hidden", (COVERED, GUST), CAMERA_GUIDED),
    Fault(
        "covered-and-operator",
        "Ctrl-C; the target is hidden",
        (COVERED, ONCE),
        CAMERA_GUIDED,
    ),
    Fault(
        "weak-magnet-uplink",
        "the magnet carries 0.2 to 1.1 times the weight; no command reaches the vehicle",
        (WEAK_MAGNET, NO_UPLINK),
        (P.PERCH, P.COMPLETE),
    ),
    Fault(
        "hung-and-packet-lost",
        "the loop hangs, and 1 or 2 of the watchdog's packets are lost",
        _hung_and_packet_lost,
    ),
    # Permanent faults.
    Fault(
        "latency-falls",
        "pictures arrive 100 to 200 ms sooner than before",
        effect(e.camera_fault, kind="sooner", for_s=e.FOR_EVER, late_s=uniform(0.1, 0.2)),
    ),
    Fault("brown-out", "the vehicle restarts", effect(e.reboots, boots_s=uniform(0.5, 1.5))),
    Fault(
        "deck-silent",
        "the deck's positions stop",
        effect(e.deck_silent, for_s=duration_s(0.3), acc_z_mps2=random_sign(uniform(0.03, 0.08))),
    ),
)

NO_FAULT = Fault("none", "no fault", (), ())
"""Marks a flight without a fault in a campaign in which other flights have faults."""
BY_NAME = {fault.name: fault for fault in FAULTS}


@dataclass(frozen=True)
class Case:
    """One fault in one flight: its `effects` begin `moment_s` seconds into `phase`.

    To reach the phase LANDING, the operator commands a landing `landed_after_s` seconds into the
    phase `landed_from`. To reach RECOVER, the magnet's holding force at the first contact is only
    `first_hold_ratio` times the weight.
    """

    fault: Fault
    phase: Phase
    moment_s: float
    effects: tuple[e.Effect, ...]
    landed_from: Phase | None = None
    landed_after_s: float = 0.0
    first_hold_ratio: float | None = None

    @property
    def text(self) -> str | None:
        """The fault, its time and the values drawn for it, in words; None without a fault."""
        if not self.effects:
            return None
        begins = f"{self.moment_s:.1f} s after {self.phase.value} began"
        if self.fault.phases == FROM_THE_START:
            begins = "from the start"
        return self.text_at(begins)

    def text_at(self, begins: str) -> str:
        """The fault and the values drawn for it, in words, with another text for its time."""
        drawn = "; ".join(map(_effect_text, self.effects))
        text = f"{self.fault.name}, {begins}: {self.fault.description} ({drawn})"
        if self.landed_from is not None:
            text += (
                f"; to reach this phase, the operator ended {self.landed_from.value} after "
                f"{self.landed_after_s:.1f} s"
            )
        if self.first_hold_ratio is not None:
            text += (
                f"; to reach this phase, the magnet held only {self.first_hold_ratio:.2f} of the "
                "weight at the first contact"
            )
        return text

    @property
    def lasts_s(self) -> float:
        """Duration of a common cause (a fault that affects several vehicles at once), s."""
        return max(float(effect.keywords["for_s"]) for effect in self.effects)


def _effect_text(effect: e.Effect) -> str:
    values = (f"{name}={_value_text(value)}" for name, value in effect.keywords.items())
    return ": ".join(filter(None, (effect.func.__name__, ", ".join(values))))


def _value_text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_value_text, value))})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


HEALTHY = Case(NO_FAULT, P.APPROACH, 0.0, ())
"""A flight without a fault."""


def select_faults(names: str) -> tuple[Fault, ...]:
    """The faults listed by name in `names`, separated by commas; `all` selects every fault. Errors:
    InvalidValue."""
    if names == "all":
        return FAULTS
    found = []
    for name in (part.strip() for part in names.split(",")):
        if name not in BY_NAME:
            meant = did_you_mean(name, BY_NAME)
            raise InvalidValue(
                f"fault {name!r} is unknown; {meant}`--faults list` lists all {len(FAULTS)}"
            )
        found.append(BY_NAME[name])
    return tuple(found)


def draw_case(seed: int, scenario: Scenario, faults: Sequence[Fault] = FAULTS) -> Case:
    """The case for a seed, with one of `faults`; equal arguments give equal cases."""
    rng = np.random.default_rng([seed, FAULT_STREAM])
    fault = faults[int(rng.integers(len(faults)))]
    phase = fault.phases[int(rng.integers(len(fault.phases)))]
    return draw_fault_case(fault, phase, rng, scenario)


def draw_fault_case(
    fault: Fault, phase: Phase, rng: np.random.Generator, scenario: Scenario
) -> Case:
    """Return a case for the given fault and phase, with start time and effects drawn at random."""
    source = DrawInputs(rng, scenario)
    moment_s = uniform(0.0, USUAL_S[phase])(source)
    effects = _value(fault.draw, source)
    landed_from, after_s, first_hold_ratio = None, 0.0, None
    if phase is Phase.LANDING:
        landed_from = one_of(*LANDED_FROM)(source)
        after_s = uniform(0.0, USUAL_S[landed_from])(source)
    if phase is Phase.RECOVER:
        first_hold_ratio = uniform(0.0, 0.6)(source)
    several = effects if isinstance(effects, tuple) else (effects,)
    return Case(fault, phase, moment_s, several, landed_from, after_s, first_hold_ratio)
