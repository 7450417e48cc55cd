"""Which of a campaign's logs are kept."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from perchctl.errors import UsageError
from perchctl.log import recording_path


class JudgedFlight(Protocol):
    """A flight's result, of whatever campaign."""

    @property
    def seed(self) -> int: ...

    @property
    def log(self) -> Path | None: ...

    @property
    def badness(self) -> tuple[Any, ...]:
        """The larger the worse; the first part is whether it is bad at all."""
        ...


R = TypeVar("R", bound=JudgedFlight)


def log_keeper(keep: str) -> Callable[[JudgedFlight], None]:
    """To be called with each flight as it ends: removes the logs, with the recordings beside them,
    that `keep` does not want: ``all``, ``failed``, or ``worst:N``. Errors: UsageError."""
    if keep == "all":
        return lambda result: None
    if keep == "failed":
        return lambda result: None if result.badness[0] else _remove(result.log)
    found = re.fullmatch(r"worst:([1-9][0-9]{0,5})", keep)
    if found is None:
        raise UsageError(f"--keep {keep}: allowed are all, failed and worst:N, as in worst:5")
    return _Worst(int(found[1]))


class _Worst:
    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: list[tuple[tuple[Any, ...], int, str]] = []

    def __call__(self, result: JudgedFlight) -> None:
        if result.log is None:
            return
        heapq.heappush(self._kept, (result.badness, -result.seed, str(result.log)))
        if len(self._kept) > self._count:
            _remove(Path(heapq.heappop(self._kept)[2]))


def _remove(log: Path | None) -> None:
    if log is not None:
        for path in (log, recording_path(log)):
            with suppress(OSError):
                path.unlink(missing_ok=True)


class CampaignResults(Generic[R]):
    """A campaign's results: those of a file of results, and those that come. Of earlier ones only
    logs in `folder` are judged: others may be another campaign's by now."""

    def __init__(
        self,
        seeds: Sequence[int],
        earlier: Mapping[int, R],
        keep_log: Callable[[R], None],
        append: Callable[[R], None] = lambda result: None,
        folder: Path | None = None,
    ) -> None:
        self.earlier = [earlier[seed] for seed in seeds if seed in earlier]
        self.left = [seed for seed in seeds if seed not in earlier]
        self._keep_log, self._append = keep_log, append
        self._ended: set[Path] = set()
        own = None if folder is None else folder.resolve()
        for result in self.earlier:
            if result.log is not None and result.log.resolve().parent == own:
                keep_log(result)

    def note(self, result: R) -> None:
        """As a flight ends."""
        if result.log is not None:
            self._ended.add(result.log)
        self._append(result)
        self._keep_log(result)

    @contextmanager
    def without_torn(self, logs: Sequence[Path]) -> Iterator[None]:
        """At the end those of the campaign's new `logs` go whose flights did not end: nobody has
        judged whether they are worth keeping. What was there before stays."""
        new = [log for log in logs if not log.exists()]
        try:
            yield
        finally:
            for log in new:
                if log not in self._ended:
                    _remove(log)
