"""What the planner observes in one tick."""

from __future__ import annotations

from dataclasses import dataclass, field

from perchctl.mission.belief.motion import ImuMotion
from perchctl.mission.phase import Operator
from perchctl.vehicle import Telemetry
from perchctl.vision import TargetEstimate


@dataclass(frozen=True)
class Mismatch:
    """An error of latency or mounting that explains why the target seems to move: pictures that are
    `later_s` later than assumed, or a camera turned by `turn_rad` about the vehicle's upward axis;
    the other is 0."""

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
    position_beside_m: float = 0.0  #: from the estimate to the newest sight; 0 if that was believed
    imu: ImuMotion = field(default_factory=ImuMotion)  #: by all samples up to `telemetry`
    felt: VisualInertialMotion | None = None  #: sideways, as pictures and accelerometer agreed
    mismatch: Mismatch | None = None  #: between the pictures and `imu`; None while they agree
