"""The simulated vehicle's process: start, paces, video, and what happens without a parent."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import perchctl
from perchctl.calibration.files import load_calibration
from perchctl.errors import ConnectionFailed, InvalidValue, NotFound
from perchctl.profile.places import data_file
from perchctl.sim.crtp.codec import Packet, Port
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.process.child import main
from perchctl.sim.process.control import HostSetup
from perchctl.sim.process.handle import SimProcess
from perchctl.sim.process.host import VehicleHost
from perchctl.sim.process.mjpeg import MjpegServer
from perchctl.sim.process.runner import MAX_LAG_S, Runner
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.vision.types import CameraModel
from tests.helpers.crtp_rig import Client

ROOT = str(Path(perchctl.__file__).resolve().parents[1])
WAIT_S = 20.0


def eventually(condition: Callable[[], bool], limit_s: float = WAIT_S) -> bool:
    """Polls what another process does; bounded."""
    end_s = time.monotonic() + limit_s
    tick = threading.Event()
    while not condition():
        if time.monotonic() > end_s:
            return False
        tick.wait(0.02)
    return True


def alive(pid: int) -> bool:
    """A process that still runs; one that only waits to be collected does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rsplit(")", 1)[1].split()[0] != "Z"


@pytest.fixture(scope="module")
def camera() -> CameraModel:
    path = data_file("calib", "example_640x480")
    if path is None:
        raise NotFound("the shipped calibration is missing")
    return load_calibration(path)


@pytest.fixture(scope="module")
def stepped() -> Iterator[SimProcess]:
    """A process for the tests that leave it running."""
    with SimProcess.start(pace="stepped") as sim:
        assert sim.truth()["t_s"] == 0.0
        yield sim


@pytest.fixture(scope="module")
def live() -> Iterator[tuple[SimProcess, float]]:
    """A process in real time, and the clock before its start."""
    before_s = time.monotonic()
    with SimProcess.start(pace="realtime") as sim:
        yield sim, before_s


@contextlib.contextmanager
def wired(uri: str) -> Iterator[socket.socket]:
    """A socket to a vehicle's link: one datagram, one packet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.connect(("127.0.0.1", int(uri.rsplit(":", 1)[1])))
        mine.setblocking(False)
        yield mine


def received(mine: socket.socket) -> list[bytes]:
    """The datagrams that have arrived."""
    datagrams = []
    with contextlib.suppress(BlockingIOError):
        while True:
            datagrams.append(mine.recv(64))
    return datagrams


# --- Handle -----------------------------------------------------------------------


def test_stepped_time_passes_only_by_advance(stepped: SimProcess) -> None:
    assert stepped.uri.startswith("udp://127.0.0.1:")
    assert stepped.stream_url == ""
    start_s = stepped.truth()["t_s"]
    assert stepped.truth()["t_s"] == start_s
    assert stepped.advance(0.5) == pytest.approx(start_s + 0.5)
    assert stepped.truth()["t_s"] == pytest.approx(start_s + 0.5)
    with pytest.raises(InvalidValue, match="back"):
        stepped.advance(-0.1)


def test_the_same_scenario_gives_the_same_flight(stepped: SimProcess) -> None:
    """In a process of its own, and as a new vehicle in one that has flown others."""
    scenario = Scenario(seed=11)

    def flight(sim: SimProcess) -> dict[str, object]:
        sim.advance(1.0)
        with wired(sim.uri) as mine:
            data = struct.pack("<BBff?f", 7, 0, 0.5, 0.0, True, 2.0)  # takeoff_2
            mine.send(Packet(Port.HIGH_LEVEL, 0, data).encode())
            sim.advance(4.0)
        truth = sim.truth()
        assert truth["position_m"][2] > 0.3
        return truth

    start_s = stepped.truth()["t_s"]
    stepped.replace_vehicle(scenario)
    replaced = flight(stepped)
    assert replaced.pop("t_s") == pytest.approx(start_s + 5.0)
    with SimProcess.start(scenario, "stepped") as sim:
        new = flight(sim)
    assert new.pop("t_s") == pytest.approx(5.0)
    assert new == replaced


def test_hooks_change_the_vehicle(stepped: SimProcess) -> None:
    sim = stepped
    sim.replace_vehicle(Scenario())
    sim.set_pose((0.1, 0.2, 1.0), (0.0, 0.0, 0.5), hold=True)
    sim.advance(0.1)
    truth = sim.truth()
    assert truth["position_m"] == pytest.approx((0.1, 0.2, 1.0))
    assert truth["rpy_rad"][2] == pytest.approx(0.5)
    sim.let_go()
    sim.advance(0.2)
    assert sim.truth()["position_m"][2] < 0.9
    sim.replace_vehicle(Scenario(mass_kg=0.03))
    assert sim.truth()["position_m"][2] < 0.05
    sim.set_battery(3.5)
    sim.push((0.1, 0.0, 0.0))
    sim.advance(0.5)
    assert sim.truth()["battery_v"] == pytest.approx(3.5, abs=0.01)
    before_s = sim.truth()["t_s"]
    sim.reboot()
    assert sim.truth()["t_s"] == before_s


def test_a_request_that_fails_is_reported_and_harmless(live: tuple[SimProcess, float]) -> None:
    sim, _ = live
    with pytest.raises(InvalidValue, match="only a stepped vehicle"):
        sim.advance(1.0)
    now_s = sim.truth()["t_s"]
    assert eventually(lambda: sim.truth()["t_s"] > now_s + 0.1)


def test_real_time_never_runs_ahead(live: tuple[SimProcess, float]) -> None:
    sim, before_s = live
    assert eventually(lambda: sim.truth()["t_s"] > 0.5)
    simulated_s = sim.truth()["t_s"]
    assert simulated_s <= time.monotonic() - before_s


class _Steps:
    """Counts steps; stands in for a vehicle where only the pace matters."""

    elapsed_s = 0.0

    def __getattr__(self, _: str) -> object:
        return self

    def step(self) -> None:
        self.elapsed_s += CONTROL_PERIOD_S


def test_real_time_catches_up_and_cuts_long_hiccups() -> None:
    now_s = [100.0]
    host = _Steps()
    runner = Runner(host, None, realtime=True, linger_s=0.0, clock=lambda: now_s[0])  # type: ignore[arg-type]

    def settle() -> float:
        while (wait_s := runner.catch_up()) == 0.0:
            assert host.elapsed_s <= now_s[0] - 100.0 + 1e-9
        return wait_s

    now_s[0] += 0.0101
    assert settle() == pytest.approx(0.0019)
    assert host.elapsed_s == pytest.approx(0.010)
    now_s[0] += 0.7  # a hiccup
    settle()
    assert host.elapsed_s == pytest.approx(0.710)
    now_s[0] += 3600.0  # a suspended computer
    settle()
    assert host.elapsed_s == pytest.approx(0.710 + MAX_LAG_S, abs=0.003)


def test_stop_ends_the_process_and_frees_the_port() -> None:
    sim = SimProcess.start(pace="stepped")
    port = int(sim.uri.rsplit(":", 1)[1])
    sim.stop()
    sim.stop()
    assert not sim.is_running()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.bind(("127.0.0.1", port))
    with pytest.raises(ConnectionFailed, match="ended"):
        sim.truth()


def test_a_taken_port_is_a_clear_error() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.bind(("127.0.0.1", 0))
        port = mine.getsockname()[1]
        with pytest.raises(ConnectionFailed, match=f"UDP port {port} .* choose another"):
            SimProcess.start(pace="stepped", port=port)


def test_a_child_that_dies_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(ConnectionFailed, match="ended with code"):
        SimProcess.start(pace="stepped")


def test_an_unknown_pace_is_refused() -> None:
    with pytest.raises(InvalidValue, match="'realtime' or 'stepped'"):
        SimProcess.start(pace="slow")  # type: ignore[arg-type]


def test_a_killed_child_is_reported() -> None:
    sim = SimProcess.start(pace="stepped")
    os.kill(sim.pid, signal.SIGKILL)
    with pytest.raises(ConnectionFailed, match="has ended"):
        sim.advance(0.1)
    sim.stop()


# --- Without a parent ----------------------------------------------------------------

_PARENT = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from perchctl.sim.process.control import HostSetup
from perchctl.sim.process.handle import SimProcess
from perchctl.sim.process.host import VehicleHost
started = []
for pace in ("realtime", "stepped"):
    sim = SimProcess.start(pace=pace, truth_file=Path({folder!r}, pace), linger_s=3.0)
    print(pace, sim.pid, sim.uri, flush=True)
    started.append(sim)
sys.stdin.readline()
"""


@pytest.mark.long
def test_flies_on_when_the_parent_is_killed(tmp_path: Path, toc_cache: str) -> None:
    """The vehicle outlives a kill -9 of its parent, answers meanwhile, and then ends."""
    code = _PARENT.format(root=ROOT, folder=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        started = [parent.stdout.readline().split() for _ in range(2)]
        parent.kill()
        parent.wait()
        for _, pid, uri in started:
            client = Client(uri, toc_cache)
            assert client.connect()
            assert alive(int(pid))
            client.close()
    for pace, pid, _ in started:
        assert eventually(lambda pid=pid: not alive(int(pid)))
        lines = [json.loads(line) for line in (tmp_path / pace).read_text().splitlines()]
        assert lines[-1]["t_s"] > 1.0
        assert lines[-1]["supervisor_info"] == 0x020E


def test_ctrl_c_does_not_reach_the_vehicle(stepped: SimProcess) -> None:
    """Neither SIGINT itself nor one to the terminal's process group ends it."""
    assert os.getsid(stepped.pid) != os.getsid(0)
    os.kill(stepped.pid, signal.SIGINT)
    before_s = stepped.truth()["t_s"]
    assert stepped.advance(0.1) == pytest.approx(before_s + 0.1)
    assert stepped.is_running()


def test_a_foreign_connection_cannot_take_the_parents_place() -> None:
    """A connection without the token is closed before anything is unpickled."""
    from perchctl import children

    with children.listen() as listener:
        foreign = socket.create_connection(listener.getsockname())
        foreign.sendall(b"0" * 64)
        connection = socket.create_connection(listener.getsockname())
        connection.sendall(b"f" * 64)
        friend = children.Channel(connection)
        channel = children.accept(listener, "f" * 64, 5.0, lambda: True)
        assert channel is not None
        friend.send({"a": 1})
        assert channel.receive(5.0) == {"a": 1}
        friend.close()
        with pytest.raises(EOFError):
            channel.receive(5.0)
        channel.close()
        foreign.close()


# --- Video ----------------------------------------------------------------------------


def _parts(url: str, count: int) -> list[np.ndarray]:
    """The first pictures of a stream, decoded."""
    pictures = []
    with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
        assert answer.headers.get_content_type() == "multipart/x-mixed-replace"
        while len(pictures) < count:
            line = answer.readline()
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
                answer.readline()
                raw = np.frombuffer(answer.read(length), np.uint8)
                pictures.append(cv2.imdecode(raw, cv2.IMREAD_UNCHANGED))
    return pictures


def test_newest_picture_wins_for_several_clients() -> None:
    server = MjpegServer()
    try:
        for grey in (10, 100, 200):
            server.publish(np.full((48, 64), grey, np.uint8))
        results: list[list[np.ndarray]] = []
        watchers = [
            threading.Thread(target=lambda: results.append(_parts(server.url, 1))) for _ in range(3)
        ]
        for watcher in watchers:
            watcher.start()
        for watcher in watchers:
            watcher.join(WAIT_S)
        assert len(results) == 3
        for (picture,) in results:
            assert picture.shape == (48, 64)  # grey
            assert abs(float(picture.mean()) - 200) < 2
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(server.url.replace("stream", "other"), timeout=WAIT_S)
        refused.value.close()
        assert refused.value.code == 404
    finally:
        server.close()


def test_a_taken_http_port_is_a_clear_error() -> None:
    server = MjpegServer()
    try:
        port = int(server.url.split(":")[2].split("/")[0])
        with pytest.raises(ConnectionFailed, match="choose another"):
            MjpegServer(port)
    finally:
        server.close()


def test_the_vehicles_picture_is_streamed(camera: CameraModel) -> None:
    """In real time, rendering in its own thread; a stock reader opens it too."""
    with SimProcess.start(Scenario(seed=1), "realtime", camera=camera) as sim:
        pictures = _parts(sim.stream_url, 3)
        width, height = camera.size_px
        assert all(p.shape == (height, width) for p in pictures)
        assert all(p.std() > 3.0 for p in pictures)
        assert any(not np.array_equal(pictures[0], p) for p in pictures[1:])  # noise, motion
        capture = cv2.VideoCapture(sim.stream_url, cv2.CAP_FFMPEG)
        ok, frame = capture.read()
        capture.release()
        assert ok
        assert frame.shape[:2] == (height, width)


def test_stepped_pictures_come_with_the_time(camera: CameraModel) -> None:
    with SimProcess.start(Scenario(seed=1), "stepped", camera=camera) as sim:
        sim.advance(0.3)
        (first,) = _parts(sim.stream_url, 1)
        (again,) = _parts(sim.stream_url, 1)
        assert np.array_equal(first, again)
        sim.advance(0.1)
        (later,) = _parts(sim.stream_url, 1)
        assert not np.array_equal(first, later)


# --- By hand -----------------------------------------------------------------------------


def test_standalone_runs_until_ctrl_c() -> None:
    command = [sys.executable, "-m", "perchctl.sim.process", "--port", "0", "--http-port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": ROOT}
    ) as process:
        assert process.stdout is not None
        uri = process.stdout.readline().split()[1]
        stream = process.stdout.readline().split()[1]
        assert uri.startswith("udp://127.0.0.1:")
        assert len(_parts(stream, 1)) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 0


def test_standalone_reports_when_its_port_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.bind(("127.0.0.1", 0))
        port = mine.getsockname()[1]
        assert main(["--port", str(port), "--http-port", "0"]) == ConnectionFailed.exit_code
    assert "choose another" in capsys.readouterr().err


# --- Bad links, in this process ------------------------------------------------------------


@contextlib.contextmanager
def hosted(link: LinkOptions) -> Iterator[VehicleHost]:
    with contextlib.closing(VehicleHost(HostSetup(link=link), live=False)) as host:
        yield host


def test_lossy_link_is_the_same_for_a_seed() -> None:
    """Loss is drawn by its own seed: the same packets are lost in each run."""

    def answered(seed: int) -> list[int]:
        with (
            hosted(LinkOptions(loss_rate=0.3, loss_seed=seed)) as host,
            wired(host.uri) as mine,
        ):
            for number in range(40):
                mine.send(bytes((0xFC, number)))
            host.step()  # all have been served by its end
            return [datagram[1] for datagram in received(mine)]

    first = answered(1)
    assert 5 < len(first) < 35
    assert answered(1) == first
    assert answered(2) != first


def test_silence_at_a_given_time() -> None:
    """The peer goes silent by the simulated clock and comes back."""
    link = LinkOptions(silent_from_s=0.2, silent_for_s=0.1)
    with hosted(link) as host, wired(host.uri) as mine:
        for number, answers in ((1, True), (2, False), (3, True)):
            mine.send(bytes((0xFC, number)))
            host.serve()
            assert (bytes((0xFC, number)) in received(mine)) == answers
            host.advance(0.21 if number == 1 else 0.1)
