"""The supervisor, which decides 25 times a second if the motors may spin.

States, conditions and times are those of docs/firmware.md, "Supervisor", "When setpoints
stop" and "Contact, tumble, crash".
"""

from __future__ import annotations

from enum import Enum, auto

from perchctl.vehicle import (
    ARMED,
    AUTO_ARM,
    CAN_ARM,
    CAN_FLY,
    CRASHED,
    FLYING,
    HL_ACTIVE,
    HL_FINISHED,
    LOCKED,
    TUMBLED,
)

EVERY = 20  # control periods between two updates
FLYING_MEMORY_S = 2.0
SILENCE_LEVEL_S = 0.5
SILENCE_CUT_S = 2.0
WATCHDOG_S = 1.0
PREFLIGHT_S = 30.0
SPIN_UP_S = 2.0
LANDED_S = 3.0
TILT_ACC_G, TILT_S = 0.5, 1.0
UPSIDE_DOWN_ACC_G, UPSIDE_DOWN_S = -0.2, 0.1
SUPERVISOR_FREE_FALL_G = 0.1
_TICK_S = 1e-6  # ages are compared on a 2 ms grid


class State(Enum):
    NOT_INITIALIZED = auto()
    CHECKS_NOT_PASSED = auto()
    CHECKS_PASSED = auto()
    ARMING = auto()
    READY = auto()
    FLYING = auto()
    LANDED = auto()
    RESET = auto()
    LEVEL_OUT = auto()
    FREE_FALL = auto()
    LOCKED = auto()
    CRASHED = auto()


CAN_FLY_STATES = frozenset({State.READY, State.FLYING, State.LEVEL_OUT, State.LANDED})
MOTORS_ALLOWED = CAN_FLY_STATES | {State.ARMING}
_IN_FLIGHT = frozenset({State.FLYING, State.LEVEL_OUT})


class Supervisor:
    """The firmware's supervisor. `update` runs at 25 Hz; the other methods only record events.

    `arms_itself` and `spin_up_s` are as in `perchctl.sim.airframe.Airframe`.
    """

    def __init__(self, *, arms_itself: bool = True, spin_up_s: float = 0.0) -> None:
        self._arms_itself, self._spin_up_s = arms_itself, spin_up_s
        self.state = State.NOT_INITIALIZED
        self.armed = False
        self.crashed = False
        self.tumbled = False
        self.emergency = False
        self.motors_allowed = False
        self._watchdog_s: float | None = None
        self._thrust_s: float | None = None
        self._entered_s = 0.0
        self._tumble_s: float | None = None

    def request_arming(self, do_arm: bool) -> tuple[bool, bool]:
        """Arm or disarm; return (success, armed)."""
        allowed = not do_arm or self.armed or self.state is State.CHECKS_PASSED
        if allowed:
            self.armed = do_arm
        return allowed, self.armed

    def request_recovery(self) -> tuple[bool, bool]:
        """Recover from a crash; return (success, recovered). A tumbled vehicle cannot recover."""
        self.crashed = self.crashed and self.tumbled
        return not self.crashed, not self.crashed

    def notify_watchdog(self, t_s: float) -> None:
        self._watchdog_s = t_s

    def update(
        self,
        t_s: float,
        *,
        motors_running: bool,
        setpoint_age_s: float,
        acc_g: tuple[float, float, float],
    ) -> bool:
        """Update the state; True if a crash or a disarm ended a flight."""
        if motors_running:
            self._thrust_s = t_s
        flying = self._thrust_s is not None and t_s - self._thrust_s < FLYING_MEMORY_S - _TICK_S
        self.tumbled = self._check_tumbled(t_s, acc_g)
        emergency = self.emergency or (
            self._watchdog_s is not None and t_s - self._watchdog_s >= WATCHDOG_S
        )
        before = self.state
        self.state = self._next(t_s, flying, emergency, setpoint_age_s)
        if self.state is not before:
            self._entered(t_s)
        self.motors_allowed = self.state in MOTORS_ALLOWED
        return before in _IN_FLIGHT and self.state in (State.CRASHED, State.RESET)

    def info(self, *, hl_active: bool, hl_finished: bool) -> int:
        """The `supervisor.info` bits; `hl_` is the high-level planner."""
        bits = {
            CAN_ARM: self.state is State.CHECKS_PASSED,
            ARMED: self.armed,
            AUTO_ARM: self._arms_itself,
            CAN_FLY: self.state in CAN_FLY_STATES,
            FLYING: self.is_flying,
            TUMBLED: self.tumbled,
            LOCKED: self.state is State.LOCKED,
            CRASHED: self.crashed,
            HL_ACTIVE: hl_active,
            HL_FINISHED: hl_finished,
        }
        return sum(bit for bit, is_set in bits.items() if is_set)

    @property
    def is_flying(self) -> bool:
        return self.state in _IN_FLIGHT

    def _next(self, t_s: float, flying: bool, emergency: bool, age_s: float) -> State:
        match self.state:
            case State.NOT_INITIALIZED | State.RESET:
                return State.CHECKS_NOT_PASSED
            case State.FREE_FALL | State.LOCKED:
                return State.LOCKED
            case State.CRASHED if not self.crashed and not self.tumbled:
                return State.CHECKS_NOT_PASSED
            case _ if emergency:
                return State.FREE_FALL
            case State.CHECKS_NOT_PASSED if not self.tumbled:
                return State.CHECKS_PASSED
            case State.CHECKS_PASSED | State.READY if self.tumbled:
                return State.CHECKS_NOT_PASSED
            case State.CHECKS_PASSED if self.armed:
                return State.READY if self._arms_itself else State.ARMING
            case State.ARMING if self.tumbled or not self.armed:
                return State.CHECKS_NOT_PASSED
            case State.ARMING if t_s - self._entered_s >= self._spin_up_s - _TICK_S:
                return State.READY
            case State.ARMING if t_s - self._entered_s > SPIN_UP_S:
                return State.CHECKS_NOT_PASSED
            case State.READY if flying and self.armed:
                return State.FLYING
            case State.READY if not self.armed or t_s - self._entered_s > PREFLIGHT_S:
                return State.RESET
            case State.FLYING | State.LEVEL_OUT if age_s > SILENCE_CUT_S + _TICK_S:
                return State.FREE_FALL
            case State.FLYING | State.LEVEL_OUT if self.tumbled:
                return State.CRASHED
            case State.FLYING | State.LEVEL_OUT if not self.armed:
                return State.RESET
            case State.FLYING | State.LEVEL_OUT if age_s > SILENCE_LEVEL_S + _TICK_S:
                return State.LEVEL_OUT
            # When levelling out ends, the state returns to FLYING, so `flying` cannot clear while
            # setpoints are missing: silence after a single stop ends with a locked vehicle.
            case State.LEVEL_OUT:
                return State.FLYING
            case State.FLYING if not flying:
                return State.LANDED
            case State.LANDED if not self.armed or t_s - self._entered_s > LANDED_S:
                return State.RESET
            case State.LANDED if flying:
                return State.FLYING
            case unchanged:
                return unchanged

    def _entered(self, t_s: float) -> None:
        self._entered_s = t_s
        if self.state is State.CRASHED:
            self.crashed = True
        if self.state not in MOTORS_ALLOWED:
            self.armed = self._arms_itself and self.state is State.CHECKS_PASSED

    def _check_tumbled(self, t_s: float, acc_g: tuple[float, float, float]) -> bool:
        if max(abs(a) for a in acc_g) < SUPERVISOR_FREE_FALL_G:
            self._tumble_s = None
        if acc_g[2] >= TILT_ACC_G:
            self._tumble_s = None
            return False
        if self._tumble_s is None:
            self._tumble_s = t_s
        since_s = t_s - self._tumble_s
        if acc_g[2] < UPSIDE_DOWN_ACC_G and since_s > UPSIDE_DOWN_S:
            return True
        return since_s > TILT_S
