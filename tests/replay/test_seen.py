"""The corpus's pictures through today's pipeline: poses and filter are those of the flight.

Which kernels numpy's BLAS, OpenCV and the C library choose is the processor's, and their sums
differ in the last bits, which a fit of edges to pictures makes larger. So bits are demanded of a
computer with the flight's libraries and arithmetic (`perchctl.record.header`), and closeness of
any other. Emulated by their own switches (`ELSEWHERE` and others), processors without FMA, AVX2,
AVX, SSE4 differed by at most 5e-8 m and 4e-7 rad, and in what the filter claims by 7e-10 m and
3e-9 rad. A constant that is off by 1e-3 shows in that claim, if it weighs anything. A threshold
shows where a picture lies between, and some constants move less than a processor does: these are
noticed by bits only.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.analysis import replay
from perchctl.analysis.replayer import Replay
from perchctl.record import recorded_pictures, to_exact_json
from perchctl.vision import filter as the_filter
from perchctl.vision import pose
from perchctl.vision.markers import edge_fit
from tests.helpers.flights import ROOT
from tests.replay.test_corpus import ANEW, FOLDER, corpus

PICTURES = 37
NEAR = {"sigma_m": 3e-9, "sigma_yaw_rad": 1.2e-8, "e_yaw_rad": 1e-6, "world_yaw_rad": 1e-6}
"""What single precision leaves open; of a marker that is cut off, 1.05e-8 rad of 1.4e-3."""
NEAR_M = 2e-7
ELSEWHERE = {
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3",
    "OPENCV_CPU_DISABLE": "AVX2,FP16,AVX",
}
"""A processor of 2008, but for the C library."""


def seen_again() -> Replay:
    return replay(corpus("seen"), recorded_pictures(FOLDER / "seen.mcap"))


def beyond(found: Replay) -> list[tuple[int, str, Any, Any]]:
    """What is not near, by turn: poses, and what the planner was shown of the target."""
    assert found.seen is not None
    return [
        (each.turn.number, *far)
        for each in found.seen.turns
        for one, other in (
            (each.turn.poses, each.poses),
            (_target(each.turn.observation), _target(each.observation)),
        )
        for far in _far("", to_exact_json(one), to_exact_json(other))
    ]


def _target(obs: Any) -> Any:
    return None if obs is None else obs.target


def _far(name: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one:
            yield from _far(key, one[key], other[key])
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for a, b in zip(one, other, strict=True):
            yield from _far(name, a, b)
    elif isinstance(one, float) and isinstance(other, float):
        if not abs(one - other) <= NEAR.get(name, NEAR_M):
            yield name, one, other
    elif one != other:
        yield name, one, other


def test_the_pictures_show_what_they_showed() -> None:
    found = seen_again()
    assert found.seen is not None
    assert (found.seen.frames, found.seen.end_reason) == (PICTURES, "")
    assert not beyond(found), f"{beyond(found)[:1]}; {ANEW}"
    if not found.log.computer_differences:
        assert not found.seen.differences, f"{found.seen.differences[0].text}; {ANEW}"


def test_they_show_all_that_matters() -> None:
    """Before take-off and after; the large marker alone, both, the small one alone."""
    turns = corpus("seen").turns
    poses = {name for turn in turns for name in turn.poses}
    assert {"large", "joint", "small"} <= poses
    assert any(turn.role == "waiting" and turn.taken.frame for turn in turns)
    stages = {t.stage for turn in turns if (t := _target(turn.observation)) is not None}
    assert len(stages) >= 3


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (edge_fit, "_SHIFT_PRIOR_PX"),  # the fit of edges
        (edge_fit, "MIN_LINE_SIGMA_PX"),
        (pose, "_TRUST"),  # the pose
        (the_filter, "_PUSH_S"),
    ],
)
def test_a_changed_constant_of_the_pipeline_is_noticed(
    module: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By 1 in 1000: on this computer, and on one where the last bits are others."""
    monkeypatch.setattr(module, name, getattr(module, name) * 1.001)
    found = seen_again()
    assert not found.is_identical
    assert beyond(found)


@pytest.mark.long
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the switches are that processor's")
def test_on_another_processor_it_is_near() -> None:
    """Its arithmetic is another, which is noticed."""
    asked = "from perchctl.record import header; print(header.arithmetic_fingerprint())"
    assert _elsewhere({}, asked) != _elsewhere(ELSEWHERE, asked)
    _elsewhere(
        ELSEWHERE,
        "from tests.replay.test_seen import beyond, seen_again\n"
        "found = seen_again()\n"
        "assert not beyond(found), beyond(found)[:3]",
    )


def _elsewhere(switches: dict[str, str], text: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", text],
        env={**os.environ, "PYTHONPATH": str(ROOT), **switches},
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
