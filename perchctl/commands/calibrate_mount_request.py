"""The command line of `perchctl calibrate --mount`, and what of it can be refused at once."""

from __future__ import annotations

import itertools
import os
import shlex
from dataclasses import dataclass, fields
from pathlib import Path

from perchctl.calibration import MountingPart, profile_camera
from perchctl.camera import parse_source, without_password
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_output, check_place
from perchctl.link import check_uri
from perchctl.profile import Profile, find_profile, load_profile, writable_profile
from perchctl.vision import CameraModel

PARTS: dict[str, tuple[MountingPart, ...]] = {
    "carry": ("carry",),
    "pivot": ("pivot",),
    "both": ("carry", "pivot"),
}
FOLDER = Path("calib")
_SIMULATED = (
    "stands on the simulator's floor, where no hand moves it: add --truth sim, or name a real one"
)


@dataclass(frozen=True)
class MountRequest:
    """Its own options as they were given; None is not given."""

    profile: str | None = None
    uri: str | None = None
    source: str | None = None
    part: str | None = None
    logs: tuple[Path, ...] = ()
    truth: str | None = None
    seed: int | None = None
    write: bool = False

    def given(self) -> str | None:
        """The first option that was, as it is typed."""
        names = {"logs": "from"}
        for field in fields(self):
            if getattr(self, field.name) != field.default:
                return f"--{names.get(field.name, field.name)}"
        return None


@dataclass(frozen=True)
class MountOptions:
    """The command line on top of the profile, checked.

    Attributes:
        name: the profile's, as it was given.
        parts: those to be done.
        into: the profile's file where the numbers are to be written.
        log: where a live recording goes.
        uri: None: no vehicle is asked.
    """

    request: MountRequest
    name: str
    profile: Profile
    camera: CameraModel
    parts: tuple[MountingPart, ...]
    into: Path | None
    report: Path
    log: Path
    source: str = ""
    uri: str | None = None

    @property
    def again(self) -> str:
        """The command line that measures from the live recording."""
        return self._command("--from", str(self.log))

    @property
    def once_more(self) -> str:
        """The command line that does this again: from the recordings, where there are any."""
        request = self.request
        if self.log.exists() and not (request.logs or request.truth):
            return self._command("--from", str(self.log), "--write")
        words = [word for log in request.logs for word in ("--from", str(log))]
        for option in ("uri", "source", "truth", "seed", "part"):
            value = getattr(request, option)
            words += [] if value is None else [f"--{option}", str(value)]
        return self._command(*words, "--write")

    def _command(self, *words: str) -> str:
        return shlex.join(["perchctl", "calibrate", "--mount", "-p", self.name, *words])


def resolve(request: MountRequest, output: Path | None, force: bool, page: bool) -> MountOptions:
    """Errors: NotFound, InvalidValue, UsageError."""
    _check_together(request, page)
    if request.part is not None and request.part not in PARTS:
        raise InvalidValue(f"--part {request.part!r} is unknown; allowed are {', '.join(PARTS)}")
    name = request.profile or ("sim" if request.truth else None)
    if name is None:
        raise UsageError(
            "--mount needs a profile (-p): what is measured is compared with what it says"
        )
    profile = load_profile(name)
    parts = PARTS[request.part or "both"]
    into = writable_profile(name) if request.write else None
    if request.truth and request.write and not is_simulated(profile):
        raise UsageError(
            f"--truth sim measures a simulated vehicle, and {name} flies {profile.link.uri} with "
            f"{without_password(profile.camera.source)}: leave --write out"
        )
    live = not (request.logs or request.truth)
    source, uri = _live(request, profile, parts) if live else ("", None)
    report, log = _places(output, find_profile(name).stem, force, live)
    camera = profile_camera(profile.camera)
    return MountOptions(request, name, profile, camera, parts, into, report, log, source, uri)


def is_simulated(profile: Profile) -> bool:
    """Whether neither vehicle nor camera is a real one."""
    return check_uri(profile.link.uri) == "sim" and profile.camera.source.startswith("sim:")


def _check_together(request: MountRequest, page: bool) -> None:
    """What excludes each other."""
    if request.truth not in (None, "sim"):
        raise InvalidValue(f"--truth {request.truth!r} is unknown; with --mount it is sim")
    if request.seed is not None and request.truth is None:
        raise UsageError("--seed is the simulator's: add --truth sim")
    other = "--truth sim" if request.truth else "--from" if request.logs else None
    if other is None:
        return
    for name in ("uri", "source"):
        if getattr(request, name) is not None:
            raise UsageError(f"{other} takes no camera and no vehicle: leave --{name} out")
    if request.truth and request.logs:
        raise UsageError("--truth sim makes its own recordings: leave --from out")
    if page:
        raise UsageError(f"{other} shows no live page: leave --view out")


def _live(
    request: MountRequest, profile: Profile, parts: tuple[MountingPart, ...]
) -> tuple[str, str | None]:
    """The camera, and the vehicle where the carry needs it (or it was named)."""
    given = profile.camera.source if request.source is None else request.source
    if given.startswith("sim:"):
        raise UsageError(
            f"camera {given} {_SIMULATED} with --source (camera:N, http://..., aideck://HOST)"
        )
    name = parse_source(given, files=True)
    source = name.spec
    named = request.uri if request.uri is not None else os.environ.get("CFLIB_URI")
    if "carry" not in parts and request.uri is None:
        return source, None
    if not name.live:
        raise UsageError(
            f"{name} is a recording, and has not the vehicle's clock: the "
            f"carry needs a live camera; --part pivot needs no vehicle"
        )
    uri = profile.link.uri if named is None else named
    if check_uri(uri) == "sim":
        raise UsageError(f"vehicle {uri} {_SIMULATED} with -u; --part pivot needs none")
    return source, uri


def _places(output: Path | None, name: str, force: bool, live: bool) -> tuple[Path, Path]:
    """The report and, beside it, a live recording. Those that are not named by `output` take
    the next name that is free, so that nothing is measured in vain."""
    if output is None:
        stems = (f"mounting_{name}{'' if n == 1 else f'_{n}'}" for n in itertools.count(1))
        pairs = ((FOLDER / f"{stem}.png", FOLDER / f"{stem}.jsonl") for stem in stems)
        report, log = next(p for p in pairs if not (p[0].exists() or p[1].exists()))
    else:
        report, log = output, output.with_suffix(".jsonl")
    check_output(report, (".png",), force, "the report's format")
    if live:
        check_place(log, force)
    return report, log
