"""A planner in another one's place, and a loop that hangs inside a turn, once: simulated time goes
on meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from perchctl.mission import Observation, PlannerState, step_mission
from perchctl.vision import Frame


def plan_by(monkeypatch: pytest.MonkeyPatch, step: Callable[..., Any]) -> None:
    """In the flight loop and in a replay of it."""
    for module in ("perchctl.flight.loop", "perchctl.analysis.decide"):
        monkeypatch.setattr(f"{module}.step_mission", step)


def hang_in_the_camera(link: Any, camera: Any, at_s: float, for_s: float = 0.4) -> None:
    poll, left = camera.poll, [True]

    def hang(now_s: float) -> Frame | None:
        frame = poll(now_s)
        if left and now_s > at_s:
            left.clear()
            link.advance_to(now_s + for_s)
        return frame

    camera.poll = hang


def hang_in_the_planner(link: Any, monkeypatch: pytest.MonkeyPatch, at_s: float) -> None:
    left = [True]

    def hang(state: PlannerState, obs: Observation, *more: Any) -> Any:
        if left and obs.t_s > at_s:
            left.clear()
            link.advance_to(obs.t_s + 0.4)
        return step_mission(state, obs, *more)

    plan_by(monkeypatch, hang)
