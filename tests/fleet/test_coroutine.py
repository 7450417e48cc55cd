"""One thread at a time: who runs is decided by the owner alone."""

from __future__ import annotations

import threading

import pytest

from perchctl.fleet.coroutine import CoroutineClosed, ThreadCoroutine


def counting(log: list[str], name: str, steps: int) -> ThreadCoroutine[str]:
    def count() -> str:
        for step in range(steps):
            log.append(f"{name}{step}")
            made.pause()
        return name

    made = ThreadCoroutine(count, name)
    return made


def test_it_runs_only_from_one_pause_to_the_next() -> None:
    log: list[str] = []
    a, b = counting(log, "a", 2), counting(log, "b", 1)
    assert log == []
    assert [a.resume(), b.resume(), b.resume(), a.resume(), a.resume()] == [
        False,
        False,
        True,
        False,
        True,
    ]
    assert log == ["a0", "b0", "a1"]
    assert (a.result, b.result) == ("a", "b")
    assert a.resume(), "it stays ended"


def test_its_error_is_raised_where_it_is_resumed() -> None:
    def fail() -> None:
        made.pause()
        raise ValueError("inside")

    made = ThreadCoroutine(fail, "fails")
    assert not made.resume()
    with pytest.raises(ValueError, match="inside"):
        made.resume()
    made.close()


@pytest.mark.parametrize("resumed", [0, 1])
def test_closed_it_ends_where_it_waits_whatever_it_does_about_it(resumed: int) -> None:
    """A flight's rescue runs in an `except BaseException`, and waits there again."""
    ended: list[str] = []

    def stubborn() -> None:
        try:
            made.pause()
        except BaseException as error:
            ended.append(type(error).__name__)
            made.pause()

    made = ThreadCoroutine(stubborn, "stubborn")
    for _ in range(resumed):
        made.resume()
    made.close()
    assert ended == [CoroutineClosed.__name__] * resumed
    assert "stubborn" not in {thread.name for thread in threading.enumerate()}
    made.close()
