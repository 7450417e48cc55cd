"""The phases of a mission, the diagnoses of transitions, and the outcomes of a flight."""

from __future__ import annotations

from enum import Enum, Flag, IntEnum, auto

from perchctl.errors import (
    AttemptsUsedUp,
    EmergencyStopped,
    Interrupted,
    SafetyAbort,
    TargetNotFound,
)


class Phase(Enum):
    """A phase of the mission: the seven of the published method (`APPROACH`, `SEARCH`, `ESTIMATE`,
    `ALIGN`, `ASCEND`, `PERCH`, `COMPLETE`), `RECOVER` after a failed attempt, `HOVER` below the
    target, `LANDING`, and the final phases `PERCHED`, `LANDED` and `ABORTED`."""

    __hash__ = object.__hash__  # identity hash, for speed: each row of the table looks up phases

    APPROACH = "APPROACH"
    SEARCH = "SEARCH"
    ESTIMATE = "ESTIMATE"  # observe until the estimate of the target's pose is steady
    ALIGN = "ALIGN"
    ASCEND = "ASCEND"
    PERCH = "PERCH"
    COMPLETE = "COMPLETE"  # transfer the weight to the magnet and stop the motors
    RECOVER = "RECOVER"
    HOVER = "HOVER"
    LANDING = "LANDING"
    PERCHED = "PERCHED"
    LANDED = "LANDED"
    ABORTED = "ABORTED"

    @property
    def is_before_landing(self) -> bool:
        """True for all phases except LANDING and the final phases."""
        return self in PRE_LANDING_PHASES

    @property
    def is_before_contact(self) -> bool:
        """True for all phases except COMPLETE, which begins with a proven contact, LANDING and the
        final phases."""
        return self in PRE_CONTACT_PHASES

    @property
    def is_final(self) -> bool:
        """True for PERCHED, LANDED and ABORTED."""
        return self in FINAL_PHASES


# Sets of phases in which rows apply. The first sets are defined by the phases they exclude, so that
# the most severe rows apply in a new phase by default.
FINAL_PHASES = frozenset({Phase.PERCHED, Phase.LANDED, Phase.ABORTED})
"""Final phases."""
AIRBORNE_PHASES = frozenset(Phase) - FINAL_PHASES
"""Phases in which the motors may run."""
PRE_LANDING_PHASES = AIRBORNE_PHASES - {Phase.LANDING}
"""Phases before the landing."""
PRE_CONTACT_PHASES = PRE_LANDING_PHASES - {Phase.COMPLETE}
"""Phases before a contact is proven."""
CAMERA_GUIDED_PHASES = frozenset(
    {Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER, Phase.HOVER}
)
"""Phases in which the camera guides the vehicle: their maneuver has `is_camera_guided` set."""
FREE_AIR_PHASES = CAMERA_GUIDED_PHASES | {Phase.APPROACH}
"""Phases in which nothing but air should touch the vehicle: their maneuver has `is_in_free_air`
set."""
PHASES_IN_WHICH_MAGNET_MAY_ATTACH = CAMERA_GUIDED_PHASES | {Phase.PERCH}
"""Phases in which the magnet may catch the vehicle before a contact is proven."""
PUBLISHED_METHOD_PHASES = (
    Phase.APPROACH,
    Phase.SEARCH,
    Phase.ESTIMATE,
    Phase.ALIGN,
    Phase.ASCEND,
    Phase.PERCH,
    Phase.COMPLETE,
)
"""The seven phases of the published method, in their order."""


class Severity(IntEnum):
    """Severity of a transition: `CONTINUE` (normal progress), `HOLD` (wait, or go back and align or
    search again), `BACK_OFF` (end the attempt), `LAND`, or `STOP` (stop the motors at once). Once a
    flight has reached `LAND`, its severity never decreases."""

    CONTINUE = 0
    HOLD = 1
    BACK_OFF = 2
    LAND = 3
    STOP = 4

    def escalate(self, new_severity: Severity) -> Severity:
        """Return the flight's severity after a transition of severity `new_severity`; `self` is the
        severity before it. The result is `new_severity`, or the higher of both if `self` is already
        `LAND` or `STOP`."""
        return max(self, new_severity) if self >= Severity.LAND else new_severity


class Outcome(Enum):
    """Why the flight ended, for example `PERCHED`, `TARGET_NOT_FOUND` or `ENDED_BY_OPERATOR`. Each
    outcome has one exit code."""

    PERCHED = "perched"
    HOVERED = "hovered"
    TARGET_NOT_FOUND = "target not found"
    ATTEMPTS_USED_UP = "attempts used up"
    SAFETY = "safety abort"
    EMERGENCY = "emergency stop"
    ENDED_BY_OPERATOR = "operator"

    @property
    def exit_code(self) -> int:
        """Exit code of the command after a flight with this outcome. A flight whose log is
        incomplete has a different exit code."""
        return _EXIT_CODES[self]


_EXIT_CODES: dict[Outcome, int] = {
    Outcome.PERCHED: 0,
    Outcome.HOVERED: 0,
    Outcome.TARGET_NOT_FOUND: TargetNotFound.exit_code,
    Outcome.ATTEMPTS_USED_UP: AttemptsUsedUp.exit_code,
    Outcome.SAFETY: SafetyAbort.exit_code,
    Outcome.EMERGENCY: EmergencyStopped.exit_code,
    Outcome.ENDED_BY_OPERATOR: Interrupted.exit_code,
}


class VehicleDiagnosis(Flag):
    """What a transition asserts about the vehicle, in addition to its reason: for example
    `BLOCKED_BY_OBSTACLE` (an obstacle is just above the vehicle) or `CAMERA_MOUNTING_WRONG`.
    `NONE` asserts nothing; several flags can be combined.

    A transition is a row of the mission's table (`Transition`). The next phase starts from the
    row's diagnosis. Code that needs such a fact tests the diagnosis, never the name of a row.
    """

    NONE = 0
    BLOCKED_BY_OBSTACLE = auto()
    """An obstacle is just above the vehicle."""
    SLIPPED_OFF_CONTACT = auto()
    """The vehicle is falling off its contact."""
    STILL_AT_PROVEN_CONTACT = auto()
    """The contact was proven, and the vehicle has not come off."""
    HANGING_AT_LAST_TOUCH = auto()
    """The vehicle is hanging where it last touched the target."""
    HELD_BY_OTHER_OBJECT = auto()
    """Something other than the target is holding the vehicle."""
    EXTERNAL_POSITIONS_WRONG = auto()
    """The external positions are leading the vehicle away from its setpoint."""
    CAMERA_MOUNTING_WRONG = auto()
    """The camera's mounting differs from the profile, or the axes of the positions are wrong."""
    PROFILE_MAY_BE_WRONG = auto()
    """The profile's camera or positioning section may be wrong and should be checked."""
    RETURNING_TO_HOVER_HEIGHT = auto()
    """The vehicle has sunk below its hover position; the hover continues once it has climbed
    back."""
    LANDING_UNCONFIRMED = auto()
    """The end of the landing could not be confirmed in time."""


class OperatorRequest(IntEnum):
    """The operator's request, which can only escalate: from `NONE` to `LAND`, then to
    `CUT_MOTORS`."""

    NONE = 0
    LAND = 1
    CUT_MOTORS = 2
