"""One frame's poses into the filters, past the gate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perchctl.profile import KalmanConfig
from perchctl.vision.filter import FilterSetup, make_filter, step_track
from perchctl.vision.gate import Sight, Verdict, judged, locked, remembered
from perchctl.vision.places import measurement
from perchctl.vision.pose import PoseSetup
from perchctl.vision.types import (
    Attitude,
    Lock,
    MarkerTrack,
    Measured,
    PipelineState,
    Stranger,
)


@dataclass(frozen=True, eq=False)
class TrackSetup:
    """The filters' constants in the level frame and in the world, the tracks' names, and
    whether a pose has to pass the gate."""

    level: FilterSetup
    world: FilterSetup
    names: tuple[str, ...]
    pose: PoseSetup
    gate: bool

    def constants(self, in_world: bool) -> FilterSetup:
        return self.world if in_world else self.level


@dataclass(frozen=True, eq=False)
class Followed:
    """The tracks one frame on. `measured` feeds nothing where its pose was not `taken`; `note`
    is a sentence for people on a pose that was not, or that begins the tracks anew."""

    measured: Measured
    tracks: dict[str, MarkerTrack]
    lock: Lock | None = None
    stranger: Stranger | None = None
    taken: bool = True
    note: str = ""


def make_track_setup(config: KalmanConfig, names: tuple[str, ...], pose: PoseSetup) -> TrackSetup:
    return TrackSetup(
        level=make_filter(config, in_world=False),
        world=make_filter(config, in_world=True),
        names=names,
        pose=pose,
        gate=config.gate,
    )


def followed_on(
    state: PipelineState,
    measured: Measured,
    t_s: float,
    attitude: Attitude | None,
    in_world: bool,
    setup: TrackSetup,
) -> Followed:
    """What the gate lets through goes into the tracks."""
    if not setup.gate:
        return Followed(measured, _stepped(state, measured, t_s, attitude, in_world, setup))
    sight, verdict = None, Verdict(taken=True, stranger=state.stranger)
    if measured.fed:
        sight = _sight(measured, t_s, attitude, in_world, setup)
        verdict = judged(state.lock, state.stranger, sight, setup.constants(in_world))
    if not verdict.taken:
        measured = replace(measured, fed={})
    if verdict.afresh:
        state = replace(state, tracks={})
    tracks = _stepped(state, measured, t_s, attitude, in_world, setup)
    lock, stranger = remembered(state.lock, verdict.stranger, t_s)
    if sight is not None and verdict.taken and tracks:
        surest = min(tracks.values(), key=lambda t: (t.unseen, float(np.trace(t.P))))
        lock = locked(lock, surest, sight, verdict.afresh)
    return Followed(measured, tracks, lock, stranger, verdict.taken, verdict.text)


def _sight(
    measured: Measured, t_s: float, attitude: Attitude | None, in_world: bool, setup: TrackSetup
) -> Sight:
    """What the gate has to judge: the surest pose of those that would be fed."""
    pose = min(measured.fed.values(), key=lambda p: float(np.linalg.norm(p.sigma_m)))
    z = measurement(pose, attitude, in_world, setup.constants(in_world), setup.pose)
    whole = pose.source == "joint" or (len(measured.poses) > 1 and not measured.contradicting)
    return Sight(t_s, pose, z, in_world, whole)


def _stepped(
    state: PipelineState,
    measured: Measured,
    t_s: float,
    attitude: Attitude | None,
    in_world: bool,
    setup: TrackSetup,
) -> dict[str, MarkerTrack]:
    """All tracks one frame on."""
    constants = setup.constants(in_world)
    old = state.tracks if state.in_world == in_world else {}
    stepped: dict[str, MarkerTrack] = {}
    for name in setup.names:
        pose = measured.fed.get(name)
        z = None
        if pose is not None:
            z = measurement(pose, attitude, in_world, constants, setup.pose)
        track = step_track(old.get(name), z, t_s, constants)
        if track is not None:
            stepped[name] = track
    return stepped
