"""OpenCV's number of threads: one while anyone needs it, and restored afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import cv2
import pytest

from perchctl.opencv_threads import one_thread
from perchctl.profile import Profile
from perchctl.vision import PipelineState, deinterlace, make_pipeline, step
from perchctl.vision import pipeline as pipeline_module
from tests.helpers.interlaced import Pass
from tests.helpers.target_picture import CAMERA


@pytest.fixture
def _several() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("_several")
def test_the_last_of_several_users_restores_it() -> None:
    """The first to come leaves first, as two streams in threads of one process do."""
    first, second = ExitStack(), ExitStack()
    first.enter_context(one_thread())
    second.enter_context(one_thread())
    first.close()
    assert cv2.getNumThreads() == 1
    second.close()
    assert cv2.getNumThreads() == 2


@pytest.mark.usefixtures("_several")
def test_an_error_restores_it() -> None:
    with pytest.raises(ZeroDivisionError), one_thread():
        _ = 1 / 0
    assert cv2.getNumThreads() == 2


@pytest.mark.usefixtures("_several")
def test_a_whole_picture_is_searched_by_all_threads_and_a_tracked_target_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    threads: list[int] = []
    find = pipeline_module.detect_markers

    def found(*given: Any) -> Any:
        threads.append(cv2.getNumThreads())
        return find(*given)

    monkeypatch.setattr(pipeline_module, "detect_markers", found)
    setup, state = make_pipeline(Profile(), CAMERA), PipelineState()
    for frame in Pass(0.5).frames(3):
        state, (picture,) = deinterlace(state, frame, setup)
        state, _ = step(state, picture, None, setup)
    assert threads == [2, 1, 1]
    assert cv2.getNumThreads() == 2
