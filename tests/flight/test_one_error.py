"""One error, one home: what steers is what is logged and shown, and it is the true one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.display.panel import status_rows
from perchctl.flight import fly_lockstep
from perchctl.mission import Phase, Tick, planner
from perchctl.mission.context import Context
from perchctl.perception import perception
from perchctl.record.fields import tick_record
from perchctl.record.write import Truth
from perchctl.sim import draw_scenario
from perchctl.vision import merge
from tests.helpers.flights import SEED, NoLog, short_profile

pytestmark = pytest.mark.long

PROFILE = short_profile()
SCENARIO = draw_scenario(PROFILE, SEED)


class Looker(NoLog):
    """The ticks, and where the vehicle truly was."""

    def __init__(self) -> None:
        super().__init__()
        self.ticks: list[tuple[Tick, Truth]] = []

    def tick(self, tick: Tick) -> None:
        assert self.truth is not None
        self.ticks.append((tick, self.truth()))


@dataclass
class Watched:
    """A flight's ticks with the truth, calls of the pose solver, and the planner's contexts."""

    ticks: list[tuple[Tick, Truth]]
    in_step: int = 0
    elsewhere: int = 0
    stepping: bool = False
    contexts: list[Context] = field(default_factory=list)


@pytest.fixture(scope="module")
def flight() -> Iterator[Watched]:
    """One quiet flight, watched from everywhere."""
    looker = Looker()
    watched = Watched(looker.ticks)
    solve, step, act = merge.estimate_pose, perception.step, planner.act

    def solved(*arguments: Any) -> Any:
        watched.in_step += watched.stepping
        watched.elsewhere += not watched.stepping
        return solve(*arguments)

    def stepped(*arguments: Any) -> Any:
        watched.stepping = True
        try:
            return step(*arguments)
        finally:
            watched.stepping = False

    def acted(context: Context) -> Any:
        watched.contexts.append(context)
        return act(context)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge, "estimate_pose", solved)
        patch.setattr(perception, "step", stepped)
        patch.setattr(planner, "act", acted)
        flown = fly_lockstep(PROFILE, log=looker, scenario=SCENARIO)
        assert flown.report.phase is Phase.PERCHED
        for tick, _ in looker.ticks:  # whatever looks at a tick solves nothing
            tick_record(tick)
            status_rows(tick)
        yield watched


def test_the_log_and_the_panel_hold_the_planner_s_error(flight: Watched) -> None:
    assert len(flight.ticks) == len(flight.contexts)
    seen = 0
    for (tick, _), context in zip(flight.ticks, flight.contexts, strict=True):
        record, shown = tick_record(tick), dict(status_rows(tick))["error"]
        target = context.obs.target
        if target is None:
            assert (record["ex_m"], shown) == (None, "no target seen yet")
            continue
        seen += 1
        assert [record[f"e{axis}_m"] for axis in "xyz"] == target.e_m.tolist()
        x, y, z = (f"{100 * v:+.1f}" for v in target.e_m)
        assert shown.startswith(f"x {x}  y {y}  z {z} cm")
        assert record["eyaw_rad"] == context.error_yaw_rad
        assert math.hypot(record["ex_m"], record["ey_m"]) == context.error_xy_m
        assert record["ez_m"] == context.error_z_m
        assert target.t_s == tick.t_s  # at the present, not at the frame's time
    assert seen > 0.5 * len(flight.ticks)
