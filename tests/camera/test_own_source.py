"""Your own camera: its first frame is waited for, and what it does wrong is a lost camera."""

from __future__ import annotations

import math
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from perchctl.camera import open_camera
from perchctl.errors import ConnectionFailed, TimedOut
from perchctl.vision import Frame

GREY = np.full((4, 6), 90, np.uint8)


class Camera:
    """Each poll returns, or raises, the next of `script`, then None."""

    live, finished, size_px = True, False, None
    closed = 0
    script: list[Any]
    wrong: BaseException | None

    def __init__(self, clock: Any, config: Any) -> None:
        pass

    def poll(self, now_s: float) -> Any:
        given = self.script.pop(0) if self.script else None
        if isinstance(given, Exception):
            raise given
        return given

    def problem(self, now_s: float) -> str | None:
        if self.wrong is not None:
            raise self.wrong
        return None

    def describe(self) -> str:
        return "my camera"

    def close(self) -> None:
        Camera.closed += 1


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Any:
    module = ModuleType("my_camera")
    module.Camera = Camera  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "my_camera", module)

    def open_with(*script: Any, wrong: BaseException | None = None) -> Any:
        Camera.script, Camera.wrong, Camera.closed = list(script), wrong, 0
        return open_camera("my_camera:Camera", lambda: 10.0, timeout_s=0.05)

    return open_with


def frame(t_s: float, image: Any = GREY) -> Frame:
    return Frame(0, t_s, image)


def test_the_first_frame_is_waited_for_and_given_first(opened: Any) -> None:
    colour = np.dstack([GREY] * 3)
    source = opened(None, frame(9.0, colour), frame(9.0), frame(8.0), frame(9.5))
    assert source.size_px == (6, 4)
    first = source.poll(10.0)
    assert (first.t_s, first.image.shape, first.t_arrival_s) == (9.0, (4, 6), 10.0)
    newer = [source.poll(10.0) for _ in range(3)]
    assert [each and each.t_s for each in newer] == [None, None, 9.5]
    assert source.problem(20.0) is None
    assert source.poll(20.0) is None
    assert source.problem(21.1) == "my_camera:Camera has delivered no frame for 1.1 s"
    assert source.problem(-math.inf) is None
    with pytest.raises(TimedOut, match=r"my_camera:Camera: no first frame within 0\.05 s"):
        opened()
    assert Camera.closed == 1


@pytest.mark.parametrize(("given", "words"), [
    (ZeroDivisionError("of its author"), "ZeroDivisionError: of its author"),
    (GREY, "must return a Frame or None, not ndarray"),
    (frame(10.5), r"t_s must be in the past, not 10\.5"),
    (frame(float("nan")), "t_s must be in the past, not nan"),
    (frame(9.2, None), "the picture is None"),
])  # fmt: skip
def test_what_it_does_wrong_is_a_lost_camera(given: Any, words: str, opened: Any) -> None:
    with pytest.raises(ConnectionFailed, match=f"my_camera:Camera: .*{words}"):
        opened(given)
    assert Camera.closed == 1
    source = opened(frame(9.0), given, frame(9.8))
    polled = [source.poll(10.0) for _ in range(3)]
    assert [each and each.t_s for each in polled] == [9.0, None, None]
    assert words.rpartition(" ")[2].replace("\\", "") in source.problem(10.0)
    failing = opened(frame(9.0), wrong=ZeroDivisionError("of its author"))
    assert "of its author" in failing.problem(10.0)
