"""Undocumented parts of cflib that perchctl reads or replaces.

This module contains everything that depends on these parts: the list (`INTERNALS`), the check that
the installed cflib has each of them (`check_internals`), and the functions through which the rest
of the package uses them. Without the check, a cflib release that renames such a part would silently
change how perchctl behaves after a radio failure.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from perchctl.errors import unfit_cflib

CLOSE_STEP_S = 0.01
"""Polling period while a driver is being closed, s. Longer: a dead dongle is reopened later.
Shorter: polling takes more processor time while a slow dongle closes."""


@dataclass(frozen=True)
class Internal:
    """A part of cflib: the attribute `name` of the object that `owner` returns, and how perchctl
    uses it."""

    name: str
    owner: Callable[[], Any]
    use: str


def _crazyflie() -> Any:
    from cflib.crazyflie import Crazyflie

    return Crazyflie()


def _latency() -> Any:
    return _crazyflie().link_statistics.latency


def _log_block() -> Any:
    from cflib.crazyflie.log import LogConfig

    return LogConfig("checked", period_in_ms=10)


def _log_variable() -> Any:
    from cflib.crazyflie.log import LogVariable

    return LogVariable("checked.variable")


def _toc() -> Any:
    from cflib.crazyflie.toc import Toc

    return Toc()


def _radio_driver() -> Any:
    from cflib.crtp.radiodriver import RadioDriver

    return RadioDriver()


def _radio_thread() -> Any:
    from cflib.crtp import radiodriver

    return radiodriver._RadioDriverThread(*[None] * 7)  # only constructed, never started


def _dongle_share() -> Any:
    from cflib.crtp.radiodriver import _SharedRadioInstance

    return _SharedRadioInstance(*[None] * 4)


def _dongle_thread() -> Any:
    from cflib.crtp.radiodriver import _SharedRadio

    return _Named(_SharedRadio.open_instance)  # constructing an instance would open a dongle


def _radio_manager() -> Any:
    from cflib.crtp.radiodriver import RadioManager

    return RadioManager


def _radio_module() -> Any:
    from cflib.crtp import radiodriver

    return radiodriver


class _Named:
    """An object whose attributes are the names that a function looks up or sets."""

    def __init__(self, function: Any) -> None:
        vars(self).update(dict.fromkeys(function.__code__.co_names))


INTERNALS = (
    Internal(
        "_link_error_cb", _crazyflie, "replaced, because it joins cflib's threads and deadlocks"
    ),
    Internal(
        "_send_lock", _crazyflie, "acquired without waiting, and renewed with each new driver"
    ),
    Internal("link", _crazyflie, "replaced after a driver has ended"),
    Internal("link_uri", _crazyflie, "read to open a new driver"),
    Internal("link_statistics", _crazyflie, "its callback is passed to each new driver"),
    Internal("packet_sent", _crazyflie, "called for each packet that bypasses `send_packet`"),
    Internal(
        "start",
        _latency,
        "replaced, because its pings wait for the lock while a radio is silent",
    ),
    Internal("needs_resending", _radio_driver, "false once a radio has negotiated safelink"),
    Internal(
        "out_queue",
        _radio_driver,
        "checked for room, because `send_packet` would wait for 2 s",
    ),
    Internal("_thread", _radio_driver, "the thread that shows whether the driver is alive"),
    Internal(
        "_radio",
        _radio_driver,
        "the driver's share of the dongle, with `send_packet` and `_rsp_queue`",
    ),
    Internal(
        "send_packet", _dongle_share, "wrapped, so that the hub can count the dongle's answers"
    ),
    Internal("_rsp_queue", _dongle_share, "used to wake a thread that waits for a dead dongle"),
    Internal(
        "_retry_before_disconnect", _radio_thread, "counts lost packets, unless the dongle is dead"
    ),
    Internal("rate_limit", _radio_thread, "set by the hub to poll an idle vehicle less often"),
    Internal("_radio", _dongle_thread, "None once the dongle is closed; it may never open again"),
    Internal("_radios", _radio_manager, "list from which a dongle's ended thread is removed"),
    Internal("_lock", _radio_manager, "held while an ended thread is removed from `_radios`"),
    Internal(
        "set_retries_before_disconnect",
        _radio_module,
        "called to make a radio tolerate many lost packets",
    ),
    Internal(
        "print",
        lambda: _Named(_radio_driver().scan_interface),
        "replaced, because it would print to stdout, in the middle of JSON output",
    ),
    Internal(
        "variables", _log_block, "read to build the packets that start a forgotten log block again"
    ),
    Internal("id", _log_block, "as `variables`"),
    Internal("period", _log_block, "as `variables`"),
    Internal("get_storage_and_fetch_byte", _log_variable, "as `variables`"),
    Internal("get_element_id", _toc, "as `variables`"),
)


def check_internals() -> None:
    """Raise UsageError, with the part and cflib's version, unless cflib has all `INTERNALS`."""
    for internal in INTERNALS:
        try:
            found = hasattr(internal.owner(), internal.name)
        except (ImportError, AttributeError, TypeError):
            found = False  # its owner does not exist, or has a different constructor
        if not found:
            version = "of an unknown version"
            with contextlib.suppress(metadata.PackageNotFoundError):
                version = metadata.version("cflib")
            raise unfit_cflib(internal.name, version)


# --- Use of the internals ---


def replace_error_callback(cf: Any, on_error: Callable[[str], None]) -> None:
    """Make drivers report errors to `on_error` instead of to cflib's own handler.

    A driver reports an error from inside `send_packet`, while the caller holds cflib's lock, or
    from its own thread. cflib's handler would then close the link and join its ping thread, which
    waits for that lock: a deadlock, after which nothing can be sent.
    """
    cf._link_error_cb = on_error


def stop_pings(cf: Any) -> None:
    """Disable cflib's pings; the radio's own null packets keep the link alive."""
    cf.link_statistics.latency.start = lambda: None


def send_lock(cf: Any) -> Any:
    """Return the lock that cflib's `send_packet` holds during the driver's call."""
    return cf._send_lock


def renew_send_lock(cf: Any) -> None:
    """Replace the lock: a call that blocked in the old driver may hold the old one forever."""
    cf._send_lock = threading.Lock()


def has_room(driver: Any) -> bool:
    """True if the driver accepts a packet without waiting. Only a radio's driver has a queue, which
    holds one packet."""
    queue = getattr(driver, "out_queue", None)
    return queue is None or not queue.full()


def has_safelink(driver: Any) -> bool:
    """True if packets need not be sent again: safelink is negotiated, or not needed."""
    return not getattr(driver, "needs_resending", True)


def driver_thread(driver: Any) -> threading.Thread | None:
    """Return the driver's thread; None without a driver."""
    thread: threading.Thread | None = getattr(driver, "_thread", None)
    return thread


def retries_left(thread: threading.Thread | None) -> int | None:
    """Return how many more lost packets a radio's thread tolerates; the count decreases with each
    one. None for other drivers."""
    left: int | None = getattr(thread, "_retry_before_disconnect", None)
    return left


def forget_dead_dongle(uri: str) -> None:
    """Make cflib forget a dongle that is closed or whose thread has ended; otherwise cflib would
    keep it forever.

    cflib counts the links of a closed dongle wrongly once an attempt to open it has failed, and
    then never closes the dongle again. After being unplugged twice, the dongle would stay dead
    (docs/firmware.md, "Dongle unplugged twice").

    The check and the removal hold cflib's own lock because a second link over the same dongle may
    have reopened it meanwhile.
    """
    from cflib.crtp.radiodriver import RadioDriver, RadioManager

    try:
        number = RadioDriver.parse_uri(uri)[0]
    except Exception:  # not a radio's URI, or the serial number of an unplugged dongle
        return
    with RadioManager._lock:
        radios = RadioManager._radios
        radio = radios[number] if number < len(radios) else None
        if radio is not None and (not radio.is_alive() or radio._radio is None):
            radios[number] = None


def keep_retrying(lost_packets: int) -> None:
    """Set how many successive packets a radio may lose before it gives up."""
    from cflib.crtp import radiodriver

    radiodriver.set_retries_before_disconnect(lost_packets)


def log_prints(logger: logging.Logger) -> None:
    """Log the output that cflib's radio driver would print."""
    from cflib.crtp import radiodriver

    vars(radiodriver)["print"] = lambda *words: logger.info("%s", words)


# --- Functions for the radio hub, which runs drivers without a `Crazyflie` ---


def count_answers(driver: Any, on_answer: Callable[[bool | None], None]) -> None:
    """Call `on_answer` after each packet of a radio's driver, in the driver's thread: with True if
    the vehicle acknowledged it, False if it was lost, None if the dongle failed.

    cflib's own statistics include only acknowledged packets.
    """
    share = driver._radio
    send_packet = share.send_packet

    def counted(data: Any) -> Any:
        answer = send_packet(data)
        on_answer(None if answer is None else bool(answer.ack))
        return answer

    share.send_packet = counted


def put_packet(driver: Any, packet: Any, wait_s: float) -> bool:
    """Pass a packet to a radio's driver if it has room within `wait_s`; return True if it was
    passed on.

    cflib's `send_packet` would wait for 2 s, and then report an error.
    """
    try:
        driver.out_queue.put(packet, True, wait_s)
    except queue.Full:
        return False
    return True


def limit_rate(driver: Any, packets_per_s: int | None) -> None:
    """Limit how often a radio's driver polls its vehicle from the next poll on; None: no limit.

    cflib reads the attribute `rate_limit` before each poll, although it sets the attribute only
    when the link is opened.
    """
    driver._thread.rate_limit = packets_per_s


def dongle_thread(uri: str) -> threading.Thread:
    """Return the thread of the dongle of an open URI.

    The thread ends as soon as the dongle rejects a setting, which with several vehicles happens at
    the next packet. The drivers then wait for the thread's answers forever and report nothing.
    """
    from cflib.crtp.radiodriver import RadioDriver, RadioManager

    thread: threading.Thread = RadioManager._radios[RadioDriver.parse_uri(uri)[0]]
    return thread


def forget_dongle(thread: threading.Thread) -> None:
    """Make the next driver reopen the dongle, even if the dongle's thread hangs in a USB call. Only
    allowed after all drivers of this dongle in this process have been closed."""
    from cflib.crtp.radiodriver import RadioManager

    with RadioManager._lock:
        RadioManager._radios[:] = [r if r is not thread else None for r in RadioManager._radios]


def close_radio(driver: Any, dongle: threading.Thread, timeout_s: float) -> None:
    """Close a radio's driver, with a timeout, even if its dongle's thread has ended. Sends nothing.

    cflib's `close` joins the driver's thread, which may wait forever for an answer. Therefore an
    answer of None is put into its queue, which makes the thread check whether it should end.
    """
    share = driver._radio
    closer = threading.Thread(target=driver.close, name="perchctl-close", daemon=True)
    closer.start()
    end_s = time.monotonic() + timeout_s
    while closer.is_alive() and time.monotonic() < end_s:
        if not dongle.is_alive():
            share._rsp_queue.put(None)
        closer.join(CLOSE_STEP_S)
