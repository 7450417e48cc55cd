"""A Crazyflie behind cflib, simulated or real: the flight's only way to the radio.

Nothing here blocks without a bound, nothing blocking is called from cflib's
callbacks, and the link is closed only when nothing flies: `close_link` sends a
zero setpoint, which drops a flying vehicle (firmware facts, "When setpoints stop").
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from perchctl import vehicle as say
from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, TimedOut
from perchctl.link.sender import Sender
from perchctl.link.telemetry import (
    ATTITUDE_BLOCK,
    BATTERY_BLOCK,
    NEEDED,
    STATE_BLOCK,
    VARIANCE_BLOCK,
    telemetry_from,
)
from perchctl.link.timebase import Timebase
from perchctl.link.uri import UDEV_HELP, check_uri
from perchctl.profile import LinkConfig
from perchctl.profile.places import user_cache_folder
from perchctl.vehicle import ARMED, FLYING, Command, Telemetry

NEEDED_PROTOCOL = 12
"""From firmware 2026.08 on: the supervisor's own port (firmware facts, "Link")."""
SILENCE_S = 1.5
SENDER_STUCK_S = 0.5
PARAMETER_TIMEOUT_S = 2.0
CONNECT_TRIES = 2
SLOW_PERIOD_MS = 100
AWAIT_SLOW_S = 1.0


class CflibLink:
    """`perchctl.link.protocol.Link` on an unmodified cflib."""

    def __init__(self, uri: str, config: LinkConfig, clock: Callable[[], float]) -> None:
        check_uri(uri)
        self._uri = uri
        self._config = config
        self._clock = clock
        self._cf: Any = None
        self._blocks: list[Any] = []
        self._sender: Sender | None = None
        self._timebase = Timebase()
        self._values: dict[str, float] = {}
        self._state_s: float | None = None
        self._samples: deque[Telemetry] = deque(maxlen=2000)
        self._first_sample = threading.Event()
        self._awaited: set[str] = set()  # slow blocks that have not spoken yet
        self._logging_s = 0.0
        self._lost: str | None = None
        self._last_arrival_s = 0.0
        self._newest: Telemetry | None = None
        self.firmware_note = ""

    # --- connecting --------------------------------------------------------

    def connect(self) -> None:
        self._open()
        try:
            self._check_firmware()
            self._set_parameters()
            self._start_logging()
            self._arm_if_needed()
            self._unlock_thrust()
        except BaseException:
            # As long as nothing is known of the vehicle, it may be flying for another.
            if self._newest is None or self._still_flying():
                self._abandon()
            else:
                self._close_link()
            raise
        self._sender = Sender(self._hand_over)

    def _open(self) -> None:
        import cflib.crtp

        _hush_cflib()
        if not cflib.crtp.CLASSES:  # init_drivers() extends this list at each call
            cflib.crtp.init_drivers()
        share_s = self._config.connect_timeout_s / CONNECT_TRIES
        cause = ""
        for _ in range(CONNECT_TRIES):
            cause = self._try_open(share_s)
            if not cause:
                self._lost = None
                return
            self._abandon()
            if "answer" not in cause:
                break
        raise ConnectionFailed(f"no Crazyflie at {self._uri}: {cause}")

    def _try_open(self, timeout_s: float) -> str:
        """Empty when fully connected, otherwise the cause in words."""
        from cflib.crazyflie import Crazyflie

        cache = user_cache_folder() / "toc"
        cache.mkdir(parents=True, exist_ok=True)
        cf = Crazyflie(rw_cache=str(cache))
        connected, failed = threading.Event(), threading.Event()
        causes: list[str] = []

        def fail(_uri: str, message: str) -> None:
            causes.append(message)
            failed.set()
            connected.set()

        cf.fully_connected.add_callback(lambda _uri: connected.set())
        cf.connection_failed.add_callback(fail)
        cf.connection_lost.add_callback(fail)
        cf.connection_lost.add_callback(self._on_lost)
        self._cf = cf
        # Opening a radio may block in its driver: it gets a thread and a bound.
        opener = threading.Thread(target=cf.open_link, args=(self._uri,), daemon=True)
        opener.start()
        if not connected.wait(timeout_s):
            return f"no answer within {timeout_s:.0f} s (is it switched on, is the address right?)"
        return _plain_cause(causes[0]) if failed.is_set() else ""

    def _on_lost(self, _uri: str, message: str) -> None:
        self._lost = _plain_cause(message)

    def _check_firmware(self) -> None:
        version = self._cf.platform.get_protocol_version()
        if version < NEEDED_PROTOCOL:
            raise ConnectionFailed(
                f"the firmware at {self._uri} speaks protocol {version}, perchctl needs "
                f"{NEEDED_PROTOCOL} or later (release 2026.08): update the firmware"
            )
        for name in NEEDED:
            if self._cf.log.toc.get_element_by_complete_name(name) is None:
                raise NotFound(
                    f"the firmware at {self._uri} has no log variable {name}, which perchctl "
                    f"needs: update the firmware to release 2026.08 or later"
                )

    def _set_parameters(self) -> None:
        for name, wanted in self._config.parameters.items():
            element = self._cf.param.toc.get_element_by_complete_name(name)
            if element is None:
                raise NotFound(
                    f"the firmware at {self._uri} has no parameter {name}: correct "
                    f"link.parameters in the profile"
                )
            self._set_parameter(name, wanted)

    def _set_parameter(self, name: str, wanted: float) -> None:
        """Set, then ask the vehicle again and compare."""
        group, _, short = name.partition(".")
        answered = threading.Event()
        answers: list[str] = []

        def on_value(_name: str, value: str) -> None:
            answers.append(value)
            answered.set()

        try:
            self._cf.param.set_value(name, str(wanted))
            self._cf.param.add_update_callback(group=group, name=short, cb=on_value)
            self._cf.param.request_param_update(name)
            if not answered.wait(PARAMETER_TIMEOUT_S):
                raise TimedOut(f"parameter {name} was set to {wanted}, but no answer came")
        except (AttributeError, ValueError, KeyError) as error:
            raise InvalidValue(f"parameter {name} cannot be set to {wanted}: {error}") from None
        finally:
            self._cf.param.remove_update_callback(group, short, on_value)
        if not math.isclose(float(answers[-1]), float(wanted), rel_tol=1e-5, abs_tol=1e-9):
            raise InvalidValue(
                f"parameter {name} was set to {wanted}, but the vehicle keeps {answers[-1]}"
            )

    def _start_logging(self) -> None:
        self._logging_s = self._clock()
        fast_ms = max(10, 10 * round(self._config.telemetry_period_s * 100))
        self._add_block("state", STATE_BLOCK, fast_ms, self._on_state)
        self._add_block("attitude", ATTITUDE_BLOCK, fast_ms, self._on_attitude)
        toc = self._cf.log.toc
        for name, variables in (("battery", BATTERY_BLOCK), ("variance", VARIANCE_BLOCK)):
            if all(toc.get_element_by_complete_name(n) is not None for n in variables):
                self._awaited.add(f"perch_{name}")
                self._add_block(name, variables, SLOW_PERIOD_MS, self._on_values)
        if not self._first_sample.wait(3.0):
            missing = [n for n in NEEDED if n not in self._values]
            raise TimedOut(
                f"{self._uri} is connected but sends no telemetry "
                f"(missing: {', '.join(missing) or 'none'})"
            )

    def _add_block(
        self,
        name: str,
        variables: dict[str, str],
        period_ms: int,
        on_data: Callable[[int, dict[str, float], Any], None],
    ) -> None:
        from cflib.crazyflie.log import LogConfig

        block = LogConfig(name=f"perch_{name}", period_in_ms=period_ms)
        for variable, ctype in variables.items():
            block.add_variable(variable, ctype)
        try:
            self._cf.log.add_config(block)
        except (KeyError, AttributeError) as error:
            raise NotFound(f"log block {name} is refused by {self._uri}: {error}") from None
        block.data_received_cb.add_callback(on_data)
        block.start()
        self._blocks.append(block)

    def _arm_if_needed(self) -> None:
        """A Crazyflie 2.1 arms itself; other airframes want to be asked."""
        newest = self._newest
        if newest is None or newest.has(ARMED):
            return
        self._cf.supervisor.send_arming_request(True)

    def _unlock_thrust(self) -> None:
        """One zero-thrust packet since boot, on the ground, then give the priority back:
        without the first a raw thrust stays 0, without the second a take-off is not
        flown (firmware facts, "Raw thrust")."""
        if self._newest is not None and self._newest.has(FLYING):
            raise ConnectionFailed(
                f"the vehicle at {self._uri} is flying already: land it before perchctl takes over"
            )
        self._cf.commander.send_setpoint(0.0, 0.0, 0.0, 0)
        self._cf.commander.send_notify_setpoint_stop()

    # --- cflib's callbacks: take the values and go ----------------------------

    def _on_values(self, _stamp: int, data: dict[str, float], block: Any) -> None:
        self._last_arrival_s = self._clock()
        self._values.update(data)
        self._awaited.discard(block.name)

    def _on_state(self, stamp: int, data: dict[str, float], _block: Any) -> None:
        now_s = self._clock()
        self._last_arrival_s = now_s
        self._values.update(data)
        self._state_s = self._timebase.to_loop_s(stamp, now_s)

    def _on_attitude(self, stamp: int, data: dict[str, float], _block: Any) -> None:
        now_s = self._clock()
        self._last_arrival_s = now_s
        self._values.update(data)
        t_s = self._timebase.to_loop_s(stamp, now_s)
        if self._state_s is None or any(name not in self._values for name in NEEDED):
            return
        if self._awaited and now_s < self._logging_s + AWAIT_SLOW_S:
            return  # the first sample shall speak of the battery too
        sample = telemetry_from(_carried(self._values, t_s - self._state_s), t_s)
        self._newest = sample
        self._samples.append(sample)
        self._first_sample.set()

    # --- flying ------------------------------------------------------------------

    def telemetry(self) -> list[Telemetry]:
        arrived = []
        while self._samples:
            arrived.append(self._samples.popleft())
        return arrived

    def send(self, command: Command) -> None:
        if self._sender is not None and not isinstance(command, say.Idle):
            self._sender.put(command)

    def _hand_over(self, command: Command) -> None:
        """In the sender's thread. Degrees leave here, radians stay behind."""
        low, high = self._cf.commander, self._cf.high_level_commander
        match command:
            case say.PositionSetpoint(x, y, z, yaw):
                low.send_position_setpoint(x, y, z, math.degrees(yaw))
            case say.RawThrust(thrust):
                low.send_setpoint(0.0, 0.0, 0.0, thrust)
            case say.TakeOff(height, duration):
                high.takeoff(height, duration)
            case say.Land(height, duration):
                low.send_notify_setpoint_stop()
                high.land(height, duration)
            case say.StopMotors():
                low.send_stop_setpoint()
                low.send_notify_setpoint_stop()
            case say.EmergencyStop():
                self._cf.supervisor.send_emergency_stop()

    def problem(self, now_s: float) -> str | None:
        if self._lost is not None:
            return self._lost
        sender = self._sender
        if sender is not None and sender.problem is not None:
            return sender.problem
        if sender is not None and sender.stuck_s() > SENDER_STUCK_S:
            return f"cflib has held a command for {sender.stuck_s():.1f} s"
        if now_s - self._last_arrival_s > SILENCE_S:
            return f"nothing heard for {now_s - self._last_arrival_s:.1f} s"
        return None

    # --- leaving -----------------------------------------------------------------

    def close(self) -> None:
        """Close when nothing flies; otherwise leave the link without its farewell packet.

        A vehicle whose supervisor still says flying after the wait is better off
        with its own landing or level-out than with a zero setpoint.
        """
        if self._sender is not None:
            self._sender.drain(1.0)
        end_s = self._clock() + 6.0
        while self._still_flying() and self._clock() < end_s:
            time.sleep(0.05)
        safe = not self._still_flying()
        if self._sender is not None:
            self._sender.stop()
        if safe:
            self._close_link()
        else:
            self._abandon()

    def _still_flying(self) -> bool:
        if self._cf is None or self._newest is None:
            return False
        return self._newest.has(FLYING)

    def _close_link(self) -> None:
        cf, self._cf = self._cf, None
        if cf is None:
            return
        closer = threading.Thread(target=cf.close_link, daemon=True)
        closer.start()
        closer.join(timeout=3.0)

    def _abandon(self) -> None:
        """Release the driver and clean up, sending nothing more."""
        cf, self._cf = self._cf, None
        if cf is None:
            return
        driver, cf.link = cf.link, None  # without it close_link has no setpoint to send
        closers = [cf.close_link] if driver is None else [driver.close, cf.close_link]

        def close() -> None:
            for each in closers:
                each()

        closer = threading.Thread(target=close, daemon=True)
        closer.start()
        closer.join(timeout=3.0)


def _carried(values: dict[str, float], ahead_s: float) -> dict[str, float]:
    """The position block carried on to the attitude block's time by its velocity."""
    carried = dict(values)
    step_s = max(-0.05, min(0.05, ahead_s))
    for axis in "xyz":
        carried[f"stateEstimate.{axis}"] += values[f"stateEstimate.v{axis}"] * step_s
    return carried


def _hush_cflib() -> None:
    """cflib logs tracebacks of what it reports by callback as well; one sentence is enough."""
    logger = logging.getLogger("cflib")
    logger.addHandler(logging.NullHandler())
    logger.propagate = bool(os.environ.get("PERCHCTL_DEBUG"))


def _plain_cause(message: str) -> str:
    """cflib's message without its traceback, and with the remedy where there is one."""
    line = message.strip().splitlines()[0] if message.strip() else "unknown cause"
    line = line.removeprefix("Couldn't load link driver: ")
    if "Crazyradio" in message or "Access denied" in message or "insufficient" in message.lower():
        missing = "Cannot find" in message
        what = "no Crazyradio is plugged in, or " if missing else ""
        return f"{what}there is no permission to use it ({line}).\n{UDEV_HELP}"
    if "Connection refused" in message:
        return "nothing listens there (connection refused)"
    if "No driver found" in message:
        return "cflib has no driver for this kind of URI"
    return line
