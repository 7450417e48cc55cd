"""One log replayed: as it was flown, or with another profile."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import perchctl
from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue
from perchctl.flight import (
    SENSED,
    lateness_text,
)
from perchctl.log import FlightLog, computer_differences, flown_camera, flown_mask, flown_profile
from perchctl.mission import Observation, Turn
from perchctl.perception import History, add_late_samples, add_samples, battery_age_s
from perchctl.profile import Profile
from perchctl.replay.compare import Difference, first_differing, same
from perchctl.replay.decide import Decided, decide, first_of, whole_turns
from perchctl.replay.sense import (
    Picture,
    PictureAnother,
    PictureMissing,
    PicturesUnreadable,
    Sensed,
    one_thread,
    sense,
)
from perchctl.vision import Pipeline, TargetEstimate, make_pipeline


@dataclass(frozen=True, eq=False)
class Seen:
    """What came of the pictures.

    Attributes:
        turns: each, seen again, up to where a picture is missing.
        frames: pictures that were looked at, of `frames_flown`.
        differences: turns of which a pose, or what the planner sees, differs.
        ended: why it ends before the flight does, or empty.
        another: it ends at a picture that is not the flown one.
        unreadable: it ends where the recording cannot be read.
    """

    turns: Sequence[Sensed]
    frames: int
    differences: int
    first: Difference | None
    frames_flown: int = 0
    ended: str = ""
    another: bool = False
    unreadable: bool = False

    @property
    def same(self) -> bool:
        """Of pictures none of which was looked at that is not known; of those that cannot be
        read, nothing is."""
        unseen = bool(self.ended) and not self.frames and not self.unreadable
        return not (self.differences or self.another or unseen)


@dataclass(frozen=True, eq=False)
class Shown:
    """What came of telemetry and times, without pictures: `differences` counts the turns in which
    the planner is shown something else."""

    turns: Sequence[Sensed]
    differences: int
    first: Difference | None


@dataclass(frozen=True, eq=False)
class Replay:
    """Attributes:
    decided: each turn of the planner, decided again.
    ticks: how many were flown; `differences`, how many of them were decided otherwise; `first`
        may be of one that was not sent.
    seen: None without pictures.
    shown: None where pictures were looked at to the end.
    changed: the keys in which the profile is another than the flown one's.
    gap: which turn is the first that the log has lost, or empty.
    notes: what limits the replay, in sentences.
    """

    log: FlightLog
    profile: Profile
    decided: Sequence[Decided]
    ticks: int
    differences: int
    first: Difference | None
    seen: Seen | None = None
    shown: Shown | None = None
    changed: tuple[str, ...] = ()
    gap: str = ""
    notes: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        shown = self.shown is None or self.shown.first is None
        return self.first is None and shown and (self.seen is None or self.seen.same)


def replay(
    log: FlightLog,
    pictures: Iterable[Picture] | None = None,
    profile: Profile | None = None,
    pipeline: Pipeline | None = None,
) -> Replay:
    """The flight again, by its own profile; or, with `profile`, what that would have changed.

    As it was flown the planner is given the recorded observations, and the pictures are compared
    for themselves; with another profile it is given what that sees in the pictures. `pipeline`
    looks at them; by default the profile's, with the flown calibration and mask. Without pictures
    the same goes for what telemetry and times alone give.
    Errors: InvalidValue, NotFound (a calibration or mask that another profile names).
    """
    flown = flown_profile(log.header)
    whole = whole_turns(log)
    turns, used = whole.turns, profile or flown
    changed = changed_keys(flown, used)
    seen = None
    if pictures is not None:
        pipeline = pipeline or pipeline_of(log, used, changed)
        # A source takes the latency off the time at which a picture came.
        later_s = flown.camera.start_latency_s - used.camera.start_latency_s
        placed_s = placed_later_s(turns, flown, used)
        seen = _seen(log, turns, used, pictures, pipeline, later_s, placed_s)
    by_telemetry = None
    unseen = seen is None or not (seen.frames or seen.another)
    if unseen or (seen is not None and seen.ended):
        by_telemetry = _shown(log, turns, flown, used)
    again, ended = by_telemetry if unseen else seen, "" if seen is None else seen.ended
    observations: dict[int, Observation | None] = {}
    if again is not None and changed:
        observations = {each.turn.number: each.observation for each in again.turns}
        turns = turns[: len(again.turns)]
    decided = list(
        decide(turns, used, lambda turn: observations.get(turn.number, turn.observation))
    )
    return Replay(
        log=log,
        profile=used,
        decided=decided,
        ticks=sum(each.turn.role == "flown" for each in decided),
        differences=sum(each.differs for each in decided if each.turn.role == "flown"),
        first=first_of(decided, log.start_s),
        seen=seen,
        shown=by_telemetry,
        changed=changed,
        gap=whole.gap,
        notes=(
            *notes_of(log, whole.gap, ended, changed, pictures=not unseen),
            *_failures(decided),
        ),
    )


def check_readable(log: FlightLog) -> None:
    """Decode all that a replay takes from the log. Errors: InvalidValue, and those of a value that
    no flight writes."""
    whole_turns(log)
    flown_profile(log.header)
    camera = flown_camera(log.header)
    if camera is not None:
        flown_mask(log.header, camera)
    if not math.isfinite(log.start_s):
        raise ValueError("the first turn has no time")


def changed_keys(one: Profile, other: Profile) -> tuple[str, ...]:
    """The dotted keys in which two profiles differ, but for what only names or describes."""

    def walk(a: object, b: object, name: str) -> Iterator[str]:
        if isinstance(a, dict) and isinstance(b, dict) and a and b:
            for key in [*a, *(k for k in b if k not in a)]:
                yield from walk(a.get(key), b.get(key), f"{name}.{key}" if name else str(key))
        elif not same(a, b):
            yield name

    told = ("name", "description", "date")
    found = walk(one.model_dump(mode="json"), other.model_dump(mode="json"), "")
    return tuple(key for key in found if key not in told)


def pipeline_of(log: FlightLog, profile: Profile, changed: Sequence[str] = ()) -> Pipeline:
    """The flown calibration and mask, unless others are named by now. Errors: InvalidValue,
    NotFound."""
    camera = flown_camera(log.header)
    if camera is None or {"camera.calibration", "camera.cam"} & {*changed}:
        camera = profile_camera(profile.camera)
    if profile.camera.mask is None or "camera.mask" in changed:
        return make_pipeline(profile, camera)
    try:
        return make_pipeline(profile, camera, flown_mask(log.header, camera))
    except ValueError as error:
        raise InvalidValue(f"{log.path}: its mask does not fit its calibration: {error}") from None


def _seen(
    log: FlightLog,
    turns: Sequence[Turn],
    profile: Profile,
    pictures: Iterable[Picture],
    pipeline: Pipeline,
    later_s: float,
    placed_later_s: float,
) -> Seen:
    found: list[Sensed] = []
    missing: PictureMissing | None = None
    with one_thread():
        try:
            for each in sense(turns, profile, pipeline, pictures, later_s):
                found.append(older(each, placed_later_s))
        except PictureMissing as error:
            missing = error
    return Seen(
        found,
        _frames_of(each.turn for each in found),
        *_differing(log, turns, found),
        frames_flown=_frames_of(turns),
        ended=f"{missing}: what came after it cannot be seen again" if missing else "",
        another=isinstance(missing, PictureAnother),
        unreadable=isinstance(missing, PicturesUnreadable),
    )


def _shown(log: FlightLog, turns: Sequence[Turn], flown: Profile, profile: Profile) -> Shown:
    found = list(shown(turns, flown, profile))
    return Shown(found, *_differing(log, turns, found))


def _differing(
    log: FlightLog, turns: Sequence[Turn], found: Iterable[Sensed]
) -> tuple[int, Difference | None]:
    """In how many turns it is not what was seen, and the first."""
    start = next((t.number for t in turns if t.role != "waiting"), len(turns))
    differing = [(each.turn, d) for each in found if (d := _unlike(each)) is not None]
    if not differing:
        return 0, None
    turn, difference = differing[0]
    first = Difference(_tick_of(turn, turns, start), turn.t_s - log.start_s, *difference)
    return len(differing), first


def _failures(decided: Sequence[Decided]) -> Iterator[str]:
    for each in decided:
        if each.error is not None:
            as_flown = ", as in flight" if each.error == each.turn.error else ""
            yield f"the planner breaks down on turn {each.turn.number}{as_flown}: {each.error}"


def _frames_of(turns: Iterable[Turn]) -> int:
    return sum(turn.taken.frame is not None and turn.taken.look for turn in turns)


def _tick_of(turn: Turn, turns: Sequence[Turn], start: int) -> int:
    if turn.number < start:
        return turn.number - start
    return sum(t.role == "flown" for t in turns[start : turn.number])


def _unlike(sensed: Sensed) -> tuple[str, object, object] | None:
    """The first field in which what is seen is not what was seen."""
    turn, seen = sensed.turn, sensed.observation
    found = first_differing("poses", turn.poses, sensed.poses)
    if found is not None or turn.observation is None or seen is None:
        return found
    for name in (*SENSED, "position_age_s"):
        found = first_differing(name, getattr(turn.observation, name), getattr(seen, name))
        if found is not None:
            return found
    return None


# --- What limits a replay, in sentences --------------------------------------------------------


ON_PICTURES = ("camera", "detector", "pose", "kalman", "merge", "target", "vehicle")
ON_NEITHER = ("link", "simulation", "log")
BEFORE_TAKEOFF = (
    "safety.min_rest_v", "safety.estimator_wait_s", "safety.estimator_variance_m2",
    "safety.ground_z_m", "safety.ground_tolerance_m", "safety.start_tilt_deg",
    "positioning.connect_timeout_s",
)  # fmt: skip
ON_AGES = ("positioning.hold_s", "positioning.land_s", "positioning.latency_s")
"""Of `positioning` these act on the positions' ages, which are recorded; the others on which
positions the vehicle is given."""


def notes_of(
    log: FlightLog, gap: str, ended: str, changed: Sequence[str], *, pictures: bool
) -> Iterator[str]:
    """`ended`: why the pictures do so before the flight; `pictures`: some were looked at."""
    made_by = log.header.get("perchctl")
    if made_by != perchctl.__version__:
        yield (
            f"perchctl {made_by} flew it, and this is {perchctl.__version__}: what differs may be "
            f"what has been changed on purpose since"
        )
    elsewhere = computer_differences(log.header)
    if elsewhere:
        yield f"it was flown with {elsewhere}: the last bits of a number may differ for that alone"
    if log.truncated:
        yield "the log ends in the flight, without its summary: replayed is what is there"
    yield from (note for note in (gap, ended) if note)
    yield from _on_keys(changed, pictures)


def _on_keys(changed: Sequence[str], pictures: bool) -> Iterator[str]:
    def those(*sections: str) -> list[str]:
        return [key for key in changed if key.split(".")[0] in sections]

    told = (
        (
            [] if pictures else those(*ON_PICTURES),
            "what it would change in the pictures cannot be shown, as there are none to look at",
        ),
        (
            [] if pictures else [key for key in changed if key == "safety.max_frame_age_s"],
            "another picture that is let pass or refused changes the camera's age; what it would "
            "change in the target's estimate cannot be shown, as there are no pictures to look at",
        ),
        (
            [key for key in those("positioning") if key not in (*ON_AGES, *BEFORE_TAKEOFF)],
            "which positions the vehicle would have been given, and where it would have taken "
            "itself to be, cannot be shown: a log has only those that it was given",
        ),
        (
            [key for key in changed if key in BEFORE_TAKEOFF],
            "it is asked before take-off only, and a replay begins with the flight",
        ),
        (those(*ON_NEITHER), "a replay has nothing that it acts on"),
    )
    yield from (f"{', '.join(keys)}: {text}" for keys, text in told if keys)


# --- What the planner would be shown, from a log alone ------------------------------------------
# The part of the inputs that needs no picture.
# Telemetry and the frames' times are recorded, so whether the estimate jumped, how old battery and
# camera are, and which picture came too late can be judged anew. What a picture showed cannot: the
# target stays where it was estimated in the flight.


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
