"""Your own planner row: perch only while a switch is on. Here the switch is a file.

In the profile: `planner: {rows: "own_row:ROWS"}`; `main` adds TOO_FAST. The functions get a
`perchctl.mission.Context`. A replay needs rows of the profile that depend on it alone.
"""

import math
import sys
from pathlib import Path

from perchctl import Phase, Severity, Transition, fly_lockstep, load_profile

SWITCH = Path("perch.on")
WAIT_S = 30.0
MOST_MPS = 0.5

ROWS = (
    # While the switch is off: it waits in ALIGN, under the target, and leaves ASCEND for ALIGN.
    Transition(
        name="switch-off",
        phases={Phase.ALIGN, Phase.ASCEND},
        when=lambda c: not SWITCH.exists(),
        to=Phase.ALIGN,
        reason="the switch is off",
        severity=Severity.HOLD,
    ),
    Transition(
        name="waited-long-enough",
        phases={Phase.ALIGN},
        when=lambda c: not SWITCH.exists() and c.t_s - c.state.flight_started_at_s > WAIT_S,
        to=Phase.LANDING,
        reason="nobody has put the switch on",
        severity=Severity.LAND,
    ),
)

TOO_FAST = Transition(
    name="too-fast",
    phases={Phase.ASCEND},
    when=lambda c: math.hypot(*c.telemetry.velocity_mps[:2]) > MOST_MPS,
    to=Phase.RECOVER,
    reason=f"faster than {MOST_MPS} m/s sideways",
    severity=Severity.BACK_OFF,
)


def main(profile: str = "sim") -> str:
    """Fly one simulated flight, and return how it ended."""
    flight = fly_lockstep(load_profile(profile), seed=0, rows=[*ROWS, TOO_FAST])
    return f"{flight.report.phase.name}: {flight.report.reason}"


if __name__ == "__main__":
    print(main(*sys.argv[1:]))
