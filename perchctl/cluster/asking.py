"""Each worker that is there is asked before the first flight whether it may fly."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from perchctl.cluster.wanted import Answer, Wanted
from perchctl.cluster.worker import asked_first, unfit
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.log import arithmetic_fingerprint

ANSWERS_S = 60.0
SEEN_S = 10.0
"""A shared folder may show so late what another computer has written."""
_LOOK_S = 0.05


async def ask_scheduler(client: Any, address: str) -> None:
    """Errors: InvalidValue, where it is of another distributed; ConnectionFailed."""
    try:
        there = await asyncio.wait_for(client.scheduler.versions(), ANSWERS_S)
    except (OSError, TimeoutError) as error:
        raise ConnectionFailed(
            f"the scheduler at {address} does not answer within {ANSWERS_S:.0f} s: look at what it "
            f"says, and start it again"
        ) from error
    found, here = there["packages"]["distributed"], version("distributed")
    if found != here:
        raise InvalidValue(
            f"the scheduler at {address} has distributed {found}, and here it is {here}: install "
            f"the same there or here, and start it again"
        )


async def ask_all(client: Any, asked: Wanted) -> list[str]:
    """Returns what is worth a note, a sentence each. Errors: InvalidValue, where one must not fly;
    ConnectionFailed."""
    try:
        run = client.run(asked_first, asked, on_error="return")
        answers: Mapping[str, Answer | Exception] = await asyncio.wait_for(run, ANSWERS_S)
    except (OSError, TimeoutError) as error:
        raise ConnectionFailed(
            f"not all workers answer within {ANSWERS_S:.0f} s: look at the scheduler, and end the "
            f"workers that hang"
        ) from error
    problems = [told for each in sorted(answers) if (told := problem_of(each, answers[each]))]
    fit = {each: a for each, a in answers.items() if isinstance(a, Answer) and not a.problem}
    problems += [each async for each in _unseen(asked, fit)]
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InvalidValue(problems[0] + more)
    others = sum(answer.arithmetic != arithmetic_fingerprint() for answer in fit.values())
    if not others:
        return []
    return [
        f"{others} of {len(fit)} workers have another processor, and calculate otherwise in the "
        f"last bits: a seed's flight there may differ from the one here"
    ]


def problem_of(address: str, answer: Answer | Exception) -> str | None:
    """One sentence."""
    if isinstance(answer, Answer):
        return unfit(address, answer) if answer.problem else None
    if isinstance(answer, OSError) and not isinstance(answer, FileNotFoundError):
        return None  # it has gone by now; should it come back, it is asked with its first flight
    return cannot_load(f"worker {address}", answer)


def cannot_load(who: str, error: BaseException) -> str:
    return (
        f"{who} cannot load what flies ({type(error).__name__}: {error}): install this "
        f"computer's perchctl there, with the extras sim and cluster"
    )


async def _unseen(asked: Wanted, fit: Mapping[str, Answer]) -> AsyncIterator[str]:
    """Whose file in the folder does not show here; all are taken away."""
    if asked.folder is None:
        return
    end_s = asyncio.get_running_loop().time() + SEEN_S
    for address, answer in sorted(fit.items()):
        left = asked.folder / answer.left
        while not _taken_away(left, asked.token):
            if asyncio.get_running_loop().time() > end_s:
                yield (
                    f"what worker {address} on {answer.host} writes to {asked.folder} is not seen "
                    f"here: name a folder in --log-dir that all computers share"
                )
                break
            await asyncio.sleep(_LOOK_S)


def _taken_away(path: Path, token: str) -> bool:
    try:
        if path.read_text(encoding="ascii") != token:
            return False
        path.unlink()
    except (OSError, UnicodeDecodeError):
        return False
    return True
