"""The simulated vehicle by hand, and its bad links in this process."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from perchctl.errors import ConnectionFailed
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.process.__main__ import main
from perchctl.sim.process.handle import HostSetup
from perchctl.sim.process.host import VehicleHost
from tests.helpers.crtp_rig import ROOT, WAIT_S, pictures_of, wired


def received(mine: socket.socket) -> list[bytes]:
    """The datagrams that have arrived."""
    datagrams = []
    with contextlib.suppress(BlockingIOError):
        while True:
            datagrams.append(mine.recv(64))
    return datagrams


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
        assert len(pictures_of(stream, 1)) == 1
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
