"""One frame's poses into the filters, past the gate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from perchctl.profile import KalmanConfig
from perchctl.values import replace
from perchctl.vision.filter import POSITION, FilterSetup, Measurement, make_filter, step_track
from perchctl.vision.gate import Sight, Verdict, judged, locked, remembered
from perchctl.vision.own import NOWHERE, OwnTargetPlace, refusal
from perchctl.vision.places import measurement
from perchctl.vision.pose import PoseSetup
from perchctl.vision.predict import is_in_view
from perchctl.vision.types import (
    Attitude,
    Lock,
    MarkerPose,
    MarkerTrack,
    MeasuredMarkers,
    PipelineState,
    Stranger,
)


@dataclass(frozen=True, eq=False)
class TrackSetup:
    """The filters' constants in the level frame and in the world, the tracks' names,
    whether a pose has to pass the gate, and where the own target is."""

    level: FilterSetup
    world: FilterSetup
    names: tuple[str, ...]
    pose: PoseSetup
    gate: bool
    own: OwnTargetPlace = NOWHERE

    def constants(self, in_world: bool) -> FilterSetup:
        return self.world if in_world else self.level


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """The tracks one frame on. `measured` feeds nothing where its pose was not `taken`; `note`
    is a sentence for people on a pose that was not, or that begins the tracks anew; `refused`, it
    was another vehicle's target."""

    measured: MeasuredMarkers
    tracks: dict[str, MarkerTrack]
    lock: Lock | None = None
    stranger: Stranger | None = None
    taken: bool = True
    note: str = ""
    refused: bool = False


def make_track_setup(
    config: KalmanConfig, names: tuple[str, ...], pose: PoseSetup, own: OwnTargetPlace = NOWHERE
) -> TrackSetup:
    """The constants of the Kalman filters of these tracks, from the profile."""
    return TrackSetup(
        level=make_filter(config, in_world=False),
        world=make_filter(config, in_world=True),
        names=names,
        pose=pose,
        gate=config.gate,
        own=own,
    )


def update_tracks(
    state: PipelineState,
    measured: MeasuredMarkers,
    t_s: float,
    attitude: Attitude | None,
    in_world: bool,
    setup: TrackSetup,
) -> TrackedFrame:
    """What the gate lets through goes into the tracks."""
    constants = setup.constants(in_world)
    fed = {
        name: measurement(pose, attitude, in_world, constants, setup.pose)
        for name, pose in measured.fed.items()
    }
    old = state.tracks if state.in_world == in_world else {}
    sight, verdict = None, Verdict(taken=True, stranger=state.stranger)
    if fed:
        sight = _sight(measured, fed, t_s, in_world)
        if state.stranger is not None and state.lock is not None and attitude is not None:
            place_m = state.lock.track.x[POSITION]
            looks = not in_world or is_in_view(place_m, attitude, setup.pose)
            sight = replace(sight, looks_there=looks)
        another = refusal(sight.pose, attitude, setup.own, setup.pose)
        verdict = _verdict(state, sight, another, constants, setup.gate)
    if not setup.gate:
        fed = fed if verdict.taken else {}
        measured = measured if verdict.taken else replace(measured, fed={})
        tracks = _stepped(old, fed, t_s, setup.names, constants)
        return TrackedFrame(
            measured, tracks, taken=verdict.taken, note=verdict.text, refused=verdict.refused
        )
    if not verdict.taken:
        measured, fed = replace(measured, fed={}), {}
    tracks = _stepped({} if verdict.afresh else old, fed, t_s, setup.names, constants)
    lock, stranger = remembered(state.lock, verdict.stranger, t_s)
    if sight is not None and verdict.taken and tracks:
        surest = next(iter(tracks.values()))
        if len(tracks) > 1:
            surest = min(tracks.values(), key=lambda t: (t.unseen, float(np.trace(t.P))))
        lock = locked(lock, surest, sight, verdict)
    return TrackedFrame(
        measured, tracks, lock, stranger, verdict.taken, verdict.text, verdict.refused
    )


def _verdict(
    state: PipelineState, sight: Sight, another: str | None, constants: FilterSetup, gate: bool
) -> Verdict:
    """The gate's; and a target that is `another` vehicle's is never locked on. One that was
    locked on goes on, however far the estimate's world has drifted meanwhile."""
    verdict = Verdict(taken=True, stranger=state.stranger)
    if gate:
        verdict = judged(state.lock, state.stranger, sight, constants)
    lock, _ = remembered(state.lock, None, sight.t_s)
    goes_on = lock is not None and (verdict.same or not verdict.afresh)
    if another is not None and verdict.taken and not goes_on:
        return Verdict(taken=False, stranger=state.stranger, text=another, refused=True)
    return verdict


def _sight(
    measured: MeasuredMarkers, fed: Mapping[str, Measurement], t_s: float, in_world: bool
) -> Sight:
    """What the gate has to judge: the surest pose of those that would be fed."""
    pose = surest_pose(measured)
    assert pose is not None
    name = next(n for n, each in measured.fed.items() if each is pose)
    whole = pose.source == "joint" or (len(measured.poses) > 1 and not measured.contradicting)
    return Sight(t_s, pose, fed[name], in_world, whole)


def surest_pose(measured: MeasuredMarkers) -> MarkerPose | None:
    """Of the poses that are fed, or else of all."""
    poses = measured.fed or measured.poses
    return min(poses.values(), key=lambda p: float(p.sigma_m @ p.sigma_m), default=None)


def _stepped(
    old: Mapping[str, MarkerTrack],
    fed: Mapping[str, Measurement],
    t_s: float,
    names: tuple[str, ...],
    constants: FilterSetup,
) -> dict[str, MarkerTrack]:
    """All tracks one frame on."""
    tracks = {n: step_track(old.get(n), fed.get(n), t_s, constants) for n in names}
    return {n: track for n, track in tracks.items() if track is not None}
