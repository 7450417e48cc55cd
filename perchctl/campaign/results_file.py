"""The results of a campaign on disk: a file that grows by one line per flight, and the logs.

Line 1 of the file is a header that describes the campaign. One record per flight follows.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

import perchctl
from perchctl.campaign.results import CampaignFlight
from perchctl.errors import InvalidValue
from perchctl.files import check_writable, write_error
from perchctl.profile import Profile
from perchctl.record import (
    camera_record,
    from_exact_json,
    json_line,
    to_exact_json,
)

R = TypeVar("R", bound=CampaignFlight)


class CampaignResults(Generic[R]):
    """The results file of a campaign. `earlier` contains the results read from it, and `remaining`
    the seeds that have not been flown yet."""

    def __init__(
        self,
        seeds: Sequence[int],
        earlier: dict[int, R],
        file: BinaryIO | None = None,
    ) -> None:
        self.earlier = [earlier[seed] for seed in seeds if seed in earlier]
        self.remaining = [seed for seed in seeds if seed not in earlier]
        self._file = file

    def write_result(self, result: R) -> None:
        """Append the result of a flight to the file, and sync it to disk. Errors: InvalidValue."""
        if self._file is not None:
            _write(self._file, {"kind": "flight", **to_exact_json(result)})


@contextmanager
def campaign_results(
    profile: Profile,
    seeds: Sequence[int],
    result_type: type[R],
    *,
    faults: Sequence[str] | None = None,
    fleet: str | None = None,
    out: Path | None = None,
    resume: bool = False,
    force: bool = False,
    log_dir: Path | None = None,
) -> Iterator[CampaignResults[R]]:
    """Yield the results (of class `result_type`) of a campaign, appended to the file `out`.

    An existing file is an error unless it is to be replaced (`force`) or continued (`resume`). To
    be continued, the file must come from the same program, profile, faults and `fleet` (a hash of
    everything that affects a fleet's flight; None for single flights). Errors: InvalidValue, also
    if `log_dir` is not writable.
    """
    if log_dir is not None:
        check_writable(log_dir / "flight.jsonl", force=True)
    if out is None:
        yield CampaignResults(seeds, {})
        return
    if out.is_file() and not (force or resume):
        raise InvalidValue(
            f"{out} already exists; add --resume to continue it, --force to replace it, or "
            "name another file"
        )
    check_writable(out, force=True, makes_folder=False)
    header = campaign_header(profile, faults, fleet)
    earlier: dict[int, R] = {}
    good = 0
    with ExitStack() as stack:
        try:
            if resume and out.exists():
                good = _read(out, header, result_type, earlier)
            file = stack.enter_context(out.open("ab", buffering=0))
            file.truncate(good)
        except OSError as error:
            raise write_error(out, error) from None
        if not good:
            _write(file, header)
        yield CampaignResults(seeds, earlier, file)


# --- The header ---


SOURCE = Path(perchctl.__file__).resolve().parent
VERSION = 2
_FORM = {"kind": "header", "format": "perchctl-campaign", "version": VERSION}
_MUST_AGREE = {
    "source": "program",
    "profile_sha256": "profile",
    "faults": "selection of faults",
    "fleet_sha256": "fleet",
}


def campaign_header(
    profile: Profile, faults: Sequence[str] | None = None, fleet: str | None = None
) -> dict[str, Any]:
    """The first line of a new campaign's file.

    `perchctl` is the version, `source` the hash of the source code, `profile` the profile's name,
    `profile_sha256` the hash of calibration and profile without name and description. `faults`:
    names of the faults to draw from, or None. `fleet_sha256`: the hash of all vehicles of a fleet;
    absent for single flights.
    """
    return {
        **_FORM,
        "perchctl": perchctl.__version__,
        "source": source_sha256(),
        "profile": profile.name,
        "profile_sha256": profile_sha256(profile),
        "faults": None if faults is None else list(faults),
        **({} if fleet is None else {"fleet_sha256": fleet}),
    }


def profile_sha256(profile: Profile) -> str:
    """The SHA-256 of all profile values that can affect a flight."""
    values = profile.model_dump(mode="json", exclude={"name", "description"})
    text = json.dumps([values, camera_record(profile)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def source_sha256(root: Path = SOURCE) -> str:
    """The SHA-256 of the names and contents of all modules below `root`; cached, so that later
    changes to the files have no effect."""
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root).as_posix()}\n".encode())
        whole.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return whole.hexdigest()


# --- Lines ---


def _write(file: BinaryIO, record: dict[str, Any]) -> None:
    try:
        line = memoryview(json_line(record))
        while line:
            line = line[file.write(line) :]
        os.fsync(file.fileno())
    except OSError as error:
        raise write_error(Path(file.name), error) from None


def _read(path: Path, header: dict[str, Any], result_type: type[R], earlier: dict[int, R]) -> int:
    """Add the flights in a file to `earlier`, keyed by seed, and return the total length of its
    complete lines. Errors: InvalidValue if the file is not a results file, or belongs to another
    campaign."""
    data = path.read_bytes()
    good = data[: data.rfind(b"\n") + 1]
    if not good and json_line(header).startswith(data):
        return 0
    try:
        found, *flights = map(json.loads, good.splitlines())
        if any(found.get(key) != value for key, value in _FORM.items()):
            raise ValueError(f"no header of version {VERSION}")
        others = [name for key, name in _MUST_AGREE.items() if found.get(key) != header.get(key)]
        if others:
            raise InvalidValue(
                f"the flights in {path} were made with a different "
                f"{' and a different '.join(others)}: use the same, or name another file"
            )
        if any(flight.pop("kind") != "flight" for flight in flights):
            raise ValueError("a line does not describe a flight")
        results = [from_exact_json(result_type, flight) for flight in flights]
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise InvalidValue(
            f"{path}: not the results of a campaign ({error}): use the original, or name a new file"
        ) from None
    for result in results:
        earlier.setdefault(result.seed, result)
    return len(good)
