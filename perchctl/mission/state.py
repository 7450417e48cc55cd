"""What the planner remembers from tick to tick: its belief, and what it has decided."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver, Sent
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Claim, Outcome, Phase, Severity
from perchctl.profile import Profile
from perchctl.vehicle import EmergencyStop, PositionSetpoint, StopMotors


@dataclass(frozen=True)
class BatteryOutlook:
    """How long, and for how many attempts, the battery lasts by the energy model; None: unknown."""

    left_s: float | None = None  # of hovering, until `battery-low` would land it
    attempts: int | None = None  # with the landing after the last; None before a target
    used_mah: float = 0.0  # by the count of the thrust
    rest_v: float | None = None  # what it would have at rest


@dataclass(frozen=True)
class LevelDescent:
    """What a descent by raw thrust remembers; thrusts are 0..65535, and 0 before it has begun."""

    thrust: float = 0.0  # ordered last
    sample_s: float = -math.inf  # of the newest sample at its last tick
    under_way_mps: float = 0.0  # climb that its last orders give, and no sample shows yet
    floor_felt_s: float | None = None  # it felt the floor


@dataclass(frozen=True, kw_only=True)
class PhaseEntry:
    """How the present phase was entered."""

    t_s: float = 0.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the vehicle, as estimated
    yaw_rad: float = 0.0
    row: str = ""  # name of the transition, for logs and displays
    reason: str = "start"
    claims: Claim = Claim.NONE  # what the transition claims
    stop: EmergencyStop | StopMotors | None = None  # what it sends at once


@dataclass(frozen=True, eq=False)
class PlannerState:
    """The planner's whole memory. Times are on the loop's clock."""

    belief: Belief
    phase: Phase = Phase.APPROACH
    entry: PhaseEntry = PhaseEntry()  #: when, where and why the phase began
    started_s: float = 0.0  #: begin of the flight
    t_s: float = 0.0  #: of the last decision
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    since: dict[Condition[Any], float] = field(default_factory=dict)
    """The phases' own conditions that hold, and from when."""
    attempts: int = 0  #: that have failed
    confirmed: int = 0  #: frames in a row that measured the target, in this phase
    searched_places: int = 0
    search_step_s: float = 0.0
    setpoint: PositionSetpoint | None = None
    integral_m: tuple[float, float] = (0.0, 0.0)
    pressed: bool = False  #: the way down begins with full thrust against something
    catch_above_m: float | None = None
    """After a slip, until the fall is stopped: how far above the vehicle the setpoint is."""
    blocked_z_m: float | None = None  #: something solid is above
    released_s: float | None = None  #: begin of the release by raw thrust
    stopped_s: float | None = None  #: first order to stop the motors
    ordered_s: float | None = None  #: last order of a landing or motor stop
    orders: int = 0
    raw_order: int | None = None  #: raw thrust that was ordered last; None in position mode
    descent: LevelDescent = LevelDescent()
    hold: str = ""  #: why the vehicle is held in place, empty when it is not
    waits: str = ""  #: why your own row keeps it in its phase, empty when none does
    waited_s: float = 0.0  #: in this phase
    battery: BatteryOutlook = BatteryOutlook()

    @property
    def row(self) -> str:
        """Name of the transition into the phase, for logs and displays."""
        return self.entry.row

    @property
    def reason(self) -> str:
        """Why the phase was entered, in words."""
        return self.entry.reason

    @property
    def pause(self) -> str:
        """Why the mission does not go on, by a hold or by your own row; else empty."""
        return self.hold or self.waits

    @property
    def is_motor_borne(self) -> bool:
        """True until the release by raw thrust begins or the motors are stopped."""
        return self.released_s is None and self.stopped_s is None

    def sent(self, maneuver: Maneuver) -> Sent:
        """What the belief has to know of the orders until now."""
        return Sent(
            maneuver=maneuver,
            began_m=self.entry.position_m,
            setpoint=self.setpoint,
            raw_thrust=self.raw_order,
            released_s=self.released_s,
            stopped_s=self.stopped_s,
            floor_felt_s=self.descent.floor_felt_s,
        )

    @classmethod
    def on_ground(cls, obs: Observation, profile: Profile) -> PlannerState:
        """The memory before the first decision, of a vehicle that stands where it will take off."""
        tel, t_s = obs.telemetry, obs.t_s
        return cls(
            belief=Belief.on_ground(obs, profile),
            entry=PhaseEntry(t_s=t_s, position_m=tel.position_m, yaw_rad=tel.yaw_rad),
            started_s=t_s,
            t_s=t_s,
            search_step_s=t_s,
        )
