"""The flight loop's senses on live pictures for a few seconds: what they see, how long it takes.

The vehicle stays as it is: nothing is sent.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from perchctl.camera import FrameSource, WrappedSource
from perchctl.flight import Clock, FlightInputs
from perchctl.link import Guard, SentCallback, ignore_sent
from perchctl.profile import Profile
from perchctl.target import PrintCheck, PrintVerdict
from perchctl.values import replace
from perchctl.vehicle import Command, ExternalPosition, MeasuredBy, Telemetry
from perchctl.vision import Detections, Frame, Pipeline, TargetEstimate

REHEARSED_S = 3.0
WARM_FRAMES = 3
"""The first frames load libraries: how long they took says nothing."""
KEPT_FRAMES = 12


class Silent:
    """A link to nothing, where there is no vehicle."""

    def connect(self) -> None:
        return None

    def measured_by(self) -> MeasuredBy:
        return MeasuredBy()

    def telemetry(self) -> list[Telemetry]:
        return []

    def send(self, command: Command) -> None:
        return None

    def external(self, place: ExternalPosition) -> bool:
        return False

    def problem(self, now_s: float) -> str | None:
        return None

    def guard(self, guard: Guard, told: SentCallback = ignore_sent) -> None:
        return None

    def close(self) -> None:
        return None


class Listened(Protocol):
    """What of a link is heard here."""

    def telemetry(self) -> list[Telemetry]: ...


@dataclass(frozen=True, eq=False)
class Looked:
    """One picture with what was found in it."""

    frame: Frame
    detections: Detections


@dataclass(eq=False)
class Rehearsal:
    """What came of it.

    Attributes:
        arrivals: index and time of arrival of each picture that was taken up.
        repeats: how often one was given out again; these count for nothing else.
        work_s: of the turns that looked at a picture; late_s: of all turns.
        ages_s: from a picture's exposure, by `camera.latency_s`, to its result.
        problems: why pictures were no good, or were remarkable, with their number.
        looked: the newest few; found: of how many pictures there was a target, and mirrored ones.
        silent_s: since the last picture, at the end.
        target: where it was at the end; None where it was not seen then.
    """

    live: bool
    problem: str = ""
    arrivals: list[tuple[int, float]] = field(default_factory=list)
    work_s: list[float] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    remarks: list[str] = field(default_factory=list)
    looked: list[Looked] = field(default_factory=list)
    pictures: int = 0
    repeats: int = 0
    found: int = 0
    mirrored: int = 0
    silent_s: float = 0.0
    target: TargetEstimate | None = None
    height_m: float | None = None
    print_verdict: PrintVerdict | None = None


class _Noted(WrappedSource):
    """Remembers the newest picture."""

    newest: Frame | None = None

    def poll(self, now_s: float) -> Frame | None:
        self.newest = super().poll(now_s)
        return self.newest


def rehearse(
    link: Listened,
    source: FrameSource,
    pipeline: Pipeline,
    profile: Profile,
    clock: Clock,
    duration_s: float = REHEARSED_S,
    stopwatch: Callable[[], float] = time.perf_counter,
) -> Rehearsal:
    """Run the senses for so long, at the loop's rate. The source's size must fit.

    `stopwatch` takes the time of the work; the clock may be a simulated one, which work does not
    move.
    """
    noted = _Noted(source)
    senses = FlightInputs(_only_heard(link, profile), noted, pipeline, profile)
    done = Rehearsal(source.live)
    prints = PrintCheck(pipeline.camera, profile.target)
    period_s = 1.0 / profile.link.loop_hz
    due_s = start_s = clock.now()
    while due_s < start_s + duration_s and not source.finished:
        began_s, mark_s = clock.now(), stopwatch()
        senses.take_in(began_s)
        work_s = stopwatch() - mark_s
        done.late_s.append(max(0.0, began_s - due_s))
        if noted.newest is not None:
            _note(done, noted.newest, senses, prints, work_s, began_s)
        due_s += period_s
        if due_s < clock.now():
            due_s = clock.now()  # as the loop: no burst of old turns
        clock.wait_until(due_s)
    end_s = clock.now()
    done.problem = source.problem(end_s) or ""
    done.silent_s = end_s - (done.arrivals[-1][1] if done.arrivals else start_s)
    done.remarks = senses.perception.take_remarks()
    target = senses.target(end_s)
    done.target = target if target is not None and target.tracked else None
    newest = senses.history.newest
    done.height_m = None if newest is None else newest.position_m[2] - profile.safety.ground_z_m
    done.print_verdict = prints.verdict() if prints.judged else None
    return done


def _note(
    done: Rehearsal,
    frame: Frame,
    senses: FlightInputs,
    prints: PrintCheck,
    work_s: float,
    now_s: float,
) -> None:
    if senses.repeated:
        done.repeats += 1
        return
    done.pictures += 1
    done.arrivals.append((frame.index, frame.t_arrival_s))
    if senses.camera_problem is not None:
        done.problems[senses.camera_problem] += 1
    output = senses.output
    if output is None:
        return
    if done.pictures > WARM_FRAMES:
        done.work_s.append(work_s)
        done.ages_s.append(now_s - frame.t_s + work_s)
    seen = output.detections
    done.found += seen.large is not None or seen.small is not None
    done.mirrored += seen.mirrored
    prints.add(output)
    done.looked = [*done.looked[1 - KEPT_FRAMES :], Looked(frame, seen)]


class _OnlyHeard(Silent):
    def __init__(self, link: Listened) -> None:
        self._link = link

    def telemetry(self) -> list[Telemetry]:
        return self._link.telemetry()


class _Stands(_OnlyHeard):
    """A vehicle that nobody tells its position here: its estimate runs away, and it stands."""

    def __init__(self, link: Listened, ground_z_m: float) -> None:
        super().__init__(link)
        self._feet_m = (0.0, 0.0, ground_z_m)

    def telemetry(self) -> list[Telemetry]:
        return [
            replace(sample, position_m=self._feet_m, velocity_mps=(0.0, 0.0, 0.0))
            for sample in super().telemetry()
        ]


def _only_heard(link: Listened, profile: Profile) -> Silent:
    """So that nothing here can send."""
    if profile.positioning.by == "target":
        return _Stands(link, profile.safety.ground_z_m)
    return _OnlyHeard(link)
