"""The corpus's pictures through today's pipeline: poses and filter are those of the flight.

Which kernels numpy's BLAS, OpenCV and the C library choose is the processor's, and their sums
differ in the last bits, which a fit of edges to pictures makes larger. So the numbers may differ
by a tolerance, which is the same on every computer; `test_senses.py` demands bits of a flight that
is recorded and seen again by one process. With the kernels of the oldest processor
(`tests.helpers.processor`) poses differed by at most 6e-9 m and 5e-8 rad, speeds by 1.2e-8 m/s,
and what the filter claims by 1.3e-10 m and 1e-9 rad. A constant that is off by 1e-3 shows in that
claim, if it weighs anything.
"""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest

from perchctl.analysis import replay
from perchctl.analysis.replayer import Replay
from perchctl.record import recorded_pictures
from perchctl.vision import filter as the_filter
from perchctl.vision import pose
from perchctl.vision.markers import edge_fit
from tests.helpers.flights import ROOT
from tests.helpers.processor import oldest_processor
from tests.replay.test_corpus import ANEW, FOLDER, corpus

PICTURES = 37
NEAR = {
    "": 2e-7,  # in the field's own unit: m, m/s, s
    "sigma_m": 3e-9,
    "sigma_yaw_rad": 1.2e-8,
    "e_yaw_rad": 1e-6,
    "world_yaw_rad": 1e-6,
}
"""What single precision leaves open; of a marker that is cut off, 1.05e-8 rad of 1.4e-3. Larger
ones hide changed constants, smaller ones are exceeded by the rounding of other libraries."""


def seen_again() -> Replay:
    """Of what the log holds: fields that are newer than it are not compared."""
    return replay(corpus("seen"), recorded_pictures(FOLDER / "seen.mcap"), tolerances=NEAR)


def _target(obs: Any) -> Any:
    return None if obs is None else obs.target


def test_the_pictures_show_what_they_showed() -> None:
    found = seen_again()
    assert found.seen is not None
    assert (found.seen.frames, found.seen.end_reason) == (PICTURES, "")
    assert not found.seen.differences, f"{found.seen.differences[0].text}; {ANEW}"


def test_they_show_all_that_matters() -> None:
    """Before take-off and after; the large marker alone, both, the small one alone."""
    turns = corpus("seen").turns
    poses = {name for turn in turns for name in turn.unfiltered_pose_by_marker}
    assert {"large", "joint", "small"} <= poses
    assert any(turn.role == "waiting" and turn.inputs.frame for turn in turns)
    stages = {t.stage for turn in turns if (t := _target(turn.observation)) is not None}
    assert len(stages) >= 3


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (edge_fit, "_BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_PX"),  # the fit of edges
        pytest.param(edge_fit, "FITTED_LINE_SIGMA_LOWER_BOUND_PX", marks=pytest.mark.long),
        pytest.param(pose, "_CORNER_SIGMA_PRIOR_DOF", marks=pytest.mark.long),  # the pose
        (the_filter, "_ACCELERATION_CORRELATION_TIME_S"),
    ],
)
def test_a_changed_constant_of_the_pipeline_is_noticed(
    module: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By 1 in 1000, which is more than another computer changes."""
    monkeypatch.setattr(module, name, getattr(module, name) * 1.001)
    found = seen_again().seen
    assert found is not None
    assert found.differences


@pytest.mark.long
def test_as_on_the_oldest_processor_it_is_near() -> None:
    """Whatever this one has beyond it, the libraries leave out."""
    text = (
        "from tests.helpers.processor import numpy_features, opencv_features\n"
        "assert not numpy_features() + opencv_features()\n"
        "from tests.replay.test_seen import seen_again\n"
        "found = seen_again().seen\n"
        "assert not found.differences, found.differences[0].text"
    )
    done = subprocess.run(
        [sys.executable, "-c", text],
        env={**os.environ, "PYTHONPATH": str(ROOT), **oldest_processor()},
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
