"""The reader's process: it ends with its parent, and not before."""

from __future__ import annotations

import socket
import threading
from typing import ClassVar

import pytest

from perchctl.children import Channel
from perchctl.positioning import child


def test_a_reader_outlives_the_time_in_which_it_was_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        own = socket.create_connection(listener.getsockname())
        parent, _ = listener.accept()
    ended = threading.Event()
    monkeypatch.setattr(child.os, "_exit", lambda code: ended.set())
    channel = Channel(own)
    parent.sendall(b"\x02\x00\x00\x00N.")  # a setup: None, pickled
    assert channel.receive(0.05) is None
    thread = threading.Thread(target=child._end_with, args=(channel,))
    thread.start()
    assert not ended.wait(0.3)  # long after that limit
    parent.close()
    assert ended.wait(5.0)
    thread.join()
    own.close()


class Clock:
    def __init__(self) -> None:
        self.t_s = 100.0

    def monotonic(self) -> float:
        return self.t_s


class Client:
    """Gives a frame after each of these waits, s, and then is gone."""

    rigidBodies: ClassVar[dict[str, object]] = {}

    def __init__(self, clock: Clock, waits_s: list[float]) -> None:
        self.clock, self.waits_s = clock, iter(waits_s)

    def waitForNextFrame(self) -> None:
        wait_s = next(self.waits_s, None)
        if wait_s is None:
            raise RuntimeError("gone")
        self.clock.t_s += wait_s


class Sent:
    def __init__(self) -> None:
        self.frames: list[child.Arrived] = []

    def send(self, frame: child.Arrived) -> None:
        self.frames.append(frame)


def test_what_waited_in_the_library_s_queue_is_not_passed_on_as_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a pause come the frames of the pause, one upon the other, the oldest first."""
    clock, sent = Clock(), Sent()
    monkeypatch.setattr(child, "time", clock)
    steady, queued = [0.01] * 3, [0.5, 1e-5, 1e-5, 1e-5]
    with pytest.raises(RuntimeError):
        child._pass_on(Client(clock, steady + queued + steady), sent, False)  # type: ignore[arg-type]
    times_s = [frame.t_s for frame in sent.frames]
    begun_s = 100.0 + sum(steady) + sum(queued)
    assert len(times_s) == 2 * len(steady)
    assert not [t_s for t_s in times_s if 100.0 + sum(steady) + 1e-6 < t_s <= begun_s + 1e-6]
