"""Who flies what `perchctl simulate` asks for: processes of this computer, or a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from importlib.util import find_spec
from pathlib import Path

from perchctl.cluster import parse_address
from perchctl.commands.output import say
from perchctl.errors import no_cluster
from perchctl.flight import defer_interrupts, flight_processes
from perchctl.profile import Profile


@contextlib.contextmanager
def hands_of(
    cluster: str | None, jobs: int, profiles: Sequence[Profile], log_dir: Path | None = None
) -> Iterator[tuple[Executor, int]]:
    """Yields who flies, and how many at a time: `jobs` processes, or the workers of `cluster`.
    `profiles`: with the files that flights read; `log_dir`: where they write. Errors: UsageError,
    ConnectionFailed, InvalidValue."""
    if cluster is None:
        with flight_processes(jobs) as executor:
            yield executor, jobs
        return
    if find_spec("distributed") is None:
        raise no_cluster()
    try:
        with defer_interrupts():
            from perchctl.cluster import cluster_hands
    except ImportError as error:
        raise no_cluster(str(error)) from error
    with cluster_hands(parse_address(cluster), profiles, log_dir) as hands:
        for note in hands.notes:
            say(note)
        yield hands, hands.width
