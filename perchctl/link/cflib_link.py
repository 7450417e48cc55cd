"""Connect to a real or simulated Crazyflie with cflib. A flight accesses the radio only through
this link.

Every call that may block has a timeout, and cflib's callbacks make no blocking calls. The link is
closed only when the vehicle is not flying: `close_link` sends a zero setpoint, which drops a flying
vehicle (docs/firmware.md, "When setpoints stop"). If the radio falls silent, perchctl waits; if a
driver has ended, perchctl reopens it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from perchctl.errors import ConnectionFailed
from perchctl.link.arming import disarm, warn_of_armed
from perchctl.link.connection import Connection, open_connection, send_packets
from perchctl.link.crtp import (
    UNLOCK_PERIOD_S,
    UNLOCK_THRUST,
    UNLOCK_TIMES,
    Packet,
    encode,
)
from perchctl.link.external_position import StandingFeed, estimator_parameters, settle_estimator
from perchctl.link.firmware import (
    check_airframe,
    check_firmware,
    detected_decks,
    read_parameters,
    set_parameters,
)
from perchctl.link.protocol import (
    LANDING_WAIT_S,
    Guard,
    SentCallback,
    check_uri,
    ignore_sent,
)
from perchctl.link.sender import LIBRARY_HANG_S, Sender
from perchctl.link.telemetry import LogBlocks
from perchctl.mission import SentCommand
from perchctl.positioning import PositionFeed
from perchctl.profile import LinkConfig, PositioningConfig
from perchctl.vehicle import (
    DISARM_IT,
    FLYING,
    Arm,
    Command,
    ExternalPosition,
    Idle,
    RawThrust,
    Telemetry,
    is_armed_by_request,
    is_fresh,
    may_be_flying,
)

SILENCE_S = 1.5
"""Time without telemetry after which the link reports a problem, s."""
DRAIN_S = 1.0
"""Longest wait for queued commands when the link is closed, s."""
UNHEARD_S = 0.5
"""A packet counts as lost with the link if it was sent after the vehicle was last heard from, or
within this time before that, s."""
FAREWELL = RawThrust(0)
"""The command that cflib's `close_link` sends."""


class CflibLink:
    """`perchctl.link.protocol.Link`, implemented with an unmodified cflib.

    `connection` is None while not connected. `landing_wait_s` is the time for which `close` waits
    for a vehicle that is still flying. Unless `positioning` uses decks, the estimator is configured
    for external positions.

    `uri` names the vehicle in every message. `link_uri` is what cflib opens instead, such as the
    vehicle behind a radio hub; it contains a key and is never shown.
    """

    def __init__(
        self,
        uri: str,
        config: LinkConfig,
        clock: Callable[[], float],
        landing_wait_s: float = LANDING_WAIT_S,
        positioning: PositioningConfig | None = None,
        link_uri: str | None = None,
    ) -> None:
        check_uri(uri)
        check_uri(link_uri or uri)
        self._positioning = positioning or PositioningConfig()
        self._uri, self._link_uri = uri, link_uri or uri
        self._config = config
        self._clock = clock
        self._landing_wait_s = landing_wait_s
        self._blocks = LogBlocks(clock)
        self._sender: Sender | None = None
        self._guard: Guard | None = None
        self._on_sent: SentCallback = ignore_sent
        self._lost_since_s: float | None = None  # time of the last arrival, while the link is lost
        self._was_armed = False  # True once this session has sent an arming command
        self.connection: Connection | None = None

    def connect(self) -> None:
        timeout_s = self._config.connect_timeout_s
        self.connection = open_connection(self._link_uri, timeout_s, shown_uri=self._uri)
        try:
            self._prepare(self.connection)
        except BaseException:
            # Without any telemetry, the vehicle may be flying for another program.
            self._leave(farewell=self._may_say_farewell() and not self._is_armed)
            raise

    def decks(self) -> tuple[str, ...]:
        return (
            () if self.connection is None else detected_decks(read_parameters(self.connection.cf))
        )

    def telemetry(self) -> list[Telemetry]:
        return self._blocks.take_samples()

    def send(self, command: Command) -> None:
        if self._sender is not None and not isinstance(command, Idle):
            self._was_armed = self._was_armed or command == Arm(True)
            self._sender.put(command)

    def send_external(self, place: ExternalPosition) -> bool:
        try:
            return self.connection is not None and self.connection.send(*encode(place))
        except Exception:  # any error from cflib; failures to send are reported separately
            return False

    def settle_estimator(self, feed: PositionFeed | None, ground_z_m: float = 0.0) -> None:
        """Start the estimator at the vehicle's position according to `feed` or, without a feed, at
        the world's origin with the height `ground_z_m`. Must be called on the ground, after
        `connect`; has a timeout. Raises ConnectionFailed, NotFound, InvalidValue and TimedOut."""
        if self.connection is None:
            raise ConnectionFailed(f"{self._uri} is not connected")
        cf, config, clock = self.connection.cf, self._positioning, self._clock
        standing = StandingFeed(self.send_external, ground_z_m, config.rate_hz, clock)
        wait = standing.wait if feed is None else time.sleep
        settle_estimator(
            cf, self._uri, config, feed or standing, lambda: self._blocks.newest, clock, wait
        )

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        self._guard, self._on_sent = guard, on_sent

    def problem(self, now_s: float) -> str | None:
        if self.connection is not None and self.connection.lost is not None:
            return self.connection.lost
        if self._sender is not None and (trouble := self._sender.trouble()) is not None:
            return trouble
        silent_s = now_s - self._blocks.last_arrival_s
        if silent_s > SILENCE_S:
            return f"no packet received for {silent_s:.1f} s"
        return None

    def new_notes(self) -> list[str]:
        """Return messages about harmless failures since the last call."""
        return [] if self._sender is None else self._sender.new_notes()

    def close(self) -> None:
        """Close the link, without cflib's farewell packet if the vehicle may still be flying.

        On the ground, a vehicle that does not arm itself is disarmed. If the vehicle still reports
        flying after the wait, or if its state is unknown, the firmware's own landing or levelling
        is safer than a zero setpoint.
        """
        if self._sender is not None:
            self._sender.drain(DRAIN_S)
        end_s = self._clock() + self._landing_wait_s
        while self._may_hear_more() and not self._may_say_farewell() and self._clock() < end_s:
            time.sleep(0.05)
        sender, disarmed = self._sender, True
        if sender is not None:
            disarmed = disarm(
                lambda: self._blocks.newest,
                lambda order: sender.put(order, "farewell"),
                self._clock,
                time.sleep,
                was_ordered=self._was_armed,
            )
        farewell = self._may_say_farewell()
        if sender is not None:
            sender.stop()
        self._leave(farewell=farewell)
        if not disarmed:
            warn_of_armed(f"the vehicle at {self._uri}")

    def _prepare(self, connection: Connection) -> None:
        check_firmware(connection.cf, self._uri)
        check_airframe(connection.cf, self._uri)
        set_parameters(connection.cf, self._uri, self._config.parameters)
        self._blocks.start(connection.cf.log, self._uri, self._config.telemetry_period_s)
        self._unlock_thrust(connection)  # the vehicle is known to be on the ground
        set_parameters(connection.cf, self._uri, estimator_parameters(self._positioning))
        self._sender = Sender(
            self._hand_over,
            self._ask_guard,
            self._clock,
            lambda sent: self._on_sent(sent),
            pieces=encode,
            tend=self._tend,
            spare=lambda: self._blocks.resume(self._hand_over),
        )

    def _unlock_thrust(self, connection: Connection) -> None:
        """Unlock raw thrust. This method is called only on the ground, because the zero-thrust
        packet cuts the motors."""
        newest, now_s = self._blocks.newest, self._clock()
        if not is_fresh(newest, now_s):
            raise ConnectionFailed(
                f"telemetry from {self._uri} has stopped: perchctl does not take over the vehicle"
            )
        if newest is not None and newest.has_bit(FLYING):
            raise ConnectionFailed(
                f"the vehicle at {self._uri} is already flying: land it before perchctl takes over"
            )
        if self._is_armed:
            raise ConnectionFailed(f"the vehicle at {self._uri} is already armed: {DISARM_IT}")
        for _ in range(UNLOCK_TIMES):
            send_packets(connection.cf, UNLOCK_THRUST)
            time.sleep(UNLOCK_PERIOD_S)

    def _ask_guard(self) -> Command | None:
        """Call the guard; runs in the sender's thread that never calls cflib."""
        if self._guard is None:
            return None
        return self._guard(self._clock(), self._blocks.newest, self._blocks.waiting_samples)

    def _hand_over(self, packet: Packet) -> bool:
        """Pass a packet to cflib; runs in the sender's other thread."""
        return self.connection is not None and self.connection.send(packet)

    def _tend(self, stuck_s: float, hangs: bool) -> None:
        """Maintain the link; runs in the sender's thread that never calls cflib."""
        connection, sender = self.connection, self._sender
        if connection is None or sender is None:
            return
        if connection.lost is not None:
            if self._lost_since_s is None:
                self._lost_since_s = self._blocks.last_arrival_s
            connection.reopen()
            return
        if self._lost_since_s is not None:
            sender.repeat_order(self._lost_since_s - UNHEARD_S)
            self._lost_since_s = None
        if hangs:
            connection.reopen(
                f"cflib has been sending one packet for more than {LIBRARY_HANG_S:g} s"
            )
        elif stuck_s > LIBRARY_HANG_S and connection.is_dead():
            connection.reopen(
                f"the radio has neither accepted nor lost a packet for {stuck_s:.1f} s"
            )

    def _may_hear_more(self) -> bool:
        """True unless the link is lost permanently. While a sender exists, a lost link is being
        reopened."""
        connection = self.connection
        return connection is not None and (connection.lost is None or self._sender is not None)

    @property
    def _is_armed(self) -> bool:
        """True if the vehicle is armed and does not arm itself."""
        newest = self._blocks.newest
        return newest is not None and is_armed_by_request(newest.supervisor)

    def _may_say_farewell(self) -> bool:
        """True if fresh telemetry shows that a zero setpoint would neither drop nor lock the
        vehicle."""
        return not may_be_flying(self._blocks.newest, self._clock())

    def _leave(self, *, farewell: bool) -> None:
        """Release the link. If `farewell` is True, cflib sends its zero setpoint, which drops a
        flying vehicle."""
        connection, self.connection = self.connection, None
        if connection is None:
            return
        at_s, linked = self._clock(), connection.lost is None
        connection.close(farewell=farewell)
        if farewell and linked:
            with contextlib.suppress(Exception):  # an observer's error must not end the link
                self._on_sent(SentCommand(at_s, "farewell", FAREWELL))
