"""The faults that can be laid into a simulated flight: docs/faults.md, row by row.

`draw_case` is one seed's fault: which, in which phase, when in it, with what parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.errors import UsageError
from perchctl.faults import draws
from perchctl.faults.draws import Draw
from perchctl.faults.effects import Effect
from perchctl.faults.expected_outcomes import (
    BROWN_OUT,
    CUT,
    KNOCKED_OFF,
    LEFT_LANDING,
    LETS_GO_LATER,
    NO_LIFT,
    OPERATOR_STOPS,
    SAGS_TOO_FAST,
    TOO_LOW,
    ExpectedOutcome,
)
from perchctl.mission import Phase
from perchctl.sim import Scenario

P = Phase
STREAM = 510

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
"""For how long a phase usually lasts: a fault begins somewhere within."""
LANDED_FROM = (P.SEARCH, P.ALIGN, P.ASCEND, P.PERCH, P.COMPLETE)


@dataclass(frozen=True)
class Fault:
    """`rows` are those of docs/faults.md, none for what has no row of its own there."""

    name: str
    rows: tuple[int, ...]
    what: str
    phases: tuple[Phase, ...]
    draw: Draw
    expected_outcomes: tuple[ExpectedOutcome, ...] = ()


FAULTS: tuple[Fault, ...] = (
    # --- the link -----------------------------------------------------------------
    Fault("downlink-silent", (13, 14), "no telemetry for 0.1 s to ever", AIR,
          draws.silence(up=False, down=True)),
    Fault("uplink-silent", (13, 14), "no command arrives for 0.1 s to ever", AIR,
          draws.silence(up=True, down=False), (CUT,)),
    Fault("link-silent", (13, 14), "both ways silent for 0.1 s to ever", AIR,
          draws.silence(up=True, down=True), (CUT,)),
    Fault("landing-lost", (14,), "the operator lands; one or two packets of the landing order "
          "are lost", BEFORE_LANDING, draws.lost("land", 0.0)),
    Fault("notify-lost", (14,), "the operator lands; one or two notify packets are lost",
          AIR, draws.lost("notify", 0.0)),
    Fault("stop-lost", (14, 42), "one or two stop packets are lost", STOPPING,
          draws.lost("stop")),
    Fault("stop-notify-lost", (14, 42), "one or two notify packets after a stop are lost",
          STOPPING, draws.lost("notify")),
    Fault("emergency-stop-lost", (14, 16), "the operator stops; one or two packets of the stop "
          "are lost", AIR, draws.lost("emergency-stop", 0.0, 0.8), (OPERATOR_STOPS,)),
    Fault("packet-twice", (14,), "a setpoint, landing order, notify or stop arrives twice", AIR,
          draws.twice),
    Fault("state-block-dead", (12, 14), "position and velocity come no more, the attitude does",
          AIR, draws.block_dead("state")),
    Fault("attitude-block-dead", (12, 14), "attitude, thrust and supervisor come no more", AIR,
          draws.block_dead("attitude")),
    Fault("battery-block-dead", (7,), "the battery's block comes no more", AIR,
          draws.block_dead("battery")),
    Fault("variance-block-dead", (8,), "the variance's block comes no more", AIR,
          draws.block_dead("variance")),
    Fault("telemetry-delayed", (12,), "telemetry 50 ms to 2 s late", AIR, draws.delayed),
    # --- the camera ---------------------------------------------------------------
    Fault("camera-silent", (21,), "no picture for 0.1 s to ever", AIR, draws.camera("silent")),
    Fault("camera-frozen", (22,), "the same picture again and again", AIR,
          draws.camera("frozen")),
    Fault("camera-snow", (23,), "a receiver's snow", AIR, draws.camera("snow")),
    Fault("camera-dark", (27,), "a nearly black picture", AIR, draws.camera("dark")),
    Fault("camera-lossy", (25,), "20 % of the pictures lost", AIR, draws.camera("lossy")),
    Fault("target-covered", (27, 31, 32, 33), "something hides the target", AIR,
          draws.camera("covered")),
    Fault("camera-late", (24,), "pictures 50 to 600 ms late that look fresh", AIR,
          draws.camera_late),
    Fault("camera-out-of-order", (24, 35), "pictures in pairs, the newer one first", AIR,
          draws.camera("out-of-order")),
    Fault("camera-mirrored", (26,), "mirrored pictures from the start", FROM_THE_START,
          draws.camera_mirrored),
    # --- the state estimate ---------------------------------------------------------
    Fault("estimate-jumps", (9,), "steps sideways by 0.1 to 2 m", AIR, draws.jump_xy),
    Fault("height-jumps", (9,), "steps in height by 0.1 to 1 m", AIR, draws.jump_z),
    Fault("heading-jumps", (9, 34), "turns by 10 to 180 deg", AIR, draws.jump_yaw),
    Fault("estimate-drifts", (9,), "slides by 3 to 30 cm/s", AIR, draws.drift),
    Fault("estimate-nan", (35,), "position and velocity are logged as NaN", AIR,
          draws.not_a_number),
    Fault("external-position", (10,), "positions from outside freeze or end", AIR,
          draws.external),
    Fault("external-occluded", (10,), "the rigid body is hidden for 0.3 s to ever", AIR,
          draws.external_occluded),
    Fault("external-swapped", (11,), "another rigid body takes its name", AIR,
          draws.external_wrong("swapped")),
    Fault("external-scaled", (11,), "positions come in millimetres", AIR,
          draws.external_wrong("millimetres")),
    Fault("external-late", (10,), "positions come 50 to 150 ms later than they say", AIR,
          draws.external_late),
    # --- power and motors -----------------------------------------------------------
    Fault("battery-sags", (6,), "loses 0.2 to 0.6 V at 10 to 100 mV/s", AIR, draws.sags,
          (SAGS_TOO_FAST,)),
    Fault("battery-reading-frozen", (7,), "its reading stands still", AIR,
          draws.reading_frozen),
    Fault("battery-low", (6,), "its reading is low", AIR, draws.reading_low),
    Fault("motor-weak", (37,), "one motor gives 15 % less", AIR, draws.weak_motor, (NO_LIFT,)),
    # --- what pushes ------------------------------------------------------------------
    Fault("kick", (37,), "a blow that changes the speed by 0.2 to 1 m/s", AIR, draws.kick,
          (KNOCKED_OFF,)),
    Fault("gust", (37,), "5 to 20 % of the weight, for 0.5 to 1 s", AIR, draws.gust),
    # --- the magnet -------------------------------------------------------------------
    Fault("no-magnet", (38,), "nothing holds", AT_CONTACT, draws.no_magnet),
    Fault("weak-magnet", (39,), "carries 0.2 to 1.1 of the weight", AT_CONTACT,
          draws.weak_magnet, (TOO_LOW,)),
    Fault("magnet-lets-go", (39, 40), "lets go 1 to 25 s after the contact", AT_CONTACT,
          draws.lets_go, (LETS_GO_LATER, TOO_LOW)),
    # --- the room and the target ------------------------------------------------------
    Fault("ceiling-beside-its-plane", (38, 40), "the target lies 2 to 20 cm above or below what "
          "the gear meets", FROM_THE_START, draws.beside_its_plane),
    Fault("ceiling-unusual", (36, 38), "at 1.1 to 1.6 m or at 2.7 to 3.4 m", FROM_THE_START,
          draws.unusual_ceiling),
    Fault("bare-ceiling", (43,), "no target", FROM_THE_START, draws.bare),
    Fault("low-bare-ceiling", (37, 43), "no target, at 0.35 to 1.3 m", FROM_THE_START,
          draws.low_and_bare),
    Fault("target-moves", (28,), "by 0.3 m", (P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER),
          draws.target_moves),
    Fault("second-target", (28,), "the same sheet 0.35 to 1.2 m away", FROM_THE_START,
          draws.second_target),
    Fault("camera-turned", (26,), "mounted 90, 180 or -90 deg from what the profile says",
          FROM_THE_START, draws.turned_mount),
    # --- the operator -----------------------------------------------------------------
    Fault("operator-once", (16,), "Ctrl-C", AIR, draws.pressed_once),
    Fault("operator-twice", (16,), "Ctrl-C, and again 0.6 to 10 s later", AIR,
          draws.pressed_twice, (OPERATOR_STOPS,)),
    Fault("operator-held", (16,), "Ctrl-C held for 0.1 to 1.8 s: it repeats every 30 ms", AIR,
          draws.held),
    Fault("hang-up", (16,), "the terminal is closed", AIR, draws.hang_up),
    # --- the program ------------------------------------------------------------------
    Fault("killed", (15,), "killed at once", AIR, draws.killed, (CUT, LEFT_LANDING)),
    Fault("suspended", (17,), "suspended for 0.3 to 5 s", AIR, draws.suspended, (CUT,)),
    Fault("hung", (18, 19, 20), "the loop is stuck for 0.3 s to ever", AIR, draws.hung),
    Fault("slow", (20,), "turns take 0.1 to 0.4 s", AIR, draws.slow),
    Fault("disk-full", (44,), "the log cannot be written", AIR, draws.disk_full),
    # --- readings that stand still, though their packets come -------------------------
    Fault("position-frozen", (12,), "position and velocity are logged as they were", AIR,
          draws.frozen(*draws.STATE_NAMES)),
    Fault("attitude-frozen", (12,), "roll, pitch and yaw are logged as they were", AIR,
          draws.frozen("stateEstimate.roll", "stateEstimate.pitch", "stateEstimate.yaw")),
    Fault("acceleration-frozen", (12,), "the acceleration is logged as it was", AIR,
          draws.frozen("acc.x", "acc.y", "acc.z")),
    Fault("thrust-frozen", (12,), "the thrust is logged as it was", AIR,
          draws.frozen("stabilizer.thrust")),
    Fault("supervisor-frozen", (12,), "the supervisor's word is logged as it was", AIR,
          draws.frozen("supervisor.info")),
    # --- what nothing announces --------------------------------------------------------
    Fault("thrust-changed", (37,), "hovering takes up to 8 % more or less thrust", AIR,
          draws.thrust_changed),
    Fault("external-mirrored", (11,), "positions come mirrored", AIR,
          draws.external_wrong("mirrored")),
    Fault("exception", (18,), "an unforeseen exception ends the loop", AIR, draws.raises),
    Fault("operator-hammers", (16,), "Ctrl-C every 80 to 250 ms, for 2.5 to 4 s", AIR,
          draws.hammered, (OPERATOR_STOPS,)),
    # --- two at once ------------------------------------------------------------------
    Fault("covered-and-kick", (27, 37), "a blow, and the target is hidden from then on",
          BY_CAMERA, draws.together(draws.camera("covered"), draws.kick)),
    Fault("covered-and-gust", (27, 37), "a gust, and the target is hidden from then on",
          BY_CAMERA, draws.together(draws.camera("covered"), draws.gust)),
    Fault("covered-and-operator", (16, 27), "Ctrl-C, and the target is hidden from then on",
          BY_CAMERA, draws.together(draws.camera("covered"), draws.pressed_once)),
    Fault("weak-magnet-uplink", (14, 39), "the magnet carries 0.2 to 1.1 of the weight, and no "
          "command arrives for a time", (P.PERCH, P.COMPLETE),
          draws.together(draws.weak_magnet, draws.silence(up=True, down=False)), (TOO_LOW, CUT)),
    Fault("hung-and-packet-lost", (14, 20), "the loop is stuck, and one or two packets of what is "
          "sent in its place are lost", AIR, draws.hung_and_packet_lost),
    # --- what comes at once, and stays --------------------------------------------------
    Fault("latency-falls", (24,), "pictures come 100 to 200 ms sooner than before", AIR,
          draws.camera_sooner),
    Fault("brown-out", (6, 13), "the voltage breaks down, and the vehicle starts again", AIR,
          draws.reboots, (BROWN_OUT,)),
    Fault("deck-silent", (10,), "the positions of the vehicle's own deck end for 0.3 s to ever",
          AIR, draws.deck_silent),
)  # fmt: skip

BY_NAME = {fault.name: fault for fault in FAULTS}


@dataclass(frozen=True)
class Case:
    """One fault in one flight. `landed_from`: the phase in which the operator lands first,
    `landed_after_s` into it, so that LANDING comes. `first_hold`: the part of the weight that the
    first contact holds, so that RECOVER comes."""

    fault: Fault
    phase: Phase
    moment_s: float
    effects: tuple[Effect, ...]
    landed_from: Phase | None = None
    landed_after_s: float = 0.0
    first_hold: float | None = None


def select_faults(names: str) -> tuple[Fault, ...]:
    """Faults by `all` or names with commas between them. Errors: UsageError."""
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
    """The seed's case out of a selection: the same for the same arguments."""
    rng = np.random.default_rng([seed, STREAM])
    fault = faults[int(rng.integers(len(faults)))]
    phase = fault.phases[int(rng.integers(len(fault.phases)))]
    return case_of(fault, phase, rng, scenario)


def case_of(fault: Fault, phase: Phase, rng: np.random.Generator, scenario: Scenario) -> Case:
    """A fault in a given phase, all else drawn."""
    moment_s = draws.between(rng, 0.0, USUAL_S[phase])
    effects = fault.draw(rng, scenario)
    landed_from, after_s, first_hold = None, 0.0, None
    if phase is Phase.LANDING:
        landed_from = LANDED_FROM[int(rng.integers(len(LANDED_FROM)))]
        after_s = draws.between(rng, 0.0, USUAL_S[landed_from])
    if phase is Phase.RECOVER:
        first_hold = draws.between(rng, 0.0, 0.6)
    return Case(fault, phase, moment_s, effects, landed_from, after_s, first_hold)
