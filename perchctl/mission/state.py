"""The planner's values: what it observes each tick and what it remembers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, IntEnum

from perchctl.geometry import Array
from perchctl.mission.energy import EnergyState
from perchctl.mission.felt import Mismatch, VisualInertialMotion
from perchctl.mission.imu import ImuMotion, Reckoning
from perchctl.mission.mounting import MountWatch
from perchctl.vehicle import PositionSetpoint, Telemetry
from perchctl.vision import TargetEstimate


class Phase(Enum):
    """The paper's seven phases, the two ways down, and the terminals."""

    __hash__ = object.__hash__  # as of any single object: each row of the table looks it up

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


SEVEN_PHASES = (
    Phase.APPROACH,
    Phase.SEARCH,
    Phase.ESTIMATE,
    Phase.ALIGN,
    Phase.ASCEND,
    Phase.PERCH,
    Phase.COMPLETE,
)
FLYING_PHASES = frozenset({*SEVEN_PHASES, Phase.RECOVER})
TERMINALS = frozenset({Phase.PERCHED, Phase.LANDED, Phase.ABORTED})


class Severity(IntEnum):
    """How grave a row is. From `LAND` on it only rises until the flight is over."""

    CONTINUE = 0
    HOLD = 1
    BACK_OFF = 2
    LAND = 3
    STOP = 4


class Outcome(Enum):
    """Why the flight ended, each with one exit code."""

    PERCHED = "perched"
    TARGET_NOT_FOUND = "target not found"
    ATTEMPTS_USED_UP = "attempts used up"
    SAFETY = "safety abort"
    EMERGENCY = "emergency stop"
    OPERATOR = "operator"


class Condition(Enum):
    """What the table debounces; `perchctl.mission.conditions` says when each holds."""

    __hash__ = object.__hash__  # as of any single object: twenty are looked up in each tick

    AT_TAKEOFF_HEIGHT = "at take-off height"
    ESTIMATED = "estimated"
    ALIGNED = "aligned"
    UNTRACKED = "untracked"
    NEAR_STANDOFF = "near the stand-off"
    SETTLED = "settled"
    CONTACT = "contact"
    MAGNET_HOLDS = "magnet holds"
    SLIPPING = "slipping"
    HANGING = "hanging"
    STEADY = "steady"
    TILTED = "tilted"
    DOWN = "down"
    ON_FLOOR = "on the floor"
    WEIGHT_HANGS = "the whole weight hangs"
    BLOCKED = "blocked"
    CARRIED = "carried or pressed, by feel"
    KNOCKED = "knocked aside"
    SATURATED = "saturated"
    UNSURE = "unsure"
    TARGET_BELOW = "target below"
    BATTERY_LOW = "battery low"
    OTHERWISE = "moves otherwise than its positions"


class MotorStop(Enum):
    """How the motors are stopped when a row aborts the flight."""

    NONE = "none"  # they are left alone
    PLAIN = "plain"  # stopped, where the supervisor has ended the flight already
    EMERGENCY = "emergency"  # cut and locked


class Operator(IntEnum):
    """The operator's command; it only rises (Ctrl-C once, twice)."""

    NONE = 0
    LAND = 1
    STOP = 2


@dataclass(frozen=True, eq=False)
class Observation:
    """All that is known in one tick. Times on the loop's clock; ages in seconds.

    Attributes:
        telemetry: the newest sample; its age is `t_s - telemetry.t_s`.
        target: the pipeline's estimate at `t_s`, None when no target was seen yet.
        new_frame: a good frame was processed in this tick.
        camera_age_s: since the last good frame arrived.
        camera_problem, link_problem: None, or one sentence.
        jumped: the state estimate moved farther than any flight could.
        turned_rad: the estimated heading's step beyond what a vehicle can turn.
        loop_late_s: how late this tick began.
        disagreeing_frames: frames in a row in which the markers contradicted.
        log_problem: the flight log cannot be written.
        delay_s: taken off the frames' times beyond the profile's latency (`measured`).
        target_refused: why the last target that was seen is another vehicle's; None: none was.
        position_age_s: of the newest position from outside that was sent to the vehicle; 0 where
            its decks measure it.
        position_problem: why none is sent, None while they are.
        imu: the motion that accelerometer and attitude tell, by all samples up to `telemetry`.
        felt: the motion sideways that pictures and accelerometer last agreed on.
        mismatch: what the pictures show otherwise than `imu` feels it; None while they agree.
    """

    t_s: float
    telemetry: Telemetry
    target: TargetEstimate | None = None
    new_frame: bool = False
    camera_age_s: float = 0.0
    camera_problem: str | None = None
    link_problem: str | None = None
    battery_age_s: float = 0.0
    jumped: bool = False
    turned_rad: float = 0.0
    loop_late_s: float = 0.0
    disagreeing_frames: int = 0
    operator: Operator = Operator.NONE
    log_problem: str | None = None
    delay_s: float = 0.0
    target_refused: str | None = None
    position_age_s: float = 0.0
    position_problem: str | None = None
    imu: ImuMotion = field(default_factory=ImuMotion)
    felt: VisualInertialMotion | None = None
    mismatch: Mismatch | None = None


@dataclass(frozen=True)
class BatteryOutlook:
    """What the battery is enough for, by the energy model.

    Attributes:
        left_s: hovering, until `battery-low` would land it; None where that is not known.
        attempts: for so many more there is enough, with the landing after the last; None before
            a target was seen, too.
        used_mah: by the count of the thrust.
        rest_v: what it would have at rest; None where that is not known.
    """

    left_s: float | None = None
    attempts: int | None = None
    used_mah: float = 0.0
    rest_v: float | None = None


@dataclass(frozen=True, eq=False)
class PlannerState:
    """The planner's whole memory; `since` holds the time at which each named
    condition became true and has been so without a break."""

    phase: Phase = Phase.APPROACH
    entered_s: float = 0.0
    started_s: float = 0.0
    t_s: float = 0.0
    reason: str = "start"
    row: str = ""
    severity: Severity = Severity.CONTINUE
    motor_stop: MotorStop = MotorStop.NONE
    outcome: Outcome | None = None
    since: dict[Condition, float] = field(default_factory=dict)
    attempts: int = 0
    searches: int = 0
    search_step_s: float = 0.0
    confirmed: int = 0
    target_m: Array | None = None  # in the world, at the last frame that measured it
    target_spread_m: float = 0.0  # by which successive frames' targets differ
    mount: MountWatch = field(default_factory=MountWatch)  # does the target stand still
    ground_m: tuple[float, float, float] | None = None
    entry_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entry_yaw_rad: float = 0.0
    setpoint: PositionSetpoint | None = None
    integral_m: tuple[float, float] = (0.0, 0.0)
    hover_thrust: float = 0.0
    contact_z_m: float | None = None  # height of the body while it is held by the magnet
    released_s: float | None = None  # begin of the release by raw thrust
    caught: bool = True  # False after a slip, until the fall is stopped
    catch_above_m: float = 0.0  # how far above it the setpoint is that stops the fall
    pressed: bool = False  # the way down begins with full thrust against something
    blocked_z_m: float | None = None  # something solid is above
    ordered_s: float | None = None  # last order of a landing or motor stop
    orders: int = 0
    stopped_s: float | None = None  # first order to stop the motors
    jump_s: float | None = None
    astray: bool = False  # positions from outside lead elsewhere: they prove nothing any more
    stale_s: float | None = None  # when there was no position from outside last
    last: Telemetry | None = None  # of the turn before
    energy: EnergyState = field(default_factory=EnergyState)  # fitted to the battery
    battery: BatteryOutlook = field(default_factory=BatteryOutlook)  # what that is enough for
    reckoning: Reckoning = field(default_factory=Reckoning)  # speed and place by the accelerometer
    reach_s: float | None = None  # within the magnet's reach since
    contact_aside_m: float | None = None  # gear to the target's axis, as it made contact
    contact_sigma_m: float = 0.0  # standard deviation of that
    heading_lost: bool = False  # position control would lead away from its setpoint
    blind_s: float | None = None  # accelerometer and attitude are all there is, since
    blind_height_m: float = 0.0  # above the ground, as reckoned since then
    level_hover: float = 0.0  # hover thrust as the way down began
    level_within: float = 0.12  # the share of it that a level way down may correct
    level_thrust: float = 0.0  # raw thrust of a level way down
    level_sample_s: float = -math.inf  # of the newest sample at its last tick
    under_way_mps: float = 0.0  # climb that its last orders give, and no sample shows yet
    touch_s: float | None = None  # a level way down felt the floor
    raw_order: int | None = None  # raw thrust that was ordered last, None in position mode
    unanswered_s: float | None = None  # the thrust that is read is not what is ordered, since
    unread_s: float = -math.inf  # when that last had lasted too long
    hold: str = ""  # why the vehicle is held in place, empty when it is not
