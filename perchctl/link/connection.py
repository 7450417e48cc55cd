"""One opened `cflib.crazyflie.Crazyflie`: opened and closed within bounds, and sent to."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from perchctl.errors import ConnectionFailed
from perchctl.files import cannot_be_written
from perchctl.link.claim import Claim, claim
from perchctl.link.uri import UDEV_HELP
from perchctl.profile.places import user_cache_folder
from perchctl.sim.crtp.codec import Packet

CONNECT_TRIES = 2
CLOSE_TIMEOUT_S = 3.0
RADIO_RETRIES = 100_000
"""Lost packets in a row after which cflib gives a radio up. Its own 100 are over in about
0.2 s, and then nothing can be ordered any more; the age of the telemetry ends a flight long
before these."""
REOPEN_TIMEOUT_S, REOPEN_PAUSE_S = 3.0, 0.2


class Connection:
    """`lost` is None while connected, then the cause in one sentence.

    `cf` is cflib's object, for its tables, parameters and log blocks.
    """

    def __init__(self) -> None:
        from cflib.crazyflie import Crazyflie

        cache = user_cache_folder() / "toc"
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            more = ": set XDG_CACHE_HOME to a folder that can be written to"
            raise cannot_be_written(cache, error, more) from None
        self.cf: Any = Crazyflie(rw_cache=str(cache))
        self.lost: str | None = None
        self.claimed: Claim | None = None
        self._left = False
        self._settled = threading.Event()  # connected, or failed
        self.cf.fully_connected.add_callback(lambda _uri: self._settled.set())
        self.cf.connection_failed.add_callback(self._on_lost)
        self.cf.connection_lost.add_callback(self._on_lost)

    def open(self, uri: str, timeout_s: float) -> bool:
        """Whether the vehicle is fully connected, or refused (`lost`), within `timeout_s`."""
        # Opening a radio may block in its driver: it gets a thread and a bound.
        opener = threading.Thread(target=self.cf.open_link, args=(uri,), daemon=True)
        opener.start()
        return self._settled.wait(timeout_s)

    def reopen(self) -> bool:
        """A new driver under the same tables and log blocks, after the link was lost in
        flight; whether one could be opened. Blocks for `REOPEN_TIMEOUT_S` at most.

        cflib's own `open_link` would reset the vehicle's log blocks and read every table and
        parameter before it is connected; the driver alone is up in milliseconds, and the
        blocks, which know nothing of it, go on arriving.
        """
        import cflib.crtp

        opened = threading.Event()

        def run() -> None:
            end_s = time.monotonic() + REOPEN_TIMEOUT_S
            while time.monotonic() < end_s and not self._left:
                try:
                    driver = cflib.crtp.get_link_driver(
                        self.cf.link_uri,
                        self.cf.link_statistics.radio_link_statistics_callback,
                        self._on_reopened_lost,
                    )
                except Exception:  # whatever the driver raises: not there, not yet
                    time.sleep(REOPEN_PAUSE_S)
                    continue
                if driver is None or self._left:
                    if driver is not None:
                        driver.close()
                    return
                self.cf.link, self.lost = driver, None
                opened.set()
                return

        threading.Thread(target=run, name="perchctl-reopen", daemon=True).start()
        return opened.wait(REOPEN_TIMEOUT_S)

    def close(self) -> None:
        """Close with cflib's farewell, a zero setpoint: only when nothing flies."""
        self._left = True
        _run_bounded([self.cf.close_link])
        self._release()

    def abandon(self) -> None:
        """Release the driver and clean up, sending nothing more."""
        self._left = True
        # Without its driver, close_link has nowhere to send the zero setpoint.
        driver, self.cf.link = self.cf.link, None
        _run_bounded([self.cf.close_link] if driver is None else [driver.close, self.cf.close_link])
        self._release()

    def _release(self) -> None:
        if self.claimed is not None:
            self.claimed.release()

    def _on_reopened_lost(self, message: str) -> None:
        driver, self.cf.link = self.cf.link, None
        if driver is not None:
            driver.close()
        self.lost = plain_cause(message)

    def _on_lost(self, _uri: str, message: str) -> None:
        self.lost = plain_cause(message)
        self._settled.set()


def open_connection(uri: str, timeout_s: float) -> Connection:
    """A vehicle's connection with all tables and parameters read.

    `timeout_s` is shared by `CONNECT_TRIES` tries, since one lost packet can hang cflib's
    connect for good (docs/firmware.md, "Link"). Raises `ConnectionFailed`, also where another
    program has the vehicle; InvalidValue without a folder for cflib's tables.
    """
    claimed = claim(uri)
    try:
        connection = _opened(uri, timeout_s)
    except BaseException:
        if claimed is not None:
            claimed.release()
        raise
    connection.claimed = claimed
    return connection


def _opened(uri: str, timeout_s: float) -> Connection:
    ready_cflib()
    _keep_radio_patient()
    share_s = timeout_s / CONNECT_TRIES
    for _ in range(CONNECT_TRIES):
        connection = Connection()
        try:
            answered = connection.open(uri, share_s)
        except BaseException:
            connection.abandon()
            raise
        if answered and connection.lost is None:
            return connection
        connection.abandon()
        if answered:
            raise ConnectionFailed(f"no Crazyflie at {uri}: {connection.lost}")
    raise ConnectionFailed(
        f"no Crazyflie at {uri}: no answer within {share_s:.0f} s "
        f"(is it switched on, is the address right?)"
    )


def ready_cflib() -> None:
    """Its drivers known, and silent."""
    import cflib.crtp

    _hush_cflib()
    if not cflib.crtp.CLASSES:  # init_drivers() extends this list at each call
        cflib.crtp.init_drivers()


def send_packets(cf: Any, packets: Iterable[Packet]) -> None:
    """Send them as they are, through the lock and the driver of cflib's `Crazyflie`."""
    for packet in packets:
        cf.send_packet(_as_cflib(packet))


def send_at_once(cf: Any, packet: Packet) -> bool:
    """Send it now, or not at all: whether it went out.

    What is true only now must not wait behind another packet, in cflib's lock or in the one
    place of its radio's queue, and go out later: the newer one is sent instead. What the radio
    has already taken, and repeats until it is acknowledged, cannot be called back.
    """
    outgoing = _as_cflib(packet)
    lock = cf._send_lock
    if not lock.acquire(blocking=False):
        return False
    try:
        driver = cf.link
        if driver is None:
            return False
        waiting = getattr(driver, "out_queue", None)
        if waiting is not None and waiting.full():
            return False
        driver.send_packet(outgoing)
        cf.packet_sent.call(outgoing)
        return True
    finally:
        lock.release()


def _as_cflib(packet: Packet) -> Any:
    from cflib.crtp.crtpstack import CRTPPacket

    outgoing = CRTPPacket()
    outgoing.set_header(packet.port, packet.channel)
    outgoing.data = packet.data
    return outgoing


def plain_cause(message: str) -> str:
    """cflib's message without its traceback, and with the remedy where there is one."""
    line = message.strip().splitlines()[0] if message.strip() else "unknown cause"
    line = line.removeprefix("Couldn't load link driver: ")
    if "Resource busy" in message or "[Errno 16]" in message:
        return (
            f"another program has it open ({line}): a Crazyradio, or a USB cable, serves one "
            f"program at a time; end that one, or plug in another Crazyradio and name it as "
            f"radio://1/..."
        )
    if "Crazyradio" in message or "Access denied" in message or "insufficient" in message.lower():
        missing = "Cannot find" in message
        what = "no Crazyradio is plugged in, or " if missing else ""
        return f"{what}there is no permission to use it ({line}).\n{UDEV_HELP}"
    if "Could not open usb" in message:
        return (
            f"no Crazyflie is plugged in by USB and switched on, or there is no permission to use "
            f"it ({line}).\n{UDEV_HELP}"
        )
    if "Connection refused" in message:
        return "nothing listens there (connection refused)"
    if "No driver found" in message:
        return "cflib has no driver for this kind of URI"
    return line


def _run_bounded(calls: Iterable[Callable[[], None]]) -> None:
    def run() -> None:
        for call in calls:
            call()

    closer = threading.Thread(target=run, daemon=True)
    closer.start()
    closer.join(CLOSE_TIMEOUT_S)


def _keep_radio_patient() -> None:
    """Where this cflib can: a radio is not given up after the first lost packets."""
    with contextlib.suppress(ImportError, AttributeError):
        from cflib.crtp import radiodriver

        radiodriver.set_retries_before_disconnect(RADIO_RETRIES)


def _hush_cflib() -> None:
    """cflib logs tracebacks of what it reports by callback as well; one sentence is enough.
    And some of its modules print, on stdout, which is for the result: that is logged, too."""
    logger = logging.getLogger("cflib")
    logger.addHandler(logging.NullHandler())
    logger.propagate = bool(os.environ.get("PERCHCTL_DEBUG"))

    def log(*words: object, **_how: object) -> None:
        logger.info(" ".join(map(str, words)))

    for name, module in list(sys.modules.items()):
        if name.startswith(("cflib.crtp", "cflib.cpx")):
            vars(module).setdefault("print", log)
