"""The three final phases: PERCHED, LANDED, and ABORTED with its motor stop."""

from __future__ import annotations

from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.descent import has_descent_command_reached_minimum
from perchctl.mission.phase import Phase
from perchctl.mission.release import has_thrust_ramped_down
from perchctl.mission.setpoints import Action
from perchctl.values import replace
from perchctl.vehicle import Idle, StopMotors


def stay_idle(c: Context) -> Action:
    """Return the unchanged state and `Idle`: no command is sent."""
    return c.state, Idle()


def act_in_aborted(c: Context) -> Action:
    """Return the state and the command of one tick in ABORTED. In the first tick, the command is
    the stop command of the transition into ABORTED. If that has none, the command is `StopMotors`
    if the raw thrust has been ramped down or the descent has reached its end; without this command,
    the firmware would lock the vehicle when its setpoints end. In all other cases and in all later
    ticks, it is `Idle`: nothing is sent."""
    if c.state.stop_or_land_command_count:
        return c.state, Idle()
    ends = (
        StopMotors()
        if has_thrust_ramped_down(c) or has_descent_command_reached_minimum(c)
        else Idle()
    )
    return replace(
        c.state, stop_or_land_command_count=1, last_stop_or_land_command_at_s=c.t_s
    ), c.state.entry.stop_command or ends


PERCHED = PhaseDefinition(phase=Phase.PERCHED, maneuver=Maneuver(), act=stay_idle)
LANDED = PhaseDefinition(phase=Phase.LANDED, maneuver=Maneuver(), act=stay_idle)
ABORTED = PhaseDefinition(phase=Phase.ABORTED, maneuver=Maneuver(), act=act_in_aborted)
