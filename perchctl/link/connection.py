"""A connection to a Crazyflie through cflib: opening and closing with timeouts, sending, and a lock
against other programs."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from perchctl.errors import ConnectionFailed, Problem
from perchctl.link import internals
from perchctl.link.crtp import Packet
from perchctl.link.hub_driver import HubDriver
from perchctl.link.protocol import UDEV_HELP, vehicle_uri
from perchctl.places import user_folder

CONNECT_TRIES = 2
"""Number of attempts to connect."""
LINK_CLOSE_TIMEOUT_S = 3.0
"""Longest wait for a driver to close, s."""
RADIO_RETRIES = 100_000
"""Number of successive lost packets after which cflib gives up on a radio link: about 200 s,
instead of 0.2 s with cflib's default of 100. Waiting is better, because a link that cflib has given
up on must negotiate safelink again."""
REOPEN_PAUSE_S = 0.05
"""Time between two attempts to reopen a driver, s."""
SAFELINK_S = 0.15
"""Timeout for safelink negotiation, s. A driver's ten attempts take 20 to 50 ms."""
DEAD_S = 0.5
"""Time without any answer after which a dongle counts as dead, s. A working dongle reports even a
lost packet within 2 ms."""


class Connection:
    """An open `cflib.crazyflie.Crazyflie`.

    `lost` is None while connected, otherwise the cause in one sentence. `cf` is cflib's `Crazyflie`
    object, which gives access to tables, parameters and log blocks. `claim`, the vehicle's lock, is
    closed when the connection ends. `shown_uri` replaces the opened URI in cflib's messages.
    """

    def __init__(self, shown_uri: str | None = None) -> None:
        from cflib.crazyflie import Crazyflie

        cache = user_folder("cache") / "toc"
        # without a cache, the tables are read from the vehicle each time
        with contextlib.suppress(OSError):
            cache.mkdir(parents=True, exist_ok=True)
        self.cf: Any = Crazyflie(rw_cache=str(cache) if cache.is_dir() else None)
        self.lost: str | None = None
        self.cause = Problem("", "")  # cause of the newest `lost`
        self._shown_uri = shown_uri
        self.claim = contextlib.ExitStack()
        self._settled = threading.Event()  # set once connected or failed
        # guards the fields below; cflib is never called with it held
        self._change = threading.Lock()
        self._left = False
        self._number = 0  # number of the current driver; reports from earlier drivers are ignored
        self._closer: threading.Thread | None = None
        self._opener: threading.Thread | None = None
        self._has_safelink = False
        self._refused_since_s: float | None = None  # when the lock became unavailable
        # time of the last call of `is_dead`, and time of the last change of the count
        self._asked_s = self._counted_s = 0.0
        self._counted: object = None
        internals.replace_error_callback(self.cf, partial(self._on_error, self._number))
        internals.stop_pings(self.cf)
        self.cf.fully_connected.add_callback(lambda _uri: self._settled.set())
        self.cf.connection_failed.add_callback(self._on_failed)

    def open(self, uri: str, timeout_s: float) -> bool:
        """Open the link; return True if it was connected or refused (see `lost`) within
        `timeout_s`."""
        # Opening a radio may block in its driver, so it runs in a thread, with a timeout.
        start_thread("perchctl-open", lambda: self.cf.open_link(uri))
        if not self._settled.wait(timeout_s):
            return False
        self._has_safelink = internals.has_safelink(self.cf.link)
        return True

    def send(self, packet: Packet) -> bool:
        """Send a packet now or not at all. Return True if the driver accepted it.

        Unlike cflib's `send_packet`, this method never waits for cflib's lock or for the single
        slot in the radio driver's queue. That wait would take 2 s, after which the driver would
        report its own failure from inside the call.
        """
        if self.lost is not None:
            return False
        outgoing = _as_cflib(packet)
        lock = internals.send_lock(self.cf)
        if not lock.acquire(blocking=False):
            if self._refused_since_s is None:
                self._refused_since_s = time.monotonic()
            return False
        try:
            self._refused_since_s = None
            driver = self.cf.link
            if driver is None or isinstance(driver, _Nowhere) or not internals.has_room(driver):
                return False
            driver.send_packet(outgoing)
            self.cf.packet_sent.call(outgoing)
            return True
        finally:
            lock.release()

    def is_dead(self) -> bool:
        """True if the driver has been stuck for `DEAD_S` and will never accept a packet again.

        Must be called repeatedly while the driver accepts no packet, and only then.

        If the vehicle is out of range, the driver counts lost packets and recovers by itself. If
        the dongle was unplugged, the driver counts nothing, but cflib still retries forever.
        """
        now_s, asked_s = time.monotonic(), self._asked_s
        self._asked_s = now_s
        if self._refused_since_s is not None and now_s - self._refused_since_s > DEAD_S:
            return True
        thread = internals.driver_thread(self.cf.link)
        left = internals.retries_left(thread)
        if self._counted != (thread, left) or now_s - asked_s > DEAD_S:
            self._counted, self._counted_s = (thread, left), now_s
        if thread is None:
            return False
        return not thread.is_alive() or (left is not None and now_s - self._counted_s > DEAD_S)

    def reopen(self, cause: str | None = None) -> None:
        """Replace the driver: open new drivers until one answers. The old driver has ended or, if
        `cause` is given, is closed. Returns at once; the link is `lost` until a driver answers."""
        with self._change:
            if self._left or (self._opener is not None and self._opener.is_alive()):
                return
            if self.lost is None:
                if cause is None:
                    return
                self._give_up(Problem(cause, ""))
            self._opener = start_thread("perchctl-reconnect", self._open_again)

    def close(self, *, farewell: bool) -> None:
        """Release the driver. If `farewell` is True, cflib sends its zero setpoint, which drops a
        flying vehicle; otherwise nothing is sent."""
        calls = [self.cf.close_link]
        with self._change:
            self._left = True
            if not farewell and self.cf.link is not None:
                # Without a driver, cflib's close_link cannot send the zero setpoint.
                calls.insert(0, self.cf.link.close)
                self.cf.link = None
        _run_bounded(calls)
        self.claim.close()

    def _on_error(self, number: int, message: str) -> None:
        """Record that a driver has ended. Called in any thread, at any time."""
        with self._change:
            if number == self._number and not self._left:
                self._give_up(find_cause(message))
        self._settled.set()

    def _on_failed(self, _uri: str, message: str) -> None:
        self._lose(find_cause(message))
        self._settled.set()

    def _lose(self, cause: Problem) -> None:
        if self._shown_uri is not None and self.cf.link_uri:
            cause = replace(cause, found=cause.found.replace(self.cf.link_uri, self._shown_uri))
        self.cause, self.lost = cause, _cause_text(cause)

    def _give_up(self, cause: Problem) -> None:
        """Close the current driver without a replacement. Called with `_change` held."""
        self._number += 1
        self._lose(cause)
        driver, self.cf.link = self.cf.link, _Nowhere()
        if driver is not None:
            self._closer = start_thread("perchctl-close", driver.close)

    def _open_again(self) -> None:
        if self._closer is not None:
            self._closer.join(LINK_CLOSE_TIMEOUT_S)  # two drivers would share one dongle
        while not self._left and not self._is_open_again():
            time.sleep(REOPEN_PAUSE_S)

    def _is_open_again(self) -> bool:
        import cflib.crtp

        with self._change:
            self._number += 1
            number = self._number
        internals.forget_dead_dongle(self.cf.link_uri)
        try:
            driver = cflib.crtp.get_link_driver(
                self.cf.link_uri,
                self.cf.link_statistics.radio_link_statistics_callback,
                partial(self._on_error, number),
            )
        except Exception:  # any driver error: the radio is not available yet
            return False
        if driver is None:
            return False
        if self._agrees_on_safelink(driver):
            with self._change:
                if number == self._number and not self._left:
                    internals.renew_send_lock(self.cf)
                    self._refused_since_s = None
                    self.cf.link, self.lost = driver, None
                    return True
        _run_bounded([driver.close])
        return False

    def _agrees_on_safelink(self, driver: Any) -> bool:
        """Wait for a new driver to negotiate safelink, with a timeout. Return True if the driver
        has safelink or does not need it.

        A vehicle that has used safelink accepts only one packet from a driver without safelink
        (docs/firmware.md, "Safelink"). A driver that was opened while the vehicle was out of range
        never gets safelink.
        """
        end_s = time.monotonic() + SAFELINK_S
        while self._has_safelink and not internals.has_safelink(driver):
            if self._left or time.monotonic() >= end_s:
                return False
            time.sleep(0.01)
        return True


class _Nowhere:
    """Placeholder for cflib's missing driver, since cflib checks for a new one only once a
    second."""

    needs_resending = False

    def send_packet(self, packet: object) -> None:
        return None

    def receive_packet(self, wait_s: float = 0.0) -> None:
        time.sleep(min(max(wait_s, 0.0), 0.02))

    def close(self) -> None:
        return None


def open_connection(uri: str, timeout_s: float, *, shown_uri: str | None = None) -> Connection:
    """Open a vehicle's connection and read all tables and parameters. Messages call the vehicle
    `shown_uri` or, if that is not given, `uri`.

    `timeout_s` is shared by `CONNECT_TRIES` attempts, since a single lost packet can block cflib's
    connect permanently (docs/firmware.md, "Link"). Raises `ConnectionFailed`, also if another
    program uses the vehicle.
    """
    share_s, shown_uri = timeout_s / CONNECT_TRIES, shown_uri or uri
    with lock_vehicle(uri, shown_uri) as claim:
        init_cflib()
        for _ in range(CONNECT_TRIES):
            connection = Connection(shown_uri)
            answered = False
            try:
                answered = connection.open(uri, share_s)
            finally:
                if not answered or connection.lost is not None:
                    connection.close(farewell=False)
            if answered and connection.lost is not None:
                cause = connection.cause
                found, separator = f"no Crazyflie at {shown_uri}: {cause.found}", _separator(cause)
                raise ConnectionFailed(found, cause.advice, separator=separator)
            if answered:
                connection.claim = claim.pop_all()
                return connection
    raise ConnectionFailed(
        f"no Crazyflie at {shown_uri}: no answer within {share_s:.0f} s",
        "switch it on and check its address; perchctl check --scan lists the vehicles that answer",
    )


def init_cflib() -> None:
    """Register cflib's drivers, keep the radio driver from giving up after the first lost packets,
    and silence cflib, which prints to stdout and logs errors that it also reports by callback.
    Raises UsageError if this cflib lacks a part that perchctl needs."""
    import cflib.crtp

    internals.check_internals()
    logger = logging.getLogger("cflib")
    logger.addHandler(logging.NullHandler())
    logger.propagate = bool(os.environ.get("PERCHCTL_DEBUG"))
    internals.log_prints(logger)
    internals.keep_retrying(RADIO_RETRIES)
    if not cflib.crtp.CLASSES:  # init_drivers() extends this list at each call
        cflib.crtp.init_drivers()
    if HubDriver not in cflib.crtp.CLASSES:
        cflib.crtp.CLASSES.append(HubDriver)


def send_packets(cf: Any, packets: Iterable[Packet]) -> None:
    """Send packets unchanged, through the lock and the driver of cflib's `Crazyflie`."""
    for packet in packets:
        cf.send_packet(_as_cflib(packet))


def _as_cflib(packet: Packet) -> Any:
    from cflib.crtp.crtpstack import CRTPPacket

    outgoing = CRTPPacket()
    outgoing.set_header(packet.port, packet.channel)
    outgoing.data = packet.data
    return outgoing


_PERMISSION = "you do not have permission to use it"
_CAUSES = {
    "Resource busy": Problem(
        "another program has it open: a Crazyradio or a USB cable serves one program at a time",
        "end that program, or plug in another Crazyradio and name it as radio://1/...",
    ),
    "Connection refused": Problem("no program is listening there (connection refused)", ""),
    "Could not open usb": Problem(
        f"no Crazyflie is connected by USB and switched on, or {_PERMISSION}", UDEV_HELP
    ),
    "Cannot find": Problem(f"no Crazyradio is plugged in, or {_PERMISSION}", UDEV_HELP),
    "Access denied": Problem(_PERMISSION, UDEV_HELP),
}
"""Cause and remedy for an error of cflib, by words in the error message; the first match is
used."""


def find_cause(message: str) -> Problem:
    """Return the cause of a cflib error and its remedy if they are known, otherwise cflib's message
    without the traceback."""
    for words, cause in _CAUSES.items():
        if words in message:
            return cause
    line = message.strip().splitlines()[0] if message.strip() else "unknown cause"
    return Problem(line.removeprefix("Couldn't load link driver: "), "")


def readable_cause(message: str) -> str:
    """Return the cause and its remedy as one text."""
    return _cause_text(find_cause(message))


def _cause_text(cause: Problem) -> str:
    return f"{cause.found}{_separator(cause)}{cause.advice}" if cause.advice else cause.found


def _separator(cause: Problem) -> str:
    """Return the separator before the remedy: a line break if the remedy has several lines."""
    return ".\n" if "\n" in cause.advice else "; "


def _run_bounded(calls: Iterable[Callable[[], None]]) -> None:
    def run() -> None:
        for call in calls:
            call()

    start_thread("perchctl-close", run).join(LINK_CLOSE_TIMEOUT_S)


def start_thread(name: str, call: Callable[[], object]) -> threading.Thread:
    """Start a daemon thread for a call that may block in a driver."""
    thread = threading.Thread(target=call, name=name, daemon=True)
    thread.start()
    return thread


# --- One program per vehicle: a lock between the programs of one user on this computer ---
# Connecting through cflib would reset the log blocks of a vehicle that flies for another program,
# and two streams of setpoints would conflict.


def lock_vehicle(uri: str, shown_uri: str | None = None) -> contextlib.ExitStack:
    """Lock the vehicle at `uri` (called `shown_uri` in messages) for this process until the result
    is closed.

    Nothing is locked if no lock can be created (no writable folder, or Windows). Raises
    ConnectionFailed if another program holds the lock.
    """
    path = user_folder("runtime") / (re.sub(r"[^A-Za-z0-9.]+", "_", vehicle_uri(uri)) + ".lock")
    with contextlib.ExitStack() as claim:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            file = claim.enter_context(path.open("a"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConnectionFailed(
                    f"the vehicle at {shown_uri or uri} is in use by another program",
                    "end that program, or name another vehicle",
                    separator=": ",
                ) from None
        return claim.pop_all()
