"""What `perchctl simulate` shares between plain flights and those with faults."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeVar

from perchctl.cluster import parse_address
from perchctl.commands.output import say
from perchctl.commands.positioning import positioned
from perchctl.commands.progress import Ended, progress_bar
from perchctl.errors import Interrupted, InvalidValue, PerchError, UsageError
from perchctl.flight import (
    CampaignResults,
    JudgedFlight,
    campaign_header,
    defer_interrupts,
    log_keeper,
    open_results,
)
from perchctl.profile import Profile, load_profile

AGAIN_S = 0.5
"""A second Ctrl-C counts from here on: a key held down is one press, as in a flight."""


_LOGS = ("--log-dir", "--record", "--keep", "--out", "--resume")
_NOT_WITH = {
    "--compare": "flies each seed by two profiles, and prints a table",
    "--sweep": "flies each seed by many profiles, and keeps no logs",
}
"""What answers a question, and does without a campaign's files."""


class Seeded(Ended, JudgedFlight, Protocol):
    """A flight's result, of whatever campaign."""

    @property
    def log_problem(self) -> str | None: ...


R = TypeVar("R", bound=Seeded)


@dataclass(frozen=True)
class SimulateRequest:
    """The command line as it was given; None is not given."""

    profile: str = "sim"
    flights: int | None = None
    seed: int | None = None
    jobs: int | None = None
    only: int | None = None
    log_dir: Path | None = None
    as_json: bool = False
    faults: str | None = None
    force: bool = False
    positioning: str | None = None
    record: bool = False
    out: Path | None = None
    resume: bool = False
    keep: str | None = None
    compare: str | None = None
    sweep: tuple[str, ...] = ()
    cluster: str | None = None

    def loaded(self) -> Profile:
        """The profile with the command line on top. Errors: NotFound, InvalidValue."""
        return positioned(load_profile(self.profile), self.positioning)

    @property
    def seeds(self) -> list[int]:
        if self.only is not None:
            return [self.only]
        first = self.seed or 0
        return list(range(first, first + (10 if self.flights is None else self.flights)))

    def log_folder(self, profile: Profile) -> Path:
        """Of one flight, which is always logged."""
        return self.log_dir or Path(profile.log.directory)

    @property
    def _options(self) -> dict[str, Any]:
        return {
            "--compare": self.compare,
            "--sweep": self.sweep,
            "--faults": self.faults,
            "--only": self.only,
            "-n": self.flights,
            "--seed": self.seed,
            "--log-dir": self.log_dir,
            "--record": self.record or None,
            "--out": self.out,
            "--resume": self.resume or None,
            "--keep": self.keep,
        }

    def check(self) -> None:
        """Errors: UsageError for an option that does not apply to what is asked for,
        InvalidValue for a place that nothing can be written to."""
        _check_question(self._options)
        if self.record and self.only is None and self.log_dir is None:
            raise UsageError("--record writes beside the logs: name their folder with --log-dir")
        many: dict[str, int | str | Path | None] = {
            "-n": self.flights,
            "--seed": self.seed,
            "--jobs": self.jobs,
            "--cluster": self.cluster,
            "--out": self.out,
        }
        if self.resume and self.out is None:
            raise UsageError("--resume goes on with a file of results: name it with --out")
        if self.keep is not None:
            if self.log_dir is None or self.only is not None:
                raise UsageError("--keep chooses among a campaign's logs: log it with --log-dir")
            log_keeper(self.keep)
        if self.faults == "list":
            others = {"--only": self.only, "--log-dir": self.log_dir}
            _refuse("--faults list flies nothing", {**many, **others}, "")
        elif self.only is not None:
            one = f"--only {self.only} repeats the one flight of seed {self.only}"
            _refuse(one, many, ", or --only")
        if self.cluster is not None:
            parse_address(self.cluster)
            if self.jobs is not None:
                raise UsageError(
                    f"--cluster {self.cluster} flies as many at a time as it has workers: "
                    f"--jobs {self.jobs} does not apply; leave it out, or --cluster"
                )
        if self.out is not None and self.out.suffix != ".jsonl":
            raise InvalidValue(f"{self.out} must end in .jsonl: a result is one line of JSON")

    @contextlib.contextmanager
    def results(
        self, profile: Profile, kind: type[R], faults: Sequence[str] | None = None
    ) -> Iterator[CampaignResults[R]]:
        """What becomes of each result: `--out`, `--resume`, `--keep`. Errors: InvalidValue."""
        keep = log_keeper(self.keep or "all")
        with contextlib.ExitStack() as stack:
            kept: CampaignResults[R] = CampaignResults(self.seeds, {}, keep)
            if self.out is not None:
                header = campaign_header(profile, faults)
                file = open_results(self.out, header, kind, self.resume, self.force)
                stack.callback(file.close)
                kept = CampaignResults(self.seeds, file.earlier, keep, file.append, self.log_dir)
            if self.log_dir is not None and self.keep not in (None, "all"):
                from perchctl.flight import seed_log_path

                stack.enter_context(
                    kept.without_torn([seed_log_path(s, self.log_dir) for s in kept.left])
                )
            yield kept


def _check_question(options: Mapping[str, Any]) -> None:
    """By the options' names; None or an empty tuple was not given. Errors: UsageError for options
    that do not go together."""
    given = {name: value for name, value in options.items() if value is not None and value != ()}
    asked = [name for name in (*_NOT_WITH, "--faults", "--only") if name in given]
    questions = [name for name in asked if name in _NOT_WITH]
    if questions and len(asked) > 1:
        raise UsageError(
            f"{' and '.join(asked)} do not go together: each flies its own seeds; ask for one "
            f"after the other"
        )
    for question in questions:
        asks = f"{question} {_NOT_WITH[question]}"
        _refuse(asks, {name: "" for name in _LOGS if name in given}, "")


def _refuse(asked: str, options: Mapping[str, int | str | Path | None], instead: str) -> None:
    given = [f"{name} {value}".strip() for name, value in options.items() if value is not None]
    if given:
        does, it = ("does", "it") if len(given) == 1 else ("do", "them")
        raise UsageError(
            f"{asked}: {' and '.join(given)} {does} not apply; leave {it} out{instead}"
        )


def fly_each(
    campaign: Callable[[Executor, Callable[[R], None]], object],
    request: SimulateRequest,
    report: Callable[[list[R], PerchError | None], None],
    kept: CampaignResults[R] | None = None,
    flights: int | None = None,
    profiles: Sequence[Profile] = (),
    objection: Callable[[list[R]], PerchError | None] = lambda results: None,
) -> int:
    """Flies the request's seeds in processes of their own or on its cluster, and reports those that
    were flown, however it ends: also by Ctrl-C, or when a flight fails. Returns the exit code.

    `campaign` is given who flies, and whom to tell of each result; `report` also why not all
    were flown. `kept`: those that were flown before, which count, too, and where each goes.
    `flights`: how many it flies, by default one a seed; `profiles`: by which; `objection`:
    what all of them together amount to. Errors: PerchError where none was.
    """
    from perchctl.commands.simulate_hands import hands_of

    total = len(request.seeds) if flights is None else flights
    kept = kept or CampaignResults(request.seeds, {}, lambda result: None)
    results: list[R] = list(kept.earlier)
    left = total - len(results)
    jobs = max(1, min(request.jobs or 1, left))
    cluster = request.cluster if left > 0 else None
    problem: PerchError | None = None
    begun = False
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            hands_of(cluster, jobs, profiles, request.log_dir) as (executor, _),
            progress_bar(total, earlier=kept.earlier) as advance,
        ):
            begun = True
            campaign(executor, noting(results, kept.note, advance))
    except PerchError as error:
        if not begun:
            raise
        problem = error
    flown = f"{len(results)} of {total} flights were flown"
    if problem is None and len(results) < total:
        problem = Interrupted(f"stopped: {flown}")
    elif problem is not None:
        problem.args = (f"{problem}; {flown}",)
    if problem is not None and not results:
        raise problem
    problem = problem or objection(results)
    report(sorted(results, key=lambda result: result.seed), problem)
    if problem is None:
        return 0
    say(str(problem))
    return problem.exit_code


def and_problem(record: Mapping[str, Any], problem: PerchError | None) -> dict[str, Any]:
    """The one object of `--json`, with why not all were flown."""
    if problem is None:
        return dict(record)
    return {**record, "error": str(problem), "exit_code": problem.exit_code}


def noting(results: list[R], *others: Callable[[R], None]) -> Callable[[R], None]:
    """Keeps each result as it comes, and tells the others; a signal waits meanwhile."""

    def note(result: R) -> None:
        with defer_interrupts():
            results.append(result)
            for tell in others:
                tell(result)

    return note


def tell_logs(results: Sequence[Seeded], log_dir: Path | None, keep: str | None = None) -> None:
    """Where the logs are, and what they lack."""
    if log_dir is None or not results:
        return
    kept = "the logs that are kept" if keep else "the flights' logs"
    say(f"{kept} are in {log_dir}")
    problems = [result.log_problem for result in results if result.log_problem is not None]
    if problems:
        say(f"{len(problems)} of {len(results)} logs are incomplete: {problems[0]}")


def stop_once(
    clock: Callable[[], float] = time.monotonic, leave: Callable[[int], object] = os._exit
) -> Callable[[int, FrameType | None], None]:
    """A handler: the first signal raises KeyboardInterrupt, a further one ends the program
    where it is."""
    first_s: list[float] = []

    def press(_number: int, _frame: FrameType | None) -> None:
        if not first_s:
            first_s.append(clock())
            raise KeyboardInterrupt
        if clock() - first_s[0] >= AGAIN_S:
            leave(Interrupted.exit_code)

    return press
