"""The planner's values: what it observes each tick and what it remembers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, IntEnum

from perchctl.geometry import Array
from perchctl.mission.imu import DeadReckoning, ImuMotion
from perchctl.mission.mounting import MountingMonitor
from perchctl.vehicle import EmergencyStop, PositionSetpoint, StopMotors, Telemetry
from perchctl.vision import TargetEstimate


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


SEVEN_PHASES = tuple(Phase)[:7]
FLYING_PHASES = frozenset({*SEVEN_PHASES, Phase.RECOVER})
BEFORE_CONTACT = FLYING_PHASES - {Phase.COMPLETE}
BY_CAMERA = frozenset({Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER})
IN_THE_OPEN = BY_CAMERA | {Phase.APPROACH}
TERMINALS = frozenset({Phase.PERCHED, Phase.LANDED, Phase.ABORTED})


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


class Condition(Enum):
    """The conditions that the table debounces; `perchctl.mission.conditions` evaluates them."""

    __hash__ = object.__hash__  # by identity: twenty are looked up in each tick

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


@dataclass(frozen=True)
class ContactError:
    """Gear's distance from the target's axis at proven contact; its sigma, infinite if unknown."""

    aside_m: float
    sigma_m: float

    def is_within(self, radius_m: float) -> bool:
        """True if the gear was surely within `radius_m` of the axis."""
        return self.aside_m + self.sigma_m <= radius_m

    @property
    def text(self) -> str:
        """The error in words, as in ``1.8 +- 0.6 mm off centre``."""
        if not math.isfinite(self.sigma_m):
            return "at an unknown distance from the centre"
        return f"{1e3 * self.aside_m:.1f} +- {1e3 * self.sigma_m:.1f} mm off centre"


class Operator(IntEnum):
    """The operator's command, which only rises: `LAND`, and `STOP`, which cuts the motors."""

    NONE = 0
    LAND = 1
    STOP = 2


@dataclass(frozen=True)
class Mismatch:
    """What explains that the target seems to move: pictures `later_s` later than assumed, or a
    camera turned by `turn_rad` about the vehicle's upward axis; the other is 0."""

    later_s: float = 0.0
    turn_rad: float = 0.0


@dataclass(frozen=True)
class VisualInertialMotion:
    """The vehicle's motion at `t_s` by pictures and accelerometer; pairs are world x and y."""

    t_s: float
    velocity_mps: tuple[float, float]  # sideways
    bias_mps2: tuple[float, float]  # excess of accelerometer and attitude
    climb_mps: float | None  # None if the delay that it rests on may be over


@dataclass(frozen=True, eq=False)
class Observation:
    """The planner's input in one tick. Times are on the loop's clock; ages are in seconds."""

    t_s: float
    telemetry: Telemetry  #: the newest sample; its age is `t_s - telemetry.t_s`
    target: TargetEstimate | None = None  #: the pipeline's, at `t_s`; None before the first
    new_frame: bool = False  #: a good frame was processed in this tick
    camera_age_s: float = 0.0  #: since the last good frame arrived
    camera_problem: str | None = None  #: None, or one sentence
    link_problem: str | None = None  #: None, or one sentence
    battery_age_s: float = 0.0
    jumped: bool = False  #: the state estimate moved farther than any flight could
    turned_rad: float = 0.0  #: step of the estimated heading beyond what a vehicle can turn
    loop_late_s: float = 0.0  #: how late this tick began
    disagreeing_frames: int = 0  #: in a row, in which the markers contradicted each other
    operator: Operator = Operator.NONE
    log_problem: str | None = None  #: the flight log cannot be written
    delay_s: float = 0.0  #: off the frames' times beyond the profile's latency (`measured`)
    delay_sigma_s: float = 0.0  #: standard deviation of the latency (`measured`); 0 if it is given
    target_refused: str | None = None  #: why the last target seen is another vehicle's
    position_age_s: float = 0.0  #: of the newest external position sent; 0 where decks measure
    position_problem: str | None = None  #: why none is sent; None while they are
    imu: ImuMotion = field(default_factory=ImuMotion)  #: by all samples up to `telemetry`
    felt: VisualInertialMotion | None = None  #: sideways, as pictures and accelerometer agreed
    mismatch: Mismatch | None = None  #: between the pictures and `imu`; None while they agree


@dataclass(frozen=True)
class EnergyState:
    """The battery as fitted so far.

    Shares are of the full charge, loads of full thrust. `fit_sums`, of least squares: sag^2, sag *
    hunger, hunger^2, and the two right sides.
    """

    ground_v: float | None = None  # at rest; from the first reading where that was under load
    used_share: float = 0.0  # by the count of the thrust, for a battery as assumed
    load: float = 0.0  # as the reading follows it
    mean_load: float = 0.0  # over the last seconds in the air
    rest_v: float | None = None  # estimated resting voltage now
    loaded_s: float = 0.0  # how long there were readings under load
    unknown_s: float = 0.0  # since the last reading
    fit_sums: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BatteryOutlook:
    """How long, and for how many attempts, the battery lasts by the energy model; None: unknown."""

    left_s: float | None = None  # of hovering, until `battery-low` would land it
    attempts: int | None = None  # with the landing after the last; None before a target
    used_mah: float = 0.0  # by the count of the thrust
    rest_v: float | None = None  # what it would have at rest


@dataclass(frozen=True, eq=False)
class PlannerState:
    """The planner's whole memory; `since`: from when each named condition held without a break."""

    phase: Phase = Phase.APPROACH
    entered_s: float = 0.0  #: begin of the phase
    started_s: float = 0.0  #: begin of the flight
    t_s: float = 0.0
    reason: str = "start"
    row: str = ""
    severity: Severity = Severity.CONTINUE
    stop: EmergencyStop | StopMotors | None = None  # what aborts the flight sends it
    outcome: Outcome | None = None
    since: dict[Condition, float] = field(default_factory=dict)
    attempts: int = 0  #: that have failed
    searches: int = 0
    search_step_s: float = 0.0
    confirmed: int = 0
    target_m: Array | None = None  # in the world, at the last frame that measured it
    target_spread_m: float = 0.0  # by which successive frames' targets differ
    mount: MountingMonitor = field(default_factory=MountingMonitor)
    ground_m: tuple[float, float, float] | None = None
    entry_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entry_yaw_rad: float = 0.0
    setpoint: PositionSetpoint | None = None
    integral_m: tuple[float, float] = (0.0, 0.0)
    hover_thrust: float = 0.0
    contact_z_m: float | None = None  # height of the body while it is held by the magnet
    released_s: float | None = None  # begin of the release by raw thrust
    caught: bool = True  # False after a slip, until the fall is stopped
    catch_goal_above_m: float = 0.0  # how far above it the setpoint is that stops the fall
    pressed: bool = False  # the way down begins with full thrust against something
    blocked_z_m: float | None = None  # something solid is above
    ordered_s: float | None = None  # last order of a landing or motor stop
    orders: int = 0
    stopped_s: float | None = None  # first order to stop the motors
    jump_s: float | None = None
    astray: bool = False  # positions from outside lead elsewhere: they prove nothing any more
    stale_s: float | None = None  # when there was no position from outside last
    last: Telemetry | None = None  # the newest sample that was decided on
    energy: EnergyState = field(default_factory=EnergyState)  # fitted to the battery
    battery: BatteryOutlook = field(default_factory=BatteryOutlook)
    reckoning: DeadReckoning = field(default_factory=DeadReckoning)
    reach_s: float | None = None  # within the magnet's reach since
    contact: ContactError | None = None  # as it made contact
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
    waits: str = ""  # why your own row keeps it in its phase, empty when none does
    waited_s: float = 0.0  # in this phase

    @property
    def pause(self) -> str:
        """Why the mission does not go on, by a hold or by your own row; else empty."""
        return self.hold or self.waits

    @property
    def ground_z_m(self) -> float:
        """Height of the ground that the flight started from; 0 if it is unknown."""
        return self.ground_m[2] if self.ground_m else 0.0

    @classmethod
    def on_ground(cls, obs: Observation) -> PlannerState:
        tel, t_s = obs.telemetry, obs.t_s
        return cls(
            entered_s=t_s,
            started_s=t_s,
            t_s=t_s,
            search_step_s=t_s,
            ground_m=tel.position_m,
            entry_m=tel.position_m,
            entry_yaw_rad=tel.yaw_rad,
        )
