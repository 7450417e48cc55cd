"""One log replayed: as it was flown, or with another profile."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import perchctl
from perchctl.calibration.files import camera_of
from perchctl.errors import InvalidValue
from perchctl.flight.senses import SENSED
from perchctl.log.read import FlightLog
from perchctl.log.setup import camera_in, mask_in, other_computer, profile_of
from perchctl.mission.state import Observation
from perchctl.mission.turn import Turn
from perchctl.pipeline import Pipeline, make_pipeline
from perchctl.profile import Profile
from perchctl.replay.compare import Difference, first_differing, same
from perchctl.replay.decide import Decided, decide, first_of, whole_turns
from perchctl.replay.sense import Picture, PictureMissing, Sensed, one_thread, sense


@dataclass(frozen=True, eq=False)
class Seen:
    """What came of the pictures.

    Attributes:
        turns: each, seen again, up to where a picture is missing.
        frames: pictures that were looked at.
        differences: turns of which a pose, or what the planner sees, differs.
        ended: why it ends before the flight does, or empty.
    """

    turns: Sequence[Sensed]
    frames: int
    differences: int
    first: Difference | None
    ended: str = ""


@dataclass(frozen=True, eq=False)
class Replay:
    """Attributes:
    decided: each turn of the planner, decided again.
    ticks: how many were flown; `differences`, how many of all were decided otherwise.
    seen: None without pictures.
    changed: the keys in which the profile is another than the flown one's.
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
    notes: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        return not self.differences and (self.seen is None or not self.seen.differences)


def replay(
    log: FlightLog,
    pictures: Iterable[Picture] | None = None,
    profile: Profile | None = None,
    pipeline: Pipeline | None = None,
) -> Replay:
    """The flight again, by its own profile; or, with `profile`, what that would have changed.

    As it was flown the planner is given the recorded observations, and the pictures are compared
    for themselves; with another profile it is given what that sees in the pictures. `pipeline`
    looks at them; by default the profile's, with the flown calibration and mask.
    Errors: InvalidValue, NotFound (a calibration or mask that another profile names).
    """
    flown = profile_of(log.header)
    whole = whole_turns(log)
    turns, used = whole.turns, profile or flown
    changed = changed_keys(flown, used)
    seen = None
    if pictures is not None:
        pipeline = pipeline or pipeline_of(log, used, changed)
        seen = _seen(log, turns, used, pictures, pipeline)
    observations: dict[int, Observation | None] = {}
    if seen is not None and changed:
        observations = {each.turn.number: each.observation for each in seen.turns}
        turns = turns[: len(seen.turns)]
    decided = list(
        decide(turns, used, lambda turn: observations.get(turn.number, turn.observation))
    )
    return Replay(
        log=log,
        profile=used,
        decided=decided,
        ticks=sum(each.turn.role == "flown" for each in decided),
        differences=sum(each.differs for each in decided),
        first=first_of(decided, log.start_s),
        seen=seen,
        changed=changed,
        notes=tuple(_notes(log, whole.gap, seen, changed)),
    )


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
    camera = camera_in(log.header)
    if camera is None or {"camera.calibration", "camera.cam"} & {*changed}:
        camera = camera_of(profile.camera)
    if profile.camera.mask is None or "camera.mask" in changed:
        return make_pipeline(profile, camera)
    try:
        return make_pipeline(profile, camera, mask_in(log.header, camera))
    except ValueError as error:
        raise InvalidValue(f"{log.path}: its mask does not fit its calibration: {error}") from None


def _seen(
    log: FlightLog,
    turns: Sequence[Turn],
    profile: Profile,
    pictures: Iterable[Picture],
    pipeline: Pipeline,
) -> Seen:
    found: list[Sensed] = []
    ended = ""
    with one_thread():
        try:
            for each in sense(turns, profile, pipeline, pictures):
                found.append(each)
        except PictureMissing as missing:
            ended = f"{missing}: what came after it cannot be seen again"
    start = next((t.number for t in turns if t.role != "waiting"), len(turns))
    differing = [(each, d) for each in found if (d := _unlike(each)) is not None]
    first = None
    if differing:
        each, difference = differing[0]
        first = Difference(
            _tick_of(each.turn, turns, start), each.turn.t_s - log.start_s, *difference
        )
    frames = sum(each.turn.taken.frame is not None and each.turn.taken.look for each in found)
    return Seen(found, frames, len(differing), first, ended)


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
    for name in SENSED:
        found = first_differing(name, getattr(turn.observation, name), getattr(seen, name))
        if found is not None:
            return found
    return None


_ON_PICTURES = ("camera", "detector", "pose", "kalman", "merge", "target", "vehicle")
_ON_NEITHER = ("link", "simulation", "log")


def _notes(log: FlightLog, gap: str, seen: Seen | None, changed: Sequence[str]) -> Iterator[str]:
    made_by = log.header.get("perchctl")
    if made_by != perchctl.__version__:
        yield (
            f"perchctl {made_by} flew it, and this is {perchctl.__version__}: what differs may be "
            f"what has been changed on purpose since"
        )
    elsewhere = other_computer(log.header)
    if elsewhere:
        yield f"it was flown with {elsewhere}: the last bits of a number may differ for that alone"
    if log.truncated:
        yield "the log ends in the flight, without its summary: replayed is what is there"
    if gap:
        yield gap
    if seen is not None and seen.ended:
        yield seen.ended
    sections = {key: key.split(".")[0] for key in changed}
    blind = [key for key, section in sections.items() if section in _ON_PICTURES]
    if blind and seen is None:
        yield (
            f"{', '.join(blind)}: what it would change in the pictures cannot be shown, as they "
            f"were not recorded"
        )
    idle = [key for key, section in sections.items() if section in _ON_NEITHER]
    if idle:
        yield f"{', '.join(idle)}: a replay has nothing that it acts on"
