"""Flies seeds for `campaign.py` in a process of its own, with the perchctl of `PYTHONPATH`.

Requests come as lines of JSON on the standard input, answers go out the same way:
``{"seed": 3}``, with ``"parts": true`` for the CPU time by `PARTS`. Of perchctl it needs
`load_profile` and `fly_seed`; of the parts what a checkout does not have is left out.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

STARTED_S = time.perf_counter()

PARTS: dict[str, tuple[str, ...]] = {
    "rendering": (
        "perchctl.sim.camera:SimCamera.advance",
        "perchctl.sim.camera:SimCamera.take",
        "perchctl.sim.renderer:Renderer.__init__",
        "perchctl.sim.renderer:Renderer.render",
        "perchctl.sim.renderer:Renderer.expose",
    ),
    "detection, tracking": (
        "perchctl.perception.perception:pictures",
        "perchctl.perception.perception:step",
        "perchctl.perception.perception:estimate",
    ),
    "judging pictures": (
        "perchctl.camera.health:FrameHealth.assess",
        "perchctl.camera.source:same_bytes",
    ),
    "physics, firmware": ("perchctl.sim.vehicle:SimulatedVehicle.advance_to",),
    "link": (
        "perchctl.link.mock:MockLink.advance_to",
        "perchctl.link.mock:MockLink.send",
        "perchctl.link.mock:MockLink.telemetry",
    ),
    "planner": (
        "perchctl.flight.loop:step_mission",
        "perchctl.mission.records:Event.list_events_of_tick",
    ),
    "history, turns, log": (
        "perchctl.flight.inputs:add_samples",
        "perchctl.perception.perception:update_calibration",
        "perchctl.flight.inputs:TurnReporter.flown_turn",
        "perchctl.flight.inputs:TurnReporter.report_waiting_turn",
        "perchctl.flight.lockstep:TruthWatcher.tick",
    ),
}
"""What is timed, each without what it calls of the others; the rest of a flight is "other"."""
OTHER = "other"


class Stopwatch:
    """CPU seconds by part; a part that calls another one stands still meanwhile."""

    def __init__(self) -> None:
        self.spent_s = dict.fromkeys((*PARTS, OTHER), 0.0)
        self._within: list[str] = []
        self._since_s = time.thread_time()

    def _go_on(self) -> None:
        now_s = time.thread_time()
        part = self._within[-1] if self._within else OTHER
        self.spent_s[part] += now_s - self._since_s
        self._since_s = now_s

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def watched(*args: Any, **keys: Any) -> Any:
            self._go_on()
            self._within.append(part)
            try:
                return function(*args, **keys)
            finally:
                self._go_on()
                self._within.pop()

        return watched

    def watch(self) -> list[tuple[Any, str, Any]]:
        """Puts it around all parts; what they were is given back."""
        before = []
        for part, names in PARTS.items():
            for name in names:
                module, _, path = name.partition(":")
                try:
                    owner = importlib.import_module(module)
                    *way, last = path.split(".")
                    for each in way:
                        owner = getattr(owner, each)
                    function = getattr(owner, last)
                except (ImportError, AttributeError):
                    continue  # this checkout has it elsewhere
                before.append((owner, last, function))
                setattr(owner, last, self.timed(part, function))
        self._since_s = time.thread_time()
        return before


def flown(fly_seed: Any, profile: Any, seed: int, by_parts: bool) -> dict[str, Any]:
    """One flight, its times and what came of it."""
    watch = Stopwatch()
    before = watch.watch() if by_parts else []
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    try:
        result = fly_seed(profile, seed)
        watch._go_on()
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    return {
        "seed": seed,
        "outcome": str(result.outcome),
        "miss_m": result.miss_m,
        "time_s": result.time_s,
        "simulated_s": result.time_s,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "parts_s": watch.spent_s if by_parts else {},
    }


def main() -> None:
    import perchctl
    from perchctl.campaign.flights import fly_seed
    from perchctl.profile import load_profile

    profile = load_profile(sys.argv[1])
    home = str(Path(perchctl.__file__).resolve().parents[1])
    hello = {"home": home, "start_s": time.perf_counter() - STARTED_S}
    print(json.dumps(hello), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        answer = flown(fly_seed, profile, int(request["seed"]), bool(request.get("parts")))
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
