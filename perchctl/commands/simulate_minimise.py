"""The work behind `perchctl simulate --minimise`: the few conditions that make a seed fail."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.commands.output import print_record, say
from perchctl.commands.progress import count_bar
from perchctl.commands.simulate_hands import hands_of
from perchctl.commands.simulate_request import SimulateRequest
from perchctl.errors import Interrupted, InvalidValue, PerchError
from perchctl.files import write_files
from perchctl.flight import (
    EndedFlight,
    ScenarioCondition,
    ScenarioConditions,
    fly_all,
    fly_to_its_end,
    minimised_failure,
    scenario_conditions,
)
from perchctl.log import to_plain
from perchctl.profile import is_profile_path, scalar_text


@dataclass
class Minimised:
    """What is known so far. `ended`: how the flight ends at these levels."""

    levels: Mapping[str, float]
    ended: EndedFlight
    flights: int = 0
    whole: bool = False


def run_minimise(request: SimulateRequest) -> int:
    """Fly the seed, then less and less of it, and print what is left.

    Errors: NotFound, InvalidValue (a seed that perches, too), Interrupted before it has failed.
    """
    assert request.minimise is not None
    seed, profile = request.minimise, request.loaded()
    conditions = scenario_conditions(profile, seed)
    found: Minimised | None = None
    problem: PerchError | None = None
    with (
        contextlib.suppress(KeyboardInterrupt),
        hands_of(request.cluster, request.jobs or 1, [profile]) as (executor, jobs),
        count_bar("flights", None) as advance,
    ):
        [whole] = fly_all(partial(fly_to_its_end, profile), [seed], executor)
        advance()
        if not whole.failed:
            raise InvalidValue(
                f"seed {seed} perches, and there is nothing to minimise: name one of the worst "
                f"seeds of perchctl simulate -p {request.profile} -n 100"
            )
        found = Minimised(dict.fromkeys(conditions.names, 1.0), whole, 1)
        so_far = found

        def flown(_ended: EndedFlight) -> None:
            so_far.flights += 1
            advance()

        def less(levels: Mapping[str, float], ended: EndedFlight) -> None:
            so_far.levels, so_far.ended = levels, ended

        try:
            minimised_failure(conditions, whole, executor, jobs, flown, less)
            so_far.whole = True
        except PerchError as error:  # what was found so far is not lost with it
            problem = error
    if found is None:
        raise Interrupted("stopped: the seed was not flown to its end")
    _report(request, conditions, found)
    if found.whole:
        return 0
    say(f"{problem or 'stopped'}: less may do; what is known so far is told")
    return (problem or Interrupted()).exit_code


def _report(request: SimulateRequest, conditions: ScenarioConditions, found: Minimised) -> None:
    text = profile_of(request, conditions, found)
    if request.output is not None:
        write_files({request.output: text.encode()})
    if request.as_json:
        print_record(
            to_plain(
                {
                    "seed": conditions.seed,
                    "outcome": found.ended.outcome,
                    "reason": found.ended.reason,
                    "whole": found.whole,
                    "flights": found.flights,
                    "conditions": [_record(conditions, c, found) for c in _left(conditions, found)],
                    "profile": text,
                    "output": request.output,
                }
            )
        )
        return
    if request.output is None:
        print(text, end="", flush=True)
        return
    for line in _words(request, conditions, found):
        print(line)
    print(f"profile:   {request.output}", flush=True)


def _left(conditions: ScenarioConditions, found: Minimised) -> list[ScenarioCondition]:
    return [condition for condition in conditions.off if found.levels[condition.name]]


def _record(
    conditions: ScenarioConditions, condition: ScenarioCondition, found: Minimised
) -> dict[str, Any]:
    values = conditions.values(found.levels)
    return {
        "name": condition.name,
        "level": found.levels[condition.name],
        "told": conditions.told(condition, found.levels),
        "drawn": conditions.told(condition, dict.fromkeys(conditions.names, 1.0)),
        "nominal": conditions.told(condition, dict.fromkeys(conditions.names, 0.0)),
        "keys": {f"simulation.{key}": values[key] for key in condition.keys},
    }


def _words(request: SimulateRequest, conditions: ScenarioConditions, found: Minimised) -> list[str]:
    left = _left(conditions, found)
    flights = f"{found.flights} flights" + ("" if found.whole else ", stopped before its end")
    lines = [f"seed {conditions.seed} of {request.profile} ends {found.ended.told}"]
    if not left:
        return [*lines, f"it does so with all its conditions nominal ({flights})"]
    lines.append(f"what makes it end so, each as little as it takes ({flights}):")
    for condition in left:
        told = _record(conditions, condition, found)
        drawn = "" if told["told"] == told["drawn"] else f", drawn {told['drawn']}"
        lines.append(f"- {condition.name}: {told['told']} (nominal {told['nominal']}{drawn})")
    return [*lines, "all else is nominal"]


def profile_of(request: SimulateRequest, conditions: ScenarioConditions, found: Minimised) -> str:
    """The profile's file: the seed with it flies just what was found."""
    base = (
        str(Path(request.profile).resolve())
        if is_profile_path(request.profile)
        else request.profile
    )
    file = str(request.output) if request.output is not None else "FILE"
    lines = [f"# {line}" for line in _words(request, conditions, found)]
    lines += [f"# again: perchctl simulate --only {conditions.seed} -p {file}"]
    lines += [f"extends: {scalar_text(base)}", ""]
    if request.positioning is not None:
        lines += [f"positioning: {{by: {request.positioning}}}", ""]
    values = conditions.values(found.levels)
    first = [key for condition in _left(conditions, found) for key in condition.keys]
    lines.append("simulation:")
    lines += [f"  {key}: {scalar_text(values[key])}" for key in first]
    lines.append("  # nominal")
    lines += [f"  {key}: {scalar_text(v)}" for key, v in values.items() if key not in first]
    return "\n".join(lines) + "\n"
