"""What becomes of a campaign's results: a file that grows line by line, and the logs that stay.

Line 1 of the file is a header that says what is flown; then comes one record a flight. A line is
in the file whole or, if the program or the computer was ended while it was written, is the last
one, which is removed when the campaign goes on.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import heapq
import json
import os
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import perchctl
from perchctl.campaign.flights import seed_log_path
from perchctl.campaign.results import FlightResult
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import cannot_be_written, check_place
from perchctl.log import (
    camera_record,
    decode_line,
    from_exact,
    json_line,
    make_log_folder,
    recording_path,
    to_exact,
)
from perchctl.profile import Profile


class CampaignFlight(Protocol):
    """A flight's result, in any kind of campaign."""

    @property
    def seed(self) -> int: ...

    @property
    def outcome(self) -> str: ...

    @property
    def log(self) -> Path | None: ...

    @property
    def log_problem(self) -> str | None: ...

    @property
    def badness(self) -> tuple[Any, ...]:
        """The larger the worse; the first part is whether it is bad at all."""
        ...


R = TypeVar("R", bound=CampaignFlight)


class CampaignResults(Generic[R]):
    """The results of a campaign's `seeds`: `earlier`, those that a file of results holds, and
    those that come. `left`: the seeds that are still to be flown. `keep_log` is called with each
    (`log_keeper`); of earlier flights only logs in `log_dir` are judged: others may be another
    campaign's by now."""

    def __init__(
        self,
        seeds: Sequence[int],
        file: ResultsFile[R] | None = None,
        keep_log: Callable[[R], None] = lambda result: None,
        log_dir: Path | None = None,
    ) -> None:
        earlier = {} if file is None else file.earlier
        self.earlier = [earlier[seed] for seed in seeds if seed in earlier]
        self.left = [seed for seed in seeds if seed not in earlier]
        self._file, self._keep_log = file, keep_log
        self._ended: set[Path] = set()
        own = None if log_dir is None or file is None else log_dir.resolve()
        for result in self.earlier:
            if result.log is not None and result.log.resolve().parent == own:
                self._keep_log(result)

    def note(self, result: R) -> None:
        """Write the result of a flight that has just ended, and keep or remove its log."""
        if result.log is not None:
            self._ended.add(result.log)
        if self._file is not None:
            self._file.append(result)
        self._keep_log(result)

    @contextmanager
    def torn_logs_removed(self, logs: Sequence[Path]) -> Iterator[None]:
        """At the end of the block, remove those of the campaign's new `logs` whose flights did not
        end: nobody has judged whether they are worth keeping. What was there before stays."""
        new = [log for log in logs if not log.exists()]
        try:
            yield
        finally:
            for log in new:
                if log not in self._ended:
                    _remove(log)


@contextmanager
def campaign_results(
    profile: Profile,
    seeds: Sequence[int],
    kind: type[R],
    *,
    faults: Sequence[str] | None = None,
    out: Path | None = None,
    resume: bool = False,
    force: bool = False,
    keep: str | None = None,
    log_dir: Path | None = None,
) -> Iterator[CampaignResults[R]]:
    """Yield the results of a campaign: appended to the file `out` (`resume`, `force`: see
    `open_results`), with the logs in `log_dir` that `keep` (see `log_keeper`) asks for.
    Errors: InvalidValue, UsageError."""
    keep_log = log_keeper(keep or "all")
    if log_dir is not None:
        make_log_folder(log_dir)
    with ExitStack() as stack:
        file = None
        if out is not None:
            file = open_results(out, campaign_header(profile, faults), kind, resume, force)
            stack.callback(file.close)
        results = CampaignResults(seeds, file, keep_log, log_dir)
        if log_dir is not None and keep not in (None, "all"):
            logs = [seed_log_path(seed, log_dir) for seed in results.left]
            stack.enter_context(results.torn_logs_removed(logs))
        yield results


# --- Which logs stay ---------------------------------------------------------------------------


def log_keeper(keep: str) -> Callable[[CampaignFlight], None]:
    """A function that is called with each flight as it ends, and removes its log, with the
    recording beside it, unless `keep` asks for it: ``all``, ``failed``, or ``worst:N``.
    Errors: UsageError."""
    if keep == "all":
        return lambda result: None
    if keep == "failed":
        return lambda result: None if result.badness[0] else _remove(result.log)
    found = re.fullmatch(r"worst:([1-9][0-9]{0,5})", keep)
    if found is None:
        raise UsageError(f"--keep {keep}: allowed are all, failed and worst:N, as in worst:5")
    return _WorstLogs(int(found[1]))


class _WorstLogs:
    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: list[tuple[tuple[Any, ...], int, str]] = []

    def __call__(self, result: CampaignFlight) -> None:
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


# --- One result as a record --------------------------------------------------------------------


TIMINGS = ("realtime_factor", "wall_s", "cpu_s", "peak_memory_mb")
"""What another computer, or the same one an hour later, measures otherwise."""
_NOT_FLOWN = ("timings", "log", "log_problem")


def result_record(result: Any) -> dict[str, Any]:
    """The record of a flight's result: JSON's own types, floats exact. What is None by default is
    left out; what was measured of the computer is in `timings`."""
    record: dict[str, Any] = to_exact(result)
    timings = {name: record.pop(name) for name in TIMINGS if name in record}
    return {**record, "timings": timings}


def result_from(record: Mapping[str, Any], kind: type[R] = FlightResult) -> R:  # type: ignore[assignment]
    """The result whose `result_record` this is. Raises ValueError for any other record."""
    timings = record.get("timings", {})
    if not isinstance(timings, Mapping):
        raise ValueError("timings: an object is needed")
    return from_exact(kind, {**{k: v for k, v in record.items() if k != "timings"}, **timings})


def flown_record(result: Any) -> dict[str, Any]:
    """The record without timings and log: the same for the same flight, on whatever computer."""
    return {k: v for k, v in result_record(result).items() if k not in _NOT_FLOWN}


# --- The file ----------------------------------------------------------------------------------


FORMAT = "perchctl-campaign"
VERSION = 1
_GIT_S = 10.0
_FLOWN = ("perchctl", "profiles", "calib")
"""What of a checkout a flight depends on."""


@dataclass(frozen=True)
class CampaignHeader:
    """What a campaign flies.

    Attributes:
        perchctl: the version.
        commit: of the checkout that runs, with ``+changed-`` and a digest of what differs where
            files differ from it; None for an installed package.
        profile: its name; `profile_sha256` is of all its values but name and description, and of
            the calibration.
        faults: the names that a fault is drawn from; None without.
    """

    perchctl: str
    commit: str | None
    profile: str
    profile_sha256: str
    faults: tuple[str, ...] | None = None

    @property
    def program(self) -> str:
        return f"perchctl {self.perchctl}" + (f" ({self.commit})" if self.commit else "")


def campaign_header(profile: Profile, faults: Sequence[str] | None = None) -> CampaignHeader:
    """The header of a campaign that begins now."""
    return CampaignHeader(
        perchctl.__version__,
        commit_of(Path(perchctl.__file__).resolve().parents[1]),
        profile.name,
        profile_sha256(profile),
        None if faults is None else tuple(faults),
    )


def profile_sha256(profile: Profile) -> str:
    """The hash of all values of a profile that may change a flight."""
    values = profile.model_dump(mode="json", exclude={"name", "description"})
    text = json.dumps([values, camera_record(profile)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def commit_of(root: Path) -> str | None:
    """The commit of the checkout whose top is `root`, with a digest of what differs from it; None
    where it is no checkout, or git cannot say."""
    if not (root / ".git").exists():
        return None

    def git(*words: str) -> bytes:
        return subprocess.run(
            ["git", "-C", str(root), *words],
            capture_output=True, check=True, timeout=_GIT_S, stdin=subprocess.DEVNULL,
        ).stdout  # fmt: skip

    try:
        commit = git("rev-parse", "HEAD").decode().strip()
        changed = git("diff", "--binary", "--no-ext-diff", "--no-textconv", "HEAD", "--", *_FLOWN)
        new = git("ls-files", "-z", "--others", "--exclude-standard", "--", *_FLOWN)
        digest = hashlib.sha256(changed)
        for name in filter(None, new.split(b"\0")):
            digest.update(b"\0" + name + b"\0" + (root / os.fsdecode(name)).read_bytes())
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return f"{commit}+changed-{digest.hexdigest()[:8]}" if changed or new else commit


class ResultsFile(Generic[R]):
    """A file of results, open for appending. `earlier`: the flights that it held, by seed."""

    def __init__(self, path: Path, fd: int, earlier: dict[int, R]) -> None:
        self.path = path
        self.earlier = earlier
        self._fd = fd

    def append(self, result: R) -> None:
        """Write one line, which is on the disk when this returns. Errors: InvalidValue."""
        self._write({"kind": "flight", **result_record(result)})

    def _write(self, record: dict[str, Any]) -> None:
        line, done = json_line(record), 0
        good = os.fstat(self._fd).st_size
        try:
            while done < len(line):
                done += os.write(self._fd, line[done:])
            os.fsync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, good)
            raise cannot_be_written(self.path, error) from None

    def close(self) -> None:
        os.close(self._fd)


def open_results(
    path: Path,
    header: CampaignHeader,
    kind: type[R],
    resume: bool = False,
    force: bool = False,
) -> ResultsFile[R]:
    """A new file, or one that the campaign goes on with. Without `resume` an existing file is
    refused, and with `force` replaced. With `resume` it has to be of the same profile and faults;
    if another perchctl wrote it, it goes on by `force` only. Errors: InvalidValue."""
    if path.is_file() and not (force or resume):
        raise InvalidValue(
            f"{path} exists already; add --resume to go on with it, --force to replace it, or name "
            f"another"
        )
    check_place(path, force=True)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    except OSError as error:
        raise cannot_be_written(path, error) from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        data = path.read_bytes() if resume else b""
        written, earlier, good = _read(path, data, kind, partial(_check_campaign, path, header))
        if written is not None and written.program != header.program and not force:
            raise InvalidValue(
                f"{path} was flown by another program ({written.program}; this is "
                f"{header.program}): take that one, name another file, or add --force to go on all "
                f"the same"
            )
        os.ftruncate(fd, good)
        results = ResultsFile(path, fd, earlier)
        if written != header:
            form = {"kind": "header", "format": FORMAT, "version": VERSION}
            results._write({**form, **asdict(header)})
        return results
    except BlockingIOError:
        os.close(fd)
        raise InvalidValue(
            f"{path} is being written by another campaign: wait for it, or name another file"
        ) from None
    except BaseException:
        os.close(fd)
        raise


def _read(
    path: Path, data: bytes, kind: type[R], check: Callable[[CampaignHeader], None]
) -> tuple[CampaignHeader | None, dict[int, R], int]:
    """The newest header, the flights, and how many bytes are whole lines. `check` is called with
    each header before a flight is read."""
    good = data.rfind(b"\n") + 1
    begin = json_line({"kind": "header", "format": FORMAT})[:-2]
    if not data.startswith(begin[: len(data)]) or (good and not data.startswith(begin)):
        raise InvalidValue(
            f"{path} holds no campaign's results: name the file of one, or a new one"
        )
    header: CampaignHeader | None = None
    flights: dict[int, R] = {}
    for number, line in enumerate(data[:good].splitlines(), start=1):
        try:
            record = decode_line(line)
            what = record.pop("kind", None)
            if what == "header":
                header = _header(record)
                check(header)
            elif what == "flight":
                result = result_from(record, kind)
                flights.setdefault(record["seed"], result)
            else:
                raise ValueError(f"kind {what!r}, allowed are header, flight")
        except ValueError as error:
            raise InvalidValue(
                f"{path}: line {number}: no line of a campaign's results ({error}): take the "
                f"original, or name a new file"
            ) from None
    return header, flights, good


def _header(record: dict[str, Any]) -> CampaignHeader:
    version = record.pop("version", None)
    if version != VERSION:
        raise ValueError(f"version {version!r}, this perchctl reads {VERSION}")
    record.pop("format", None)
    return from_exact(CampaignHeader, record)


def _check_campaign(path: Path, now: CampaignHeader, was: CampaignHeader) -> None:
    """Raise InvalidValue for the file of another campaign, before a flight of it is read."""
    if was.faults != now.faults:
        names = [", ".join(h.faults) if h.faults else "no faults" for h in (was, now)]
        raise InvalidValue(
            f"{path} is of a campaign with {names[0]:.80}, and this one flies {names[1]:.80}: name "
            f"the same, or another file"
        )
    if was.profile_sha256 != now.profile_sha256:
        raise InvalidValue(
            f"{path} was flown with another profile ({was.profile} {was.profile_sha256[:8]}, now "
            f"{now.profile} {now.profile_sha256[:8]}): take that one, or name another file"
        )
