"""OpenCV's number of threads: one while anybody needs it, and what it was afterwards."""

from __future__ import annotations

from contextlib import ExitStack

import cv2
import pytest

from perchctl.opencv_threads import one_thread


@pytest.fixture
def _several() -> object:
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
