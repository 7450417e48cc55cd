"""What a worker of a cluster must have before it flies, and how that is verified.

A flight elsewhere is the flight here only by the same program, libraries and data. The program is
known by its source, not by a version that two states of a checkout share.
"""

from __future__ import annotations

import pickle
import platform
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
from distributed import get_worker

import perchctl
from perchctl.calibration import profile_camera
from perchctl.campaign.results_file import SOURCE, profile_sha256
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError
from perchctl.files import cannot_be_written
from perchctl.profile import Profile, read_mask
from perchctl.record import arithmetic_fingerprint

ANSWERS_S = 60.0
_LIBRARIES = ("numpy", "mujoco", "filterpy", "distributed")
"""The libraries that compute a flight's figures or carry them between computers; OpenCV has
several package names and is compared apart."""
_SHORT = 8


@dataclass(frozen=True)
class WorkerRequirements:
    """What each worker of a campaign must have. It is sent with each flight.

    Attributes:
        campaign: a name of its own, by which a worker knows that it was verified already.
        program: perchctl's version, for people; `source` is the hash of its source.
        libraries: Python's and each library's version, by name.
        profiles: what flies, each with the hash of its values and of the files that it names.
        mark: a file in the folder where logs are written, whose text is `campaign`; None without.
    """

    campaign: str
    program: str
    source: str
    libraries: Mapping[str, str]
    profiles: tuple[tuple[Profile, str], ...]
    mark: Path | None = None


@contextmanager
def worker_requirements(
    profiles: Sequence[Profile], folder: Path | None
) -> Iterator[WorkerRequirements]:
    """Yield the requirements of a campaign that begins now; a small file stands in `folder`
    meanwhile. Errors: InvalidValue if it cannot be written."""
    # Their values are sent with each flight; of those that name the same files one is verified.
    different = {(p.camera.calibration, p.camera.mask): p for p in profiles}
    each = tuple((profile, profile_sha256(profile)) for profile in different.values())
    campaign = f"perchctl-{secrets.token_hex(16)}"
    mark = None if folder is None else folder.absolute() / f".{campaign}"
    if mark is not None:
        try:
            mark.write_text(campaign, encoding="ascii")
        except OSError as error:
            raise cannot_be_written(mark, error) from None
    try:
        program = f"perchctl {perchctl.__version__}"
        yield WorkerRequirements(campaign, program, SOURCE, libraries(), each, mark)
    finally:
        if mark is not None:
            with suppress(OSError):
                mark.unlink()


def libraries() -> dict[str, str]:
    """Return the version of each library by its name; of Python the minor version."""
    found = {"python": ".".join(platform.python_version_tuple()[:2]), "opencv": cv2.__version__}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


# --- In the worker's process -------------------------------------------------------------------


@dataclass(frozen=True)
class WorkerReport:
    """A worker's verification of itself. `problem`: why it must not fly, one clause, or None.
    `host`: its computer. `arithmetic`: the fingerprint of its floating-point results."""

    host: str
    problem: str | None
    arithmetic: str = ""


_reports: dict[str, WorkerReport] = {}
"""The reports of this worker, by campaign."""


def fly_verified(order: bytes, required: WorkerRequirements) -> Any:
    """Call the pickled function with its arguments, after verifying a worker that is new.
    Errors: InvalidValue if this worker must not fly; whatever the flight raises."""
    worker = get_worker()
    report = _reports.get(required.campaign) or report_fitness(required, worker)
    if report.problem is not None:
        raise InvalidValue(_unfit(worker.address, report))
    fn, args, named = pickle.loads(order)
    return fn(*args, **named)


def report_fitness(required: WorkerRequirements, dask_worker: Any) -> WorkerReport:
    """Verify this worker and return its report; dask passes `dask_worker`."""
    report = _reports[required.campaign] = fitness(required, dask_worker.state.nthreads)
    return report


def fitness(required: WorkerRequirements, threads: int) -> WorkerReport:
    """Return the report of a process with that number of threads."""
    problem = (
        _other_program(required)
        or _many_threads(threads)
        or _other_data(required)
        or _other_folder(required.mark, required.campaign)
    )
    return WorkerReport(platform.node(), problem, arithmetic_fingerprint())


def _other_program(required: WorkerRequirements) -> str | None:
    here = {required.program: required.source[:_SHORT], **required.libraries}
    there = {f"perchctl {perchctl.__version__}": SOURCE[:_SHORT], **libraries()}
    others = [name for name in {**here, **there} if here.get(name) != there.get(name)]
    if not others:
        return None
    found, wanted = (
        " and ".join(f"{name} {versions[name]}" for name in others if name in versions)
        for versions in (there, here)
    )
    return (
        f"has {found}, and here it is {wanted}: install the same there, and start its workers again"
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


def _other_folder(mark: Path | None, text: str) -> str | None:
    """Return why the log folder is not usable here, or None: the campaign's mark must be
    readable in it."""
    if mark is None:
        return None
    shared = "name one in --log-dir that all computers have at this path"
    try:
        here = mark.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        here = ""
    if here != text:
        return f"does not see what this computer writes to {mark.parent}: {shared}"
    try:
        own = mark.with_name(f"{mark.name}-{secrets.token_hex(8)}")
        own.touch()
        own.unlink()
    except OSError as error:
        return f"cannot write to {mark.parent} ({error.strerror or error}): {shared}"
    return None


# --- In the campaign's process -----------------------------------------------------------------


def verify_cluster(client: Any, address: str, required: WorkerRequirements) -> list[str]:
    """Verify the scheduler, and each worker that is there before the first flight. Returns what is
    worth a note, a sentence each. Errors: InvalidValue if one of them must not fly, or the
    scheduler has another version of distributed; ConnectionFailed."""
    try:
        versions = client.sync(client.scheduler.versions, callback_timeout=ANSWERS_S)
        here, there = required.libraries["distributed"], versions["packages"]["distributed"]
        if here != there:
            raise InvalidValue(
                f"the scheduler at {address} has distributed {there}, and here it is {here}: "
                f"install the same there or here, and start it again"
            )
        answers: Mapping[str, WorkerReport | Exception] = client.sync(
            client._run, report_fitness, required, on_error="return", callback_timeout=ANSWERS_S
        )
    except (OSError, TimeoutError) as error:
        raise ConnectionFailed(
            f"not all workers of the scheduler at {address} answer within {ANSWERS_S:.0f} s: look "
            f"at what it says, and end the workers that hang"
        ) from error
    found = [_problem(address, answers[address]) for address in sorted(answers)]
    problems = [problem for problem in found if problem is not None]
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InvalidValue(problems[0] + more)
    fit = [report for report in answers.values() if isinstance(report, WorkerReport)]
    others = sum(report.arithmetic != arithmetic_fingerprint() for report in fit)
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
    return (
        f"worker {address} cannot load what flies ({type(answer).__name__}: {answer}): install "
        f"this computer's perchctl there, with the extras sim and cluster"
    )


def _unfit(address: str, report: WorkerReport) -> str:
    return f"worker {address} on {report.host} {report.problem}"
