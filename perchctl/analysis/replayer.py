"""Replay one flight from its log, with the flown profile or with another one.

A turn is one iteration of the flight loop.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import perchctl
from perchctl.analysis.compare import profile_differences
from perchctl.analysis.decide import (
    Comparison,
    ReplayedDecision,
    replay_decisions,
    turns_and_gap_text,
)
from perchctl.analysis.sense import Picture, PictureMissing, ReplayedInputs, replay_inputs
from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue
from perchctl.flight import FlightInputs
from perchctl.mission import Observation, TickRecord
from perchctl.profile import Profile
from perchctl.record import FlightLog, log_names
from perchctl.vision import Pipeline, make_pipeline

CAUTION = (
    "after the first difference the vehicle would have moved differently: from "
    "then on, the replay shows how the planner reacts to the telemetry and images "
    "of a different flight"
)


@dataclass(frozen=True)
class Difference:
    """The first field of one turn in which a replay differs from the log.

    `tick`: number of the turn since take-off, from 0; negative before take-off. `t_s`: time since
    the first flown turn. `recorded`, `replayed`: the two values, in JSON types.
    """

    tick: int
    t_s: float
    field: str
    recorded: Any
    replayed: Any

    @property
    def text(self) -> str:
        """One line, such as ``tick 512 at 10.24 s: command.z_m was 1.25, the replay has 1.26``."""
        was, now = json.dumps(self.recorded), json.dumps(self.replayed)
        return f"tick {self.tick} at {self.t_s:.2f} s: {self.field} was {was}, the replay has {now}"


@dataclass(frozen=True, eq=False)
class PerceptionReplay:
    """Result of replaying perception with the recorded images, telemetry and times.

    Attributes:
        turns: the replayed turns, up to the first missing image.
        differences: the first difference in each turn whose poses or observation differ.
        frames_flown: number of frames that the flight processed.
        missing: why a missing or unreadable image ended the replay early, or None.
    """

    turns: Sequence[ReplayedInputs]
    differences: Sequence[Difference]
    frames_flown: int
    missing: PictureMissing | None

    @property
    def frames(self) -> int:
        """Number of frames that were processed again."""
        return _frames_of(each.turn for each in self.turns)

    @property
    def end_reason(self) -> str:
        """Why the replay ends before the flight does; empty if it does not."""
        return f"{self.missing}: later frames cannot be replayed" if self.missing else ""

    @property
    def is_identical(self) -> bool:
        """True if no replayed value differs.

        An image that is missing or unreadable does not count as a difference.
        """
        return not (self.differences or (self.missing is not None and self.missing.is_different))


@dataclass(frozen=True, eq=False)
class Replay:
    """Replay of a log through the planner, and through perception if images were recorded.

    Attributes:
        decisions: the planner's replayed decisions, one for each turn.
        differences: the first difference in each decision that differs from the log.
        seen: replay of perception; None if no images were recorded.
        changed_keys: profile keys that differ from the flown profile.
        gap_text: sentence about turns missing from the log, or empty (see `turns_and_gap_text`).
    """

    log: FlightLog
    decisions: Sequence[ReplayedDecision]
    differences: Sequence[Difference]
    seen: PerceptionReplay | None = None
    changed_keys: tuple[str, ...] = ()
    gap_text: str = ""

    @property
    def ticks(self) -> int:
        """Number of replayed turns in which the vehicle was flown."""
        return sum(each.turn.role == "flown" for each in self.decisions)

    @property
    def is_identical(self) -> bool:
        """True if no decision and no perception result differs."""
        return not self.differences and (self.seen is None or self.seen.is_identical)

    @property
    def uncompared(self) -> list[str]:
        """Dotted names of the fields that the log does not contain and that are therefore not
        compared."""
        names = (field.path.removeprefix("observation.") for field in self.log.unknown_fields)
        # The telemetry samples in `taken` have the same fields as the observation's telemetry, so
        # their names are not repeated.
        return [name for name in names if not name.startswith("taken.")]

    @property
    def notes(self) -> list[str]:
        """The limitations of this replay, one sentence each."""
        made_by, elsewhere = self.log.header.get("perchctl"), self.log.computer_differences
        found = []
        if made_by != perchctl.__version__:
            found.append(
                f"perchctl {made_by} flew this flight, but this is version "
                f"{perchctl.__version__}: a difference may be a deliberate change"
            )
        if elsewhere:
            found.append(
                f"the flight was flown with {elsewhere}: numbers may differ in their last bits"
            )
        if self.uncompared:
            found.append(
                f"the log does not contain {', '.join(self.uncompared)}: these fields are not "
                "compared, and the planner uses their defaults"
            )
        if self.log.truncated:
            found.append(
                "the log ends during the flight, without its summary: only the recorded "
                "part was replayed"
            )
        ended = "" if self.seen is None else self.seen.end_reason
        found += [note for note in (self.gap_text, ended) if note]
        if self.changed_keys and not self.is_identical:
            found.append(CAUTION)
        for each in self.decisions:
            if each.error is not None:
                found.append(f"the planner failed at tick record {each.turn.number}: {each.error}")
        return found

    def record(self) -> dict[str, Any]:
        """The replay in JSON types.

        `ticks`, `differences` and `first_difference` concern the planner. `pictures` concerns
        perception and is None if no images were recorded. `changed` is empty for the flown profile.
        `not_compared` lists the fields that the log does not contain.
        """
        seen = self.seen
        pictures = seen and {
            "frames": seen.frames,
            "frames_flown": seen.frames_flown,
            "ended": seen.end_reason or None,
            **_counted(seen.differences),
        }
        return {
            "log": str(self.log.path),
            "same": self.is_identical,
            "ticks": self.ticks,
            **_counted(self.differences),
            "pictures": pictures,
            "changed": list(self.changed_keys),
            "not_compared": self.uncompared,
            "notes": self.notes,
        }

    def lines(self) -> list[str]:
        """The replay as lines of text for a terminal, without `notes`."""
        lines = [f"changed:   {', '.join(self.changed_keys)}"] if self.changed_keys else []
        text = "all with the same commands"
        if self.differences:
            text = f"{len(self.differences)} with a different decision"
        lines.append(f"planner:   {self.ticks} ticks, {text}")
        lines += [f"first:     {each.text}" for each in self.differences[:1]]
        if (seen := self.seen) is None:
            return lines
        text = f"{seen.frames} frames"
        if seen.end_reason:
            text = f"replayed up to frame {seen.frames} of {seen.frames_flown}"
        if seen.differences:
            text += f", {len(seen.differences)} ticks with different poses"
        elif seen.frames:
            text += ", all with bit-identical poses"
        lines.append(f"pictures:  {text}")
        return lines + [f"first:     {each.text}" for each in seen.differences[:1]]


def _counted(differences: Sequence[Difference]) -> dict[str, Any]:
    first = asdict(differences[0]) if differences else None
    return {"differences": len(differences), "first_difference": first}


def replay(
    log: FlightLog,
    pictures: Iterable[Picture] | None = None,
    profile: Profile | None = None,
    pipeline: Pipeline | None = None,
    tolerances: Mapping[str, float] | None = None,
) -> Replay:
    """Replay the flight with its own profile or, if given, with `profile`.

    The planner gets the recorded observations; with another profile and `pictures`, it gets the
    observations from the replayed perception. Perception is compared separately. The default
    `pipeline` is the profile's, with the flown calibration and mask. `tolerances`: permitted
    difference for the numbers in a field, keyed by field name without its owner; "" stands for all
    other fields. By default, every bit is compared. Errors: InvalidValue, NotFound.
    """
    flown = log.flown_profile
    turns, gap = turns_and_gap_text(log)
    unknown = {(field.owner, field.name) for field in log.unknown_fields}
    comparison = Comparison(unknown, tolerances or {})
    used = profile or flown
    changed = changed_keys(flown, used)
    if not log.has_position_variance:  # a field missing from an old log did not exist yet
        used = used.with_({"link.unreported": ["variance", *used.link.unreported]})
    seen = None
    if pictures is not None:
        pipeline = pipeline or replay_pipeline(log, used, changed)
        # A live source has already subtracted the flown latency from each image's arrival time.
        delay_s = flown.camera.start_latency_s - used.camera.start_latency_s
        replayed, missing = _replayed(turns, used, pipeline, pictures, delay_s)
        differing = list(_differing(log, turns, replayed, comparison))
        seen = PerceptionReplay(replayed, differing, _frames_of(turns), missing)
    observations: dict[int, Observation | None] = {}
    if seen is not None and changed and seen.frames:
        observations = {each.turn.number: each.observation for each in seen.turns}
        turns = turns[: len(seen.turns)]
    decided = list(
        replay_decisions(
            turns, used, lambda turn: observations.get(turn.number, turn.observation), comparison
        )
    )
    differences = [
        Difference(each.tick, log.to_flight_s(each.turn.t_s), *each.difference)
        for each in decided
        if each.difference is not None
    ]
    return Replay(log, decided, differences, seen, changed, gap)


def changed_keys(flown: Profile, replayed: Profile) -> tuple[str, ...]:
    """The dotted keys whose values differ between two profiles, except name, description and
    date."""
    found = profile_differences(flown.model_dump(mode="json"), replayed.model_dump(mode="json"))
    return tuple(key for key in found if key not in ("name", "description", "date"))


def replay_pipeline(log: FlightLog, profile: Profile, changed: Sequence[str] = ()) -> Pipeline:
    """The pipeline for `profile`, with the flown calibration and mask unless their keys are among
    the `changed` keys. Errors: InvalidValue, NotFound."""
    camera = log.flown_camera
    if camera is None or "camera.calibration" in changed:
        camera = profile_camera(profile.camera)
    if profile.camera.mask is None or "camera.mask" in changed:
        return make_pipeline(profile, camera)
    try:
        return make_pipeline(profile, camera, log.flown_mask(camera))
    except ValueError as error:
        raise InvalidValue(
            f"{log.path}: the mask used in the flight does not fit the calibration: {error}"
        ) from None


# --- Replay of the perception ---


def _replayed(
    turns: Sequence[TickRecord],
    profile: Profile,
    pipeline: Pipeline,
    pictures: Iterable[Picture],
    delay_s: float,
) -> tuple[list[ReplayedInputs], PictureMissing | None]:
    """Replay perception up to the first missing image."""
    found: list[ReplayedInputs] = []
    missing: PictureMissing | None = None
    try:
        for each in replay_inputs(turns, profile, pipeline, pictures, delay_s):
            found.append(each)
    except PictureMissing as error:
        missing = error
    return found, missing


def _differing(
    log: FlightLog,
    turns: Sequence[TickRecord],
    found: Iterable[ReplayedInputs],
    comparison: Comparison,
) -> Iterator[Difference]:
    tick = -sum(turn.role == "waiting" for turn in turns)
    for each in found:
        was, seen = each.turn.observation, each.observation
        fields: list[tuple[str, Any, Any]] = [
            ("poses", each.turn.unfiltered_pose_by_marker, each.poses)
        ]
        if was is not None and seen is not None:
            logged = log_names(Observation)
            fields += [
                (logged.keys[n], getattr(was, n), getattr(seen, n))
                for n in FlightInputs.SENSED_FIELDS
                if (logged.owner, logged.keys[n]) not in comparison.unknown
            ]
        difference = comparison.first_difference(fields)
        if difference is not None:
            yield Difference(tick, log.to_flight_s(each.turn.t_s), *difference)
        tick += each.turn.role in ("waiting", "flown")


def _frames_of(turns: Iterable[TickRecord]) -> int:
    return sum(
        turn.inputs.frame is not None and turn.inputs.is_detection_requested for turn in turns
    )
