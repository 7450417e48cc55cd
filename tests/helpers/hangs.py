"""A loop that is hung up inside a turn, once: simulated time goes on meanwhile."""

from __future__ import annotations

from typing import Any

import pytest

from perchctl.link.mock import MockLink, ScriptedLink
from perchctl.mission import planner
from perchctl.mission.state import Observation, PlannerState
from perchctl.vision.types import Frame


def hang_in_the_camera(link: ScriptedLink | MockLink, camera: Any, at_s: float) -> None:
    poll, left = camera.poll, [True]

    def hang(now_s: float) -> Frame | None:
        frame = poll(now_s)
        if left and now_s > at_s:
            left.clear()
            link.advance_to(now_s + 0.4)
        return frame

    camera.poll = hang


def hang_in_the_planner(
    link: ScriptedLink | MockLink, monkeypatch: pytest.MonkeyPatch, at_s: float
) -> None:
    step, left = planner.step, [True]

    def hang(state: PlannerState, obs: Observation, *more: Any) -> Any:
        if left and obs.t_s > at_s:
            left.clear()
            link.advance_to(obs.t_s + 0.4)
        return step(state, obs, *more)

    monkeypatch.setattr(planner, "step", hang)
