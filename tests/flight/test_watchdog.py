"""The watchdog: what is sent while the flight loop is silent. No thread, no clock."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest

from perchctl.flight.watchdog import CUT_PERIOD_S, MAX_CUTS, REPEAT_AFTER_S, Watchdog
from perchctl.mission import Observation, OperatorRequest, Phase, PlannerState
from perchctl.mission.belief.update import COMMANDED_KEEPALIVE_RAW_THRUST
from perchctl.mission.descent import (
    LANDING_COMMAND_PERIOD_S,
    MAX_LANDING_COMMAND_COUNT,
    MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY,
)
from perchctl.mission.release import (
    FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M,
    MOTOR_STOP_COMMAND_COUNT,
)
from perchctl.profile import Profile
from perchctl.vehicle import (
    ARMED,
    CAN_FLY,
    FLYING,
    HL_ACTIVE,
    LOCKED,
    Arm,
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
)
from tests.helpers.mission import AIRBORNE, HOVER_THRUST, READY, remembering, state_with, telemetry

PROFILE = Profile()
LAND_S = PROFILE.safety.loop_late_land_s
PERIOD_S = 0.02
T_S = 100.0
HOVER = PositionSetpoint(0.1, 0.2, 0.9, 0.5)
RELEASED = RawThrust(COMMANDED_KEEPALIVE_RAW_THRUST)
CEILING_M = 2.0
AT_CEILING = state_with(
    phase=Phase.COMPLETE,
    t_s=T_S,
    takeoff_position_m=(0.0, 0.0, 0.0),
    vehicle_world_z_at_last_contact_m=CEILING_M,
    weight_transfer_began_at_s=T_S - 1.0,
    hover_thrust=HOVER_THRUST,
)
IN_AIR = state_with(
    phase=Phase.ALIGN, t_s=T_S, takeoff_position_m=(0.0, 0.0, 0.0), hover_thrust=HOVER_THRUST
)
SILENT_S = (0.31, 0.5, 0.9)


class Rig:
    """A watchdog whose loop has done one turn at `T_S`."""

    def __init__(
        self, command: Command = HOVER, state: PlannerState = IN_AIR, z_m: float = 1.0
    ) -> None:
        self.operator = OperatorRequest.NONE
        self.dog = Watchdog(PROFILE, lambda: self.operator)
        self.z_m = z_m
        self.turn(T_S, command, state)

    def turn(self, t_s: float, command: Command = HOVER, state: PlannerState = IN_AIR) -> None:
        obs = Observation(t_s, telemetry(t_s, self.z_m))
        self.dog.tick(
            t_s + PERIOD_S, remembering(state, last_telemetry=obs.telemetry), command, obs
        )

    def after(self, silent_s: float, **changes: object) -> Command | None:
        """What is sent so long after the turn; telemetry 20 ms old, altered."""
        newest = telemetry(T_S + silent_s - 0.02, self.z_m)
        return self.poll(silent_s, replace(newest, **changes))  # type: ignore[arg-type]

    def poll(self, silent_s: float, newest: Telemetry | None) -> Command | None:
        return self.dog.poll(T_S + silent_s, newest)


# --- a loop that lives ----------------------------------------------------------------------


@pytest.mark.parametrize("silent_s", [0.0, 0.02, 0.1, 0.29])
def test_a_loop_that_lives_or_has_not_begun_is_left_alone(silent_s: float) -> None:
    assert Rig().after(silent_s) is None
    assert Watchdog(PROFILE, lambda: OperatorRequest.NONE).poll(1e6, telemetry(1e6)) is None


ARMED_BITS = ARMED | CAN_FLY


@pytest.mark.parametrize(("word", "bits", "sent"), [
    (OperatorRequest.CUT_MOTORS, ARMED_BITS, EmergencyStop()),
    (OperatorRequest.CUT_MOTORS, AIRBORNE, EmergencyStop()),  # the first command may have gone out
    (OperatorRequest.LAND, ARMED_BITS, Arm(False)),
    (OperatorRequest.LAND, ARMED_BITS | FLYING, None),  # in the air disarming would drop it
    (OperatorRequest.LAND, READY, None),
    (OperatorRequest.NONE, ARMED_BITS, None),
])  # fmt: skip
@pytest.mark.parametrize("has_failed", [False, True])
def test_the_operators_word_counts_before_the_first_tick(
    word: OperatorRequest, bits: int, sent: Command | None, has_failed: bool
) -> None:
    dog = Watchdog(PROFILE, lambda: word)
    if has_failed:
        dog.note_rescue()
    assert dog.poll(T_S, telemetry(T_S, 0.0, supervisor=bits)) == sent


def test_a_cut_before_the_first_tick_is_repeated_until_it_shows() -> None:
    dog = Watchdog(PROFILE, lambda: OperatorRequest.CUT_MOTORS)
    times_s = [T_S + CUT_PERIOD_S * k for k in range(4)]
    bits = [ARMED_BITS, ARMED_BITS, ARMED_BITS, LOCKED]
    sent = [
        dog.poll(t_s, telemetry(t_s, 0.0, supervisor=each, thrust=0.0))
        for t_s, each in zip(times_s, bits, strict=True)
    ]
    assert sent == [EmergencyStop()] * 3 + [None]


# --- 0.3 s: the last safe setpoint ------------------------------------------------------------

HIGH = replace(HOVER, z_m=1.8)
HELD = replace(HOVER, z_m=1.0)
"""At the vehicle's height: neither a climb nor a press goes on."""
PRESSING = remembering(
    AT_CEILING,
    phase=Phase.PERCH,
    vehicle_world_z_at_last_contact_m=None,
    weight_transfer_began_at_s=None,
)
FALLS = {"velocity_mps": (0.0, 0.0, -0.8), "thrust": 1000.0, "acc_z_g": 0.1}


@pytest.mark.parametrize("silent_s", SILENT_S)
@pytest.mark.parametrize(("command", "state", "z_m", "changes", "held"), [
    (HOVER, IN_AIR, 1.0, {}, HOVER),
    (HIGH, IN_AIR, 1.0, {}, HELD),
    # A catch that the loop has begun goes on braking.
    (replace(HOVER, z_m=2.0), IN_AIR, 1.0, {"velocity_mps": (0.0, 0.0, -0.5)},
     replace(HOVER, z_m=2.0)),
    # What hangs still in the release keeps its raw thrust, by its acceleration, too, where the
    # position's packets come no more.
    (RELEASED, AT_CEILING, CEILING_M, {"thrust": 1000.0}, RELEASED),
    (RELEASED, AT_CEILING, CEILING_M, {"thrust": 1000.0, "behind_s": 0.5}, RELEASED),
    # A raw press goes on in contact, and becomes a hold in the air.
    (RawThrust(60000), PRESSING, CEILING_M, {}, RawThrust(60000)),
    (RawThrust(60000), PRESSING, 1.9, {"velocity_mps": (0.0, 0.0, 0.2)},
     PositionSetpoint(0.0, 0.0, 1.9, 0.0)),
])  # fmt: skip
def test_the_last_safe_setpoint_is_held_until_the_landing(
    silent_s: float, command: Command, state: PlannerState, z_m: float,
    changes: dict[str, object], held: Command,
) -> None:  # fmt: skip
    assert Rig(command, state, z_m).after(silent_s, **changes) == held


def test_a_catch_that_the_watchdog_held_ends_with_the_sinking() -> None:
    catch = replace(HOVER, z_m=2.0)
    rig = Rig(catch, z_m=1.0)
    assert rig.after(0.31, velocity_mps=(0.0, 0.0, -0.5)) == catch
    rig.z_m = 0.8
    assert rig.after(0.5) == replace(HOVER, z_m=0.8)


@pytest.mark.parametrize("newest", [None, telemetry(T_S, 5.0)])
def test_without_telemetry_it_is_the_height_of_the_last_turn(newest: Telemetry | None) -> None:
    assert Rig(HIGH, z_m=1.0).poll(0.35, newest) == HELD


def test_a_slip_while_the_loop_is_silent_is_caught_then_landed() -> None:
    rig = Rig(RELEASED, AT_CEILING, CEILING_M)
    rig.z_m = CEILING_M - 0.05
    rig.after(0.33, **FALLS)
    caught = rig.after(0.35, **FALLS)
    assert caught == PositionSetpoint(
        0.0, 0.0, min(rig.z_m + FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M, 3.0), 0.0
    )
    rig.z_m = CEILING_M - 0.4
    for i in range(6):
        assert isinstance(rig.after(0.4 + 0.05 * i, **FALLS), PositionSetpoint)
    for i in range(60):
        command = rig.after(0.7 + 0.05 * i)
        if isinstance(command, Land):
            return
        assert isinstance(command, (PositionSetpoint, type(None)))
    raise AssertionError("it was never landed")


# --- 1.0 s: a landing ---------------------------------------------------------------------------


def test_a_silence_of_a_second_lands_and_repeats_until_it_shows() -> None:
    rig = Rig()
    late_s = LAND_S + PERIOD_S + 0.01
    order = rig.after(late_s)
    assert isinstance(order, Land)
    assert order.height_m < 0.0
    assert rig.dog.overruled_s > LAND_S
    assert rig.after(late_s + 0.05) is None
    active = READY | HL_ACTIVE  # also shown where the notify was lost, and nothing lands
    again_s = LANDING_COMMAND_PERIOD_S + 0.01
    for i in range(1, MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY):
        assert isinstance(rig.after(late_s + i * again_s, supervisor=active), Land)
    assert (
        rig.after(
            late_s + MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY * again_s,
            supervisor=active,
        )
        is None
    )


def test_a_landing_is_ordered_a_limited_number_of_times() -> None:
    rig = Rig()
    orders = [rig.poll(1.05 + 0.05 * i, None) for i in range(200)]
    assert sum(isinstance(c, Land) for c in orders) == MAX_LANDING_COMMAND_COUNT
    assert not [c for c in orders if c is not None and not isinstance(c, Land)]


def test_what_stands_with_its_motors_off_is_not_started_again() -> None:
    rig = Rig(z_m=0.0)
    assert rig.after(1.2, supervisor=READY, thrust=0.0) is None


def test_from_the_ceiling_it_peels_off_before_it_lands() -> None:
    """A landing that runs by its clock while the magnet holds ends with a fall."""
    rig = Rig(replace(HOVER, z_m=2.25), PRESSING, CEILING_M)
    for silent_s in (1.1, 1.15, 1.2):
        command = rig.after(silent_s)
        assert isinstance(command, PositionSetpoint)
        assert command.z_m <= CEILING_M
    rig.z_m = CEILING_M - 0.15
    assert any(isinstance(rig.after(1.3 + 0.02 * i), Land) for i in range(80))


@pytest.mark.parametrize("known", [True, False])
def test_what_hangs_released_is_not_landed(known: bool) -> None:
    rig = Rig(RELEASED, AT_CEILING, CEILING_M)
    rig.operator = OperatorRequest.LAND
    for i in range(200):
        silent_s = 1.1 + 0.05 * i
        command = rig.after(silent_s, thrust=1000.0) if known else rig.poll(silent_s, None)
        assert not isinstance(command, Land)


def test_a_landing_of_the_vehicles_own_is_left_alone() -> None:
    landing = remembering(
        IN_AIR,
        phase=Phase.LANDING,
        stop_or_land_command_count=MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY,
        last_stop_or_land_command_at_s=T_S,
    )
    rig = Rig(Idle(), landing)
    assert rig.after(0.5, supervisor=READY | HL_ACTIVE) is None
    assert rig.after(5.0, supervisor=READY | HL_ACTIVE) is None


def test_only_stops_after_the_motors_were_stopped_for_good() -> None:
    rig = Rig(StopMotors(), remembering(AT_CEILING, motor_stop_commanded_at_s=T_S), CEILING_M)
    sent = [rig.after(s, thrust=0.0) for s in (0.5, 1.1, 9.0)]
    assert all(command in (None, StopMotors()) for command in sent)


def test_a_loop_that_revives_is_believed_and_a_second_silence_begins_anew() -> None:
    rig = Rig(HIGH)
    assert rig.after(0.5) == HELD
    rig.turn(T_S + 0.6)
    assert rig.after(0.65) is None
    rig.z_m = 0.6
    assert rig.after(0.6 + REPEAT_AFTER_S + 0.01) == replace(HOVER, z_m=0.6)


# --- the operator ---------------------------------------------------------------------------------


def test_the_operator_lands_a_silent_loop_at_once() -> None:
    rig = Rig()
    rig.operator = OperatorRequest.LAND
    assert rig.after(0.2) is None  # the loop's own, if it lives
    assert isinstance(rig.after(0.31), Land)
    assert rig.dog.state is not None


def test_the_operators_stop_cuts_while_the_loop_is_silent() -> None:
    rig = Rig()
    rig.operator = OperatorRequest.CUT_MOTORS
    assert rig.after(0.02) is None  # the loop's own: its row records it
    assert rig.after(0.15) == EmergencyStop()


def test_what_does_not_peel_off_is_let_go_watched_and_stopped() -> None:
    """A loop that fell silent as it peeled off in vain, and hangs for ever, would else leave it
    there with turning motors. It stays where it is, and its thrust follows the orders."""
    below = PositionSetpoint(0.0, 0.0, CEILING_M - 0.25, 0.0)
    rig = Rig(below, remembering(AT_CEILING, weight_transfer_began_at_s=None), CEILING_M)
    sent: list[Command] = []
    thrust = 20000.0
    for i in range(395):
        command = rig.after(1.1 + 0.02 * i, thrust=thrust)
        thrust = float(getattr(command, "thrust", 0.0 if command == StopMotors() else thrust))
        sent += [command] if command is not None else []
    raw = [c.thrust for c in sent if isinstance(c, RawThrust)]
    assert raw == sorted(raw, reverse=True)
    assert raw[-1] == COMMANDED_KEEPALIVE_RAW_THRUST
    complete = PROFILE.planner.complete
    assert len(raw) * 0.02 == pytest.approx(complete.ramp_s + complete.hang_s, abs=0.2)
    assert sent[-MOTOR_STOP_COMMAND_COUNT:] == [StopMotors()] * MOTOR_STOP_COMMAND_COUNT
    assert rig.poll(9.5, None) in (None, StopMotors())  # no order spins its motors up again


# --- after the flight ---------------------------------------------------------------------------


@pytest.mark.parametrize("closing", ["rescue", "closing", "motors off"])
def test_after_the_loop_only_the_operators_stop_cuts_and_at_once(closing: str) -> None:
    """A perched vehicle is not locked by a late stop."""
    rig = Rig()
    if closing == "rescue":
        rig.dog.note_rescue()
    else:
        rig.dog.end(motors_off=closing == "motors off")
    assert [rig.after(s) for s in (0.01, 0.5, 1.1, 9.0)] == [None] * 4
    rig.operator = OperatorRequest.CUT_MOTORS
    assert rig.after(0.06) == (None if closing == "motors off" else EmergencyStop())


@pytest.mark.parametrize("by_planner", [True, False])
def test_an_emergency_stop_is_repeated_until_it_is_confirmed(by_planner: bool) -> None:
    rig = Rig(EmergencyStop() if by_planner else HOVER)
    rig.operator = OperatorRequest.CUT_MOTORS
    times = [0.2 + 0.05 * i for i in range(20)]
    cuts = [s for s in times if rig.after(s) == EmergencyStop()]
    assert len(cuts) == 10
    assert min(b - a for a, b in itertools.pairwise(cuts)) > CUT_PERIOD_S - 1e-6
    locked = {"supervisor": LOCKED, "thrust": 0.0}
    assert rig.after(1.5, supervisor=LOCKED) == EmergencyStop()  # its motors still run
    assert rig.poll(1.7, telemetry(T_S + 0.5, supervisor=LOCKED, thrust=0.0)) == EmergencyStop()
    assert [rig.after(2.0 + 0.05 * i, **locked) for i in range(20)] == [None] * 20


def test_an_emergency_stop_is_repeated_a_limited_number_of_times() -> None:
    rig = Rig()
    rig.operator = OperatorRequest.CUT_MOTORS
    cuts = [rig.poll(0.2 + 0.05 * i, None) for i in range(1000)]
    assert cuts.count(EmergencyStop()) == MAX_CUTS


# --- two threads ---------------------------------------------------------------------------------


class Noting(Watchdog):
    """Notes which fields are written."""

    def __init__(self, operator: Callable[[], OperatorRequest]) -> None:
        object.__setattr__(self, "written", set())
        super().__init__(PROFILE, operator)
        self.written.clear()

    def __setattr__(self, name: str, value: object) -> None:
        self.written.add(name)
        super().__setattr__(name, value)

    def take(self) -> set[str]:
        written, self.written = self.written, set()
        return written - {"written"}


def test_no_field_is_written_by_both_threads() -> None:
    """They share no lock: what both wrote, one of them could undo."""
    by_loop: set[str] = set()
    by_link: set[str] = set()
    for order, command in itertools.product(OperatorRequest, (HOVER, EmergencyStop())):
        rig = Rig()
        rig.operator = order
        rig.dog = dog = Noting(partial(getattr, rig, "operator"))
        rig.turn(T_S, command)
        by_loop |= dog.take()
        for silent_s in (0.02, 0.15, 0.5, 1.1, 1.3):
            rig.after(silent_s)
        by_link |= dog.take()
        dog.note_rescue()
        dog.end(motors_off=True)
        by_loop |= dog.take()
    assert {"_last", "_closing", "_motors_off"} < by_loop
    assert {"_held", "_way_down", "_cuts", "overruled_s"} < by_link
    assert not by_loop & by_link


# --- a position from outside that has stopped coming -------------------------------------


@pytest.mark.parametrize(("by", "age_s"), [("target", 0.05), ("mocap", 0.7)])
def test_without_positions_a_silent_loop_is_followed_by_a_level_descent(
    by: str, age_s: float
) -> None:
    """No sight comes without the loop, and its own landing would fly by none."""
    profile = Profile.model_validate({"positioning": by})
    dog = Watchdog(profile, lambda: OperatorRequest.NONE, lambda now_s: now_s - T_S + age_s)
    obs = Observation(T_S, telemetry(T_S, 1.0), external_position_age_s=age_s)
    dog.tick(T_S + PERIOD_S, remembering(IN_AIR, last_telemetry=obs.telemetry), HOVER, obs)
    for i in range(60):
        now_s = T_S + LAND_S + 0.1 + 0.05 * i
        command = dog.poll(now_s, telemetry(now_s - 0.02, 1.0, supervisor=AIRBORNE))
        assert isinstance(command, RawThrust)


def test_what_has_waited_for_the_loop_is_felt_too() -> None:
    """The blow of the floor lasts for a hundredth of a second, and it is asked every twentieth."""
    profile = Profile.model_validate({"positioning": "target"})
    felt = []
    for waits in (True, False):
        dog = Watchdog(profile, lambda: OperatorRequest.NONE)
        obs = Observation(T_S, telemetry(T_S, 0.1), external_position_age_s=0.05)
        low = remembering(IN_AIR, phase=Phase.LANDING, last_telemetry=obs.telemetry)
        dog.tick(T_S + PERIOD_S, low, RawThrust(HOVER_THRUST), obs)
        samples: list[Telemetry] = []
        for i in range(1, 121):
            t_s = T_S + 0.01 * i
            blow_g = 4.0 if 80 <= i < 82 else 1.0
            samples.append(telemetry(t_s, 0.1, acc_z_g=blow_g, supervisor=AIRBORNE))
            if i % 5 == 4:
                command = dog.poll(t_s + 0.01, samples[-1], samples if waits else ())
        assert isinstance(command, RawThrust)
        felt.append(command.thrust)
    assert felt[0] < 0.75 * felt[1]
