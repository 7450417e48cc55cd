"""A campaign's results, appended line by line as they come, and gone on with later.

Line 1 is a header that says what is flown; then one record a flight (`perchctl.flight.record`).
A line is in the file whole or, where the program or the computer was ended in the middle of it,
is the last one, which goes when the campaign goes on.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import perchctl
from perchctl.errors import InvalidValue
from perchctl.files import cannot_be_written, check_place
from perchctl.flight.record import result_from, result_record
from perchctl.log import camera_record, decode_line, from_exact, json_line
from perchctl.profile import Profile

R = TypeVar("R")

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
    """Of a campaign that begins now."""
    return CampaignHeader(
        perchctl.__version__,
        commit_of(Path(perchctl.__file__).resolve().parents[1]),
        profile.name,
        profile_sha256(profile),
        None if faults is None else tuple(faults),
    )


def profile_sha256(profile: Profile) -> str:
    """Of all that may change a flight."""
    values = profile.model_dump(mode="json", exclude={"name", "description"})
    text = json.dumps([values, camera_record(profile)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def commit_of(root: Path) -> str | None:
    """Of the checkout whose top is `root`; None where it is none, or nobody can say."""
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
    """Open for appending. `earlier`: the flights that it holds already, by seed."""

    def __init__(self, path: Path, fd: int, earlier: dict[int, R]) -> None:
        self.path = path
        self.earlier = earlier
        self._fd = fd

    def append(self, result: R) -> None:
        """One line, on the disk when this returns. Errors: InvalidValue."""
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
    """A new file, or one that is gone on with. Without `resume` an existing file is refused, and
    with `force` replaced. With `resume` it has to be of the same profile and faults; one that
    another perchctl wrote is gone on with by `force` only. Errors: InvalidValue."""
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
    """The newest header, the flights, and how many bytes are whole lines. `check` is asked about
    the headers before a flight is read."""
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
    """Before a flight is read: what is of another campaign is not damaged."""
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
