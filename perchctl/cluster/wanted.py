"""What a campaign's computer asks of each worker, and what a worker answers.

A flight elsewhere is the flight here only by the same program, libraries and data. The program is
told by its source, not by a version that two states of a checkout share.
"""

from __future__ import annotations

import hashlib
import platform
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2

import perchctl
from perchctl.calibration import profile_camera
from perchctl.errors import PerchError
from perchctl.files import cannot_be_written
from perchctl.flight import commit_of, profile_sha256
from perchctl.log import arithmetic_fingerprint
from perchctl.profile import Profile, read_mask

_LIBRARIES = ("numpy", "mujoco", "filterpy", "distributed")
"""Beside OpenCV, which comes under several names: what a flight's figures are made by, and what
carries them, of which two versions may not understand each other."""
_ROOT = Path(perchctl.__file__).resolve().parent
_SHORT = 8


@dataclass(frozen=True)
class Wanted:
    """Sent with each flight.

    Attributes:
        campaign: a name of its own, by which a worker knows that it was asked already.
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
def wanted(profiles: Sequence[Profile], folder: Path | None) -> Iterator[Wanted]:
    """Of a campaign that begins now. In `folder` a small file stands meanwhile. Errors:
    InvalidValue, where it cannot."""
    # Their values are sent with each flight; of those that name the same files one is asked.
    different = {(p.camera.calibration, p.camera.mask): p for p in profiles}
    each = tuple((profile, profile_sha256(profile)) for profile in different.values())
    asked = Wanted(
        f"perchctl-{secrets.token_hex(8)}", program(), SOURCE, libraries(), each,
        None if folder is None else folder.absolute(), secrets.token_hex(16),
    )  # fmt: skip
    if folder is None:
        yield asked
        return
    try:
        asked.mark.write_text(asked.token, encoding="ascii")
    except OSError as error:
        raise cannot_be_written(asked.mark, error) from None
    try:
        yield asked
    finally:
        with suppress(OSError):
            asked.mark.unlink()


def program() -> str:
    commit = commit_of(_ROOT.parent)
    return f"perchctl {perchctl.__version__}" + (f" ({commit})" if commit else "")


def source_sha256(root: Path) -> str:
    """Of all modules below, by name and text."""
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root).as_posix()}\n".encode())
        whole.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return whole.hexdigest()


SOURCE = source_sha256(_ROOT)
"""As it was loaded: a worker that runs on while its files change is none of the new program."""


def libraries() -> tuple[tuple[str, str], ...]:
    """Name and version. Of Python what its bug fixes share."""
    python = ".".join(platform.python_version_tuple()[:2])
    others = [(name, _version(name)) for name in _LIBRARIES]
    return (("python", python), ("opencv", cv2.__version__), *others)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


@dataclass(frozen=True)
class Answer:
    """A worker's. `problem`: why it must not fly, one clause; None: it may. `host`: its computer.
    `arithmetic`: how it calculates. `left`: the file that it has written, to be seen here."""

    host: str
    problem: str | None
    arithmetic: str = ""
    left: str = ""


def answer_to(asked: Wanted, threads: int, name: str = "") -> Answer:
    """In the worker's process. `threads`: flights that it would fly at a time; `name`: of the
    file that it leaves in the folder."""
    host = platform.node()
    problem = (
        _other_program(asked)
        or _other_libraries(asked)
        or _many_threads(threads)
        or _other_data(asked)
        or _other_folder(asked, name)
    )
    if problem is not None:
        return Answer(host, problem)
    return Answer(host, None, arithmetic_fingerprint(), name)


def _other_program(asked: Wanted) -> str | None:
    if asked.source == SOURCE:
        return None
    return (
        f"has {program()} with the source {SOURCE[:_SHORT]}, and here it is {asked.program} with "
        f"{asked.source[:_SHORT]}: install the same there, and start its workers again"
    )


def _other_libraries(asked: Wanted) -> str | None:
    own = dict(libraries())
    others = [(name, here) for name, here in asked.libraries if own.get(name, "none") != here]
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


def _other_data(asked: Wanted) -> str | None:
    for profile, sha256 in asked.profiles:
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


def _other_folder(asked: Wanted, name: str) -> str | None:
    if asked.folder is None:
        return None
    shared = "name one in --log-dir that all computers have at this path"
    try:
        here = asked.mark.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        here = ""
    if here != asked.token:
        return f"does not see what this computer writes to {asked.folder}: {shared}"
    mark = asked.folder / (name or f".{asked.campaign}-{secrets.token_hex(8)}")
    try:
        mark.write_text(asked.token, encoding="ascii")
        if not name:
            mark.unlink()
    except OSError as error:
        return f"cannot write to {asked.folder} ({error.strerror or error}): {shared}"
    return None
