"""The process of one vehicle in a fleet: one ordinary flight, and a connection to the parent.

The flight is the same as in `perchctl fly`, with its own link, watchdog, camera and log. Two things
are added: it waits on the floor for permission to take off, and its operator is the parent. A
separate thread serves the connection, so that nothing in the flight ever waits for the parent.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import statistics
import sys
import threading
import time
from dataclasses import replace

from perchctl.calibration import profile_camera
from perchctl.children import Channel
from perchctl.corridor import Point
from perchctl.errors import Interrupted, PerchError, SafetyAbort
from perchctl.extensions import error_at
from perchctl.fleet.messages import BEAT_S, Order, Pace, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.parent_watch import ParentSwitch
from perchctl.flight import FlyOptions, fly_session, operator_signals
from perchctl.mission import Event, OperatorRequest, Tick, Watcher
from perchctl.record import FlightSummary, LogWatcher
from perchctl.vehicle import NO_BATTERY_READING_V, PositionSetpoint, RawThrust

OPTIONS_TIMEOUT_S = 60.0
"""Time to wait for the options of the flight, s. The parent sends them at once, and nothing is
connected before they arrive."""
LAST_WORD_TIMEOUT_S = 2.0
"""Time for the parent to receive the result, s. Longer: a process lingers if its parent hangs.
Shorter: a busy parent may miss the result and report the process as failed."""
POLL_S = 0.05
"""Time between two checks for something to send, s."""


def main(channel: Channel) -> None:
    """Fly as the first message, `FlyOptions`, requests; send one `Result`, and end the process."""
    switch = ParentSwitch()
    with operator_signals(switch, _say):
        try:
            options: FlyOptions = channel.receive(OPTIONS_TIMEOUT_S)
            line = ParentLine(channel, switch)
        # the parent is gone, or no longer wants a flight
        except (EOFError, OSError, Interrupted):
            return
        reporter = StatusReporter(line, switch)
        try:
            result = fly_vehicle(options, switch, line, reporter)
        except BaseException as error:  # a signal came while another failure was being handled
            result = reporter.failure or reporter.result_of_error(error)
        line.finish(result)
    sys.stdout.flush()
    os._exit(0)  # a library's hanging thread must not keep the process alive


def fly_vehicle(
    options: FlyOptions, switch: ParentSwitch, line: ParentLine, reporter: StatusReporter
) -> Result:
    """Fly once, and convert the outcome or any error to a `Result`. An error that occurs while
    another one is being handled is raised; `reporter` then knows how far the flight got."""
    log: LogWatcher | None = None
    try:
        line.may_interrupt = True
        seed = options.seed if options.simulated else None
        log = LogWatcher.open_real_time(
            options.log_dir, options.profile, options.uri, options.source, seed, options.record
        )
        reporter.log = str(log.path)
        if options.serve_pictures:
            reporter.serve_pictures(options)
        report, miss_m = fly_session(
            options,
            (log, reporter, *reporter.watchers),
            switch,
            remarks=log.remarks,
            may_take_off=reporter.may_take_off,
            climb_withheld=switch.climb_withheld,
        )
        outcome = VehicleOutcome.from_phase(report.phase)
        summary = log.close(report, miss_m if outcome is VehicleOutcome.PERCHED else None)
        assert summary is not None, "the log was closed with a report"
        for sentence in report.detached_watcher_messages:
            _say(sentence)
        return reporter.result_of(outcome, summary, str(log.path))
    except BaseException as error:
        line.may_interrupt = False
        result = reporter.failure = reporter.result_of_error(error)
        if log is not None:
            log.abandon(str(error) or type(error).__name__)
        return result


class ParentLine:
    """The connection to the parent, served by a separate thread; only `finish` waits.

    If the parent is gone or sends an invalid message, the vehicle lands. After an invalid message
    the connection stays open, because the operator may still cut the motors. Until the flight loop
    reads commands, a command interrupts the start of the process, as a signal would.

    Attributes:
        may_interrupt: True while an `Interrupted` may be raised in the main thread.
    """

    def __init__(self, channel: Channel, switch: ParentSwitch) -> None:
        self.may_interrupt = False
        self._channel, self._switch = channel, switch
        self._status = Status()
        self._turned_s: float | None = None
        self._result: Result | None = None
        self._soon = self._has_interrupted = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="perchctl-parent", daemon=True)
        self._thread.start()

    def note_turn(self) -> None:
        """Record that the flight loop has run one iteration (turn)."""
        self._turned_s = time.monotonic()

    def tell(self, status: Status) -> None:
        """Store the newest status. A status with a new stage or phase is sent without waiting for
        the next regular message."""
        before, self._status = self._status, status
        self._soon = self._soon or (before.stage, before.phase) != (status.stage, status.phase)

    def finish(self, result: Result) -> None:
        """Send the result as the last message; wait at most `LAST_WORD_TIMEOUT_S` for it."""
        self._result = result
        self._ended.wait(LAST_WORD_TIMEOUT_S)

    def _run(self) -> None:
        told_s = -math.inf
        try:
            while True:
                if self._channel.poll(POLL_S):
                    self._take_orders()
                self._interrupt_start()
                result = self._result
                if result is not None:
                    self._channel.send(result)
                    return
                now_s = time.monotonic()
                if self._soon or now_s - told_s >= BEAT_S:
                    self._soon, told_s = False, now_s
                    turned_s = self._turned_s
                    age_s = None if turned_s is None else now_s - turned_s
                    self._channel.send(replace(self._status, loop_age_s=age_s))
        except (EOFError, OSError):
            self._switch.lose_parent()
            self._ended.set()
            self._interrupt_start_alone()
        except Exception as error:
            self._switch.lose_parent(
                f"the connection to the parent process failed ({error_at(error)})"
            )
            self._ended.set()
            self._interrupt_start_alone()
        finally:
            self._ended.set()

    def _take_orders(self) -> None:
        """Process all waiting orders. If this process was stopped for a while, many orders may be
        waiting; a permission counts only if the newest order still gives it."""
        order = self._next_order()
        while self._channel.poll(0.0):
            if order is not None:
                self._switch.take(replace(order, may_take_off=False, may_climb=False))
            order = self._next_order()
        if order is not None:
            self._switch.take(order)

    def _next_order(self) -> Order | None:
        """Return the next message if it is an order; otherwise land, and return None. Raises
        EOFError or OSError if the parent is gone."""
        try:
            message = self._channel.recv()
        except (EOFError, OSError):
            raise
        except Exception as error:  # any error that unpickling raises
            self._switch.lose_parent(
                f"a message from the parent process is unreadable ({error_at(error)})"
            )
            return None
        if isinstance(message, Order) and isinstance(message.word, OperatorRequest):
            return message
        self._switch.lose_parent(f"the parent sent a {type(message).__name__} instead of an order")
        return None

    def _interrupt_start_alone(self) -> None:
        """Once the parent is gone, wait until the start can be interrupted or the loop reads
        commands."""
        while self._result is None and not (self._has_interrupted or self._switch.listening):
            self._interrupt_start()
            time.sleep(POLL_S)

    def _interrupt_start(self) -> None:
        """Interrupt the start, because nothing reads the command while vehicle and camera are being
        connected. Do so only once: a second signal would interrupt the clean-up after the first
        one."""
        starts = self.may_interrupt and not self._switch.listening
        if starts and self._switch.landing_requested and not self._has_interrupted:
            self._has_interrupted = True
            os.kill(os.getpid(), signal.SIGTERM)  # `operator_signals` turns it into an Interrupted


class StatusReporter(Watcher):
    """A watcher that reports the flight's state to the parent, and stores what is needed for the
    result.

    Attributes:
        log: the flight's log file, once it is open.
        watchers: further watchers of the flight, which serve its images.
        failure: the result, if the flight has raised an exception.
    """

    name = "the status report to the fleet"
    problem: str | None = None

    def __init__(self, line: ParentLine, switch: ParentSwitch) -> None:
        self.log: str | None = None
        self.watchers: tuple[Watcher, ...] = ()
        self.failure: Result | None = None
        self._picture_port: int | None = None
        self._line, self._switch = line, switch
        self._first: tuple[float, float, float] | None = None  # loop, wall and CPU time, s
        self._last: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._setpoint_s: float | None = None
        self._gaps_s: list[float] = []
        self._rest: str | None = None  # where a rescued vehicle came to rest
        self._tick: Tick | None = None

    def serve_pictures(self, options: FlyOptions) -> None:
        """Serve the flight's images for the fleet's page, without buttons. An error is printed, but
        does not prevent the flight."""
        try:
            # a flight without a page does not need this module
            from perchctl.display import FlightPage, LivePage

            page = LivePage(profile_camera(options.profile.camera), f"perchctl fly {options.uri}")
            self.watchers = (FlightPage.of(page, options.profile),)
            self._picture_port = page.port
        except Exception as error:
            _say(f"the images for the fleet's page cannot be served: {error_at(error)}")

    def may_take_off(self, waiting: str) -> bool:
        """`FlightParts.may_take_off`: the parent's permission."""
        self._line.note_turn()
        stage = Stage.CHECKING if waiting else Stage.READY
        reason = f"waiting for {waiting}" if waiting else ""
        self._line.tell(Status(stage=stage, reason=reason, picture_port=self._picture_port))
        return self._switch.may_take_off

    def tick(self, tick: Tick) -> None:
        now_s = time.monotonic()
        self._line.note_turn()
        self._tick, self._last = tick, (tick.t_s, now_s, time.process_time())
        self._first = self._first or self._last
        if isinstance(tick.command, PositionSetpoint | RawThrust):
            if self._setpoint_s is not None:
                self._gaps_s.append(now_s - self._setpoint_s)
            self._setpoint_s = now_s
        else:
            self._setpoint_s = None
        try:
            status = flight_status(tick)
        except Exception as error:  # detaching this watcher would make the loop seem to hang
            status = Status(
                stage=Stage.FLYING,
                phase=tick.state.phase,
                reason=f"its status is unknown: {error_at(error)}",
            )
        self._line.tell(replace(status, log=self.log, picture_port=self._picture_port))

    def event(self, event: Event) -> None:
        if event.rest_state is not None:
            self._rest = event.reason

    def result_of(self, outcome: VehicleOutcome, summary: FlightSummary, log: str) -> Result:
        """The result of a flight that ended without an exception."""
        return replace(
            self._result(summary.exit_code, outcome, summary.reason),
            attempts=summary.attempts,
            miss_m=summary.miss_m,
            battery_min_v=summary.battery_min_v,
            log=log,
        )

    def result_of_error(self, error: BaseException) -> Result:
        """Return the result of a flight that raised an exception: it was refused on the ground, or
        rescued in the air."""
        match error:
            case PerchError():
                code, reason = error.exit_code, str(error)
            case KeyboardInterrupt():
                code, reason = Interrupted.exit_code, "interrupted"
            case _:
                code = PerchError.exit_code
                reason = f"unforeseen {type(error).__name__}: {error}"
        if self._rest is not None:
            reason = f"{reason}; {self._rest}"
        result = self._result(code, VehicleOutcome.FAILED, reason)
        # Without a tick, the log is deleted.
        return replace(result, log=None if self._tick is None else self.log)

    def _result(self, code: int, outcome: VehicleOutcome, reason: str) -> Result:
        tick, lost = self._tick, self._switch.lost
        if lost is not None:
            reason = f"{lost}: {reason}"
        # The first setpoint is sent before its tick is observed; an error in between leads to a
        # rescue.
        has_flown = tick is not None or self._rest is not None
        if has_flown and lost is not None and code == Interrupted.exit_code:
            code = SafetyAbort.exit_code  # the operator did not land the vehicle
        return Result(
            exit_code=code,
            outcome=outcome,
            reason=reason,
            has_flown=has_flown,
            ended_s=None if tick is None else self._last[1],
            place_m=None if tick is None else _valid_place_m(tick),
            pace=self._pace(),
        )

    def _pace(self) -> Pace | None:
        if self._first is None or len(self._gaps_s) < 2:
            return None
        flown_s, wall_s, cpu_s = (
            end - begin for begin, end in zip(self._first, self._last, strict=True)
        )
        percentiles = statistics.quantiles(self._gaps_s, n=100, method="inclusive")
        return Pace(
            flown_s=flown_s,
            wall_s=wall_s,
            gap_p50_s=percentiles[49],
            gap_p99_s=percentiles[98],
            gap_max_s=max(self._gaps_s),
            cores=cpu_s / wall_s,
        )


def flight_status(tick: Tick) -> Status:
    """Return the status of a vehicle that is flying, is hanging or has landed."""
    state, telemetry, known_m = tick.state, tick.telemetry, tick.gear_to_target_lateral_and_up_m
    x_m, y_m, z_m = telemetry.position_m
    return Status(
        stage=Stage.ENDING if state.phase.is_final else Stage.FLYING,
        phase=state.phase,
        reason=state.pause_reason or state.transition_reason,
        height_m=z_m - state.belief.ground_z_m,
        error_m=None if known_m is None else known_m[0],
        battery_v=telemetry.battery_v if telemetry.battery_v >= NO_BATTERY_READING_V else None,
        telemetry_age_s=tick.telemetry_age_s,
        place_m=(x_m, y_m) if state.belief.is_position_trusted else None,
    )


def _valid_place_m(tick: Tick) -> Point | None:
    """Return the vehicle's position in the axes of its estimate; None if it is unknown."""
    place_m = tick.telemetry.position_m[:2]
    is_known = tick.state.belief.is_position_valid and all(map(math.isfinite, place_m))
    return place_m if is_known else None


def _say(sentence: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(f"perchctl: {sentence}", flush=True)
