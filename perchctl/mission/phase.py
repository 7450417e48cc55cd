"""The phases of a mission, what a transition claims, and how a flight can end."""

from __future__ import annotations

from enum import Enum, Flag, IntEnum, auto


class Phase(Enum):
    """The paper's seven phases, recovery, landing, and the three final phases."""

    __hash__ = object.__hash__  # by identity: each row of the table looks it up

    APPROACH = "APPROACH"
    SEARCH = "SEARCH"
    ESTIMATE = "ESTIMATE"
    ALIGN = "ALIGN"
    ASCEND = "ASCEND"
    PERCH = "PERCH"
    COMPLETE = "COMPLETE"
    RECOVER = "RECOVER"
    LANDING = "LANDING"
    PERCHED = "PERCHED"
    LANDED = "LANDED"
    ABORTED = "ABORTED"

    @property
    def is_flying(self) -> bool:
        """True until a landing begins."""
        return self in FLYING_PHASES

    @property
    def is_before_contact(self) -> bool:
        """True while flying, until a contact is proven."""
        return self in BEFORE_CONTACT

    @property
    def is_over(self) -> bool:
        """True for a phase that is never left."""
        return self in TERMINALS


# Sets of phases that rows apply in. The first three are defined by what they leave out, so that the
# gravest rows hold in a new phase before anybody thinks of it.
TERMINALS = frozenset({Phase.PERCHED, Phase.LANDED, Phase.ABORTED})
"""Phases that are never left."""
AIRBORNE = frozenset(Phase) - TERMINALS
FLYING_PHASES = AIRBORNE - {Phase.LANDING}
BEFORE_CONTACT = FLYING_PHASES - {Phase.COMPLETE}
BY_CAMERA = frozenset({Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER})
"""Phases that are flown by what the camera sees: those whose maneuver is `by_camera`."""
IN_THE_OPEN = BY_CAMERA | {Phase.APPROACH}
"""Phases in which nothing but air should touch the vehicle: `in_the_open` in their maneuver."""
MAGNET_MAY_CATCH = BY_CAMERA | {Phase.PERCH}
"""Phases in which the magnet may catch the vehicle before a contact is proven."""
SEVEN_PHASES = (
    Phase.APPROACH,
    Phase.SEARCH,
    Phase.ESTIMATE,
    Phase.ALIGN,
    Phase.ASCEND,
    Phase.PERCH,
    Phase.COMPLETE,
)
"""The paper's, in their order."""


class Severity(IntEnum):
    """How grave a transition is. From `LAND` on, a flight's severity only rises."""

    CONTINUE = 0
    HOLD = 1
    BACK_OFF = 2
    LAND = 3
    STOP = 4

    def escalate(self, transition: Severity) -> Severity:
        """The flight's severity after a transition of the given severity."""
        return max(self, transition) if self >= Severity.LAND else transition


class Outcome(Enum):
    """Why the flight ended, each with one exit code."""

    PERCHED = "perched"
    TARGET_NOT_FOUND = "target not found"
    ATTEMPTS_USED_UP = "attempts used up"
    SAFETY = "safety abort"
    EMERGENCY = "emergency stop"
    OPERATOR = "operator"


class Claim(Flag):
    """What a row claims of the vehicle, beside why it leaves the phase. The next phase begins with
    it, and whoever needs to know asks for the claim, never for a row by its name."""

    NONE = 0
    BLOCKED = auto()
    """Something solid is just above the vehicle."""
    SLIPPED = auto()
    """The vehicle falls off its contact."""
    STILL_ATTACHED = auto()
    """The contact was proven, and nothing has come off it."""
    HANGS = auto()
    """It hangs where it last touched the target."""
    HELD_BY_OTHER = auto()
    """Something holds it where the target is not."""
    POSITIONS_WRONG = auto()
    """External positions lead position control away from its setpoint."""
    MOUNTING_WRONG = auto()
    """The camera is mounted otherwise than the profile says, or the positions' axes are wrong."""
    PROFILE_SUSPECT = auto()
    """The profile's camera or positioning may be wrong: whoever reads the report should look."""
    UNCONFIRMED = auto()
    """Nothing proved in time how the landing ended."""


class Operator(IntEnum):
    """The operator's command, which only rises: `LAND`, and `STOP`, which cuts the motors."""

    NONE = 0
    LAND = 1
    STOP = 2
