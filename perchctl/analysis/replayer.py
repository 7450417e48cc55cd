"""One log replayed: as it was flown, or with another profile."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import perchctl
from perchctl.analysis.compare import profile_differences
from perchctl.analysis.decide import (
    Decided,
    Difference,
    decide,
    first_differing,
    first_of,
    whole_turns,
)
from perchctl.analysis.sense import (
    Picture,
    PictureMissing,
    Sensed,
    one_thread,
    sense,
)
from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue
from perchctl.flight import FlightInputs
from perchctl.mission import Observation, Turn
from perchctl.profile import Profile
from perchctl.record import FlightLog
from perchctl.vision import Pipeline, make_pipeline


@dataclass(frozen=True, eq=False)
class Seen:
    """What the senses made of the recorded pictures, telemetry and times.

    Attributes:
        turns: each, seen again, up to where a picture is missing.
        differences: turns of which a pose, or what the planner sees, differs; `first` of them.
        frames: pictures that were looked at, of `frames_flown`.
        missing: what ended it before the flight; None where nothing did.
    """

    turns: Sequence[Sensed]
    differences: int
    first: Difference | None
    frames: int = 0
    frames_flown: int = 0
    missing: PictureMissing | None = None

    @property
    def ended(self) -> str:
        """Why it ends before the flight does, or empty."""
        return f"{self.missing}: what came after it cannot be seen again" if self.missing else ""

    @property
    def is_another(self) -> bool:
        """True if it ends at a picture that is not the flown one."""
        return self.missing is not None and self.missing.kind == "another"

    @property
    def same(self) -> bool:
        """True if nothing differs. A recording that cannot be read tells of no difference; of one
        whose first picture is missing nothing is known."""
        is_unknown = self.missing is not None and self.missing.kind == "missing" and not self.frames
        return not (self.differences or self.is_another or is_unknown)


@dataclass(frozen=True, eq=False)
class Replay:
    """A log decided again, and seen again where there are pictures.

    Attributes:
        decided: each turn of the planner, decided again.
        ticks: how many were flown; `differences`, how many of them were decided otherwise; `first`
            may be of one that was not sent.
        seen: what the pictures show; None without any.
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
    changed: tuple[str, ...] = ()
    gap: str = ""
    notes: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """True if no decision and nothing that was seen differs."""
        return self.first is None and (self.seen is None or self.seen.same)


def replay(
    log: FlightLog,
    pictures: Iterable[Picture] | None = None,
    profile: Profile | None = None,
    pipeline: Pipeline | None = None,
) -> Replay:
    """Replay the flight by its own profile; or, with `profile`, by another one.

    As it was flown the planner is given the recorded observations, and the pictures are compared
    for themselves; with another profile it is given what that sees in the pictures. `pipeline`
    looks at them; by default the profile's, with the flown calibration and mask.
    Errors: InvalidValue, NotFound (a calibration or mask that another profile names).
    """
    flown = log.flown_profile
    turns, gap = whole_turns(log)
    used = profile or flown
    changed = changed_keys(flown, used)
    seen = None
    if pictures is not None:
        pipeline = pipeline or pipeline_of(log, used, changed)
        seen = _seen(log, turns, flown, used, pictures, pipeline)
    is_seen = seen is not None and (seen.frames > 0 or seen.is_another)
    observations: dict[int, Observation | None] = {}
    if is_seen and seen is not None and changed:
        observations = {each.turn.number: each.observation for each in seen.turns}
        turns = turns[: len(seen.turns)]
    decided = list(
        decide(turns, used, lambda turn: observations.get(turn.number, turn.observation))
    )
    ended = "" if seen is None else seen.ended
    return Replay(
        log=log,
        profile=used,
        decided=decided,
        ticks=sum(each.turn.role == "flown" for each in decided),
        differences=sum(each.differs for each in decided if each.turn.role == "flown"),
        first=first_of(decided, log.start_s),
        seen=seen,
        changed=changed,
        gap=gap,
        notes=(
            *notes_of(log, gap, ended, changed, pictures=is_seen),
            *_failures(decided),
        ),
    )


def check_readable(log: FlightLog) -> None:
    """Decode all that a replay takes from the log. Errors: InvalidValue, and those of a value that
    no flight writes."""
    whole_turns(log)
    _ = log.flown_profile
    camera = log.flown_camera
    if camera is not None:
        log.flown_mask(camera)
    if not math.isfinite(log.start_s):
        raise ValueError("the first turn has no time")


def changed_keys(one: Profile, other: Profile) -> tuple[str, ...]:
    """Return the dotted keys in which two profiles differ, but for those that only name or
    describe them."""
    found = profile_differences(one.model_dump(mode="json"), other.model_dump(mode="json"))
    return tuple(key for key in found if key not in ("name", "description", "date"))


def pipeline_of(log: FlightLog, profile: Profile, changed: Sequence[str] = ()) -> Pipeline:
    """Return the pipeline with the flown calibration and mask, unless the changed keys name others.
    Errors: InvalidValue, NotFound."""
    camera = log.flown_camera
    if camera is None or {"camera.calibration", "camera.cam"} & {*changed}:
        camera = profile_camera(profile.camera)
    if profile.camera.mask is None or "camera.mask" in changed:
        return make_pipeline(profile, camera)
    try:
        return make_pipeline(profile, camera, log.flown_mask(camera))
    except ValueError as error:
        raise InvalidValue(f"{log.path}: its mask does not fit its calibration: {error}") from None


def _seen(
    log: FlightLog,
    turns: Sequence[Turn],
    flown: Profile,
    profile: Profile,
    pictures: Iterable[Picture],
    pipeline: Pipeline,
) -> Seen:
    # A source takes the latency off the time at which a picture came.
    later_s = flown.camera.start_latency_s - profile.camera.start_latency_s
    found: list[Sensed] = []
    missing: PictureMissing | None = None
    with one_thread():
        try:
            for each in sense(turns, profile, pipeline, pictures, later_s):
                found.append(each)
        except PictureMissing as error:
            missing = error
    return Seen(
        found,
        *_differing(log, turns, found),
        frames=_frames_of(each.turn for each in found),
        frames_flown=_frames_of(turns),
        missing=missing,
    )


def _differing(
    log: FlightLog, turns: Sequence[Turn], found: Iterable[Sensed]
) -> tuple[int, Difference | None]:
    """Count the turns in which something else is seen than was, and find the first."""
    start = next((t.number for t in turns if t.role != "waiting"), len(turns))
    differing = [(each.turn, d) for each in found if (d := _unlike(each)) is not None]
    if not differing:
        return 0, None
    turn, difference = differing[0]
    tick = turn.number - start
    if tick > 0:
        tick = sum(t.role == "flown" for t in turns[start : turn.number])
    return len(differing), Difference(tick, turn.t_s - log.start_s, *difference)


def _failures(decided: Sequence[Decided]) -> Iterator[str]:
    for each in decided:
        if each.error is not None:
            as_flown = ", as in flight" if each.error == each.turn.error else ""
            yield f"the planner breaks down on turn {each.turn.number}{as_flown}: {each.error}"


def _frames_of(turns: Iterable[Turn]) -> int:
    return sum(turn.taken.frame is not None and turn.taken.look for turn in turns)


def _unlike(sensed: Sensed) -> tuple[str, object, object] | None:
    """Return the first field in which what is seen is not what was seen; None without one."""
    was, seen = sensed.turn.observation, sensed.observation
    found = first_differing("poses", sensed.turn.poses, sensed.poses)
    if found is None and was is not None and seen is not None:
        names = FlightInputs.SENSED
        each = (first_differing(n, getattr(was, n), getattr(seen, n)) for n in names)
        found = next((difference for difference in each if difference is not None), None)
    return found


# --- What limits a replay, in sentences --------------------------------------------------------

ON_PICTURES = (
    "camera", "detector", "pose", "kalman", "merge", "target", "vehicle",
    "safety.max_frame_age_s", "safety.camera_hold_s",
)  # fmt: skip
BEFORE_TAKEOFF = (
    "safety.min_rest_v", "safety.estimator_wait_s", "safety.estimator_variance_m2",
    "safety.ground_z_m", "safety.ground_tolerance_m", "safety.start_tilt_deg",
    "positioning.connect_timeout_s",
)  # fmt: skip
ON_TELEMETRY = ("safety.jump_m", "safety.jump_z_m", "safety.jump_deg", "safety.jump_mps")
"""They act on what the loop makes of telemetry, which is made anew with pictures only."""
ON_AGES = ("positioning.hold_s", "positioning.land_s")
"""Of `positioning` these act on the positions' ages, which are recorded; the others on which
positions the vehicle is given."""


def notes_of(
    log: FlightLog, gap: str, ended: str, changed: Sequence[str], *, pictures: bool
) -> Iterator[str]:
    """Yield what limits a replay, a sentence each. `ended` says why the pictures end before the
    flight; `pictures` is True if some were looked at."""
    made_by = log.header.get("perchctl")
    if made_by != perchctl.__version__:
        yield (
            f"perchctl {made_by} flew it, and this is {perchctl.__version__}: what differs may be "
            f"what has been changed on purpose since"
        )
    elsewhere = log.computer_differences
    if elsewhere:
        yield f"it was flown with {elsewhere}: the last bits of a number may differ for that alone"
    if log.truncated:
        yield "the log ends in the flight, without its summary: replayed is what is there"
    yield from (note for note in (gap, ended) if note)
    limits: dict[str, list[str]] = {}
    for key in changed:
        limits.setdefault(_limit_of(key, pictures), []).append(key)
    yield from (f"{', '.join(keys)}: {text}" for text, keys in limits.items() if text)


def _limit_of(key: str, pictures: bool) -> str:
    """Return what a replay cannot tell of a key; empty where it tells all."""
    section = key.split(".")[0]
    if key in BEFORE_TAKEOFF:
        return "it is asked before take-off only, and a replay begins with the flight"
    if not pictures and (section in ON_PICTURES or key in ON_PICTURES):
        return "what it would change in the pictures cannot be shown, as there are none to look at"
    if not pictures and key in ON_TELEMETRY:
        return "what it would change in the telemetry is shown by a replay with pictures only"
    if section == "positioning" and key not in ON_AGES:
        return (
            "which positions the vehicle would have been given, and where it would have taken "
            "itself to be, cannot be shown: a log has only those that it was given"
        )
    if section in ("link", "simulation", "log"):
        return "a replay has nothing that it acts on"
    return ""
