"""The work behind `perchctl fit-weights --collect`: a session's file, filled with positions."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perchctl.calibration.files import load_calibration
from perchctl.camera.mirror import UnmirroredSource
from perchctl.camera.open import open_source
from perchctl.camera.source import FrameSource
from perchctl.commands.progress import count_bar
from perchctl.errors import InvalidValue, UsageError
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.vision.types import CameraModel
from perchctl.weights.collect import Eye, SessionFile, collecting_pipeline, fault_of, rows_of
from perchctl.weights.dialogue import Experiment
from perchctl.weights.truth import EstimateTruth, MocapTruth, Truth, TypedTruth, four_numbers

TRUTHS = ("typed", "mocap", "estimate", "sim")
_DEGREES = (1.0, math.pi / 180.0)


@dataclass(frozen=True)
class CollectOptions:
    """What to collect, and where its truth is from."""

    session: Path
    profile: str
    positions: int = 10
    frames: int = 100
    truth: str = "typed"
    source: str | None = None
    uri: str | None = None
    mocap: str | None = None
    bodies: str = "cf,target"
    target: str | None = None
    seed: int = 0
    noise: float = 4.0
    blur: float = 1.0


def collect(options: CollectOptions) -> None:
    """Fill the session's file with positions; it is continued where it was stopped.

    Errors: UsageError, NotFound, InvalidValue, TimedOut, Interrupted, ConnectionFailed.
    """
    if options.truth not in TRUTHS:
        raise InvalidValue(f"--truth {options.truth!r} is unknown; allowed are {', '.join(TRUTHS)}")
    for name, least in (("positions", 2), ("frames", 10)):
        if getattr(options, name) < least:
            raise InvalidValue(f"--{name} {getattr(options, name)} must be at least {least}")
    for name in ("noise", "blur"):
        if not 0.0 <= getattr(options, name) <= 50.0:
            raise InvalidValue(f"--{name} {getattr(options, name):g} must be between 0 and 50")
    profile = load_profile(options.profile, with_weights=False)
    camera = load_calibration(find_calibration(profile.camera.calibration))
    if options.truth == "sim":
        _collect_simulated(options, profile, camera)
    else:
        _collect_with_person(options, profile, camera)


def _session(options: CollectOptions) -> SessionFile:
    session = SessionFile(options.session, options.frames)
    if session.note:
        _say(session.note)
    if session.done:
        _say(f"{session.path} holds {len(session.done)} positions already")
    return session


def _collect_simulated(options: CollectOptions, profile: Profile, camera: CameraModel) -> None:
    try:
        from perchctl.weights.simulated import Stand
    except ImportError as error:
        raise UsageError(
            f"the simulator is not installed ({error.name} is missing); install it with: "
            f"{sys.executable} -m pip install 'perchctl[sim]'"
        ) from None

    session = _session(options)
    stand = Stand(profile, camera, options.positions, options.seed, options.noise, options.blur)
    setup = collecting_pipeline(profile, camera)
    left = max(0, options.positions - len(session.done))
    with count_bar("frames", left * options.frames) as advance:
        for position in range(session.next_position, session.next_position + left):
            place, eye, sights = stand.place(position), Eye(setup), []
            for frame in stand.frames(position, place, options.frames):
                sights.append(eye.look(frame))
                advance()
            fault = fault_of(sights)
            if fault is not None:
                raise InvalidValue(
                    f"position {position} of the simulated experiment cannot be used ({fault}); "
                    f"less --noise or --blur, or another --seed, makes it seen"
                )
            session.append(position, rows_of(position, sights, place.actual))


def _collect_with_person(options: CollectOptions, profile: Profile, camera: CameraModel) -> None:
    start_s = time.monotonic()

    def now() -> float:
        return time.monotonic() - start_s

    spec = profile.camera.source if options.source is None else options.source
    if spec.startswith("sim:"):
        raise UsageError(
            "the simulated camera knows its own truth: add --truth sim, or name a real camera "
            "with --source (camera:N, http://...)"
        )
    config = profile.camera
    with ExitStack() as stack:
        truth = _truth(options, profile, now)
        stack.callback(truth.close)
        source: FrameSource = open_source(
            spec, config.latency_s, camera.size_px, now, config.start_timeout_s
        )
        stack.callback(source.close)
        if config.mirrored:
            source = UnmirroredSource(source)
        experiment = Experiment(
            _session(options),
            source,
            collecting_pipeline(profile, camera),
            truth,
            ask=_ask,
            say=_say,
            bar=count_bar,
            now=now,
            wait=time.sleep,
        )
        experiment.run(options.positions, options.frames)


def _truth(options: CollectOptions, profile: Profile, now: Callable[[], float]) -> Truth:
    gear = np.asarray(profile.vehicle.gear_body_m, dtype=np.float64)
    given = None if options.target is None else four_numbers(options.target, _DEGREES)
    if options.truth == "typed":
        return TypedTruth()
    if options.truth == "mocap":
        if options.mocap is None or ":" not in options.mocap:
            raise UsageError("--truth mocap needs --mocap TYPE:HOST, as in vicon:192.168.1.2")
        body, _, target = options.bodies.partition(",")
        return MocapTruth(options.mocap, body, target if given is None else given, gear)
    from perchctl.link.estimate import EstimateLink

    link = EstimateLink(profile.link.uri if options.uri is None else options.uri, profile.link, now)
    link.connect()
    return EstimateTruth(link.telemetry, given, gear, link.close)


def _ask(question: str) -> str:
    """On stderr, as stdout is for the result. Raises EOFError at the end of the input."""
    print(question, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\n")


def _say(sentence: str) -> None:
    print(f"perchctl: {sentence}", file=sys.stderr)
