"""Flight loops fed with a recorded flight instead of simulators: do they keep time, and what does
each part cost?

    python benchmarks/recorded_loops.py [-n 4] [--log FLIGHT.jsonl] [--seed 11]

Without `--log`, a simulated flight is recorded first, faster than real time; a log needs its
pictures beside it (`--record`). Then N loops fly it at once, each in a process of its own with the
real cflib, camera stream, planner, watchdog and log, as in `perchctl fleet fly`. One more process
plays the recording to them: to each a Crazyflie's end of the link on UDP and a camera on HTTP. They
show the last second before take-off until the loop's first setpoint, then the flight at its own
pace. Telemetry and pictures do not depend on what the loops command, so a loop may end otherwise
than the recorded flight.

For each loop: the gaps between two setpoints on the wall clock (p50, p99, largest), its end, and
the computing time of its parts, in cores, from the first tick to the last.
"""

from __future__ import annotations

import argparse
import bisect
import contextlib
import json
import math
import os
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.camera import decode_picture  # noqa: E402
from perchctl.flight import FlyOptions, fly_session  # noqa: E402
from perchctl.link import Packet, Port  # noqa: E402
from perchctl.mission import Phase, Tick, Watcher  # noqa: E402
from perchctl.profile import load_profile  # noqa: E402
from perchctl.record import LogWatcher, read_log  # noqa: E402
from perchctl.record.recorded import recorded_frames  # noqa: E402
from perchctl.record.write import recording_path  # noqa: E402
from perchctl.vehicle import PositionSetpoint, RawThrust, Telemetry  # noqa: E402

BEFORE_S = 1.0
"""Of the recording, shown again and again before take-off and after the end."""
JPEG_QUALITY = 92
READY_TIMEOUT_S, FLIGHT_TIMEOUT_S = 180.0, 300.0
MOST_P99_S, MOST_GAP_S = 0.060, 0.200
"""What the gaps between setpoints should stay below."""
POSITION = b"\x07"
"""First byte of a position setpoint."""
PARTS = ("vision", "perception", "mission", "link", "camera", "log", "rest")


# --- The recording ---


def log_values(sample: Telemetry) -> dict[str, float]:
    """Return the firmware's log variables from which the link made this sample."""
    values: dict[str, float] = {
        "stateEstimate.roll": math.degrees(sample.roll_rad),
        "stateEstimate.pitch": -math.degrees(sample.pitch_rad),
        "stateEstimate.yaw": math.degrees(sample.yaw_rad),
        "acc.x": sample.acc_x_g,
        "acc.y": sample.acc_y_g,
        "acc.z": sample.acc_z_g,
        "stabilizer.thrust": sample.thrust,
        "supervisor.info": sample.supervisor,
        "pm.vbat": sample.battery_v,
        "pm.state": sample.battery_state,
        "kalman.varX": sample.position_variance_m2 or 0.0,
        "kalman.varY": sample.position_variance_m2 or 0.0,
        "kalman.varZ": sample.height_variance_m2 or 0.0,
        "kalman.varPX": sample.velocity_variance_m2ps2 or 0.0,
        "kalman.varPY": sample.velocity_variance_m2ps2 or 0.0,
        "kalman.varPZ": sample.climb_variance_m2ps2 or 0.0,
    }
    for axis, place_m, speed_mps in zip("xyz", sample.position_m, sample.velocity_mps, strict=True):
        values[f"stateEstimate.{axis}"] = place_m
        values[f"stateEstimate.v{axis}"] = speed_mps
    for number, duty in enumerate(sample.motor_duty or (), 1):
        values[f"motor.m{number}"] = duty
    return values


@dataclass(frozen=True)
class Recorded:
    """A recorded flight; times are since its first setpoint, s.

    Attributes:
        samples: log variables by name, with their times.
        pictures: JPEGs, with their times of arrival.
    """

    samples_s: list[float]
    samples: list[dict[str, float]]
    pictures_s: list[float]
    pictures: list[bytes]

    @property
    def end_s(self) -> float:
        return min(self.samples_s[-1], self.pictures_s[-1])

    def at(self, t_s: float) -> float:
        """Return the time of the recording to show at `t_s`; after its end, the last `BEFORE_S`
        over and over."""
        if t_s > self.end_s:
            return self.end_s - BEFORE_S + (t_s - self.end_s) % BEFORE_S
        return t_s


def read_recorded(path: Path) -> Recorded:
    """Read a log and its pictures."""
    turns = read_log(path).turns
    began_s = next(turn.t_s for turn in turns if isinstance(turn.command, PositionSetpoint))
    samples = [sample for turn in turns for sample in turn.inputs.samples]
    samples.sort(key=lambda sample: sample.t_s)
    arrivals_s, pictures = [], []
    for about, picture in recorded_frames(recording_path(path)):
        if picture is not None:
            grey = decode_picture(picture.data)
            jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
            arrivals_s.append(about["t_arrival_s"] - began_s)
            pictures.append(jpeg.tobytes())
    return Recorded(
        [sample.t_s - began_s for sample in samples],
        [log_values(sample) for sample in samples],
        arrivals_s,
        pictures,
    )


def record_flight(folder: Path, seed: int) -> Path:
    """Fly a simulated flight, keep its pictures, and return its log."""
    from perchctl.flight import fly_lockstep

    path, profile = folder / "recorded.jsonl", load_profile("sim")
    log = LogWatcher.open_lockstep(path, profile, seed, record=True)
    flight = fly_lockstep(profile, seed, log)
    flight.close_log(log)
    print(f"recorded seed {seed}: {flight.final_phase.name}", flush=True)
    return path


# --- The process that plays it ---


class Stream(ThreadingHTTPServer):
    """A camera on loopback that shows the newest picture."""

    daemon_threads = True
    block_on_close = False

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.changed = threading.Condition()
        self.newest: tuple[int, bytes] = 0, b""
        self.url = f"http://127.0.0.1:{self.server_address[1]}/stream.mjpg"
        threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True).start()

    def newer_than(self, number: int) -> tuple[int, bytes]:
        """Wait for a picture newer than `number`; return it with its number."""
        with self.changed:
            self.changed.wait_for(lambda: self.newest[0] > number)
            return self.newest

    def show(self, jpeg: bytes) -> None:
        with self.changed:
            self.newest = self.newest[0] + 1, jpeg
            self.changed.notify_all()


class _Handler(BaseHTTPRequestHandler):
    server: Stream

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        number = 0
        with contextlib.suppress(OSError):
            while True:
                number, jpeg = self.server.newer_than(number)
                head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}"
                self.wfile.write(f"{head}\r\n\r\n".encode() + jpeg + b"\r\n")

    def log_message(self, format: str, *args: Any) -> None:
        return None


class Player:
    """Plays the recording to one loop: the vehicle's end of the link, and its camera."""

    def __init__(self, recorded: Recorded) -> None:
        from perchctl.sim import Scenario, SimulatedVehicle
        from perchctl.sim.crtp import CrtpServer
        from perchctl.sim.scenario import CONTROL_PERIOD_S

        self._recorded = recorded
        self._firmware = SimulatedVehicle(Scenario()).firmware  # answers, but never flies
        self._server = CrtpServer(self._firmware)
        self._period_s = CONTROL_PERIOD_S
        self._begun_s = time.monotonic()
        self._first_setpoint_s: float | None = None
        self._shown: int | None = None
        self._peer: tuple[str, int] | None = None
        self.stream = Stream()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self.socket.getsockname()[1]}"

    def take(self) -> None:
        """Answer the packets that have arrived."""
        with contextlib.suppress(BlockingIOError):
            while True:
                datagram, address = self.socket.recvfrom(64)
                packet = Packet.decode(datagram)
                if packet is None:
                    continue
                if datagram[0] != 0xFF:
                    self._peer = address
                kind = packet.port, packet.channel, packet.data[:1]
                if kind == (Port.COMMANDER_GENERIC, 0, POSITION) and not self._first_setpoint_s:
                    self._first_setpoint_s = time.monotonic()
                for answer in self._server.handle(packet):
                    self.socket.sendto(answer.encode(), address)

    def play(self, now_s: float) -> None:
        """Show what was seen and felt at this time."""
        recorded, first_s = self._recorded, self._first_setpoint_s
        waited_s = (now_s - self._begun_s) % BEFORE_S
        t_s = waited_s - BEFORE_S if first_s is None else recorded.at(now_s - first_s)
        sample = max(0, bisect.bisect(recorded.samples_s, t_s) - 1)
        self._firmware.log_overrides = recorded.samples[sample]
        self._firmware._steps = round((now_s - self._begun_s) / self._period_s)  # its clock
        picture = max(0, bisect.bisect(recorded.pictures_s, t_s) - 1)
        if picture != self._shown:
            self._shown = picture
            self.stream.show(recorded.pictures[picture])
        if self._peer is not None:
            for packet in self._server.due_packets():
                self.socket.sendto(packet.encode(), self._peer)


STEP_S = 0.005
"""Between two looks at what is due; the telemetry is sent every 10 ms."""


def play(path: Path, count: int) -> None:
    """Play a log to `count` loops until the standard input is closed; print the addresses first and
    the computing time last."""
    cv2.setNumThreads(1)
    recorded = read_recorded(path)
    players = [Player(recorded) for _ in range(count)]
    print(json.dumps([(each.uri, each.stream.url) for each in players]), flush=True)
    sockets = [each.socket for each in players]
    begun_s, begun_cpu_s = time.monotonic(), time.process_time()
    due_s = begun_s
    while True:
        ready, _, _ = select.select(
            [*sockets, sys.stdin], [], [], max(0.0, due_s - time.monotonic())
        )
        if sys.stdin in ready:
            break
        for each in players:
            if each.socket in ready:
                each.take()
        now_s = time.monotonic()
        if now_s >= due_s:
            for each in players:
                each.play(now_s)
            due_s = max(due_s + STEP_S, now_s)
    print((time.process_time() - begun_cpu_s) / (time.monotonic() - begun_s), flush=True)


# --- The process of one loop ---


class Meter(Watcher):
    """The gaps between the setpoints of a flight, and the computing time of its parts."""

    name = "the meter"
    problem: str | None = None

    def __init__(self) -> None:
        self.spent_s = dict.fromkeys(PARTS, 0.0)
        self.gaps_s: list[float] = []
        self._inner_s = 0.0
        self._setpoint_s: float | None = None
        self._first: tuple[float, dict[str, float]] | None = None
        self._last: tuple[float, dict[str, float]] = 0.0, {}

    def attach(self, owner: Any, name: str, part: str) -> None:
        """Count the calls of a function for a part, without those of other parts within."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            outer_s, self._inner_s = self._inner_s, 0.0
            begun_s = time.thread_time()
            try:
                return function(*arguments, **named)
            finally:
                took_s = time.thread_time() - begun_s
                self.spent_s[part] += took_s - self._inner_s
                self._inner_s = outer_s + took_s

        setattr(owner, name, timed)

    def tick(self, tick: Tick) -> None:
        now_s = time.monotonic()
        self._last = now_s, self._used_s()
        self._first = self._first or self._last
        if isinstance(tick.command, PositionSetpoint | RawThrust):
            if self._setpoint_s is not None:
                self.gaps_s.append(now_s - self._setpoint_s)
            self._setpoint_s = now_s
        else:
            self._setpoint_s = None

    def cores(self) -> dict[str, float]:
        """Return the computing time of each part over the time of the flight."""
        assert self._first is not None
        (first_s, before), (last_s, after) = self._first, self._last
        return {part: (after[part] - before[part]) / (last_s - first_s) for part in after}

    def _used_s(self) -> dict[str, float]:
        used = dict(self.spent_s)
        for thread in threading.enumerate():
            if thread is not threading.main_thread() and thread.ident is not None:
                with contextlib.suppress(OSError):  # it has just ended
                    clock = time.pthread_getcpuclockid(thread.ident)
                    used[_part_of(thread)] += time.clock_gettime(clock)
        used["rest"] = time.process_time() - sum(used[part] for part in PARTS if part != "rest")
        return used


def _part_of(thread: threading.Thread) -> str:
    """Return the part that a thread works for."""
    target: Any = getattr(thread, "_target", None)
    owner = getattr(target, "__self__", None)
    module = type(owner).__module__ if owner is not None else getattr(target, "__module__", "")
    words = f"{type(thread).__module__} {module} {thread.name}"
    for word, part in (
        ("perchctl.camera", "camera"),
        ("perchctl.record", "log"),
        ("perchctl.link", "link"),
        ("perchctl-", "link"),
        ("cflib", "link"),
    ):
        if word in words:
            return part
    return "rest"


def fly_loop(path: Path, uri: str, url: str, folder: Path) -> None:
    """Fly once; print "ready" before take-off, wait for a line, and print the result as JSON."""
    import perchctl.flight.inputs
    import perchctl.flight.loop
    import perchctl.perception.perception as perception

    meter = Meter()
    meter.attach(perception, "step", "vision")
    meter.attach(perception, "deinterlace", "vision")
    meter.attach(perchctl.flight.inputs.FlightInputs, "poll_inputs", "perception")
    meter.attach(perchctl.flight.inputs.FlightInputs, "observation", "perception")
    meter.attach(perchctl.flight.loop, "step_mission", "mission")
    for name in ("frame", "turn", "tick", "event"):
        meter.attach(LogWatcher, name, "log")
    profile = read_log(path).flown_profile
    options = FlyOptions(profile, path, uri, url, log_dir=folder)
    log = LogWatcher.open_real_time(folder, profile, uri, url)
    told = permitted = False

    def may_take_off(waiting: str) -> bool:
        nonlocal told, permitted
        if not waiting and not told:
            told = True
            print("ready", flush=True)
        permitted = permitted or bool(select.select([sys.stdin], [], [], 0.0)[0])
        return permitted

    report, _ = fly_session(options, (log, meter), may_take_off=may_take_off)
    log.close(report, None)
    cuts = statistics.quantiles(meter.gaps_s, n=100, method="inclusive")
    print(
        json.dumps(
            {
                "end": report.phase.name,
                "reason": report.reason,
                "gaps_s": [cuts[49], cuts[98], max(meter.gaps_s)],
                "cores": meter.cores(),
            }
        ),
        flush=True,
    )


# --- All of them ---


@contextlib.contextmanager
def started(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run this script with these words; end it with the block."""
    command = [sys.executable, str(Path(__file__).resolve()), *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def line_of(process: subprocess.Popen[str], timeout_s: float) -> str:
    """Return the next line of a process. Raises SystemExit if it ends or is silent."""
    assert process.stdout is not None
    if not select.select([process.stdout], [], [], timeout_s)[0]:
        raise SystemExit(f"process {process.pid} is silent")
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"process {process.pid} has ended without its result")
    return line


def fly_recorded(count: int, path: Path | None, seed: int) -> None:
    """Let `count` loops fly a log at once, and print their gaps and computing time.

    Without a log, a flight with this seed is recorded first."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = path or record_flight(folder, seed)
        player = stack.enter_context(started("--play", path, "-n", count))
        addresses = json.loads(line_of(player, READY_TIMEOUT_S))
        loops = [
            stack.enter_context(started("--fly", path, uri, url, folder / str(number)))
            for number, (uri, url) in enumerate(addresses)
        ]
        for loop in loops:
            line_of(loop, READY_TIMEOUT_S)
        for loop in loops:
            assert loop.stdin is not None
            loop.stdin.write("go\n")
            loop.stdin.flush()
        results = [json.loads(line_of(loop, FLIGHT_TIMEOUT_S)) for loop in loops]
        assert player.stdin is not None
        player.stdin.close()
        player_cores = float(line_of(player, READY_TIMEOUT_S))
    print_results(results, player_cores)
    gaps_s = [result["gaps_s"] for result in results]
    keep = sum(p99_s < MOST_P99_S and most_s < MOST_GAP_S for _, p99_s, most_s in gaps_s)
    limits = f"p99 below {1e3 * MOST_P99_S:.0f} ms and none above {1e3 * MOST_GAP_S:.0f} ms"
    print(f"{keep} of {count} loops with gaps of {limits}", flush=True)


def print_results(results: Sequence[Mapping[str, Any]], player_cores: float) -> None:
    """Print a line for each loop."""
    print(f"{'loop':<6}{'gaps p50':>9}{'p99':>6}{'most':>6} ms  cores{'all':>6}", end="")
    print("".join(f"{part:>11}" for part in PARTS), " end")
    for number, result in enumerate(results, 1):
        gaps = "".join(
            f"{1e3 * gap_s:>{w}.0f}" for gap_s, w in zip(result["gaps_s"], (9, 6, 6), strict=True)
        )
        cores = result["cores"]
        parts = "".join(f"{cores[part]:>11.3f}" for part in PARTS)
        reason = "" if result["end"] == Phase.PERCHED.name else f": {result['reason']}"
        end = f"{result['end']}{reason}"
        print(f"{number:<6}{gaps}          {sum(cores.values()):>6.2f}{parts}  {end}")
    total = sum(sum(result["cores"].values()) for result in results)
    print(
        f"{total:.2f} cores for {len(results)} loops, {player_cores:.2f} for the recording, ",
        end="",
    )
    print(f"load {os.getloadavg()[0]:.1f}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=4, help="loops at once")
    parser.add_argument("--log", type=Path, help="recorded flight, with its pictures beside it")
    parser.add_argument("--seed", type=int, default=11, help="of the flight that is recorded")
    parser.add_argument("--play", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--fly", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.play is not None:
        play(given.play, given.n)
    elif given.fly is not None:
        path, uri, url, folder = given.fly
        fly_loop(Path(path), uri, url, Path(folder))
    else:
        fly_recorded(given.n, given.log, given.seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
