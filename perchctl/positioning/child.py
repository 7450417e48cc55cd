"""The child process in which the library of motion capture runs, away from the flight.

Some of its systems wait in `connect` for ever, without letting any other thread of their process
run, and some end the process without a word (docs/positioning.md). Here that stops nobody.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from perchctl.children import Channel, connect_back

START_TIMEOUT_S = 30.0
MOST_HZ = 500.0
"""No system is faster; what comes faster is not a measurement, and would keep the parent busy."""
AFTER_PARENT_S = 1.0
PAUSE_S, AT_ONCE_S = 0.1, 2e-4

Body = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position and quaternion (w, x, y, z): plain numbers, so that nothing of the library travels."""


@dataclass(frozen=True)
class CaptureSetup:
    """What the child connects to. `partial`: a frame without a body is no frame, since the
    library's loop turns by its own clock, whether or not anything has arrived."""

    kind: str
    options: dict[str, str] = field(default_factory=dict)
    partial: bool = False
    timeout_s: float = 5.0


@dataclass(frozen=True)
class Arrived:
    """`t_s`: on this process's monotonic clock."""

    t_s: float
    bodies: dict[str, Body]


@dataclass(frozen=True)
class Failed:
    """The library has given up, with its words."""

    text: str


@dataclass(frozen=True)
class NotLoaded:
    """The library is there, and Python cannot import it."""

    text: str


class Connected:
    """The library has returned from its connecting; whether frames come is another matter."""


def serve_parent() -> None:
    """Send frames until the parent is gone, or the library gives up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = connect_back()
    setup = channel.receive(START_TIMEOUT_S)
    try:
        with _bounded(setup):
            connect = _loaded()
            client = connect(setup.kind, _by_address(setup))
        channel.send(Connected())
        threading.Thread(target=_end_with, args=(channel,), daemon=True).start()
        _pass_on(client, channel, setup.partial)
    except _LoadingFailed as error:
        with contextlib.suppress(OSError):
            channel.send(NotLoaded(str(error)))
    except Exception as error:  # whatever the library raises
        with contextlib.suppress(OSError):  # the parent may be gone, and have caused it
            channel.send(Failed(str(error) or type(error).__name__))


class _LoadingFailed(Exception):
    pass


class _Unresolved(Exception):
    pass


def _loaded() -> Callable[[str, dict[str, str]], Any]:
    try:
        import motioncapture
    except Exception as error:  # whatever its own modules and shared libraries raise
        raise _LoadingFailed(str(error) or type(error).__name__) from None
    connect: Callable[[str, dict[str, str]], Any] = motioncapture.connect
    return connect


@contextlib.contextmanager
def _bounded(setup: CaptureSetup) -> Iterator[None]:
    """By a thread of the interpreter that needs no turn of Python's: it ends the process, also
    when the parent has been killed meanwhile."""
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(setup.timeout_s + AFTER_PARENT_S, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def _by_address(setup: CaptureSetup) -> dict[str, str]:
    """OptiTrack's reader knows addresses only. Errors: _Unresolved."""
    if setup.kind != "optitrack":
        return setup.options
    host = setup.options["hostname"]
    try:
        return setup.options | {"hostname": socket.gethostbyname(host)}
    except (OSError, UnicodeError) as error:  # the latter: a name that can be none
        why = getattr(error, "strerror", None) or "it is no host's name"
        raise _Unresolved(
            f"the host name {host!r} cannot be resolved ({why}): correct positioning.host, or give "
            f"the address, as in 192.168.1.2"
        ) from None


def _pass_on(client: Any, channel: Channel, partial: bool) -> None:
    """After a pause the library may hand out what has waited in its queue: the first frame, and
    each that then comes without any waiting, is of an unknown age, and not passed on."""
    sent_s, behind = -1.0, False
    while True:
        asked_s = time.monotonic()
        client.waitForNextFrame()
        now_s = time.monotonic()
        behind = now_s - asked_s > PAUSE_S or (behind and now_s - asked_s < AT_ONCE_S)
        if behind or now_s - sent_s < 1.0 / MOST_HZ:
            continue
        bodies = {str(name): _body(body) for name, body in client.rigidBodies.items()}
        if bodies or not partial:
            sent_s = now_s
            channel.send(Arrived(now_s, bodies))


def _body(body: Any) -> Body:
    x, y, z = (float(part) for part in body.position)
    q = body.rotation
    return (x, y, z), (float(q.w), float(q.x), float(q.y), float(q.z))


def _end_with(channel: Channel) -> None:
    """The parent never speaks again: what is read is its end. The library may be anywhere."""
    channel.socket.settimeout(None)  # its setup was waited for with a limit; a flight has none
    with contextlib.suppress(OSError):
        channel.socket.recv(1)
    os._exit(0)
