"""Links that read from a vehicle without commanding it, and a scan for vehicles.

`AttitudeLink` reads the motion of a vehicle that is moved by hand. `ProbeLink` reads a vehicle's
configuration and the link quality, and can blink the vehicle's LEDs. Nothing in this module makes a
vehicle fly, arm or spin a motor.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from perchctl.calibration import AttitudeSample
from perchctl.errors import NotFound, PerchError, Problem, TimedOut
from perchctl.link.cflib_link import CflibLink
from perchctl.link.connection import (
    Connection,
    find_cause,
    init_cflib,
    send_packets,
    start_thread,
)
from perchctl.link.crtp import Packet, Port
from perchctl.link.external_position import estimator_parameters
from perchctl.link.firmware import (
    NEEDED_PROTOCOL,
    check_firmware,
    missing_variables,
    read_device_type,
    read_parameters,
    set_parameters,
)
from perchctl.link.protocol import FORMS, USUAL_ADDRESS
from perchctl.link.telemetry import FIRST_SAMPLE_TIMEOUT_S, Timebase, start_block
from perchctl.profile import LinkConfig
from perchctl.vehicle import FLYING, is_armed_by_request


class ReadOnlyLink(CflibLink):
    """A `CflibLink` that sets no parameters, arms nothing, and sends no commands, not even as it
    closes: the vehicle may be flying for another program."""

    def close(self) -> None:
        """Close at once, without the setpoint that cflib normally sends when it closes."""
        self._leave(farewell=False)

    def _may_say_farewell(self) -> bool:
        return False  # even if connecting fails half-way

    def _prepare(self, connection: Connection) -> None:
        """Do nothing; subclasses start the data streams that they receive."""


# --- Motion by hand: attitude and rotation rates at the same time, in one packet ---


MOTION_PERIOD_S = 0.01
"""Period of `MOTION_BLOCK`, s."""
MOTION_BLOCK = dict.fromkeys(
    (
        "stateEstimate.roll",
        "stateEstimate.pitch",
        "stateEstimate.yaw",
        "gyro.x",
        "gyro.y",
        "gyro.z",
    ),
    "float",
) | {"supervisor.info": "uint16_t"}
"""Uses all 26 bytes of a log block."""
MOST_ATTITUDE_SAMPLES = 20_000
"""Largest number of unread samples; older ones are dropped."""


class AttitudeLink(ReadOnlyLink):
    """A `ReadOnlyLink` that collects 100 attitude samples per second. Raises the same errors as
    `CflibLink`."""

    def __init__(self, uri: str, config: LinkConfig, clock: Callable[[], float]) -> None:
        super().__init__(uri, config, clock)
        self._timebase = Timebase()
        self._samples: deque[AttitudeSample] = deque(maxlen=MOST_ATTITUDE_SAMPLES)
        self._heard = threading.Event()
        self._motors_run = False

    @property
    def motors_running(self) -> bool:
        """True if the newest packet reports that the motors are running (it still does so for 2 s
        after they stop), or that a vehicle without automatic arming is armed: its propellers spin
        the whole time it is armed."""
        return self._motors_run

    def samples(self) -> list[AttitudeSample]:
        """Return the samples that arrived since the last call, oldest first."""
        return [self._samples.popleft() for _ in range(len(self._samples))]

    def _prepare(self, connection: Connection) -> None:
        check_firmware(connection.cf, self._uri)
        log = connection.cf.log
        start_block(log, self._uri, "motion", MOTION_BLOCK, MOTION_PERIOD_S, self._on_motion)
        if not self._heard.wait(FIRST_SAMPLE_TIMEOUT_S):
            raise TimedOut(f"{self._uri} is connected but sends no telemetry")

    def _on_motion(self, stamp: int, values: Mapping[str, float], _block: Any = None) -> None:
        """Handle a packet of `MOTION_BLOCK`, in cflib's thread: degrees, and the Crazyflie's
        nose-up pitch (docs/firmware.md, "Signs and units"); its gyroscope is right-handed."""
        now_s = self._blocks.last_arrival_s = self._clock()
        t_s = self._timebase.to_loop_s(stamp, now_s)
        bits = int(values["supervisor.info"])
        self._motors_run = bool(bits & FLYING) or is_armed_by_request(bits)
        self._heard.set()
        if all(map(math.isfinite, values.values())):
            self._samples.append(
                AttitudeSample(
                    t_s=t_s,
                    roll_rad=math.radians(values["stateEstimate.roll"]),
                    pitch_rad=-math.radians(values["stateEstimate.pitch"]),
                    yaw_rad=math.radians(values["stateEstimate.yaw"]),
                    gyro_radps=np.radians([values[f"gyro.{axis}"] for axis in "xyz"]),
                )
            )


# --- Configuration of a vehicle, and quality of the radio ---


LAST_ECHO_WAIT_S = 0.5
"""Time to wait for the last echo, s."""
ECHO_PERIOD_S = 0.02
"""Time between echo packets, s."""
LED_PARAMETER = "led.bitmask"
ALL_LEDS, NO_LEDS, FIRMWARES_LEDS = 255, 128, 0
"""Values of `LED_PARAMETER`: bit 7 takes control of the LEDs from the firmware, and the lower bits
switch them on."""
BLINK_S = 0.25
"""Time for which the LEDs are on, and then off, s. Longer: the blinking is harder to distinguish
from the firmware's own pattern. Shorter: more packets are sent."""
END_BLINKING_TRIES = 3
"""Number of attempts to end blinking. A late answer to an earlier value may be mistaken for the
answer to the last one. More: the wait for a vehicle that does not answer becomes longer. Fewer: the
LEDs may keep their state until the next restart."""
# same length as cflib's own echo, since cflib unpacks every echo as its own
_ECHO = struct.Struct("<BQ")
_ECHO_MARK = 1  # cflib's own pings start with 0


class ProbeLink(ReadOnlyLink):
    """A `ReadOnlyLink` that accepts any firmware, since its purpose is to find faults. Only
    `blinking` sets a parameter.

    `quality` is the link quality, %: 100 if no packet had to be sent again, None if there is no
    radio. `missing` lists the log variables that perchctl needs but the firmware lacks.
    """

    NEEDED_PROTOCOL = NEEDED_PROTOCOL
    estimator_parameters = staticmethod(estimator_parameters)

    def __init__(
        self,
        uri: str,
        config: LinkConfig,
        clock: Callable[[], float],
        link_uri: str | None = None,
    ) -> None:
        super().__init__(uri, config, clock, link_uri=link_uri)
        self.quality: float | None = None
        self.missing: tuple[str, ...] = ()

    def _prepare(self, connection: Connection) -> None:
        self.missing = tuple(missing_variables(connection.cf))
        connection.cf.link_statistics.link_quality_updated.add_callback(self._on_quality)
        if not self.missing:
            with contextlib.suppress(NotFound, TimedOut):  # `telemetry` then stays empty
                self._blocks.start(connection.cf.log, self._uri, self._config.telemetry_period_s)

    @property
    def _cf(self) -> Any:
        assert self.connection is not None
        return self.connection.cf

    def protocol_version(self) -> int:
        """Return the protocol version; -1 for a vehicle that is too old to have one."""
        return int(self._cf.platform.get_protocol_version())

    def device_type(self) -> str | None:
        """Return the vehicle type reported by the firmware; None if it does not answer."""
        return read_device_type(self._cf)

    def parameters(self) -> dict[str, float]:
        """Return all parameters by name, as read when the link was opened."""
        return read_parameters(self._cf)

    def position_age_s(self) -> float:
        """Return the age of the newest sample's position, s; infinite without a sample."""
        newest = self._blocks.newest
        return math.inf if newest is None else self._clock() - newest.t_s + newest.behind_s

    def lost(self) -> str | None:
        """Return the reason why the link is lost; None while it works."""
        return "the link was closed" if self.connection is None else self.connection.lost

    @contextlib.contextmanager
    def blinking(self) -> Iterator[None]:
        """Blink all LEDs during the block; then the firmware controls them again.

        Raises, before the block, NotFound for firmware without `LED_PARAMETER`, InvalidValue and
        TimedOut as `set_parameters` does.
        """
        cf, ended = self._cf, threading.Event()
        set_parameters(cf, self._uri, {LED_PARAMETER: ALL_LEDS})

        def blink() -> None:
            for mask in itertools.cycle((NO_LEDS, ALL_LEDS)):
                if ended.wait(BLINK_S):
                    return
                with contextlib.suppress(Exception):  # any error from cflib: no blinking
                    cf.param.set_value(LED_PARAMETER, str(mask))

        thread = start_thread("perchctl-blink", blink)
        try:
            yield
        finally:
            ended.set()
            thread.join()
            for _ in range(END_BLINKING_TRIES):
                with contextlib.suppress(PerchError):
                    set_parameters(cf, self._uri, {LED_PARAMETER: FIRMWARES_LEDS})
                    break

    def round_trips_s(self, duration_s: float) -> list[float]:
        """Send echo packets for `duration_s`, and wait `LAST_ECHO_WAIT_S` for the last one. Return
        the round-trip time of each packet, s; infinite for a lost packet."""
        sent_s: list[float] = []
        back_s: dict[int, float] = {}
        all_back = threading.Event()
        count = max(1, round(duration_s / ECHO_PERIOD_S))

        def on_packet(packet: Any) -> None:
            data = bytes(packet.data)
            if len(data) == _ECHO.size and data[0] == _ECHO_MARK:
                back_s.setdefault(_ECHO.unpack(data)[1], time.monotonic())
                if len(back_s) == count:
                    all_back.set()

        self._cf.add_header_callback(on_packet, Port.LINK, 0)
        try:
            start_s = time.monotonic()
            for number in range(count):
                sent_s.append(time.monotonic())
                send_packets(self._cf, [Packet(Port.LINK, 0, _ECHO.pack(_ECHO_MARK, number))])
                time.sleep(max(0.0, start_s + (number + 1) * ECHO_PERIOD_S - time.monotonic()))
            all_back.wait(LAST_ECHO_WAIT_S)
        finally:
            self._cf.remove_header_callback(on_packet, Port.LINK, 0)
        return [back_s.get(number, math.inf) - at_s for number, at_s in enumerate(sent_s)]

    def _on_quality(self, percent: float) -> None:
        self.quality = float(percent)


# --- Search for vehicles: channels, rates and addresses of the radio, USB, and UDP ---


SCAN_TIMEOUT_S = 20.0
"""Timeout of a scan for vehicles, s."""


def find_uris_and_problem(uri: str = "") -> tuple[list[str], Problem | None]:
    """Scan for vehicles that currently answer at the default radio address or at the address of
    `uri`. Sends only null packets. Return their URIs, and the reason why no radio could be scanned
    (None if one was).

    A driver may block: after `SCAN_TIMEOUT_S`, the URIs found so far are returned.
    """
    addresses: list[int | None] = [None]  # the usual address
    parts = uri.partition("?")[0].split("/")
    if uri.startswith("radio://") and len(parts) > 5 and parts[5].upper() != USUAL_ADDRESS:
        addresses.append(int(parts[5], 16))
    found: list[str] = []
    why: list[Problem | None] = [Problem("the radio did not answer in time", "")]

    init_cflib()

    def run() -> None:
        from cflib import crtp

        with contextlib.suppress(Exception):  # any driver error
            why[0] = _radio_problem()
        for driver in crtp.CLASSES:
            for address in addresses:
                with contextlib.suppress(Exception):
                    found.extend(uri for uri, _ in driver().scan_interface(address))

    start_thread("perchctl-scan", run).join(SCAN_TIMEOUT_S)
    uris = (uri for uri in dict.fromkeys(found) if uri.partition("://")[0] in FORMS)
    return list(uris), why[0]


def _radio_problem() -> Problem | None:
    from cflib.drivers.crazyradio import Crazyradio

    try:
        Crazyradio().close()
    except Exception as error:
        return find_cause(str(error) or "Cannot find a Crazyradio Dongle")
    return None
