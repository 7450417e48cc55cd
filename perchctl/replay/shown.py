"""What the planner would be shown, from a log alone: the part of the senses that needs no picture.

Telemetry and the frames' times are recorded, so whether the estimate jumped, how old battery and
camera are, and which picture came too late can be judged anew. What a picture showed cannot: the
target stays where it was estimated in the flight.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from perchctl.flight import History, add_late_samples, add_samples, battery_age_s, lateness_text
from perchctl.mission import Observation, Turn
from perchctl.profile import Profile
from perchctl.replay.sense import Sensed
from perchctl.vision import TargetEstimate


@dataclass
class _Camera:
    """What a replay remembers of the camera from one turn to the next.

    `told` is the trouble as it was recorded, `problem` as the replay has it; `alive`: the filter's
    own word on whether it tracks, which a stale or unwatched picture hides.
    """

    young_s: list[float] = field(default_factory=list)  # turns before take-off with such a picture
    before: Observation | None = None
    good_s: float = -math.inf
    problem: str | None = None
    alive: bool = False


def shown(turns: Sequence[Turn], flown: Profile, profile: Profile) -> Iterator[Sensed]:
    """Each turn, in order, from the first before take-off on: `flown` is the profile that it was
    flown by, `profile` the one whose `safety` and `positioning` count. With the same one twice
    the observations are the recorded ones, to the bit."""
    history, camera = History(), _Camera()
    later_s = placed_later_s(turns, flown, profile)
    for turn in turns:
        history = add_samples(history, list(turn.taken.samples), profile.safety)
        if turn.t_s != turn.began_s:
            history = add_late_samples(history, list(turn.taken.late), profile.safety)
        obs, newest = turn.observation, history.newest
        if obs is None or newest is None:
            if _is_judged(turn) and _late(turn, 0.0, profile) is None:
                camera.young_s.append(turn.began_s)
            yield Sensed(turn, turn.poses, None)
            continue
        again = replace(
            _pictured(turn, obs, camera, flown, profile),
            telemetry=newest,
            battery_age_s=battery_age_s(history, turn.t_s),
            jumped=history.jumped,
            turned_rad=history.turned_rad,
        )
        yield older(Sensed(turn, turn.poses, again), later_s)


def placed_later_s(turns: Sequence[Turn], flown: Profile, profile: Profile) -> float:
    """How much older positions from outside are by the other profile; 0 of a flight by decks."""
    if not any(turn.outside is not None for turn in turns):
        return 0.0
    return profile.positioning.latency_s - flown.positioning.latency_s


def older(sensed: Sensed, later_s: float) -> Sensed:
    """With positions that are so much older."""
    obs = sensed.observation
    if obs is None or not later_s:
        return sensed
    aged = replace(obs, position_age_s=obs.position_age_s + later_s)
    return replace(sensed, observation=aged)


def _pictured(
    turn: Turn, obs: Observation, camera: _Camera, flown: Profile, profile: Profile
) -> Observation:
    """The observation with another `max_frame_age_s` and `camera_hold_s`.

    A good picture makes the camera's age 0, and nothing else does.
    """
    before = camera.before
    if before is None:
        camera.good_s = _good_before(obs, camera.young_s)
    good = was_good = obs.camera_age_s == 0.0
    used_s = obs.delay_s if before is None else before.delay_s
    was_late, late = _late(turn, used_s, flown), _late(turn, used_s, profile)
    was_late = None if was_good or obs.camera_problem != was_late else was_late
    if late is not None and (was_good or was_late is not None):
        good, camera.problem = False, late
    elif was_late is not None:
        good, camera.problem = True, None
    elif was_good or before is None or obs.camera_problem != before.camera_problem:
        camera.problem = obs.camera_problem
    if good:
        camera.good_s = turn.t_s
    camera.before = obs
    return replace(
        obs,
        target=_target(turn, obs, camera, flown, profile),
        new_frame=obs.new_frame and good,
        camera_age_s=turn.t_s - camera.good_s,
        camera_problem=camera.problem,
    )


def _target(
    turn: Turn, obs: Observation, camera: _Camera, flown: Profile, profile: Profile
) -> TargetEstimate | None:
    """As it was estimated, and tracked while pictures are fresh and looked at."""
    target = obs.target
    if target is None:
        return None
    if turn.taken.look and obs.camera_age_s <= flown.safety.camera_hold_s:
        camera.alive = target.tracked
    fresh = turn.t_s - camera.good_s <= profile.safety.camera_hold_s
    tracked = camera.alive and turn.taken.look and fresh
    return target if tracked == target.tracked else replace(target, tracked=tracked)


def _is_judged(turn: Turn) -> bool:
    """It has a frame that is no old one once more."""
    taken = turn.taken
    return taken.frame is not None and not taken.frame.repeated and taken.problem is None


def _late(turn: Turn, used_s: float, profile: Profile) -> str | None:
    """What is said of its frame, where that is too old; `used_s` was taken off its time."""
    frame = turn.taken.frame
    if frame is None or not (_is_judged(turn) and turn.taken.live):
        return None
    return lateness_text(turn.began_s - (frame.t_s - used_s), profile.safety)


def _good_before(obs: Observation, young_s: Iterable[float]) -> float:
    """When the last good picture came before take-off: one that is young enough, and no newer
    than the one from which the recorded age counts."""
    good_s = (t_s for t_s in young_s if obs.t_s - t_s >= obs.camera_age_s)
    return max(good_s, default=-math.inf)
