"""One error, one home: what steers is what is logged and shown, and it is the true one."""

from __future__ import annotations

import math
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.display.panel import status_rows
from perchctl.flight import fly_lockstep
from perchctl.mission import Phase, Tick, planner
from perchctl.mission.context import Context
from perchctl.record.fields import tick_record
from tests.helpers.flights import SEED, short_profile
from tests.helpers.loop_rig import Watcher

pytestmark = pytest.mark.long

Watched = tuple[list[Tick], list[Context]]


@pytest.fixture(scope="module")
def flight() -> Watched:
    """The ticks of one quiet flight, and the planner's contexts."""
    watcher, contexts, act = Watcher(), list[Context](), planner.act

    def acted(context: Context) -> Any:
        contexts.append(context)
        return act(context)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "act", acted)
        flown = fly_lockstep(short_profile(), SEED, watchers=(watcher,))
    assert flown.report.phase is Phase.PERCHED
    return watcher.ticks, contexts


def test_the_log_and_the_panel_hold_the_planner_s_error(flight: Watched) -> None:
    ticks, seen = flight[0], 0
    for tick, context in zip(*flight, strict=True):
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
    assert seen > 0.5 * len(ticks)
