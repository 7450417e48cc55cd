"""The child process: runs the vehicle that the parent describes, or one started by hand.

``python -m perchctl.sim.process --port 19850`` runs one in the foreground.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2

from perchctl.calibration import load_calibration
from perchctl.children import Channel, connect_back
from perchctl.errors import PerchError
from perchctl.places import data_file
from perchctl.sim.capture.natnet import COMMAND_PORT
from perchctl.sim.capture.settings import CaptureFault, CaptureSettings
from perchctl.sim.process.host import VehicleHost
from perchctl.sim.process.shared import (
    CLOCK_MARGIN_S,
    LOOP_PATIENCE_S,
    START_TIMEOUT_S,
    HostSetup,
    SharedTime,
)
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario


def serve_parent() -> None:
    """Run the vehicle that the parent describes, until it sends stop or is gone."""
    cv2.setNumThreads(1)  # the picture must not take the physics' core
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = connect_back()
    setup = channel.receive(START_TIMEOUT_S)
    realtime = setup.pace == "realtime"
    try:
        shared = SharedTime(setup.time_file)
        host = VehicleHost(setup, live=realtime)
    except (PerchError, OSError, ValueError) as error:
        channel.send(f"{type(error).__name__}: {error}")
        return
    with contextlib.closing(host):
        stream_url = host.stream.url if host.stream is not None else ""
        channel.send((host.uri, stream_url, host.capture))
        Runner(host, channel, realtime=realtime, linger_s=setup.linger_s, shared=shared).run()


def main(arguments: Sequence[str] | None = None) -> int:
    """A simulated vehicle in the foreground, in real time, until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="python -m perchctl.sim.process",
        description="A simulated Crazyflie on udp://, its camera on http://, until Ctrl-C.",
    )
    parser.add_argument("--port", type=int, default=19850, help="UDP port of the vehicle")
    parser.add_argument("--http-port", type=int, default=8080, help="port of the camera's stream")
    parser.add_argument(
        "--capture",
        action="store_true",
        help=f"no deck; motion capture on 127.0.0.1:{COMMAND_PORT}, as OptiTrack's",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of noise and drops")
    options = parser.parse_args(arguments)

    calibration = data_file("calib", "example_640x480")
    setup = HostSetup(
        scenario=Scenario(
            seed=options.seed, extra={"external_position": 1.0} if options.capture else {}
        ),
        capture=CaptureSettings(seed=options.seed) if options.capture else None,
        camera=load_calibration(calibration) if calibration is not None else None,
        port=options.port,
        http_port=options.http_port,
        capture_port=COMMAND_PORT if options.capture else 0,
    )
    # A shell starts what runs in its background with Ctrl-C ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        host = VehicleHost(setup, live=True)
    except PerchError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    with contextlib.closing(host):
        stream = host.stream.url if host.stream is not None else "none"
        positions = " ".join(host.capture or ("none",))
        print(
            f"vehicle {host.uri}\ncamera  {stream}\ncapture {positions}\nCtrl-C ends it",
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            Runner(host, None, realtime=True, linger_s=0.0).run()
    return 0


# --- How time passes in the simulated vehicle's process, and when it ends ----------------------
# - real time: paced by the wall clock; catches up after a hiccup, never runs ahead. While a flight
#   sets `SharedTime.limit_s`, it waits for the flight's loop and for its own pictures instead;
# - stepped: only the parent's `advance` moves time; between two of them the link is
#   answered, so that cflib connects without simulated time passing.
#
# When the parent is gone, however it went, the vehicle flies on in real time for
# `HostSetup.linger_s` and then ends, so that the firmware's reaction can be observed.


MAX_LAG_S = 1.0
"""A longer hiccup (a suspended computer) is cut off instead of being caught up with."""
_IDLE_S = 0.25
_BATCH = 50  # steps between two polls of the control connection while catching up


class Runner:
    """Runs one host until it is stopped or its parent has been gone for a while."""

    def __init__(
        self,
        host: VehicleHost,
        channel: Channel | None,
        *,
        realtime: bool,
        linger_s: float,
        clock: Callable[[], float] = time.monotonic,
        shared: SharedTime | None = None,
    ) -> None:
        self._host = host
        self._channel = channel
        self._realtime = realtime
        self._linger_s = linger_s
        self._clock = clock
        self._shared = shared or SharedTime()
        self._waiting_since_s: float | None = None
        self._limit_s = math.inf
        self._parent = os.getppid()
        self._end_s: float | None = None
        self._stopped = False
        self._origin_s = clock() - host.elapsed_s
        self._calls: dict[str, Callable[..., Any]] = {
            "advance": self._advance,
            "truth": host.truth,
            "set_pose": self._set_pose,
            "carry": lambda stops: host.vehicle.world.carry(stops),
            "let_go": lambda: host.vehicle.world.let_go(),
            "silence": lambda duration_s: host.endpoint.silence(host.elapsed_s, duration_s),
            "reboot": host.server.reboot,
            "replace_vehicle": host.replace_vehicle,
            "set_battery": self._set_battery,
            "push": self._push,
            "capture_fault": self._capture_fault,
            "stop": self._stop,
        }

    def run(self) -> None:
        while not self._stopped and not self._is_over():
            self._wait(self.catch_up() if self._realtime else _IDLE_S)

    def _restart_clock(self) -> None:
        self._origin_s = self._clock() - self._host.elapsed_s

    def catch_up(self) -> float:
        """Step up to now, some steps at most at once; how long to wait for the next step."""
        now_s = self._clock() - self._origin_s
        max_lag_s = MAX_LAG_S if math.isinf(self._shared.limit_s) else CLOCK_MARGIN_S
        if now_s - self._host.elapsed_s > max_lag_s:
            self._origin_s += now_s - self._host.elapsed_s - max_lag_s
            now_s = self._clock() - self._origin_s
        for _ in range(_BATCH):
            if self._host.elapsed_s + CONTROL_PERIOD_S > now_s:
                break
            if self._must_wait():
                return CONTROL_PERIOD_S
            self._host.step()
            self._shared.reached_s = self._host.elapsed_s
        next_s = self._origin_s + self._host.elapsed_s + CONTROL_PERIOD_S
        return max(0.0, next_s - self._clock())

    def _must_wait(self) -> bool:
        """True while the flight's loop or the picture has not kept up, for `LOOP_PATIENCE_S` at
        most: what hangs for good must not stop time."""
        limit_s, before_s = self._shared.limit_s, self._limit_s
        loop_late = self._host.elapsed_s >= limit_s
        if math.isinf(limit_s) or not (loop_late or self._host.picture_late_s > CLOCK_MARGIN_S):
            self._waiting_since_s = None
            return False
        now_s, self._limit_s = self._clock(), limit_s
        if self._waiting_since_s is None or (loop_late and limit_s != before_s):
            self._waiting_since_s = now_s  # the loop has given a sign of life
        return now_s - self._waiting_since_s < LOOP_PATIENCE_S

    def _wait(self, timeout_s: float) -> None:
        sockets = [self._host.endpoint.socket]
        if self._channel is not None:
            sockets.append(self._channel.socket)
        ready, _, _ = select.select(sockets, [], [], timeout_s)
        if self._host.endpoint.socket in ready:
            self._host.serve()
        if self._channel is not None and self._channel.socket in ready:
            self._answer(self._channel)

    def _answer(self, channel: Channel) -> None:
        """One request of the parent: (name, arguments) -> (True, result) or (False, text)."""
        try:
            name, arguments = channel.receive()
        except EOFError:
            self._lose_parent()
            return
        answer: tuple[bool, Any]
        try:
            answer = True, self._calls[name](**arguments)
        except Exception as error:
            answer = False, f"{type(error).__name__}: {error}"
        try:
            channel.send(answer)
        except OSError:
            self._lose_parent()

    def _is_over(self) -> bool:
        if self._channel is not None and os.getppid() != self._parent:
            self._lose_parent()
        return self._end_s is not None and self._clock() >= self._end_s

    def _lose_parent(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self._end_s = self._clock() + self._linger_s
        self._realtime = True
        self._shared = SharedTime()
        self._restart_clock()

    # --- the parent's requests ------------------------------------------------------

    def _advance(self, dt_s: float) -> float:
        if self._realtime:
            raise RuntimeError("only a stepped vehicle can be advanced")
        self._host.advance(dt_s)
        return self._host.elapsed_s

    def _set_pose(self, **where: Any) -> None:
        self._host.vehicle.world.set_pose(**where)

    def _set_battery(self, rest_v: float) -> None:
        self._host.vehicle.world.battery_rest_v = rest_v

    def _push(self, force_n: tuple[float, float, float]) -> None:
        self._host.vehicle.world.external_force_n = force_n

    def _capture_fault(self, fault: CaptureFault | None, for_s: float) -> None:
        capture = self._host.vehicle.capture
        if capture is None:
            raise RuntimeError("it was started without a motion capture")
        if fault is None:
            capture.heal()
        else:
            capture.lay(fault, for_s)

    def _stop(self) -> None:
        self._stopped = True
