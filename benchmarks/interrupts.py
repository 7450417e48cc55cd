"""The operator's orders in simulated flights through the real cflib, in real time.

    python benchmarks/interrupts.py [--seed 2] [--repeat 3]

First Ctrl-C in each phase: starts `perchctl fly` once a phase, waits until its panel-less output
names the phase, interrupts it, and prints exit code, last phase, and whether the supervisor locked.
Expected of every row: exit 130, landed (or hanging with the motors off), not locked.

Then the time from a key to the packet that cuts the motors: `perchctl fly --view` in a terminal of
its own, with a wire between cflib and the vehicle that notes when the emergency stop passes. Keys
are typed into that terminal; the page's button is pressed as a browser does it. The time counts
from the press that decides: the only one of the space bar and of the button, the second of two, the
third of more. Expected of every row: exit 53, within `LATEST_MS`.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import math
import os
import re
import select
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

from perchctl.calibration import profile_camera
from perchctl.link import Packet, Port
from perchctl.mission.phase import PUBLISHED_METHOD_PHASES
from perchctl.profile import load_profile
from perchctl.record import read_log
from perchctl.sim import SimProcess, draw_scenario
from perchctl.vehicle import LOCKED

TIMEOUT_S = 120.0
SHOWN = 2000
"""Characters of a terminal that are shown of a flight that has failed."""
CTRL_C, SPACE = "\x03", " "
EMERGENCY_STOP = Packet(Port.SUPERVISOR, 1, bytes((3,)))
POSITION, LAND_2 = 7, 8
"""First bytes of a position setpoint, and of the high-level commander's landing order."""
WAYS: dict[str, tuple[tuple[float, str], ...]] = {
    "space bar": ((0.0, SPACE),),
    "Cut motors on the page": ((0.0, "cut"),),
    "Ctrl-C twice, 0.35 s apart": ((0.0, CTRL_C), (0.35, CTRL_C)),
    "Ctrl-C twice, 1.5 s apart": ((0.0, CTRL_C), (1.5, CTRL_C)),
    "Ctrl-C hammered, 4 Hz": tuple((0.25 * k, CTRL_C) for k in range(3)),
    "Ctrl-C hammered, 8 Hz": tuple((0.125 * k, CTRL_C) for k in range(3)),
}
"""When what is pressed; the last press decides."""
LATEST_MS = 400.0


def interrupt_in(phase: str, seed: int, folder: Path) -> tuple[int, str, bool]:
    """Exit code, last phase and lock of a flight interrupted when it enters `phase`."""
    flight = subprocess.Popen(
        [sys.executable, "-m", "perchctl", "fly", "--seed", str(seed), "--log-dir", str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert flight.stderr is not None
    for line in flight.stderr:
        if f"] {phase}:" in line:
            flight.send_signal(signal.SIGINT)
            break
    flight.stderr.read()
    code = flight.wait(TIMEOUT_S)
    log = read_log(max(folder.glob("*.jsonl"), key=lambda path: path.stat().st_mtime))
    last = log.records[-1]
    return code, str(last["phase"]), bool(int(last["supervisor"]) & LOCKED)


# --- from a key to the packet ---


class Wire:
    """UDP between cflib and the vehicle; `stopped_s` is when the first emergency stop passed,
    `orders_s` has when each order to be at a height passed, the vehicle's own landing included."""

    def __init__(self, vehicle_uri: str) -> None:
        host, _, port = vehicle_uri.removeprefix("udp://").rpartition(":")
        self._vehicle = host, int(port)
        self._near, self._far = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self._near.getsockname()[1]}"
        self.stopped_s: float | None = None
        self.orders_s: list[float] = []
        self._closed = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._near.close()
        self._far.close()

    def _run(self) -> None:
        client = None
        while not self._closed:
            for end in select.select([self._near, self._far], [], [], 0.05)[0]:
                with contextlib.suppress(OSError):
                    datagram, sender = end.recvfrom(128)
                    if end is self._far and client is not None:
                        self._near.sendto(datagram, client)
                    elif end is self._near:
                        client = sender
                        self._note(Packet.decode(datagram))
                        self._far.sendto(datagram, self._vehicle)

    def _note(self, packet: Packet | None) -> None:
        if self.stopped_s is None and packet == EMERGENCY_STOP:
            self.stopped_s = time.monotonic()
        if packet is None or not packet.data:
            return
        kind = packet.port, packet.data[0]
        if kind in ((Port.HIGH_LEVEL, LAND_2), (Port.COMMANDER_GENERIC, POSITION)):
            self.orders_s.append(time.monotonic())

    def ordered_after_s(self, t_s: float) -> float:
        """When the first order to be at a height passed at `t_s` or later; inf if none did."""
        return next((at_s for at_s in list(self.orders_s) if at_s >= t_s), math.inf)


class TerminalFlight:
    """`perchctl` with `words` in a terminal of its own, which is read until the flight ends, except
    while `paused` is set."""

    def __init__(self, *words: str) -> None:
        self._ours, theirs = os.openpty()
        take_terminal = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)"
        run = "import sys; from perchctl.__main__ import main; sys.exit(main())"
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"{take_terminal}\n{run}", *words],
            stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        self.shown = ""
        self.paused = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def wait_for(self, pattern: str) -> str:
        """The first text shown that fits."""
        end_s = time.monotonic() + TIMEOUT_S
        while (found := re.search(pattern, self.shown)) is None:
            if time.monotonic() > end_s or self.process.poll() is not None:
                raise SystemExit(f"{pattern!r} never came:\n{self.shown[-SHOWN:]}")
            time.sleep(0.01)
        return found.group()

    def press(self, what: str) -> None:
        if what != "cut":
            os.write(self._ours, what.encode())
            return
        url = urlsplit(self.wait_for(r"http://127[^\s]+token=[\w-]+"))
        page = http.client.HTTPConnection(url.netloc, timeout=5.0)
        token = {"X-Perchctl-Token": url.query.removeprefix("token=")}
        page.request("POST", "/cut", headers=token)
        page.getresponse().read()
        page.close()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while piece := os.read(self._ours, 65536):
                self.shown += piece.decode(errors="replace")
                while self.paused.is_set():
                    time.sleep(0.01)


@contextlib.contextmanager
def started_vehicle(
    seed: int, target_xy_m: tuple[float, float] | None = None
) -> Iterator[tuple[Wire, str]]:
    """A wire to a simulated vehicle, and the address of its camera's stream. `target_xy_m`: where
    its target hangs, instead of where the seed says."""
    profile = load_profile("sim")
    scenario, camera = draw_scenario(profile, seed), profile_camera(profile.camera)
    if target_xy_m is not None:
        scenario = replace(scenario, target_xy_m=target_xy_m)
    with (
        SimProcess.start(scenario, camera=camera, target=profile.target) as vehicle,
        contextlib.closing(Wire(vehicle.uri)) as wire,
    ):
        yield wire, vehicle.stream_url


def key_to_packet_ms(way: str, seed: int, folder: Path) -> tuple[float, int]:
    """From the deciding press to the packet, ms, and the flight's exit code."""
    with started_vehicle(seed) as (wire, stream):
        words = ("--yes", "--uri", wire.uri, "--source", stream, "--log-dir", str(folder))
        flight = TerminalFlight("fly", "--view", *words)
        flight.wait_for(r"\] SEARCH:")
        begun_s = pressed_s = time.monotonic()
        for at_s, what in WAYS[way]:
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            if wire.stopped_s is not None:
                raise SystemExit(f"{way}: stopped before the press that decides")
            pressed_s = time.monotonic()
            flight.press(what)
        code = flight.process.wait(TIMEOUT_S)
        if wire.stopped_s is None:
            return float("inf"), code
        return 1e3 * (wire.stopped_s - pressed_s), code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3, help="flights for each way to cut")
    options = parser.parse_args()
    good = True
    with tempfile.TemporaryDirectory() as folder:
        print(f"{'key to packet':<28} {'median':>9} {'most':>9}  exit")
        for way in WAYS:
            found = [
                key_to_packet_ms(way, options.seed, Path(folder)) for _ in range(options.repeat)
            ]
            times_ms, codes = [ms for ms, _ in found], {code for _, code in found}
            good = good and codes == {53} and max(times_ms) <= LATEST_MS
            print(
                f"{way:<28} {statistics.median(times_ms):>6.0f} ms {max(times_ms):>6.0f} ms  "
                f"{', '.join(map(str, sorted(codes)))}",
                flush=True,
            )
        print(f"\n{'Ctrl-C in':<10} {'exit':>4}  {'ended':<8} locked")
        for phase in PUBLISHED_METHOD_PHASES:
            code, ended, locked = interrupt_in(phase.value, options.seed, Path(folder))
            good = good and code == 130 and ended in ("LANDED", "PERCHED") and not locked
            print(f"{phase.value:<10} {code:>4}  {ended:<8} {locked}", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
