"""What a worker of a cluster must have before it flies, and how that is verified.

A flight elsewhere is the flight here only by the same program, libraries and data. The program is
known by its source, not by a version that two states of a checkout share.
"""

from __future__ import annotations

import asyncio
import hashlib
import pickle
import platform
import secrets
import traceback
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
from distributed import get_worker

import perchctl
from perchctl.calibration import profile_camera
from perchctl.campaign.results_file import commit_of, profile_sha256
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError
from perchctl.files import cannot_be_written
from perchctl.log import arithmetic_fingerprint
from perchctl.profile import Profile, read_mask

ANSWERS_S = 60.0
SEEN_S = 10.0
"""A shared folder may show so late what another computer has written."""
_POLL_S = 0.05
_LIBRARIES = ("numpy", "mujoco", "filterpy", "distributed")
"""Beside OpenCV, which comes under several names: what computes a flight's figures, and what
carries them, of which two versions may not understand each other."""
_ROOT = Path(perchctl.__file__).resolve().parent
_SHORT = 8


@dataclass(frozen=True)
class WorkerRequirements:
    """What each worker of a campaign must have. It is sent with each flight.

    Attributes:
        campaign: a name of its own, by which a worker knows that it was verified already.
        program: perchctl's version, and its commit in a checkout, for people.
        source: hash of its source.
        libraries: Python's and each library's version, by name.
        profiles: what flies, each with the hash of its values and of the files that it names.
        folder: where logs are written; `token` is the text of a file in it.
    """

    campaign: str
    program: str
    source: str
    libraries: tuple[tuple[str, str], ...]
    profiles: tuple[tuple[Profile, str], ...]
    folder: Path | None = None
    token: str = ""

    @property
    def mark(self) -> Path:
        """The file in `folder`."""
        assert self.folder is not None
        return self.folder / f".{self.campaign}"


@contextmanager
def worker_requirements(
    profiles: Sequence[Profile], folder: Path | None
) -> Iterator[WorkerRequirements]:
    """Yield the requirements of a campaign that begins now; a small file stands in `folder`
    meanwhile. Errors: InvalidValue if it cannot be written."""
    # Their values are sent with each flight; of those that name the same files one is verified.
    different = {(p.camera.calibration, p.camera.mask): p for p in profiles}
    each = tuple((profile, profile_sha256(profile)) for profile in different.values())
    required = WorkerRequirements(
        f"perchctl-{secrets.token_hex(8)}", program(), SOURCE, libraries(), each,
        None if folder is None else folder.absolute(), secrets.token_hex(16),
    )  # fmt: skip
    if folder is None:
        yield required
        return
    try:
        required.mark.write_text(required.token, encoding="ascii")
    except OSError as error:
        raise cannot_be_written(required.mark, error) from None
    try:
        yield required
    finally:
        with suppress(OSError):
            required.mark.unlink()


def program() -> str:
    """perchctl's version, with the commit of a checkout."""
    commit = commit_of(_ROOT.parent)
    return f"perchctl {perchctl.__version__}" + (f" ({commit})" if commit else "")


def source_sha256(root: Path) -> str:
    """The hash of all modules below `root`, by name and text."""
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root).as_posix()}\n".encode())
        whole.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return whole.hexdigest()


SOURCE = source_sha256(_ROOT)
"""As it was loaded: a worker that runs on while its files change does not have the new program."""


def libraries() -> tuple[tuple[str, str], ...]:
    """Name and version of each library; of Python only what its bug fixes share."""
    python = ".".join(platform.python_version_tuple()[:2])
    others = [(name, _version(name)) for name in _LIBRARIES]
    return (("python", python), ("opencv", cv2.__version__), *others)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


# --- In the worker's process -------------------------------------------------------------------


@dataclass(frozen=True)
class WorkerReport:
    """What a worker found of itself. `problem`: why it must not fly, one clause; None if it may.
    `host`: its computer. `arithmetic`: how it calculates. `file`: the name of the one that it has
    left in the folder, to be seen by the campaign's computer."""

    host: str
    problem: str | None
    arithmetic: str = ""
    file: str = ""


_reports: dict[str, WorkerReport] = {}
"""Of this worker, by campaign."""


def report_fitness(required: WorkerRequirements, dask_worker: Any = None) -> WorkerReport:
    """The report of a worker that is there before the first flight. It leaves a file in the
    folder, which the campaign's computer looks for and takes away."""
    name = f".{required.campaign}-{dask_worker.id}"
    report = fitness(required, dask_worker.state.nthreads, name)
    if report.problem is None:
        _reports[required.campaign] = report
    return report


def fly_order(order: bytes, required: WorkerRequirements) -> bytes:
    """Fly one `flight_order`; a worker that came later is verified now. Returns the pickled pair
    of whether that succeeded, and its result or its error."""
    worker = get_worker()
    report = _reports.get(required.campaign)
    if report is None:
        report = fitness(required, worker.state.nthreads)
        _reports[required.campaign] = report
    if report.problem is not None:
        return pickle.dumps((False, InvalidValue(_unfit(worker.address, report))))
    answer: tuple[bool, Any]
    try:
        fn, args = pickle.loads(order)
        answer = True, fn(*args)
    except Exception as error:
        error.add_note(traceback.format_exc())  # pickle drops where it was raised
        answer = False, error
    try:
        return pickle.dumps(answer)
    except Exception as error:
        return pickle.dumps((False, RuntimeError(f"a result that cannot be sent: {error}")))


def flight_order(fn: Callable[..., Any], args: tuple[Any, ...]) -> bytes:
    """A flight in the form in which it is sent."""
    return pickle.dumps((fn, args))


def fitness(required: WorkerRequirements, threads: int, file: str = "") -> WorkerReport:
    """The report of this process. `threads`: flights that it would fly at a time; `file`: the name
    of the one that it leaves in the folder, empty for none."""
    host = platform.node()
    problem = (
        _other_program(required)
        or _other_libraries(required)
        or _many_threads(threads)
        or _other_data(required)
        or _other_folder(required, file)
    )
    if problem is not None:
        return WorkerReport(host, problem)
    return WorkerReport(host, None, arithmetic_fingerprint(), file)


def _other_program(required: WorkerRequirements) -> str | None:
    if required.source == SOURCE:
        return None
    return (
        f"has {program()} with the source {SOURCE[:_SHORT]}, and here it is {required.program} "
        f"with {required.source[:_SHORT]}: install the same there, and start its workers again"
    )


def _other_libraries(required: WorkerRequirements) -> str | None:
    own = dict(libraries())
    others = [(name, here) for name, here in required.libraries if own.get(name, "none") != here]
    if not others:
        return None
    there = " and ".join(f"{name} {own.get(name, 'none')}" for name, _ in others)
    here = " and ".join(f"{name} {value}" for name, value in others)
    return (
        f"has {there}, and here it is {here}: install the same there, and start its workers again"
    )


def _many_threads(threads: int) -> str | None:
    if threads == 1:
        return None
    return (
        f"flies {threads} flights in one process, and would get in its own way: start it as "
        f"dask worker --nthreads 1 --nworkers {threads}"
    )


def _other_data(required: WorkerRequirements) -> str | None:
    for profile, sha256 in required.profiles:
        if profile_sha256(profile) == sha256:
            continue
        try:
            camera = profile_camera(profile.camera)
            if profile.camera.mask is not None:
                read_mask(profile.camera.mask, camera.size_px)
        except PerchError as error:
            return f"cannot fly {profile.name}: {error}; bring the file there, to the same path"
        files = " or ".join(str(f) for f in (profile.camera.calibration, profile.camera.mask) if f)
        return (
            f"has another {files} for {profile.name} than there is here: bring this computer's "
            f"there"
        )
    return None


def _other_folder(required: WorkerRequirements, file: str) -> str | None:
    if required.folder is None:
        return None
    shared = "name one in --log-dir that all computers have at this path"
    try:
        here = required.mark.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        here = ""
    if here != required.token:
        return f"does not see what this computer writes to {required.folder}: {shared}"
    mark = required.folder / (file or f".{required.campaign}-{secrets.token_hex(8)}")
    try:
        mark.write_text(required.token, encoding="ascii")
        if not file:
            mark.unlink()
    except OSError as error:
        return f"cannot write to {required.folder} ({error.strerror or error}): {shared}"
    return None


# --- In the campaign's process -----------------------------------------------------------------


async def verify_scheduler(client: Any, address: str) -> None:
    """Errors: InvalidValue if it has another version of distributed; ConnectionFailed."""
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


async def verify_workers(client: Any, required: WorkerRequirements) -> list[str]:
    """Verify each worker that is there before the first flight. Returns what is worth a note, a
    sentence each. Errors: InvalidValue if one of them must not fly; ConnectionFailed."""
    try:
        run = client.run(report_fitness, required, on_error="return")
        answers: Mapping[str, WorkerReport | Exception] = await asyncio.wait_for(run, ANSWERS_S)
    except (OSError, TimeoutError) as error:
        raise ConnectionFailed(
            f"not all workers answer within {ANSWERS_S:.0f} s: look at the scheduler, and end the "
            f"workers that hang"
        ) from error
    found = {address: _problem(address, answers[address]) for address in sorted(answers)}
    problems = [problem for problem in found.values() if problem is not None]
    fit = {a: r for a, r in answers.items() if isinstance(r, WorkerReport) and r.problem is None}
    problems += [each async for each in _unseen_files(required, fit)]
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InvalidValue(problems[0] + more)
    others = sum(report.arithmetic != arithmetic_fingerprint() for report in fit.values())
    if not others:
        return []
    return [
        f"{others} of {len(fit)} workers have another processor, and calculate otherwise in the "
        f"last bits: a seed's flight there may differ from the one here"
    ]


def _problem(address: str, answer: WorkerReport | Exception) -> str | None:
    if isinstance(answer, WorkerReport):
        return None if answer.problem is None else _unfit(address, answer)
    if isinstance(answer, OSError) and not isinstance(answer, FileNotFoundError):
        return None  # it has gone by now; should it come back, its first flight verifies it
    return cannot_load(f"worker {address}", answer)


def _unfit(address: str, report: WorkerReport) -> str:
    return f"worker {address} on {report.host} {report.problem}"


def cannot_load(who: str, error: BaseException) -> str:
    """The sentence on a worker that lacks what it needs to fly."""
    return (
        f"{who} cannot load what flies ({type(error).__name__}: {error}): install this "
        f"computer's perchctl there, with the extras sim and cluster"
    )


async def _unseen_files(
    required: WorkerRequirements, fit: Mapping[str, WorkerReport]
) -> AsyncIterator[str]:
    """A sentence on each worker whose file in the folder does not show here; all are removed."""
    if required.folder is None:
        return
    end_s = asyncio.get_running_loop().time() + SEEN_S
    for address, report in sorted(fit.items()):
        left = required.folder / report.file
        while not _removed(left, required.token):
            if asyncio.get_running_loop().time() > end_s:
                yield (
                    f"what worker {address} on {report.host} writes to {required.folder} is not "
                    f"seen here: name a folder in --log-dir that all computers share"
                )
                break
            await asyncio.sleep(_POLL_S)


def _removed(path: Path, token: str) -> bool:
    try:
        if path.read_text(encoding="ascii") != token:
            return False
        path.unlink()
    except (OSError, UnicodeDecodeError):
        return False
    return True
