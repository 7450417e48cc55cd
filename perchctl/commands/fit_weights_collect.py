"""The work behind `perchctl fit-weights --collect`: a session's file, filled with positions."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from perchctl.calibration import profile_camera
from perchctl.camera import open_camera
from perchctl.commands.fit_weights_request import CollectRequest
from perchctl.commands.output import say
from perchctl.commands.progress import count_bar
from perchctl.errors import InvalidValue, UsageError, no_simulator
from perchctl.profile import PositioningConfig, Profile, load_profile
from perchctl.vision import CameraModel
from perchctl.weights import (
    EstimateTruth,
    Experiment,
    MocapTruth,
    SessionFile,
    TypedTruth,
    four_numbers,
)

TRUTHS = ("typed", "mocap", "estimate", "sim")
VEHICLE, TARGET = "cf", "target"
"""Rigid bodies that nobody has named."""
_DEGREES = (1.0, math.pi / 180.0)


def collect(request: CollectRequest, path: Path) -> None:
    """Fill the session's file with positions; it is continued where it was stopped.

    Errors: UsageError, NotFound, InvalidValue, TimedOut, Interrupted, ConnectionFailed.
    """
    if request.truth not in TRUTHS:
        raise InvalidValue(f"--truth {request.truth!r} is unknown; allowed are {', '.join(TRUTHS)}")
    for name, least in (("positions", 2), ("frames", 10)):
        if getattr(request, name) < least:
            raise InvalidValue(f"--{name} {getattr(request, name)} must be at least {least}")
    for name in ("noise", "blur"):
        if not 0.0 <= getattr(request, name) <= 50.0:
            raise InvalidValue(f"--{name} {getattr(request, name):g} must be between 0 and 50")
    profile = load_profile(request.profile, with_weights=False)
    camera = profile_camera(profile.camera)
    if request.truth == "sim":
        _collect_simulated(request, path, profile, camera)
    else:
        _collect_with_person(request, path, profile, camera)


def _open_session(path: Path, frames: int) -> SessionFile:
    session = SessionFile(path, frames)
    if session.note:
        say(session.note)
    if session.done:
        say(f"{session.path} holds {len(session.done)} positions already")
    return session


def _collect_simulated(
    request: CollectRequest, path: Path, profile: Profile, camera: CameraModel
) -> None:
    try:
        from perchctl.weights import SimulatedStand
    except ImportError as error:
        raise no_simulator(error.name) from None

    session = _open_session(path, request.frames)
    stand = SimulatedStand(
        profile, camera, request.positions, request.seed, request.noise, request.blur
    )
    left = max(0, request.positions - len(session.done))
    with count_bar("frames", left * request.frames) as advance:
        stand.fill(session, left, request.frames, advance)


def _collect_with_person(
    request: CollectRequest, path: Path, profile: Profile, camera: CameraModel
) -> None:
    start_s = time.monotonic()

    def now() -> float:
        return time.monotonic() - start_s

    spec = profile.camera.source if request.source is None else request.source
    if spec.startswith("sim:"):
        raise UsageError(
            "the simulator has the truth itself: add --truth sim, or name a real camera "
            "with --source (camera:N, http://..., aideck://HOST)"
        )
    with ExitStack() as stack:
        truth = _truth(request, profile, now)
        stack.callback(truth.close)
        source = open_camera(spec, now, profile.camera, size_px=camera.size_px)
        stack.callback(source.close)
        experiment = Experiment(
            _open_session(path, request.frames),
            source,
            profile,
            camera,
            truth,
            ask=_ask,
            say=say,
            bar=count_bar,
            now=now,
            wait=time.sleep,
        )
        experiment.run(request.positions, request.frames)


def _truth(
    request: CollectRequest, profile: Profile, now: Callable[[], float]
) -> TypedTruth | MocapTruth | EstimateTruth:
    gear = np.asarray(profile.vehicle.gear_body_m, dtype=np.float64)
    given = None if request.target is None else four_numbers(request.target, _DEGREES)
    if request.truth == "typed":
        return TypedTruth()
    if request.truth == "mocap":
        own = profile.positioning if profile.positioning.by == "mocap" else None
        mocap, (body, target) = _capture_of(request, own)
        return MocapTruth.open(mocap, body, target if given is None else given, gear, own)
    from perchctl.link import EstimateLink

    link = EstimateLink(profile.link.uri if request.uri is None else request.uri, profile.link, now)
    link.connect()
    return EstimateTruth(link.telemetry, given, gear, link.close)


def _capture_of(
    request: CollectRequest, own: PositioningConfig | None
) -> tuple[str, tuple[str, str]]:
    """``TYPE:HOST``, and the rigid bodies of vehicle and target: of the options, else as the
    profile (`own`) has them. Errors: UsageError."""
    mocap = request.mocap
    if mocap is None and own is not None:
        mocap = f"{own.system}:{own.host}"
    if mocap is None or not mocap.partition(":")[2].strip():
        raise UsageError(
            "--truth mocap needs --mocap TYPE:HOST, as in vicon:192.168.1.2, or a profile with "
            "positioning: {by: mocap, system: vicon, host: 192.168.1.2}"
        )
    if request.bodies is None:
        return mocap, (VEHICLE if own is None else own.body, TARGET)
    body, _, target = request.bodies.partition(",")
    return mocap, (body, target)


def _ask(question: str) -> str:
    """On stderr, as stdout is for the result. Raises EOFError at the end of the input."""
    print(question, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\n")
