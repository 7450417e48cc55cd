"""What stays of a campaign: a file of results that grows line by line, and logs.

Line 1 of the file is a header that says what is flown; then comes one record a flight. A line is
in the file whole or, if the program or the computer was ended while it was written, is the last
one, which is removed when the campaign goes on.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import perchctl
from perchctl.campaign.results import FlightResult
from perchctl.errors import InvalidValue
from perchctl.files import cannot_be_written, check_place
from perchctl.profile import Profile
from perchctl.record import (
    camera_record,
    from_exact,
    json_line,
    path_beside,
    to_exact,
)


class CampaignFlight(Protocol):
    """The result of a flight, of any kind of campaign."""

    @property
    def seed(self) -> int: ...

    @property
    def outcome(self) -> str: ...

    @property
    def is_bad(self) -> bool: ...

    @property
    def log(self) -> Path | None: ...

    @property
    def log_problem(self) -> str | None: ...


R = TypeVar("R", bound=CampaignFlight)


class CampaignResults(Generic[R]):
    """The results of a campaign's seeds: `earlier` were read from its file, `left` are the seeds
    still to be flown."""

    def __init__(
        self,
        seeds: Sequence[int],
        file: ResultsFile[R] | None = None,
        failed_logs_only: bool = False,
    ) -> None:
        earlier = {} if file is None else file.earlier
        self.earlier = [earlier[seed] for seed in seeds if seed in earlier]
        self.left = [seed for seed in seeds if seed not in earlier]
        self._file, self._failed_logs_only = file, failed_logs_only

    def note(self, result: R) -> None:
        """Write the result of a flight, and keep or remove its log and recording."""
        if self._file is not None:
            self._file.append(result)
        if self._failed_logs_only and result.log is not None and not result.is_bad:
            for path in (result.log, path_beside(result.log, ".mcap")):
                with suppress(OSError):
                    path.unlink(missing_ok=True)


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
    log_dir: Path | None = None,
    failed_logs_only: bool = False,
) -> Iterator[CampaignResults[R]]:
    """Yield the results of a campaign, which are appended to the file `out` (`resume`, `force`: see
    `open_results`). `failed_logs_only`: of the logs in `log_dir` only those of bad flights stay.
    Errors: InvalidValue."""
    if log_dir is not None:
        check_place(log_dir / "flight.jsonl", force=True)
    if out is None:
        yield CampaignResults(seeds, None, failed_logs_only)
        return
    with closing(open_results(out, campaign_header(profile, faults), kind, resume, force)) as file:
        yield CampaignResults(seeds, file, failed_logs_only)


# --- One result as a record --------------------------------------------------------------------


TIMINGS = ("realtime_factor", "wall_s", "cpu_s", "peak_memory_mb")
"""The fields that differ between computers, or from hour to hour."""
_NOT_FLOWN = ("timings", "log", "log_problem")


def result_record(result: Any) -> dict[str, Any]:
    """Return a flight's result as a record of JSON types with exact floats. Fields that are None
    by default are left out; `timings` holds what was measured of the computer."""
    record: dict[str, Any] = to_exact(result)
    timings = {name: record.pop(name) for name in TIMINGS if name in record}
    return {**record, "timings": timings}


def result_from(record: Mapping[str, Any], kind: type[R] = FlightResult) -> R:  # type: ignore[assignment]
    """Return the result of a `result_record`. Raises ValueError for any other record."""
    timings = record.get("timings", {})
    if not isinstance(timings, Mapping):
        raise ValueError("timings: an object is needed")
    return from_exact(kind, {**{k: v for k, v in record.items() if k != "timings"}, **timings})


def flown_record(result: Any) -> dict[str, Any]:
    """Return the record without timings and log, which equal flights share on all computers."""
    return {k: v for k, v in result_record(result).items() if k not in _NOT_FLOWN}


# --- The header --------------------------------------------------------------------------------


VERSION = 1
_FORM = {"kind": "header", "format": "perchctl-campaign"}
_ROOT = Path(perchctl.__file__).resolve().parent
_GIT_S = 10.0
_MUST_AGREE = {"faults": "other faults", "profile_sha256": "another profile"}


def campaign_header(profile: Profile, faults: Sequence[str] | None = None) -> dict[str, Any]:
    """What a campaign that begins now flies: the first line of its file.

    `perchctl` is the version, `source` the hash of its source, and `commit` that of the checkout
    that runs, with ``-dirty`` where files differ from it, None for an installed package. `profile`
    is its name; `profile_sha256` is of all its values but name and description, and of the
    calibration. `faults` are the names that a fault is drawn from; None without.
    """
    return {
        **_FORM,
        "version": VERSION,
        "perchctl": perchctl.__version__,
        "commit": commit_of(_ROOT.parent),
        "source": SOURCE,
        "profile": profile.name,
        "profile_sha256": profile_sha256(profile),
        "faults": None if faults is None else list(faults),
    }


def profile_sha256(profile: Profile) -> str:
    """Return the SHA-256 of all values of a profile that may change a flight."""
    values = profile.model_dump(mode="json", exclude={"name", "description"})
    text = json.dumps([values, camera_record(profile)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def source_sha256(root: Path) -> str:
    """Return the SHA-256 of all modules below `root`, by name and text."""
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root).as_posix()}\n".encode())
        whole.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return whole.hexdigest()


SOURCE = source_sha256(_ROOT)
"""The source as it was loaded; later changes of the files do not count."""


_DESCRIBE = ("describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*")
"""Arguments of git that give the commit, whatever tags it has."""


def commit_of(root: Path) -> str | None:
    """Return the commit of the checkout at `root`; None if it is none, or git cannot say."""
    if not (root / ".git").exists():
        return None
    try:
        return subprocess.run(
            ["git", "-C", str(root), *_DESCRIBE],
            capture_output=True, check=True, timeout=_GIT_S, stdin=subprocess.DEVNULL, text=True,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None


# --- The file ----------------------------------------------------------------------------------


class ResultsFile(Generic[R]):
    """A file of results, open for appending. `earlier` has the flights that it held, by seed."""

    def __init__(self, path: Path, fd: int) -> None:
        self.earlier: dict[int, R] = {}
        self._path, self._fd = path, fd

    def append(self, result: R) -> None:
        """Write a result as one line, which is on the disk when this returns. Errors:
        InvalidValue."""
        self.write({"kind": "flight", **result_record(result)})

    def write(self, record: dict[str, Any]) -> None:
        """Write a record as one line, as `append` does."""
        line, done = json_line(record), 0
        good = os.fstat(self._fd).st_size
        try:
            while done < len(line):
                done += os.write(self._fd, line[done:])
            os.fsync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, good)
            raise cannot_be_written(self._path, error) from None

    def close(self) -> None:
        """Close the file, and release it for another campaign."""
        os.close(self._fd)


def open_results(
    path: Path,
    header: dict[str, Any],
    kind: type[R],
    resume: bool = False,
    force: bool = False,
) -> ResultsFile[R]:
    """Open a new file, or one that the campaign continues. Without `resume` an existing file is
    refused, and with `force` replaced. With `resume` it must have the same profile and faults;
    one that another perchctl wrote needs `force`, too. Errors: InvalidValue."""
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
    file: ResultsFile[R] = ResultsFile(path, fd)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        data = path.read_bytes() if resume else b""
        good = data[: data.rfind(b"\n") + 1]
        if not data.startswith(json_line(_FORM)[:-2][: len(data)]):
            raise InvalidValue(
                f"{path} holds no campaign's results: name the file of one, or a new one"
            )
        source = None
        for number, line in enumerate(good.splitlines(), start=1):
            try:
                source = _read_line(path, line, header, kind, file.earlier) or source
            except ValueError as error:
                raise InvalidValue(
                    f"{path}: line {number}: no line of a campaign's results ({error}): take the "
                    f"original, or name a new file"
                ) from None
        if good and source != header["source"] and not force:
            raise InvalidValue(
                f"{path} was flown by another program (its source is {source!s:.8}, and here it is "
                f"{header['source']:.8}): take that one, name another file, or add --force to go "
                f"on all the same"
            )
        os.ftruncate(fd, len(good))
        if source != header["source"]:
            file.write(header)
        return file
    except BlockingIOError:
        file.close()
        raise InvalidValue(
            f"{path} is being written by another campaign: wait for it, or name another file"
        ) from None
    except BaseException:
        file.close()
        raise


def _read_line(
    path: Path, line: bytes, now: dict[str, Any], kind: type[R], flights: dict[int, R]
) -> str | None:
    """Add the flight of a line to `flights`, or return the program's source that a header names.
    Raises ValueError for any other line, and InvalidValue for the header of another campaign."""
    record = json.loads(line)
    if not isinstance(record, dict):
        raise ValueError("not an object")
    what = record.pop("kind", None)
    if what == "flight":
        result = result_from(record, kind)
        flights.setdefault(result.seed, result)
        return None
    if what != "header":
        raise ValueError(f"kind {what!r}, allowed are header, flight")
    if record.get("version") != VERSION:
        raise ValueError(f"version {record.get('version')!r}, this perchctl reads {VERSION}")
    for key, other in _MUST_AGREE.items():
        if record.get(key) != now[key]:
            raise InvalidValue(
                f"{path} was flown with {other} ({_shown(record, key)}; this campaign has "
                f"{_shown(now, key)}): name the same, or another file"
            )
    return str(record.get("source"))


def _shown(header: dict[str, Any], key: str) -> str:
    """Return a header's value for messages: a profile by its name and the start of its hash."""
    value = header.get(key)
    if key == "profile_sha256":
        return f"{header.get('profile')} {value!s:.8}"
    if key == "faults":
        return ", ".join(map(str, value)) if value else "no faults"
    return f"{value!s:.80}"
