"""The reader's process: it ends with its parent, and not before."""

from __future__ import annotations

import socket
import threading

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
