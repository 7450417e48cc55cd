"""The reader's process: it ends with its parent, and not before."""

from __future__ import annotations

import socket
import threading
from typing import Any, ClassVar

import pytest

from perchctl.children import Channel
from perchctl.positioning import capture


def test_a_reader_outlives_the_time_in_which_it_was_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        own = socket.create_connection(listener.getsockname())
        parent, _ = listener.accept()
    ended = threading.Event()
    monkeypatch.setattr(capture.os, "_exit", lambda code: ended.set())
    channel = Channel(own)
    parent.sendall(b"\x02\x00\x00\x00N.")  # a setup: None, pickled
    assert channel.receive(0.05) is None
    thread = threading.Thread(target=capture._end_with, args=(channel,))
    thread.start()
    assert not ended.wait(0.3)  # long after that limit
    parent.close()
    assert ended.wait(5.0)
    thread.join()
    own.close()


class Parent:
    """Gives the setup, and takes what is said."""

    def __init__(self, setup: capture.CaptureSetup, gone: bool = False) -> None:
        self.setup, self.gone, self.said = setup, gone, list[Any]()

    def receive(self, timeout_s: float) -> capture.CaptureSetup:
        return self.setup

    def send(self, message: Any) -> None:
        if self.gone:
            raise BrokenPipeError
        self.said.append(message)


@pytest.mark.parametrize(("host", "raised", "words"), [
    ("lab", socket.gaierror(-2, "Name or service not known"),
     "the host name 'lab' cannot be resolved (Name or service not known): correct"),
    ("a..b", UnicodeError("label empty or too long"), "'a..b' cannot be resolved (it is no host"),
])  # fmt: skip
def test_a_host_that_cannot_be_resolved_is_named(
    host: str, raised: Exception, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def resolve(name: str) -> str:
        raise raised

    parent = Parent(capture.CaptureSetup("optitrack", {"hostname": host}))
    monkeypatch.setattr(capture, "connect_back", lambda: parent)
    monkeypatch.setattr(capture, "_loaded", lambda: None)
    monkeypatch.setattr(capture.signal, "signal", lambda *_: None)
    monkeypatch.setattr(capture.socket, "gethostbyname", resolve)
    capture.serve_parent()
    (said,) = parent.said
    assert isinstance(said, capture.Failed)
    assert words in said.text


def test_a_parent_that_is_gone_is_left_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    parent = Parent(capture.CaptureSetup("vicon", {"hostname": "lab"}), gone=True)
    monkeypatch.setattr(capture, "connect_back", lambda: parent)
    monkeypatch.setattr(capture, "_loaded", lambda: lambda kind, options: None)
    monkeypatch.setattr(capture.signal, "signal", lambda *_: None)
    capture.serve_parent()


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
        self.frames: list[capture.Arrived] = []

    def send(self, frame: capture.Arrived) -> None:
        self.frames.append(frame)


def test_what_waited_in_the_library_s_queue_is_not_passed_on_as_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a pause come the frames of the pause, one upon the other, the oldest first."""
    clock, sent = Clock(), Sent()
    monkeypatch.setattr(capture, "time", clock)
    steady, queued = [0.01] * 3, [0.5, 1e-5, 1e-5, 1e-5]
    with pytest.raises(RuntimeError):
        capture._pass_on(Client(clock, steady + queued + steady), sent, False)  # type: ignore[arg-type]
    times_s = [frame.t_s for frame in sent.frames]
    begun_s = 100.0 + sum(steady) + sum(queued)
    assert len(times_s) == 2 * len(steady)
    assert not [t_s for t_s in times_s if 100.0 + sum(steady) + 1e-6 < t_s <= begun_s + 1e-6]
